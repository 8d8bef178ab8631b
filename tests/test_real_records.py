"""The judge of blocks under records against other solutions, and jaxrock against its judgements."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

import jaxrock as rk
from references import chaotic, responses
from references.arithmetic import Arithmetic
from references.real_records import CHANGE, Scene, digits_of, follow, judge


def shaken(seed, count=500, dt=0.01, scale=1.5):
    """A slender block under three cycles and noise."""
    made = chaotic.Made(seed, period=0.6, noise=0.5, seconds=12.0)
    return Scene(made.samples()[:count], dt, scale, 0.3, 2.1, 0.9)


def test_a_constant_push_ends_as_its_integrals_say():
    """Between uplift and the end of a constant push the opening is an elliptic integral; then the energy decides."""
    alpha, p, u, count, dt = 0.25, 2.0, 0.4, 31, 0.01
    with mpmath.workdps(40):
        a, force = mpmath.mpf(alpha), mpmath.mpf(u)
        energy = lambda x: 2 * mpmath.sin(x / 2) * (force * mpmath.cos(a - x / 2) - mpmath.sin(a - x / 2))
        # x = y^2 removes the root at the start of the integral of dx / x'
        time = lambda x: mpmath.quad(lambda y: 2 * y / mpmath.sqrt(2 * energy(y * y)), [0, mpmath.sqrt(x)])
        whole = mpmath.mpf(p) * mpmath.mpf(dt) * (count - 1)
        x = mpmath.findroot(lambda x: time(x) - whole, mpmath.mpf("0.04"))
        left = 1 - mpmath.cos(a - x) - energy(x)
        peak = (a - mpmath.acos(1 - left)) / a
    one = Scene(np.full(count, 1.0), dt, u, alpha, p, 0.9)
    for limbs in (2, 4):
        run = follow(one, limbs)
        assert run.overturned is False and abs(run.peak - float(peak)) < 4e-16
        assert abs(run.rotations[-1] + float(x)) < 1e-16


@pytest.mark.parametrize("seed", range(3))
def test_it_finds_what_the_taylor_reference_finds(seed):
    one, arithmetic = shaken(seed), Arithmetic(40)
    with arithmetic.context():
        block, numbers = (one.alpha, one.p, one.restitution), (one.samples, one.dt)
        path = responses.follow((block, "record", numbers), arithmetic.number(one.scale), (), arithmetic)
        peak, time = float(path.peak / arithmetic.number(one.alpha)), float(path.peak_time)
    run = follow(one)
    assert run.overturned == path.overturned
    assert abs(run.peak - peak) < 1e-15 and abs(run.time_of_peak - time) < 1e-14


def test_it_agrees_with_jaxrock_where_jaxrock_decides():
    made, heights, slenderness = chaotic.Made(5, noise=0.6), jnp.geomspace(0.3, 12.0, 12), jnp.array([2.0, 5.0, 12.0])
    record = rk.Record(made.samples(), made.dt)
    height, ratio = (x.ravel() for x in jnp.meshgrid(heights, slenderness))
    block = jax.vmap(lambda width, height: rk.Block.from_dimensions(width=width, height=height))(height / ratio, height)
    found = jax.jit(jax.vmap(lambda block: (rk.outcome(block, record), block.restitution)))(block)
    outcome, restitution = jax.tree.map(np.asarray, found)
    sure = np.flatnonzero(np.asarray(outcome.status == rk.Status.successful) & (outcome.max_rotation > 0))
    assert len(sure) > 25
    for i in sure:
        numbers = (float(x[i]) for x in (block.alpha, block.p, restitution))
        run = follow(Scene(made.samples(), made.dt, 1.0, *numbers))
        assert run.overturned == outcome.overturned[i]
        if not run.overturned:
            off = abs(outcome.max_rotation[i] - run.peak * float(block.alpha[i]))
            assert off < 1e-12 + 4 * outcome.error[i] < 1e-6


def test_digits_that_do_not_suffice_are_told():
    """Many hops before a verdict: copies an ulp of alpha apart part, and 38 digits keep them apart by their change."""
    one = shaken(1, 1200)
    near, far = follow(one, 2, CHANGE), follow(replace(one, alpha=np.nextafter(one.alpha, 1.0)))
    same = follow(one)
    assert abs(near.rotations - same.rotations).max() < abs(far.rotations - same.rotations).max()
    known = judge(one, budget=100)
    assert known.overturned is None and np.isnan(known.peak)


def test_more_digits_change_nothing_that_was_decided():
    for seed in range(3):
        one = shaken(seed, 1200)
        known, more = judge(one), follow(one, 8, 12345, 3)
        assert known.digits == digits_of(2) and known.overturned == more.overturned
        assert abs(known.runs[0].peak - more.peak) < 1e-15
        np.testing.assert_allclose(known.runs[0].rotations, more.rotations, atol=1e-9 * one.alpha)


@pytest.mark.parametrize("name", [chaotic.EXAMPLE, *chaotic.MADE])
def test_kept_chaotic_scenes_are_rebuilt(name):
    for kept in [kept for kept in chaotic.kept_scenes() if kept["record"] == name][:2]:
        known = judge(chaotic.scene(kept))
        assert known.overturned == kept["overturned"] and known.digits == kept["digits"]
        if not known.overturned:
            np.testing.assert_allclose(
                [known.peak, known.time_of_peak], [kept["peak"], kept["time_of_peak"]], rtol=1e-9
            )
