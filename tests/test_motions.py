"""Motions: their series, knots and bounds, their formulas in mpmath, and what arithmetic makes of them."""

import functools
import math
import operator

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.inverse.likelihood import _of_strength
from jaxrock.motions.pieces import Extent
from jaxrock.motions.pulses.pulse import AbstractPulse
from jaxrock.motions.record import padded, with_room

EPS = np.finfo(float).eps
ORDER = 12
RNG = np.random.default_rng(3)
SAMPLES = np.append(RNG.normal(0, 0.3, 11), 0.7)  # ends with a jump
RECORD = rk.Record(SAMPLES, 0.02)
NEAR_FAULT = rk.MavroeidisPapageorgiouPulse(0.6, 0.9, 2.3, 0.7)

MOTIONS = {
    "rectangle": rk.RectangularPulse(-0.8, 0.6),
    "triangle": rk.TriangularPulse(0.8, 0.6),
    "half sine": rk.HalfSinePulse(0.8, 0.6),
    "sine": rk.SinePulse(-0.8, 1.3),
    "cosine": rk.CosinePulse(0.8, 1.3),
    "ricker, symmetric": rk.RickerPulse(0.8, 0.7),
    "ricker, antisymmetric": rk.RickerPulse(0.8, 0.7, "antisymmetric"),
    "ricker, cut": rk.RickerPulse(0.8, 0.7, center=0.3),
    "near-fault": NEAR_FAULT,
    "near-fault, many oscillations": rk.MavroeidisPapageorgiouPulse(-0.6, 0.9, 9.5),
    "near-fault, few oscillations": rk.MavroeidisPapageorgiouPulse(0.6, 0.9, 1.001, -2.0),
    "record": RECORD,
    "record of one sample": rk.Record([0.4], 0.02),
    "record of two samples": rk.Record([0.4, -0.2], 0.02),
    "scaled": -2.5 * NEAR_FAULT,
    "scaled record": RECORD * 0.3,
    "shifted": rk.CosinePulse(0.8, 1.3).shifted(0.377),
    "shifted by nothing": rk.CosinePulse(0.8, 1.3).shifted(0.0),
    "sum that overlaps": rk.CosinePulse(0.8, 1.3) + rk.RectangularPulse(0.3, 0.9).shifted(0.6),
    "sum with a gap": rk.TriangularPulse(0.5, 0.4) + rk.HalfSinePulse(0.7, 0.5).shifted(2.0),
    "sum of records": RECORD + rk.Record(SAMPLES[::-1], 0.03),
    "difference": rk.RickerPulse(0.8, 0.7) - rk.SinePulse(0.4, 1.1),
    "sum of sums": (RECORD + rk.SinePulse(0.4, 0.1)) + (0.5 * NEAR_FAULT).shifted(0.05),
} | {
    f"exponential, shape {shape:g}": rk.ExponentialPulse(0.8, 0.6, shape)
    for shape in (-math.inf, -700, -41, -40, -3, -1e-12, 0, 1e-12, 0.5, 40, 41, 700, math.inf)
}  # fmt: skip

each = pytest.mark.parametrize("name", MOTIONS)


ROOM = 2000
_at = jax.jit(lambda motion, time: motion.acceleration(time))


def acceleration(motion, time):
    """At times of any shape; so many at once that all questions to motions of a kind are one program."""
    time = np.asarray(time, float)
    room = np.zeros(-(-time.size // ROOM) * ROOM)
    room[: time.size] = time.ravel()
    found = [np.asarray(_at(motion, part)) for part in room.reshape(-1, ROOM)]
    return np.concatenate(found)[: time.size].reshape(time.shape)


@functools.partial(jax.jit, static_argnames="order")
def series(motion, piece, local, unit, order):
    """Point by point: that is compiled sooner than all side by side."""
    return jax.lax.map(lambda point: jnp.stack(motion.series(*point, order)), (piece, local, unit))


@jax.jit
def long_and_short(motion, piece, local, unit):
    """Series of `ORDER`, and of order 3 in half the unit."""
    return series(motion, piece, local, unit, ORDER), series(motion, piece, local, unit / 2, 3)


@jax.jit
def tables(motion):
    """Knots, scales, bounds and end of a motion, and its series of order 0 at many shares of every piece, in a unit
    that must not matter."""
    straight, lengths = jnp.full_like(motion.bounds, jnp.inf), jnp.diff(motion.knots)
    piece, local = np.repeat(np.arange(lengths.size), len(MANY)), jnp.outer(lengths, MANY).ravel()
    found = series(motion, piece, local, np.full(len(piece), 0.05), 0)
    found = found.reshape(lengths.size, len(MANY), found.shape[1])
    return motion.knots, straight if motion.scales is None else motion.scales, motion.bounds, motion.end, found


knots_of = jax.jit(lambda motion: motion.knots)


@functools.cache
def told(name):
    return tuple(np.asarray(x) for x in tables(MOTIONS[name]))


def facts(name):
    """Knots, scales, bounds and end of a motion."""
    return told(name)[:4]


def values(name):
    """Series of order 0 at many shares of every piece."""
    return told(name)[4]


def size(name):
    return facts(name)[2].max()


FEW = np.array([0.0, 0.11, 0.37, 0.5, 0.83, 0.999])
MANY = np.append(FEW, np.linspace(0.0, 1.0, 501))


def points(name, shares):
    """Piece, time since its start, and its length, at shares of every piece: a row for each. Those without a length
    are there, too, so that motions of a kind have as many."""
    lengths = np.diff(facts(name)[0])
    piece = np.repeat(np.arange(lengths.size), len(shares))
    return piece, np.outer(lengths, shares).ravel(), lengths[piece]


MOVING = [name for name in MOTIONS if name != "record of one sample"]
each_moving = pytest.mark.parametrize("name", MOVING)


# --------------------------------------------------------------------------------- every motion


@each_moving
def test_series_is_the_acceleration_around_a_point(name):
    knots, scales, _, end = facts(name)
    piece, local, length = points(name, FEW)
    unit = np.minimum(scales[piece], 0.3)
    terms = np.asarray(long_and_short(MOTIONS[name], piece, local, unit)[0])
    assert terms.shape[1] <= ORDER + 1
    reached = np.clip(local + unit * np.array([[0.1], [-0.12], [0.02], [-1e-3]]), 0.0, length * (1 - 1e-9))
    value = sum(terms[:, k] * ((reached - local) / unit) ** k for k in range(terms.shape[1]))
    time = knots[piece] + reached
    # Times round; where the acceleration is steep, it follows.
    tolerance = size(name) * (1e-14 + 4 * EPS * (time + end) / unit) + 1e-300
    moves = length > 0
    assert moves.any()
    off = np.abs(value - acceleration(MOTIONS[name], time))
    np.testing.assert_array_less(off[:, moves], tolerance[:, moves])


@each_moving
def test_shorter_series_in_another_unit(name):
    """A shorter series is the beginning of a longer one; its terms go with the powers of the unit."""
    piece, local, length = points(name, FEW)
    unit, moves = np.full(len(piece), 0.1), length > 0
    long, third = map(np.asarray, long_and_short(MOTIONS[name], piece, local, unit))
    one = values(name)[:, : len(FEW)].reshape(len(piece), -1)
    for order, short in ((0, one), (3, third)):
        assert short.shape[1] == min(order + 1, long.shape[1])
        expected = long[:, : order + 1] * 0.5 ** np.arange(short.shape[1])
        np.testing.assert_allclose(short[moves], expected[moves], rtol=1e-13, atol=1e-15 * size(name))


@each
def test_knots_increase_from_zero_to_the_end(name):
    knots, scales, bounds, end = facts(name)
    assert knots[0] == 0 and knots[-1] == end
    assert np.all(np.diff(knots) >= 0) and np.all(np.isfinite(knots))
    assert scales.shape == bounds.shape == (knots.size - 1,)
    assert np.all(scales > 0)
    assert np.all((bounds >= 0) & np.isfinite(bounds))


@each_moving
def test_bounds_bound(name):
    """On a dense grid of every piece, both ends of it included."""
    knots, _, bounds, _ = facts(name)
    moves = np.diff(knots) > 0
    found = np.abs(values(name)[moves, :, 0])
    np.testing.assert_array_less(found, np.broadcast_to(bounds[moves, None] * (1 + 4 * EPS) + 1e-300, found.shape))
    # And not by far more than the motion in all (sums add up the bounds of their parts; a spike never moves).
    assert size(name) <= 2.5 * found.max() or name == "exponential, shape inf"


@each
def test_ground_is_still_before_and_after(name):
    end = float(facts(name)[3])
    times = [-math.inf, -1.0, -1e-300, end, np.nextafter(end, np.inf), end + 1e-9, 2 * end + 1, 1e300, math.inf]
    np.testing.assert_array_equal(acceleration(MOTIONS[name], np.array(times)), 0.0)


JUMPS = {
    "rectangle": (rk.RectangularPulse(-0.8, 0.6), [(0.0, -0.8), (0.6, 0.0)]),
    "cosine": (rk.CosinePulse(0.8, 1.3), [(0.0, 0.8), (1.3, 0.0)]),
    "shifted cosine": (rk.CosinePulse(0.8, 1.3).shifted(0.377), [(0.0, 0.0), (0.377, 0.8)]),
    "record": (RECORD, [(0.0, SAMPLES[0]), (float(RECORD.end), 0.0)]),
    "shifted record": (2 * RECORD.shifted(0.3), [(0.3, 2 * SAMPLES[0])]),
    "cut ricker": (rk.RickerPulse(0.8, 0.7, center=0.1), [(0.2, 0.0)]),
    "limit of shapes": (rk.ExponentialPulse(0.8, 0.6, -np.inf), [(0.0, 0.8), (0.3, 0.8), (0.6, 0.0)]),
    "sum": (
        rk.RectangularPulse(0.5, 0.4) + rk.RectangularPulse(0.25, 0.9).shifted(0.3),
        [(0.0, 0.5), (0.3, 0.75), (0.4, 0.25), (1.2, 0.0)],
    ),
    "sum of what follows at once": (
        rk.RectangularPulse(0.5, 0.4) + rk.RectangularPulse(-0.25, 0.9).shifted(0.4),
        [(0.4, -0.25)],
    ),
    "difference that starts together": (rk.CosinePulse(0.8, 1.3) - rk.RectangularPulse(0.3, 0.2), [(0.0, 0.5)]),
}


made_so_strong = jax.jit(_of_strength)


@pytest.mark.parametrize("name", [name for name, motion in MOTIONS.items() if isinstance(motion, AbstractPulse)])
@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_pulse_is_proportional_to_its_amplitude(name, way):
    """So likelihoods may leave it out where they set the strength of a motion."""
    motion, t = MOTIONS[name], np.linspace(0, 1.2 * float(facts(name)[3]), 50)
    scaled = made_so_strong(motion, np.log(0.37), way)
    found = float(scaled.factor) * acceleration(scaled.motion, t)
    expected = way * 0.37 / size(name) * acceleration(motion, t)
    np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("motion, values", JUMPS.values(), ids=JUMPS)
def test_value_at_a_jump_is_the_one_after_it(motion, values):
    time, value = np.array(values).T
    np.testing.assert_array_equal(acceleration(motion, time), value)


def test_acceleration_has_the_shape_of_the_time():
    motion, time = MOTIONS["triangle"], np.linspace(-0.5, 2.0, 12).reshape(3, 2, 2)
    found = _at(motion, time)
    assert found.shape == (3, 2, 2)
    np.testing.assert_array_equal(np.ravel(found), acceleration(motion, time.ravel()))
    assert _at(motion, 0.8).shape == ()
    assert _at(motion, np.zeros((0,))).shape == (0,)


# --------------------------------------------------------------------- formulas, written again

INSIDE = np.append(np.linspace(0, 1, 401)[:-1], 1 - 1e-9)


def ricker(y, antisymmetric):
    """Ricker's wavelets, as derivatives of a Gaussian, before scaling."""
    gaussian = (lambda x: mp.exp(-(x**2) / 2)) if antisymmetric else lambda x: mp.exp(-(x**2))
    return mp.diff(gaussian, y, 3 if antisymmetric else 2)


FORMULAS = {
    "rectangle": lambda t: -0.8 + 0 * t,
    "triangle": lambda t: 0.8 * (1 - np.abs(2 * t / 0.6 - 1)),
    "half sine": lambda t: 0.8 * np.sin(np.pi * t / 0.6),
    "sine": lambda t: -0.8 * np.sin(2 * np.pi * t / 1.3),
    "cosine": lambda t: 0.8 * np.cos(2 * np.pi * t / 1.3),
    "record": lambda t: np.interp(t, 0.02 * np.arange(12), SAMPLES),
    "record of two samples": lambda t: 0.4 - 0.6 * t / 0.02,
}


@pytest.mark.parametrize("name", FORMULAS)
def test_formulas(name):
    time = facts(name)[3] * INSIDE
    found = acceleration(MOTIONS[name], time)
    np.testing.assert_allclose(found, FORMULAS[name](time), rtol=0, atol=5e-15 * size(name))


@pytest.mark.parametrize("center", [None, 1.1])
@pytest.mark.parametrize("kind", ["symmetric", "antisymmetric"])
def test_ricker_is_a_derivative_of_a_gaussian(kind, center):
    pulse, antisymmetric = rk.RickerPulse(0.7, 0.9, kind, center), kind == "antisymmetric"
    time = float(pulse.end) * INSIDE[::20]
    found = np.asarray(acceleration(pulse, time))
    rate = 2 * mp.pi / (mp.sqrt(3) * mp.mpf(0.9)) if antisymmetric else mp.pi / mp.mpf(0.9)
    with mp.workdps(40):
        exact = [ricker(rate * (mp.mpf(t) - mp.mpf(float(pulse.center))), antisymmetric) for t in time]
        # Largest at y^2 = 3 - sqrt(6), where the fourth derivative vanishes; positive after the centre for the
        # pulse, whose odd kind is (y^3 - 3 y) e^(-y^2/2); positive at the centre for the even kind.
        if antisymmetric:
            peak = -abs(ricker(mp.sqrt(3 - mp.sqrt(6)), True))
        else:
            peak = ricker(mp.mpf(0), False)
        exact = np.array([float(0.7 * u / peak) for u in exact])
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-14)


@pytest.mark.parametrize("kind, peaks", [("symmetric", [0.0]), ("antisymmetric", [-1, 1])])
def test_ricker_peak_is_the_amplitude(kind, peaks):
    pulse = rk.RickerPulse(0.7, 0.9, kind)
    place = 0.9 * math.sqrt(3) / (2 * math.pi) * math.sqrt(3 - math.sqrt(6))
    time = float(pulse.center) + place * np.array(peaks)
    np.testing.assert_allclose(np.abs(acceleration(pulse, time)), 0.7, rtol=1e-15)
    dense = np.abs(acceleration(pulse, np.linspace(0.0, float(pulse.end), 200_001)))
    assert 0.7 * (1 - 1e-6) < dense.max() <= 0.7 * (1 + 4 * EPS)


@pytest.mark.parametrize("kind, share", [("symmetric", 1), ("antisymmetric", 2 / math.sqrt(3))])
def test_ricker_cuts_off_nothing_that_matters(kind, share):
    """At and before time 0, and so after the end, the wavelet is below 1e-12 of its peak; not far below."""
    pulse, antisymmetric = rk.RickerPulse(0.7, 0.9, kind), kind == "antisymmetric"
    start = math.pi * share * float(pulse.center) / 0.9
    with mp.workdps(60):
        peak = abs(ricker(mp.sqrt(3 - mp.sqrt(6)) if antisymmetric else mp.mpf(0), antisymmetric))
        tail = [float(abs(ricker(mp.mpf(start + more), antisymmetric)) / peak) for more in np.linspace(0, 5, 21)]
    assert 1e-13 < tail[0] < 1e-12
    assert np.all(np.diff(tail) < 0)
    assert abs(float(acceleration(pulse, np.array([0.0]))[0])) < 0.7e-12


# ---------------------------------------------------------------------------- exponential family

SHAPES = [-math.inf, -700, -100, -40.5, -39, -5, -0.02, -0.005, -1e-12, 0.0]
SHAPES += [-shape for shape in SHAPES[:-1]]
SHARES = [1e-9, 1e-5, 1e-3, 0.004, 0.02, 0.1, 0.24, 0.4, 0.47, 0.49, 0.499, 0.49999]
SHARES = [0.0, *SHARES, 0.5, *(1 - share for share in SHARES)]


def exponential(time, amplitude, duration, shape):
    """The definition (Voyagaki et al. 2012, 2.1); its limits for infinite shapes."""
    x = time / duration
    x = min(x, 1 - x)
    if mp.isinf(shape):
        return amplitude if shape < 0 else mp.mpf(0)
    if shape == 0:
        return 2 * amplitude * x
    return amplitude * mp.expm1(2 * shape * x) / mp.expm1(shape)


@pytest.mark.parametrize("shape", SHAPES)
def test_exponential_pulse(shape):
    amplitude, duration = 0.8, 0.6
    time = duration * np.array(SHARES)
    found = np.asarray(acceleration(rk.ExponentialPulse(amplitude, duration, shape), time))
    with mp.workdps(60):
        numbers = [mp.mpf(x) for x in (amplitude, duration, shape)]
        exact = [exponential(mp.mpf(t), *numbers) for t in time.tolist()]
        # How much the value changes if the time does by the rounding of the duration.
        rounding = mp.mpf(4 * EPS * duration)
        moved = [exponential(mp.mpf(t) + rounding * (1 if t < 0.3 else -1), *numbers) for t in time.tolist()]
        change = np.array([float(abs(a - b)) for a, b in zip(moved, exact)])
        exact = np.array([float(u) for u in exact])
    np.testing.assert_array_less(np.abs(found - exact), change + 4 * EPS * np.abs(exact) + 5e-17 * amplitude)


@pytest.mark.parametrize("shape", SHAPES)
def test_exponential_pulse_is_even(shape):
    pulse = rk.ExponentialPulse(0.8, 1.0, shape)
    time = np.array([0.125, 0.25, 0.375, 0.4375, 0.5 - 2**-10])
    np.testing.assert_allclose(acceleration(pulse, time), acceleration(pulse, 1 - time), rtol=1e-12, atol=1e-16)


@jax.jit
def slopes(amplitude, duration, shape, time):
    """Derivatives of the acceleration with respect to amplitude, duration and shape at many times."""

    def at(amplitude, duration, shape, time):
        return rk.ExponentialPulse(amplitude, duration, shape).acceleration(time)

    return jnp.stack(jax.vmap(jax.grad(at, (0, 1, 2)), (None, None, None, 0))(amplitude, duration, shape, time))


DERIVATIVE_SHAPES = [0.0, 1e-300, 1e-12, 1e-4, 0.00999, 0.0101, 1.0, 12.0, 39.9, 45.0, 700.0]


@pytest.mark.parametrize("shape", sorted({*DERIVATIVE_SHAPES, *(-shape for shape in DERIVATIVE_SHAPES)}))
def test_derivatives_of_the_exponential_pulse(shape):
    """jax.grad against central differences at 60 digits, which leave 40."""
    values = (0.8, 0.6)
    time = 0.6 * np.array([0.001, 0.013, 0.1, 0.31, 0.45, 0.499, 0.52, 0.7, 0.93, 0.998])
    found = np.asarray(slopes(*values, shape, time))
    with mp.workdps(60):
        numbers = [mp.mpf(x) for x in (*values, shape)]
        step = mp.mpf(10) ** -20

        def slope(t, which):
            sides = []
            for sign in (1, -1):
                moved = list(numbers)
                moved[which] += sign * step
                sides.append(exponential(mp.mpf(t), *moved))
            return float((sides[0] - sides[1]) / (2 * step))

        exact = np.array([[slope(t, which) for t in time.tolist()] for which in range(3)])
    # Where the pulse is constant to rounding (e^-40) so are its derivatives.
    tiny = 1e-16 * np.abs(exact).max(axis=1, keepdims=True) + 5e-17
    np.testing.assert_array_less(np.abs(found - exact), 1e-9 * np.abs(exact) + tiny)


@pytest.mark.parametrize("shape", [-math.inf, math.inf])
def test_derivatives_at_the_limits(shape):
    """The limits depend on the amplitude alone."""
    time = 0.6 * np.array([0.001, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9])
    found = np.asarray(slopes(0.8, 0.6, shape, time))
    np.testing.assert_array_equal(found, [[float(shape < 0)] * 10, [0.0] * 10, [0.0] * 10])


# -------------------------------------------------------------------------------- near-fault pulse


@pytest.mark.parametrize("oscillations, phase", [(2.3, 0.7), (1.001, 0.0), (5.0, -np.pi / 2), (11.0, 3.0)])
def test_near_fault_acceleration_integrates_to_the_velocity(oscillations, phase):
    amplitude, period = 0.6, 0.9
    pulse = rk.MavroeidisPapageorgiouPulse(amplitude, period, oscillations, phase)
    end = oscillations * period
    assert float(pulse.end) == pytest.approx(end, rel=1e-15)
    # Velocity over g [s] by the formula of the source, and by Gauss's rule on 200 panels.
    edges = np.linspace(0.0, end, 201)
    x = edges - end / 2
    peak = amplitude * period / (2 * np.pi)
    exact = peak / 2 * (1 + np.cos(2 * np.pi * x / end)) * np.cos(2 * np.pi * x / period + phase)
    nodes, weights = np.polynomial.legendre.leggauss(10)
    time = (edges[:-1, None] + edges[1:, None]) / 2 + np.diff(edges)[:, None] / 2 * nodes
    panels = np.sum(weights * np.asarray(acceleration(pulse, time)), axis=1) * np.diff(edges) / 2
    velocity = np.append(0.0, np.cumsum(panels))
    np.testing.assert_allclose(velocity, exact, rtol=0, atol=2e-15 * end)
    assert abs(velocity[-1]) < 2e-15 * end


# -------------------------------------------------------------------------- arithmetic and batches

TIMES = np.linspace(-0.2, 3.2, 1201)
A, B = MOTIONS["cosine"], rk.TriangularPulse(0.5, 0.7).shifted(0.3)

ARITHMETIC = {
    "2*m": (2 * A, lambda a, b: 2 * a),
    "m*2": (A * 2, lambda a, b: 2 * a),
    "2.5*m": (2.5 * A, lambda a, b: 2.5 * a),
    "m*numpy scalar": (A * np.float64(2.5), lambda a, b: 2.5 * a),
    "numpy scalar*m": (np.float64(2.5) * A, lambda a, b: 2.5 * a),
    "jax scalar*m": (jnp.asarray(2.5) * A, lambda a, b: 2.5 * a),
    "0*m": (0 * A, lambda a, b: 0 * a),
    "m/2": (A / 2, lambda a, b: 0.5 * a),
    "m/jax scalar": (A / jnp.asarray(4.0), lambda a, b: 0.25 * a),
    "-m": (-A, lambda a, b: -a),
    "-(3*m)": (-(3 * A), lambda a, b: -3 * a),
    "m+n": (A + B, lambda a, b: a + b),
    "n+m": (B + A, lambda a, b: a + b),
    "m-n": (A - B, lambda a, b: a - b),
    "m-m": (A - A, lambda a, b: 0 * a),
    "sum": (sum([A, B, A]), lambda a, b: 2 * a + b),
    "3*(m-n)+n": (3 * (A - B) + B, lambda a, b: 3 * a - 2 * b),
}


@pytest.mark.parametrize("combined, rule", ARITHMETIC.values(), ids=ARITHMETIC)
def test_arithmetic(combined, rule):
    assert isinstance(combined, rk.motions.AbstractMotion)
    expected = rule(np.asarray(acceleration(A, TIMES)), np.asarray(acceleration(B, TIMES)))
    np.testing.assert_allclose(acceleration(combined, TIMES), expected, rtol=0, atol=2e-15)


@pytest.mark.parametrize("delay", [0.0, 0.25, 1.7])
@pytest.mark.parametrize("name", ["cosine", "record", "triangle", "sum that overlaps"])
def test_shifted(name, delay):
    motion, knots = MOTIONS[name], facts(name)[0]
    shifted = motion.shifted(delay)
    np.testing.assert_allclose(knots_of(shifted), np.append(0.0, knots + delay), rtol=2 * EPS)
    expected = np.asarray(acceleration(motion, TIMES))
    time = TIMES + delay
    # A time that rounds onto the other side of a jump is no error.
    apart = np.min(np.abs(TIMES[:, None] - knots), axis=1) > 1e-12
    np.testing.assert_allclose(acceleration(shifted, time)[apart], expected[apart], rtol=0, atol=2e-13)
    twice = motion.shifted(delay / 2).shifted(delay / 2)
    np.testing.assert_allclose(acceleration(twice, time)[apart], expected[apart], rtol=0, atol=2e-13)


NUMBERS = np.array([0.3, 0.8, -0.5]), np.array([0.7, 1.3, 2.9]), np.array([1.5, 2.0, 4.0])
BATCHED = {
    "rectangle": lambda a, d, x: rk.RectangularPulse(a, d),
    "triangle": lambda a, d, x: rk.TriangularPulse(a, d),
    "exponential": lambda a, d, x: rk.ExponentialPulse(a, d, 30 * (x - 2)),
    "half sine": lambda a, d, x: rk.HalfSinePulse(a, d),
    "sine": lambda a, d, x: rk.SinePulse(a, d),
    "cosine": lambda a, d, x: rk.CosinePulse(a, d),
    "ricker": lambda a, d, x: rk.RickerPulse(a, d, center=x),
    "ricker, antisymmetric": lambda a, d, x: rk.RickerPulse(a, d, "antisymmetric"),
    "near-fault": lambda a, d, x: rk.MavroeidisPapageorgiouPulse(a, d, x, a),
    "arithmetic": lambda a, d, x: (a * rk.SinePulse(1.0, d)).shifted(x) - rk.CosinePulse(a, x),
}


@functools.cache
def batches():
    """Accelerations of all of them, by one program."""
    each = lambda *numbers: {name: make(*numbers).acceleration(TIMES) for name, make in BATCHED.items()}
    return jax.device_get(jax.jit(jax.vmap(each))(*NUMBERS))


@pytest.mark.parametrize("name", BATCHED)
def test_vmap_over_parameters(name):
    single = [acceleration(BATCHED[name](*numbers), TIMES) for numbers in zip(*(n.tolist() for n in NUMBERS))]
    np.testing.assert_allclose(batches()[name], np.stack(single), rtol=1e-14, atol=1e-15)


def test_a_batch_of_motions_is_made_at_once():
    """Arrays in a pulse or record are for vmap: each lane is one motion."""
    amplitude, period, _ = NUMBERS
    for many, one in (
        (rk.SinePulse(amplitude, period), lambda i: rk.SinePulse(amplitude[i], period[i])),
        (rk.RickerPulse(amplitude, period), lambda i: rk.RickerPulse(amplitude[i], period[i])),
        (
            rk.Record(np.stack([SAMPLES, -SAMPLES, 3 * SAMPLES]), period),
            lambda i: rk.Record([1, -1, 3][i] * SAMPLES, period[i]),
        ),
    ):
        found = jax.jit(jax.vmap(lambda m: m.acceleration(TIMES)))(many)
        expected = np.stack([acceleration(one(i), TIMES) for i in range(3)])
        np.testing.assert_allclose(found, expected, rtol=1e-14, atol=1e-15)


# ------------------------------------------------------------------------------------------ late motions

LATE = rk.SinePulse(0.3, 0.8)
QUICK = {"model": rk.Linear(), "engine": rk.Series(order=8)}


@jax.jit
def of_a_late_one(delay):
    return rk.outcome(rk.Block(0.2, 2.0), LATE.shifted(delay), **QUICK)


@jax.jit
def of_two_late_ones(delay):
    motion = LATE.shifted(delay) - 0.1 * LATE.shifted(delay + 0.5)
    return rk.outcome(rk.Block(0.2, 2.0), motion, **QUICK)


@pytest.mark.parametrize("delay", [1e3, 1e6, 1e9, 1e12])
def test_a_late_motion_does_what_it_does_early(delay):
    """Its knots are rounded to 1e-4 s at 1e12 s; how long its pieces last is not."""
    early, late = of_a_late_one(0.0), of_a_late_one(delay)
    for name in ("max_rotation", "max_velocity", "margin"):
        np.testing.assert_allclose(getattr(late, name), getattr(early, name), rtol=1e-15)
    assert late.impact_count == early.impact_count


@pytest.mark.parametrize("delay", [1e6, 1e9, 9e11])
def test_two_late_motions_say_how_late_they_may_be(delay):
    """Check that two late motions report rounding: a sum counts the rounded times of both, and `error` includes it."""
    early, late = of_two_late_ones(0.0), of_two_late_ones(delay)
    off = abs(float(late.max_rotation) - float(early.max_rotation))
    assert off <= float(late.error) <= 1e-14 * delay
    assert float(early.error) < 1e-13


def test_late_in_single_precision():
    """Where times are rounded to 64 s."""
    block = rk.Block(np.float32(0.2), np.float32(2.0))
    motion = rk.SinePulse(np.float32(0.3), np.float32(0.8))
    delays = np.float32(0.0), np.float32(1e9)
    early, late = (rk.outcome(block, motion.shifted(delay), **QUICK).max_rotation for delay in delays)
    assert early.dtype == late.dtype == np.float32
    np.testing.assert_allclose(late, early, rtol=1e-6)


def test_sums_of_many_motions_are_small_programs():
    """Check that programs of sums stay small: a sum queries its parts once, else each motion doubled the program."""

    def operations(count):
        motion = functools.reduce(operator.add, [rk.SinePulse(0.2, 1.0 + k).shifted(0.1 * k) for k in range(count)])
        return len(jax.make_jaxpr(lambda motion: (motion.scales, motion.time_rounding))(motion).eqns)

    assert operations(8) < 4.5 * operations(4)  # squares, for the knots of sums within sums


@pytest.mark.parametrize("name", MOTIONS)
def test_how_many_pieces_last(name):
    """As the lengths tell it: of the motion, with room for more samples, after quiet, and after none."""
    for motion in (MOTIONS[name], padded(MOTIONS[name]), with_room(2.0 * MOTIONS[name])):
        for whole in (motion, motion.shifted(0.3), motion.shifted(0.0)):
            found, expected = whole.lasting, Extent.of(whole.lengths)
            assert (int(found.pieces), bool(found.forward)) == (int(expected.pieces), bool(expected.forward))


@pytest.mark.parametrize("way", ["factors", "signs", "shifts"])
def test_many_factors_or_shifts_are_one(way):
    """Three hundred factors or shifts cost as much as one."""
    motion, time = rk.HalfSinePulse(0.3, 0.8), np.linspace(0.0, 4.0, 40)
    for _ in range(300):
        motion = {"factors": lambda m: 1.01 * m, "signs": lambda m: -m, "shifts": lambda m: m.shifted(0.01)}[way](
            motion
        )
    assert motion.motion == rk.HalfSinePulse(0.3, 0.8)
    later = 3.0 if way == "shifts" else 0.0
    expected = 0.3 * np.where((time >= later) & (time < later + 0.8), np.sin(np.pi * (time - later) / 0.8), 0.0)
    expected *= 1.01**300 if way == "factors" else 1.0
    np.testing.assert_allclose(motion.acceleration(time), expected, atol=1e-12)


def test_factors_and_shifts_of_one_are_still_checked():
    with pytest.raises(ValueError, match="`delay` must be 0 or more and finite"):
        rk.SinePulse(0.3, 0.8).shifted(2.0).shifted(-1.0)
    with pytest.raises(ValueError, match="`factor` must be finite"):
        math.inf * (2.0 * rk.SinePulse(0.3, 0.8))


def test_a_sum_of_several():
    """Python's `sum` begins with 0; the limit admits several."""
    parts, time = [rk.HalfSinePulse(0.1 * k, 0.8).shifted(0.3 * k) for k in range(1, 6)], np.linspace(0.0, 3.0, 30)
    each = [
        np.where((time >= 0.3 * k) & (time < 0.3 * k + 0.8), 0.1 * k * np.sin(np.pi * (time / 0.8 - 0.375 * k)), 0.0)
        for k in range(1, 6)
    ]
    np.testing.assert_allclose(sum(parts).acceleration(time), np.sum(each, axis=0), atol=1e-14)
    assert sum(rk.SinePulse(0.1, 0.4).shifted(k) for k in range(33)).second.delay == 32  # the largest number


MADE_OF_MANY = {
    "scaled sums": lambda: functools.reduce(
        lambda m, _: 0.9 * (m + rk.SinePulse(1, 1)), range(100), rk.SinePulse(1, 1)
    ),
    "many records": lambda: sum(rk.Record(SAMPLES, 0.01 * k) for k in range(1, 102)).knots,
    "factors of shifts": lambda: functools.reduce(lambda m, _: 0.9 * m.shifted(0.1), range(300), rk.SinePulse(1, 1)),
    "verticals": lambda: functools.reduce(lambda m, _: m.with_vertical(RECORD), range(200), RECORD),
}


@pytest.mark.parametrize("name", MADE_OF_MANY)
def test_a_motion_of_too_many_is_refused_where_it_is_made(name):
    with pytest.raises(ValueError, match="must be made of at most 100 motions, .* make a `Record` of its samples"):
        MADE_OF_MANY[name]()


DOUBTED = {  # peak, and the words of the warning
    "m/s2": (3.436, "peaks at 3.436 g. If its samples are in m/s2, divide them by 9.81: it then peaks at 0.35 g"),
    "cm/s2": (343.0, "peaks at 343 g. If its samples are in cm/s2, divide them by 981: it then peaks at 0.35 g"),
}


@pytest.mark.parametrize("unit", DOUBTED)
def test_a_record_in_another_unit_is_doubted_once(unit):
    peak, told = DOUBTED[unit]
    with pytest.warns(UserWarning, match=f"^Record 'mine' {told}") as found:
        record = rk.Record([0.0, -peak, 0.1], 0.01, "mine")
    assert len(found) == 1
    # Motions made of a record, and records scaled by a factor, do not warn again.
    suite = rk.motions.Suite([record, 2.0 * record])
    jax.jit(lambda number: suite[number].acceleration(0.01))(1)
    rk.processing.scaled(RECORD, acceleration=40.0)
    rk.motions.Components(record, record).along(0.3)
    jax.jit(lambda samples: rk.Record(samples, 0.01).acceleration(0.01))(record.samples)
    with pytest.warns(UserWarning, match="^A record peaks at 3.4"):
        rk.Record(np.array([[0.0, 0.1], [3.4, 0.0]]), 0.01)


def test_no_record_up_to_three_g_is_doubted():
    rk.Record([0.0, 3.0, -3.0], 0.01)
