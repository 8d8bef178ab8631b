"""Run chains of NumPyro's and BlackJAX's samplers over the points of a log-density."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxrock._core.arrays import shown
from jaxrock.inverse.densities import LogDensity

_ROUND = 250  # steps between two checks of the diagnostics
_WARM_UP = 2  # rounds that are discarded; a kernel of NumPyro adapts in them


class Steps(NamedTuple):
    """Points (steps, chains, parameters), log-densities there (None if not reported), and the number of gradients."""

    points: np.ndarray
    log_density: np.ndarray | None
    gradients: int


def rounds_of(make: Callable, density: LogDensity, points: np.ndarray, seed: int):
    """Return an endless generator of rounds of the sampler `make(density)`, started at points, (chains, parameters).

    **Raises:** ValueError unless the sampler is a kernel of NumPyro with a `potential_fn`, or an algorithm of BlackJAX
    whose states have a position.
    """
    sampler = make(density)
    if hasattr(sampler, "sample") and hasattr(sampler, "get_diagnostics_str"):
        if getattr(sampler, "model", None) is not None:
            raise ValueError("Argument `sampler` must make a kernel with a `potential_fn`, but makes one of a model.")
        return _by_numpyro(sampler, points, seed)
    if callable(getattr(sampler, "init", None)) and callable(getattr(sampler, "step", None)):
        return _by_blackjax(sampler, points, seed)
    said = "make a kernel of NumPyro or an algorithm of BlackJAX of a log-density"
    raise ValueError(f"Argument `sampler` must {said}, but makes {shown(sampler)}.")


def _by_numpyro(kernel: Any, points: np.ndarray, seed: int):
    from numpyro.infer import MCMC

    settings = {"num_chains": len(points), "chain_method": "vectorized", "progress_bar": False}
    chains = MCMC(kernel, num_warmup=_WARM_UP * _ROUND, num_samples=_ROUND, **settings)
    key, fields = jax.random.key(seed), ("potential_energy", "num_steps")
    while True:
        chains.run(key, init_params=jnp.asarray(points), extra_fields=fields)
        found = chains.get_samples(group_by_chain=True)
        told = chains.get_extra_fields(group_by_chain=True)
        density = np.asarray(-told["potential_energy"]).T if "potential_energy" in told else None
        count = int(np.sum(told.get("num_steps", found.shape[0] * found.shape[1])))
        yield Steps(np.asarray(found).swapaxes(0, 1), density, count)
        chains.post_warmup_state = chains.last_state
        key = chains.post_warmup_state.rng_key


def _by_blackjax(algorithm: Any, points: np.ndarray, seed: int):
    @jax.jit
    def one_round(state, key):
        def step(state, key):
            state, info = jax.vmap(algorithm.step)(jax.random.split(key, len(points)), state)
            gradients = jnp.sum(getattr(info, "num_integration_steps", jnp.ones(len(points), int)))
            return state, (state.position, getattr(state, "logdensity", None), gradients)

        return jax.lax.scan(step, state, jax.random.split(key, _ROUND))

    state = jax.jit(jax.vmap(algorithm.init))(jnp.asarray(points))
    if not hasattr(state, "position"):
        raise ValueError("Argument `sampler` must make chains with a position, but BlackJAX's state has none.")
    key, number = jax.random.key(seed), 0
    while True:
        state, (positions, density, gradients) = one_round(state, jax.random.fold_in(key, number))
        number += 1
        if number > _WARM_UP:
            yield Steps(np.asarray(positions), None if density is None else np.asarray(density), int(gradients.sum()))
