"""A branch that reverse mode goes through: both of its sides are computed."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import ArrayLike, Bool, PyTree


def cond_select(needed: Bool[ArrayLike, ""], function: Callable, value: PyTree) -> PyTree:
    """Return `function(value, needed, inside)` where needed, as `jaxrock.compiler.cond_any`, but always computed."""
    return jax.tree.map(lambda a, b: jnp.where(needed, a, b), function(value, needed, lambda x: x), value)
