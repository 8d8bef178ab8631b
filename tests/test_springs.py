"""Spring models: their equations, 40-digit references with derivatives, the free stage, energy, both engines, SciPy."""

import functools
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxrock as rk
from jaxrock.blocks.restitution import Reset
from jaxrock.engines.free_stage import Visit, _time_to_impact, _time_to_peak, free_stage
from jaxrock.models.equation import Angle
from references import lumped_column
from references.in_jaxrock import PULSES

SCENES = json.loads((Path(__file__).parents[1] / "references" / "springs.json").read_text())["scenes"]
RESULTS = ("max_rotation", "max_velocity", "time_of_max")
SHORT = rk.Series(order=6)  # a shorter program
SPRINGS = (("SM1", "sine"), ("SM1", "linear"), ("SM1", "plastic"), ("SM3", "plastic"))
MOMENTS = {  # over m g R at an opening angle: Diamantopoulos & Fragiadakis (2017)
    ("SM1", "sine"): lambda x, alpha, m: m.sin(alpha - x),  # 4, 7, 10
    ("SM1", "linear"): lambda x, alpha, m: m.sin(alpha) * (1 - x / alpha),  # 5, 8, 11
    ("SM1", "plastic"): lambda x, alpha, m: m.sin(alpha) - m.sin(x),  # 6
    ("SM3", "plastic"): lambda x, alpha, m: m.sin(alpha) - m.cos(alpha) * m.sin(x),  # 9, 12
}


def slow(*row):
    return pytest.param(*row, marks=pytest.mark.slow)


# ---- The equations ----


@pytest.mark.parametrize("kind", ["SM1", "SM2", "SM3", "mmSM"])
@pytest.mark.parametrize("law", ["sine", "linear", "plastic"])
def test_equation(kind, law):
    """Moment and arm are the printed ones; the block uplifts at tan(alpha), and at the saddle nothing pulls."""
    moment = MOMENTS["SM3" if law == "plastic" and kind in ("SM2", "SM3") else "SM1", law]
    for alpha in (0.05, 0.3, 0.7):
        table, angle = rk.Spring(kind, law).moments(rk.Block(alpha, 2.0)), np.linspace(0, 1.5, 7)
        parts = [(table.restoring(Angle.of(x)), table.arm(Angle.of(x))) for x in angle]
        np.testing.assert_allclose(
            parts, [(moment(x, alpha, np), np.cos(alpha) * np.cos(x)) for x in angle], atol=4e-16
        )
        assert float(table.threshold) == pytest.approx(np.tan(alpha), rel=4e-16)
        assert abs(moment(float(table.saddle), alpha, np)) < 4e-16
        slope = (moment(table.saddle - 1e-5, alpha, np) - moment(table.saddle + 1e-5, alpha, np)) / 2e-5
        assert float(table.stiffness) == pytest.approx(float(slope), rel=1e-9)
        # The velocity that reaches the saddle, from the work up to there.
        work = mpmath.quad(lambda x: moment(x, alpha, mpmath), [0.1 * alpha, float(table.saddle)])  # noqa: B023
        assert float(table.manifold(jnp.array(0.1 * alpha))) == pytest.approx(float(mpmath.sqrt(2 * work)), rel=1e-14)
        # The force that holds it, where it is printed.
        force = rk.closed_form.pushover.spring_force(angle, alpha, kind, law)
        np.testing.assert_allclose(force, [a / b for a, b in parts], rtol=1e-13, atol=1e-14)


def test_pushover():
    """Equation 17 is 16 times 1 + tan(alpha) tan(rotation); figure 15 is the ratio of the two arms."""
    alpha, x = np.meshgrid([0.05, 0.2, 0.46], np.linspace(0, 0.46, 9))
    pushover = rk.closed_form.pushover
    longer = 1 + np.tan(alpha) * np.tan(x)
    spring, block = pushover.spring_force(x, alpha, "SM1", "sine"), pushover.force(x, alpha)
    np.testing.assert_allclose(spring, block * longer, rtol=1e-12, atol=1e-15)
    ratio = np.cos(alpha) * np.cos(x) / np.cos(alpha - x)
    np.testing.assert_allclose(pushover.overturning_moment_ratio(x, alpha), ratio, rtol=1e-14)
    # Law "linear" follows the block's moment to 1.41 % of its largest at h/b = 2.
    off = np.abs(pushover.spring_force(x, alpha) - spring) * np.cos(x) / np.tan(alpha)
    assert 0.01 < off[x <= alpha].max() < 0.0142
    # Law "plastic" of SM3 still holds at alpha: equation 19 over tan(alpha) is 1/cos(alpha) - 1 there, 18 is zero.
    left, none = (pushover.spring_force(alpha, alpha, kind, "plastic") / np.tan(alpha) for kind in ("SM3", "SM1"))
    np.testing.assert_allclose(left, 1 / np.cos(alpha) - 1, atol=1e-15)
    np.testing.assert_allclose(none, 0, atol=1e-15)


@pytest.mark.parametrize("law", ["sine", "linear", "plastic"])
@pytest.mark.parametrize("count, slower", [(2, 3 / 2), (3, 9 / 8), (6, 51 / 50), (10_001, 1 + 0.5e-8)])
def test_lumped_masses(law, count, slower):
    """Their moment of inertia over the block's, mass by mass; two put one half at the top, very many are the rod."""
    height, mass = lumped_column.masses_along(count, 2.0)
    assert np.sum(mass) == pytest.approx(lumped_column.MASS) and np.average(height, weights=mass) == pytest.approx(1)
    assert np.average(height**2, weights=mass) * 3 / 4 == pytest.approx(slower, rel=1e-12)
    block, angle = rk.Block(0.3, 2.0), Angle.of(0.17)
    column, rod = (rk.Spring("mmSM", law, n).moments(block) for n in (count, None))
    for name in ("restoring", "arm"):
        slowly, quickly = (float(getattr(table, name)(angle)) for table in (column, rod))
        assert slowly * slower == pytest.approx(quickly, rel=1e-15)
    assert float(column.threshold) == pytest.approx(np.tan(0.3), rel=1e-15)
    assert float(column.saddle) == pytest.approx(float(rod.saddle), rel=1e-15)


@pytest.mark.parametrize("words", [("SM4", "sine"), ("SM1", "lineal"), ("MMSM",)])
def test_unknown_words(words):
    asked = {"SM4": "'SM4'\\.$", "SM1": "Did you mean 'linear'", "MMSM": "Did you mean 'mmSM'"}[words[0]]
    with pytest.raises(ValueError, match=f"Argument `(kind|law)` must be one of .* {asked}"):
        rk.Spring(*words)
    with pytest.raises(ValueError, match="Argument `(kind|law)` must be one of"):
        rk.closed_form.pushover.spring_force(0.1, 0.2, *words)


@pytest.mark.parametrize("count", [1, 0, -6])
def test_too_few_masses(count):
    with pytest.raises(ValueError, match="Argument `masses` must be a whole number, at least 2, but is"):
        rk.Spring("mmSM", masses=count)
    with pytest.raises(ValueError, match="Argument `masses` must be None for 'SM1', which has one mass, but is"):
        rk.Spring("SM1", masses=count)


def test_a_stout_block_has_no_balance():
    """At pi/4 and above the moment of SM3's plastic spring is positive up to pi/2: refused, not answered."""
    spring = rk.Spring("SM3", "plastic")
    with pytest.raises(ValueError, match="Argument `block.alpha` must be below pi/4"):
        spring.moments(rk.Block(0.8, 1.0))
    with pytest.raises(Exception, match="must be below pi/4"):
        jax.block_until_ready(jax.jit(lambda alpha: spring.moments(rk.Block(alpha, 1.0)).saddle)(0.8))
    assert rk.Spring("SM1", "plastic").moments(rk.Block(0.8, 1.0)).saddle == pytest.approx(0.8, rel=1e-15)
    for ask in (rk.outcome, rk.simulate):
        with pytest.raises(ValueError, match="Argument `block.alpha` must be below pi/4 .* but is 0.8"):
            ask(rk.Block(0.8, 1.0), rk.SinePulse(2.0, 0.6), spring)
        with pytest.raises(ValueError, match="Argument `block.alpha2` must be below pi/4 .* but is 0.8"):
            ask(rk.blocks.AsymmetricBlock(0.5, 0.8, 1.0), rk.SinePulse(2.0, 0.6), spring)
    found = rk.outcome(rk.Block(0.8, 1.0, 0.5), rk.SinePulse(2.0, 0.6), spring, engine=SHORT, throw=False)
    assert found.status == rk.Status.not_finite and np.isnan(found.max_rotation)


# ---- References ----


@functools.cache
def run(kind, spring, derivatives):
    """Derivatives (scenes, results, parameters), if any, and outcomes, compiled once."""

    def outcome(x):
        block = rk.Block(x[0], x[1], x[2])
        motion = x[3] * rk.example_record() if kind == "record" else PULSES[kind](*[x[k] for k in range(3, x.size)])
        return rk.outcome(block, motion, rk.Spring(*spring), engine=None if derivatives else SHORT)

    def results(x):
        found = outcome(x)
        return jnp.stack([getattr(found, name) for name in RESULTS]), found

    if not derivatives:  # one by one, as a single scene is compiled
        return lambda x: (None, jax.tree.map(lambda *found: np.array(found), *map(outcome, x)))
    return jax.jit(jax.vmap(jax.jacfwd(results, has_aux=True)))


def rows(kind, spring):
    found = [row for row in SCENES if row["kind"] == kind and row["spring"] == list(spring)]
    return found, np.array([row["block"] + row["motion"] for row in found])


@pytest.mark.parametrize(
    ("kind", "spring", "derivatives"),
    [("sine", SPRINGS[3], False)]
    + [
        slow(kind, spring, True) for kind in ("sine", "exponential", "ricker symmetric", "record") for spring in SPRINGS
    ],
)
def test_references(kind, spring, derivatives):
    """Peak, velocity and time, and their derivatives (slow), against 40-digit Taylor series."""
    scenes, x = rows(kind, spring)
    assert len(scenes) >= 2
    slopes, found = run(kind, spring, derivatives)(x)
    assert np.all(found.status == rk.Status.successful) and np.all(found.differentiable)
    for k, name in enumerate(RESULTS):
        exact = np.array([float(row[name]["value"]) for row in scenes])
        np.testing.assert_allclose(getattr(found, name), exact, rtol=1e-11)
        if not derivatives:
            continue
        gradient = np.array([[float(c) for c in row[name]["gradient"]] for row in scenes])
        elastic = np.abs(gradient * x) / exact[:, None]
        off = np.abs((slopes[:, k] - gradient) * x) / exact[:, None]
        assert np.all(off <= 1e-9 * (1 + elastic.max(axis=1, keepdims=True)))


# ---- The free stage ----


def free_peak(kind, alpha, e, x, v):
    """Peak of the free rocking on a plastic spring and its time (p t), by quadrature in 30 digits."""
    with mpmath.workdps(30):
        alpha, e, x, v = (mpmath.mpf(value) for value in (alpha, e, x, v))
        most, weight = mpmath.sin(alpha), mpmath.cos(alpha) if kind == "SM3" else mpmath.mpf(1)
        saddle = mpmath.asin(most / weight)

        def mean(low, gap):
            """Mean moment from `low` to `low` + `gap`."""
            return most - weight * mpmath.sin(low + gap / 2) * mpmath.sincpi(gap / 2 / mpmath.pi)

        def rise(low, speed):
            """Turning point, and the time up to there; d^2 = peak - angle takes the root out of the integrand."""
            top = mpmath.findroot(lambda y: 2 * (y - low) * mean(low, y - low) - speed**2, (low, saddle), "anderson")
            far = mpmath.sqrt(top - low)
            return top, mpmath.quad(lambda d: 2 / mpmath.sqrt(2 * mean(top - d * d, d * d)), [0, far / 2, far])

        if v > 0:
            return rise(x, v)
        arrival = mpmath.sqrt(v**2 + 2 * x * mean(0, x))
        top, after = rise(mpmath.mpf(0), e * arrival)
        if x < saddle and 2 * (saddle - x) * mean(x, saddle - x) > v**2:
            return top, after + rise(mpmath.mpf(0), arrival)[1] - rise(x, -v)[1]
        return top, after + mpmath.quad(lambda y: 1 / mpmath.sqrt(v**2 + 2 * (x - y) * mean(y, x - y)), [0, x / 2, x])


@jax.jit
def follow(visit, x, v):
    """From an angle and a velocity on, under no motion; one program for all springs."""
    return free_stage((visit, visit), x, v, jnp.array(True), jnp.array(0.0))


@pytest.mark.parametrize("spring", SPRINGS[2:], ids=" ".join)
def test_free_stage(spring):
    """A constant and a sinusoid: peak and its time by quadrature, from below the saddle and from beyond it."""

    @jax.jit
    def start(alpha, share, speed):
        """Stay, angle, velocity in shares of what reaches the saddle, and a little more than that."""
        block = rk.Block(alpha, 1.0, 0.6)
        table = rk.Spring(*spring).moments(block)
        x = share * table.saddle
        most = table.manifold(x)
        return Visit(table, Reset.of(block.law, block.corners, block.p)), x, speed * jnp.abs(most), 1.001 * most

    for alpha, share, speed in [
        (0.05, 0.3, 0.9),
        (0.3, 0.5, -0.7),
        (0.6, 0.9, 0.999),
        (0.7, 1.2, -1.3),
        (0.7, 0.8, -2),
    ]:
        visit, x, v, more = jax.device_get(start(alpha, share, speed))
        found = jax.device_get(follow(visit, x, v))
        assert not found.overturned
        peak, time = free_peak(spring[0], alpha, 0.6, float(x), float(v))
        assert float(found.peak) == pytest.approx(float(peak), rel=2e-14)
        assert float(found.peak_time) == pytest.approx(float(time), rel=1e-13)
        assert follow(visit, x, more).overturned == (share < 1 or v > 0)


@pytest.mark.parametrize("spring", [SPRINGS[3], *(slow(spring) for spring in SPRINGS[:3])], ids=" ".join)
def test_energy_between_impacts(spring):
    """A free column keeps its energy from impact to impact, loses 1 - e^2 at each, and overturns above its balance."""
    alpha, e, p = 0.4, 0.8, 2.0
    block, model = rk.Block(alpha, p, e), rk.Spring(*spring)
    moment = MOMENTS[spring]

    @jax.jit
    def release(speed):
        still = rk.Record([0.0], 0.1)
        found = rk.simulate(block, still, model, initial=(0.0, speed), duration=8.0, engine=rk.Series(order=10))
        names = ("time", "rotation", "velocity", "impact_times", "impact_count", "overturned")
        return {name: getattr(found, name) for name in names}

    over = float(
        mpmath.sqrt(2 * mpmath.quad(lambda x: moment(x, alpha, mpmath), [0, float(model.moments(block).saddle)]))
    )
    response = jax.device_get(release(0.98 * over * p))
    nodes, weights = np.polynomial.legendre.leggauss(30)
    x = np.abs(response["rotation"])
    work = x * np.sum(moment(x[:, None] * (nodes + 1) / 2, alpha, np) * weights / 2, axis=1)
    energy = (response["velocity"] / p) ** 2 / 2 + work
    hits = np.searchsorted(response["impact_times"], response["time"], side="right")
    expected = (0.98 * over) ** 2 / 2 * e ** (2 * hits)
    assert response["impact_count"] >= 3
    np.testing.assert_allclose(energy, expected, rtol=1e-12, atol=1e-14)
    assert not release(over * p * (1 - 1e-9))["overturned"] and release(over * p * (1 + 1e-9))["overturned"]


# ---- Both engines, and SciPy ----


def scipy_overturns(spring, alpha, p, e, amplitude, period):
    """Verdict of DOP853 under one sine, by its own events."""
    moment, time, side = MOMENTS[spring], np.arcsin(np.tan(alpha) / amplitude) * period / (2 * np.pi), -1.0
    state = [0.0, 0.0]

    def flow(t, y):
        u = amplitude * np.sin(2 * np.pi * t / period) if t < period else 0.0
        return [y[1], -(p**2) * (moment(y[0], alpha, np) + side * u * np.cos(alpha) * np.cos(y[0]))]

    def ground(t, y):
        return y[0] if t > time else 1.0

    def flat(t, y):
        return np.pi / 2 - y[0]

    ground.terminal = flat.terminal = True
    ground.direction = flat.direction = -1
    for _ in range(40):
        ends = period if time < period else 60.0
        found = solve_ivp(flow, (time, ends), state, "DOP853", rtol=1e-12, atol=1e-15, events=(ground, flat))
        time, state = found.t[-1], [found.y[0, -1], found.y[1, -1]]
        if found.t_events[1].size:
            return True
        if found.t_events[0].size:
            state, side = [0.0, -e * state[1]], -side
            if time > period and state[1] < 0.3 * p * alpha:
                return False
    raise AssertionError("no verdict")


@pytest.mark.slow
@pytest.mark.parametrize("spring", SPRINGS, ids=" ".join)
def test_critical_amplitudes(spring):
    """Every end is one for DOP853, too: it overturns on one side and stands on the other, within 1e-8."""
    alpha, p, e, period = 0.3, 2.0, 0.85, 1.1
    found = rk.critical_amplitudes(
        rk.Block(alpha, p, e), rk.SinePulse(1.0, period), rk.Spring(*spring), intensity=(1.05, 6.0), derivatives=False
    )
    assert found.complete and found.count >= 1 and np.all(found.balanced)
    for value, rising in zip(np.asarray(found.value), np.asarray(found.rising)):
        below, above = (scipy_overturns(spring, alpha, p, e, value * (1 + s * 1e-8), period) for s in (-1, 1))
        assert (below, above) == (not rising, bool(rising))


@pytest.mark.parametrize("spring", [SPRINGS[3], *(slow(spring) for spring in SPRINGS[:3])], ids=" ".join)
def test_diffrax(spring):
    """The diffrax engine finds the same outcomes, safe and overturned."""
    scenes, x = rows("sine", spring)
    block, motion = rk.Block(*x[0, :3]), rk.SinePulse(*x[0, 3:])
    follow = jax.jit(
        lambda factor: rk.outcome(block, factor * motion, rk.Spring(*spring), engine=rk.Diffrax(rtol=1e-10))
    )
    found = follow(1.0)
    assert found.status == rk.Status.successful and not found.overturned
    for name in RESULTS:
        assert float(getattr(found, name)) == pytest.approx(float(scenes[0][name]["value"]), rel=1e-8)
    lost = follow(10.0)
    assert lost.status == rk.Status.successful and lost.overturned and lost.margin < 0


@pytest.mark.parametrize("law, count", [("linear", 2), slow("linear", 6), slow("sine", 3), slow("plastic", 4)])
def test_histories_of_lumped_masses(law, count):
    """SciPy, mass by mass: rotation, velocity and impacts under a sine, from before the uplift to the free rocking."""
    alpha, radius, e, period = 0.2, 2.0, 0.9, 0.8
    u = lambda t: 0.33 * np.sin(2 * np.pi * t / period) if t < period else 0.0
    time = np.linspace(0, 4.0, 200)
    rotation, velocity, impacts = lumped_column.history(alpha, radius, e, law, count, u, [period], time)
    block = rk.Block.from_radius(alpha, radius, e)

    @jax.jit
    def followed(block, pulse):
        spring, engine = rk.Spring("mmSM", law, count), rk.Series(order=8)
        found = rk.simulate(block, pulse, spring, duration=4.0, engine=engine, samples=2)
        return *found(time), found.impact_count, found.impact_times

    found, speed, hits, hit_times = jax.device_get(followed(block, rk.SinePulse(0.33, period)))
    np.testing.assert_allclose(found, rotation, atol=1e-9)
    np.testing.assert_allclose(speed, velocity, atol=1e-8)
    assert len(impacts) >= 2 and hits == len(impacts)
    np.testing.assert_allclose(hit_times[: len(impacts)], impacts, atol=1e-8)


@pytest.mark.slow
def test_kinds_are_one_model():
    """SM1, SM2 and SM3 differ by the law "plastic" alone, and the law "sine" rocks freely as the block itself does."""
    block, motion = rk.Block(0.3, 2.0, 0.9), rk.RickerPulse(0.6, 0.7)
    first, *others = (rk.outcome(block, motion, rk.Spring(kind)) for kind in ("SM1", "SM2", "SM3"))
    for other in others:
        assert jax.tree.all(jax.tree.map(lambda a, b: bool(np.all(a == b)), first, other))
    still = rk.Record([0.0], 0.1)
    for name in RESULTS:
        free = [
            float(getattr(rk.outcome(block, still, model, initial=(0.2, -0.1)), name))
            for model in (rk.Housner(), rk.Spring("SM1", "sine"))
        ]
        assert free[0] == pytest.approx(free[1], rel=1e-15)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_a_turn_that_is_the_balance_to_the_last_digit(kind):
    """The time up to there is long, as the logarithm of the least number is, and finite in single precision, too."""

    @jax.jit
    def out_and_back(alpha, p):
        moments = rk.models.Housner().moments(rk.Block(alpha, p))
        most = moments.manifold(jnp.zeros_like(alpha))
        tiny = most * np.finfo(kind).tiny ** 0.75  # its square is zero
        back = _time_to_impact(moments, tiny, tiny, 2 * tiny, most, most)
        return _time_to_peak(moments, moments.saddle, most, most), back

    out, back = jax.device_get(out_and_back(kind(0.2), kind(1.0)))
    assert out.dtype == back.dtype == kind
    for time in (out, back):
        assert 0.95 < float(time) / -np.log(np.sqrt(np.finfo(kind).tiny)) < 1.05
