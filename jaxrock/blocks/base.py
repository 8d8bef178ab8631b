"""The base of a rock in a plane: the points at which its outline touches the ground as it opens to the right.

Outlines are known points (n, 2), in no order: width outward from the centre of mass, and height. The corner is the
outermost point on the ground; the centre of mass is given by its height.
"""

import warnings

import numpy as np

from jaxrock._core.precision import frames_of_the_package
from jaxrock.blocks.edge import Edge, fitted_edge

_SMOOTH = 0.2  # share of the longest arm of the weight by which a smooth edge may differ from the faces of a mesh


def arms_of(points: np.ndarray, corner: np.ndarray, height: float, opening: np.ndarray) -> np.ndarray:
    """Return the horizontal distance from the centre of mass to the lowest point beyond a corner, at opening angles."""
    beyond = np.concatenate([[corner], points[points[:, 0] > corner[0]]]) - [0.0, height]
    found = []
    for sine, cosine in zip(np.sin(opening), np.cos(opening)):  # one by one: a scan has millions of vertices
        lowest = beyond[(beyond @ [-sine, cosine]).argmin()]
        found.append(lowest @ [cosine, sine])
    return np.array(found)


def rolled(points: np.ndarray, corner: np.ndarray, height: float) -> np.ndarray:
    """Return the vertex that supports the rock in balance, after it rolled to the right from vertex to vertex of its
    hull.
    """
    for _ in range(len(points)):
        beyond = points[points[:, 0] > corner[0] + 1e-9 * np.ptp(points[:, 0])]
        slopes = np.arctan2(beyond[:, 1] - corner[1], beyond[:, 0] - corner[0])
        if slopes.size == 0 or slopes.min() >= np.arctan2(corner[0], height - corner[1]):
            break
        corner = beyond[slopes.argmin()]
    return corner


def rounded_edge(points: np.ndarray, corner: np.ndarray, height: float, knots: int) -> Edge:
    """Fit the rounded edge to the right of a corner."""
    radius, alpha = (
        np.hypot(corner[0], height - corner[1]),
        np.arctan2(corner[0], height - corner[1]),
    )
    contact, opening = _touching(points, corner)
    arms = contact[:, 0] * np.cos(opening) + (contact[:, 1] - height) * np.sin(opening)
    last = int(np.argmax(arms <= 0)) + 1 if (arms <= 0).any() else arms.size
    opening, arms = opening[:last], arms[:last]
    found = fitted_edge(opening, arms / radius - np.sin(alpha - opening), knots)
    angles = np.linspace(0.0, opening[-1], 200)
    own = arms_of(points, corner, height, angles)
    off = np.abs(radius * (np.sin(alpha - angles) + np.asarray(found.run(angles))) - own).max()
    if off > _SMOOTH * own.max():
        warnings.warn(
            f"The base is made of faces: on a smooth edge the arm of the weight is up to {off:.3g} m off, of "
            f"{own.max():.3g} m. See also what bounds it, by `base` of `AsymmetricBlock.from_mesh`.",
            stacklevel=frames_of_the_package() + 1,
        )
    return found


def _touching(points: np.ndarray, corner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices that touch the ground in turn beyond a corner, and an opening angle for each.

    The angle is midway between those of the faces on either side, except 0 for the corner.
    """
    chain, angles = [corner], [0.0]
    while angles[-1] < np.pi / 2:
        beyond = points[points[:, 0] > chain[-1][0] + 1e-9 * np.ptp(points[:, 0])]
        if not len(beyond):
            break
        slopes = np.arctan2(beyond[:, 1] - chain[-1][1], beyond[:, 0] - chain[-1][0])
        chain.append(beyond[slopes.argmin()])
        angles.append(slopes.min())
    turns = np.append(angles[1:], np.pi / 2)  # opening angles of the faces after each vertex
    midway = (np.array(angles) + turns) / 2
    midway[0] = 0.0
    return np.array(chain), midway
