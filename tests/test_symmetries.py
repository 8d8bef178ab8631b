"""What must not change: mirror, similarity, time shift, superposition of motions, jit, vmap, order of the series."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk

BLOCK = rk.Block(0.2, 2.0, 0.9)
NOISE = np.random.default_rng(5).normal(size=400)
PATH = np.convolve(NOISE, np.hanning(15), mode="same")
SHAKING = rk.Record(0.9 * PATH / np.abs(PATH).max(), 0.02)

SCENES = {
    "sine, one impact": (BLOCK, rk.SinePulse(0.6, 1.1)),
    "sine, overturned": (BLOCK, rk.SinePulse(1.6, 1.1)),
    "sine, chattering": (BLOCK, rk.SinePulse(0.215, 2.5)),
    "cosine": (BLOCK, rk.CosinePulse(0.9, 0.5)),
    "ricker": (BLOCK, rk.RickerPulse(0.6, 0.7)),
    "ricker, antisymmetric": (BLOCK, rk.RickerPulse(0.6, 0.7, "antisymmetric")),
    "near-fault": (BLOCK, rk.MavroeidisPapageorgiouPulse(0.5, 0.9, 2.2, 0.4)),
    "exponential": (BLOCK, rk.ExponentialPulse(0.8, 0.4, 3.0)),
    "record": (rk.Block(0.2, 1.3), SHAKING),
    "initial motion only": (BLOCK, rk.Record([0.0], 0.01)),
}
MODELS = {"nonlinear": rk.Housner(), "linear": rk.Linear()}

outcome = jax.jit(rk.outcome)
simulate = jax.jit(lambda block, motion, model, initial: rk.simulate(block, motion, model, initial=initial))

scene = pytest.mark.parametrize("scene", SCENES)
model = pytest.mark.parametrize("model", MODELS)


def run(name, model, **changes):
    block, motion = SCENES[name]
    initial = (0.11, -0.05) if name == "initial motion only" else (0.0, 0.0)
    return outcome(changes.get("block", block), changes.get("motion", motion), MODELS[model],
                   initial=changes.get("initial", initial)), initial  # fmt: skip


def same(a, b, tolerance, rotation=1.0, time=1.0, delay=0.0):
    """Two outcomes are equal up to units of rotation and time."""
    assert a.status == rk.Status.successful and b.status == rk.Status.successful
    assert bool(a.overturned) == bool(b.overturned)
    assert int(a.impact_count) == int(b.impact_count)
    np.testing.assert_allclose(b.margin, a.margin, rtol=tolerance)
    if not a.overturned:
        np.testing.assert_allclose(b.max_rotation, a.max_rotation * rotation, rtol=tolerance)
        np.testing.assert_allclose(b.max_velocity, a.max_velocity * rotation / time, rtol=tolerance)
        np.testing.assert_allclose(b.time_of_max, a.time_of_max * time + delay, rtol=tolerance)


@scene
@model
def test_mirror(scene, model):
    block, motion = SCENES[scene]
    first, initial = run(scene, model)
    mirrored = tuple(-x for x in initial)
    same(first, run(scene, model, motion=-motion, initial=mirrored)[0], 1e-15)
    left = simulate(block, motion, MODELS[model], initial)
    right = simulate(block, -motion, MODELS[model], mirrored)
    np.testing.assert_array_equal(left.rotation, -right.rotation)
    np.testing.assert_array_equal(left.velocity, -right.velocity)


def slower(motion, factor):
    """The same motion, `factor` times as long."""
    times = {"duration", "period", "center", "dt"}
    names = [name for name in vars(motion) if name in times]
    changed = {name: getattr(motion, name) * factor for name in names}
    import equinox as eqx

    return eqx.tree_at(lambda m: [getattr(m, n) for n in names], motion, [changed[n] for n in names])


@scene
@model
def test_size(scene, model):
    """Geometric similarity: p halved and the motion twice as long, for slender and non-slender blocks."""
    block, motion = SCENES[scene]
    first, (rotation, velocity) = run(scene, model)
    bigger = rk.Block(block.alpha, block.p / 2, block.given_restitution)
    again, _ = run(scene, model, block=bigger, motion=slower(motion, 2.0), initial=(rotation, velocity / 2))
    same(first, again, 1e-15, time=2.0)


@scene
def test_slenderness_of_linear_block(scene):
    """The linear equation is homogeneous: rotation and acceleration scale with alpha."""
    block, motion = SCENES[scene]
    first, (rotation, velocity) = run(scene, "linear")
    slimmer = rk.Block(block.alpha / 4, block.p, block.restitution)
    again, _ = run(scene, "linear", block=slimmer, motion=0.25 * motion, initial=(rotation / 4, velocity / 4))
    same(first, again, 1e-15, rotation=0.25)


@scene
@model
def test_delay(scene, model):
    if scene == "initial motion only":
        pytest.skip("the clock starts with the motion")
    first, _ = run(scene, model)
    # A delay that is no multiple of anything: times round differently.
    again, _ = run(scene, model, motion=SCENES[scene][1].shifted(0.377))
    if not first.overturned:
        assert again.time_of_max - first.time_of_max == pytest.approx(0.377, abs=1e-11)
    np.testing.assert_allclose(again.max_rotation, first.max_rotation, rtol=3e-12)
    np.testing.assert_allclose(again.margin, first.margin, rtol=1e-11)
    assert int(again.impact_count) == int(first.impact_count)


@scene
def test_superposition(scene):
    """A motion is the sum of its parts, whatever their knots."""
    motion = SCENES[scene][1]
    first, _ = run(scene, "nonlinear")
    again, _ = run(scene, "nonlinear", motion=0.3 * motion + 0.7 * motion)
    np.testing.assert_allclose(again.max_rotation, first.max_rotation, rtol=1e-11)
    assert bool(again.overturned) == bool(first.overturned)


@scene
@model
def test_free_stage_is_what_integration_gives(scene, model):
    """The energy argument against the integrated motion, which a silent tail forces upon the engine."""
    block, motion = SCENES[scene]
    first, _ = run(scene, model)
    silent = motion + 0.0 * rk.RectangularPulse(1.0, 1.0).shifted(motion.end + 12 / block.p)
    again, _ = run(scene, model, motion=silent)
    assert bool(again.overturned) == bool(first.overturned)
    np.testing.assert_allclose(again.margin, first.margin, rtol=1e-9)
    np.testing.assert_allclose(again.max_rotation, first.max_rotation, rtol=1e-12)
    np.testing.assert_allclose(again.max_velocity, first.max_velocity, rtol=1e-12)
    np.testing.assert_allclose(again.time_of_max, first.time_of_max, rtol=1e-11)


@scene
@model
def test_history_and_outcome_agree(scene, model):
    """Two ways through the same engine: stopping at every event, and passing those that cannot matter."""
    block, motion = SCENES[scene]
    result, initial = run(scene, model)
    response = simulate(block, motion, MODELS[model], initial)
    assert response.status == rk.Status.successful
    assert bool(response.overturned) == bool(result.overturned)
    np.testing.assert_allclose(response.margin, result.margin, rtol=1e-11)
    if not result.overturned:
        np.testing.assert_allclose(response.max_rotation, result.max_rotation, rtol=1e-12)
        np.testing.assert_allclose(response.time_of_max, result.time_of_max, rtol=1e-11)
        assert float(np.max(np.abs(response.rotation))) <= float(result.max_rotation) * (1 + 1e-12)
        rotation, _ = response(result.time_of_max)
        np.testing.assert_allclose(np.abs(rotation), result.max_rotation, rtol=1e-12)


@pytest.mark.parametrize("order", [6, 10, 12, 20, 24])
@scene
def test_order_of_the_series(scene, order):
    first, _ = run(scene, "nonlinear")
    again = outcome(*SCENES[scene], engine=rk.Series(order=order), initial=(0.11, -0.05)
                    if scene == "initial motion only" else (0.0, 0.0))  # fmt: skip
    np.testing.assert_allclose(again.max_rotation, first.max_rotation, rtol=3e-12)
    np.testing.assert_allclose(again.margin, first.margin, rtol=1e-10)


def test_limits_of_the_exponential_pulse():
    for shape, pulse in ((-np.inf, rk.RectangularPulse), (0.0, rk.TriangularPulse), (1e-13, rk.TriangularPulse)):
        a = outcome(BLOCK, rk.ExponentialPulse(0.7, 0.5, shape))
        b = outcome(BLOCK, pulse(0.7, 0.5))
        np.testing.assert_allclose(a.max_rotation, b.max_rotation, rtol=1e-12)
    spike = outcome(BLOCK, rk.ExponentialPulse(0.7, 0.5, np.inf))
    assert spike.max_rotation == 0 and spike.margin >= 1 and spike.impact_count == 0


def test_triangle_as_a_record():
    record = rk.Record([0.0, 0.4, 0.8, 0.4, 0.0], 0.1)
    a, b = outcome(BLOCK, record), outcome(BLOCK, rk.TriangularPulse(0.8, 0.4))
    np.testing.assert_allclose(a.max_rotation, b.max_rotation, rtol=1e-13)
    np.testing.assert_allclose(a.margin, b.margin, rtol=1e-12)


@model
def test_eager_jit_vmap_and_loop_agree(model):
    amplitudes = jnp.linspace(0.15, 1.7, 23)

    def one(amplitude):
        return rk.outcome(BLOCK, rk.SinePulse(amplitude, 1.1), MODELS[model])

    loop = [one(a) for a in amplitudes]
    for many in (jax.vmap(one)(amplitudes), jax.jit(jax.vmap(one))(amplitudes)):
        for i, single in enumerate(loop):
            lane = jax.tree.map(lambda x: x[i], many)
            np.testing.assert_allclose(lane.max_rotation, single.max_rotation, rtol=1e-13)
            np.testing.assert_allclose(lane.margin, single.margin, rtol=1e-11)
            assert int(lane.impact_count) == int(single.impact_count)
            assert lane.status == single.status


def test_vmap_over_blocks_and_nested():
    blocks = rk.Block(jnp.linspace(0.1, 0.4, 5), jnp.linspace(1.0, 4.0, 5))
    many = jax.vmap(rk.outcome, in_axes=(0, None))(blocks, SHAKING)
    for i in range(5):
        single = rk.outcome(rk.Block(blocks.alpha[i], blocks.p[i]), SHAKING)
        np.testing.assert_allclose(many.margin[i], single.margin, rtol=1e-8)
        assert bool(many.overturned[i]) == bool(single.overturned)
    records = rk.Record(jnp.stack([SHAKING.samples, 0.5 * SHAKING.samples]), jnp.full(2, 0.02))
    grid = jax.vmap(jax.vmap(rk.outcome, in_axes=(0, None)), in_axes=(None, 0))(blocks, records)
    assert grid.max_rotation.shape == (2, 5)
    np.testing.assert_allclose(grid.margin[0], many.margin, rtol=1e-8)


def test_histories_under_vmap():
    amplitudes = jnp.array([0.1, 0.3, 0.6, 1.6])
    many = jax.vmap(lambda a: rk.simulate(BLOCK, rk.SinePulse(a, 1.1), duration=4.0))(amplitudes)
    times = jax.vmap(lambda r: r.impact_times)(many)
    for i, amplitude in enumerate(amplitudes):
        single = rk.simulate(BLOCK, rk.SinePulse(amplitude, 1.1), duration=4.0)
        np.testing.assert_allclose(many.rotation[i], single.rotation, atol=1e-12)
        count = len(single.impact_times)
        np.testing.assert_allclose(times[i, :count], single.impact_times, rtol=1e-12)
        assert np.all(np.isinf(times[i, count:]))
