"""Estimate the parameters of a motion, with intervals, from rocks that stand, fell, or rocked by a measured angle.

The likelihood (see `likelihood`) has many maxima, because overturning sets are unions of intervals. The search scans
it first, and starts climbers from the best places of the scan. No search can prove that there is no higher maximum
between its places.

Intervals are those of the profile likelihood. They hold all values of a parameter with which some values of the others
explain the observations nearly as well as the best. Where the observations leave a side open, the interval ends at the
range that was searched, and is marked open.
"""

from collections.abc import Callable, Sequence
from typing import Annotated, Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, ArrayLike, Bool

from jaxrock._arguments.annotations import arguments, at_least
from jaxrock._arguments.tables import AbstractTable, Column
from jaxrock._core.arrays import to_device
from jaxrock._core.progress import Progress
from jaxrock._core.types import Real
from jaxrock.engines.stepper import AbstractEngine
from jaxrock.inverse.likelihood import Likelihood
from jaxrock.inverse.observations import SEEN_ROTATION, SEEN_TOPPLED, Observations
from jaxrock.inverse.profile_likelihood import Profile, Shape, profile, shape_at
from jaxrock.inverse.scan import Competing, competing, scan, spread, starts as starts_of
from jaxrock.inverse.scatter import quadrature_accuracy
from jaxrock.inverse.search import Trace, optimizer_or_none, summits_of
from jaxrock.inverse.unknowns import Evaluator, Problem, Unknown
from jaxrock.models.equation import AbstractEquation
from jaxrock.models.rigid import Housner
from jaxrock.numerics.batched_bfgs import Summits, batched_bfgs
from jaxrock.status import Enumeration, item

_SCANNED, _LEAST_SCANNED = 16, 256  # places of the scan for each start; least number of places
_ROUNDS_BESIDE, _SCANNED_BESIDE, _BESIDE = 3, 128, 0.08  # rounds, points in each, and their extent in ranges
_CLIMBING_BESIDE = 8  # climbers started from these points
_UNSURE = 0.5  # standard error of a log-likelihood above which a remark reports it
_GAIN = 1e-6  # least gain of log-likelihood in a round after which another round follows
_RETRIES = 7  # starts of a fit with another scatter
_RATIO = 1.9207  # log-likelihood ratio of 95 %, half of 1.96^2
_SURPRISED = 3.0  # standard deviations of the observations' log-probability
_ODD, _NAMED = 2.0, 3  # surprise of one rock, in standard deviations, above which it is named; most rocks named
_COMPUTED = 0.5  # least share of the possible scenes that must be computed at the maximum
_FLAT = 0.5  # standard deviation, in ranges, above which a direction is not determined


class EstimateStatus(Enumeration):
    """Result code of an estimate; `EstimateStatus[estimate.status]` is the message."""

    successful = item(
        "One of the maxima that were found stands out, and every interval lies within the range that was searched."
    )
    open_interval = item(
        "The observations leave a parameter open: an interval ends at the range that was searched, not where the "
        "observations end it. More rocks near the boundary, or a prior, would close it."
    )
    no_information = item(
        "The observations tell nothing: every motion that was looked at explains them about equally well. Intervals "
        "are the ranges that were searched."
    )
    contradictory = item(
        "The observations contradict each other: under none of the motions that were tried are they likely, given how "
        "well rocks and motion are said to be known. Look at the rocks named, or state a larger scatter. There are no "
        "intervals."
    )
    not_computed = item(
        "Under the best motion the responses of rocks were mostly too close to call, or could not be computed: nothing "
        "can be said. Look at the motion, or set the engine."
    )
    not_converged = item("The maximum was not reached. Raise `starts`; a likelihood that jumps there may have none.")
    several_maxima = item(
        "Several maxima explain the observations about equally well: others are less than 1.92 below the highest in "
        "log-likelihood (see `competing`). Every interval covers those that were found and the gaps between, and ends "
        "within the range that was searched."
    )


class Estimate(AbstractTable):
    """The motion that observations allow; arrays have the order of `names`.

    - `names`, `values`: the parameters, and their values where the likelihood (with priors: posterior density) is
      largest.
    - `interval`: (parameters, 2) 95 % intervals of the profile likelihood, in the parameters' units. They cover maxima
      of other starts that are as good.
    - `open`: (parameters, 2) whether an end is only the end of the range.
    - `covariance`: (parameters, parameters) of logarithms of the parameters (of the parameter itself where the search
      is not in its logarithm). It is the inverse Hessian of a parabola through log-likelihoods about 1/2 below the
      maximum, because steps of the likelihood make its slopes unusable. It is infinite along a flat direction, where
      the likelihood falls by less than 0.02 within half a range. It describes the highest maximum alone; intervals
      cover all.
    - `directions`, `deviations`: (parameters, parameters) rows of unit vectors in ranges of the parameters, and
      (parameters,) the standard deviation along each, in ranges. Directions of half a range or more are not determined.
    - `log_likelihood`: at the maximum, with the priors.
    - `surprise`: by how many standard deviations the observations are less probable than expected; above 3 they
      contradict each other.
    - `probability`: (rocks,) that each rock does what it did (that it stands, where a rotation was measured).
    - `probability_error`, `log_likelihood_error`: (rocks,) and (), standard errors of `probability` and
      `log_likelihood` by the quadrature over scatter and rocks. Eight quadratures with random nodes estimate them.
    - `competing`, `competing_values`: (n, parameters) and (n,), other maxima less than 1.92 below the highest in
      log-likelihood, the highest first. On the straight line to every higher one it falls by more than 0.5.
    - `scatter`: the scatter assumed; `consistent_scatter`: where observations contradict each other, about the least
      scatter with which they would not. Infinite if none up to ten times as large suffices.
    - `summits`, `summit_values`: (climbs, parameters) end points of the climbs, and (climbs,) the log-likelihood there.
      Climbs from points beside the best come first, then those from the starts.
    - `trace`: a `Trace` of the search from the starts, without the climbs beside the best; `plot.search` draws it.
    - `responses`: number of scenes computed.
    - `remarks`: warnings about the result, in words.
    - `status`: an `EstimateStatus`.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    values: Real
    interval: Real
    open: Bool[Array, "parameters 2"]
    covariance: Real
    directions: Real
    deviations: Real
    log_likelihood: Real
    surprise: Real
    probability: Real
    scatter: Real
    consistent_scatter: Real
    summits: Real
    summit_values: Real
    competing: Real
    competing_values: Real
    probability_error: Real
    log_likelihood_error: Real
    trace: Trace
    responses: int = eqx.field(static=True)
    remarks: tuple[str, ...] = eqx.field(static=True)
    status: EstimateStatus

    def __getitem__(self, name: str) -> Real:
        """Return the value of a parameter."""
        return self.values[self.names.index(name)]

    @property
    def _columns(self):
        ends = {"low": 0, "high": 1}
        return {
            "parameter": Column(("parameter",), self.names),
            "value": Column(("parameter",), self.values, "that of the parameter"),
            **{k: Column(("parameter",), self.interval[:, i], "that of the parameter") for k, i in ends.items()},
            **{f"open_{k}": Column(("parameter",), self.open[:, i]) for k, i in ends.items()},
            **{name: Column((), getattr(self, name)) for name in ("log_likelihood", "surprise", "scatter", "status")},
        }


@arguments
def estimate_motion(
    observations: Observations,
    motion: Callable,
    unknowns: dict[str, Unknown],
    scatter: ArrayLike = 0.3,
    *,
    lapse: ArrayLike = 0.02,
    starts: Annotated[int, at_least(1, 10**6)] = 64,
    optimizer: Annotated[Any, optimizer_or_none] = None,
    accuracy: Annotated[float, quadrature_accuracy] = 0.02,
    model: AbstractEquation = Housner(),
    engine: AbstractEngine | None = None,
    progress: bool | None = None,
) -> Estimate:
    """Estimate the parameters of a motion from rocks that stand, fell, or rocked by a measured angle.

    **Arguments:**

    - `observations`: an `Observations`.
    - `motion`: the function that makes the motion from its parameters by name: a pulse, such as `SinePulse`, or your
      own. To scale a record, scale the whole: see `Likelihood`.
    - `unknowns`: an `Unknown` for each of these parameters.
    - `scatter`: standard deviation of ln amplitude from rock to rock [-], positive; `lapse`: probability that an
      observation says nothing; see `Likelihood`. They are not estimated.
    - `starts`: largest number of starting points, at least 1. They are the best local maxima of a scan. It visits 16
      times as many places (at least 256) over the ranges, then more around the best.
    - `optimizer`: an `optax.GradientTransformation`, such as `optax.adam(0.1)`, or a minimiser of optimistix, such as
      `optimistix.BFGS(rtol=1e-6, atol=1e-6)`. It works on angles: a parameter passes its range within pi. None: the
      package's batched BFGS, which finds the intervals in any case.
    - `accuracy`: approximate root mean square error of a probability by the quadrature [-], in [0.001, 0.05].
      `Likelihood` states its cost.
    - `model`, `engine`: as in `outcome`.
    - `progress`: whether to draw a progress bar; None: on a terminal, if it takes long.

    **Returns:** an `Estimate`.

    **Raises:** ValueError for arguments outside their ranges.
    """
    if not unknowns:
        raise ValueError("Argument `unknowns` must name at least one parameter.")
    likelihood = Likelihood(observations, motion, scatter, model, engine, lapse, accuracy=accuracy)
    problem = Problem(likelihood, dict(unknowns))
    bar = Progress(_LEAST_SCANNED + starts * 60, "fit", progress)
    evaluate = Evaluator(problem, lambda more: bar.add(min(more, bar.total - bar.done - 1)))
    scan(evaluate, max(_SCANNED * starts, _LEAST_SCANNED))
    summits = summits_of(evaluate, starts_of(evaluate, starts), optimizer)
    trace = Trace.of(evaluate, summits)
    if not np.isfinite(evaluate.lowest):
        raise ValueError("Argument `unknowns` must have ranges in which there are motions, but all its values are bad.")
    for _ in range(_ROUNDS_BESIDE):
        more, before = summits_of(evaluate, _beside(evaluate, summits), optimizer), summits.values.max()
        summits = _joined(more, summits)
        if summits.values.max() < before + _GAIN:
            break
    for _ in range(3):
        best = int(np.argmax(summits.values))
        shape = shape_at(evaluate, summits.points[best])
        profiled = profile(evaluate, summits, shape)
        if profiled.better is None:
            break
        # Climbing along a profile has crossed to a higher summit.
        summits = _joined(batched_bfgs(evaluate, profiled.better[None]), summits)
    result = _conclude(evaluate, summits, shape, profiled, trace)
    bar.add(bar.total - bar.done)
    return result


def _beside(evaluate: Evaluator, summits: Summits) -> np.ndarray:
    """Return the best of some points around the highest summit.

    Gaps in the overturning set that are narrower than the scatter make small summits beside the highest one.
    """
    low, high = evaluate.ends
    best = evaluate.places(summits.points[np.argmax(summits.values)])
    places = best + _BESIDE * (spread(_SCANNED_BESIDE, evaluate) - (low + high) / 2)
    places = np.clip(places, low, high)
    order = np.argsort(-evaluate.scan(places), kind="stable")
    return evaluate.points(places[order[:_CLIMBING_BESIDE]])


def _joined(more: Summits, summits: Summits) -> Summits:
    points, values, arrived = (np.concatenate(pair) for pair in zip(more[:3], summits[:3]))
    return Summits(points, values, arrived)


def _conclude(evaluate: Evaluator, summits: Summits, shape: Shape, profiled: Profile, trace: Trace) -> Estimate:
    problem = evaluate.problem
    best = int(np.argmax(summits.values))
    parameters = problem.parameters(evaluate.places(summits.points))
    logs = np.array([unknown.log for unknown in problem.unknowns.values()])
    stands, computed, *facts = evaluate.facts(evaluate.places(summits.points[best]))
    surprise = _surprise(facts)
    probability = np.where(np.asarray(problem.likelihood.observations.seen) == SEEN_TOPPLED, 1 - stands, stands)
    others, errors = competing(evaluate, summits), evaluate.errors(evaluate.places(summits.points[best]))
    remarks, consistent = _remarks(problem, shape, profiled, others, errors[1]), np.inf
    status = EstimateStatus.several_maxima if len(others.values) else EstimateStatus.successful
    if profiled.open.any():
        status = EstimateStatus.open_interval
    if summits.values[best] - evaluate.lowest < _RATIO:
        status = EstimateStatus.no_information
    elif profiled.open.all():
        remarks += ("They allow some combinations of these and not others: `feasible_region` maps them.",)
    if not summits.arrived[best] and not profiled.open.any():
        status = EstimateStatus.not_converged
    if np.mean(computed) < _COMPUTED:
        status = EstimateStatus.not_computed
    interval, covariance = np.where(logs[:, None], np.exp(profiled.ends), profiled.ends), shape.covariance
    if surprise > _SURPRISED:
        status = EstimateStatus.contradictory
        interval, covariance = np.full_like(interval, np.nan), np.full_like(covariance, np.nan)
        consistent = _consistent(evaluate, summits.points[best])
        remarks = (f"{_worst(problem.likelihood, probability, stands, facts)}.",)
        if np.isfinite(consistent):
            remarks += (f"With a scatter of {consistent:.2g} the observations would not contradict each other.",)
        else:
            remarks += ("With no scatter that was tried, up to ten times as large, do the observations agree.",)
    arrays = {
        "values": parameters[best], "interval": interval, "open": profiled.open, "covariance": covariance,
        "directions": shape.directions, "deviations": shape.deviations, "log_likelihood": summits.values[best],
        "surprise": surprise, "probability": probability, "consistent_scatter": consistent, "summits": parameters,
        "summit_values": summits.values, "competing": problem.parameters(others.places),
        "competing_values": others.values, "probability_error": errors[0], "log_likelihood_error": errors[1],
    }  # fmt: skip
    return Estimate(
        **to_device({name: np.asarray(x) for name, x in arrays.items()}),
        names=problem.names,
        scatter=problem.likelihood.scatter,
        trace=trace,
        responses=evaluate.scenes,
        remarks=remarks,
        status=status,
    )


def _surprise(facts: Sequence[np.ndarray]) -> float:
    badness, mean, variance = (float(np.sum(x)) for x in facts)
    # The added 0.25 keeps rounding from counting as surprise where outcomes are nearly certain and the variance is 0.
    return (badness - mean) / np.sqrt(variance + 0.25)


def _worst(likelihood: Likelihood, probability: np.ndarray, stands: np.ndarray, facts: Sequence[np.ndarray]) -> str:
    """Name the most surprising rocks, the worst first, with the probability of the outcome or the error of rotation."""
    badness, mean, variance = facts
    surprise = (badness - mean) / np.sqrt(variance + 0.25)
    order = np.argsort(-surprise)[:_NAMED]
    lapse, seen = float(likelihood.lapse), likelihood.observations
    away = np.sqrt(np.maximum(2 * (badness + np.log((1 - lapse) * stands + lapse / 2)), 0.0))

    def told(rock):
        if seen.seen[rock] == SEEN_ROTATION:
            return f"{seen.names[rock]} (its rotation is off by {away[rock]:.1f} standard deviations)"
        return f"{seen.names[rock]} ({probability[rock]:.1g})"

    named = [told(rock) for rock in order if surprise[rock] > _ODD or rock == order[0]]
    return f"Least probable under the best motion: {', '.join(named)}"


def _consistent(evaluate: Evaluator, point: np.ndarray) -> float:
    """Return roughly the least scatter under which the observations do not contradict each other; else infinity."""
    for factor in (1.5, 2.0, 3.0, 4.5, 7.0, 10.0):
        scatter = evaluate.problem.likelihood.scatter * factor
        problem = eqx.tree_at(lambda p: p.likelihood.scatter, evaluate.problem, scatter)
        again = Evaluator(problem)
        scan(again, _LEAST_SCANNED)
        starts = np.concatenate([point[None], starts_of(again, _RETRIES)])
        summits = batched_bfgs(again, starts)
        evaluate.count += again.scenes // evaluate.problem.likelihood.scenes
        if _surprise(again.facts(again.places(summits.points[np.argmax(summits.values)]))[2:]) <= _SURPRISED:
            return float(scatter)
    return np.inf


def _remarks(problem: Problem, shape: Shape, profiled: Profile, others: Competing, error: float) -> tuple[str, ...]:
    """Return remarks on open intervals, flat directions, other maxima and errors of the quadrature."""
    remarks = []
    for place, value in zip(problem.parameters(others.places), others.values):
        named = ", ".join(f"{name} {x:.3g}" for name, x in zip(problem.names, place))
        remarks.append(
            f"Another maximum explains the observations about as well: {named} (log-likelihood {value:.2f})."
        )
    if error > _UNSURE:
        said = f"The quadrature leaves a standard error of {error:.2g} in the log-likelihood at its maximum"
        remarks.append(f"{said}: a smaller `accuracy` reduces it.")
    for name, (below, above) in zip(problem.names, profiled.open):
        if below and above:
            remarks.append(f"The observations do not determine {name}.")
        elif below or above:
            remarks.append(f"The observations do not bound {name} from {'below' if below else 'above'}.")
    for direction, deviation in zip(shape.directions, shape.deviations):
        if deviation > _FLAT and len(problem.names) > 1:
            turned = direction * np.sign(direction[np.argmax(np.abs(direction))])
            parts = [f"{x:+.2f} {name}" for x, name in zip(turned, problem.names) if abs(x) > 0.1]
            remarks.append(f"Near the maximum the likelihood is flat along {', '.join(parts)} (shares of the ranges).")
    return tuple(remarks)
