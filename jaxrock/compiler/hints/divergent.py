"""Divergent conditions: their branches are separate steps, to which machine code assigns lanes that need them.

A vector of lanes skips a branch only if no lane takes it; otherwise all lanes wait. The body of a loop may end with a
`cond` on `divergent(flag)`. Machine code then follows more lanes than a vector holds, and runs each branch for a
vector full of lanes that wait for it.

XLA runs both branches for all lanes anyway, so that an extra branch only costs time. `supports_divergence` tells
whether one pays. Both are primitives of JAX. Under XLA, `divergent` is the identity, and `supports_divergence` False.
"""

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, ArrayLike, Bool

_supports_p, _divergent_p = Primitive("supports_divergence"), Primitive("divergent")


def supports_divergence() -> Bool[Array, ""]:
    """Return whether lanes take different branches without paying for those of other lanes."""
    return _supports_p.bind()


def divergent(flag: Bool[ArrayLike, "..."]) -> Bool[Array, "..."]:
    """Mark the flag of a `cond` whose branches are separate steps.

    **Arguments:**

    - `flag`: the predicate. The `cond` is the last operation of the body of a loop, or of a branch of such a `cond`.

    **Returns:** the flag.
    """
    return _divergent_p.bind(jnp.asarray(flag))


_supports_p.def_impl(lambda: jnp.zeros((), bool))
_supports_p.def_abstract_eval(lambda: jax.core.ShapedArray((), jnp.dtype(bool)))
mlir.register_lowering(_supports_p, mlir.lower_fun(lambda: jnp.zeros((), bool), multiple_results=False))

_divergent_p.def_impl(lambda flag: flag)
_divergent_p.def_abstract_eval(lambda flag: flag)
batching.defvectorized(_divergent_p)
ad.defjvp(_divergent_p, None)
mlir.register_lowering(_divergent_p, lambda context, flag: [flag])
