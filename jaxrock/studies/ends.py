"""Ends of overturning intervals along lines: zeros of the margin, even two of them between two sampled points.

The margin, its slope and the number of impacts at sampled points tell where an end may hide, and only there is the
sampling refined. Many lines are searched at once, with one batch of points per round.

A point whose verdict is open tells nothing of its surroundings, so points beside it are asked in its place. Within the
rounding of an end every verdict is open: there the sign of the computed margin closes the bracket.

`lowest_ends` searches traced arrays with the functions of this module that take `numbers`: numpy here, jax.numpy there.
"""

from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np

Sides = list[Any]  # z, margin, slope, impacts and openness at both ends of many intervals, (2, intervals) each

_ROUGH, _DEEP = 7, 60  # halvings of an interval: where the margin is not smooth, and where an end may hide
_TIGHT = 18  # width of a bracket, relative, over the rounding of margins
_BALANCED = 1e-6, 2e4  # margin at an end where the block comes to balance: so much, or so often the rounding
_BLUR = (
    1e-8,
    2e4,
)  # width of a bracket, relative, in which open verdicts are its end's: so much, or so often the rounding
PLACES = (0.5, 0.52, 0.55)  # where an interval is divided, over its width: a place is skipped if its verdict is open


def brackets_of(at: Callable, grid: np.ndarray) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return intervals with one end each, and per scene `complete` and `from_the_least`.

    `at`: margin (NaN where unknown), its slope, impacts, and whether the verdict is open, at points of scenes.

    `complete`: every point could be decided. `from_the_least`: the scene overturns at the first point.

    An interval is halved at most `_ROUGH` times where the verdict changes or the margin is not smooth. It is halved
    further, at most `_DEEP` times, where an end may hide: the margin's tangents meet beyond zero or near it, or both
    sides overturn after different numbers of impacts (there may be a gap between them).
    """
    scenes, points = grid.shape
    index = np.repeat(np.arange(scenes), points)
    values = without_open(np, [grid, *(x.reshape(scenes, points) for x in at(grid.ravel(), index))])
    margin, is_open = values[1], values[4]
    sides = [np.stack([x[:, :-1].ravel(), x[:, 1:].ravel()]) for x in values]
    index, depth = np.repeat(np.arange(scenes), points - 1), np.zeros(scenes * (points - 1), int)
    complete = ~(np.isnan(margin) | is_open).any(axis=1)
    kept = []
    while index.size:
        blurred = is_blurred(np, sides)
        values = _divided(at, sides[0], index, blurred)
        complete[index[~is_told(np, values, blurred)]] = False
        with np.errstate(invalid="ignore"):  # the margin of a block that fell flat before its saddle is infinite
            sides, depth, single, more = halved(np, sides, values, depth)
        index = np.tile(index, 2)
        kept.append((index[single], *(x[:, single] for x in sides)))
        sides, index, depth = [x[:, more] for x in sides], index[more], depth[more]
    names = ("index", "z", "margin", "slope", "impacts", "is_open")
    told = {"complete": complete, "from_the_least": margin[:, 0] < 0}
    return {name: np.concatenate([part[k] for part in kept], axis=-1) for k, name in enumerate(names)}, told


def without_open(numbers: ModuleType, values: list) -> list:
    """Return sampled points and their values, (..., points); a point that is open repeats the one before it."""
    before = [numbers.concatenate([x[..., :1], x[..., :-1]], axis=-1) for x in values]
    inner = numbers.arange(values[0].shape[-1]) < values[0].shape[-1] - 1  # the search reaches to the last point
    return [numbers.where(values[4] & inner, old, new) for old, new in zip(before, values)]


def _divided(at: Callable, z: np.ndarray, index: np.ndarray, blurred: np.ndarray) -> tuple:
    """Return a point in every interval and its values; if possible one whose verdict is not open."""
    values: list[np.ndarray] = []
    again = np.arange(index.size)
    for place in PLACES:
        trial = z[0, again] + place * (z[1, again] - z[0, again])
        new = [np.array(x) for x in (trial, *at(trial, index[again]))]
        values = values or new
        for array, each in zip(values, new):
            array[again] = each
        again = again[new[4] & ~blurred[again]]
        if not again.size:
            break
    return tuple(values)


def is_blurred(numbers: ModuleType, sides: Sides):
    """Return whether an interval is so narrow that open verdicts in it are those of an end within it."""
    return sides[0][1] - sides[0][0] <= _blur(numbers, sides)


def _blur(numbers: ModuleType, sides: Sides):
    least, often = _BLUR
    return max(least, often * _rounding(sides)) * numbers.maximum(1.0, abs(sides[0]).max(axis=0))


def none_open(numbers: ModuleType, like) -> list:
    """Return the least and the largest open point of each bracket, before there are any."""
    return [numbers.full_like(like, numbers.inf), numbers.full_like(like, -numbers.inf)]


def with_open(numbers: ModuleType, extremes: list, values: tuple) -> list:
    """Return the least and the largest open point of each bracket, after one more point."""
    z, is_open = values[0], values[4]
    low, high = numbers.where(is_open, z, numbers.inf), numbers.where(is_open, z, -numbers.inf)
    return [numbers.minimum(extremes[0], low), numbers.maximum(extremes[1], high)]


def are_close(numbers: ModuleType, extremes: list, sides: Sides):
    """Return whether all open points of a closed bracket lie in the blur of its end."""
    z = sides[0].mean(axis=0)
    return numbers.maximum(extremes[1] - z, z - extremes[0]) <= _blur(numbers, sides)


def is_told(numbers: ModuleType, values: Sides | tuple, blurred):
    """Return whether points tell what becomes of the scene: known, and not open outside of the blur of an end."""
    return numbers.where(values[4], blurred, ~numbers.isnan(values[1]))


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
    known = is_told(numbers, sides, is_blurred(numbers, sides)).all(axis=0)
    single = differ & (depth >= _ROUGH) & known
    more = ((differ | rough) & (depth < _ROUGH)) | (hidden & (depth < _DEEP))
    return sides, depth, single, more & known & ~single


def _may_hide(numbers: ModuleType, z, margin, slope, impacts, is_open):
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
    names = ("z", "margin", "slope", "impacts", "is_open")
    index, sides = brackets["index"], [brackets[name].copy() for name in names]
    columns, known = np.arange(index.size), np.ones(index.size, bool)
    extremes = none_open(np, sides[0][0])
    for count in range(MOST_POINTS):
        open_ = is_wide(np, sides)
        if not open_.any():
            break
        with np.errstate(invalid="ignore"):
            trial = next_point(np, sides, count)[open_]
        values = (trial, *at(trial, index[open_]))
        known[open_] &= ~np.isnan(values[1]) | values[4]
        for array, new in zip(extremes, with_open(np, [x[open_] for x in extremes], values)):
            array[open_] = new
        onto = ((values[1] < 0) == (sides[1][1, open_] < 0)).astype(int)
        for array, new in zip(sides, values):
            array[onto, columns[open_]] = new
    return {"index": index, "known": known & are_close(np, extremes, sides)} | ends_of(np, sides)


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
    z, margin, _, impacts, _ = sides
    least, often = _BALANCED
    rising = ~(margin[0] < 0)  # zero is safe
    return {
        "z": z.mean(axis=0),
        "safe": numbers.where(rising, z[0], z[1]),
        "rising": rising,
        "impacts": numbers.where(rising, impacts[1], impacts[0]),
        "balanced": numbers.maximum(abs(margin[0]), abs(margin[1])) < max(least, often * _rounding(sides)),
    }
