"""Processing of records: each step against what it must preserve and what it must remove."""

import jax
import numpy as np
import pytest
import scipy.signal

import jaxrock as rk
from jaxrock.motions.filters import evenly, of_displacement, of_velocity, smoothed
from jaxrock.motions.piecewise_linear import piecewise_linear

G, DT = 9.81, 0.01
TIME = DT * np.arange(1001)
EVENT = rk.motions.Origin(event="Made", station="Here", component="090")
SMOOTH = rk.Record(0.2 * np.sin(2 * np.pi * TIME) * np.exp(-((TIME - 4) ** 2)), DT, "made", EVENT)
do = rk.processing


@pytest.mark.parametrize("first", [0.0, 0.1])
def test_a_record_comes_back_from_its_displacement(first):
    """The spline of the displacement is what straight lines of acceleration integrate to, from rest, with a jolt."""
    samples = np.asarray(SMOOTH.samples) + first * np.exp(-TIME)
    lines = piecewise_linear(rk.Record(samples, DT))
    found = do.from_displacement(100 * lines.displacement, DT, unit="cm")
    np.testing.assert_allclose(found.samples[:-20], samples[:-20], atol=1e-8)
    np.testing.assert_allclose(piecewise_linear(found).displacement, lines.displacement, atol=1e-12)


def test_a_record_comes_back_from_its_velocity():
    found = do.from_velocity(piecewise_linear(SMOOTH).velocity, DT)
    np.testing.assert_allclose(found.samples, SMOOTH.samples, atol=2e-4)
    np.testing.assert_allclose(piecewise_linear(found).velocity, piecewise_linear(SMOOTH).velocity, atol=2e-4)


def test_noise_of_a_displacement_needs_the_filter():
    place = piecewise_linear(SMOOTH).displacement + np.random.default_rng(1).normal(0, 1e-5, TIME.size)
    raw, smooth = (do.from_displacement(place, DT, corner=corner) for corner in (None, 8.0))
    assert np.abs(raw.samples - SMOOTH.samples).max() > 0.02
    assert np.abs(smooth.samples - SMOOTH.samples).max() < 2e-3


@pytest.mark.parametrize("corner", [5.0, 10.0, 25.0])
@pytest.mark.parametrize("hertz", [0.5, 1.5])
def test_the_filter_of_a_displacement_leaves_its_beginning(corner, hertz):
    """The ground moves at once; what is slower than the corner passes."""
    place = 0.02 * (1 - np.cos(2 * np.pi * hertz * TIME))
    raw, smooth = (do.from_displacement(place, DT, corner=each) for each in (None, corner))
    passes, raw, smooth = 1 / (1 + (hertz / corner) ** 8), np.asarray(raw.samples), np.asarray(smooth.samples)
    np.testing.assert_allclose(smooth[:-100], passes * raw[:-100], atol=2e-3 * raw.max())


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_drift_of_the_velocity_is_taken_off(degree):
    drift = sum(0.01 * (TIME / 10) ** k for k in range(degree))
    clean = do.baseline_corrected(SMOOTH, degree)
    found = do.baseline_corrected(rk.Record(SMOOTH.samples + drift, DT), degree)
    np.testing.assert_allclose(found.samples, clean.samples, atol=1e-6)
    assert np.abs(clean.samples - SMOOTH.samples).max() < 1e-3


@pytest.mark.parametrize("low, high, kept", [(None, 3.0, 1.0), (3.0, None, 8.0), (0.5, 3.0, 1.0), (3.0, 20.0, 8.0)])
def test_filters_keep_what_passes(low, high, kept):
    """Check a filter on 1 Hz and 8 Hz together: one passes, without delay."""
    parts = {f: np.sin(2 * np.pi * f * TIME) * np.exp(-((TIME - 5) ** 2)) for f in (1.0, 8.0)}
    found = do.filtered(rk.Record(sum(parts.values()), DT), low, high)
    assert np.abs(found.samples - parts[kept]).max() < 0.03
    delayed = do.filtered(rk.Record(sum(parts.values()), DT), low, high, zero_phase=False)
    assert np.abs(delayed.samples - parts[kept]).max() > 0.04


# Corners [Hz] and order: bands down to a hundredth of their frequency, a double pole, both ends of the range.
FILTERS = [(0.5, 0.52, 4), (5.0, 5.2, 4), (2.0, 2.02, 3), (3.0, 3.3, 6), (1.0, 1.5, 20), (1.0, 3 + 8**0.5, 1),
           (0.05, 0.06, 2), (0.05, 49.0, 5), (None, 0.02, 20), (None, 20.0, 7),
           (0.02, None, 9), (40.0, None, 1)]  # fmt: skip


def by_the_spectrum(values, low, high, order, count=1 << 19):
    """Apply the squared gain of a Butterworth filter at each frequency, with padding until all has rung out."""
    tangent = np.tan(np.pi / 2 * np.linspace(0.0, 1.0, count // 2 + 1))
    low, high = (None if corner is None else np.tan(np.pi * corner * DT) for corner in (low, high))
    with np.errstate(all="ignore"):
        if high is None:
            ratio = low / tangent
        else:
            ratio = tangent / high if low is None else (tangent**2 - low * high) / (tangent * (high - low))
        gain = 1 / (1 + np.abs(ratio) ** (2 * order))
    return np.fft.irfft(np.fft.rfft(values, count) * gain, count)[: values.size]


@pytest.mark.parametrize("low, high, order", FILTERS)
def test_a_filter_without_delay_loses_nothing_that_rings(low, high, order):
    values = np.random.default_rng(4).normal(0, 0.1, 1500)
    expected = by_the_spectrum(values, low, high, order)
    found = do.filtered(rk.Record(values, DT), low, high, order=order)
    np.testing.assert_allclose(found.samples, expected, atol=1e-10 * np.abs(expected).max())


def test_a_narrow_filter_without_delay_by_padding():
    """Padding with rest until all has rung out is the judge, forwards and backwards."""
    record = rk.example_record()
    sections = scipy.signal.butter(4, (0.5, 0.52), "bandpass", fs=100, output="sos")
    rest = np.pad(record.samples, 100_000)
    there = scipy.signal.sosfilt(sections, scipy.signal.sosfilt(sections, rest)[::-1])[::-1][100_000:-100_000]
    found = do.filtered(record, 0.5, 0.52)
    np.testing.assert_allclose(found.samples, there, atol=1e-10 * np.abs(there).max())


def test_a_filter_of_one_pass_by_its_poles():
    """The differential equation of order 1 under the bilinear transform, sample by sample, is the judge."""
    values, upper = np.random.default_rng(4).normal(0, 0.1, 300), np.tan(np.pi * 0.3 * DT)
    expected, before, state = [], 0.0, 0.0
    for value in values:
        state = (state * (1 - upper) + upper * (value + before)) / (1 + upper)
        before = value
        expected.append(state)
    found = do.filtered(rk.Record(values, DT), high=0.3, order=1, zero_phase=False)
    np.testing.assert_allclose(found.samples, expected, atol=1e-15)


@pytest.mark.parametrize("corner, order", [(0.3, 1), (0.3, 4), (8.0, 20)])
def test_a_low_pass_of_continued_samples_by_repetition(corner, order):
    """Samples mirrored or turned at both ends, for 1300 s either way, are the judge: the spectrum has no ends."""
    values = np.random.default_rng(4).normal(0, 0.1, 500).cumsum() / 10
    last, place = values.size - 1, np.arange(-(1 << 17), 1 << 17)
    turns, within = np.divmod(place, 2 * last)
    mirrored = values[np.where(within <= last, within, 2 * last - within)]
    line = values[0] + (values[-1] - values[0]) * place / last
    beside = values - np.linspace(values[0], values[-1], values.size)
    odd = np.where(within <= last, beside[np.minimum(within, last)], -beside[(2 * last - within) % last])
    begin = 1 << 17
    for beyond, whole, straight_line in ((evenly, mirrored, 0 * line), (of_velocity, odd, line)):
        expected = by_the_spectrum(whole, None, corner, order, 1 << 18) + straight_line
        found = smoothed(values, DT, corner, order, beyond)
        np.testing.assert_allclose(found, expected[begin : begin + values.size], atol=1e-6)
    # Turned about its end a displacement is mirrored at twice its length.
    turned = np.concatenate([values, 2 * values[-1] - values[-2::-1]])
    twice = smoothed(turned, DT, corner, order, evenly)[: values.size]
    np.testing.assert_allclose(smoothed(values, DT, corner, order, of_displacement), twice, atol=1e-12)


def test_a_low_pass_far_below_a_record_leaves_its_mean():
    values = np.random.default_rng(5).normal(0, 0.1, 1001)
    mean = (values.sum() - (values[0] + values[-1]) / 2) / 1000
    np.testing.assert_allclose(smoothed(values, DT, 2e-4, 4, evenly), mean, atol=1e-12)


def test_a_taper_changes_the_ends_only():
    found = do.tapered(rk.Record(np.ones(1001), DT), 1.0)
    np.testing.assert_allclose(found.samples[100:-100], 1.0)
    np.testing.assert_allclose(found.samples[:101], (1 - np.cos(np.pi * TIME[:101])) / 2, atol=1e-12)
    np.testing.assert_allclose(found.samples, found.samples[::-1], atol=1e-12)
    np.testing.assert_array_equal(do.tapered(SMOOTH, 0.0).samples, SMOOTH.samples)


def test_a_shorter_step_is_the_same_motion():
    found = do.resampled(SMOOTH, DT / 4)
    assert found.samples.size == 4001
    for measure in (rk.intensity.arias, rk.intensity.peak_displacement, rk.intensity.peak_velocity):
        assert float(measure(found)) == pytest.approx(float(measure(SMOOTH)), rel=1e-10)
    uneven = do.resampled(SMOOTH, 0.007)
    np.testing.assert_allclose(uneven.samples, np.interp(0.007 * np.arange(1429), TIME, SMOOTH.samples), atol=1e-15)


def test_a_longer_step_loses_what_it_cannot_hold():
    fast = rk.Record(SMOOTH.samples + 0.1 * np.sin(2 * np.pi * 40 * TIME), DT)
    found = do.resampled(fast, 0.025)
    np.testing.assert_allclose(found.samples[10:-10], np.interp(0.025 * np.arange(401), TIME, SMOOTH.samples)[10:-10],
                               atol=2e-3)  # fmt: skip


def test_cut_and_scaled():
    part = do.cut(SMOOTH, 2.0, 6.0)
    np.testing.assert_array_equal(part.samples, SMOOTH.samples[200:601])
    np.testing.assert_array_equal(do.cut(SMOOTH, 2.003, 5.997).samples, SMOOTH.samples[201:600])
    np.testing.assert_array_equal(do.cut(SMOOTH).samples, SMOOTH.samples)
    assert float(rk.intensity.peak_acceleration(do.scaled(SMOOTH, acceleration=0.4))) == pytest.approx(0.4, rel=1e-14)
    assert float(rk.intensity.peak_velocity(do.scaled(SMOOTH, velocity=0.3))) == pytest.approx(0.3, rel=1e-12)
    np.testing.assert_array_equal(do.scaled(SMOOTH, -2.0).samples, -2 * SMOOTH.samples)


@pytest.mark.parametrize("dt", [0.01, 0.005, 1 / 256, 1 / 300, 0.02])
def test_single_precision_cuts_and_resamples_as_double_does(dt):
    """Its time steps are off by a few times 1e-8, which is no reason to lose a sample."""
    counts = []
    for double in (True, False):
        with jax.enable_x64(double):
            record = rk.Record(np.arange(60_001) % 997 / 1024, dt)
            part = do.cut(record, 100 * dt, 200 * dt)
            found = [np.asarray(part.samples), np.asarray(do.cut(record, end=1 / 3).samples)]
            steps = (dt / 2, dt / 4, dt / 5, 1.25 * dt, 2 * dt, 2.5 * dt, dt * 4 / 3, round(1.333 * dt, 12))
            found += [np.asarray(do.resampled(record, step).samples) for step in steps]
            counts.append([each.size for each in found])
            np.testing.assert_array_equal(found[0], np.arange(100, 201) / 1024)
    assert counts[0] == counts[1]
    assert counts[0][0] == 101 and counts[0][2] == 120_001


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_a_displacement_is_differentiated_in_the_precision_that_was_given(dtype):
    """Without double precision in JAX, too: what is rounded to single precision has a noisy second derivative."""
    time = 0.001 * np.arange(5001)
    place = (0.1 * (1 - np.cos(2 * time))).astype(dtype)
    with jax.enable_x64(False):
        of_place = do.from_displacement(place, 0.001)
        of_velocity = do.from_velocity(0.2 * np.sin(2 * time), 0.001)
        fused = do.fused(rk.Record(0.4 / G * np.cos(2 * time), 0.001), place.tolist(), 0.001)
    exact = 0.4 / G * np.cos(2 * time)
    error = np.abs(np.asarray(of_place.samples) - exact).max() / exact.max()
    assert error < 1e-4 if dtype == np.float64 else error > 1e-2
    np.testing.assert_allclose(of_velocity.samples, exact, atol=1e-5 * exact.max())
    np.testing.assert_allclose(fused.samples[:-10], exact[:-10], atol=1e-3 * exact.max())


@pytest.mark.parametrize(
    "step",
    [
        do.baseline_corrected,
        lambda r: do.tapered(r, 0.5),
        lambda r: do.filtered(r, 0.1),
        lambda r: do.resampled(r, 0.02),
        lambda r: do.cut(r, 1.0),
        lambda r: do.scaled(r, 2.0),
    ],
)
def test_name_and_origin_are_kept(step):
    assert (step(SMOOTH).name, step(SMOOTH).origin) == ("made", EVENT)


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: do.filtered(SMOOTH), "`low` and `high` must not both be None"),
        (lambda: do.filtered(SMOOTH, 2.0, 1.0), "`high` must be above `low`"),
        (lambda: do.filtered(SMOOTH, 2.0, 2.000001), "`high` must be above `low`, 2.0 Hz, by a millionth of itself"),
        (lambda: do.filtered(SMOOTH, high=50.0), "`high` must be above 0 and below half the sampling rate, 50 Hz"),
        (lambda: do.filtered(SMOOTH, 1e-30), "`low` must be at least a millionth of the sampling rate, 0.0001 Hz"),
        (lambda: do.from_velocity(np.ones(9), DT, corner=1e-30), "`corner` must be at least a millionth"),
        (lambda: do.tapered(SMOOTH, 6.0), "`seconds` must be at most half the record"),
        (lambda: do.cut(SMOOTH, 20.0), "must leave a sample"),
        (lambda: do.scaled(SMOOTH), "Just one of the arguments"),
        (lambda: do.scaled(SMOOTH, 1.0, velocity=1.0), "Just one of the arguments"),
        (lambda: do.scaled(rk.Record(np.zeros(9), DT), acceleration=1.0), "`record` must move"),
        (lambda: do.resampled(SMOOTH, DT * np.pi), "`dt` must be to the old step"),
        (lambda: do.from_displacement([0.0, 1.0], DT), "at least 4 samples"),
        (lambda: do.from_displacement(np.zeros(9), DT, unit="km"), "`unit` must be one of 'm', 'cm', 'mm'"),
        (lambda: do.baseline_corrected(rk.Record([1.0], DT)), "more samples than `degree`"),
        (lambda: rk.motions.Components(SMOOTH, rk.Record(SMOOTH.samples, 0.02)), "must have one time step"),
    ],
)
def test_what_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_components_turn():
    other = rk.Record(np.cos(TIME), DT)
    pair = rk.motions.Components(SMOOTH, other)
    np.testing.assert_allclose(pair.along(0.0).samples, SMOOTH.samples)
    np.testing.assert_allclose(pair.along(np.pi / 2).samples, other.samples, atol=1e-15)
    turned = jax.vmap(lambda angle: pair.along(angle).samples)(np.array([0.3, 0.3 + np.pi / 2]))
    squares = np.asarray(SMOOTH.samples) ** 2 + np.asarray(other.samples) ** 2
    np.testing.assert_allclose(np.sum(np.asarray(turned) ** 2, 0), squares, rtol=1e-12)
