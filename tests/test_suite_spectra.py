"""Spectra of suites: one motion after the other; percentiles, where blocks overturn and where scenes are open."""

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

import jaxrock as rk

QUICK = {"model": rk.Linear(), "engine": rk.Series(order=8), "progress": False}  # compiles in half the time
ALPHA, PERIODS = 0.2, np.array([1.0, 2.0, 3.5, 5.0, 8.0])
RNG = np.random.default_rng(0)
STEPS = np.arange(900)
RECORDS = {
    "long": rk.Record(0.7 * np.sin(0.1 * STEPS) * np.exp(-0.004 * STEPS), 0.01),
    "short": rk.Record(0.5 * np.sin(0.2 * STEPS[:300]), 0.02),
    "weak": rk.Record(0.3 * np.sin(0.12 * STEPS[:500]), 0.01),
    "still": rk.Record(0.1 * np.sin(0.12 * STEPS[:500]), 0.01),
}
RESULTS = ("rotation_ratio", "velocity_ratio", "impact_count", "overturned", "margin")


def suite_of(motions=RECORDS):
    return rk.motions.Suite(list(motions.values()), list(motions))


@pytest.fixture(scope="module")
def found():
    return rk.rocking_spectrum(ALPHA, suite_of(), PERIODS, **QUICK)


def made(rotation_ratio, status=rk.Status.successful, velocity_ratio=None):
    """Return the spectrum of a suite with these ratios (motions, n)."""
    ratio = jnp.asarray(rotation_ratio, float)
    velocity = ratio if velocity_ratio is None else jnp.asarray(velocity_ratio, float)
    count, sizes = ratio.shape
    return rk.studies.Spectrum(
        jnp.arange(1.0, sizes + 1), ratio, velocity, jnp.zeros(ratio.shape, int), jnp.isinf(ratio), ratio, status,
        motions=tuple(f"record {k}" for k in range(count)),
    )  # fmt: skip


def statuses(kinds):
    """Return an array of statuses of the shape of their names."""
    numbers = np.array([[int(getattr(rk.Status, kind)._value) for kind in row] for row in kinds])
    return eqx.tree_at(lambda x: x._value, rk.Status.successful, jnp.asarray(numbers, jnp.int32))


MIXED = {
    "record": RECORDS["long"],
    "record times a factor": 1.5 * RECORDS["weak"],
    "pulse": rk.SinePulse(0.5, 1.0),
    "with a vertical motion": RECORDS["short"].with_vertical(0.3 * RECORDS["short"]),
}


@pytest.mark.parametrize("motions", [RECORDS, MIXED], ids=["records", "mixed"])
def test_a_row_is_the_spectrum_of_its_motion(motions):
    many = rk.rocking_spectrum(ALPHA, suite_of(motions), PERIODS, **QUICK)
    assert many.motions == tuple(motions) and many.rotation_ratio.shape == (len(motions), PERIODS.size)
    for row, motion in enumerate(motions.values()):
        one = rk.rocking_spectrum(ALPHA, motion, PERIODS, **QUICK)
        assert one.motions is None and not many.is_open[row].any()
        for name in RESULTS:
            np.testing.assert_allclose(getattr(many, name)[row], getattr(one, name), rtol=1e-11, atol=1e-13)


def test_a_suite_of_one_is_the_single_motion():
    one, single = (
        rk.rocking_spectrum(ALPHA, x, PERIODS, **QUICK) for x in (suite_of({"a": RECORDS["weak"]}), RECORDS["weak"])
    )
    for name in RESULTS:
        assert getattr(one, name).shape == (1, PERIODS.size)
        np.testing.assert_allclose(getattr(one, name)[0], getattr(single, name), rtol=1e-11, atol=1e-13)
    for bounds in (one.percentiles([0, 16, 50, 100]), one.percentiles(50, "rotation_ratio")):
        for bound in bounds:
            np.testing.assert_array_equal(bound, np.broadcast_to(one.rotation_ratio, bound.shape))


def test_the_order_of_records_plays_no_part(found):
    names = ["still", "short", "long", "weak"]
    other = rk.rocking_spectrum(ALPHA, suite_of({name: RECORDS[name] for name in names}), PERIODS, **QUICK)
    rows = [other.motions.index(name) for name in found.motions]
    for name in RESULTS:
        np.testing.assert_array_equal(getattr(other, name)[np.array(rows)], getattr(found, name))
    np.testing.assert_array_equal(other.percentiles(), found.percentiles())


def test_physics_of_a_suite(found):
    """Turned round, or k times as slow over k times the periods, it does the same; below the threshold blocks rest."""
    turned = rk.rocking_spectrum(ALPHA, suite_of({k: -1.0 * x for k, x in RECORDS.items()}), PERIODS, **QUICK)
    slow = {k: rk.Record(x.samples, 3.0 * x.dt) for k, x in RECORDS.items()}
    slow = rk.rocking_spectrum(ALPHA, suite_of(slow), 3.0 * PERIODS, **QUICK)
    for other in (turned, slow):
        for name in ("rotation_ratio", "velocity_ratio", "margin"):
            np.testing.assert_allclose(getattr(other, name), getattr(found, name), rtol=1e-9, atol=1e-12)
    assert (np.asarray(found.rotation_ratio)[3] == 0).all() and found.overturned.any() and not found.overturned.all()


@pytest.mark.parametrize("motions", [1, 2, 3, 7, 22, 100])
def test_percentiles_of_finite_peaks_are_those_of_numpy(motions):
    values, others = RNG.gamma(2.0, size=(2, motions, 9))
    spectrum = made(values, velocity_ratio=others)
    wanted = [0.0, 2.5, 16, 50, 84, 97.5, 99.99, 100]
    for result, each in (("rotation_ratio", values), ("velocity_ratio", others)):
        lower, upper = spectrum.percentiles(wanted, result)
        np.testing.assert_allclose(lower, np.percentile(each, wanted, axis=0), rtol=1e-13)
        np.testing.assert_array_equal(lower, upper)


INF = np.inf
INFINITE = {  # peaks of the motions, percentile, and what it is
    "the middle one overturns": ([1, 2, INF, INF, INF], 50, INF),
    "on a finite one": ([1, 2, INF, INF, INF], 25, 2),
    "just above it": ([1, 2, INF, INF, INF], 25.001, INF),
    "between two finite ones": ([1, 2, INF, INF, INF], 12.5, 1.5),
    "between two that overturn": ([1, INF, INF], 75, INF),
    "none stands": ([INF, INF], 16, INF),
    "the last of all stand": ([1, 2, 3], 100, 3),
    "half of an even number": ([1, 2, INF, INF], 50, INF),
    "rounding of the place": ([1.0] * 162 + [INF] * 89, 64.4, 1.0),
}


@pytest.mark.parametrize("values, percentile, expected", INFINITE.values(), ids=INFINITE)
def test_percentiles_where_blocks_overturn(values, percentile, expected):
    spectrum = made(RNG.permutation(np.asarray(values, float))[:, None])
    for bound in spectrum.percentiles(percentile):
        assert bound.shape == (1, 1) and float(bound[0, 0]) == pytest.approx(expected)


def test_open_scenes_bound_percentiles():
    """Whatever they do, percentiles lie within the bounds; with 0 and infinity they are the bounds."""
    values = np.where(RNG.random((9, 40)) < 0.2, INF, RNG.gamma(2.0, size=(9, 40)))
    kinds = RNG.choice(["successful", "chaotic", "undecided", "step_budget_exhausted"], (9, 40), p=[0.6, 0.2, 0.1, 0.1])
    is_open = (kinds == "undecided") | (kinds == "step_budget_exhausted")
    spectrum, wanted = made(np.where(is_open, np.nan, values), statuses(kinds)), [0, 16, 50, 84, 100]
    np.testing.assert_array_equal(spectrum.is_open, is_open)
    lower, upper = spectrum.percentiles(wanted)
    assert not np.isnan(lower).any() and not np.isnan(upper).any() and (np.asarray(lower) < upper).any()
    for fill in (0.0, INF, *RNG.gamma(2.0, size=20)):
        possible, _ = made(np.where(is_open, fill, values)).percentiles(wanted)
        assert (lower <= possible).all() and (possible <= upper).all()
        if fill in (0.0, INF):
            np.testing.assert_array_equal(possible, lower if fill == 0 else upper)
    whole = ~is_open.any(axis=0)
    np.testing.assert_array_equal(np.asarray(lower)[:, whole], np.asarray(upper)[:, whole])


BAD = {
    "NaN": (lambda x: x.percentiles([16, np.nan]), r"`percentile` must be in \[0, 100\], but is nan"),
    "below 0": (lambda x: x.percentiles(-1e-9), r"`percentile` must be in \[0, 100\], but is -1e-09"),
    "above 100": (lambda x: x.percentiles([50, 101]), r"`percentile` must be in \[0, 100\], but is 101"),
    "none": (lambda x: x.percentiles([]), "`percentile` must be a number or a list"),
    "a table": (lambda x: x.percentiles([[16], [84]]), "`percentile` must be a number or a list"),
    "of what is no ratio": (lambda x: x.percentiles(50, "margin"), "`result` must be one of 'rotation_ratio', 'vel"),
    "of one motion": (
        lambda x: rk.rocking_spectrum(ALPHA, RECORDS["weak"], PERIODS, **QUICK).percentiles(50),
        "this is no spectrum of a suite",
    ),
    "an empty suite": (lambda x: rk.motions.Suite([]), "`motions` must hold at least one motion"),
    "a list": (lambda x: rk.rocking_spectrum(ALPHA, list(RECORDS.values()), PERIODS), "must be a motion or a Suite"),
    "a figure by duration": (lambda x: rk.plot.spectrum(x, by_duration=True), "`by_duration` must be False"),
}  # fmt: skip


@pytest.mark.parametrize("call, message", BAD.values(), ids=BAD)
def test_bad_input(found, call, message):
    with pytest.raises(ValueError, match=message):
        call(found)


def test_a_motion_that_is_there_twice_is_told():
    twice = suite_of({"a": RECORDS["weak"], "b": RECORDS["weak"]})
    with pytest.warns(UserWarning, match="Motions 'a' and 'b' are the same: what they do counts twice"):
        rk.rocking_spectrum(ALPHA, twice, PERIODS, **QUICK)


def test_tables_have_an_axis_of_motions(found):
    pytest.importorskip("xarray")
    pytest.importorskip("pandas")
    data, frame = found.to_xarray(), found.to_pandas()
    assert data["margin"].dims == ("motion", "abscissa") and data["motion"].values.tolist() == list(RECORDS)
    assert frame.index.names == ["motion", "abscissa"] and len(frame) == len(RECORDS) * PERIODS.size
    assert frame.loc[("weak", 2.0), "rotation_ratio"] == found.rotation_ratio[2, 1]


def test_progress_counts_records(capsys):
    rk.rocking_spectrum(ALPHA, suite_of(), PERIODS, **QUICK | {"progress": True})
    told = capsys.readouterr().err
    assert "records" in told and f"{len(RECORDS)}/{len(RECORDS)}" in told


def test_suites_go_through_transformations():
    """Under jit, with motions that depend on what is traced; slopes of a percentile are differences."""

    def median(scale):
        suite = rk.motions.Suite([scale * RECORDS["weak"], scale * RECORDS["short"]])
        lower, _ = rk.rocking_spectrum(ALPHA, suite, PERIODS[3:], **QUICK).percentiles([50])
        return lower[0]

    value, slope = jax.jit(jax.value_and_grad(lambda scale: median(scale).sum()))(0.9)
    step = 1e-6
    above, below = (float(median(0.9 + x).sum()) for x in (step, -step))
    assert float(value) == pytest.approx(float(median(0.9).sum()), rel=1e-11)
    assert float(slope) == pytest.approx((above - below) / (2 * step), rel=1e-5)
    many = jax.vmap(median)(np.array([0.8, 0.9]))
    np.testing.assert_allclose(many[1], median(0.9), rtol=1e-11)


def test_old_names_warn():
    one = rk.rocking_spectrum(ALPHA, RECORDS["weak"], PERIODS, **QUICK)
    surface = rk.overturning_map([2.0, 4.0], [1.5, 9.0], restitution=0.9, **QUICK)
    outcomes = rk.hazard.suite_outcomes(rk.Block(ALPHA, 2.0, 0.9), [RECORDS["weak"]], **QUICK)
    for result, old, new in (
        (one, "max_rotation", "rotation_ratio"), (one, "max_velocity", "velocity_ratio"),
        (surface, "max_rotation", "rotation_ratio"), (outcomes, "rotation", "rotation_ratio"),
    ):  # fmt: skip
        with pytest.warns(DeprecationWarning, match=f"{type(result).__name__}.{old}` is now `{new}`") as told:
            np.testing.assert_array_equal(getattr(result, old), getattr(result, new))
        assert told[0].filename == __file__
    np.testing.assert_array_equal(surface.overturned, np.asarray(surface.state) > 0)
    assert surface.overturned.dtype == bool and surface.overturned.any() and not surface.overturned.all()


def test_surfaces_over_size_and_scale_of_a_suite():
    """By a sweep: an axis of motions, one of sizes and one of scales; the same as single outcomes."""
    period, scale = np.array([2.0, 5.0]), np.array([0.8, 1.2, 3.0])

    def at(motion, period, scale):
        return rk.outcome(rk.Block(ALPHA, 2 * np.pi / period), scale * motion, QUICK["model"], engine=QUICK["engine"])

    grid = rk.sweep(at, motion=suite_of(), period=period, scale=scale, progress=False)
    assert grid.shape == (4, 2, 3) and grid.axes["motion"].tolist() == list(RECORDS)
    for place in np.ndindex(grid.shape):
        one = at(list(RECORDS.values())[place[0]], period[place[1]], scale[place[2]])
        assert bool(one.overturned) == bool(grid.values.overturned[place])
        np.testing.assert_allclose(grid.values.margin[place], one.margin, rtol=1e-10)
    assert grid.values.overturned.any() and not grid.values.overturned.all()


def drawn(spectrum):
    """Return, for both axes of a figure, its lines by label, its hatched bars, and its shaded spans."""
    axes = rk.plot.spectrum(spectrum)
    axes[0].figure.canvas.draw()
    for axis in axes:
        lines = {line.get_label(): line for line in axis.lines}
        bars = sorted((patch.get_x(), patch.get_width()) for patch in axis.patches if patch.get_hatch())
        spans = [(patch.get_x(), patch.get_width()) for patch in axis.patches if not patch.get_hatch()]
        yield axis, lines, bars, spans
    plt.close("all")


def test_a_figure_of_a_suite():
    """Median, gaps where motions overturn, the shade where the median does, hatches where a scene is open."""
    values = np.array([[INF, INF, 0.4, 0.3], [INF, 0.6, 0.5, 0.4], [INF, 0.8, 0.7, 0.6]])
    kinds = np.full(values.shape, "successful", dtype="U30")
    kinds[1, 2], kinds[0, 3] = "undecided", "chaotic"
    for axis, lines, bars, spans in drawn(made(values, statuses(kinds))):
        median = lines["median"].get_ydata()
        np.testing.assert_array_equal(median, [np.nan, 0.8, np.nan, 0.4])
        single = lines["3 motions"].get_ydata().reshape(3, 5)[:, :4]
        np.testing.assert_array_equal(single, np.where((kinds == "undecided") | np.isinf(values), np.nan, values))
        assert spans == [(0.5, 1.0)] and {bar for bar in bars} == {(2.5, 1.0)}
        assert axis.get_ylim()[0] == 0 and np.isfinite(axis.get_ylim()[1])
        band = axis.collections[0].get_paths()[0].vertices
        assert band[:, 1].max() == pytest.approx(axis.get_ylim()[1])  # up to the top where the 84th overturns


@pytest.mark.parametrize(
    "values, said", [(np.zeros((3, 2)), ["no block uplifts"]), (np.full((3, 2), INF), [])], ids=["at rest", "lost"]
)
def test_figures_of_suites_without_curves(values, said):
    for number, (axis, *_) in enumerate(drawn(made(values))):
        assert axis.get_ylim() == (0, 1) and [text.get_text() for text in axis.texts] == (said if number == 0 else [])


def test_figures_of_suites_of_any_size():
    every = statuses([["undecided"] * 2] * 3)
    for spectrum in (made([[0.5]]), made([[INF]]), made(np.full((3, 2), 0.5), every)):
        for axis, *_ in drawn(spectrum):
            assert np.isfinite(axis.get_ylim()).all()
    axes = rk.plot.spectrum(made(RNG.gamma(2.0, size=(4, 9))))
    axes[0].set_yscale("log")
    axes[0].figure.canvas.draw()
    assert 0 < axes[0].get_ylim()[0] < axes[0].get_ylim()[1]
    plt.close("all")
