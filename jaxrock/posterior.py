"""Samples of the posterior distribution of a motion's parameters, by Hamiltonian Monte Carlo (NumPyro, an extra)."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Inexact

from jaxrock.engine import AbstractEngine
from jaxrock.inverse import Estimate
from jaxrock.likelihood import Likelihood
from jaxrock.models import Housner, Model
from jaxrock.observations import Observations
from jaxrock.problem import Problem, Unknown

Real = Inexact[Array, "..."]


class PosteriorStatus(eqx.Enumeration):
    """Whether samples can be trusted; `PosteriorStatus[posterior.status]` is the message."""

    successful = "The chains agree, and hold enough independent samples."
    few_samples = "The effective sample size is below 400: take more samples."
    chains_differ = "The chains do not agree (R-hat above 1.01): take more samples, or look at the maxima one by one."


class Posterior(eqx.Module):
    """Samples of a posterior distribution.

    - `names`: the parameters; `samples`: (chains, samples, parameters), in their units.
    - `log_density`: (chains, samples) log-likelihood and log-prior, by the logarithms of the parameters.
    - `effective_size`, `r_hat`: (parameters,) of each parameter's own chains.
    - `divergences`: how many steps left the energy surface; the likelihood's jumps cause some.
    - `status`: a `PosteriorStatus`.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    samples: Real
    log_density: Real
    effective_size: Real
    r_hat: Real
    divergences: int = eqx.field(static=True)
    status: PosteriorStatus

    def interval(self, share: float = 0.95) -> Real:
        """(parameters, 2) intervals that leave equal shares of the samples on both sides."""
        flat = self.samples.reshape(-1, len(self.names))
        return jnp.quantile(flat, jnp.array([(1 - share) / 2, (1 + share) / 2]), axis=0).T


def sample_motion(
    observations: Observations,
    motion: Callable,
    unknowns: dict[str, Unknown],
    scatter: ArrayLike = 0.3,
    *,
    estimate: Estimate | None = None,
    chains: int = 4,
    samples: int = 600,
    warmup: int = 300,
    seed: int = 0,
    model: Model = Housner(),
    engine: AbstractEngine | None = None,
    progress: bool = False,
) -> Posterior:
    """Sample the parameters of a motion given rocks, with NumPyro's No-U-Turn sampler.

    Priors are those of the `Unknown`s, uniform over their ranges where they have none: the posterior is proper even
    where the observations tell nothing, and then as wide as the ranges.

    **Arguments:**

    - `observations`, `motion`, `unknowns`, `scatter`, `model`, `engine`: as in `estimate_motion`.
    - `estimate`: where chains begin: at the best maxima that it found. None: spread over the middle of the ranges.
    - `chains`, `samples`, `warmup`: number of chains, at least 2, of samples of each, and of steps before them.
    - `seed`: of the random numbers.
    - `progress`: whether to draw NumPyro's progress bar.

    **Returns:** a `Posterior`.

    **Raises:** ValueError for arguments outside their ranges; ImportError without NumPyro (`pip install
    "jaxrock[posterior]"`).

    **Source:** Hoffman & Gelman (2014), the sampler; Vehtari et al. (2021), the diagnostics.
    """
    try:
        from numpyro.diagnostics import effective_sample_size, split_gelman_rubin
        from numpyro.infer import MCMC, NUTS
    except ImportError as error:
        raise ImportError('Sampling needs NumPyro: pip install "jaxrock[posterior]".') from error
    for name, value, least in (("chains", chains, 2), ("samples", samples, 4), ("warmup", warmup, 1)):
        if value < least:
            raise ValueError(f"Argument `{name}` must be at least {least}, but is {value}.")
    problem = Problem(Likelihood(observations, motion, scatter, model, engine), dict(unknowns))

    def potential(point):
        # Points are logits of the places: their density has the slope of that map in it.
        change = jnp.sum(jax.nn.log_sigmoid(point) + jax.nn.log_sigmoid(-point))
        return -problem.log_density(point) - change

    sampler = MCMC(
        NUTS(potential_fn=potential, max_tree_depth=6),
        num_warmup=warmup,
        num_samples=samples,
        num_chains=chains,
        chain_method="vectorized",
        progress_bar=progress,
    )
    begin = _beginnings(problem, estimate, chains, seed)
    sampler.run(jax.random.key(seed), init_params=begin, extra_fields=("diverging", "potential_energy"))
    points = sampler.get_samples(group_by_chain=True)
    extra = sampler.get_extra_fields(group_by_chain=True)
    places = np.asarray(problem.places(points))
    size = np.array([float(effective_sample_size(places[..., i])) for i in range(places.shape[-1])])
    r_hat = np.array([float(split_gelman_rubin(places[..., i])) for i in range(places.shape[-1])])
    status = PosteriorStatus.successful
    if size.min() < 400:
        status = PosteriorStatus.few_samples
    if not r_hat.max() < 1.01:
        status = PosteriorStatus.chains_differ
    change = jnp.sum(jax.nn.log_sigmoid(points) + jax.nn.log_sigmoid(-points), axis=-1)
    return Posterior(
        names=problem.names,
        samples=jnp.stack(list(problem.values(jnp.asarray(places)).values()), axis=-1),
        log_density=-extra["potential_energy"] - change,
        effective_size=jnp.asarray(size),
        r_hat=jnp.asarray(r_hat),
        divergences=int(extra["diverging"].sum()),
        status=status,
    )


def _beginnings(problem: Problem, estimate: Estimate | None, chains: int, seed: int) -> Real:
    """Points at which chains begin, none like another."""
    noise = np.random.default_rng(seed).normal(size=(chains, len(problem.names)))
    if estimate is None:
        return jnp.asarray(noise)
    order = np.argsort(-np.asarray(estimate.summit_values))
    good = order[np.asarray(estimate.summit_values)[order] > float(estimate.log_likelihood) - 3]
    summits = np.asarray(estimate.summits)[good[np.arange(chains) % good.size]]
    logs = np.array([unknown.log for unknown in problem.unknowns.values()])
    places = np.where(logs, np.log(np.where(logs, summits, 1.0)), summits)
    return problem.points(jnp.asarray(places)) + 0.1 * noise
