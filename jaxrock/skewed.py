"""Free swings about a balance where the restoring moment is a sinusoid and a constant (spring models, law "plastic").

Over its slope there, the moment at an angle `gap` short of the balance is sin(gap) + skew (1 - cos(gap)); time is in
units in which this slope is one. Below the energy of the balance the block turns back at the gap g0, and with
gap = g0 cosh(phi) its time is the integral of a smooth function of phi; above it gap = kappa sinh(phi) does the same.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Inexact

from jaxrock._roots import bracketed_root
from jaxrock._trigonometry import exponential, sine_cosine, sine_lag, sine_ratio

Scalar = Inexact[ArrayLike, ""]
Real = Inexact[ArrayLike, "..."]

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(48)
_NODES, _WEIGHTS = (_NODES + 1) / 2, _WEIGHTS / 2  # of [0, 1]


def moment(gap: Scalar, skew: Scalar) -> Scalar:
    """Restoring moment over its slope at the balance."""
    half, cosine = sine_cosine(gap / 2)
    return 2 * half * (cosine + skew * half)


def distance(gap: Real, skew: Scalar) -> Real:
    """Speed that just reaches the balance, with the sign of the gap: the root of twice the work up to there."""
    # 4 sin^2(gap/2) + 2 skew (gap - sin(gap)), without cancellation.
    return gap * jnp.sqrt(sine_ratio(gap / 2) ** 2 + 2 * skew * gap * sine_lag(gap))


def turning_gap(deficit: Scalar, skew: Scalar, reach: Scalar) -> Scalar:
    """Gap at which a block turns back, at most `reach`; `deficit`: twice the energy that it lacks to the balance.

    Beyond the balance the same holds with the negative skew.
    """
    missing = jnp.sqrt(jnp.maximum(deficit, _least(deficit)))
    return bracketed_root(_lacking, jnp.zeros_like(missing), reach, missing, skew)


def _lacking(gap: Inexact[Array, ""], missing: Inexact[Array, ""], skew: Inexact[Array, ""]) -> Inexact[Array, ""]:
    return distance(gap, skew) - missing


def time_to_turning(gap: Scalar, speed: Scalar, turn: Scalar, skew: Scalar) -> Scalar:
    """Time from a gap, at this speed, to the turning point at the gap `turn`."""

    def rate2(off):
        """Squared speed over gap^2 - turn^2, at the gap turn + 2 off."""
        mean = turn + off
        lean = off**2 * sine_lag(off) / mean + mean / 2 * sine_ratio(mean / 2) ** 2 * sine_ratio(off)
        return sine_ratio(mean) * sine_ratio(off) + skew * lean

    start = rate2(jnp.maximum(gap - turn, 0.0) / 2)
    length = jnp.arcsinh(speed / (jnp.sqrt(start) * turn))
    up, down = _exponentials(length)
    return length * _mean(1 / jnp.sqrt(rate2(turn * (up + down - 2) / 4)))


def time_from_balance(gap: Scalar, excess: Scalar, skew: Scalar) -> Scalar:
    """Time from the balance to a gap, negative before it; `excess`: squared speed at the balance."""
    kappa = jnp.sqrt(jnp.maximum(excess, _least(excess)))
    length = jnp.arcsinh(gap / kappa)
    up, down = _exponentials(length)
    gaps = kappa * (up - down) / 2
    squares = gaps * gaps
    speed2 = distance(gaps, skew) ** 2 + kappa**2
    return length * _mean(jnp.sqrt((squares + kappa**2) / speed2))


def _least(like: Scalar) -> float:
    """Of a squared speed: its root has a derivative, and a square."""
    return 4 * float(jnp.finfo(like.dtype).tiny)


def _exponentials(length: Scalar) -> tuple[Inexact[Array, " nodes"], Inexact[Array, " nodes"]]:
    """exp(phi) and exp(-phi) at the nodes between 0 and a length."""
    phi = length * jnp.asarray(_NODES, length.dtype)
    return exponential(phi), exponential(-phi)


def _mean(values: Inexact[Array, " nodes"]) -> Inexact[Array, ""]:
    """Gauss-Legendre quadrature over an interval of length one."""
    return jnp.sum(values * jnp.asarray(_WEIGHTS, values.dtype))
