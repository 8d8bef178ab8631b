"""The motion that rocks allow: parameters of a pulse, with intervals, from rocks that stand, fell, or rocked so far.

The likelihood (see `likelihood`) has many maxima, because overturning sets are unions of intervals: it is climbed from
many starts. Intervals are those of the profile likelihood: all values of a parameter with which some values of the others
explain the observations nearly as well as the best. Where the observations leave a side open they end at the range that
was searched, and say so.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Inexact

from jaxrock._checks import finite, positive, scalar
from jaxrock._progress import Progress
from jaxrock.climb import Summits, climb
from jaxrock.engine import AbstractEngine
from jaxrock.likelihood import Likelihood
from jaxrock.models import Housner, Model
from jaxrock.observations import Observations

Real = Inexact[Array, "..."]

_LANES = 8  # points in one call of the compiled program
_NEAR = 1e-4  # of a range: nearer to its ends nobody goes
_RATIO = 1.9207  # log-likelihood ratio of 95 %, half of 1.96^2
_SURPRISED = 3.0  # standard deviations of the observations' log-probability
_FLAT = 0.5  # of a range: a standard deviation beyond which a direction is not determined


class Unknown(eqx.Module):
    """A parameter that is looked for, and where.

    **Arguments:**

    - `low`, `high`: the range, in the unit of the parameter; positive if `log`.
    - `log`: whether it is searched, and its prior is uniform, in its logarithm (default) or in itself.
    - `prior`: median and standard deviation of a normal prior on the logarithm (or on itself); None: a uniform one,
      with which the fit is that of maximum likelihood.

    **Raises:** ValueError for values outside their ranges.
    """

    low: Real
    high: Real
    prior: tuple[Real, Real] | None
    log: bool = eqx.field(static=True)

    def __init__(
        self, low: ArrayLike, high: ArrayLike, log: bool = True, prior: tuple[ArrayLike, ArrayLike] | None = None
    ):
        check = positive if log else finite
        self.low, self.high = (scalar(name, check(name, x)) for name, x in (("low", low), ("high", high)))
        if not self.low < self.high:
            raise ValueError(f"Argument `high` must be above `low`, but is {high} with {low}.")
        self.log = log
        self.prior = None if prior is None else (check("prior[0]", prior[0]), positive("prior[1]", prior[1]))

    @property
    def ends(self) -> Float[Array, "2"]:
        """Both ends of the range, as logarithms if `log`."""
        ends = jnp.stack([self.low, self.high])
        return jnp.log(ends) if self.log else ends

    def log_prior(self, place: Real) -> Real:
        """Logarithm of the prior's density at a place in the range, but for a constant."""
        if self.prior is None:
            return jnp.zeros_like(place)
        middle = jnp.log(self.prior[0]) if self.log else self.prior[0]
        return -(((place - middle) / self.prior[1]) ** 2) / 2


class Problem(eqx.Module):
    """A likelihood and the parameters that are unknown in it, in the coordinates in which they are searched.

    Points are logits of the place in each range, so that all of space is allowed.
    """

    likelihood: Likelihood
    unknowns: dict[str, Unknown]

    @property
    def names(self) -> tuple[str, ...]:
        """The unknown parameters, in the order of coordinates."""
        return tuple(self.unknowns)

    @property
    def ends(self) -> Float[Array, "parameters 2"]:
        """Ranges of the places: logarithms of parameters, or parameters themselves."""
        return jnp.stack([unknown.ends for unknown in self.unknowns.values()])

    def places(self, points: Real) -> Real:
        """Places of points, (..., parameters)."""
        low, high = self.ends.T
        return low + (high - low) * jax.nn.sigmoid(points)

    def points(self, places: Real) -> Real:
        """Points of places, which are kept off the very ends."""
        low, high = self.ends.T
        share = jnp.clip((places - low) / (high - low), _NEAR, 1 - _NEAR)
        return jnp.log(share) - jnp.log1p(-share)

    def values(self, places: Real) -> dict[str, Real]:
        """Parameters by name."""
        return {
            name: jnp.exp(places[..., i]) if unknown.log else places[..., i]
            for i, (name, unknown) in enumerate(self.unknowns.items())
        }

    def log_density(self, points: Real, slopes: bool = True) -> Real:
        """Log-likelihood and log-prior (by the places) at points, (..., parameters); first derivatives if `slopes`."""
        places = self.places(points)
        prior = sum(unknown.log_prior(places[..., i]) for i, unknown in enumerate(self.unknowns.values()))
        return jnp.sum(self.likelihood.log_terms(self.values(places), slopes), axis=-1) + prior


@eqx.filter_jit
def _batch(problem: Problem, points: Real) -> tuple[Real, Real]:
    # The points do not depend on one another, so that the slopes of the sum are those of each.
    value, back = jax.vjp(problem.log_density, points)
    return value, back(jnp.ones_like(value))[0]


@eqx.filter_jit
def _facts(problem: Problem, place: Real) -> tuple[Real, tuple[Real, Real, Real]]:
    values = problem.values(place)
    return problem.likelihood.survival(values), problem.likelihood.surprise(values)


class Evaluator:
    """Values and slopes at any number of points, in batches of one compiled program; it counts."""

    def __init__(self, problem: Problem, progress: Callable[[int], None] = lambda more: None):
        self.problem, self.count, self.progress = problem, 0, progress

    def __call__(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        points = np.asarray(points)
        found = []
        for begin in range(0, len(points), _LANES):
            part = points[begin : begin + _LANES]
            padded = np.pad(part, ((0, _LANES - len(part)), (0, 0)), mode="edge")
            found.append([np.asarray(x)[: len(part)] for x in _batch(self.problem, jnp.asarray(padded))])
            self.progress(len(part))
        self.count += len(points)
        return tuple(np.concatenate(x) for x in zip(*found))


class EstimateStatus(eqx.Enumeration):
    """What became of an estimate; `EstimateStatus[estimate.status]` is the message."""

    successful = "One maximum stands out, and every interval lies within the range that was searched."
    open_interval = (
        "The observations leave a parameter open: an interval ends at the range that was searched, not where the "
        "observations end it. More rocks near the boundary, or a prior, would close it."
    )
    no_information = (
        "The observations tell nothing: every motion in the range explains them about equally well. Intervals are the "
        "ranges that were searched."
    )
    contradictory = (
        "The observations contradict each other: under no motion of this kind are they likely, given how well rocks "
        "and motion are said to be known. Look at the rocks named, or state a larger scatter. There are no intervals."
    )
    not_converged = "The maximum was not reached. Raise `starts`; a likelihood that jumps there may have none."


class Estimate(eqx.Module):
    """The motion that observations allow; arrays have the order of `names`.

    - `names`, `values`: the parameters and where their likelihood (with priors: posterior density) is largest.
    - `interval`: (parameters, 2) 95 % intervals of the profile likelihood, in the parameters' units; other starts' maxima
      that are as good lie within.
    - `open`: (parameters, 2) whether an end is only the end of the range.
    - `covariance`: (parameters, parameters) of logarithms of the parameters (of a parameter itself that is not searched in
      its logarithm): the inverse of minus the Hessian at the maximum; infinite where that is singular.
    - `directions`, `deviations`: (parameters, parameters) rows of unit vectors in ranges of the parameters, and (parameters,)
      the standard deviation along each, in ranges; those of half a range and more are not determined.
    - `log_likelihood`: at the maximum, with the priors.
    - `surprise`: how many standard deviations less probable the observations are than is to be expected; above 3 they
      contradict each other.
    - `probability`: (rocks,) that each rock does what it did (that it stands, where a rotation was measured).
    - `scatter`: under which all this holds; `consistent_scatter`: where observations contradict each other, about the least
      with which they would not; infinite if there is none up to ten times as large.
    - `summits`, `summit_values`: (starts, parameters) where each start arrived, and (starts,) the log-likelihood there.
    - `responses`: how many scenes were computed.
    - `remarks`: what is to be said about it, in words.
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
    responses: int = eqx.field(static=True)
    remarks: tuple[str, ...] = eqx.field(static=True)
    status: EstimateStatus

    def __getitem__(self, name: str) -> Real:
        """The value of a parameter."""
        return self.values[self.names.index(name)]


def estimate_motion(
    observations: Observations,
    motion: Callable,
    unknowns: dict[str, Unknown],
    scatter: ArrayLike = 0.3,
    *,
    starts: int = 64,
    model: Model = Housner(),
    engine: AbstractEngine | None = None,
    progress: bool | None = None,
) -> Estimate:
    """Estimate the parameters of a motion from rocks that stand, fell, or rocked so far.

    **Arguments:**

    - `observations`: an `Observations`.
    - `motion`: what makes the motion of its parameters by name: a pulse, such as `SinePulse`, or a function of your own.
    - `unknowns`: an `Unknown` for each of these parameters.
    - `scatter`: standard deviation of ln amplitude from rock to rock [-], positive; see `Likelihood`. It is not estimated.
    - `starts`: points spread over the ranges from which the maximum is looked for, at least 1.
    - `model`, `engine`: as in `outcome`.
    - `progress`: whether to draw a progress bar; None: on a terminal, if it takes long.

    **Returns:** an `Estimate`.

    **Raises:** ValueError for arguments outside their ranges.
    """
    if starts < 1:
        raise ValueError(f"Argument `starts` must be at least 1, but is {starts}.")
    if not unknowns:
        raise ValueError("Argument `unknowns` must name at least one parameter.")
    problem = Problem(Likelihood(observations, motion, scatter, model, engine), dict(unknowns))
    bar = Progress(starts * 80, "fit", progress)
    evaluate = Evaluator(problem, lambda more: bar.add(min(more, bar.total - bar.done - 1)))
    first = np.asarray(problem.points(jnp.asarray(_spread(starts, problem))))
    found = climb(evaluate, first)
    for _ in range(3):
        best = int(np.argmax(found.values))
        shape = _shape(evaluate, found.points[best])
        profiled = _profile(evaluate, found, shape)
        if profiled.better is None:
            break
        # A profile went over a pass to a higher summit.
        more = climb(evaluate, profiled.better[None])
        found = Summits(*(np.concatenate(pair) for pair in zip(more, found)))
    result = _conclude(evaluate, found, shape, profiled)
    bar.add(bar.total - bar.done)
    return result


def _spread(count: int, problem: Problem) -> np.ndarray:
    """Places spread evenly over the ranges: multiples of irrational numbers, modulo one."""
    low, high = np.asarray(problem.ends).T
    size = low.size
    root = np.roots([1, *[0] * (size - 1), -1, -1])
    ratio = np.max(root.real[np.abs(root.imag) < 1e-9])  # x^(n+1) = x + 1, the golden ratio for n = 1
    share = (0.5 + np.outer(np.arange(count), ratio ** -np.arange(1.0, size + 1))) % 1
    return low + (high - low) * (0.01 + 0.98 * share)


class _Shape(NamedTuple):
    """The likelihood near its maximum, by places."""

    place: np.ndarray
    covariance: np.ndarray  # infinite where singular
    directions: np.ndarray
    deviations: np.ndarray


def _shape(evaluate: Evaluator, point: np.ndarray) -> _Shape:
    """The Hessian by differences of slopes, over a third of a standard deviation: finer than that there may be steps."""
    problem = evaluate.problem
    place = np.asarray(problem.places(jnp.asarray(point)))
    low, high = np.asarray(problem.ends).T
    size = high - low
    step = np.full(place.size, 0.02)  # of the range
    for _ in range(2):
        moves = np.concatenate([np.diag(step), -np.diag(step)]) * size
        at = np.asarray(problem.points(jnp.asarray(np.clip(place + moves, low, high))))
        at_places = np.asarray(problem.places(jnp.asarray(at)))
        share = (at_places - low) / size
        slopes = evaluate(at)[1] / (share * (1 - share))  # by places in ranges
        half = place.size
        distance = np.diagonal(at_places[:half] - at_places[half:]) / size
        hessian = (slopes[:half] - slopes[half:]) / np.maximum(distance, 1e-12)[:, None]
        hessian = -(hessian + hessian.T) / 2
        spread = 1 / np.sqrt(np.maximum(np.diagonal(hessian), 1e-6))
        step = np.clip(spread / 3, 1e-4, 0.05)
    eigenvalues, vectors = np.linalg.eigh(hessian)
    deviations = 1 / np.sqrt(np.maximum(eigenvalues, 1e-6))
    covariance = np.full_like(hessian, np.inf)
    if eigenvalues[0] > 1e-6 * max(eigenvalues[-1], 1.0):
        covariance = np.linalg.inv(hessian) * np.outer(size, size)
    return _Shape(place, covariance, vectors.T, deviations)


class _Profile(NamedTuple):
    ends: np.ndarray  # (parameters, 2), places
    open: np.ndarray
    better: np.ndarray | None  # a point above the maximum
    lowest: float  # log-likelihood that was met


def _profile(evaluate: Evaluator, found: Summits, shape: _Shape) -> _Profile:
    """Ends of the intervals in which the profile of the log-likelihood is less than 1.92 below its maximum.

    For every parameter and side: some values outward to the end of the range, the others climbing at each; then the root
    of the likelihood ratio, which is nearly straight, by secants in the outermost bracket.
    """
    problem = evaluate.problem
    low, high = np.asarray(problem.ends).T
    best, count = found.values.max(), low.size
    others = np.asarray(problem.places(jnp.asarray(found.points[found.values > best - _RATIO])))
    near = _NEAR * (high - low)
    sides = [(j, s) for j in range(count) for s in (-1, 1)]
    known = {side: [(shape.place[side[0]], 0.0, shape.place)] for side in sides}

    def follow(wanted):
        """Climb with one parameter held, from the nearest place that is known."""
        begin = []
        for (j, s), value in wanted:
            nearest = min(known[j, s], key=lambda row: abs(row[0] - value))
            begin.append(np.where(np.arange(count) == j, value, nearest[2]))
        begin = np.asarray(problem.points(jnp.asarray(np.array(begin))))
        free = np.array([np.arange(count) != j for (j, _), _ in wanted])
        reached = climb(evaluate, begin, free, promise=1e-4, together=False) if count > 1 else Summits(begin, evaluate(begin)[0], None)
        places = np.asarray(problem.places(jnp.asarray(reached.points)))
        for ((j, s), _), place, value in zip(wanted, places, reached.values):
            known[j, s].append((place[j], np.sqrt(2 * max(best - value, 0.0)), place))
        return reached

    visited = []
    for multiple in (1.0, 2.0, 3.5, np.inf):
        wanted = []
        for j, s in sides:
            spread = np.sqrt(shape.covariance[j, j]) if np.isfinite(shape.covariance[j, j]) else (high - low)[j] / 8
            value = shape.place[j] + s * multiple * min(spread, (high - low)[j] / 8)
            wanted.append(((j, s), np.clip(value, low[j] + near[j], high[j] - near[j])))
        visited.append(follow(wanted))
    for _ in range(4):
        wanted = []
        for j, s in sides:
            bracket = _bracket(known[j, s], s)
            if bracket is not None:
                (a, r, _), (b, q, _) = bracket
                share = np.clip((np.sqrt(2 * _RATIO) - r) / max(q - r, 1e-12), 0.05, 0.95)
                wanted.append(((j, s), a + (b - a) * share))
        if wanted:
            visited.append(follow(wanted))
    ends, open_ = np.zeros((count, 2)), np.zeros((count, 2), bool)
    for j, s in sides:
        side, bracket = (s + 1) // 2, _bracket(known[j, s], s)
        if bracket is None:
            ends[j, side], open_[j, side] = (high if s > 0 else low)[j], True
        else:
            (a, r, _), (b, q, _) = bracket
            ends[j, side] = a + (b - a) * np.clip((np.sqrt(2 * _RATIO) - r) / max(q - r, 1e-12), 0, 1)
    ends[:, 0] = np.minimum(ends[:, 0], others.min(axis=0))
    ends[:, 1] = np.maximum(ends[:, 1], others.max(axis=0))
    values, points = (np.concatenate([getattr(v, n) for v in visited]) for n in ("values", "points"))
    better = points[np.argmax(values)] if values.max() > best + 1e-6 else None
    return _Profile(ends, open_, better, min(values.min(), found.values.min()))


def _bracket(rows: list[tuple], side: int):
    """The outermost neighbours between which the root of the ratio passes 1.96; None if the last is below it."""
    rows = sorted(rows, key=lambda row: side * row[0])
    if rows[-1][1] < np.sqrt(2 * _RATIO):
        return None
    inside = max(i for i, row in enumerate(rows) if row[1] < np.sqrt(2 * _RATIO))
    return rows[inside], rows[inside + 1]


def _conclude(evaluate: Evaluator, found: Summits, shape: _Shape, profiled: _Profile) -> Estimate:
    problem = evaluate.problem
    best = int(np.argmax(found.values))
    places = problem.places(jnp.asarray(found.points))
    logs = np.array([unknown.log for unknown in problem.unknowns.values()])
    values = {name: x[best] for name, x in problem.values(places).items()}
    terms, facts = _facts(problem, places[best])
    surprise = _surprise(facts)
    probability = jnp.where(problem.likelihood.observations.seen == 1, 1 - terms, terms)
    remarks, consistent = _remarks(problem, shape, profiled), jnp.inf
    status = EstimateStatus.successful
    if profiled.open.any():
        status = EstimateStatus.open_interval
    if found.values[best] - profiled.lowest < _RATIO:
        status = EstimateStatus.no_information
    if not found.arrived[best] and not profiled.open.any():
        status = EstimateStatus.not_converged
    interval, covariance = np.where(logs[:, None], np.exp(profiled.ends), profiled.ends), shape.covariance
    if surprise > _SURPRISED:
        status = EstimateStatus.contradictory
        interval, covariance = np.full_like(interval, np.nan), np.full_like(covariance, np.nan)
        consistent = _consistent(evaluate, found.points[best])
        names = problem.likelihood.observations.names
        worst = np.argsort(np.asarray(probability))[:3]
        worst = [f"{names[i]} ({float(probability[i]):.1g})" for i in worst if probability[i] < 0.05]
        remarks = (f"Least probable under the best motion: {', '.join(worst)}.",)
        if np.isfinite(consistent):
            remarks += (f"With a scatter of {consistent:.2g} the observations would not contradict each other.",)
    per_point = problem.likelihood.observations.alpha.size * 13
    return Estimate(
        names=problem.names,
        values=jnp.stack(list(values.values())),
        interval=jnp.asarray(interval),
        open=jnp.asarray(profiled.open),
        covariance=jnp.asarray(covariance),
        directions=jnp.asarray(shape.directions),
        deviations=jnp.asarray(shape.deviations),
        log_likelihood=jnp.asarray(found.values[best]),
        surprise=jnp.asarray(surprise),
        probability=probability,
        scatter=problem.likelihood.scatter,
        consistent_scatter=jnp.asarray(consistent),
        summits=jnp.stack(list(problem.values(places).values()), axis=-1),
        summit_values=jnp.asarray(found.values),
        responses=evaluate.count * per_point,
        remarks=remarks,
        status=status,
    )


def _surprise(facts: tuple[Real, Real, Real]) -> float:
    badness, mean, variance = (float(jnp.sum(x)) for x in facts)
    # A quarter keeps near certainties, whose variance is nothing, from being surprised by rounding.
    return (badness - mean) / np.sqrt(variance + 0.25)


def _consistent(evaluate: Evaluator, point: np.ndarray) -> float:
    """About the least scatter under which observations do not contradict each other."""
    for factor in (1.5, 2.0, 3.0, 4.5, 7.0, 10.0):
        scatter = evaluate.problem.likelihood.scatter * factor
        problem = eqx.tree_at(lambda p: p.likelihood.scatter, evaluate.problem, scatter)
        again = Evaluator(problem)
        starts = np.concatenate([point[None], np.asarray(problem.points(jnp.asarray(_spread(_LANES - 1, problem))))])
        found = climb(again, starts)
        evaluate.count += again.count
        place = problem.places(jnp.asarray(found.points[np.argmax(found.values)]))
        if _surprise(_facts(problem, place)[1]) <= _SURPRISED:
            return float(scatter)
    return np.inf


def _remarks(problem: Problem, shape: _Shape, profiled: _Profile) -> tuple[str, ...]:
    """Open intervals and flat directions in words."""
    remarks = []
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
