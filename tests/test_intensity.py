"""Measures of intensity: closed forms of harmonic pulses, direct quadrature, and another integrator of oscillators."""

import itertools
import tracemalloc
import warnings

import jax
import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid, quad
from scipy.linalg import expm

import jaxrock as rk
from jaxrock.motions.measures import measure_of, strengths
from jaxrock.motions.piecewise_linear import piecewise_linear

G, A, T = 9.81, 0.3, 0.8
SINE = rk.SinePulse(A, T)
NOISE = np.random.default_rng(3).normal(0, 0.2, 400)
RECORD = rk.Record(NOISE, 0.02)


OF_SAMPLES = 0.02 * np.arange(NOISE.size)


def lines(time):
    return G * np.interp(time, OF_SAMPLES, NOISE)


@pytest.mark.parametrize(
    "measure, expected",
    [
        pytest.param(rk.intensity.peak_displacement, A * G * T**2 / (2 * np.pi), id="PGD"),
        pytest.param(rk.intensity.velocity_to_acceleration, T / np.pi, id="PGV/PGA"),
        pytest.param(rk.intensity.arias, np.pi / (2 * G) * (A * G) ** 2 * T / 2, id="Arias"),
        pytest.param(rk.intensity.cumulative_absolute_velocity, A * G * T * 2 / np.pi, id="CAV"),
        pytest.param(lambda m: rk.intensity.uplift_ratio(m, rk.Block(0.2, 2.0)), A / np.tan(0.2), id="PGA/(g tan)"),
        pytest.param(
            lambda m: rk.intensity.velocity_ratio(m, rk.Block(0.2, 2.0)),
            2.0 * A * T / np.pi / np.tan(0.2),
            id="p PGV/(g tan)",
        ),
    ],
)
def test_of_a_sine_pulse(measure, expected):
    assert measure(SINE) == pytest.approx(expected, rel=1e-7)


@pytest.mark.parametrize("name, power", [("arias", 2), ("cumulative_absolute_velocity", 1), ("peak_displacement", 1),
                                         ("velocity_to_acceleration", 0), ("significant_duration", 0)])  # fmt: skip
def test_of_a_motion_twice_as_strong(name, power):
    measure = getattr(rk.intensity, name)
    assert measure(2.0 * SINE) == pytest.approx(2.0**power * measure(SINE), rel=1e-12)


def test_significant_duration_of_a_sine_pulse():
    """The share of Arias intensity by t is t/T - sin(4 pi t/T)/(4 pi)."""
    ends = [rk.intensity.significant_duration(SINE, 1e-9, share) for share in (0.05, 0.95)]
    begin = rk.intensity.significant_duration(SINE, 1e-9, 0.25) - T / 4  # by how much the first share is late
    found = (np.array(ends) - begin) / T
    np.testing.assert_allclose(found - np.sin(4 * np.pi * found) / (4 * np.pi), [0.05, 0.95], atol=1e-7)
    assert rk.intensity.significant_duration(SINE) == pytest.approx(np.diff(ends)[0], rel=1e-9)


def test_a_share_that_is_reached_before_a_pause():
    """Half of the intensity of two equal shocks has come where the pause begins, not where it ends."""
    record = rk.Record([0.3, 0.0, 0.0, 0.0, 0.0, 0.3], 1.0)
    assert rk.intensity.significant_duration(record, 0.25, 0.5) == pytest.approx(0.5 ** (1 / 3), rel=1e-4)


def test_of_a_record_by_quadrature():
    """Each line by itself: quadrature knows nothing of closed forms."""
    time = 0.02 * np.arange(NOISE.size)

    def summed(function):
        return sum(quad(function, a, b, epsabs=1e-13, limit=200)[0] for a, b in zip(time[:-1], time[1:]))

    assert rk.intensity.arias(RECORD) == pytest.approx(np.pi / (2 * G) * summed(lambda t: lines(t) ** 2), rel=1e-10)
    cav = summed(lambda t: abs(lines(t)))
    assert rk.intensity.cumulative_absolute_velocity(RECORD) == pytest.approx(cav, rel=1e-6)
    fine = np.linspace(0, time[-1], 100 * (NOISE.size - 1) + 1)
    place = cumulative_trapezoid(cumulative_trapezoid(lines(fine), fine, initial=0), fine, initial=0)
    found = np.abs(place).max()
    with pytest.warns(UserWarning, match="its baseline drifts"):
        assert rk.intensity.peak_displacement(RECORD) == pytest.approx(found, rel=1e-6)


def test_peak_displacement_lies_between_samples():
    """Speed up, slow down, stop: the ground turns back within one line."""
    record = rk.Record([1.0, 1.0, -3.0, -3.0], 1.0)
    velocity, place = G * 1.0, G * 0.5
    # Then a = 1 - 4 t: v = 1 + t - 2 t^2 is zero at t = 1.
    assert rk.intensity.peak_displacement(record) == pytest.approx(place + velocity + G * (0.5 - 4 / 6), rel=1e-12)


FIRST_LINES = {
    "speeds up and slows down": ([1.0, -2.0], 1.0),
    "one line": ([0.4463746, -0.5369532], 0.1),
    "back and forth": ([0.3, -0.6, 0.3], 0.5),
    "from no acceleration": ([0.0, 0.4, -0.9], 0.3),
    "a constant, then back": ([0.2, 0.2, -0.7, -0.7], 0.3),
    "at rest for a while": ([0.0, 0.0, 0.0, 0.5, -1.0], 0.2),
}


@pytest.mark.parametrize("name", FIRST_LINES)
def test_peak_displacement_where_a_line_begins_at_rest(name):
    """Check the peak displacement of lines that begin at rest against cubics, exact for lines, at 100,000 times."""
    samples, dt = FIRST_LINES[name]
    time = np.linspace(0.0, dt * (len(samples) - 1), 100_001)
    velocity = cumulative_trapezoid(G * np.interp(time, dt * np.arange(len(samples)), samples), time, initial=0)
    largest = np.abs(cumulative_trapezoid(velocity, time, initial=0)).max()
    record = rk.Record(samples, dt)
    assert rk.intensity.peak_displacement(record) == pytest.approx(largest, rel=1e-7)
    suite = rk.motions.Suite([record, rk.SinePulse(A, T)])
    assert strengths("measure", measure_of("measure", "PGD"), suite)[0] == pytest.approx(largest, rel=1e-7)
    assert float(rk.intensity.peak_velocity(record)) == pytest.approx(np.abs(velocity).max(), rel=1e-7)


LONG_LINES = {  # period [s] and damping; lines last 0.2 to 40 s
    "undamped": (0.31, 0.0),
    "hardly damped": (0.05, 0.001),
    "usual": (0.4, 0.05),
    "strongly damped": (0.7, 0.6),
    "nearly critical": (0.9, 0.999),
}


@pytest.mark.parametrize("name", LONG_LINES)
def test_oscillators_under_lines_of_many_periods(name):
    """Exponentials of matrices are the judge, five hundred times a period."""
    period, damping = LONG_LINES[name]
    omega, samples = 2 * np.pi / period, [0.0, 0.3, -0.1, 0.0, 0.0, 0.05, 0.0]
    for step in (0.2, 3.0, 17.0):
        count = int(np.ceil(500 * step / period))
        system = np.array([[0, 1, 0, 0], [-(omega**2), -2 * damping * omega, -1, 0], [0, 0, 0, 1], [0, 0, 0, 0]])
        flows, state, largest = powers(expm(system * step / count), count + 1)[:, :2], np.zeros(2), np.zeros(2)
        for a, b in itertools.pairwise([*samples, 0.0, 0.0, 0.0]):
            states = flows @ np.append(state, [G * a, G * (b - a) / step])
            state, largest = states[-1], np.maximum(largest, np.abs(states).max(axis=0))
        record = rk.Record(samples, step)
        assert rk.intensity.spectral_velocity(record, period, damping) == pytest.approx(omega * largest[0], rel=1e-4)
        speed = rk.intensity.spectral_velocity(record, period, damping, pseudo=False)
        assert speed == pytest.approx(largest[1], rel=1e-4)


@pytest.mark.parametrize("gap", [3600.0, 86400.0])
def test_quiet_between_shocks_costs_nothing(gap):
    """Measures of shocks that do not overlap are sums, maxima, or those of the first; quiet between them changes
    none."""
    shock = rk.processing.cut(rk.example_record(), 3.0, 13.0)
    shock = rk.processing.baseline_corrected(rk.processing.tapered(shock, 1.0))
    both = shock + 0.5 * shock.shifted(gap)
    periods = [0.05, 1.0]
    tracemalloc.start()
    found = rk.intensity.spectral_acceleration(both, periods)
    period = rk.intensity.mean_period(both)
    assert tracemalloc.get_traced_memory()[1] < 100e6
    tracemalloc.stop()
    np.testing.assert_allclose(found, rk.intensity.spectral_acceleration(shock, periods), rtol=1e-6)
    assert period == pytest.approx(rk.intensity.mean_period(shock), rel=2e-4)
    for measure, more in ((rk.intensity.arias, 1.25), (rk.intensity.cumulative_absolute_velocity, 1.5)):
        assert measure(both) == pytest.approx(more * measure(shock), rel=1e-6)
    first = rk.intensity.significant_duration(shock, 0.05, 0.5)
    assert rk.intensity.significant_duration(both, 0.04, 0.4) == pytest.approx(first, rel=1e-6)
    assert rk.intensity.significant_duration(both, 0.04, 0.99) > gap


@pytest.mark.parametrize("later", [3.0, 25.0, 300.0, 3600.0])
def test_mean_period_of_two_rectangles(later):
    """The squared amplitude of both is twice that of one times 1 + cos(2 pi f later): QUADPACK has a rule for it."""

    def power(f):
        return (np.sin(np.pi * f * 0.4) / f) ** 2

    def band(function):
        fast = quad(function, 0.25, 20, weight="cos", wvar=2 * np.pi * later, limit=2000, maxp1=200)[0]
        return quad(function, 0.25, 20, limit=500)[0] + fast

    one = rk.RectangularPulse(0.3, 0.4)
    expected = band(lambda f: power(f) / f) / band(power)
    assert rk.intensity.mean_period(one + one.shifted(later)) == pytest.approx(expected, rel=1e-4)


def test_mean_period_of_a_sequence_by_one_long_transform():
    random = np.random.default_rng(7).normal(0, 0.1, 500) * np.hanning(500)
    samples = np.zeros(20_000)
    for first in (0, 3_000, 11_000, 19_000):
        samples[first : first + 500] += random * (1 + first / 1e4)
    count = 1 << 21
    frequency = np.fft.rfftfreq(count, 0.01)
    power = np.abs(np.fft.rfft(samples, count) * np.sinc(0.01 * frequency) ** 2) ** 2
    within = (frequency > 0.25) & (frequency < 20)
    expected = (power / np.maximum(frequency, 1e-9))[within].sum() / power[within].sum()
    assert rk.intensity.mean_period(rk.Record(samples, 0.01)) == pytest.approx(expected, rel=1e-4)


def pulse_of_many_cycles(cycles):
    return rk.MavroeidisPapageorgiouPulse(0.3, 0.5, cycles, 0.4)


@pytest.mark.parametrize("cycles", [8.0, 300.0])
def test_many_cycles_within_one_piece(cycles):
    """Sums over times, four hundred a cycle, of the velocity by its formula and of its derivative are the judge."""
    count = 400
    time = (np.arange(int(cycles * count)) + 0.5) * 0.5 / count
    bell, wave = 4 * np.pi / cycles, 4 * np.pi
    x = time - cycles / 4
    size = A * G * 0.5 / (2 * np.pi) / 2
    velocity = size * (1 + np.cos(bell * x)) * np.cos(wave * x + 0.4)
    acceleration = -size * (
        bell * np.sin(bell * x) * np.cos(wave * x + 0.4) + (1 + np.cos(bell * x)) * wave * np.sin(wave * x + 0.4)
    )
    motion = pulse_of_many_cycles(cycles)
    assert rk.intensity.peak_velocity(motion) == pytest.approx(np.abs(velocity).max(), rel=1e-4)
    assert rk.intensity.peak_acceleration(motion) == pytest.approx(np.abs(acceleration).max() / G, rel=1e-4)
    step = time[1] - time[0]
    assert rk.intensity.cumulative_absolute_velocity(motion) == pytest.approx(
        np.abs(acceleration).sum() * step, rel=1e-4
    )
    assert rk.intensity.arias(motion) == pytest.approx(np.pi / 2 / G * (acceleration**2).sum() * step, rel=1e-6)
    place = np.cumsum(velocity) * step
    assert rk.intensity.peak_displacement(motion) == pytest.approx(np.abs(place).max(), rel=1e-2)


def test_a_wavelet_within_a_long_piece():
    """A wavelet in a long piece is as strong as one in a short piece."""
    long, close = (rk.RickerPulse(0.4, 0.1, center=where) for where in (50.0, None))
    for measure in (rk.intensity.peak_acceleration, rk.intensity.peak_velocity):
        assert measure(long) == pytest.approx(float(measure(close)), rel=1e-9)
    assert rk.intensity.arias(long) == pytest.approx(rk.intensity.arias(close), rel=1e-7)
    assert rk.intensity.spectral_acceleration(long, 0.1) == pytest.approx(
        float(rk.intensity.spectral_acceleration(close, 0.1)), rel=1e-5
    )


def test_many_cycles_in_a_suite():
    """The velocity at the middle is that of the envelope, independent of the cycles of others in the ensemble."""
    suite = rk.motions.Suite([rk.MavroeidisPapageorgiouPulse(A, 0.5, np.array([2.0, 300.0, 40.0]))])
    np.testing.assert_allclose(suite.peak_velocity, A * G * 0.5 / (2 * np.pi), rtol=1e-9)


def test_too_many_cycles_are_refused():
    for measure in (rk.intensity.peak_velocity, rk.intensity.arias):
        with pytest.raises(ValueError, match="`motion` must last at most .* make a `Record` of its relevant part"):
            measure(pulse_of_many_cycles(1e6))
    traced = jax.jit(lambda cycles: rk.intensity.peak_velocity(pulse_of_many_cycles(cycles)))
    np.testing.assert_allclose(traced(3.0), rk.intensity.peak_velocity(pulse_of_many_cycles(3.0)), rtol=1e-12)
    with pytest.raises(Exception, match="`motion` must have at most 20 cycles within a piece where it is traced"):
        jax.block_until_ready(traced(100.0))


OSCILLATORS = [(0.25, 0.05), (0.05, 0.05), (0.9, 0.0), (3.0, 0.2)]  # period [s], damping


def powers(matrix, count):
    return np.stack(list(itertools.accumulate([matrix] * (count - 1), np.matmul, initial=np.eye(4))))


def largest_by_another_integrator(period, damping):
    """Distance and speed by exponentials of matrices, which are exact under straight lines; 2000 times a sample."""
    omega, dt = 2 * np.pi / period, OF_SAMPLES[1]
    # Distance, speed, and of the ground acceleration and slope: their changes.
    changes = np.array([[0, 1, 0, 0], [-(omega**2), -2 * damping * omega, -1, 0], [0, 0, 0, 1], [0, 0, 0, 0]])
    few = powers(expm(changes * dt / 2000), 51)
    flow = (powers(few[-1], 40)[:, None] @ few).reshape(-1, 4, 4)
    ground = lines(OF_SAMPLES)
    states = np.zeros((4, ground.size + int(period / dt) + 1))  # the ground is still for a period more
    states[2:, : ground.size - 1] = ground[:-1], np.diff(ground) / dt
    for i in range(1, states.shape[1]):
        states[:2, i] = flow[-1, :2] @ states[:, i - 1]
    return np.abs(flow[:, :2] @ states).max(axis=(0, 2))


@pytest.mark.parametrize("period, damping", OSCILLATORS)
def test_spectra_by_another_integrator(period, damping):
    omega = 2 * np.pi / period
    place, speed = largest_by_another_integrator(period, damping)
    assert rk.intensity.spectral_acceleration(RECORD, period, damping) == pytest.approx(omega**2 * place / G, rel=1e-6)
    assert rk.intensity.spectral_velocity(RECORD, period, damping) == pytest.approx(omega * place, rel=1e-6)
    relative = rk.intensity.spectral_velocity(RECORD, period, damping, pseudo=False)
    assert relative == pytest.approx(speed, rel=1e-4)


@pytest.mark.parametrize("period", [0.9, 1.5, 6.0])
def test_residual_spectrum_of_a_half_sine(period):
    """Undamped, longer than two pulses: the peak is that of the free vibration after it (Chopra, 4.8.3)."""
    duration, b = 0.4, period / 0.8
    expected = A * abs(2 * b * np.cos(np.pi * duration / period) / (b**2 - 1))
    found = rk.intensity.spectral_acceleration(rk.HalfSinePulse(A, duration), period, 0.0)
    assert found == pytest.approx(expected, rel=1e-6)


def test_long_and_short_oscillators():
    """A stiff one moves with the ground, of a soft one the mass stays where it is."""
    record = rk.example_record()
    peak = float(rk.intensity.peak_acceleration(record))
    assert rk.intensity.spectral_acceleration(record, 0.004) == pytest.approx(peak, rel=2e-3)
    soft = rk.intensity.spectral_velocity(rk.SinePulse(A, T), 1000.0, 0.0) * 1000.0 / (2 * np.pi)
    assert soft == pytest.approx(A * G * T**2 / (2 * np.pi), rel=1e-3)


def test_average_spectral_acceleration():
    periods = [0.2, 0.5, 1.0]
    each = rk.intensity.spectral_acceleration(RECORD, periods)
    assert each.shape == (3,)
    average = rk.intensity.average_spectral_acceleration(RECORD, periods)
    assert average == pytest.approx(each.prod() ** (1 / 3), rel=1e-12)


@pytest.mark.parametrize("duration", [0.4, 1.3])
def test_mean_period_of_a_rectangle(duration):
    def power(f):
        return (np.sin(np.pi * f * duration) / f) ** 2

    below = quad(power, 0.25, 20, limit=500)[0]
    above = quad(lambda f: power(f) / f, 0.25, 20, limit=500)[0]
    assert rk.intensity.mean_period(rk.RectangularPulse(0.3, duration)) == pytest.approx(above / below, rel=1e-4)


def test_one_motion_has_one_mean_period():
    """However it is written: later, with a vertical part, at a shorter step, times a factor."""
    random = np.random.default_rng(2).normal(size=158)
    record = rk.Record(np.convolve(random, np.ones(8) / 8, "valid")[:150] * np.sin(np.pi * np.arange(150) / 149), 0.02)
    alike = (record.shifted(0.0), record.shifted(1.2345), record.with_vertical(record), -2.0 * record)
    for motion in (*alike, rk.processing.resampled(record, 0.002)):
        assert rk.intensity.mean_period(motion) == pytest.approx(rk.intensity.mean_period(record), rel=1e-6)
    assert rk.intensity.arias(record.shifted(1.2345)) == pytest.approx(rk.intensity.arias(record), rel=1e-12)


def test_mean_period_of_few_samples_a_second():
    """Compare the mean period of a record with few samples a second with that at a shorter step.

    Straight lines between samples have content above half of the sampling rate, too.
    """
    signs = np.where(np.arange(400) % 2, 0.1, -0.1)
    record = rk.Record((np.sin(2 * np.pi * np.arange(400) * 0.05) + signs) * (np.arange(400) % 399 > 0), 0.05)
    finer = rk.Record(np.interp(0.0125 * np.arange(1597), 0.05 * np.arange(400), record.samples), 0.0125)
    assert rk.intensity.mean_period(record) == pytest.approx(rk.intensity.mean_period(finer), rel=1e-5)


@pytest.mark.parametrize("samples", [[1.0, -0.5, 0.8], [0.3, 0.3, 0.3, 0.3], [-0.2, 0.9, 0.1, -0.7, 1.0]])
@pytest.mark.parametrize("step", [0.03, 0.4, 1.5])
def test_mean_period_of_a_record_that_begins_and_ends_with_a_jump(samples, step):
    """Its transform in closed form, by parts: jumps at the ends, and a corner at every sample."""
    times, slopes = step * np.arange(len(samples)), np.diff(samples) / step
    corners = np.diff(np.concatenate([[0.0], slopes, [0.0]]))

    def power(f):
        turn = 2j * np.pi * f
        turned = np.exp(-turn * times)
        jumps = samples[0] - samples[-1] * turned[-1]
        return abs(jumps / turn + corners @ turned / turn**2) ** 2

    below = quad(power, 0.25, 20, limit=2000)[0]
    above = quad(lambda f: power(f) / f, 0.25, 20, limit=2000)[0]
    assert rk.intensity.mean_period(rk.Record(samples, step)) == pytest.approx(above / below, rel=1e-5)


def test_mean_period_of_a_long_sine():
    record = rk.Record(np.sin(2 * np.pi * np.arange(40_000) * 0.005 / 0.5), 0.005)
    assert rk.intensity.mean_period(record) == pytest.approx(0.5, rel=3e-3)


def test_a_motion_made_of_pulses():
    """A pulse, a pause and its mirror image: every sum is twice that of one."""
    both = SINE + (-SINE).shifted(2.0)
    assert rk.intensity.arias(both) == pytest.approx(2 * rk.intensity.arias(SINE), rel=1e-6)
    assert rk.intensity.peak_displacement(both) == pytest.approx(rk.intensity.peak_displacement(SINE), rel=1e-6)


def test_a_drifting_baseline_warns():
    steady = rk.example_record()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rk.intensity.peak_velocity(steady)
        rk.intensity.peak_velocity(rk.HalfSinePulse(A, T))  # which is meant
    drifting = rk.Record(steady.samples + 0.02, steady.dt, "off")
    with pytest.warns(UserWarning, match="The ground of off ends with .* its baseline drifts"):
        rk.intensity.peak_velocity(drifting)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rk.intensity.peak_velocity(rk.processing.baseline_corrected(drifting, 1))


def test_a_displacement_that_is_drift_warns():
    """The velocity of this record ends near zero, its displacement does not."""
    steady = rk.example_record()
    with pytest.warns(UserWarning, match="The ground of .* ends 1.41 m away, its peak is 1.41 m: its baseline drifts"):
        rk.intensity.peak_displacement(steady)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert rk.intensity.peak_displacement(rk.processing.baseline_corrected(steady)) < 0.35
        rk.intensity.peak_displacement(rk.HalfSinePulse(A, T))  # which is meant


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: rk.intensity.spectral_acceleration(SINE, 0.0), "`period` must be from 0.001"),
        (lambda: rk.intensity.spectral_acceleration(SINE, 1.0, 1.0), r"`damping` must be in \[0, 1\)"),
        (lambda: rk.intensity.significant_duration(SINE, 0.5, 0.5), "`end` must be above `begin`"),
        (lambda: rk.intensity.significant_duration(0.0 * SINE), "`motion` must move"),
        (lambda: rk.intensity.velocity_to_acceleration(0.0 * SINE), "`motion` must move"),
        (lambda: rk.intensity.arias(rk.SinePulse(np.array([0.1, 0.2]), 1.0)), "`motion` must hold one scene"),
        (
            lambda: rk.intensity.velocity_ratio(rk.SinePulse(np.array([0.1, 0.2]), 1.0), rk.Block(0.2, 2.0)),
            "`motion` must hold one scene",
        ),
    ],
)
def test_what_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


BESIDE = {
    "a record that rests": (rk.Record(np.zeros(3), 1.0) + rk.SinePulse(0.3, 0.25), 0.3, 0.25),
    "a record that comes later": (rk.SinePulse(0.6, 1.0) + rk.example_record().shifted(5.0), 0.6, 1.0),
}


@pytest.mark.parametrize("case", BESIDE)
def test_a_pulse_among_many_pieces(case):
    """Its peaks lie within a piece of its own, however many pieces there are."""
    motion, amplitude, period = BESIDE[case]
    speed = amplitude * 9.81 * period / np.pi
    np.testing.assert_allclose(rk.intensity.peak_acceleration(motion), amplitude, rtol=1e-12)
    np.testing.assert_allclose(rk.intensity.peak_velocity(motion), speed, rtol=1e-9)
    np.testing.assert_allclose(np.abs(piecewise_linear(motion).velocity).max(), speed, rtol=1e-6)
    block = rk.Block(0.25, 2.0)
    np.testing.assert_allclose(rk.intensity.uplift_ratio(motion, block), amplitude / np.tan(0.25), rtol=1e-12)


def test_sums_over_a_pulse_beside_a_record():
    """Check that sums add up over a pulse and a record that do not overlap."""
    pulse, record = rk.SinePulse(0.6, 1.0), rk.example_record()
    both = pulse + record.shifted(5.0)
    for measure in (rk.intensity.arias, rk.intensity.cumulative_absolute_velocity):
        np.testing.assert_allclose(measure(both), measure(pulse) + measure(record), rtol=1e-6)


def test_ratios_to_a_block_are_functions_of_jax():
    block, step = rk.Block(0.2, 2.0), 1e-6
    measures = rk.intensity.uplift_ratio, rk.intensity.velocity_ratio

    def of(amplitude):
        return [measure(rk.SinePulse(amplitude, 0.6), block) for measure in measures]

    def and_beside(amplitude):
        found = of(amplitude)
        return found, found

    known, above, below = of(0.4), of(0.4 + step), of(0.4 - step)
    assert all(isinstance(value, float) for value in known)
    slopes, values = jax.jit(jax.jacrev(and_beside, has_aux=True))(0.4)
    np.testing.assert_allclose(values, known, rtol=1e-14)
    np.testing.assert_allclose(slopes, np.subtract(above, below) / (2 * step), rtol=1e-8)


@pytest.mark.parametrize("name, call", [
    ("motion", lambda x: rk.intensity.arias(rk.SinePulse(x, 0.6))),
    ("motion", lambda x: rk.intensity.velocity_to_acceleration(rk.SinePulse(x, 0.6))),
    ("record", lambda x: rk.processing.baseline_corrected(rk.Record(x * np.ones(9), 0.1))),
    ("record", lambda x: rk.motions.fit_pulse(rk.Record(x * np.ones(9), 0.1), rk.SinePulse)),
    ("factor", lambda x: rk.processing.scaled(rk.Record(np.ones(9), 0.1), factor=x)),
    ("outline", lambda x: rk.blocks.AsymmetricBlock.from_outline(x * np.array([[0.0, 0], [1, 0], [0, 1]])).p1),
])  # fmt: skip
def test_what_must_be_known_is_called_by_its_name(name, call):
    for way in (jax.jit(call), jax.grad(call)):
        with pytest.raises(ValueError, match=f"Argument `{name}` must be known"):
            way(0.4)
