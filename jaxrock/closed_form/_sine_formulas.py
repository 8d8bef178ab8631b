"""The formulas of D&D (see `sine_pulse`) for arrays of one shape, shared by the public functions; nothing is checked
here.

`a` is the intensity, `w` the frequency ratio, `e` the restitution.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrock._arguments.ranges import checked, finite, positive, share
from jaxrock.closed_form import _sine_arcs as arcs
from jaxrock.compiler import elementwise
from jaxrock.numerics.roots import bracketed_root


def _above_one(name, value):
    return checked(name, value, "be greater than 1 (the block uplifts)", lambda x: (x > 1) & (x < np.inf))


# Decorator of the public functions: it checks arguments by these names, and broadcasts them.
elementwise_in_sine = elementwise(intensity=_above_one, frequency_ratio=positive, restitution=share, time=finite)


def end_of_pulse(a: Array, w: Array) -> Array:
    """Return p T_ex, the time from uplift to the end of the pulse."""
    return (2 * jnp.pi - arcs.uplift_phase(a)) / w


def series_constants(a: Array, w: Array) -> tuple[Array, ...]:
    """Return A0*, B0*, C0*, omega, p T_ex; D&D 3.9."""
    slope = jnp.sqrt((a - 1) * (a + 1))
    return w * (w + slope) / (w**2 + 1), w * (w - slope) / (w**2 + 1), 2 * a / (w**2 + 1), w, end_of_pulse(a, w)


def free_coordinates(A0, B0, C0, w, end) -> tuple[Array, Array]:
    """Return 1 - |rotation| +- velocity at the end of the pulse: the factors of D0*, each with its exponential."""
    return A0 * jnp.exp(-end) - w * C0 / 2, B0 * jnp.exp(end) + w * C0 / 2


def coordinate_product(a: Array, w: Array) -> Array:
    """Return D0*; D&D 3.9, first line."""
    decaying, growing = free_coordinates(*series_constants(a, w))
    return decaying * growing


def no_impact(w: Array) -> Array:
    """Return the least intensity that overturns a block without impact; D&D 3.10."""

    def excess(slope, w):
        a = jnp.sqrt(1 + slope**2)
        return slope - w - a * jnp.exp(-(2 * jnp.pi - jnp.arctan2(1.0, slope)) / w)

    decay = jnp.exp(-1.5 * jnp.pi / w)
    # (1 - decay) slope is at most omega + decay, because psi is at most pi/2
    slope = bracketed_root(excess, w, (w + decay) / -jnp.expm1(-1.5 * jnp.pi / w), w)
    return jnp.sqrt(1 + slope**2)


def impact_at_end(w: Array) -> Array:
    """Return the intensity at which the first impact comes just as the pulse ends; D&D 3.31."""

    def excess(logarithm, w):
        missing = jnp.exp(logarithm)
        slope = w - missing
        side = 1 + w**2 + jnp.sqrt(1 + (2 + slope**2) * w**2)
        return logarithm + (2 * jnp.pi - jnp.arctan2(1.0, slope)) / w - jnp.log(side / w)

    # For small omega the slope is near omega: the logarithm of their difference is the unknown.
    lowest = jnp.log((1 + w**2) / w) - 2 * jnp.pi / w - 1
    missing = jnp.exp(bracketed_root(excess, lowest, jnp.log(w), w))
    return jnp.sqrt(1 + (w - missing) ** 2)


def first_excursion(time: Array, a: Array, w: Array) -> tuple[Array, Array]:
    """Return opening and speed of the first excursion; D&D 3.4."""
    return arcs.opening_and_speed(time, arcs.start(a), a, w)


def impact_during_pulse(a: Array, w: Array) -> Array:
    """Return the first root of D&D 3.21: the block can fall only after the driving stretch, and then falls once."""
    lower = (jnp.pi - 2 * arcs.uplift_phase(a)) / w
    return bracketed_root(lambda t, a, w: first_excursion(t, a, w)[0], lower, end_of_pulse(a, w), a, w)


def first_impact(a: Array, w: Array) -> Array:
    """Return the time at which the first excursion ends; inf where it does not."""
    limit, lost = impact_at_end(w), no_impact(w)
    middle = (limit + lost) / 2
    after = jnp.where((a > limit) & (a < lost), a, middle)
    decaying, growing = free_coordinates(*series_constants(after, w))
    since_end = jnp.log((1 + jnp.sqrt(1 - decaying * growing)) / growing)  # D&D 3.13
    during_pulse = impact_during_pulse(jnp.where(a > limit, (1 + limit) / 2, a), w)
    after_pulse = end_of_pulse(after, w) + since_end
    return jnp.where(a < limit, during_pulse, jnp.where(a < lost, after_pulse, jnp.inf))


def impact_speed(time: Array, a: Array, w: Array) -> Array:
    """Return the speed over p alpha with which the first excursion ends at its `first_impact`; D&D 3.22, 3.15."""
    late = time > end_of_pulse(a, w)
    lost = jnp.where(late, 1 - coordinate_product(a, w), 1.0)
    return jnp.where(late, jnp.sqrt(lost), -first_excursion(time, a, w)[1])


def growth_after_impact(a: Array, w: Array, e: Array, time: Array, jump: bool = False) -> Array:
    """Return left minus right side of D&D 3.20, over 2 e^(p T_ex - time): positive where one impact overturns."""
    A0, B0, C0, _, end = series_constants(a, w)
    angle = w * time + arcs.uplift_phase(a)
    if jump:  # 3.22 as printed: an approximate time is not a zero of the rotation
        twice_speed = B0 * jnp.exp(time) - A0 * jnp.exp(-time) + C0 * w * jnp.cos(angle)
    else:
        twice_speed = -2 * first_excursion(time, a, w)[1]
    after = e * twice_speed + C0 * (w * jnp.exp(time - end) - w * jnp.cos(angle) - jnp.sin(angle)) - 2
    return after / 2


def approximate_impact(a: Array, w: Array) -> Array:
    """Return the approximate time of impact, D&D 3.29, with kappa and lambda of 3.26; NaN where it is not real."""
    A0, B0, C0, _, _ = series_constants(a, w)
    angle = w + arcs.uplift_phase(a)
    sine, cosine = jnp.sin(angle), jnp.cos(angle)
    falling = A0 - C0 * jnp.e * w / 2 * (cosine + w * sine)
    rising = B0 + C0 * w / (2 * jnp.e) * (cosine - w * sine)
    offset = 1 - a * sine
    square = offset**2 - falling * rising
    ratio = (offset + jnp.sqrt(jnp.maximum(square, 0.0))) / rising
    return jnp.where((square >= 0) & (ratio > 0), jnp.log(jnp.where(ratio > 0, ratio, 1.0)), jnp.nan)
