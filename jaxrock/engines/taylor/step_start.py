"""Properties of a step from its first terms: initial signs, the start of the search for events, bounds of the
velocity."""

import jax.numpy as jnp

from jaxrock._core.types import Scalar
from jaxrock.compiler.hints import select
from jaxrock.engines.state import State
from jaxrock.numerics.polynomial import fall_bound


def first_sign(value: Scalar, following: Scalar) -> Scalar:
    """Return the initial sign of a value; where it is zero, that of its derivative."""
    return select(value != 0, jnp.sign(value), select(following < 0, -1.0, 1.0))


def unbalanced(coefficients: list[Scalar]) -> list[Scalar]:
    """Return the series of a block whose acceleration cancels to zero, with one far below rounding in the direction of
    the jerk. With all zeros, every event of a block that stands still would happen at once."""
    second, third = coefficients[2:4]
    nearly_nothing = float(jnp.finfo(third.dtype).eps) ** 2 * third
    return [*coefficients[:2], select(second == 0, nearly_nothing, second), *coefficients[3:]]


def signs_at_start(state: State, coefficients) -> tuple[Scalar, Scalar]:
    """Return the initial signs of velocity and acceleration."""
    velocity = select(state.uplifting, 1.0, first_sign(state.velocity, coefficients[2]))
    acceleration = first_sign(select(state.extremal, 0.0, coefficients[2]), coefficients[3])
    return velocity, select(state.uplifting, 1.0, acceleration)


def overshoot(coefficients: list[Scalar], length: Scalar) -> Scalar:
    """Bound how far the velocity can exceed its end values within a step: an eighth of its largest second derivative
    times length^2."""
    one = jnp.ones_like(length)
    third = jnp.maximum(fall_bound(coefficients, one, 3, length), fall_bound(coefficients, -one, 3, length))
    return third * length**2 / 8


def clear_start(state: State, scaled: list[Scalar], saddle: Scalar) -> Scalar:
    """Return the time from which to search for events.

    A block that leaves rest starts with zero opening, velocity and (continuous motion) acceleration; all three are
    positive up to this time.
    """
    one, zero = jnp.ones_like(saddle), jnp.zeros_like(saddle)
    lead = select(state.uplifting, 3 * scaled[3], scaled[2])
    rest = [zero, zero, zero, select(state.uplifting, 0.0, scaled[3]), *scaled[4:]]
    tiny = jnp.finfo(saddle.dtype).tiny
    clear = jnp.clip(lead / jnp.maximum(fall_bound(rest, one, 2), tiny), 0.0, 0.5)
    below_saddle = jnp.sqrt(saddle / (4 * sum(jnp.abs(c) for c in scaled) + tiny))
    leaving = (state.opening == 0) & (state.velocity == 0)
    return select(leaving, jnp.minimum(clear, below_saddle), 0.0)
