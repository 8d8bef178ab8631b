"""Functions of arrays, element by element: a `LaneFunction` of one element, at many elements."""

import functools
import inspect
import math
from collections.abc import Callable
from typing import Any, get_args, get_origin

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxrock._core.arrays import as_real, check_shapes, is_concrete, to_device
from jaxrock._core.settings import under_usual_settings
from jaxrock.compiler.hints.padded_size import padded_size
from jaxrock.compiler.primitive.make import lane_function


def elementwise(refill: bool = False, **checks: Callable) -> Callable:
    """Decorate a function of one element, so that it takes arrays that broadcast, and runs as a lane function.

    The function has derivatives of every order, and runs in machine code where llvmlite is installed. It must depend on
    its arguments alone. A function of the package is kept between sessions, as its code is known to be the same; any
    other one is traced in every session.

    **Arguments:**

    - `refill`: whether a lane whose loop is finished takes the next element. The function is then one loop.
    - `checks`: by the name of an argument, `check(name, value)`, which returns an array or raises ValueError. Other
      arguments are converted to floating-point arrays.

    **Returns:** a decorator.

    **Example:**

    ```python
    import jax, jax.numpy as jnp
    from jaxrock.compiler import elementwise

    @elementwise(refill=True)
    def square_root(a):  # by Newton's steps
        return jax.lax.while_loop(lambda x: abs(x * x - a) > 1e-6 * a, lambda x: (x + a / x) / 2, a)

    roots = square_root(jnp.array([4.0, 9.0]))
    slope = jax.grad(square_root)(4.0)
    ```
    """

    def decorate(function: Callable) -> Callable:
        signature = inspect.signature(function)
        name = f"{function.__module__}.{function.__qualname__}"
        is_known = name.startswith(f"{__name__.split('.')[0]}.") and "<" not in name
        one = lane_function(
            lambda values: function(*values),
            key=name if is_known else None,
            results=_told_by(signature.return_annotation),
            in_lanes=True,
            refill=refill,
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
            if not is_concrete(values) or any(x.size == 0 for x in values):
                return compiled(*values)
            return _with_room(compiled, values)

        return checked_and_compiled

    return decorate


def _at_elements(one: Callable, *values) -> Any:
    """Map a lane function of one element over arrays that broadcast."""
    values = jnp.broadcast_arrays(*values)
    shape = values[0].shape
    if shape == ():
        return one(values)
    found = jax.vmap(lambda *values: one(values))(*(x.ravel() for x in values))
    return jax.tree.map(lambda x: x.reshape(shape), found)


def _with_room(function: Callable, values: list) -> Any:
    """Call a function of concrete arrays at a padded length: it is compiled for few lengths, not for every shape."""
    shape = np.broadcast_shapes(*(x.shape for x in values))
    if shape == ():
        return function(*values)
    size = math.prod(shape)
    room = padded_size(size)
    filled = [np.empty(room, x.dtype) for x in values]
    for whole, x in zip(filled, values):
        whole[:size] = np.broadcast_to(np.asarray(x), shape).ravel()
        whole[size:] = whole[size - 1]  # copies of the last element: the padding takes no longer
    found = function(*filled)
    return jax.tree.map(lambda x: to_device(np.asarray(x)[:size].reshape(shape)), found)


def _told_by(annotation: Any) -> Callable | None:
    """Return a function from the values of one element to the types of its results; None if these are not annotated.

    The annotation of the result must be `Float` numbers, or tuples of them.
    """
    if get_origin(annotation) is tuple:
        parts = [_told_by(part) for part in get_args(annotation)]
        known = [part for part in parts if part is not None]
        return (lambda values: tuple(part(values) for part in known)) if len(known) == len(parts) else None
    if getattr(annotation, "dtype", None) is Float:
        return lambda values: jax.ShapeDtypeStruct((), values[0].dtype)
    return None
