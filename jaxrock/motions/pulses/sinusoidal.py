"""Pulses that are parts of a sinusoid: half a sine, one cycle of a sine or cosine."""

import math

import jax.numpy as jnp
from jaxtyping import ArrayLike

from jaxrock._arguments.parameters import parameter, set_parameters
from jaxrock._arguments.ranges import size, strength, with_throw
from jaxrock._core.types import Real
from jaxrock.compiler.hints import materialize
from jaxrock.motions.pulses.pulse import AbstractPulse, Piece, one_piece
from jaxrock.numerics.elementary import sine_cosine_of_any


def sinusoid(amplitude: Real, rate: Real, angle: Real, unit: Real, order: int, local: Real) -> list[Real]:
    """Return Taylor coefficients of amplitude sin(angle + rate (time - local)) in time/unit, from u'' = -rate^2 u."""
    sine, cosine = sine_cosine_of_any(angle)
    return harmonic(
        materialize(amplitude * sine, local), materialize(amplitude * cosine, local) * rate * unit, rate * unit, order
    )


def harmonic(value: Real, slope: Real, rate: Real, order: int) -> list[Real]:
    """Return Taylor coefficients of the solution of u'' = -rate^2 u with the given value and slope."""
    terms, square = [value, slope], rate**2
    for k in range(order - 1):
        terms.append(square * terms[k] * (-1 / ((k + 1) * (k + 2))))
    return terms[: order + 1]


class HalfSinePulse(AbstractPulse):
    """amplitude sin(pi t/duration) [g] for `duration` [s] (positive)."""

    amplitude: Real = parameter("g", strength, symbol="a_g")
    duration: Real = parameter("s", size, symbol="t_d")

    @with_throw
    def __init__(self, amplitude: ArrayLike, duration: ArrayLike, *, throw: bool = True):
        set_parameters(self, amplitude=amplitude, duration=duration)

    @property
    def knots(self) -> Real:
        return one_piece(self.duration)

    @property
    def scales(self) -> Real:
        return (self.duration / math.pi)[None]

    @property
    def bounds(self) -> Real:
        return jnp.abs(self.amplitude)[None]

    def series(self, piece: Piece, local: Real, unit: Real, order: int) -> list[Real]:
        rate = math.pi / self.duration
        return sinusoid(self.amplitude, rate, rate * local, unit, order, local)


class _OneCycle(AbstractPulse):
    """One full cycle of a sinusoid."""

    amplitude: Real = parameter("g", strength, symbol="a_g")
    period: Real = parameter("s", size, symbol="T")

    @with_throw
    def __init__(self, amplitude: ArrayLike, period: ArrayLike, *, throw: bool = True):
        set_parameters(self, amplitude=amplitude, period=period)

    @property
    def knots(self) -> Real:
        return one_piece(self.period)

    @property
    def scales(self) -> Real:
        return (self.period / (2 * math.pi))[None]

    @property
    def bounds(self) -> Real:
        return jnp.abs(self.amplitude)[None]


class SinePulse(_OneCycle):
    """One full cycle of amplitude sin(2 pi t/period) [g], `period` in s, positive (D&D 2012, 3.2)."""

    __init__ = _OneCycle.__init__  # repeated for type checkers, which would derive one from the fields

    def series(self, piece: Piece, local: Real, unit: Real, order: int) -> list[Real]:
        rate = 2 * math.pi / self.period
        return sinusoid(self.amplitude, rate, rate * local, unit, order, local)


class CosinePulse(_OneCycle):
    """One full cycle of amplitude cos(2 pi t/period) [g], `period` in s, positive: it starts and ends with a jump."""

    __init__ = _OneCycle.__init__

    def series(self, piece: Piece, local: Real, unit: Real, order: int) -> list[Real]:
        rate = 2 * math.pi / self.period
        sine, cosine = sine_cosine_of_any(rate * local)
        value, slope = (
            materialize(self.amplitude * cosine, local),
            materialize(-self.amplitude * sine, local) * rate * unit,
        )
        return harmonic(value, slope, rate * unit, order)
