"""Both engines over the whole parameter space: they agree, they tell their errors, and they never answer nonsense."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings, strategies as st

import jaxrock as rk
from jaxrock.engines.taylor.policy import POLICY, exact
from jaxrock.engines.trajectory import followed
from references.hard_cases import LANES, SAMPLES, engines, outcomes

RTOL = 1e-8
NUDGE = 1e-6  # relative change of amplitude and initial state, for condition numbers
LEVELS = 7  # coordinates of a scene that are drawn inside a cube

# A batch of scenes: points of a cube of the parameter space around a centre, large or small.
cubes = st.tuples(st.tuples(*[st.floats(0, 1)] * LEVELS), st.sampled_from([1.0, 0.3, 0.01]), st.integers(0, 2**32 - 1))


def search(examples):
    """Settings of a search: the same every time, and without shrinking, for a failure names its scene."""
    phases, checks = (Phase.explicit, Phase.generate), list(HealthCheck)
    return settings(
        max_examples=examples,
        derandomize=True,
        deadline=None,
        database=None,
        phases=phases,
        suppress_health_check=checks,
    )


def log(x, low, high):
    """From [0, 1] to [low, high], equally spread in the logarithm."""
    return low * (high / low) ** x


def scenes_of(kind, model, cube, liveliest=0.95):
    """`LANES` scenes of a kind inside a cube, of restitution up to `liveliest`: (block, numbers, initial) each."""
    center, width, seed = cube
    random = np.random.default_rng(seed)
    rows = []
    for x in np.clip(np.array(center) + width * random.uniform(-1, 1, (LANES, LEVELS)), 0, 1):
        alpha, p = log(x[0], 1e-4, 1.2), log(x[1], 0.1, 10.0)
        restitution = np.clip(1.1 * x[2] - 0.05, 0, liveliest)
        size = (alpha if model == "linear" else np.tan(alpha)) * log(x[3], 1.0, 50.0)
        start = np.array([alpha, p * alpha]) * random.uniform(-1, 1, 2) * random.choice([0.0, 0.0, 1.0, 1e-3, 1e-8])
        if kind == "sine":
            numbers = size, 2 * np.pi / (p * log(x[4], 0.05, 200.0))
        elif kind == "exponential":
            numbers = size, log(x[4], 1e-6, 60.0) / p, np.sinh(8 * (2 * x[5] - 1)) / 2
        elif kind == "sum":
            length = log(x[4], 0.01, 10.0) / p
            other = size * random.uniform(-1, 1)
            numbers = size, length, other, length * log(x[5], 0.01, 1.0), length * random.choice([0.0, 1.0, 2 * x[6]])
        else:
            noise = np.convolve(random.normal(size=SAMPLES + 8), np.hanning(9), mode="valid")
            numbers = log(x[4], 1e-5, 2.5) / p, *(size * noise / np.abs(noise).max())
        rows.append(((alpha, p, restitution), numbers, start))
    return rows


def scaled(kind, rows, factor):
    """The scenes with their amplitudes and initial states times a factor."""
    amplitudes = {"sine": [0], "exponential": [0], "sum": [0, 2], "record": range(1, SAMPLES + 1)}[kind]

    def numbers(row):
        return tuple(x * factor if i in amplitudes else x for i, x in enumerate(row))

    return [(block, numbers(row), np.array(start) * factor) for block, row, start in rows]


def nonsense(found):
    """Return lanes with status successful whose numbers no outcome may have, such as NaN."""
    good, lost = found["successful"], found["overturned"]
    finite = np.isfinite(found["margin"])
    for name in ("max_rotation", "max_velocity", "time_of_max", "error"):
        value = found[name]
        finite &= np.where(lost, np.isposinf(value), np.isfinite(value) & (value >= 0))
    sane = finite & ((found["margin"] < 0) == lost) & (found["impact_count"] >= 0)
    return good & ~sane


@functools.cache
def engine(name):
    """An engine of the table: they share its compiled functions."""
    return engines()[name]


def compare(kind, model, cube, liveliest=0.95, most=10):
    """Both engines on the scenes of a cube; returns how many scenes each has refused."""
    rows = scenes_of(kind, model, cube, liveliest)
    alpha = np.array([block[0] for block, _, _ in rows])
    exact, found = (outcomes(kind, model, engine(name), rows) for name in ("series", "diffrax"))
    lower, upper = (outcomes(kind, model, engine("series"), scaled(kind, rows, 1 + s * NUDGE)) for s in (-1, 1))
    for result in (exact, found, lower, upper):
        assert not np.any(nonsense(result)), rows[np.argmax(nonsense(result))]

    both = exact["successful"] & found["successful"]
    differ = both & (exact["overturned"] != found["overturned"])
    assert not np.any(differ), ("verdict", rows[np.argmax(differ)])
    safe = both & ~exact["overturned"]
    with np.errstate(invalid="ignore", divide="ignore"):
        off = np.where(safe, np.abs(exact["max_rotation"] - found["max_rotation"]), 0.0)
        told = np.where(safe, exact["error"] + found["error"], 0.0)
        steady = safe & lower["successful"] & upper["successful"] & ~lower["overturned"] & ~upper["overturned"]
        moves = np.abs(upper["max_rotation"] - lower["max_rotation"]) / (2 * NUDGE * exact["max_rotation"])
    condition = np.where(steady & (exact["max_rotation"] > 0), moves, 1e4)  # beyond it the difference tells nothing
    apart = safe & (off > most * RTOL * alpha * np.maximum(condition, 1)) & (condition < 1e4)
    assert not np.any(apart), ("peak", off[apart] / alpha[apart], condition[apart], rows[np.argmax(apart)])
    dishonest = safe & (off > 10 * told + 1e-13 * alpha)
    assert not np.any(dishonest), ("error", off[dishonest], told[dishonest], rows[np.argmax(dishonest)])
    return int(np.sum(~exact["successful"])), int(np.sum(~found["successful"]))


KINDS = [("sine", "nonlinear")]
MORE = [
    ("record", "nonlinear"),
    ("sum", "linear"),
    ("exponential", "nonlinear"),
    ("sum", "nonlinear"),
    ("sine", "linear"),
    ("exponential", "linear"),
    ("record", "linear"),
    ("sine", "sine spring"),
    ("sine", "linear spring"),
    ("sum", "plastic spring"),
]


@pytest.mark.parametrize("kind, model", KINDS, ids=["-".join(pair) for pair in KINDS])
def test_engines_agree(kind, model):
    """Some hundred scenes of each kind, none of them refused without need."""
    refused, scenes = np.zeros(2), [0]

    @search(4)
    @given(cubes)
    def run(cube):
        refused[:] += compare(kind, model, cube)
        scenes[0] += LANES

    run()
    assert np.all(refused <= 0.02 * scenes[0]), (refused, scenes)


@pytest.mark.slow
@pytest.mark.parametrize("kind, model", KINDS + MORE, ids=["-".join(pair) for pair in KINDS + MORE])
def test_engines_agree_everywhere(kind, model):
    """Some thousand scenes of each kind."""
    refused, scenes = np.zeros(2), [0]

    @search(25)
    @given(cubes)
    def run(cube):
        refused[:] += compare(kind, model, cube, liveliest=0.99, most=20)  # one scene in thousands is at 10.1
        scenes[0] += LANES

    run()
    assert np.all(refused <= 0.02 * scenes[0]), (refused, scenes)


@pytest.mark.slow
def test_elastic_impacts():
    """Restitution up to 1, where impacts never end and may use up any budget."""

    @search(3)
    @given(cubes)
    def run(cube):
        compare("sine", "nonlinear", cube, liveliest=1.0)

    run()


@pytest.mark.parametrize("name", ["series", "diffrax"])
def test_mirror_images(name):
    """Left and right are the same to the last digit."""

    @search(3)
    @given(cubes)
    def run(cube):
        rows = scenes_of("sine", "nonlinear", cube)
        here, there = (outcomes("sine", "nonlinear", engine(name), scaled("sine", rows, s)) for s in (1.0, -1.0))
        for key, values in here.items():
            np.testing.assert_array_equal(values, there[key], err_msg=key)

    run()


# ---- Free rocking ----


@functools.cache
def free(name):
    """Histories of freely rocking blocks: 8/p of them, 401 samples."""
    still = rk.Record([0.0], 0.01)

    def one(alpha, p, restitution, rotation, velocity):
        response = rk.simulate(
            rk.Block(alpha, p, restitution), still, initial=(rotation, velocity), duration=8 / p, engine=engine(name)
        )
        parts = response.impact_times, response.impact_velocities, response.time, response.rotation, response.velocity
        return parts, response.status == rk.Status.successful, response.overturned

    return jax.jit(one)


@pytest.mark.parametrize("name, tolerance", [("series", 1e-13), ("diffrax", 1e-6)], ids=["series", "diffrax"])
def test_energy_of_free_rocking(name, tolerance):
    """Between impacts the energy is constant; each impact leaves e^2 of it."""

    @search(12)
    @given(st.floats(0, 1), st.floats(0, 1), st.floats(0.1, 0.98), st.floats(-0.95, 0.95), st.floats(-1, 1))
    def run(slenderness, speed, restitution, rotation, push):
        alpha, p = log(slenderness, 1e-3, 1.2), log(speed, 0.1, 10.0)
        rotation, velocity = rotation * alpha, push * p * np.sin(alpha)
        (times, speeds, time, angle, rate), answered, lost = free(name)(alpha, p, restitution, rotation, velocity)
        if lost or not answered:
            assert answered or restitution > 0.9
            return
        times, speeds = (np.asarray(values)[np.isfinite(times)] for values in (times, speeds))
        # Energy over that of the saddle, without cancellation.
        opening = np.abs(np.asarray(angle))
        potential = 2 * np.sin(opening / 2) * np.sin(alpha - opening / 2)
        energy = (np.asarray(rate) ** 2 / (2 * p**2) + potential) / (1 - np.cos(alpha))
        flight = np.searchsorted(times, np.asarray(time), side="right")
        large = [k for k in range(len(times) + 1) if np.sum(flight == k) > 1 and energy[flight == k].max() > 1e-9]
        for k in large:
            np.testing.assert_allclose(energy[flight == k], energy[flight == k][0], rtol=tolerance * 10, atol=tolerance)
        for k in range(len(times) - 1):
            if speeds[k + 1] ** 2 > 1e-9 * (p * alpha) ** 2:
                np.testing.assert_allclose(speeds[k + 1], -restitution * speeds[k], rtol=10 * tolerance)

    run()


def test_a_block_that_stands_still_is_answered():
    """No motion, no rotation: zero error, margin above one, in both engines."""
    for name in ("series", "diffrax"):
        rows = [((0.2, 1.0, 0.9), (0.0, 1.0), (0.0, 0.0))]
        found = outcomes("sine", "nonlinear", engine(name), rows)
        assert found["successful"].all() and not nonsense(found).any()
        assert found["max_rotation"][0] == found["error"][0] == 0 and found["margin"][0] == 2


def test_nonsense_is_found():
    """The search's own judge."""
    good = dict(
        successful=np.array([True]), overturned=np.array([False]), margin=np.array([0.5]), impact_count=np.array([1])
    )
    good |= {name: np.array([0.1]) for name in ("max_rotation", "max_velocity", "time_of_max", "error")}
    assert not nonsense(good).any()
    for name in ("max_rotation", "max_velocity", "time_of_max", "error", "margin"):
        assert nonsense(good | {name: np.array([np.nan])}).all()
        assert nonsense(good | {name: np.array([np.inf])}).all()
    assert nonsense(good | {"overturned": np.array([True])}).all()


def under_multiples(motion, loose, scales):
    """Outcomes of a block under a motion times these numbers: exact, of a few at a time, for which the careful pass is
    enough; and by a loose engine, of all at once."""
    block = (0.2, 2.5, 0.9)
    if motion == "sine":
        rows = [(block, (0.35 * scale, 0.9), (0.0, 0.0)) for scale in scales]
        exact = outcomes("sine", "nonlinear", engine("series"), rows)
        return exact, outcomes("sine", "nonlinear", loose, rows, lanes=len(rows))

    def followed(engine, lanes):
        run = jax.jit(jax.vmap(lambda a: rk.outcome(rk.Block(*block), a * rk.example_record(), engine=engine)))
        parts = [run(part) for part in scales.reshape(-1, lanes)]
        names = ("max_rotation", "overturned", "error")
        good = [np.asarray(part.status == rk.Status.successful) for part in parts]
        found = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        return found | {"successful": np.concatenate(good)}

    return followed(rk.Series(), 50), followed(loose, len(scales))


@pytest.mark.parametrize(
    "motion, tolerance, most",
    [
        ("record", 1e-6, 1e-3),
        ("sine", 1e-8, 1e-5),
        pytest.param("record", 1e-8, 1e-5, marks=pytest.mark.slow),
        pytest.param("record", 1e-11, 1e-8, marks=pytest.mark.slow),
        pytest.param("sine", 1e-6, 1e-3, marks=pytest.mark.slow),
        pytest.param("sine", 1e-11, 1e-8, marks=pytest.mark.slow),
    ],
)
def test_what_a_tolerance_leaves_undone_is_told(motion, tolerance, most):
    """Verdicts are those of the exact series, or there is none; peaks are within the error that is told, and that is
    not too large to be of use."""
    exact, found = under_multiples(motion, rk.Series(tolerance=tolerance), np.linspace(0.6, 2.4, 150))
    good = found["successful"]
    assert good.mean() > 0.95
    np.testing.assert_array_equal(found["overturned"][good], exact["overturned"][good])
    standing = good & ~exact["overturned"] & (exact["max_rotation"] > 0)
    off = np.abs(found["max_rotation"][standing] - exact["max_rotation"][standing])
    assert standing.sum() > 20 and (off <= (found["error"] + exact["error"])[standing]).all()
    assert np.median(found["error"][standing]) < most


def test_less_is_computed_where_less_is_asked():
    """Orders of steps follow the tolerance, but for what is asked for by itself."""
    asked = exact(np.float64), 1e-12, 1e-8, 1e-4
    assert [POLICY.order(2, t, linear=False) for t in asked] == [16, 15, 11, 8]
    assert [POLICY.order(2, t, linear=True) for t in asked] == [20, 17, 13, 10]
    assert all([POLICY.order(5000, t, linear) for t in asked] == [9, 9, 7, 6] for linear in (False, True))
    half = exact(np.float32)
    assert [POLICY.order(*kind) for kind in [(2, half, False), (2, half, True), (5000, half, False)]] == [10, 12, 6]


class Count(eqx.Module):
    """A state with the fields that a loop over steps reads."""

    steps: jax.Array
    last: jax.Array

    @property
    def done(self):
        return self.steps >= self.last


def test_lanes_of_histories_are_not_copied_at_every_step():
    """Check that the data of each lane are written in place, without a select between whole arrays."""

    def run(last):
        start = Count(jnp.int32(0), last)
        return followed(
            lambda s: Count(s.steps + 1, s.last), start, 100, lambda c, s, x, _: jax.lax.while_loop(c, s, x)
        )

    lasts = jnp.array([3, 0, 100, 7], jnp.int32)
    final, kept = jax.vmap(run)(lasts)
    np.testing.assert_array_equal(final.steps, lasts)
    for last, steps in zip(lasts, kept.steps):
        np.testing.assert_array_equal(steps, np.minimum(np.arange(101), last))
    lines = jax.jit(jax.vmap(run)).lower(lasts).as_text().splitlines()
    chosen = [line for line in lines if "stablehlo.select" in line]
    assert chosen and not any("4x101x" in line for line in chosen)


def test_diffrax_in_single_precision():
    """By its default tolerances, which are for double precision: five digits."""
    scene = block, pulse, _ = (0.2, 2.0, 0.9), (0.4, 0.6), (0.0, 0.0)
    half = jax.tree.map(jnp.float32, (rk.Block(*block), rk.SinePulse(*pulse)))
    found, exact = rk.outcome(*half, engine=rk.Diffrax()), outcomes("sine", "nonlinear", engine("series"), [scene])
    assert found.status == rk.Status.successful and found.max_rotation.dtype == jnp.float32
    assert exact["successful"] and abs(float(found.max_rotation) - exact["max_rotation"][0]) < 2e-5


def test_many_scenes_by_diffrax_in_single_precision():
    """None uses its budget up at a turning point that is taken for something else."""
    random = np.random.default_rng(1)
    low, high = np.array([[0.05, 0.2, 0.03, 0.5, 0.4], [2.0, 2.0, 0.6, 5.0, 1.0]])
    scenes = random.uniform(low, high, (300, 5))

    def one(x):
        return rk.outcome(rk.Block(x[2], x[3], x[4]), rk.SinePulse(x[0], x[1]), engine=rk.Diffrax())

    found, exact = (jax.jit(jax.vmap(one))(jnp.asarray(scenes, kind)) for kind in (jnp.float32, jnp.float64))
    assert found.max_rotation.dtype == jnp.float32 and (found.status == rk.Status.successful).all()
    np.testing.assert_array_equal(found.overturned, exact.overturned)
    both = ~np.asarray(exact.overturned)
    assert 50 < both.sum() < 250
    assert np.max(np.abs(found.max_rotation - exact.max_rotation)[both] / scenes[both, 2]) < 1e-3
