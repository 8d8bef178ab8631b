"""Vibrations of a clamped column of lumped masses."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxrock._core.settings import kept_by_precision


class UnitColumn(NamedTuple):
    """Vibrations of a cantilever of unit length, mass and bending stiffness, clamped at its base.

    A mode's shape has unit modal mass. Displacements of column and modes: u = shapes @ q.
    """

    frequencies: Float[np.ndarray, " modes"]
    shapes: Float[np.ndarray, "nodes modes"]
    rotation: Float[np.ndarray, " modes"]  # y' M shape: the modes of a unit rotation about the base
    translation: Float[np.ndarray, " modes"]  # 1' M shape
    tip: Float[np.ndarray, " modes"]  # the shapes at the top
    chords: Float[np.ndarray, "elements modes"]  # rotations of the elements
    carried: Float[np.ndarray, " elements"]  # moment of the weight above each element, per rotation of the element
    sway: Float[np.ndarray, "elements elements"]  # mass matrix in the rotations of the elements
    buckling: float  # critical own weight of a clamped column, over bending stiffness/length^2


@kept_by_precision
def unit_column(masses: int) -> UnitColumn:
    """Return the unit column of `masses` lumped masses (its base included) and `masses` - 1 beam elements.

    Each element gives half its mass to either end: the base moment of gravity is exact, and the moment of inertia is 1
    + 1/(2 (masses - 1)^2) times the block's. Low modes come from the flexibility matrix, high ones from the stiffness
    matrix, because rounding drowns the others in each.
    """
    elements = masses - 1
    mass = np.full(elements, 1 / elements)
    mass[-1] /= 2
    height = np.arange(1, elements + 1) / elements
    root = np.sqrt(mass)
    low, high = np.minimum.outer(height, height), np.maximum.outer(height, height)
    compliance, soft = np.linalg.eigh(low**2 * (3 * high - low) / 6 * np.outer(root, root))
    stiffness, stiff = np.linalg.eigh(_stiffness(elements) / np.outer(root, root))
    compliance, soft = compliance[::-1], soft[:, ::-1]
    from_soft = stiffness**2 < stiffness[0] * stiffness[-1] * (1 + 1e-9)
    squares = np.where(from_soft, 1 / compliance, stiffness)
    vectors = np.where(from_soft, soft, stiff)
    shapes = vectors / root[:, None]
    shapes = shapes * np.sign(shapes[-1])
    chords = elements * np.diff(shapes, axis=0, prepend=0.0)
    above = mass[::-1].cumsum()[::-1]
    sway = np.minimum.outer(above, above) / elements**2
    weight = (chords.T * above / elements) @ chords / np.sqrt(np.outer(squares, squares))
    return UnitColumn(
        np.sqrt(squares), shapes, (height * mass) @ shapes, mass @ shapes, shapes[-1], chords, above / elements, sway,
        float(1 / np.linalg.eigvalsh(weight)[-1]),
    )  # fmt: skip


def _stiffness(elements: int) -> Float[np.ndarray, "nodes nodes"]:
    """Return the lateral stiffness of a unit cantilever of Euler-Bernoulli elements, whose nodes rotate freely."""
    n = elements
    matrix = np.zeros((2 * n + 2, 2 * n + 2))
    element = n * np.array(
        [[12 * n**2, 6 * n, -12 * n**2, 6 * n], [6 * n, 4, -6 * n, 2], [-12 * n**2, -6 * n, 12 * n**2, -6 * n],
         [6 * n, 2, -6 * n, 4]]
    )  # fmt: skip
    for i in range(n):
        matrix[2 * i : 2 * i + 4, 2 * i : 2 * i + 4] += element
    free = matrix[2:, 2:]  # the base is clamped
    return free[::2, ::2] - free[::2, 1::2] @ np.linalg.solve(free[1::2, 1::2], free[1::2, ::2])
