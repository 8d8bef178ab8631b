"""Sums of exponentials and a polynomial on [0, 1]: their first way out of a band and their maximum, certified.

Every quantity of a linear system under a polynomial load is such a curve. Its derivatives are bounded by the sizes
of its terms, so that a march in strides that cannot hold a zero finds every event, however fast some terms vibrate.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Complex, Inexact

Scalar = Inexact[ArrayLike, ""]
Flag = Bool[ArrayLike, ""]

_MOST_STRIDES = 400


def powers(base: Inexact[Array, "..."], count: int) -> Inexact[Array, "count ..."]:
    """Powers 0 to count - 1, along a new first axis."""
    base = jnp.asarray(base)
    repeated = jnp.broadcast_to(base, (count - 1, *base.shape))
    return jnp.cumprod(jnp.concatenate([jnp.ones_like(base)[None], repeated]), 0)


class Curve(eqx.Module):
    """Re(sum of amplitude e^(rate x)) + sum of coefficient x^k."""

    amplitudes: Complex[Array, " modes"]
    rates: Complex[Array, " modes"]
    coefficients: Inexact[Array, " terms"]
    errors: Inexact[Array, " modes"]  # what rounding may have changed in each mode at 0

    def jet(self, x: Scalar) -> tuple[Scalar, Scalar, Scalar]:
        """Value and two derivatives."""
        terms = self.amplitudes * jnp.exp(self.rates * x)
        faster = self.rates * terms
        value, slope, curvature, _ = self._polynomial(self.coefficients, x)
        return value + terms.real.sum(), slope + faster.real.sum(), curvature + (self.rates * faster).real.sum()

    @staticmethod
    def _polynomial(coefficients, x) -> tuple[Scalar, Scalar, Scalar, Scalar]:
        """Value and three derivatives of the polynomial."""
        rising, found = powers(x, coefficients.size), []
        for _ in range(4):
            found.append(jnp.sum(coefficients * rising[: coefficients.size]))
            coefficients = coefficients[1:] * jnp.arange(1, coefficients.size)
        return tuple(found)

    def bounds(self, x: Scalar, radius: Scalar) -> tuple[Scalar, Scalar]:
        """Bounds of the second and the third derivative's size on [x, x + radius]."""
        growth = jnp.maximum(self.rates.real, 0.0) * radius
        sizes = jnp.abs(self.amplitudes) * jnp.exp(self.rates.real * x + growth) * jnp.abs(self.rates) ** 2
        _, _, second, third = self._polynomial(jnp.abs(self.coefficients), x + radius)
        return second + sizes.sum(), third + (sizes * jnp.abs(self.rates)).sum()

    def noise(self) -> tuple[Scalar, Scalar]:
        """What rounding may change in value and slope on [0, 1]."""
        order, eps = jnp.arange(self.coefficients.size), 8 * jnp.finfo(self.errors.dtype).eps
        sizes = (eps * jnp.abs(self.amplitudes) + self.errors) * jnp.exp(jnp.maximum(self.rates.real, 0.0))
        sides = eps * jnp.abs(self.coefficients)
        return sizes.sum() + sides.sum(), (sizes * jnp.abs(self.rates)).sum() + (sides * order).sum()

    def ceiling(self) -> Scalar:
        """A bound of the size on [0, 1]."""
        sizes = jnp.abs(self.amplitudes) * jnp.exp(jnp.maximum(self.rates.real, 0.0))
        return sizes.sum() + jnp.abs(self.coefficients).sum()


def _below_parabola(value: Scalar, slope: Scalar, fall: Scalar) -> Scalar:
    """Length on which value + slope x - fall x^2/2 stays positive, for a value of 0 or more."""
    root = jnp.sqrt(slope**2 + 2 * fall * value)
    rising = slope > 0
    above = jnp.where(rising, slope + root, 2 * value)
    under = jnp.where(rising, fall, root - slope)
    endless = jnp.where((value > 0) | rising, jnp.inf, 0.0)
    return jnp.where(under > 0, above / jnp.where(under > 0, under, 1.0), endless)


def _clear(value, slope, curvature, bounds, noise):
    """Length on which a quantity stays positive; one that is zero here must be on its way up."""
    second, third = bounds
    touching = value <= noise[0]
    up = jnp.where(jnp.abs(slope) <= noise[1], 0.0, slope)
    # From zero: slope + curvature x/2 - third x^2/6.
    leaving = jnp.where(up >= 0, _below_parabola(jnp.maximum(up, 0.0), curvature / 2, third / 3), 0.0)
    return touching, jnp.where(touching, leaving, _below_parabola(jnp.maximum(value, 0.0), slope, second))


def _ratio(part: Scalar, whole: Scalar) -> Scalar:
    """|part/whole|, or infinity."""
    return jnp.where(whole == 0, jnp.inf, jnp.abs(part / jnp.where(whole == 0, 1.0, whole)))


def first_exit(curve: Curve, low: Scalar, high: Scalar, end: Scalar) -> tuple[Scalar, Flag, Flag]:
    """Where on [0, end] the curve first leaves the band, or `end`; whether below, whether above.

    A curve that starts on an edge must turn outward to leave. If the strides do not come to an end the march stops
    early, with no hit: what lies before is certain. It has no derivatives.
    """
    curve, low, high, end = jax.lax.stop_gradient((curve, low, high, end))
    noise = curve.noise()
    noise = noise[0] + 4 * jnp.finfo(noise[0].dtype).eps * jnp.maximum(jnp.abs(low), jnp.abs(high)), noise[1]

    def step(carry):
        x, radius, _, _, _, count = carry
        value, slope, curvature = curve.jet(x)
        bounds = curve.bounds(x, radius)
        at_low, from_low = _clear(value - low, slope, curvature, bounds, noise)
        at_high, from_high = _clear(high - value, -slope, -curvature, bounds, noise)
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


def highest(curve: Curve, best: Scalar, end: Scalar) -> Scalar:
    """The largest value on [0, end], or `best` if that is larger; with derivatives."""
    still, least, last = jax.lax.stop_gradient((curve, best, end))
    noise, eps = still.noise(), jnp.finfo(last.dtype).eps

    def step(carry):
        x, radius, least, place, count = carry
        value, slope, curvature = still.jet(x)
        second, third = still.bounds(x, radius)
        higher = value > least
        least, place = jnp.where(higher, value, least), jnp.where(higher, x, place)
        record = least - value <= noise[0]
        _, falling = _clear(least - value, -slope, -curvature, (second, third), noise)
        rising = jnp.where(record & (slope >= 0), _below_parabola(jnp.maximum(slope, 0.0), curvature, third), 0.0)
        # What stays within rounding may be passed over.
        within = jnp.minimum(jnp.sqrt(_ratio(noise[0], curvature)), jnp.cbrt(_ratio(noise[0], third)))
        within = jnp.minimum(within, _ratio(noise[0], slope))
        stride = jnp.minimum(jnp.maximum(jnp.maximum(falling, rising), jnp.maximum(within, 4 * eps)), radius)
        return jnp.minimum(x + stride, last), jnp.minimum(4 * stride, last), least, place, count + 1

    nowhere = still.ceiling() <= least
    start = (jnp.where(nowhere, last, 0.0), last, least, -jnp.ones_like(last), jnp.zeros((), jnp.int32))
    _, _, least, place, _ = jax.lax.while_loop(
        lambda carry: (carry[0] < last) & (carry[4] < 25 * _MOST_STRIDES), step, start
    )
    at_end = ~nowhere & (still.jet(last)[0] > least)
    place = jnp.where(at_end, end, place)
    return jnp.where(place >= 0, curve.jet(place)[0], best)
