"""Functions that JAX traces only where it compiles them, because tracing them takes seconds."""

from collections.abc import Callable

import jax
from jax.extend.core import ClosedJaxpr, Primitive

try:
    from jax.interpreters.mlir import lower_fun, register_lowering
except ImportError:  # a release of JAX without them
    lower_fun = None


_deferred_p = Primitive("deferred")
_deferred_p.multiple_results = True


class _Function:
    """A function of a flat list with the shapes of its results, which prints as its description."""

    def __init__(self, call: Callable, results: tuple, description: str):
        self.call, self.results, self.description = call, results, description

    def __repr__(self):
        return self.description


def deferred(function: Callable, made_of: ClosedJaxpr, description: str, results) -> Callable:
    """`function(tree)`, which returns `results` (a tree of `jax.ShapeDtypeStruct`), traced where it is compiled.

    Under `jax.vmap` and `jax.jvp` it does not go: it belongs inside of what has rules for these. `made_of` and
    `description` stand for it in the text of programs, so they have to tell it from others.
    """

    if lower_fun is None:
        return function

    def run(tree):
        leaves, structure = jax.tree.flatten(tree)
        shapes, structure_of_results = jax.tree.flatten(results)

        def call(leaves):
            return jax.tree.leaves(function(structure.unflatten(leaves)))

        flat = _Function(call, tuple(shapes), description)
        return structure_of_results.unflatten(_deferred_p.bind(*leaves, function=flat, made_of=made_of))

    return run


def _run(*leaves, function, made_of):
    return function.call(leaves)


_deferred_p.def_impl(_run)


if lower_fun is not None:
    register_lowering(_deferred_p, lower_fun(_run, multiple_results=True))


@_deferred_p.def_abstract_eval
def _(*leaves, function, made_of):
    return [jax.core.ShapedArray(x.shape, x.dtype) for x in function.results]
