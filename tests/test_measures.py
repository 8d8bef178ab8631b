"""Fragilities by any measure of intensity, which measures say something, and which explain most."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import jaxrock as rk

QUICK = {"model": rk.Linear(), "engine": rk.Series(order=6), "progress": False}  # compiles in half the time
DURATION = np.array([0.1, 0.3, 0.5, 0.8, 1.3])
PULSES = [rk.RectangularPulse(np.ones(5), DURATION)]
BLOCK = rk.Block(0.2, 2.0, 0.9)
G = 9.81


def wall():
    """Amplitudes that topple."""
    return 0.2 / np.asarray(rk.closed_form.single_lobe.safety_wall(2.0 * DURATION, -np.inf))


def mean_of_two(motion):
    return float(np.sqrt(rk.intensity.spectral_acceleration(motion, [0.3, 0.6]).prod()))


@pytest.mark.parametrize(
    "measure, of_unit, power",
    [
        ("PGA", lambda t: 1.0, 1),
        ("PGV", lambda t: G * t, 1),
        ("CAV", lambda t: G * t, 1),
        ("IA", lambda t: np.pi / 2 * G * t, 2),
        (rk.intensity.arias, lambda t: np.pi / 2 * G * t, 2),
        ("SA(0.6)", lambda t: rk.intensity.spectral_acceleration(rk.RectangularPulse(1.0, t), 0.6), 1),
        (mean_of_two, lambda t: mean_of_two(rk.RectangularPulse(1.0, t)), 1),
    ],
    ids=lambda x: getattr(x, "__name__", str(x)),
)
def test_stripes_by_every_measure(measure, of_unit, power):
    """Slender blocks topple above the safety wall in closed form, whatever the levels are called."""
    unit = np.array([float(of_unit(t)) for t in DURATION])
    walls = unit * wall() ** power
    levels = np.geomspace(0.5 * walls.min(), 2 * walls.max(), 12)
    found = rk.hazard.simulated_fragility(BLOCK, PULSES, levels, measure=measure, **QUICK)
    np.testing.assert_array_equal(found.verdict[:, :, 0] == 1, levels > walls[:, None])
    assert found.power == power and found.undecided == 0
    table = found.table()
    np.testing.assert_allclose(table["peak_acceleration"], ((levels / unit[:, None]) ** (1 / power)).ravel(), rtol=1e-6)


@pytest.mark.parametrize("name, unit", [("IA", "m/s"), ("SA(0.5)", "g"), ("PGD", "m"), ("mine", "")])
def test_units(name, unit):
    found = rk.hazard.SimulatedFragility(
        jnp.array([0.1, 0.2]), np.zeros((1, 2, 1), np.int8), jnp.ones(1), jnp.ones(1), ("a",), name
    )
    assert found.unit == unit


@pytest.mark.parametrize(
    "measure, message",
    [
        ("SA", "`measure` must be one of 'PGA', 'PGV', 'PGD', 'IA', 'CAV', 'SA.period.', 'SV.period.', or a function"),
        ("SA(0)", "`period` must be from 0.001"),
        (lambda motion: 1 + rk.intensity.arias(motion), "`measure` must grow as a power of a motion's scale"),
        (lambda motion: 3.0, "`measure` must grow as a power of a motion's scale, but is 3, 3 and 3 of a motion"),
        (rk.intensity.significant_duration, "`measure` must grow as a power of a motion's scale"),
        (lambda motion: "x", "`measure` must give one number of a motion"),
        (lambda motion: 0.0, "`measure` must be positive for all motions, but is 0 for"),
    ],
)
def test_measures_that_are_refused(measure, message):
    with pytest.raises(ValueError, match=message):
        rk.hazard.simulated_fragility(BLOCK, PULSES, [0.1, 0.2], measure=measure, **QUICK)


def test_a_curve_of_another_measure_is_refused(tmp_path):
    """As far as both are known: labels of one's own are not compared. Nor is a table for OpenQuake written of it."""
    table = [0.1, 0.2, 0.4], [0.0, 0.5, 1.0]
    by_velocity = rk.hazard.TabulatedFragility(*table, "PGV")
    curves = [rk.hazard.HazardCurve([0.05, 0.5], [1e-2, 1e-4], name) for name in ("PGV", "", "peak velocity")]
    rates = [float(rk.hazard.toppling_rate(by_velocity, curve)) for curve in curves]
    assert rates[0] > 0 and len(set(rates)) == 1
    said = "Argument `curve` must be of the fragility's measure, PGV, but is PGA."
    curve = rk.hazard.HazardCurve([0.05, 0.5], [1e-2, 1e-4], "PGA")
    of_any = rk.hazard.TabulatedFragility(*table)
    for call in (
        lambda: rk.hazard.toppling_rate(by_velocity, curve),
        lambda: rk.hazard.survival_probability([of_any, by_velocity], [1e3, 1e3], curve),
        lambda: rk.hazard.allowed_scale([by_velocity], [1e3], curve),
    ):
        with pytest.raises(ValueError, match=said):
            call()
    with pytest.raises(ValueError, match="Argument `measure` must be of the fragility's measure, PGV, but is PGA."):
        rk.hazard.write_nrml({"topples": by_velocity}, tmp_path / "fragility.xml")
    spectral = rk.hazard.LogNormalFragility(0.3, 0.4, "SA(0.5)")
    longer, same = (rk.hazard.HazardCurve([0.05, 0.5], [1e-2, 1e-4], name) for name in ("SA(0.6)", "SA(0.50)"))
    assert float(rk.hazard.toppling_rate(spectral, same)) > 0
    with pytest.raises(ValueError, match="fragility's measure, SA.0.5., but is SA.0.6."):
        rk.hazard.toppling_rate(spectral, longer)


def test_fragilities_know_their_measure():
    found = rk.hazard.simulated_fragility(BLOCK, PULSES, [0.3, 0.6, 1.2], measure="PGV", **QUICK)
    assert found.tabulated().measure == found.fit().fragility.measure == "PGV"


# --------------------------------------------------------------------------------------- what explains most

RANDOM = np.random.default_rng(11)
COUNT = 120
MOTIONS = [rk.SinePulse(RANDOM.uniform(0.2, 1.0, COUNT), RANDOM.uniform(0.3, 1.5, COUNT))]


def outcomes(cause):
    """Verdicts that a function of a motion's (PGA, PGV) alone decides, with scatter."""
    suite = rk.motions.Suite(MOTIONS)
    strength = np.log(cause(np.asarray(suite.peak_acceleration), np.asarray(suite.peak_velocity)))
    scatter = np.random.default_rng(12).normal(size=COUNT)  # the same, whatever tests ran before
    fell = strength + 0.2 * scatter > np.median(strength)
    verdict = fell.astype(np.int8)[:, None, None, None]
    blank = np.zeros(verdict.shape)
    return rk.hazard.SuiteOutcomes(
        suite, rk.Block(np.array([0.2]), np.array([2.0])), np.ones(1), (1,), verdict, blank, blank
    )


@pytest.mark.parametrize("cause, best", [(lambda a, v: v, "PGV"), (lambda a, v: a, "PGA")])
def test_the_measure_that_decides_comes_first(cause, best):
    found = outcomes(cause)
    table = rk.hazard.compare_measures(found, ["PGA", "PGV"])
    assert table["measure"][0] == best and (np.diff(table["auc"]) < 0).all()
    assert table["dispersion"][0] == pytest.approx(0.2, rel=0.4)
    columns = found.table()
    fit = rk.hazard.fit_probit({best: columns[best]}, columns["verdict"], clusters=columns["motion"])
    assert table["slope"][0] == float(fit.slopes[0]) and table["status"][0] == "successful"
    fell = columns["verdict"] == 1
    pairs = columns[best][fell][:, None] > columns[best][~fell]
    assert table["auc"][0] == pytest.approx(pairs.mean(), rel=1e-12)


def chance(motion):
    """A measure that has nothing to do with the motion's strength."""
    return 1.5 + np.sin(1e6 * float(motion.period if hasattr(motion, "period") else motion.motion.period))


def test_a_useless_measure_is_flagged():
    found = outcomes(lambda a, v: v)
    table = rk.hazard.compare_measures(found, {"PGV": rk.intensity.peak_velocity, "chance": chance})
    assert dict(zip(table["measure"], table["useless"])) == {"PGV": False, "chance": True}


def test_bounds_and_too_few_records():
    found = outcomes(lambda a, v: v)
    found.verdict[:30] = -1
    lower, upper = (rk.hazard.compare_measures(found, ["PGV"], bound=each)["median"][0] for each in ("lower", "upper"))
    assert lower > upper
    between = rk.hazard.compare_measures(found, ["PGV"], bound="share")
    assert upper < between["median"][0] < lower
    # The probability over pairs, of which an open scene is on both sides.
    values, fell = found.table()["PGV"], np.where(found.verdict == -1, 0.5, found.verdict == 1).ravel()
    pairs = fell[:, None] * (1 - fell)
    larger = (values[:, None] > values) + (values[:, None] == values) / 2
    assert between["auc"][0] == pytest.approx(np.sum(pairs * larger) / pairs.sum(), rel=1e-12)
    one = rk.motions.Suite([rk.SinePulse(0.5, 1.0)])
    blank, scale = np.zeros((1, 2, 1, 1)), np.array([1.0, 2.0])
    alone = rk.hazard.SuiteOutcomes(one, found.blocks, scale, (1,), blank.astype(np.int8), blank, blank)
    with pytest.raises(ValueError, match="must name at least two clusters"):
        rk.hazard.compare_measures(alone, ["PGA"])
    with pytest.raises(ValueError, match="`measures` must hold a measure"):
        rk.hazard.compare_measures(found, [])


@pytest.mark.parametrize("kind", ["one", "two"])
def test_p_values_by_an_established_package(kind):
    """Rao's score test of statsmodels."""
    statsmodels = pytest.importorskip("statsmodels.api")
    measures = {"a": np.exp(RANDOM.normal(size=200)), "b": np.exp(RANDOM.normal(size=200))}
    measures = measures if kind == "two" else {"a": measures["a"]}
    fell = np.log(measures["a"]) + 2 * RANDOM.normal(size=200) > 0
    fit = rk.hazard.fit_probit(measures, fell)
    design = np.stack([np.ones(200), *map(np.log, measures.values())], axis=1)
    family = statsmodels.families.Binomial(statsmodels.families.links.Probit())
    for column, found in enumerate(fit.p_values, 1):
        without = statsmodels.GLM(fell.astype(float), np.delete(design, column, 1), family=family).fit(tol=1e-14)
        expected = without.score_test(design[:, column : column + 1])[1]
        np.testing.assert_allclose(found, np.ravel(expected)[0], rtol=1e-4, atol=1e-12)
    assert "a" not in fit.useless


@pytest.mark.parametrize("each", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_the_flag_errs_as_often_as_it_says(each):
    """One in twenty of measures that say nothing does not get it, where outcomes go together in threes, too."""
    clusters, told = np.arange(COUNT) // each, 0
    level = np.exp(RANDOM.normal(size=COUNT))[clusters]
    for _ in range(200):
        draws = RANDOM.random(COUNT)[clusters]
        told += float(rk.hazard.fit_probit({"x": level}, draws < 0.5, clusters=clusters).p_values[0]) <= 0.05
    assert 2 <= told <= 20


def test_many_lists_of_measures_are_fitted_at_once():
    """Where nobody can ask what became of a fit."""
    levels, fell = np.random.default_rng(5).uniform(0.1, 1.0, (3, 200)), np.arange(200) % 3 == 0
    found = jax.vmap(lambda level: rk.hazard.fit_probit({"x": level}, fell).intercept)(levels)
    alone = [rk.hazard.fit_probit({"x": level}, fell).intercept for level in levels]
    np.testing.assert_allclose(found, alone, rtol=1e-9)


def test_what_parts_outcomes_well_is_not_flagged():
    """A test of the slope in its own standard errors would take the best of all measures for useless."""
    level, order = np.geomspace(0.1, 1.0, COUNT), np.arange(COUNT)

    def fit(fell):
        return rk.hazard.fit_probit({"x": level}, fell, clusters=order)

    for fell, status in ((order > 60, "separable"), ((order > 60) ^ (order == 30), "successful")):
        found = fit(fell)
        assert found.status == getattr(rk.hazard.FitStatus, status)
        assert float(found.p_values[0]) < 1e-6 and found.useless == ()
    assert fit((order < 60) ^ (order == 90)).useless == ("x",)


RISING = np.geomspace(0.1, 1.0, COUNT)


@pytest.mark.parametrize(
    "level, fell, clusters, p_value",
    [
        (RISING, np.arange(COUNT) < 60, np.arange(COUNT), 0),  # parted, the wrong way
        (RISING, np.ones(COUNT), np.arange(COUNT), 1),
        (np.full(COUNT, 0.3), np.arange(COUNT) < 60, np.arange(COUNT), 1),
        (np.tile([0.5, 0.65], 60), np.arange(COUNT) < 60, np.arange(COUNT) // 2, 1),  # each did the same at both
    ],
    ids=["falls", "all alike", "constant", "clusters cancel"],
)
def test_what_says_nothing_is_flagged_where_there_is_no_slope(level, fell, clusters, p_value):
    fit = rk.hazard.fit_probit({"x": level}, fell, clusters=clusters)
    assert fit.useless == ("x",)
    assert float(fit.p_values[0]) == pytest.approx(p_value, abs=1e-6)


def test_what_others_part_already_needs_no_more_measures():
    rows = 1.0 + np.arange(200)
    fit = rk.hazard.fit_probit({"x": rows, "more": 1 + rows % 3}, rows > 60)
    assert fit.useless == ("more",) and float(fit.p_values[1]) == 1


@pytest.mark.slow
def test_the_flag_of_a_lognormal_fit():
    """That of a probit fit, of clusters: what one motion does at all levels goes together."""
    levels = np.geomspace(0.1, 2.0, 8)
    fell = RANDOM.binomial(10, scipy.stats.norm.cdf(np.log(levels / 0.5) / 3.0), (5, 8))
    verdict = (np.arange(10) < fell[:, :, None]).astype(np.int8)
    ones, labels = jnp.ones(5), np.repeat(np.arange(5), 8)
    found = rk.hazard.SimulatedFragility(jnp.asarray(levels), verdict, ones, ones, tuple("abcde"), "PGA").fit()
    other = rk.hazard.fit_probit({"x": np.tile(levels, 5)}, fell.ravel(), 10.0, clusters=labels)
    assert float(found.p_value) == pytest.approx(float(other.p_values[0]), rel=1e-9)
