"""Argument checks: one message template, for values that are known and for values under jit."""

import contextlib
import contextvars
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import get_opaque_trace_state
from jaxtyping import Array, ArrayLike, Bool, Inexact

from jaxrock._guard import guarded

Values = ArrayLike | Sequence[float | int] | Sequence[Sequence[float | int]]


def as_real(name: str, value: Values) -> Inexact[Array, "..."]:
    """Return `value` as a floating-point array, or say what it is instead; what is known stays so within `jax.jit`."""
    if any(isinstance(part, jax.core.Tracer) for part in jax.tree.leaves(value)):
        return _as_real(name, value)
    with jax.ensure_compile_time_eval():
        return _as_real(name, value)


def _as_real(name: str, value: Values) -> Inexact[Array, "..."]:
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

    A known value that fails raises ValueError at once, within `jax.jit` too; one that is traced carries a check, which
    raises when the compiled function meets it (see `_guard`).
    """
    array = as_real(name, value)
    message = f"Argument `{name}` must {allowed}"
    if isinstance(array, jax.core.Tracer):
        return watched(array, message, _failed(holds)(array))
    good = holds(np.asarray(array))
    if isinstance(good, jax.core.Tracer):
        return watched(array, message, ~jnp.all(good))
    known, good = np.asarray(array), np.broadcast_to(np.asarray(good), array.shape)
    if not good.all():
        raise ValueError(f"{message}, but is {known[~good].flat[0]}.")
    return array


def _failed(holds: Callable) -> Callable:
    """Whether it does not hold somewhere. Under `jax.vmap` outside of `jax.jit` every operation is compiled by itself:
    what is there once and for all is one operation."""
    is_constant = getattr(holds, "__closure__", None) is None and "<locals>" not in holds.__qualname__
    return _compiled_failed(holds) if is_constant else lambda array: ~jnp.all(holds(array))


@functools.cache
def _compiled_failed(holds: Callable) -> Callable:
    return jax.jit(lambda array: ~jnp.all(holds(array)), inline=True)


def watched(values, message: str, failed: Bool[ArrayLike, ""]):
    """Return `values`, which are traced, with a check: it is put down, or made where they are computed."""
    state, checks = _put_down.get()
    if state is not None and state == get_opaque_trace_state():
        checks.append((message, failed))
        return values
    return guarded(values, failed, message + ".")


# What is traced where checks are put down, and these; every thread has its own.
_put_down = contextvars.ContextVar("put_down", default=(None, None))


@contextlib.contextmanager
def put_down():
    """Checks of traced values are not made, but put down: pairs of a message, and whether the check has failed.

    A program that may raise is not kept by JAX's cache of compiled programs; one that returns what was put down is.
    Checks within transformations of the function that is traced here are still made.
    """
    checks = []
    before = _put_down.set((get_opaque_trace_state(), checks))
    try:
        yield checks
    finally:
        _put_down.reset(before)


class Range(NamedTuple):
    """The numbers that are allowed somewhere; called with a name and a value it returns the value as such an array."""

    allowed: str  # in words, after "must"
    low: float  # ends of the interval in which a number may be moved
    high: float
    holds: Callable

    def __call__(self, name: str, value: Values) -> Inexact[Array, "..."]:
        """Return `value` as an array of these numbers, or raise ValueError."""
        return checked(name, value, self.allowed, self.holds)


positive = Range("be positive and finite", 0.0, np.inf, lambda x: (x > 0) & (x < np.inf))
not_negative = Range("be 0 or more and finite", 0.0, np.inf, lambda x: (x >= 0) & (x < np.inf))
finite = Range("be finite", -np.inf, np.inf, lambda x: (x > -np.inf) & (x < np.inf))
not_nan = Range("be a number", -np.inf, np.inf, lambda x: x == x)  # some may be infinite
acute = Range("be in (0, pi/2)", 0.0, np.pi / 2, lambda x: (x > 0) & (x < np.pi / 2))  # an angle below a right one
share = Range("be in [0, 1]", 0.0, 1.0, lambda x: (x >= 0) & (x <= 1))
RANGES = {
    "positive": positive, "not_negative": not_negative, "finite": finite, "not_nan": not_nan, "acute": acute,
    "share": share,
}  # fmt: skip


def scalar(name: str, array: Inexact[Array, "..."]) -> Inexact[Array, ""]:
    """Return `array` if it is one number."""
    if array.ndim:
        raise ValueError(f"Argument `{name}` must be one number, but has shape {array.shape}. Use jax.vmap for many.")
    return array


def whole(name: str, value: int | None, least: int) -> None:
    """Raise ValueError for what is no whole number from `least` on, or None."""
    good = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if value is not None and not (good and value >= least):
        raise ValueError(f"Argument `{name}` must be a whole number, at least {least}, but is {value!r}.")


def instance(name: str, value: Any, kind: type, words: str) -> None:
    """Raise ValueError for what is not of a kind."""
    if not isinstance(value, kind):
        raise ValueError(f"Argument `{name}` must be {words}, but is {value!r}.")


def one_of(name: str, value: str, allowed: tuple[str, ...]) -> str:
    """Return `value` if it is one of the allowed words."""
    if value not in allowed:
        words = ", ".join(repr(word) for word in allowed)
        raise ValueError(f"Argument `{name}` must be one of {words}, but is {value!r}.")
    return value
