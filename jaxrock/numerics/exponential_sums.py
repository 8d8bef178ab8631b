"""Sums of exponentials and a polynomial on [0, 1]: their certified first exit from a band, and their maximum.

Every quantity of a linear system under a polynomial load is such a curve. Its derivatives are bounded by the sizes of
its terms. A march in strides that provably contain no zero finds every event, however fast some terms vibrate.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Complex, Inexact

from jaxrock._core.types import Flag, Scalar
from jaxrock.numerics.roots import implicit

_Values = Inexact[Array, "*values"]
_MOST_STRIDES = 10_000


def powers(base: Inexact[ArrayLike, "..."], count: int) -> Inexact[Array, "count ..."]:
    """Return the powers 0 to count - 1, along a new first axis."""
    base = jnp.asarray(base)
    exponent = np.arange(count).reshape(-1, *[1] * base.ndim)
    found = jnp.ones((count, *base.shape), base.dtype)
    # By repeated squaring, selected by the bits of the exponent: one loop for XLA, which makes a loop of every
    # concatenation.
    for bit in range((count - 1).bit_length()):
        found = found * jnp.where(exponent >> bit & 1 == 1, base, 1)
        base = base * base
    return found


def _derivatives(count: int) -> np.ndarray:
    """Return matrices that map a polynomial's coefficients to those of its derivatives, orders 0 to 3."""
    first = np.diag(np.arange(1.0, count), 1)
    return np.stack([np.linalg.matrix_power(first, order) for order in range(4)])


class Curve(eqx.Module):
    """Re(sum of amplitude e^(rate x)) + sum of coefficient x^k."""

    amplitudes: Complex[Array, "*rows modes"]
    rates: Complex[Array, "*rows modes"]
    coefficients: Inexact[Array, "*rows terms"]
    errors: Inexact[Array, "*rows modes"]  # bound of the rounding error of each mode at 0

    def jet(self, x: Scalar) -> Inexact[Array, "three"]:
        """Return value, slope and curvature."""
        count = self.coefficients.size
        waves = self.amplitudes * jnp.exp(self.rates * x) * powers(self.rates, 3)
        smooth = jnp.asarray(_derivatives(count)[:3]) @ self.coefficients
        return smooth @ powers(x, count) + waves.real.sum(axis=1)

    def ceiling(self) -> Scalar:
        """Return a bound of the absolute value on [0, 1]."""
        sizes = jnp.abs(self.amplitudes) * jnp.exp(jnp.maximum(self.rates.real, 0.0))
        return sizes.sum() + jnp.abs(self.coefficients).sum()


class _Tables(eqx.Module):
    """Precomputed tables for the points of a march along a curve, which then needs few exponentials and powers."""

    rates: Complex[Array, " modes"]
    waves: Complex[Array, "three modes"]  # value, slope, curvature
    sizes: Inexact[Array, "three modes"]  # of value, second and third derivative
    smooth: Inexact[Array, "three terms"]
    largest: Inexact[Array, "two terms"]  # of second and third derivative
    errors: Inexact[Array, "two modes"]  # rounding errors of value and slope, from the modes, with which they decay
    floor: Inexact[Array, " two"]  # constant rounding errors of value and slope

    @classmethod
    def of(cls, curve: Curve, level: Scalar) -> "_Tables":
        """Make the tables of a curve that is compared with numbers of the size `level`."""
        amplitudes, rates = curve.amplitudes, curve.rates
        turned = jnp.stack([amplitudes * rates**k for k in range(4)])
        smooth = _derivatives(curve.coefficients.size) @ curve.coefficients
        eps = 8 * jnp.finfo(smooth.dtype).eps
        errors = eps * jnp.abs(amplitudes) + curve.errors
        sides = eps * jnp.abs(smooth[:2]).sum(1)
        return cls(
            rates=rates,
            waves=turned[:3],
            sizes=jnp.abs(turned[np.array([0, 2, 3])]),
            smooth=jnp.asarray(smooth[:3]),
            largest=jnp.abs(smooth[2:]),
            errors=jnp.stack([errors, errors * jnp.abs(rates)]),
            floor=sides.at[0].add(eps * jnp.abs(level)),
        )

    def noise(self, turned: Complex[Array, " modes"]) -> Inexact[Array, " two"]:
        """Return bounds of the rounding errors of value and slope; `turned` are the modes' growth factors."""
        return self.errors @ jnp.abs(turned) + self.floor


def _partial_sums(terms: Inexact[Array, "*rows modes"]) -> Inexact[Array, "*rows sums"]:
    """Return the sums of the first 0, 1, ... modes."""
    return terms @ np.tri(terms.shape[-1] + 1, terms.shape[-1], -1).T


class _View:
    """A curve at x, with bounds on [x, x + radius] from which lengths without a crossing follow."""

    def __init__(self, tables: _Tables, x: Scalar, radius: Scalar):
        count = tables.smooth.shape[1]
        turned = jnp.exp(tables.rates * x)
        terms, smooth = (tables.waves * turned).real, tables.smooth @ powers(x, count)
        grown = jnp.abs(turned) * jnp.exp(jnp.maximum(tables.rates.real, 0.0) * radius)
        sizes, largest = tables.sizes * grown, tables.largest @ powers(x + radius, count)
        self.value, self.slope, self.curvature = smooth + terms.sum(1)
        self.third = largest[1] + sizes[2].sum()
        # The curve without its fastest modes, and the swing of these, for every split into slow and fast.
        self.slow, self.drift = smooth[:2, None] + _partial_sums(terms[:2])
        swing, bend = _partial_sums(sizes[:2])
        self.swing, self.bend = swing[-1] - swing, largest[0] + bend
        self.noise = tables.noise(turned)
        # A length within which the curve stays below the rounding noise may be skipped.
        still = jnp.maximum(jnp.abs(self.slope), self.noise[1])
        within = _ratio(self.noise[0], still), jnp.sqrt(_ratio(self.noise[0], self.curvature))
        self.within = jnp.minimum(jnp.minimum(*within), jnp.cbrt(_ratio(self.noise[0], self.third)))

    def clear(self, level: Scalar, sign: float) -> tuple[Flag, Scalar]:
        """Return whether the curve touches the level, and a length on which it stays on this side (sign 1: above it).

        The length is the longest of many, each from a parabola below the slower modes, less the swing of the faster
        ones. It is zero where the curve touches the level and leaves this side with certainty despite rounding.
        """
        value, slope = sign * (self.value - level), sign * self.slope
        touching = value <= self.noise[0]
        # A start at zero: slope + curvature x/2 - third x^2/6 stays positive.
        up = jnp.where(slope <= self.noise[1], 0.0, slope)
        leaving = _below_parabola(up, sign * self.curvature / 2, self.third / 3)
        leaving = jnp.where(slope < -self.noise[1], 0.0, jnp.maximum(leaving, self.within))
        above = sign * (self.slow - level) - self.swing
        apart = _below_parabola(jnp.maximum(above, 0.0), sign * self.drift, self.bend)
        apart = jnp.max(jnp.where(above > self.noise[0], apart, 0.0))
        return touching, jnp.where(touching, leaving, apart)


def _below_parabola(value: _Values, slope: _Values, fall: _Values) -> _Values:
    """Return lengths on which value + slope x - fall x^2/2 stays positive, for a value of 0 or more."""
    root = jnp.sqrt(slope**2 + 2 * fall * value)
    rising = slope > 0
    above = jnp.where(rising, slope + root, 2 * value)
    under = jnp.where(rising, fall, root - slope)
    endless = jnp.where((value > 0) | rising, jnp.inf, 0.0)
    return jnp.where(under > 0, above / jnp.where(under > 0, under, 1.0), endless)


def _ratio(part: Scalar, whole: Scalar) -> Scalar:
    """Return |part/whole|, or infinity."""
    return jnp.where(whole == 0, jnp.inf, jnp.abs(part / jnp.where(whole == 0, 1.0, whole)))


def first_exit(curve: Curve, low: Scalar, high: Scalar, end: Scalar) -> tuple[Scalar, Flag, Flag]:
    """Return the point of [0, end] at which the curve first leaves the band, or `end`; whether below, whether above.

    A curve that starts on an edge must turn outward to leave. At the limit of strides the march stops early, without a
    hit: the curve is certainly inside before that point. The result has no derivatives.
    """
    curve, low, high, end = jax.lax.stop_gradient((curve, low, high, end))
    tables = _Tables.of(curve, jnp.maximum(jnp.abs(low), jnp.abs(high)))

    def step(carry):
        x, radius, _, _, _, count = carry
        view = _View(tables, x, radius)
        (at_low, from_low), (at_high, from_high) = view.clear(low, 1.0), view.clear(high, -1.0)
        below, above = at_low & (from_low <= 0), at_high & (from_high <= 0)
        stride = jnp.minimum(jnp.minimum(from_low, from_high), radius)
        reached = jnp.where(below | above, x, jnp.minimum(x + stride, end))
        going = ~below & ~above & (reached < end) & (count < _MOST_STRIDES)
        return reached, jnp.minimum(4 * stride, end), going, below, above, count + 1

    inside = curve.ceiling() < jnp.minimum(-low, high)
    no = jnp.zeros_like(inside)
    start = (jnp.where(inside, end, 0.0), end, ~inside & (end > 0), no, no, jnp.zeros((), jnp.int32))
    x, _, _, below, above, _ = jax.lax.while_loop(lambda carry: carry[2], step, start)
    return x, below, above


def highest(curve: Curve, best: Scalar, end: Scalar) -> tuple[Scalar, Flag]:
    """Return the largest of `best` and the values on [0, end], with derivatives, and whether the search finished."""
    still, least, last = jax.lax.stop_gradient((curve, best, end))
    tables, eps = _Tables.of(still, least), jnp.finfo(last.dtype).eps

    def step(carry):
        x, radius, least, place, count = carry
        view = _View(tables, x, radius)
        value, slope, curvature, third = view.value, view.slope, view.curvature, view.third
        higher = value > least
        least, place = jnp.where(higher, value, least), jnp.where(higher, x, place)
        record, falling = view.clear(least, -1.0)
        rising = jnp.where(record & (slope >= 0), _below_parabola(jnp.maximum(slope, 0.0), curvature, third), 0.0)
        stride = jnp.maximum(jnp.maximum(falling, rising), jnp.maximum(view.within, 4 * eps))
        stride = jnp.minimum(stride, radius)
        return jnp.minimum(x + stride, last), jnp.minimum(4 * stride, last), least, place, count + 1

    nowhere = still.ceiling() <= least
    # Start with a high value: otherwise every ripple of a rising curve would be a new maximum.
    first = _top_of_steady(still, last)
    value = still.jet(first)[0]
    place = jnp.where(~nowhere & (value > least), first, -1.0)
    least = jnp.where(place >= 0, value, least)
    start = (jnp.where(nowhere, last, 0.0), last, least, place, jnp.zeros((), jnp.int32))
    x, _, least, place, _ = jax.lax.while_loop(
        lambda carry: (carry[0] < last) & (carry[4] < _MOST_STRIDES), step, start
    )
    # The top moves with the parameters, which matters for second derivatives.
    top = jnp.where(place > 0, implicit(_to_top, jnp.maximum(place, 0.0), curve), 0.0)
    of_end, of_top = jax.vmap(curve.jet)(jnp.stack([end, top]))[:, 0]
    # A curve that still rises at its end has its top found just before, and by rounding that may be the higher value.
    at_end = ~nowhere & (of_end >= least - tables.noise(jnp.exp(tables.rates * last))[0])
    return jnp.where(at_end, of_end, jnp.where(place >= 0, of_top, best)), x >= last


def _to_top(curve: Curve, x: Scalar) -> Scalar:
    """Return Newton's step to the top of a curve; zero where the curve is not concave."""
    _, slope, bend = curve.jet(x)
    return jnp.where(bend < 0, slope / jnp.where(bend < 0, bend, 1.0), 0.0)


def _top_of_steady(curve: Curve, end: Scalar) -> Scalar:
    """Return approximately the point of [0, end] at which the curve without its oscillating modes is highest."""
    amplitudes, rates = jnp.where(curve.rates.imag == 0, curve.amplitudes, 0.0).real, curve.rates.real
    count = curve.coefficients.size
    smooth = (_derivatives(count) @ curve.coefficients)[:3]
    waves = amplitudes * jnp.stack([jnp.ones_like(rates), rates, rates**2])

    def jet(x):
        return waves @ jnp.exp(rates * x) + smooth @ powers(x, count)

    x = end * np.linspace(0, 1, 9)

    def nearer(_, x):
        _, slope, curvature = jet(x)
        return jnp.clip(x - jnp.where(curvature < 0, slope / curvature, 0.0), 0.0, end)

    return jax.lax.fori_loop(0, 4, nearer, x[jnp.argmax(jax.vmap(jet)(x)[:, 0])])
