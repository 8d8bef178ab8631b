"""A rock from the mesh of its surface: volume, mass, the ground it stands on, and its plane section in any direction.

For known numbers only, in NumPy.
"""

import warnings
from typing import Annotated, Any, NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float, Int

from jaxrock._arguments.annotations import arguments, at_least, word_of
from jaxrock._arguments.ranges import direction, finite, positive, scalar
from jaxrock._core.arrays import Values
from jaxrock._core.precision import frames_of_the_package
from jaxrock.blocks.base import arms_of, rolled, rounded_edge
from jaxrock.blocks.closed_surface import ClosedSurface
from jaxrock.blocks.edge import Edge
from jaxrock.blocks.mesh import metres_of, triangles_of, trimesh_of
from jaxrock.blocks.rigid import LENGTHS
from jaxrock.blocks.section import Section, section_of_slab
from jaxrock.blocks.slab import Slab
from jaxrock.blocks.solid import Solid

_PLANES = ("projection", "cut")
_SHARE = 0.01  # share of the height within which vertices stand on the ground


class Rock(NamedTuple):
    """A rock of even density; the third axis points up, lengths in m. `Rock.from_mesh(...)` makes one.

    - `volume` [m^3]; `centre`: (3,) of mass; `inertia`: (3, 3) about it, over the mass [m^2].
    - `vertices`: (n, 3); `base`: (k, 3) those within `tolerance` of the lowest, on which it stands.
    - `faces`: (m, 3) numbers of the vertices of its triangles, turned outward; None: it cannot be cut.
    """

    volume: float
    centre: Float[np.ndarray, "3"]
    inertia: Float[np.ndarray, "3 3"]
    vertices: Float[np.ndarray, "n 3"]
    base: Float[np.ndarray, "k 3"]
    tolerance: float
    faces: Int[np.ndarray, "m 3"] | None = None

    @classmethod
    @arguments
    def from_mesh(
        cls, mesh: Any, *, unit: Annotated[str | None, word_of(*LENGTHS)] = None, tolerance: ArrayLike | None = None
    ) -> "Rock":
        """Build a rock from a closed surface.

        **Arguments:**

        - `mesh`: a `trimesh.Trimesh`, or the path of a file that trimesh reads (STL, PLY, OBJ, ...); its third axis
          points up, and it stands as it does in the field. Needs `pip install "jaxrock[mesh]"`. Seams are welded.
          Closed surfaces within the rock that are turned inward are cavities.
        - `unit`: of its coordinates: "m", "cm" or "mm". None: the unit that the mesh states, else "m".
        - `tolerance`: vertices up to this height above the lowest stand on the ground [m], positive; None: a hundredth
          of the height. Choose the error of the mesh: a smaller tolerance may leave a rock on a needle.

        **Returns:** a `Rock`. A warning says that faces were turned outward.

        **Raises:** ValueError for a surface that is not closed, for several bodies, or for a unit that the mesh
        contradicts; for a base that is no area, or a centre of mass that is not above it. OSError if the file cannot be
        opened; ImportError without trimesh.
        """
        mesh = trimesh_of(mesh)
        factor = metres_of(mesh, unit)
        vertices, faces = _turned_outward(*triangles_of(mesh))
        vertices = factor * vertices
        solid = Solid.within(vertices, faces)
        height = np.ptp(vertices[:, 2])
        tolerance = (
            _SHARE * height if tolerance is None else float(scalar("tolerance", positive("tolerance", tolerance)))
        )
        base = vertices[vertices[:, 2] <= vertices[:, 2].min() + tolerance]
        rock = cls(*solid, vertices, base, tolerance, faces)
        for azimuth in np.linspace(0, np.pi, 180, endpoint=False):
            section = rock._between(azimuth)
            if not section.left[0] < 0 < section.right[0]:
                within = f"of {len(base)} vertices within {tolerance:.3g} m of the lowest"
                raise ValueError(
                    f"Argument `mesh` must stand, but its centre of mass is not above its base ({within}) at azimuth "
                    f"{azimuth:.3g} rad."
                )
        return rock

    @arguments
    def section(
        self,
        azimuth: ArrayLike,
        base: Annotated[str, word_of("narrow", "wide")] = "narrow",
        plane: Annotated[str, word_of(*_PLANES)] = "projection",
    ) -> Section:
        """Return the section of the rock that rocks in the plane of an azimuth.

        **Arguments:**

        - `azimuth`: from the first axis towards the second [rad]; its direction is to the right.
        - `base`: of a rounded base. "narrow": the rock rocks about the outermost points on the ground, and vertices
          beyond are ignored. "wide": about the points to which it has rolled when it is in balance. The righting moment
          of a rock that stands on its base and then rolls lies between those of the two at every rotation. So the two
          bound its resistance. They do not bound its overturning, because toppling is not ordered: that one topples and
          it does not is still possible. For a flat base both are the same.
        - `plane`: "projection": of all vertices to the plane, with the rock's own mass and inertia, for rocking about
          an axis across it. "cut": the slab of even thickness that the plane through the centre of mass cuts out, with
          the slab's own centre, inertia and ground, as from a photograph or an outline.

        **Returns:** a `Section`.

        **Raises:** ValueError for an azimuth beyond a full turn; for a cut whose centre is not above its ground.
        """
        narrow, points = self._seen(azimuth, plane)
        last = [rolled(points * [side, 1], corner * [side, 1], narrow.centre[1]) * [side, 1]
                for side, corner in ((1, narrow.right), (-1, narrow.left))]  # fmt: skip
        right, left = (not np.allclose(end, corner) for end, corner in zip(last, (narrow.right, narrow.left)))
        found = narrow._replace(rolls=(right, left))
        return found._replace(right=last[0], left=last[1]) if base == "wide" else found

    @arguments
    def arms(
        self, azimuth: ArrayLike, opening: Values, plane: Annotated[str, word_of(*_PLANES)] = "projection"
    ) -> Float[np.ndarray, "2 openings"]:
        """Return the distance from the centre of mass out to the point of contact, for a rock opened on its base by an
        angle.

        **Arguments:**

        - `azimuth`, `plane`: as in `section`.
        - `opening`: (openings,) opening angles [rad].

        **Returns:** (2, openings) distances along the ground to the right and to the left [m]: the arm of the weight,
        which rights the rock where it is positive.

        **Raises:** ValueError for arguments that are not finite, or of another shape.
        """
        angles = np.asarray(finite("opening", opening), float)
        if angles.ndim != 1:
            raise ValueError(f"Argument `opening` must be a list, but has shape {angles.shape}.")
        narrow, points = self._seen(azimuth, plane)
        sides = (1.0, narrow.right), (-1.0, narrow.left)
        return np.stack([arms_of(points * [way, 1], end * [way, 1], narrow.centre[1], angles) for way, end in sides])

    @arguments
    def edges(
        self,
        azimuth: ArrayLike,
        knots: Annotated[int, at_least(2, 64)] = 8,
        plane: Annotated[str, word_of(*_PLANES)] = "projection",
    ) -> tuple[Edge, Edge]:
        """Fit the rounded edges on which the rock rolls to the right and to the left, for `jaxrock.models.Rolling`.

        **Arguments:**

        - `azimuth`, `plane`: as in `section`.
        - `knots`: number of opening angles, from 0 to its balance, at which the radius of curvature is given.

        **Returns:** a pair of `Edge` whose points of contact are nearest to the vertices, by least squares. Each vertex
        is taken to touch the ground midway between the faces next to it. A side that does not roll gets a sharp edge.

        A warning says where the arm of the weight differs from that of the mesh (`arms`) by more than a fifth of the
        longest: such a base is made of faces, on which a rock does not roll smoothly.

        **Raises:** ValueError for arguments outside their ranges.
        """
        section, points = self.section(azimuth, plane=plane), self._seen(azimuth, plane)[1]

        def edge(way, corner, rolls):
            return rounded_edge(points * [way, 1], corner * [way, 1], section.centre[1], knots) if rolls else Edge(0.0)

        right, left = section.rolls
        return edge(1.0, section.right, right), edge(-1.0, section.left, left)

    @arguments
    def slenderness(self, azimuth: Values) -> Float[np.ndarray, "azimuths"]:
        """Return the angle of the centre of mass over the point on which it rocks towards each azimuth [rad],
        (azimuths,).
        """
        azimuths = np.asarray(direction("azimuth", azimuth), float)
        if azimuths.ndim != 1:
            raise ValueError(f"Argument `azimuth` must be a list, but has shape {azimuths.shape}.")
        return np.array([self._between(each).slenderness[0] for each in azimuths])

    @arguments
    def widths(self, azimuth: ArrayLike) -> Float[np.ndarray, " n"]:
        """Return the distances of all vertices from the centre of mass in the direction of an azimuth [m]."""
        return self._widths(float(scalar("azimuth", direction("azimuth", azimuth))))

    def _widths(self, azimuth: float) -> Float[np.ndarray, " n"]:
        return (self.vertices - self.centre)[:, :2] @ _towards(azimuth)

    def _seen(self, azimuth: ArrayLike, plane: str) -> tuple[Section, Float[np.ndarray, "n 2"]]:
        """Return the section by the points on the ground alone, and all points: width from the centre of mass, and
        height.
        """
        azimuth = float(scalar("azimuth", direction("azimuth", azimuth)))
        points = np.stack([self._widths(azimuth), self.vertices[:, 2]], axis=1)
        if plane == "projection":
            return self._between(azimuth), points
        if self.faces is None:
            raise ValueError("Argument `plane` must be 'projection' for a rock without `faces`.")
        return section_of_slab(Slab.cut(points, self._widths(azimuth + np.pi / 2), self.faces), self.tolerance)

    def _between(self, azimuth: float) -> Section:
        """Return the section by the points on the ground alone."""
        towards = _towards(azimuth)
        places = (self.base[:, :2] - self.centre[:2]) @ towards
        right, left = (np.array([places[k], self.base[k, 2]]) for k in (places.argmax(), places.argmin()))
        axis = np.array([-towards[1], towards[0], 0.0])
        return Section(
            right, left, np.array([0.0, self.centre[2]]), float(np.sqrt(axis @ self.inertia @ axis)), (False, False)
        )


def _turned_outward(
    vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]
) -> tuple[Float[np.ndarray, "k 3"], Int[np.ndarray, "l 3"]]:
    """Return the closed surface that triangles make, and warn if faces are turned."""
    found = ClosedSurface.of(vertices, faces)
    if found.turned:
        warnings.warn(
            f"Argument `mesh` must be turned outward, but {found.turned} of its {len(found.faces)} faces were not: "
            "they are turned.",
            stacklevel=frames_of_the_package() + 1,
        )
    return found.vertices, found.faces


def section_of(
    mesh: Any, azimuth: ArrayLike, base: str, plane: str, unit: str | None, tolerance: ArrayLike | None
) -> Section:
    """Return the section of a rock or a mesh, and warn of a base that rolls."""
    rock = mesh if isinstance(mesh, Rock) else Rock.from_mesh(mesh, unit=unit, tolerance=tolerance)
    found = rock.section(azimuth, base, plane)
    if any(found.rolls):
        ends = [max(rock.section(azimuth, each, plane).slenderness) for each in ("narrow", "wide")]
        warnings.warn(
            f"The base is rounded: the rock rolls on before it is in balance, at {ends[0]:.3g} rad if it rocked about "
            f"the ground it stands on, at {ends[1]:.3g} rad if about where it rolls to. See both, with `base`; or let "
            "it roll, by the model `jaxrock.models.Rolling(*rock.edges(azimuth))`.",
            stacklevel=frames_of_the_package() + 1,
        )
    return found


def _towards(azimuth: float) -> np.ndarray:
    return np.array([np.cos(azimuth), np.sin(azimuth)])
