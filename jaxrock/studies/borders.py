"""Exact borders of overturning maps: curves on which a block just stands, with islands and safe gaps between them.

A column of a map is one frequency of the pulse. In each column the ends of all overturning intervals are found as
critical amplitudes are. Matching intervals of neighbouring columns form a region. Columns are inserted where intervals
do not match, because a region begins, ends, forks or bends there, down to a ten-millionth of the width.

Slow pulses have unboundedly many islands at ever lower intensities. Islands too small to be seen in the map are drawn
only as far as they were found.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxrock._arguments.annotations import arguments
from jaxrock._core.arrays import is_traced
from jaxrock.studies.ends import brackets_of, roots_of
from jaxrock.studies.search_axis import known_margin
from jaxrock.studies.spectra import OverturningMap, under_pulse
from jaxrock.sweeps.runner import cheap_per_point
from jaxrock.sweeps.sweep import surface

_FIRST = 256  # intervals of the first sampling of a column
_BEND = 1e-3  # of the ranges: the error of a straight line between two columns that is let pass
_CLOSE = 1e-7  # of the range of frequencies: columns are put no closer
_SPECK = 1e-6  # of the area of a map: what may be drawn wrongly where intervals do not fit
_MOST = 600  # columns
_NEAR = 1e-6  # relative: points of a map that lie so near to a border may have either verdict


class Region(NamedTuple):
    """Overturned blocks between two borders.

    - `impacts`: before overturning, at the lower border; 0 in regions without.
    - `frequency_ratio`: (n,) rising [-].
    - `lower`, `upper`: (n,) intensities [-], exact to rounding at each of them. At the edge of a map they are its own.
    """

    impacts: int
    frequency_ratio: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


class Borders(NamedTuple):
    """Result of `overturning_borders`.

    - `regions`: a list of `Region`s.
    - `crowded`: (n, 2) ranges of frequency ratios in which regions are not to be trusted. Islands there are too many to
      be told apart, or the engine gave up (a step budget that is too small), or points of the map contradict the
      intervals.
    """

    regions: list[Region]
    crowded: np.ndarray


class _Interval(NamedTuple):
    lower: float
    upper: float
    impacts: int
    kind: tuple[int, ...]  # impacts at either end: equal of intervals that belong together


@arguments
def overturning_borders(result: OverturningMap, *, progress: bool | None = False) -> Borders:
    """Find the regions of an overturning map in which blocks overturn, between their exact borders.

    **Arguments:**

    - `result`: from `overturning_map`, without further axes; its grid only tells the search where to look.
    - `progress`: whether to draw a progress bar; None: on a terminal, if it takes long.

    **Returns:** `Borders`. An interval of intensities may be missed if it is much narrower than a hundredth of the
    range and leaves no trace in the margins beside it. A safe gap between different numbers of impacts is not missed.

    **Raises:** ValueError for a map with further axes, of one column or one row (or of several that are alike), or that
    was not computed by `overturning_map`; TypeError within `jax.jit`, `jax.vmap` or a derivative.
    """
    if is_traced(result):
        raise TypeError(
            "Borders are searched from what was found before, so they cannot be traced (jax.jit, jax.vmap): ask "
            "`critical_amplitudes` for the lowest ends at every frequency."
        )
    if result.parameters or result.scene is None or not has_two_axes(result):
        raise ValueError(
            "Argument `result` must be a map of two axes, with two different values or more each, from "
            "`overturning_map`."
        )
    found = borders_within(result, None, progress)
    assert found is not None  # without a budget the search always finishes
    return found


def has_two_axes(result: OverturningMap) -> bool:
    """Return whether both axes of a map have an extent: at least two different values."""
    axes = np.asarray(result.frequency_ratio), np.asarray(result.intensity)
    return all(axis.ndim == 1 and np.ptp(axis) > 0 for axis in axes)


def borders_within(result: OverturningMap, most: int | None, progress: bool | None = False) -> Borders | None:
    """Find borders as `overturning_borders` does, of a map with two axes; None if it takes more scenes than `most`."""
    ratio, intensity = np.asarray(result.frequency_ratio), np.asarray(result.intensity)
    search = _Search(result.scene, float(intensity.min()), float(intensity.max()), progress, _Budget(most))
    try:
        return _found(search, ratio, intensity, np.asarray(result.state))
    except _TooMany:
        return None


class _TooMany(Exception):
    """Raised when a search needs more scenes than its budget."""


class _Budget:
    """Number of scenes that a search may still compute; None: unlimited."""

    def __init__(self, most: int | None):
        self.left = most

    def take(self, count: int) -> None:
        """Take `count` scenes from the budget, or raise `_TooMany`."""
        if self.left is None:
            return
        self.left -= count
        if self.left < 0:
            raise _TooMany


def _found(search: "_Search", ratio: np.ndarray, intensity: np.ndarray, state: np.ndarray) -> Borders:
    first, where = np.unique(ratio, return_index=True)
    columns = dict(zip(first, search.columns(first)))
    for x, known in zip(first, state.T[where]):
        if _contradicts(columns[x], intensity, known):
            columns[x] = None
    width = float(np.ptp(ratio))
    while True:
        places = sorted(columns)
        between, crowded = _wanted(places, columns, width, search.high - search.low)
        if not between or len(columns) > _MOST:
            break
        columns |= zip(between, search.columns(np.array(between)))
    return Borders(_regions(places, columns), np.array(crowded).reshape(-1, 2))


def _contradicts(column: "list[_Interval] | None", intensity: np.ndarray, state: np.ndarray) -> bool:
    """Return whether points of a map contradict the intervals of their column, apart from points close to a border."""
    if column is None:
        return False
    lost = np.zeros(intensity.size, bool)
    near = state < 0
    for interval in column:
        lost |= (intensity >= interval.lower) & (intensity <= interval.upper)
        for end in interval[:2]:
            near |= abs(intensity / end - 1) < _NEAR
    return bool(((lost != (state > 0)) & ~near).any())


class _Search(NamedTuple):
    """Search along the columns of a map, between two intensities and within a budget."""

    scene: tuple
    low: float
    high: float
    progress: bool | None
    budget: _Budget = _Budget(None)

    def at(self, z: np.ndarray, ratio: np.ndarray) -> tuple:
        """Margin, slope, impacts and openness at pairs of log intensity `z` and frequency ratio."""
        self.budget.take(z.size)
        return tuple(map(np.asarray, surface(_point, (z, ratio), self.scene, "borders", self.progress, outer=False)))

    def columns(self, ratio: np.ndarray) -> list[list[_Interval] | None]:
        """Overturning intervals of every column; None for a column in which a requested point has no result."""
        steps = self.low + (self.high - self.low) * np.geomspace(1e-4, 1.0, _FIRST)
        grid = np.broadcast_to(np.log([self.low, *steps]), (ratio.size, _FIRST + 1))
        failed: set[float] = set()

        def ask(z, ratio):
            values = self.at(z, ratio)
            failed.update(ratio[np.isnan(values[0])].tolist())
            return values

        def at(z, index):
            return ask(z, ratio[index])

        brackets, told = brackets_of(at, grid)
        ends = roots_of(at, brackets)
        failed.update(ratio[~told["complete"]].tolist(), ratio[ends["index"][~ends["known"]]].tolist())
        first, last = (ask(np.full(ratio.size, edge), ratio) for edge in (grid[0, 0], grid[0, -1]))
        found = [self._ends(grid[0], first, last, ends, k) for k in range(ratio.size)]
        rows = [[(*pair, x) for pair in pairs] for x, pairs in zip(ratio.tolist(), found)]
        cuts = _cuts(ask, [row for column in rows for row in column])
        parts = [[part for row in column for part in _parts(row, cuts)] for column in rows]
        return [None if x in failed else column for x, column in zip(ratio.tolist(), parts)]

    @staticmethod
    def _ends(grid, first: tuple, last: tuple, ends: dict, k: int) -> list[tuple]:
        """Both ends of each interval of column k: logarithm of the intensity, impacts."""
        mine = np.flatnonzero(ends["index"] == k)
        mine = mine[np.argsort(ends["z"][mine])]
        lower = [(ends["z"][i], int(ends["impacts"][i])) for i in mine if ends["rising"][i]]
        upper = [(ends["z"][i], int(ends["impacts"][i])) for i in mine if not ends["rising"][i]]
        if first[0][k] < 0:
            lower = [(grid[0], int(first[2][k])), *lower]
        if last[0][k] < 0:
            upper = [*upper, (grid[-1], int(last[2][k]))]
        return list(zip(lower, upper))


def _cuts(ask: Callable, found: list[tuple]) -> dict[tuple, float]:
    """Find the intensity at which an interval switches between overturning with and without impacts.

    There is no safe gap at this cut. The result is keyed by the interval: both ends and the frequency ratio.
    """
    mixed = [row for row in found if _is_mixed(row[0], row[1])]
    if not mixed:
        return {}
    low, high, ratio = (np.array(x) for x in zip(*((first[0], last[0], x) for first, last, x in mixed)))
    without = np.array([first[1] == 0 for first, *_ in mixed])
    for _ in range(50):
        middle = (low + high) / 2
        same = (ask(middle, ratio)[2] == 0) == without
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return {row: float(cut) for row, cut in zip(mixed, (low + high) / 2)}


def _is_mixed(lower: tuple, upper: tuple) -> bool:
    return (lower[1] == 0) != (upper[1] == 0)


def _parts(row: tuple, cuts: dict[tuple, float]) -> list[_Interval]:
    """Split the interval between two ends at its cut, if overturning is free of impacts on one side of the cut only."""
    (low, first), (high, last), _ = row
    if not _is_mixed(*row[:2]):
        return [_Interval(math.exp(low), math.exp(high), first, (first, last))]
    cut = math.exp(cuts[row])
    return [_Interval(math.exp(low), cut, first, (first, -1)), _Interval(cut, math.exp(high), last, (-1, last))]


@cheap_per_point
def _point(z, ratio, scene):
    """Margin, slope by z, impacts and whether the verdict is open, of a block under a pulse of intensity e^z."""

    def margin(z):
        result, _ = under_pulse(jnp.exp(z), ratio, scene)
        return result.margin, result

    margin, slope, result = jax.jvp(margin, (z,), (jnp.ones_like(z),), has_aux=True)
    margin, is_open = known_margin(margin, result.status)
    return margin, slope, result.impact_count, is_open


def _pairs(here: list[_Interval], there: list[_Interval], strict: bool) -> list[tuple[int, int]]:
    """Match intervals of two columns: they overlap, and neither overlaps another interval of that kind.

    `strict`: match only intervals of equal kind. Otherwise the remaining intervals may also match with different impact
    counts, if both have impacts or neither has.
    """
    overlap = [
        (i, j)
        for i, a in enumerate(here)
        for j, b in enumerate(there)
        if max(a.lower, b.lower) <= min(a.upper, b.upper)
    ]
    found = _only([(i, j) for i, j in overlap if here[i].kind == there[j].kind])
    if strict:
        return found
    left, right = {i for i, _ in found}, {j for _, j in found}
    rest = [(i, j) for i, j in overlap if i not in left and j not in right]
    return sorted(found + _only([(i, j) for i, j in rest if (here[i].impacts == 0) == (there[j].impacts == 0)]))


def _only(fits: list[tuple[int, int]]) -> list[tuple[int, int]]:
    return [(i, j) for i, j in fits if sum(i == k for k, _ in fits) == 1 == sum(j == k for _, k in fits)]


def _seen(count: int) -> float:
    """Height, as a share of the range, above which an unmatched interval makes the search insert a column.

    It grows with the number of intervals in the column.
    """
    return 2e-4 * max(1.0, count / 8) ** 2


def _wanted(places: list, columns: dict, width: float, height: float) -> tuple[list[float], list[tuple]]:
    """Return frequency ratios at which to insert columns, and the ranges that stay unresolved.

    A range stays unresolved if its intervals do not match and it is too narrow to refine, or if a column has no result.
    """
    wanted, crowded, pairs = set(), [], []
    for left, right in zip(places, places[1:]):
        if columns[left] is None or columns[right] is None:
            crowded.append((left, right))
            pairs.append([])
            continue
        found = _pairs(columns[left], columns[right], strict=True)
        pairs.append(found)
        lonely, seen = 0.0, 1.0
        for side, place in enumerate((left, right)):
            paired = {pair[side] for pair in found}
            alone = [each.upper - each.lower for k, each in enumerate(columns[place]) if k not in paired]
            lonely = max(lonely, *alone, 0.0)
            seen = min(seen, _seen(len(columns[place])))
        if right - left > _CLOSE * width and lonely > seen * height:
            wanted.add((left + right) / 2)
        elif (right - left) * lonely > _SPECK * width * height:
            crowded.append((left, right))
    return sorted(wanted | _bends(places, columns, pairs, width, height)), crowded


def _bends(places: list, columns: dict, pairs: list, width: float, height: float) -> set[float]:
    """Return frequency ratios at which to insert columns because a border is not straight."""
    wanted = set()
    for (left, here, right), (before, after) in zip(zip(places, places[1:], places[2:]), zip(pairs, pairs[1:])):
        if max(here - left, right - here) <= _CLOSE * width:
            continue
        share, onward = (here - left) / (right - left), dict(after)
        for i, j in before:
            if j not in onward:
                continue
            a, b, c = columns[left][i], columns[here][j], columns[right][onward[j]]
            if any(abs(y - (x + share * (z - x))) > _BEND * height for x, y, z in zip(a[:2], b[:2], c[:2])):
                wanted |= {(left + here) / 2, (here + right) / 2}
    return wanted


def _regions(places: list, columns: dict) -> list[Region]:
    """Chain matching intervals, column after column."""
    open_, regions = {}, []
    for k, place in enumerate(places):
        now, before = columns[place] or [], (columns[places[k - 1]] if k else None) or []
        onward = {j: i for i, j in _pairs(before, now, strict=False)}
        chains = {j: open_.pop(onward[j], []) if j in onward else [] for j in range(len(now))}
        regions += open_.values()
        open_ = {j: [*chain, (place, now[j])] for j, chain in chains.items()}
    regions += open_.values()
    return [_region(chain) for chain in regions]


def _region(chain: list[tuple[float, _Interval]]) -> Region:
    ratio = np.array([place for place, _ in chain])
    lower, upper = (np.array([interval[k] for _, interval in chain]) for k in (0, 1))
    return Region(chain[0][1].impacts, ratio, lower, upper)
