"""The only root of a polynomial between two points, by Newton's iterations, in lanes.

There a division takes as long as ten products.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxrock._core.types import Scalar
from jaxrock.compiler.hints import materialize, select
from jaxrock.numerics.polynomial import jet, value_and_slope

_MORE = 6  # largest number of Newton steps in full degree


def _settled(x: Scalar) -> float:
    """Return the relative change of a root after which Newton's iteration stops.

    The next relative change is the square of this one, times a factor of up to 1e4 where the slope is small.
    """
    return max(1e-10, math.sqrt(4e-5 * float(jnp.finfo(x.dtype).eps)))


def is_found(x: Scalar, change: Scalar, share: float = 1e-7) -> Bool[Array, ""]:
    """Return whether the last relative change of a root is at most `share`, or in single precision 80 units of
    rounding.
    """
    return change <= max(share, 80 * float(jnp.finfo(x.dtype).eps)) * x


def _guess(values: tuple[Scalar, Scalar], slopes: tuple[Any, Any]) -> Scalar:
    """Return the root in [0, 1] of a parabola or, if the `slopes` at both ends are known, approximately of a cubic."""
    sign = select(values[0] > 0, 1.0, -1.0)
    value, slope, fall = sign * values[0], sign * slopes[0], sign * values[1]
    curvature = fall - value - slope
    root = jnp.sqrt(jnp.maximum(slope * slope - 4 * value * curvature, 0.0))
    share = select(slope > 0, slope + root, 2 * value) / select(slope > 0, -2 * curvature, root - slope)
    share = jnp.clip(share, 0.0, 1.0)
    if slopes[1] is None:
        return share
    cubic = slope + sign * slopes[1] - 2 * (fall - value)
    for _ in range(2):
        off, rate = jet([value, slope, curvature - cubic, cubic], share, 1)
        share = jnp.clip(share - off / rate, 0.0, 1.0)
    return share


def root_between(degrees, terms: list[Scalar], start: Scalar, end: Scalar, values, slopes):
    """Return the only root of a polynomial in [start, end], and Newton's last change; `values`, `slopes`: at both ends.

    The first iterations take polynomials of these `degrees`: they need not be exact.
    """
    width, order = end - start, len(terms) - 1
    far_slope = None if slopes[1] is None else width * slopes[1]
    x = materialize(start + width * _guess(values, (width * slopes[0], far_slope)), end)

    def nearer(x, degree):
        value, slope = value_and_slope(terms[: max(degree, order * degree // 16) + 1], x)
        change = value / slope
        return jnp.clip(x - change, start, end), jnp.abs(change)

    for degree in degrees if order > 10 else ():  # low orders belong to the short steps of records
        x, _ = nearer(x, degree)

    def unsettled(carry):
        x, change, count = carry
        return ~(change <= _settled(x) * x) & (count < _MORE)

    # At least once in full degree: two truncated polynomials may agree by chance.
    more = x, jnp.full_like(x, jnp.inf), jnp.zeros_like(x, jnp.int32)
    x, change, _ = jax.lax.while_loop(unsettled, lambda carry: (*nearer(carry[0], order), carry[2] + 1), more)
    return x, change
