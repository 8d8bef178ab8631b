"""A value computed without derivatives, with the derivatives of an equal one."""

import jax
import jax.numpy as jnp

from jaxrock.compiler import custom_tangent


def with_derivatives_of(value, other):
    """Return `value` with the derivatives of `other`, which differs from it by rounding only.

    Without differentiation it costs nothing.

    **Arguments:**

    - `value`, `other`: arrays in trees of one structure.
    """
    return custom_tangent(_following, value, other)


def _following(_, other, tangents):
    return jax.tree.map(lambda x, d: jnp.zeros_like(x) if d is None else d, other, tangents)
