"""Figures of rocks."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.rock import Rock
from jaxrock.plot.style import BLUE, RED, figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@figure(2)
def slenderness(rock: Rock, axes: "Sequence[Axes] | None" = None, *, points: int = 360) -> "Sequence[Axes]":
    """Draw slenderness and frequency parameter of a rock over azimuth, each in a polar plot.

    **Arguments:**

    - `rock`: a `Rock`.
    - `axes`: two polar axes of matplotlib; None makes a figure.
    - `points`: number of azimuths.

    **Returns:** the axes: of the slenderness towards each azimuth [rad], and of p about the point there [rad/s].
    """
    import matplotlib.pyplot as plt
    from matplotlib.ticker import MaxNLocator

    if axes is None:
        _, axes = plt.subplots(1, 2, figsize=(7.5, 3.8), layout="constrained", subplot_kw={"projection": "polar"})
    azimuth = np.linspace(0, 2 * np.pi, points)
    found = [rock.section(each) for each in azimuth]
    blocks = [AsymmetricBlock.from_corners(x.right, x.left, x.centre, x.gyration_radius) for x in found]
    axes[0].plot(azimuth, [float(block.alpha1) for block in blocks], color=BLUE, label="narrow base")
    if any(any(each.rolls) for each in found):
        wide = [rock.section(each, "wide").slenderness[0] for each in azimuth]
        axes[0].plot(azimuth, wide, "--", color=RED, linewidth=1, label="wide base")
        axes[0].legend(loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=2, fontsize=8, frameon=False)
    axes[1].plot(azimuth, [float(block.p1) for block in blocks], color=BLUE)
    for axis, title in zip(axes, ("slenderness [rad]", "p [rad/s]")):
        axis.set_title(title, fontsize=9)
        axis.yaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
        axis.tick_params(axis="y", labelsize=7)
    return axes


@figure(1)
def righting(rock: Rock, azimuth: float = 0.0, axis=None):
    """Draw the righting arm of a rock that rotates towards an azimuth: the arm of its weight over the opening angle.

    **Arguments:**

    - `rock`: a `Rock`; `azimuth`: as in `Rock.section`, towards the right.
    - `axis`: of matplotlib; None makes a figure.

    **Returns:** the axis. Curves are the arms [m] of the rock itself, as it rests on its vertices in turn, and of the
    smooth edge of `Rock.edges`. Those of the narrow and the wide base bound them.
    """
    import matplotlib.pyplot as plt

    axis = plt.subplots(figsize=(4.6, 3.4), layout="constrained")[1] if axis is None else axis
    narrow, wide = (rock.section(azimuth, base) for base in ("narrow", "wide"))
    opening = np.linspace(0, min(1.05 * max(wide.slenderness[0], narrow.slenderness[0]), np.pi / 2), 200)
    for section, label in ((narrow, "narrow base"), (wide, "wide base")):
        across, up = section.right[0], section.centre[1] - section.right[1]
        style = {"color": "grey", "linestyle": "--" if section is wide else ":", "linewidth": 1}
        axis.plot(opening, across * np.cos(opening) - up * np.sin(opening), label=label, **style)
    axis.plot(opening, rock.arms(azimuth, opening)[0], color=BLUE, label="the rock, rolling")
    radius, start = np.hypot(narrow.right[0], narrow.centre[1] - narrow.right[1]), narrow.slenderness[0]
    smooth = np.sin(start - opening) + np.asarray(rock.edges(azimuth)[0].run(opening))
    axis.plot(opening, radius * smooth, color=RED, linewidth=1, label="smooth edge")
    axis.axhline(0, color="black", linewidth=0.5)
    axis.set(xlabel="opening angle [rad]", ylabel="arm of the weight [m]", xlim=(0, opening[-1]))
    axis.legend(frameon=False, fontsize=8)
    return axis
