"""Figures show what they are given: the data in the axes, of results that are made by hand."""

from dataclasses import fields

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.colors import to_rgba

import jaxrock as rk
from jaxrock.closed_form import sine_pulse, single_lobe
from jaxrock.inverse.search import Trace
from jaxrock.motions.pulses import PULSES, UNITS
from jaxrock.plot.responses import acceleration_of, moments_seen
from jaxrock.studies.saved_outcomes import an_outcome
from jaxrock.studies.sensitivities import Slopes, SlopeStatus

QUICK = {"model": rk.Linear(), "engine": rk.Series(order=8)}  # compiles in half the time
LINEAR = {"alpha": 0.2, "progress": False, **QUICK}  # of maps


@pytest.fixture(autouse=True)
def closed_afterwards():
    yield
    plt.close("all")


def sensitivity_of(elasticity):
    """A sensitivity with these elasticities by two parameters."""
    elasticity = np.asarray(elasticity)
    number, good = elasticity[..., 0], np.ones(elasticity.shape[:-1], bool)
    elasticity, number, good = map(jnp.asarray, (elasticity, number, good))
    slopes = Slopes(number, elasticity, elasticity, number, SlopeStatus.useful)
    return rk.studies.Sensitivity(
        ("alpha", "amplitude"), elasticity, slopes, slopes, slopes, an_outcome(), good, number, number, number
    )


def test_tornado():
    axis = rk.plot.tornado(sensitivity_of([-2.0, 0.5]))
    assert [bar.get_width() for bar in axis.patches] == [0.5, -2.0]  # the largest on top, which is last
    assert [label.get_text() for label in axis.get_yticklabels()] == ["amplitude", "alpha"]


def test_a_tornado_is_of_one_scene():
    with pytest.raises(ValueError, match=r"`sensitivity` must be of one scene, but is of many, of shape \(2,\)"):
        rk.plot.tornado(sensitivity_of([[-2.0, 0.5], [1.0, 2.0]]))


def test_a_tornado_of_a_block_that_overturns_says_so():
    """It was an empty frame."""
    told = rk.studies.sensitivity(rk.Block(0.2, 2.0, 0.9), rk.RectangularPulse(1.4, 0.9), **QUICK)
    with pytest.raises(ValueError, match="Argument `sensitivity` must have .* 'max_rotation', .*: draw its `margin`"):
        rk.plot.tornado(told)
    assert len(rk.plot.tornado(told, "margin").patches) == len(told.names)


def test_sensitivity_map():
    elasticity = np.random.default_rng(0).normal(size=(3, 4, 2))
    elasticity[0, 0] = np.nan
    surface = rk.studies.SensitivityMap(
        jnp.linspace(0.1, 0.9, 3), jnp.linspace(1, 4, 4), jnp.asarray(0.0), sensitivity_of(elasticity)
    )
    axis = rk.plot.sensitivity_map(surface, "amplitude", limit=2.0)
    shown = axis.collections[0].get_array()
    np.testing.assert_allclose(np.ma.filled(shown, np.nan).reshape(3, 4), elasticity[..., 1])
    assert axis.collections[0].get_clim() == (-2.0, 2.0)


def test_critical():
    """Rising ends without and with impacts, falling ends; what is filled up is not shown."""
    intensity = jnp.array([[1.5, 2.0, 3.0], [1.4, jnp.inf, jnp.inf]])
    rising = jnp.array([[True, False, True], [True, False, False]])
    impacts = jnp.array([[1, 1, 0], [0, 0, 0]])
    ends = rk.studies.Critical(
        count=jnp.array([3, 1]), value=intensity, intensity=intensity, rising=rising, impacts=impacts,
        balanced=rising, derivative=intensity[..., None], complete=jnp.array([True, True]), names=("alpha",),
    )  # fmt: skip
    axis = rk.plot.critical([0.5, 0.7], ends)
    shown = {line.get_label(): line.get_xydata().tolist() for line in axis.lines}
    assert shown == {
        "overturns above: without impact": [[0.5, 3.0], [0.7, 1.4]],
        "overturns above: after impacts": [[0.5, 1.5]],
        "safe again above": [[0.5, 2.0]],
    }
    maps = {patch.get_label(): patch.get_facecolor() for patch in rk.plot.overturning(
        map_of([[0, 1], [0, 2]], [1.0, 2.0], [2.0, 3.0])).get_legend().get_patches()}  # fmt: skip
    colors = {line.get_label().split(": ")[-1]: to_rgba(line.get_color()) for line in axis.lines}
    assert colors["without impact"] == maps["overturned without impact"]
    assert colors["after impacts"] == maps["overturned after impacts"]
    assert axis.get_xlabel() and rk.plot.critical([0.5, 0.7], ends, label="period [s]").get_xlabel() == "period [s]"
    part = eqx.tree_at(lambda x: x.complete, ends, jnp.array([True, False]))
    (cross,) = (line for line in rk.plot.critical([0.5, 0.7], part).lines if line.get_marker() == "x")
    assert cross.get_label() == "not all computed" and cross.get_xdata().tolist() == [0.7]


def test_broken_curves():
    """Check that a single point between gaps, or at an end, is drawn as a dot."""
    _, axis = plt.subplots()
    values = [1.0, np.inf, 2.0, 3.0, np.nan, 4.0, np.inf, 5.0]
    line = rk.plot.broken_curve(axis, np.arange(8), values, color="red")
    np.testing.assert_array_equal(line.get_ydata(), np.where(np.isfinite(values), values, np.nan))
    assert axis.lines[1].get_xydata().tolist() == [[0.0, 1.0], [5.0, 4.0], [7.0, 5.0]]
    assert axis.lines[1].get_color() == "red"


def test_safety_regions():
    axis = rk.plot.safety_regions(0.5, longest=4.0, points=8)
    wall = axis.lines[0].get_xydata()
    np.testing.assert_allclose(wall[:, 0], np.linspace(0.5, 4.0, 8))
    np.testing.assert_allclose(wall[:, 1], single_lobe.safety_wall(wall[:, 0], 0.5))
    assert len(axis.collections) == 5
    assert "$O_3$" in {text.get_text() for text in axis.texts} and axis.get_legend() is not None
    assert rk.plot.safety_regions(0.5, points=8, legend=False).get_legend() is None


def test_sine_regions():
    axis = rk.plot.sine_regions(0.9, frequency_ratio=np.geomspace(1.0, 4.0, 8))
    (curve,) = (line for line in axis.lines if line.get_label() == "case 2: no impact")
    np.testing.assert_allclose(curve.get_ydata(), sine_pulse.no_impact_limit(curve.get_xdata()))
    over = rk.plot.overturning(map_of([[0, 1], [0, 2]], [1.0, 2.0], [2.0, 3.0]))
    words = over.get_ylabel()
    assert rk.plot.sine_regions(0.9, over, frequency_ratio=np.geomspace(1.0, 4.0, 8)).get_ylabel() == words


def test_sine_regions_over_durations():
    """As the map below: x to 2 pi / x, y to 1 / y; in the other coordinates they would say something else."""
    given = {"frequency_ratio": np.geomspace(1.0, 4.0, 8)}
    result = map_of([[0, 1], [0, 2]], [1.0, 2.0], [2.0, 3.0])
    over = rk.plot.overturning(result, by_duration=True)
    axis = rk.plot.sine_regions(0.9, over, by_duration=True, **given)
    (curve,) = (line for line in axis.lines if line.get_label() == "case 2: no impact")
    duration, strength = curve.get_data()
    np.testing.assert_allclose(strength, 1 / sine_pulse.no_impact_limit(2 * np.pi / duration))
    alone = rk.plot.sine_regions(0.9, by_duration=True, **given)
    assert alone.get_xlabel() == axis.get_xlabel()
    for by_duration, drawn in ((False, over), (True, rk.plot.overturning(result))):
        with pytest.raises(ValueError, match=f"`by_duration` must be {not by_duration} for an axis over"):
            rk.plot.sine_regions(0.9, drawn, by_duration=by_duration, **given)


@pytest.mark.parametrize(
    "by_duration, upward, mine",
    [
        (False, "uplift strength", "intensity"),
        (False, "intensity times 2", "intensity"),
        (True, "uplift strength times 0.5", "uplift strength"),
        (True, "intensity", "uplift strength"),
    ],
)
def test_sine_regions_over_what_is_upward(by_duration, upward, mine):
    """Labels as `borders` writes them."""
    _, axis = plt.subplots()
    axis.set_ylabel(upward)
    with pytest.raises(ValueError, match=f"`axis` must have the {mine} upward, but has '{upward}'"):
        rk.plot.sine_regions(0.9, axis, by_duration=by_duration, frequency_ratio=np.geomspace(1.0, 4.0, 8))


def test_found_record():
    """Both records, what lies between them, and their spectra."""
    number, start = jnp.zeros(()), rk.Record([0.1, 0.2, -0.3, 0.0], 0.5, "a start")
    change = np.array([0.0, 0.1, 0.0, -0.1])
    after = rk.Record(start.samples + change, 0.5)
    status = rk.inverse.RecordStatus.successful
    found = rk.inverse.FoundRecord(
        after, start, number, number, number[None], number, number[None], number[None], jnp.array(jnp.nan), status
    )
    records, between, spectra = rk.plot.found_record(found)
    assert records.get_title() == "a start" and records.get_xlim() == between.get_xlim() == (0.0, 1.5)
    for line, expected in ((records.lines[0], start.samples), (records.lines[1], after.samples)):
        np.testing.assert_allclose(line.get_xydata(), np.stack([[0.0, 0.5, 1.0, 1.5], expected], axis=1))
    np.testing.assert_allclose(between.lines[0].get_ydata(), change, atol=1e-16)
    np.testing.assert_allclose(spectra.lines[1].get_xydata(), [[0.5, 0.1], [1.0, 0.0]], atol=1e-16)
    long = eqx.tree_at(lambda x: x.start, found, rk.Record(start.samples, 0.5, "a station, " * 20))
    axis = rk.plot.found_record(long)[0]
    axis.figure.canvas.draw()
    box, whole = axis.title.get_window_extent(), axis.figure.bbox
    assert 0 < box.x0 and box.x1 < whole.x1 and box.y1 < whole.y1


def a_region(rows, columns):
    """Amplitudes and periods, the likeliest of them 0.4 and 0.7."""
    likelihood = -((np.log(rows / 0.4)[:, None]) ** 2) - np.log(columns / 0.7) ** 2
    values, likely = (jnp.asarray(rows), jnp.asarray(columns)), jnp.asarray(likelihood > -1)
    return rk.inverse.FeasibleRegion(("amplitude", "period"), values, jnp.asarray(likelihood), likely)


def test_feasible_region():
    """The best is the top of the scale; axes are logarithmic and have the units of the parameters."""
    region = a_region(np.geomspace(0.1, 1.0, 4), np.geomspace(0.2, 2.0, 5))
    strongest = map(jnp.asarray, (np.full(5, 0.5), np.full((1, 5), 0.5), np.zeros(5, int), np.ones(5, bool)))
    wall = rk.inverse.Unexceeded(region.values[1], *strongest)
    axis = rk.plot.feasible_region(region, wall=wall)
    assert (axis.get_ylabel(), axis.get_xlabel()) == ("amplitude [g]", "period [s]")
    assert (axis.get_xscale(), axis.get_yscale()) == ("log", "log")
    assert float(axis.collections[0].get_array().max()) == 0.0
    labels = axis.get_legend_handles_labels()[1]
    assert labels[0] == "95 % region" and len(labels) == 2
    np.testing.assert_allclose(axis.lines[-1].get_ydata(), 0.5)


def test_a_wall_lies_along_the_axes_of_its_region():
    """Whichever of the two is drawn upward, with gaps where not all is known; over other parameters it has no place."""
    amplitude, period, likelihood = (jnp.asarray(x) for x in ([0.1, 1.0], [0.2, 2.0], np.zeros((2, 2))))
    known = np.array([True, True, False])
    wall = rk.inverse.Unexceeded(
        *map(jnp.asarray, ([0.5, 1.5, 1.8], [0.3, 0.4, 0.5], np.ones((1, 3)), np.zeros(3, int), known))
    )

    def drawn(names, values):
        region = rk.inverse.FeasibleRegion(names, values, likelihood, jnp.asarray(np.ones((2, 2), bool)))
        return rk.plot.feasible_region(region, wall=wall).lines[0].get_xydata()

    np.testing.assert_allclose(
        drawn(("amplitude", "period"), (amplitude, period)), [[0.5, 0.3], [1.5, 0.4], [1.8, np.nan]]
    )
    np.testing.assert_allclose(
        drawn(("duration", "amplitude"), (period, amplitude)), [[0.3, 0.5], [0.4, 1.5], [np.nan] * 2]
    )
    for names in (("shape", "duration"), ("amplitude", "phase"), ("duration", "period")):
        with pytest.raises(ValueError, match=f"Argument `wall` must be None for a region over {names[0]} and"):
            drawn(names, (amplitude, period))


@pytest.mark.parametrize(("inside", "labels"), [(True, ["most likely"]), (False, [])])
def test_a_cross_outside_of_a_region_is_not_listed(inside, labels):
    values, likelihood = (jnp.array([0.1, 1.0]), jnp.array([0.2, 2.0])), jnp.zeros((2, 2))
    region = rk.inverse.FeasibleRegion(("amplitude", "period"), values, likelihood, likelihood > -1)
    estimate = an_estimate(("amplitude", "period"), [0.5, 1.0 if inside else 3.0])
    axis = rk.plot.feasible_region(region, estimate)
    assert axis.get_legend_handles_labels()[1] == labels
    alone = rk.plot.search(estimate)
    assert (alone.get_ylabel(), alone.get_xlabel()) == ("amplitude [g]", "period [s]")


def an_estimate(names, values):
    """With these parameters, and a search of no steps."""
    zero = jnp.zeros(())
    trace = Trace(jnp.full((1, 1, len(names)), jnp.nan), jnp.full((1, 1), jnp.nan))
    numbers = {each.name: zero for each in fields(rk.inverse.Estimate)}
    own = {"names": names, "values": jnp.asarray(values), "trace": trace, "open": jnp.zeros((2, 2), bool)}
    told = {"responses": 0, "remarks": (), "status": rk.inverse.EstimateStatus.successful}
    return rk.inverse.Estimate(**numbers | own | told)


def test_ticks_of_many_decades_do_not_overlap():
    figure, (few, many) = plt.subplots(2, 1, figsize=(5.5, 4))
    few.set(xscale="log", xlim=(0.1, 90)), many.set(xscale="log", xlim=(1e-3, 100))
    shown = []
    for axis in (few, many):
        rk.plot.log_ticks(axis)
        figure.canvas.draw()
        boxes = [x.get_window_extent() for x in axis.get_xticklabels() if x.get_text()]
        assert all(a.x1 < b.x0 for a, b in zip(boxes, boxes[1:]))
        (left, right), places = axis.get_xlim(), axis.get_xticks()
        shown.append(places[(places >= left) & (places <= right)].tolist())
    assert shown[0] == pytest.approx([0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50])
    assert shown[1] == pytest.approx([1e-3, 1e-2, 0.1, 1, 10, 100])


def maps_of(rows, columns):
    """Figures of a feasible region, sensitivities and a fragility surface of so many rows and columns, which have one
    value each."""
    up, across = jnp.asarray(np.geomspace(0.1, 1.0, rows)), jnp.asarray(np.geomspace(0.2, 2.0, columns))
    ones, all_likely = jnp.asarray(np.ones((rows, columns))), jnp.asarray(np.ones((rows, columns), bool))
    region = rk.inverse.FeasibleRegion(("amplitude", "period"), (up, across), ones, all_likely)
    told = rk.studies.SensitivityMap(up, across, jnp.asarray(0.0), sensitivity_of(np.ones((rows, columns, 2))))
    shares = rk.hazard.SimulatedSurface(up, across, np.ones((1, rows, columns, 1), np.int8))
    return (
        rk.plot.feasible_region(region),
        rk.plot.sensitivity_map(told, "alpha"),
        rk.plot.fragility_surface(shares, contours=(0.5,)),
    )


@pytest.mark.parametrize("shape", [(3, 1), (1, 3), (1, 1)])
@pytest.mark.filterwarnings("error")
def test_other_maps_of_one_row_or_column_are_drawn(shape):
    for axis in maps_of(*shape):
        cells = axis.collections[0]
        corners = cells.get_coordinates()
        assert np.ma.getdata(cells.get_array()).shape == shape
        assert np.diff(corners[..., 0], axis=1).min() > 0 and np.diff(corners[..., 1], axis=0).min() > 0
        assert np.ptp(axis.get_xlim()) > 0 and np.ptp(axis.get_ylim()) > 0


def test_a_feasible_region_is_drawn_in_order():
    """Whatever the order of its lists, cells and border are the same."""
    rows, columns = np.geomspace(0.1, 1.0, 4), np.geomspace(0.2, 2.0, 5)

    def drawn(up, across):
        cells, border = rk.plot.feasible_region(a_region(rows[list(up)], columns[list(across)])).collections
        return cells.get_array(), cells.get_coordinates(), border.get_paths()[0].vertices

    for found, expected in zip(drawn([2, 0, 3, 1], [4, 3, 2, 1, 0]), drawn(range(4), range(5))):
        np.testing.assert_allclose(found, expected)


def test_units_of_parameters_are_those_declared():
    assert UNITS == {"amplitude": "g", "duration": "s", "period": "s", "center": "s", "phase": "rad"}
    assert set(PULSES) >= {"sine", "half-sine", "rectangle", "mavroeidis-papageorgiou"}


def test_a_map_of_one_row_or_column_is_drawn():
    """Its cells have a width, whatever the order of the axes; overturned ones are not the colour of the safe."""
    grid = np.linspace(0.5, 8, 9), np.array([3.0])
    states = np.asarray(rk.overturning_map(*grid, **LINEAR).state)[0]
    assert set(states) == {0, 1, 2}
    mixed = np.random.default_rng(1).permutation(9)
    for first in (grid[0], grid[0][mixed]):
        axis = rk.plot.overturning(rk.overturning_map(first, grid[1], **LINEAR))
        drawn = axis.collections[-1]
        np.testing.assert_array_equal(np.ma.filled(drawn.get_array(), 0).ravel(), states)
        assert np.ptp(drawn.get_coordinates()[..., 1]) > 0.1 and np.ptp(axis.get_ylim()) > 0.1
        plt.close(axis.figure)


@pytest.mark.filterwarnings("error")
def test_places_that_are_there_twice_have_one_cell():
    """Check that equal places share one cell: two cells would have no width, and all would have the colour of safe."""
    result = rk.overturning_map([2.0, 2.0], [4.0, 3.0, 4.0], **LINEAR)
    axis = rk.plot.overturning(result, exact=False)
    drawn = axis.collections[-1]
    np.testing.assert_array_equal(np.ma.filled(drawn.get_array(), 0), np.asarray(result.state)[[1, 0], :1])
    assert (np.asarray(result.state) > 0).all()
    assert np.ptp(drawn.get_coordinates()[..., 0]) > 0.1 and np.ptp(axis.get_xlim()) > 0.1
    plt.close(axis.figure)
    unsaid = rk.plot.overturning(result).collections[-1].get_array()  # of one column no borders are looked for
    np.testing.assert_array_equal(unsaid, drawn.get_array())
    with pytest.raises(ValueError, match="`result` must be a map of two axes, with two different values or more each"):
        rk.plot.overturning(result, exact=True)


def test_sizes_that_are_there_twice_are_shaded():
    axis, _ = rk.plot.spectrum(spectrum_of([True, True, False, False], [2.0, 2.0, 3.0, 4.0]))
    (span,) = axis.patches
    assert (span.get_x(), span.get_width()) == (1.5, 1.0)


def test_sizes_that_overturn_alone_are_shaded():
    """A spectrum's overturned sizes each have a cell, half way to their neighbours."""
    sizes = 1.07 + 0.08 * np.arange(64)
    spectrum = rk.rocking_spectrum(np.arctan(0.2), rk.example_record(), sizes, progress=False, **QUICK)
    lost, places = np.asarray(spectrum.overturned), np.asarray(spectrum.abscissa)
    axis, _ = rk.plot.spectrum(spectrum)
    spans = sorted((patch.get_x(), patch.get_x() + patch.get_width()) for patch in axis.patches)
    shaded = np.any([(places > begin) & (places < end) for begin, end in spans], axis=0)
    np.testing.assert_array_equal(shaded, lost)
    assert min(end - begin for begin, end in spans) < 1.5 * (places[1] - places[0])  # one stands alone
    plt.close(axis.figure)


def test_a_map_of_too_many_islands_is_drawn_by_pixels(monkeypatch, caplog):
    """Where exact borders take too long, and it is said; where they were asked for they are drawn."""
    monkeypatch.setattr("jaxrock.plot.surfaces._SCENES", 500)
    surface = rk.overturning_map([3.0, 3.01], np.linspace(1.05, 4.5, 6), **LINEAR)
    with caplog.at_level("INFO", "jaxrock"):
        pixels = rk.plot.overturning(surface)
    assert "too many islands" in caplog.text and len(pixels.lines) == 0
    assert len(rk.plot.overturning(surface, exact=True).lines) > 2
    plt.close("all")


def map_of(state, ratio, intensity):
    state = np.asarray(state)
    peaks, counts = np.where(state == 0, 0.5, np.inf), np.zeros_like(state)
    state, peaks, counts = map(jnp.asarray, (state, peaks, counts))
    return rk.studies.OverturningMap(
        jnp.asarray(ratio), jnp.asarray(intensity), state, peaks, counts, peaks, rk.Status.successful
    )


def spectrum_of(lost, abscissa):
    lost = np.asarray(lost)
    peaks, counts = np.where(lost, np.inf, 0.5), np.zeros(lost.shape, int)
    lost, peaks, counts = map(jnp.asarray, (lost, peaks, counts))
    return rk.studies.Spectrum(jnp.asarray(abscissa), peaks, peaks, counts, lost, peaks, rk.Status.successful)


def test_a_spectrum_may_have_a_logarithmic_axis():
    for axis in rk.plot.spectrum(spectrum_of([False, True, False], [1.0, 2.0, 3.0])):
        assert axis.get_ylim()[0] == 0
        axis.set_yscale("log")
        assert 0 < axis.get_ylim()[0] < 0.5 < axis.get_ylim()[1]


def test_a_spectrum_leaves_out_what_was_not_computed():
    """Gaps with a cross: numbers there are those of a part of the motion, and no verdicts, whatever they say."""
    status = jax.vmap(lambda bad: rk.Status.where(bad, rk.Status.step_budget_exhausted, rk.Status.successful))(
        jnp.array([False, False, True, True])
    )
    found = spectrum_of([False, True, True, False], [1.0, 2.0, 3.0, 4.0])
    for axis in rk.plot.spectrum(eqx.tree_at(lambda x: x.status, found, status)):
        assert axis.lines[0].get_ydata()[0] == 0.5 and np.isnan(axis.lines[0].get_ydata()[1:]).all()
        (crosses,) = (line for line in axis.lines if line.get_marker() == "x")
        assert crosses.get_xdata().tolist() == [3.0, 4.0] and crosses.get_label() == "not computed"
        assert [(patch.get_x(), patch.get_width()) for patch in axis.patches] == [(1.5, 1.0)]


@pytest.mark.parametrize("lost", [True, False])
def test_a_spectrum_of_none_that_rocks_starts_at_zero(lost):
    peaks = jnp.full(2, jnp.inf if lost else 0.0)
    found = spectrum_of([lost, lost], [1.0, 2.0])
    axes = rk.plot.spectrum(eqx.tree_at(lambda x: (x.rotation_ratio, x.velocity_ratio), found, (peaks, peaks)))
    assert [axis.get_ylim() for axis in axes] == [(0, 1)] * 2
    assert [text.get_text() for text in axes[0].texts] == ([] if lost else ["no block uplifts"])


def test_the_legend_of_many_intensities_lies_beside_the_curves():
    lost = np.zeros((8, 3), bool)
    found = eqx.tree_at(
        lambda x: x.intensity, spectrum_of(lost, [1.0, 2.0, 3.0]), jnp.arange(1.0, 9), is_leaf=lambda x: x is None
    )
    axis, _ = rk.plot.spectrum(found)
    axis.figure.canvas.draw()
    legend = axis.get_legend().get_window_extent()
    assert legend.x0 >= axis.get_window_extent().x1 and legend.x1 <= axis.figure.bbox.x1


def wrong_figures():
    """Calls with an argument that is not what is asked for, and what is said of it."""
    spectrum, told = spectrum_of([False], [1.0]), sensitivity_of([1.0, 2.0])
    one = jnp.asarray([1.0])
    surface = rk.studies.SensitivityMap(one, one, jnp.asarray(0.0), told)
    numbers, counts, verdicts = (jnp.asarray(np.zeros(3, kind)) for kind in (float, int, bool))
    slopes = jnp.asarray(np.zeros((3, 1)))
    ends = rk.studies.Critical(
        jnp.array(3), numbers, numbers, verdicts, counts, verdicts, slopes, jnp.array(True), ("alpha",)
    )
    one_axis = plt.figure().add_subplot()
    plot = rk.plot
    return [
        (lambda: plot.history(an_outcome()), "`response` must be a Response"),
        (lambda: plot.phase(an_outcome()), "`response` must be a Response"),
        (lambda: plot.spectrum(map_of([[0]], [1.0], [1.0])), "`result` must be a Spectrum"),
        (lambda: plot.overturning(spectrum), "`result` must be an OverturningMap"),
        (lambda: plot.overturning(map_of([[0]], [1.0], [1.0]), [one_axis]), "`axis` must be an axis of matplotlib"),
        (lambda: plot.spectrum(spectrum, one_axis), "`axes` must be 2 axes of matplotlib, but is Axes"),
        (lambda: plot.spectrum(spectrum, [one_axis]), "`axes` must be 2 axes of matplotlib, but is list of 1"),
        (lambda: plot.tornado(told, "rotation"), "`result` must be .*max_rotation"),
        (lambda: plot.sensitivity_map(surface, "shap"), "`parameter` must be .*alpha"),
        (lambda: plot.scene(rk.Block(0.2, 2.0), None, plt.figure()), "`axis` must be an axis of matplotlib"),
        (lambda: plot.critical([1.0], ends), "`abscissa` and `ends` must be of as many scenes"),
    ]


def test_arguments_of_figures_are_checked():
    for call, words in wrong_figures():
        with pytest.raises(ValueError, match=f"Arguments? {words}"):
            call()


def test_a_history_over_long_quiet_shows_its_events():
    """Peaks of two shocks a day apart, and of a wavelet within a long piece, are drawn at their full height."""
    pulse = rk.SinePulse(0.4, 0.8)
    response = rk.simulate(rk.Block(0.3, 2.0), pulse + pulse.shifted(86_400.0), **QUICK)
    axes = rk.plot.history(response)
    (time, rotation), (shaken, ground) = (axes[k].lines[0].get_data() for k in (0, 2))
    assert np.abs(rotation).max() == pytest.approx(float(response.max_rotation) / 0.3, rel=1e-4)
    assert np.abs(ground).max() == pytest.approx(0.4, rel=1e-6)
    for begin in (0.0, 86_400.0):
        assert np.sum((time > begin) & (time < begin + 0.8)) > 50
    wavelet = rk.RickerPulse(0.4, 0.1, center=1000.0)
    shaken = moments_seen(wavelet, 0.0, 2000.0, 20_001)
    assert np.abs(acceleration_of(wavelet, shaken)).max() > 0.39
