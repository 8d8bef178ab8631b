"""One of two values by a condition, as one operation: `jnp.where` is a call of a function, and there are hundreds."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrock.numerics.typed import common_type, typed


def where(condition: Any, one: Any, other: Any) -> jax.Array:
    """`one` where a condition holds, else `other`, as `jnp.where` has it."""
    shape = np.shape(one)  # of which one flag may choose the whole
    if shape != np.shape(other) or np.shape(condition) not in (shape, ()) or (_yields(one) and _yields(other)):
        return jnp.where(condition, one, other)
    dtype = common_type(one, other)
    return jax.lax.select_n(jnp.asarray(condition), typed(other, dtype), typed(one, dtype))


def _yields(value: Any) -> bool:
    """Return whether the type of a number gives way to that of others."""
    return isinstance(value, (bool, int, float)) or getattr(jax.typeof(value), "weak_type", False)
