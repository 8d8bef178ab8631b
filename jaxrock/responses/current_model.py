"""Models with a user's own functions, as these are at the time of a call."""

import functools
import operator

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxrock._arguments.parameters import is_ours
from jaxrock._core.arrays import is_traced
from jaxrock._core.throwing import throwing
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.rigid import Block, Side
from jaxrock.compiler import checks, trace_function
from jaxrock.engines.stepper import AbstractEngine
from jaxrock.engines.taylor.accurate import Series
from jaxrock.models.equation import AbstractEquation, Angle
from jaxrock.models.spring import Spring
from jaxrock.models.user_equation import Equation, Functions


def current_model(model: AbstractEquation, block: Block | AsymmetricBlock, *scene) -> AbstractEquation:
    """Return a model with the current version of all its functions: a pytree for `jax.jit`.

    A user's own class of models is identified by its type and its fields, like any pytree. Its methods are part of the
    traced computation, and tracing at every call would take a second. So methods should read nothing that changes but
    fields. The same holds for classes of motions.

    **Arguments:**

    - `model`: any model.
    - `block`, `scene`: arguments of its later use; their kind and precision count.

    **Returns:** the model; the same object, where it holds no functions.
    """
    if not any(map(_is_functions, jax.tree.leaves(model, is_leaf=_is_functions))):
        return model
    kind = Side if isinstance(block, AsymmetricBlock) else Block
    dtype = jnp.result_type(*jax.tree.leaves((block, scene)))
    dtype = dtype if jnp.issubdtype(dtype, jnp.inexact) else jnp.result_type(float)
    number = jax.ShapeDtypeStruct((), dtype)
    example = jax.tree.map(lambda leaf: number, _example(kind))

    def current(node):
        return trace_function(node, number, number, number, example) if _is_functions(node) else node

    return jax.tree.map(current, model, is_leaf=_is_functions)


def standing(
    block: Block | AsymmetricBlock, model: AbstractEquation, engine: AbstractEngine, throw: bool = True
) -> Block | AsymmetricBlock:
    """Return the block, with checks that the model has a balance for it.

    Checked are an `Equation` (of `current_model`) at rest, a block on a spring, and a user's own model that `engine`
    solves by its balance. Without `throw`, a block that fails becomes NaN.

    The checks are here and not in the engines, so that compiled engines contain no host callbacks, and JAX can cache
    them.
    """
    if isinstance(model, Spring):
        return _balanced(block, model, throw)
    if not isinstance(model, Equation) and (is_ours(model) or not isinstance(engine, Series)):
        return block
    for side in (block,) if isinstance(block, Block) else block.sides:
        # For concrete values: one call, not fifty. For traced ones, checks within the functions belong to this trace.
        found = _faults(model, side) if is_traced((model, side)) else _compiled_faults(model, side)
        if not throw:
            block = _none_where(jnp.stack(list(found.values())).any(), block)
            continue
        for message, applies in found.items():
            block = checks.error_if(block, applies, message, collectable=False)
    return block


@jax.jit
def _none_where(bad: Bool[Array, ""], block: Block | AsymmetricBlock) -> Block | AsymmetricBlock:
    # Integer leaves are counts or indices.
    return jax.tree.map(
        lambda x: jnp.where(bad, jnp.nan, x) if jnp.issubdtype(jnp.result_type(x), jnp.inexact) else x, block
    )


def _balanced(block: Block | AsymmetricBlock, spring: Spring, throw: bool) -> Block | AsymmetricBlock:
    """Check the angles of the block on the spring; without `throw`, mark invalid ones."""
    for name in ("alpha",) if isinstance(block, Block) else ("alpha1", "alpha2"):
        alpha = getattr(block, name)
        with throwing(throw):
            found = spring.balanced(f"block.{name}", alpha)
        if found is not alpha:
            block = eqx.tree_at(operator.attrgetter(name), block, found)
    return block


def _faults(model: AbstractEquation, block: Block | Side) -> dict[str, Bool[Array, ""]]:
    if isinstance(model, Equation):
        return {message: jnp.any(applies) for message, applies in model.faults(block).items()}
    moments = model.moments(block)
    saddle, flat = moments.saddle, Angle.of(jnp.full_like(moments.saddle, jnp.pi / 2))
    rights = (saddle < jnp.pi / 2) & (moments.restoring(flat) > 0)
    return {_NO_BALANCE: ~jnp.all((saddle > 0) & (saddle < jnp.inf)), _RIGHTS_AGAIN: jnp.any(rights)}


_NO_BALANCE = (
    "The restoring moment of `model` must fall to zero at some rotation, where the block balances; one that does not "
    "is for `Diffrax()`"
)
_RIGHTS_AGAIN = (
    "The restoring moment of `model` must not right the block again between its balance and pi/2; one that does is for "
    "`Diffrax()`"
)


_compiled_faults = jax.jit(_faults)


def _is_functions(node) -> bool:
    return isinstance(node, Functions)


@functools.cache
def _example(kind: type) -> Block | Side:
    """Return a block of this kind, in the form that `as_functions_see` gives."""

    def made():
        with checks.collect():
            return kind(*(jnp.asarray(x) for x in (0.2, 1.0, 0.9)))

    return jax.eval_shape(made)
