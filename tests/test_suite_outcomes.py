"""Suites as recorded and at many scales: every scene against one of its own, and what is made of them."""

import logging
import xml.etree.ElementTree as ElementTree

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.stats

import jaxrock as rk
from jaxrock.blocks.random import _drawn, _drawn_sides
from jaxrock.hazard.suites import measures_by_name
from jaxrock.studies import azimuths, suite_scenes
from jaxrock.studies.suite_scenes import of_motion, stacked

RANDOM = np.random.default_rng(4)
RECORDS = [
    rk.Record(
        RANDOM.uniform(0.5, 1.5) * np.exp(-((np.linspace(-2, 2, n)) ** 2)) * np.sin(0.06 * np.arange(n) + k),
        dt,
        f"record {k}",
    )
    for k, (n, dt) in enumerate([(300, 0.01), (500, 0.01), (450, 0.02), (1000, 0.005)])
]
MOTIONS = [*RECORDS, rk.SinePulse(np.array([0.6, 1.2]), 0.7)]
SCALE = np.array([0.4, 1.0, 2.5])
QUICK = {"model": rk.Linear(), "engine": rk.Series(order=6)}  # compiles in half the time
ROCKS = rk.blocks.AsymmetricBlock(np.array([0.15, 0.25]), np.array([0.3, 0.2]), np.array([2.5, 3.5]))


@pytest.fixture(scope="module")
def found():
    """Two lopsided rocks under all motions, at three scales, both ways round."""
    return rk.hazard.suite_outcomes(ROCKS, MOTIONS, SCALE, facing="both", progress=False, **QUICK)


def test_every_scene_is_one_of_its_own(found):
    assert found.verdict.shape == (6, 3, 2, 2) and found.undecided == 0
    assert 0.1 < (found.verdict == 1).mean() < 0.9
    for m, motion in ((1, RECORDS[1]), (2, RECORDS[2]), (5, rk.SinePulse(1.2, 0.7))):
        for s, f, b in [(0, 0, 0), (1, 1, 1), (2, 0, 1)]:
            rock = rk.blocks.AsymmetricBlock(*(float(x[b]) for x in (ROCKS.alpha1, ROCKS.alpha2, ROCKS.p1)))
            alone = rk.outcome(rock, float(found.facing[f] * SCALE[s]) * motion, **QUICK)
            assert found.verdict[m, s, f, b] == int(alone.overturned)
            rotation = float(alone.max_rotation) / min(float(rock.alpha1), float(rock.alpha2))
            assert found.rotation_ratio[m, s, f, b] == pytest.approx(rotation, rel=1e-9)
            assert found.margin[m, s, f, b] == pytest.approx(float(alone.margin), rel=1e-7)


def test_up_stays_up_where_a_rock_is_turned_round():
    motion = RECORDS[1].with_vertical(rk.Record(-0.15 * np.abs(RECORDS[2].samples), RECORDS[2].dt))
    found = rk.hazard.suite_outcomes(ROCKS, [motion], SCALE, facing="both", progress=False, **QUICK)
    turned = rk.hazard.suite_outcomes(ROCKS.mirrored, [motion], SCALE, facing="both", progress=False, **QUICK)
    np.testing.assert_allclose(found.margin[:, :, 1], turned.margin[:, :, 0], rtol=1e-9)
    np.testing.assert_allclose(found.margin[:, :, 0], turned.margin[:, :, 1], rtol=1e-9)


def test_turning_round_a_symmetric_block_changes_nothing():
    found = rk.hazard.suite_outcomes(rk.Block(0.2, 2.5), RECORDS[:2], facing="both", progress=False, **QUICK)
    assert found.verdict.shape == (2, 1, 2, 1)
    np.testing.assert_array_equal(found.verdict[:, :, 0], found.verdict[:, :, 1])
    turned = [rk.Record(-m.samples, m.dt) for m in RECORDS[:2]]
    turned = rk.hazard.suite_outcomes(rk.Block(0.2, 2.5), turned, facing="both", progress=False, **QUICK)
    np.testing.assert_allclose(turned.rotation_ratio[:, 0, 0, 0], found.rotation_ratio[:, 0, 1, 0], rtol=1e-9)


class Tabulated(rk.restitution.AbstractRestitution):
    """A law of one's own, with a declared list and a number that nobody declares."""

    ratios: jax.Array = rk.parameter("-", "share", axes=1)
    factor: jax.Array | float = 1.0

    def ratio(self, corners, speed):
        return self.factor * jnp.interp(speed, jnp.arange(3.0), self.ratios)


def test_draws_share_what_belongs_to_the_law():
    law, factors = Tabulated(jnp.array([0.9, 0.8, 0.7]), 0.99), jax.device_put((np.linspace(0.9, 1.1, 5), np.ones(5)))
    rock = rk.blocks.AsymmetricBlock(0.2, 0.25, 2.0, restitution=law)
    for drawn in (_drawn(rk.Block(0.2, 2.0, law), *factors, 0.0, factors[1]), _drawn_sides(rock, *factors, 0.0)):
        drawn = stacked(drawn)
        assert jax.tree.leaves(drawn)[0].shape == (5,)
        np.testing.assert_array_equal(drawn.law.ratios, law.ratios)
        assert float(drawn.law.factor) == 0.99


def test_numbers_of_a_law_of_ones_own_go_through_suites(monkeypatch):
    """And through azimuths; scenes are traced only, which says whether they are of one block each."""
    seen = []

    def traced(motion, blocks, *rest):
        seen.append(blocks.law)
        return jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), jax.eval_shape(of_motion, motion, blocks, *rest))

    for module in (suite_scenes, azimuths):
        monkeypatch.setattr(module, "of_motion", traced)
    law, components = Tabulated(jnp.array([0.9, 0.8, 0.7]), 0.99), rk.motions.Components(RECORDS[0], RECORDS[0])
    blocks, given = rk.Block(np.array([0.2]), 2.0, law), {"scale": SCALE, "progress": False} | QUICK
    found = rk.hazard.suite_outcomes(blocks, RECORDS[:1], **given)
    assert found.verdict.shape == (1, 3, 1, 1) and "law.factor" not in found.table()
    rk.studies.azimuth_outcomes(lambda _: rk.Block(0.2, 2.0, law), components, [0.0], **given)
    for each in seen:
        np.testing.assert_array_equal(each.ratios, law.ratios)
        assert float(each.factor) == 0.99
    assert len(seen) == 2


def by_hand():
    """A block that comes back, one that does not topple, one undecided."""
    verdict = np.array([[0, 1, 0, 1], [0, 0, 0, 0], [0, -1, 1, 1]], np.int8)[:, :, None, None]
    rotation = np.where(verdict == 1, np.inf, np.where(verdict == 0, 0.5, np.nan))
    suite = rk.motions.Suite([rk.SinePulse(0.5, each) for each in (0.5, 1.0, 2.0)])
    scale = np.array([0.5, 1.0, 2.0, 4.0])
    return rk.hazard.SuiteOutcomes(
        suite, rk.Block(np.array([0.2]), np.array([2.0])), scale, (1,), verdict, rotation, rotation
    )


def test_capacities_are_never_forced_to_rise():
    found = by_hand()
    np.testing.assert_array_equal(found.capacity[:, 0, 0], [[0.5, 1.0], [4.0, np.inf], [0.5, 2.0]])
    np.testing.assert_array_equal(found.comes_back[:, 0, 0], [True, False, False])
    assert found.undecided == 1


def test_damage_states_are_bounded():
    lower, upper = by_hand().reaches([0.1, 0.6])
    np.testing.assert_array_equal(lower[0], [[1, 0], [1, 1], [1, 0], [1, 1]])
    np.testing.assert_array_equal(lower[2, 1], [0, 0])
    np.testing.assert_array_equal(upper[2, 1], [1, 1])
    assert (lower <= upper).all()


def test_long_table(found):
    table = found.table({"Arias": rk.intensity.arias})
    assert {len(column) for column in table.values()} == {found.verdict.size}
    row = np.flatnonzero((table["motion"] == "record 2") & (table["scale"] == 2.5) & (table["facing"] == -1))
    assert row.size == 2
    np.testing.assert_array_equal(table["verdict"][row], found.verdict[2, 2, 1])
    np.testing.assert_allclose(table["alpha1"][row], ROCKS.alpha1)
    np.testing.assert_allclose(table["PGA"][row], 2.5 * float(rk.intensity.peak_acceleration(RECORDS[2])))
    np.testing.assert_allclose(table["Arias"][row], 2.5**2 * rk.intensity.arias(RECORDS[2]), rtol=1e-12)
    named = found.table(["IA", "PGV", "SA(0.5)"])
    np.testing.assert_allclose(named["IA"], table["Arias"], rtol=1e-12)
    spectral = rk.intensity.spectral_acceleration(RECORDS[2], 0.5)
    np.testing.assert_allclose(named["SA(0.5)"][row], 2.5 * spectral, rtol=1e-12)
    durations = found.table({"D": rk.intensity.significant_duration})["D"]  # which does not grow with the scale
    np.testing.assert_allclose(durations[row], rk.intensity.significant_duration(RECORDS[2]), rtol=1e-9)
    frame = pytest.importorskip("pandas").DataFrame(table)
    assert frame.groupby("motion").size().eq(12).all()


def test_a_column_is_what_its_name_was_given_for():
    arias = by_hand().table(["IA"])["IA"]
    np.testing.assert_array_equal(by_hand().table({"PGA": "IA"})["PGA"], arias)
    np.testing.assert_allclose(by_hand().table({"PGA": "PGA"})["PGA"], by_hand().table()["PGA"])


@pytest.mark.parametrize("measures", [{"a": "SA"}, ["Arias"], ["IA", "IA"], {"verdict": "IA"}, {"p": "IA"}])
def test_measures_of_other_names(measures):
    with pytest.raises(ValueError, match="`measures` must"):
        by_hand().table(measures)


@pytest.mark.parametrize("measures", [[lambda m: 1.0, lambda m: 2.0], [rk.intensity.arias], {1: "IA", "1": "CAV"}])
def test_measures_without_names_of_their_own(measures):
    """The last would be taken for all of them."""
    with pytest.raises(ValueError, match="`measures` must (hold names, or functions by name|have each name once)"):
        measures_by_name(measures)


@pytest.mark.parametrize(
    "given, message",
    [
        ({"scale": [1.0, 1.0]}, "`scale` must be a number, or rise"),
        ({"scale": -1.0}, "`scale` must be positive"),
        ({"facing": "left"}, "`facing` must be one of 'one', 'both'"),
        ({"motions": []}, "at least one motion"),
    ],
)
def test_what_is_refused(given, message):
    with pytest.raises(ValueError, match=message):
        rk.hazard.suite_outcomes(**{"block": rk.Block(0.2, 2.0), "motions": [MOTIONS[0]]} | given)


# ---------------------------------------------------------------------------------------------- probit fits

N = 180
MEASURES = {"PGA": np.exp(RANDOM.normal(-1, 0.5, N)), "ratio": np.exp(RANDOM.normal(-2, 0.4, N))}
TRUTH = np.array([4.0, 2.0, 1.2])
DESIGN = np.stack([np.ones(N), *map(np.log, MEASURES.values())])
FELL = (scipy.stats.norm.cdf(TRUTH @ DESIGN) > RANDOM.random(N)).astype(float)


def test_a_probit_of_two_measures_by_another_optimiser():
    """SciPy climbs the likelihood, differences give its curvature."""

    def height(line):
        return -scipy.stats.norm.logcdf(np.where(FELL == 1, 1, -1) * (line @ DESIGN)).sum()

    best = scipy.optimize.minimize(height, TRUTH, method="BFGS", options={"gtol": 1e-9}).x
    fit = rk.hazard.fit_probit(MEASURES, FELL)
    np.testing.assert_allclose([fit.intercept, *fit.slopes], best, rtol=1e-6)
    step, curvature = 1e-4, np.zeros((3, 3))
    for i, j in np.ndindex(3, 3):
        a, b = step * np.eye(3)[i], step * np.eye(3)[j]
        both = height(best + a + b) - height(best + a - b) - height(best - a + b) + height(best - a - b)
        curvature[i, j] = both / (4 * step**2)
    np.testing.assert_allclose(fit.covariance, np.linalg.inv(curvature), rtol=1e-4, atol=1e-7)
    assert float(fit.log_likelihood) == pytest.approx(-height(best), rel=1e-10)
    inside = scipy.stats.norm.cdf(best @ [1, np.log(0.4), np.log(0.15)])
    assert float(fit(PGA=0.4, ratio=0.15)) == pytest.approx(inside, rel=1e-5)
    # Tables often come in single precision; what is computed with them does not.
    single = rk.hazard.fit_probit({name: values.astype(np.float32) for name, values in MEASURES.items()}, FELL)
    np.testing.assert_allclose(single.slopes, fit.slopes, rtol=1e-5)


FITS = {
    "of a lognormal fragility": lambda x, y, fell, labels: rk.hazard.fit_fragility(x, fell),
    "of a surface": lambda x, y, fell, labels: rk.hazard.fit_surface(x, y, fell),
    "of a surface, of clusters": lambda x, y, fell, labels: rk.hazard.fit_surface(x, y, fell, 1, labels),
} | {
    f"of a line, {errors}": lambda x, y, fell, labels, errors=errors: rk.hazard.fit_probit(
        {"x": x, "y": y}, fell, clusters=labels, errors=errors
    )
    for errors in ("information", "clusters", "jackknife")
}


@pytest.mark.parametrize("name", FITS)
def test_fits_of_many_sizes_are_one_program(name, caplog):
    """They have room for more rows and clusters, which changes nothing: beside what is traced, which has none."""

    def of_first(count):
        return *(values[:count] for values in (*MEASURES.values(), FELL)), np.arange(count) // 5

    FITS[name](*of_first(N))
    *data, labels = of_first(N - 13)
    with jax.log_compiles(), caplog.at_level(logging.WARNING, "jax"):
        found = FITS[name](*data, labels)
        again, _ = caplog.text, caplog.clear()
        expected = jax.jit(lambda *data: FITS[name](*data, labels))(*data)
    assert "Compiling jit(<lambda>)" in caplog.text
    assert "_fit)" not in again and "_clustered)" not in again
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", FITS)
def test_fits_stay_where_their_data_were_put(name):
    *_, device = jax.devices()
    data = jax.device_put((*MEASURES.values(), FELL), device)
    found = jax.tree.leaves(FITS[name](*data, np.arange(N) // 5))
    assert device != jax.devices()[0] and {*found[0].devices()} == {device}


@pytest.mark.parametrize("clusters", [None, np.arange(N) // 5])
def test_against_an_established_package(clusters):
    statsmodels = pytest.importorskip("statsmodels.api")
    fit = rk.hazard.fit_probit(MEASURES, FELL, clusters=clusters)
    kind = (
        {} if clusters is None else {"cov_type": "cluster", "cov_kwds": {"groups": clusters, "use_correction": False}}
    )
    other = statsmodels.Probit(FELL, DESIGN.T).fit(disp=0, tol=1e-14, **kind)
    np.testing.assert_allclose([fit.intercept, *fit.slopes], other.params, rtol=1e-6)
    count = N if clusters is None else clusters.max() + 1
    factor = 1.0 if clusters is None else np.sqrt(count / (count - 1))
    np.testing.assert_allclose(fit.standard_errors, factor * other.bse, rtol=1e-4)


def test_errors_for_few_motions():
    """Check errors of 15 motions with 12 scenes each: jackknife intervals cover the true slope more often."""
    inside = {"information": 0, "clusters": 0, "jackknife": 0}
    labels, repetitions = np.repeat(np.arange(15), N // 15), 40
    for seed in range(repetitions):
        random = np.random.default_rng(seed)
        level = np.exp(random.normal(0, 0.5, labels.size))
        capacity = random.normal(0, 0.6, 15)[labels] + random.normal(0, 0.3, labels.size)
        fell = np.log(level) > capacity
        for kind in inside:
            fit = rk.hazard.fit_probit({"PGA": level}, fell, clusters=labels, errors=kind)
            assert fit.status == rk.hazard.FitStatus.successful
            # P = Phi(ln level/sqrt(0.6^2 + 0.3^2)): the intercept is 0.
            inside[kind] += abs(float(fit.intercept)) < 1.96 * float(fit.standard_errors[0])
    shares = {kind: count / repetitions for kind, count in inside.items()}
    assert shares["information"] < 0.75 < 0.85 < shares["clusters"] <= shares["jackknife"], shares


def test_a_jackknife_of_what_parts_without_one_row():
    """Without the third of them no line is the best: errors are not known, the fit is."""
    levels, fell = np.resize([0.1, 0.2, 0.3, 0.4, 0.5, 0.6], N), np.resize([0, 0, 1, 0, 1, 1], N)
    labels = np.where(np.arange(N) % 6 == 2, 2, np.arange(N) % 15 + (np.arange(N) % 15 == 2))  # 15, as above
    fit = rk.hazard.fit_probit({"PGA": levels}, fell, clusters=labels, errors="jackknife")
    assert fit.status == rk.hazard.FitStatus.successful and np.isnan(fit.standard_errors).all()
    other = rk.hazard.fit_probit({"PGA": levels}, fell, clusters=labels, errors="clusters")
    for name in ("intercept", "slopes", "log_likelihood", "p_values"):
        np.testing.assert_allclose(getattr(fit, name), getattr(other, name), rtol=1e-9)


def test_a_single_measure_is_the_lognormal_fit():
    levels, trials = np.geomspace(0.1, 0.8, 12), 20.0
    fell = np.array([1, 1, 2, 4, 7, 8, 11, 12, 15, 17, 18, 19])
    other = rk.hazard.fit_fragility(levels, fell, trials)
    # All of them many times over have the same maximum, and `N` rows are those of the program above.
    one = rk.hazard.fit_probit({"PGA": np.tile(levels, N // 12)}, np.tile(fell, N // 12), trials)
    assert float(one.fragility.median) == pytest.approx(float(other.fragility.median), rel=1e-9)
    assert float(one.fragility.dispersion) == pytest.approx(float(other.fragility.dispersion), rel=1e-9)


MANY = N // 4  # the program of the fits above


@pytest.mark.parametrize(
    "measures, fell, status",
    [
        ({"PGA": MANY * [0.1, 0.2, 0.3, 0.4]}, MANY * [0, 0, 1, 1], rk.hazard.FitStatus.separable),
        ({"PGA": MANY * [0.1, 0.2, 0.3, 0.4]}, MANY * [1, 1, 1, 1], rk.hazard.FitStatus.separable),
        ({"PGA": MANY * [0.2, 0.2, 0.2, 0.2]}, MANY * [0, 1, 0, 1], rk.hazard.FitStatus.not_converged),
        ({"PGA": MANY * [0.1, 0.2, 0.2, 0.4]}, MANY * [0, 0, 1, 1], rk.hazard.FitStatus.separable),
        ({"PGA": MANY * [0.1, 0.2, 0.2, 0.4]}, MANY * [0.0, 0.0, 0.4, 1.0], rk.hazard.FitStatus.separable),
        (
            {"PGA": MANY * [0.1, 0.2, 0.2, 0.4], "ratio": MANY * [0.4, 0.2, 0.2, 0.2]},
            MANY * [0, 0, 1, 1],
            rk.hazard.FitStatus.separable,
        ),
        (
            {"PGA": MANY * [0.1, 0.2, 0.2, 0.4], "ratio": MANY * [0.1, 0.2, 0.2, 0.4]},
            [*MANY * [0, 0, 1, 1]][:-1] + [0],
            rk.hazard.FitStatus.not_converged,
        ),
    ],
    ids=["parted", "all alike", "constant", "one level of both", "with counts", "a plane", "the same twice"],
)
def test_fits_that_fail_say_so(measures, fell, status):
    """Check fits that fail, also of outcomes parted but for some on the border: their likelihood has no maximum."""
    fit = rk.hazard.fit_probit(measures, fell)
    assert fit.status == status
    assert np.isnan(fit.slopes).all() and np.isnan(fit.covariance).all()


def test_trials_of_another_number():
    with pytest.raises(ValueError, match=r"`trials` must have shape \(3,\) or \(\), but has shape \(2,\)"):
        rk.hazard.fit_probit({"PGA": [0.1, 0.2, 0.3]}, [0, 1, 1], [1, 2])


# ----------------------------------------------------------------------------------------------------- NRML


def test_nrml(tmp_path):
    path, space = tmp_path / "f.xml", {"n": "http://openquake.org/xmlns/nrml/0.5"}
    rk.hazard.write_nrml(
        {"uplift": rk.hazard.LogNormalFragility(0.2, 0.1), "topples": rk.hazard.LogNormalFragility(0.4, 0.3)}, path
    )
    root = ElementTree.parse(path).getroot()
    assert root.find(".//n:limitStates", space).text == "uplift topples"
    last = root.findall(".//n:params", space)[1].attrib
    law = scipy.stats.lognorm(0.3, scale=0.4)
    assert float(last["mean"]) == pytest.approx(law.mean(), rel=1e-9)
    assert float(last["stddev"]) == pytest.approx(law.std(), rel=1e-9)
    rk.hazard.write_nrml({"topples": rk.hazard.TabulatedFragility([0.1, 0.2, 0.4], [0.0, 0.7, 0.6])}, path, "PGV")
    root = ElementTree.parse(path).getroot()
    assert root.find(".//n:imls", space).text == "10 20 40"  # m/s here, cm/s there
    assert root.find(".//n:poes", space).text == "0 0.7 0.6"
    for measure, levels in {"PGD": "10 20 40", "CAV": "0.1 0.2 0.4", "IA": "0.1 0.2 0.4"}.items():
        ours = np.array([0.1, 0.2, 0.4]) * (9.81 if measure == "CAV" else 1)  # m/s, which are g s there
        rk.hazard.write_nrml({"topples": rk.hazard.TabulatedFragility(ours, [0.0, 0.7, 0.6])}, path, measure)
        assert ElementTree.parse(path).getroot().find(".//n:imls", space).text == levels
    with pytest.raises(ValueError, match="`measure` must be one that OpenQuake knows, as SA, but is 'SV"):
        rk.hazard.write_nrml({"topples": rk.hazard.LogNormalFragility(0.2, 0.1)}, path, "SV(0.5)")
    with pytest.raises(ValueError, match="`fragilities` must hold fragilities by name"):
        rk.hazard.write_nrml({}, path)
