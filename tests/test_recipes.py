"""Recipes: those that are alike are one, and scenes that a quick program postpones to a careful one are collected,
computed, and put back in their places."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrock.transforms.differentiation import differentiable
from jaxrock.transforms.recipe import Passes, Recipe


def _result(scene, state):
    """Real numbers, a few of them, whole numbers and flags; what the quick pass leaves is not finished."""
    value, finished = state
    few = jnp.stack([value, -value, 2 * value])
    return (value, few, jnp.int32(scene[0]), value > 1), ~finished


_PASSES = Passes(
    begin=lambda scene: (scene, (scene[0], scene[0] < -jnp.inf)),
    quickly=lambda scene, state, limit: (jnp.where(scene[0] >= scene[1], scene[0] ** 2, jnp.nan), scene[0] >= scene[1]),
    carefully=lambda scene, state: (scene[0] ** 2, state[0] > -jnp.inf),
    unfinished=lambda scene, state: state[0] < -jnp.inf,
    conclude=_result,
    round=None,
)
_one = differentiable(_PASSES.whole, passes=_PASSES)
_many = jax.jit(jax.vmap(_one, in_axes=((0, None),)))


def test_recipes_of_the_same_facts_are_one():
    numbers, more = [jax.ShapeDtypeStruct((), float)], [jax.ShapeDtypeStruct((3,), float)]

    def made(like, facts):
        return Recipe.of(lambda leaves: leaves, jax.tree.structure(numbers), like, facts)

    first = made(numbers, "twice")
    assert made(numbers, "twice") is first
    assert first not in (made(numbers, "thrice"), made(more, "twice"))
    assert made(numbers, None) is not made(numbers, None)


@pytest.mark.parametrize("level", [-1.0, 0.97, 0.5, 3.0], ids=["none", "nearly all", "half", "all"])
@pytest.mark.parametrize("count", [65, 128, 1000], ids=["a vector begun", "full vectors", "in threads"])
def test_postponed_scenes_come_back_to_their_places(count, level):
    x = np.random.default_rng(count).uniform(0, 2, count)
    value, few, whole, flag = map(np.asarray, _many((x, level)))
    np.testing.assert_array_equal(value, x**2)
    np.testing.assert_array_equal(few, np.stack([x**2, -(x**2), 2 * x**2], axis=1))
    np.testing.assert_array_equal(whole, x.astype(int))
    np.testing.assert_array_equal(flag, x**2 > 1)


def test_their_derivatives_do_too():
    function = jax.vmap(jax.grad(lambda x: _one((x, 0.5))[0]))
    x = np.linspace(0, 2, 100)
    np.testing.assert_allclose(function(x), 2 * x, rtol=1e-15)
