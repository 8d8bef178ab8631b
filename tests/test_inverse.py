"""Inference on a motion from rocks: probabilities against counted verdicts, maxima against grids, honest refusals."""

import re
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import jaxrock as rk
from jaxrock.command_line.main import main
from jaxrock.inverse.likelihood import _Scene
from jaxrock.inverse.observation_files import _COLUMNS
from jaxrock.inverse.observations import SEEN
from jaxrock.inverse.posterior import _within
from jaxrock.inverse.profile_likelihood import shape_at
from jaxrock.inverse.scatter import Possible, Quadrature, levels_around, rocks_at
from jaxrock.inverse.unknowns import Evaluator, Problem, _batch
from jaxrock.numerics.batched_bfgs import batched_bfgs
from references import chaotic

# All tests have twelve rocks and a sine pulse, so that they share one compiled program.
ALPHA = np.array([0.10, 0.12, 0.14, 0.16, 0.18, 0.20, 0.22, 0.24, 0.26, 0.28, 0.31, 0.34])
P = np.array([3.0, 2.2, 3.6, 2.6, 4.2, 3.1, 2.4, 5.0, 3.4, 2.8, 4.5, 3.8])
TRUTH = {"amplitude": 0.35, "period": 0.8}
UNKNOWNS = {"amplitude": rk.inverse.Unknown(0.05, 2.0), "period": rk.inverse.Unknown(0.2, 3.0)}
SCATTER = 0.2


def rocks(seen, alpha=ALPHA, p=P, **more):
    return rk.inverse.Observations(alpha, p, seen, **({"alpha_sd": 0.04 * alpha, "p_sd": 0.02 * p} | more))


def rocked(amplitude, period, alpha, p, restitution):
    found = rk.outcome(rk.Block(alpha, p, restitution), rk.SinePulse(amplitude, period))
    return {"overturned": found.overturned, "peak": jnp.where(found.overturned, 0.0, found.max_rotation)}


def what_becomes(**scenes):
    """Return verdicts and peak rotations of scenes given by parallel lists, without a likelihood or margin."""
    arrays = np.broadcast_arrays(*scenes.values())
    count = arrays[0].size
    # As many as of the largest test, over and over: one compiled program.
    lists = {name: np.resize(x, max(count, 48_000)) for name, x in zip(scenes, arrays)}
    found = rk.sweep(rocked, outer=False, progress=False, **lists).values
    return {name: x[:count].reshape(arrays[0].shape) for name, x in found.items()}


def overturned(**scenes):
    return what_becomes(**scenes)["overturned"]


def by_momentum(alpha):
    """Housner's restitution."""
    return 1 - 1.5 * np.sin(alpha) ** 2


@pytest.fixture(scope="module")
def verdicts():
    """Shares of 1,000 possible scenes in which each rock stands: from the verdict alone, at four motions."""
    seen, rng = rocks(["survived"] * 12, restitution_sd=0.03), np.random.default_rng(0)
    e = rng.normal(size=(4, 1000, 12))
    of_each = (seen.alpha_sd, seen.alpha), (seen.p_sd, seen.p), (seen.restitution_sd, 1.0)
    sd = np.stack([np.asarray(sd) / np.asarray(x) for sd, x in of_each])[:, None]
    alpha, p, restitution = (np.ravel(x) for x in rocks_at(seen, jnp.asarray(e[1:] * sd)))
    motions = [(0.15, 0.4), (0.25, 0.8), (0.35, 0.8), (0.5, 1.6)]
    size, length = np.array(motions).T[..., None]
    factor = np.exp(SCATTER * e[0]).ravel()
    lost = overturned(amplitude=size * factor, period=length, alpha=alpha, p=p, restitution=restitution)
    return seen, motions, 1 - lost.reshape(4, 1000, 12).mean(axis=1)


def test_probabilities_are_shares_of_verdicts(verdicts):
    seen, motions, shares = verdicts
    evaluate = evaluator(seen)
    found = np.array([evaluate.facts(place)[0] for place in np.log(motions)])
    unsure = (shares > 0.02) & (shares < 0.98)
    assert unsure.sum() > 12
    assert np.max(np.abs(found - shares)) < 0.07
    assert np.sqrt(np.mean((found - shares)[unsure] ** 2)) < 0.035
    assert abs(np.mean(found - shares)) < 0.005


def evaluator(seen, scatter=SCATTER):
    return Evaluator(Problem(rk.inverse.Likelihood(seen, rk.SinePulse, scatter), UNKNOWNS))


def test_survivors_far_inside_say_nothing_and_slopes_are_slopes():
    words = ["survived", "toppled", "rotation"] * 4
    evaluate = evaluator(rocks(["survived"] * 12))
    weak = evaluate.points(np.log([[0.05001, 0.21]]))
    assert abs(evaluate(weak)[0][0] - 12 * np.log(0.99)) < 1e-12  # one in a hundred is wrong about it
    assert abs(evaluator(rocks(["toppled"] * 12))(weak)[0][0] - 12 * np.log(0.01)) < 1e-9
    evaluate = evaluator(rocks(words, rotation=0.05, rotation_sd=0.01))
    points = np.random.default_rng(1).normal(size=(4, 2)) * 0.7
    steps = 1e-6 * np.eye(2)
    values = [[evaluate(points + s * step)[0] for s in (1, -1)] for step in steps]
    differences = np.array([(up - down) / 2e-6 for up, down in values]).T
    np.testing.assert_allclose(evaluate(points)[1], differences, rtol=1e-4, atol=1e-4)


def test_what_fills_up_a_batch_is_not_computed_and_changes_nothing():
    evaluate, places = evaluator(rocks(["survived", "toppled"] * 6)), np.log(np.geomspace([0.1, 0.3], [1.0, 2.0], 4))
    all_at_once = evaluate.at(places)
    for name, whole, part in zip(("values", "slopes"), all_at_once, evaluate.at(places[:3])):
        np.testing.assert_array_equal(whole[:3], part, name)
    values, slopes, (_, known, *_) = _batch(evaluate.problem, places, np.arange(4) < 3)
    np.testing.assert_array_equal(values[:3], all_at_once[0][:3])
    assert values[3] == -np.inf and not slopes[3].any()
    np.testing.assert_array_equal(known, [[1.0] * 12] * 3 + [[0.0] * 12])


def test_a_motion_of_ones_own_is_asked_for_places_that_are_looked_at():
    """Nothing else: it may refuse what is no number."""

    def motion(amplitude, period):
        return rk.SinePulse(amplitude, eqx.error_if(period, ~(period > 0.1), "no period"))

    likelihood = rk.inverse.Likelihood(rocks(["survived", "toppled"] * 6), motion, SCATTER)
    found = Evaluator(Problem(likelihood, UNKNOWNS)).at(np.log([[0.35, 0.8]]))[0]
    np.testing.assert_allclose(found, evaluator(likelihood.observations).at(np.log([[0.35, 0.8]]))[0], rtol=1e-12)


def test_a_likelihood_is_smooth_in_the_amplitude():
    """However rough the margin is: nodes do not move along."""
    amplitude = TRUTH["amplitude"] * np.exp(np.linspace(-0.5, 0.5, 1001))
    terms = log_terms(rocks(["survived", "toppled"] * 6), amplitude=amplitude, period=1.7)
    bends = np.abs(np.diff(terms, 2, axis=0))
    # A normal probability bends by 1/scatter^2 at most; the rest is where nodes come and go, far outside.
    assert bends.max() < 1e-2 and np.quantile(bends, 0.98) < 5e-5


def log_terms(seen, scatter=SCATTER, **values):
    """Return terms of the log-likelihood at motions (motions, rocks)."""
    likelihood, arrays = rk.inverse.Likelihood(seen, rk.SinePulse, scatter), np.broadcast_arrays(*values.values())
    count = arrays[0].size
    # As many at a time as `feasible_region` takes: one compiled program.
    parts = zip(*(np.resize(x, (-(-count // 64), 64)) for x in arrays))
    found = [np.asarray(likelihood.log_terms(dict(zip(values, part)), slopes=False)) for part in parts]
    return np.concatenate(found)[:count]


@pytest.mark.parametrize(
    ("period", "low", "high", "scatter", "off", "most"),
    [
        # Such rotations are met within one or two hundredths of the amplitude, a tenth of the way from node to node.
        pytest.param(1.2, 0.12, 0.6, 0.3, 0.45, 1.0, id="from none to overturning between nodes"),
        # A twentieth more of all reference rotations is off by 0.32 in the mean.
        pytest.param(0.4, 0.25, 1.2, 0.1, 0.06, 0.45, id="short pulses, under which it grows steadily"),
    ],
)
def test_densities_of_measured_rotations_are_integrals_over_the_scatter(period, low, high, scatter, off, most):
    """However little the rotation is uncertain."""
    alpha = np.array([0.2, 0.17, 0.23] * 4)
    p, peak, sd = np.array([3.0, 3.5, 2.5] * 4), np.repeat([0.1, 0.08, 0.12, 0.05], 3), np.repeat([0.01, 0.02], 6)
    seen = rk.inverse.Observations(alpha, p, ["rotation"] * 12, rotation=peak, rotation_sd=sd)
    amplitude = np.geomspace(low, high, 80)
    found = log_terms(seen, scatter, amplitude=amplitude, period=period)
    e = np.linspace(-4.5, 4.5, 3001)
    factors = np.exp(scatter * e)
    exact = np.empty_like(found)
    grid = np.geomspace(amplitude[0] * factors[0], amplitude[-1] * factors[-1], 12_000)
    weight = np.exp(-((np.log(grid / amplitude[:, None]) / scatter) ** 2) / 2) / (np.sqrt(2 * np.pi) * scatter)
    # There are three blocks only.
    scenes = what_becomes(amplitude=grid, period=period, alpha=alpha[:3, None], p=p[:3, None],
                          restitution=by_momentum(alpha[:3, None]))  # fmt: skip
    for i in range(12):
        density = np.exp(-(((peak[i] - scenes["peak"][i % 3]) / sd[i]) ** 2) / 2) / (np.sqrt(2 * np.pi) * sd[i])
        density = np.where(scenes["overturned"][i % 3], 0.0, density)
        exact[:, i] = weight @ density * np.log(grid[1] / grid[0])
    exact = np.log(0.98 * exact + 0.01 * 2 / np.pi)
    assert np.sqrt(np.mean((found - exact) ** 2)) < off and np.max(np.abs(found - exact)) < most
    total = found.sum(axis=1)
    assert np.sum(np.diff(np.sign(np.diff(total))) < 0) == 1  # one maximum
    assert abs(np.log(amplitude[total.argmax()] / amplitude[exact.sum(axis=1).argmax()])) < 0.05


def test_motions_that_there_are_not_are_impossible():
    terms = log_terms(rocks(["survived"] * 12), amplitude=np.array([0.2, 0.2, np.nan]), period=np.array([1, -1, 1]))
    assert np.isfinite(terms[0]).all() and (terms[1:] == -np.inf).all()
    never = {"amplitude": UNKNOWNS["amplitude"], "period": rk.inverse.Unknown(1e10, 1e11)}  # s: beyond all ranges
    with pytest.raises(ValueError, match="`unknowns` must have ranges in which there are motions"):
        rk.inverse.estimate_motion(rocks(["survived"] * 12), rk.SinePulse, never, SCATTER, starts=1)


@pytest.mark.parametrize("what", ["survival", "log_terms"])
def test_slopes_that_were_not_computed_are_refused(what):
    likelihood = rk.inverse.Likelihood(rocks(["survived"] * 12), rk.SinePulse, SCATTER)
    options = {} if what == "survival" else {"slopes": False}
    with pytest.raises(NotImplementedError, match="without derivatives"):
        jax.eval_shape(
            jax.grad(lambda a: getattr(likelihood, what)(dict(amplitude=a, period=1.0), **options).sum()), 0.3
        )


@pytest.mark.parametrize("scatter", [0.2, 0.45])
def test_slopes_by_the_scatter(scatter):
    """Check slopes for straight margins: P = Phi(ln(critical/amplitude)/scatter), and its slope."""
    critical, strength = np.log([0.22, 0.27, 0.36, 0.4] * 3), np.log(0.3)
    (found, _), (slopes, _) = map(np.asarray, stands(scatter, critical, strength))
    z = (critical - strength) / scatter
    np.testing.assert_allclose(np.exp(found), scipy.stats.norm.cdf(z), atol=1e-3)
    np.testing.assert_allclose(np.exp(found) * slopes, -z / scatter * scipy.stats.norm.pdf(z), rtol=0.015)


@pytest.mark.parametrize("scatter", [0.2, 0.45])
def test_slopes_by_the_scatter_of_what_is_hardly_possible(scatter):
    """Five standard deviations away, beyond the last nodes: rocks that stood all the same, and that toppled."""
    z = np.array([-5.0, 5.0] * 6)
    strength = np.log(0.3)
    _, slopes = stands(scatter, strength + scatter * z, strength)
    slopes = np.where(z < 0, *slopes)  # of that which was hardly possible
    # The straight lines on which margins go on there are a little steeper than the margins are.
    true = 5 / scatter * scipy.stats.norm.pdf(5) / scipy.stats.norm.sf(5)
    np.testing.assert_allclose(slopes, true, rtol=0.1)


@jax.jit
def stands(scatter, critical, strength):
    """Logarithms of the probabilities that rocks stand, which are lost above amplitudes, and topple, and their slopes
    by the scatter."""

    def probabilities(scatter):
        seen = rk.inverse.Observations(np.full(12, 0.2), np.full(12, 3.0), ["survived"] * 12)
        quadrature = Quadrature.of(0.02, True)
        levels, where = levels_around(seen, quadrature, scatter, strength)
        y = critical - jax.lax.stop_gradient(levels.strength)  # nodes are fixed, as in a likelihood
        margin, rotation = jnp.where(y < 0, 1 - jnp.exp(-2 * y), jnp.sqrt(1 + 4 * jnp.maximum(y, 0.0)) - 1), 0 * y
        found = Possible.of(where, margin, rotation, y == y, y < 0, rotation + 1, quadrature.apart).log_probabilities()
        return found, found

    slopes, found = jax.jacfwd(probabilities, has_aux=True)(scatter)
    return found, slopes


def test_open_scenes_enter_with_their_share():
    """Rocks stand in all scenes but one, in which chaos leaves the verdict open; without a share it is bridged."""
    where, middle = np.linspace(-4, 4, 9)[:, None, None], 4

    def topples(share):
        y, known = np.full((9, 1, 1), 0.5), np.arange(9)[:, None, None] != middle
        shares = np.where(known, np.nan, share)
        found = Possible.of(*jax.device_put((where, y, 0 * y, known, y < 0, 0 * y + 1)), 1.0, jnp.asarray(shares))
        return float(jnp.exp(found.log_probabilities()[1, 0])), found

    half, one = scipy.stats.norm.cdf([0.5, 1.0]) - 0.5  # normal probability to each side, up to there
    for share in (0.4, 0.9):
        expected = 2 * share * (0.75 * half + 0.25 * (one - half))
        assert topples(share)[0] == pytest.approx(expected, abs=3e-4)
    assert topples(0.0)[0] == pytest.approx(2 * one / 64, rel=1e-2)  # half a copy
    assert topples(np.nan)[0] < 1e-4 and np.all(topples(np.nan)[1].known)


def test_chaotic_scenes_of_a_likelihood():
    """A verdict that holds counts, without slopes of what is known only to its error; an open one has a share."""
    samples, dt = chaotic.record("twice")
    scene = _Scene(lambda stretch: rk.Record(samples, dt * stretch), rk.Housner(), None, ("stretch",))
    level = np.log([1.378, 1.516, 0.3]) + np.log(np.abs(samples).max())
    p = np.array([0.9755561453051129, 1.8891563520285026, 1.8891563520285026])
    blocks = rk.Block(np.full(3, 0.24497866312686414), p, np.full(3, 0.9117647058823529))
    rows, (real, lost, known, share) = jax.jit(scene.rows)(jnp.ones((3, 1)), jnp.asarray(level), jnp.ones(3), blocks)
    np.testing.assert_array_equal(known, [True, False, True])
    assert not lost[0] and real[0, 0] > 0 and not rows[0].any() and rows[2].any()
    assert 0.1 < share[1] < 0.9 and np.isnan(share[np.array([0, 2])]).all()


@pytest.mark.parametrize("what", ["rocks", "rocks and values", "the motion's function"])
def test_slopes_that_there_are_not_are_refused(what):
    """By rocks a likelihood was differentiated without what their own response changes by."""

    def height(x):
        alpha, amplitude, factor = (x if part in what else 1.0 for part in ("rocks", "values", "function"))
        likelihood = rk.inverse.Likelihood(
            rocks(["survived"] * 12, alpha * ALPHA), lambda amplitude, period: rk.SinePulse(amplitude, factor * period)
        )
        return likelihood.log_terms({"amplitude": 0.3 * amplitude, "period": 1.0}).sum()

    with pytest.raises(NotImplementedError, match="not by the rocks, nor by what the functions of motion and model"):
        jax.eval_shape(jax.grad(height), 1.0)


def truth(seed, scatter=SCATTER):
    """Draw the observations of twelve rocks under the true motion, with all scatter."""
    e = np.random.default_rng(seed).normal(size=(3, 12))
    alpha, p = ALPHA * np.exp(0.04 * e[0]), P * np.exp(0.02 * e[1])
    size = TRUTH["amplitude"] * np.exp(scatter * e[2])
    known = {"alpha": alpha, "p": p, "restitution": by_momentum(alpha)}
    return ["toppled" if x else "survived" for x in overturned(amplitude=size, period=TRUTH["period"], **known)]


def logs_at(seen, **over):
    """The log-likelihood over lists of both parameters, which neither climbs nor interpolates."""
    found = rk.inverse.feasible_region(rk.inverse.Likelihood(seen, rk.SinePulse, SCATTER), over, progress=False)
    return np.asarray(found.log_likelihood)


def test_a_fit_finds_the_maximum_and_its_intervals_end_where_the_profile_says():
    seen = rocks(truth(3))
    found = rk.inverse.estimate_motion(seen, rk.SinePulse, UNKNOWNS, SCATTER, starts=4)
    lists = {name: np.geomspace(float(x.low), float(x.high), 256) for name, x in UNKNOWNS.items()}
    assert logs_at(seen, **{name: x[::8] for name, x in lists.items()}).max() <= float(found.log_likelihood) + 1e-6
    ends = {name: [float(x) for x in interval] for name, interval in zip(found.names, np.asarray(found.interval))}
    below = 2 * (float(found.log_likelihood) - logs_at(seen, **lists | {"amplitude": ends["amplitude"]}).max(axis=1))
    ratios = [
        below,
        2 * (float(found.log_likelihood) - logs_at(seen, **lists | {"period": ends["period"]}).max(axis=0)),
    ]
    for ratio, is_open in zip(np.ravel(ratios), np.ravel(found.open)):
        assert ratio < 3.84 + 0.01 if is_open else abs(ratio - 3.84) < 0.3
    assert np.sum(np.asarray(found.open)) < 4
    assert all(low <= TRUTH[name] <= high for name, (low, high) in ends.items())


@pytest.mark.slow
def test_a_posterior_is_that_of_a_grid():
    pytest.importorskip("numpyro")
    seen = rocks(truth(3))
    found = rk.inverse.sample_motion(seen, rk.SinePulse, UNKNOWNS, SCATTER, effective_size=2000)
    assert found.status != rk.inverse.PosteriorStatus.not_converged
    assert found.effective_size.min() > 2000 and found.r_hat.max() < 1.01
    # Uniform in logarithms: so is the grid, of middles of cells.
    axes = [np.linspace(np.log(float(x.low)), np.log(float(x.high)), 161) for x in UNKNOWNS.values()]
    middles = [np.exp((axis[1:] + axis[:-1]) / 2) for axis in axes]
    values = logs_at(seen, amplitude=middles[0], period=middles[1])
    weights = np.exp(values - values.max()) / np.exp(values - values.max()).sum()
    for i, (name, axis, middle) in enumerate(zip(found.names, axes, middles)):
        share = weights.sum(axis=1 - i)
        mean = np.sum(share * middle)
        sd = np.sqrt(np.sum(share * (middle - mean) ** 2))
        error = sd / np.sqrt(float(found.effective_size[i]))
        assert abs(float(found[name].mean()) - mean) < 4 * error
        assert abs(float(found[name].std()) / sd - 1) < 0.3  # most of it may come from a lobe of one in a thousand
        for probability in (0.025, 0.16, 0.5, 0.84, 0.975):
            level = np.exp(np.interp(probability, np.append(0, np.cumsum(share)), axis))
            within = float(np.mean(found[name] < level))
            expected = 4 * np.sqrt(probability * (1 - probability) / float(found.effective_size[i]))
            assert abs(within - probability) < expected + 0.002
    with pytest.raises(ValueError, match="`estimate` must be of these unknowns"):
        others = UNKNOWNS | {"amplitude": rk.inverse.Unknown(10.0, 20.0)}
        rk.inverse.sample_motion(seen, rk.SinePulse, others, SCATTER, estimate=found.estimate)
    top = values.max()
    assert top - 0.1 < float(found.log_density.max()) <= float(found.estimate.log_likelihood) + 1e-6


def test_samples_need_numpyro(monkeypatch):
    seen = rocks(["survived"] * 12)
    monkeypatch.setitem(sys.modules, "numpyro.diagnostics", None)
    with pytest.raises(ImportError, match=r"jaxrock\[posterior\]"):
        rk.inverse.sample_motion(seen, rk.SinePulse, UNKNOWNS, SCATTER)


@pytest.mark.parametrize("name", ["effective_size", "steps"])
def test_samples_need_good_arguments(name):
    pytest.importorskip("numpyro")
    with pytest.raises(ValueError, match=f"`{name}` must be a whole number from 1 to"):
        rk.inverse.sample_motion(rocks(["survived"] * 12), rk.SinePulse, UNKNOWNS, SCATTER, **{name: 0})


def test_survivors_bound_from_above_only():
    found = rk.inverse.estimate_motion(rocks(["survived"] * 12), rk.SinePulse, UNKNOWNS, SCATTER, starts=8)
    assert found.status == rk.inverse.EstimateStatus.open_interval
    is_open = np.asarray(found.open)
    assert is_open[0, 0] and not is_open[0, 1] and is_open[1].all()
    assert "do not bound amplitude from below" in " ".join(found.remarks)


def test_rocks_that_no_motion_moves_tell_nothing():
    unknowns = {"amplitude": rk.inverse.Unknown(0.05, 0.3), "period": rk.inverse.Unknown(0.2, 3.0)}
    seen = rocks(["survived"] * 12, alpha=ALPHA + 1.0, restitution=0.5)
    found = rk.inverse.estimate_motion(seen, rk.SinePulse, unknowns, 0.1, starts=8)
    assert found.status == rk.inverse.EstimateStatus.no_information
    np.testing.assert_allclose(found.interval, [[0.05, 0.3], [0.2, 3.0]])


@pytest.mark.slow
def test_contradictions_have_no_intervals():
    # The sturdiest half fell, the slenderest stands.
    seen = rocks(["survived"] * 6 + ["toppled"] * 6, p=np.full(12, 3.0))
    found = rk.inverse.estimate_motion(seen, rk.SinePulse, UNKNOWNS, 0.05, starts=8)
    assert found.status == rk.inverse.EstimateStatus.contradictory
    assert np.isnan(found.interval).all() and found.consistent_scatter > 0.05
    assert "rock" in " ".join(found.remarks)


def test_a_rotation_that_no_motion_makes_is_named():
    """Its rock is likely to stand, as it does; and no larger scatter would move it that far."""
    unknowns = {"amplitude": rk.inverse.Unknown(0.05, 0.06), "period": rk.inverse.Unknown(0.2, 0.3)}
    seen = rocks(["survived"] * 3 + ["rotation"], ALPHA[-4:], P[-4:], rotation=0.3, rotation_sd=0.001)
    found = rk.inverse.estimate_motion(seen, rk.SinePulse, unknowns, 0.05, starts=1)
    assert found.status == rk.inverse.EstimateStatus.contradictory and float(found.probability[3]) > 0.9
    assert "rock 4 (its rotation is off by 300.0 standard deviations)" in found.remarks[0]
    assert (
        np.isinf(found.consistent_scatter) and "no scatter that was tried, up to ten times as large" in found.remarks[1]
    )


def test_climbers_find_summits_and_hold_what_is_held():
    def hills(x):
        value = -np.sum((x - 1) ** 2 * np.array([1.0, 40.0]), axis=1)
        return value, -2 * (x - 1) * np.array([1.0, 40.0])

    starts = np.array([[0.0, 0.0], [3.0, -2.0]])
    np.testing.assert_allclose(batched_bfgs(hills, starts).points[0], 1.0, atol=1e-4)
    held = batched_bfgs(hills, starts, np.array([True, False]), group=np.arange(len(starts)))
    np.testing.assert_allclose(held.points, [[1.0, 0.0], [1.0, -2.0]], atol=1e-4)

    def single(x):
        """In single precision, and not a number where the second climber starts."""
        value, slope = hills(x)
        return np.where(x[:, 0] > 2, np.nan, value).astype(np.float32), slope.astype(np.float32)

    found = batched_bfgs(single, starts)
    np.testing.assert_allclose(found.points[0], 1.0, atol=1e-3)
    np.testing.assert_array_equal(found.arrived, [True, False])


@pytest.mark.parametrize("dtype, off", [(np.float64, 1e-6), (np.float32, 1e-3)])
def test_maxima_at_the_end_of_a_range_are_in_it(dtype, off):
    """A maximum at an end, rounded: in single precision the logarithm of 3 is off by more than it may be in double."""
    low, high = np.log([0.05, 0.2]), np.log([2.0, 3.0])
    rounded = np.log(np.nextafter(np.exp([low, high]).astype(dtype), np.array([[0.0], [np.inf]], dtype)))
    assert (rounded[0] <= low).all() and (rounded[1] >= high).all() and _within(rounded, low, high, dtype)
    assert not _within(rounded * np.array([[1.0], [1 + off]]), low, high, dtype)


WORDS = ["toppled"] * 6 + ["survived"] * 6


class _Bowl:
    """Values and slopes of a normal likelihood with ripples; places are points."""

    def __init__(self, hessian, summit, ripple):
        self.hessian, self.summit, self.ripple = hessian, summit, ripple
        self.ends = np.repeat([[-1.0], [1.0]], len(summit), axis=1)
        self.waves = 90 * np.arange(1, 1 + len(summit))

    def places(self, points):
        return points

    def at(self, places):
        away = places - self.summit
        pull, phase = away @ self.hessian, away @ self.waves
        return (
            -np.sum(pull * away, axis=1) / 2 + self.ripple * np.cos(phase),
            -pull - self.ripple * np.sin(phase)[:, None] * self.waves,
        )


@pytest.mark.parametrize("summit", [(0.0,), (0.3, -0.2), (1.0, 0.97), (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)])
def test_steps_of_a_likelihood_do_not_change_its_shape(summit):
    """Ripples of 0.02, that bend it by up to 30 times as much, at the end of a range, too."""
    axes = np.linalg.qr(np.random.default_rng(4).normal(size=(len(summit),) * 2))[0]
    exact = axes @ np.diag(np.geomspace(0.05, 0.2, len(summit)) ** 2) @ axes.T
    shape = shape_at(_Bowl(np.linalg.inv(exact), np.array(summit), 0.02), np.array(summit))
    tight = np.linalg.cholesky(exact)
    np.testing.assert_allclose(
        np.linalg.solve(tight, np.linalg.solve(tight, shape.covariance).T), np.eye(len(summit)), atol=0.15
    )


def test_a_flat_likelihood_with_steps_has_no_covariance():
    shape = shape_at(_Bowl(np.diag([100.0, 0.0]), np.array([0.3, 0.1]), 0.002), np.array([0.3, 0.1]))
    assert np.isinf(shape.covariance).all()
    np.testing.assert_allclose(shape.deviations[1], 0.05, rtol=0.1)
    np.testing.assert_allclose(np.abs(shape.directions[0]), [0, 1], atol=0.02)


def test_regions_agree_with_verdicts():
    """Rocks known exactly, hardly any scatter: a motion is allowed if it does to every rock what was seen."""
    scatter = 0.002
    over = {"amplitude": np.linspace(0.2, 0.5, 16), "period": np.linspace(0.5, 1.2, 16)}
    known = {"alpha": ALPHA, "p": P, "restitution": np.asarray(rocks(WORDS).restitution)}
    words = overturned(amplitude=over["amplitude"][7], period=over["period"][6], **known)
    seen = rocks(["toppled" if x else "survived" for x in words], alpha_sd=0.0, p_sd=0.0)
    found = rk.inverse.feasible_region(rk.inverse.Likelihood(seen, rk.SinePulse, scatter), over)
    # Five standard deviations to both sides of the motion at each rock: (rows, columns, factors, rocks).
    factors = np.exp(np.linspace(-5, 5, 21) * scatter)
    lost = overturned(amplitude=over["amplitude"][:, None, None, None] * factors[:, None],
                      period=over["period"][:, None, None], **known)  # fmt: skip
    sure = (lost.all(axis=2) | ~lost.any(axis=2)).all(axis=-1)
    as_seen = (lost[:, :, 10] == (np.asarray(seen.seen) == 1)).all(axis=-1)
    assert (sure & as_seen).sum() >= 3 and (sure & ~as_seen).sum() > 100
    height, allowed = np.asarray(found.log_likelihood), np.asarray(found.allowed)
    assert np.min(height[sure & as_seen]) > 12 * np.log(0.99) - 0.02
    assert np.max(height[sure & ~as_seen]) < np.log(0.05)
    assert not allowed[sure & ~as_seen].any()


def test_up_to_the_unexceeded_motion_all_that_stand_stand():
    seen, durations = rocks(WORDS), np.array([0.02, 0.3, 0.5, 0.8, 1.2, 2.0])  # as many as below: one program
    found = rk.inverse.unexceeded_motion(seen, rk.SinePulse, durations, progress=False)
    amplitude, weakest, complete = map(np.asarray, (found.amplitude, found.weakest, found.complete))
    assert np.isinf(amplitude[0]) and weakest[0] == -1 and complete.all()
    wall, weakest = amplitude[1:], weakest[1:]
    assert (weakest >= 6).all()  # those that toppled do not count
    known = {name: np.asarray(getattr(seen, name))[6:] for name in ("alpha", "p", "restitution")}
    below = wall[:, None] * np.append(np.linspace(0.2, 0.999, 100), 1 - 1e-9)
    assert not overturned(amplitude=below[..., None], period=durations[1:, None, None], **known).any()
    above = overturned(amplitude=wall[:, None] * (1 + 1e-9), period=durations[1:, None], **known)
    assert (above.sum(axis=1) == 1).all() and (above.argmax(axis=1) + 6 == weakest).all()


def test_the_command_from_a_table_to_figures(tmp_path, capsys, monkeypatch):
    """Check the command from a table of rocks to figures: its options, and results in its tables."""
    estimate_motion, asked = rk.inverse.estimate_motion, []

    def noted(*given, **named):
        asked.append((given, named, estimate_motion(*given, **named)))
        return asked[-1][-1]

    monkeypatch.setattr(rk.inverse, "estimate_motion", noted)
    rows = [f"{a!r},{0.04 * a!r},{p!r},{0.02 * p!r},{word}" for a, p, word in zip(ALPHA.tolist(), P.tolist(), WORDS)]
    rows = [f'"rock {i + 1}",{row}' for i, row in enumerate(rows)]
    path = tmp_path / "rocks.csv"
    path.write_text("\n".join(["name,alpha_rad,alpha_rad_sd,p_rad_per_s,p_rad_per_s_sd,observed", *rows]) + "\n")
    ranges = ("--amplitude", "0.05", "2", "--duration", "0.2", "3", "--scatter", "0.2")
    status = main(["invert", str(path), *ranges, "--starts", "8", "--points", "6", "--out", str(tmp_path)])
    printed, errors = capsys.readouterr()
    assert status == 0 and errors == ""
    assert printed.startswith("12 rocks: 6 survived, 6 toppled, 0 rotation\n  amplitude ")
    [(given, named, found)] = asked
    expected = rocks(WORDS), rk.SinePulse, UNKNOWNS, SCATTER, {"lapse": 0.02, "starts": 8, "model": rk.Housner()}
    assert jax.tree.structure((*given, named)) == jax.tree.structure(expected)
    jax.tree.map(np.testing.assert_array_equal, (*given, named), expected)
    lines = (tmp_path / "estimate.csv").read_text().splitlines()
    for line, name, value, interval in zip(lines[1:], found.names, found.values, found.interval, strict=True):
        fields = line.split(",")
        assert fields[:2] == [name, {"amplitude": "g", "period": "s"}[name]]
        np.testing.assert_allclose([float(x) for x in fields[2:5]], [value, *interval], rtol=2e-5)
    shares = np.genfromtxt(tmp_path / "probabilities.csv", delimiter=",", skip_header=1, usecols=4)
    np.testing.assert_allclose(shares, found.probability, rtol=1e-3, atol=1e-5)
    region = np.loadtxt(tmp_path / "region.csv", delimiter=",", skiprows=1)
    assert region.shape == (36, 4) and (region[:, 2] <= float(found.log_likelihood)).all()
    wall = (tmp_path / "unexceeded.csv").read_text().splitlines()
    assert wall[0] == "duration_s,amplitude_g,rock,complete" and len(wall) == 7
    assert (tmp_path / "region.png").stat().st_size > 1000
    assert len(path.read_text().splitlines()) == 13  # what was read is left alone


def test_rocks_that_say_nothing_leave_what_was_known_before(tmp_path, capsys):
    """They cannot be moved in the range: the most probable motion and its intervals are those of the priors."""
    path = tmp_path / "rocks.csv"
    path.write_text("name,alpha_rad,p_rad_per_s,observed\na,0.6,2,survived\nb,0.7,3,survived\n")
    ranges = ("--amplitude", "0.04", "0.25", "--duration", "0.2", "5", "--starts", "4", "--points", "2")
    priors = ("--prior", "amplitude", "0.1", "0.2", "--prior", "duration", "1.2", "0.4")
    status = main(["invert", str(path), *ranges, *priors, "--lapse", "0.05", "--out", str(tmp_path)])
    printed, errors = capsys.readouterr()
    assert status == 0 and errors == ""
    assert f"log-likelihood {2 * np.log(1 - 0.05 / 2):.3f}, with the priors, scatter 0.3" in printed
    for line, (median, sd) in zip((tmp_path / "estimate.csv").read_text().splitlines()[1:], [(0.1, 0.2), (1.2, 0.4)]):
        expected = median * np.exp(np.sqrt(2 * 1.9207) * sd * np.array([0, -1, 1]))
        np.testing.assert_allclose([float(x) for x in line.split(",")[2:5]], expected, rtol=2e-4)
        assert line.endswith(",0,0")


@pytest.mark.parametrize(
    "prior, message",
    [
        (("shape", "1", "1"), "must name one of amplitude, duration, but names shape"),
        (("period", "1", "1", "--prior", "duration", "1", "1"), "must name duration at most once, but does so twice"),
        (("duration", "1", "wide"), "must end with two numbers, but is duration 1 wide"),
        (("duration", "1", "-1"), "must end with a positive median and deviation, but is duration 1 -1"),
    ],
)
def test_impossible_priors_of_the_command(tmp_path, capsys, prior, message):
    path = tmp_path / "rocks.csv"
    path.write_text("name,alpha_rad,p_rad_per_s,observed\na,0.6,2,survived\n")
    assert main(["invert", str(path), "--prior", *prior, "--out", str(tmp_path)]) == 2
    assert re.search(message, capsys.readouterr().err)


HEADER = (
    "name,alpha_deg,alpha_deg_sd,half_diagonal_m,half_diagonal_m_sd,restitution,observed,rotation_deg,rotation_deg_sd"
)


def test_a_file_of_rocks(tmp_path):
    path = tmp_path / "rocks.csv"
    path.write_text(f"# a comment\n{HEADER}\na,10,0.5,1.2,0.1,,toppled,,\n\nb,20,1,0.9,,0.8,rotation,3,0.5\n")
    seen = rk.inverse.read_observations(path)
    np.testing.assert_allclose(seen.alpha, np.deg2rad([10, 20]))
    np.testing.assert_allclose(seen.p, np.sqrt(3 * 9.81 / 4 / np.array([1.2, 0.9])))
    np.testing.assert_allclose(seen.p_sd / seen.p, [0.1 / 2.4, 0])
    np.testing.assert_allclose(seen.restitution, [1 - 1.5 * np.sin(np.deg2rad(10)) ** 2, 0.8])
    np.testing.assert_allclose(seen.rotation_sd[1], np.deg2rad(0.5))
    assert seen.names == ("a", "b")


def test_the_example_is_read_and_says_what_people_say(tmp_path, capsys):
    with pytest.raises(SystemExit, match="0"):
        main(["invert", "--example"])
    path = tmp_path / "rocks.csv"
    path.write_text(capsys.readouterr().out)
    seen = rk.inverse.read_observations(path)
    assert [SEEN[k] for k in np.asarray(seen.seen)] == ["toppled", "rotation", "survived", "survived"]
    np.testing.assert_allclose(seen.rotation[1], np.deg2rad(5.1))


def test_all_columns_of_a_file_are_told(capsys):
    """Check that `--help`, the docstring and the page about rocks list all columns of a file."""
    with pytest.raises(SystemExit):
        main(["invert", "--help"])
    page = (Path(__file__).parents[1] / "docs" / "how_to" / "rock.md").read_text()
    for told in (capsys.readouterr().out, page):
        assert {name for name in _COLUMNS if not name.endswith("_sd")} <= set(re.findall(r"\w+", told))
    assert {name for name in _COLUMNS if not name.endswith(("_sd", "_deg"))} <= set(
        re.findall(r"\w+", rk.inverse.read_observations.__doc__)
    )


@pytest.mark.parametrize(
    "line, message",
    [
        ("a,95,0.5,1,0,,toppled,,", r"line 2: Argument `alpha` must be in \(0, pi/2\)"),
        ("a,10,0.5,-1,0,,toppled,,", "line 2: `half_diagonal_m` must be positive"),
        ("a,10,0.5,1,0,1.5,toppled,,", r"line 2: Argument `restitution` must be in \[0, 1\]"),
        ("a,70,0.5,1,0,,toppled,,", "line 2: Argument `alpha` must be at most 0.955"),
        ("a,10,0.5,1,0,,Felll,,", r"toppled, rotation, but is 'Felll'\. Did you mean 'fell'\?$"),
        ("a,10,0.5,1,0,,stod,,", r"but is 'stod'\. Did you mean 'stood'\?$"),
        ("a,10,0.5,1,0,,gone,,", r"line 2: `observed` must be one of survived, toppled, rotation, but is 'gone'\.$"),
        ("a,10,0.5,1,0,,rotation,3,", "line 2: a measured rotation needs a value and a standard deviation"),
        ("a,ten,0.5,1,0,,toppled,,", "line 2: `alpha_deg` must be a number"),
        ("a,10,0.5,1,0,,toppled,", "line 2: has 8 fields, but there are 9 columns"),
        ("a,,0.5,1,0,,toppled,,", "line 2: `alpha` is empty"),
        (
            "a,0.17,0.01,1,0,,toppled,,",
            "line 2: `alpha_deg` must be 0.5 or more, .* is 0.17; .* the column is `alpha_rad`",
        ),
        ("a,10,0.5,1,0,,stood,3,0.5", "line 2: `observed` is 'stood', but a rotation is given: call it rocked"),
        ("a,10,0.5,1,0,,fell,3,", "line 2: `observed` is 'fell', but a rotation is given"),
        ("a,10,0.5,1,0,,rocked,40,0.5", "line 2: Argument `rotation` must be below twice `alpha`"),
        ("#1,10,0.5,1,0,,toppled,,", "line 2: looks like a rock, but a line that begins with # is a comment"),
    ],
)
def test_impossible_rocks_are_named_by_their_line(tmp_path, line, message):
    refused(tmp_path, HEADER, line, message)


def refused(folder, header, line, message):
    path = folder / "rocks.csv"
    path.write_text(f"{header}\n{line}\n")
    with pytest.raises(ValueError, match=message):
        rk.inverse.read_observations(path)


@pytest.mark.parametrize(
    "header, message",
    [
        ("alpha_deg;p_rad_per_s;observed", "must separate its fields by commas"),
        ("alpha_deg,alpha_rad_sd,p_rad_per_s,observed", "has a column `alpha_rad_sd`, but no column `alpha_rad`"),
        ("alpha_deg,half_diagonal_m,p_rad_per_s_sd,observed", "`p_rad_per_s_sd`, but no column `p_rad_per_s`"),
        ("alpha_deg,p_rad_per_s,restitution_sd,observed", "`restitution_sd`, but no column `restitution`"),
        ("alpha_deg,p_rad_per_s,observed,rotation_rad,rotation_deg", "rotation_rad, rotation_deg, and not both"),
        ("alpha_deg,p_rad_per_s,observed,facing", "`facing`, which is for rocks whose sides differ"),
        ("alpha_deg,p_rad_per_s,observed,inertia_ratio", "`inertia_ratio`, which is for rocks whose sides differ"),
        ("alpha_deg,alpha_rad,p_rad_per_s,observed", "must have one of the columns alpha_rad, alpha_deg"),
        ("alpha_deg,observed", "must have one of the columns p_rad_per_s"),
        ("alpha_deg,p_rad_per_s,half_diagonal_m,observed", "radius1_m, and only one"),
        ("alpha_deg\tp_rad_per_s\tobserved", "by commas, not by tabs"),
        ("width,height_m,observed", "a column `width`; the nearest that is known: width_m"),
        ("alpha_deg,p_rad_per_s,observed,xyz", "a column `xyz`; known are alpha1_deg, .*width_m_sd"),
    ],
)
def test_columns_that_say_nothing_or_too_much_are_named(tmp_path, header, message):
    refused(tmp_path, header, ",".join("1" * (header.count(",") + 1)), message)


LIKELIHOOD = rk.inverse.Likelihood(rk.inverse.Observations(ALPHA, P, ["survived"] * 12), rk.SinePulse)


def test_unexceeded_records():
    """Check records of one shape and several durations, which share samples: as each alone.

    The amplitudes are those that the motions are given.
    """
    seen, shape = rk.inverse.Observations([0.12], [3.0], ["survived"]), 0.5 * np.sin(np.linspace(0, 2 * np.pi, 20))
    quick = {"model": rk.Linear(), "engine": rk.Series(order=6)}  # compiles in half the time
    make = lambda amplitude, duration: amplitude * rk.Record(shape, duration / 19)
    found = rk.inverse.unexceeded_motion(seen, make, [0.5, 0.6], progress=False, **quick)
    for duration, amplitude in zip((0.5, 0.6), found.amplitude):
        stands, falls = (
            rk.outcome(rk.Block(0.12, 3.0), make(float(x * amplitude), duration), **quick).overturned
            for x in (0.999, 1.001)
        )
        assert falls and not stands


@pytest.mark.parametrize(
    "wrong, message",
    [
        (lambda: LIKELIHOOD.log_terms({"amp": 0.3}), r"`motion` must make a motion of \['amp'\], but: .*'amplitude'"),
        (lambda: LIKELIHOOD.survival({"amplitude": 0.3}), "`motion` must make a motion of .*: missing .* 'period'"),
        (lambda: LIKELIHOOD.survival({}), "`values` must name the parameters of the motion, but is empty"),
        (
            lambda: LIKELIHOOD.log_terms({"amplitude": np.ones(2), "period": np.ones(3)}),
            "`amplitude` and `period` must have shapes that go together",
        ),
        (
            lambda: rk.inverse.estimate_motion(
                LIKELIHOOD.observations, rk.SinePulse, {"amplitud": rk.inverse.Unknown(0.1, 1.0)}
            ),
            "`motion` must make a motion of",
        ),
        (
            lambda: rk.inverse.Likelihood(LIKELIHOOD.observations, lambda x: x).survival({"x": 0.3}),
            "`motion` must make a motion of its parameters, but makes an array",
        ),
        (
            lambda: rk.inverse.unexceeded_motion(
                LIKELIHOOD.observations, lambda a, d: rk.Record(a * jnp.ones(9), d), [0.5, 0.6]
            ),
            "`motion` must make a motion whose samples do not depend on amplitude",
        ),
        (
            lambda: rk.inverse.unexceeded_motion(LIKELIHOOD.observations, lambda a, d: a, [0.5]),
            "`motion` must make a motion of amplitude and duration, but makes",
        ),
        (lambda: rk.inverse.Unknown(2.0, 1.0), "`high` must be above `low`"),
        (lambda: rk.inverse.Unknown(0.0, 1.0), "`low` must be positive"),
        (lambda: rk.inverse.Unknown(0.2, 3.0, prior=(100.0, 0.5)), "`prior` must be within five standard deviations"),
        (lambda: rk.inverse.Unknown(-1.0, 1.0, log=False, prior=(-2.0, 0.1)), "`prior` must be within five"),
        (lambda: rk.inverse.Observations([0.1], [2.0], ["topled"]), "`seen` must hold only .* Did you mean 'toppled'"),
        (lambda: rk.inverse.Observations([0.1, 0.2], [2.0], ["toppled"]), "`seen` must have a word for each of 2"),
        (lambda: rk.inverse.Observations([0.1], [2.0], ["rotation"]), "`rotation` must be given"),
        (
            lambda: rocks(["toppled"] * 12, alpha_sd=0.12),
            "`alpha_sd` must be below `alpha`, and in radians, but is 0.12",
        ),
        (lambda: rocks(["toppled"] * 12, p_sd=5.1), "`p_sd` must be below `p`, and in rad/s, but is 5.1"),
        (
            lambda: rocks(["rotation"] * 12, rotation=1.0, rotation_sd=0.01),
            "`rotation` must be below twice `alpha`, .* 1.$",
        ),
        (
            lambda: rocks(["rotation"] * 12, rotation=0.1, rotation_sd=0.8),
            "`rotation_sd` must be below `alpha`, and in",
        ),
        (lambda: rk.inverse.Likelihood(rocks(["toppled"] * 12), rk.SinePulse, 0.0), "`scatter` must be positive"),
    ],
)
def test_wrong_arguments_are_named(wrong, message):
    with pytest.raises(ValueError, match=message):
        wrong()


def test_observations_of_traced_values():
    """Check observations of traced values: shapes are known within `jax.jit`, and wrong values raise there."""
    words = ["survived", "toppled", "rotation"]
    given = {"alpha_sd": 0.01, "rotation": 0.05, "rotation_sd": 0.01}

    def restitution(alpha, known):
        return rk.inverse.Observations(alpha, [2.0, 3.0, 4.0], words, known, **given).restitution

    alpha, known = jnp.array([0.1, 0.2, 0.3]), jnp.array([0.9, np.nan, np.nan])
    compiled = jax.jit(restitution)
    np.testing.assert_allclose(compiled(alpha, known), restitution(alpha, known), rtol=1e-15)
    slopes = jax.jit(jax.jacfwd(restitution))(alpha, known)
    np.testing.assert_allclose(slopes, np.diag([0.0, *-1.5 * np.sin(2 * np.array([0.2, 0.3]))]), rtol=1e-13)
    with pytest.raises(Exception, match="Argument `alpha` must be at most 0.955"):
        compiled(alpha + 0.7, known)
    measured = lambda x: rk.inverse.Observations(alpha, 4 * alpha, words, **(given | {"rotation": x})).rotation.sum()
    assert jax.jit(jax.grad(measured))(0.05) == 1.0
