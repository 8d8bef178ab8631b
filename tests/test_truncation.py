"""Truncation error of a step under a record, beside the estimate from its last terms, for starts of every kind."""

import functools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.engines.scene import Scene
from jaxrock.engines.state import initial_state
from jaxrock.engines.taylor.expansion import taylor_expansion
from jaxrock.models.coefficients import Coefficients, Terms
from jaxrock.numerics.polynomial import last_size, remainder

COUNT, MORE = 20_000, 12  # starts; terms that are taken for all


class Slow(rk.models.AbstractEquation):
    """A moment that hardly changes with the angle, and an arm that does: terms vanish together."""

    slope: float

    def moments(self, block):
        return Coefficients(
            Terms(constant=jnp.sin(block.alpha), line=-self.slope * jnp.ones_like(block.alpha)),
            Terms(cosine=jnp.cos(block.alpha)),
        )


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


def left_out(model, has_vertical, columns):
    """Return, for a step over a whole piece: the last terms, the actual truncation, the allowance, and the estimate.

    The terms after the last give the actual truncation.
    """

    def one(alpha, stretch, opening, velocity, now, then, vertical):
        def record(first):  # it has many pieces
            return rk.Record(jnp.zeros(40).at[:2].set(first), stretch)

        horizontal = record(jnp.stack([now, then]))
        motion = horizontal.with_vertical(record(vertical)) if has_vertical else horizontal
        scene = Scene.of(rk.Block(alpha, 1.0, 0.9), motion, model)
        stepper = rk.Series().stepper(scene, None, history=False).on(jnp.float64(1.0))
        piece = jnp.int32(has_vertical)  # the knots of both components are its own: the first piece has no length
        state = initial_state(scene, opening, jnp.zeros_like(opening))
        state = replace(state, side=jnp.float64(1.0), velocity=velocity, piece=piece)
        shaking, unit = stepper.shaking(state.piece, state.local)
        start, order = stepper.start(state, shaking, unit), stepper.order
        terms = taylor_expansion(start, order + MORE).opening
        allowed = stepper.tolerance * jnp.minimum(alpha, jnp.abs(terms[0]) + jnp.abs(terms[1]))
        length = stepper.room(state) / unit
        later = sum(c * length ** (order + 1 + k) for k, c in enumerate(terms[order + 1 :]))
        kept = terms[: order + 1]
        return last_size(kept) * length**order, jnp.abs(later), allowed, remainder(kept, length)

    return (np.asarray(x) for x in jax.jit(jax.vmap(one))(*map(jnp.asarray, columns)))


CASES = {
    "nonlinear": (rk.Housner(), False),
    "vertical": (rk.Housner(), True),
    "linear, vertical": (rk.Linear(), True),
    "linear spring": (rk.Spring("SM1", "linear"), False),
    "plastic spring": (rk.Spring("SM1", "plastic"), False),
    "slow moment": (Slow(0.1), False),
    "hardly any moment": (Slow(1e-4), True),
}


@pytest.mark.parametrize(("model", "has_vertical"), CASES.values(), ids=CASES)
def test_no_more_is_left_out_than_is_allowed(model, has_vertical):
    told, true, allowed, _ = left_out(model, has_vertical, starts(np.random.default_rng(19)))
    taken = told <= allowed  # as steps are
    assert np.all(true[taken] <= allowed[taken])
    assert np.mean(taken) > 0.6 * np.mean(true <= allowed)  # nor is much said to be left out that is not


@functools.cache
def outcomes_of(order):
    """Outcomes of scenes with this moment by an order of the series, compiled once for both of its slopes."""

    def one(alpha, p, samples, dt, slope):
        return rk.outcome(rk.Block(alpha, p, 0.9), rk.Record(samples, dt), Slow(slope), engine=rk.Series(order=order))

    many = jax.jit(jax.vmap(one, in_axes=(0, 0, 0, 0, None)))
    return lambda *given: jax.device_get(many(*given))


@pytest.mark.parametrize(("model", "has_vertical"), CASES.values(), ids=CASES)
def test_what_is_left_out_is_told(model, has_vertical):
    """The estimate is that of an asymptotic series: of the steps whose truncation matters few exceed it much."""
    last, true, allowed, told = left_out(model, has_vertical, starts(np.random.default_rng(19)))
    taken = (last <= allowed) & (true > 1e-2 * allowed)
    share = true[taken] / told[taken]
    assert taken.sum() > 5 and np.median(share) < 4 and np.mean(share > 30) < 0.02


@pytest.mark.parametrize("slope", [0.1, 1e-3])
def test_a_moment_that_hardly_changes(slope):
    """Outcomes by the order of records, beside order 20 over quarters of the pieces."""
    random, count = np.random.default_rng(3), 200
    alpha, p = random.uniform(0.05, 0.4, count), random.uniform(0.5, 8, count)
    dt = 10 ** random.uniform(-2.5, -1.3, count)
    samples = random.normal(size=(count, 150))
    samples *= (np.tan(alpha) * random.uniform(1.5, 10, count) / np.abs(samples).max(1))[:, None]
    quarters = np.stack([np.interp(np.arange(597) / 4, np.arange(150), row) for row in samples])
    found = outcomes_of(None)(alpha, p, samples, dt, slope)
    # So few at a time that all go the careful way.
    parts = [outcomes_of(20)(*(x[k : k + 50] for x in (alpha, p, quarters, dt / 4)), slope) for k in range(0, 200, 50)]
    exact = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    judged = (found.status == rk.Status.successful) & (exact.status == rk.Status.successful)
    np.testing.assert_array_equal(found.overturned[judged], exact.overturned[judged])
    judged &= ~found.overturned
    off = np.abs(found.max_rotation[judged] - exact.max_rotation[judged])
    assert judged.sum() > 100 and np.all(off <= found.error[judged] + exact.error[judged])
