"""Volume, centre and inertia of a body of even density within a closed surface. Known numbers, in NumPy."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int


class Solid(NamedTuple):
    """A body of even density.

    - `volume`; `centre`: (3,) of mass; `inertia`: (3, 3) about it, over the mass.
    """

    volume: float
    centre: Float[np.ndarray, "3"]
    inertia: Float[np.ndarray, "3 3"]

    @classmethod
    def within(cls, vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]) -> "Solid":
        """Integrate within a closed surface, whose faces are turned outward: sums over tetrahedra from one point.

        That point is a vertex for the centre, and the centre for the inertia. Tetrahedra from a far origin cancel: from
        100 km, p of a rock is 3.6 % off.
        """
        origin = vertices[faces[0, 0]]
        volumes, ends = volumes_of(vertices, faces), (vertices - origin)[faces].sum(axis=1)
        volume = volumes.sum()
        centre = volumes @ ends / (4 * volume)
        arms = vertices - origin - centre
        corners = arms[faces]
        volumes = _tetrahedra(corners)
        moments = sum(np.einsum("i,ij,ik->jk", volumes, each, each, optimize=True)
                      for each in (*np.moveaxis(corners, 1, 0), corners.sum(axis=1)))  # fmt: skip
        second = moments / (20 * volume)
        return cls(float(volume), centre + origin, np.trace(second) * np.eye(3) - second)


def volumes_of(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]) -> Float[np.ndarray, " m"]:
    """Return the volumes of the tetrahedra from one vertex to every face, negative where it is turned towards it."""
    return _tetrahedra((vertices - vertices[faces[0, 0]])[faces])


def _tetrahedra(corners: Float[np.ndarray, "m 3 3"]) -> Float[np.ndarray, " m"]:
    first, second, third = np.moveaxis(corners, 1, 0)
    return np.einsum("ij,ij->i", first, np.cross(second, third)) / 6
