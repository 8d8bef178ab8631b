"""A scene: block, motion and model reduced to the numbers that the engines need."""

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Inexact, Int

from jaxrock._checks import put_down
from jaxrock._parameters import check_single, in_precision, is_ours
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.restitution import Reset, on_sides
from jaxrock.blocks.rigid import Block
from jaxrock.engines.outlook import Outlook
from jaxrock.models.coefficients import Coefficients
from jaxrock.models.equation import AbstractEquation, AbstractMoments
from jaxrock.motions.joined_records import in_place as found_in_place, is_in_place
from jaxrock.motions.motion import AbstractMotion, is_of_several
from jaxrock.motions.shaking import Shaking, sum_of_series
from jaxrock.numerics.choice import where
from jaxrock.numerics.lookup import pick

Scalar = Inexact[Array, ""]
_MANY = 32  # pieces, from which on there may be room for more
_TOGETHER = 4  # knots that come together, of motions at once


def peak_bound(motion: AbstractMotion) -> Scalar:
    """A bound of the motion's acceleration [g]: its peak, for records and most pulses."""
    return jnp.max(motion.bounds)


def _moments(block: Block | AsymmetricBlock, model: AbstractEquation) -> tuple:
    """Coefficients of side 1, and of side 2 if it has one of its own; times are p t, or p1 t on both sides."""
    if is_ours(model):  # of what is traced they were asked before (`responses.current_model`): none in machine code
        with put_down():
            return _made(block, model)
    return _made(block, model)


def _made(block: Block | AsymmetricBlock, model: AbstractEquation) -> tuple:
    if isinstance(block, Block):
        moments = model.moments(block)
        return moments.balanced if isinstance(moments, Coefficients) else moments, None
    both = zip(model.moments_of_sides(block), block.sides)
    return tuple(moments.times((side.p / block.p1) ** 2) for moments, side in both)


def _least_threshold(moments: AbstractMoments, far: AbstractMoments | None) -> Scalar:
    return moments.threshold if far is None else jnp.minimum(moments.threshold, far.threshold)


def _endless(values: Inexact[Array, " pieces"], count: Int[Array, ""] | None) -> Inexact[Array, " knots"]:
    """Values of pieces, and infinity for what comes after the last."""
    values = jnp.concatenate([values, jnp.full(1, jnp.inf, values.dtype)])
    return values if count is None else where(jnp.arange(values.size) < count, values, jnp.inf)


def uplift_threshold(block: Block | AsymmetricBlock, model: AbstractEquation) -> Scalar:
    """Ground acceleration at which a block uplifts, to its weaker side [g]."""
    return _least_threshold(*_moments(block, model))


class Here(NamedTuple):
    """The one piece of which a step is told, where derivatives by a whole motion become those by a few numbers."""

    number: Int[Array, ""]
    start: Scalar  # [s]
    length: Scalar  # [s]


class Scene(eqx.Module):
    """One block under one motion. Piece `pieces` (one past the last) is the quiet after the motion.

    A symmetric block has one `moments` for both sides. That of an asymmetric one, or of one whose law of restitution
    tells sides apart, is for the side on which it stands (rotation > 0 unless `on` tells otherwise), and `far` for the
    other.
    """

    moments: AbstractMoments
    far: AbstractMoments | None
    p: Scalar  # unit of time and velocity on either side
    alpha: Scalar  # size of an angle that matters
    reset: Reset  # the impact that ends the stay on this side
    far_reset: Reset  # on the other
    motion: AbstractMotion
    knots: Inexact[Array, " knots"]
    scales: Inexact[Array, " knots"] | None  # None: straight lines
    count: Int[Array, ""] | None  # of pieces before the end, where there may be some without length after it
    following: Int[Array, " knots"] | None  # from each piece on the first that lasts; None: one after the other
    outlook: Outlook
    falls_flat: bool = eqx.field(static=True)
    first: Int[Array, ""] | None = None  # piece, where the motion is one of many that follow one another; None: 0
    room: int | None = eqx.field(static=True, default=None)  # for pieces of one of them
    here: Here | None = None  # None: all are known

    @classmethod
    def of(
        cls, block: Block | AsymmetricBlock, motion: AbstractMotion, model: AbstractEquation, in_place: bool = False
    ) -> "Scene":
        """Build the scene, of one record of many `in_place` or with arrays of its own; raise ValueError where a
        parameter is an array outside of `jax.vmap`."""
        check_single(block=block, motion=motion)
        dtype = jnp.result_type(*jax.tree.leaves((block, motion)))
        block, motion = in_precision(block, dtype), in_precision(motion, dtype)
        stretch = found_in_place(motion) if in_place and is_in_place(motion) else None
        motion = motion if stretch is None else stretch.motion
        knots, envelope = motion.knots, motion.envelope
        if stretch is not None:
            count = stretch.end
        else:  # up to the last piece with a length: a late motion's knots may all be one number
            # Of motions that end together one may go on longer: what lies between their ends has slopes.
            count = motion.lasting.pieces if knots.size > _MANY and not is_of_several(motion) else None
        if envelope.vertical is not None and not model.feels_weight:
            raise ValueError(
                "Argument `motion` must not be vertical for a Spring, whose moment does not weigh anything."
            )
        moments, far = _moments(block, model)
        if isinstance(block, Block):
            p, alpha, corners = block.p, block.alpha, on_sides(block.law, block.corners)
            far = None if corners[0] is corners[1] else moments
        else:
            p, alpha, corners = block.p1, jnp.minimum(block.alpha1, block.alpha2), block.corners
        most = 1.0 if isinstance(block, Block) else jnp.inf
        reset, far_reset = (Reset.of(block.law, each, p, most) for each in corners)
        return cls(
            moments=moments,
            far=far,
            p=p,
            alpha=alpha,
            reset=reset,
            far_reset=far_reset,
            motion=motion,
            knots=knots,
            scales=None if motion.scales is None else _endless(motion.scales, None if stretch else count),
            count=count,
            following=motion.following,
            outlook=Outlook.of(envelope, _least_threshold(moments, far)),
            falls_flat=model.falls_flat,
            first=None if stretch is None else stretch.first,
            room=None if stretch is None else stretch.room,
        )

    @property
    def most_pieces(self) -> int:
        """For how many pieces there is room."""
        return self.knots.size - 1 if self.room is None else self.room

    @property
    def pieces(self) -> Int[ArrayLike, ""]:
        """Number of smooth pieces of the motion."""
        return self.most_pieces if self.count is None else self.count

    def on(self, side: Scalar | float) -> "Scene":
        """The scene as a block on this side sees it; at rest as on side +1."""
        if self.far is None:
            return self

        def of(here, there):
            return jax.tree.map(lambda a, b: where(side < 0, b, a), here, there)

        return replace(
            self,
            moments=of(self.moments, self.far),
            far=of(self.far, self.moments),
            reset=of(self.reset, self.far_reset),
            far_reset=of(self.far_reset, self.reset),
        )

    @property
    def both_moments(self) -> tuple[AbstractMoments, AbstractMoments]:
        """Moments of this side and of the other."""
        return self.moments, self.moments if self.far is None else self.far

    @property
    def different_moments(self) -> tuple[AbstractMoments, ...]:
        """The one moments, or both."""
        return (self.moments,) if self.far is None else (self.moments, self.far)

    @property
    def threshold(self) -> Scalar:
        """Ground acceleration below which the block stays at rest, to whichever side it goes [g]."""
        return _least_threshold(self.moments, self.far)

    def drives_of(self, shaking: Shaking) -> list[tuple[list[Scalar], Scalar]]:
        """What lifts a block at rest to side 1 and to side -1, as a series, and the level above which it does.

        To side s where -s u > threshold (1 + v).
        """
        found = []
        for side, moments in zip((1, -1), self.both_moments):
            drive = [-side * u for u in shaking.horizontal]
            if shaking.vertical is not None:
                drive = sum_of_series(drive, [-moments.threshold * v for v in shaking.vertical])
            found.append((drive, moments.threshold))
        return found

    def after_quiet(self, piece: Int[Array, ""]) -> Int[Array, ""]:
        """First piece from `piece` on that may uplift a block at rest; cheap, so it may stop early."""
        later = self.outlook.after_quiet(piece)
        if is_of_several(self.motion):  # those just before may have no length, but slopes
            later = jnp.maximum(later - _TOGETHER, piece)
        return jnp.minimum(later, self.pieces)

    def from_here(self, piece: Int[Array, ""]) -> Int[Array, ""]:
        """This piece, or, where it does not last, the first after it that does, if the scene tells which."""
        return piece if self.following is None else jnp.minimum(self.following[piece], self.pieces)

    def length(self, piece: Int[Array, ""]) -> Scalar:
        """How long a piece lasts [s]; the quiet after the motion has no end."""
        if self.here is not None:
            return self.here.length
        return where(piece < self.pieces, self.motion.length(jnp.minimum(piece, self.pieces - 1)), jnp.inf)

    def start(self, piece: Int[Array, ""]) -> Scalar:
        """When a piece begins [s]."""
        if self.here is None:
            return pick(self.knots, piece)
        return self.here.start + where(piece > self.here.number, self.here.length, 0.0)

    def scale(self, piece: Int[Array, ""]) -> Scalar | float:
        """Time in which the acceleration of a piece changes [s]."""
        return jnp.inf if self.scales is None else pick(self.scales, piece)

    def shaking(self, piece: Int[Array, ""], local: Scalar, order: int) -> tuple[Shaking, Scalar]:
        """Taylor coefficients of the ground acceleration [g] in time/unit, and the unit [s]."""
        unit = 1 / self.p if self.scales is None else jnp.minimum(1 / self.p, self.scale(piece))
        during = piece < self.pieces
        inner = jnp.minimum(piece, self.pieces - 1)
        shaking = Shaking(
            self.motion.series(inner, local, unit, order), self.motion.vertical_series(inner, local, unit, order)
        )
        return shaking.each(lambda terms: [where(during, u, 0.0) for u in terms]), unit
