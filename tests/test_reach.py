"""How far a block goes within a piece of a record: exactly in the linear model, beside the series, and what is told."""

import functools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.engines.scene import Scene
from jaxrock.engines.state import initial_state
from jaxrock.engines.taylor import trial_step

RNG = np.random.default_rng(11)
SAMPLES = RNG.normal(0, 0.3, 40)
COUNT = 400


@functools.partial(jax.jit, static_argnums=0)
def _reached(way, dt, *given):
    """Compiled once for each way."""

    def one(alpha, p, opening, velocity, side, piece):
        motion = rk.Record(SAMPLES, dt)
        scene = Scene.of(rk.Block(alpha, p, 0.9), motion, rk.Linear())
        stepper = rk.Series(order=20).stepper(scene, None, history=False).on(side)
        state = initial_state(scene, side * opening, side * velocity * p)
        state = replace(state, piece=piece)
        shaking, unit = stepper.shaking(state.piece, state.local)
        start, whole = stepper.start(state, shaking, unit), stepper.room(state) * (1 / unit)
        found = way(stepper, start, unit, whole)
        times = jnp.linspace(0.0, 1.0, 101) * found.room
        speeds = jax.vmap(lambda t: _linear_speed(start, t))(times)
        return found._replace(start=start.speed), speeds

    return jax.vmap(one)(*given)


def reached(way, *given):
    """Return bounds of a piece by one of the two ways, and positions of the block at many times within it."""
    *numbers, dt = given
    return jax.device_get(_reached(way, dt, *numbers, RNG.integers(0, 38, COUNT).astype(np.int32)))


def _linear_speed(start, t):
    """x'' = s^2 (x - alpha - side u): hyperbolic functions about the balance, which moves."""
    now, slope = start.shaking.horizontal
    rate = start.stretch
    offset = start.opening - start.moments.restoring_terms.constant - start.side * now
    grown = 2 * jnp.sinh(rate * t / 2) ** 2  # cosh - 1, without cancellation
    return start.speed + (start.speed - start.side * slope) * grown + rate * offset * jnp.sinh(rate * t)


def drawn():
    alpha, p = RNG.uniform(0.08, 0.3, COUNT), RNG.uniform(0.8, 4.0, COUNT)
    opening = alpha * RNG.uniform(0.01, 1.6, COUNT)
    return alpha, p, opening, alpha * RNG.normal(0, 0.5, COUNT), RNG.choice([-1.0, 1.0], COUNT)


@pytest.mark.parametrize("dt", [0.005, 0.04, 0.15])
def test_exact_pieces_are_those_of_the_series(dt):
    """Half and quarters of pieces, too, where p dt is large."""
    where = RNG.bit_generator.state
    given = drawn()
    exact, speeds = reached(trial_step._exactly, *given, dt)
    assert np.all(exact.holds) and (np.all(exact.full) or dt > 0.04)
    RNG.bit_generator.state = where
    given = drawn()
    series, _ = reached(trial_step._by_series, *given, dt)
    same = np.asarray(exact.room == series.room)
    assert same.mean() > 0.1
    for name in ("opening", "speed"):
        found, expected = (np.asarray(getattr(x, name))[same] for x in (exact, series))
        np.testing.assert_allclose(found, expected, rtol=4e-15, atol=4e-16)
    np.testing.assert_allclose(exact.speed, speeds[:, -1], rtol=4e-15, atol=4e-16)


@pytest.mark.parametrize("dt", [0.005, 0.15])
def test_what_is_told_of_a_piece_is_so(dt):
    """Check the facts of a piece: one-way velocity keeps its sign, steady velocity grows or falls, and bounds hold."""
    exact, speeds = reached(trial_step._exactly, *drawn(), dt)
    speeds = np.asarray(speeds)
    signs = np.sign(speeds)
    assert np.all((signs == signs[:, :1]).all(axis=1)[np.asarray(exact.one_way)])
    steps = np.diff(speeds, axis=1)
    monotone = np.all(steps > -1e-15, axis=1) | np.all(steps < 1e-15, axis=1)
    assert np.all(monotone[np.asarray(exact.steady)])
    assert np.all(np.abs(speeds).max(axis=1) <= np.asarray(exact.largest) * (1 + 1e-12))
    for told in (exact.one_way, exact.steady):  # and it is told of most, and not of all
        assert 0.5 < np.mean(told) < 1 or dt < 0.1


def test_only_linear_equations_under_straight_lines_go_exactly():
    """A vertical motion, or an arm that grows, takes the series."""
    record = rk.Record(SAMPLES, 0.01)

    def is_exact(model, motion):
        found = []
        jax.eval_shape(lambda motion: started(model, motion, found), motion)
        return found[0]

    def started(model, motion, found):
        scene = Scene.of(rk.Block(0.2, 2.0), motion, model)
        stepper = rk.Series().stepper(scene, None, history=False)
        state = initial_state(scene, jnp.asarray(0.1), jnp.asarray(0.0))
        found.append(trial_step._is_linear(stepper.start(state, *stepper.shaking(state.piece, state.local))))
        return state

    assert is_exact(rk.Linear(), record) and is_exact(rk.Linear(), 2 * record)
    assert not is_exact(rk.Housner(), record)
    assert not is_exact(rk.Linear(), record.with_vertical(record))
    assert not is_exact(rk.Linear(), record + rk.SinePulse(0.1, 0.5))
