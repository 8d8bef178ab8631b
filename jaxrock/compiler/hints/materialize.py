"""Hints that keep XLA's CPU backend from computing a value repeatedly.

On CPUs, XLA computes a cheap value again in every fused loop that uses it. A series, each of whose terms uses all terms
before, would be computed dozens of times a step. XLA never repeats a division. So `materialize` divides a value that
has many uses by a one whose value XLA cannot see.

The hints are primitives of JAX. They become operations where XLA lowers them for a CPU, and are the identity elsewhere.
A jaxpr that is traced for `llvm` has none of them.
"""

import contextlib
import contextvars
from collections.abc import Iterator

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from jaxrock.compiler.hints.as_dtype import as_dtype
from jaxrock.compiler.ordinary import IS_ORDINARY

_one_p, _materialize_p = Primitive("opaque_one"), Primitive("materialize")
_marks = contextvars.ContextVar("marks", default=not IS_ORDINARY)


def are_hints_wanted() -> bool:
    """Return whether tracing adds hints now."""
    return _marks.get()


@contextlib.contextmanager
def with_hints(wanted: bool) -> Iterator[None]:
    """Let tracing add hints within the body, or not."""
    before = _marks.set(wanted)
    try:
        yield
    finally:
        _marks.reset(before)


def opaque_one(witness):
    """Return the number one in a form that XLA cannot fold; `witness`: known at run time only, and never negative."""
    witness = jnp.asarray(witness)
    return _one_p.bind(witness) if are_hints_wanted() else jnp.ones_like(witness)


def materialize_by(value, one):
    """Let XLA compute a value with many uses only once; `one` comes from `opaque_one`."""
    return _marked(value, one, by_one=True)


def materialize(value, witness):
    """Let XLA compute a value with many uses only once, on CPUs.

    **Arguments:**

    - `value`: array or number; values that are not floating-point are returned unchanged.
    - `witness`: number that is known at run time only, and never negative.

    **Returns:** the value.
    """
    return _marked(value, witness, by_one=False)


def materialize_flag(flag, witness):
    """Let XLA compute a flag with many uses only once, on CPUs; `witness` is that of `materialize`."""
    return (
        materialize(jnp.where(flag, 1.0, 0.0).astype(jnp.asarray(witness).dtype), witness) > 0.5
        if are_hints_wanted()
        else flag
    )


def _marked(value, witness, by_one: bool):
    if not are_hints_wanted():
        return value
    value = value if isinstance(value, jax.Array) else jnp.asarray(value)
    if not jnp.issubdtype(value.dtype, jnp.inexact):
        return value
    witness = as_dtype(witness, value.dtype)
    if witness.shape != value.shape:
        witness = jnp.broadcast_to(witness, value.shape)
    return _materialize_p.bind(value, witness, by_one=by_one)


def _one_on_cpu(witness):
    # XLA does not repeat an exponential either, and its underflow to zero is exact.
    return 1 + jnp.exp(jnp.where(witness < 0, 0.0, -2000.0).astype(witness.dtype))


def _kept_on_cpu(value, witness, by_one: bool):
    return value / (witness if by_one else jnp.where(witness < 0, 2.0, 1.0).astype(value.dtype))


_one_p.def_impl(jnp.ones_like)
_one_p.def_abstract_eval(lambda witness: witness)
batching.defvectorized(_one_p)
ad.defjvp(_one_p, None)
mlir.register_lowering(_one_p, mlir.lower_fun(jnp.ones_like, multiple_results=False))
mlir.register_lowering(_one_p, mlir.lower_fun(_one_on_cpu, multiple_results=False), platform="cpu")


def _of_many(operands, axes, by_one):
    size = next(x.shape[axis] for x, axis in zip(operands, axes) if axis is not None)
    value, witness = (
        jnp.broadcast_to(x, (size, *jnp.shape(x))) if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(operands, axes)
    )
    return _materialize_p.bind(value, witness, by_one=by_one), 0


_materialize_p.def_impl(lambda value, witness, by_one: value)
_materialize_p.def_abstract_eval(lambda value, witness, by_one: value)
batching.primitive_batchers[_materialize_p] = _of_many
ad.defjvp(
    _materialize_p, lambda change, value, witness, by_one: _materialize_p.bind(change, witness, by_one=by_one), None
)
mlir.register_lowering(_materialize_p, lambda context, value, witness, by_one: [value])
mlir.register_lowering(_materialize_p, mlir.lower_fun(_kept_on_cpu, multiple_results=False), platform="cpu")


def _transposed(cotangent, value, witness, by_one):
    return cotangent if type(cotangent) is ad.Zero else _materialize_p.bind(cotangent, witness, by_one=by_one), None


ad.primitive_transposes[_materialize_p] = _transposed
