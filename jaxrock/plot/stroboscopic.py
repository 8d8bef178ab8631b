"""Figures of motions that repeat: bifurcation diagrams and basins of attraction."""

from typing import TYPE_CHECKING

import numpy as np

from jaxrock.plot.style import GREY, RED, draw_cells, figure, in_order, limits_of, shade
from jaxrock.status import Status
from jaxrock.studies.attractors import Basins
from jaxrock.studies.period_doubling import Bifurcation

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_ORBITS = ("#1f5a8a", "#d9a441", "#5f8f4e", "#7b4f8f", "#3f9a9a", "#a8743c")  # colours of basins, then again
_MOST = 6  # orbits with an entry in the legend


@figure(1)
def bifurcation_diagram(result: Bifurcation, axis: "Axes | None" = None, *, velocity: bool = False) -> "Axes":
    """Draw a bifurcation diagram: a dot for each state once a period; values at which the block overturned are shaded.

    A value that was not computed (see `status`) has no dots, and a cross on the axis.

    **Arguments:**

    - `result`: from `studies.bifurcation`.
    - `axis`: matplotlib axis; None makes a figure.
    - `velocity`: whether to draw angular velocities in place of rotations.

    **Returns:** the axis.
    """
    import matplotlib.pyplot as plt

    if axis is None:
        _, axis = plt.subplots(figsize=(7, 4.5), layout="constrained")
    values, order = in_order(result.parameter)
    states = np.asarray(result.velocity if velocity else result.rotation)[order]
    there = np.isfinite(states)
    across = np.broadcast_to(values[:, None], states.shape)
    axis.plot(across[there], states[there], "k.", markersize=1, rasterized=True)
    overturned = np.asarray(result.overturned)[order]
    if overturned.any():
        shade(axis, values, overturned, color=RED, alpha=0.25, linewidth=0, label="overturned")
        axis.legend(loc="best")
    unknown = values[np.asarray(result.status != Status.successful)[order]]
    axis.plot(unknown, np.zeros_like(unknown), "kx", transform=axis.get_xaxis_transform(), clip_on=False)
    axis.set_xlabel("parameter")
    axis.set_ylabel("angular velocity once a period [rad/s]" if velocity else "rotation once a period [rad]")
    return axis


@figure(1)
def basins_of_attraction(result: Basins, axis: "Axes | None" = None) -> "Axes":
    """Draw basins of attraction over the state at the start: a colour for each orbit, whose states are dots.

    Grey starts have not settled, red ones have overturned, black ones were not computed (see `status`).

    **Arguments:**

    - `result`: from `studies.basins`.
    - `axis`: matplotlib axis; None makes a figure.

    **Returns:** the axis.
    """
    import matplotlib.pyplot as plt
    from matplotlib.colors import BoundaryNorm, ListedColormap
    from matplotlib.patches import Patch

    if axis is None:
        _, axis = plt.subplots(figsize=(7, 5), layout="constrained")
    (x, columns), (y, rows) = in_order(result.rotation), in_order(result.velocity)
    number = np.asarray(result.attractor)[np.ix_(rows, columns)]
    count = len(result.orbits)
    orbits = [_ORBITS[k % len(_ORBITS)] for k in range(count)]
    colors = ["black", "#e3b5ae", GREY, *orbits]
    norm = BoundaryNorm(np.arange(-2.5, count + 1), len(colors))
    draw_cells(axis, x, y, number, cmap=ListedColormap(colors), norm=norm)
    names = {-2: "not computed", -1: "overturned", 0: "not settled"}
    names |= {k + 1: _said(orbit.shape[0]) for k, orbit in enumerate(result.orbits[:_MOST])}
    for orbit in result.orbits:
        rotation, velocity = np.asarray(orbit).T
        axis.plot(rotation, velocity, "o", color="white", markeredgecolor="black", markersize=4)
    there = [k for k in names if (number == k).any()]
    axis.legend(handles=[Patch(color=colors[k + 2], label=names[k]) for k in there], loc="upper right")
    axis.set_xlim(*limits_of(x))
    axis.set_ylim(*limits_of(y))
    axis.set_xlabel("rotation at the start [rad]")
    axis.set_ylabel("angular velocity at the start [rad/s]")
    return axis


def _said(periods: int) -> str:
    return "orbit of one period" if periods == 1 else f"orbit of {periods} periods"
