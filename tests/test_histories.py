"""Fits to histories: against free rocking in closed form, certified least squares, and repeated experiments."""

import types

import equinox as eqx
import jax
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.numerics.least_squares import Covariance, LeastSquares, Minimum, Progression, covariance, least_squares

ALPHA, P, RESTITUTION, TILT = 0.2, 2.5, 0.9, 0.12
TIME = np.linspace(0.02, 6.0, 240)
GUESS = rk.Block(0.17, 2.9, 0.94)


def free_rocking(time, alpha=ALPHA, p=P, restitution=RESTITUTION, tilt=TILT):
    """Housner (1963): theta = alpha - (alpha - peak) cosh(p t) on each side, impacts after acosh(1/(1 - peak/alpha))/p.

    The slender block, in NumPy; each impact keeps restitution^2 of 1 - (1 - peak/alpha)^2.
    """
    rotation, begin, side = np.zeros_like(time), 0.0, np.sign(tilt)
    peak, since = abs(tilt), 0.0  # of this half cycle, and how long before `begin` it was
    while begin < time[-1] and peak > 1e-9 * alpha:
        quarter = np.arccosh(1 / (1 - peak / alpha)) / p
        end = begin + quarter - since
        inside = (time >= begin) & (time <= end)
        rotation[inside] = side * (alpha - (alpha - peak) * np.cosh(p * (time[inside] - begin + since)))
        kept = restitution**2 * (1 - (1 - peak / alpha) ** 2)
        peak, begin, side = alpha * (1 - np.sqrt(1 - kept)), end, -side
        since = -np.arccosh(1 / (1 - peak / alpha)) / p
    return rotation


def noise(seed, size=TIME.size, kept=0.0):
    """Errors of unit variance, each of which keeps a share of the one before."""
    fresh = np.random.default_rng(seed).normal(size=size)
    errors = [fresh[0]]
    for x in fresh[1:]:
        errors.append(kept * errors[-1] + np.sqrt(1 - kept**2) * x)
    return np.array(errors)


def fit(rotation, time=TIME, block=GUESS, starts=4, **options):
    return rk.inverse.fit_history(time, rotation, block, None, rk.Linear(), starts=starts, **options)


# --------------------------------------------------------------------------------------- free rocking


def test_free_rocking_without_errors_is_recovered():
    found = fit(free_rocking(TIME))
    assert found.status == rk.inverse.HistoryStatus.successful and found.warnings == ()
    np.testing.assert_allclose(found.values, [ALPHA, P, RESTITUTION, TILT], rtol=1e-8)
    # The engine follows the closed form, so that what is fitted is the same model.
    np.testing.assert_allclose(found.rotation, free_rocking(TIME), atol=1e-10)
    assert found.agreement == 1
    assert found["restitution"] == found.values[2] == float(found.block.restitution)
    assert len(rk.plot.history_fit(found, TIME)) == 2
    for time, words in ((TIME[:-1], "be of the"), (TIME[::-1], "increase"), (TIME[0], "be of the")):
        with pytest.raises(ValueError, match=f"Argument `time` must {words}"):
            rk.plot.history_fit(found, time)
    two_sided = eqx.tree_at(lambda fit: fit.block, found, rk.blocks.AsymmetricBlock(ALPHA, 1.2 * ALPHA, P))
    assert len(rk.plot.history_fit(two_sided, TIME)) == 2
    # Mirrored, it is the same block from the other side.
    mirrored = fit(-free_rocking(TIME))
    np.testing.assert_allclose(mirrored.values, found.values * [1, 1, 1, -1], rtol=1e-8)


def test_covariance_is_that_of_the_closed_form():
    """Standard errors from central differences of Housner's formula, and estimates within four of them."""
    size = 1e-3
    found = fit(free_rocking(TIME) + size * noise(3))
    truth = np.array([ALPHA, P, RESTITUTION, TILT])
    assert found.status == rk.inverse.HistoryStatus.successful and not found.correlated
    assert found.scatter == pytest.approx(size, rel=0.15)
    steps = 1e-6 * np.diag(found.values)
    slopes = np.array(
        [free_rocking(TIME, *(found.values + h)) - free_rocking(TIME, *(found.values - h)) for h in steps]
    )
    slopes = slopes / (2e-6 * found.values[:, None])
    exact = found.scatter**2 * np.linalg.inv(slopes @ slopes.T)
    np.testing.assert_allclose(found.covariance, exact, rtol=1e-5)
    assert np.all(np.abs(found.values - truth) < 4 * np.sqrt(np.diag(exact)))
    np.testing.assert_allclose(found.rotation + found.residuals, free_rocking(TIME) + size * noise(3), atol=1e-15)
    # With the scatter given, it is not estimated; a wrong one is told of.
    known = fit(free_rocking(TIME) + size * noise(3), scatter=2 * size)
    np.testing.assert_allclose(known.covariance, exact * (2 * size / found.scatter) ** 2, rtol=1e-4)
    assert known.misfit == pytest.approx(found.scatter / (2 * size), rel=1e-6)
    assert any("times the stated scatter" in warning for warning in known.warnings)


def test_small_rotations_tell_alpha_and_p_only_together():
    """Far from the saddle the acceleration is p^2 alpha, and nothing else shows."""
    tilt = 0.01 * ALPHA
    time = TIME * 0.12
    found = fit(
        free_rocking(time, tilt=tilt) + 1e-2 * tilt * noise(5), time, block=rk.Block(0.19, 2.6, 0.9), spread=0.1
    )
    assert found.status == rk.inverse.HistoryStatus.not_identified
    assert any("alpha" in warning and " p " in warning for warning in found.warnings)
    relative = found.covariance / np.outer(found.values, found.values)
    both = np.array([1.0, 2.0, 0.0, 0.0])
    assert np.sqrt(relative[0, 0]) > 0.25 and np.sqrt(both @ relative @ both) < 0.01
    assert found["p"] ** 2 * found["alpha"] == pytest.approx(P**2 * ALPHA, rel=0.01)


def test_errors_that_last_are_told_of():
    found = fit(free_rocking(TIME) + 1e-3 * noise(7, kept=0.9))
    assert found.correlated and any("correlated" in warning for warning in found.warnings)
    wider = found.intervals()[:, 1] - found.intervals()[:, 0]
    independent = found.intervals(robust=False)
    assert np.all(wider > independent[:, 1] - independent[:, 0])


@pytest.mark.parametrize("freedom, t", [(1, 12.7062047364), (2, 4.3026527297), (30, 2.0422724563)])
def test_intervals_are_those_of_student(freedom, t):
    """Quantiles of his table."""
    few = types.SimpleNamespace(
        values=np.ones(1), covariance=np.ones((1, 1)), residuals=np.ones(freedom + 1), correlated=False
    )
    np.testing.assert_allclose(rk.inverse.HistoryFit.intervals(few), [[1 - t, 1 + t]], rtol=1e-9)


# --------------------------------------------------------------------------------------- least squares alone


def test_certified_least_squares():
    """Misra1a of the NIST Statistical Reference Datasets: estimates and standard errors, certified to 11 digits."""
    x = np.array([77.6, 114.9, 141.1, 190.8, 239.9, 289.0, 332.8, 378.4, 434.8, 477.3, 536.8, 593.1, 689.1, 760.0])
    y = np.array([10.07, 14.73, 17.94, 23.93, 29.61, 35.18, 40.02, 44.82, 50.76, 55.05, 61.01, 66.40, 75.47, 81.78])

    def at(point, samples):
        decay = np.exp(-point[1] * x)
        inside = np.arange(x.size) < samples
        return (point[0] * (1 - decay) - y) * inside, np.stack([1 - decay, point[0] * x * decay], axis=1)

    scale = np.array([500.0, 1e-4])
    problem = LeastSquares(at, scale, np.zeros(2), np.full(2, np.inf))
    found = least_squares(problem, scale, Progression((14,), 0.1, 0.1), 3, 0)
    spread = covariance(found, scale, False)
    np.testing.assert_allclose(found.point, [2.3894212918e02, 5.5015643181e-04], rtol=1e-8)
    errors = np.sqrt(np.diag(spread.independent))
    np.testing.assert_allclose(errors, [2.7070075241, 7.2668688436e-06], rtol=1e-7)
    assert np.sum(found.residuals**2) == pytest.approx(1.2455138894e-01, rel=1e-9)
    assert found.converged and found.agreement == 1


def test_a_parameter_that_does_not_show_stays_and_has_no_interval():
    slopes = np.stack([np.ones(20), np.zeros(20)], axis=1)
    at = lambda point, samples: (point[0] - np.ones(20) + 0.1 * noise(1, 20), slopes)
    scale = np.ones(2)
    found = least_squares(
        LeastSquares(at, scale, -9 * scale, 9 * scale), np.array([3.0, 2.0]), Progression((20,), 0.1, 0.1), 1, 0
    )
    assert found.point[1] == 2.0 and found.point[0] == pytest.approx(1 - 0.1 * noise(1, 20).mean())
    assert np.sqrt(covariance(found, scale, True).independent[1, 1]) > 1e5


@pytest.mark.parametrize(
    "rotation, untold",
    [
        (0 * TIME, ("alpha", "p", "restitution")),
        (free_rocking(TIME / 20), ("restitution",)),  # no impact yet
    ],
    ids=["never moved", "no impact"],
)
def test_what_a_history_does_not_show_has_no_interval(rotation, untold):
    """However well the rest fits, errors of measurement are none and their scatter is not known."""
    time = TIME if not rotation.any() else TIME / 20
    found = fit(rotation, time, rk.Block(ALPHA, P, RESTITUTION), starts=1)
    assert bool(found.status == rk.inverse.HistoryStatus.not_identified)
    wide = dict(zip(found.names, np.diff(found.intervals())[:, 0]))
    assert all(wide[name] > 100 for name in untold)


def test_a_start_without_a_result_is_given_up():
    def at(point, samples):
        """A line through the origin that cannot be evaluated with a slope below 1.9 (one of the starts)."""
        slope = np.arange(1.0, 10.0)
        return np.where(point < 1.9, np.inf, (point - 3) * slope), slope[:, None]

    def found(first, starts):
        problem = LeastSquares(at, np.ones(1), -9 * np.ones(1), 9 * np.ones(1))
        return least_squares(problem, np.array([first]), Progression((9,), 1.0, 1e-6), starts, 0)

    nowhere = found(-5.0, 2)
    assert not nowhere.converged and nowhere.agreement == 0 and np.isinf(nowhere.residuals).all()
    assert np.isinf(covariance(nowhere, np.ones(1), False).independent)
    somewhere = found(1.5, 6)  # the first start has none
    assert somewhere.converged and 0 < somewhere.agreement < 1
    np.testing.assert_allclose(somewhere.point, 3.0)


@pytest.mark.parametrize("kept", [0.0, 0.6, 0.9])
def test_robust_variance_of_a_mean(kept):
    """Compare the variance of a mean of n correlated errors with (1 + kept)/(1 - kept)/n, up to the bias of few."""
    size, found = 2000, []
    for seed in range(60):
        residuals = noise(seed, size, kept)
        minimum = Minimum(np.zeros(1), residuals - residuals.mean(), np.ones((size, 1)), True, 1.0)
        spread = covariance(minimum, np.ones(1), False)
        assert isinstance(spread, Covariance) and abs(spread.correlation - kept) < 0.1
        found.append(spread.robust[0, 0])
    assert np.mean(found) * size == pytest.approx((1 + kept) / (1 - kept), rel=0.15)


# --------------------------------------------------------------------------------------- bad input


DATA = free_rocking(TIME)


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(time=TIME[:8], rotation=DATA[:8]), "`time` must be a list of more than 8 values"),
        (dict(time=-TIME), "`time` must be 0 or more"),
        (dict(time=TIME[::-1]), "`time` must rise"),
        (dict(rotation=DATA[1:]), r"`rotation` must have the shape \(240,\)"),
        (dict(rotation=np.where(TIME > 3, np.nan, DATA)), "`rotation` must be finite"),
        (dict(scatter=0.0), "`scatter` must be positive"),
        (dict(scatter=[1.0, 2.0]), "`scatter` must be finite numbers of shape"),
        (dict(parameters=("alpha", "amplitude")), "`parameters` must be different names out of alpha, p, restitution"),
        (dict(parameters=("alpha", "alpha")), "`parameters` must be different names"),
        (dict(parameters=()), "`parameters` must be different names"),
        (dict(motion=rk.Record(np.zeros(9), 0.1)), "`motion` must move the ground"),
        (dict(block=rk.Block(np.array([0.1, 0.2]), np.array([2.0, 2.0]))), "`block` must hold one scene"),
        (dict(block=rk.Block(0.2, 2.5, 1.0)), "`restitution` can be fitted only from within its range"),
        (dict(time=np.zeros(0), rotation=np.zeros(0)), "`rotation` must hold measurements"),
        (dict(starts=0), "`starts` must be a whole number from 1 to"),
        (dict(spread=-0.1), "`spread` must be positive"),
    ],
)
def test_bad_input_is_refused(change, message):
    options = dict(time=TIME, rotation=DATA, block=GUESS) | change
    with pytest.raises(ValueError, match=message):
        rk.inverse.fit_history(**options)


# --------------------------------------------------------------------------------------- slow


@pytest.mark.slow
def test_intervals_cover_the_truth():
    """95 % intervals of four parameters over 400 experiments: 93 to 97 % of each hold the truth."""
    truth = np.array([ALPHA, P, RESTITUTION, TILT])
    inside = []
    for seed in range(400):
        found = fit(free_rocking(TIME) + 2e-3 * noise(seed), starts=1)
        ends = found.intervals(robust=False)
        inside.append((ends[:, 0] < truth) & (truth < ends[:, 1]))
    assert np.all(np.abs(np.mean(inside, axis=0) - 0.95) < 0.02)


@pytest.mark.slow
def test_a_shaking_table():
    """A block and the sine pulse under it, whose sensor is late and not levelled."""
    block, pulse = rk.Block(0.2, 2.5, 0.9), rk.SinePulse(0.4, 0.9)
    time = np.linspace(0.0, 5.0, 300)
    response = rk.simulate(block, pulse, duration=5.0, samples=2)
    rotation = np.asarray(response(np.clip(time - 0.07, 0, 5))[0]) + 0.004 + 1e-4 * noise(2, 300)
    names = ("alpha", "restitution", "amplitude", "period", "delay", "offset")
    guess = rk.Block(0.22, 2.5, 0.93), rk.SinePulse(0.42, 0.95)
    found = rk.inverse.fit_history(time, rotation, *guess, parameters=names, spread=0.1, scatter=1e-4)
    truth = np.array([0.2, 0.9, 0.4, 0.9, 0.07, 0.004])
    assert found.status == rk.inverse.HistoryStatus.successful
    assert np.all(np.abs(found.values - truth) < 4 * np.sqrt(np.diag(found.covariance)))
    assert np.all(np.sqrt(np.diag(found.covariance)) < 0.02 * truth)
    again = rk.simulate(found.block, found.motion, initial=found.initial, duration=5.0, samples=2)
    shown = again(np.clip(time - found["delay"], 0, 5))[0] + found["offset"]
    np.testing.assert_allclose(shown, found.rotation, atol=1e-8)


@pytest.mark.slow
def test_no_history_no_result():
    engine = rk.Series(order=8, tolerance=1e-10, max_steps=3)
    found = rk.inverse.fit_history(TIME, DATA, GUESS, engine=engine, starts=2)
    assert found.status == rk.inverse.HistoryStatus.not_simulated


@pytest.mark.slow
def test_a_scaled_record():
    """Amplitude [g] of a record under which a block rocked."""
    record, block = rk.example_record(), rk.Block(0.2, 2.0)
    time = np.linspace(0.0, 12.0, 300)
    rotation = np.asarray(rk.simulate(block, record, duration=12.0, samples=2)(time)[0])
    guess = rk.Block(0.21, 2.0)
    found = rk.inverse.fit_history(
        time, rotation, guess, record, parameters=("alpha", "amplitude"), spread=0.03, starts=2
    )
    peak = float(jax.numpy.max(jax.numpy.abs(record.samples)))
    np.testing.assert_allclose(found.values, [0.2, peak], rtol=1e-6)
