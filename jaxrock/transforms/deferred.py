"""Functions that JAX traces only where it compiles them, because tracing them takes seconds."""

from collections.abc import Callable

import jax
from jax.extend.core import ClosedJaxpr, Primitive

try:
    from jax.interpreters.mlir import lower_fun, register_lowering
except ImportError:  # a release of JAX without them
    lower_fun = None


_late_p = Primitive("late")


_late_p.multiple_results = True


class _Function:
    """A function of a flat list, which prints as what it was made of; what it returns is known before."""

    def __init__(self, call: Callable, results: tuple, told: str):
        self.call, self.results, self.told = call, results, told

    def __repr__(self):
        return self.told


def late(function: Callable, made_of: ClosedJaxpr, told: str, results) -> Callable:
    """`function(tree)`, which returns `results` (a tree of `jax.ShapeDtypeStruct`), traced where it is compiled.

    Under `jax.vmap` and `jax.jvp` it does not go: it belongs inside of what has rules for these. `made_of` and `told`
    stand for it in the text of programs, so they have to tell it from others.
    """

    if lower_fun is None:
        return function

    def run(tree):
        leaves, structure = jax.tree.flatten(tree)
        shapes, structure_of_results = jax.tree.flatten(results)
        flat = _Function(lambda leaves: jax.tree.leaves(function(structure.unflatten(leaves))), tuple(shapes), told)
        found = _late_p.bind(*leaves, function=flat, made_of=made_of)
        return structure_of_results.unflatten(found)

    return run


def _run(*leaves, function, made_of):
    return function.call(leaves)


_late_p.def_impl(_run)


if lower_fun is not None:
    register_lowering(_late_p, lower_fun(_run, multiple_results=True))


@_late_p.def_abstract_eval
def _(*leaves, function, made_of):
    return [jax.core.ShapedArray(x.shape, x.dtype) for x in function.results]
