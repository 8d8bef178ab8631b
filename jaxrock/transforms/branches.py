"""Branches that `jax.vmap` does not turn into both of their sides."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import ArrayLike, Bool, PyTree

from jaxrock.numerics.xla_cpu import are_marked, keep

Flag = Bool[ArrayLike, ""]


def when(needed: Flag, function: Callable, value: PyTree) -> PyTree:
    """`function(value, needed, inside)` where needed; under vmap the function runs only if some lane needs it.

    What the function makes from values outside must pass through `inside` first: otherwise XLA moves it
    out of the branch, and every step pays for it.
    """

    def body(carry):
        first, value = carry

        # The flag changes in the loop: what depends on it stays in the loop.
        witness = jnp.where(first, 0.0, -1.0) if are_marked() else None

        def inside(x):
            return x if witness is None else keep(x, witness)

        return jnp.zeros_like(first), function(value, first, inside)

    return jax.lax.while_loop(lambda carry: carry[0], body, (needed, value))[1]


def either(needed: Flag, function: Callable, value: PyTree) -> PyTree:
    """As `when`, but always computed, so that reverse mode goes through."""
    return jax.tree.map(lambda a, b: jnp.where(needed, a, b), function(value, needed, lambda x: x), value)
