"""Functions of arrays, element by element: programs of one element at many, with derivatives."""

import functools
import inspect
import math
from collections.abc import Callable
from typing import Any, get_args, get_origin

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxrock._checks import as_real, check_shapes, is_at_hand, placed
from jaxrock._settings import under_usual_settings
from jaxrock.transforms.differentiation import differentiable


def elementwise(refilled: bool = False, **checks: Callable) -> Callable:
    """Decorate a function of arrays that broadcast: it is that of one element at many, with derivatives as those of a
    scene, in machine code where that is, and in another session without tracing.

    `refilled`: whether in its one loop elements that are done make room for others (see `Recipe`). `checks`: of
    arguments by name; the others are numbers.
    """

    def decorate(function: Callable) -> Callable:
        signature = inspect.signature(function)
        one = differentiable(
            lambda values: function(*values),
            name=f"{function.__module__}.{function.__qualname__}",
            results=_told_by(signature.return_annotation),
            in_lanes=True,
            refilled=refilled,
        )
        compiled = jax.jit(functools.partial(_at_elements, one))

        @under_usual_settings
        @functools.wraps(function)
        def checked_and_compiled(*args, **kwargs):
            given = signature.bind(*args, **kwargs).arguments
            given = {name: checks.get(name, as_real)(name, value) for name, value in given.items()}
            check_shapes(**given)
            kind = jnp.result_type(*given.values())
            values = [x.astype(kind) for x in given.values()]
            if not is_at_hand(values) or any(x.size == 0 for x in values):
                return compiled(*values)
            return _with_room(compiled, values)

        return checked_and_compiled

    return decorate


def _at_elements(one: Callable, *values) -> Any:
    """A function of one element at all."""
    values = jnp.broadcast_arrays(*values)
    shape = values[0].shape
    if shape == ():
        return one(values)
    found = jax.vmap(lambda *values: one(values))(*(x.ravel() for x in values))
    return jax.tree.map(lambda x: x.reshape(shape), found)


_LEAST, _DOUBLED = 8, 4096  # elements for which there is room, and up to which room is doubled


def room_for(size: int) -> int:
    """Room for so many: a few numbers serve all."""
    doubled = 1 << (max(size, _LEAST) - 1).bit_length()
    return doubled if size <= _DOUBLED else -(-size // (doubled // 8)) * (doubled // 8)


def _with_room(function: Callable, values: list) -> Any:
    """The function of known arrays: of any shape in a few lengths, for each of which it is compiled."""
    shape = np.broadcast_shapes(*(x.shape for x in values))
    if shape == ():
        return function(*values)
    size = math.prod(shape)
    room = room_for(size)
    filled = [np.empty(room, x.dtype) for x in values]
    for whole, x in zip(filled, values):
        whole[:size] = np.broadcast_to(np.asarray(x), shape).ravel()
        whole[size:] = whole[size - 1]  # elements like another: none takes longer
    found = function(*filled)
    return jax.tree.map(lambda x: placed(np.asarray(x)[:size].reshape(shape)), found)


def _told_by(annotation: Any) -> Callable | None:
    """Of the values of one element what a function returns, by its annotation: numbers of their kind, or tuples of
    these; None: it does not tell."""
    if get_origin(annotation) is tuple:
        parts = [_told_by(part) for part in get_args(annotation)]
        known = [part for part in parts if part is not None]
        return (lambda values: tuple(part(values) for part in known)) if len(known) == len(parts) else None
    if getattr(annotation, "dtype", None) is Float:
        return lambda values: jax.ShapeDtypeStruct((), values[0].dtype)
    return None
