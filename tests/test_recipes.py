"""Recipes: those that are alike are one, what is made of them stays longer than their programs, and scenes that a
quick program postpones to a careful one are collected, computed, and put back in their places."""

import gc
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.transforms.differentiation import differentiable
from jaxrock.transforms.recipe import Passes, Recipe, forget_programs


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


@pytest.fixture
def traced(monkeypatch):
    """Facts of the recipes that are traced."""
    found, trace = [], Recipe._trace

    def noted(self, function):
        found.append(self.facts)
        return trace(self, function)

    monkeypatch.setattr(Recipe, "_trace", noted)
    return found


def margin(amplitude):
    pulse = rk.RectangularPulse(amplitude, 0.3)
    return rk.outcome(rk.Block(0.2, 2.0), pulse, rk.Linear(), engine=rk.Series(order=4)).margin


def forget():
    forget_programs()
    jax.clear_caches()


def test_what_is_machine_code_is_not_traced_again(traced):
    forget()
    before = jax.jit(lambda a: margin(a))(0.3)
    forget()
    traced.clear()
    assert jax.jit(lambda a: margin(a))(0.3) == before
    assert not traced


def test_what_was_forgotten_is_traced_for_what_is_new(traced):
    before = margin(0.3)
    forget()
    traced.clear()
    assert jax.vmap(margin)(jnp.array([0.3, 0.4]))[0] == before
    assert len(traced) == 1


def test_only_the_latest_programs_stay():
    numbers = [jax.ShapeDtypeStruct((), float)]
    made = [Recipe.of(lambda x: x, jax.tree.structure(numbers), numbers, f"number {i}") for i in range(40)]
    programs = [each.program for each in made]
    assert [each.program is program for each, program in zip(made[8:], programs[8:])] == [True] * 32
    assert made[0].program is not programs[0]  # and is traced again where it is wanted
    own = Recipe.of(lambda x: x, jax.tree.structure(numbers), numbers, None)
    program = own.program
    forget_programs()
    assert made[39].program is not programs[39]
    assert own.program is program  # without facts it may hold what can be traced only once


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


def _deep(levels):
    for _ in range(100):
        _shallow()
    if levels:
        _deep(levels - 1)


def _shallow():
    pass


def test_frames_have_room_while_a_recipe_is_traced():
    """Else memory is asked for, and touched anew, at every call across the end of a piece: the system counts that."""
    resource = pytest.importorskip("resource")
    whose = getattr(resource, "RUSAGE_THREAD", resource.RUSAGE_SELF)
    number = [jax.ShapeDtypeStruct((), float)]
    found = []

    def count(levels=300):
        before = resource.getrusage(whose).ru_minflt
        _deep(levels)
        found.append(resource.getrusage(whose).ru_minflt - before)

    def traced(leaves):
        count()
        return leaves

    def in_a_thread(run):  # whose frames begin in a small piece, unlike those of a test
        thread = threading.Thread(target=run)
        thread.start()
        thread.join()

    in_a_thread(count)
    in_a_thread(lambda: Recipe(traced, jax.tree.structure(number), number).program)
    bare, roomy = found
    # A release of Python may keep a cycle (gh-142183), so the limit leaves room for little.
    assert roomy < 50 <= bare or roomy <= bare < 50


def test_the_collector_rests_while_a_recipe_is_traced():
    number, found = [jax.ShapeDtypeStruct((), float)], []
    recipe = Recipe(lambda leaves: found.append(gc.isenabled()) or leaves, jax.tree.structure(number), number)
    before = gc.isenabled()
    assert recipe.program is not None and found == [False]
    assert gc.isenabled() == before
