"""Models whose functions are a user's own, as they are when they are asked for."""

import functools
import operator

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxrock._checks import is_traced, put_down, throwing
from jaxrock._guard import guarded
from jaxrock._parameters import is_ours
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.rigid import Block, Side
from jaxrock.engines.stepper import AbstractEngine
from jaxrock.engines.taylor.careful import Series
from jaxrock.models.equation import AbstractEquation, Angle
from jaxrock.models.spring import Spring
from jaxrock.models.user_equation import Equation, Functions
from jaxrock.transforms.user_function import UserFunction


def current_model(model: AbstractEquation, block: Block | AsymmetricBlock, *scene) -> AbstractEquation:
    """A model whose functions are what they are now, wherever in it they are: a pytree for `jax.jit`.

    A class of models of the user's own is known by what it is and by its fields, as any pytree: its methods are part of
    all that the engine computes, and tracing that at every call would take a second. So methods should read nothing
    that changes but fields. The same holds for classes of motions.

    **Arguments:**

    - `model`: any model.
    - `block`, `scene`: what it will be asked for; their kind and precision count.

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
        return UserFunction.of(node, number, number, number, example) if _is_functions(node) else node

    return jax.tree.map(current, model, is_leaf=_is_functions)


def standing(
    block: Block | AsymmetricBlock, model: AbstractEquation, engine: AbstractEngine, throw: bool = True
) -> Block | AsymmetricBlock:
    """The block, with checks that it stands by an equation of the user's own (of `current_model`), which is one, or
    balances on a spring, or by a model of the user's own that `engine` solves by its balance. Where nothing is to be
    raised (`throw`), one that does not is not a number.

    Here and not where the engines ask for moments: what they compile then calls back to nothing, and JAX can keep it.
    """
    if isinstance(model, Spring):
        return _balanced(block, model, throw)
    if not isinstance(model, Equation) and (is_ours(model) or not isinstance(engine, Series)):
        return block
    for side in (block,) if isinstance(block, Block) else block.sides:
        # Known numbers: one call, not fifty. Of others checks within the functions belong to this trace.
        found = _faults(model, side) if is_traced((model, side)) else _compiled_faults(model, side)
        if not throw:
            block = _none_where(jnp.stack(list(found.values())).any(), block)
            continue
        for message, applies in found.items():
            block = guarded(block, applies, message)
    return block


@jax.jit
def _none_where(bad: Bool[Array, ""], block: Block | AsymmetricBlock) -> Block | AsymmetricBlock:
    # What is declared whole counts, or is a place among others.
    return jax.tree.map(
        lambda x: jnp.where(bad, jnp.nan, x) if jnp.issubdtype(jnp.result_type(x), jnp.inexact) else x, block
    )


def _balanced(block: Block | AsymmetricBlock, spring: Spring, throw: bool) -> Block | AsymmetricBlock:
    """The block, whose angles are checked, and marked where nothing is to be raised."""
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
    "is for `Diffrax()`."
)
_RIGHTS_AGAIN = (
    "The restoring moment of `model` must not right the block again between its balance and pi/2; one that does is for "
    "`Diffrax()`."
)


_compiled_faults = jax.jit(_faults)


def _is_functions(node) -> bool:
    return isinstance(node, Functions)


@functools.cache
def _example(kind: type) -> Block | Side:
    """A block `as_functions_see` those of its kind."""

    def made():
        with put_down():
            return kind(*(jnp.asarray(x) for x in (0.2, 1.0, 0.9)))

    return jax.eval_shape(made)
