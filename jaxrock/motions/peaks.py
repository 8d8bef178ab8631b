"""The largest acceleration and velocity of a motion, as functions of JAX."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrock._checks import is_traced, watched
from jaxrock._quickly import quickly
from jaxrock.blocks.rigid import GRAVITY
from jaxrock.motions.motion import AbstractMotion, Scalar
from jaxrock.motions.record import with_room
from jaxrock.numerics.gauss_legendre import gauss_legendre

_NODES, _WEIGHTS = gauss_legendre(6)
_FEW = 32  # pieces
_PARTS = 256  # of every piece, where there are few
_PER_SCALE = 8  # parts of the time in which an acceleration changes, where there are many
_LEAST = 2  # parts of that time, still exact to 1e-9
_MOST = 1 << 20  # largest number of parts of a known motion
_AT_A_TIME = 8192  # parts at a time
_NEWTON = 3  # steps to a zero or a top: each doubles the digits of the one before


def peaks_of_motion(motion: AbstractMotion) -> tuple[Scalar, Scalar]:
    """`intensity.peak_acceleration` [g] and `peak_velocity` [m/s] at once, without a warning of a record's baseline."""
    return peaks_and_last_velocity(motion)[:2]


def peaks_and_last_velocity(motion: AbstractMotion) -> tuple[Scalar, Scalar, Scalar]:
    """Return peaks of acceleration [g] and velocity [m/s], and the last velocity [m/s].

    A few programs serve records of any length.

    **Raises:** ValueError for a motion of too many cycles within its pieces; the limit is lower under tracing.
    """
    motion = with_room(motion)
    return _fine_enough(motion, _peaks_of)


def peaks_of_many(motions: AbstractMotion, choose: Callable, count: int) -> tuple[Array, Array]:
    """Return `peaks_of_motion` of every `choose(motions, index)`, by one program."""

    def peaks(motions, room):
        return jax.vmap(lambda index: _peaks_of(choose(motions, index), room))(jnp.arange(count))

    return _fine_enough(motions, peaks)[:2]


def _fine_enough(motion: Any, peaks: Callable) -> tuple:
    """Return the results of `peaks(motion, room)` with the usual parts of every piece, or with more where needed."""
    *found, wanted = peaks(motion, None)
    if wanted is None:
        return tuple(found)
    if is_traced(wanted):
        message = "Argument `motion` must have at most 20 cycles within a piece where it is traced"
        return watched(tuple(found), message, jnp.any(wanted > 0))
    most = float(np.max(np.asarray(wanted)))
    if not most > 0:  # NaN where the motion is
        return tuple(found)
    if most > _MOST:
        raise too_long(_MOST // _LEAST, most / _LEAST)
    return tuple(peaks(motion, min(_MOST, 1 << int(np.ceil(np.log2(most * _PER_SCALE / _LEAST)))))[:-1])


def too_long(most: float, lasts: float) -> ValueError:
    """Make the error for motions with more cycles than the limit."""
    return ValueError(
        f"Argument `motion` must last at most {most:g} times the time in which its acceleration changes, but lasts "
        f"{lasts:.3g} times that: make a `Record` of its relevant part."
    )


@quickly(static_argnums=1)
def _peaks_of(motion: AbstractMotion, room: int | None):
    """Return peaks of acceleration [g] and velocity [m/s], the last velocity, and the number of parts wanted.

    That number is 0 if there are enough parts, None if there always are. Every piece is cut into parts. Gauss-Legendre
    quadrature integrates the acceleration over each part, and up to its zero in it. Newton's method finds the top of
    the acceleration beside the larger end of each part.
    """
    kind = motion.knots.dtype
    nodes, weights = (jnp.asarray(values, kind) / 2 for values in (_NODES, _WEIGHTS))
    lengths = motion.lengths

    def in_part(piece, begin, step):
        @jax.vmap
        def jets(local):
            """Acceleration and its first two derivatives, at some times."""
            terms = motion.series(piece, jnp.clip(local, 0.0, lengths[piece]), jnp.ones_like(local), 2)
            terms = [*terms, *[jnp.zeros_like(terms[0])] * (3 - len(terms))]
            return terms[0], terms[1], 2 * terms[2]

        def gain_and(width, others):
            """Velocity gained in as much of it as is asked for, and the acceleration at other times."""
            values = jets(jnp.concatenate([begin + width * (0.5 + nodes), others]))[0]
            return values[: nodes.size] @ weights * width, values[nodes.size :]

        gain, (left, right) = gain_and(step, jnp.stack([begin, begin + step]))
        turns = jnp.sign(left) * jnp.sign(right) < 0  # the product of small ones may be zero
        zero = step * jnp.where(turns, left / jnp.where(turns, left - right, 1.0), 0.0)

        def nearer(_, found):
            zero, top = found
            values, slopes, bends = jets(begin + jnp.stack([zero, top]))
            zero = jnp.clip(zero - values[0] / jnp.where(slopes[0] == 0, jnp.inf, slopes[0]), 0.0, step)
            move = -slopes[1] / jnp.where(bends[1] == 0, jnp.inf, bends[1])
            return zero, top + jnp.where(jnp.abs(move) <= step, move, 0.0)

        larger = jnp.where(jnp.abs(left) >= jnp.abs(right), 0.0, step)
        zero, top = jax.lax.fori_loop(0, _NEWTON, nearer, (zero, larger))
        turning, (highest,) = gain_and(zero, (begin + top)[None])
        peak = jnp.max(jnp.abs(jnp.stack([left, right, highest])))
        return jnp.where(step > 0, peak, 0.0), gain, jnp.where(turns, turning, 0.0)

    if room is None:
        peaks, gains, turnings = jax.vmap(in_part)(*_parts(motion))
    else:
        parts = _parts_by_scale(motion, room)
        peaks, gains, turnings = jax.lax.map(lambda part: in_part(*part), parts, batch_size=_AT_A_TIME)
    velocity = jnp.cumsum(gains)
    before = jnp.concatenate([jnp.zeros_like(velocity[:1]), velocity[:-1]])
    fastest = jnp.maximum(jnp.max(jnp.abs(velocity)), jnp.max(jnp.abs(before + turnings)))
    return jnp.max(peaks), fastest * GRAVITY, velocity[-1] * GRAVITY, _wanted(motion)


def _wanted(motion: AbstractMotion) -> Array | None:
    """Return the least number of parts of all pieces together, if `_parts` are too few; else 0."""
    lengths, scales = jax.lax.stop_gradient((motion.lengths, motion.scales))
    if scales is None:
        return None
    wanted = _LEAST * lengths / scales
    total = wanted.sum()
    enough = jnp.max(wanted) <= _PARTS if lengths.size <= _FEW else total <= _PARTS * _FEW
    return jnp.where(enough, 0.0, total)


def _parts(motion: AbstractMotion) -> tuple[Array, Array, Array]:
    """The piece of every part, where in it the part begins, and how long it is [s].

    Of few pieces all have as many; of many those that are no straight line have as many as their curves ask for.
    """
    lengths = motion.lengths
    if lengths.size > _FEW and motion.scales is not None:
        return _parts_by_scale(motion, _PARTS * _FEW)
    count = _PARTS if lengths.size <= _FEW else 1
    piece, within = (jax.lax.broadcasted_iota(jnp.int32, (lengths.size, count), axis).ravel() for axis in (0, 1))
    step = lengths[piece] / count
    return piece, jnp.minimum(within * step, lengths[piece]), step


def _parts_by_scale(motion: AbstractMotion, room: int) -> tuple[Array, Array, Array]:
    """Return `_parts` by time scale: one for every piece, the others in proportion to its changes."""
    lengths, scales = motion.lengths, jnp.inf if motion.scales is None else motion.scales
    wanted = _PER_SCALE * lengths / scales
    counts = 1 + jnp.floor(wanted * jnp.minimum(1.0, room / jnp.maximum(wanted.sum(), 1.0))).astype(int)
    total = lengths.size + room  # those that are left over lie at the end, without a length
    piece = jnp.repeat(jnp.arange(lengths.size), counts, total_repeat_length=total)
    within = jnp.arange(total) - (jnp.cumsum(counts) - counts)[piece]
    step = lengths[piece] / counts[piece]
    return piece, jnp.minimum(within * step, lengths[piece]), jnp.where(within < counts[piece], step, 0.0)
