"""Ends of overturning intervals along lines: zeros of the margin, even two of them between two sampled points.

The margin, its slope and the number of impacts at sampled points tell where an end may hide, and only there is the
sampling refined. Many lines are searched at once, with one batch of points per round.

`lowest_ends` searches traced arrays with the functions of this module that take `numbers`: numpy here, jax.numpy there.
"""

from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np

Sides = list[Any]  # z, margin, slope and impacts at both ends of many intervals, (2, intervals) each

_ROUGH, _DEEP = 7, 60  # halvings of an interval: where the margin is not smooth, and where an end may hide
_TIGHT = 18  # width of a bracket, relative, over the rounding of margins
_BALANCED = 1e-6, 2e4  # margin at an end where the block comes to balance: so much, or so often the rounding


def brackets_of(at: Callable, grid: np.ndarray) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return intervals with one end each, and per scene `complete` and `from_the_least`.

    `complete`: every point could be decided. `from_the_least`: the scene overturns at the first point.

    An interval is halved at most `_ROUGH` times where the verdict changes or the margin is not smooth. It is halved
    further, at most `_DEEP` times, where an end may hide: the margin's tangents meet beyond zero or near it, or both
    sides overturn after different numbers of impacts (there may be a gap between them).
    """
    scenes, points = grid.shape
    index = np.repeat(np.arange(scenes), points)
    margin, slope, impacts = (x.reshape(scenes, points) for x in at(grid.ravel(), index))
    sides = [np.stack([x[:, :-1].ravel(), x[:, 1:].ravel()]) for x in (grid, margin, slope, impacts)]
    index, depth = np.repeat(np.arange(scenes), points - 1), np.zeros(scenes * (points - 1), int)
    complete = ~np.isnan(margin).any(axis=1)
    kept = []
    while index.size:
        middle = sides[0].mean(axis=0)
        values = (middle, *at(middle, index))
        complete[index[np.isnan(values[1])]] = False
        with np.errstate(invalid="ignore"):  # the margin of a block that fell flat before its saddle is infinite
            sides, depth, single, more = halved(np, sides, values, depth)
        index = np.tile(index, 2)
        kept.append((index[single], *(x[:, single] for x in sides)))
        sides, index, depth = [x[:, more] for x in sides], index[more], depth[more]
    names = ("index", "z", "margin", "slope", "impacts")
    told = {"complete": complete, "from_the_least": margin[:, 0] < 0}
    return {name: np.concatenate([part[k] for part in kept], axis=-1) for k, name in enumerate(names)}, told


def halved(numbers: ModuleType, sides: Sides, values: tuple, depth) -> tuple:
    """Return both halves of every interval, left halves first, from the values at its middle.

    **Returns:** their sides and depths; whether a half contains exactly one end; whether to halve it again.
    """
    (left, right), (low, high), (rise, fall) = sides[:3]
    guess = (low + high) / 2 + (rise - fall) * (right - left) / 8  # cubic through both values and slopes
    size = numbers.minimum(numbers.minimum(abs(low), abs(high)), abs(values[1]))
    rough = numbers.tile(abs(values[1] - guess) > 0.05 * size, 2)
    halves = [(numbers.concatenate([x[0], v]), numbers.concatenate([v, x[1]])) for x, v in zip(sides, values)]
    sides, depth = [numbers.stack(each) for each in halves], numbers.tile(depth, 2) + 1
    differ = (sides[1][0] < 0) != (sides[1][1] < 0)
    hidden = ~differ & _may_hide(numbers, *sides) & (sides[0][1] - sides[0][0] > _TIGHT * _rounding(sides))
    known = ~numbers.isnan(sides[1]).any(axis=0)
    single = differ & (depth >= _ROUGH) & known
    more = ((differ | rough) & (depth < _ROUGH)) | (hidden & (depth < _DEEP))
    return sides, depth, single, more & known & ~single


def _may_hide(numbers: ModuleType, z, margin, slope, impacts):
    """Return whether the margin may pass through zero twice between two points at which it has one sign."""
    width, sign = z[1] - z[0], numbers.where(margin[0] < 0, -1.0, 1.0)
    low, high, rise, fall = sign * margin[0], sign * margin[1], sign * slope[0], sign * slope[1]
    dips = (rise < 0) & (fall > 0)
    where = (high - fall * width - low) / numbers.where(dips, rise - fall, 1.0)
    lowest = numbers.where(dips, low + rise * where, numbers.inf)
    plunges = (low + rise * width < 0) | (high - fall * width < 0)
    gap = (sign < 0) & (impacts[0] != impacts[1])
    return (lowest < 0.3 * numbers.minimum(low, high)) | plunges | gap


def roots_of(at: Callable, brackets: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Find the end in every bracket to rounding, by Newton's method safeguarded by bisection.

    `known` in the result: all points on the way could be decided.
    """
    index, sides = brackets["index"], [brackets[name].copy() for name in ("z", "margin", "slope", "impacts")]
    columns, known = np.arange(index.size), np.ones(index.size, bool)
    for count in range(MOST_POINTS):
        open_ = is_wide(np, sides)
        if not open_.any():
            break
        with np.errstate(invalid="ignore"):
            trial = next_point(np, sides, count)[open_]
        values = (trial, *at(trial, index[open_]))
        known[open_] &= ~np.isnan(values[1])
        onto = ((values[1] < 0) == (sides[1][1, open_] < 0)).astype(int)
        for array, new in zip(sides, values):
            array[onto, columns[open_]] = new
    return {"index": index, "known": known} | ends_of(np, sides)


MOST_POINTS = 120  # evaluations to close a bracket


def is_wide(numbers: ModuleType, sides: Sides):
    """Return whether a bracket is wider than rounding."""
    low, high = sides[0]
    return high - low > _TIGHT * _rounding(sides) * numbers.maximum(1.0, numbers.maximum(abs(low), abs(high)))


def _rounding(sides: Sides) -> float:
    """Return the machine epsilon of the margins, whose type may be less precise than that of the points."""
    return float(np.finfo(sides[1].dtype).eps)


def next_point(numbers: ModuleType, sides: Sides, count):
    """Return the next point to evaluate in each bracket, after `count` points: a Newton step, or the middle."""
    z, margin, slope = sides[:3]
    near = abs(margin[1]) < abs(margin[0])
    best, value, rate = (numbers.where(near, x[1], x[0]) for x in (z, margin, slope))
    step = -value / numbers.where(rate == 0, numbers.inf, rate)
    # A Newton step goes slightly too far, so that the bracket closes from both sides.
    trial = best + 1.05 * step + numbers.copysign(_TIGHT / 4 * _rounding(sides), step)
    inside = (trial > z[0]) & (trial < z[1]) & (count % 4 != 3)
    return numbers.where(inside, trial, z.mean(axis=0))


def ends_of(numbers: ModuleType, sides: Sides) -> dict[str, Any]:
    """Describe the ends in closed brackets; `safe` is the side on which the block stands."""
    z, margin, _, impacts = sides
    least, often = _BALANCED
    rising = ~(margin[0] < 0)  # zero is safe
    return {
        "z": z.mean(axis=0),
        "safe": numbers.where(rising, z[0], z[1]),
        "rising": rising,
        "impacts": numbers.where(rising, impacts[1], impacts[0]),
        "balanced": numbers.maximum(abs(margin[0]), abs(margin[1])) < max(least, often * _rounding(sides)),
    }
