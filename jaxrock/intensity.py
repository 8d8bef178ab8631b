"""Intensity measures of ground motions: peak acceleration and peak velocity."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Inexact

from jaxrock.block import GRAVITY
from jaxrock.motion import AbstractMotion

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(6)
_PARTS = 256  # of every smooth piece, where there are few
_FEW = 32


def peak_acceleration(motion: AbstractMotion) -> Inexact[Array, ""]:
    """Peak ground acceleration (PGA) [g].

    **Arguments:**

    - `motion`: a motion of scalar parameters (use `jax.vmap` for many).

    **Returns:** the largest |acceleration|: exact for records and straight lines, to about 1e-9 for smooth pulses.
    """
    return _peaks(motion)[0]


def peak_velocity(motion: AbstractMotion) -> Inexact[Array, ""]:
    """Peak ground velocity (PGV) [m/s], of a ground that is at rest at first, under 9.81 m/s^2.

    **Arguments:**

    - `motion`: as in `peak_acceleration`; a record should have been corrected so that its velocity ends near zero.

    **Returns:** the largest |velocity|: exact for records and straight lines, to about 1e-9 for smooth pulses.
    """
    return _peaks(motion)[1]


@jax.jit
def _peaks(motion: AbstractMotion):
    """Peaks of acceleration [g] and velocity [m/s].

    Every piece is cut into parts, in which the acceleration is integrated by Gauss and Legendre; between ends, extrema
    are those of the parabola (acceleration) and of the straight line whose integral is taken (velocity).
    """
    knots = motion.knots
    parts = _PARTS if knots.size - 1 <= _FEW else 1
    lengths = jnp.diff(knots)
    shares = jnp.concatenate([(jnp.arange(parts)[:, None] + (1 + _NODES) / 2).ravel(), jnp.arange(parts + 1.0)]) / parts

    def in_piece(piece, length):
        def at(share):
            return motion.series(piece, share * length, jnp.ones_like(length), 0)[0]

        values = jax.vmap(at)(shares)
        inner, ends = values[: -parts - 1].reshape(parts, -1), values[-parts - 1 :]
        return inner @ (_WEIGHTS / 2) * length / parts, ends

    gains, ends = jax.vmap(in_piece)(jnp.arange(lengths.size), lengths)
    step = (lengths / parts)[:, None]
    velocity = jnp.cumsum(gains.ravel())
    before = jnp.concatenate([jnp.zeros_like(velocity[:1]), velocity[:-1]]).reshape(gains.shape)
    left, right = ends[:, :-1], ends[:, 1:]
    # The velocity turns where the acceleration passes zero.
    turns = left * right < 0
    share = jnp.where(turns, left / jnp.where(turns, left - right, 1.0), 0.0)
    turning = before + left * share * step / 2
    fastest = jnp.maximum(jnp.max(jnp.abs(velocity)), jnp.max(jnp.abs(turning)))
    return jnp.maximum(jnp.max(jnp.abs(ends)), _between(ends)), fastest * GRAVITY


def _between(ends):
    """Largest size of a smooth curve between equally spaced values: at the top of a parabola through three of them."""
    if ends.shape[1] < 3:
        return jnp.zeros((), ends.dtype)
    size = jnp.abs(ends)
    low, top, high = size[:, :-2], size[:, 1:-1], size[:, 2:]
    bend = 2 * top - low - high
    peaked = (top >= low) & (top >= high) & (bend > 0) & (jnp.sign(ends[:, :-2]) == jnp.sign(ends[:, 2:]))
    rise = (high - low) ** 2 / jnp.where(peaked, 8 * bend, 1.0)
    return jnp.max(jnp.where(peaked, top + rise, 0.0))
