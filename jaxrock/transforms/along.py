"""Forward mode along every number of a scene that moves: value and Jacobian, in one recipe."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrock.transforms.recipe import Recipe


def value_and_jacobian(recipe: Recipe, moves: tuple[bool, ...]) -> Recipe:
    """The recipe of (value, Jacobian): for every leaf of the value the derivatives by the leaves that move (a list of
    arrays, the leaf's shape behind), None for integers."""
    return recipe.derivative(moves, lambda: _made(recipe, moves))


def _made(recipe: Recipe, moves: tuple[bool, ...]) -> Recipe:
    value = recipe.results
    moving = [leaf for leaf, move in zip(recipe.like, moves) if move]

    def shapes(out):
        if not jnp.issubdtype(out.dtype, jnp.inexact):
            return None
        return [jax.ShapeDtypeStruct((*out.shape, *leaf.shape), out.dtype) for leaf in moving]

    return Recipe(
        _both(recipe, moves),
        jax.tree.structure(list(recipe.like)),
        recipe.like,
        facts=None if recipe.facts is None else f"{recipe.facts} by {[int(move) for move in moves]}",
        results=(value, [shapes(out) for out in jax.tree.leaves(value)]),
        in_lanes=recipe.in_lanes,
        refilled=recipe.refilled,
    )


def _both(recipe: Recipe, moves: tuple[bool, ...]) -> Callable:
    def both(leaves):
        moving = [leaf for leaf, move in zip(leaves, moves) if move]
        sizes = [leaf.size for leaf in moving]
        directions = jnp.split(jnp.eye(sum(sizes), dtype=jnp.result_type(*moving)), np.cumsum(sizes)[:-1], axis=1)
        directions = [d.reshape(-1, *leaf.shape).astype(leaf.dtype) for d, leaf in zip(directions, moving)]

        def function(moving):
            rest = iter(moving)
            return recipe.forward([next(rest) if move else x for x, move in zip(leaves, moves)])

        def along(*directions):
            return jax.jvp(function, (moving,), (list(directions),))

        value, tangents = jax.vmap(along, out_axes=(None, 0))(*directions)
        columns = [_columns(*pair, moving) for pair in zip(value, tangents, strict=True)]
        return jax.tree.unflatten(jax.tree.structure(recipe.results), value), columns

    return both


def _columns(out: Any, column: Any, moving: list) -> list | None:
    """Derivatives of a leaf of the value by the moving leaves, in their shapes."""
    if not jnp.issubdtype(out.dtype, jnp.inexact):
        return None
    cuts = np.cumsum([leaf.size for leaf in moving])[:-1]
    parts = jnp.split(column, cuts, axis=0)
    return [jnp.moveaxis(p, 0, -1).reshape(*out.shape, *leaf.shape) for p, leaf in zip(parts, moving)]
