"""Compilation in the least time, for programs that run only briefly."""

import functools
import importlib.util
from collections.abc import Callable
from typing import Any, TypeVar, cast

import jax
import numpy as np

from jaxrock._core.arrays import is_traced
from jaxrock._core.settings import under_usual_settings

Made = TypeVar("Made", bound=Callable)

LOW_EFFORT_LIMIT = 100_000  # numbers; with more, a program runs long enough for good code to pay
_NO_EFFORT = {"xla_backend_optimization_level": 0}  # XLA's level for LLVM
_OLDER_EMITTERS = {"xla_cpu_use_fusion_emitters": False}  # newer jaxlibs lack this option


@functools.cache
def low_effort_options() -> dict[str, Any]:
    """Return XLA's options for compilation in the least time on CPUs, as far as this jaxlib has them."""
    for known in (_NO_EFFORT | _OLDER_EMITTERS, _NO_EFFORT):
        try:
            jax.jit(lambda x: x + 1, compiler_options=known).lower(1.0).compile()
        except Exception:  # JAX reports unknown options by an internal error type
            continue
        return known
    return {}


@functools.cache
def _has_machine_code() -> bool:
    return importlib.util.find_spec("llvmlite") is not None


def jit_low_effort(jit: Callable = jax.jit, follows_scenes: bool = False, **settings: Any) -> Callable[[Made], Made]:
    """Decorate a function of few numbers, so that XLA compiles it in the least time on CPUs.

    Compilation takes less than half of the time, and the program up to three times as long to run
    (`benchmarks/fits.py`). Traced into another program, the function gets the options of that program.

    **Arguments:**

    - `jit`: `jax.jit`, or a function like it. `settings`: its further arguments.
    - `follows_scenes`: whether the function runs lane functions. Then it is compiled with least effort only where these
      are machine code of `llvm`, and not XLA's.

    **Returns:** a decorator. The decorated function is compiled as usual for arguments that are traced, larger than
    `LOW_EFFORT_LIMIT` or not on a CPU.
    """

    def decorate(function: Made) -> Made:
        whole = jit(function, **settings)

        @functools.cache
        def at_once() -> Callable:
            return jit(function, compiler_options=low_effort_options(), **settings)

        @under_usual_settings
        @functools.wraps(function)
        def run(*args: Any, **named: Any) -> Any:
            few = (not follows_scenes or _has_machine_code()) and _are_few((args, named))
            by_itself = few and not is_traced(jax.lax.neg(0.0))  # False while a program around it is traced
            return (at_once() if by_itself else whole)(*args, **named)

        return cast(Made, run)

    return decorate


def _are_few(tree: Any) -> bool:
    """Return whether all arrays in a tree are concrete, small, and on a CPU."""
    arrays = [x for x in jax.tree.leaves(tree) if isinstance(x, (jax.Array, np.ndarray))]
    if is_traced(tree) or sum(x.size for x in arrays) > LOW_EFFORT_LIMIT:
        return False
    platforms = {device.platform for x in arrays if isinstance(x, jax.Array) for device in x.devices()}
    return platforms == {"cpu"}
