"""Rules of forward mode for single operations of JAX, as the jaxpr of one point consists of them.

`JVP_RULES` has the partial derivatives of elementwise operations by each operand. `MOVED` applies operations that move
numbers about to tangents with one more axis in front. JAX's own rules serve all other operations.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jax import lax

# Partial derivatives that are one, or minus one: the tangent needs no product.
ONE, MINUS_ONE = object(), object()


class Over(NamedTuple):
    """A reciprocal as a partial derivative: the tangent is divided, as the reciprocal alone may be infinite."""

    function: Callable


def number(like, value):
    """Return a NumPy scalar of the dtype of `like`, which JAX writes into a jaxpr as a literal."""
    return np.asarray(value, like.dtype)[()]


def _chosen(flag, one, other, like):
    """Return `one` where a flag is set and `other` elsewhere, in the shape of `like`."""

    def filled(x):
        return x if not isinstance(x, float) else lax.full_like(like, x) if like.shape else number(like, x)

    return lax.select_n(flag, filled(other), filled(one))


def _share(z, own, other):
    """Return the partial derivative of a maximum or minimum z: 1 for the operand that equals z, 1/2 where both do."""
    return _chosen(lax.eq(own, z), _chosen(lax.eq(other, z), 0.5, 1.0, z), 0.0, z)


def _power(parameters, z, x):
    n = parameters["y"]
    if n == 0:
        return number(x, 0.0)
    return lax.mul(number(x, n), x if n == 2 else lax.integer_pow(x, n - 1))


def _one_less_square(x):
    return lax.mul(lax.sub(number(x, 1.0), x), lax.add(number(x, 1.0), x))


# By the name of the operation: for each operand, a function of the parameters, the result and the operands.
JVP_RULES: dict[str, tuple] = {
    "add": (ONE, ONE),
    "add_any": (ONE, ONE),
    "sub": (ONE, MINUS_ONE),
    "neg": (MINUS_ONE,),
    "copy": (ONE,),
    "mul": (lambda _, z, x, y: y, lambda _, z, x, y: x),
    "div": (Over(lambda _, z, x, y: y), lambda _, z, x, y: lax.neg(lax.div(z, y))),
    "max": (lambda _, z, x, y: _share(z, x, y), lambda _, z, x, y: _share(z, y, x)),
    "min": (lambda _, z, x, y: _share(z, x, y), lambda _, z, x, y: _share(z, y, x)),
    "abs": (lambda _, z, x: _chosen(lax.ge(x, number(x, 0.0)), 1.0, -1.0, x),),  # as JAX has it at zero
    "square": (lambda _, z, x: lax.mul(number(x, 2.0), x),),
    "integer_pow": (_power,),
    "sqrt": (lambda _, z, x: lax.div(number(z, 0.5), z),),
    "exp": (lambda _, z, x: z,),
    "log": (Over(lambda _, z, x: x),),
    "sin": (lambda _, z, x: lax.cos(x),),
    "cos": (lambda _, z, x: lax.neg(lax.sin(x)),),
    "tan": (lambda _, z, x: lax.add(number(z, 1.0), lax.square(z)),),
    "tanh": (lambda _, z, x: _one_less_square(z),),
    "asin": (lambda _, z, x: lax.rsqrt(_one_less_square(x)),),
}


def _behind(places: Any) -> tuple:
    """Return numbers of axes after one more axis is put in front."""
    return tuple(place + 1 for place in places)


def _sliced(d, parameters):
    strides = parameters["strides"]
    return lax.slice(
        d,
        (0, *parameters["start_indices"]),
        (d.shape[0], *parameters["limit_indices"]),
        None if strides is None else (1, *strides),
    )


def _broadcast(d, parameters):
    axes = 0, *_behind(parameters["broadcast_dimensions"])
    return lax.broadcast_in_dim(d, (d.shape[0], *parameters["shape"]), axes)


# By the name of an operation of one operand: a function of its tangent, with an axis in front, and its parameters.
MOVED: dict[str, Callable] = {
    "slice": _sliced,
    "squeeze": lambda d, parameters: lax.squeeze(d, _behind(parameters["dimensions"])),
    "broadcast_in_dim": _broadcast,
    "reshape": lambda d, parameters: lax.reshape(d, (d.shape[0], *parameters["new_sizes"])),
    "convert_element_type": lambda d, parameters: lax.convert_element_type(d, parameters["new_dtype"]),
    "reduce_sum": lambda d, parameters: d.sum(_behind(parameters["axes"])),
}

# Operations whose tangents are zero, beside all that return no real numbers.
STILL = {"stop_gradient", "stop_gradient_of_tree", "floor", "ceil", "round", "sign", "opaque_one"}

# By the name of the operation: a function of its parameters and of one item for each operand. It returns the items of
# the operands by which the operation has derivatives.
OF_SOME: dict[str, Callable] = {
    "custom_tangent": lambda parameters, operands: operands[parameters["structures"][0].num_leaves :],
    "materialize": lambda parameters, operands: operands[:1],
}
