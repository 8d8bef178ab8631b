"""Numbers of one type, at once where they are that already: tracing asks for it thousands of times."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def typed(value: Any, dtype: np.dtype) -> Any:
    """As `jnp.asarray(value, dtype)`; of a number of Python's one of NumPy's."""
    if isinstance(value, jax.Array):
        kind = jax.typeof(value)
        if kind.dtype == dtype and not kind.weak_type:
            return value
    elif type(value) in (float, int) and dtype.kind == "f":
        return np.asarray(value, dtype)
    return jnp.asarray(value, dtype)


def common_type(*values: Any) -> np.dtype:
    """As `jnp.result_type`."""
    kinds: set[np.dtype] = set()
    for value in values:
        if type(value) in (float, int):  # which give way to real numbers
            continue
        kind = jax.typeof(value) if isinstance(value, jax.Array) else None
        if kind is None or kind.dtype.kind != "f":
            return jnp.result_type(*values)
        kinds.add(kind.dtype)
    return kinds.pop() if len(kinds) == 1 else jnp.result_type(*values)
