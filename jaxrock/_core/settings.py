"""Settings of JAX under which the package computes, independent of those with which users check their own code.

Some settings make JAX stricter. It raises for every NaN (`jax_debug_nans`), for operands of two types
(`jax_numpy_dtype_promotion`), for implicit transfers to a device (`jax_transfer_guard`). They find mistakes in the
user's own code. Results of this package hold NaN and infinity by contract, beside a status that says so. Its programs
mix types and transfer numbers on purpose.

So public functions run under the usual settings, as do the rules by which JAX transforms and compiles them. The user's
code around them keeps its own settings. JAX keeps each of these settings by thread, and nothing global changes.
"""

import contextlib
import functools
from collections.abc import Callable, Iterator
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

_P = ParamSpec("_P")
_R = TypeVar("_R")

_LENIENT = (None, "allow", "log", "log_explicit")
# By name: values that stay, and the context that sets the usual value instead of any other.
_USUAL: dict[str, tuple[tuple, Callable]] = {
    "jax_debug_nans": ((False,), lambda: jax.debug_nans(False)),
    "jax_debug_infs": ((False,), lambda: jax.debug_infs(False)),
    "jax_disable_jit": ((False,), lambda: jax.disable_jit(False)),
    "jax_numpy_dtype_promotion": (("standard",), lambda: jax.numpy_dtype_promotion("standard")),
    "jax_numpy_rank_promotion": (("allow", "warn"), lambda: jax.numpy_rank_promotion("allow")),
    "jax_transfer_guard_host_to_device": (_LENIENT, lambda: jax.transfer_guard_host_to_device("allow")),
    "jax_transfer_guard_device_to_device": (_LENIENT, lambda: jax.transfer_guard_device_to_device("allow")),
    "jax_transfer_guard_device_to_host": (_LENIENT, lambda: jax.transfer_guard_device_to_host("allow")),
}


@contextlib.contextmanager
def usual_settings() -> Iterator[None]:
    """Enter, in this thread, the settings of JAX under which the package computes."""
    with contextlib.ExitStack() as stack:
        for _, usual in _unusual():
            stack.enter_context(usual())
        yield


def _unusual() -> list[tuple[str, Callable]]:
    """Return the settings that a user has made stricter, each with the context that undoes it."""
    config: Any = jax.config
    return [(name, usual) for name, (allowed, usual) in _USUAL.items() if getattr(config, name) not in allowed]


def under_usual_settings(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorate a function to run under the package's settings of JAX, independent of its caller's settings."""

    @functools.wraps(function)
    def run(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        if not _unusual():
            return function(*args, **kwargs)
        with usual_settings():
            return function(*args, **kwargs)

    return run


# ------------------------------------------------------------------------------------------ the precision of a session


def kept_by_precision(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorate a function that makes NumPy arrays for programs of JAX: cache its results, separately for single and
    double precision.

    JAX caches the constant of a NumPy array, and reuses it in every later program that holds the same array. That holds
    also after `jax_enable_x64` has changed: such a program would not compile, or compute in single precision. A
    module's own array must therefore enter programs by `jnp.asarray` with a type, which converts it anew.
    """

    @functools.cache
    def kept(double: bool, args: tuple, named: tuple) -> Any:
        return function(*args, **dict(named))

    @functools.wraps(function)
    def run(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        config: Any = jax.config
        return kept(config.jax_enable_x64, args, tuple(kwargs.items()))

    return run


def is_wider(x: Any) -> bool:
    """Return whether a JAX array has a type that JAX has disabled, such as double precision."""
    return isinstance(x, jax.Array) and jax.dtypes.canonicalize_dtype(x.dtype) != x.dtype


def in_precision_of_session(tree: Any) -> Any:
    """Return a tree whose JAX arrays have enabled types.

    Arrays made in double precision become single where `jax.enable_x64(False)` holds, as NumPy arrays do in JAX.
    """
    config: Any = jax.config
    if config.jax_enable_x64:
        return tree
    try:
        flat: tuple[list, Any] = jax.tree.flatten(tree)
    except (TypeError, ValueError):  # keys that cannot be sorted: the decorated function raises for them
        return tree
    leaves, structure = flat
    if not any(map(is_wider, leaves)):
        return tree
    return structure.unflatten([narrowed(x) for x in leaves])


def called_by_users(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorate a public function: it runs under the package's settings, on arrays of enabled types."""

    @under_usual_settings
    @functools.wraps(function)
    def run(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        given = tuple(map(in_precision_of_session, args))  # one by one: a half-built object must stay itself
        return function(*given, **{name: in_precision_of_session(value) for name, value in kwargs.items()})

    return run


def narrowed(x: Any) -> Any:
    """Return a JAX array in an enabled type, and anything else unchanged."""
    if not is_wider(x):
        return x
    kind = jax.dtypes.canonicalize_dtype(x.dtype)
    if isinstance(x, jax.core.Tracer) or x.committed:
        return jnp.asarray(x, kind)
    return jax.device_put(np.asarray(x).astype(kind))
