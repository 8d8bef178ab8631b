"""Compile the setup of a loop as a lane function: XLA would compile many small kernels."""

from collections.abc import Callable
from typing import Any

import jax

from jaxrock.compiler import lane_function

_SHORT = 8  # numbers in an array that machine code keeps in registers


def compile_setup(function: Callable, tree: Any) -> Any:
    """Return `function(tree)`: machine code computes numbers and short arrays, XLA long ones, which scenes may share.

    It is part of a function that forward mode follows as a whole.

    **Arguments:**

    - `function`: function at module level, for one scene, that depends on its argument only.
    - `tree`: its argument, of arrays.
    """
    whole = function(tree)
    like = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in numbers_of(whole)]
    found = lane_function(
        lambda tree: numbers_of(function(tree)),
        key=f"{function.__module__}.{function.__qualname__}",
        results=lambda _: like,
        in_lanes=True,
        mode="jvp",
    )(tree)
    return with_numbers(whole, found)


def numbers_of(tree: Any) -> list:
    """Return the numbers and short arrays of a tree."""
    return [x for x in jax.tree.leaves(tree) if _is_short(x)]


def with_numbers(tree: Any, numbers: list) -> Any:
    """Return a tree with its numbers and short arrays replaced."""
    rest = iter(numbers)
    return jax.tree.map(lambda x: next(rest) if _is_short(x) else x, tree)


def _is_short(x: Any) -> bool:
    return isinstance(x, jax.Array) and x.size <= _SHORT
