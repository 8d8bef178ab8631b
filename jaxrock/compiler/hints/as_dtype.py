"""Conversion to a dtype with a fast way for values that have it already: tracing calls it thousands of times."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def as_dtype(value: Any, dtype: np.dtype) -> Any:
    """Return `value` as an array of a dtype, as `jnp.asarray` does.

    **Arguments:**

    - `value`: array or number. `dtype`: NumPy dtype.

    **Returns:** `value` itself if it has the dtype and no weak type, else an array of JAX. A Python number that becomes
    a floating-point one gives an array of NumPy.
    """
    if isinstance(value, jax.Array):
        kind = jax.typeof(value)
        if kind.dtype == dtype and not kind.weak_type:
            return value
    elif type(value) in (float, int) and dtype.kind == "f":
        return np.asarray(value, dtype)
    return jnp.asarray(value, dtype)


def common_type(*values: Any) -> np.dtype:
    """Return the dtype of `jnp.result_type`, sooner for arrays of one floating-point type."""
    kinds: set[np.dtype] = set()
    for value in values:
        if type(value) in (float, int):  # a weak type gives way to floating-point arrays
            continue
        kind = jax.typeof(value) if isinstance(value, jax.Array) else None
        if kind is None or kind.dtype.kind != "f":
            return jnp.result_type(*values)
        kinds.add(kind.dtype)
    return kinds.pop() if len(kinds) == 1 else jnp.result_type(*values)
