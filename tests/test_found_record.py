"""The least-changed record: beside a closed form, its constraints, and what it is for."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

import jaxrock as rk
from jaxrock.inverse.design_point import allowed_changes, least_change
from jaxrock.inverse.kept_spectrum import KeptSpectrum

ALPHA, P, DT, COUNT = 0.2, 3.0, 0.02, 40
LINEAR = {"model": rk.Linear(), "engine": rk.Series(order=12)}
BLOCK = rk.Block(ALPHA, P, 0.9)
TIME = DT * np.arange(COUNT)
# Uplifts the block at once, and is too short to topple it.
START = rk.Record(1.6 * ALPHA * (TIME < 0.22), DT, "a start")


def push(p=P):
    """A linear block that rises at time 0, and hits the ground no more, overturns if the sum of these times the samples
    exceeds alpha: p times the integral of acceleration and exp(-p t) (the growing part of its rotation)."""
    fine = np.linspace(0.0, 1.0, 2001)
    inner = np.trapezoid((1 - abs(2 * fine - 1)) * np.exp(-p * 2 * DT * (fine - 0.5)), 2 * DT * fine)
    weights = p * inner * np.exp(-p * TIME)
    for end, shape in ((0, fine[::-1]), (-1, fine)):
        at = (fine if end == 0 else fine - 1) * DT
        weights[end] = p * np.trapezoid(shape * np.exp(-p * at), DT * fine) * np.exp(-p * TIME[end])
    return weights


def size(samples):
    return np.sqrt(np.mean(np.square(samples)))


def closed_form(band=None, baseline=False):
    weights = push()
    lacking = ALPHA - weights @ np.asarray(START.samples)
    assert lacking > 0
    return lacking / np.linalg.norm(allowed_changes(COUNT, DT, band, baseline)(weights)) / np.sqrt(COUNT)


@functools.cache
def found(**given):
    return rk.inverse.find_record(BLOCK, START, **LINEAR, **given)


SPACES = {"all": {"baseline": False}, "baseline kept": {"baseline": True}, "band": {"band": (0.5, 8.0)}}


@pytest.mark.parametrize("space", SPACES.values(), ids=SPACES)
def test_beside_the_closed_form(space):
    """Where the block topples without an impact the limit is a plane: some start finds its nearest point. With impacts
    less may do, where the change may not be a push."""
    result = found(starts=3, **space)
    expected = closed_form(space.get("band"), space.get("baseline", True))
    assert (abs(result.changes / expected - 1) < 2e-6).any()
    assert result.change < expected * (1 + 2e-6)
    if space == SPACES["all"]:
        np.testing.assert_allclose(result.changes, expected, rtol=1e-4)  # some start may end a little before
        assert result.change < result.scaling
    assert bool(result.status == rk.inverse.RecordStatus.successful)
    assert -1e-3 < result.margin[0] <= 0
    assert rk.outcome(BLOCK, result.record, **LINEAR).overturned
    np.testing.assert_allclose(size(result.record.samples - START.samples), result.change, rtol=1e-9)


def test_what_scaling_takes():
    """Check scaling: the record times the factor has the integral that topples."""
    factor = ALPHA / (push() @ np.asarray(START.samples))
    np.testing.assert_allclose(found(starts=3, baseline=False).scaling, (factor - 1) * size(START.samples), rtol=1e-6)


def test_scaling_does_not_jump_over_a_narrow_range():
    """Factors of 1.231 to 1.246 topple, and then none up to 1.62, by the ends that `critical_amplitudes` finds."""
    time = 0.1 * np.arange(COUNT)
    record = rk.Record(0.42 * np.sin(2 * np.pi * time / 0.8) * np.sin(np.pi * time / 4), 0.1)
    block = rk.Block(ALPHA, 2.0, 0.9)
    asked = {"intensity": (1.0, 4.0), "derivatives": False, "progress": False}
    factors = rk.critical_amplitudes(block, record, **asked, **LINEAR).value / np.abs(record.samples).max()
    np.testing.assert_allclose(factors[:3], [1.231, 1.246, 1.62], rtol=5e-3)
    given = {"starts": 1, "steps": 2, "baseline": False, "progress": False}
    result = rk.inverse.find_record(block, record, "topple", **given, **LINEAR)
    np.testing.assert_allclose(result.scaling, (factors[0] - 1) * size(record.samples), rtol=1e-6)
    assert result.change <= result.scaling


def test_the_baseline_is_kept():
    """Velocity and displacement at the end, of straight lines between samples, by a rule exact for cubic ones."""
    change = np.asarray(found(starts=3, baseline=True).record.samples - START.samples)
    left, right = change[:-1], change[1:]
    middle, at = (left + right) / 2, TIME[:-1] + DT / 2
    rest = [TIME[-1] - t for t in (TIME[:-1], at, TIME[1:])]
    velocity = np.sum(left + 4 * middle + right)
    displacement = np.sum(left * rest[0] + 4 * middle * rest[1] + right * rest[2])
    assert abs(velocity) + abs(displacement) < 1e-12
    changed = np.asarray(found(starts=3, baseline=False).record.samples - START.samples)
    assert abs(changed.sum()) > 1e-2


def test_the_band_is_kept():
    change = np.asarray(found(starts=3, band=(0.5, 8.0)).record.samples - START.samples)
    spectrum, frequency = abs(np.fft.rfft(change)), np.fft.rfftfreq(COUNT, DT)
    outside = (frequency < 0.5) | (frequency > 8.0)
    assert outside.sum() > 3 and spectrum[outside].max() < 1e-13 < 1e-3 < spectrum.max()


PERIODS = (0.25, 0.4, 0.7)


def test_oscillators_are_those_of_the_intensities():
    """At the samples, and by rows as by recursion."""
    samples = np.random.default_rng(3).normal(0, 0.3, 60)
    for period in PERIODS:
        kept = KeptSpectrum.of(np.array([period]), samples, 0.01)
        there = kept.displacement(period, samples)
        peak = rk.intensity.spectral_acceleration(rk.Record(samples, 0.01), period)
        assert 0.98 * peak < np.abs(there).max() < peak * (1 + 1e-9)
        for instant in (1, 30, 59, 75):
            row = kept.row(period, instant)
            other = np.random.default_rng(instant).normal(size=60)
            both = there[instant] * (row @ other), kept.displacement(period, other)[instant] * (row @ samples)
            np.testing.assert_allclose(*both, rtol=1e-10)


def test_the_spectrum_is_kept():
    """Its peaks, judged by oscillators that are followed between samples; without, it changes."""
    free, kept = found(starts=3, baseline=False), found(starts=3, baseline=False, spectrum=PERIODS)
    spectrum = functools.partial(rk.intensity.spectral_acceleration, period=PERIODS)
    before, after, changed = map(spectrum, (START, kept.record, free.record))
    np.testing.assert_allclose(after, before, rtol=0.06)
    assert np.abs(changed / before - 1).max() > 0.1 and np.isnan(free.spectrum)
    assert kept.spectrum <= 0.05 and bool(kept.status == rk.inverse.RecordStatus.successful)
    assert rk.outcome(BLOCK, kept.record, **LINEAR).overturned and kept.change > free.change


@pytest.mark.parametrize("band", [None, (2.0, 9.0)])
@pytest.mark.parametrize("baseline", [True, False])
def test_allowed_changes_are_a_projection(band, baseline):
    project = allowed_changes(41, 0.01, band, baseline)
    matrix = project(np.eye(41))
    np.testing.assert_allclose(matrix @ matrix, matrix, atol=1e-12)
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-12)
    assert np.linalg.matrix_rank(matrix) < 42 - 2 * baseline


def test_what_leaves_nothing_leaves_no_rounding():
    """Which would be a direction like any other, out of all bounds."""
    project = allowed_changes(COUNT, DT, (1.0, 3.0), True, np.random.default_rng(0).normal(size=(4, COUNT)))
    np.testing.assert_array_equal(project(np.random.default_rng(1).normal(size=(5, COUNT))), 0.0)


NARROW = {"band": (1.0, 3.0), "spectrum": (0.25,), "starts": 2, "steps": 5}  # four numbers, of which three are held


def test_what_was_found_stays_where_the_spectrum_cannot_be_kept():
    """One number is left, by which the block topples; to keep the peak that then grows, none."""
    kept = KeptSpectrum.of(np.array(NARROW["spectrum"]), np.asarray(START.samples), DT)
    result = rk.inverse.find_record(BLOCK, START, **NARROW, **LINEAR)
    change = np.asarray(result.record.samples - START.samples)
    assert bool(result.status == rk.inverse.RecordStatus.spectrum_changed) and result.spectrum > 0.05
    assert rk.outcome(BLOCK, result.record, **LINEAR).overturned and -1e-3 < result.margin[0] <= 0
    np.testing.assert_allclose([result.change, np.min(result.changes)], size(change), rtol=1e-9)
    allowed = allowed_changes(COUNT, DT, NARROW["band"], True, kept.rows)(change)
    np.testing.assert_allclose(allowed, change, atol=1e-12)
    again = kept.kept_at(np.asarray(result.record.samples))
    np.testing.assert_array_equal(allowed_changes(COUNT, DT, NARROW["band"], True, again.rows)(np.eye(COUNT)), 0.0)


@pytest.mark.parametrize("seed", range(4))
def test_the_least_change_under_several_bounds(seed):
    random = np.random.default_rng(seed)
    slopes, bound = random.normal(size=(3, 7)) * [[1.0], [100.0], [0.01]], random.normal(size=3) - 0.5
    bound = bound * [1.0, 100.0, 0.01]
    change = least_change(slopes, bound)
    assert (slopes @ change <= bound + 1e-9 * abs(bound)).all()
    rows = slopes / np.linalg.norm(slopes, axis=1)[:, None]
    limits = {
        "type": "ineq",
        "fun": lambda x: (bound - slopes @ x) / np.linalg.norm(slopes, axis=1),
        "jac": lambda x: -rows,
    }
    judge = minimize(lambda x: x @ x, np.zeros(7), jac=lambda x: 2 * x, constraints=limits, options={"ftol": 1e-14})
    np.testing.assert_allclose(np.linalg.norm(change), np.linalg.norm(judge.x), rtol=1e-5)


def test_no_change_lies_on_both_sides():
    assert least_change(np.array([[1.0, 2.0], [-1.0, -2.0]]), np.array([-1.0, -1.0])) is None
    assert least_change(np.zeros((1, 2)), np.array([-1.0])) is None


def test_texts_claim_only_the_nearest_of_the_starts():
    """The result is the nearest of the starts' records; its text claims no more, and `changes` has the others."""
    result = found(starts=8, baseline=False)
    assert result.changes.shape == (8,) and float(result.change) == float(np.min(result.changes))
    words = rk.inverse.RecordStatus[result.status]
    assert "nearest of those that the starts led to" in words and "may find a nearer one" in words
    assert "No record" not in words


TWO = rk.Block(np.array([ALPHA, 0.8 * ALPHA]), np.array([P, 1.5 * P]), 0.9)


def test_a_block_that_falls_is_spared():
    toppled = 1.5 * found(starts=3, baseline=False).record.samples
    result = rk.inverse.find_record(BLOCK, rk.Record(toppled, DT), "spare", starts=3, baseline=False, **LINEAR)
    assert 0 <= result.margin[0] < 0.05 and result.change <= result.scaling
    assert not rk.outcome(BLOCK, result.record, **LINEAR).overturned


@pytest.mark.parametrize("target", [0.6, 0.3])
def test_a_margin_is_come_to(target):
    result = rk.inverse.find_record(BLOCK, START, target, starts=2, **LINEAR)
    assert target - 0.05 < result.margin[0] <= target


@pytest.mark.slow
def test_two_blocks_at_once():
    result = rk.inverse.find_record(TWO, START, ["topple", "spare"], starts=3, **LINEAR)
    fallen = jax.vmap(lambda block: rk.outcome(block, result.record, **LINEAR).overturned)(
        rk.Block(TWO.alpha, TWO.p, jnp.full(2, 0.9))
    )
    assert fallen.tolist() == [True, False] or bool(result.status == rk.inverse.RecordStatus.not_reached)


def test_what_is_there_already():
    result = rk.inverse.find_record(BLOCK, START, "spare", **LINEAR)
    assert result.change == 0 and bool(result.status == rk.inverse.RecordStatus.unchanged)
    np.testing.assert_array_equal(result.record.samples, START.samples)


def test_where_nothing_may_change():
    """No frequency of a record of 0.8 s lies in the band."""
    result = rk.inverse.find_record(BLOCK, START, band=(0.1, 0.5), starts=4, **LINEAR)
    assert bool(result.status == rk.inverse.RecordStatus.not_reached) and jnp.isinf(result.change)
    np.testing.assert_array_equal(result.record.samples, START.samples)
    assert jnp.isfinite(result.scaling) and jnp.isinf(result.changes).all()


@pytest.mark.slow
def test_what_cannot_be():
    """Ask for two equal blocks, one toppled and one spared: no record is reached."""
    twice = rk.Block(np.full(2, ALPHA), np.full(2, P), 0.9)
    result = rk.inverse.find_record(twice, START, ["topple", "spare"], starts=2, **LINEAR)
    assert bool(result.status == rk.inverse.RecordStatus.not_reached) and jnp.isinf(result.change)
    np.testing.assert_array_equal(result.record.samples, START.samples)


BAD = {
    "a record at rest": ({"start": rk.Record(np.zeros(9), DT)}, "`start` must shake"),
    "a word": ({"target": "fall"}, "`target` must be one of 'topple', 'spare'"),
    "two targets": ({"target": [0.1, 0.2]}, "`target` must be one for each of 1 blocks"),
    "a band that falls": ({"band": (5.0, 1.0)}, "`band` must rise"),
    "periods that the record does not show": ({"spectrum": [0.1, 1.0]}, "each of 0.2 s .ten steps of the record. or"),
    "one period": ({"spectrum": 1.0}, "`spectrum` must be a list of periods"),
    "no optimiser": ({"optimizer": 0.1}, "`optimizer` must be an optax.GradientTransformation"),
    "blocks in a square": ({"block": rk.Block(np.full((2, 2), 0.2), P)}, "`block` must be one block or a list"),
}


@pytest.mark.parametrize(("given", "words"), BAD.values(), ids=BAD)
def test_what_is_refused(given, words):
    with pytest.raises(ValueError, match=words):
        rk.inverse.find_record(**{"block": BLOCK, "start": START, **LINEAR, **given})


@pytest.mark.slow
def test_under_the_built_in_record():
    """Half of the change that scaling takes, from any of some seeds."""
    block = rk.Block(0.2, 2.0)
    result = rk.inverse.find_record(block, rk.example_record(), starts=3)
    assert rk.outcome(block, result.record).overturned and result.margin[0] > -0.02
    assert result.change < 0.6 * result.scaling
