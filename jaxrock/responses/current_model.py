"""Models with a user's own functions, as these are at the time of a call."""

import functools
import operator

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxrock._arguments.parameters import check_single, is_ours
from jaxrock._core.arrays import is_traced
from jaxrock._core.throwing import throwing
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.rigid import Block, Side
from jaxrock.compiler import checks
from jaxrock.engines.stepper import AbstractEngine
from jaxrock.engines.taylor.accurate import Series
from jaxrock.models.equation import AbstractEquation, AbstractMoments, Angle
from jaxrock.models.mechanism import Mechanism
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
    example = _example(kind, block.opens if isinstance(block, Block) else None)
    return jax.tree.map(
        lambda node: node.current(dtype, example) if _is_functions(node) else node, model, is_leaf=_is_functions
    )


def standing(
    block: Block | AsymmetricBlock, model: AbstractEquation, engine: AbstractEngine, throw: bool = True
) -> Block | AsymmetricBlock:
    """Return the block, with checks that the model has a balance for it.

    Checked are an `Equation` or a `Mechanism` (of `current_model`) at rest, a block on a spring, and a user's own model
    that `engine` solves by its balance. Without `throw`, a block that fails becomes NaN.

    The checks are here and not in the engines, so that compiled engines contain no host callbacks, and JAX can cache
    them.
    """
    check_single(model=model)
    if isinstance(model, Spring):
        return _balanced(block, model, throw)
    if not isinstance(model, Equation | Mechanism) and (is_ours(model) or not isinstance(engine, Series)):
        return block
    # For concrete values: one call, not fifty. For traced ones, checks within the functions belong to this trace.
    found = _faults(model, block) if is_traced((model, block)) else _compiled_faults(model, block)
    if not throw:
        return _none_where(jnp.stack(list(found.values())).any(), block)
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


def _faults(model: AbstractEquation, block: Block | AsymmetricBlock) -> dict[str, Bool[Array, ""]]:
    """Return messages, each with whether its fault occurs on a side of the block."""
    if isinstance(model, Equation | Mechanism):
        found = [model.faults(side) for side in ((block,) if isinstance(block, Block) else block.sides)]
    else:
        sides = (model.moments(block),) if isinstance(block, Block) else model.moments_of_sides(block)
        found = [_unbalanced(moments) for moments in sides]
    return {message: jnp.any(jnp.stack([jnp.any(each[message]) for each in found])) for message in found[0]}


def _unbalanced(moments: AbstractMoments) -> dict[str, Bool[Array, "..."]]:
    saddle, flat = moments.saddle, Angle.of(jnp.full_like(moments.saddle, jnp.pi / 2))
    rights = (saddle < jnp.pi / 2) & (moments.restoring(flat) > 0)
    return {_NO_BALANCE: ~((saddle > 0) & (saddle < jnp.inf)), _RIGHTS_AGAIN: rights}


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
    return isinstance(node, Functions) and not node.is_current


@functools.cache
def _example(kind: type, opens: str | None) -> Block | Side:
    """Return a block of this kind, in the form that `as_functions_see` gives."""

    def made():
        with checks.collect():
            numbers = (jnp.asarray(x) for x in (0.2, 1.0, 0.9))
            return kind(*numbers) if opens is None else kind(*numbers, opens=opens)

    return jax.eval_shape(made)
