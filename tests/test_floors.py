"""Floors against SciPy's DOP853 of building and block together, response spectra, limits and finite differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxrock as rk
from jaxrock.motions import on_floor
from jaxrock.studies import parameters

STEP = 0.05
SAMPLES = np.concatenate([[0.0], 0.567 * np.sin(2.2 * np.arange(1, 40)) * np.hanning(41)[1:-1] + 0.162])
RECORD = rk.Record(SAMPLES, STEP)
LINES = [
    (STEP * k, STEP * (k + 1), lambda t, k=k: SAMPLES[k] + (SAMPLES[k + 1] - SAMPLES[k]) / STEP * (t - STEP * k))
    for k in range(39)
]
SINE = rk.SinePulse(0.144, 0.6)
CYCLE = [(0.0, 0.6, lambda t: 0.144 * np.sin(2 * np.pi * t / 0.6))]
GROUNDS = {"record": (RECORD, LINES), "sine": (SINE, CYCLE)}
# Periods, dampings and gains of the buildings, from the ground up.
CHAINS = {
    "floor": [(0.5, 0.05, 1.0)],
    "stiff floor": [(0.08, 0.02, 1.0)],
    "roof of three": [(0.6, 0.05, 1.22)],
    "isolated": [(2.0, 0.15, 1.0), (0.3, 0.03, 1.0)],
    "in resonance": [(0.5, 0.05, 1.0), (0.5, 0.05, 0.7)],
}
BLOCK = rk.Block(0.2, 3.0)


def slow(*case):
    """Mark a case that compiles for seconds."""
    return pytest.param(*case, marks=pytest.mark.slow)


def floor_of(motion, chain):
    """Return the floor at the top of a chain of oscillators."""
    for period, damping, gain in chain:
        motion = on_floor(motion, period=period, damping=damping, gain=gain)
    return motion


def floor_acceleration(ground, chain, states):
    """Return the acceleration of the last floor [g], and y'/g and y''/g of all oscillators, of states (y/g, y'/g)."""
    changes = []
    for (period, damping, gain), place, speed in zip(chain, states[::2], states[1::2]):
        omega = 2 * np.pi / period
        relative = -2 * damping * omega * speed - omega**2 * place - ground
        changes += [speed, relative]
        ground = ground + gain * relative
    return ground, changes


def judged_acceleration(pieces, chain, times):
    """Follow the oscillators piece by piece; return the acceleration at shares `times` of every piece."""
    states, found = np.zeros(2 * len(chain)), []
    for begin, end, ground in [*pieces, (pieces[-1][1], pieces[-1][1] + 3.0, lambda t: 0.0)]:

        def change(t, y, ground=ground):
            return floor_acceleration(ground(t), chain, y)[1]

        solution = solve_ivp(change, (begin, end), states, "DOP853", rtol=1e-12, atol=1e-15, dense_output=True)
        states = solution.y[:, -1]
        at = begin + times * (end - begin)
        found.append((at, [floor_acceleration(ground(t), chain, solution.sol(t))[0] for t in at]))
    return (np.concatenate(x) for x in zip(*found))


class Together:
    """Oscillators and a block as one system, followed by DOP853 from event to event."""

    alpha, p = 0.2, 3.0

    def __init__(self, pieces, chain, factor):
        last = pieces[-1][1]
        rest = [(last + 0.25 * k, last + 0.25 * (k + 1), lambda t: 0.0) for k in range(6)]
        self.pieces, self.chain, self.factor = [*pieces, *rest], chain, factor
        self.states, self.side, self.peak, self.time = np.zeros(2 * len(chain) + 2), 0, 0.0, 0.0

    def change(self, t, y):
        u, changes = floor_acceleration(self.ground(t), self.chain, y[:-2])
        if self.side == 0:
            return [*changes, 0.0, 0.0]
        arm = self.alpha - y[-2]
        return [*changes, y[-1], -(self.p**2) * (np.sin(arm) + self.side * self.factor * u * np.cos(arm))]

    def push(self, t, y):
        return self.factor * floor_acceleration(self.ground(t), self.chain, y[:-2])[0]

    def lifts(self, t, y):
        return 1.0 if self.side else np.tan(self.alpha) - abs(self.push(t, y))

    def lands(self, t, y):
        return y[-2] if self.side and t > self.time + 1e-9 else 1.0

    def turns(self, t, y):
        return y[-1] if self.side else 1.0

    def follow(self):
        """Return the largest rotation."""
        events = [lambda t, y: self.lifts(t, y), lambda t, y: self.lands(t, y), lambda t, y: self.turns(t, y)]
        for event, stops in zip(events, (True, True, False)):
            event.terminal, event.direction = stops, -1
        for begin, end, ground in self.pieces:
            self.time, self.ground = begin, ground
            while self.time < end:
                found = solve_ivp(
                    self.change, (self.time, end), self.states, "DOP853", rtol=1e-12, atol=1e-14, events=events,
                    max_step=0.05,
                )  # fmt: skip
                self.peak = max([self.peak, *(y[-2] for y in found.y_events[2])])
                self.time, self.states = found.t[-1], found.y[:, -1]
                self.happen(len(found.t_events[0]), len(found.t_events[1]))
        return self.peak

    def happen(self, lifts, lands):
        if lifts:
            self.side = -int(np.sign(self.push(self.time, self.states)))
        elif lands:
            restitution = 1 - 1.5 * np.sin(self.alpha) ** 2
            self.side, self.states[-2], self.states[-1] = -self.side, 0.0, -restitution * self.states[-1]
            if self.states[-1] < 1e-4:
                self.side, self.states[-1] = 0, 0.0


@pytest.mark.parametrize(
    ("ground", "chain"),
    [
        *(("record", chain) for chain in CHAINS),
        ("sine", "floor"),
        ("sine", "isolated"),
        *(slow("sine", chain) for chain in ("stiff floor", "roof of three", "in resonance")),
    ],
)
def test_acceleration_of_dop853(ground, chain):
    motion, pieces = GROUNDS[ground]
    shares = np.linspace(0, 1, 8)[:-1] if ground == "record" else np.linspace(0, 1, 60)[:-1]
    times, judged = judged_acceleration(pieces, CHAINS[chain], shares)
    found = floor_of(motion, CHAINS[chain]).acceleration(times)
    np.testing.assert_allclose(found, judged, atol=1e-10)


@pytest.mark.parametrize(
    ("ground", "chain", "factor"),
    [
        ("record", "floor", 1.0),
        ("record", "roof of three", 0.735),
        ("record", "isolated", 0.8),
        ("sine", "floor", 1.0),
        slow("sine", "roof of three", 0.64),
        slow("sine", "isolated", 3.5),
    ],
)
def test_peak_of_building_and_block_as_one_system(ground, chain, factor):
    motion, pieces = GROUNDS[ground]
    found = rk.outcome(BLOCK, factor * floor_of(motion, CHAINS[chain]))
    assert found.status == rk.Status.successful and not found.overturned
    assert found.max_rotation > 0.002
    np.testing.assert_allclose(found.max_rotation, Together(pieces, CHAINS[chain], factor).follow(), atol=1e-10)


PULSES = [
    rk.RickerPulse(0.3, 0.8), rk.TriangularPulse(0.3, 0.7), rk.RectangularPulse(0.3, 0.5), RECORD.shifted(0.3),
    2.0 * RECORD, slow(RECORD + SINE), slow(rk.HalfSinePulse(0.3, 0.5)), slow(rk.CosinePulse(0.3, 0.8)),
    slow(rk.RickerPulse(0.3, 0.8, "antisymmetric")), slow(rk.ExponentialPulse(0.3, 0.8, 4.0)),
    slow(rk.ExponentialPulse(0.3, 0.8, -60.0)), slow(rk.MavroeidisPapageorgiouPulse(0.3, 0.8, 2.3, 0.5)),
]  # fmt: skip


@pytest.mark.parametrize("motion", PULSES, ids=lambda motion: type(motion).__name__)
def test_floor_by_the_convolution_integral(motion):
    """Duhamel: w = -u + integral of h(t - x) u(x), h the acceleration of a floor after a unit impulse."""
    period, damping, time = 0.4, 0.03, 0.93
    omega = 2 * np.pi / period
    knots = np.asarray(motion.knots)
    edges = np.unique(np.concatenate([knots[knots < time], [time], np.arange(0, time, 0.05)]))
    nodes, weights = np.polynomial.legendre.leggauss(20)
    half = np.diff(edges)[:, None] / 2
    at = edges[:-1, None] + half * (1 + nodes)
    damped, elapsed = omega * np.sqrt(1 - damping**2), time - at
    # After a unit impulse y/g = -e^(-damping omega t) sin(damped t)/damped, damped = omega sqrt(1 - damping^2).
    decay = np.exp(-damping * omega * elapsed) / damped
    place = decay * np.sin(damped * elapsed)
    speed = decay * (damped * np.cos(damped * elapsed) - damping * omega * np.sin(damped * elapsed))
    kernel = 2 * damping * omega * speed + omega**2 * place
    judged = np.sum(half * weights * kernel * np.asarray(motion.acceleration(at)))
    found = on_floor(motion, period=period, damping=damping).acceleration(time)
    np.testing.assert_allclose(found, judged, atol=2e-14)


@pytest.mark.parametrize("motion", [RECORD, SINE, rk.RickerPulse(0.3, 0.8)], ids=["record", "sine", "ricker"])
def test_a_stiff_building_moves_with_the_ground(motion):
    times = np.linspace(0.0, float(motion.end), 300)[1:-1]
    found = on_floor(motion, period=2e-3, damping=0.5).acceleration(times)
    np.testing.assert_allclose(found, motion.acceleration(times), atol=2e-3)


def test_gain_zero_is_the_ground():
    times = np.linspace(0.01, 1.9, 50)
    found = on_floor(RECORD, period=0.5, gain=0.0).acceleration(times)
    np.testing.assert_allclose(found, RECORD.acceleration(times), atol=1e-15)


def test_response_spectrum_of_an_undamped_oscillator():
    """With little damping the acceleration of a floor is its pseudo-acceleration (Nigam & Jennings 1969)."""
    for period in (0.1, 0.5, 1.7):
        peak = rk.intensity.peak_acceleration(on_floor(RECORD, period=period, damping=1e-3))
        pseudo = rk.intensity.spectral_acceleration(RECORD, period, damping=1e-3)
        np.testing.assert_allclose(peak, pseudo, rtol=1e-5)


@pytest.mark.slow
def test_interpolated_samples_of_a_floor_are_not_exact():
    motion, times, errors = on_floor(RECORD, period=0.5), np.linspace(0.0, 1.9, 997), []
    exact = np.asarray(motion.acceleration(times))
    for parts in (1, 4, 16):
        at = np.arange(0, 2.0 + STEP, STEP / parts)
        samples = rk.Record(np.asarray(motion.acceleration(at)), STEP / parts).acceleration(times)
        errors.append(np.abs(samples - exact).max() / np.abs(exact).max())
    assert errors[0] > 1e-2
    np.testing.assert_allclose(errors, errors[0] / 16.0 ** np.arange(3), rtol=0.6)


@pytest.mark.parametrize(
    "motion",
    [
        *(floor_of(RECORD, CHAINS[name]) for name in ("floor", "stiff floor")),
        floor_of(SINE, CHAINS["floor"]),
        *(slow(floor_of(RECORD, CHAINS[name])) for name in ("roof of three", "isolated", "in resonance")),
        *(slow(floor_of(SINE, CHAINS[name])) for name in CHAINS if name != "floor"),
        on_floor(RECORD, period=0.01),
        slow(on_floor(RECORD + SINE, period=0.3)),
        -1.7 * on_floor(RECORD, period=0.3),
    ],
)
def test_bounds_bound(motion):
    knots, bounds = np.asarray(motion.knots), np.asarray(motion.bounds)
    times = knots[:-1, None] + np.diff(knots)[:, None] * np.linspace(0, 1, 200)[:-1]
    largest = np.abs(motion.acceleration(times)).max(axis=1)
    assert (largest <= bounds * (1 + 1e-12) + 1e-15).all()
    assert largest.max() > 0.9 * bounds.max()
    lasts = bounds > 0
    assert np.median(largest[lasts] / bounds[lasts]) > 0.85


def test_the_ringing_ends_at_rounding():
    motion = on_floor(RECORD, period=0.5, damping=0.02)
    lasts = float(motion.end - RECORD.end)
    np.testing.assert_allclose(lasts, np.log(2.0**52) / (0.02 * 2 * np.pi / 0.5))
    assert abs(float(motion.acceleration(motion.end - 1e-9))) < 1e-15
    assert float(motion.acceleration(RECORD.end + 0.01)) != 0.0


def slope(peaks, x, step):
    """Return the derivative by central differences of fourth order."""
    outer, inner = (np.diff(peaks(x + k * step * np.array([-1.0, 1.0])))[0] / (2 * k * step) for k in (2, 1))
    return (4 * inner - outer) / 3


@pytest.mark.parametrize(
    ("ground", "name"),
    [
        ("record", "period"),
        ("sine", "period"),
        *(slow(ground, name) for ground in GROUNDS for name in ("damping", "gain")),
    ],
)
def test_derivatives_by_the_building(ground, name):
    motion, values = GROUNDS[ground][0], {"period": 0.5, "damping": 0.05, "gain": 1.2}

    def peak(x):
        return rk.outcome(BLOCK, on_floor(motion, **{**values, name: x})).max_rotation

    expected = slope(jax.jit(jax.vmap(peak)), values[name], 1e-5)
    np.testing.assert_allclose(jax.jit(jax.grad(peak))(values[name]), expected, rtol=1e-7)


def test_derivatives_by_all_samples():
    def peak(samples):
        return rk.outcome(BLOCK, on_floor(rk.Record(samples, STEP), period=0.5)).max_rotation

    way = np.cos(np.arange(40.0))
    expected = slope(jax.vmap(lambda x: peak(SAMPLES + x * way)), 0.0, 1e-6)
    np.testing.assert_allclose(jax.grad(peak)(jnp.asarray(SAMPLES)) @ way, expected, rtol=1e-7)


def test_sensitivities_name_the_building():
    names = parameters.named(BLOCK, on_floor(SINE, period=0.5))
    assert set(names) == {"alpha", "p", "restitution", "period", "damping", "gain", "amplitude", "motion.period"}


@pytest.mark.parametrize("motion", [RECORD, slow(SINE)])
def test_many_periods_at_once(motion):
    periods = jnp.array([0.3, 0.5, 0.8])
    many = jax.vmap(lambda t: rk.outcome(BLOCK, on_floor(motion, period=t)))(periods)
    for k, period in enumerate(periods):
        one = rk.outcome(BLOCK, on_floor(motion, period=float(period)))
        np.testing.assert_allclose(many.max_rotation[k], one.max_rotation, rtol=1e-9)


@pytest.mark.slow
def test_a_mirrored_floor_mirrors_the_block_and_floors_are_linear():
    plain = rk.outcome(BLOCK, on_floor(RECORD, period=0.5))
    for other in (
        -on_floor(RECORD, period=0.5),
        on_floor(-RECORD, period=0.5),
        on_floor(RECORD.shifted(0.4), period=0.5),
        on_floor(RECORD, period=0.5).shifted(0.4),
        on_floor(0.25 * RECORD, period=0.5) + 0.75 * on_floor(RECORD, period=0.5),
    ):
        np.testing.assert_allclose(rk.outcome(BLOCK, other).max_rotation, plain.max_rotation, rtol=1e-9)


def test_the_vertical_acceleration_is_that_of_the_ground():
    vertical = rk.SinePulse(0.3, 0.7)
    inside = on_floor(RECORD.with_vertical(vertical), period=0.5)
    outside = on_floor(RECORD, period=0.5).with_vertical(vertical)
    found, expected = (rk.outcome(BLOCK, motion).max_rotation for motion in (inside, outside))
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    assert abs(found - rk.outcome(BLOCK, on_floor(RECORD, period=0.5)).max_rotation) > 1e-4


@pytest.mark.slow
def test_a_suite_of_floors():
    suite = rk.motions.Suite([RECORD, 0.8 * RECORD])
    floors = rk.motions.Suite([on_floor(motion, period=0.5) for motion in suite])
    many = jax.vmap(lambda k: rk.outcome(BLOCK, on_floor(suite[k], period=0.5)))(jnp.arange(2))
    for k in range(2):
        np.testing.assert_allclose(many.max_rotation[k], rk.outcome(BLOCK, floors[k]).max_rotation, rtol=1e-9)


@pytest.mark.slow
def test_histories_and_the_diffrax_engine():
    motion = on_floor(RECORD, period=0.5)
    series = rk.outcome(BLOCK, motion)
    history = rk.simulate(BLOCK, motion)
    np.testing.assert_allclose(np.abs(history.rotation).max(), series.max_rotation, rtol=2e-3)
    diffrax = rk.outcome(BLOCK, on_floor(SINE, period=0.5), engine=rk.Diffrax())
    np.testing.assert_allclose(
        diffrax.max_rotation, rk.outcome(BLOCK, on_floor(SINE, period=0.5)).max_rotation, rtol=1e-7
    )


@pytest.mark.slow
def test_critical_amplitudes_of_a_floor():
    motion = on_floor(SINE, period=0.5)
    critical = rk.critical_amplitudes(BLOCK, motion)
    assert critical.count > 50 and not critical.balanced.any()  # the floor goes on ringing
    np.testing.assert_allclose(critical.scale * rk.intensity.peak_acceleration(motion), critical.value, rtol=1e-9)
    for scale, rises in zip(critical.scale[:6], critical.rising):
        below, above = (bool(rk.outcome(BLOCK, x * scale * motion).overturned) for x in (1 - 1e-8, 1 + 1e-8))
        assert (below, above) == (not rises, rises)


@pytest.mark.slow
@pytest.mark.parametrize("how", [{}, {"max_ends": 2}])
def test_derivatives_of_critical_amplitudes_by_the_building(how):
    """Where the ringing is over before the block comes to balance; also by the peak of the floor, which changes."""
    building = {"period": 0.1, "damping": 0.9, "gain": 1.2}

    def found(**more):
        motion = on_floor(SINE, **building | more)
        return rk.critical_amplitudes(BLOCK, motion, **how)

    critical = found()
    assert critical.balanced.all()
    for name, value in building.items():
        step = 1e-4 * value
        low, high = (np.asarray(found(**{name: value + x}).value) for x in (-step, step))
        slopes = critical.derivative[..., critical.names.index(name)]
        np.testing.assert_allclose(slopes, (high - low) / (2 * step), rtol=1e-5)


@pytest.mark.parametrize("ground", [RECORD, slow(SINE)])
def test_accelerations_of_single_precision(ground):
    motion = on_floor(ground, period=0.5)
    half, times = jax.tree.map(jnp.float32, motion), np.linspace(0.01, 3.0, 50)
    np.testing.assert_allclose(half.acceleration(times), motion.acceleration(times), atol=2e-6)


def test_peaks_of_single_precision():
    found = rk.outcome(*jax.tree.map(jnp.float32, (BLOCK, on_floor(SINE, period=0.5))))
    assert found.status == rk.Status.successful and found.max_rotation.dtype == jnp.float32
    expected = rk.outcome(BLOCK, on_floor(SINE, period=0.5)).max_rotation
    np.testing.assert_allclose(found.max_rotation, expected, rtol=5e-3)


@pytest.mark.parametrize("damping", [0.0, 1.0, -0.1, np.nan])
def test_damping_out_of_range(damping):
    with pytest.raises(ValueError, match=r"Argument `damping` must be in \(0, 1\)"):
        on_floor(RECORD, period=0.5, damping=damping)


def test_a_period_far_too_short_for_a_curved_motion():
    with pytest.raises(ValueError, match="Argument `period` must be long enough"):
        on_floor(rk.SinePulse(0.3, 1e5), period=1e-3)
    with pytest.raises(Exception, match="where it is traced"):
        jax.vmap(lambda t: rk.outcome(BLOCK, on_floor(SINE, period=t)).max_rotation)(jnp.array([0.5, 1e-4]))


def test_a_floor_that_leaves_the_periods_for_which_it_is_exact_says_so():
    shorter = eqx.tree_at(lambda motion: motion.period, on_floor(SINE, period=0.5), jnp.asarray(0.02))
    assert rk.outcome(BLOCK, shorter).status == rk.Status.not_finite
