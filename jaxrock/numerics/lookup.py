"""Lookup of a value by an index that differs from lane to lane."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Int, Shaped

from jaxrock.compiler.hints import select

_FEW = 8


def take(values: Shaped[Array, " n"], index: Int[Array, ""] | int) -> Shaped[Array, ""]:
    """Return `values[index]`; few values are compared one by one, because a gather does not vectorise."""
    if values.shape[0] > _FEW:
        return values[index]
    value = values[0]
    for i in range(1, values.shape[0]):
        value = select(index >= i, values[i], value)
    return value


def count_up_to(values: Shaped[Array, " n"], x: Shaped[ArrayLike, ""]) -> Int[Array, ""]:
    """Return the number of sorted values that are not larger than x, without derivatives."""
    values, x = jax.lax.stop_gradient((values, jnp.asarray(x)))
    if values.shape[0] <= _FEW:
        return jnp.sum(values <= x, dtype=jnp.int32)

    def halved(carry):
        low, high = carry
        middle = (low + high) >> 1
        below = values[middle] <= x
        return select(below, middle + 1, low), select(below, high, middle)

    ends = jnp.int32(0), jnp.int32(values.shape[0])
    return jax.lax.while_loop(lambda carry: carry[0] < carry[1], halved, ends)[0]


def stretch_from(
    starts: Shaped[Array, " n"], x: Shaped[Array, ""], upward: Bool[Array, ""]
) -> tuple[Int[Array, ""], Shaped[Array, ""], Bool[Array, ""]]:
    """Return the interval between sorted numbers that holds x when moving upward or downward, and its end.

    **Arguments:** `starts`: starts of the intervals, 0 or more, the first 0.

    **Returns:** its index; its end, beyond x by more than rounding; whether there is an end above 0.
    """
    rounding = 64 * float(jnp.finfo(x.dtype).eps)
    stretch = jnp.maximum(count_up_to(starts, x * select(upward, 1 + rounding, 1 - rounding)) - 1, 0)
    following = select(upward, stretch + 1, stretch)
    end = take(starts, jnp.minimum(following, starts.size - 1))
    return stretch, end, (following < starts.size) & (end > 0)
