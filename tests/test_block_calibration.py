"""A block from verdicts under known motions: the truth is found again, and the likelihood is smooth."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.stats

import jaxrock as rk
from jaxrock.inverse.calibration_grid import Axis, Table, blocks_of_cells
from jaxrock.studies.suite_scenes import Scenes, scenes_of_suite, stacked
from references import chaotic

RANDOM = np.random.default_rng(1)
COUNT, ALPHA, SCATTER, P = 200, 0.2, 0.3, 3.0
PULSES = np.stack([RANDOM.uniform(0.2, 0.6, COUNT), RANDOM.uniform(0.2, 0.9, COUNT)], axis=1)  # amplitude and period
TRUE = ALPHA * np.exp(SCATTER * RANDOM.normal(size=COUNT))
UNKNOWN, SPREAD = rk.inverse.Unknown(0.05, 0.5), rk.inverse.Unknown(0.05, 0.8)
QUICK = {"model": rk.Linear(), "engine": rk.Series(order=8, tolerance=1e-10), "progress": False}
POINT = {"alpha": 0.18, "alpha_sd": 0.2}


@functools.cache
def motions():
    return [rk.SinePulse(*each) for each in PULSES]


@functools.cache
def suite():
    return rk.motions.Suite([rk.SinePulse(*PULSES.T)])


@jax.jit
@jax.vmap
def _outcomes(alpha, amplitude, period):
    block, pulse = rk.Block(alpha, P), rk.SinePulse(amplitude, period)
    result = rk.outcome(block, pulse, QUICK["model"], engine=QUICK["engine"])
    return result.overturned, result.max_rotation / alpha


def outcomes(*scenes):
    """Return whether blocks overturn, and peak rotations over slenderness: any number of scenes by one program."""
    arrays = np.broadcast_arrays(*scenes)
    count = arrays[0].size
    lists = [np.resize(x, (-(-count // 64), 64)) for x in arrays]
    found = [jax.device_get(_outcomes(*part)) for part in zip(*lists)]
    return [np.concatenate(x)[:count] for x in zip(*found)]


@functools.cache
def verdicts():
    """Draw the verdicts of blocks, each with a block of its own."""
    return outcomes(ALPHA * np.exp(SCATTER * np.random.default_rng(5).normal(size=COUNT)), *PULSES.T)


@pytest.fixture(scope="module")
def found():
    make = lambda alpha: rk.Block(alpha, P)
    fell, _ = verdicts()
    return rk.inverse.calibrate_block(make, suite(), fell, {"alpha": UNKNOWN}, {"alpha": SPREAD}, cells=512, folds=10,
                              **QUICK)  # fmt: skip


def test_the_truth_is_found_again(found):
    assert found.status == rk.inverse.CalibrationStatus.successful
    for name, truth in (("alpha", ALPHA), ("alpha_sd", SCATTER)):
        off = np.log(float(found.values[name]) / truth) / float(found.standard_errors[name])
        assert abs(off) < 2.5
        assert 0.005 < float(found.standard_errors[name]) < 0.25


@pytest.fixture(scope="module")
def slopes(found):
    return jax.jit(jax.grad(found.log_density))(POINT)


@pytest.mark.parametrize("name", ["alpha", "alpha_sd"])
def test_slopes_of_the_likelihood_by_differences(found, slopes, name):
    slope = float(slopes[name])
    step = 1e-5 * POINT[name]
    ends = [float(found.log_density({**POINT, name: POINT[name] + sign * step})) for sign in (1, -1)]
    assert slope == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-6)


@pytest.mark.parametrize("about", [0.3, 0.5, 0.7])
def test_a_probability_is_the_share_of_the_distribution_that_topples(found, about):
    """By intervals whose ends are found by halving: the grid knows them to half a cell."""
    test = int(np.abs(np.asarray(found.probability) - about).argmin())
    alphas = np.linspace(0.03, 0.8, 400)
    fell = lambda alpha: outcomes(alpha, *PULSES[test])[0]
    lost = fell(alphas)
    law = scipy.stats.lognorm(float(found.values["alpha_sd"]), scale=float(found.values["alpha"]))
    edges = np.flatnonzero(np.diff(lost.astype(int)))
    low, high = alphas[edges], alphas[edges + 1]
    for _ in range(12):
        middle = (low + high) / 2
        same = fell(middle) == lost[edges]
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    share = np.sum(np.where(lost[edges], law.cdf(low), -law.cdf(low))) + lost[-1]
    assert (float(found.probability[test]) - 0.005) / 0.99 == pytest.approx(share, abs=0.011)


def test_diagnostics(found):
    toppled, chosen = np.asarray(found.toppled), np.asarray(found.probability)
    pairs = [(a > b) + 0.5 * (a == b) for a in chosen[toppled == 1] for b in chosen[toppled == 0]]
    assert found.auc() == pytest.approx(np.mean(pairs), rel=1e-12)
    assert 0.8 < found.auc(held_out=True) <= found.auc() + 0.01
    nothing = eqx.tree_at(lambda f: f.held_out, found, np.full(COUNT, np.nan))
    assert np.isnan(nothing.auc(held_out=True)) and nothing.auc() == found.auc()
    curve = found.curve(5)
    assert curve["tests"].sum() == COUNT
    assert np.abs(curve["probability"] - curve["toppled"]).max() < 0.2
    odd = found.disagreeing(0.2)
    as_it_was = np.where(toppled == 1, chosen, 1 - chosen)
    assert set(odd) == set(np.flatnonzero(as_it_was < 0.2))
    low, high = np.asarray(found.bounds)
    assert (low <= chosen).all() and (chosen <= high).all()


def test_rotations_say_more_than_verdicts(found):
    fell, rotation = verdicts()
    noisy = rotation * np.exp(0.2 * RANDOM.normal(size=COUNT))
    seen = np.where(fell, np.nan, np.where(noisy < 0.01, 0.0, noisy))
    more = rk.inverse.calibrate_block(
        lambda alpha: rk.Block(alpha, P), suite(), fell, {"alpha": UNKNOWN}, {"alpha": SPREAD},
        cells=512, rotation=seen, rotation_sd=0.2, **QUICK,
    )  # fmt: skip
    assert more.status == rk.inverse.CalibrationStatus.successful
    for name, truth in (("alpha", ALPHA), ("alpha_sd", SCATTER)):
        assert float(more.standard_errors[name]) < float(found.standard_errors[name])
        assert abs(np.log(float(more.values[name]) / truth)) < 3 * float(more.standard_errors[name])


def test_a_parameter_that_tests_do_not_tell():
    """Pulses far too weak, and far too strong, say that the rock lies between, and no more."""
    fell = np.arange(COUNT) % 2 == 0  # as many as above: one program
    pulses = rk.motions.Suite([rk.SinePulse(np.where(fell, 6.0, 0.02), np.full(COUNT, 0.6))])
    for scatter in (SPREAD, 0.3):
        flat = rk.inverse.calibrate_block(
            lambda alpha: rk.Block(alpha, P), pulses, fell, {"alpha": UNKNOWN}, {"alpha": scatter}, cells=512, **QUICK
        )
        assert flat.status == rk.inverse.CalibrationStatus.not_told
        assert np.isinf(list(flat.standard_errors.values())).all()


def test_a_likelihood_is_not_flat_at_the_ends_of_a_range():
    """Without scatter the outermost cells are the ends: shares of cells that rise straight do so up to there."""
    axis = Axis.of("p", rk.inverse.Unknown(1.5, 6.0), None, 8)
    np.testing.assert_allclose(axis.values[[0, -1]], [1.5, 6.0], rtol=1e-15)

    def share(place):
        return axis.weights({"p": 1.5 * jnp.exp(place * axis.width)}, "p") @ np.arange(8.0)

    places = np.array([0, 0.2, 0.5, 1, 3.3, 6, 6.6, 7])
    shares, slopes = jax.jit(jax.vmap(jax.value_and_grad(share)))(places)
    np.testing.assert_allclose(shares, places, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(slopes, 1.0, rtol=1e-12)


class Firm(rk.restitution.AbstractRestitution):
    """A law whose numbers nobody declares: all blocks share them."""

    firm: jax.Array
    speed: jax.Array

    def ratio(self, corners, speed):
        return self.firm / (1 + speed / self.speed)


def test_blocks_of_cells_share_what_belongs_to_a_law_of_ones_own():
    axes = {"alpha": Axis.of("alpha", UNKNOWN, SPREAD, 8)}
    blocks = blocks_of_cells(lambda alpha: rk.Block(alpha, P, Firm(0.9, 4.0)), axes)
    assert blocks.alpha.shape == (8,) and (float(blocks.law.firm), float(blocks.law.speed)) == (0.9, 4.0)
    with pytest.raises(ValueError, match="declares its parameters .*, but `law.firm` is not declared, and differs"):
        blocks_of_cells(lambda alpha: rk.Block(alpha, P, Firm(1 - alpha, 4.0)), axes)
    unknown = blocks_of_cells(lambda alpha: rk.Block(alpha, P, Firm(0.9, jnp.nan)), axes)  # the same in all
    assert np.isnan(unknown.law.speed) and unknown.law.speed.shape == ()


class Stepped(rk.restitution.AbstractRestitution):
    """A law with a list that is declared."""

    ratios: jax.Array = rk.parameter("-", axes=1)

    def ratio(self, corners, speed):
        return jnp.interp(speed, np.arange(2.0), self.ratios)


def test_lists_of_a_law_belong_to_all_cells():
    axes = {"alpha": Axis.of("alpha", UNKNOWN, SPREAD, 8)}
    blocks = blocks_of_cells(lambda alpha: rk.Block(alpha, P, Stepped(jnp.array([0.9, 0.8]))), axes)
    np.testing.assert_array_equal(blocks.law.ratios, [0.9, 0.8])
    with pytest.raises(ValueError, match=r"shares its lists, but `law.ratios` is declared as one \(axes=1\), and diff"):
        blocks_of_cells(lambda alpha: rk.Block(alpha, P, Stepped(jnp.stack([1 - alpha, 0.8]))), axes)


def test_names_in_any_order():
    """Two parameters and a scatter: where the likelihood is largest does not hang on the order of their names."""
    unknowns = {"alpha": UNKNOWN, "p": rk.inverse.Unknown(1.5, 6.0)}
    given = {"cells": {"alpha": 64, "p": 8}} | QUICK  # as many scenes as above: one program
    fell, _ = verdicts()
    found = [
        rk.inverse.calibrate_block(
            rk.Block, suite(), fell, {name: unknowns[name] for name in order}, {"alpha": SPREAD}, **given
        )
        for order in (("alpha", "p"), ("p", "alpha"))
    ]
    for name in ("alpha", "p", "alpha_sd"):
        assert float(found[0].values[name]) == pytest.approx(float(found[1].values[name]), rel=1e-6)
    truth = found[0].log_density({"alpha": ALPHA, "alpha_sd": SCATTER, "p": P})
    assert float(found[0].log_likelihood) > float(truth) - 0.1
    assert abs(np.log(float(found[0].values["p"]) / P)) < 3 * float(found[0].standard_errors["p"]) < 1


@pytest.mark.slow
def test_two_parameters_of_a_lopsided_rock_whose_facing_is_not_known():
    make = lambda alpha, p: rk.blocks.AsymmetricBlock(alpha, 1.3 * alpha, p)
    ways = np.where(np.random.default_rng(2).random(12) < 0.5, 1, -1)
    fell = [bool(rk.outcome(make(TRUE[k], P), int(way) * motions()[k]).overturned) for k, way in enumerate(ways)]
    unknowns = {"alpha": UNKNOWN, "p": rk.inverse.Unknown(1.5, 6.0)}
    given = {"cells": {"alpha": 24, "p": 8}, "progress": False}
    for facing in (ways, 0):
        fit = rk.inverse.calibrate_block(make, motions()[:12], fell, unknowns, {"alpha": 0.3}, facing=facing, **given)
        assert set(fit.values) == {"alpha", "p"}
        assert np.isfinite(fit.probability).all()
    first, scatter = motions()[:12], {"alpha": 0.3}
    turned = rk.inverse.calibrate_block(make, [-m for m in first], fell, unknowns, scatter, facing=-ways, **given)
    known = rk.inverse.calibrate_block(make, first, fell, unknowns, scatter, facing=ways, **given)
    np.testing.assert_allclose(turned.probability, known.probability, atol=1e-6)
    step = 1e-5
    point = {"alpha": 0.21, "p": 2.7}
    slope = float(jax.grad(known.log_density)(point)["p"])
    ends = [float(known.log_density({**point, "p": 2.7 + sign * step})) for sign in (1, -1)]
    assert slope == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-6)


@pytest.mark.parametrize(
    "given, message",
    [
        ({"toppled": [1, 0]}, "`toppled` must hold 1, 0, -1 for each of 1 tests"),
        ({"toppled": [2]}, "`toppled` must hold"),
        ({"unknowns": {}}, "`unknowns` must hold"),
        ({"scatter": {}}, "`scatter` must hold one or more"),
        ({"scatter": {"p": 0.1}}, "`scatter` must hold one or more"),
        ({"scatter": {"alpha": -0.1}}, "`scatter` must be positive"),
        ({"facing": 2}, "`facing` must hold"),
        ({"rotation": [0.5]}, "`rotation` must be NaN for tests that toppled"),
        ({"rotation_sd": 0.0}, r"`rotation_sd` must be in \(0, 1\], but is 0.0"),
        ({"folds": 5}, "`folds` must be 0, or from 2 to the 1 groups"),
        ({"cells": {"q": 9}}, "`cells` must have some of the names"),
        ({"cells": {"alpha": 4}}, "`cells` must be a whole number from 8 to 4096"),
        ({"groups": [[1, 2], [3]]}, "`groups` must hold a label for each of 1 tests"),
        ({"block": lambda beta: rk.Block(beta, 2.0)}, "`block` must make a block of"),
    ],
)
def test_what_is_refused(given, message):
    good = {"block": lambda alpha: rk.Block(alpha, P), "motions": motions()[:1], "toppled": [1],
            "unknowns": {"alpha": UNKNOWN}, "scatter": {"alpha": SPREAD}, "progress": False}  # fmt: skip
    with pytest.raises(ValueError, match=message):
        rk.inverse.calibrate_block(**good | given)


@pytest.mark.parametrize(
    "block, message",
    [
        (
            lambda alpha: rk.blocks.AsymmetricBlock(alpha, 2.5 * alpha, P),
            r"fails in 2 of 16, the first of which is alpha = 0.6\d+: argument `alpha2` must be in \(0, pi/2\)",
        ),
        (lambda alpha: rk.Block(2 * alpha, P), "fails in 3 of 16, .* argument `alpha` must be at most 0.955"),
        (lambda alpha: rk.Block(alpha, P, 1.5 * alpha), r"first of which is alpha = 0.77\d*: argument `restitution`"),
        (lambda alpha: rk.Block(jnp.arcsin(1.3 * alpha), P, 0.9), "argument `alpha` must be in"),
    ],
    ids=["a second angle", "a wide block", "a restitution", "NaN"],
)  # fmt: skip
def test_the_cell_that_makes_no_block_is_named(block, message):
    """The grid goes beyond the range of the unknown."""
    unknown = rk.inverse.Unknown(0.1, 0.4)
    with pytest.raises(ValueError, match=message):
        rk.inverse.calibrate_block(
            block, motions()[:2], [1, 0], {"alpha": unknown}, {"alpha": 0.3}, cells=16, progress=False
        )


def test_open_scenes_count_by_their_share():
    """Two orientations and two cells; bounds count none and all."""
    verdict = np.array([[[1, -1], [0, -1]]], np.int8)
    share = np.array([[[1.0, 0.25], [0.0, 0.75]]])
    found = Scenes(verdict, np.zeros(verdict.shape), np.zeros(verdict.shape), share)
    one, both = (Table.of(found, np.ones(1), np.array([way]), None, 0.3, (2,)) for way in (1, 0))
    for table, toppled, lower, upper in ((one, [1, 0.25], [1, 0], [1, 1]), (both, [0.5, 0.5], [0.5, 0], [0.5, 1])):
        for found, expected in zip((table.toppled, table.lower, table.upper), (toppled, lower, upper)):
            np.testing.assert_array_equal(found[0], expected)


def test_the_share_of_a_scene_that_chaos_leaves_open():
    """One is open and one decided; with few steps neither is computed."""
    motion = rk.Record(*chaotic.record("twice"))
    blocks = rk.Block(np.array([0.24497866312686414, 0.9]), 1.8891563520285026, 0.9117647058823529)
    found = scenes_of_suite(stacked(blocks), rk.motions.Suite([motion]), np.array([1.516]), rk.Housner(), None, False)
    np.testing.assert_array_equal(found.verdict.ravel(), [-1, 0])
    assert 0.1 < found.share[0, 0, 0] < 0.9 and found.share[0, 0, 1] == 0
    few = rk.Series(max_steps=20)
    found = scenes_of_suite(stacked(blocks), rk.motions.Suite([motion]), np.array([1.516]), rk.Housner(), few, False)
    np.testing.assert_array_equal(found.verdict.ravel(), [-1, -1])
    np.testing.assert_array_equal(found.share.ravel(), [0.5, 0.5])
