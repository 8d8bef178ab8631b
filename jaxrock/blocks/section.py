"""A rock seen along the ground: the points about which it rocks, and its centre of mass. Known numbers, in NumPy."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxrock.blocks.slab import Slab


class Section(NamedTuple):
    """A rock seen along the ground, at right angles to an azimuth; lengths in m, the centre of mass at width 0.

    - `right`, `left`: (2,) width and height of the points about which it rocks; `centre`: (2,).
    - `gyration_radius`: sqrt(I/m) about the horizontal axis through the centre of mass.
    - `rolls`: (2,) whether the base is so round on a side that the rock rolls on before it is in balance.
    """

    right: Float[np.ndarray, "2"]
    left: Float[np.ndarray, "2"]
    centre: Float[np.ndarray, "2"]
    gyration_radius: float
    rolls: tuple[bool, bool]

    @property
    def slenderness(self) -> tuple[float, float]:
        """Angles of the centre of mass over the right and the left point [rad]."""
        right, left = self.right - self.centre, self.left - self.centre
        return float(np.arctan2(abs(right[0]), -right[1])), float(np.arctan2(abs(left[0]), -left[1]))


def section_of_slab(slab: Slab, tolerance: float) -> tuple[Section, Float[np.ndarray, "n 2"]]:
    """Return the section of a slab that stands on its points within a tolerance of the lowest, and its outline's
    points.
    """
    points = slab.points - [slab.centre[0], 0.0]
    ground = points[points[:, 1] <= points[:, 1].min() + tolerance]
    right, left = ground[ground[:, 0].argmax()], ground[ground[:, 0].argmin()]
    if not left[0] < 0 < right[0]:
        raise ValueError(
            "Argument `plane` must be 'projection' for a rock whose cut does not stand: its centre is not above the "
            f"ground within {tolerance:.3g} m of the lowest point of the cut."
        )
    centre = np.array([0.0, slab.centre[1]])
    return Section(right, left, centre, slab.gyration_radius, (False, False)), points
