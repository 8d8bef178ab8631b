"""A word, once, where numbers are single precision by default."""

import functools
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
        stacklevel=_LEVEL,
    )


_LEVEL = 5  # from here to who called `outcome` or `simulate`
