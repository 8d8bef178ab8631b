"""Walls that open to one side, against a DOP853 loop written apart, against two-sided blocks, and closed forms."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.command_line.main import main
from jaxrock.engines.scene import Scene
from jaxrock.models.rolling import Rolling
from references import walls

RECORD = rk.example_record()
SIDES = {"right": 1, "left": -1}
COUNT = 24
PULSE = rk.SinePulse(0.35, 0.9)  # lifts to the left first, then to the right
TWICE = rk.Record(0.6 * np.sin(np.pi * np.arange(41) / 10) * np.exp(-np.arange(41) / 40), 0.1)


@functools.cache
def scenes():
    """Slenderness, frequency parameter, restitution, side and scale of the record, by index."""
    random = np.random.default_rng(5)
    low, high = [0.08, 1.2, 0.0, 0.6], [0.25, 4.0, 0.93, 1.5]
    return [(*random.uniform(low, high), random.choice(["right", "left"])) for _ in range(COUNT)]


@functools.cache
def judged(index):
    alpha, p, e, scale, opens = scenes()[index]
    return walls.followed(alpha, p, e, SIDES[opens], scale * np.asarray(RECORD.samples), float(RECORD.dt))


def outcomes(opens, engine=None):
    """Outcomes of the scenes to one side, computed together, by index."""
    index = [i for i, scene in enumerate(scenes()) if scene[-1] == opens]
    points = np.array([scenes()[i][:-1] for i in index])

    @jax.vmap
    def one(point):
        alpha, p, e, scale = point
        return rk.outcome(rk.Block(alpha, p, e, opens=opens), scale * RECORD, engine=engine)

    found = jax.device_get(jax.jit(one)(points))
    return {i: jax.tree.map(lambda x, at=at: x[at], found) for at, i in enumerate(index)}


@functools.cache
def series():
    return outcomes("right") | outcomes("left")


@pytest.mark.parametrize("index", range(COUNT))
def test_walls_under_a_record_are_those_of_a_dop853_loop(index):
    found, reference = series()[index], judged(index)
    assert found.status == rk.Status.successful
    assert bool(found.overturned) == reference.overturned
    if not reference.overturned:
        assert abs(found.max_rotation - reference.peak) < 1e-11
        assert abs(found.time_of_max - reference.time) < 1e-10
        alpha, p, *_ = scenes()[index]
        assert found.large_impact_count == reference.large_impacts(alpha, p)


def test_these_scenes_have_few_and_many_impacts_and_both_verdicts():
    counts = [len(judged(i).speeds) for i in range(COUNT)]
    lost = [judged(i).overturned for i in range(COUNT)]
    assert min(counts) < 20 < 150 < max(counts)
    assert 3 <= sum(lost) <= COUNT - 12


def test_impacts_of_a_history_are_those_of_the_loop():
    index = max((i for i in range(COUNT) if not judged(i).overturned), key=lambda i: len(judged(i).speeds))
    alpha, p, e, scale, opens = scenes()[index]
    response, speeds = rk.simulate(rk.Block(alpha, p, e, opens=opens), scale * RECORD), np.array(judged(index).speeds)
    times, velocities = np.asarray(response.impact_times), np.asarray(response.impact_velocities)
    fast = np.abs(velocities) > 1e-6
    np.testing.assert_allclose(-SIDES[opens] * velocities[fast], speeds[speeds > 1e-6], rtol=1e-6)
    rotation, after = response(times[fast])
    np.testing.assert_allclose(after, -e * velocities[fast], rtol=1e-9)  # each leaves e^2 of the energy
    assert np.all(np.abs(rotation) < 1e-12)
    assert np.all(SIDES[opens] * np.asarray(response.rotation) >= 0)


@pytest.mark.parametrize("opens", SIDES)
def test_the_first_excursion_is_that_of_a_block(opens):
    """Up to its first impact a wall does not know what stands behind it; a push against it lifts it not at all."""
    motion = -SIDES[opens] * rk.HalfSinePulse(0.35, 0.3)
    wall, block = rk.Block(0.2, 2.0, 0.3, opens=opens), rk.Block(0.2, 2.0, 0.3)
    found, other = rk.outcome(wall, motion), rk.outcome(block, motion)
    np.testing.assert_allclose(found.max_rotation, other.max_rotation, rtol=1e-14)
    assert 0.01 < found.max_rotation < 0.2
    for held in (-1 * motion, -3 * motion, (-1 * motion).with_vertical(rk.SinePulse(0.3, 0.2))):
        still = rk.outcome(wall, held)
        assert still.max_rotation == 0 and still.impact_count == 0 and still.margin >= 1
        assert rk.outcome(block, held).max_rotation > 0.01


@pytest.mark.parametrize("motion", [PULSE, 0.8 * RECORD], ids=["pulse", "record"])
def test_a_mirrored_motion_moves_a_mirrored_wall(motion):
    one = rk.outcome(rk.Block(0.2, 2.0, 0.5, opens="right"), motion)
    other = rk.outcome(rk.Block(0.2, 2.0, 0.5, opens="left"), -1 * motion)
    assert one.max_rotation > 0
    for name in ("max_rotation", "time_of_max", "max_velocity", "impact_count", "margin", "clearance"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-14, err_msg=name)


def test_without_restitution_a_wall_rests_at_once():
    response = rk.simulate(rk.Block(0.2, 2.0, 0.0, opens="right"), rk.RectangularPulse(-0.5, 0.2), duration=5.0)
    assert response.impact_count == 1
    late = np.linspace(float(response.impact_times[0]), 5.0, 50)
    assert all(np.all(np.asarray(values) == 0) for values in response(late))


@pytest.mark.parametrize("e", [0.4, 0.8])
@pytest.mark.parametrize("opens", SIDES)
def test_free_rocking_keeps_e2_of_its_energy_at_each_impact(opens, e):
    """Peaks x_n of the free wall: 1 - cos(alpha) - (1 - cos(alpha - x_n)) is the energy over m g R."""
    alpha, side = 0.25, SIDES[opens]
    wall, still = rk.Block(alpha, 2.0, e, opens=opens), rk.RectangularPulse(0.0, 0.01)
    response = rk.simulate(wall, still, initial=(0.8 * side * alpha, 0.0), duration=20.0)
    peaks = side * np.asarray(response.peak_rotations)
    energy = np.cos(alpha - peaks) - np.cos(alpha)
    large = energy > 1e-6
    assert np.all(peaks > 0) and large.sum() >= 5
    np.testing.assert_allclose(energy[large][1:] / energy[large][:-1], e**2, rtol=1e-9)


def test_the_free_stage_is_that_of_steps():
    """By energy after a short motion, and by steps through a long quiet one."""
    for initial in [(0.1, 0.0), (0.05, 0.3), (0.19, -0.9), (0.0, 0.35), (0.21, -0.02), (0.1, 0.4)]:
        wall = rk.Block(0.2, 2.0, 0.7, opens="right")
        short, long = rk.RectangularPulse(0.0, 0.01), rk.Record(np.zeros(600), 0.05)
        one, other = (rk.outcome(wall, motion, initial=initial) for motion in (short, long))
        assert one.status == other.status == rk.Status.successful
        assert bool(one.overturned) == bool(other.overturned)
        for name in ("max_rotation", "max_velocity", "time_of_max", "margin"):
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-9, err_msg=name)


def test_a_wall_that_comes_back_from_beyond_its_saddle_falls_to_its_own_side():
    """With e near 1 the rebound has the energy to pass the saddle again, on the same side."""
    wall, still = rk.Block(0.2, 2.0, 0.99, opens="right"), rk.RectangularPulse(0.0, 0.01)
    found = rk.outcome(wall, still, initial=(0.3, -1.0))
    assert bool(found.overturned) and found.impact_count == 1
    response = rk.simulate(wall, still, initial=(0.3, -1.0), duration=20.0)
    assert bool(response.overturned) and float(response.rotation[-1]) == np.pi / 2


MODELS = {
    "Housner": rk.Housner(),
    "linear": rk.Linear(),
    "spring": rk.models.Spring("SM2"),
    "functions": rk.models.Equation(
        lambda x, block: jnp.sin(block.alpha - x), lambda x, block: jnp.cos(block.alpha - x)
    ),
}


@pytest.mark.parametrize(
    "model, opens",
    [
        ("Housner", "right"),
        ("spring", "left"),
        pytest.param("Housner", "left", marks=pytest.mark.slow),
        pytest.param("linear", "right", marks=pytest.mark.slow),
        pytest.param("linear", "left", marks=pytest.mark.slow),
    ],
)
def test_both_engines_agree(model, opens):
    wall = rk.Block(0.2, 2.5, 0.6, opens=opens)
    for motion in (PULSE, TWICE):
        one = rk.outcome(wall, motion, MODELS[model])
        other = rk.outcome(wall, motion, MODELS[model], engine=rk.Diffrax(rtol=1e-11))
        assert one.status == other.status == rk.Status.successful
        for name in ("max_rotation", "max_velocity", "time_of_max", "margin"):
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=1e-8, err_msg=name)


@pytest.mark.slow
def test_functions_and_a_rolling_edge_work_for_walls():
    wall = rk.Block(0.2, 2.5, 0.6, opens="left")
    one, other = (rk.outcome(wall, PULSE, model) for model in (rk.Housner(), MODELS["functions"]))
    np.testing.assert_allclose(one.max_rotation, other.max_rotation, atol=1e-8)
    sharp, rolled = (rk.outcome(wall, PULSE, Rolling(rk.blocks.Edge(r))) for r in (1e-6, 0.02))
    np.testing.assert_allclose(sharp.max_rotation, one.max_rotation, rtol=1e-4)
    assert rolled.status == rk.Status.successful
    assert 1e-4 < abs(rolled.max_rotation / one.max_rotation - 1) < 1e-2


def peak(point, opens="right", engine=None):
    """Peak and margin of a wall that comes down twice and is then thrown higher, by six numbers."""
    (alpha, p, e, start, push, late), side = point, SIDES[opens]
    motion = (-side * push * rk.HalfSinePulse(1.0, 0.5)).shifted(late)
    found = rk.outcome(rk.Block(alpha, p, e, opens=opens), motion, initial=(side * start, 0.0), engine=engine)
    return jnp.stack([found.max_rotation, found.margin])


@pytest.mark.parametrize("opens", ["right", pytest.param("left", marks=pytest.mark.slow)])
def test_derivatives_forward_reverse_and_differences(opens):
    point, step = jnp.array([0.2, 2.5, 0.8, 0.05, 0.24, 0.75]), 1e-5
    one = functools.partial(peak, opens=opens)
    forward, reverse = jax.jacfwd(one)(point), jax.jacrev(one)(point)
    assert np.all(np.abs(forward[0]) > 1e-2)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-12)
    for k in range(point.size):
        ahead, back = (one(point.at[k].add(way * step)) for way in (1, -1))
        np.testing.assert_allclose(forward[:, k], (ahead - back) / (2 * step), rtol=1e-5)
    other = jax.jacfwd(functools.partial(one, engine=rk.Diffrax(rtol=1e-11)))(point)
    np.testing.assert_allclose(forward, other, rtol=1e-6)


def test_derivatives_by_a_record_in_reverse():
    wall, way = rk.Block(0.2, 2.5, 0.7, opens="left"), jnp.cos(jnp.arange(41.0))

    def found(samples):
        return rk.outcome(wall, rk.Record(samples, 0.1)).max_rotation

    samples = 0.6 * TWICE.samples
    _, forward = jax.jvp(found, (samples,), (way,))
    assert abs(forward) > 1e-2
    np.testing.assert_allclose(jax.grad(found)(samples) @ way, forward, rtol=1e-10)
    np.testing.assert_allclose((found(samples + 1e-6 * way) - found(samples - 1e-6 * way)) / 2e-6, forward, rtol=1e-5)


def test_derivatives_of_a_history():
    def rotation(e):
        return rk.simulate(rk.Block(0.2, 2.5, e, opens="left"), 0.75 * TWICE, duration=4.0)(jnp.array([1.0, 2.5]))[0]

    forward, reverse = jax.jacfwd(rotation)(0.7), jax.jacrev(rotation)(0.7)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(forward, (rotation(0.70001) - rotation(0.69999)) / 2e-5, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize(
    "motion, opens",
    [(PULSE, "left"), (PULSE.with_vertical(0.5 * PULSE), "right"), (RECORD, "left")],
    ids=["pulse", "vertical", "record"],
)
def test_the_fast_pass_is_the_accurate_one(motion, opens):
    """Many scenes together, and so few at a time that they go without the fast pass."""
    points = np.random.default_rng(2).uniform([0.1, 1.0, 0.0, 0.5], [0.3, 4.0, 0.9, 1.4], (150, 4))

    def one(point):
        alpha, p, e, scale = point
        return rk.outcome(rk.Block(alpha, p, e, opens=opens), scale * motion)

    @jax.jit
    def both(points):
        return jax.vmap(one)(points), jax.lax.map(one, points, batch_size=50)

    fast, accurate = jax.device_get(both(points))
    assert 0.05 < accurate.overturned.mean() < 0.9 and accurate.impact_count.max() > 10
    for name in ("overturned", "impact_count", "large_impact_count"):
        np.testing.assert_array_equal(getattr(fast, name), getattr(accurate, name), name)
    for name in ("max_rotation", "max_velocity", "margin"):
        np.testing.assert_allclose(getattr(fast, name), getattr(accurate, name), rtol=1e-8, atol=1e-12, err_msg=name)


@pytest.mark.parametrize("opens", SIDES)
def test_a_push_barely_above_the_threshold_lifts_a_wall(opens):
    """The drive rises above the threshold and falls below it again within one step."""
    motion, angles = -SIDES[opens] * rk.RickerPulse(0.3, 1.5), np.arctan(0.3 / (1 + np.geomspace(1e-6, 0.3, 100)))

    def lifted(alpha):
        return rk.outcome(rk.Block(alpha, 2.0, 0.5, opens=opens), motion).max_rotation

    assert np.all(jax.jit(jax.vmap(lifted))(angles) > 0)


def test_many_walls_are_as_each_alone():
    for index in (0, 5, 11):
        alpha, p, e, scale, opens = scenes()[index]
        alone = rk.outcome(rk.Block(alpha, p, e, opens=opens), scale * RECORD)
        for name in ("max_rotation", "max_velocity", "margin", "impact_count"):
            np.testing.assert_allclose(getattr(alone, name), getattr(series()[index], name), rtol=1e-10, atol=1e-13)


@pytest.mark.filterwarnings("ignore:jaxrock runs in single precision")
def test_single_precision():
    with jax.enable_x64(False):
        motion = rk.SinePulse(np.float32(0.35), np.float32(0.9))
        found = rk.outcome(rk.Block(np.float32(0.2), np.float32(2.5), np.float32(0.6), opens="left"), motion)
    exact = rk.outcome(rk.Block(0.2, 2.5, 0.6, opens="left"), PULSE)
    assert found.max_rotation.dtype == jnp.float32
    np.testing.assert_allclose(found.max_rotation, exact.max_rotation, rtol=1e-5)


def test_a_law_that_depends_on_the_speed_or_the_side():
    law = rk.restitution.SpeedDependent(0.8, 0.2, 0.5)
    response = rk.simulate(rk.Block(0.2, 2.0, law, opens="left"), PULSE)
    speeds = np.abs(np.asarray(response.impact_velocities)[:3])
    _, after = response(response.impact_times[:3])
    np.testing.assert_allclose(np.abs(np.asarray(after)), speeds * (0.2 + 0.6 * np.exp(-speeds / 0.5)), rtol=1e-9)
    both = rk.restitution.PerSide(0.3, 0.6)
    for opens, e in (("right", 0.3), ("left", 0.6)):
        wall = rk.Block(0.2, 2.0, both, opens=opens)
        scene = Scene.of(wall, PULSE, rk.Housner())
        assert scene.far is None and float(wall.restitution) == float(scene.reset.ratio(1.0)) == e


def test_what_is_refused():
    with pytest.raises(ValueError, match="`restitution` must be given for a wall that opens to one side"):
        rk.Block(0.2, 2.0, opens="right")
    with pytest.raises(ValueError, match="`restitution` must be given"):
        rk.Block.from_radius(0.2, 3.0, opens="left", inertia_ratio=0.7)
    with pytest.raises(ValueError, match="`restitution` must be given"):
        rk.Block.from_dimensions(0.6, 3.0, opens="left")
    with pytest.raises(ValueError, match="`opens` must be one of 'right', 'left', but is 'up'"):
        rk.Block(0.2, 2.0, 0.4, opens="up")
    wall = rk.Block(0.2, 2.0, 0.4, opens="right")
    for run in (rk.outcome, rk.simulate):
        with pytest.raises(ValueError, match=r"`initial\[0\]` must be 0 or more, as the wall opens to that side"):
            run(wall, PULSE, initial=(-0.1, 0.0))
        with pytest.raises(ValueError, match=r"`initial\[1\]` must be 0 or more, as the wall opens to that side"):
            run(wall, PULSE, initial=(0.0, -0.1))
        assert run(wall, PULSE, initial=(0.05, -0.1)).status == rk.Status.successful
    with pytest.raises(ValueError, match="must not be of a wall that opens to one side"):
        rk.responses.contact_forces(rk.simulate(wall, PULSE), wall)
    with pytest.raises(ValueError, match="must rock to both sides"):
        rk.studies.similarity.groups(wall, 0.4, 7.0)


def test_a_traced_start_behind_a_wall_has_a_status():
    wall = rk.Block(0.2, 2.0, 0.4, opens="left")
    start = jax.vmap(lambda v: rk.outcome(wall, PULSE, initial=(0.0, v)).status)
    assert list(start(jnp.array([-0.1, 0.0, 0.1])) == rk.Status.not_finite) == [False, False, True]
    found = rk.outcome(wall, PULSE, initial=(0.1, 0.0), throw=False)
    assert found.status == rk.Status.not_finite and np.isnan(found.max_rotation)


def test_the_side_survives_transformations_of_trees():
    wall = rk.Block.from_dimensions(0.6, 3.0, 0.4, opens="left")
    assert repr(wall).endswith("opens='left')") and "opens" not in repr(rk.Block(0.2, 2.0))
    many = jax.tree.map(lambda x: jnp.stack([x, x]), wall)
    assert many.opens == jax.jit(lambda block: block)(wall).opens == "left"
    drawn = rk.blocks.draw_blocks(wall, 5, alpha=0.1, restitution=0.05)
    assert drawn.opens == "left" and drawn.alpha.shape == (5,)
    assert rk.Block.from_radius(0.2, 3.0, 0.4, opens="right", inertia_ratio=0.7).only_side == 1
    assert Scene.of(wall, PULSE, rk.Housner()).only_side == -1


def test_spectra_and_maps_of_walls():
    settings = {"alpha": 0.2, "restitution": 0.5, "opens": "left"}
    found = rk.overturning_map(jnp.array([1.0, 3.0]), jnp.array([1.5, 3.0, 6.0]), **settings)
    peaks = rk.studies.self_similar_spectrum(jnp.array([1.0, 3.0]), jnp.array([1.5, 3.0, 6.0]), **settings)
    for i, row in enumerate((1.5, 3.0, 6.0)):
        for j, ratio in enumerate((1.0, 3.0)):
            pulse = rk.SinePulse(row * np.tan(0.2), 2 * np.pi / ratio)
            one = rk.outcome(rk.Block(0.2, 1.0, 0.5, opens="left"), pulse)
            np.testing.assert_allclose(found.rotation_ratio[i, j], one.max_rotation / 0.2, rtol=1e-10)
            np.testing.assert_allclose(peaks.rotation_ratio[i, j], one.max_rotation / 0.2, rtol=1e-10)
    spectrum = rk.rocking_spectrum(0.2, TWICE, jnp.array([2.0, 4.0]), 0.5, opens="right")
    one = rk.outcome(rk.Block(0.2, np.pi / 2, 0.5, opens="right"), TWICE)
    np.testing.assert_allclose(spectrum.rotation_ratio[1], one.max_rotation / 0.2, rtol=1e-10)


def test_turned_round_a_wall_is_another_one():
    suite = rk.motions.Suite([0.5 * RECORD, 0.9 * RECORD])
    wall = rk.Block(0.15, 3.0, 0.5, opens="right")
    found = rk.hazard.suite_outcomes(wall, suite, [1.0], facing="both")
    for k, opens in enumerate(("right", "left")):
        for motion, scale in enumerate((0.5, 0.9)):
            one = rk.outcome(rk.Block(0.15, 3.0, 0.5, opens=opens), scale * RECORD)
            ratio = np.ravel(found.rotation_ratio[motion])[k]
            np.testing.assert_allclose(ratio, one.max_rotation / 0.15, rtol=1e-9)


def test_figures_of_a_wall():
    pyplot = pytest.importorskip("matplotlib.pyplot")
    wall = rk.Block(0.2, 2.0, 0.5, opens="left")
    response = rk.simulate(wall, PULSE, duration=2.0)
    thresholds = [line for line in rk.plot.history(response)[2].lines if line.get_label() == "uplift threshold"]
    np.testing.assert_allclose(thresholds[0].get_ydata()[0], np.tan(0.2))
    both = (len(rk.plot.scene(block).patches) for block in (wall, rk.Block(0.2, 2.0, 0.5)))
    assert next(both) == next(both) + 1  # what stands behind it
    with pytest.raises(ValueError, match="whose only side is -1"):
        rk.plot.animate(response, rk.Block(0.2, 2.0, 0.5))
    pyplot.close("all")


def test_the_command_knows_the_side(tmp_path, capsys):
    words = ["map", "--opens", "left", "--points", "4", "--pixels", "--out", str(tmp_path)]
    assert main(words) == 2
    assert "`--restitution` must be given for a wall that opens to one side" in capsys.readouterr().err
    assert main([*words, "--restitution", "0.5"]) == 0


def test_critical_amplitudes_of_a_wall():
    wall = rk.Block(0.2, 2.0, 0.5, opens="left")
    found = rk.critical_amplitudes(wall, rk.SinePulse(0.3, 1.0), intensity=(1.0, 8.0))
    first = float(np.ravel(found.value)[0])
    below, above = (rk.outcome(wall, rk.SinePulse(first * by, 1.0)) for by in (1 - 1e-6, 1 + 1e-6))
    assert bool(below.overturned) != bool(above.overturned)


def test_a_fit_to_a_history_finds_the_wall():
    wall, time = rk.Block(0.2, 2.0, 0.6, opens="right"), np.linspace(0, 3, 300)
    still = rk.RectangularPulse(0.0, 0.01)
    rotation, _ = rk.simulate(wall, still, initial=(0.1, 0.0), duration=3.1)(time)
    start = rk.Block(0.2, 2.1, 0.55, opens="right")
    found = rk.inverse.fit_history(time, rotation, start, initial=(0.1, 0.0), parameters=("p", "restitution"), starts=1)
    assert found.block.opens == "right"
    np.testing.assert_allclose([found.block.p, found.block.restitution], [2.0, 0.6], rtol=1e-6)
