"""A slab of even thickness, cut out of a closed surface by a vertical plane. Known numbers only, in NumPy."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int


class Slab(NamedTuple):
    """The cut of a plane through a body; lengths in m.

    - `points`: (n, 2) of its outline, in no order; `area` [m^2]; `centre`: (2,) of the area.
    - `gyration_radius`: sqrt(I/m) about the axis through its centre, across.
    """

    points: Float[np.ndarray, "n 2"]
    area: float
    centre: Float[np.ndarray, "2"]
    gyration_radius: float

    @classmethod
    def cut(
        cls,
        points: Float[np.ndarray, "n 2"],
        distance: Float[np.ndarray, " n"],
        faces: Int[np.ndarray, "m 3"],
    ) -> "Slab":
        """Cut a closed surface of triangles by a plane.

        **Arguments:**

        - `points`: vertices in coordinates of the plane; `distance`: their distances beyond it.
        - `faces`: triangles by the numbers of their vertices, all turned outward.

        **Returns:** a `Slab`; of several parts, or with holes, where the surface is so. A vertex on the plane counts as
        beyond it, so the outline is closed in every case.

        **Raises:** ValueError where the plane misses the surface.
        """
        beyond = distance >= 0
        ends = []
        for leaving in (True, False):  # in every cut face, one edge leaves the far side and one enters it
            first, second = (np.concatenate([faces[:, (k + turn) % 3] for k in range(3)]) for turn in (0, 1))
            crosses = (beyond[first] == leaving) & (beyond[second] != leaving)
            face = np.tile(np.arange(len(faces)), 3)[crosses]
            first, second = (x[crosses][np.argsort(face)] for x in (first, second))
            share = distance[first] / (distance[first] - distance[second])
            ends.append(points[first] + share[:, None] * (points[second] - points[first]))
        return cls._around(*ends)

    @classmethod
    def _around(cls, start: Float[np.ndarray, "k 2"], end: Float[np.ndarray, "k 2"]) -> "Slab":
        """Integrate within a closed line by Green's theorem: sums over the triangles from one point to each segment."""
        if not len(start):
            raise ValueError("The plane must cut the surface, but passes it by.")
        middle = start.mean(axis=0)
        a, b = start - middle, end - middle
        twice = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
        twice = twice if twice.sum() > 0 else -twice
        area = twice.sum() / 2
        centre = ((a + b) * twice[:, None]).sum(axis=0) / (6 * area)
        second = (((a * a) + (a * b) + (b * b)).sum(axis=1) * twice).sum() / 12
        gyration = np.sqrt(second / area - centre @ centre)
        return cls(np.concatenate([start, end]), float(area), centre + middle, float(gyration))
