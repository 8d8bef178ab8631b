"""Looking up a value by a number that differs from lane to lane."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Int, Shaped

_FEW = 8


def pick(values: Shaped[Array, " n"], index: Int[ArrayLike, ""]) -> Shaped[Array, ""]:
    """`values[index]`; of a few values by comparison, because looking up does not vectorise."""
    if values.shape[0] > _FEW:
        return values[index]
    value = values[0]
    for i in range(1, values.shape[0]):
        value = jnp.where(index >= i, values[i], value)
    return value
