"""Intensity measures of ground motions: peak acceleration and peak velocity."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Inexact

from jaxrock._arguments import arguments
from jaxrock._parameters import check_single
from jaxrock.blocks.rigid import GRAVITY
from jaxrock.motions.motion import AbstractMotion
from jaxrock.numerics.gauss_legendre import gauss_legendre

_NODES, _WEIGHTS = gauss_legendre(6)
_PARTS = 256  # of every smooth piece, where there are few
_FEW = 32


@arguments
def peak_acceleration(motion: AbstractMotion) -> Inexact[Array, ""]:
    """Peak ground acceleration (PGA) [g].

    **Arguments:**

    - `motion`: a motion of scalar parameters (use `jax.vmap` for many).

    **Returns:** the largest |acceleration|: exact for records and straight lines, to about 1e-9 for smooth pulses.
    """
    check_single(motion=motion)
    return _peaks(motion)[0]


@arguments
def peak_velocity(motion: AbstractMotion) -> Inexact[Array, ""]:
    """Peak ground velocity (PGV) [m/s], of a ground that is at rest at first, under 9.81 m/s^2.

    **Arguments:**

    - `motion`: as in `peak_acceleration`; a record should have been corrected so that its velocity ends near zero.

    **Returns:** the largest |velocity|: exact for records and straight lines, to about 1e-9 for smooth pulses.
    """
    check_single(motion=motion)
    return _peaks(motion)[1]


@jax.jit
def _peaks(motion: AbstractMotion):
    """Peaks of acceleration [g] and velocity [m/s].

    Every piece is cut into parts. Velocity is integrated over each by Gauss and Legendre, and to where the acceleration
    passes zero in it; the largest acceleration at an end of a part is followed to the top beside it.
    """
    knots = motion.knots
    nodes, weights = (jnp.asarray(values, knots.dtype) for values in (_NODES, _WEIGHTS))
    parts = _PARTS if knots.size - 1 <= _FEW else 1

    def in_piece(piece, length):
        step = length / parts

        def jet(local):
            """Acceleration and its first two derivatives."""
            terms = motion.series(piece, jnp.clip(local, 0.0, length), jnp.ones_like(length), 2)
            terms = [*terms, *[jnp.zeros_like(terms[0])] * (3 - len(terms))]
            return terms[0], terms[1], 2 * terms[2]

        def gain(begin, width):
            """Velocity that is gained."""
            values = jax.vmap(lambda node: jet(begin + width * (1 + node) / 2)[0])(nodes)
            return values @ weights * width / 2

        begins = step * jnp.arange(parts)
        ends = jax.vmap(lambda local: jet(local)[0])(step * jnp.arange(parts + 1))
        left, right = ends[:-1], ends[1:]
        turns = left * right < 0
        place = step * jnp.where(turns, left / jnp.where(turns, left - right, 1.0), 0.0)

        def to_zero(begin, place):
            for _ in range(3):
                value, slope, _ = jet(begin + place)
                place = jnp.clip(place - value / jnp.where(slope == 0, jnp.inf, slope), 0.0, step)
            return gain(begin, place)

        turning = jnp.where(turns, jax.vmap(to_zero)(begins, place), 0.0)
        top = step * jnp.argmax(jnp.abs(ends))
        for _ in range(3):
            _, slope, bend = jet(top)
            move = -slope / jnp.where(bend == 0, jnp.inf, bend)
            top = top + jnp.where(jnp.abs(move) <= step, move, 0.0)
        peak = jnp.maximum(jnp.max(jnp.abs(ends)), jnp.abs(jet(top)[0]))
        return peak, jax.vmap(gain, (0, None))(begins, step), turning

    peaks, gains, turnings = jax.vmap(in_piece)(jnp.arange(knots.size - 1), motion.lengths)
    velocity = jnp.cumsum(gains.ravel())
    before = jnp.concatenate([jnp.zeros_like(velocity[:1]), velocity[:-1]])
    fastest = jnp.maximum(jnp.max(jnp.abs(velocity)), jnp.max(jnp.abs(before + turnings.ravel())))
    return jnp.max(peaks), fastest * GRAVITY
