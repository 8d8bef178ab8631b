"""Derivatives of a recipe, as recipes: value and Jacobian by all that moves, value and change in one direction or in a
few, and the transpose of that change."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrock.transforms.pushforward import pushed
from jaxrock.transforms.recipe import Recipe


def value_and_jacobian(recipe: Recipe, moves: tuple[bool, ...]) -> Recipe:
    """The recipe of (value, Jacobian): for every leaf of the value its derivatives by all numbers of the leaves that
    move, in a leading axis; None for integers."""
    return recipe.derivative(moves, _with_jacobian)


def value_and_change(recipe: Recipe, moves: tuple[bool, ...]) -> Recipe:
    """The recipe of (value, change) in one direction, whose leaves follow the recipe's; for integers None."""
    return recipe.derivative(moves, _with_change)


def value_and_changes(recipe: Recipe, moves: tuple[bool, ...], count: int) -> Recipe:
    """The recipe of (value, changes) in so many directions, which have a leading axis."""
    return recipe.derivative(moves, _with_changes, count)


def pulled_back(recipe: Recipe, moves: tuple[bool, ...]) -> Recipe:
    """The recipe of what changes of the leaves that move weigh, if those of the value (but integers), which follow its
    leaves, weigh so much: the transpose of `value_and_change`, of functions that reverse mode goes through."""
    return recipe.derivative(moves, _transposed)


def _with_jacobian(recipe: Recipe, moves: tuple[bool, ...]) -> Recipe:
    def both(leaves):
        directions = directions_of(_moving(leaves, moves))
        if len(directions[0]) == 1:  # arrays of one number would be for nothing
            value, tangents = pushed(recipe.program, leaves, moves, [x[0] for x in directions], None)
            tangents = [x[None] for x in tangents]
        else:
            value, tangents = pushed(recipe.program, leaves, moves, directions, len(directions[0]))
        columns = [d if _is_real(x) else None for x, d in zip(value, tangents, strict=True)]
        return jax.tree.unflatten(jax.tree.structure(recipe.results), value), columns

    count = sum(math.prod(leaf.shape) for leaf in _moving(recipe.like, moves))
    results = _with_each(recipe.results, lambda out: jax.ShapeDtypeStruct((count, *out.shape), out.dtype))
    return _made(recipe, moves, both, recipe.like, "jacobian", results)


def _with_change(recipe: Recipe, moves: tuple[bool, ...]) -> Recipe:
    like = (*recipe.like, *_moving(recipe.like, moves))

    def both(leaves):
        own, direction = leaves[: len(moves)], leaves[len(moves) :]
        value, tangents = pushed(recipe.program, own, moves, direction, None)
        changes = [d if _is_real(x) else None for x, d in zip(value, tangents, strict=True)]
        return jax.tree.unflatten(jax.tree.structure(recipe.results), value), changes

    results = _with_each(recipe.results, lambda out: jax.ShapeDtypeStruct(out.shape, out.dtype))
    return _made(recipe, moves, both, like, "change", results, directions=sum(moves), origin=(recipe, moves))


def _with_changes(recipe: Recipe, moves: tuple[bool, ...], count: int) -> Recipe:
    def many(x):
        return jax.ShapeDtypeStruct((count, *x.shape), x.dtype)

    def both(leaves):
        own, directions = leaves[: len(moves)], leaves[len(moves) :]
        value, tangents = pushed(recipe.program, own, moves, directions, count)
        changes = [d if _is_real(x) else None for x, d in zip(value, tangents, strict=True)]
        return jax.tree.unflatten(jax.tree.structure(recipe.results), value), changes

    like = (*recipe.like, *map(many, _moving(recipe.like, moves)))
    results = _with_each(recipe.results, many)
    return _made(recipe, moves, both, like, f"{count} changes", results, directions=sum(moves))


def _transposed(recipe: Recipe, moves: tuple[bool, ...]) -> Recipe:
    real = [out for out in jax.tree.leaves(recipe.results) if _is_real(out)]
    moving = _moving(recipe.like, moves)

    def pulled(leaves):
        own, rest = leaves[: len(moves)], iter(leaves[len(moves) :])
        value, pull = jax.vjp(_of_moving(recipe, moves, own), _moving(own, moves))
        return pull([next(rest) if _is_real(x) else np.zeros(x.shape, jax.dtypes.float0) for x in value])[0]

    return _made(recipe, moves, pulled, (*recipe.like, *real), "pulled back", moving)


def _with_each(value: Any, shapes: Callable) -> tuple:
    return value, [shapes(out) if _is_real(out) else None for out in jax.tree.leaves(value)]


def _made(
    recipe: Recipe, moves: tuple[bool, ...], function: Callable, like: Sequence, word: str, results: Any, **more: Any
) -> Recipe:
    return Recipe(
        function,
        jax.tree.structure(list(like)),
        like,
        facts=None if recipe.facts is None else f"{recipe.facts} {word} {[int(move) for move in moves]}",
        results=results,
        in_lanes=recipe.in_lanes,
        refilled=recipe.refilled,
        order=recipe.order + 1,
        derivatives=recipe.derivatives,
        **more,
    )


def _moving(leaves: Sequence, moves: tuple[bool, ...]) -> list:
    return [leaf for leaf, move in zip(leaves, moves) if move]


def _is_real(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jnp.inexact)


def _of_moving(recipe: Recipe, moves: tuple[bool, ...], leaves: Sequence) -> Callable:
    """The recipe's leaves as a function of those that move."""

    def function(moving):
        rest = iter(moving)
        return recipe([next(rest) if move else x for x, move in zip(leaves, moves)])

    return function


def directions_of(moving: Sequence) -> list:
    """Changes of some leaves by one of their numbers each, in a leading axis."""
    sizes = [math.prod(leaf.shape) for leaf in moving]
    whole = jnp.eye(sum(sizes), dtype=jnp.result_type(*(leaf.dtype for leaf in moving)))
    parts = jnp.split(whole, np.cumsum(sizes)[:-1], axis=1)
    return [part.reshape(-1, *leaf.shape).astype(leaf.dtype) for part, leaf in zip(parts, moving)]


def in_rows(directions: Sequence, most: int) -> list:
    """Directions in rows of at most so many, the last filled up with zeros."""
    count = len(directions[0])
    rows = -(-count // most)
    width = -(-count // rows)

    def cut(x):
        return jnp.pad(x, [(0, rows * width - count), *[(0, 0)] * (x.ndim - 1)]).reshape(rows, width, *x.shape[1:])

    return [cut(x) for x in directions]
