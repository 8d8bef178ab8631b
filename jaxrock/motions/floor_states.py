"""The states of a linear oscillator under a motion, exact to rounding, as functions of JAX.

With q = -omega^2 y/g [g] of the displacement y relative to the ground, and r = q'/omega, the equation is q' = omega r,
r' = omega (u - q - 2 damping r). Its matrix K solves K^2 = -1 - 2 damping K. So all its functions are a + b K: pairs of
numbers.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Inexact

from jaxrock._core.types import Real, Scalar
from jaxrock.compiler.hints import materialize, select
from jaxrock.numerics.elementary import sine_cosine_of_any

_TERMS = 20  # of the series of exponential integrals, up to an angle of 1


class OscillatorState(NamedTuple):
    """The state of an oscillator: q and r [g]."""

    place: Inexact[Array, "..."]
    speed: Inexact[Array, "..."]

    def __sub__(self, other: "OscillatorState") -> "OscillatorState":
        return OscillatorState(self.place - other.place, self.speed - other.speed)

    def plus(self, other: "OscillatorState") -> "OscillatorState":
        """Return the sum of two states."""
        return OscillatorState(self.place + other.place, self.speed + other.speed)


class MatrixFunction(NamedTuple):
    """A function a + b K of the matrix K."""

    a: Inexact[Array, "..."]
    b: Inexact[Array, "..."]

    def times(self, other: "MatrixFunction", damping: Scalar) -> "MatrixFunction":
        """Return the product with another one."""
        both = self.b * other.b
        return MatrixFunction(self.a * other.a - both, self.a * other.b + self.b * other.a - 2 * damping * both)

    def of(self, state: OscillatorState, damping: Scalar) -> OscillatorState:
        """Apply it to a state."""
        place, speed = state
        return OscillatorState(self.a * place + self.b * speed, self.a * speed - self.b * (place + 2 * damping * speed))


def free(angle: Inexact[Array, "..."], damping: Scalar) -> MatrixFunction:
    """Return the transition of a free oscillator over omega t = `angle`, e^(K angle)."""
    root = jnp.sqrt((1 - damping) * (1 + damping))
    sine, cosine = sine_cosine_of_any(root * angle)
    decay, lever = jnp.exp(-damping * angle), sine / root
    return MatrixFunction(decay * (cosine + damping * lever), decay * lever)


def under_line(
    angle: Inexact[Array, "..."], begin: Inexact[Array, "..."], end: Inexact[Array, "..."], damping: Scalar
) -> OscillatorState:
    """Return the state after omega t = `angle` from rest, under a straight line of acceleration.

    It is the integral of e^(K (angle - x)) (0, u(x)). It keeps its digits for small angles, where q is about
    angle^2/2 of the acceleration.
    """
    small = angle < 1
    near = select(small, angle, 0.5)
    power, factor = MatrixFunction(jnp.ones_like(near), jnp.zeros_like(near)), 1.0
    first, second = MatrixFunction(power.a, power.b), MatrixFunction(power.a / 2, power.b / 2)
    for k in range(1, _TERMS):
        power = MatrixFunction(-near * power.b, near * (power.a - 2 * damping * power.b))
        factor /= k + 1
        first = MatrixFunction(first.a + factor * power.a, first.b + factor * power.b)
        second = MatrixFunction(second.a + factor / (k + 2) * power.a, second.b + factor / (k + 2) * power.b)
    far = select(small, 2.0, angle)
    whole = free(far, damping)
    one = _divided(MatrixFunction(whole.a - 1, whole.b), far, damping)
    two = _divided(MatrixFunction(one.a - 1, one.b), far, damping)
    change = end - begin
    a, b = (
        angle * (select(small, p, f) * begin + select(small, q, g) * change)
        for p, f, q, g in zip(first, one, second, two)
    )
    return OscillatorState(b, a - 2 * damping * b)


def _divided(pair: MatrixFunction, angle: Inexact[Array, "..."], damping: Scalar) -> MatrixFunction:
    """Return a function of K over K angle; the inverse of K is -(K + 2 damping)."""
    return MatrixFunction((pair.b - 2 * damping * pair.a) / angle, -pair.a / angle)


def from_rest(angle: Real, terms: Sequence[Real], damping: Scalar) -> tuple[list, list]:
    """Return the Taylor coefficients of q and r of an oscillator that starts from rest.

    **Arguments:**

    - `angle`: omega times the unit of time. `terms`: Taylor coefficients of the acceleration [g].
    """
    places, speeds = [jnp.zeros_like(terms[0])], [jnp.zeros_like(terms[0])]
    for k, u in enumerate(terms):
        places_next = angle * speeds[k] * (1 / (k + 1))
        speeds_next = angle * (u - places[k] - 2 * damping * speeds[k]) * (1 / (k + 1))
        places.append(materialize(places_next, angle))
        speeds.append(materialize(speeds_next, angle))
    return places, speeds


def chained_states(transitions: MatrixFunction, gains: OscillatorState, damping: Scalar) -> OscillatorState:
    """Return the states before each of many stretches, and after the last one, of an oscillator that starts at rest.

    A state follows from the one before: transition, plus gain. Stretches of 2, 4, 8, ... are combined, all at once.
    """
    size = transitions.a.size

    def shifted(x, reach, fill):
        before = jnp.concatenate([jnp.full(size, fill, x.dtype), x])
        return jax.lax.dynamic_slice_in_dim(before, size - reach, size)

    def wider(k, both):
        transitions, gains = both
        reach = 1 << k
        before = MatrixFunction(shifted(transitions.a, reach, 1.0), shifted(transitions.b, reach, 0.0))
        earlier = OscillatorState(*(shifted(x, reach, 0.0) for x in gains))
        gained = transitions.of(earlier, damping)
        return transitions.times(before, damping), gains.plus(gained)

    _, ends = jax.lax.fori_loop(0, (size - 1).bit_length(), wider, (transitions, gains))
    return OscillatorState(*(jnp.concatenate([jnp.zeros_like(x[:1]), x]) for x in ends))


def ringing_amplitude(
    place: Inexact[Array, "..."], slope: Inexact[Array, "..."], damping: Scalar
) -> Inexact[Array, "..."]:
    """Return the amplitude c of a free oscillation, |x| <= c e^(-damping omega t), from x and x'/omega."""
    lever = (slope + damping * place) / jnp.sqrt((1 - damping) * (1 + damping))
    return jnp.sqrt(jnp.maximum(place**2 + lever**2, jnp.finfo(place.dtype).tiny))
