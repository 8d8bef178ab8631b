"""Colours that all figures share, curves with gaps, and ticks of logarithmic axes."""

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BLUE, RED, GREY, SAND = "#1f5a8a", "#b3352c", "#8a8a8a", "#d9a441"


def log_ticks(axis: "Axes") -> "Axes":
    """Label the logarithmic axes of a figure at 1, 2, 5, 10, ..., in plain numbers, and nowhere else.

    **Arguments:**

    - `axis`: matplotlib axis; what is not logarithmic in it is left alone.

    **Returns:** the axis.
    """
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    for scale, ticks in ((axis.get_xscale(), axis.xaxis), (axis.get_yscale(), axis.yaxis)):
        if scale == "log":
            ticks.set_major_locator(LogLocator(subs=(1, 2, 5)))
            ticks.set_major_formatter(StrMethodFormatter("{x:g}"))
            ticks.set_minor_formatter(NullFormatter())
    return axis


def broken_curve(axis, abscissa, values, **line):
    """Draw a curve that has gaps, such as a spectrum where blocks overturn: what stands alone in a gap is a dot.

    **Arguments:**

    - `axis`: matplotlib axis.
    - `abscissa`, `values`: (n,) each; values that are not finite are gaps.
    - `line`: colour, style, width and label, as matplotlib names them.

    **Returns:** the line.
    """
    abscissa, values = np.asarray(abscissa), np.asarray(values, float)
    values = np.where(np.isfinite(values), values, np.nan)
    (drawn,) = axis.plot(abscissa, values, **line)
    there = np.pad(np.isfinite(values), 1)
    alone = there[1:-1] & ~there[:-2] & ~there[2:]  # survivors between overturned blocks, of which no line is drawn
    axis.plot(abscissa[alone], values[alone], ".", color=drawn.get_color(), markersize=4)
    return drawn


def cell_edges(places: np.ndarray) -> np.ndarray:
    """Where the cells about places that rise, or fall, begin and end: half way between them; one alone is as wide as a
    tenth of what it is. Cells of positive places are positive, for logarithmic axes."""
    if places.size == 1:
        return places[0] + np.array([-1, 1]) * (0.05 * abs(places[0]) or 0.5)
    inner = (places[1:] + places[:-1]) / 2
    ends = 2 * places[[0, -1]] - inner[[0, -1]]
    ends = np.where((places[[0, -1]] > 0) & (ends <= 0), places[[0, -1]] / 2, ends)
    return np.concatenate([ends[:1], inner, ends[1:]])


def shade(axis: "Axes", places: np.ndarray, which: np.ndarray, **patch) -> None:
    """Shade the cells about some of the places, from the lower to the upper end of an axis.

    **Arguments:**

    - `axis`: matplotlib axis.
    - `places`: (n,) rising or falling; `which`: (n,) whether each is shaded.
    - `patch`: colour and label, as matplotlib names them.
    """
    edges, label = cell_edges(places), patch.pop("label", None)
    ends = np.flatnonzero(np.diff(np.concatenate([[0], which.astype(int), [0]])))
    for begin, end in ends.reshape(-1, 2):
        axis.axvspan(edges[begin], edges[end], label=label, **patch)
        label = None
