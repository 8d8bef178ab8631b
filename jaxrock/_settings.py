"""JAX's settings under which the package computes, whatever a user has set to look at own code.

Some settings make JAX stricter: it raises for every NaN (`jax_debug_nans`), for operands of two types
(`jax_numpy_dtype_promotion`), for numbers that go to a device unasked (`jax_transfer_guard`). They find mistakes in the
code that their user writes. Results of this package hold NaN and infinity by contract, beside a status that says so.
Its own programs mix types and place numbers on purpose. So public functions, and the rules by which JAX transforms and
compiles them, run under the usual settings; the user's code around them keeps its own. JAX keeps each of these settings
by thread, and nothing global changes.
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
# By name: values that are left as they are, and the context in which the setting is a usual one.
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
    """Within it, in this thread, JAX's settings are those under which the package computes."""
    with contextlib.ExitStack() as stack:
        for _, usual in _unusual():
            stack.enter_context(usual())
        yield


def _unusual() -> list[tuple[str, Callable]]:
    """Settings that a user has made stricter, with the contexts that undo it."""
    config: Any = jax.config
    return [(name, usual) for name, (allowed, usual) in _USUAL.items() if getattr(config, name) not in allowed]


def under_usual_settings(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorate a function that runs under the package's settings of JAX, whatever those of its caller are."""

    @functools.wraps(function)
    def run(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        if not _unusual():
            return function(*args, **kwargs)
        with usual_settings():
            return function(*args, **kwargs)

    return run


# ------------------------------------------------------------------------------------------ the precision of a session


def kept_by_precision(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorate a function that makes arrays of NumPy for programs of JAX: they are kept, those of single and of double
    precision apart.

    JAX keeps what it makes of an array of NumPy in a program, and gives it to every later program that holds the same
    array, also after `jax_enable_x64` has changed: that program would not compile, or compute in single precision. Such
    an array of a module comes to programs by `jnp.asarray` with a type, which makes it anew.
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
    """Whether an array of JAX is of a type that JAX has switched off, such as double precision."""
    return isinstance(x, jax.Array) and jax.dtypes.canonicalize_dtype(x.dtype) != x.dtype


def in_precision_of_session(tree: Any) -> Any:
    """A tree whose arrays of JAX are of types that are switched on: what was made in double precision is single where
    `jax.enable_x64(False)` holds, as JAX makes of NumPy's arrays."""
    config: Any = jax.config
    if config.jax_enable_x64:
        return tree
    try:
        flat: tuple[list, Any] = jax.tree.flatten(tree)
    except (TypeError, ValueError):  # keys of a dictionary that cannot be sorted: the function says what is wrong
        return tree
    leaves, structure = flat
    if not any(map(is_wider, leaves)):
        return tree
    return structure.unflatten([narrowed(x) for x in leaves])


def called_by_users(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorate what users call: it runs under the package's settings, on arrays of types that are switched on."""

    @under_usual_settings
    @functools.wraps(function)
    def run(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        given = tuple(map(in_precision_of_session, args))  # each by itself: an object that is being made stays as it is
        return function(*given, **{name: in_precision_of_session(value) for name, value in kwargs.items()})

    return run


def narrowed(x: Any) -> Any:
    """One array of JAX, of a type that is switched on; anything else as it is."""
    if not is_wider(x):
        return x
    kind = jax.dtypes.canonicalize_dtype(x.dtype)
    if isinstance(x, jax.core.Tracer) or x.committed:
        return jnp.asarray(x, kind)
    return jax.device_put(np.asarray(x).astype(kind))
