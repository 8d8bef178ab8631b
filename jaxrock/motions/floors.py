"""Floors: the acceleration of a linear oscillator under a ground motion, exact to rounding, as a motion.

A `Floor` holds the ground motion and three numbers. A `SolvedFloor` also holds the states of the oscillator before each
stretch of time, from which its Taylor series follows at any time. Engines solve a floor once, before their loops.

- Under straight lines a stretch is a piece of the ground motion. The line and the free oscillation about it are closed
  forms, for any period.
- Under any other motion a stretch is so short that the Taylor series from its start is exact to rounding.
"""

import functools
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Inexact, Int

from jaxrock._arguments.annotations import arguments
from jaxrock._arguments.parameters import broadcast, leaves_of, parameter, set_parameters, shared
from jaxrock._arguments.ranges import Range, size, with_throw
from jaxrock._core.arrays import is_traced
from jaxrock._core.types import Scalar
from jaxrock.compiler import checks
from jaxrock.compiler.hints import select
from jaxrock.motions.floor_series import Building, bound_of_stretch, floor_terms
from jaxrock.motions.floor_states import OscillatorState, chained_states, free, from_rest, under_line
from jaxrock.motions.motion import AbstractMotion, Piece, is_of_several
from jaxrock.motions.pieces import Extent
from jaxrock.motions.record import roomy
from jaxrock.motions.shaking import Bounds, Envelope
from jaxrock.numerics.lookup import take
from jaxrock.numerics.polynomial import horner

_ORDER = 24  # of the Taylor series over a stretch
_PER_SCALE = 2  # stretches in the time in which the ground acceleration changes
_RINGS = 12  # pieces after the end of the ground motion
_FEW = 32  # knots; with more, pieces without a length are skipped
_MOST = 1 << 20  # stretches under a known motion
_TRACED = 4096  # stretches under a traced one
_damped = Range("be in (0, 1), as an undamped floor never comes to rest", 0.0, 1.0, lambda x: (x > 0) & (x < 1))


@with_throw
@arguments
def on_floor(
    motion: AbstractMotion,
    *,
    period: ArrayLike,
    damping: ArrayLike = 0.05,
    gain: ArrayLike = 1.0,
    throw: bool = True,
) -> "Floor":
    """Return the acceleration of a floor under a ground motion, where the building is a linear oscillator.

    The displacement y relative to the ground obeys y'' + 2 damping omega y' + omega^2 y = -g u, omega = 2 pi/period.
    The floor moves with u + gain y''/g; for gain 1 this is -(2 damping omega y' + omega^2 y)/g.

    **Arguments:**

    - `motion`: any ground motion. Another floor makes a cascade: a light structure on a heavy one.
    - `period`: of the building [s], positive. Many periods: `jax.vmap`.
    - `damping`: over critical, in (0, 1).
    - `gain`: participation of the floor in the mode [-]. For a mode shape phi and masses m it is phi(floor) sum(m
      phi)/sum(m phi^2), as y of the mode counts that often. 1: the oscillator itself; 0: the ground.

    **Returns:** a motion, exact to rounding, and differentiable by all of these. After the end of the ground motion the
    floor rings on for 36/(damping omega), until its oscillation has decayed to the rounding unit. The vertical
    acceleration is that of the ground.

    **Raises:** ValueError for a number outside its range. Also for a motion other than straight lines whose period is
    very short beside its duration; where numbers are traced, sooner.

    With `throw=False`, numbers outside their ranges become NaN.

    Under a motion of curves the period may later vary, as in fits: below half its first value an outcome may be NaN
    with a status.

    **Source:** Clough & Penzien (1993), modal analysis. An oscillator under straight lines: Nigam & Jennings (1969).
    """
    return Floor(motion, period, damping, gain)


class Floor(AbstractMotion):
    """A floor of a building under a ground motion, made by `on_floor`."""

    motion: AbstractMotion
    period: Inexact[Array, "..."] = parameter("s", size, symbol="T")
    damping: Inexact[Array, "..."] = parameter("-", _damped, symbol="zeta")
    gain: Inexact[Array, "..."] = parameter("-")
    room: int = eqx.field(static=True)  # stretches besides one for each piece

    def __init__(self, motion: AbstractMotion, period: ArrayLike, damping: ArrayLike, gain: ArrayLike):
        self.motion, self.room = motion, 0
        set_parameters(self, period=period, damping=damping, gain=gain)
        self.period, self.room = _with_room(self)

    @property
    def rate(self) -> Inexact[Array, "..."]:
        """Circular frequency of the building [rad/s]."""
        return 2 * math.pi / self.period

    @property
    def building(self) -> Building:
        """Damping and participation."""
        return Building(self.damping, self.gain)

    @property
    def knots(self) -> Inexact[Array, " knots"]:
        inner = self.motion.knots
        return jnp.concatenate([inner, inner[-1] + _ring_times(self)[1:]])

    @property
    def lengths(self) -> Inexact[Array, " pieces"]:
        return jnp.concatenate([self.motion.lengths, jnp.diff(_ring_times(self))])

    @property
    def lasting(self) -> Extent:
        forward = self.motion.lasting.forward & (self.rate > 0)
        pieces = self.motion.knots.size - 1 + _RINGS
        return Extent(select(forward, pieces, 0).astype(jnp.int32), forward)

    @property
    def time_rounding(self) -> Scalar | None:
        return self.motion.time_rounding

    @property
    def following(self) -> Int[Array, " knots"] | None:
        inner, pieces = self.motion.following, self.motion.knots.size - 1
        if pieces + 1 <= _FEW:
            return None
        numbers = jnp.arange(pieces + _RINGS + 1, dtype=jnp.int32)
        if inner is not None:
            return jnp.concatenate([inner[:-1], numbers[pieces:]])
        if is_of_several(self.motion):
            return None
        # Records are padded at their ends by pieces without a length.
        return select((numbers >= self.motion.lasting.pieces) & (numbers < pieces), pieces, numbers)

    @property
    def scales(self) -> Inexact[Array, " pieces"]:
        inner, own = self.motion.scales, 1 / self.rate
        pieces = self.motion.knots.size - 1
        during = jnp.full(pieces, own) if inner is None else jnp.minimum(inner, own)
        return jnp.concatenate([during, jnp.full(_RINGS, own)])

    @property
    def bounds(self) -> Inexact[Array, " pieces"]:
        return solved(self).bounds

    @property
    def envelope(self) -> Envelope:
        return Envelope(Bounds(self.bounds), _longer(self.motion.envelope.vertical))

    @property
    def vertical_bounds(self) -> Inexact[Array, " pieces"] | None:
        vertical = self.envelope.vertical
        return None if vertical is None else vertical.times_gain(vertical.values)

    def series(self, piece: Piece, local: Scalar, unit: Scalar, order: int) -> list[Scalar]:
        return solved(self).series(piece, local, unit, order)

    def vertical_series(self, piece: Piece, local: Scalar, unit: Scalar, order: int) -> list[Scalar] | None:
        pieces = self.motion.knots.size - 1
        inner = self.motion.vertical_series(jnp.minimum(piece, pieces - 1), local, unit, order)
        return None if inner is None else [select(piece < pieces, v, 0.0) for v in inner]


def _longer(vertical: Bounds | None) -> Bounds | None:
    if vertical is None:
        return None
    return vertical._replace(values=jnp.concatenate([vertical.values, jnp.zeros(_RINGS, vertical.values.dtype)]))


def _ring_times(floor: Floor) -> Inexact[Array, " rings"]:
    """Return the times after the end of the ground motion that bound the pieces of the ringing, from 0 on [s].

    The last one is that at which the amplitude is below rounding. The first pieces are the shortest, as the bounds of
    strong ringing matter most.
    """
    gone = -math.log(jnp.finfo(floor.rate.dtype).eps)
    shares = jnp.asarray([(k / _RINGS) ** 2 for k in range(_RINGS + 1)], floor.rate.dtype)
    return gone / (floor.damping * floor.rate) * shares


class _Stretches(eqx.Module):
    """Stretches of time: equal parts of each piece of the ground motion, then the pieces of the ringing."""

    first: Int[Array, " pieces"]  # the first stretch of each piece
    count: Int[Array, " pieces"]  # stretches of each piece
    step: Inexact[Array, " pieces"]  # length of these [s]
    piece: Int[Array, " stretches"]
    start: Inexact[Array, " stretches"]  # from the begin of the piece [s]
    length: Inexact[Array, " stretches"]  # [s]

    @classmethod
    def of(cls, floor: Floor) -> "_Stretches":
        """Cut the pieces of a floor; those under a motion of curves by their time scale."""
        lengths, inner = floor.lengths, floor.motion.knots.size - 1
        numbers = jnp.arange(lengths.size, dtype=jnp.int32)
        if floor.room == 0:
            return cls(numbers, jnp.ones_like(numbers), lengths, numbers, jnp.zeros_like(lengths), lengths)
        wanted = _wanted(floor)
        share = jnp.minimum(1.0, floor.room / jnp.maximum(wanted.sum(), 1.0))
        counts = 1 + jnp.floor(jnp.where(wanted >= 0, wanted * share, 0.0)).astype(jnp.int32)
        firsts, size = jnp.cumsum(counts) - counts, inner + floor.room
        number = jnp.arange(size, dtype=jnp.int32)
        piece = jnp.clip(jnp.searchsorted(firsts, number, side="right") - 1, 0, inner - 1)
        within = number - firsts[piece]
        # With far too few of them nothing is exact, and NaN says so.
        step = lengths[:inner] / counts * jnp.where(wanted.sum() > 2 * floor.room, jnp.nan, 1.0)
        rings = jnp.arange(_RINGS, dtype=jnp.int32)
        return cls(
            jnp.concatenate([firsts, size + rings]).astype(jnp.int32),
            jnp.concatenate([counts, jnp.ones_like(rings)]),
            jnp.concatenate([step, lengths[inner:]]),
            jnp.concatenate([piece, inner + rings]).astype(jnp.int32),
            jnp.concatenate([within * step[piece], jnp.zeros(_RINGS, lengths.dtype)]),
            jnp.concatenate([select(within < counts[piece], step[piece], 0.0), lengths[inner:]]),
        )


def _wanted(floor: Floor) -> Inexact[Array, " pieces"]:
    """Return the number of stretches that each piece of the ground motion needs."""
    lengths, scales, rate = jax.lax.stop_gradient((floor.motion.lengths, floor.motion.scales, floor.rate))
    return lengths * (rate if scales is None else jnp.maximum(rate, _PER_SCALE / scales))


def _is_straight(motion: AbstractMotion) -> bool:
    """Return whether a motion consists of straight lines, as the number of its coefficients says."""
    if _has_floors(motion):
        return False
    zero = jnp.zeros((), motion.knots.dtype)
    return len(motion.series(jnp.zeros((), jnp.int32), zero, zero + 1, _ORDER)) <= 2


def _needed(floor: Floor) -> Scalar | None:
    """Return the number of stretches besides one for each piece; None under straight lines."""
    return None if _is_straight(floor.motion) else _wanted(floor).sum()


def _with_room(floor: Floor) -> tuple[Inexact[Array, "..."], int]:
    """Return the period, and the room for stretches, from the values where they are known.

    **Raises:** ValueError for a motion that needs too many; where numbers are traced the limit is lower.
    """
    needed: Any = _needed
    own, depth = shared(floor), max((jnp.ndim(x.value) for x in leaves_of(floor) if not x.is_shared), default=0)
    shape = jnp.broadcast_shapes((), *(jnp.shape(x.value) for x in leaves_of(floor) if not x.is_shared))
    floor = broadcast(floor, shape) if depth else floor
    for _ in range(depth):
        needed = jax.vmap(needed, in_axes=(jax.tree.map(lambda one: None if one else 0, own),))
    if jax.eval_shape(needed, floor) is None:
        return floor.period, 0
    message = (
        "Argument `period` must be long enough beside the duration of a motion that is not of straight lines{}: make "
        "a `Record` of the motion, `rk.Record(motion.acceleration(times), dt)`"
    )
    if is_traced(floor):
        failed = jnp.any(needed(floor) > _TRACED)
        return checks.error_if(floor.period, failed, message.format(" where it is traced")), _TRACED
    most = float(np.max(np.asarray(jax.jit(needed)(floor))))
    if most > _MOST:
        raise ValueError(f"{message.format('')}.")
    return floor.period, roomy(max(16, math.ceil(most))) if most >= 0 else 16


class SolvedFloor(AbstractMotion):
    """A floor with the states of its oscillator before each stretch, and bounds."""

    floor: Floor  # whose ground motion is solved, too
    stretches: _Stretches
    states: OscillatorState
    values: Inexact[Array, " pieces"]

    knots = property(lambda self: self.floor.knots)
    lengths = property(lambda self: self.floor.lengths)
    lasting = property(lambda self: self.floor.lasting)
    time_rounding = property(lambda self: self.floor.time_rounding)
    following = property(lambda self: self.floor.following)
    scales = property(lambda self: self.floor.scales)
    bounds = property(lambda self: self.values)

    def length(self, piece: Piece) -> Scalar:
        """Return the duration of one piece [s]."""
        return take(self.stretches.step, piece) * take(self.stretches.count, piece)

    @property
    def envelope(self) -> Envelope:
        """Bounds of the horizontal and of the vertical acceleration."""
        return Envelope(Bounds(self.values), _longer(self.floor.motion.envelope.vertical))

    @property
    def vertical_bounds(self) -> Inexact[Array, " pieces"] | None:
        """Bounds of the vertical acceleration."""
        return self.floor.vertical_bounds

    def vertical_series(self, piece: Piece, local: Scalar, unit: Scalar, order: int) -> list[Scalar] | None:
        """Return the coefficients of the ground's vertical acceleration."""
        return self.floor.vertical_series(piece, local, unit, order)

    def series(self, piece: Piece, local: Scalar, unit: Scalar, order: int) -> list[Scalar]:
        """Return the coefficients of the floor's acceleration."""
        ground = _ground(self.floor.motion, piece, local, unit, order)
        return floor_terms(self.floor.building, ground, self._state(piece, local), self.floor.rate * unit, order)

    def _state(self, piece: Piece, local: Scalar) -> OscillatorState:
        """Return the state of the oscillator at a time after the begin of a piece."""
        floor, cuts, damping = self.floor, self.stretches, self.floor.damping
        stretch, begin, elapsed = piece, jnp.zeros_like(local), local
        if floor.room:
            step = cuts.step[piece]
            place = jnp.clip(local / select(step > 0, step, 1.0), 0, (cuts.count[piece] - 1).astype(local.dtype))
            number = jax.lax.stop_gradient(jnp.floor(place))
            begin = number * step
            stretch, elapsed = cuts.first[piece] + number.astype(jnp.int32), local - begin
        state = OscillatorState(self.states.place[stretch], self.states.speed[stretch])
        transition = free(floor.rate * elapsed, damping)
        if not floor.room:
            now, *slope = _ground(floor.motion, piece, local, jnp.ones_like(local), 1)
            lag = slope[0] / floor.rate if slope else jnp.zeros_like(now)
            centre = OscillatorState(now - lag * floor.rate * elapsed - 2 * damping * lag, lag)
            moved = transition.of(state - centre, damping)
            return moved.plus(OscillatorState(now - 2 * damping * lag, lag))
        unit = jnp.where(step > 0, step, 1.0)
        terms = _ground(floor.motion, piece, begin, unit, _ORDER)
        share = elapsed / unit
        gained = (horner(x, share) for x in from_rest(floor.rate * unit, terms, damping))
        return transition.of(state, damping).plus(OscillatorState(*gained))


def _ground(motion: AbstractMotion, piece: Piece, local: Scalar, unit: Scalar, order: int) -> list[Scalar]:
    """Return the coefficients of a ground motion, which are zero after its end."""
    pieces = motion.knots.size - 1
    inner = motion.series(jnp.minimum(piece, pieces - 1), local, unit, order)
    return [select(piece < pieces, u, 0.0) for u in inner]


@jax.jit
def solved(floor: Floor) -> SolvedFloor:
    """Solve the oscillator of a floor from rest: its state before each stretch, and bounds of each piece."""
    floor = eqx.tree_at(lambda f: f.motion, floor, with_solved_floors(floor.motion).prepared)
    cuts, damping = _Stretches.of(floor), floor.damping
    angles = floor.rate * cuts.length
    straight = floor.room == 0

    def terms_of(piece, start, length):
        return _ground(floor.motion, piece, start, length, 1 if straight else _ORDER)

    terms = jax.vmap(terms_of)(cuts.piece, cuts.start, cuts.length)
    if straight:
        gains = under_line(angles, terms[0], sum(terms[1:], terms[0]), damping)
    else:
        gains = OscillatorState(*(sum(x) for x in from_rest(angles, terms, damping)))
    states = chained_states(free(angles, damping), gains, damping)
    before, after = (OscillatorState(*(x[part] for x in states)) for part in (slice(None, -1), slice(1, None)))
    rings = None if straight else jnp.arange(angles.size) >= angles.size - _RINGS
    bound = functools.partial(bound_of_stretch, floor.building)
    values = jax.vmap(bound)(terms, before, after, angles, rings)
    if not straight:
        pieces = floor.motion.knots.size - 1 + _RINGS
        values = jnp.where(cuts.length > 0, values, 0.0)  # unused ones
        values = jax.ops.segment_max(values, cuts.piece, pieces, indices_are_sorted=True)
    return SolvedFloor(floor, cuts, before, values)  # type: ignore[call-arg]


def with_solved_floors(motion: AbstractMotion) -> AbstractMotion:
    """Solve the floors in a motion, once for all its uses; a motion without floors stays as it is."""

    if not _has_floors(motion):
        return motion
    return jax.tree.map(lambda part: solved(part) if _is_floor(part) else part, motion, is_leaf=_is_floor)


def _has_floors(motion: AbstractMotion) -> bool:
    return any(map(_is_floor, jax.tree.leaves(motion, is_leaf=_is_floor)))


def _is_floor(part: Any) -> bool:
    return isinstance(part, Floor)
