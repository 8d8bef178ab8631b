"""The largest acceleration and velocity of a motion, as functions of JAX."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrock._core.arrays import is_traced
from jaxrock._core.types import Scalar
from jaxrock.blocks.rigid import GRAVITY
from jaxrock.compiler import checks
from jaxrock.compiler.hints import jit_low_effort
from jaxrock.motions.floors import with_solved_floors
from jaxrock.motions.motion import AbstractMotion
from jaxrock.motions.record import with_room
from jaxrock.numerics.gauss_legendre import gauss_legendre

_NODES, _WEIGHTS = gauss_legendre(6)
_FEW = 32  # pieces; more count as many
_PARTS = 256  # parts of every piece, where there are few pieces
_PER_SCALE = 8  # parts per time scale of the acceleration, where there are many pieces
_LEAST = 2  # least number of parts per time scale: still exact to 1e-9
_MOST = 1 << 20  # largest number of parts of a known motion
_AT_A_TIME = 8192  # parts in one batch
_NEWTON = 3  # Newton steps to a zero or an extremum: each doubles the number of correct digits


def peaks_of_motion(motion: AbstractMotion) -> tuple[Scalar, Scalar]:
    """Return `intensity.peak_acceleration` [g] and `peak_velocity` [m/s] together, without a warning of baseline
    drift.
    """
    return peaks_and_last_velocity(motion)[:2]


def peaks_and_last_velocity(motion: AbstractMotion) -> tuple[Scalar, Scalar, Scalar]:
    """Return the peaks of acceleration [g] and velocity [m/s], and the last velocity [m/s].

    Records are padded, so that a few compiled programs serve records of any length.

    **Raises:** ValueError for a motion of too many cycles within its pieces; the limit is lower under tracing.
    """
    motion = with_room(motion)
    return _fine_enough(motion, _peaks_of)


def peaks_of_many(motions: AbstractMotion, choose: Callable, count: int) -> tuple[Array, Array]:
    """Return `peaks_of_motion` of every `choose(motions, index)`, by one compiled program."""

    def peaks(motions, room):
        return jax.vmap(lambda index: _peaks_of(choose(motions, index), room))(jnp.arange(count))

    return _fine_enough(motions, peaks)[:2]


def _fine_enough(motion: Any, peaks: Callable) -> tuple:
    """Return the results of `peaks(motion, room)` with the default number of parts, or with more where needed."""
    *found, wanted = peaks(motion, None)
    if wanted is None:
        return tuple(found)
    if is_traced(wanted):
        message = "Argument `motion` must have at most 20 cycles within a piece where it is traced"
        return checks.error_if(tuple(found), jnp.any(wanted > 0), message)
    most = float(np.max(np.asarray(wanted)))
    if not most > 0:  # also for NaN
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


@jit_low_effort(static_argnums=1)
def _peaks_of(motion: AbstractMotion, room: int | None):
    """Return the peaks of acceleration [g] and velocity [m/s], the last velocity, and the number of parts needed.

    That number is 0 if the parts suffice, None if they always do. Every piece is cut into parts. Gauss-Legendre
    quadrature integrates the acceleration over each part, and up to its zero in the part. Newton's method finds the
    extremum of the acceleration near the larger end of each part.
    """
    motion = with_solved_floors(motion)
    kind = motion.knots.dtype
    nodes, weights = (jnp.asarray(values, kind) / 2 for values in (_NODES, _WEIGHTS))
    lengths = motion.lengths

    def in_part(piece, begin, step):
        @jax.vmap
        def jets(local):
            """Return the acceleration and its first two derivatives at some times."""
            terms = motion.series(piece, jnp.clip(local, 0.0, lengths[piece]), jnp.ones_like(local), 2)
            terms = [*terms, *[jnp.zeros_like(terms[0])] * (3 - len(terms))]
            return terms[0], terms[1], 2 * terms[2]

        def gain_and(width, others):
            """Return the velocity gained within `width` of the part, and the acceleration at other times."""
            values = jets(jnp.concatenate([begin + width * (0.5 + nodes), others]))[0]
            return values[: nodes.size] @ weights * width, values[nodes.size :]

        gain, (left, right) = gain_and(step, jnp.stack([begin, begin + step]))
        turns = jnp.sign(left) * jnp.sign(right) < 0  # the product of two tiny values could underflow to zero
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
    """Return the number of parts needed for all pieces together, if `_parts` gives too few; else 0."""
    lengths, scales = jax.lax.stop_gradient((motion.lengths, motion.scales))
    if scales is None:
        return None
    wanted = _LEAST * lengths / scales
    total = wanted.sum()
    enough = jnp.max(wanted) <= _PARTS if lengths.size <= _FEW else total <= _PARTS * _FEW
    return jnp.where(enough, 0.0, total)


def _parts(motion: AbstractMotion) -> tuple[Array, Array, Array]:
    """Return the piece of every part, the begin of the part within it, and the length of the part [s].

    Few pieces get equally many parts each. Among many pieces, a straight line is one part, and others get parts by
    their time scale.
    """
    lengths = motion.lengths
    if lengths.size > _FEW and motion.scales is not None:
        return _parts_by_scale(motion, _PARTS * _FEW)
    count = _PARTS if lengths.size <= _FEW else 1
    piece, within = (jax.lax.broadcasted_iota(jnp.int32, (lengths.size, count), axis).ravel() for axis in (0, 1))
    step = lengths[piece] / count
    return piece, jnp.minimum(within * step, lengths[piece]), step


def _parts_by_scale(motion: AbstractMotion, room: int) -> tuple[Array, Array, Array]:
    """Return `_parts` by time scale: one for every piece, the others in proportion to length over time scale."""
    lengths, scales = motion.lengths, jnp.inf if motion.scales is None else motion.scales
    wanted = _PER_SCALE * lengths / scales
    counts = 1 + jnp.floor(wanted * jnp.minimum(1.0, room / jnp.maximum(wanted.sum(), 1.0))).astype(int)
    total = lengths.size + room  # unused parts lie at the end and have no length
    piece = jnp.repeat(jnp.arange(lengths.size), counts, total_repeat_length=total)
    within = jnp.arange(total) - (jnp.cumsum(counts) - counts)[piece]
    step = lengths[piece] / counts[piece]
    return piece, jnp.minimum(within * step, lengths[piece]), jnp.where(within < counts[piece], step, 0.0)
