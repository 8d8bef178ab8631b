"""All intervals of intensity that overturn a block under one cycle of a sine; terms as in `sine_pulse`."""

from typing import Annotated, Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from jaxrock._arguments.annotations import arguments, at_least, known
from jaxrock._arguments.ranges import Range, share
from jaxrock._arguments.repr import described
from jaxrock.closed_form import _sine_arcs as arcs
from jaxrock.closed_form.sine_limits import after_pulse_limits, impact_time_limit, no_impact_limit

_above_one = Range("be above 1, and at most 1e6", 1.0, np.inf, lambda x: (x > 1) & (x <= 1e6))
_ratio = Range("be positive, from 1e-3 to 1e3", 0.0, np.inf, lambda x: (x >= 1e-3) & (x <= 1e3))
_MOST_DROP = 8  # largest drop of impacts between samples for which each change is searched separately


class OverturningIntervals(eqx.Module):
    """The intensities that overturn a block, from the lowest: everything between `lower` and `upper`.

    - `impacts`: before overturning, in the middle of the interval.
    - `searched_from`: below this intensity nothing was searched.

    Without loss (restitution 1) the safe gap below the last interval closes, and it touches the one before.
    """

    __repr__ = described

    lower: Float[np.ndarray, " n"]
    upper: Float[np.ndarray, " n"]
    impacts: Int[np.ndarray, " n"]
    searched_from: float


@arguments
def overturning_intervals(
    frequency_ratio: Annotated[float, known(_ratio)],
    restitution: Annotated[float, known(share)],
    *,
    searched_from: Annotated[float, known(_above_one)] = 1.0001,
    points: Annotated[int, at_least(2, 10**7)] = 4096,
) -> OverturningIntervals:
    """Find every interval of intensity that overturns a block, the islands with 3, 5, 7... impacts included.

    **Arguments:**

    - `frequency_ratio`: omega_g/p, positive. `restitution`: in [0, 1].
    - `searched_from`: lowest intensity searched, above 1.
    - `points`: samples of the search below `impact_time_limit`. Islands and gaps between samples are found where the
      number of impacts changes with them, as it did in all cases checked.

    **Returns:** `OverturningIntervals`; the ends are roots to rounding.

    **Source:** D&D 3.10, 3.18 and 3.20. For more impacts, the same condition after each arc in closed form. The set
    that the paper calls complete covers frequency ratios above 1.05 only.
    """
    ratio = frequency_ratio
    limit, last = float(impact_time_limit(ratio)), float(no_impact_limit(ratio))
    lower, upper = _sampled(searched_from, limit, ratio, restitution, points) if searched_from < limit else ([], [])
    begins, stops = (float(x) for x in after_pulse_limits(ratio, restitution))
    if len(lower) > len(upper):
        upper.append(stops if np.isfinite(stops) else limit)
    elif np.isfinite(stops):
        lower.append(begins)
        upper.append(stops)
    # Ends above the limit are exact roots, which may lie below the start of the search.
    lower, upper = np.maximum([*lower, last], searched_from), np.array([*upper, np.inf])
    lower, upper = lower[lower < upper], upper[lower < upper]
    impacts = _at(np.minimum((lower[:-1] + upper[:-1]) / 2, np.nextafter(last, 0)), ratio, restitution)[1]
    return OverturningIntervals(lower, upper, np.append(impacts, 0), float(searched_from))


def _sampled(searched_from: float, limit: float, ratio: float, restitution: float, points: int) -> tuple[list, list]:
    """Return the ends of the intervals below a limit; the last one continues above it where it has no upper end."""
    samples = np.linspace(searched_from, max(limit * (1 - 1e-13), searched_from), points)
    values, impacts = _at(samples, ratio, restitution)
    # A change in the number of impacts marks an island or a gap, however narrow; others lie near a local extreme.
    turns = _impact_turns(samples, impacts, ratio, restitution)
    step = (limit - searched_from) / points * np.linspace(-1, 1, 129)
    more = [turns, _inside(turns, samples[1] - samples[0]), (samples[_near_zero(values), None] + step).ravel()]
    more = np.clip(np.concatenate(more), searched_from, samples[-1])
    samples, order = np.unique(np.concatenate([samples, more]), return_index=True)
    values = np.concatenate([values, _at(more, ratio, restitution)[0]])[order]
    lost = values > 0
    change = np.flatnonzero(lost[1:] != lost[:-1])

    def unchanged(points):
        return (_at(points, ratio, restitution)[0] > 0) == lost[change][:, None]

    low, high = _narrowed(samples[change], samples[change + 1], unchanged, 27)
    ends = (low + high) / 2
    lower, upper = list(ends[~lost[change]]), list(ends[lost[change]])
    if lost[0]:
        lower.insert(0, searched_from)
    return lower, upper


def _impact_turns(samples: np.ndarray, impacts: np.ndarray, ratio, restitution) -> np.ndarray:
    """Return both sides of the intensities at which the number of impacts falls, each to rounding."""
    drop = impacts[:-1] - impacts[1:]
    pairs = np.flatnonzero((drop > 0) & (drop <= _MOST_DROP))
    levels = [(i, level) for i in pairs for level in range(impacts[i + 1], impacts[i])]
    if not levels:
        return np.zeros(0)
    index, level = np.array(levels).T

    def more(points):
        return _at(points, ratio, restitution)[1] > level[:, None]

    return np.unique(np.concatenate(_narrowed(samples[index], samples[index + 1], more, 15)))


def _at(points: np.ndarray, ratio: float, restitution: float) -> tuple[np.ndarray, np.ndarray]:
    """Return `growth` at the end of the pulse, and the impacts before overturning, at points of any shape."""
    if not points.size:
        return np.zeros(points.shape), np.zeros(points.shape, int)
    end: Any = jax.tree.map(np.asarray, arcs.at_pulse_end(points.ravel(), ratio, restitution))
    directly = end.opening + end.speed > 1
    return arcs.growth(end, restitution).reshape(points.shape), (end.impacts + ~directly).reshape(points.shape)


def _narrowed(below, above, like_below, levels: int) -> tuple[np.ndarray, np.ndarray]:
    """Narrow the brackets of a change, each cut into 4 at every level."""
    rows = np.arange(below.size)
    for _ in range(levels):
        grid = below[:, None] + (above - below)[:, None] * np.linspace(0, 1, 5)
        first = np.cumprod(like_below(grid[:, 1:-1]), axis=1).sum(axis=1)
        below, above = grid[rows, first], grid[rows, first + 1]
    return below, above


def _inside(turns: np.ndarray, widest: float) -> np.ndarray:
    """Return samples between neighbouring turns that lie within one step of the search."""
    gaps = np.diff(turns)
    narrow = gaps < widest
    return (turns[:-1, None] + gaps[:, None] * np.linspace(0, 1, 33)[1:-1])[narrow].ravel()


def _near_zero(values: np.ndarray) -> np.ndarray:
    """Return the indices of samples that are local extremes towards zero."""
    size, sign = np.abs(values), np.sign(values)
    lowest = (size[1:-1] <= size[:-2]) & (size[1:-1] <= size[2:]) & (size[1:-1] < 0.3)
    return 1 + np.flatnonzero(lowest & (sign[1:-1] == sign[:-2]) & (sign[1:-1] == sign[2:]))
