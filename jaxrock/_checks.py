"""Argument checks: one message template, for values that are known and for values under jit."""

import contextlib
import functools
import inspect
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import get_opaque_trace_state
from jaxtyping import Array, ArrayLike, Bool, Inexact

Values = ArrayLike | Sequence[float | int] | Sequence[Sequence[float | int]]


def as_real(name: str, value: Values) -> Inexact[Array, "..."]:
    """Return `value` as a floating-point array, or say what it is instead."""
    try:
        array = jnp.asarray(value)
    except (TypeError, ValueError) as error:
        raise ValueError(f"Argument `{name}` must be a number or an array of numbers, but is {value!r}.") from error
    if jnp.issubdtype(array.dtype, jnp.complexfloating):
        raise ValueError(f"Argument `{name}` must be real, but is {value!r}.")
    if not jnp.issubdtype(array.dtype, jnp.floating):
        array = array.astype(jnp.result_type(float))
    # A Python float leaves a weak type behind, which would recompile every function it meets.
    return jax.lax.convert_element_type(array, array.dtype)


def checked(name: str, value: Values, allowed: str, holds: Callable) -> Inexact[Array, "..."]:
    """Return `value` as an array for which `holds` is true everywhere.

    A known value that fails raises ValueError at once; one that is traced carries an
    `equinox.error_if`, which raises when the compiled function meets it.
    """
    array = as_real(name, value)
    message = f"Argument `{name}` must {allowed}"
    good = holds(array)
    if isinstance(array, jax.core.Tracer) or isinstance(good, jax.core.Tracer):
        return watched(array, message, ~jnp.all(good))
    known, good = np.asarray(array), np.broadcast_to(np.asarray(good), array.shape)
    if not good.all():
        raise ValueError(f"{message}, but is {known[~good].flat[0]}.")
    return array


def watched(values, message: str, failed: Bool[ArrayLike, ""]):
    """Return `values`, which are traced, with a check: it is put down, or made where they are computed."""
    if _put_down is not None and _put_down[0] == get_opaque_trace_state():
        _put_down[1].append((message, failed))
        return values
    return eqx.error_if(values, failed, message + ".")


_put_down: tuple | None = None


@contextlib.contextmanager
def put_down():
    """Checks of traced values are not made, but put down: pairs of a message, and whether the check has failed.

    A program that may raise is not kept by JAX's cache of compiled programs; one that returns what was put down is.
    Checks within transformations of the function that is traced here are still made.
    """
    global _put_down
    before, found = _put_down, []
    _put_down = get_opaque_trace_state(), found
    try:
        yield found
    finally:
        _put_down = before


def positive(name: str, value: Values) -> Inexact[Array, "..."]:
    """Return `value` as an array of positive finite numbers."""
    return checked(name, value, "be positive and finite", lambda x: (x > 0) & (x < np.inf))


def finite(name: str, value: Values) -> Inexact[Array, "..."]:
    """Return `value` as an array of finite numbers."""
    return checked(name, value, "be finite", lambda x: (x > -np.inf) & (x < np.inf))


def not_nan(name: str, value: Values) -> Inexact[Array, "..."]:
    """Return `value` as an array of numbers, of which some may be infinite."""
    return checked(name, value, "be a number", lambda x: x == x)


def acute(name: str, value: Values) -> Inexact[Array, "..."]:
    """Return `value` as an array of angles between 0 and a right one."""
    return checked(name, value, "be in (0, pi/2)", lambda x: (x > 0) & (x < np.pi / 2))


def share(name: str, value: Values) -> Inexact[Array, "..."]:
    """Return `value` as an array of numbers from 0 to 1."""
    return checked(name, value, "be in [0, 1]", lambda x: (x >= 0) & (x <= 1))


def scalar(name: str, array: Inexact[Array, "..."]) -> Inexact[Array, ""]:
    """Return `array` if it is one number."""
    if array.ndim:
        raise ValueError(f"Argument `{name}` must be one number, but has shape {array.shape}. Use jax.vmap for many.")
    return array


def one_of(name: str, value: str, allowed: tuple[str, ...]) -> str:
    """Return `value` if it is one of the allowed words."""
    if value not in allowed:
        words = ", ".join(repr(word) for word in allowed)
        raise ValueError(f"Argument `{name}` must be one of {words}, but is {value!r}.")
    return value


def elementwise(**checks: Callable) -> Callable:
    """Decorate a function of arrays that broadcast: its arguments are checked, by name, and it is compiled."""

    def decorate(function: Callable) -> Callable:
        signature = inspect.signature(function)
        compiled = jax.jit(lambda *values: function(*jnp.broadcast_arrays(*values)))

        @functools.wraps(function)
        def checked_and_compiled(*args, **kwargs):
            given = signature.bind(*args, **kwargs).arguments
            return compiled(*(checks[name](name, value) for name, value in given.items()))

        return checked_and_compiled

    return decorate
