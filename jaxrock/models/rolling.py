"""The block with rounded edges: it rolls on them instead of turning about a corner."""

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool

from jaxrock._arguments.annotations import arguments
from jaxrock._arguments.parameters import parameter, set_parameters
from jaxrock._arguments.repr import described
from jaxrock._core.one_program import one_program
from jaxrock._core.types import Scalar
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.edge import Edge, EdgePieces
from jaxrock.blocks.restitution import ratio_of_inertia
from jaxrock.blocks.rigid import Block, Side
from jaxrock.models.equation import AbstractEquation, AbstractMoments, Angle, Rolled, Summit, first_zero, last_rise
from jaxrock.numerics.elementary import sine_cosine


class Rolling(AbstractEquation):
    """A rigid block that rolls without slipping on rounded edges; the diffrax engine solves it.

    At rest it stands on the ground between two corners, where the rounding begins. The `alpha` and `p` of a block
    belong to these corners, and so does its restitution. The impact comes when the flat part meets the ground; it
    changes the angular velocity as for a block with sharp corners there.

    At an opening angle x, H is the height of the centre of mass over the ground, over R. H' is its horizontal distance
    from the point of contact, and r the radius of curvature there. Then H'' = r - H and

        [1 + k (H^2 + H'^2 - 1)] x'' + k r H' x'^2 = -[(1 + v) H' + s u H],

    k the inertia ratio m R^2/I. On a circle of radius r over a rectangle H = r + (cos(alpha) - r) cos(x) + sin(alpha)
    sin(x). The block uplifts where a block with sharp corners does, and balances later: at
    arctan(sin(alpha)/(cos(alpha) - r)).

    **Arguments:**

    - `edge`: radius over R [-], 0 or more, of the circle that is the edge; or an `Edge`, which may be rounded
      otherwise.
    - `other`: the edge of side 2 of an `AsymmetricBlock`, over R2. None: as `edge`.
    - `inertia_ratio`: of a symmetric `Block`: m R^2/I about a corner [-], in (0, 1]; 3/4 for a rectangle. An
      `AsymmetricBlock` has its own.

    Where the radius is so large that the block does not balance before pi/2, it overturns only by lying flat. A
    facetted base, which loses energy at every facet, is not such an edge.

    **Raises:** ValueError for values outside their ranges; for a symmetric block with an `other` edge.

    **Source:** derived here, as Lagrange's equation of rolling without slipping.
    """

    edge: Edge
    other: Edge | None
    inertia_ratio: Scalar = parameter("-", ratio_of_inertia)

    __repr__ = described

    @arguments
    def __init__(
        self, edge: Edge | ArrayLike, other: Edge | ArrayLike | None = None, *, inertia_ratio: ArrayLike = 0.75
    ):
        set_parameters(self, inertia_ratio=inertia_ratio)
        edge = edge if isinstance(edge, Edge) else Edge(edge)
        other = other if other is None or isinstance(other, Edge) else Edge(other)
        self.edge, self.other = (edge, None) if other is None else _alike(edge, other)

    def moments(self, block: Block | Side) -> "RollingMoments":
        """Return the moments of a symmetric block."""
        if self.other is not None:
            raise ValueError("Argument `other` must be None for a symmetric block, whose edges are alike.")
        if isinstance(block, Block) and block.beam is not None:
            raise ValueError(
                "Argument `block` must be one body in a `Rolling`, but is a frame, whose columns do not roll."
            )
        return RollingMoments.of(block.alpha, self.inertia_ratio, self.edge)

    def moments_of_sides(self, block: AsymmetricBlock) -> tuple["RollingMoments", "RollingMoments"]:
        """Return the moments of both sides of an asymmetric block."""
        first = RollingMoments.of(block.alpha1, block.inertia_ratio, self.edge)
        return first, RollingMoments.of(block.alpha2, block.inertia_ratio2, self.other or self.edge)

    @property
    def forces_follow(self) -> bool:
        """Return True: only weight and ground act on the block."""
        return True

    @property
    def is_series(self) -> bool:
        """Return False: the moment of inertia about the point of contact changes."""
        return False


class RollingMoments(AbstractMoments):
    """The moments that act on a block on one of its rounded edges."""

    slenderness: Angle
    ratio: Scalar
    pieces: EdgePieces
    factor: Scalar  # multiplies all accelerations (see `times`)
    saddle: Scalar
    summit: Summit
    firm: Scalar | None = None  # angle past which the block gets no firmer (`last_rise`); None: a circle

    @classmethod
    def of(cls, alpha: Scalar, ratio: Scalar, edge: Edge) -> "RollingMoments":
        """Compute the moments of a block, or of a side."""
        made = cls(Angle.of(alpha), ratio, edge.pieces(), jnp.ones_like(alpha), alpha, Summit(alpha, alpha))
        firm, saddle = None if edge.angle is None else _firm(made), _balance(made)
        return replace(made, saddle=saddle, firm=firm, summit=_summit(made, saddle))

    def times(self, factor: Scalar | float) -> "RollingMoments":
        """Multiply all accelerations by a factor."""
        return replace(self, factor=factor * self.factor, summit=self.summit.times(factor))

    @property
    def bends(self) -> int:
        """Return the number of angles of a list, at which the moments bend."""
        return 0 if self.pieces.start is None else self.pieces.start.size

    def ahead(self, opening: Scalar, outward: Bool[Array, ""]) -> tuple["RollingMoments", Scalar]:
        """Return the moments of the piece that acts from an opening angle on, and the angle that ends it."""
        piece, angle = self.pieces.ahead(opening, outward)
        return replace(self, pieces=piece), angle

    def rolled(self, angle: Angle) -> Rolled:
        """Return the position of the centre of mass over the point of contact."""
        sine, cosine = self.slenderness.sine, self.slenderness.cosine
        added = self.pieces.at(angle.value)
        return Rolled(
            cosine * angle.cosine + sine * angle.sine + added.rise,
            sine * angle.cosine - cosine * angle.sine + added.run,
            added.radius,
        )

    def _inertia(self, at: Rolled) -> Scalar:
        """Return the moment of inertia about the point of contact, over that at rest."""
        return 1 + self.ratio * (at.height**2 + at.reach**2 - 1)

    def acceleration(self, angle: Angle, velocity: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """Acceleration of the opening angle per (p t)^2; push = side u, weight = 1 + v (None: 1)."""
        at = self.rolled(angle)
        moment = self.factor * ((at.reach if weight is None else weight * at.reach) + push * at.height)
        # The change of inertia as the block rolls is geometric: `factor`, the unit of time, does not multiply it.
        return -(moment + self.ratio * at.radius * at.reach * velocity**2) / self._inertia(at)

    def restoring(self, angle: Angle) -> Scalar:
        """Return the restoring moment over m g R at an opening angle, with the moment of inertia at rest."""
        at = self.rolled(angle)
        return self.factor * at.reach / self._inertia(at)

    def fall(self, angle: Angle) -> Scalar:
        """Return how far the restoring moment changes from an opening angle to the balance."""
        return self.summit.fall(angle, self.restoring(angle))

    @property
    def fall_at_rest(self) -> Scalar:
        """Return `fall` at rest."""
        return self.summit.fall_at_rest(self.restoring_at_rest)

    def arm(self, angle: Angle) -> Scalar:
        """Return the overturning moment over m R u g at an opening angle, with the moment of inertia at rest."""
        at = self.rolled(angle)
        return self.factor * at.height / self._inertia(at)

    def repulsion(self, angle: Angle, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """Return the rate at which nearby angles of a block that stands still diverge, per angle."""
        still = jnp.zeros_like(angle.value)
        return jax.grad(lambda x: self.acceleration(Angle.of(x), still, push, weight))(angle.value)

    def work(self, opening: Scalar) -> Scalar:
        """Return the rise of the centre of mass: the moment of inertia there does not matter."""
        half, (_, sine, cosine) = Angle.of(opening / 2), self.slenderness
        over_a_corner = 2 * half.sine * (sine * half.cosine - cosine * half.sine)  # cos(alpha - x) - cos(alpha)
        return self.factor * (over_a_corner + self.pieces.at(opening).rise)

    @property
    def restoring_at_rest(self) -> Scalar:
        """Return the value for a sharp corner."""
        return self.factor * self.slenderness.sine

    @property
    def arm_at_rest(self) -> Scalar:
        """Return the value for a sharp corner."""
        return self.factor * self.slenderness.cosine

    @property
    def stiffness(self) -> Scalar:
        """Return the rate at which the restoring moment falls at the balance; the factor where no balance lies before
        pi/2."""
        at = self.rolled(Angle(self.saddle, *sine_cosine(self.saddle)))
        falls = at.height - at.radius
        return jnp.where(falls > 0, self.factor * falls / self._inertia(at), self.factor)

    def held_manifold(self, angle: Angle, hold: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """Return infinity: the block may roll on to a part that holds it better."""
        return jnp.full_like(hold, jnp.inf)

    def unheld_manifold(self, angle: Angle, hold: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar | float:
        """Return zero beyond `firm`: there no part holds the block better further on, as on a circle."""
        return 0.0 if self.firm is None else jnp.where(angle.value < self.firm, jnp.inf, 0.0)


@one_program
def _balance(moments: RollingMoments) -> Scalar:
    """Return the opening angle at which the centre of mass is over the point of contact, at most pi/2."""
    return first_zero(lambda x: moments.rolled(Angle.of(x)).reach, moments.saddle)


@one_program
def _summit(moments: RollingMoments, saddle: Scalar) -> Summit:
    return Summit.of(moments.restoring, saddle)


@one_program
def _firm(moments: RollingMoments) -> Scalar:
    return last_rise(moments, moments.saddle)


def _alike(first: Edge, second: Edge) -> tuple[Edge, Edge]:
    """Pad two edges to the same number of angles, so that one program serves both sides."""
    if first.angle is None and second.angle is None:
        return first, second
    known = [jnp.zeros(1) if edge.angle is None else edge.angle for edge in (first, second)]
    count = max(angle.size for angle in known)
    longer = [jnp.concatenate([angle, angle[-1] + 1.0 + jnp.arange(count - angle.size)]) for angle in known]
    return first.with_angles(longer[0]), second.with_angles(longer[1])
