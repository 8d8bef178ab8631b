"""Where rocking solvers go wrong: small hops, grazing, tangential uplift, accumulation, the boundary, odd records."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk
from references import hard_cases
from references.hard_cases import KINDS, MODELS as NAMES
from references.in_jaxrock import MODELS

outcome = jax.jit(rk.outcome)
STILL = rk.Record([0.0], 0.01)
model = pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)


@pytest.mark.parametrize("engine", [rk.Series(), rk.Diffrax(rtol=1e-8)], ids=["series", "diffrax"])
@pytest.mark.parametrize("start", [1e-8, 1e-6, 1e-4, 1e-2, 0.5, 0.999, 1 - 1e-9])
def test_free_rocking_in_closed_form(start, engine):
    """Impact times and velocities of a freely rocking linear block from hops of 1e-8 to the brink (Housner 1963)."""
    alpha, p, e = 0.2, 1.7, 0.9
    loose = isinstance(engine, rk.Diffrax)
    initial = (start * alpha, 0.0)
    response = rk.simulate(rk.Block(alpha, p, e), STILL, rk.Linear(), initial=initial, duration=60.0, engine=engine)
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
    found = min(30, len(response.impact_times))
    assert found == 30 or start < 1e-4  # hops lower than the tolerance are rest
    assert found > 3
    # Near the brink the first time is as uncertain as the distance to it.
    tolerance = (1e-7 if loose else 1e-11) + (1e-8 if loose else 1e-15) / (1 - start)
    np.testing.assert_allclose(response.impact_times[:found], np.array(times)[:found], rtol=tolerance)
    np.testing.assert_allclose(
        response.impact_velocities[:found], (sign * speeds)[:found], rtol=1e-7 if loose else 1e-10
    )


@model
def test_energy(model):
    """Between impacts the energy of a free block is constant; at an impact its kinetic part drops by e^2."""
    block = rk.Block(0.3, 2.0, 0.85)
    response = rk.simulate(block, STILL, model, initial=(-0.25, 0.1), duration=12.0, samples=4001)
    table, alpha = model.moments(block), float(block.alpha)
    opening, speed = jnp.abs(response.rotation), response.velocity / block.p
    if isinstance(model, rk.Housner):
        potential = jnp.cos(alpha - opening) - jnp.cos(alpha)
    else:
        potential = alpha * opening - opening**2 / 2
    energy = np.asarray(speed**2 / 2 + potential)
    flight = np.searchsorted(np.asarray(response.impact_times), np.asarray(response.time), side="right")
    levels = [energy[flight == k] for k in range(6)]
    for level, following in zip(levels, levels[1:]):
        assert np.ptp(level) < 1e-14
        np.testing.assert_allclose(following.mean() / level.mean(), 0.85**2, rtol=1e-12)
    assert float(table.saddle) == pytest.approx(alpha, rel=1e-15)


@model
@pytest.mark.parametrize("excess", [0.0, 1e-15, 1e-12, 1e-9, 1e-6, 1e-3])
def test_uplift_at_the_peak(model, excess):
    """The threshold equals the peak, or is passed for an instant: nothing, or next to nothing, happens."""
    block = rk.Block(0.2, 1.0, 0.9)
    threshold = float(model.moments(block).threshold)
    result = outcome(block, rk.SinePulse(threshold * (1 + excess), 2.0), model)
    assert result.status == rk.Status.successful
    # Excess x, above the threshold for ~sqrt(x): the rotation is of order x^2.
    assert float(result.max_rotation) <= 40 * excess**2 + 1e-28
    assert excess > 1e-9 or float(result.margin) == pytest.approx(1.0, abs=1e-12)
    assert float(result.max_rotation) > 0 or excess < 1e-12


def test_block_that_never_uplifts():
    block = rk.Block(0.2, 1.0)
    threshold = np.tan(0.2)
    for share in (0.0, 0.5, 0.999):
        result = outcome(block, rk.SinePulse(share * threshold, 2.0))
        assert result.max_rotation == 0 and result.impact_count == 0 and result.max_velocity == 0
        assert float(result.margin) == pytest.approx(2 - share)


@pytest.mark.parametrize("restitution, impacts", [(0.0, 1), (0.3, 2)])
def test_heavy_impacts(restitution, impacts):
    response = rk.simulate(rk.Block(0.2, 1.0, restitution), STILL, initial=(0.1, 0.0), duration=20.0)
    assert response.status == rk.Status.successful
    assert int(response.impact_count) >= impacts
    assert response.rotation[-1] == 0 and response.velocity[-1] == 0


def test_elastic_impacts_never_end():
    """Restitution 1 conserves energy for ever; impacts too many for the budget are reported."""
    block = rk.Block(0.2, 1.0, 1.0)
    response = rk.simulate(block, STILL, initial=(0.1, 0.0), duration=200.0)
    assert response.status == rk.Status.successful
    speeds = np.abs(response.impact_velocities)
    np.testing.assert_allclose(speeds, speeds[0], rtol=1e-12)
    tiny = rk.simulate(block, STILL, initial=(1e-9, 0.0), duration=200.0)
    assert tiny.status == rk.Status.step_budget_exhausted
    again = rk.outcome(block, rk.SinePulse(0.6, 1.0), engine=rk.Series(max_steps=3))
    assert again.status == rk.Status.step_budget_exhausted


def test_accumulation_and_new_uplift():
    """Chattering to rest, waiting, and uplift by the second half of the pulse: the peaks are mirror images."""
    block, pulse = rk.Block(0.1, 1.0, 0.8), rk.SinePulse(0.1 * 1.0143, 2 * np.pi / 0.75)
    response = rk.simulate(block, pulse, rk.Linear())
    rotation, times = np.asarray(response.rotation), np.asarray(response.time)
    assert response.status == rk.Status.successful
    at_rest = (times > 3.3) & (times < 5.9)
    assert np.all(rotation[at_rest] == 0)
    first, second = rotation[times < 3.3], rotation[times > 5.9]
    assert first.min() < 0 and np.abs(first).max() == pytest.approx(np.abs(second).max(), rel=1e-3)
    assert int(response.impact_count) > 100


def test_grazing_from_both_sides():
    """A block that is pushed back up just as it touches the ground: the outcome passes smoothly through it."""
    block = rk.Block(0.2, 1.0, 0.9)

    # Falling from rest at 0.01 rad, stopped by a push that begins late (impact) or early (no impact).
    def impacts(delay):
        motion = rk.RectangularPulse(-0.9, 0.3).shifted(delay)
        response = rk.simulate(block, motion, initial=(0.01, 0.0), duration=delay + 0.25)
        return len(response.impact_times), float(response(delay + 0.25)[0])

    low, high = 0.05, 0.3
    assert impacts(low)[0] == 0 and impacts(high)[0] > 0
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (middle, high) if impacts(middle)[0] == 0 else (low, middle)
    (none, before), (some, after) = impacts(low), impacts(high)
    assert none == 0 and some >= 1
    assert after == pytest.approx(before, abs=1e-6)


def test_two_crossings_inside_one_step():
    """A dip through the ground that is much shorter than a step is two impacts, not none."""
    block = rk.Block(0.2, 1.0, 1.0)
    # Down at speed v, and pushed up hard by a constant force: back at the ground after 2 v/a.
    push, height = -3.0, 1e-3
    speed = np.sqrt(2 * (-push - 0.2) * height + height**2) * (1 + 1e-5)
    response = rk.simulate(block, rk.RectangularPulse(push, 1.0), rk.Linear(), initial=(height, -speed), duration=0.3)
    assert int(response.impact_count) >= 2
    gap = np.diff(response.impact_times)[0]
    assert 0 < gap < 1e-3


@pytest.mark.parametrize("where", ["knot", "end", "start"])
def test_impact_at_a_knot(where):
    """An impact that falls on a knot, on the end of the motion, or on its first sample, to the last digit."""
    block = rk.Block(0.2, 1.0, 0.9)
    free = rk.simulate(block, STILL, rk.Linear(), initial=(0.1, 0.0), duration=3.0)
    time = float(free.impact_times[0])
    quiet = rk.Record([0.0, 0.0, 0.0], time if where == "knot" else time / 2)
    initial = (0.0, -float(free.impact_velocities[0])) if where == "start" else (0.1, 0.0)
    response = rk.simulate(block, quiet, rk.Linear(), initial=initial, duration=2.9)
    assert response.status == rk.Status.successful
    if where != "start":
        np.testing.assert_allclose(response.impact_times[:2], free.impact_times[:2], rtol=1e-14)
        np.testing.assert_allclose(response.rotation[-1], free(2.9)[0], rtol=1e-12)
    result = rk.outcome(block, quiet, rk.Linear(), initial=initial)
    assert result.status == rk.Status.successful and not result.overturned


def test_beyond_alpha_and_rescued():
    """A block may lean past its balance point and be brought back by the second half of the pulse."""
    block = rk.Block(0.2, 1.0, 0.9)
    amplitude = np.linspace(3.0, 8.0, 400)
    found = jax.vmap(lambda a: rk.outcome(block, rk.SinePulse(a * np.tan(0.2), 2.0)))(amplitude)
    safe = np.asarray(~found.overturned)
    assert np.any(np.asarray(found.max_rotation)[safe] > 0.2 * 1.2)
    assert np.all(np.asarray(found.margin)[safe] > 0)


@pytest.mark.parametrize(
    "model", [rk.Linear(), pytest.param(rk.Housner(), marks=pytest.mark.slow)], ids=["linear", "nonlinear"]
)
def test_margin_is_smooth_through_the_boundary(model):
    """At every change of verdict along the intensity the margin goes through zero with the same slope."""
    block = rk.Block(0.2, 1.0, 0.9)
    threshold = float(model.moments(block).threshold)
    margin = jax.jit(jax.vmap(lambda a: rk.outcome(block, rk.SinePulse(a * threshold, 2 * jnp.pi / 2.2), model).margin))
    count = 1200  # always as many, so that all is one compilation
    grid = np.linspace(1.02, 7.0, count)
    values = np.asarray(margin(grid))
    changes = np.flatnonzero(np.diff(np.sign(values)))
    assert len(changes) >= 3
    for i in changes:
        low, high = grid[i], grid[i + 1]
        for _ in range(12):
            points = np.linspace(low, high, count)
            inner = np.asarray(margin(points))
            k = int(np.flatnonzero(np.sign(inner) != np.sign(inner[0]))[0])
            low, high = points[k - 1], points[k]
            if high - low < 1e-13 * high:
                break
        step = 1e-6
        sides = [low - 2 * step, low - step, high + step, high + 2 * step]
        sides = np.asarray(margin(np.resize(sides, count)))[:4]
        slopes = sides[1] / -step, sides[2] / step
        assert np.sign(sides[0]) == np.sign(sides[1]) != np.sign(sides[2])
        assert slopes[0] == pytest.approx(slopes[1], rel=1e-2)
        assert abs(slopes[0]) > 1e-3


def test_hops_that_grow_are_not_rest():
    """Forcing just below the threshold lifts the next hop above all before: it must not be taken for dying out."""
    strength, e, start = jnp.meshgrid(jnp.linspace(0.1, 0.95, 8), jnp.linspace(0.3, 0.9, 6), jnp.logspace(-5, -1, 8))

    @jax.jit
    @jax.vmap
    def both(strength, e, start):
        block, push = rk.Block(0.2, 1.0, e), rk.RectangularPulse(0.2 * strength, 30.0)
        initial = (0.2 * start, 0.0)
        engine = rk.Series(max_steps=2000)
        result = rk.outcome(block, push, rk.Linear(), initial=initial, engine=engine)
        response = rk.simulate(block, push, rk.Linear(), initial=initial, duration=29.0, engine=engine)
        return result, (response.max_rotation, response.margin, response.status)

    result, (peak, margin, status) = both(strength.ravel(), e.ravel(), start.ravel())
    assert np.all(result.status == rk.Status.successful) and np.all(status == rk.Status.successful)
    np.testing.assert_allclose(result.max_rotation, peak, rtol=1e-12)
    np.testing.assert_allclose(result.margin, margin, rtol=1e-10)
    assert np.any(np.asarray(peak) > 0.2 * start.ravel() * 1.01)


def test_thrown_flat_and_back_within_a_step():
    """The peak passes pi/2 for an instant (SciPy: 1.0008 pi/2): the block has fallen."""
    result = outcome(rk.Block(1.0, 1.0, 0.5), rk.SinePulse(29.476, 0.7853981633974483))
    assert result.overturned and result.margin < 0


@pytest.mark.parametrize("distance", [1e-3, 1e-9])
def test_margin_of_an_initial_tilt(distance):
    """A still block released at either side of its balance point."""
    margins = [
        float(outcome(rk.Block(0.2, 1.0, 0.5), STILL, rk.Linear(), initial=(0.2 * (1 + s * distance), 0.0)).margin)
        for s in (-1, 1)
    ]
    np.testing.assert_allclose(margins, [distance**2, -(distance**2)], rtol=1e-6)


RECORDS = {
    "zero": np.zeros(50),
    "one sample": np.array([0.9]),
    "two samples": np.array([0.9, 0.9]),
    "constant below the threshold": np.full(50, 0.15),
    "constant above the threshold": np.full(50, 0.5),
    "offset from zero": 0.5 + 0.1 * np.sin(np.arange(50)),
    "single spike": np.eye(1, 50, 20)[0] * 4,
    "alternating": 3.0 * (-1.0) ** np.arange(50),
}


@pytest.mark.parametrize("dt", [1e-5, 0.01, 2.5], ids=lambda dt: f"dt={dt}")
@pytest.mark.parametrize("name", RECORDS)
def test_odd_records(name, dt):
    """Answered, or refused with a status; history and outcome agree."""
    block, record = rk.Block(0.2, 1.0, 0.9), rk.Record(RECORDS[name], dt)
    result, response = rk.outcome(block, record), rk.simulate(block, record)
    assert result.status == rk.Status.successful and response.status == rk.Status.successful
    assert bool(result.overturned) == bool(response.overturned)
    assert np.all(np.isfinite(response.rotation)) and np.all(np.isfinite(response.velocity))
    np.testing.assert_allclose(result.margin, response.margin, rtol=1e-9)
    if name in ("zero", "one sample", "constant below the threshold"):
        assert result.max_rotation == 0


@pytest.mark.parametrize("shape", [-np.inf, -700, -1e-12, 0, 1e-12, 700, np.inf])
@pytest.mark.parametrize("duration", [1e-6, 0.05, 2.0, 60.0])
def test_extreme_pulses(shape, duration):
    result = outcome(rk.Block(0.2, 1.0, 0.9), rk.ExponentialPulse(0.9, duration, shape))
    assert result.status == rk.Status.successful
    assert np.isfinite(result.margin)


@pytest.mark.parametrize("ratio", [0.05, 0.3, 8.0, 200.0])
@pytest.mark.parametrize("alpha", [1e-4, 0.2, 1.2])
def test_extreme_blocks(ratio, alpha):
    block = rk.Block(alpha, 3.0, 0.5)
    found = jax.vmap(lambda a: rk.outcome(block, rk.SinePulse(a * jnp.tan(alpha), 2 * jnp.pi / (3.0 * ratio))))(
        jnp.array([1.01, 1.5, 4.0, 30.0, 1000.0])
    )
    assert np.all(found.status == rk.Status.successful)
    assert np.all(np.isfinite(found.margin))
    assert np.all((found.margin < 0) == found.overturned)


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


def test_not_finite_is_a_status():
    broken = jax.tree.map(lambda x: x * jnp.nan, rk.SinePulse(0.5, 1.0))
    result = rk.outcome(rk.Block(0.2, 1.0), broken)
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
    """Every case is answered within its bound, with an honest error; refused, or answered with an error that tells
    enough, only where the table allows it."""
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
    """What is wrong by more than the bound is found, in each number."""
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
