"""Where rocking solvers go wrong: small hops, grazing, tangential uplift, accumulation, the boundary, odd records."""

import functools
import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

import jaxrock as rk
from references import hard_cases
from references.hard_cases import KINDS, MODELS as NAMES
from references.in_jaxrock import MODELS

STILL = rk.Record([0.0], 0.01)
BLOCK = (0.2, 1.0, 0.9)  # alpha, p, restitution
EXACT, LOOSE = rk.Series(), rk.Diffrax(rtol=1e-8)
SHORT = rk.Series(order=6)  # a shorter program
model = pytest.mark.parametrize("model", MODELS)


# ---- A program for each model, engine and kind of motion serves the tests of this file ----


class Scene(NamedTuple):
    """A block under a record, by default one that is still."""

    block: tuple = BLOCK
    initial: tuple = (0.0, 0.0)
    duration: float = 20.0
    samples: np.ndarray = np.zeros(1)
    dt: float = 0.01


def _simulated(scene, model, engine, samples):
    block, record = rk.Block(*scene.block), rk.Record(scene.samples, scene.dt)
    return rk.simulate(
        block, record, model, initial=scene.initial, duration=scene.duration, engine=engine, samples=samples
    )


@jax.jit
def _history(model, engine, scene):
    found = _simulated(scene, model, engine, 501)
    names = ("time", "rotation", "velocity", "impact_times", "impact_velocities", "margin", "overturned")
    return {name: getattr(found, name) for name in names} | {"status": found.status._value}


@jax.jit
def _impacts(scene):
    found = _simulated(scene, rk.Linear(), LOOSE, 2)
    return {name: getattr(found, name) for name in ("impact_times", "impact_velocities")}


@jax.jit
@functools.partial(jax.vmap, in_axes=(None, None, 0))
def _outcomes(model, engine, scene):
    block, record = rk.Block(*scene.block), rk.Record(scene.samples, scene.dt)
    found = rk.outcome(block, record, model, initial=scene.initial, engine=engine)
    names = ("max_rotation", "margin", "overturned")
    return {name: getattr(found, name) for name in names} | {"status": found.status._value}


def model_and_engine(scene):
    """Blocks are linear under records of one or two samples, and others under many."""
    return {1: (rk.Linear(), EXACT), 2: (rk.Linear(), SHORT)}.get(scene.samples.size, (rk.Housner(), EXACT))


def history(scene, loose=False):
    """Return the data of a history as arrays, with the impacts alone."""
    scene = jax.tree.map(lambda x: np.asarray(x, float), scene)
    found = jax.device_get(_impacts(scene) if loose else _history(*model_and_engine(scene), scene))
    happened = np.isfinite(found["impact_times"])
    return found | {name: found[name][happened] for name in ("impact_times", "impact_velocities")}


def successful(found):
    return found["status"] == rk.Status.successful._value


def under_sines(model, amplitudes, period, block=BLOCK, initial=(0.0, 0.0)):
    """Outcomes under sine pulses, as arrays, by the programs of the table below."""
    scenes = [(block, (amplitude, period), initial) for amplitude in amplitudes]
    return hard_cases.outcomes("sine", model, EXACT, scenes)


# ---- Free rocking, and records ----

STARTS = [1e-8, 1e-6, 1e-4, 1e-2, 0.5, 0.999, 1 - 1e-9]
HOPS = {start: Scene((0.2, 1.7, 0.9), (start * 0.2, 0.0), 60.0) for start in STARTS}
ENERGY = Scene((0.3, 2.0, 0.85), (-0.25, 0.1), 12.0)
ELASTIC = (0.2, 1.0, 1.0)
MANY = hard_cases.SAMPLES
QUIET = np.zeros(MANY)
FREE = {
    "energy": ENERGY._replace(samples=QUIET),
    "no rebound": Scene((0.2, 1.0, 0.0), (0.1, 0.0), samples=QUIET),
    "hardly a rebound": Scene((0.2, 1.0, 0.3), (0.1, 0.0), samples=QUIET),
    "no loss": Scene(ELASTIC, (0.1, 0.0), 200.0, QUIET),
    "tiny, no loss": Scene(ELASTIC, (1e-9, 0.0), 200.0, QUIET),
    "from 0.1": Scene(BLOCK, (0.1, 0.0), 2.9, QUIET),
}
# A still record has a knot, the last one of many, or the first, where the block that starts from 0.1 hits the ground.
IMPACT = 1.3185043975796946, np.sqrt(2 * (np.cos(0.1) - np.cos(0.2)))  # time: as in the table; speed
LAST = MANY - 1
AT_KNOTS = {
    "knot": FREE["from 0.1"]._replace(dt=IMPACT[0] / 2),
    "end": FREE["from 0.1"]._replace(dt=IMPACT[0] / LAST),  # LAST of them are the time, without a rounding
    "start": Scene(BLOCK, (0.0, -IMPACT[1]), 2.9, QUIET, IMPACT[0] / LAST),
}
RECORDS = {
    "one sample": np.array([0.9]),
    "two samples": np.array([0.9, 0.9]),
    "zero": QUIET,
    "constant below the threshold": np.full(MANY, 0.15),
    "constant above the threshold": np.full(MANY, 0.5),
    "offset from zero": 0.5 + 0.1 * np.sin(np.arange(MANY)),
    "single spike": np.eye(1, MANY, 20)[0] * 4,
    "alternating": 3.0 * (-1.0) ** np.arange(MANY),
}
STEPS = [1e-5, 0.01, 2.5]
ODD = {
    (name, dt): Scene(BLOCK, (0.0, 0.0), (samples.size - 1) * dt + 10.0, samples, dt)
    for name, samples in RECORDS.items()
    for dt in STEPS
}
LONG = {"tiny, no loss": Scene(ELASTIC, (1e-9, 0.0), samples=np.zeros(2), dt=200.0)}


@functools.cache
def outcomes(samples):
    """Outcomes of those under records of so many samples, by name; of the length of the table's, by its program."""
    scenes = {name: scene for name, scene in (ODD | AT_KNOTS | LONG).items() if scene.samples.size == samples}
    if samples == MANY:
        rows = [(scene.block, (scene.dt, *scene.samples), scene.initial) for scene in scenes.values()]
        found = hard_cases.outcomes("record", "nonlinear", EXACT, rows)
    else:
        columns = jax.tree.map(lambda *x: np.array(x), *scenes.values())
        found = jax.device_get(_outcomes(*model_and_engine(next(iter(scenes.values()))), columns))
        found["successful"] = found["status"] == rk.Status.successful._value
    return {name: {key: values[i] for key, values in found.items()} for i, name in enumerate(scenes)}


@pytest.mark.parametrize("engine", ["series", "diffrax"])
@pytest.mark.parametrize("start", STARTS)
def test_free_rocking_in_closed_form(start, engine):
    """Impact times and velocities of a freely rocking linear block from hops of 1e-8 to the brink (Housner 1963)."""
    (alpha, p, e), loose = HOPS[start].block, engine == "diffrax"
    response = history(HOPS[start], loose)
    energy = start * (2 - start)  # over that of the saddle
    times, speeds = (
        [np.arccosh(1 / (1 - start)) / p if start > 0.5 else np.arctanh(np.sqrt(energy)) / p],
        [p * alpha * np.sqrt(energy)],
    )
    while len(times) < 30:
        energy *= e**2
        times.append(times[-1] + 2 * np.arctanh(np.sqrt(energy)) / p)
        speeds.append(p * alpha * np.sqrt(energy))
    sign = np.array([-1, 1] * 15)
    found = min(30, len(response["impact_times"]))
    assert found == 30 or start < 1e-4  # hops lower than the tolerance are rest
    assert found > 3
    # Near the brink the first time is as uncertain as the distance to it.
    tolerance = (1e-7 if loose else 1e-11) + (1e-8 if loose else 1e-15) / (1 - start)
    np.testing.assert_allclose(response["impact_times"][:found], np.array(times)[:found], rtol=tolerance)
    np.testing.assert_allclose(
        response["impact_velocities"][:found], (sign * speeds)[:found], rtol=1e-7 if loose else 1e-10
    )


@model
def test_energy(model):
    """Between impacts the energy of a free block is constant; at an impact its kinetic part drops by e^2."""
    response = history(ENERGY if model == "linear" else FREE["energy"])
    alpha, p, e = ENERGY.block
    opening, speed = np.abs(response["rotation"]), response["velocity"] / p
    if model == "nonlinear":
        potential = np.cos(alpha - opening) - np.cos(alpha)
    else:
        potential = alpha * opening - opening**2 / 2
    energy = speed**2 / 2 + potential
    flight = np.searchsorted(response["impact_times"], response["time"], side="right")
    levels = [energy[flight == k] for k in range(6)]
    for level, following in zip(levels, levels[1:]):
        assert np.ptp(level) < 1e-14
        np.testing.assert_allclose(following.mean() / level.mean(), e**2, rtol=1e-12)
    saddle = MODELS[model].moments(rk.Block(*ENERGY.block)).saddle
    assert float(saddle) == pytest.approx(alpha, rel=1e-15)


EXCESS = [0.0, 1e-15, 1e-12, 1e-9, 1e-6, 1e-3]


@model
@pytest.mark.parametrize("excess", EXCESS)
def test_uplift_at_the_peak(model, excess):
    """The threshold equals the peak, or is passed for an instant: nothing, or next to nothing, happens."""
    threshold = float(MODELS[model].moments(rk.Block(*BLOCK)).threshold)
    result = under_sines(model, [threshold * (1 + excess)], 2.0)
    assert result["successful"]
    # Excess x, above the threshold for ~sqrt(x): the rotation is of order x^2.
    assert result["max_rotation"] <= 40 * excess**2 + 1e-28
    assert excess > 1e-9 or result["margin"] == pytest.approx(1.0, abs=1e-12)
    assert result["max_rotation"] > 0 or excess < 1e-12


def test_the_threshold_is_touched():
    """At the peak of a pulse, and passed by a digit or two: of a hundred blocks one is lifted by 1e-32 rad and stands
    still where its acceleration cancels to nothing, which is no reason for its steps to be used up."""
    random, digit = np.random.default_rng(7), np.finfo(float).eps
    alpha, p, period = random.uniform([[0.03], [0.5], [0.1]], [[0.6], [5.0], [3.0]], (3, 3000))

    def touched(factor, alpha, p, period):
        return rk.outcome(rk.Block(alpha, p, 0.9), rk.SinePulse(factor * jnp.tan(alpha), period))

    for factor in (1.0, 1.0 + digit, 1.0 + 4 * digit):
        found = jax.jit(jax.vmap(touched, (None, 0, 0, 0)))(factor, alpha, p, period)
        assert (found.status == rk.Status.successful).all() and not found.overturned.any()
        assert np.max(found.max_rotation) < 1e-25 and np.max(np.abs(found.margin - 1)) < 1e-12


def test_block_that_never_uplifts():
    share = np.array([0.0, 0.5, 0.999])
    result = under_sines("nonlinear", share * np.tan(0.2), 2.0)
    for name in ("max_rotation", "impact_count", "max_velocity"):
        np.testing.assert_array_equal(result[name], 0)
    np.testing.assert_allclose(result["margin"], 2 - share, rtol=1e-6)


@pytest.mark.parametrize("name, impacts", [("no rebound", 1), ("hardly a rebound", 2)])
def test_heavy_impacts(name, impacts):
    response = history(FREE[name])
    assert successful(response)
    assert len(response["impact_times"]) >= impacts
    assert response["rotation"][-1] == 0 and response["velocity"][-1] == 0


def test_elastic_impacts_never_end():
    """Restitution 1 conserves energy for ever; impacts too many for the budget are reported."""
    response = history(FREE["no loss"])
    assert successful(response)
    speeds = np.abs(response["impact_velocities"])
    np.testing.assert_allclose(speeds, speeds[0], rtol=1e-12)
    assert history(FREE["tiny, no loss"])["status"] == rk.Status.step_budget_exhausted._value
    assert outcomes(2)["tiny, no loss"]["status"] == rk.Status.step_budget_exhausted._value


@functools.partial(jax.jit, static_argnums=0)
def _used_up(steps):
    """Return a history without loss that runs out of steps.

    As a whole, its last impact, three times, its states then, and the forces of the ground.
    """
    block, still = rk.Block(0.2, 2.0, 1.0), rk.RectangularPulse(0.0, 1.0)
    engine = rk.Series(max_steps=steps)
    cut = rk.simulate(block, still, rk.Linear(), initial=(0.1, 0.0), duration=100.0, engine=engine)
    last = jnp.max(cut.impact_times, where=jnp.isfinite(cut.impact_times), initial=0.0)
    times = jnp.stack([1.0, last - 1e-6, 99.0])
    return cut, last, times, jnp.stack(cut(times)), rk.responses.contact_forces(cut, block)


@pytest.mark.parametrize("steps", [40, 43])
def test_a_history_ends_where_its_steps_are_used_up(steps):
    """Check that a history is NaN beyond the steps it took, whether it ends with a stride of steps or within one."""
    cut, last, times, states, forces = _used_up(steps)
    assert cut.status == rk.Status.step_budget_exhausted
    last, times, states = jax.device_get((last, times, states))

    def whole(time):
        """Arcs about their tops, on alternate corners."""
        arc = np.round(time / np.arccosh(2.0))
        local = 2 * time - 2 * arc * np.arccosh(2.0)
        return (-1) ** arc * np.array([0.2 - 0.1 * np.cosh(local), -0.2 * np.sinh(local)])

    assert 3 < last < 30 and np.max(np.asarray(cut.impact_times)) == last
    for i in (0, 1):
        np.testing.assert_allclose(states[:, i], whole(times[i]), rtol=1e-9, atol=1e-12)
    assert np.all(np.isnan(states[:, 2]))
    time, rotation = np.asarray(cut.time), np.asarray(cut.rotation)
    followed = np.isfinite(rotation)
    assert np.all(followed[time < last]) and not np.any(followed[time > last + 2])
    assert np.abs(rotation[followed]).max() < 0.1 * (1 + 1e-9)
    for force in (forces.normal, forces.friction):
        np.testing.assert_array_equal(np.isfinite(force), followed)
    assert 0 < forces.least_normal < 1 and 0 < forces.largest_friction < 1
    rk.plot.history(cut)
    plt.close("all")


def test_accumulation_and_new_uplift():
    """Chattering to rest, waiting, and uplift by the second half of the pulse: the peaks are mirror images."""
    period = 2 * np.pi / 0.75
    response = history_in(np.float64, 0.1, 1.0, 0.8, np.tan(0.1) * 1.0143, period, period)
    rotation, times = response["rotation"], response["time"]
    assert successful(response)
    at_rest = (times > 3.3) & (times < 5.9)
    assert np.all(rotation[at_rest] == 0)
    first, second = rotation[times < 3.3], rotation[times > 5.9]
    assert first.min() < 0 and np.abs(first).max() == pytest.approx(np.abs(second).max(), rel=1e-3)
    assert response["impact_count"] > 100


# ---- A push begins after a delay ----


@jax.jit
def _pushed(e, push, lasts, delay, initial, duration):
    """Histories of linear blocks: what is largest and how it ends, and events."""

    def one(e, push, lasts, delay, initial, duration):
        motion = rk.RectangularPulse(push, lasts).shifted(delay)
        found = rk.simulate(
            rk.Block(0.2, 1.0, e), motion, rk.Linear(), initial=tuple(initial), duration=duration,
            engine=rk.Series(order=10, max_steps=2000), samples=2,
        )  # fmt: skip
        names = ("max_rotation", "margin", "impact_count", "impact_times")
        return {"status": found.status._value} | {name: getattr(found, name) for name in names}

    return jax.vmap(one)(e, push, lasts, delay, initial, duration)


def pushed(**scenes):
    """Return `_pushed` as arrays, computed in batches of a fixed number of lanes; the last batch is padded."""
    columns = [np.array(scenes[name], float) for name in ("e", "push", "lasts", "delay", "initial", "duration")]
    count = max(len(column) for column in columns if column.ndim)
    columns[4] = np.broadcast_to(columns[4], (count, 2)) if columns[4].ndim == 1 else columns[4]
    columns = [np.broadcast_to(x, (count, *x.shape[1:])) for x in columns]
    batches = [np.minimum(np.arange(i, i + hard_cases.LANES), count - 1) for i in range(0, count, hard_cases.LANES)]
    found = [jax.device_get(_pushed(*(x[batch] for x in columns))) for batch in batches]
    return {name: np.concatenate([part[name] for part in found])[:count] for name in found[0]}


def test_grazing_from_both_sides():
    """A block that is pushed back up just as it touches the ground: the outcome passes smoothly through it."""

    # Falling from rest at 0.01 rad, stopped by a push that begins late (impact) or early (no impact), and so lifted
    # higher than before: the largest rotation is the last.
    def ends(delays):
        found = pushed(e=0.9, push=-0.9, lasts=0.4, delay=delays, initial=(0.01, 0.0), duration=delays + 0.35)
        return found["impact_count"], found["max_rotation"]

    delays = np.array([0.05, 0.3])
    while delays[1] - delays[0] > 4e-16:
        delays = np.linspace(*delays, hard_cases.LANES)
        impacts, _ = ends(delays)
        assert impacts[0] == 0 and impacts[-1] > 0
        first = np.flatnonzero(impacts)[0]
        delays = delays[first - 1 : first + 1]
    (none, some), (before, after) = ends(delays)
    assert none == 0 and some >= 1
    assert after == pytest.approx(before, abs=1e-6) and before > 0.02


def test_two_crossings_inside_one_step():
    """A dip through the ground that is much shorter than a step is two impacts, not none."""
    # Down at speed v, and pushed up hard by a constant force: back at the ground after 2 v/a.
    push, height = -3.0, 1e-3
    speed = np.sqrt(2 * (-push - 0.2) * height + height**2) * (1 + 1e-5)
    response = pushed(e=1.0, push=push, lasts=1.0, delay=0.0, initial=[(height, -speed)], duration=0.3)
    assert response["impact_count"] >= 2
    first, second = response["impact_times"][0, :2]
    assert 0 < second - first < 1e-3


@pytest.mark.parametrize("where", ["knot", "end", "start"])
def test_impact_at_a_knot(where):
    """An impact that falls on a knot, on the end of the motion, or on its first sample, to the last digit."""
    free, response, result = history(FREE["from 0.1"]), history(AT_KNOTS[where]), outcomes(MANY)[where]
    assert successful(response)
    if where != "start":
        np.testing.assert_allclose(response["impact_times"][:2], free["impact_times"][:2], rtol=1e-14)
        np.testing.assert_allclose(response["rotation"][-1], free["rotation"][-1], rtol=1e-12)
    assert result["successful"] and not result["overturned"]


def test_beyond_alpha_and_rescued():
    """A block may lean past its balance point and be brought back by the second half of the pulse."""
    found = under_sines("nonlinear", np.linspace(3.0, 8.0, 400) * np.tan(0.2), 2.0)
    safe = ~found["overturned"]
    assert np.any(found["max_rotation"][safe] > 0.2 * 1.2)
    assert np.all(found["margin"][safe] > 0)


@pytest.mark.parametrize("model", ["linear", pytest.param("nonlinear", marks=pytest.mark.slow)])
def test_margin_is_smooth_through_the_boundary(model):
    """At every change of verdict along the intensity the margin goes through zero with the same slope."""
    threshold = float(MODELS[model].moments(rk.Block(*BLOCK)).threshold)

    def margin(intensities):
        return under_sines(model, intensities * threshold, 2 * np.pi / 2.2)["margin"]

    grid = np.linspace(1.02, 7.0, 1200)
    values = margin(grid)
    changes = np.flatnonzero(np.diff(np.sign(values)))
    assert len(changes) >= 3
    for i in changes:
        low, high = grid[i], grid[i + 1]
        for _ in range(12):
            points = np.linspace(low, high, hard_cases.LANES)
            inner = margin(points)
            k = int(np.flatnonzero(np.sign(inner) != np.sign(inner[0]))[0])
            low, high = points[k - 1], points[k]
            if high - low < 1e-13 * high:
                break
        step = 1e-6
        sides = margin(np.array([low - 2 * step, low - step, high + step, high + 2 * step]))
        slopes = sides[1] / -step, sides[2] / step
        assert np.sign(sides[0]) == np.sign(sides[1]) != np.sign(sides[2])
        assert slopes[0] == pytest.approx(slopes[1], rel=1e-2)
        assert abs(slopes[0]) > 1e-3


def test_hops_that_grow_are_not_rest():
    """Forcing just below the threshold lifts the next hop above all before: it must not be taken for dying out."""
    lanes = np.meshgrid(np.linspace(0.1, 0.95, 8), np.linspace(0.3, 0.9, 6), np.logspace(-5, -1, 8))
    strength, e, start = (x.ravel() for x in lanes)
    initial = np.stack([0.2 * start, 0.0 * start], axis=1)
    response = pushed(e=e, push=0.2 * strength, lasts=30.0, delay=0.0, initial=initial, duration=29.0)
    # The push of the table's motions, beside a cosine of no height that ends within it.
    scenes = [((0.2, 1.0, a), (0.0, 15.0, 0.2 * b, 30.0, 0.0), c) for a, b, c in zip(e, strength, initial)]
    result = hard_cases.outcomes("sum", "linear", EXACT, scenes)
    assert np.all(result["successful"]) and np.all(successful(response))
    np.testing.assert_allclose(result["max_rotation"], response["max_rotation"], rtol=1e-12)
    np.testing.assert_allclose(result["margin"], response["margin"], rtol=1e-10)
    assert np.any(response["max_rotation"] > 0.2 * start * 1.01)


def test_thrown_flat_and_back_within_a_step():
    """The peak passes pi/2 for an instant (SciPy: 1.0008 pi/2): the block has fallen."""
    result = under_sines("nonlinear", [29.476], 0.7853981633974483, block=(1.0, 1.0, 0.5))
    assert result["overturned"] and result["margin"] < 0


@pytest.mark.parametrize("distance", [1e-3, 1e-9])
def test_margin_of_an_initial_tilt(distance):
    """A still block released at either side of its balance point."""
    margins = [
        under_sines("linear", [0.0], 0.01, block=(0.2, 1.0, 0.5), initial=(0.2 * (1 + s * distance), 0.0))["margin"][0]
        for s in (-1, 1)
    ]
    np.testing.assert_allclose(margins, [distance**2, -(distance**2)], rtol=1e-6)


@pytest.mark.parametrize("dt", STEPS, ids=lambda dt: f"dt={dt}")
@pytest.mark.parametrize("name", RECORDS)
def test_odd_records(name, dt):
    """Answered, or refused with a status; history and outcome agree."""
    result, response = outcomes(RECORDS[name].size)[name, dt], history(ODD[name, dt])
    assert result["successful"] and successful(response)
    assert result["overturned"] == response["overturned"]
    assert np.all(np.isfinite(response["rotation"])) and np.all(np.isfinite(response["velocity"]))
    np.testing.assert_allclose(result["margin"], response["margin"], rtol=1e-9)
    if name in ("zero", "one sample", "constant below the threshold"):
        assert result["max_rotation"] == 0


@pytest.mark.parametrize("shape", [-np.inf, -700, -1e-12, 0, 1e-12, 700, np.inf])
@pytest.mark.parametrize("duration", [1e-6, 0.05, 2.0, 60.0])
def test_extreme_pulses(shape, duration):
    result = hard_cases.outcomes("exponential", "nonlinear", EXACT, [(BLOCK, (0.9, duration, shape), (0.0, 0.0))])
    assert result["successful"]
    assert np.isfinite(result["margin"])


@pytest.mark.parametrize("ratio", [0.05, 0.3, 8.0, 200.0])
@pytest.mark.parametrize("alpha", [1e-4, 0.2, 1.2])
def test_extreme_blocks(ratio, alpha):
    amplitudes = np.array([1.01, 1.5, 4.0, 30.0, 1000.0]) * np.tan(alpha)
    found = under_sines("nonlinear", amplitudes, 2 * np.pi / (3.0 * ratio), block=(alpha, 3.0, 0.5))
    assert np.all(found["successful"])
    assert np.all(np.isfinite(found["margin"]))
    assert np.all((found["margin"] < 0) == found["overturned"])


@pytest.mark.parametrize("order", [None, 20])
@pytest.mark.parametrize("many", [False, True], ids=["one", "many"])
def test_a_long_wait_in_single_precision(order, many):
    """Check a slow sine in single precision: its last coefficients vanish, and powers of the time to uplift overflow.

    The product of the two would be NaN; from order 19 on, the block would be reported as never moving.
    """
    scene = jax.tree.map(jnp.float32, (rk.Block(0.2, 1.0, 0.9), rk.SinePulse(0.3, 2 * np.pi / 0.05)))

    def one(scene):
        return rk.outcome(*scene, rk.Linear(), engine=rk.Series(order=order))

    if many:
        found = jax.jit(jax.vmap(one))(jax.tree.map(lambda x: jnp.full(100, x), scene))
    else:
        found = one(scene)
    assert found.margin.dtype == jnp.float32
    told = np.asarray(found.status == rk.Status.successful)
    assert told.all() or order == 20
    assert np.all(np.asarray(found.overturned)[told]) and np.all(np.abs(np.asarray(found.margin)[told] + 2.7373) < 1e-3)


@pytest.mark.slow
def test_single_precision():
    """Five digits in float32, with a warning that says how to get more."""
    block, pulse = rk.Block(0.2, 2.0, 0.9), rk.SinePulse(0.5, 1.1)
    exact = rk.outcome(block, pulse)
    half = jax.tree.map(lambda x: x.astype(jnp.float32), (block, pulse))
    result = rk.outcome(*half)
    assert result.max_rotation.dtype == jnp.float32 and result.status == rk.Status.successful
    np.testing.assert_allclose(result.max_rotation, exact.max_rotation, rtol=1e-5)
    response = rk.simulate(*half)
    np.testing.assert_allclose(response.max_rotation, exact.max_rotation, rtol=1e-5)


@jax.jit
def _verdict(samples, dt, duration):
    engine = rk.Series(order=4)
    record, block = rk.Record(samples, dt), rk.Block(0.2, 2.0)
    found = rk.simulate(block, record, rk.Linear(), duration=duration, samples=2, engine=engine)
    return found.overturned, found.margin, found.status == rk.Status.successful


@pytest.mark.parametrize("dt", [0.005, 0.01, 0.02])
def test_a_history_as_long_as_its_record_tells_the_verdict(dt):
    """Check that a history as long as its record tells the verdict, although the last step is a rounding longer.

    Without the free stage a block that is thrown down would be reported safe.
    """
    constant = np.full(10, 3.0)
    end = float(rk.Record(constant, dt).end)
    for duration in (dt * (constant.size - 1), end, np.nextafter(end, 1.0), np.nextafter(end, 0.0)):
        overturned, margin, is_answered = jax.device_get(_verdict(constant, dt, float(duration)))
        assert overturned and margin < 0 and is_answered


@jax.jit
def _under_a_sine(alpha, p, restitution, amplitude, period, duration):
    block, pulse = rk.Block(alpha, p, restitution), rk.SinePulse(amplitude, period)
    found = rk.simulate(block, pulse, duration=duration, engine=SHORT, samples=801)
    names = ("time", "rotation", "velocity", "max_rotation", "max_velocity", "impact_count")
    return {name: getattr(found, name) for name in names} | {"status": found.status._value}


def history_in(precision, *numbers):
    """A history where JAX has this precision, as arrays: one program for each of them in this file."""
    with jax.enable_x64(precision is np.float64):
        return jax.device_get(_under_a_sine(*map(precision, numbers)))


@pytest.mark.filterwarnings("ignore:jaxrock runs in single precision")
@pytest.mark.parametrize("precision", [np.float32, np.float64])
def test_what_comes_to_rest_does_not_fall_through_the_ground(precision):
    """Check rest in single precision, where the hops that a history leaves out last for 20 ms."""
    response = history_in(precision, 0.23036395, 3.820548, 0.92390084, 0.24509491, 0.26094967, 0.4)
    assert np.abs(response["rotation"]).max() <= response["max_rotation"] * (1 + 1e-5)
    assert np.abs(response["velocity"]).max() <= response["max_velocity"] * (1 + 1e-5)


def test_not_finite_is_a_status():
    broken = jax.tree.map(lambda x: x * np.nan, rk.SinePulse(0.5, 1.0))
    result = rk.outcome(rk.Block(0.2, 1.0, 0.9), broken, rk.Linear(), engine=EXACT)  # as in the table: traced once
    assert result.status != rk.Status.successful


# ---- The table, through both engines ----

BOUNDS = {"series": 1e-11, "diffrax": 1e-7, "tight": 1e-10, "single": 1e-4}
slow = pytest.mark.slow


def tables():
    """Engine, model, kind: the slow ones are those that only compile more of the same."""
    quick = {("series", "nonlinear", kind) for kind in KINDS} | {("series", "linear", "sum")}
    quick |= {("diffrax", "nonlinear", "sine"), ("single", "nonlinear", "sine")}
    every = itertools.product(BOUNDS, NAMES, KINDS)
    return [pytest.param(*parts, id="-".join(parts), marks=() if parts in quick else slow) for parts in every]


@pytest.mark.parametrize("engine, model, kind", tables())
def test_table(engine, model, kind):
    """Check that every case is answered within its bound, with an honest error.

    It may be refused, or answered with a large but sufficient error, only where the table allows it.
    """
    cases = [case for case in hard_cases.CASES if case.kind == kind and model in case.models]
    cases = [case for case in cases if case.single or engine != "single"]
    known = [hard_cases.answers()[hard_cases.key(case, model)] for case in cases]
    scenes = [(row["scene"][0], row["scene"][2], row["scene"][3]["initial"]) for row in known]
    dtype = np.float32 if engine == "single" else np.float64
    found = hard_cases.outcomes(kind, model, hard_cases.engines()[engine], scenes, dtype)
    wrong = []
    for i, (case, row) in enumerate(zip(cases, known)):
        lane, may_refuse = {name: values[i] for name, values in found.items()}, engine in case.refused
        if lane["successful"]:
            bound = np.inf if may_refuse else BOUNDS[engine]
            fault = hard_cases.judge(row, lane, bound, counted=not may_refuse)
        else:
            fault = "" if may_refuse else "refused"
        wrong += [f"{case.name}: {fault}"] if fault else []
    assert not wrong, "\n".join(wrong)


def test_the_table_has_answers():
    """Names are unique, the answers are those of the scenes in the table, and none is left over."""
    scenes = {hard_cases.key(c, model): hard_cases.scene(c, model) for c in hard_cases.CASES for model in c.models}
    assert len(scenes) == sum(len(case.models) for case in hard_cases.CASES) > 300
    assert set(scenes) == set(hard_cases.answers())
    for name, (block, kind, numbers, options) in scenes.items():
        its_block, its_kind, its_numbers, its_options = hard_cases.answers()[name]["scene"]
        assert its_kind == kind and its_options["model"] == options["model"]
        stored = its_block + its_numbers + its_options["initial"]
        np.testing.assert_allclose(stored, block + numbers + options["initial"], rtol=1e-15)


def test_the_judge_sees_errors():
    """Check that the judge finds an error beyond the bound in each number."""
    known = hard_cases.answers()["several excursions (nonlinear)"]
    good = {"max_rotation": np.float64(known["peak"]), "impact_count": known["impacts"], "overturned": False}
    good |= {"margin": 0.5, "error": 1e-15}
    bound = 1e-11
    assert hard_cases.judge(known, good, bound) == ""
    off = bound * known["condition"] * 0.2
    spoilt = {
        "verdict": {"overturned": True},
        "margin": {"margin": -0.5},
        "impacts": {"impact_count": known["impacts"] + 1},
        "peak": {"max_rotation": good["max_rotation"] + 1.1 * off, "error": 1.0},
        "error": {"max_rotation": good["max_rotation"] + 0.9 * off},
    }
    for name, change in spoilt.items():
        assert hard_cases.judge(known, good | change, bound).startswith(name)
    assert hard_cases.judge(known, good | {"max_rotation": np.float64("nan")}, bound).startswith("peak")


@pytest.mark.filterwarnings("ignore:jaxrock runs in single precision")
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_the_error_of_a_small_peak(dtype):
    """Check the small peaks of blocks that hardly move when the motion ends: by energy, and by steps in the history."""
    rates, pulse = np.geomspace(1e-3, 2.0, 4), (0.3, 0.25)
    scenes = [((0.2, p, 0.5), pulse, (0.0, 0.0)) for p in rates]
    found = hard_cases.outcomes("sine", "nonlinear", EXACT, scenes, dtype)
    peak, error = (np.asarray(found[name], float) for name in ("max_rotation", "error"))
    histories = [history_in(dtype, 0.2, p, 0.5, *pulse, 0.8) for p in rates]
    other = np.array([float(history["max_rotation"]) for history in histories])
    assert found["error"].dtype == histories[0]["max_rotation"].dtype == dtype
    assert peak.min() < 1e-7 and np.all(np.abs(peak - other) <= error)
    assert np.all(error < 5e-16 if dtype is np.float64 else error < 1e-6)


@pytest.mark.parametrize("engine", [EXACT, LOOSE], ids=["series", "diffrax"])
def test_a_start_whose_square_vanishes_is_rest(engine):
    """A velocity of 1e-160 rad/s: the block stands."""
    scene = (0.2, 2.0, 0.9), (0.01, 0.5), (0.0, 1e-160)
    found = hard_cases.outcomes("sine", "nonlinear", engine, [scene])
    assert found["successful"] and not found["overturned"] and found["max_rotation"] < 1e-100
