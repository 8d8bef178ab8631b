"""Derivatives of functions that JAX differentiates in forward mode only, or not at all."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import jaxpr_as_fun

from jaxrock._settings import narrowed
from jaxrock.keeping.facts import facts as facts_of
from jaxrock.numerics.given import given, is_zero
from jaxrock.transforms.recipe import Derivatives, Passes, Recipe
from jaxrock.transforms.scenes import computed


def with_derivatives_of(value, other):
    """`value`, a number or several, with the derivatives of `other`, which is the same but for rounding; without
    derivatives it is free."""
    return given(_following, value, other)


def _following(_, other, change):
    return jax.tree.map(lambda x, d: jnp.zeros_like(x) if is_zero(d) else d, other, change)


def differentiable(
    function: Callable,
    on_tape: Callable | None = None,
    passes: Passes | None = None,
    name: str | None = None,
    results: Callable | None = None,
    in_lanes: bool = False,
    refilled: bool = False,
    derivatives: Derivatives = "at once",
) -> Callable:
    """`function(tree)` with derivatives of every order, forward and reverse, from forward mode alone.

    The derivative is a small Jacobian times the change of the inputs: one column for every number that is
    differentiated, all in one run with the value. As a product it transposes, so reverse mode goes through; and the
    function that makes value and Jacobian is of the same kind, so second derivatives do, too. Under `jax.vmap` all
    this runs in lanes (see `scenes`).

    `on_tape`: the same function, through whose own code reverse mode goes; for derivatives by very many numbers.
    `passes`: the function in parts; `function` is then their `whole`.
    `name`: of a function that depends on nothing but its argument: then it need not be traced if it has been before.
    `in_lanes`, `refilled`: whether machine code may run it, and refill the lanes of its loop.
    `derivatives`: how forward mode makes them (see `Recipe`).
    `results`: of the tree what the function returns (of `jax.ShapeDtypeStruct`), where that is known without tracing.
    """

    def run(tree):
        leaves, structure = jax.tree.flatten(tree)
        leaves = [_strong(x) for x in leaves]
        like = [jax.ShapeDtypeStruct(jnp.shape(x), x.dtype) for x in leaves]
        told = None if name is None else facts_of((name, structure.unflatten(like)))
        known = results(structure.unflatten(like)) if told is not None and results is not None else None
        recipe = Recipe.of(
            function, structure, like, told,
            passes=passes, on_tape=on_tape, results=known, in_lanes=in_lanes, refilled=refilled,
            derivatives=derivatives,
        )  # fmt: skip
        recipe, leaves = _without_outside(recipe, leaves)
        return computed(recipe, leaves)

    return run


def _strong(x: Any) -> Any:
    x = narrowed(jnp.asarray(x))
    return jax.lax.convert_element_type(x, x.dtype) if getattr(x, "weak_type", False) else x


def _without_outside(recipe: Recipe, leaves: list) -> tuple[Recipe, list]:
    """A recipe whose function holds no traced values of what is around it: they become leaves.

    Where there are any, what is left of it is the whole, traced: its parts and its way over a tape take no such leaves,
    so that many scenes go the careful way, and derivatives by very many numbers the usual one.
    """
    if not recipe.holds_traced:
        return recipe, leaves
    program, shapes = recipe.program, recipe.results
    outside = [isinstance(x, jax.core.Tracer) for x in program.consts]
    more = [_strong(x) for x, traced in zip(program.consts, outside) if traced]
    count = len(leaves)

    def function(all_leaves):
        rest = iter(all_leaves[count:])
        consts = [next(rest) if traced else x for x, traced in zip(program.consts, outside)]
        found = jaxpr_as_fun(type(program)(program.jaxpr, consts))(*all_leaves[:count])
        return jax.tree.unflatten(jax.tree.structure(shapes), found)

    like = [*recipe.like, *(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in more)]
    structure = jax.tree.structure(like)
    kept = Recipe(
        function, structure, like,
        in_lanes=recipe.in_lanes, refilled=recipe.refilled, derivatives=recipe.derivatives,
    )  # fmt: skip
    return kept, [*leaves, *more]
