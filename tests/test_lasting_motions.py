"""Motions that last: harmonic shaking of many cycles, and sums of many motions, beside NumPy and SciPy."""

import functools
import math
import operator

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxrock as rk
from jaxrock._arguments.parameters import leaves_of, with_values
from jaxrock.motions.merged_parts import MergedParts

RNG = np.random.default_rng(7)
ALPHA, P, RESTITUTION = 0.2, 2.0, 0.85
THRESHOLD = math.tan(ALPHA)
BLOCK = rk.Block(ALPHA, P, RESTITUTION)

HARMONIC = {  # amplitude [g], period [s], cycles, phase [rad]
    "whole cycles": (0.3, 0.5, 7.0, 0.0),
    "a part of a cycle": (-0.4, 0.8, 0.3, 0.4),
    "a cosine": (0.25, 0.7, 4.5, math.pi / 2),
    "very many": (0.3, 0.1, 5000.0, -1.0),
}


@pytest.mark.parametrize("name", HARMONIC)
def test_harmonic_motion_is_a_sinusoid(name):
    amplitude, period, cycles, phase = HARMONIC[name]
    end = cycles * period
    time = np.linspace(0.0, 1.1 * end, 997)
    expected = np.where(time < end, amplitude * np.sin(2 * np.pi * time / period + phase), 0.0)
    found = rk.HarmonicMotion(amplitude, period, cycles, phase).acceleration(time)
    np.testing.assert_allclose(found, expected, atol=4e-16 * abs(amplitude) * (4 + 2 * np.pi * cycles))


def test_one_cycle_is_a_sine_pulse():
    one, pulse = rk.HarmonicMotion(0.4, 0.6, 1), rk.SinePulse(0.4, 0.6)
    for name in ("max_rotation", "max_velocity", "margin"):
        found, expected = (getattr(rk.outcome(BLOCK, motion), name) for motion in (one, pulse))
        np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_cycles_cost_no_memory():
    assert rk.HarmonicMotion(0.3, 0.5, 1e5).knots.size == 2


# ------------------------------------------------------------------------------------------ judged by SciPy


def lifted_by_scipy(shakes, time, end):
    """Time at which a block at rest lifts, and its side; (end, 0) where it does not."""
    fine = np.linspace(time, end, 400)
    above = np.flatnonzero(np.abs([shakes(t) for t in fine]) > THRESHOLD)
    if above.size == 0:
        return end, 0.0
    low, high = fine[max(above[0] - 1, 0)], fine[above[0]]
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (low, middle) if abs(shakes(middle)) > THRESHOLD else (middle, high)
    return high, -float(np.sign(shakes(high)))


def arc_by_scipy(shakes, time, end, state, side):
    """Housner's block up to `end` or an impact: -p^2 [sin(s alpha - theta) + u cos(s alpha - theta)], on side s."""

    def flow(t, y):
        angle = side * ALPHA - y[0]
        return [y[1], -(P**2) * (math.sin(angle) + shakes(t) * math.cos(angle))]

    def landing(t, y):
        return side * y[0]

    def turn(t, y):
        return y[1]

    landing.terminal, landing.direction = True, -1
    return solve_ivp(flow, (time, end), state, "DOP853", events=[landing, turn], rtol=1e-11, atol=1e-14)


def rocks_by_scipy(ground, knots, free=4.0):
    """Largest rotation of a block from rest, from knot to knot and from impact to impact."""
    state, side, time, peak = [0.0, 0.0], 0.0, 0.0, 0.0
    for end in [*knots[1:], knots[-1] + free]:
        shakes = ground if end <= knots[-1] else lambda _: 0.0
        while time < end - 1e-12:
            if side == 0:
                time, side = lifted_by_scipy(shakes, time, end)
                continue
            found = arc_by_scipy(shakes, time, end, state, side)
            turns = [abs(y[0]) for y in found.y_events[1]]
            peak, time, state = max(peak, abs(found.y[0, -1]), *turns), found.t[-1], found.y[:, -1]
            if found.status == 1:
                state = [0.0, RESTITUTION * state[1]]
                rests = abs(state[1]) < 1e-7 and abs(shakes(time)) < THRESHOLD
                state, side = ([0.0, 0.0], 0.0) if rests else (state, float(np.sign(state[1])))
    return peak


def test_the_response_to_harmonic_shaking():
    amplitude, period, cycles, phase = 0.32, 0.7, 12.0, 0.2
    knots = [0.0, cycles * period]
    expected = rocks_by_scipy(lambda t: amplitude * math.sin(2 * math.pi * t / period + phase), knots)
    found = rk.outcome(BLOCK, rk.HarmonicMotion(amplitude, period, cycles, phase))
    assert found.status == rk.Status.successful
    assert 0.01 < expected < ALPHA
    np.testing.assert_allclose(found.max_rotation, expected, rtol=1e-7)


def of_many(count, seed=1, spacing=0.3, strength=1.0):
    """Numbers of sine pulses: amplitude [g], period [s], delay [s]."""
    rng = np.random.default_rng(seed)
    delays = np.sort(rng.uniform(0.0, spacing * count, count))[rng.permutation(count)]
    return np.stack([strength * rng.uniform(0.05, 0.2, count), rng.uniform(0.3, 0.9, count), delays], 1)


def pulses(numbers):
    return [rk.SinePulse(amplitude, period).shifted(delay) for amplitude, period, delay in numbers]


def ground_of(numbers):
    def ground(t):
        a, period, delay = numbers.T
        return float(
            np.sum(np.where((t >= delay) & (t < delay + period), a * np.sin(2 * np.pi * (t - delay) / period), 0))
        )

    return ground


def test_the_response_to_a_sum_of_fifty_pulses():
    numbers = of_many(50)
    knots = np.unique(np.concatenate([[0.0], numbers[:, 2], numbers[:, 1] + numbers[:, 2]])).tolist()
    expected = rocks_by_scipy(ground_of(numbers), knots)
    found = rk.outcome(BLOCK, sum(pulses(numbers)))
    assert found.status == rk.Status.successful
    assert 0.01 < expected < ALPHA
    np.testing.assert_allclose(found.max_rotation, expected, rtol=1e-7)


# ------------------------------------------------------------------------------------------ sums of many

RECORD = rk.Record(RNG.normal(0, 0.2, 60), 0.02)
SUMS = {
    "three alike": pulses(of_many(3)),
    "four alike": pulses(of_many(4)),
    "two kinds": pulses(of_many(5)) + [rk.CosinePulse(0.1 * k, 0.5).shifted(0.3 * k) for k in range(1, 5)],
    "with a record": [RECORD, *pulses(of_many(6)), rk.Record(RNG.normal(0, 0.2, 11), 0.05).shifted(0.4)],
    "not shifted": [rk.TriangularPulse(0.1 * k, 0.3 * k) for k in range(1, 6)],
    "scaled sums": [-0.5 * (a + b) for a, b in zip(pulses(of_many(4)), pulses(of_many(4, 3)))],
    "shifted sums": [sum(pulses(of_many(4))).shifted(0.3), *pulses(of_many(2, 5)), 2.0 * sum(pulses(of_many(3, 6)))],
    "shapes": [rk.ExponentialPulse(0.2, 0.5, shape).shifted(0.2) for shape in (-3.0, 0.0, 2.0, 50.0)],
    "harmonic": [rk.HarmonicMotion(0.1, 0.2 * k, 3.5, 0.1 * k).shifted(0.5 * k) for k in range(1, 6)],
    "at once": [rk.HalfSinePulse(0.1, 0.5).shifted(1.0) for _ in range(6)],
}
TIMES = np.linspace(0.0, 5.0, 733)


@pytest.mark.parametrize("name", SUMS)
def test_a_sum_adds_the_accelerations(name):
    parts, motion = SUMS[name], sum(SUMS[name])
    expected = np.sum([part.acceleration(TIMES) for part in parts], axis=0)
    np.testing.assert_allclose(motion.acceleration(TIMES), expected, atol=3e-15)
    shifted = (2.0 * motion).shifted(0.4).acceleration(TIMES + 0.4)
    np.testing.assert_allclose(shifted[:-1], 2 * expected[:-1], atol=3e-13)  # at jumps the times are rounded


@pytest.mark.parametrize("name", SUMS)
def test_tables_of_a_sum_hold_its_accelerations(name):
    """Bounds, scales and knots, beside values within every piece."""
    motion = sum(SUMS[name])
    of = jax.jit(lambda motion: (motion.knots, motion.bounds, motion.scales, motion.lasting))
    knots, bounds, scales, lasting = jax.device_get(of(motion))
    assert knots[0] == 0 and (np.diff(knots) >= 0).all()
    np.testing.assert_allclose(knots[-1], max(float(part.end) for part in SUMS[name]), rtol=1e-15)
    shares = np.linspace(0.01, 0.99, 41)
    long = np.flatnonzero(np.diff(knots) > 1e-9)
    time = knots[long, None] + np.diff(knots)[long, None] * shares
    values = np.sum([part.acceleration(time) for part in SUMS[name]], axis=0)
    assert (np.abs(values).max(axis=1) <= bounds[long] * (1 + 1e-12) + 1e-15).all()
    assert bounds.max() <= sum(float(part.bounds.max()) for part in SUMS[name]) * (1 + 1e-12)
    assert (bounds[np.diff(knots) <= 0] == 0).all() and (scales > 0).all()
    assert int(lasting.pieces) == np.flatnonzero(np.diff(knots) > 0)[-1] + 1 and bool(lasting.forward)


def binary(parts):
    """The sum of sums of two, as motions within motions."""
    return functools.reduce(lambda first, second: rk.motions.AbstractMotion.__add__(1.0 * first, second), parts)


@pytest.mark.parametrize("count", [3, 5])
def test_flat_and_nested_sums_agree(count):
    parts = pulses(of_many(count, strength=2.0))
    flat, nested = (rk.outcome(BLOCK, make(parts)) for make in (sum, binary))
    for name in ("max_rotation", "max_velocity", "margin", "time_of_max"):
        np.testing.assert_allclose(getattr(flat, name), getattr(nested, name), rtol=1e-11)
    assert flat.max_rotation > 0.001


def test_parts_of_sums_are_parts_of_the_sum():
    a, b, c, d = pulses(of_many(4))
    assert (a + b + c + d).parts == ((a + b) + (c + d)).parts == (a + (b + (c + d))).parts == (a, b, c, d)
    assert sum([a, b, c]).second == c and (a + b).first == a


@pytest.mark.parametrize("count", [200, pytest.param(1000, marks=pytest.mark.slow)])
def test_sums_of_very_many_parts(count):
    numbers = of_many(count)
    motion = sum(pulses(numbers))
    assert len(motion.parts) == count
    time = np.linspace(0.0, 300.0, 50)
    expected = [ground_of(numbers)(t) for t in time]
    np.testing.assert_allclose(motion.acceleration(time), expected, atol=1e-13)


@pytest.mark.slow
def test_programs_of_sums_do_not_grow_with_their_parts():
    def operations(count):
        merged = MergedParts.of(pulses(of_many(count)))
        whole = lambda m: m.series("series", jnp.int32(3), jnp.asarray(0.1), jnp.asarray(0.3), 8)
        return len(str(jax.make_jaxpr(whole)(merged)).splitlines())

    assert operations(60) <= operations(6) + 2


# ------------------------------------------------------------------------------------------ names and derivatives

NAMES = {
    2: ("first", "second"),
    3: ("first.first", "first.second", "second"),
    4: ("parts.0", "parts.1", "parts.2", "parts.3"),
}


@pytest.mark.parametrize("count", NAMES)
def test_parameters_have_the_names_of_their_parts(count):
    motion = sum(pulses(of_many(count)))
    numbers = ("motion.amplitude", "motion.period", "delay")
    assert [leaf.name for leaf in leaves_of(motion)] == [f"{part}.{name}" for part in NAMES[count] for name in numbers]
    changed = with_values(motion, {f"{NAMES[count][1]}.motion.amplitude": 0.77})
    assert changed.parts[1].motion.amplitude == 0.77 and changed.parts[0] == motion.parts[0]


def slopes(motion, forward, step=2e-6):
    """Derivatives of the largest rotation by all numbers of a motion, by automatic and by central differences."""
    leaves, structure = jax.tree.flatten(motion)
    numbers = jnp.stack(leaves)

    @jax.jit
    def peak(numbers):
        return rk.outcome(BLOCK, jax.tree.unflatten(structure, list(numbers))).max_rotation

    found = (jax.jacfwd if forward else jax.grad)(peak)(numbers)
    differences = []
    for change in step * np.eye(numbers.size):
        differences.append((peak(numbers + change) - peak(numbers - change)) / (2 * step))
    return np.asarray(found), np.asarray(differences)


@pytest.mark.parametrize("forward", [True, False], ids=["forward", "reverse"])
@pytest.mark.parametrize("kind", ["harmonic", "of two kinds"])
def test_derivatives_by_all_numbers(kind, forward):
    motion = {
        "harmonic": rk.HarmonicMotion(0.32, 0.7, 6.3, 0.2),
        "of two kinds": sum(pulses(of_many(4))) + rk.TriangularPulse(0.2, 0.5).shifted(0.1),
    }[kind]
    found, differences = slopes(motion, forward)
    assert np.abs(differences).max() > 0.01
    np.testing.assert_allclose(found, differences, atol=2e-6 * np.abs(differences).max())


def test_knots_that_coincide_carry_derivatives():
    """Cosines that begin with a jump at one time, under a rocking block: the response is smooth in each time."""
    motion = sum([rk.SinePulse(0.35, 0.6), *(rk.CosinePulse(0.08, 0.5).shifted(0.3) for _ in range(3))])
    found, differences = slopes(motion, True)
    assert np.abs(differences[4::3]).min() > 1e-3
    np.testing.assert_allclose(found, differences, atol=1e-6 * np.abs(differences).max())


@pytest.mark.parametrize("before", [0, pytest.param(12, marks=pytest.mark.slow)])
def test_a_block_at_rest_moves_with_all_knots_that_coincide(before):
    """Pulses that lift it with one jump, perhaps after many that do not: a shift of all moves no peak."""
    weak = [rk.SinePulse(0.01, 0.3).shifted(0.1 + 0.37 * k) for k in range(before)]
    strong = [rk.CosinePulse(0.25, 0.1).shifted(0.37 * before + 1.0) for _ in range(6)]
    motion = sum([*weak, *strong])
    slope = jax.grad(lambda m: rk.outcome(BLOCK, m).max_rotation)(motion)
    shifts = np.array([part.delay for part in slope.parts[before:]])
    assert np.abs(shifts).max() > 1e-3
    assert abs(shifts.sum()) < 1e-12


def test_vertical_parts_add():
    horizontal, vertical = (pulses(of_many(4, seed)) for seed in (1, 2))
    motion = sum(h.with_vertical(v) for h, v in zip(horizontal, vertical))
    both = rk.outcome(BLOCK, 1.5 * motion), rk.outcome(BLOCK, 1.5 * sum(horizontal).with_vertical(sum(vertical)))
    np.testing.assert_allclose(*(found.max_rotation for found in both), rtol=1e-11)
    assert abs(both[0].max_rotation - rk.outcome(BLOCK, 1.5 * sum(horizontal)).max_rotation) > 1e-6


def test_sums_in_lanes():
    """A batch of sums, each with numbers of its own."""
    numbers = np.stack([of_many(4, seed, strength=2.0) for seed in range(5)])
    many = functools.reduce(
        operator.add, [rk.SinePulse(n[:, 0], n[:, 1]).shifted(n[:, 2]) for n in numbers.swapaxes(0, 1)]
    )
    found = jax.jit(jax.vmap(lambda m: rk.outcome(BLOCK, m).max_rotation))(many)
    expected = [rk.outcome(BLOCK, sum(pulses(each))).max_rotation for each in numbers]
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_reverse_and_forward_mode_agree_under_many_numbers():
    """Sixty numbers: reverse mode takes the tape. One direction in forward mode judges it."""
    motion = sum(pulses(of_many(20)))
    direction = jax.tree.map(lambda x: jnp.cos(1e3 * x), motion)
    peak = lambda m: rk.outcome(BLOCK, m).max_rotation
    slope = jax.grad(peak)(motion)
    found = sum(jnp.vdot(a, b) for a, b in zip(jax.tree.leaves(slope), jax.tree.leaves(direction)))
    np.testing.assert_allclose(found, jax.jvp(peak, (motion,), (direction,))[1], rtol=1e-9)
    assert abs(found) > 1e-3
