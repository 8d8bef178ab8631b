"""What the series of a step leaves out, beside the terms themselves, from starts of every kind."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.engines.scene import Scene
from jaxrock.engines.state import initial_state
from jaxrock.engines.taylor.expansion import expand

COUNT, MORE = 20_000, 12  # starts; terms that are taken for all


def starts(random):
    """Slenderness, p dt, opening angle, velocity, and the ground's acceleration (two components, at two samples):
    mostly of one size with what lifts a block, now and then zero, nearly flat, or a ramp of 3 g in a sample."""
    size = lambda low, high: 10 ** random.uniform(low, high, COUNT)  # noqa: E731
    rarely = lambda share: random.random(COUNT) < share  # noqa: E731
    alpha = random.uniform(0.03, 0.6, COUNT)
    opening = np.where(rarely(0.1), random.uniform(0, 1.5, COUNT), alpha * size(-6, 0.3))
    velocity = np.where(rarely(0.05), random.uniform(-2, 2, COUNT), random.normal(size=COUNT) * alpha * size(-4, 0.3))
    now = np.where(rarely(0.05), 0, random.normal(size=COUNT) * size(-3, 0.5))
    change = np.where(rarely(0.05), 0, random.normal(size=COUNT) * size(-4, 0.5))
    vertical = 0.5 * random.normal(size=(COUNT, 2))
    return alpha, size(-3, 0), opening, np.where(rarely(0.05), 0, velocity), now, now + change, vertical


def left_out(model, order, has_vertical, columns):
    """What is told, the sum of what is left out, and what is allowed to be."""

    def one(alpha, stretch, opening, velocity, now, then, vertical):
        def record(first):  # it has many pieces
            return rk.Record(jnp.zeros(40).at[:2].set(first), stretch)

        horizontal = record(jnp.stack([now, then]))
        motion = horizontal.with_vertical(record(vertical)) if has_vertical else horizontal
        scene = Scene.of(rk.Block(alpha, 1.0, 0.9), motion, model)
        stepper = rk.Series(order=order).stepper(scene, None, history=False).on(jnp.float64(1.0))
        piece = jnp.int32(has_vertical)  # the knots of both components are its own: the first piece has no length
        state = initial_state(scene, opening, jnp.zeros_like(opening))
        state = replace(state, side=jnp.float64(1.0), velocity=velocity, piece=piece)
        shaking, unit = stepper.shaking(state.piece, state.local)
        start = stepper.start(state, shaking, unit)
        terms = expand(start, order + MORE).opening
        told = stepper.remainder(start, terms[: order + 1])
        allowed = stepper.tolerance * jnp.minimum(alpha, jnp.abs(terms[0]) + jnp.abs(terms[1]))
        length = stepper.room(state) / unit  # a whole piece
        later = sum(c * length ** (order + 1 + k) for k, c in enumerate(terms[order + 1 :]))
        return told.at(length), jnp.abs(later), allowed

    return (np.asarray(x) for x in jax.jit(jax.vmap(one))(*map(jnp.asarray, columns)))


@pytest.mark.parametrize(
    ("model", "order", "has_vertical"),
    [(rk.Housner(), 8, False), (rk.Housner(), 6, False), (rk.Housner(), 8, True), (rk.Linear(), 8, True)],
    ids=["nonlinear", "order 6", "vertical", "linear, vertical"],
)
def test_little_more_is_left_out_than_is_told(model, order, has_vertical):
    told, true, allowed = left_out(model, order, has_vertical, starts(np.random.default_rng(19)))
    assert np.mean(true > told) < 1e-3 and np.all(true <= 10 * told)
    taken = told <= allowed
    assert np.all(true[taken] <= allowed[taken])
    assert np.mean(taken) > 0.4 * np.mean(true <= allowed)  # it is not said to be much more than it is, either
