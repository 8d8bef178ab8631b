"""Conditions whose cases are steps of their own, for machine code that deals lanes to what they need.

In a vector of lanes a condition is skipped only if no lane is in it: what one lane needs, all others wait for. In the
body of a loop that ends with a condition on `apart(flag)`, machine code follows more lanes than a vector holds, and
does each case for as many as wait for it at once. XLA does both cases for all lanes anyway, and must not be given a
case more than it needs: `lanes_part` tells whether it pays. Both are primitives of JAX: elsewhere a flag, and False.
"""

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Bool

_part_p, _apart_p = Primitive("lanes_part"), Primitive("apart")


def lanes_part() -> Bool[Array, ""]:
    """Return whether lanes take different steps without paying for those of all others."""
    return _part_p.bind()


def apart(flag: Bool[Array, ""]) -> Bool[Array, ""]:
    """The flag of a condition whose cases are steps of their own: the last of the body of a loop, or of such a case."""
    return _apart_p.bind(jnp.asarray(flag))


_part_p.def_impl(lambda: jnp.zeros((), bool))
_part_p.def_abstract_eval(lambda: jax.core.ShapedArray((), jnp.dtype(bool)))
mlir.register_lowering(_part_p, mlir.lower_fun(lambda: jnp.zeros((), bool), multiple_results=False))

_apart_p.def_impl(lambda flag: flag)
_apart_p.def_abstract_eval(lambda flag: flag)
batching.defvectorized(_apart_p)
ad.defjvp(_apart_p, None)
mlir.register_lowering(_apart_p, lambda context, flag: [flag])
