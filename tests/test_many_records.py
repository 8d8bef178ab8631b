"""Records of many lengths are one program, and many scales of a record share its arrays."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.motions.pieces import Extent
from jaxrock.responses.outcome import _outcome

QUICK = {"model": rk.Linear(), "engine": rk.Series(order=6)}  # compiles in half the time


class Unpadded(rk.Record):
    """A record that the engines take as it is."""


KINDS, BLOCK = (rk.Record, Unpadded), rk.Block(0.15, 3.0)


@functools.cache
def with_and_without_room(count):
    """Samples, and of both kinds of record all that an outcome tells, and the slope of its margin by the time step."""
    samples = 1.5 * np.asarray(rk.example_record().samples)[380 : 380 + count]

    def margin(dt, kind):
        found = rk.outcome(BLOCK, kind(samples, dt), **QUICK)
        return found.margin, found

    found = [jax.value_and_grad(margin, has_aux=True)(0.01, kind) for kind in KINDS]
    return samples, [outcome for (_, outcome), _ in found], [slope for _, slope in found]


@pytest.mark.parametrize("count", [65, pytest.param(300, marks=pytest.mark.slow)])
def test_room_for_more_samples_changes_nothing(count):
    """A record gets room for more samples, so that one program serves many lengths: results are those without."""
    samples, outcomes, _ = with_and_without_room(count)
    for found, expected in zip(*map(jax.tree.leaves, outcomes)):
        np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-15)
    histories = [rk.simulate(BLOCK, kind(samples, 0.01), samples=101, **QUICK) for kind in KINDS]
    np.testing.assert_allclose(*(history.time for history in histories), rtol=1e-15)
    np.testing.assert_allclose(*(history.rotation for history in histories), atol=1e-12)


def test_derivatives_by_the_time_step_with_room():
    """The record's end moves with its time step, too."""
    _, _, (found, expected) = with_and_without_room(65)
    assert abs(expected) > 1
    np.testing.assert_allclose(found, expected, rtol=1e-9)


@pytest.mark.parametrize("kind", ["anywhere", "beside where a piece begins", "of refused time steps"])
def test_how_many_pieces_last_without_looking_at_each(kind, most=400):
    """By two numbers as by a list: wherever the record ends, as times are rounded, and for what was never checked."""
    draw = np.random.default_rng(8)
    dt, finish = draw.uniform(1e-3, 0.1, 3000), draw.uniform(-0.1, 1.1, 3000)
    if kind == "anywhere":
        finish = finish * most * dt
    elif kind == "beside where a piece begins":
        finish = dt * draw.integers(0, most + 2, dt.size)
        finish = np.stack([np.nextafter(finish, -1.0), finish, np.nextafter(finish, 1e9)], axis=1).ravel()
        dt = np.repeat(dt, 3)
    else:
        dt, finish = map(np.ravel, np.meshgrid([-0.1, -0.0, 0.0, np.nan, np.inf, 5e-324], [-1.0, 0.0, 1.0, np.nan]))

    def both(dt, finish):
        listed = jnp.where(dt * jnp.arange(most) < finish, dt, 0.0)
        return Extent.of_equal(dt, most, finish), Extent.of(listed)

    found, expected = jax.vmap(both)(dt, finish)
    np.testing.assert_array_equal(found.forward, dt >= 0)
    assert np.all(expected.forward[found.forward])
    np.testing.assert_array_equal(found.pieces[found.forward], expected.pieces[found.forward])
    assert kind != "anywhere" or len(np.unique(found.pieces)) > 300


def test_records_of_many_lengths_are_one_program():
    samples, block = np.asarray(rk.example_record().samples), rk.Block(0.2, 2.0)
    rk.outcome(block, rk.Record(samples[:1790], 0.01), **QUICK)
    before = _outcome._cache_size()
    for count in (1537, 1600, 1792):
        rk.outcome(block, rk.Record(samples[:count], 0.01), **QUICK)
    assert _outcome._cache_size() == before


@pytest.mark.parametrize("vertical", [False, True])
def test_scales_of_a_record_share_its_arrays(vertical):
    """No lane keeps arrays of its own as long as the record; what acts against the threshold is one for a moment."""
    record, block = rk.example_record(), rk.Block(0.2, 2.0)

    def margin(scale):
        motion = scale * record
        return rk.outcome(block, motion.with_vertical(0.3 * record) if vertical else motion, **QUICK).margin

    scales = np.linspace(0.5, 2.0, 200)
    memory = jax.jit(jax.vmap(margin)).lower(scales).compile().memory_analysis()
    assert memory.temp_size_in_bytes < (500 if vertical else 40) * record.samples.nbytes


def test_one_scene_holds_its_lists_once():
    """Not once for each lane of a vector: a record of a million samples is answered in little memory."""
    record, block = rk.example_record(), rk.Block(0.2, 2.0)
    memory = jax.jit(lambda r: rk.outcome(block, r, **QUICK).margin).lower(record).compile().memory_analysis()
    assert memory.temp_size_in_bytes < 25 * record.samples.nbytes


def test_a_suite_is_drawn_up_by_a_few_programs():
    """Twelve records of twelve lengths need no program that the first of them did not need (but for its shapes)."""
    programs = []

    def listen(name, *_, **__):
        programs.append(name)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        random = np.random.default_rng(0)
        rk.motions.Suite([rk.Record(random.normal(0, 0.3, 1030), 0.01)])
        programs.clear()
        suite = rk.motions.Suite([rk.Record(random.normal(0, 0.3, 1100 + 37 * k), 0.01) for k in range(12)])
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)  # those of other tests stay
    compiled = [name for name in programs if name.endswith("backend_compile_duration")]
    # Slices of arrays are cut by shape: that is all.
    assert len(suite) == 12 and len(compiled) <= 3, compiled
