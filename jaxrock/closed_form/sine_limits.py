"""Limits of overturning under one cycle of a sine, case by case; terms and conventions as in `sine_pulse`."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxrock._core.types import Floats, RealLike
from jaxrock.closed_form import _sine_formulas as formulas
from jaxrock.closed_form._sine_formulas import elementwise_in_sine
from jaxrock.numerics.roots import bracketed_root

_GRID = 256  # samples that may bracket a root of case 1.1, the topmost first


@elementwise_in_sine
def no_impact_limit(frequency_ratio: RealLike) -> Floats:
    """Least intensity that overturns a block without impact (case 2), at any restitution.

    **Source:** D&D 3.10.
    """
    return formulas.no_impact(frequency_ratio)


@elementwise_in_sine
def impact_time_limit(frequency_ratio: RealLike) -> Floats:
    """Intensity at which the first impact comes just as the pulse ends; above it, the impact comes later.

    **Source:** D&D 3.31.
    """
    return formulas.impact_at_end(frequency_ratio)


@elementwise_in_sine
def after_pulse_limits(frequency_ratio: RealLike, restitution: RealLike) -> tuple[Floats, Floats]:
    """Both ends of the intensities at which a block overturns after one impact that comes after the pulse (case 1.2).

    **Returns:** (lower, upper); lower is `impact_time_limit` where the interval continues below it; both inf where
    there is no such interval.

    **Source:** D&D 3.18, searched only where it holds: between 3.31 and 3.10.
    """
    first, last = formulas.impact_at_end(frequency_ratio), formulas.no_impact(frequency_ratio)

    def excess(a, w, e):
        return e**2 * (1 - formulas.coordinate_product(a, w)) - 1

    # 1 - D0* rises to one maximum and falls to 1 at the upper limit.
    inner = (jnp.sqrt(5.0) - 1) / 2

    def narrow(_, bracket):
        low, high = bracket
        left, right = high - inner * (high - low), low + inner * (high - low)
        better = excess(left, frequency_ratio, restitution) > excess(right, frequency_ratio, restitution)
        return jnp.where(better, low, left), jnp.where(better, right, high)

    top = sum(jax.lax.fori_loop(0, 60, narrow, (jax.lax.stop_gradient(first), jax.lax.stop_gradient(last)))) / 2
    exists = excess(top, frequency_ratio, restitution) > 0
    upper = bracketed_root(excess, top, last, frequency_ratio, restitution)
    begins = excess(first, frequency_ratio, restitution) < 0
    lower = bracketed_root(excess, first, top, frequency_ratio, restitution)
    return jnp.where(exists, jnp.where(begins, lower, first), jnp.inf), jnp.where(exists, upper, jnp.inf)


@elementwise_in_sine
def during_pulse_limit(frequency_ratio: RealLike, restitution: RealLike) -> Floats:
    """Least intensity from which, up to `impact_time_limit`, one impact during the pulse overturns a block (case 1.1).

    **Returns:** the intensity; inf where there is no such interval.

    **Source:** D&D 3.20 and 3.21 (the "numerical" curve of figure 3), with the first root of 3.21.
    """
    last = formulas.impact_at_end(frequency_ratio)

    def excess(a, w, e):
        return formulas.growth_after_impact(a, w, e, formulas.impact_during_pulse(a, w))

    return _topmost_root(excess, last, frequency_ratio, restitution)


@elementwise_in_sine
def approximate_during_pulse_limit(frequency_ratio: RealLike, restitution: RealLike) -> Floats:
    """Case 1.1 without a transcendental equation: D&D's approximation of `during_pulse_limit`.

    Within 1 % for frequency ratios from 2.5 to below 4 and restitutions of 0.8 to 0.96; below 2 it is 2 to 6 % low,
    near the upper end of the curve (above 4) up to 8 % high. **Returns:** inf where it has no root.

    **Source:** D&D 3.30 with 3.29.
    """
    last = formulas.impact_at_end(frequency_ratio)

    def excess(a, w, e):
        return formulas.growth_after_impact(a, w, e, formulas.approximate_impact(a, w), jump=True)

    return _topmost_root(excess, last, frequency_ratio, restitution)


def _topmost_root(excess: Callable, last: Array, w: Array, e: Array) -> Array:
    """Return the highest intensity up to `last` at which `excess` turns positive; inf if there is none."""
    last, *still = jax.lax.stop_gradient((last, w, e))

    def sample(number):
        return 1 + (last - 1) * (number / _GRID) ** 2

    def one_lower(carry):
        number, _, below = carry
        return number - 1, below, excess(sample(number - 2.0), *still) > 0

    def goes_on(carry):
        number, above, below = carry
        return (number > 2) & ~(above & ~below)

    none = jnp.zeros_like(last, bool)
    number, above, below = jax.lax.while_loop(goes_on, one_lower, (last * 0 + _GRID + 2, none, none))
    root = bracketed_root(excess, sample(number - 1), sample(number), w, e)
    return jnp.where(above & ~below, root, jnp.inf)
