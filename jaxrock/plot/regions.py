"""Figures of motions that rocks allow."""

from typing import TYPE_CHECKING

import numpy as np

from jaxrock.inverse.estimate import Estimate
from jaxrock.inverse.feasible import FeasibleRegion, Unexceeded
from jaxrock.motions.pulses import UNITS
from jaxrock.plot.style import GREY, RED, broken_curve, draw_cells, figure, in_order, limits_of, log_ticks

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@figure(1)
def feasible_region(
    region: FeasibleRegion, estimate: Estimate | None = None, wall: Unexceeded | None = None, axis: "Axes | None" = None
) -> "Axes":
    """Draw a feasible region: the log-likelihood below its best, the 95 % region, the estimate, the unexceeded motion.

    **Arguments:**

    - `region`: a `FeasibleRegion`, with its first parameter upward. An axis is logarithmic if its values are positive.
    - `estimate`: an `Estimate`, drawn as a cross; None leaves it out.
    - `wall`: an `Unexceeded`, for a region over an amplitude and a duration or period. Its curve has gaps where not
      all amplitudes were decided; None leaves it out.
    - `axis`: matplotlib axis; None makes a figure.

    **Returns:** the axis.

    **Raises:** ValueError for a `wall` over other parameters.
    """
    import matplotlib.pyplot as plt

    curve = None if wall is None else _along(wall, region.names)
    if axis is None:
        _, axis = plt.subplots(figsize=(6, 4.5), layout="constrained")
    (rows, up), (columns, across) = map(in_order, region.values)
    below = np.asarray(region.log_likelihood - region.log_likelihood.max())[np.ix_(up, across)]
    shade = draw_cells(axis, columns, rows, np.maximum(below, -20), cmap="Blues")
    axis.figure.colorbar(shade, ax=axis, label="log-likelihood, less that of the best", extend="min")
    if min(below.shape) > 1 and below.min() < np.log(0.05):  # otherwise the region has no border in the map
        axis.contour(columns, rows, below, levels=[np.log(0.05)], colors="black", linewidths=1, linestyles="solid")
        axis.plot([], [], color="black", linewidth=1, label="95 % region")
    if curve is not None:
        broken_curve(axis, *curve, color=RED, linewidth=1, label="up to here all that stand, stand")
    ends = limits_of(columns), limits_of(rows)
    if estimate is not None and set(region.names) <= set(estimate.names):
        place = [float(estimate[name]) for name in region.names[::-1]]
        inside = all(low <= x <= high for x, (low, high) in zip(place, ends))
        axis.plot(*place, "k+", markersize=9, clip_on=not inside, label="most likely" if inside else None)
    for values, scale in ((rows, axis.set_yscale), (columns, axis.set_xscale)):
        if values.min() > 0:
            scale("log")
    log_ticks(axis)
    axis.set(xlim=ends[0], ylim=ends[1], ylabel=_label(region.names[0]), xlabel=_label(region.names[1]))
    if axis.get_legend_handles_labels()[0]:
        axis.legend(fontsize=8, framealpha=0.8)
    return axis


def _label(name: str) -> str:
    return f"{name} [{UNITS[name]}]" if name in UNITS else name


def _along(wall: Unexceeded, names: tuple[str, str]) -> tuple[np.ndarray, np.ndarray]:
    """Return the curve of a wall over the second parameter and the first; NaN where not all was decided."""
    known = np.where(np.asarray(wall.complete), np.asarray(wall.amplitude), np.nan)
    curve = {"amplitude": known} | dict.fromkeys(("duration", "period"), np.asarray(wall.durations))
    if "amplitude" not in names or not set(names) <= set(curve):
        raise ValueError(
            f"Argument `wall` must be None for a region over {names[0]} and {names[1]}: it is an amplitude over a "
            "duration or a period."
        )
    return curve[names[1]], np.where(np.isfinite(known), curve[names[0]], np.nan)


@figure(1)
def search(estimate: Estimate, region: FeasibleRegion | None = None, axis: "Axes | None" = None) -> "Axes":
    """Draw the paths of the search of an estimate: a line from each start to a dot at its end.

    **Arguments:**

    - `estimate`: result of `estimate_motion`.
    - `region`: a `FeasibleRegion` to draw behind the paths, over its parameters; None: the first two of the estimate.
    - `axis`: matplotlib axis; None makes a figure.

    **Returns:** the axis.
    """
    import matplotlib.pyplot as plt

    if axis is None:
        _, axis = plt.subplots(figsize=(6, 4.5), layout="constrained")
    names = estimate.names[:2] if region is None else region.names
    if len(names) < 2 or not set(names) <= set(estimate.names):
        raise ValueError(f"Argument `estimate` must have two parameters to draw, but has {', '.join(estimate.names)}.")
    if region is not None:
        feasible_region(region, estimate, axis=axis)
    else:
        axis.set(ylabel=_label(names[0]), xlabel=_label(names[1]))
    rows, columns = (np.asarray(estimate.trace.values)[..., estimate.names.index(name)] for name in names)
    told: dict[str, str | None] = {"way": "from a start", "end": "to where it ended"}
    for row, column in zip(rows.T, columns.T):
        here = np.flatnonzero(~np.isnan(row))
        if here.size:
            axis.plot(column[here], row[here], color=GREY, linewidth=0.7, label=told.pop("way", None))
            axis.plot(column[here[-1]], row[here[-1]], ".", color=RED, markersize=4, label=told.pop("end", None))
    if axis.get_legend_handles_labels()[0]:
        axis.legend(fontsize=8, framealpha=0.8)
    return axis
