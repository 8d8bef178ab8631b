"""Maxima, intervals and probabilities of likelihoods beside brute force: grids, and counting."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.inverse.scatter import Quadrature, rocks_at

RATIO = 1.9207  # half of 1.96^2
UNKNOWNS = {"amplitude": (0.03, 3.0), "period": (0.1, 4.0)}
GRID = 96  # points along each axis
FEW, MANY = (1, 2), (0, *range(3, 30))


def unknowns():
    return {name: rk.inverse.Unknown(*ends) for name, ends in UNKNOWNS.items()}


def problem(seed):
    """Make three rocks that rocked so far, stand, or fell, under a random motion."""
    rng = np.random.default_rng([17, seed])
    alpha, p = rng.uniform(0.08, 0.3, 3), rng.uniform(1.5, 5.0, 3)
    amplitude, period = np.exp(rng.uniform(np.log([0.15, 0.3]), np.log([0.9, 2.0])))
    scatter = (0.05, 0.1, 0.3)[seed % 3]
    factor = np.exp(scatter * rng.normal(size=3))
    found = peaks(alpha, p, amplitude * factor, np.full(3, period))
    fell, peak = np.asarray(found[0]), np.asarray(found[1])
    measured = ~fell & (peak > 0.01) & (rng.random(3) < 0.6)
    words = ["rotation" if x else "toppled" if y else "survived" for x, y in zip(measured, fell)]
    sizes = np.where(measured, peak, np.nan)
    known = {"rotation": np.where(measured, sizes, 1.0), "rotation_sd": np.where(measured, 0.05 * sizes, 1.0)}
    return rk.inverse.Observations(alpha, p, words, alpha_sd=0.03 * alpha, **known), scatter


@jax.jit
@jax.vmap
def peaks(alpha, p, amplitude, period):
    found = rk.outcome(rk.Block(alpha, p), rk.SinePulse(amplitude, period))
    return found.overturned, jnp.where(found.overturned, 0.0, found.max_rotation)


def on_a_grid(observations, scatter):
    """Return log-likelihoods over both parameters, and their values."""
    over = {name: np.geomspace(low * 1.001, high * 0.999, GRID) for name, (low, high) in UNKNOWNS.items()}
    region = rk.inverse.feasible_region(
        rk.inverse.Likelihood(observations, rk.SinePulse, scatter), over, progress=False
    )
    return np.asarray(region.log_likelihood), over


def beside_a_grid(seed):
    observations, scatter = problem(seed)
    found = rk.inverse.estimate_motion(observations, rk.SinePulse, unknowns(), scatter, progress=False)
    grid, over = on_a_grid(observations, scatter)
    top = float(found.log_likelihood)
    assert grid.max() < top + 0.05, seed
    if bool(found.status == rk.inverse.EstimateStatus.contradictory):
        return
    within = grid > top - RATIO + 0.1  # points hardly within may lie on either side of an end
    step = 1.01 * np.log(np.array([x[1] / x[0] for x in over.values()]))
    for axis, (low, high) in enumerate(np.log(np.asarray(found.interval))):
        values = np.log(list(over.values())[axis][within.any(axis=1 - axis)])
        assert low < values.min() + step[axis] and high > values.max() - step[axis], (seed, axis)


@pytest.mark.parametrize("seed", FEW)
def test_a_grid_is_nowhere_higher_and_intervals_cover_it(seed):
    beside_a_grid(seed)


@pytest.mark.slow
@pytest.mark.parametrize("seed", MANY)
def test_many_grids_are_nowhere_higher_and_intervals_cover_them(seed):
    beside_a_grid(seed)


def test_the_highest_summit_is_found():
    """A search from 64 starts spread over the ranges ends at 3 g and 0.144 s, 2 below the highest."""
    alpha = np.array([0.2972009055343436, 0.1501163844668137, 0.25348076588040636])
    p = np.array([4.544637790936756, 2.868796822887179, 3.0325865559297958])
    rotation = np.array([0.1406422817340355, 0.08883323395717965, 0.07126082833246905])
    rocks = rk.inverse.Observations(alpha, p, ["rotation"] * 3, rotation=rotation, rotation_sd=0.03 * rotation)
    given = {"scatter": 0.05, "lapse": 1e-4}
    found = rk.inverse.estimate_motion(rocks, rk.SinePulse, unknowns(), **given, progress=False)
    assert float(found.log_likelihood) > 10.88
    truth = np.array([0.46420329, 0.35595367])
    assert (np.asarray(found.interval)[:, 0] < truth).all() and (truth < np.asarray(found.interval)[:, 1]).all()
    assert found.log_likelihood_error < 0.5 and found.probability_error.shape == (3,)


def test_an_interval_goes_on_to_where_the_profile_ends():
    """A grid judges the ends; a search that stops early ends the period's interval at 1.29 s instead of 1.47 s."""
    rng = np.random.default_rng(3)
    count = int(rng.integers(3, 10))
    alpha, p = rng.uniform(0.08, 0.3, count), rng.uniform(1.5, 5, count)
    amplitude, period = np.exp(rng.uniform(np.log(0.15), np.log(0.9))), np.exp(rng.uniform(np.log(0.3), np.log(2.0)))
    scatter = float(rng.choice([0.1, 0.2, 0.3]))
    size = amplitude * np.exp(scatter * np.array([rng.normal() for _ in range(count)]))
    fell = np.asarray(peaks(alpha, p, size, np.full(count, period))[0])
    words = ["toppled" if x else "survived" for x in fell]
    rocks = rk.inverse.Observations(alpha, p, words, alpha_sd=0.03 * alpha, p_sd=0.03 * p)
    found = rk.inverse.estimate_motion(rocks, rk.SinePulse, unknowns(), scatter, progress=False)
    grid, over = on_a_grid(rocks, scatter)
    within = grid > float(found.log_likelihood) - RATIO
    for axis, (low, high) in enumerate(np.asarray(found.interval)):
        values = list(over.values())[axis]
        inside = values[within.any(axis=1 - axis)]
        assert low < inside.min() * values[1] / values[0] and high > inside.max() * values[0] / values[1], axis


@functools.cache
def counted(scatter, alpha_sd, p_sd, draws=20_000):
    """Return shares of drawn scenes in which rocks stand, by the verdict alone; and the rocks and motions."""
    rng = np.random.default_rng(11)
    alpha, p = rng.uniform(0.08, 0.35, 12), rng.uniform(1.8, 5.0, 12)
    period, strength = np.exp(rng.uniform(np.log(0.3), np.log(2.5), 12)), np.exp(rng.uniform(0, 1.5, 12))
    amplitude, shares = np.tan(alpha) * strength, []
    for a, b, t, x in zip(alpha, p, period, amplitude):
        seen = rk.inverse.Observations([a], [b], ["survived"], alpha_sd=alpha_sd * a, p_sd=p_sd * b)
        e = rng.normal(size=(3, draws))
        rocks = rocks_at(seen, jnp.asarray(np.stack([alpha_sd * e[0], p_sd * e[1], 0 * e[1]])[..., None]))
        fell = peaks(*(np.ravel(y) for y in rocks[:2]), x * np.exp(scatter * e[2]), np.full(draws, t))[0]
        shares.append(1 - np.mean(fell))
    return alpha, p, period, amplitude, np.array(shares)


# Root mean square error asked for, and counts of few rocks, which are themselves off by 0.003.
ACCURACIES = {0.02: 0.04, 0.01: 0.018, 0.005: 0.01}


@pytest.mark.parametrize(("scatter", "alpha_sd", "p_sd"), [(0.1, 0.0, 0.0), (0.1, 0.1, 0.05)])
def test_probabilities_are_as_accurate_as_was_asked_for(scatter, alpha_sd, p_sd):
    alpha, p, period, amplitude, shares = counted(scatter, alpha_sd, p_sd)
    for accuracy, most in ACCURACIES.items():
        found, told = [], []
        for a, b, t, x in zip(alpha, p, period, amplitude):
            seen = rk.inverse.Observations([a], [b], ["survived"], alpha_sd=alpha_sd * a, p_sd=p_sd * b)
            likelihood = rk.inverse.Likelihood(seen, rk.SinePulse, scatter, lapse=0.0, accuracy=accuracy)
            values = {"amplitude": x, "period": t}
            found.append(float(likelihood.survival(values)[0]))
            told.append(float(likelihood.survival_error(values)[0]))
        off = np.array(found) - shares
        assert np.sqrt(np.mean(off**2)) < most, accuracy
        assert np.mean(np.abs(off) < 3 * np.array(told) + 0.008) > 0.8, accuracy


def test_slopes_by_the_amplitude_are_those_of_finer_quadratures():
    """Central differences of a likelihood five times as accurate are the judge.

    By the period a likelihood has steps in its margins, with other slopes between: `test_inverse.py` compares these
    with its own differences.
    """
    alpha, p = np.array([0.12, 0.2, 0.26]), np.array([3.0, 3.6, 2.6])
    rocks = rk.inverse.Observations(alpha, p, ["toppled", "survived", "survived"], alpha_sd=0.05 * alpha)

    def total(accuracy):
        likelihood = rk.inverse.Likelihood(rocks, rk.SinePulse, 0.3, accuracy=accuracy)
        return lambda x: likelihood.log_terms({"amplitude": jnp.exp(x), "period": 0.9}).sum(-1)

    places = np.log([0.25, 0.4, 0.6])
    slopes = jax.grad(lambda x: total(0.005)(x).sum())(jnp.asarray(places))
    values = np.asarray(total(0.004)(np.concatenate([places + 0.1, places - 0.1])))
    np.testing.assert_allclose(slopes, (values[:3] - values[3:]) / 0.2, atol=0.15, rtol=0.1)


@pytest.mark.parametrize("accuracy", [0.0, 1e-4, 0.2, np.nan])
def test_accuracies_that_there_are_not(accuracy):
    rocks = rk.inverse.Observations([0.2], [3.0], ["survived"])
    with pytest.raises(ValueError, match="`accuracy` must be"):
        rk.inverse.Likelihood(rocks, rk.SinePulse, accuracy=accuracy)


@pytest.mark.parametrize("accuracy", [0.02, 0.01, 0.005])
def test_possible_rocks_are_normal(accuracy):
    """Means are zero, directions hardly correlated, and the variance within strata is known."""
    normals, absorbed = (getattr(Quadrature.of(accuracy, False), name) for name in ("normals", "absorbed"))
    np.testing.assert_allclose(normals.mean(axis=1), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.mean(np.square(normals), axis=1) + absorbed, 1.0, rtol=1e-12)
    assert 0 < absorbed < 0.4
    if normals.shape[1] > 4:
        assert np.abs(np.corrcoef(normals)[0, 1]) < 0.1


def test_competing_summits_are_reported():
    """Two ways to topple one rock and spare two: short and strong, or long and weak."""
    alpha, p = np.array([0.12, 0.25]), np.array([4.0, 1.6])
    rocks = rk.inverse.Observations(alpha, p, ["rotation"] * 2, rotation=[0.06, 0.1], rotation_sd=[0.002, 0.003])
    found = rk.inverse.estimate_motion(rocks, rk.SinePulse, unknowns(), 0.02, progress=False)
    kinds = rk.inverse.EstimateStatus
    others, heights = np.asarray(found.competing), np.asarray(found.competing_values)
    assert others.shape == (heights.size, 2) and (heights <= found.log_likelihood).all()
    assert (heights > found.log_likelihood - RATIO).all() and (np.diff(heights) <= 0).all()
    assert sum("Another maximum" in remark for remark in found.remarks) == heights.size or bool(
        found.status == kinds.contradictory
    )
    if bool(found.status == kinds.successful):
        assert heights.size == 0
    low, high = np.asarray(found.interval).T
    if np.isfinite(low).all():
        assert ((others >= low) & (others <= high)).all()


KINDS = {
    rk.inverse.EstimateStatus: ("successful", "several_maxima", "no_information", "contradictory", "open_interval"),
    rk.inverse.RecordStatus: ("successful", "useless_slopes", "spectrum_changed", "not_reached"),
}


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_no_status_claims_more_than_was_tried(kind):
    """No search proves that it found every maximum, the nearest record, or every motion."""
    words = " ".join(kind[getattr(kind, name)] for name in KINDS[kind])
    for claim in ("One maximum stands out", "No record near", "every motion in the range", "under no motion"):
        assert claim not in words
