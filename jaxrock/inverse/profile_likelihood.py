"""The likelihood around its maximum: the curvature there, and profiles, which give intervals of parameters."""

from typing import NamedTuple

import numpy as np

from jaxrock.inverse.scan import low_discrepancy
from jaxrock.inverse.unknowns import Evaluator
from jaxrock.numerics.batched_bfgs import Summits, batched_bfgs

_RATIO = 1.9207  # log-likelihood ratio of 95 %, half of 1.96^2
_ROOT = np.sqrt(2 * _RATIO)
_PARABOLAS, _SETTLED = 4, 0.3  # most fits of a parabola; relative change of its axes below which they have converged
_TELLING = 0.16  # least curvature, in squared ranges: a fall by 0.02 over half a range; less may be steps
_NOTHING = 50.0  # fall of the log-likelihood at which falls are capped
_BEYOND = (0.01, 0.02, 0.04, 0.08, 0.16, 0.32, 0.64)  # shares of a range beyond an end at which the region may resume
_OUTWARD = 4  # number of such searches
_BRACKETS, _NARROW, _NEAR = 10, 2e-3, 0.01  # most rounds; sufficient width of a bracket, in ranges, and error of root
_MULTIPLES = 1.5, 3.0, np.inf  # standard deviations from the maximum at which profiles begin
_SEEDS, _SCANNED = 2, 32  # climbers for each value; places of the preceding scan over the other parameters
_BESIDE = 0.2  # extent of a second scan around the nearest place, in ranges: ridges are narrow
_HOPE = 1.5  # depth below the region from which climbers may still reach it
_AWAY = 0.02  # least distance of starting places from the ends of a range: at an end no climber would move


class Shape(NamedTuple):
    """The likelihood near its maximum, by places."""

    place: np.ndarray
    covariance: np.ndarray  # infinite where singular
    directions: np.ndarray
    deviations: np.ndarray


def shape_at(evaluate: Evaluator, point: np.ndarray) -> Shape:
    """Fit a parabola to values about a standard deviation away, where the log-likelihood has fallen by 1/2.

    Derivatives do not give this curvature: on a finer scale the likelihood has steps, with other curvatures between
    them. Each parabola sets the distances of the next points along its axes, and later fits use all values so far.
    """
    place = evaluate.places(point)
    size, count = np.ptp(evaluate.ends, axis=0), place.size
    top = evaluate.at(place[None])[0]
    axes, (first, second) = _alone(evaluate, place, top), np.triu_indices(count, 1)  # rows, in ranges
    offsets, falls = np.zeros((1, count)), np.zeros(1)
    for _ in range(_PARABOLAS):
        steps = np.concatenate([axes, (axes[first] + axes[second]) / np.sqrt(2)])
        more = _around(evaluate, place, steps)
        offsets = np.concatenate([offsets, (more - place) / size])
        falls = np.concatenate([falls, top - evaluate.at(more)[0]])
        back = np.linalg.inv(axes)
        slope, bend = _parabola(offsets @ back, falls)
        bends, vectors = np.linalg.eigh(bend)
        axes, slopes = vectors.T @ axes, np.abs(vectors.T @ slope)
        # The distance to a fall of 1/2 is the root of slope length + bend length^2/2 = 1/2.
        length = 1 / np.maximum(slopes + np.sqrt(np.maximum(slopes**2 + bends, 0.0)), 0.25)
        length = np.minimum(length, 0.5 / np.max(np.abs(axes), axis=1))
        axes *= length[:, None]
        if np.all(np.abs(length - 1) < _SETTLED):
            break
    hessian = back @ bend @ back.T
    eigenvalues, directions = np.linalg.eigh(hessian)
    covariance = np.full_like(bend, np.inf)
    if eigenvalues[0] > _TELLING:
        covariance = np.linalg.inv(hessian) * np.outer(size, size)
    return Shape(place, covariance, directions.T, 1 / np.sqrt(np.maximum(eigenvalues, 1e-6)))


def _alone(evaluate: Evaluator, place: np.ndarray, top: np.ndarray) -> np.ndarray:
    """Return steps along each parameter alone, in ranges, over which the log-likelihood falls by about 1/2."""
    length = np.full(place.size, 0.02)
    for _ in range(4):
        falls = top - evaluate.at(_around(evaluate, place, np.diag(length)))[0]
        fall = np.nan_to_num(np.maximum(*np.split(falls[1:], 2)), nan=np.inf)
        if np.all((fall > 0.1) & (fall < 2.0) | (length == 0.5)):
            break
        length = np.minimum(length * np.clip(np.sqrt(0.5 / np.maximum(fall, 1e-9)), 0.05, 4.0), 0.5)
    return np.diag(length)


def _around(evaluate: Evaluator, place: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return a place and the places at steps, in ranges, to both sides; a place near an end is first moved inside."""
    low, high = evaluate.ends
    reach = np.minimum(np.max(np.abs(steps), axis=0), 0.5) * (high - low)
    moves = np.concatenate([np.zeros((1, place.size)), steps, -steps]) * (high - low)
    return np.clip(np.clip(place, low + reach, high - reach) + moves, low, high)


def _parabola(offsets: np.ndarray, falls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return slope and curvature at 0 of the least-squares parabola through falls, weighted by root likelihood."""
    count = offsets.shape[1]
    row, column = np.triu_indices(count)
    falls = np.minimum(np.nan_to_num(falls, nan=np.inf), _NOTHING)
    weight = np.exp(-np.maximum(falls, 0.0) / 2)[:, None]
    squares = offsets[:, row] * offsets[:, column] * np.where(row == column, 0.5, 1.0)
    terms = np.concatenate([np.ones_like(weight), offsets, squares], axis=1)
    found = np.linalg.lstsq(terms * weight, falls * weight[:, 0], rcond=None)[0]
    bend = np.zeros((count, count))
    bend[row, column] = bend[column, row] = found[1 + count :]
    return found[1 : 1 + count], bend


class Profile(NamedTuple):
    """Intervals by the profile likelihood."""

    ends: np.ndarray  # (parameters, 2), places
    open: np.ndarray  # whether an end is only that of the range
    better: np.ndarray | None  # a point above the maximum


class _Row(NamedTuple):
    """A value of the held parameter, the root of twice the log-likelihood ratio there, and the place."""

    value: float
    root: float
    place: np.ndarray


def profile(evaluate: Evaluator, summits: Summits, shape: Shape) -> Profile:
    """Return the ends of intervals in which the profile of the log-likelihood is less than 1.92 below its maximum.

    For every parameter and side, the profile is sampled at some values up to the end of the range, the others climbing
    at each. Secants in the outermost bracket then find where the likelihood ratio crosses. Climbers begin at the best
    places nearby, also of a scan over the other parameters. Passed from value to value alone, they would stay on a
    lower summit.
    """
    low, high = evaluate.ends
    size = high - low
    sides = _Sides(evaluate, summits.values.max(), shape.place)
    variance = np.diagonal(shape.covariance)
    spread = np.minimum(np.sqrt(np.where(np.isfinite(variance), variance, np.inf)), size / 8)
    for multiple in _MULTIPLES:
        values = [shape.place[j] + s * multiple * spread[j] for j, s in sides.rows]
        inside = [np.clip(v, low[j], high[j]) for v, (j, _) in zip(values, sides.rows)]
        sides.follow(dict(zip(sides.rows, inside)))
    sides.recall()
    # Beyond a valley the region may go on: near its end, because a likelihood has steps, and farther away.
    for _ in range(_OUTWARD):
        sides.narrow()
        before = {side: sides.outermost(side) for side in sides.rows}
        tried = [{(j, s): sides.outside(before[j, s], j, s, x) for j, s in sides.rows} for x in _BEYOND]
        for wanted in tried:
            sides.follow(sides.hopeful(wanted))
        sides.recall()
        if all(abs(sides.outermost(side) - before[side]) < _NARROW * size[side[0]] for side in before):
            break
    sides.narrow()
    ends, open_ = np.stack([low, high], axis=1), np.ones((low.size, 2), bool)
    for j, s in sides.rows:
        pair = sides.bracket((j, s))
        if pair is not None:
            ends[j, (s + 1) // 2], open_[j, (s + 1) // 2] = _secant(*pair, 0.0), False
    better = sides.highest[1] if sides.highest[0] > sides.best + 1e-6 else None
    return Profile(ends, open_, better)


def _secant(inner: _Row, outer: _Row, margin: float) -> float:
    """Return the value where the root is 1.96, by a secant; `margin` is its least distance from both, as a share."""
    share = (_ROOT - inner.root) / max(outer.root - inner.root, 1e-12)
    return inner.value + (outer.value - inner.value) * np.clip(share, margin, 1 - margin)


class _Sides:
    """The known rows of the profiles on both sides of each parameter; a side is a parameter and -1 or 1."""

    def __init__(self, evaluate: Evaluator, best: float, place: np.ndarray):
        self.evaluate, self.best = evaluate, best
        self.rows = {(j, s): [_Row(place[j], 0.0, place)] for j in range(place.size) for s in (-1, 1)}
        self.highest = (-np.inf, None)

    def follow(self, wanted: dict[tuple[int, int], float]) -> None:
        """Climb with one parameter held at a value, for each given side, from two places.

        These are the highest of a scan, and the nearest on the profile or the best of all nearby.
        """
        if not wanted:
            return
        begin, free = [], []
        for (j, _), places in zip(wanted, self._scanned(wanted)[0]):
            held = np.arange(places.shape[1]) == j
            begin.extend(places)
            free.extend([~held] * _SEEDS)
        low, high = self.evaluate.ends
        inner = np.clip(np.array(begin), low + _AWAY * (high - low), high - _AWAY * (high - low))
        points = self.evaluate.points(np.where(free, inner, begin))
        group = np.repeat(np.arange(len(wanted)), _SEEDS)
        reached = batched_bfgs(self.evaluate, points, np.array(free), rounds=25, promise=1e-3, group=group)
        places, values = self.evaluate.places(reached.points), reached.values
        for number, (side, value) in enumerate(wanted.items()):
            best = _SEEDS * number + int(np.argmax(values[_SEEDS * number : _SEEDS * (number + 1)]))
            self.rows[side].append(_Row(value, np.sqrt(2 * max(self.best - values[best], 0.0)), places[best]))
        top = int(np.argmax(values))
        self.highest = max(self.highest, (values[top], reached.points[top]), key=lambda pair: pair[0])

    def _scanned(self, wanted: dict[tuple[int, int], float]) -> tuple[list[np.ndarray], np.ndarray]:
        """Return for each side starting places with its parameter held, and the highest place of a scan.

        The scan covers these places, some spread over the other parameters, and some around the nearest.
        """
        low, high = self.evaluate.ends
        tried = []
        for (j, s), value in wanted.items():
            nearest = min(self.rows[j, s], key=lambda row: abs(row.value - value))
            nearby = self._nearby(j, value, abs(nearest.value - value), nearest.place)
            others = low + (high - low) * low_discrepancy(_SCANNED, low.size)
            beside = np.clip(nearest.place + _BESIDE * (others - (low + high) / 2), low, high)
            tried.append(np.concatenate([[nearest.place, nearby], others, beside]))
            tried[-1][:, j] = value
        values = self.evaluate.scan(np.concatenate(tried)).reshape(len(tried), -1)
        first = np.argmax(values, axis=1)
        return [places[[k, int(k == 0)]] for places, k in zip(tried, first)], values.max(axis=1)

    def hopeful(self, wanted: dict[tuple[int, int], float]) -> dict[tuple[int, int], float]:
        """Select the sides at which a scan comes near to the region."""
        highest = self._scanned(wanted)[1]
        return {side: x for (side, x), top in zip(wanted.items(), highest) if top > self.best - _RATIO - _HOPE}

    def narrow(self) -> None:
        """Follow secants until all brackets are narrow enough."""
        for _ in range(_BRACKETS):
            brackets = {side: self.bracket(side) for side in self.rows}
            wide = {side: pair for side, pair in brackets.items() if pair is not None and self.is_wide(side, pair)}
            if not wide:
                return
            self.follow({side: _secant(*pair, 0.1) for side, pair in wide.items()})
            self.recall()

    def outermost(self, side: tuple[int, int]) -> float:
        """Return the outermost value within 95 %."""
        return max((row for row in self.rows[side] if row.root < _ROOT), key=lambda row: side[1] * row.value).value

    def outside(self, value: float, j: int, s: int, share: float) -> float:
        """Return a value farther out by a share of the range, or its end."""
        low, high = self.evaluate.ends
        return float(np.clip(value + s * share * (high - low)[j], low[j], high[j]))

    def is_wide(self, side: tuple[int, int], pair: tuple[_Row, _Row]) -> bool:
        """Return whether the bracket is too wide to give the end."""
        low, high = self.evaluate.ends
        inner, outer = pair
        narrow = abs(outer.value - inner.value) < _NARROW * (high - low)[side[0]]
        return not (narrow or min(_ROOT - inner.root, outer.root - _ROOT) < _NEAR)

    def recall(self) -> None:
        """Add to each side the outermost known place within 95 %, which may lie beyond a valley."""
        places, values = self.evaluate.known
        within = values > self.best - _RATIO
        places, values = places[within], values[within]
        for (j, s), rows in self.rows.items():
            if values.size:
                i = np.argmax(s * places[:, j])
                rows.append(_Row(places[i, j], np.sqrt(2 * max(self.best - values[i], 0.0)), places[i]))

    def _nearby(self, j: int, value: float, reach: float, otherwise: np.ndarray) -> np.ndarray:
        """Return the best known place whose parameter `j` is within half of `reach` of a value; else `otherwise`."""
        places, values = self.evaluate.known
        near = np.abs(places[:, j] - value) <= reach / 2
        return places[near][np.argmax(values[near])] if near.any() else otherwise

    def bracket(self, side: tuple[int, int]) -> tuple[_Row, _Row] | None:
        """Return the outermost neighbours between which the root passes 1.96; None if the last is below it."""
        rows = sorted(self.rows[side], key=lambda row: side[1] * row.value)
        if rows[-1].root < _ROOT:
            return None
        inside = max(i for i, row in enumerate(rows) if row.root < _ROOT)
        return rows[inside], rows[inside + 1]
