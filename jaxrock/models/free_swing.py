"""Free swings about a balance where the restoring moment is a sinusoid and a constant (spring models, law "plastic").

Over its slope there, the moment at an angle `gap` short of the balance is sin(gap) + skew (1 - cos(gap)). Time is in
units in which this slope is one.

Below the energy of the balance the block turns back at the gap g0. With gap = g0 cosh(phi) its time is the integral of
a smooth function of phi. Above that energy gap = kappa sinh(phi) does the same.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Inexact

from jaxrock._core.types import Scalar
from jaxrock.numerics.elementary import exponential, sine_cosine, sine_lag, sine_ratio
from jaxrock.numerics.gauss_legendre import gauss_legendre_of_unit
from jaxrock.numerics.roots import bracketed_root

# With 24 nodes the error stays below rounding of the energy. It is 1e-15 up to lengths of 10 (a turn 1e-4 from the
# balance), and 1e-11 at 35, where rounding decides whether the block turns.
_NODES, _WEIGHTS = gauss_legendre_of_unit(24)


def moment(gap: Scalar, skew: Scalar) -> Scalar:
    """Return the restoring moment over its slope at the balance."""
    half, cosine = sine_cosine(gap / 2)
    return 2 * half * (cosine + skew * half)


def distance(gap: Scalar, skew: Scalar) -> Scalar:
    """Return the speed that just reaches the balance, with the sign of the gap: the root of twice the work up to
    there."""
    # The root of 4 sin^2(gap/2) + 2 skew (gap - sin(gap)), without cancellation.
    return gap * jnp.sqrt(sine_ratio(gap / 2) ** 2 + 2 * skew * gap * sine_lag(gap))


def turning_gap(deficit: Scalar, skew: Scalar, reach: Scalar) -> Scalar:
    """Return the gap at which a block turns back, at most `reach`; `deficit`: twice the energy missing to the balance.

    Beyond the balance, the negative skew gives the gap.
    """
    missing = jnp.sqrt(jnp.maximum(deficit, least(deficit)))
    return bracketed_root(_lacking, jnp.zeros_like(missing), reach, missing, skew)


def _lacking(gap: Inexact[Array, ""], missing: Inexact[Array, ""], skew: Inexact[Array, ""]) -> Inexact[Array, ""]:
    return distance(gap, skew) - missing


def time_to_turning(gap: Scalar, speed: Scalar, turn: Scalar, skew: Scalar) -> Scalar:
    """Return the time from a gap, at this speed, to the turning point at the gap `turn`."""

    def rate2(off):
        """Return the squared speed over gap^2 - turn^2, at the gap turn + 2 off."""
        mean = turn + off
        half, lag = sine_ratio(mean / 2), off**2 * sine_lag(off)
        rest = 1 - lag  # sin(off)/off
        return half * sine_cosine(mean / 2)[1] * rest + skew * (lag / mean + mean / 2 * half**2 * rest)

    start = rate2(jnp.maximum(gap - turn, 0.0) / 2)
    length = jnp.arcsinh(speed / (jnp.sqrt(start) * turn))
    return _integral(lambda up, down: 1 / jnp.sqrt(rate2(turn * (up + down - 2) / 4)), length)


def time_from_balance(gap: Scalar, excess: Scalar, skew: Scalar) -> Scalar:
    """Return the time from the balance to a gap, negative before it; `excess`: squared speed at the balance."""
    kappa = jnp.sqrt(jnp.maximum(excess, least(excess)))

    def of(up, down):
        gap = kappa * (up - down) / 2
        return jnp.sqrt((gap**2 + kappa**2) / (distance(gap, skew) ** 2 + kappa**2))

    return _integral(of, jnp.arcsinh(gap / kappa))


def _integral(function: Callable, length: Scalar) -> Scalar:
    """Integrate a function of exp(phi) and exp(-phi) over phi from 0 to a length, by Gauss-Legendre quadrature."""
    nodes, weights = (jnp.asarray(values, length.dtype) for values in (_NODES, _WEIGHTS))

    def add(k, total):
        up = exponential(nodes[k] * length)
        return total + weights[k] * function(up, 1 / up)

    return length * jax.lax.fori_loop(0, _NODES.size, add, jnp.zeros_like(length))


def least(like: Scalar) -> float:
    """Return the smallest squared speed whose root has a derivative and a square."""
    return 4 * float(jnp.finfo(like.dtype).tiny)
