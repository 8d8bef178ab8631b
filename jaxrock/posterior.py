"""Samples of the posterior distribution of a motion's parameters (NumPyro, an extra).

The posterior has several maxima and ridges, and many motions at once are cheap: so ensembles of walkers, which need
log-densities only and learn from each other how far and where to step. Several ensembles know nothing of each other:
whether they agree tells whether they have arrived.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Inexact

from jaxrock._progress import Progress
from jaxrock.engine import AbstractEngine
from jaxrock.inverse import Estimate, EstimateStatus, estimate_motion
from jaxrock.likelihood import Likelihood
from jaxrock.models import Housner, Model
from jaxrock.observations import Observations
from jaxrock.problem import Problem, Unknown

Real = Inexact[Array, "..."]

_ENSEMBLES, _WALKERS = 4, 24
_STEPS = 50  # in one call of the compiled program
_THINNED = 5  # one in so many is kept
_BURNT = 3  # of what is kept one in so many, the first, is not used
_DEPTH = 6.0  # log-density below the best maximum down to which walkers begin at maxima
_APART = 0.05  # of the ranges: how far from them
_ALIKE = 1.01  # R-hat
_END = 0.02  # of a range, where samples are counted: an end is open if there are a fifth as many as of a uniform one


class PosteriorStatus(eqx.Enumeration):
    """Whether samples can be trusted; `PosteriorStatus[posterior.status]` is the message."""

    successful = "The ensembles agree, and hold enough independent samples."
    open_interval = (
        "The ensembles agree. The observations leave a parameter open: its distribution reaches the end of the range, "
        "which bounds it as a prior does."
    )
    not_converged = "The ensembles do not agree, or there are too few independent samples. Raise `steps`."
    contradictory = (
        "The observations contradict each other (see the estimate): samples say what would hold if they did not."
    )


class Posterior(eqx.Module):
    """Samples of a posterior distribution.

    - `names`: the parameters; `samples`: (ensembles, steps, walkers, parameters), in their units; every fifth step.
    - `log_density`: (ensembles, steps, walkers) log-likelihood and log-prior.
    - `effective_size`: (parameters,) number of independent samples that would know the mean as well.
    - `r_hat`: (parameters,) between halves of all ensembles, 1 if they agree.
    - `open`: (parameters, 2) whether the distribution reaches the end of its range.
    - `estimate`: the `Estimate` from whose maxima walkers began.
    - `status`: a `PosteriorStatus`.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    samples: Real
    log_density: Real
    effective_size: Real
    r_hat: Real
    open: Bool[Array, "parameters 2"]
    estimate: Estimate
    status: PosteriorStatus

    def __getitem__(self, name: str) -> Real:
        """All samples of a parameter, (samples,)."""
        return self.samples[..., self.names.index(name)].ravel()

    def interval(self, share: float = 0.95) -> Real:
        """(parameters, 2) intervals that leave equal shares of the samples on both sides."""
        flat = self.samples.reshape(-1, len(self.names))
        return jnp.quantile(flat, jnp.array([(1 - share) / 2, (1 + share) / 2]), axis=0).T

    def summary(self) -> str:
        """Mean, standard deviation, quantiles and diagnostics as a table, and the status."""
        lines = [f"{'':<12}{'mean':>10}{'sd':>10}{'2.5 %':>10}{'50 %':>10}{'97.5 %':>10}{'effective':>11}{'R-hat':>8}"]
        for i, name in enumerate(self.names):
            x = self[name]
            numbers = jnp.concatenate([jnp.stack([x.mean(), x.std()]), jnp.quantile(x, jnp.array([0.025, 0.5, 0.975]))])
            cells = "".join(f"{float(number):>10.4g}" for number in numbers)
            lines.append(f"{name:<12}{cells}{float(self.effective_size[i]):>11.0f}{float(self.r_hat[i]):>8.3f}")
        return "\n".join([*lines, PosteriorStatus[self.status]])


def sample_motion(
    observations: Observations,
    motion: Callable,
    unknowns: dict[str, Unknown],
    scatter: ArrayLike = 0.3,
    *,
    lapse: ArrayLike = 0.02,
    estimate: Estimate | None = None,
    effective_size: int = 1000,
    steps: int = 3000,
    seed: int = 0,
    model: Model = Housner(),
    engine: AbstractEngine | None = None,
    progress: bool | None = None,
) -> Posterior:
    """Sample the parameters of a motion given rocks that stand, fell, or rocked so far.

    Priors are those of the `Unknown`s, uniform over their ranges (in the logarithm if `log`) where they have none: the
    posterior is proper even where the observations tell nothing, and then as wide as the ranges.

    **Arguments:**

    - `observations`, `motion`, `unknowns`, `scatter`, `lapse`, `model`, `engine`: as in `estimate_motion`.
    - `estimate`: what `estimate_motion` found: walkers begin at its best maxima. None makes one.
    - `effective_size`: of every parameter at which it ends, once the ensembles agree (R-hat below 1.01); at least 1.
    - `steps`: of all walkers, at most; at least 1. The first third is not used.
    - `seed`: of the random numbers.
    - `progress`: whether to draw a progress bar; None: on a terminal, if it takes long.

    **Returns:** a `Posterior`.

    **Raises:** ValueError for arguments outside their ranges; ImportError without NumPyro (`pip install
    "jaxrock[posterior]"`).

    **Source:** Ter Braak (2006), differential evolution; Goodman & Weare (2010), stretches and the effective size of an
    ensemble; Vehtari et al. (2021), R-hat.
    """
    try:
        import numpyro.infer  # noqa: F401
    except ImportError as error:
        raise ImportError('Sampling needs NumPyro: pip install "jaxrock[posterior]".') from error
    for name, value in (("effective_size", effective_size), ("steps", steps)):
        if value < 1:
            raise ValueError(f"Argument `{name}` must be at least 1, but is {value}.")
    if estimate is None:
        estimate = estimate_motion(
            observations, motion, unknowns, scatter, lapse=lapse, model=model, engine=engine, progress=progress
        )
    problem = Problem(Likelihood(observations, motion, scatter, model, engine, lapse), dict(unknowns))
    bar, rounds = Progress(steps, "posterior", progress), -(-steps // _STEPS)
    key, walkers = jax.random.key(seed), _beginnings(problem, estimate, seed)
    found = []
    for number in range(rounds):
        walkers, kept = _advance(problem, jax.random.fold_in(key, number), walkers)
        found.append([np.asarray(x) for x in kept])
        places, density = (np.concatenate(x)[len(found) * (_STEPS // _THINNED) // _BURNT :] for x in zip(*found))
        sizes, r_hat = diagnostics(places)
        bar.add(min(_STEPS, steps - bar.done))
        if sizes.min() >= effective_size and r_hat.max() < _ALIKE:
            break
    bar.add(bar.total - bar.done)
    return _conclude(problem, estimate, places, density, sizes, r_hat, effective_size)


@eqx.filter_jit  # so that it is traced once, however often loops around it are
def _log_density(problem: Problem, places: Real) -> Real:
    low, high = problem.ends.T
    inside = ((places >= low) & (places <= high)).all(axis=-1)
    return jnp.where(inside, problem.log_density(jnp.clip(places, low, high), slopes=False), -jnp.inf)


@eqx.filter_jit
def _advance(problem: Problem, key: Array, walkers: Real) -> tuple[Real, tuple[Real, Real]]:
    """Walkers, (ensembles, walkers, parameters), after some steps; places and log-densities of those that are kept."""
    from numpyro.infer import AIES

    arrays, rest = eqx.partition(problem, eqx.is_array)

    @jax.custom_batching.custom_vmap
    def log_density(arrays, places):
        return _log_density(eqx.combine(arrays, rest), places)

    @log_density.def_vmap
    def _(size, batched, arrays, places):
        return log_density(arrays, places), True  # more of them, in one batch

    # Steps of length one between two walkers lead from one maximum to another.
    moves = {AIES.DEMove(): 0.6, AIES.StretchMove(): 0.3, AIES.DEMove(g0=1.0): 0.1}
    with jax.ensure_compile_time_eval():  # it checks them
        kernel = AIES(potential_fn=lambda place: -log_density(arrays, place), randomize_split=True, moves=moves)

    def begin(key, walkers):
        return kernel.init(jax.random.split(key, walkers.shape[0]), 0, walkers)

    def step(_, state):
        return jax.vmap(lambda state: kernel.sample(state, (), {}))(state)

    def keep(state, _):
        state = jax.lax.fori_loop(0, _THINNED, step, state)
        return state, (state.z, log_density(arrays, state.z))

    state = jax.vmap(begin)(jax.random.split(key, walkers.shape[0]), walkers)
    state, kept = jax.lax.scan(keep, state, length=_STEPS // _THINNED)
    return state.z, kept


def diagnostics(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Effective sizes and R-hat, (parameters,) each, of places (steps, ensembles, walkers, parameters).

    Walkers of an ensemble are not independent: the effective size comes from the series of their means, whose variance
    tells how many independent walkers there are, and whose autocorrelation how many independent steps.
    """
    from numpyro.diagnostics import effective_sample_size, split_gelman_rubin

    by_ensemble = places.swapaxes(0, 1)
    means = by_ensemble.mean(axis=2)
    variance = by_ensemble.var(axis=(0, 1, 2)), np.maximum(means.var(axis=(0, 1)), 1e-300)
    sizes = np.asarray(effective_sample_size(means)) * variance[0] / variance[1]
    flat = by_ensemble.reshape(by_ensemble.shape[0], -1, places.shape[-1])
    return sizes, np.asarray(split_gelman_rubin(flat))


def _beginnings(problem: Problem, estimate: Estimate, seed: int) -> Real:
    """Places at which walkers begin, (ensembles, walkers, parameters), none like another: around the best maxima."""
    random = np.random.default_rng(seed)
    low, high = np.asarray(problem.ends).T
    logs = np.array([unknown.log for unknown in problem.unknowns.values()])
    values = np.asarray(estimate.summit_values)
    summits = np.asarray(estimate.summits)[values > values.max() - _DEPTH]
    places = np.where(logs, np.log(np.where(logs, summits, 1.0)), summits)
    places = places[random.integers(len(places), size=(_ENSEMBLES, _WALKERS))]
    share = (places - low) / (high - low) + _APART * random.normal(size=places.shape)
    share = 1 - np.abs(1 - np.abs(share) % 2)  # what lies beyond an end is reflected
    return jnp.asarray(low + (high - low) * share)


def _conclude(
    problem: Problem,
    estimate: Estimate,
    places: np.ndarray,
    density: np.ndarray,
    sizes: np.ndarray,
    r_hat: np.ndarray,
    wanted: int,
) -> Posterior:
    low, high = np.asarray(problem.ends).T
    share = ((places - low) / (high - low)).reshape(-1, low.size)
    open_ = np.stack([(share < _END).mean(axis=0), (share > 1 - _END).mean(axis=0)], axis=1) > _END / 5
    status = PosteriorStatus.open_interval if open_.any() else PosteriorStatus.successful
    if not (sizes.min() >= wanted and r_hat.max() < _ALIKE):
        status = PosteriorStatus.not_converged
    if bool(estimate.status == EstimateStatus.contradictory):
        status = PosteriorStatus.contradictory
    values = problem.values(jnp.asarray(places.swapaxes(0, 1)))
    return Posterior(
        names=problem.names,
        samples=jnp.stack(list(values.values()), axis=-1),
        log_density=jnp.asarray(density.swapaxes(0, 1)),
        effective_size=jnp.asarray(sizes),
        r_hat=jnp.asarray(r_hat),
        open=jnp.asarray(open_),
        estimate=estimate,
        status=status,
    )
