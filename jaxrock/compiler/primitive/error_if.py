"""Checks of values that are known only when a program runs, as a primitive of JAX.

Where JAX compiles for a CPU of this process, the check raises by a function that XLA calls (`xla_ffi`). JAX can cache
such programs. Elsewhere it calls back to Python, as `equinox.error_if` does. An exported program has neither: there,
values that fail become NaN, and the status of a result says so. Outside of `jax.jit` (under `jax.vmap`, say) the check
raises at once.
"""

import contextlib
import contextvars
import functools
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive, get_opaque_trace_state
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, ArrayLike, Bool, PyTree

from jaxrock._core.arrays import as_array
from jaxrock._core.settings import under_usual_settings
from jaxrock.compiler.primitive.sharding_types import typed_like, without_mesh
from jaxrock.compiler.xla_ffi import CHECK, has_check

_error_if_p = Primitive("error_if")
_error_if_p.multiple_results = True


def error_if(values: PyTree, failed: Bool[ArrayLike, "..."], message: str, collectable: bool = True) -> PyTree:
    """Return `values` with a check that raises ValueError where it has `failed`.

    XLA removes a check whose values no result depends on. In exported programs, only floating-point values are marked.

    **Arguments:**

    - `values`: arrays in a tree, traced or not.
    - `failed`: (...), whether the check fails.
    - `message`: of the error, without a full stop at its end.
    - `collectable`: whether a surrounding `collect` takes the check instead.

    **Returns:** the same tree.
    """
    state, checks = _collecting.get()
    if collectable and state is not None and state == get_opaque_trace_state():
        checks.append((message, failed))
        return values
    leaves, structure = jax.tree.flatten(values)
    return jax.tree.unflatten(structure, _error_if_p.bind(*map(as_array, [failed, *leaves]), message=f"{message}."))


# The trace whose checks are collected, and these; every thread has its own.
_collecting: contextvars.ContextVar[tuple[Any, Any]] = contextvars.ContextVar("collecting", default=(None, None))


@contextlib.contextmanager
def collect() -> Iterator[list[tuple[str, Bool[Array, ""]]]]:
    """Collect the checks of the current trace instead of making them.

    JAX caches a program that returns its checks on every platform, but one that raises on CPUs only. Checks within
    inner transformations (a `jax.vmap`, say) are still made.

    **Returns:** a list of pairs, which grows: the message of a check, and whether the check fails.
    """
    checks: list[tuple[str, Bool[Array, ""]]] = []
    before = _collecting.set((get_opaque_trace_state(), checks))
    try:
        yield checks
    finally:
        _collecting.reset(before)


@_error_if_p.def_impl
def _(failed, *values, message):
    if np.asarray(failed).any():
        raise ValueError(message)
    return list(values)


@_error_if_p.def_abstract_eval
def _(failed, *values, message):
    return typed_like([failed, *values], [(x.shape, x.dtype) for x in values])


@under_usual_settings
def _batched(operands, axes, *, message):
    size = next(x.shape[axis] for x, axis in zip(operands, axes) if axis is not None)
    moved = [
        jnp.broadcast_to(x, (size, *x.shape)) if axis is None else x if axis == 0 else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(operands, axes)
    ]
    found = _error_if_p.bind(*moved, message=message)
    return found, [0] * len(found)


def _pushed(operands, changes, *, message):
    found = _error_if_p.bind(*operands, message=message)
    return found, list(changes[1:])


def _transposed(cotangents, failed, *values, message):
    return [None, *cotangents]


def _calling_back(failed, *values, message):
    return list(eqx.error_if(values, failed, message))


def _raising(failed, *values, message, alone):
    """Raise within the program.

    `alone`: whether XLA sees no other device. Then the check has side effects, so that it stays where it is. XLA can
    only distribute programs without side effects to many devices, and may hoist such a check out of a loop.
    """
    like = jax.ShapeDtypeStruct((), jnp.bool_)

    def check(failed):
        return jax.ffi.ffi_call(CHECK, like, has_side_effect=alone)(failed, message=message)

    failed = jnp.any(failed)
    return _marked(jax.lax.cond(failed, check, lambda failed: failed, failed), *values, message=message)


def _marked(failed, *values, message):
    """Make the values of failed lanes NaN."""

    def of(x):
        if not jnp.issubdtype(x.dtype, jnp.inexact):
            return x
        return jnp.where(failed.reshape(failed.shape + (1,) * (x.ndim - failed.ndim)), jnp.nan, x)

    return [of(x) for x in values]


def _is_alone(axes) -> bool:
    mesh = getattr(axes, "mesh", None)
    if mesh is None:
        return getattr(axes, "num_devices", 1) == 1
    return mesh.size == 1 or set(mesh.axis_names) == set(axes.manual_axes)


@under_usual_settings
def _lowered(context, *operands, message, on_cpu):
    settings = getattr(context.module_context, "lowering_parameters", None)
    if getattr(settings, "for_export", False):
        rule = _marked
    else:
        rule = _calling_back
        if on_cpu and has_check():
            rule = functools.partial(_raising, alone=_is_alone(context.module_context.axis_context))
    return mlir.lower_fun(rule)(without_mesh(context), *operands, message=message)


batching.primitive_batchers[_error_if_p] = _batched
ad.primitive_jvps[_error_if_p] = _pushed
ad.primitive_transposes[_error_if_p] = _transposed
mlir.register_lowering(_error_if_p, functools.partial(_lowered, on_cpu=False))
mlir.register_lowering(_error_if_p, functools.partial(_lowered, on_cpu=True), platform="cpu")
