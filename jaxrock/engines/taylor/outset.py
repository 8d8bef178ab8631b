"""What is known of a step beforehand: its first signs, from where on events may come, how fast the block may be."""

import jax.numpy as jnp
from jaxtyping import Array, Inexact

from jaxrock.engines.state import State
from jaxrock.numerics.choice import where
from jaxrock.numerics.polynomial import fall_bound

Scalar = Inexact[Array, ""]


def first_sign(value: Scalar, following: Scalar) -> Scalar:
    """Sign with which a value starts; where it is zero, that of its derivative."""
    return where(value != 0, jnp.sign(value), where(following < 0, -1.0, 1.0))


def unbalanced(coefficients: list[Scalar]) -> list[Scalar]:
    """The series of a block whose acceleration cancels to nothing: it goes, by far less than rounding, where the change
    of the acceleration takes it. Where it stands still, too, every event would be at once."""
    second, third = coefficients[2:4]
    nearly_nothing = float(jnp.finfo(third.dtype).eps) ** 2 * third
    return [*coefficients[:2], where(second == 0, nearly_nothing, second), *coefficients[3:]]


def signs_at_start(state: State, coefficients) -> tuple[Scalar, Scalar]:
    """Signs with which velocity and acceleration start."""
    velocity = where(state.uplifting, 1.0, first_sign(state.velocity, coefficients[2]))
    acceleration = first_sign(where(state.extremal, 0.0, coefficients[2]), coefficients[3])
    return velocity, where(state.uplifting, 1.0, acceleration)


def overshoot(coefficients: list[Scalar], length: Scalar) -> Scalar:
    """How far the velocity can exceed its end values within a step (an eighth of its largest second derivative)."""
    one = jnp.ones_like(length)
    third = jnp.maximum(fall_bound(coefficients, one, 3, length), fall_bound(coefficients, -one, 3, length))
    return third * length**2 / 8


def clear_start(state: State, scaled: list[Scalar], saddle: Scalar) -> Scalar:
    """From where to look for events: a block that leaves rest has opening, velocity and (continuous motion)
    acceleration zero at its start, and all three are positive up to here."""
    one, zero = jnp.ones_like(saddle), jnp.zeros_like(saddle)
    lead = where(state.uplifting, 3 * scaled[3], scaled[2])
    rest = [zero, zero, zero, where(state.uplifting, 0.0, scaled[3]), *scaled[4:]]
    tiny = jnp.finfo(saddle.dtype).tiny
    clear = jnp.clip(lead / jnp.maximum(fall_bound(rest, one, 2), tiny), 0.0, 0.5)
    below_saddle = jnp.sqrt(saddle / (4 * sum(jnp.abs(c) for c in scaled) + tiny))
    leaving = (state.opening == 0) & (state.velocity == 0)
    return where(leaving, jnp.minimum(clear, below_saddle), 0.0)
