"""A scene: block, motion and model reduced to the numbers that the engines need."""

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Inexact, Int

from jaxrock._arguments.parameters import check_single, in_precision, is_ours
from jaxrock._core.types import Scalar
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.restitution import Reset, on_sides
from jaxrock.blocks.rigid import Block
from jaxrock.compiler import checks
from jaxrock.compiler.hints import select
from jaxrock.engines.remaining_forcing import RemainingForcing
from jaxrock.models.coefficients import of_one_kind
from jaxrock.models.equation import AbstractEquation, AbstractMoments
from jaxrock.motions.floors import with_solved_floors
from jaxrock.motions.harmonic import cycles_in
from jaxrock.motions.joined_records import in_place as found_in_place, is_in_place
from jaxrock.motions.motion import AbstractMotion, is_of_several, merged_pieces
from jaxrock.motions.shaking import Shaking, sum_of_series
from jaxrock.numerics.lookup import take

_MANY = 32  # number of pieces from which on the knot array may be padded beyond the motion's end
_TOGETHER = 4  # pieces to step back in a sum of motions, whose knots may coincide


def peak_bound(motion: AbstractMotion) -> Scalar:
    """A bound of the motion's acceleration [g]: its peak, for records and most pulses."""
    return jnp.max(motion.bounds)


def _moments(block: Block | AsymmetricBlock, model: AbstractEquation) -> tuple:
    """Return the moments of side 1, and of side 2 if it has its own; time is p t, or p1 t on both sides."""
    if is_ours(model):  # `responses.current_model` checks traced parameters beforehand: machine code holds no checks
        with checks.collect():
            return _made(block, model)
    return _made(block, model)


def _made(block: Block | AsymmetricBlock, model: AbstractEquation) -> tuple:
    if isinstance(block, Block):
        moments = model.moments(block)
        return moments.balanced, None
    both = zip(model.moments_of_sides(block), block.sides)
    return of_one_kind(*(moments.times((side.p / block.p1) ** 2) for moments, side in both))


def _least_threshold(moments: AbstractMoments, far: AbstractMoments | None) -> Scalar:
    return moments.threshold if far is None else jnp.minimum(moments.threshold, far.threshold)


def _endless(values: Inexact[Array, " pieces"], count: Int[Array, ""] | None) -> Inexact[Array, " knots"]:
    """Append infinity for the quiet after the last piece; pieces past `count` are infinite, too."""
    values = jnp.concatenate([values, jnp.full(1, jnp.inf, values.dtype)])
    return values if count is None else select(jnp.arange(values.size) < count, values, jnp.inf)


def _ties(knots: Inexact[Array, " knots"]) -> Int[Array, " knots"]:
    """Return, for each knot, the number of the first one that coincides with it."""
    numbers = jnp.arange(knots.size, dtype=jnp.int32)
    return jax.lax.cummax(select(jnp.diff(knots, prepend=-jnp.inf) > 0, numbers, 0))


def uplift_threshold(block: Block | AsymmetricBlock, model: AbstractEquation) -> Scalar:
    """Return the ground acceleration at which a block uplifts, to its weaker side [g]."""
    return _least_threshold(*_moments(block, model))


class Here(NamedTuple):
    """The one piece that a taped step knows: derivatives by a whole motion become derivatives by a few numbers."""

    number: Int[Array, ""]
    start: Scalar  # [s]
    length: Scalar  # [s]


class Scene(eqx.Module):
    """One block under one motion. Piece `pieces` (one past the last) is the quiet after the motion.

    A symmetric block has one `moments` for both sides, and `far` is None. For an asymmetric block, or a law of
    restitution that differs between the sides, `moments` belongs to the present side and `far` to the other. The
    present side is that with rotation > 0 unless `on` says otherwise.
    """

    moments: AbstractMoments
    far: AbstractMoments | None
    p: Scalar  # unit of time and velocity, on both sides
    alpha: Scalar  # scale of an angle, for tolerances
    reset: Reset  # the impact that ends the stay on this side
    far_reset: Reset  # the impact on the other side
    motion: AbstractMotion
    knots: Inexact[Array, " knots"]
    scales: Inexact[Array, " knots"] | None  # None: every piece is a straight line
    count: Int[Array, ""] | None  # pieces before the end; zero-length pieces may follow. None: all
    following: Int[Array, " knots"] | None  # the first piece of positive length from each one on; None: the next one
    outlook: RemainingForcing
    falls_flat: bool = eqx.field(static=True)
    first: Int[Array, ""] | None = None  # first piece, where the array joins many motions; None: 0
    room: int | None = eqx.field(static=True, default=None)  # most pieces of one of these motions
    merged: int = eqx.field(static=True, default=0)  # pieces of sums of many parts beyond those of their longest part
    ties: Int[Array, " knots"] | None = None  # for each knot of a sum of many, the first that coincides with it
    cycles: Scalar | None = None  # of harmonic parts of the motion; None: it has none
    here: Here | None = None  # None: the whole motion is known
    only_side: int | None = eqx.field(static=True, default=None)  # of a wall that opens to one side; None: both
    forces_follow: bool = eqx.field(static=True, default=False)  # whether those of the ground are known (`contact`)
    is_frame: bool = eqx.field(static=True, default=False)

    @classmethod
    def of(
        cls, block: Block | AsymmetricBlock, motion: AbstractMotion, model: AbstractEquation, in_place: bool = False
    ) -> "Scene":
        """Build the scene.

        With `in_place`, one record of many is read where it lies; else the scene has arrays of its own. Raises
        ValueError where a parameter is an array outside of `jax.vmap`.
        """
        check_single(block=block, motion=motion)
        dtype = jnp.result_type(*jax.tree.leaves((block, motion)))
        block, motion = in_precision(block, dtype), in_precision(motion, dtype)
        stretch = found_in_place(motion) if in_place and is_in_place(motion) else None
        motion = with_solved_floors(motion).prepared if stretch is None else stretch.motion
        knots, envelope = motion.knots, motion.envelope
        if stretch is not None:
            count = stretch.end
        else:  # up to the last piece of positive length: the knots of a late motion may all round to one number
            # In a sum, parts that end together may move apart: zero-length pieces between their ends carry derivatives.
            count = motion.lasting.pieces if knots.size > _MANY and not is_of_several(motion) else None
        if envelope.vertical is not None and not model.feels_weight:
            raise ValueError(
                "Argument `motion` must not be vertical for a Spring, whose moment does not weigh anything."
            )
        moments, far = _moments(block, model)
        if isinstance(block, Block):
            p, alpha, only_side = block.p, block.alpha, block.only_side
            corners = on_sides(block.law, block.corners) if only_side is None else (block.corners,) * 2
            far = None if corners[0] is corners[1] else moments
        else:
            p, alpha, corners = block.p1, jnp.minimum(block.alpha1, block.alpha2), block.corners
            only_side = None
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
            outlook=RemainingForcing.of(envelope, _least_threshold(moments, far), moments.threshold_of_weight),
            falls_flat=model.falls_flat,
            forces_follow=model.forces_follow,
            is_frame=isinstance(block, Block) and block.beam is not None,
            first=None if stretch is None else stretch.first,
            room=None if stretch is None else stretch.room,
            only_side=only_side,
            merged=merged_pieces(motion),
            ties=_ties(knots) if merged_pieces(motion) else None,
            cycles=cycles_in(motion),
        )

    @property
    def most_pieces(self) -> int:
        """Return the largest number of pieces, from static shapes."""
        return self.knots.size - 1 if self.room is None else self.room

    @property
    def pieces_of_part(self) -> int:
        """Return the largest number of pieces, in which a sum of many parts counts as its longest part.

        Steps under many pulses are as long as under one. Pieces of records are shorter than steps.
        """
        return self.most_pieces - self.merged

    @property
    def pieces(self) -> Int[ArrayLike, ""]:
        """Return the number of smooth pieces of the motion."""
        return self.most_pieces if self.count is None else self.count

    def on(self, side: Scalar | float) -> "Scene":
        """Return the scene with the moments and resets of this side first; at rest those of side +1."""
        if self.far is None:
            return self

        def of(here, there):
            return jax.tree.map(lambda a, b: select(side < 0, b, a), here, there)

        return replace(
            self,
            moments=of(self.moments, self.far),
            far=of(self.far, self.moments),
            reset=of(self.reset, self.far_reset),
            far_reset=of(self.far_reset, self.reset),
        )

    def next_side(self, side: Scalar) -> Scalar:
        """Return the side on which a block stands after an impact: a wall rebounds to its only one."""
        return -side if self.only_side is None else side

    @property
    def both_moments(self) -> tuple[AbstractMoments, AbstractMoments]:
        """Return the moments of this side and of the other."""
        return self.moments, self.moments if self.far is None else self.far

    @property
    def different_moments(self) -> tuple[AbstractMoments, ...]:
        """Return the moments without repetition: one entry for a symmetric block, else two."""
        return (self.moments,) if self.far is None else (self.moments, self.far)

    @property
    def threshold(self) -> Scalar:
        """Return the ground acceleration below which the block stays at rest, whichever its weaker side [g]."""
        return _least_threshold(self.moments, self.far)

    def drives_of(self, shaking: Shaking) -> list[tuple[list[Scalar], Scalar]]:
        """Return, for uplift to side 1 and to side -1, the drive as a series and the level that it must exceed.

        The block uplifts to side s where -s u > threshold + own v, own the part of the threshold that the weight holds.
        No drive lifts a wall to the side that is held.
        """
        found = []
        for side, moments in zip((1, -1), self.both_moments):
            drive = [-side * u for u in shaking.horizontal]
            if shaking.vertical is not None:
                own = moments.threshold if moments.threshold_of_weight is None else moments.threshold_of_weight
                drive = sum_of_series(drive, [-own * v for v in shaking.vertical])
            if self.only_side not in (None, side):
                drive = [jnp.zeros_like(c) for c in drive]
            found.append((drive, moments.threshold))
        return found

    def after_quiet(self, piece: Int[Array, ""]) -> Int[Array, ""]:
        """Return the first piece from `piece` on that may uplift a block at rest; the search is cheap and may stop
        early."""
        later = self.outlook.after_quiet(piece)
        if is_of_several(self.motion):  # zero-length pieces just before may carry derivatives
            back = later - _TOGETHER if self.ties is None else self.ties[jnp.minimum(later, self.most_pieces)]
            later = jnp.maximum(back, piece)
        return jnp.minimum(later, self.pieces)

    def from_here(self, piece: Int[Array, ""]) -> Int[Array, ""]:
        """Return this piece, or the first one after it of positive length where `following` is known."""
        return piece if self.following is None else jnp.minimum(self.following[piece], self.pieces)

    def length(self, piece: Int[Array, ""]) -> Scalar:
        """Return the length of a piece [s]; the quiet after the motion has no end."""
        if self.here is not None:
            return self.here.length
        return select(piece < self.pieces, self.motion.length(jnp.minimum(piece, self.pieces - 1)), jnp.inf)

    def start(self, piece: Int[Array, ""]) -> Scalar:
        """Return the time at which a piece begins [s]."""
        if self.here is None:
            return take(self.knots, piece)
        return self.here.start + select(piece > self.here.number, self.here.length, 0.0)

    def scale(self, piece: Int[Array, ""]) -> Scalar | float:
        """Return the time in which the acceleration of a piece changes [s]."""
        return jnp.inf if self.scales is None else take(self.scales, piece)

    def shaking(self, piece: Int[Array, ""], local: Scalar, order: int) -> tuple[Shaking, Scalar]:
        """Return Taylor coefficients of the ground acceleration [g] in time/unit, and the unit [s]."""
        unit = 1 / self.p if self.scales is None else jnp.minimum(1 / self.p, self.scale(piece))
        during = piece < self.pieces
        inner = jnp.minimum(piece, self.pieces - 1)
        shaking = Shaking(
            self.motion.series(inner, local, unit, order), self.motion.vertical_series(inner, local, unit, order)
        )
        return shaking.each(lambda terms: [select(during, u, 0.0) for u in terms]), unit
