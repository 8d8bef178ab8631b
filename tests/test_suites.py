"""Fragility by simulation: against closed forms of toppling, known probabilities, and resampled suites."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
import scipy.stats
from scipy.special import ndtr

import jaxrock as rk
from jaxrock.hazard.intervals import intervals_of_motions
from jaxrock.hazard.surfaces import _verdict
from jaxrock.motions.suite import repeated
from references import chaotic

G = 9.81
RICKER_TOP = np.sqrt((3 - np.sqrt(6)) * 6) * np.exp(-(3 - np.sqrt(6)) / 2)  # of |y^3 - 3y| e^(-y^2/2)
WALL = rk.closed_form.single_lobe.safety_wall


# --------------------------------------------------------------------------------------- intensity measures


@pytest.mark.parametrize(
    "motion, peak, speed",
    [
        (rk.RectangularPulse(0.3, 0.8), 0.3, 0.3 * 0.8),
        (rk.TriangularPulse(-0.3, 0.8), 0.3, 0.3 * 0.4),
        (rk.HalfSinePulse(0.3, 0.8), 0.3, 0.3 * 0.8 * 2 / np.pi),
        (rk.SinePulse(0.3, 0.8), 0.3, 0.3 * 0.8 / np.pi),
        (rk.CosinePulse(0.3, 0.8), 0.3, 0.3 * 0.8 / (2 * np.pi)),
        (rk.RickerPulse(0.3, 0.8), 0.3, 0.3 * 0.8 / np.pi * np.sqrt(0.5) * np.exp(-0.5)),
        # The velocity of this phase is 1 + cos of both in step: V = amplitude g period/(2 pi) at the centre.
        (rk.MavroeidisPapageorgiouPulse(0.3, 0.8, 2.0, 0.0), None, 0.3 * 0.8 / (2 * np.pi)),
        # Straight lines: the velocity is largest where the acceleration passes zero, within a sample.
        (rk.Record([0.0, 0.3, -0.1, 0.0], 0.4), 0.3, 0.06 + 0.3 * 0.3 / 2),
        (2 * rk.SinePulse(0.3, 0.8).shifted(0.5), 0.6, 0.6 * 0.8 / np.pi),
        # Its top is where no part ends: (y^3 - 3y) e^(-y^2/2) has the integral (1 - y^2) e^(-y^2/2), 1 at its largest.
        (rk.RickerPulse(0.3, 0.8, "antisymmetric"), 0.3, 0.3 * 0.8 * np.sqrt(3) / (2 * np.pi) / RICKER_TOP),
    ],
    ids=lambda x: type(x).__name__ if isinstance(x, rk.motions.AbstractMotion) else "",
)
def test_peaks_of_motions(motion, peak, speed):
    """Peak acceleration [g] and peak velocity [m/s] by hand."""
    if peak is not None:
        np.testing.assert_allclose(rk.intensity.peak_acceleration(motion), peak, rtol=1e-9)
    np.testing.assert_allclose(rk.intensity.peak_velocity(motion), G * speed, rtol=1e-9)


LINES = np.array([0.0, 0.3, -0.1, 0.2, -0.4, 0.0])
NORTH, EAST = rk.Record(LINES, 0.2), rk.Record(LINES[::-1] / 2, 0.2)


def peaks_of(factor):
    """Return peaks of a suite made from a traced number: of a record, and of both its components in two planes."""
    both = rk.motions.Components(rk.Record(factor * LINES, 0.2), EAST)
    suites = [rk.motions.Suite([rk.Record(factor * LINES, 0.2), EAST]), rk.motions.Suite([both], azimuth=[0.3, 1.2])]
    return [peak for suite in suites for peak in (suite.peak_acceleration, suite.peak_velocity)]


def test_a_suite_may_be_made_of_what_is_traced():
    """By `jax.jit`, `jax.vmap` and `jax.grad`: as outside of them, and as peaks go with the factor."""
    factors = np.array([0.5, 1.0, 2.0])
    one_by_one = [np.stack(each) for each in zip(*map(peaks_of, factors))]

    def first(factor):
        peaks = peaks_of(factor)
        return peaks[0], peaks

    slopes, many = jax.jit(jax.vmap(jax.jacobian(first, has_aux=True)))(factors)
    for found, compiled, expected in zip(many, jax.jit(peaks_of)(2.0), one_by_one):
        np.testing.assert_allclose(found, expected, rtol=1e-12)
        np.testing.assert_allclose(compiled, expected[2], rtol=1e-12)
    np.testing.assert_allclose(slopes, [[0.4, 0.0]] * 3, rtol=1e-12)


def test_a_motion_that_does_not_move_is_refused_where_it_is_traced():
    with pytest.raises(Exception, match="`motions` must move the ground"):
        jax.block_until_ready(jax.jit(peaks_of)(0.0))


def test_a_known_suite_stays_known_within_a_program():
    """Its peaks are numbers, by which levels may be chosen."""
    known = []
    jax.jit(lambda x: known.append(rk.motions.Suite([NORTH, EAST])) or x)(1.0)
    assert float(known[0].peak_acceleration[0]) == pytest.approx(0.4, rel=1e-14)
    np.testing.assert_array_equal(known[0].peak_velocity, rk.motions.Suite([NORTH, EAST]).peak_velocity)


# --------------------------------------------------------------------------------------- verdicts

DURATIONS = np.array([0.1, 0.3, 0.5, 0.8, 1.3])
PULSE_LEVELS = np.geomspace(0.1, 2.0, 16)
QUICK = {"model": rk.Linear(), "engine": rk.Series(order=6), "progress": False}  # compiles in half the time


@functools.cache
def twelve():
    return rk.blocks.draw_blocks(rk.Block(0.2, 2.0, 0.9), 12, alpha=0.1, p=0.1, restitution=0.03, seed=4)


def test_every_verdict_under_rectangular_pulses():
    """Slender blocks topple above the safety wall in closed form, each above its own; PGV is PGA times duration."""
    motions = [rk.RectangularPulse(np.ones(5), DURATIONS)]
    levels = PULSE_LEVELS
    found = rk.hazard.simulated_fragility(twelve(), motions, levels, **QUICK)
    wall = np.asarray(twelve().alpha) / np.asarray(WALL(np.asarray(twelve().p) * DURATIONS[:, None], -np.inf))
    topples = levels[:, None] > wall[:, None, :]
    assert found.undecided == 0 and 0.3 < np.mean(topples) < 0.9
    np.testing.assert_array_equal(found.verdict, topples)
    np.testing.assert_allclose(found.lower, topples.mean(axis=(0, 2)))
    assert found.monotone.all() and not found.falls.any()
    below, above = np.moveaxis(found.capacities, -1, 0)
    assert np.all((below < wall) & (wall < above))
    # By velocity the same blocks topple at level = wall g duration.
    by_velocity = rk.hazard.simulated_fragility(twelve(), motions, levels, measure="PGV", **QUICK)
    speeds = wall * G * DURATIONS[:, None]
    np.testing.assert_array_equal(by_velocity.verdict, levels[:, None] > speeds[:, None, :])
    # And over both measures.
    grid = rk.hazard.simulated_surface(twelve(), [rk.RectangularPulse], levels, DURATIONS, **QUICK)
    np.testing.assert_array_equal(grid.verdict[0], np.swapaxes(topples, 0, 1))
    middle = grid.at(0.5)
    np.testing.assert_allclose(middle.probabilities, topples[2].mean(axis=1))
    with pytest.raises(ValueError, match=r"`ratio` must be in \[0.1, 1.3\]"):
        grid.at(2.0)


def test_rocks_of_two_sides_both_ways_round():
    """Slender sides topple above the wall of theirs, to which a rectangular pulse throws them, if no impact follows."""
    rock = rk.blocks.draw_blocks(
        rk.blocks.AsymmetricBlock(0.15, 0.25, 2.0, restitution=(0.2, 0.2)), 4, alpha=0.1, p=0.1, seed=4
    )
    motions = [rk.RectangularPulse(np.ones(5), DURATIONS)]
    levels = PULSE_LEVELS
    found = rk.hazard.simulated_fragility(rock, motions, levels, facing="both", **QUICK)
    wall = np.concatenate(
        [
            np.asarray(alpha) / np.asarray(WALL(np.asarray(p) * DURATIONS[:, None], -np.inf))
            for alpha, p in ((rock.alpha2, rock.p2), (rock.alpha1, rock.p1))  # a push to the right lifts it to the left
        ],
        axis=1,
    )
    np.testing.assert_array_equal(found.verdict, levels[:, None] > wall[:, None, :])
    alone = rk.hazard.simulated_fragility(rock, motions, levels, **QUICK)
    np.testing.assert_array_equal(alone.verdict, found.verdict[..., :4])
    grid = rk.hazard.simulated_surface(rock, [rk.RectangularPulse], levels, DURATIONS, facing="both", **QUICK)
    np.testing.assert_array_equal(grid.verdict[0], np.swapaxes(found.verdict, 0, 1))
    assert grid.ways == 2


def test_a_surface_of_what_is_made_of_samples():
    """Each period has a record of its own: a scene is of one of them (it is traced only)."""
    group = jax.vmap(lambda t: rk.Record([0.0, 0.3, 0.0], t))(jnp.array([0.4, 0.5]))
    scene = rk.Block(np.array([0.2]), np.array([2.0])), group, rk.Linear(), rk.Series(order=4)
    assert [each.shape for each in jax.eval_shape(_verdict, 0, 0, 1.0, scene)] == [(), ()]


def test_draws_of_two_sides():
    """Both are drawn by one factor, about what the restitution follows; ratios that are given stay."""
    rock = rk.blocks.AsymmetricBlock(0.15, 0.25, 2.0, 0.7)
    many = rk.blocks.draw_blocks(rock, 20000, alpha=0.1, p=0.05, seed=1)
    np.testing.assert_allclose(many.alpha2 / many.alpha1, 0.25 / 0.15, rtol=1e-14)
    assert np.std(np.log(many.p1)) == pytest.approx(0.05, rel=0.05)
    place = 17
    one = rk.blocks.AsymmetricBlock(many.alpha1[place], many.alpha2[place], many.p1[place], 0.7)
    drawn = jax.tree.map(lambda x: x[place], many)
    np.testing.assert_allclose([drawn.p2, drawn.restitution1], [one.p2, one.restitution1], rtol=1e-14)
    kept = rk.blocks.draw_blocks(rk.blocks.AsymmetricBlock(0.1, 0.2, 2.0, restitution=(0.9, 0.8)), 5, alpha=0.1)
    np.testing.assert_array_equal(kept.restitution2, [0.8] * 5)
    with pytest.raises(ValueError, match="`restitution` must be 0 for an AsymmetricBlock"):
        rk.blocks.draw_blocks(rock, 5, restitution=0.1)


def test_draws_are_what_they_say():
    block = rk.Block(0.2, 2.0, 0.95)
    many = rk.blocks.draw_blocks(block, 20000, alpha=0.1, p=0.05, restitution=0.05, seed=1)
    alpha, p, restitution = (np.asarray(x) for x in (many.alpha, many.p, many.restitution))
    assert np.median(alpha) == pytest.approx(0.2, rel=0.005)
    assert np.std(np.log(p)) == pytest.approx(0.05, rel=0.03)
    assert restitution.max() <= 1
    assert np.mean(restitution > 0.95) == pytest.approx((ndtr(1) - 0.5) / ndtr(1), abs=0.02)
    follows = rk.blocks.draw_blocks(rk.Block(0.2, 2.0), 5, alpha=0.1)
    np.testing.assert_allclose(follows.restitution, 1 - 1.5 * np.sin(np.asarray(follows.alpha)) ** 2)
    np.testing.assert_array_equal(*(rk.blocks.draw_blocks(block, 5, p=0.1).p for _ in range(2)))


# --------------------------------------------------------------------------------------- tables and fits


def table(verdict, levels=None):
    """A simulated fragility with given verdicts (motions, levels, draws)."""
    verdict = np.asarray(verdict, np.int8)
    motions, count, _ = verdict.shape
    levels, ones = jax.device_put((np.arange(1.0, count + 1) if levels is None else levels, np.ones(motions)))
    names = tuple(f"motion {k}" for k in range(motions))
    return rk.hazard.SimulatedFragility(levels, verdict, ones, ones, names, "PGA")


def test_what_is_undecided_bounds_the_probability():
    found = table([[[0, 0], [1, -1], [1, 1]], [[0, 0], [0, 0], [-1, 1]]])
    assert found.undecided == 2
    np.testing.assert_allclose(found.lower, [0, 1 / 4, 3 / 4])
    np.testing.assert_allclose(found.upper, [0, 2 / 4, 4 / 4])
    for use in (found.fit, found.tabulated, found.counts):
        with pytest.raises(
            ValueError, match="`bound` must be 'lower', 'upper' or 'share', because 2 of 12 scenes are undecided"
        ):
            use()
    np.testing.assert_allclose(found.tabulated("upper").probabilities, found.upper)
    np.testing.assert_allclose(found.tabulated("lower").probabilities, found.lower)
    np.testing.assert_array_equal(found.table()["undecided"], [0, 1, 0, 0, 0, 1])
    np.testing.assert_array_equal(found.table()["toppled"], [0, 1, 2, 0, 0, 1])
    # The second block of the first motion may have toppled at level 2, but did so at 3.
    np.testing.assert_allclose(found.capacities[0], [[1, 2], [1, 3]])


def test_open_scenes_count_by_the_share_that_topples():
    verdict = [[[0, 0], [1, -1], [1, 1]], [[0, 0], [0, 0], [-1, 1]]]
    share = np.where(np.equal(verdict, -1), [[[0.25]], [[0.75]]], verdict)
    known = dataclasses.replace(table(verdict), share=share)
    np.testing.assert_array_equal(known.counts("share"), [[0, 1.25, 2], [0, 0, 1.75]])
    np.testing.assert_allclose(known.tabulated("share").probabilities, [0, 1.25 / 4, 3.75 / 4])
    np.testing.assert_array_equal(table(verdict).counts("share"), [[0, 1.5, 2], [0, 0, 1.5]])
    assert float(known.fit("share").fragility.median) < float(known.fit("lower").fragility.median)
    levels, ratio = jax.device_put((np.arange(1.0, 4), np.array([1.0, 2.0])))
    verdict, share = (np.swapaxes(x, 0, 1)[None] for x in (verdict, share))
    surface = rk.hazard.SimulatedSurface(levels, ratio, verdict.astype(np.int8))
    with pytest.raises(ValueError, match="2 of 12"):
        surface.fit()
    fits = [dataclasses.replace(surface, share=each).fit("share") for each in (None, share)]
    assert float(fits[0].fragility.median) != float(fits[1].fragility.median)


OPEN = {"alpha": 0.24497866312686414, "p": 1.8891563520285026, "restitution": 0.9117647058823529}


def test_shares_of_simulated_scenes():
    """Chaos leaves the verdict under one record open (`references.chaotic`); 7 of 17 motions overturn."""
    motion = rk.Record(*chaotic.record("twice"))
    peak = float(rk.intensity.peak_acceleration(motion))
    levels = peak * np.array([0.1, 1.516])
    found = rk.hazard.simulated_fragility(rk.Block(**OPEN), [motion], levels, progress=False)
    np.testing.assert_array_equal(found.verdict.ravel(), [0, -1])
    assert found.share.shape == found.verdict.shape and found.share[0, 0, 0] == 0
    assert 0.1 < found.share[0, 1, 0] < 0.9 and found.counts("share")[0, 1] == found.share[0, 1, 0]


def test_what_stands_again_is_not_made_to_topple():
    found = table([[[0], [1], [0], [1]], [[0], [0], [1], [1]]])
    np.testing.assert_array_equal(found.monotone, [[False], [True]])
    np.testing.assert_allclose(found.tabulated().probabilities, [0, 0.5, 0.5, 1])
    np.testing.assert_allclose(table([[[0], [1], [0], [1]]]).falls, [0, 0, 1, 0])
    assert found.tabulated()(2.0) == 0.5


LEVELS = np.geomspace(0.1, 1.6, 12)


SUCCESSFUL = int(rk.hazard.FitStatus.successful._value)


def known(fit):
    """A fit of NumPy's arrays."""
    return jax.tree.map(np.asarray, fit)


def stripes(seed, motions=80, levels=LEVELS):
    """Motions with lognormal capacities of median 0.4 and dispersion 0.35, at all levels alike."""
    capacity = 0.4 * np.exp(0.35 * np.random.default_rng(seed).normal(size=motions))
    return table((levels > capacity[:, None])[:, :, None], levels)


def test_fits_of_stripes_and_their_errors():
    """Medians and dispersions of 80 suites scatter as the covariance of clusters says."""
    fits = [known(stripes(seed).fit()) for seed in range(80)]
    assert all(fit.status._value == SUCCESSFUL for fit in fits)
    logarithms = np.array([np.log([fit.fragility.median, fit.fragility.dispersion]) for fit in fits])
    # Few motions make the dispersion a little small: the likelihood by SciPy has its maxima in the same places.
    np.testing.assert_allclose(logarithms.mean(axis=0), [-0.91503151, -1.08819027], atol=1e-6)
    np.testing.assert_allclose(logarithms.mean(axis=0), np.log([0.4, 0.35]), atol=0.05)
    stated = np.mean([np.sqrt(np.diag(fit.covariance)) for fit in fits], axis=0)
    np.testing.assert_allclose(stated, logarithms.std(axis=0), rtol=0.25)
    # As if levels were independent, it would be too sure.
    plain = [known(rk.hazard.fit_fragility(LEVELS, stripes(seed).counts().sum(axis=0), 80.0)) for seed in range(80)]
    assert np.all(np.mean([np.sqrt(np.diag(fit.covariance)) for fit in plain], axis=0) < 0.75 * logarithms.std(axis=0))
    found, independent = stripes(0), plain[0]
    np.testing.assert_allclose(independent.fragility.median, fits[0].fragility.median)
    rows = found.table()
    same = rk.hazard.fit_fragility(rows["level"], rows["toppled"], rows["trials"])
    np.testing.assert_allclose(same.fragility.dispersion, independent.fragility.dispersion, rtol=1e-9)


def test_intervals_of_one_block_are_those_of_a_sample():
    """Many fine levels show every capacity: Student's t and chi-squared of their logarithms, by SciPy."""
    levels = np.geomspace(0.05, 3.0, 960)  # as many as there are rows in the test above: one program
    capacity = np.log(0.4) + 0.35 * np.random.default_rng(5).normal(size=6)
    found = table((levels > np.exp(capacity)[:, None])[:, :, None], levels).intervals(confidence=0.9)
    sample = scipy.stats.t.interval(0.9, 5, capacity.mean(), scipy.stats.sem(capacity))
    np.testing.assert_allclose(np.log(found.median), sample, atol=0.015)
    scatter = capacity.std(ddof=1) * np.sqrt(5 / scipy.stats.chi2(5).ppf([0.95, 0.05]))
    np.testing.assert_allclose(found.dispersion, scatter, rtol=0.05)


def test_intervals_that_cannot_be_told():
    rises = np.repeat([0, 1], LEVELS.size // 2)[:, None]
    for verdict, status in (([rises], "separable"), ([rises, 1 - rises, 1 - rises], "not_growing")):
        found = table(verdict).intervals()
        assert found.status == getattr(rk.hazard.FitStatus, status)
        assert np.isnan(found.median).all() and np.isnan(found.dispersion).all()


def test_no_intervals_where_all_motions_did_the_same():
    """Their variance is none, of which nothing follows: the fit stands, errors and intervals are not numbers."""
    found = table([[[k < n for k in range(12)] for n in range(12)]] * 3)
    assert found.fit().status == rk.hazard.FitStatus.successful
    assert np.isfinite(found.fit().fragility.median) and np.isnan(found.fit().covariance).all()
    assert found.intervals().status == rk.hazard.FitStatus.alike
    assert np.isnan(found.intervals().median).all() and np.isnan(found.intervals().dispersion).all()


def test_turns_of_a_record_are_one_motion():
    """Three records at four azimuths each: the sandwich of records by NumPy's sums."""
    capacity = np.array([[0.3], [0.4], [0.6]]) * np.array([0.7, 1.0, 1.1, 1.6])
    fell = LEVELS > capacity[:, :, None]  # (records, turns, levels)
    ones, names = jnp.ones(12), tuple(f"motion {k}" for k in range(12))
    verdict = fell.reshape(12, -1, 1).astype(np.int8)
    found = rk.hazard.SimulatedFragility(jnp.asarray(LEVELS), verdict, ones, ones, names, "PGA", turns=4)
    fit, plain = found.fit(), rk.hazard.fit_fragility(LEVELS, fell.sum(axis=(0, 1)), 12.0)
    z = np.log(LEVELS / float(fit.fragility.median)) / float(fit.fragility.dispersion)
    residual = scipy.stats.norm.pdf(z) / (ndtr(z) * ndtr(-z)) * (fell - ndtr(z))
    rows = np.stack([np.full(12, -1 / float(fit.fragility.dispersion)), -z])
    scores = np.einsum("rtl,il->ri", residual, rows)
    covariance = np.asarray(plain.covariance)
    expected = 3 / 2 * covariance @ scores.T @ scores @ covariance
    np.testing.assert_allclose(fit.covariance, expected, rtol=1e-6)
    draws = table(np.swapaxes(fell, 1, 2), LEVELS)  # what one does to four blocks goes together, too
    assert float(fit.p_value) == pytest.approx(float(draws.fit().p_value), rel=1e-9)
    np.testing.assert_allclose(found.intervals().median, draws.intervals().median, rtol=1e-9)
    again = dataclasses.replace(found, verdict=np.tile(verdict[:4], (3, 1, 1)))
    assert again.intervals().status == rk.hazard.FitStatus.alike  # records did the same, though turns did not


@pytest.mark.parametrize("turns", [1, 3])
def test_one_record_tells_nothing_of_others(turns):
    verdict = (LEVELS > 0.3 * np.arange(1.0, 4)[:, None]).astype(np.int8)
    verdict = verdict.T[None] if turns == 1 else verdict[:, :, None]  # three draws, or three azimuths
    ones, names = jnp.ones(turns), tuple("abc"[:turns])
    found = rk.hazard.SimulatedFragility(jnp.asarray(LEVELS), verdict, ones, ones, names, "PGA", turns=turns)
    fit = found.fit()
    assert np.isfinite(fit.fragility.median) and np.isnan(fit.covariance).all() and np.isnan(fit.p_value)
    assert np.isnan(found.intervals().median).all()


def test_motions_that_are_the_same():
    """Check that equal motions are one, whatever their names or constructors; other samples, steps, kinds are not."""
    same = [rk.Record([0.0, 0.3, 0.0], 0.4, name) for name in ("a", "b")]
    others = [rk.Record([0.0, 0.3, 1e-9], 0.4), rk.Record([0.0, 0.3, 0.0], 0.41), 2 * same[0], -1 * same[0]]
    others += [rk.SinePulse(0.3, 0.4), rk.CosinePulse(0.3, 0.4), 2 * rk.SinePulse(0.3, 0.4)]
    assert repeated(rk.motions.Suite([same[0], *others])) is None
    assert repeated(rk.motions.Suite([*same, *others[:2]])) == ("a", "b")
    many = rk.motions.Suite([rk.SinePulse(np.array([0.3, 0.5]), 0.4), rk.SinePulse(0.5, 0.4)])
    assert repeated(many) == ("SinePulse 2", "SinePulse")
    with pytest.raises(ValueError, match="`motions` must hold each motion once, but 'a' and 'b' are the same"):
        rk.hazard.simulated_fragility(twelve(), same, [0.1, 0.2])
    pulses = rk.motions.Suite([rk.RectangularPulse(np.ones(5), np.append(DURATIONS[1:], DURATIONS[-1]))], list("cdeab"))
    with pytest.warns(UserWarning, match="Motions 'a' and 'b' are the same: what they do counts twice"):
        rk.hazard.suite_outcomes(twelve(), pulses, PULSE_LEVELS, **QUICK)


def test_intervals_hold_for_few_motions():
    """Check intervals of 300 suites of 10: standard errors cover the true dispersion far less often."""
    fits = [known(stripes(seed, 10).fit()) for seed in range(300)]
    off = [np.abs(np.log(f.fragility.dispersion / 0.35)) / np.sqrt(f.covariance[1, 1]) for f in fits]
    assert np.mean(np.array(off) < 1.96) < 0.85
    intervals = [known(intervals_of_motions(f, 10, 0.95)) for f in fits]
    for name, truth in (("median", 0.4), ("dispersion", 0.35)):
        low, high = np.array([getattr(each, name) for each in intervals]).T
        assert 0.91 < np.mean((low < truth) & (truth < high)) < 0.985


INDEPENDENT = {
    "overlap": ([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8], [0, 0, 1, 0, 1, 0, 1, 1], 1),
    "counts": ([0.2, 0.3, 0.45, 0.6], [1, 4, 9, 11], 12),
    "parted": ([0.2, 0.3, 0.45, 0.6], [0, 0, 12, 12], 12),
}


@pytest.mark.parametrize("case", INDEPENDENT)
def test_ends_of_independent_outcomes(case):
    """At every finite end the profile is 1.92 below the top, by a search over a fine grid."""
    levels, toppled, trials = INDEPENDENT[case]
    found = rk.hazard.fragility_intervals(levels, toppled, trials)
    x, k = np.log(levels), np.array(toppled, float)

    def heights(slope, median):
        z = slope[..., None] * (x - median[..., None])
        above, below = scipy.special.log_ndtr(z), scipy.special.log_ndtr(-z)
        weights = trials * np.exp(-(z**2) - above - below)
        sums = [np.sum(weights * x**power, axis=-1) for power in range(3)]
        with np.errstate(divide="ignore", invalid="ignore"):
            penalty = np.log(sums[0] * sums[2] - sums[1] ** 2) / 2
        return above @ k + below @ (trials - k) + np.nan_to_num(penalty, nan=-np.inf)

    slopes, medians = np.exp(np.linspace(-9, 6, 601)), np.linspace(-6, 4, 801)
    top, ends = heights(*np.meshgrid(slopes, medians)).max(), 0
    if case == "parted":  # any median in the gap, whatever the penalty says
        np.testing.assert_allclose(found.median, [0.3, 0.45])
    for end in np.asarray(found.median):
        if np.isfinite(end) and end > 0 and case != "parted":
            assert top - heights(slopes, np.full(601, np.log(end))).max() == pytest.approx(1.9207, abs=5e-3)
            ends += 1
    for end in np.asarray(found.dispersion):
        if np.isfinite(end) and end > 0:
            assert top - heights(np.full(801, 1 / end), medians).max() == pytest.approx(1.9207, abs=5e-3)
            ends += 1
    assert ends == {"overlap": 1, "counts": 4, "parted": 1}[case]


def test_what_can_be_parted_leaves_the_gap_open():
    """A thousand of each: any dispersion down to none, any median in the gap, and hardly another."""
    found = rk.hazard.fragility_intervals([0.3, 0.45], [0, 1000], 1000)
    low, high = np.asarray(found.dispersion)
    assert low == 0 and 0.05 < high < 0.1
    np.testing.assert_allclose(found.median, [0.3, 0.45])


def test_one_level_says_nothing_of_the_slope():
    found = rk.hazard.fragility_intervals([0.3, 0.3], [1, 0])
    np.testing.assert_array_equal([found.median, found.dispersion], [[0, np.inf]] * 2)


TRUTH = rk.hazard.SurfaceFragility(*map(jnp.asarray, (0.15, -0.6, 0.3)))


def true_share(acceleration, ratio):
    """Return the true probability that `TRUTH` topples."""
    return ndtr(np.log(acceleration / (0.15 * ratio**-0.6)) / 0.3)


def test_fit_of_a_surface():
    """Outcomes drawn from a surface: its numbers within four standard errors, its contours by their definition."""
    random = np.random.default_rng(2)
    acceleration, ratio = random.uniform(0.1, 1.5, 4000), random.uniform(0.03, 0.3, 4000)
    toppled = random.uniform(size=4000) < true_share(acceleration, ratio)
    found = rk.hazard.fit_surface(acceleration, ratio, toppled)
    assert found.status == rk.hazard.FitStatus.successful
    numbers = lambda f: np.array([np.log(float(f.median)), float(f.exponent), np.log(float(f.dispersion))])
    errors = np.sqrt(np.diag(found.covariance))
    assert np.all(np.abs(numbers(found.fragility) - numbers(TRUTH)) < 4 * errors) and np.all(errors < 0.1)
    contour = TRUTH.acceleration(np.array([0.05, 0.5, 0.95]), 0.1)
    np.testing.assert_allclose(TRUTH(contour, 0.1), [0.05, 0.5, 0.95], rtol=1e-12)
    np.testing.assert_allclose(TRUTH.at(0.1)(contour), [0.05, 0.5, 0.95], rtol=1e-12)
    np.testing.assert_allclose(np.asarray(contour)[1], 0.15 * 0.1**-0.6)
    one = rk.hazard.fit_surface(acceleration, np.full(4000, 0.1), toppled)
    assert one.status == rk.hazard.FitStatus.not_converged
    each = rk.hazard.fit_surface(acceleration, ratio, toppled, clusters=np.arange(4000))  # a sandwich, of many
    wider = np.diag(each.covariance) / np.diag(found.covariance)
    assert np.all(wider != 1) and np.all(np.abs(wider - 1) < 0.1)
    for parted in (np.zeros(4000), acceleration * ratio > 0.1):
        failed = rk.hazard.fit_surface(acceleration, ratio, parted)
        assert failed.status == rk.hazard.FitStatus.separable and np.isnan(failed.fragility.median)


def test_a_surface_of_turned_records_is_one_of_clusters():
    random = np.random.default_rng(7)
    levels = np.geomspace(0.1, 1.6, 1000)  # as many rows as above: one program
    verdict = (random.uniform(size=(4, 1000, 3)) < ndtr(np.log(levels / 0.4) / 0.4)[:, None]).astype(np.int8)
    levels, ones, speed = jax.device_put((levels, np.ones(4), np.geomspace(0.5, 2.0, 4)))
    found = rk.hazard.SimulatedFragility(levels, verdict, ones, speed, tuple("abcd"), "PGA", turns=2)
    rows = found.table()
    ratio = rows["peak_velocity"] / (G * rows["peak_acceleration"])
    records = np.repeat(["one", "two"], 2000)
    fit = rk.hazard.fit_surface(rows["peak_acceleration"], ratio, rows["toppled"], rows["trials"], records)
    np.testing.assert_allclose(rk.hazard.surface_of(found).covariance, fit.covariance, rtol=1e-12)
    one = rk.hazard.surface_of(dataclasses.replace(found, turns=4))
    assert one.fragility.median == fit.fragility.median and np.isnan(one.covariance).all()


def test_fit_of_a_simulated_surface():
    """All cells of a grid, draws as clusters: nearly as certain as independent outcomes, which these are."""
    acceleration, ratio = np.geomspace(0.1, 1.5, 20), np.geomspace(0.03, 0.3, 20)
    share = true_share(acceleration[:, None], ratio)
    verdict = (np.random.default_rng(3).uniform(size=(1, 20, 20, 10)) < share[:, :, None]).astype(np.int8)
    found = rk.hazard.SimulatedSurface(*jax.device_put((acceleration, ratio)), verdict)
    np.testing.assert_array_equal(found.lower, verdict[0].mean(axis=-1))
    fit, table_ = found.fit(), np.meshgrid(acceleration, ratio, np.arange(10), indexing="ij")
    plain = rk.hazard.fit_surface(table_[0].ravel(), table_[1].ravel(), verdict.ravel())
    assert float(fit.fragility.median) == float(plain.fragility.median) == pytest.approx(0.15, rel=0.05)
    errors = np.sqrt(np.diag(fit.covariance) / np.diag(plain.covariance))
    assert np.all((0.5 < errors) & (errors < 2.0))
    # A block says nothing of others, whichever way round.
    finer = np.geomspace(0.1, 1.5, 200)
    single = np.random.default_rng(4).uniform(size=(200, 20)) < true_share(finer[:, None], ratio)
    single = rk.hazard.SimulatedSurface(*jax.device_put((finer, ratio)), single[None, :, :, None].astype(np.int8))
    mirrored = dataclasses.replace(single, verdict=np.repeat(single.verdict, 2, axis=3), ways=2)
    for alone in (single.fit(), mirrored.fit()):
        assert np.isfinite(alone.fragility.median) and np.isnan(alone.covariance).all()
    # A block and its mirror image are one draw, both ways under one pulse as under two.
    other = verdict[..., ::-1]
    both = dataclasses.replace(found, verdict=np.concatenate([verdict, other], axis=3), ways=2).fit()
    pulses = np.concatenate([verdict, other])
    np.testing.assert_allclose(both.covariance, dataclasses.replace(found, verdict=pulses).fit().covariance, rtol=1e-12)
    verdict[0, 5, 5, 0] = -1
    with pytest.raises(ValueError, match="1 of 4000 scenes are undecided"):
        found.fit()
    axis = rk.plot.fragility_surface(found, fit.fragility)
    assert axis.get_xlabel() == "PGV/PGA [s]" and len(axis.lines) == 3
    shown = [np.array(axis.collections[0].get_array()).ravel()]
    known = dataclasses.replace(found, share=np.where(verdict == -1, 0.9, verdict == 1))
    shown.append(np.array(rk.plot.fragility_surface(known).collections[0].get_array()).ravel())
    changed = np.abs(shown[1] - shown[0])
    assert np.count_nonzero(changed) == 1 and changed.max() == pytest.approx(0.4 / verdict.shape[-1])


def test_figure_of_a_fragility():
    found = table([[[0, 0], [1, -1], [1, 1]], [[0, 0], [0, 0], [-1, 1]]])
    axis = rk.plot.fragility(found, rk.hazard.LogNormalFragility(2.0, 0.3))
    assert [text.get_text() for text in axis.get_legend().get_texts()] == [
        "simulated",
        "undecided",
        "lognormal: 2, 0.3",
    ]


RECORD = rk.Record([0.0, 0.3, 0.0], 0.4)


def test_motions_of_one_name_are_numbered():
    """They would be taken for one, where outcomes are grouped by motions."""
    named = rk.Record([0.1, -0.2, 0.0], 0.5, "station")
    found = rk.motions.Suite([RECORD, 2 * RECORD, rk.SinePulse(0.3, 0.8), named, 0.5 * named])
    assert found.names == ("Record", "Scaled", "SinePulse", "station 1", "station 2")
    assert rk.motions.Suite([RECORD, RECORD]).names == ("Record 1", "Record 2")
    both = rk.motions.Suite([rk.motions.Components(RECORD, RECORD)] * 2, azimuth=[0.0, 1.0])
    assert len(set(both.names)) == 4 and len(set(both.sources)) == 2


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: rk.motions.Suite([RECORD])[:2], "A motion of a suite has a whole number, but this is slice"),
        (
            lambda: rk.blocks.draw_blocks(rk.Block(0.4, 3.0), 1000, alpha=0.3),
            "deviation `alpha` must let all 1000 draws be blocks, but one is none .* Lower it",
        ),
        (
            lambda: rk.hazard.simulated_surface(twelve(), [rk.ExponentialPulse], [0.1, 0.2], [0.1, 0.2]),
            "`pulses` must make motions of amplitude and period, but .*ExponentialPulse.* does not: missing .*'shape'",
        ),
        (
            lambda: rk.hazard.simulated_fragility(twelve(), [RECORD], [0.1, 0.2], facing="back"),
            "`facing` must be",
        ),
        (lambda: rk.motions.Suite([]), "`motions` must hold at least one motion"),
        (lambda: rk.motions.Suite([RECORD], ["a", "b"]), "`names` must name 1 motions, but has 2 names"),
        (lambda: rk.motions.Suite([RECORD, RECORD], ["a", "a"]), "differ from motion to motion, but has 'a' twice"),
        (lambda: rk.processing.tapered(2.0 * RECORD, 1.0), r"a Scaled \(`jaxrock.processing.scaled\(record, factor\)`"),
        (
            lambda: rk.motions.Suite([rk.Record([0.0, 0.0, 0.0], 0.4, "quiet")]),
            "`motions` must move the ground, but 'quiet' does not",
        ),
        (
            lambda: rk.motions.Suite([rk.Record([0.3], 0.01, "one")]),
            "`motions` must move the ground, but 'one' does not",
        ),
        (lambda: rk.hazard.simulated_fragility(twelve(), [RECORD], [0.2]), "`levels` must hold at least two levels"),
        (
            lambda: rk.hazard.simulated_fragility(twelve(), [RECORD], [0.2, 0.1]),
            "`levels` must be positive and finite, and rise",
        ),
        (
            lambda: rk.hazard.simulated_fragility(twelve(), [RECORD], [0.1, 0.2], measure="SA"),
            "`measure` must be one of 'PGA'",
        ),
        (lambda: rk.blocks.draw_blocks(rk.Block(0.2, 2.0), 0), "`draws` must be a whole number from 1"),
        (lambda: rk.blocks.draw_blocks(rk.Block(0.2, 2.0), 9, p=-1.0), "`p` must be 0 or more"),
        (
            lambda: rk.hazard.simulated_surface(twelve(), [], [0.1, 0.2], [0.1, 0.2]),
            "`pulses` must hold at least one pulse",
        ),
        (lambda: table(np.zeros((1, 2, 1))).counts("middle"), "`bound` must be one of 'lower', 'upper'"),
        (lambda: rk.hazard.fit_surface([0.1, 0.2], [0.1, 0.2], [0.0, 1.0]), "must be lists of one length above 2"),
        (
            lambda: rk.hazard.fit_surface([0.1, 0.2, 0.3], [0.1, 0.2, 0.3], [0.0, 1.0, 0.0], clusters=[1, 2]),
            r"shape \(3,\)",
        ),
        (
            lambda: rk.hazard.fit_surface([0.1, 0.2, 0.3], [0.1, 0.3, 0.2], [0.0, 1.0, 0.0], clusters=["a"] * 3),
            "`clusters` must name at least two clusters",
        ),
    ],
)
def test_bad_input_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_motions_by_their_numbers():
    suite = rk.motions.Suite([RECORD, 2 * RECORD])
    assert suite[-1].factor == suite[jnp.asarray(1)].factor == 2.0
    for number in (2, -3):
        with pytest.raises(IndexError, match=f"is out of range: {number} of 2 motions"):
            suite[number]


def test_a_traced_record_of_one_sample_is_refused():
    speed = jax.jit(lambda x: rk.motions.Suite([rk.Record(x[None], 0.01)]).peak_velocity)
    with pytest.raises(jax.errors.JaxRuntimeError, match="`motions` must move the ground"):
        jax.block_until_ready(speed(0.3))


# --------------------------------------------------------------------------------------- slow


@pytest.mark.slow
def test_records_of_unlike_length():
    """Each scaled record gives the verdicts of `outcome` on its own, whatever the others' lengths and samples."""
    record = rk.example_record()
    short = rk.Record(np.append(record.samples[400:1600], 0.0), 1.5 * record.dt, "a part")
    levels, blocks = np.array([0.3, 0.6, 1.2, 2.4]), rk.Block(jnp.array([0.15, 0.2]), jnp.array([2.0, 3.0]))
    found = rk.hazard.simulated_fragility(blocks, [record, short], levels)
    assert found.names == (record.name, "a part") and 0 < np.mean(found.verdict) < 1

    @functools.partial(jax.jit, static_argnums=0)
    def alone(size, samples, dt, level, alpha, p):
        motion = rk.Record(samples, dt)
        return rk.outcome(rk.Block(alpha, p), level / jnp.max(jnp.abs(samples)) * motion).overturned

    for row, motion in zip(found.verdict, (record, short)):
        for level, verdicts in zip(levels, row):
            for alpha, p, verdict in zip(blocks.alpha, blocks.p, verdicts):
                assert verdict == alone(motion.samples.size, motion.samples, motion.dt, level, alpha, p)
    columns = found.table()
    np.testing.assert_allclose(columns["peak_acceleration"], np.tile(levels, 2), rtol=1e-12)
    fitted = rk.hazard.surface_of(found)
    assert fitted.covariance.shape == (3, 3)


@pytest.mark.slow
def test_a_sine_pulse_topples_and_spares_again():
    """Dimitrakopoulos & DeJong (2012), figure 4: above the island of overturning after an impact a block is safe."""
    ratio, restitution = 2.5, 0.9
    no_impact = float(rk.closed_form.sine_pulse.no_impact_limit(ratio))
    block = rk.Block(0.1, 1.0, restitution)
    levels = 0.1 * np.linspace(1.0, 1.2 * no_impact, 200)
    found = rk.hazard.simulated_fragility(block, [rk.SinePulse(1.0, 2 * np.pi / ratio)], levels, rk.Linear())
    assert not found.monotone[0, 0] and found.falls.max() == 1
    np.testing.assert_array_equal(found.verdict[0, levels > 0.1 * no_impact * 1.0001, 0], 1)
