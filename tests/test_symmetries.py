"""Invariances: mirror, similarity, time shift, superposition of motions, jit, vmap, order of the series."""

import equinox as eqx
import jax
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
    "ricker, antisymmetric": (BLOCK, rk.RickerPulse(0.6, 0.7, "antisymmetric")),
    "near-fault": (BLOCK, rk.MavroeidisPapageorgiouPulse(0.5, 0.9, 2.2, 0.4)),
    "exponential": (BLOCK, rk.ExponentialPulse(0.8, 0.4, 3.0)),
    "record": (rk.Block(0.2, 1.3), SHAKING),
}
MODELS = {"nonlinear": rk.Housner(), "linear": rk.Linear(), "plastic spring": rk.Spring("SM3", "plastic")}

outcome = rk.outcome


@jax.jit
def followed(block, motion, initial, time):
    response = rk.simulate(block, motion, initial=initial)
    return response, response(time)[0]


def simulate(block, motion, factor, initial=(0.0, 0.0), time=0.0):
    """A history under a motion times a factor, and the rotation at a time: compiled once for each kind of motion."""
    return followed(block, float(factor) * motion, initial, float(time))


RARE = {"ricker, antisymmetric", "near-fault", "exponential"}  # other motions, the same engine


def scenes(names):
    """Decorate a test with scenes by their names."""
    marked = [pytest.param(name, marks=pytest.mark.slow) if name in RARE else name for name in names]
    return pytest.mark.parametrize("scene", marked)


scene = scenes(SCENES)
# The linear model shares the engine's path: one scene of it, unless all are asked for.
scene_and_model = pytest.mark.parametrize(
    "scene, model",
    [
        pytest.param(scene, model, id=f"{model}-{scene}", marks=() if quick else pytest.mark.slow)
        for model in MODELS
        for scene in SCENES
        for quick in [scene not in RARE and model == "nonlinear" or (scene, model) == ("sine, one impact", "linear")]
    ],
)


def staged(motion, factor=1.0, delay=0.0, silence=0.0, share=1.0):
    """The motion times a factor, after a delay, before a silence, from two shares of it: one type, so that it
    compiles once a scene."""
    moved = (share * factor * motion).shifted(delay)
    rest = ((1.0 - share) * factor * motion).shifted(delay + silence)
    return moved + rest


def run(scene, model, initial=(0.0, 0.0), block=None, **changes):
    own, motion = SCENES[scene]
    return outcome(block or own, staged(motion, **changes), MODELS[model], initial=initial)


def same(a, b, tolerance, rotation=1.0, time=1.0, delay=0.0):
    """Two outcomes are equal up to units of rotation and time, and a delay."""
    assert a.status == rk.Status.successful and b.status == rk.Status.successful
    assert bool(a.overturned) == bool(b.overturned)
    assert int(a.impact_count) == int(b.impact_count)
    np.testing.assert_allclose(b.margin, a.margin, rtol=10 * tolerance)
    if not a.overturned:
        np.testing.assert_allclose(b.max_rotation, a.max_rotation * rotation, rtol=tolerance)
        np.testing.assert_allclose(b.max_velocity, a.max_velocity * rotation / time, rtol=tolerance)
        np.testing.assert_allclose(b.time_of_max, a.time_of_max * time + delay, rtol=10 * tolerance)


@scene_and_model
def test_mirror(scene, model):
    initial = (0.03, -0.05)
    mirrored = (-0.03, 0.05)
    same(run(scene, model, initial), run(scene, model, mirrored, factor=-1.0), 1e-15)


@pytest.mark.parametrize("scene", ["sine, one impact", "record"])
def test_mirrored_history(scene):
    block, motion = SCENES[scene]
    left, _ = simulate(block, motion, 1.0, (0.03, -0.05))
    right, _ = simulate(block, motion, -1.0, (-0.03, 0.05))
    np.testing.assert_array_equal(left.rotation, -np.asarray(right.rotation))
    np.testing.assert_array_equal(left.velocity, -np.asarray(right.velocity))


def slower(motion, factor):
    """Return the motion stretched to `factor` times its duration."""
    names = [name for name in vars(motion) if name in {"duration", "period", "center", "dt"}]
    return eqx.tree_at(
        lambda m: [getattr(m, name) for name in names], motion, [getattr(motion, name) * factor for name in names]
    )


@scene_and_model
def test_size(scene, model):
    """Geometric similarity: p halved and the motion twice as long, for slender and non-slender blocks."""
    block, motion = SCENES[scene]
    bigger = rk.Block(block.alpha, block.p / 2, block.law)
    first = outcome(block, staged(motion), MODELS[model], initial=(0.03, -0.05))
    again = outcome(bigger, staged(slower(motion, 2.0)), MODELS[model], initial=(0.03, -0.025))
    same(first, again, 1e-13, time=2.0)


# Housner's restitution depends on alpha.
@scenes([name for name, (block, _) in SCENES.items() if not isinstance(block.law, rk.restitution.Housner)])
def test_slenderness_of_linear_block(scene):
    """The linear equation is homogeneous: rotation and acceleration scale with alpha."""
    block, _ = SCENES[scene]
    slimmer = rk.Block(block.alpha / 4, block.p, block.law)
    first = run(scene, "linear", (0.03, -0.05))
    again = run(scene, "linear", (0.0075, -0.0125), block=slimmer, factor=0.25)
    same(first, again, 1e-15, rotation=0.25)


@scene_and_model
def test_delay(scene, model):
    """A delay that is no multiple of anything: times round differently."""
    same(run(scene, model), run(scene, model, delay=0.377), 3e-12, delay=0.377)


@scene_and_model
def test_wrapping_changes_nothing(scene, model):
    same(outcome(*SCENES[scene], MODELS[model]), run(scene, model), 1e-12)


@pytest.mark.parametrize("scene", ["sine, one impact", pytest.param("record", marks=pytest.mark.slow)])
def test_superposition(scene):
    """A motion is the sum of its parts."""
    block, motion = SCENES[scene]
    same(outcome(block, motion), outcome(block, staged(motion, share=0.3)), 1e-11)


@scene_and_model
def test_free_stage_is_what_integration_gives(scene, model):
    """Compare the energy argument of the free stage with integration, which a silent tail forces."""
    first, again = run(scene, model), run(scene, model, silence=12.0)
    assert bool(again.overturned) == bool(first.overturned)
    np.testing.assert_allclose(again.margin, first.margin, rtol=1e-9)
    np.testing.assert_allclose(again.max_rotation, first.max_rotation, rtol=1e-12)
    np.testing.assert_allclose(again.max_velocity, first.max_velocity, rtol=1e-12)
    np.testing.assert_allclose(again.time_of_max, first.time_of_max, rtol=1e-11)


@scene
def test_history_and_outcome_agree(scene):
    """Two ways through the same engine: stopping at every event, and passing those that cannot matter."""
    block, motion = SCENES[scene]
    result = outcome(block, motion)
    response, rotation = simulate(block, motion, 1.0, time=0.0 if result.overturned else result.time_of_max)
    assert response.status == rk.Status.successful
    assert bool(response.overturned) == bool(result.overturned)
    np.testing.assert_allclose(response.margin, result.margin, rtol=1e-11)
    if not result.overturned:
        np.testing.assert_allclose(response.max_rotation, result.max_rotation, rtol=1e-12)
        np.testing.assert_allclose(response.time_of_max, result.time_of_max, rtol=1e-11)
        assert float(np.max(np.abs(response.rotation))) <= float(result.max_rotation) * (1 + 1e-12)
        np.testing.assert_allclose(np.abs(rotation), result.max_rotation, rtol=1e-12)


ORDERS = [("sine, one impact", 6), ("record", 12)]
MORE_ORDERS = [(scene, order) for scene in ("sine, one impact", "record") for order in (6, 12, 24)]


@pytest.mark.parametrize(
    "scene, order", ORDERS + [pytest.param(*row, marks=pytest.mark.slow) for row in MORE_ORDERS if row not in ORDERS]
)
def test_order_of_the_series(scene, order):
    block, motion = SCENES[scene]
    again = outcome(block, motion, engine=rk.Series(order=order))
    same(outcome(block, motion), again, 3e-12)


@pytest.mark.slow
def test_limits_of_the_exponential_pulse():
    for shape, pulse in ((-np.inf, rk.RectangularPulse), (0.0, rk.TriangularPulse), (1e-13, rk.TriangularPulse)):
        a = outcome(BLOCK, rk.ExponentialPulse(0.7, 0.5, shape), MODELS["nonlinear"])
        b = outcome(BLOCK, pulse(0.7, 0.5), MODELS["nonlinear"])
        np.testing.assert_allclose(a.max_rotation, b.max_rotation, rtol=1e-12)
    spike = outcome(BLOCK, rk.ExponentialPulse(0.7, 0.5, np.inf))
    assert spike.max_rotation == 0 and spike.margin >= 1 and spike.impact_count == 0


@pytest.mark.slow
def test_triangle_as_a_record():
    record = rk.Record([0.0, 0.4, 0.8, 0.4, 0.0], 0.1)
    a, b = outcome(BLOCK, record), outcome(BLOCK, rk.TriangularPulse(0.8, 0.4))
    np.testing.assert_allclose(a.max_rotation, b.max_rotation, rtol=1e-13)
    np.testing.assert_allclose(a.margin, b.margin, rtol=1e-12)


@pytest.mark.parametrize("model", ["nonlinear", pytest.param("linear", marks=pytest.mark.slow)])
def test_eager_jit_vmap_and_loop_agree(model):
    amplitudes = np.linspace(0.15, 1.7, 23)

    def one(amplitude):
        return rk.outcome(BLOCK, rk.SinePulse(amplitude, 1.1), MODELS[model])

    loop = [jax.device_get(one(a)) for a in amplitudes]
    for many in jax.device_get((jax.vmap(one)(amplitudes), jax.jit(jax.vmap(one))(amplitudes))):
        for i, single in enumerate(loop):
            lane = jax.tree.map(lambda x, i=i: x[i], many)
            np.testing.assert_allclose(lane.max_rotation, single.max_rotation, rtol=1e-13)
            np.testing.assert_allclose(lane.margin, single.margin, rtol=1e-11)
            assert int(lane.impact_count) == int(single.impact_count)
            assert lane.status._value == single.status._value


def test_vmap_over_blocks_and_nested():
    alpha, p = np.linspace(0.1, 0.4, 5), np.linspace(1.0, 4.0, 5)
    blocks = rk.Block(alpha, p)
    many = jax.device_get(jax.vmap(rk.outcome, in_axes=(0, None))(blocks, SHAKING))
    for i in range(5):
        single = rk.outcome(rk.Block(alpha[i], p[i]), SHAKING)
        np.testing.assert_allclose(many.margin[i], single.margin, rtol=1e-8)
        assert bool(many.overturned[i]) == bool(single.overturned)
    samples = np.asarray(SHAKING.samples)
    records = rk.Record(np.stack([samples, 0.5 * samples]), np.full(2, 0.02))
    grid = jax.device_get(jax.vmap(jax.vmap(rk.outcome, in_axes=(0, None)), in_axes=(None, 0))(blocks, records))
    assert grid.max_rotation.shape == (2, 5)
    np.testing.assert_allclose(grid.margin[0], many.margin, rtol=1e-8)


def test_histories_under_vmap():
    factors = np.array([0.1, 0.3, 0.6, 1.6])

    @jax.jit
    @jax.vmap
    def many(factor):
        response = rk.simulate(BLOCK, factor * rk.SinePulse(1.0, 1.1))
        return response.rotation, response.impact_times

    rotations, times = map(np.asarray, many(factors))
    for rotation, all_times, factor in zip(rotations, times, factors):
        single, _ = simulate(BLOCK, rk.SinePulse(1.0, 1.1), factor)
        np.testing.assert_allclose(rotation, single.rotation, atol=1e-12)
        count = len(single.impact_times)
        np.testing.assert_allclose(all_times[:count], single.impact_times, rtol=1e-12)
        assert np.all(np.isinf(all_times[count:]))
