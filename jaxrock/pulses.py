"""Pulses: smooth shapes with an amplitude [g] and a duration or period [s], starting at time 0."""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Inexact, Int

from jaxrock._checks import checked, finite, not_nan, one_of, positive
from jaxrock._keep import keep
from jaxrock._pick import pick
from jaxrock._trigonometry import sine_cosine_of_any
from jaxrock.motion import AbstractMotion

Real = Inexact[Array, "..."]


def _one_piece(end: Real) -> Real:
    """Knots of a motion that is smooth from 0 to `end`."""
    return jnp.stack([jnp.zeros_like(end), end])


def _sinusoid(amplitude: Real, rate: Real, angle: Real, unit: Real, order: int, local: Real) -> list[Real]:
    """Taylor coefficients of amplitude sin(angle + rate (time - local)) in time/unit, from u'' = -rate^2 u."""
    sine, cosine = sine_cosine_of_any(angle)
    return _harmonic(keep(amplitude * sine, local), keep(amplitude * cosine, local) * rate * unit, rate * unit, order)


def _harmonic(value: Real, slope: Real, rate: Real, order: int) -> list[Real]:
    """Taylor coefficients of the solution of u'' = -rate^2 u with the given value and slope."""
    terms, square = [value, slope], rate**2
    for k in range(order - 1):
        terms.append(square * terms[k] * (-1 / ((k + 1) * (k + 2))))
    return terms[: order + 1]


class AbstractPulse(AbstractMotion):
    """A motion that is proportional to its `amplitude` [g]."""

    amplitude: eqx.AbstractVar[Real]


class RectangularPulse(AbstractPulse):
    """Constant `amplitude` [g] for `duration` [s] (positive): the limit shape -> -inf of `ExponentialPulse`."""

    amplitude: Real
    duration: Real

    def __init__(self, amplitude: ArrayLike, duration: ArrayLike):
        self.amplitude = finite("amplitude", amplitude)
        self.duration = positive("duration", duration)

    @property
    def knots(self):
        return _one_piece(self.duration)

    @property
    def scales(self):
        return jnp.full_like(self.knots[1:], jnp.inf)

    @property
    def bounds(self):
        return jnp.abs(self.amplitude)[None]

    def series(self, piece, local, unit, order):
        return [self.amplitude + 0.0 * local]


class TriangularPulse(AbstractPulse):
    """Straight up to `amplitude` [g] at mid `duration` [s] and straight down: shape 0 of `ExponentialPulse`."""

    amplitude: Real
    duration: Real

    def __init__(self, amplitude: ArrayLike, duration: ArrayLike):
        self.amplitude = finite("amplitude", amplitude)
        self.duration = positive("duration", duration)

    @property
    def knots(self):
        return jnp.stack([jnp.zeros_like(self.duration), self.duration / 2, self.duration])

    @property
    def scales(self):
        return jnp.full_like(self.knots[1:], jnp.inf)

    @property
    def bounds(self):
        return jnp.stack([jnp.abs(self.amplitude)] * 2)

    def series(self, piece, local, unit, order):
        slope = 2 * self.amplitude / self.duration
        rising = piece == 0
        value = jnp.where(rising, slope * local, self.amplitude - slope * local)
        return [value, jnp.where(rising, slope, -slope) * unit][: order + 1]


def _growth_ratio(x: Real) -> Real:
    """(e^x - 1)/x for x <= 0, smooth through 0."""
    small = jnp.abs(x) < 1e-2
    far = jnp.where(small, -1.0, x)
    near = 1 + x / 2 * (1 + x / 3 * (1 + x / 4 * (1 + x / 5 * (1 + x / 6 * (1 + x / 7)))))
    return jnp.where(small, near, jnp.expm1(far) / far)


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

    amplitude: Real
    duration: Real
    shape: Real

    def __init__(self, amplitude: ArrayLike, duration: ArrayLike, shape: ArrayLike):
        self.amplitude = finite("amplitude", amplitude)
        self.duration = positive("duration", duration)
        self.shape = not_nan("shape", shape)

    @property
    def _layer(self) -> Real:
        """Part of the duration in which the exponential is not yet negligible (e^-40), at most one half.

        Outside the layers the pulse is constant to rounding. They get pieces of their own, so that a
        pulse of any shape costs a bounded number of steps.
        """
        return 20.0 / jnp.maximum(jnp.abs(self.shape), 40.0)

    @property
    def knots(self):
        # The layers of a rectangle-like pulse lie at both ends; those of a spike on both sides of the peak.
        inner = jnp.where(self.shape > 0, 0.5 - self._layer, self._layer)
        zero = jnp.zeros_like(inner)
        return self.duration * jnp.stack([zero, inner, zero + 0.5, 1 - inner, zero + 1])

    def _curved(self, piece: Int[Array, "..."]) -> Bool[Array, "..."]:
        """Whether a piece is a layer; one thinner than rounding is left out."""
        middle = (piece == 1) | (piece == 2)
        in_layer = jnp.where(self.shape > 0, middle, ~middle)
        return in_layer & (jnp.abs(self.shape) < 1e24)

    @property
    def scales(self):
        scale = self.duration / jnp.clip(2 * jnp.abs(self.shape), 1e-3, 1e25)
        return jnp.where(self._curved(jnp.arange(4)), scale, jnp.inf)

    @property
    def bounds(self):
        size = jnp.abs(self.amplitude)
        outer = jnp.where(self.shape > 40, 0.0, size)
        return jnp.stack([outer, size, size, outer])

    def series(self, piece, local, unit, order):
        shape = jnp.clip(self.shape, -1e25, 1e25)
        layer, y = self._layer, local / self.duration
        spiked = shape > 0
        down, up = jnp.where(spiked, 0.0, shape), jnp.where(spiked, shape, 0.0)
        # Distance from the nearer foot and from the peak, each without cancellation where it matters.
        foot = pick(jnp.stack([y, layer + y, 0.5 - y, layer - y]), piece)
        peak = pick(jnp.stack([0.5 - y, layer - y, y, layer + y]), piece)
        fall = jnp.exp(2 * down * foot) / _growth_ratio(down)
        rise = jnp.exp(-2 * up * peak) / _growth_ratio(-up)
        value_down = 2 * foot * _growth_ratio(2 * down * foot) / _growth_ratio(down)
        value_up = (1 - 2 * peak) * rise * _growth_ratio(up * (2 * peak - 1))
        # Far from its peak a spike is zero to rounding; between its layers a rectangle is one.
        flat, middle = layer < 0.5, (piece == 1) | (piece == 2)
        value_up = jnp.where(~middle & flat, 0.0, value_up)
        value_down = jnp.where(middle & flat, 1.0, value_down)
        direction = jnp.where(piece < 2, 1.0, -1.0)
        step = direction * unit / self.duration
        terms = [self.amplitude * jnp.where(spiked, value_up, value_down)]
        term = self.amplitude * 2 * jnp.where(spiked, rise, fall) * step
        curved = self._curved(piece)
        for k in range(1, order + 1):
            terms.append(jnp.where(curved, term, 0.0))
            term = term * 2 * shape * step / (k + 1)
        return terms


class HalfSinePulse(AbstractPulse):
    """amplitude sin(pi t/duration) [g] for `duration` [s] (positive)."""

    amplitude: Real
    duration: Real

    def __init__(self, amplitude: ArrayLike, duration: ArrayLike):
        self.amplitude = finite("amplitude", amplitude)
        self.duration = positive("duration", duration)

    @property
    def knots(self):
        return _one_piece(self.duration)

    @property
    def scales(self):
        return (self.duration / math.pi)[None]

    @property
    def bounds(self):
        return jnp.abs(self.amplitude)[None]

    def series(self, piece, local, unit, order):
        rate = math.pi / self.duration
        return _sinusoid(self.amplitude, rate, rate * local, unit, order, local)


class SinePulse(AbstractPulse):
    """One full cycle of amplitude sin(2 pi t/period) [g], `period` in s, positive (D&D 2012, 3.2)."""

    amplitude: Real
    period: Real

    def __init__(self, amplitude: ArrayLike, period: ArrayLike):
        self.amplitude = finite("amplitude", amplitude)
        self.period = positive("period", period)

    @property
    def knots(self):
        return _one_piece(self.period)

    @property
    def scales(self):
        return (self.period / (2 * math.pi))[None]

    @property
    def bounds(self):
        return jnp.abs(self.amplitude)[None]

    def series(self, piece, local, unit, order):
        rate = 2 * math.pi / self.period
        return _sinusoid(self.amplitude, rate, rate * local, unit, order, local)


class CosinePulse(AbstractPulse):
    """One full cycle of amplitude cos(2 pi t/period) [g], `period` in s, positive: it starts and ends with a jump."""

    amplitude: Real
    period: Real

    def __init__(self, amplitude: ArrayLike, period: ArrayLike):
        self.amplitude = finite("amplitude", amplitude)
        self.period = positive("period", period)

    @property
    def knots(self):
        return _one_piece(self.period)

    @property
    def scales(self):
        return (self.period / (2 * math.pi))[None]

    @property
    def bounds(self):
        return jnp.abs(self.amplitude)[None]

    def series(self, piece, local, unit, order):
        rate = 2 * math.pi / self.period
        sine, cosine = sine_cosine_of_any(rate * local)
        value, slope = keep(self.amplitude * cosine, local), keep(-self.amplitude * sine, local) * rate * unit
        return _harmonic(value, slope, rate * unit, order)


# Peak of |y^3 - 3y| e^(-y^2/2), at y^2 = 3 - sqrt(6).
_ANTISYMMETRIC_PEAK = math.sqrt(3 - math.sqrt(6)) * math.sqrt(6) * math.exp(-(3 - math.sqrt(6)) / 2)


class RickerPulse(AbstractPulse):
    """A Ricker wavelet, the second or third derivative of a Gaussian.

    symmetric: u = amplitude (1 - 2 y^2) e^(-y^2), y = pi (t - center)/period;
    antisymmetric: u proportional to (y^3 - 3 y) e^(-y^2/2), y = 2 pi (t - center)/(sqrt(3) period),
    scaled to a peak of `amplitude`.

    **Arguments:**

    - `amplitude`: peak acceleration [g].
    - `period`: period of the spectral peak [s], positive.
    - `kind`: "symmetric" or "antisymmetric".
    - `center`: time of the wavelet's centre [s], positive. None: late enough that what is cut off at
      time 0 is below 1e-12 of the peak. The motion ends at 2 center.

    **Raises:** ValueError for a value outside its range.

    **Source:** Ricker (1943); Diamantopoulos & Fragiadakis (2017), section 4 (symmetric);
    Vassiliou & Makris (2011) (antisymmetric).
    """

    amplitude: Real
    period: Real
    center: Real
    kind: str = eqx.field(static=True)

    def __init__(
        self, amplitude: ArrayLike, period: ArrayLike, kind: str = "symmetric", center: ArrayLike | None = None
    ):
        self.amplitude = finite("amplitude", amplitude)
        self.period = positive("period", period)
        self.kind = one_of("kind", kind, ("symmetric", "antisymmetric"))
        default = 5.7 / math.pi if kind == "symmetric" else 8.2 * math.sqrt(3) / (2 * math.pi)
        self.center = default * self.period if center is None else positive("center", center)

    @property
    def knots(self):
        return _one_piece(2 * self.center)

    @property
    def scales(self):
        return (self.period / (2 * math.pi))[None]

    @property
    def bounds(self):
        return jnp.abs(self.amplitude)[None]

    def series(self, piece, local, unit, order):
        # With y = rate (t - center): Gaussian g' = -rate y g, then times a polynomial in y.
        symmetric = self.kind == "symmetric"
        rate = (math.sqrt(2) if symmetric else 2 / math.sqrt(3)) * math.pi / self.period
        y, step = rate * (local - self.center), rate * unit
        gauss = [jnp.exp(-(y**2) / 2)]
        gauss.append(-step * y * gauss[0])
        for k in range(1, order):
            gauss.append(keep(-step * (y * gauss[k] + step * gauss[k - 1]) * (1 / (k + 1)), local))
        if symmetric:
            factor = [1 - y**2, -2 * y * step, -(step**2)]
        else:
            size = 1 / _ANTISYMMETRIC_PEAK
            factor = [
                size * (y**3 - 3 * y),
                size * (3 * y**2 - 3) * step,
                size * 3 * y * step**2,
                size * step**3,
            ]
        return [
            self.amplitude * sum(factor[j] * gauss[k - j] for j in range(min(k, len(factor) - 1) + 1))
            for k in range(order + 1)
        ]


class MavroeidisPapageorgiouPulse(AbstractPulse):
    """The near-fault pulse of Mavroeidis & Papageorgiou: a cosine velocity under a cosine bell.

    velocity = V/2 [1 + cos(2 pi x/(oscillations period))] cos(2 pi x/period + phase), x = t - center,
    |x| <= oscillations period/2; `amplitude` g = 2 pi V/period.

    **Arguments:**

    - `amplitude`: acceleration amplitude 2 pi V/(g period) [g], V the peak of the velocity's envelope.
    - `period`: [s], positive.
    - `oscillations`: number of cycles under the bell (gamma of the source), above 1.
    - `phase`: phase of the cosine [rad] (nu of the source).

    **Raises:** ValueError for a value outside its range.

    **Source:** Mavroeidis & Papageorgiou (2003), equation 3 (velocity); its derivative is used.
    """

    amplitude: Real
    period: Real
    oscillations: Real
    phase: Real

    def __init__(self, amplitude: ArrayLike, period: ArrayLike, oscillations: ArrayLike = 2.0, phase: ArrayLike = 0.0):
        self.amplitude = finite("amplitude", amplitude)
        self.period = positive("period", period)
        self.oscillations = checked(
            "oscillations", oscillations, "be above 1 and finite", lambda x: (x > 1) & (x < jnp.inf)
        )
        self.phase = finite("phase", phase)

    @property
    def knots(self):
        return _one_piece(self.oscillations * self.period)

    @property
    def scales(self):
        return (self.period / (2 * math.pi) / (1 + 1 / self.oscillations))[None]

    @property
    def bounds(self):
        return jnp.abs(self.amplitude)[None] * (1 + 0.5 / self.oscillations)

    def series(self, piece, local, unit, order):
        # The product of cosines is a sum of three: at the period, and at the two side frequencies.
        time = local - self.oscillations * self.period / 2
        total = [0.0] * (order + 1)
        for weight, ratio in ((0.5, 1.0), (0.25, 1 + 1 / self.oscillations), (0.25, 1 - 1 / self.oscillations)):
            rate = ratio * 2 * math.pi / self.period
            angle = rate * time + self.phase
            size = self.amplitude * weight * ratio
            terms = _sinusoid(-size, rate, angle, unit, order, local)
            total = [a + b for a, b in zip(total, terms)]
        return total
