"""Figures of rocks."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.mesh import Rock
from jaxrock.plot.style import BLUE, RED

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def slenderness(rock: Rock, axes: "Sequence[Axes] | None" = None, *, points: int = 360) -> "Sequence[Axes]":
    """Draw slenderness and frequency parameter of a rock over azimuth, each in a polar plot.

    **Arguments:**

    - `rock`: a `Rock`.
    - `axes`: two polar axes of matplotlib; None makes a figure.
    - `points`: azimuths.

    **Returns:** the axes: of the slenderness towards each azimuth [rad], and of p about the point there [rad/s].
    """
    import matplotlib.pyplot as plt

    if axes is None:
        _, axes = plt.subplots(1, 2, figsize=(7.5, 3.8), layout="constrained", subplot_kw={"projection": "polar"})
    azimuth = np.linspace(0, 2 * np.pi, points)
    found = [rock.section(each) for each in azimuth]
    blocks = [AsymmetricBlock.from_corners(x.right, x.left, x.centre, x.gyration_radius) for x in found]
    axes[0].plot(azimuth, [float(block.alpha1) for block in blocks], color=BLUE, label="narrow base")
    if any(any(each.rolls) for each in found):
        wide = [rock.section(each, "wide").slenderness[0] for each in azimuth]
        axes[0].plot(azimuth, wide, "--", color=RED, linewidth=1, label="wide base")
        axes[0].legend(loc="lower left", fontsize=8, frameon=False)
    axes[1].plot(azimuth, [float(block.p1) for block in blocks], color=BLUE)
    for axis, title in zip(axes, ("slenderness [rad]", "p [rad/s]")):
        axis.set_title(title, fontsize=9)
    return axes
