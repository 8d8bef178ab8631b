"""What comes before a loop, in machine code: XLA would compile a program for every few operations."""

from collections.abc import Callable
from typing import Any

import jax

from jaxrock.transforms.differentiation import differentiable

_SHORT = 8  # numbers of an array that machine code keeps in registers


def prepared(function: Callable, tree: Any) -> Any:
    """`function(tree)`, numbers and short arrays by machine code where that is; long ones, which many scenes may share,
    by XLA. It is part of something that forward mode goes through as a whole.

    `function`: of a module, of one scene, depends on nothing else; `tree`: its argument, of arrays.
    """
    whole = function(tree)
    like = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in numbers_of(whole)]
    found = differentiable(
        lambda tree: numbers_of(function(tree)),
        name=f"{function.__module__}.{function.__qualname__}",
        results=lambda _: like,
        in_lanes=True,
        derivatives="in a direction",
    )(tree)
    return with_numbers(whole, found)


def numbers_of(tree: Any) -> list:
    """Numbers and short arrays in a tree."""
    return [x for x in jax.tree.leaves(tree) if _is_short(x)]


def with_numbers(tree: Any, numbers: list) -> Any:
    """A tree with these instead of its own."""
    rest = iter(numbers)
    return jax.tree.map(lambda x: next(rest) if _is_short(x) else x, tree)


def _is_short(x: Any) -> bool:
    return isinstance(x, jax.Array) and x.size <= _SHORT
