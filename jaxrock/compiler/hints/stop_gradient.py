"""Zero tangents for a whole tree by one operation: `jax.lax.stop_gradient` takes one for each leaf."""

from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

Tree = TypeVar("Tree")
_stop_gradient_p = Primitive("stop_gradient_of_tree")
_stop_gradient_p.multiple_results = True


def stop_gradient(tree: Tree) -> Tree:
    """Return a tree whose derivatives are zero.

    **Arguments:**

    - `tree`: arrays in a tree; other leaves are returned unchanged.

    **Returns:** the same values.
    """
    flat: tuple[list, Any] = jax.tree.flatten(tree)
    leaves, structure = flat
    moving = [getattr(x, "dtype", None) is not None and jnp.issubdtype(x.dtype, jnp.inexact) for x in leaves]
    found = iter(_stop_gradient_p.bind(*(x for x, moves in zip(leaves, moving) if moves)))
    return structure.unflatten([next(found) if moves else x for x, moves in zip(leaves, moving)])


def _still(values, changes):
    found = _stop_gradient_p.bind(*values)
    return found, [ad.Zero(jax.typeof(x).to_tangent_aval()) for x in found]


_stop_gradient_p.def_impl(lambda *values: list(values))
_stop_gradient_p.def_abstract_eval(lambda *types: list(types))
batching.primitive_batchers[_stop_gradient_p] = lambda values, axes: (_stop_gradient_p.bind(*values), list(axes))
ad.primitive_jvps[_stop_gradient_p] = _still
mlir.register_lowering(_stop_gradient_p, lambda context, *values: list(values))
