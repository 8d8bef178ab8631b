"""Figures of overturning maps."""

import logging
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxrock.engines.taylor.accurate import Series
from jaxrock.plot.style import (
    BLUE,
    DURATION,
    GREY,
    INTENSITY,
    RATIO,
    RED,
    STRENGTH,
    draw_cells,
    figure,
    in_order,
    limits_of,
    without_more,
)
from jaxrock.studies.borders import Borders, Region, borders_within, has_two_axes, overturning_borders
from jaxrock.studies.spectra import OverturningMap

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_LOG = logging.getLogger("jaxrock")
_SCENES = 500_000  # most scenes for exact borders of a figure: enough for all pulses except the longest
_SAFE = ("#faf7ee", "#c4a35a")  # survivors, from those at rest to those that nearly overturn
_STATES = ("black", BLUE, RED)  # not computed, overturned without impact, overturned after impacts


@figure(1)
def overturning(
    result: OverturningMap,
    axis: "Axes | None" = None,
    *,
    by_duration: bool = False,
    exact: bool | None = None,
    safe: bool = True,
    progress: bool | None = None,
) -> "Axes":
    """Draw an overturning map: survivors by their peak rotation, overturned without impact, overturned after impacts.

    **Arguments:**

    - `result`: from `overturning_map`, without further axes.
    - `axis`: matplotlib axis; None makes a figure.
    - `by_duration`: whether to draw uplift strength over pulse duration, as is usual for single-lobe pulses, in place
      of intensity over frequency ratio.
    - `exact`: whether to draw exact borders (`overturning_borders`), or pixels alone. Borders include islands and gaps
      of any size; pixels remain where there are too many islands, or the search failed. None: borders if the series
      engine solves the map, and if they take half a million scenes at most.
    - `safe`: whether survivors are coloured, with a scale beside the axis.
    - `progress`: whether to draw a progress bar during the search for borders; None: on a terminal, if it takes long.

    **Returns:** the axis.

    **Raises:** ValueError for a map with further axes, and for `exact` borders of one column or one row.
    """
    import matplotlib.pyplot as plt
    from matplotlib.colors import BoundaryNorm, LinearSegmentedColormap, ListedColormap

    without_more(result)
    if axis is None:
        _, axis = plt.subplots(figsize=(7, 5), layout="constrained")
    x = np.asarray(result.pulse_duration if by_duration else result.frequency_ratio)
    y = np.asarray(result.uplift_strength if by_duration else result.intensity)
    (x, columns), (y, rows) = in_order(x), in_order(y)
    state = np.asarray(result.state)[np.ix_(rows, columns)]
    axis.set_facecolor(_SAFE[0])
    if safe:
        shades = LinearSegmentedColormap.from_list("survivors", _SAFE)
        peaks = _beyond(np.where(state == 0, np.asarray(result.rotation_ratio)[np.ix_(rows, columns)], np.nan))
        picture = draw_cells(axis, x, y, peaks, cmap=shades, vmin=0, vmax=1)
        axis.figure.colorbar(picture, ax=axis, label=r"peak rotation of survivors $\theta_{max}/\alpha$", extend="max")
    pixels, found = np.ones(x.size, bool), _borders_of(result, exact, progress)
    if found is not None:
        pixels = _within(np.asarray(result.frequency_ratio)[columns], found.crowded)
        for region in found.regions:
            draw_region(axis, region, by_duration)
    lost = np.ma.masked_where((state == 0) | ~pixels, state)
    colors, norm = ListedColormap(_STATES), BoundaryNorm((-1.5, 0.5, 1.5, 2.5), 3)
    draw_cells(axis, x, y, lost, cmap=colors, norm=norm)
    if (state == -1).any():
        unknown = np.nonzero(state == -1)
        axis.plot(x[unknown[1]], y[unknown[0]], "kx", markersize=3)
    _explain_states(axis, state, "lower right" if by_duration else "upper left")
    axis.set(xlim=limits_of(x), ylim=limits_of(y))
    axis.set_xlabel(DURATION if by_duration else RATIO)
    axis.set_ylabel(
        f"{STRENGTH} (uplift threshold / peak acceleration)"
        if by_duration
        else f"{INTENSITY} (peak acceleration / uplift threshold)"
    )
    return axis


def _borders_of(result: OverturningMap, exact: bool | None, progress: bool | None) -> Borders | None:
    """Return exact borders if `exact`, or if it is None and they are found quickly; otherwise None."""
    if exact:
        return overturning_borders(result, progress=progress)
    if exact is False or not _is_quick(result):
        return None
    found = borders_within(result, _SCENES, progress)
    if found is None:
        _LOG.info("too many islands for exact borders: pixels are drawn (exact=True takes the time)")
    return found


def _explain_states(axis: "Axes", state: np.ndarray, place: str) -> None:
    """Draw a legend of verdicts, with "not computed" only where it occurs."""
    from matplotlib.patches import Patch

    names = {-1: "not computed", 0: "safe", 1: "overturned without impact", 2: "overturned after impacts"}
    colors = dict(zip((-1, 1, 2, 0), (*_STATES, _SAFE[0])))
    shown = sorted(set(np.unique(state).tolist()) | {0, 1, 2})
    handles = [Patch(facecolor=colors[i], edgecolor=GREY, label=names[i]) for i in shown]
    axis.legend(handles=handles, loc=place, fontsize=8)


def draw_region(axis: "Axes", region: Region, by_duration: bool = False) -> None:
    """Draw a region of overturned blocks between its borders."""
    x, edges = np.asarray(region.frequency_ratio), (region.lower, region.upper)
    if by_duration:
        x, edges = 2 * np.pi / x, tuple(1 / edge for edge in edges)
    color = BLUE if region.impacts == 0 else RED
    axis.fill_between(x, *edges, facecolor=color, edgecolor="none", linewidth=0)
    for edge in edges:
        axis.plot(x, edge, color="black", linewidth=0.5)


@figure(1)
def borders(
    result: OverturningMap,
    axis: "Axes | None" = None,
    *,
    by_strength: bool = False,
    scale: float = 1.0,
    progress: bool | None = None,
    **line: Any,
) -> "Axes":
    """Draw the borders of an overturning map alone, so that several maps can share an axis.

    Borders in the ranges that `overturning_borders` reports as crowded are not all drawn; the log then reports that.

    **Arguments:**

    - `result`: as in `overturning`.
    - `axis`: matplotlib axis; None makes a figure.
    - `by_strength`: whether to draw the uplift strength, one over the intensity, upward in place of the intensity.
    - `scale`: factor on the quantity drawn upward.
    - `progress`: as in `overturning`.
    - `line`: colour, style, width and label, as matplotlib names them.

    **Returns:** the axis.

    **Raises:** ValueError for a map with further axes.
    """
    import matplotlib.pyplot as plt

    without_more(result)
    if axis is None:
        _, axis = plt.subplots(figsize=(6, 4), layout="constrained")
    label = line.pop("label", None)
    ends = [edge(np.asarray(result.intensity)) for edge in (np.min, np.max)]
    found = overturning_borders(result, progress=progress)
    if found.crowded.size:
        _LOG.info("borders are left out where islands are too many, or the search failed (`Borders.crowded`)")
    for region in found.regions:
        for edge in (region.lower, region.upper):
            inside = (edge > ends[0] * (1 + 1e-12)) & (edge < ends[1] * (1 - 1e-12))
            if inside.any():  # not the edge of the map
                shown = scale * np.where(inside, 1 / edge if by_strength else edge, np.nan)
                axis.plot(region.frequency_ratio, shown, label=label, **line)
                label = None
    axis.set_xlabel(RATIO)
    axis.set_ylabel((STRENGTH if by_strength else INTENSITY) + ("" if scale == 1 else f" times {scale:g}"))
    return axis


def _is_quick(result: OverturningMap) -> bool:
    if result.scene is None or not has_two_axes(result):
        return False
    *_, model, engine = result.scene
    return isinstance(engine, Series) if engine is not None else model.is_series


def _within(x: np.ndarray, ranges: np.ndarray) -> np.ndarray:
    """Return for each pixel whether it lies in one of the ranges, or reaches into it."""
    half = np.abs(np.gradient(x)) / 2 if x.size > 1 else 0 * x
    return ((x[:, None] + half[:, None] > ranges[:, 0]) & (x[:, None] - half[:, None] < ranges[:, 1])).any(1)


def _beyond(peaks: np.ndarray) -> np.ndarray:
    """Return peaks with NaN replaced by the largest neighbour, so that survivors' colours reach up to the borders."""
    around = np.pad(peaks, 1, constant_values=np.nan)
    n, m = peaks.shape
    moved = [around[i : i + n, j : j + m] for i in range(3) for j in range(3)]
    nearest = np.fmax.reduce(moved)
    return np.where(np.isnan(peaks), nearest, peaks)
