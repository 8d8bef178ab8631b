"""Colours and labels that figures share, cells of maps, curves with gaps, and ticks of logarithmic axes."""

import functools
import inspect
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np

from jaxrock._arguments.annotations import arguments
from jaxrock._core.arrays import shown

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BLUE, RED, GREY, SAND = "#1f5a8a", "#b3352c", "#8a8a8a", "#d9a441"
DURATION, RATIO = "pulse duration $p\\,t_d$", r"frequency ratio $\omega/p$"  # labels that identify horizontal axes
STRENGTH, INTENSITY = "uplift strength", "intensity"  # beginnings of labels that identify vertical axes

Drawing = TypeVar("Drawing", bound=Callable)


def figure(count: int) -> Callable[[Drawing], Drawing]:
    """Decorate a function that draws into `axis`, or into `count` `axes`, to check its arguments.

    **Raises:** ValueError, when the function is called, for an invalid argument.
    """

    def decorate(function: Drawing) -> Drawing:
        checked, signature = arguments(function), inspect.signature(function)

        @functools.wraps(function)
        def drawing(*args: Any, **kwargs: Any) -> Any:
            given = signature.bind(*args, **kwargs).arguments
            if given.get("axis") is not None and not _is_axis(given["axis"]):
                raise ValueError(f"Argument `axis` must be an axis of matplotlib, but is {shown(given['axis'])}.")
            if given.get("axes") is not None:
                _check_axes(given["axes"], count)
            return checked(*args, **kwargs)

        return cast(Drawing, drawing)

    return decorate


def _is_axis(axis: Any) -> bool:
    return hasattr(axis, "plot") and hasattr(axis, "figure")


def _check_axes(axes: Any, count: int) -> None:
    if not isinstance(axes, (Sequence, np.ndarray)) or len(axes) != count or not all(map(_is_axis, axes)):
        given = type(axes).__name__ + (f" of {len(axes)}" if hasattr(axes, "__len__") else "")
        raise ValueError(f"Argument `axes` must be {count} axes of matplotlib, but is {given}.")


def log_ticks(axis: "Axes") -> "Axes":
    """Label the logarithmic axes of a figure at 1, 2, 5, 10, ..., in plain numbers, and nowhere else.

    Axes of more than three decades are labelled at 1, 10, ... alone.

    **Arguments:**

    - `axis`: matplotlib axis; its linear axes are left unchanged.

    **Returns:** the axis.
    """
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    class Locator(LogLocator):
        def tick_values(self, vmin: float, vmax: float) -> Any:
            self.set_params(subs=(1,) if vmin > 0 and vmax / vmin > 1e3 else (1, 2, 5))
            return super().tick_values(vmin, vmax)

    for scale, ticks in ((axis.get_xscale(), axis.xaxis), (axis.get_yscale(), axis.yaxis)):
        if scale == "log":
            ticks.set_major_locator(Locator())
            ticks.set_major_formatter(StrMethodFormatter("{x:g}"))
            ticks.set_minor_formatter(NullFormatter())
    return axis


def broken_curve(axis, abscissa, values, **line):
    """Draw a curve that has gaps, such as a spectrum where blocks overturn; a single point between gaps is a dot.

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
    alone = there[1:-1] & ~there[:-2] & ~there[2:]  # survivors between overturned blocks, which a line does not show
    axis.plot(abscissa[alone], values[alone], ".", color=drawn.get_color(), markersize=4)
    return drawn


def cell_edges(places: np.ndarray) -> np.ndarray:
    """Return the edges of the cells about places that rise, or fall: halfway between the places.

    The cell of a single place is a tenth of its value wide. Cells of positive places are positive, for logarithmic
    axes.
    """
    if places.size == 1:
        return places[0] + np.array([-1, 1]) * (0.05 * abs(places[0]) or 0.5)
    inner = (places[1:] + places[:-1]) / 2
    ends = 2 * places[[0, -1]] - inner[[0, -1]]
    ends = np.where((places[[0, -1]] > 0) & (ends <= 0), places[[0, -1]] / 2, ends)
    return np.concatenate([ends[:1], inner, ends[1:]])


def in_order(places) -> tuple[np.ndarray, np.ndarray]:
    """Return the sorted unique places, and their original indices; of two equal places neither would have a cell."""
    return np.unique(np.asarray(places), return_index=True)


def draw_cells(axis: "Axes", across: np.ndarray, up: np.ndarray, values: np.ndarray, **style):
    """Draw values (up, across) as cells about places that rise, or fall; a single place has a cell, too."""
    return axis.pcolormesh(cell_edges(across), cell_edges(up), values, rasterized=True, **style)


def limits_of(places: np.ndarray) -> tuple[float, float]:
    """Return the limits of an axis over places that rise: the first and the last, or the cell of a single place."""
    ends = cell_edges(places) if places.size == 1 else places
    return float(ends[0]), float(ends[-1])


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


def without_more(result: Any) -> None:
    """Raise ValueError for a spectrum or a map with further axes."""
    if result.parameters:
        names = ", ".join(f"`{name}`" for name in result.parameters)
        raise ValueError(f"Argument `result` must have no further axes, but has {names}: draw one of its parts.")
