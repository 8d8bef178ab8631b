"""The outline of a block as a polygon: its area, centre of mass, inertia, and the corners on which it stands."""

from typing import NamedTuple

import numpy as np

from jaxrock._arguments.ranges import strength, whole
from jaxrock._core.arrays import Values
from jaxrock._core.one_program import check_known


class Outline(NamedTuple):
    """A polygon of even thickness and density; lengths in m. For known numbers only: not for use under jit."""

    vertices: np.ndarray  # (n, 2), counterclockwise
    order: np.ndarray  # (n,) position of each vertex in the outline as given
    area: float
    centre: np.ndarray  # (2,)
    gyration_radius: float  # sqrt(I/m) about the centre

    @classmethod
    def of(cls, outline: Values) -> "Outline":
        """Integrate over the polygon, as sums over the triangles from its first vertex to each edge.

        **Raises:** ValueError where it has fewer than three vertices, no area, or crosses or touches itself.
        """
        check_known(outline=outline)
        given = np.asarray(strength("outline", outline), float)
        if given.ndim != 2 or given.shape[1] != 2 or len(given) < 3:
            raise ValueError(f"Argument `outline` must have shape (n, 2) with n at least 3, but has {given.shape}.")
        order = np.arange(len(given))
        a = given - given[0]
        b = np.roll(a, -1, axis=0)
        twice = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
        if twice.sum() < 0:
            return cls.of(given[::-1])._replace(order=order[::-1])
        area = twice.sum() / 2
        if not area > 1e-12 * np.ptp(a, axis=0).max() ** 2:
            reason = "its vertices lie on a line, or it crosses itself"
            raise ValueError(f"Argument `outline` must enclose an area, but {reason}.")
        _check_simple(given)
        centre = ((a + b) * twice[:, None]).sum(0) / (6 * area)
        a, b = a - centre, b - centre
        twice = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
        second = (((a * a) + (a * b) + (b * b)).sum(1) * twice).sum() / 12
        return cls(given, order, area, centre + given[0], float(np.sqrt(second / area)))

    def at(self, position: int) -> np.ndarray:
        """Return the vertex at a position in the outline as given."""
        position = whole("supports", position, -len(self.order), len(self.order) - 1)
        return self.vertices[np.flatnonzero(self.order == position % len(self.order))[0]]

    def standing(self, supports, centre, gyration_radius) -> tuple:
        """Return the right and left corner, centre of mass and radius of gyration: given, or the outline's own."""
        right, left = self.flat_base() if supports is None else (self.at(position) for position in supports)
        centre = self.centre if centre is None else centre
        return right, left, centre, self.gyration_radius if gyration_radius is None else gyration_radius

    def flat_base(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the right and left corner: the outermost of the lowest vertices."""
        height = self.vertices[:, 1]
        lowest = self.vertices[height <= height.min() + 1e-9 * np.ptp(height)]
        right, left = lowest[lowest[:, 0].argmax()], lowest[lowest[:, 0].argmin()]
        if right[0] == left[0]:
            raise ValueError("Argument `outline` must have a flat base, or `supports` must tell where it stands.")
        return right, left

    def check_rolling(self, corner: np.ndarray, side: int, alpha: float) -> None:
        """Raise ValueError where another vertex comes down to the level of a corner within alpha."""
        reach = (self.vertices - corner) * np.array([side, 1.0])
        beyond = reach[reach[:, 0] > 1e-9 * np.ptp(self.vertices[:, 0])]
        contact = np.arctan2(beyond[:, 1], beyond[:, 0]).min(initial=np.pi / 2)
        if contact < alpha:
            raise ValueError(
                f"Argument `outline` must let the block rock about its corners up to its balance at {alpha:.4g} rad, "
                f"but on side {1 if side > 0 else 2} another vertex reaches the ground at {contact:.4g} rad: it rolls "
                "onto that face. A rounded base: `from_corners`, with the model `jaxrock.models.Rolling`."
            )


def _check_simple(vertices: np.ndarray) -> None:
    """Raise ValueError where two edges that are not neighbours cross or touch."""
    number = np.flatnonzero((vertices != np.roll(vertices, -1, axis=0)).any(axis=1))  # edges of positive length
    start = vertices[number]
    end, n = np.roll(start, -1, axis=0), len(start)

    def turn(a, b, c):
        return np.sign(
            (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])
        )

    i, j = np.triu_indices(n, 2)
    keep = ~((i == 0) & (j == n - 1))
    i, j = i[keep], j[keep]
    apart = turn(start[i], end[i], start[j]) * turn(start[i], end[i], end[j])
    across = turn(start[j], end[j], start[i]) * turn(start[j], end[j], end[i])
    low, high = np.minimum(start, end), np.maximum(start, end)
    near = ((low[i] <= high[j]) & (low[j] <= high[i])).all(axis=1)  # decides for collinear edges
    meeting = near & (apart <= 0) & (across <= 0)
    if meeting.any():
        first, second = (number[each[meeting]][0] for each in (i, j))
        raise ValueError(f"Argument `outline` must not cross or touch itself, but edges {first} and {second} do.")
