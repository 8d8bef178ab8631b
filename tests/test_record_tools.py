"""Derived records: a displacement fused with an accelerometer, and the pulse in a record."""

import functools

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from scipy.optimize import minimize

import jaxrock as rk
from jaxrock.motions.piecewise_linear import piecewise_linear
from jaxrock.motions.pulse_fit import _models, _Problem

DT = 0.01
TIME = DT * np.arange(2001)
GROUND = rk.Record(
    0.25 * np.sin(2 * np.pi * 1.1 * TIME) * np.exp(-(((TIME - 9) / 2.5) ** 2))
    + 0.03 * np.sin(2 * np.pi * 0.15 * TIME) * np.exp(-(((TIME - 10) / 3) ** 2)),
    DT,
)
PLACE = piecewise_linear(GROUND).displacement
NOISE = np.random.default_rng(8)

# ------------------------------------------------------------------------------------------------ fused


@pytest.mark.parametrize("step", [1, 2, 10])
def test_what_both_sensors_agree_on_stays(step):
    """Also where the displacement is sampled less often than the acceleration."""
    found = rk.processing.fused(GROUND, PLACE[::step], step * DT, corner=0.5)
    np.testing.assert_allclose(found.samples[:-100], GROUND.samples[:-100], atol=1e-3 if step == 10 else 2e-5)


@pytest.mark.parametrize("begin, end", [(0, 2001), (800, 1100), (900, 931)])
def test_what_both_agree_on_stays_at_both_ends(begin, end):
    """Also where the ground moves at once, and when the sensors are switched off."""
    part = rk.Record(GROUND.samples[begin:end], DT)
    found = rk.processing.fused(part, piecewise_linear(part).displacement, DT, corner=0.5)
    np.testing.assert_allclose(found.samples, part.samples, atol=1e-5)


def test_two_bad_sensors_make_a_good_one():
    """Fuse two bad sensors: the accelerometer drifts and the displacement is noisy, but together they are accurate."""
    drifting = rk.Record(GROUND.samples + 0.003 * np.cos(0.2 * TIME) + 0.002, DT)
    noisy = PLACE + NOISE.normal(0, 1e-3, TIME.size)
    found = rk.processing.fused(drifting, 100 * noisy, DT, unit="cm", corner=0.3)
    wrong = [np.abs(piecewise_linear(each).displacement - PLACE).max() for each in (drifting, found)]
    assert wrong[0] > 2.0 and wrong[1] < 0.02
    alone = rk.processing.from_displacement(noisy, DT)
    errors = [np.std(np.asarray(each.samples - GROUND.samples)[100:-100]) for each in (alone, found)]
    assert errors[0] > 1.0 and errors[1] < 2e-3


@pytest.mark.parametrize(
    "drift, error",
    [
        pytest.param(lambda t: 0.02 + 0 * t, 1e-5, id="constant"),
        pytest.param(lambda t: 0.002 * t - 0.01, 1e-5, id="ramp"),
        pytest.param(lambda t: 0.01 * np.cos(0.15 * t), 5e-4, id="wave"),
    ],
)
@pytest.mark.parametrize("dt, corner", [(DT, 0.5), (0.001, 0.5), (0.007, 0.3), (0.05, 0.5)])
def test_a_drift_is_taken_off_up_to_both_ends(drift, error, dt, corner):
    """All of it: it came back over the last 1/corner, and left the ground moving at the end."""
    time = DT * np.arange(1501)
    ground = rk.Record(0.2 * np.sin(2 * np.pi * 0.8 * time) * np.exp(-(((time - 7) / 2) ** 2)), DT)
    fine = dt * np.arange(int(15 / dt + 1e-9) + 1)
    place = CubicHermiteSpline(time, piecewise_linear(ground).displacement, piecewise_linear(ground).velocity)(fine)
    found = rk.processing.fused(rk.Record(ground.samples + drift(time), DT), place, dt, corner=corner)
    count = found.samples.size
    assert count == (1501 if 15 / dt == round(15 / dt) else 1500)
    np.testing.assert_allclose(found.samples, ground.samples[:count], atol=error if dt <= DT else 5e-4)
    assert abs(piecewise_linear(found).velocity[-1] - piecewise_linear(ground).velocity[count - 1]) < 1e-3


@pytest.mark.parametrize("count", [2, 3, 5])
@pytest.mark.parametrize("dt", [DT, 0.001, 0.5])
def test_few_samples_have_no_drift_either(count, dt):
    found = rk.processing.fused(rk.Record(np.full(count, 0.02), DT), np.zeros(60), dt, corner=0.5)
    np.testing.assert_allclose(found.samples, np.zeros(count), atol=1e-12)


def test_noise_of_a_displacement_stays_small_at_both_ends():
    noisy = PLACE + NOISE.normal(0, 1e-4, TIME.size)
    found = rk.processing.fused(rk.Record(GROUND.samples + 0.02, DT), noisy, DT, corner=0.5)
    np.testing.assert_allclose(found.samples, GROUND.samples, atol=3e-4)
    assert abs(piecewise_linear(found).velocity[-1] - piecewise_linear(GROUND).velocity[-1]) < 3e-3


def test_fast_noise_of_a_displacement_does_not_come_back_as_slow():
    """It is sampled ten times as often as the acceleration, with a hum of 97 Hz that would look like 3 Hz."""
    fine = np.interp(0.001 * np.arange(20001), TIME, PLACE) + 1e-4 * np.sin(2 * np.pi * 97 * 0.001 * np.arange(20001))
    found = rk.processing.fused(GROUND, fine, 0.001, corner=0.5)
    np.testing.assert_allclose(found.samples[10:-100], GROUND.samples[10:-100], atol=1e-3)


def test_the_shorter_one_ends_both():
    assert rk.processing.fused(GROUND, PLACE[:1501], DT).samples.size == 1501
    longer = np.concatenate([PLACE, np.full(300, PLACE[-1])])
    assert rk.processing.fused(GROUND, longer, DT).samples.size == TIME.size


@pytest.mark.parametrize(
    "given, message",
    [
        ({"corner": 50.0}, "`corner` must be above 0 and below half the sampling rate, 50 Hz"),
        ({"dt": 0.5, "corner": 2.0}, "`corner` must be above 0 and below half the sampling rate, 1 Hz"),
        ({"displacement": [0.0, 1.0]}, "at least 4 samples"),
        ({"unit": "g"}, "`unit` must be one of 'm', 'cm', 'mm'"),
    ],
)
def test_what_cannot_be_fused(given, message):
    with pytest.raises(ValueError, match=message):
        rk.processing.fused(**{"record": GROUND, "displacement": PLACE, "dt": DT} | given)


# ---------------------------------------------------------------------------------------------- pulses


def sampled(pulse, noise=0.0, dt=0.005, end=8.0):
    time = dt * np.arange(round(end / dt) + 1)
    return rk.Record(np.asarray(pulse.acceleration(time)) + NOISE.normal(0, noise, time.size), dt)


@pytest.mark.parametrize(
    "pulse, parameters, delay, digits",
    [
        (
            rk.MavroeidisPapageorgiouPulse,
            {"amplitude": 0.3, "period": 1.3, "oscillations": 1.8, "phase": 0.7},
            2.3,
            1e-3,
        ),
        (rk.SinePulse, {"amplitude": -0.2, "period": 0.8}, 1.2345, 1e-3),
        (rk.TriangularPulse, {"amplitude": 0.4, "duration": 0.9}, 3.0, 1e-3),
        pytest.param(
            *(functools.partial(rk.RickerPulse, kind="antisymmetric"), {"amplitude": 0.3, "period": 1.1}, 1.0, 1e-3),
            marks=pytest.mark.slow,
        ),
    ],
    ids=lambda x: getattr(x, "__name__", None),
)
def test_a_pulse_is_found_again(pulse, parameters, delay, digits):
    fit = rk.motions.fit_pulse(sampled(pulse(**parameters).shifted(delay)), pulse, starts=3)
    assert fit.status == rk.motions.PulseStatus.successful and fit.explained > 1 - 1e-5
    for name, value in (parameters | {"delay": delay}).items():
        assert fit.values[name] == pytest.approx(value, rel=digits, abs=digits), name
    assert np.abs(fit.residual.samples).max() < 0.02 * 0.4


@pytest.mark.parametrize("cycles", [20.0, 200.0])
def test_the_velocity_that_is_fitted_follows_every_cycle(cycles):
    """The velocity by its formula judges integrals over as many parts as the ranges ask for."""
    record = rk.Record(np.asarray(rk.SinePulse(0.2, 0.5).acceleration(0.01 * np.arange(400))), 0.01)
    ranges = {"amplitude": (0.2, 0.4), "period": (0.1, 0.3), "oscillations": (2.0, cycles), "phase": (0.0, 1.0)}
    problem = _Problem.of(record, rk.MavroeidisPapageorgiouPulse, ranges | {"delay": (0.0, 1.0)}, "velocity")
    size, period, phase = 0.3, 0.2, 0.4
    time = np.linspace(0.0, cycles * period, 777)
    x = time - time[-1] / 2
    velocity = (1 + np.cos(2 * np.pi * x / time[-1])) * np.cos(2 * np.pi * x / period + phase)
    expected = 9.81 * size * period / (4 * np.pi) * velocity
    place = np.array([size, np.log(period), cycles, phase, 0.0])
    assert problem.kind.names == ("amplitude", "period", "oscillations", "phase", "delay")
    np.testing.assert_allclose(_models(problem.kind, place[None], time)[0], expected, atol=1e-8)
    assert problem.kind.parts == (128 if cycles < 100 else 1024)


def test_ranges_of_too_many_cycles_are_refused():
    ranges = {"oscillations": (2.0, 1e6)}
    with pytest.raises(ValueError, match="`ranges` must hold pulses that last at most 32768 times the time"):
        rk.motions.fit_pulse(sampled(rk.SinePulse(0.2, 0.5)), rk.MavroeidisPapageorgiouPulse, ranges)


def exponential(time, amplitude, duration, shape):
    """Voyagaki et al. (2012), equation 2.1, in NumPy."""
    x = np.clip(time / duration, 0.0, 1.0)
    rise = np.expm1(2 * shape * np.minimum(x, 1 - x)) / np.expm1(shape)
    return amplitude * np.where((time >= 0) & (time <= duration), rise, 0.0)


def sine(time, amplitude, period):
    return amplitude * np.where((time >= 0) & (time <= period), np.sin(2 * np.pi * time / period), 0.0)


@pytest.mark.parametrize(
    "form, pulse, truth, of",
    [
        (sine, rk.SinePulse, (0.3, 1.0, 2.0), "velocity"),
        pytest.param(exponential, rk.ExponentialPulse, (0.3, 1.0, 1.5, 2.0), "velocity", marks=pytest.mark.slow),
        pytest.param(exponential, rk.ExponentialPulse, (0.3, 1.0, 1.5, 2.0), "acceleration", marks=pytest.mark.slow),
    ],
)
def test_a_pulse_in_noise_is_a_least_square(form, pulse, truth, of):
    """SciPy's search without derivatives, from the truth, finds nothing lower."""
    time, fine = 0.005 * np.arange(1601), 0.001 * np.arange(8001)
    noise = np.random.default_rng(8).normal(0, 0.02, time.size)  # of its own: whatever ran before
    record = rk.Record(form(time - truth[-1], *truth[:-1]) + noise, 0.005)
    ranges = {"duration": (0.3, 3.0), "shape": (-8, 8)} if pulse is rk.ExponentialPulse else None
    fit = rk.motions.fit_pulse(record, pulse, ranges, of=of, starts=2)
    target = piecewise_linear(record).velocity if of == "velocity" else np.asarray(record.samples)

    def cost(x):
        if of == "acceleration":
            return np.sum((form(time - x[-1], *x[:-1]) - target) ** 2)
        samples = form(fine - x[-1], *x[:-1])
        velocity = 9.81 * 0.001 * np.concatenate([[0.0], np.cumsum((samples[1:] + samples[:-1]) / 2)])
        return np.sum((velocity[::5] - target) ** 2)

    found = np.array(list(fit.values.values()))
    best = minimize(cost, truth, method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-12})
    assert cost(found) <= best.fun * (1 + 1e-3)
    assert 1 - cost(found) / np.sum(target**2) == pytest.approx(fit.explained, abs=1e-4)


def test_the_pulse_that_is_left_out_and_the_one_that_is_left():
    two = rk.SinePulse(0.4, 1.2).shifted(1.0) + rk.SinePulse(0.2, 0.5).shifted(4.0)
    record = sampled(two)
    first = rk.motions.fit_pulse(record, rk.SinePulse, {"period": (0.3, 3.0)}, starts=2)
    second = rk.motions.fit_pulse(first.residual, rk.SinePulse, {"period": (0.3, 3.0)}, starts=2)
    assert (first.values["period"], second.values["period"]) == (
        pytest.approx(1.2, rel=2e-3),
        pytest.approx(0.5, rel=1e-2),
    )
    assert float(first.motion.end) == pytest.approx(2.2, rel=1e-2)


def test_an_end_of_a_range_is_told():
    fit = rk.motions.fit_pulse(
        sampled(rk.SinePulse(0.4, 1.2).shifted(1.0)), rk.SinePulse, {"period": (1.5, 3.0)}, starts=1
    )
    assert fit.status == rk.motions.PulseStatus.at_an_end and fit.at_ends == ("period",)


def made(amplitude, width):
    return rk.SinePulse(amplitude, width)


@pytest.mark.parametrize(
    "given, message",
    [
        ({"pulse": made}, "`ranges` must hold a range of `width`, but does not"),
        ({"pulse": lambda period: rk.SinePulse(1.0, period)}, "`pulse` must have an `amplitude`"),
        ({"ranges": {"duration": (1, 2)}}, "`ranges` must hold amplitude, period, delay, but holds 'duration'"),
        ({"ranges": {"period": (2.0, 1.0)}}, "`ranges` must rise, but that of `period` is 2 to 1"),
        ({"record": rk.Record(np.zeros(50), 0.1)}, "`record` must move"),
        ({"of": "displacement"}, "`of` must be one of 'velocity', 'acceleration'"),
    ],
)
def test_what_cannot_be_fitted(given, message):
    with pytest.raises(ValueError, match=message):
        rk.motions.fit_pulse(**{"record": GROUND, "pulse": rk.SinePulse} | given)
