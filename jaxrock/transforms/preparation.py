"""What comes before a loop and after it in machine code, where XLA would compile a program for every few operations."""

from collections.abc import Callable
from typing import Any

import jax

from jaxrock.transforms.differentiation import differentiable, with_derivatives_of

_SHORT = 8  # numbers of an array that machine code keeps in registers


def prepared(function: Callable, tree: Any, within: bool) -> Any:
    """`function(tree)`, a function of a module: numbers and short arrays by machine code where that is. Long arrays,
    which many scenes may share, are left to XLA.

    `within`: whether this is a part of something that forward mode goes through as a whole, of which all that it is
    told moves in one direction. If not, derivatives are those of the function as it is written.
    """
    whole, structure = jax.tree.flatten(function(tree))
    like = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in _short(whole)]
    run = differentiable(
        lambda tree: _short(jax.tree.leaves(function(tree))),
        name=f"{function.__module__}.{function.__qualname__}",
        results=lambda _: like,
        in_lanes=True,
        derivatives="in a direction",
    )
    found = run(tree if within else jax.lax.stop_gradient(tree))
    found = found if within else with_derivatives_of(found, _short(whole))
    rest = iter(found)
    return jax.tree.unflatten(structure, [next(rest) if _is_short(x) else x for x in whole])


def _is_short(x: jax.Array) -> bool:
    return x.size <= _SHORT


def _short(leaves: list) -> list:
    return [x for x in leaves if _is_short(x)]
