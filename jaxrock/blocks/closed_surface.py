"""A closed surface of triangles: seams welded, faces turned outward, and one body within. Known numbers, in NumPy.

SciPy is imported only when a surface is examined.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxrock.blocks.solid import volumes_of

_NEAR = 1e-7  # share of the extent within which vertices beside an opening are the same but for rounding
_FLAT = 1e-12  # share of the cube of the extent below which a volume is rounding
_MANY = 50  # closed surfaces that are examined for cavities; scans leave thousands of crumbs
_ROOM = 2**20  # pairs of points and faces whose angles are computed at once


class ClosedSurface(NamedTuple):
    """A surface around one body, which may have cavities.

    - `vertices`: (n, 3) those that faces use; `faces`: (m, 3) numbers of their vertices, turned out of the body.
    - `turned`: number of faces that were turned the other way.
    """

    vertices: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "m 3"]
    turned: int

    @classmethod
    def of(cls, vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]) -> "ClosedSurface":
        """Weld the seams of a surface, and turn its faces outward.

        **Raises:** ValueError for a surface that is not closed, that has no inside, or that holds several bodies.
        """
        faces = _welded(vertices, faces)
        used, faces = np.unique(faces, return_inverse=True)
        vertices, given = vertices[used], faces.reshape(-1, 3)
        _check_closed(given)
        part, turned = _alike(given)
        faces = np.where(turned[:, None], given[:, ::-1], given)
        volumes = np.bincount(part, volumes_of(vertices, faces))
        extent = np.ptp(vertices, axis=0).max()
        if not abs(volumes).max() > _FLAT * extent**3:
            raise ValueError("Argument `mesh` must enclose a volume, but is flat.")
        outer = int(abs(volumes).argmax())
        _check_one_body(vertices, faces, part, volumes, outer)
        if volumes[outer] < 0:
            faces, turned = faces[:, ::-1], ~turned
        return cls(vertices, faces, int(turned.sum()))


class _Edges(NamedTuple):
    """Edges of triangles. The sides of faces that share an edge follow each other in the order of `side`."""

    ends: Int[np.ndarray, "e 2"]  # the vertices of every edge, the lower number first
    faces: Int[np.ndarray, " e"]  # number of faces at every edge
    side: Int[np.ndarray, " sides"]  # side k of face f is k * m + f

    @classmethod
    def of(cls, faces: Int[np.ndarray, "m 3"]) -> "_Edges":
        ends = np.sort(_sides(faces), axis=1)
        side = np.lexsort(ends.T[::-1])
        ends = ends[side]
        first = np.flatnonzero(np.append(True, (ends[1:] != ends[:-1]).any(axis=1)))
        return cls(ends[first], np.diff(np.append(first, len(ends))), side)


def _sides(faces: Int[np.ndarray, "m 3"]) -> Int[np.ndarray, "sides 2"]:
    """Return start and end of the sides of all faces."""
    return np.concatenate([faces[:, [k, (k + 1) % 3]] for k in range(3)])


def _welded(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]) -> Int[np.ndarray, "k 3"]:
    """Join vertices of one place beside openings, which files with textures or without numbers of vertices hold twice.

    Vertices of closed parts stay, so bodies that touch each other are not joined.
    """
    for tolerance in (0.0, _NEAR * np.ptp(vertices[np.unique(faces)], axis=0).max()):
        edges = _Edges.of(faces)
        beside = np.unique(edges.ends[edges.faces == 1])
        if not len(beside):
            break
        number = np.arange(len(vertices))
        number[beside] = beside[_places(vertices[beside], tolerance)]
        faces = number[faces]
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]  # a face without area has no other side
    return faces


def _places(points: Float[np.ndarray, "n 3"], tolerance: float) -> Int[np.ndarray, " n"]:
    """Return the first of the points at the place of every point."""
    if tolerance == 0.0:
        _, first, place = np.unique(points + 0.0, axis=0, return_index=True, return_inverse=True)  # -0.0 is 0.0
        return first[place.reshape(-1)]
    from scipy.spatial import cKDTree

    place = _components(cKDTree(points).query_pairs(tolerance, output_type="ndarray"), len(points))
    return np.unique(place, return_index=True)[1][place]


def _components(pairs: Int[np.ndarray, "k 2"], count: int) -> Int[np.ndarray, " n"]:
    """Return the number of the component of every node of a graph."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(pairs), bool), tuple(pairs.T)), shape=(count, count))
    return connected_components(graph, directed=False)[1]


def _check_closed(faces: Int[np.ndarray, "m 3"]) -> None:
    """Raise ValueError unless every edge belongs to two faces."""
    count = _Edges.of(faces).faces if len(faces) else np.zeros(0, int)
    if not len(count) or (count == 1).any():
        said = f"{(count == 1).sum()} of its {len(count)} edges belong to one face only"
        raise ValueError(f"Argument `mesh` must be closed, but {said}: repair it first.")
    if (count > 2).any():
        said = f"{(count > 2).sum()} of its {len(count)} edges belong to more than two faces"
        raise ValueError(
            f"Argument `mesh` must have two faces at every edge, but {said} (bodies that touch, walls within, or "
            "faces that are there twice): repair it first."
        )


def _alike(faces: Int[np.ndarray, "m 3"]) -> tuple[Int[np.ndarray, " m"], Bool[np.ndarray, " m"]]:
    """Return the closed surface that every face is part of, and the faces to turn so that each surface is consistent.

    Every face is there twice, as given and turned; faces across an edge belong together where they run along it in
    opposite directions. The fewest faces are turned.
    """
    count, start = len(faces), _sides(faces)[:, 0]
    one, other = _Edges.of(faces).side.reshape(-1, 2).T
    opposed = start[one] != start[other]
    one, other = one % count, other % count
    across = np.where(opposed, other, other + count), np.where(opposed, other + count, other)
    pairs = np.concatenate([np.stack([one, across[0]], 1), np.stack([one + count, across[1]], 1)])
    given, turned = _components(pairs, 2 * count).reshape(2, count)
    if (given == turned).any():
        raise ValueError("Argument `mesh` must have an inside and an outside, but is one-sided: repair it first.")
    part = np.unique(np.minimum(given, turned), return_inverse=True)[1].reshape(-1)
    turn = given > turned
    most = np.bincount(part, turn) > np.bincount(part) / 2
    return part, turn ^ most[part]


def _check_one_body(
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "m 3"],
    part: Int[np.ndarray, " m"],
    volumes: Float[np.ndarray, " k"],
    outer: int,
) -> None:
    """Raise ValueError unless all surfaces but the outer one are its cavities, turned the other way."""
    surfaces = len(volumes)
    if surfaces > _MANY:
        raise ValueError(_several(surfaces, volumes))
    triangles = [vertices[faces[part == k]] for k in range(surfaces)]
    around = np.array([[_is_around(other, each) for other in triangles] for each in triangles])
    bodies = np.flatnonzero(around.sum(axis=1) % 2 == 0)  # a stone that lies in a cavity is a body again
    if len(bodies) > 1:
        raise ValueError(_several(len(bodies), volumes[bodies]))
    cavities = np.arange(surfaces) != outer
    if (volumes[cavities] * volumes[outer] > 0).any():
        raise ValueError(
            "Argument `mesh` must be turned inward around its cavities, but a surface that lies within the body is "
            "turned outward. Turn it if it is a cavity; remove it if not."
        )


def _several(count: int, volumes: Float[np.ndarray, " k"]) -> str:
    sizes = np.sort(abs(volumes))[::-1]
    return (
        f"Argument `mesh` must be one body, but holds {count}; the second has {sizes[1] / sizes[0]:.2g} of the volume "
        "of the first. Take one: `mesh = trimesh.load(path, force='mesh')`, then `mesh.merge_vertices(merge_tex=True, "
        "merge_norm=True)`, then `max(mesh.split(), key=lambda part: part.volume)`, or another of `mesh.split()`."
    )


def _is_around(triangles: Float[np.ndarray, "m 3 3"], others: Float[np.ndarray, "n 3 3"]) -> bool:
    """Return whether a closed surface goes round the outermost points of another: by its solid angle, 4 pi or 0."""
    points, own = others.reshape(-1, 3), triangles.reshape(-1, 3)
    if (points.min(axis=0) <= own.min(axis=0)).any() or (points.max(axis=0) >= own.max(axis=0)).any():
        return False  # as a surface is not around itself
    for point in points[np.concatenate([points.argmin(axis=0), points.argmax(axis=0)])]:
        angle = 0.0
        for begin in range(0, len(triangles), _ROOM):
            a, b, c = np.moveaxis(triangles[begin : begin + _ROOM] - point, 1, 0)
            length_a, length_b, length_c = (np.linalg.norm(each, axis=1) for each in (a, b, c))
            above = np.einsum("ij,ij->i", a, np.cross(b, c))
            below = length_a * length_b * length_c + sum(
                np.einsum("ij,ij->i", one, other) * length
                for one, other, length in ((a, b, length_c), (b, c, length_a), (c, a, length_b))
            )
            angle += 2 * np.arctan2(above, below).sum()
        if abs(angle) < 2 * np.pi:
            return False
    return True
