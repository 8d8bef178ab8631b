"""Single-lobe pulses: rectangle, triangle, and the exponential family that holds both."""

import math

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Int

from jaxrock._arguments.parameters import parameter, set_parameters
from jaxrock._arguments.ranges import not_nan, size, strength, with_throw
from jaxrock._core.types import Real
from jaxrock.compiler.hints import select
from jaxrock.motions.pulses.pulse import AbstractPulse, Piece, one_piece
from jaxrock.numerics.lookup import take
from jaxrock.numerics.polynomial import horner


class RectangularPulse(AbstractPulse):
    """Constant `amplitude` [g] for `duration` [s] (positive): the limit shape -> -inf of `ExponentialPulse`."""

    amplitude: Real = parameter("g", strength, symbol="a_g")
    duration: Real = parameter("s", size, symbol="t_d")

    @classmethod
    def word(cls) -> str:
        """Return the command line's word for it."""
        return "rectangle"

    @with_throw
    def __init__(self, amplitude: ArrayLike, duration: ArrayLike, *, throw: bool = True):
        set_parameters(self, amplitude=amplitude, duration=duration)

    @property
    def knots(self) -> Real:
        return one_piece(self.duration)

    @property
    def scales(self) -> Real:
        return jnp.full_like(self.knots[1:], jnp.inf)

    @property
    def bounds(self) -> Real:
        return jnp.abs(self.amplitude)[None]

    def series(self, piece: Piece, local: Real, unit: Real, order: int) -> list[Real]:
        return [self.amplitude + 0.0 * local]


class TriangularPulse(AbstractPulse):
    """Straight up to `amplitude` [g] at mid `duration` [s] and straight down: shape 0 of `ExponentialPulse`."""

    amplitude: Real = parameter("g", strength, symbol="a_g")
    duration: Real = parameter("s", size, symbol="t_d")

    @classmethod
    def word(cls) -> str:
        """Return the command line's word for it."""
        return "triangle"

    @with_throw
    def __init__(self, amplitude: ArrayLike, duration: ArrayLike, *, throw: bool = True):
        set_parameters(self, amplitude=amplitude, duration=duration)

    @property
    def knots(self) -> Real:
        return jnp.stack([jnp.zeros_like(self.duration), self.duration / 2, self.duration])

    @property
    def scales(self) -> Real:
        return jnp.full_like(self.knots[1:], jnp.inf)

    @property
    def bounds(self) -> Real:
        return jnp.stack([jnp.abs(self.amplitude)] * 2)

    def series(self, piece: Piece, local: Real, unit: Real, order: int) -> list[Real]:
        slope = 2 * self.amplitude / self.duration
        rising = piece == 0
        value = select(rising, slope * local, self.amplitude - slope * local)
        return [value, select(rising, slope, -slope) * unit][: order + 1]


def _growth_ratio(x: Real) -> Real:
    """Return (e^x - 1)/x for x <= 0, smooth through 0."""
    small = jnp.abs(x) < 1e-2
    far = select(small, -1.0, x)
    near = horner([jnp.full_like(x, 1 / math.factorial(k + 1)) for k in range(7)], x)
    return select(small, near, jnp.expm1(far) / far)


class ExponentialPulse(AbstractPulse):
    """The single-lobe pulse family that runs from rectangle through triangle to spike.

    With x = time/duration, u = amplitude (1 - e^(2 shape x))/(1 - e^shape) up to x = 1/2, then mirrored.

    **Arguments:**

    - `amplitude`: peak acceleration [g]; positive drives negative rotation.
    - `duration`: [s], positive.
    - `shape`: from -inf (rectangle) through 0 (triangle) to +inf (spike, which moves nothing).

    Smooth and differentiable in all three, also at shape 0. **Raises:** ValueError for a
    duration that is not positive, or NaN.

    **Source:** Voyagaki, Psycharis & Mylonakis (2012), equation 2.1, with the opposite sign of the motion.
    """

    amplitude: Real = parameter("g", strength, symbol="a_g")
    duration: Real = parameter("s", size, symbol="t_d")
    shape: Real = parameter("-", not_nan, symbol="beta")

    @with_throw
    def __init__(self, amplitude: ArrayLike, duration: ArrayLike, shape: ArrayLike, *, throw: bool = True):
        set_parameters(self, amplitude=amplitude, duration=duration, shape=shape)

    @property
    def _layer(self) -> Real:
        """Part of the duration in which the exponential is not yet negligible (e^-40), at most one half.

        Outside the layers the pulse is constant to rounding. The layers are separate pieces, so that a pulse of any
        shape costs a bounded number of steps.
        """
        return 20.0 / jnp.maximum(jnp.abs(self.shape), 40.0)

    @property
    def knots(self) -> Real:
        # The layers of a rectangle-like pulse lie at both ends; those of a spike on both sides of the peak.
        inner = select(self.shape > 0, 0.5 - self._layer, self._layer)
        zero = jnp.zeros_like(inner)
        return self.duration * jnp.stack([zero, inner, zero + 0.5, 1 - inner, zero + 1])

    def _curved(self, piece: Int[Array, "..."]) -> Bool[Array, "..."]:
        """Return whether a piece is a layer; a layer thinner than rounding counts as none."""
        middle = (piece == 1) | (piece == 2)
        in_layer = select(self.shape > 0, middle, ~middle)
        return in_layer & (jnp.abs(self.shape) < 1e24)

    @property
    def scales(self) -> Real:
        scale = self.duration / jnp.clip(2 * jnp.abs(self.shape), 1e-3, 1e25)
        return select(self._curved(jnp.arange(4)), scale, jnp.inf)

    @property
    def bounds(self) -> Real:
        size = jnp.abs(self.amplitude)
        outer = select(self.shape > 40, 0.0, size)
        return jnp.stack([outer, size, size, outer])

    def series(self, piece: Piece, local: Real, unit: Real, order: int) -> list[Real]:
        shape = jnp.clip(self.shape, -1e25, 1e25)
        rate = 1 / self.duration  # loop-invariant: computed once
        layer, y = self._layer, local * rate
        spiked = shape > 0
        down, up = select(spiked, 0.0, shape), select(spiked, shape, 0.0)
        # Distance from the nearer foot and from the peak, each without cancellation where it matters.
        foot = take(jnp.stack([y, layer + y, 0.5 - y, layer - y]), piece)
        peak = take(jnp.stack([0.5 - y, layer - y, y, layer + y]), piece)
        per_down, per_up = 1 / _growth_ratio(down), 1 / _growth_ratio(-up)
        fall = jnp.exp(2 * down * foot) * per_down
        rise = jnp.exp(-2 * up * peak) * per_up
        value_down = 2 * foot * _growth_ratio(2 * down * foot) * per_down
        value_up = (1 - 2 * peak) * rise * _growth_ratio(up * (2 * peak - 1))
        # Far from its peak a spike is zero to rounding; between its layers a rectangle is one.
        flat, middle = layer < 0.5, (piece == 1) | (piece == 2)
        value_up = select(~middle & flat, 0.0, value_up)
        value_down = select(middle & flat, 1.0, value_down)
        direction = select(piece < 2, 1.0, -1.0)
        step = direction * unit * rate
        terms = [self.amplitude * select(spiked, value_up, value_down)]
        term = self.amplitude * 2 * select(spiked, rise, fall) * step
        term, ratio = select(self._curved(piece), term, 0.0), 2 * shape * step
        for k in range(1, order + 1):
            terms.append(term)
            term = term * ratio * (1 / (k + 1))
        return terms
