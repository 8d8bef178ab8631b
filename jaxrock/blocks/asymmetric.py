"""Asymmetric blocks: two corners, each with its own slenderness, frequency parameter and restitution."""

from typing import Annotated, Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool

from jaxrock._arguments.annotations import arguments, pair, word_of
from jaxrock._arguments.parameters import Owner, parameter, set_parameters
from jaxrock._arguments.ranges import Range, acute, checked, rate, ratio, size, strength, with_throw
from jaxrock._arguments.repr import described
from jaxrock._core.arrays import Values, check_shapes
from jaxrock._core.one_program import one_program
from jaxrock._core.types import Real
from jaxrock.blocks.outline import Outline
from jaxrock.blocks.restitution import AbstractRestitution, AngularMomentum, Corners, PerSide, law_of, ratio_of_inertia
from jaxrock.blocks.rigid import GRAVITY, LENGTHS, Side
from jaxrock.blocks.rock import section_of
from jaxrock.numerics.elementary import sine_cosine

Ratios = tuple[ArrayLike, ArrayLike] | AbstractRestitution | None

_LARGEST = "be at most p1/sqrt(2 sqrt(inertia_ratio (1 - inertia_ratio))), the largest about any corner"
_gyration = Range("be 0 or more and finite, and at most 1e9", 0.0, np.inf, lambda x: (x >= 0) & (x <= 1e9))


def _law(restitution: Ratios) -> AbstractRestitution:
    """Return the law for the argument `restitution` of an asymmetric block."""
    if isinstance(restitution, (tuple, list)):
        return PerSide(*pair("restitution", restitution))
    return law_of(restitution, AngularMomentum())


def _as_seen(corner1: Values, corner2: Values, centre: Values) -> tuple[tuple[Real, Real], tuple[Real, Real]]:
    """Return slenderness angles, and distances of the centre of mass from the corners."""
    places = {"corner1": corner1, "corner2": corner2, "centre": centre}
    right, left, middle = (strength(name, place) for name, place in places.items())
    for name, place in zip(places, (right, left, middle)):
        if place.shape != (2,):
            raise ValueError(f"Argument `{name}` must have shape (2,), but has {place.shape}.")
    width1 = size("corner1[0] - centre[0]", right[0] - middle[0])
    width2 = size("centre[0] - corner2[0]", middle[0] - left[0])
    height1 = size("centre[1] - corner1[1]", middle[1] - right[1])
    height2 = size("centre[1] - corner2[1]", middle[1] - left[1])
    alphas = jnp.arctan2(width1, height1), jnp.arctan2(width2, height2)
    return alphas, (jnp.hypot(width1, height1), jnp.hypot(width2, height2))


class AsymmetricBlock(Owner):
    """A free-standing rigid block whose two sides differ: a rock, a statue, a loaded cabinet.

    Side 1 is that of positive rotations, on which the block stands on corner 1, the right one. Side 2 is that of
    negative rotations. Positive ground acceleration drives negative rotation, as everywhere.

    **Arguments:**

    - `alpha1`, `alpha2`: slenderness angles, between the vertical at rest and the line from each corner to the centre
      of mass [rad], in (0, pi/2).
    - `p1`: frequency parameter about corner 1, sqrt(m g R1/I1) [rad/s], positive.
    - `inertia_ratio`: m R1^2/I1, with I1 the moment of inertia about corner 1 [-], in (0, 1]; 3/4 for a rectangle.
    - `radius_ratio`: R2/R1, distances from the corners to the centre of mass [-], positive. None: that of a flat base,
      cos(alpha1)/cos(alpha2), which follows the angles under differentiation.
    - `restitution`: pair of the restitutions of an impact that ends the stay on side 1, and on side 2; or a law of
      restitution for both. None: by angular momentum about the new corner, zero at least.

    All may be arrays of one shape, for use under `jax.vmap`.

    **Raises:** ValueError for a value outside its range; where the product of given restitutions exceeds 1. The product
    is the part of its speed that a block keeps over two impacts. (One may exceed 1: about corners of unequal height it
    often does.)

    **Source:** Housner (1963) for each side; `jaxrock.restitution.AngularMomentum` for the impact.
    """

    alpha1: Real = parameter("rad", acute)
    alpha2: Real = parameter("rad", acute)
    p1: Real = parameter("rad/s", rate)
    inertia_ratio: Real = parameter("-", ratio_of_inertia)
    given_radius_ratio: Real | None = parameter("-", ratio, follows="radius_ratio", argument="radius_ratio")
    law: AbstractRestitution

    __repr__ = described

    @with_throw
    def __init__(
        self,
        alpha1: ArrayLike,
        alpha2: ArrayLike,
        p1: ArrayLike,
        inertia_ratio: ArrayLike = 0.75,
        radius_ratio: ArrayLike | None = None,
        restitution: Ratios = None,
        *,
        throw: bool = True,
    ):
        self.given_radius_ratio = None
        given = {} if radius_ratio is None else {"given_radius_ratio": radius_ratio}
        set_parameters(self, alpha1=alpha1, alpha2=alpha2, p1=p1, inertia_ratio=inertia_ratio, **given)
        self.law = _law(restitution)

    @classmethod
    @with_throw
    def from_radii(
        cls,
        alpha1: ArrayLike,
        alpha2: ArrayLike,
        R1: ArrayLike,
        R2: ArrayLike,
        gyration_radius: ArrayLike,
        restitution: Ratios = None,
        gravity: ArrayLike = GRAVITY,
        *,
        throw: bool = True,
    ) -> "AsymmetricBlock":
        """Build a block from the distances of its corners to the centre of mass, and its inertia.

        **Arguments:**

        - `alpha1`, `alpha2`, `restitution`: as in `AsymmetricBlock`.
        - `R1`, `R2`: distances from the corners to the centre of mass [m], positive.
        - `gyration_radius`: sqrt(I/m), I the moment of inertia about the centre of mass [m], 0 or more.
        - `gravity`: acceleration of gravity [m/s^2], positive.

        **Returns:** an `AsymmetricBlock`.

        **Raises:** ValueError for a value outside its range.
        """
        first, second, gravity = size("R1", R1), size("R2", R2), size("gravity", gravity)
        gyration = _gyration("gyration_radius", gyration_radius)
        check_shapes(R1=first, R2=second, gyration_radius=gyration, gravity=gravity)
        return cls(alpha1, alpha2, *_of_radii(first, second, gyration, gravity), restitution)

    @classmethod
    @with_throw
    def from_frequencies(
        cls,
        alpha1: ArrayLike,
        alpha2: ArrayLike,
        p1: ArrayLike,
        p2: ArrayLike,
        inertia_ratio: ArrayLike = 0.75,
        restitution: Ratios = None,
        *,
        throw: bool = True,
    ) -> "AsymmetricBlock":
        """Build a block from the frequency parameters about both corners.

        **Arguments:**

        - `alpha1`, `alpha2`, `p1`, `inertia_ratio`, `restitution`: as in `AsymmetricBlock`; the inertia ratio at
          least 1/2, so that the farther corner has the smaller frequency parameter.
        - `p2`: frequency parameter about corner 2 [rad/s], positive.

        **Returns:** an `AsymmetricBlock` with R2/R1 from (p2/p1)^2 = R2/R1/(kappa1 [(R2/R1)^2 + 1/kappa1 - 1]).

        **Raises:** ValueError for a value outside its range, or a p2 that no distance of the second corner gives.
        """
        kappa = checked("inertia_ratio", inertia_ratio, "be in [1/2, 1]", lambda x: (x >= 0.5) & (x <= 1))
        p1, p2 = rate("p1", p1), rate("p2", p2)
        check_shapes(p1=p1, p2=p2, inertia_ratio=kappa)
        same, is_possible, radii = _of_rates(p1, p2, kappa)
        checked("p2", same, _LARGEST, lambda _: is_possible)
        return cls(alpha1, alpha2, p1, kappa, radii, restitution)

    @classmethod
    @with_throw
    def from_corners(
        cls,
        corner1: Values,
        corner2: Values,
        centre: Values,
        gyration_radius: ArrayLike,
        restitution: Ratios = None,
        gravity: ArrayLike = GRAVITY,
        *,
        throw: bool = True,
    ) -> "AsymmetricBlock":
        """Build a block from the places of its corners and of its centre of mass, at rest.

        **Arguments:**

        - `corner1`, `corner2`, `centre`: (2,) horizontal and vertical place of the right corner, the left corner and
          the centre of mass [m]; the centre above both corners, and between them.
        - `gyration_radius`, `restitution`, `gravity`: as in `from_radii`.

        **Returns:** an `AsymmetricBlock`.

        **Raises:** ValueError where the block would not stand.
        """
        alphas, radii = _as_seen(corner1, corner2, centre)
        return cls.from_radii(*alphas, *radii, gyration_radius, restitution, gravity)

    @classmethod
    @with_throw
    @arguments
    def from_outline(
        cls,
        outline: Values,
        *,
        supports: Annotated[tuple[int, int] | None, pair] = None,
        centre: Values | None = None,
        gyration_radius: ArrayLike | None = None,
        restitution: Ratios = None,
        gravity: ArrayLike = GRAVITY,
        throw: bool = True,
    ) -> "AsymmetricBlock":
        """Build a homogeneous block from the polygon of its outline, in the plane of rocking.

        **Arguments:**

        - `outline`: (n, 2) vertices in order, horizontal and vertical [m], n at least 3; no two edges cross.
        - `supports`: positions in `outline` of the right and the left corner on which it stands; None takes the
          outermost of the lowest vertices (a flat base).
        - `centre`: (2,) centre of mass [m]; None: that of the area.
        - `gyration_radius`: sqrt(I/m) about the centre of mass [m]; None: that of the area.
        - `restitution`, `gravity`: as in `from_radii`.

        **Returns:** an `AsymmetricBlock`; about corners of unequal height where `supports` say so.

        **Raises:** ValueError for an outline that crosses itself or has no area, and where the block would not stand.
        Also where another vertex reaches the ground before the block is in balance on a corner: such a block rolls onto
        that face, and does not rock about the corner.
        """
        shape = Outline.of(outline)
        right, left, middle, gyration = shape.standing(supports, centre, gyration_radius)
        block = cls.from_corners(right, left, middle, gyration, restitution, gravity)
        for corner, side, alpha in ((right, 1, block.alpha1), (left, -1, block.alpha2)):
            shape.check_rolling(corner, side, float(alpha))
        return block

    @classmethod
    @arguments
    @with_throw
    def from_mesh(
        cls,
        mesh: Any,
        azimuth: ArrayLike,
        *,
        base: Annotated[str, word_of("narrow", "wide")] = "narrow",
        plane: Annotated[str, word_of("projection", "cut")] = "projection",
        unit: Annotated[str | None, word_of(*LENGTHS)] = None,
        tolerance: ArrayLike | None = None,
        restitution: Ratios = None,
        gravity: ArrayLike = GRAVITY,
        throw: bool = True,
    ) -> "AsymmetricBlock":
        """Build the block of a rock in the vertical plane of an azimuth, from the mesh of its surface.

        **Arguments:**

        - `mesh`: a `Rock`, or a mesh for `Rock.from_mesh`; `unit`, `tolerance`: as there, of a mesh only.
        - `azimuth`: from the first axis towards the second [rad]; its direction is to the right (corner 1).
        - `base`, `plane`: as in `Rock.section`. It warns of a rounded base, for which "narrow" and "wide" differ.
        - `restitution`, `gravity`: as in `from_radii`.

        **Returns:** an `AsymmetricBlock`: rocking in the plane alone, without twisting, rolling sideways, or sliding.

        **Raises:** as `Rock.from_mesh`, and ValueError for arguments outside their ranges.
        """
        return cls.from_corners(*section_of(mesh, azimuth, base, plane, unit, tolerance)[:4], restitution, gravity)

    @property
    def radius_ratio(self) -> Real:
        """R2/R1: given, or that of a flat base."""
        flat = sine_cosine(self.alpha1)[1] / sine_cosine(self.alpha2)[1]
        return flat if self.given_radius_ratio is None else self.given_radius_ratio

    @property
    def inertia_ratio2(self) -> Real:
        """m R2^2/I2."""
        return _second_inertia(self)

    @property
    def p2(self) -> Real:
        """Frequency parameter about corner 2 [rad/s]."""
        return _second_rate(self)

    @property
    @one_program
    def restitution1(self) -> Real:
        """Angular velocity after an impact that ends the stay on side 1 over that before it."""
        return self.law.ratio(self.corners[0], jnp.zeros_like(self.p1))

    @property
    @one_program
    def restitution2(self) -> Real:
        """Angular velocity after an impact that ends the stay on side 2 over that before it."""
        return self.law.ratio(self.corners[1], jnp.zeros_like(self.p1))

    @property
    def corners(self) -> tuple[Corners, Corners]:
        """The arguments of the law of restitution for impacts that end a stay on side 1, and on side 2."""
        return (
            Corners(self.alpha1, self.alpha2, self.p1, self.inertia_ratio2, 1 / self.radius_ratio, 1),
            Corners(self.alpha2, self.alpha1, self.p2, self.inertia_ratio, self.radius_ratio, -1),
        )

    @property
    def sides(self) -> tuple[Side, Side]:
        """The parameters of side 1 and of side 2 for a model."""
        return Side(self.alpha1, self.p1, self.restitution1), Side(self.alpha2, self.p2, self.restitution2)

    @property
    def mirrored(self) -> "AsymmetricBlock":
        """The block seen from behind, its sides exchanged."""
        radii = None if self.given_radius_ratio is None else 1 / self.given_radius_ratio
        return AsymmetricBlock(self.alpha2, self.alpha1, self.p2, self.inertia_ratio2, radii, self.law.mirrored)


@one_program
def _of_radii(first: Real, second: Real, gyration: Real, gravity: Real) -> tuple[Real, Real, Real]:
    """Return the frequency parameter and the inertia ratio of side 1, and R2/R1."""
    kappa = first**2 / (first**2 + gyration**2)
    return jnp.sqrt(gravity * kappa / first), kappa, second / first


@one_program
def _of_rates(p1: Real, p2: Real, kappa: Real) -> tuple[Real, Bool[Array, "..."], Real]:
    """Return p2 of every block, whether such a block exists, and R2/R1."""
    square = (p2 / p1) ** 2
    inner = 1 - 4 * square**2 * kappa * (1 - kappa)
    return jnp.broadcast_to(p2, inner.shape), inner >= 0, (1 + jnp.sqrt(inner)) / (2 * square * kappa)


@one_program
def _second_rate(block: AsymmetricBlock) -> Real:
    return block.p1 * jnp.sqrt(block.inertia_ratio2 / (block.inertia_ratio * block.radius_ratio))


@one_program
def _second_inertia(block: AsymmetricBlock) -> Real:
    square = block.radius_ratio**2
    return square / (square + 1 / block.inertia_ratio - 1)
