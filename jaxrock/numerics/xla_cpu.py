"""Keeping XLA's CPU backend from computing the same thing again.

On CPUs, XLA computes a cheap value again in every loop that uses it, so that a series, whose terms each use all before,
would be computed dozens of times a step. A division is never repeated: what many use is divided by a one that the
compiler cannot see. Both are primitives of JAX, which become operations where XLA lowers them for a CPU; everywhere
else they are the value itself, and where it is known that a program is for machine code of our own, it has none.
"""

import contextlib
import contextvars
from collections.abc import Iterator

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from jaxrock.numerics.typed import typed

_one_p, _keep_p = Primitive("unseen_one"), Primitive("keep")
_marks = contextvars.ContextVar("marks", default=True)


def are_marked() -> bool:
    """Return whether values are marked in what is traced now."""
    return _marks.get()


@contextlib.contextmanager
def marking(wanted: bool) -> Iterator[None]:
    """Within it values are marked, or are not."""
    before = _marks.set(wanted)
    try:
        yield
    finally:
        _marks.reset(before)


def unseen_one(witness):
    """The number one, in a way that the compiler cannot see; `witness`: a number that is known at run time only and
    never negative."""
    witness = jnp.asarray(witness)
    return _one_p.bind(witness) if are_marked() else jnp.ones_like(witness)


def keep_by(value, one):
    """Mark a value that many others use, so that it is computed once; `one`: an `unseen_one`."""
    return _marked(value, one, by_one=True)


def keep(value, witness):
    """As `keep_by`, from a witness of the one."""
    return _marked(value, witness, by_one=False)


def keep_flag(flag, witness):
    """As `keep`, of a condition."""
    return keep(jnp.where(flag, 1.0, 0.0).astype(jnp.asarray(witness).dtype), witness) > 0.5 if are_marked() else flag


def _marked(value, witness, by_one: bool):
    if not are_marked():
        return value
    value = value if isinstance(value, jax.Array) else jnp.asarray(value)
    if not jnp.issubdtype(value.dtype, jnp.inexact):
        return value
    witness = typed(witness, value.dtype)
    if witness.shape != value.shape:
        witness = jnp.broadcast_to(witness, value.shape)
    return _keep_p.bind(value, witness, by_one=by_one)


def _one_on_cpu(witness):
    # An exponential is never repeated either, and its underflow is exact.
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
        jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(operands, axes)
    )
    return _keep_p.bind(value, witness, by_one=by_one), 0


_keep_p.def_impl(lambda value, witness, by_one: value)
_keep_p.def_abstract_eval(lambda value, witness, by_one: value)
batching.primitive_batchers[_keep_p] = _of_many
ad.defjvp(_keep_p, lambda change, value, witness, by_one: _keep_p.bind(change, witness, by_one=by_one), None)
mlir.register_lowering(_keep_p, lambda context, value, witness, by_one: [value])
mlir.register_lowering(_keep_p, mlir.lower_fun(_kept_on_cpu, multiple_results=False), platform="cpu")


def _transposed(cotangent, value, witness, by_one):
    return cotangent if type(cotangent) is ad.Zero else _keep_p.bind(cotangent, witness, by_one=by_one), None


ad.primitive_transposes[_keep_p] = _transposed
