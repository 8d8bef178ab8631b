"""Compiling a part of a program into one function of machine code.

XLA's CPU backend makes a kernel of every few operations and hands arrays of a chunk of lanes from kernel to kernel
through memory. For chunks that fit the cache, handing over takes as long as the arithmetic. A call with the right mark
becomes one function instead, with its loops inside.
"""

import re
from collections.abc import Callable

import jax
import jax.numpy as jnp
import jaxlib
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun, jaxprs_in_params

# The mark is no promise of XLA: only releases with which all tests passed are given it.
_TRIED = ((0, 10), (0, 11))
# What calls a library, and so cannot be part of one function.
_OUTSIDE = re.compile(
    "callback|ffi|print|dot_general|conv_general|fft|sort|scatter|random|psum|all_|axis_index|custom_call|cholesky|"
    "triangular|schur|^(lu|qr|svd|eigh?)$"
)


def as_one_function(function: Callable) -> Callable:
    """`function` of pytrees of arrays; on CPUs, where it can be, compiled into one function."""
    if jax.default_backend() != "cpu" or jaxlib.version.__version_info__[:2] not in _TRIED:
        return function

    def marked(*args):
        program, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
        if _reaches_outside(program.jaxpr):
            return function(*args)

        def using_all(constants, leaves):
            first, *rest = jaxpr_as_fun(ClosedJaxpr(program.jaxpr, constants))(*leaves)
            used = sum(x.ravel()[0].astype(float) for x in [*constants, *leaves])
            return jnp.where(used * used < -1, jnp.zeros_like(first), first), *rest

        # XLA aborts where an argument of such a call is a constant, or is not used after all simplifications: here
        # none is known to be constant, and all are used, for nothing.
        veil = _unseen_zero()
        inputs = [_veiled(x, veil) for x in [*program.consts, *jax.tree.leaves(args)]]
        found = jax.jit(using_all)(inputs[: len(program.consts)], inputs[len(program.consts) :])
        found = set_xla_metadata(found, xla_cpu_small_call="true", inlineable="false")
        return jax.tree.unflatten(jax.tree.structure(shapes), found)

    return marked


def _unseen_zero():
    """Zero, in a way that the compiler cannot see: it removes loops of one turn, but runs none."""
    return jnp.minimum(jax.lax.while_loop(lambda count: count < 3, lambda count: count + 1, jnp.int32(0)), 0)


def _veiled(x, zero):
    x = jnp.asarray(x)
    if x.dtype == bool:
        return x ^ (zero > 0)
    return x / (1 - zero).astype(x.dtype) if jnp.issubdtype(x.dtype, jnp.inexact) else x + zero.astype(x.dtype)


def _reaches_outside(program) -> bool:
    """Whether a program calls what cannot be compiled into one function with it."""
    for equation in program.eqns:
        if _OUTSIDE.search(equation.primitive.name):
            return True
        if any(_reaches_outside(inner) for inner in jaxprs_in_params(equation.params)):
            return True
    return False
