"""Closed forms against the papers' (corrected) formulas in 220 digits; the linear engine against the closed forms."""

import functools
import math
import re

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.closed_form import pushover, restitution, sine_pulse, single_lobe
from jaxrock.numerics.divided_differences import exponential_difference, logarithm_ratio
from jaxrock.numerics.roots import bracketed_root

SHORT = {"model": rk.Linear(), "engine": rk.Series(order=6)}  # of histories: compiles in half the time
ALPHA = 0.1  # plays no part in the linear model, whose results are over alpha


def each(function, *values):
    """Evaluate a function element by element: XLA compiles every shape anew, and scalars in the least time."""
    values = np.broadcast_arrays(*(np.asarray(value, float) for value in values))
    shape = values[0].shape
    found = [jax.device_get(function(*map(float, row))) for row in np.stack([x.ravel() for x in values], axis=-1)]
    return jax.tree.map(lambda *x: np.array(x).reshape(shape), *found)


def slopes(function, *values):
    """Derivatives by each argument, element by element."""
    return np.array(each(jax.grad(function, argnums=tuple(range(len(values)))), *values))


# ---- Building blocks ----


@pytest.mark.parametrize("nodes", [(1.0, 1.0), (0.3, -0.3, 0.3, 0.0), (5.0, -5.0, 5.0 + 1e-7, 0.0), (-700.0, 3.0, 2.0),
                                   (1e-9, 0.0, -1e-9), (2.0,) * 5, (-1e17, 0.0, 1.0)])  # fmt: skip
def test_exponential_difference(nodes):
    with mp.workdps(250):
        exact = [mp.mpf(node) + mp.mpf(10) ** -30 * i for i, node in enumerate(nodes)]
        row = [mp.exp(node) for node in exact]
        for width in range(1, len(exact)):
            row = [(row[i + 1] - row[i]) / (exact[i + width] - exact[i]) for i in range(len(row) - 1)]
        assert float(exponential_difference(*nodes)) == pytest.approx(float(row[0]), rel=5e-15)


def test_exponential_difference_has_all_derivatives():
    """At equal nodes the k-th derivative of [x, 0] is 1/(k + 1)."""

    def derived(f):
        """The next derivative, with those before it."""

        def slope_and_values(x):
            slope, (value, before) = jax.grad(f, has_aux=True)(x)
            return slope, (slope, [*before, value])

        return slope_and_values

    f = lambda x: (value := exponential_difference(x, 0.0), (value, []))
    for _ in range(4):
        f = derived(f)
    _, (last, before) = jax.jit(f)(0.0)
    np.testing.assert_allclose([*before, last], [1, 1 / 2, 1 / 3, 1 / 4, 1 / 5], rtol=1e-14)


logarithm_ratio_and_slope = jax.jit(jax.value_and_grad(logarithm_ratio))


@pytest.mark.parametrize("y", [-1e6, -3.0, -0.05, -1e-9, 0.0, 1e-9, 0.0499999, 0.05, 0.9, 1 - 1e-12])
def test_logarithm_ratio(y):
    with mp.workdps(50):
        exact = 1 if y == 0 else -mp.log(1 - mp.mpf(y)) / mp.mpf(y)
        slope = 0.5 if y == 0 else (1 / (1 - mp.mpf(y)) - exact) / mp.mpf(y)
        found = logarithm_ratio_and_slope(y)
        assert float(found[0]) == pytest.approx(float(exact), rel=1e-14)
        assert float(found[1]) == pytest.approx(float(slope), rel=1e-13)


def test_bracketed_root_has_two_derivatives():
    root = lambda a: bracketed_root(lambda x, a: x**3 - a, jnp.array(0.0), jnp.array(10.0), a)
    value, slope, bend = jax.jit(lambda a: (root(a), jax.grad(root)(a), jax.grad(jax.grad(root))(a)))(2.0)
    assert float(value) == pytest.approx(2 ** (1 / 3), rel=1e-15)
    assert float(slope) == pytest.approx(2 ** (-2 / 3) / 3, rel=1e-14)
    assert float(bend) == pytest.approx(-2 * 2 ** (-5 / 3) / 9, rel=1e-13)


# ---- Single-lobe pulse: every shape and duration ----


def printed(what, strength, duration, shape, time=None):
    """Voyagaki et al. (2012) as printed or corrected: equations 3.2, 3.12, 3.15. Cancels; hence the digits."""
    strength, f, b = (mp.mpf(x) for x in (strength, duration, shape))
    tiny = mp.mpf(10) ** -60
    b = tiny if b == 0 else b
    f = f + tiny if f == 2 * abs(b) else f
    if what == "wall":
        power = 2 * b / (f - 2 * b)
        return (1 - (mp.exp(f) * (f + 2 * b) / (2 * f * mp.exp(f / 2 + b) - (f - 2 * b))) ** power) / (1 - mp.exp(b))
    u, k = 1 - strength * (1 - mp.exp(b)), f / (2 * b)
    grows, decays = (f + 2 * b) * u ** (1 - k), (f - 2 * b) * u ** (1 + k)

    def rotation(t):
        total = b * (grows * mp.exp(f * t) - decays * mp.exp(-f * t)) + f**2 - 4 * b**2 - f**2 * mp.exp(2 * b * t)
        if t >= 0.5:
            total += f**2 * (mp.exp(2 * b * t) - mp.exp(2 * b * (1 - t)))
            total -= 4 * b * f * mp.exp(b) * mp.sinh(f * (t - 0.5))
        if t >= 1:
            total += f**2 * mp.exp(2 * b * (1 - t)) - (f**2 - 4 * b**2)
            total += b * ((f - 2 * b) * mp.exp(f * (t - 1)) - (f + 2 * b) * mp.exp(-f * (t - 1)))
        return 1 - total / (strength * (1 - mp.exp(b)) * (f**2 - 4 * b**2))

    def slope(t):  # 3.15a
        return (
            grows * mp.exp(f * t) + decays * mp.exp(-f * t)
            + 2 * f * mp.exp(2 * b * (1 - t)) - 4 * f * mp.exp(b) * mp.cosh(f * (t - 0.5))
        )  # fmt: skip

    if what == "rotation":
        return rotation(mp.mpf(time))
    if mp.sign(slope(mp.mpf(1))) != mp.sign(slope(mp.mpf(1) / 2)):
        peak = mp.findroot(slope, (mp.mpf(1) / 2, mp.mpf(1)), solver="anderson", tol=mp.mpf(10) ** -120, maxsteps=400)
    else:
        up = (f + 2 * b) * mp.exp(f) - 2 * f * mp.exp(f / 2 + b) + (f - 2 * b) * u ** (1 + k)
        down = 2 * f * mp.exp(b - f / 2) - (f - 2 * b) * mp.exp(-f) - (f + 2 * b) * u ** (1 - k)
        peak = mp.log(up / down) / (2 * f)
    return peak if what == "peak_time" else rotation(peak)


def drawn_lobes():
    """Random durations 0.05 to 20; shapes 0, duration = +-2 shape, any up to 100; a part of the way from wall to 1."""
    rng = np.random.default_rng(3)
    for i in range(24):
        duration = 10 ** rng.uniform(-1.3, 1.3)
        shape = [0.0, duration / 2, -duration / 2, rng.uniform(-100, 100)][i % 4]
        yield rng.uniform(0.02, 0.98), duration, shape


PARTS, DURATIONS, SHAPES = np.array(list(drawn_lobes())).T
over_lobes = pytest.mark.parametrize("i", range(24), ids=[f"{d:.3g}, {b:.3g}" for d, b in zip(DURATIONS, SHAPES)])


@functools.cache
def lobes():
    """Safety walls of the lobes, and strengths above them."""
    walls = each(single_lobe.safety_wall, DURATIONS, SHAPES)
    return walls, walls + (1 - walls) * PARTS


@functools.cache
def of_lobes(name, *time):
    return each(getattr(single_lobe, name), *time, lobes()[1], DURATIONS, SHAPES)


@over_lobes
def test_single_lobe_in_220_digits(i):
    (wall, strength), duration, shape = (x[i] for x in lobes()), DURATIONS[i], SHAPES[i]
    with mp.workdps(220):
        assert wall == pytest.approx(float(printed("wall", 0.5, duration, shape)), rel=1e-13)
        for name in ("peak_time", "peak_rotation"):
            assert of_lobes(name)[i] == pytest.approx(float(printed(name, strength, duration, shape)), rel=1e-13)
        for time in (0.5, 0.75, 1.0, 1.2):
            exact, found = float(printed("rotation", strength, duration, shape, time)), of_lobes("rotation", time)[i]
            assert np.isnan(found) if exact < 0 else found == pytest.approx(exact, rel=1e-12, abs=1e-300)


@functools.cache
def of_pulses(name):
    """Return, for every lobe, times of uplift at three strengths, or a wall."""
    if name == "uplift_time":
        return each(single_lobe.uplift_time, [0.03, 0.5, 0.97], SHAPES[:, None])
    return each(getattr(single_lobe, name), DURATIONS, SHAPES)


@over_lobes
def test_walls_of_the_pulse_in_220_digits(i):
    """V 2.4: at uplift the pulse is at the threshold; 3.8: at a wall the block is at alpha at the peak, or the end."""
    duration, shape = DURATIONS[i], SHAPES[i]
    for strength, uplift in zip((0.03, 0.5, 0.97), of_pulses("uplift_time")[i]):
        exact = mp.log(1 - strength * (1 - mp.exp(shape))) / (2 * shape) if shape else strength / 2
        assert uplift == pytest.approx(float(exact), rel=1e-12)
    with mp.workdps(220):
        for name, time in (("rising_wall", 0.5), ("falling_wall", 1.0)):
            found = float(of_pulses(name)[i])
            below, above = (printed("rotation", found * (1 + s), duration, shape, time) for s in (-1e-11, 1e-11))
            assert above < 1 < below


@pytest.mark.parametrize(("duration", "shape"), [(2.0, 18.0), (2.0, 40.0), (2.0, 100.0), (60.0, 200.0)])
@pytest.mark.parametrize(("name", "time"), [("rising_wall", 0.5), ("falling_wall", 1.0)])
def test_walls_of_spikes(name, time, duration, shape):
    """Where e^-shape is lost beside 1: in double, and in single precision."""
    function = getattr(single_lobe, name)
    found, slope = map(float, jax.value_and_grad(function, 1)(duration, shape))
    in_single = function(np.float32(duration), np.float32(shape))
    assert in_single.dtype == np.float32
    with mp.workdps(400):
        below, above = (printed("rotation", found * (1 + s), duration, shape, time) for s in (-1e-11, 1e-11))
        assert above < 1 < below
    assert float(in_single) == pytest.approx(found, rel=1e-5)
    assert slope < 0


# A minute is compiled for both. The time of the peak has the derivatives that its rotation is made of.
PEAKS = ["peak_time", pytest.param("peak_rotation", marks=pytest.mark.slow)]


@functools.cache
def slopes_of_lobes(name):
    values = (DURATIONS, SHAPES) if name == "safety_wall" else (lobes()[1], DURATIONS, SHAPES)
    return slopes(getattr(single_lobe, name), *values)


@over_lobes
@pytest.mark.parametrize("name", ["safety_wall", *PEAKS])
def test_single_lobe_gradients(name, i):
    wall = name == "safety_wall"
    values = (DURATIONS[i], SHAPES[i]) if wall else (lobes()[1][i], DURATIONS[i], SHAPES[i])
    step = mp.mpf(10) ** -20
    with mp.workdps(220):
        exact = []
        for k in range(len(values)):
            ends = []
            for side in (1, -1):
                moved = [mp.mpf(v) for v in values]
                moved[k] += side * step
                ends.append(printed("wall", 0.5, *moved) if wall else printed(name, *moved))
            exact.append(float((ends[0] - ends[1]) / (2 * step)))
        found = slopes_of_lobes(name)[:, i]
        np.testing.assert_allclose(found, exact, rtol=1e-9, atol=1e-11 * np.max(np.abs(exact)))


@pytest.mark.parametrize("duration", [0.05, 1.0, 2.0, 7.0, 20.0, 300.0])
def test_single_lobe_limits(duration):
    """Rectangle, triangle, spike; V 3.9, 3.10 corrected, 3.13, 3.14, and the border between S1 and S2."""
    approx = functools.partial(pytest.approx, rel=1e-12)
    f, half = duration, duration / 2
    # Shapes: rectangle, triangle, spike.
    wall, falling, rising = (
        each(function, f, [-np.inf, 0.0, np.inf])
        for function in (single_lobe.safety_wall, single_lobe.falling_wall, single_lobe.rising_wall)
    )
    assert wall[0] == approx(-np.expm1(-f))
    assert wall[1] == approx(2 - 2 / f * (half + np.log(2 - np.exp(-half))))
    assert wall[2] < 1e-14 * f
    if f <= 20:
        assert falling[0] == approx(1 - 1 / np.cosh(f))
        assert rising[0] == approx(1 - 1 / np.cosh(half))
        assert falling[1] == pytest.approx(2 - 2 / f * np.arcsinh(2 * np.sinh(half)), rel=1e-11)
        assert rising[1] == pytest.approx(
            float(1 + mp.log(1 + mp.mpf(half) * (f - mp.sqrt(mp.mpf(f) ** 2 + 4))) / f), rel=1e-11
        )
        border = 2 - 2 / f * np.arccosh(2 * np.cosh(half) - 1)
        assert each(single_lobe.peak_border, f, 0.0) == pytest.approx(border, rel=1e-11)
    limits, large = (each(single_lobe.peak_rotation, 0.9999, 0.3, x) for x in ([-np.inf, np.inf], [-1e15, 1e15]))
    np.testing.assert_allclose(limits, large, rtol=0, atol=1e-13)


def test_single_lobe_against_the_papers_numbers(references):
    cases = references["linear_exponential"]
    number = lambda name, of: np.array([float(x[name]) for x in of])
    shape, duration, wall = (number(name, cases) for name in ("shape", "pulse_duration", "wall"))
    np.testing.assert_allclose(each(single_lobe.safety_wall, duration, shape), wall, rtol=1e-14)
    strength, peak, peak_time = (
        np.array([number(name, case["points"]) for case in cases]) for name in ("uplift_strength", "peak", "peak_time")
    )
    # Decimal strengths near 1 lose digits of 1 - strength; near the wall the peak time runs away.
    rel = 1e-12 * (1 + 1e-3 / (1 - strength) + 1e-3 / (strength / wall[:, None] - 1))
    for function, exact in ((single_lobe.peak_rotation, peak), (single_lobe.peak_time, peak_time)):
        found = each(function, strength, duration[:, None], shape[:, None])
        assert np.max(np.abs(found / exact - 1) / rel) < 1


def test_single_lobe_inverses():
    strength, shape = np.meshgrid(np.linspace(0.02, 0.98, 13), np.array([-np.inf, -30, -1, 0.0, 2, 40]))
    duration = each(single_lobe.critical_duration, strength, shape)
    np.testing.assert_allclose(each(single_lobe.safety_wall, duration, shape), strength, rtol=1e-12)
    found = each(single_lobe.critical_shape, strength[1:], duration[1:])
    np.testing.assert_allclose(each(single_lobe.safety_wall, duration[1:], found), strength[1:], rtol=1e-12)
    assert each(single_lobe.critical_shape, 0.9, 1.0) == -np.inf  # not even a rectangle
    assert each(single_lobe.critical_duration, 1.2, 0.0) == np.inf


def test_long_critical_durations():
    """Compare critical durations of blocks that hardly uplift with log 2 times the peak's slope over 1 - strength."""
    missing, shape = np.array([3e-2, 5e-4, 1e-8])[:, None], np.array([-5.0, -0.5, 0.0, 2, 40, 1e5])
    duration = each(single_lobe.critical_duration, 1 - missing, shape)
    np.testing.assert_allclose(each(single_lobe.safety_wall, duration, shape), 1 - missing + 0 * shape, rtol=1e-14)
    slope = 2 * np.where(shape == 0, 1, shape / -np.expm1(np.where(shape == 0, 1, -shape)))
    np.testing.assert_allclose(duration[-1] * missing[-1], np.log(2) * slope, rtol=1e-5)


def test_single_lobe_safe_arguments():
    assert each(single_lobe.peak_rotation, 1.0, 2.0, 0.0) == 0.0
    assert each(single_lobe.peak_rotation, 0.1, 2.0, 0.0) == np.inf
    assert float(single_lobe.uplift_time(1.5, 1.0)) == np.inf
    with pytest.raises(ValueError, match="Argument `pulse_duration` must be positive"):
        single_lobe.safety_wall(-1.0, 0.0)
    with pytest.raises(ValueError, match="Argument `shape` must be a number"):
        single_lobe.safety_wall(1.0, np.nan)


@pytest.mark.parametrize("name", PEAKS)
def test_single_lobe_safe_gradients(name):
    strength, shape = np.transpose([(0.1, 0.0), (0.5, 1.0), (0.9, -np.inf), (1.0, 5.0), (1.5, np.inf)])
    assert np.isfinite(slopes(getattr(single_lobe, name), strength, 2.0, shape)[0]).all()


@jax.jit
@functools.partial(jax.vmap, in_axes=(0, 0, 0, None))
def engine_lobe(strength, duration, shape, e):
    pulse = rk.ExponentialPulse(-ALPHA / strength, duration, shape)  # Voyagaki's sign of the motion
    return rk.outcome(rk.Block(ALPHA, 1.0, e), pulse, rk.Linear())


@pytest.mark.slow
def test_engine_agrees_with_the_single_lobe():
    """10,000 random points in each region of safety, and verdicts in each region of overturning."""
    rng = np.random.default_rng(0)
    n, compared = 40_000, {}
    duration, shape = 0.05 * 400 ** rng.uniform(0, 1, n), rng.uniform(-1, 1, n) * 10 ** rng.uniform(-3, 2, n)
    wall = np.asarray(single_lobe.safety_wall(duration, shape))
    strength = np.where(np.arange(n) % 4, wall + (1 - wall) * rng.uniform(0, 1, n) ** 2, wall * rng.uniform(0, 1, n))
    region = np.asarray(single_lobe.region(strength, duration, shape))
    found = engine_lobe(strength, duration, shape, 0.9)
    decided = np.asarray(found.status == rk.Status.successful)
    assert np.mean(decided) > 0.999
    np.testing.assert_array_equal(np.asarray(found.overturned)[decided], (strength < wall)[decided])
    for kind in (single_lobe.Region.peaks_after, single_lobe.Region.peaks_during):
        here = decided & (region == kind)
        exact = np.asarray(single_lobe.peak_rotation(strength, duration, shape))[here]
        off = np.abs(np.asarray(found.max_rotation)[here] / ALPHA - exact)
        # What a rounded strength does, by the closed form's own derivative.
        slope = np.asarray(jax.vmap(jax.grad(single_lobe.peak_rotation))(strength[here], duration[here], shape[here]))
        compared[kind] = here.sum(), np.max(off / (exact + 1e-2 * np.abs(slope) * strength[here]))
    assert all(count > 8000 for count, _ in compared.values())
    assert all(worst < 1e-12 for _, worst in compared.values()), compared


def test_histories_agree_with_the_single_lobe():
    for strength, duration, shape in [(0.5, 2.0, 3.0), (0.8, 1.0, -2.0), (0.7, 0.5, 0.0), (0.97, 3.0, -np.inf)]:
        pulse = rk.ExponentialPulse(-ALPHA / strength, duration, shape)
        response = rk.simulate(rk.Block(ALPHA, 1.0, 0.9), pulse, duration=3 * duration, samples=2, **SHORT)
        time = np.linspace(0, 3, 61)
        angle, speed = (np.asarray(x) for x in response(time * duration))
        exact = each(single_lobe.rotation, time, strength, duration, shape)
        returned = np.isnan(exact)
        impacts = np.asarray(response.impact_times)
        first = impacts[0] / duration if len(impacts) else np.inf
        np.testing.assert_array_equal(returned, time > first)
        np.testing.assert_allclose(angle[~returned] / ALPHA, exact[~returned], atol=1e-13)
        exact = each(single_lobe.velocity, time, strength, duration, shape)
        np.testing.assert_allclose(speed[~returned] / ALPHA, exact[~returned], atol=1e-13)


# ---- Sine pulse ----


@functools.cache
def intervals(ratio, e):
    """Return intervals by fewer samples than usual; the sampling takes longer than all else here."""
    return sine_pulse.overturning_intervals(ratio, e, points=128)


def test_limits_during_the_pulse_are_ends_of_intervals(references):
    """Check that limits during the pulse are ends of intervals; six of those in 200 bits have no limit."""
    cases = references["linear_sine_intervals"]
    ratio, e = (np.array([float(case[name]) for case in cases]) for name in ("frequency_ratio", "restitution"))
    limits = np.asarray(sine_pulse.during_pulse_limit(ratio, e))
    assert np.sum(np.isfinite(limits)) == len(cases) - 6
    for limit, case in zip(limits, cases):
        ends = np.array([float(lower) for lower, _ in case["ends"]])
        assert np.isinf(limit) or np.min(np.abs(ends / limit - 1)) < 1e-13


def test_sine_intervals_against_the_papers_numbers(references):
    for case in references["linear_sine_intervals"][::14]:  # the others: the test of the engine's intervals
        ratio, e = float(case["frequency_ratio"]), float(case["restitution"])
        found = intervals(ratio, e)
        lower, upper = np.array([[float(x) if x else np.inf for x in ends] for ends in case["ends"]]).T
        np.testing.assert_allclose(found.lower, lower, rtol=1e-13)
        np.testing.assert_allclose(found.upper, upper, rtol=1e-13)


@jax.jit
@functools.partial(jax.vmap, in_axes=(0, 0, 0))
def engine_sine(intensity, ratio, e):
    return rk.outcome(rk.Block(ALPHA, 1.0, e), rk.SinePulse(ALPHA * intensity, 2 * jnp.pi / ratio), rk.Linear())


QUICK = {(0.5, 0.9), (1.05, 0.95), (4.2, 0.9), (5.3, 1.0)}


@pytest.mark.parametrize("ratio, e", [
    pytest.param(ratio, e, marks=() if (ratio, e) in QUICK else pytest.mark.slow)
    for ratio in (0.25, 0.35, 0.5, 0.7, 0.85, 1.0, 1.05, 1.5, 2.5, 4.2, 5.3, 8.0) for e in (0.8, 0.9, 0.95, 1.0)
])  # fmt: skip
def test_engine_finds_every_interval(ratio, e):
    """Both sides of every end at 1e-10, and no other verdict in between."""
    if e == 1:  # without loss near intensity 1 there are endless hops
        found = sine_pulse.overturning_intervals(ratio, e, searched_from=1.02)
    else:
        found = intervals(ratio, e) if (ratio, e) in QUICK else sine_pulse.overturning_intervals(ratio, e)
    ends = np.concatenate([found.lower, found.upper[:-1]])
    ends = ends[ends > found.searched_from]  # the search may start inside an island
    between = np.linspace(found.searched_from, 1.05 * found.lower[-1], 2048 - 2 * len(ends))
    intensity = np.concatenate([ends * (1 - 1e-10), ends * (1 + 1e-10), between])
    # Without loss the safe gap below the last interval closes: there two intervals touch.
    expected = ((intensity[:, None] >= found.lower) & (intensity[:, None] <= found.upper)).any(axis=1)
    engine = engine_sine(intensity, np.full(2048, ratio), np.full(2048, e))
    decided = np.asarray(engine.status == rk.Status.successful)
    assert np.mean(decided) > 0.99
    np.testing.assert_array_equal(np.asarray(engine.overturned)[decided], expected[decided])
    assert len(ends) < 2 or e == 1 or not np.all(expected[: 2 * len(ends)])


def test_islands():
    """Find islands that the paper's four curves miss: overturning after 3, 5, 7... impacts at low frequency."""
    np.testing.assert_array_equal(intervals(0.5, 0.8).impacts, [5, 3, 1, 0])
    np.testing.assert_array_equal(intervals(3.0, 0.9).impacts, [1, 0])


@pytest.mark.parametrize("begin", [1.7, 2.5, 3.5, 5.0])  # below and above the limits 2.376, 3.485 and 3.631
def test_a_search_finds_what_lies_above_its_beginning(begin):
    found, whole = sine_pulse.overturning_intervals(3.0, 0.9, searched_from=begin, points=64), intervals(3.0, 0.9)
    above = whole.upper > begin
    np.testing.assert_allclose(found.lower, np.maximum(whole.lower, begin)[above], rtol=1e-13)
    np.testing.assert_allclose(found.upper, whole.upper[above], rtol=1e-13)
    np.testing.assert_array_equal(found.impacts, whole.impacts[above])


@pytest.mark.parametrize("ratio", [1e-3, 0.01, 0.0142])
def test_intervals_of_long_pulses_are_in_order(ratio):
    found = intervals(ratio, 0.9)
    assert found.lower[0] >= found.searched_from and np.all(found.lower < found.upper) and found.upper[-1] == np.inf


@pytest.mark.slow
def test_many_islands():
    np.testing.assert_array_equal(sine_pulse.overturning_intervals(0.25, 0.95).impacts, [*range(35, 0, -2), 0])


def test_engine_agrees_with_the_sine_pulse():
    """Peaks of 10,000 random blocks whose first impact comes after the pulse; verdicts of all."""
    rng = np.random.default_rng(1)
    n = 8 * 2048
    ratio, e = rng.uniform(1.0, 10, n), rng.uniform(0.5, 1, n)
    first, last = np.asarray(sine_pulse.impact_time_limit(ratio)), np.asarray(sine_pulse.no_impact_limit(ratio))
    intensity = first + (last * 1.05 - first) * rng.uniform(0, 1, n)
    parts = [engine_sine(*part) for part in zip(*(np.split(x, 8) for x in (intensity, ratio, e)))]  # compiled above
    found = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    assert np.all(found.status == rk.Status.successful)
    (before, after), slopes = jax.device_get(
        jax.jvp(
            lambda a: (sine_pulse.first_peak(a, ratio), sine_pulse.peak_after_pulse(a, ratio, e)),
            (intensity,), (np.ones(n),),
        )
    )  # fmt: skip
    peak, slope = np.maximum(before, after), np.where(before > after, *slopes)
    lower, upper = (np.asarray(x) for x in sine_pulse.after_pulse_limits(ratio, e))
    lost = ((intensity > lower) & (intensity < upper)) | (intensity > last)
    np.testing.assert_array_equal(found.overturned, lost)
    safe = ~lost
    assert safe.sum() > 10_000
    off = np.abs(found.max_rotation[safe] / ALPHA - peak[safe])
    assert np.max(off / (peak[safe] + 1e-2 * np.abs(slope[safe]) * intensity[safe])) < 1e-12


@pytest.mark.parametrize("ratio", [0.02, 0.5, 3.0, 50.0])
def test_sine_limits_in_50_digits(ratio):
    with mp.workdps(60):
        w = mp.mpf(ratio)
        end = lambda a: (2 * mp.pi - mp.asin(1 / a)) / w
        lost = lambda a: mp.sqrt(a**2 - 1) - a * mp.exp(-end(a)) - w
        limit = lambda a: (w**2 - w * mp.sqrt(a**2 - 1)) * mp.exp(end(a)) - 1 - w**2 - mp.sqrt(1 + (a**2 + 1) * w**2)
        for function, residual in ((sine_pulse.no_impact_limit, lost), (sine_pulse.impact_time_limit, limit)):
            found = mp.mpf(float(each(function, ratio)))
            sides = [residual(found * (1 + s * mp.mpf(10) ** -14)) for s in (-1, 1)]
            assert sides[0] * sides[1] < 0


def test_sine_constants_and_approximations():
    """D0* by both of its forms (the second corrected); the scale law where it holds; D&D's range of equation 3.30."""
    a, w = np.meshgrid(np.linspace(1.05, 6, 9), np.array([0.5, 2.0, 7.0, 20.0]))
    c = each(sine_pulse.constants, a, w)
    root = np.sqrt(a**2 - 1)
    second = w**2 - 2 * a**2 + 1 + (root + w) * a * np.exp(-c.end) + (root - w) * a * np.exp(c.end)
    size = np.abs((root - w) * a * np.exp(c.end)) + w**2 + 2 * a**2 + 1
    np.testing.assert_allclose(c.D0 * ((w**2 + 1) / w) ** 2 / size, second / size, atol=1e-13)
    exact, law = (each(f, 3.0, 100.0, 0.9) for f in (sine_pulse.peak_after_pulse, sine_pulse.restitution_scale_law))
    assert law / exact == pytest.approx(0.99924, abs=1e-5)
    ratio, e = np.meshgrid(np.linspace(2.55, 3.95, 8), np.array([0.8, 0.9, 0.96]))
    approximate, exact = (
        each(f, ratio, e) for f in (sine_pulse.approximate_during_pulse_limit, sine_pulse.during_pulse_limit)
    )
    assert np.max(np.abs(approximate / exact - 1)) < 0.01
    limits = each(sine_pulse.during_pulse_limit, 5.1, [0.95, 0.8])
    assert limits[0] < each(sine_pulse.impact_time_limit, 5.1)  # printed: none
    assert limits[1] == np.inf
    lost = each(sine_pulse.no_impact_limit, 2.0) + np.array([-1e-9, 1e-9])
    for function in (sine_pulse.peak_after_pulse, sine_pulse.restitution_scale_law):  # whatever D0* is there
        assert np.isinf(each(function, lost, 2.0, 0.8)).tolist() == [False, True]


def test_sine_impact_times():
    for a, w in [(1.05, 0.5), (1.5, 3.0), (2.5, 3.0), (3.6, 3.0)]:
        pulse = rk.SinePulse(ALPHA * a, 2 * np.pi / w)
        response = rk.simulate(rk.Block(ALPHA, 1.0, 0.7), pulse, duration=25.0, samples=2, **SHORT)
        uplift = np.arcsin(1 / a) / w
        found = each(sine_pulse.impact_time, a, w)
        assert found == pytest.approx(np.asarray(response.impact_times)[0] - uplift, rel=1e-12)
    assert each(sine_pulse.impact_time, 10.0, 3.0) == np.inf


DIFFERENCES = np.array([-2.0, -1.0, -0.5, 0.5, 1.0, 2.0])


def upper_after_pulse_limit(w, e):
    return sine_pulse.after_pulse_limits(w, e)[1]


@pytest.mark.parametrize("function, values", [
    (sine_pulse.no_impact_limit, (2.0,)), (sine_pulse.impact_time_limit, (0.4,)),
    (sine_pulse.during_pulse_limit, (2.0, 0.9)), (sine_pulse.impact_time, (1.5, 2.0)),
    (sine_pulse.impact_time, (2.2, 2.0)), (sine_pulse.first_peak, (1.5, 2.0)),
    (sine_pulse.peak_after_pulse, (2.0, 2.0, 0.5)), (upper_after_pulse_limit, (3.0, 0.9)),
])  # fmt: skip
def test_sine_gradients(function, values):
    for i, slope in enumerate(slopes(function, *values)):
        # Fourth-order differences with Richardson's extrapolation: 1e-9.
        moved = np.array(values)[:, None] + 1e-3 * DIFFERENCES * np.eye(len(values))[i][:, None]
        ends = dict(zip(DIFFERENCES, each(function, *moved)))
        coarse, fine = ((8 * (ends[h] - ends[-h]) - (ends[2 * h] - ends[-2 * h])) / (12 * h * 1e-3) for h in (1.0, 0.5))
        assert float(slope) == pytest.approx((16 * fine - coarse) / 15, rel=1e-8)


# ---- Without motion ----


def test_pushover_and_restitution():
    alpha, block = 0.3, rk.Block(0.3, 2.0)
    assert float(restitution.housner(alpha)) == pytest.approx(float(block.restitution), rel=1e-15)
    assert float(restitution.housner(alpha, 1.5)) == pytest.approx(1 - 2 * np.sin(0.3) ** 2 / 1.5)
    assert float(pushover.force(0.0, alpha)) == pytest.approx(float(rk.Housner().moments(block).threshold))
    assert float(pushover.energy(1e-9, alpha)) == pytest.approx(1e-9 * np.sin(0.3), rel=1e-8)
    quiet, engine = rk.RectangularPulse(0.0, 1.0), SHORT["engine"]
    blow = lambda velocity: rk.outcome(block, quiet, initial=(0.0, velocity), engine=engine).overturned
    velocity = float(2.0 * pushover.toppling_velocity(alpha))
    assert bool(blow(velocity * (1 + 1e-12))) and not bool(blow(velocity * (1 - 1e-12)))


def test_pushover_has_ranges():
    for ask in (pushover.spring_force, pushover.overturning_moment_ratio):
        for rotation in (1.6, -0.1):
            with pytest.raises(ValueError, match=r"Argument `rotation` must be in \[0, pi/2\), but is"):
                ask(rotation, 0.2)
    with pytest.raises(ValueError, match="Argument `inertia` must be finite, and at least 1, but is 0.75"):
        restitution.housner(0.3, 0.75)  # its inverse, the `inertia_ratio` of a block
    for ask in (pushover.force, pushover.energy):  # a force beyond would have the wrong sign, and a work too
        for rotation in (1.6, -0.1):
            with pytest.raises(ValueError, match=r"Argument `rotation` must be in \[0, pi/2\], but is"):
                ask(rotation, 0.2)
    assert float(pushover.force(np.pi / 2, 0.2)) == pytest.approx(-1 / np.tan(0.2))
    with pytest.raises(ValueError, match="Argument `impacts` must be 0 or more"):
        pushover.amplitude_after(-5, 0.9, 0.5)


def test_no_impact_costs_nothing():
    """Check the amplitude without impacts: it does not depend on the restitution, even at a restitution of zero."""
    value, slope = jax.value_and_grad(lambda e: pushover.amplitude_after(0, 0.5, e))(0.0)
    assert (float(value), float(slope)) == (pytest.approx(0.5, rel=1e-15), 0.0)


@pytest.mark.parametrize("impacts, restitution", [(0, 0.9), (3, 1.0), (1, 1 - 1e-12), (2, 0.9)])
@pytest.mark.parametrize("short", [0.5, 1e-6, 2.0**-40])
def test_amplitudes_near_balance(impacts, restitution, short):
    """How far from balance a block stays, and its slope, to 50 digits."""
    with mp.workdps(50):
        left = lambda a: 1 - mp.sqrt(1 - mp.mpf(restitution) ** (2 * impacts) * a * (2 - a))
        value, slope = left(mp.mpf(1) - short), mp.diff(left, mp.mpf(1) - short, h=mp.mpf(10) ** -25)
        distance = float(1 - value)
    found, change = jax.value_and_grad(pushover.amplitude_after, argnums=1)(float(impacts), 1 - short, restitution)
    assert 1 - float(found) == pytest.approx(distance, rel=1e-9, abs=2.3e-16)
    assert float(change) == pytest.approx(float(slope), rel=1e-4 if 0 < 1 - restitution < 1e-9 else 1e-12)


def test_free_rocking():
    """Housner's period and decay against a history."""
    block, quiet = rk.Block(ALPHA, 2.0, 0.9), rk.SinePulse(0.0, 1.0)
    response = rk.simulate(block, quiet, initial=(0.5 * ALPHA, 0.0), duration=4.0, samples=2, **SHORT)
    impacts = np.asarray(response.impact_times)
    assert impacts[0] == pytest.approx(float(pushover.period(0.5)) / 8, rel=1e-12)
    amplitudes = np.asarray(pushover.amplitude_after(np.arange(1, len(impacts)), 0.5, 0.9))
    np.testing.assert_allclose(np.diff(impacts) * 2.0, 0.5 * pushover.period(amplitudes), rtol=1e-9)


@jax.jit
def slopes_by_time(*values):
    """Return derivatives by time of rotation and velocity under a single lobe."""
    return [jax.grad(function)(*values) for function in (single_lobe.rotation, single_lobe.velocity)]


@pytest.mark.parametrize("shape", [0.7, 0.0, -3.0])
@pytest.mark.parametrize("time", [0.5, 1.0])
def test_slopes_by_time_where_the_branches_of_a_pulse_meet(time, shape):
    """The rotation's is the velocity, the velocity's what differences say from before."""
    given = 0.4, 1.5, shape
    of_rotation, of_velocity = slopes_by_time(time, *given)
    before = [each(single_lobe.velocity, time - x, *given) for x in (0.0, 1e-6, 2e-6)]
    assert float(of_rotation) == pytest.approx(1.5 * before[0], rel=1e-12)
    assert float(of_velocity) == pytest.approx((3 * before[0] - 4 * before[1] + before[2]) / 2e-6, rel=1e-6)


def test_slopes_by_time_at_an_impact_are_those_before_it():
    given = 1.2, 5.0, 0.9
    time = float(each(sine_pulse.impact_time, *given[:2]))
    before, of_velocity = each(jax.value_and_grad(sine_pulse.velocity), time - np.array([0.0, 1e-6, 2e-6]), *given)
    assert float(jax.grad(sine_pulse.rotation)(time, *given)) == pytest.approx(before[0], rel=1e-12)
    assert of_velocity[0] == pytest.approx((3 * before[0] - 4 * before[1] + before[2]) / 2e-6, rel=1e-6)


def test_a_triangle_has_the_slope_by_shape_of_its_neighbours():
    slopes = [each(jax.grad(single_lobe.pulse, 1), 0.3, shape) for shape in (-1e-7, 0.0, 1e-7)]
    np.testing.assert_allclose(slopes, -0.12, rtol=1e-6)


def test_arrays_of_any_shape_are_of_a_few_programs():
    """Each of their elements is that of the array of all; a new length, for which there is room, compiles nothing."""
    strengths, uplift = np.linspace(0.1, 0.9, 32), single_lobe.uplift_time
    of_all, of_eight = (np.asarray(uplift(strengths[:count], shape=0.7)) for count in (32, 8))
    np.testing.assert_allclose(of_eight, of_all[:8], rtol=1e-15)
    programs = []
    listen = lambda name, *_, **__: programs.append(name)
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        for shape in ((1,), (3,), (2, 4), (31,), (4, 1, 5)):
            count = math.prod(shape)
            found = uplift(strengths[:count].reshape(shape), shape=np.full(shape[-1:], 0.7))
            assert found.shape == shape and isinstance(found, jax.Array)
            np.testing.assert_array_equal(np.asarray(found).ravel(), (of_eight if count <= 8 else of_all)[:count])
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert not [name for name in programs if name.endswith("backend_compile_duration")]
    longer = np.asarray(uplift(np.linspace(0.1, 0.9, 5001), shape=0.7))  # room for a few more
    assert longer.shape == (5001,)
    assert longer[[0, -1]] == pytest.approx(of_all[[0, -1]], rel=1e-15)
    assert uplift(np.zeros((0, 3)), shape=0.7).shape == (0, 3)
    here = jax.device_put(strengths[:5], jax.devices("cpu")[1])  # stays where its user has put it
    assert uplift(here, shape=0.7).devices() == {jax.devices("cpu")[1]}


@pytest.mark.parametrize("function, values", [
    (sine_pulse.no_impact_limit, (2.0,)), (sine_pulse.impact_time, (2.0, 0.5)),
    (sine_pulse.during_pulse_limit, (2.0, 0.9)), (sine_pulse.rotation, (0.5, 2.0, 0.5, 0.9)),
    (single_lobe.safety_wall, (1.0, 0.5)), (single_lobe.uplift_time, (0.3, 0.5)),
], ids=lambda x: getattr(x, "__name__", str(x)))  # fmt: skip
def test_nothing_is_left_to_xla(function, values):
    """All of an element is machine code, where llvmlite is; an operation it does not know would take all before it."""
    pytest.importorskip("llvmlite")
    text = jax.jit(jax.value_and_grad(function)).lower(*values).as_text()
    assert "stablehlo.custom_call" in text
    assert not re.findall(r"stablehlo\.(?:while|exponential|log|sine|cosine|power|atan)\w*", text)
