"""Programs that run for a moment, which XLA compiles in the least time."""

import functools
import importlib.util
from collections.abc import Callable
from typing import Any, TypeVar, cast

import jax
import numpy as np

from jaxrock._checks import is_traced
from jaxrock._settings import under_usual_settings

Made = TypeVar("Made", bound=Callable)

MUCH = 100_000  # numbers, with which a program runs long enough for it to matter how well it was compiled
_NO_EFFORT = {"xla_backend_optimization_level": 0}  # of LLVM
_OLDER_EMITTERS = {"xla_cpu_use_fusion_emitters": False}  # which newer jaxlibs do not have


@functools.cache
def options() -> dict[str, Any]:
    """XLA's options by which it compiles in the least time on CPUs, as far as this jaxlib knows them."""
    for known in (_NO_EFFORT | _OLDER_EMITTERS, _NO_EFFORT):
        try:
            jax.jit(lambda x: x + 1, compiler_options=known).lower(1.0).compile()
        except Exception:  # reported by an internal error type
            continue
        return known
    return {}


@functools.cache
def _has_machine_code() -> bool:
    return importlib.util.find_spec("llvmlite") is not None


def quickly(jit: Callable = jax.jit, follows_scenes: bool = False, **settings: Any) -> Callable[[Made], Made]:
    """Decorate a function of few numbers, compiled by `jit` with `settings`: on CPUs in less than half of the time, to
    what takes up to three times as long to run (`benchmarks/fits.py`). Within another program it is a part of that,
    which has options of its own. If it `follows_scenes`, only where these are machine code, not XLA's."""

    def decorate(function: Made) -> Made:
        whole = jit(function, **settings)

        @functools.cache
        def at_once() -> Callable:
            return jit(function, compiler_options=options(), **settings)

        @under_usual_settings
        @functools.wraps(function)
        def run(*args: Any, **named: Any) -> Any:
            few = (not follows_scenes or _has_machine_code()) and _are_few((args, named))
            by_itself = few and not is_traced(jax.lax.neg(0.0))  # as it is while a program around it is traced
            return (at_once() if by_itself else whole)(*args, **named)

        return cast(Made, run)

    return decorate


def _are_few(tree: Any) -> bool:
    """Return whether all arrays in it are known, small, and on a CPU."""
    arrays = [x for x in jax.tree.leaves(tree) if isinstance(x, (jax.Array, np.ndarray))]
    if is_traced(tree) or sum(x.size for x in arrays) > MUCH:
        return False
    platforms = {device.platform for x in arrays if isinstance(x, jax.Array) for device in x.devices()}
    return platforms == {"cpu"}
