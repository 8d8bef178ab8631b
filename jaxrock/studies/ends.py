"""The ends of intervals along lines: where a margin passes through zero, also twice between two sampled points.

The margin, its slope and the number of impacts at sampled points tell where an end may hide, and only there the
sampling is refined. Many lines are searched at once; what is asked of each round goes out in one batch.
"""

from collections.abc import Callable

import numpy as np

_ROUGH, _DEEP = 7, 60  # halvings of an interval: where the margin is not smooth, and where an end may hide
_TIGHT = 4e-15  # width of a bracket, relative


def brackets_of(at: Callable, grid: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Intervals with one end each; and for every scene whether all points could be decided.

    An interval is halved where the verdict changes, until that is all that happens in it; and where an end may hide:
    the margin's tangents meet beyond zero or near it, or both sides overturn after different numbers of impacts (there
    may be a gap between them). Where the margin is not smooth it is halved some times for good measure.
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
        (left, right), (low, high), (rise, fall) = sides[0], sides[1], sides[2]
        guess = (low + high) / 2 + (rise - fall) * (right - left) / 8  # cubic through both values and slopes
        size = np.minimum(np.minimum(np.abs(low), np.abs(high)), np.abs(values[1]))
        rough = np.abs(values[1] - guess) > 0.05 * size
        halves = [
            [np.stack([x[0], v]) for x, v in zip(sides, values)],
            [np.stack([v, x[1]]) for x, v in zip(sides, values)],
        ]
        sides = [np.concatenate([first, second], axis=1) for first, second in zip(*halves)]
        index, depth, rough = np.tile(index, 2), np.tile(depth, 2) + 1, np.tile(rough, 2)
        width = sides[0][1] - sides[0][0]
        differ = (sides[1][0] < 0) != (sides[1][1] < 0)
        hidden = ~differ & _may_hide(*sides) & (width > _TIGHT)
        single = differ & (depth >= _ROUGH)
        kept.append((index[single], *(x[:, single] for x in sides)))
        more = ((differ | rough) & (depth < _ROUGH)) | (hidden & (depth < _DEEP))
        more &= ~np.isnan(sides[1]).any(axis=0) & ~single
        sides, index, depth = [x[:, more] for x in sides], index[more], depth[more]
    names = ("index", "z", "margin", "slope", "impacts")
    return {name: np.concatenate([part[k] for part in kept], axis=-1) for k, name in enumerate(names)}, complete


def _may_hide(z: np.ndarray, margin: np.ndarray, slope: np.ndarray, impacts: np.ndarray) -> np.ndarray:
    """Whether the margin may pass through zero twice between two points at which it has the same sign."""
    width, sign = z[1] - z[0], np.where(margin[0] < 0, -1.0, 1.0)
    low, high, rise, fall = sign * margin[0], sign * margin[1], sign * slope[0], sign * slope[1]
    dips = (rise < 0) & (fall > 0)
    where = (high - fall * width - low) / np.where(dips, rise - fall, 1.0)
    lowest = np.where(dips, low + rise * where, np.inf)
    plunges = (low + rise * width < 0) | (high - fall * width < 0)
    gap = (sign < 0) & (impacts[0] != impacts[1])
    return (lowest < 0.3 * np.minimum(low, high)) | plunges | gap


def roots_of(at: Callable, brackets: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The end in every bracket to rounding, by Newton's method, which bisection keeps within it."""
    index, z, margin, slope, impacts = (brackets[n].copy() for n in ("index", "z", "margin", "slope", "impacts"))
    columns = np.arange(index.size)
    for count in range(120):
        width = z[1] - z[0]
        open_ = width > _TIGHT * np.maximum(1.0, np.abs(z).max(axis=0))
        if not open_.any():
            break
        near = np.abs(margin[1]) < np.abs(margin[0])
        side = near.astype(int)
        best, value, rate = z[side, columns], margin[side, columns], slope[side, columns]
        step = -value / np.where(rate == 0, np.inf, rate)
        # A little too far, so that the bracket closes from both sides.
        trial = best + 1.05 * step + np.copysign(_TIGHT / 4, step)
        inside = (trial > z[0]) & (trial < z[1]) & (count % 4 != 3)
        trial = np.where(inside, trial, z.mean(axis=0))[open_]
        values = (trial, *at(trial, index[open_]))
        onto = ((values[1] < 0) == (margin[1, open_] < 0)).astype(int)
        for array, new in zip((z, margin, slope, impacts), values):
            array[onto, columns[open_]] = new
    rising = ~(margin[0] < 0)  # zero is safe
    lost, safe = rising.astype(int), 1 - rising.astype(int)
    return {
        "index": index,
        "z": z.mean(axis=0),
        "safe": z[safe, columns],
        "rising": rising,
        "impacts": impacts[lost, columns],
        "balanced": np.abs(margin).max(axis=0, initial=0.0) < 1e-6,
    }
