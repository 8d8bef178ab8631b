"""Checks of values that are known when a program runs, as a primitive of JAX.

Where JAX compiles for a CPU of this process the check raises by a function that XLA calls (`_foreign`), which leaves
programs that JAX can keep; elsewhere by calling back to Python, as `equinox.error_if` does. A program that is exported
finds neither: there a value that fails becomes what is not a number, and the status of a result says so. Outside of
`jax.jit` (under `jax.vmap`, say) it raises at once.
"""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Bool, PyTree

from jaxrock._abstract import typed_like, without_mesh
from jaxrock._foreign import CHECK, has_check
from jaxrock._settings import under_usual_settings

_guard_p = Primitive("guard")
_guard_p.multiple_results = True


def guarded(values: PyTree, failed: Bool[Array, ""], message: str) -> PyTree:
    """`values`, with a check that raises `message` where it has `failed`.

    Only real numbers can be marked, and what nobody uses is not computed: of whole numbers alone a check may be lost.
    """
    leaves, structure = jax.tree.flatten(values)
    return jax.tree.unflatten(structure, _guard_p.bind(*map(as_array, [failed, *leaves]), message=message))


def as_array(value: Any) -> Array:
    """`value` as an array. (Of a number that is differentiated outside of `jax.jit`, `jnp.asarray` would have a program
    compiled that changes nothing.)"""
    return value if isinstance(value, jax.Array) else jnp.asarray(value)


@_guard_p.def_impl
def _(failed, *values, message):
    if np.asarray(failed).any():
        raise ValueError(message)
    return list(values)


@_guard_p.def_abstract_eval
def _(failed, *values, message):
    return typed_like([failed, *values], [(x.shape, x.dtype) for x in values])


@under_usual_settings
def _batched(operands, axes, *, message):
    size = next(x.shape[axis] for x, axis in zip(operands, axes) if axis is not None)
    moved = [
        jnp.broadcast_to(x, (size, *x.shape)) if axis is None else x if axis == 0 else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(operands, axes)
    ]
    found = _guard_p.bind(*moved, message=message)
    return found, [0] * len(found)


def _pushed(operands, changes, *, message):
    found = _guard_p.bind(*operands, message=message)
    return found, list(changes[1:])


def _transposed(cotangents, failed, *values, message):
    return [None, *cotangents]


def _calling_back(failed, *values, message):
    return list(eqx.error_if(values, failed, message))


def _raising(failed, *values, message, alone):
    """`alone`: whether no other device takes part, as far as XLA sees. Then the check stays where it is; what XLA deals
    to many devices by itself must be without effects, and may come out of a loop that takes no turn."""
    like = jax.ShapeDtypeStruct((), jnp.bool_)

    def check(failed):
        return jax.ffi.ffi_call(CHECK, like, has_side_effect=alone)(failed, message=message)

    failed = jnp.any(failed)
    return _marked(jax.lax.cond(failed, check, lambda failed: failed, failed), *values, message=message)


def _marked(failed, *values, message):
    """Lane by lane: what has failed is not a number."""

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


batching.primitive_batchers[_guard_p] = _batched
ad.primitive_jvps[_guard_p] = _pushed
ad.primitive_transposes[_guard_p] = _transposed
mlir.register_lowering(_guard_p, functools.partial(_lowered, on_cpu=False))
mlir.register_lowering(_guard_p, functools.partial(_lowered, on_cpu=True), platform="cpu")
