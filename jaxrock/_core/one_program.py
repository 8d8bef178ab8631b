"""Compile a function as one program: outside of `jax.jit`, JAX compiles every operation for every shape."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar, cast

import jax

from jaxrock._core.arrays import is_concrete, is_traced
from jaxrock._core.settings import called_by_users, under_usual_settings

Making = TypeVar("Making", bound=Callable)


def by_numpy_or_one_program(**settings: Any) -> Callable[[Making], Making]:
    """Decorate a function so that NumPy runs it on concrete arguments, and one compiled program on others.

    **Arguments:**

    - `settings`: arguments of `jax.jit`.
    """

    def decorate(function: Making) -> Making:
        compiled = jax.jit(function, **settings)

        @under_usual_settings
        @functools.wraps(function)
        def run(*args: Any) -> Any:
            return function(*args) if is_concrete(args) else compiled(*args)

        return cast(Making, run)

    return decorate


def check_known(**values: Any) -> None:
    """Raise ValueError for a traced value, where the function computes by NumPy."""
    for name, value in values.items():
        if is_traced(value):
            raise ValueError(
                f"Argument `{name}` must be known: this is no function under `jax.jit`, `jax.vmap` or a derivative."
            )


def one_program(function: Making) -> Making:
    """Decorate a pure function of arrays: on concrete arguments all its operations are one compiled program.

    Without it, each operation would be compiled for every shape. Traced arguments pass to the function itself.
    """
    compiled = jax.jit(function)

    @called_by_users
    @functools.wraps(function)
    def run(*args: Any) -> Any:
        return function(*args) if is_traced(args) else compiled(*args)

    return cast(Making, run)
