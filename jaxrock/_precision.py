"""A word, once, where numbers are single precision by default."""

import functools
import sys
import warnings

import jax


def say_if_single() -> None:
    """Warn, once in a process, if JAX computes in single precision; to be called by what users call."""
    if not jax.config.jax_enable_x64:
        _say()


@functools.cache
def _say() -> None:
    warnings.warn(
        "jaxrock runs in single precision here: expect 5 digits. For 13, put "
        '`jax.config.update("jax_enable_x64", True)` before the first computation.',
        stacklevel=_frames_of_the_package() + 1,
    )


def _frames_of_the_package() -> int:
    """Of those that lead to the caller of this: after them comes who called the package."""
    frame, count = sys._getframe(1), 0
    while frame is not None and frame.f_globals.get("__name__", "").split(".")[0] == __name__.split(".")[0]:
        frame, count = frame.f_back, count + 1
    return count
