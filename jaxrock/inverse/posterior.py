"""Sample the posterior distribution of a motion's parameters (with NumPyro's diagnostics, an extra).

The posterior has several maxima and ridges, parameters are few, and densities are expensive. The chains therefore use
independent proposals that first adapt to the posterior (see `proposals`), starting from the maxima of an estimate and
from the whole range. Agreement of the chains shows convergence. It cannot show that no maximum was missed by both the
estimate and the proposals. (Ensembles of walkers, by NumPyro's AIES, take many times as many points:
benchmarks/inverse.md.) The user can give any sampler of NumPyro or BlackJAX instead (see `samplers`).
"""

from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool

from jaxrock._arguments.annotations import arguments, at_least
from jaxrock._arguments.ranges import inner_share, scalar
from jaxrock._arguments.tables import AbstractTable, Column
from jaxrock._core.progress import Progress
from jaxrock._core.types import Real
from jaxrock.engines.stepper import AbstractEngine
from jaxrock.inverse.densities import LogDensity
from jaxrock.inverse.estimate import Estimate, EstimateStatus, estimate_motion
from jaxrock.inverse.likelihood import Likelihood
from jaxrock.inverse.observations import Observations
from jaxrock.inverse.samplers import rounds_of
from jaxrock.inverse.scatter import quadrature_accuracy
from jaxrock.inverse.unknowns import Problem, Unknown, densities
from jaxrock.models.equation import AbstractEquation
from jaxrock.models.rigid import Housner
from jaxrock.motions.pulses import UNITS
from jaxrock.numerics.independence_sampler import ROUNDS, independent_proposals
from jaxrock.status import Enumeration, item

_CHAINS = 8
_ROUND = 512  # points of a round, of all chains together
_PATIENCE, _POOR = 512, 0.03  # steps before a restart; effective samples for each step below which chains restart
_DEPTH = 6.0  # chains start at maxima whose log-density is at most so much below the best
_JITTER, _INSIDE = 0.1, 6.0  # scatter of the starts of other samplers around maxima; their largest |coordinate|
_ALIKE = 1.01  # R-hat below which chains agree
_END = 0.02  # share of a range at each end; open if it holds more than a fifth of a uniform distribution's samples


class PosteriorStatus(Enumeration):
    """Result code that says if samples can be trusted; `PosteriorStatus[posterior.status]` is the message."""

    successful = item("The chains agree, and hold enough independent samples.")
    open_interval = item(
        "The chains agree. The observations leave a parameter open: its distribution reaches the end of the range, "
        "which bounds it as a prior does."
    )
    not_converged = item("The chains do not agree, or there are too few independent samples. Raise `steps`.")
    contradictory = item(
        "The observations contradict each other (see the estimate): samples say what would hold if they did not."
    )


class Posterior(AbstractTable):
    """Samples of a posterior distribution.

    - `names`: the parameters; `samples`: (chains, steps, parameters), in their units.
    - `log_density`: (chains, steps) log-likelihood plus log-prior.
    - `effective_size`: (parameters,) number of independent samples that would determine the mean as well.
    - `r_hat`: (parameters,) between halves of all chains, 1 if they agree.
    - `open`: (parameters, 2) whether the distribution reaches the end of its range.
    - `responses`: number of scenes computed, without those of the estimate.
    - `estimate`: the `Estimate`, at whose maxima the chains started.
    - `status`: a `PosteriorStatus`.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    samples: Real
    log_density: Real
    effective_size: Real
    r_hat: Real
    open: Bool[Array, "parameters 2"]
    responses: int = eqx.field(static=True)
    estimate: Estimate
    status: PosteriorStatus

    def __getitem__(self, name: str) -> Real:
        """Return all samples of a parameter, (samples,)."""
        return self.samples[..., self.names.index(name)].ravel()

    def interval(self, share: float = 0.95) -> Real:
        """Return (parameters, 2) intervals that leave equal shares of the samples on both sides."""
        share = float(scalar("share", inner_share("share", share)))
        flat = self.samples.reshape(-1, len(self.names))
        return jnp.quantile(flat, jnp.array([(1 - share) / 2, (1 + share) / 2]), axis=0).T

    def to_arviz(self) -> Any:
        """Return the samples for ArviZ (a separate extra): an `InferenceData`, or from ArviZ 1.0 on a `DataTree`."""
        import arviz

        samples = {name: np.asarray(self.samples[..., i]) for i, name in enumerate(self.names)}
        groups = {"posterior": samples, "sample_stats": {"lp": np.asarray(self.log_density)}}
        made: Any = arviz.from_dict
        return made(**groups) if hasattr(arviz, "InferenceData") else made(groups)

    def summary(self) -> str:
        """Return a table of mean, standard deviation, quantiles and diagnostics, and the status."""
        lines = [f"{'':<12}{'mean':>10}{'sd':>10}{'2.5 %':>10}{'50 %':>10}{'97.5 %':>10}{'effective':>11}{'R-hat':>8}"]
        for i, name in enumerate(self.names):
            x = self[name]
            numbers = jnp.concatenate([jnp.stack([x.mean(), x.std()]), jnp.quantile(x, jnp.array([0.025, 0.5, 0.975]))])
            cells = "".join(f"{float(number):>10.4g}" for number in numbers)
            lines.append(f"{name:<12}{cells}{float(self.effective_size[i]):>11.0f}{float(self.r_hat[i]):>8.3f}")
        return "\n".join([*lines, PosteriorStatus[self.status]])

    @property
    def _columns(self):
        samples = {name: self.samples[..., i] for i, name in enumerate(self.names)}
        both = ("chain", "step")
        return {
            **{name: Column(both, values, UNITS.get(name, "unknown")) for name, values in samples.items()},
            "log_density": Column(both, self.log_density),
            "status": Column((), self.status),
        }


@arguments
def sample_motion(
    observations: Observations,
    motion: Callable,
    unknowns: dict[str, Unknown],
    scatter: ArrayLike = 0.3,
    *,
    lapse: ArrayLike = 0.02,
    estimate: Estimate | None = None,
    effective_size: Annotated[int, at_least(1, 10**9)] = 1000,
    steps: Annotated[int, at_least(1, 10**9)] = 4000,
    seed: Annotated[int, at_least(0)] = 0,
    sampler: Callable | None = None,
    accuracy: Annotated[float, quadrature_accuracy] = 0.02,
    model: AbstractEquation = Housner(),
    engine: AbstractEngine | None = None,
    progress: bool | None = None,
) -> Posterior:
    """Sample the parameters of a motion given rocks that stand, fell, or rocked by a measured angle.

    Priors are those of the `Unknown`s; without one, uniform over the range (in the logarithm if `log`). So the
    posterior is always proper, and as wide as the ranges where observations carry no information.

    **Arguments:**

    - `observations`, `motion`, `unknowns`, `scatter`, `lapse`, `accuracy`, `model`, `engine`: as in `estimate_motion`.
    - `estimate`: the result of `estimate_motion`, where chains begin. None: it is computed.
    - `effective_size`: effective sample size of every parameter at which it ends, once the chains agree (R-hat below
      1.01); at least 1.
    - `steps`: largest number of steps of each of eight chains, at least 1. Steps before a restart of the chains count,
      but are not used.
    - `seed`: seed of the random numbers.
    - `sampler`: a function that makes another sampler from a `LogDensity`, such as
      `lambda density: numpyro.infer.NUTS(potential_fn=lambda point: -density(point))` or
      `lambda density: blackjax.nuts(density, 0.5, jnp.ones(2))`. Its eight chains begin at maxima of the estimate; the
      first 500 steps of each are not kept. None: chains of the package (`jaxrock.numerics.independence_sampler`).
    - `progress`: whether to draw a progress bar; None: on a terminal, if it takes long.

    **Returns:** a `Posterior`.

    **Raises:** ValueError for arguments outside their ranges, and for an estimate of other unknowns; ImportError
    without NumPyro (`pip install "jaxrock[posterior]"`).

    **Source:** Hastings (1970), independent proposals; Cappe et al. (2004), populations of them that learn; Gelman et
    al. (2013, 11.4), R-hat between halves of chains, and effective size, by NumPyro.
    """
    try:
        import numpyro.diagnostics  # noqa: F401
    except ImportError as error:
        raise ImportError('Sampling needs NumPyro: pip install "jaxrock[posterior]".') from error
    if estimate is None:
        estimate = estimate_motion(
            observations,
            motion,
            unknowns,
            scatter,
            lapse=lapse,
            accuracy=accuracy,
            model=model,
            engine=engine,
            progress=progress,
        )
    likelihood = Likelihood(observations, motion, scatter, model, engine, lapse, accuracy=accuracy)
    problem = Problem(likelihood, dict(unknowns))
    wanted = _Wanted(effective_size, steps, seed)
    if sampler is None:
        bar = Progress(ROUNDS + -(-steps * _CHAINS // _ROUND), "posterior", progress)
        drawn = _by_proposals(problem, estimate, wanted, bar)
    else:
        bar = Progress(steps, "posterior", progress)
        drawn = _by_another(sampler, problem, estimate, wanted, bar)
    bar.add(bar.total - bar.done)
    return _conclude(problem, estimate, drawn, effective_size)


class _Wanted(NamedTuple):
    """The required number of independent samples, the largest number of steps of a chain, and the seed."""

    size: int
    steps: int
    seed: int

    def is_reached(self, sizes: np.ndarray, r_hat: np.ndarray) -> bool:
        """Return whether chains agree, and hold enough independent samples."""
        return bool(sizes.min() >= self.size and r_hat.max() < _ALIKE)


class _Drawn(NamedTuple):
    """Drawn samples: places (steps, chains, parameters), log-likelihood plus log-prior there, diagnostics, and the
    number of points computed."""

    places: np.ndarray
    values: np.ndarray
    sizes: np.ndarray
    r_hat: np.ndarray
    points: int


def _by_proposals(problem: Problem, estimate: Estimate, wanted: _Wanted, bar: Progress) -> _Drawn:
    random, density = np.random.default_rng(wanted.seed), _Density(problem)
    low, high = np.asarray(problem.ends).T
    sampler = independent_proposals(density, low, high, chains=_CHAINS, points=_ROUND, progress=lambda: bar.add(1))
    chains, sizes = sampler.init(_summits(problem, estimate), random), np.zeros(0)
    for done in range(0, wanted.steps, _ROUND // _CHAINS):
        if chains.steps >= _PATIENCE and sizes.min() < _POOR * _CHAINS * chains.steps:
            chains = sampler.anew(random, chains)  # poor mixing: adapt the proposals to all points so far, and restart
        chains, _ = sampler.step(random, chains, min(_ROUND // _CHAINS, wanted.steps - done))
        sizes, r_hat = diagnostics(chains.places[1:])
        bar.add(1)
        if wanted.is_reached(sizes, r_hat):
            break
    return _Drawn(chains.places[1:], chains.log_density[1:], sizes, r_hat, density.count)


def _by_another(make: Callable, problem: Problem, estimate: Estimate, wanted: _Wanted, bar: Progress) -> _Drawn:
    density = LogDensity(problem.current())
    summits = problem.values(jnp.asarray(_summits(problem, estimate)))
    points = np.clip(np.asarray(density.point(summits)), -_INSIDE, _INSIDE)
    points = points[np.arange(_CHAINS) % len(points)]
    points = points + _JITTER * np.random.default_rng(wanted.seed).normal(size=points.shape)
    rounds, count = [], 0
    for steps in rounds_of(make, density, points, wanted.seed):
        rounds.append(steps)
        count += steps.gradients
        places = np.asarray(density.place(jnp.asarray(np.concatenate([each.points for each in rounds]))))
        sizes, r_hat = diagnostics(places)
        bar.add(min(len(steps.points), bar.total - bar.done))
        if len(places) >= wanted.steps or wanted.is_reached(sizes, r_hat):
            break
    points = np.concatenate([each.points for each in rounds])[: wanted.steps]
    if rounds[0].log_density is None:
        values = _Density(problem)(places.reshape(-1, places.shape[-1])).reshape(places.shape[:-1])[: wanted.steps]
    else:
        values = np.concatenate([each.log_density for each in rounds])[: wanted.steps]
        values = values - np.asarray(density.log_volume(jnp.asarray(points)))
    return _Drawn(places[: wanted.steps], values, *diagnostics(places[: wanted.steps]), count)


class _Density:
    """Evaluates log-densities at any number of places, in batches of one compiled program, and counts the places."""

    def __init__(self, problem: Problem):
        self.problem, self.count = problem.current(), 0

    def __call__(self, places: np.ndarray) -> np.ndarray:
        self.count += len(places)
        return densities(self.problem, places)


def _summits(problem: Problem, estimate: Estimate) -> np.ndarray:
    """Return the places of the best maxima of the estimate, (maxima, parameters)."""
    values = np.asarray(estimate.summit_values)
    summits = np.asarray(estimate.summits)[values > values.max() - _DEPTH]
    logs = np.array([unknown.log for unknown in problem.unknowns.values()])
    places = np.where(logs, np.log(np.where(logs, summits, 1.0)), summits)
    low, high = np.asarray(problem.ends).T
    if estimate.names != problem.names or not _within(places, low, high, np.asarray(estimate.summits).dtype):
        raise ValueError("Argument `estimate` must be of these unknowns in these ranges, but is of others.")
    return np.clip(places, low, high)


def _within(places: np.ndarray, low: np.ndarray, high: np.ndarray, dtype) -> bool:
    """Return whether places are in their ranges, but for the rounding of numbers of this type."""
    rounding = np.finfo(dtype).eps * np.maximum(1.0, np.maximum(np.abs(low), np.abs(high)))
    slack = np.maximum(1e-9 * (high - low), 4 * rounding)
    return bool(((places > low - slack) & (places < high + slack)).all())


def diagnostics(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return effective sizes and R-hat, (parameters,) each, of places (steps, chains, parameters).

    Fewer than four steps give 0 and infinity.
    """
    from numpyro.diagnostics import effective_sample_size, split_gelman_rubin

    if len(places) < 4:
        return np.zeros(places.shape[-1]), np.full(places.shape[-1], np.inf)
    by_chain = places.swapaxes(0, 1)
    sizes, r_hat = np.asarray(effective_sample_size(by_chain)), np.asarray(split_gelman_rubin(by_chain))
    # Chains that never moved have NaN diagnostics.
    return np.where(np.isnan(sizes), 0.0, sizes), np.where(np.isnan(r_hat), np.inf, r_hat)


def _conclude(problem: Problem, estimate: Estimate, drawn: _Drawn, wanted: int) -> Posterior:
    places, density, sizes, r_hat, points = drawn
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
        responses=points * problem.likelihood.scenes,
        estimate=estimate,
        status=status,
    )
