"""Selection as a single operation: `jnp.where` adds a nested jaxpr for each of hundreds of calls."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrock.compiler.hints.as_dtype import as_dtype, common_type


def select(condition: Any, one: Any, other: Any) -> jax.Array:
    """Return `one` where a condition holds, and `other` elsewhere, as `jnp.where` does.

    **Arguments:**

    - `condition`: flags, or one flag for whole arrays. `one`, `other`: arrays or numbers.

    **Returns:** an array of their common type, by one operation if both have the same shape.
    """
    shape = np.shape(one)  # one flag may choose the whole array
    if shape != np.shape(other) or np.shape(condition) not in (shape, ()) or (_yields(one) and _yields(other)):
        return jnp.where(condition, one, other)
    dtype = common_type(one, other)
    return jax.lax.select_n(jnp.asarray(condition), as_dtype(other, dtype), as_dtype(one, dtype))


def _yields(value: Any) -> bool:
    """Return whether a number has a weak type, which gives way to the types of others."""
    return isinstance(value, (bool, int, float)) or getattr(jax.typeof(value), "weak_type", False)
