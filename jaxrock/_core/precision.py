"""A warning, once in a process, where JAX computes in single precision."""

import functools
import sys
import warnings
from typing import Any

import jax

_NOT_OF_USERS = (__name__.split(".")[0], "equinox", "jax", "functools", "contextlib")


def setting(name: str) -> Any:
    """Return a setting of JAX, whose settings type checkers do not see."""
    return getattr(jax.config, name)


def say_if_single() -> None:
    """Warn, once in a process, if JAX computes in single precision; public functions call it."""
    if not setting("jax_enable_x64"):
        _say()


@functools.cache
def _say() -> None:
    warnings.warn(
        "jaxrock runs in single precision here: expect 5 digits. For 13, put "
        '`jax.config.update("jax_enable_x64", True)` before the first computation.',
        stacklevel=frames_of_the_package() + 1,
    )


def frames_of_the_package() -> int:
    """Count the frames between the caller and the user's line: the package's, and those of libraries that call it."""
    frame, count = sys._getframe(1), 0
    while frame is not None and frame.f_globals.get("__name__", "").split(".")[0] in _NOT_OF_USERS:
        frame, count = frame.f_back, count + 1
    return count
