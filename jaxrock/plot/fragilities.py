"""Figures of simulated fragilities, by one and by two measures."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from jaxrock.hazard.fragility import LogNormalFragility
from jaxrock.hazard.simulation import SimulatedFragility
from jaxrock.hazard.surfaces import SimulatedSurface, SurfaceFragility
from jaxrock.plot.style import BLUE, RED, SAND, draw_cells, figure, limits_of, log_ticks
from jaxrock.studies.suite_scenes import topples

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@figure(1)
def fragility(
    simulated: SimulatedFragility, fit: LogNormalFragility | None = None, axis: "Axes | None" = None
) -> "Axes":
    """Draw the share of blocks that topple against the level of shaking, with its bounds.

    **Arguments:**

    - `simulated`: result of `simulated_fragility`.
    - `fit`: a lognormal fragility to draw over it, such as `simulated.fit().fragility`.
    - `axis`: matplotlib axis; None makes a figure.

    **Returns:** the axis.
    """
    import matplotlib.pyplot as plt

    if axis is None:
        _, axis = plt.subplots(figsize=(5.5, 3.6), layout="constrained")
    levels = np.asarray(simulated.levels)
    axis.plot(levels, simulated.lower, "o-", color=BLUE, markersize=3, linewidth=0.8, label="simulated")
    if simulated.undecided:
        axis.fill_between(
            levels, simulated.lower, simulated.upper, color=SAND, alpha=0.6, linewidth=0, label="undecided"
        )
    if fit is not None:
        dense = np.geomspace(levels[0], levels[-1], 300)
        label = f"lognormal: {float(fit.median):.3g}, {float(fit.dispersion):.2g}"
        axis.plot(dense, fit(dense), color=RED, linewidth=1.2, label=label)
    unit = f" [{simulated.unit}]" if simulated.unit else ""
    axis.set(xscale="log", xlabel=simulated.measure + unit, ylabel="probability to topple", ylim=(-0.02, 1.02))
    axis.legend(loc="upper left", fontsize=8, frameon=False)
    return log_ticks(axis)


@figure(1)
def fragility_surface(
    simulated: SimulatedSurface,
    fit: SurfaceFragility | None = None,
    axis: "Axes | None" = None,
    *,
    contours: Sequence[float] = (0.05, 0.5, 0.95),
) -> "Axes":
    """Draw the share of blocks that topple over PGV/PGA and peak acceleration, with contours.

    **Arguments:**

    - `simulated`: result of `simulated_surface`. Undecided scenes count by their share.
    - `fit`: a `SurfaceFragility` whose contours are drawn over the shares, dashed.
    - `axis`: matplotlib axis; None makes a figure. `contours`: probabilities.

    **Returns:** the axis.
    """
    import matplotlib.pyplot as plt

    if axis is None:
        _, axis = plt.subplots(figsize=(5.5, 4), layout="constrained")
    ratio, acceleration = np.asarray(simulated.ratio), np.asarray(simulated.acceleration)
    share = topples(simulated.verdict, "share", simulated.share).mean(axis=(0, 3))
    picture = draw_cells(axis, ratio, acceleration, np.asarray(share), cmap="YlOrBr", vmin=0, vmax=1)
    axis.figure.colorbar(picture, ax=axis, label="probability to topple")
    if min(share.shape) > 1:  # a line of cells has no contours
        lines = axis.contour(ratio, acceleration, share, levels=contours, colors="black", linewidths=1)
        axis.clabel(lines, fmt=lambda p: f"{100 * p:g} %", fontsize=7)
    if fit is not None:
        for probability in contours:
            axis.plot(ratio, fit.acceleration(probability, ratio), "--", color=BLUE, linewidth=1)
    axis.set(xlabel="PGV/PGA [s]", ylabel="PGA [g]", ylim=limits_of(acceleration))
    return axis
