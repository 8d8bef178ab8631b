"""Borders of overturning maps are exact, whatever the grid: islands, gaps and tips too. Judged by closed forms."""

import dataclasses

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.closed_form import sine_pulse, single_lobe
from jaxrock.studies import borders
from jaxrock.studies.borders import _Interval, _pairs

RESTITUTION, TIP = 0.8, 4.33389  # largest frequency ratio of case 1.2, by 200-bit Taylor series
COARSE = np.linspace(0.5, 8.0, 5), np.linspace(1.02, 10.0, 3)
LINEAR = {"alpha": 0.2, "restitution": RESTITUTION, "model": rk.Linear(), "progress": False}


@pytest.fixture(autouse=True)
def closed_afterwards():
    yield
    plt.close("all")


@pytest.fixture(scope="module")
def surface():
    return rk.overturning_map(*COARSE, **LINEAR)


@pytest.fixture(scope="module")
def regions(surface):
    return rk.studies.overturning_borders(surface).regions


@pytest.fixture(scope="module")
def small():
    """A map of two regions, whose borders take few columns."""
    return rk.overturning_map(np.linspace(2.5, 2.7, 5), np.linspace(1.02, 3.0, 3), **LINEAR)


@pytest.fixture(scope="module")
def borders_of_small(small):
    return rk.studies.overturning_borders(small)


@pytest.fixture(scope="module")
def narrow():
    """A map of one region, whose borders are nearly straight: they need no columns but its own."""
    return rk.overturning_map([3.0, 3.01], np.linspace(1.5, 2.5, 3), **LINEAR)


@pytest.fixture(scope="module")
def with_curves(small):
    """The small map with its borders, and the curves of the closed forms."""
    return rk.plot.sine_regions(RESTITUTION, rk.plot.overturning(small), frequency_ratio=np.linspace(1, 5, 8))


def in_pieces(function, x, *more):
    """A function of a list, of eight numbers at a time, as `sine_regions` asks it: one program for any number."""
    found = [function(piece, *more) for piece in np.resize(x, (-(-x.size // 8), 8))]
    return jax.tree.map(lambda *rows: np.concatenate(rows)[: x.size], *found)


def at(regions, ratio):
    """Lower and upper intensity of all regions that have a column there."""
    found = [
        (float(region.lower[k]), float(region.upper[k]))
        for region in regions
        for k in np.flatnonzero(region.frequency_ratio == ratio)
    ]
    return np.array(sorted(found)).reshape(-1, 2)


def test_a_grid_of_fifteen_points_shows_islands_and_gaps(regions):
    assert sorted(region.impacts for region in regions) == [0, 1, 3, 5]


def test_borders_are_the_closed_forms(regions, references):
    """At every column; islands at one of them, by 200-bit Taylor series."""
    by_impacts = {region.impacts: region for region in regions}
    blue, red = by_impacts[0], by_impacts[1]
    limit = in_pieces(sine_pulse.no_impact_limit, blue.frequency_ratio)
    np.testing.assert_allclose(blue.lower, limit, rtol=1e-11)
    np.testing.assert_allclose(blue.upper, 10.0, rtol=1e-15)
    low, high = in_pieces(sine_pulse.after_pulse_limits, red.frequency_ratio, RESTITUTION)
    during = in_pieces(sine_pulse.during_pulse_limit, red.frequency_ratio, RESTITUTION)
    np.testing.assert_allclose(red.upper, high, rtol=2e-9)  # the two meet in the tip
    np.testing.assert_allclose(red.lower, np.where(np.isfinite(during), during, low), rtol=2e-9)
    (known,) = (
        case["ends"]
        for case in references["linear_sine_intervals"]
        if (case["frequency_ratio"], case["restitution"]) == ("0.5", "0.8")
    )
    ends = np.array([[float(x or 10.0) for x in pair] for pair in known])
    np.testing.assert_allclose(at(regions, 0.5)[-len(ends) :], np.minimum(ends, 10.0), rtol=1e-11)


@pytest.mark.parametrize(("impacts", "low", "high"), [(1, TIP - 1e-5, TIP + 1e-5), (3, 0.875, 0.9)])
def test_regions_end_in_their_tips(regions, impacts, low, high):
    (region,) = (region for region in regions if region.impacts == impacts)
    assert low < region.frequency_ratio[-1] < high
    assert region.upper[-1] - region.lower[-1] < 0.01


def test_borders_are_smooth(regions):
    """A straight line between two columns is nowhere off by more than a thousandth of the range, or two."""
    (region,) = (region for region in regions if region.impacts == 0)
    middle = (region.frequency_ratio[1:] + region.frequency_ratio[:-1]) / 2
    exact = in_pieces(sine_pulse.no_impact_limit, middle)
    straight = (region.lower[1:] + region.lower[:-1]) / 2
    drawn = exact < 10
    assert np.max(np.abs(straight - exact)[drawn]) < 2e-3 * 9


@pytest.mark.slow  # fast: the closed forms of a sine above, walls in `test_spectra`
def test_the_wall_of_single_lobes():
    strength, duration = np.linspace(0.05, 0.95, 3), np.linspace(0.5, 6.0, 4)
    surface = rk.overturning_map(
        pulse_duration=duration, uplift_strength=strength, pulse=rk.ExponentialPulse, shape=0.5, restitution=0.9,
        model=rk.Linear(), progress=False,
    )  # fmt: skip
    (region,) = rk.studies.overturning_borders(surface).regions
    wall = single_lobe.safety_wall(2 * np.pi / region.frequency_ratio, 0.5)
    np.testing.assert_allclose(1 / region.lower, wall, rtol=1e-11)
    axis = rk.plot.overturning(surface, by_duration=True)
    x, y = axis.lines[0].get_xydata().T
    np.testing.assert_allclose(y, single_lobe.safety_wall(x, 0.5), rtol=1e-11)


def interval(lower, upper, *kind):
    return _Interval(lower, upper, kind[0], kind)


PAIRS = {
    "a region goes on": ([interval(1, 2, 1, 1)], [interval(1.1, 2.2, 1, 1)], [(0, 0)], [(0, 0)]),
    "one ends": ([interval(1, 2, 1, 1), interval(3, 4, 0, 0)], [interval(3, 5, 0, 0)], [(1, 0)], [(1, 0)]),
    "one forks": ([interval(1, 4, 1, 1)], [interval(1, 2, 1, 1), interval(3, 4, 1, 1)], [], []),
    "islands slide": (
        [interval(1, 2, 3, 3), interval(2.1, 3, 1, 1)], [interval(1.9, 2.5, 3, 3), interval(2.6, 3, 1, 1)],
        [(0, 0), (1, 1)], [(0, 0), (1, 1)],
    ),
    "apart": ([interval(1, 2, 1, 1)], [interval(3, 4, 1, 1)], [], []),
    "an impact more": ([interval(1, 2, 3, 3)], [interval(1, 2, 5, 5)], [], [(0, 0)]),
    "impacts or none": ([interval(1, 2, 1, 1)], [interval(1, 2, 0, 0)], [], []),
}  # fmt: skip


@pytest.mark.parametrize("name", PAIRS)
def test_intervals_that_belong_together(name):
    here, there, strict, loose = PAIRS[name]
    assert _pairs(here, there, strict=True) == strict
    assert _pairs(here, there, strict=False) == loose


def test_where_impacts_give_way_to_none_without_a_gap(monkeypatch):
    """A region is parted there, in every column elsewhere: here by a margin that is made up."""

    def margins(self, z, ratio):
        intensity = np.exp(z)
        return 2 - intensity, -intensity, np.where(intensity > 2 + ratio, 0, 1), np.zeros(z.shape, bool)

    monkeypatch.setattr(borders._Search, "at", margins)
    for (lower, upper), cut in zip(borders._Search((), 1.0, 4.0, False).columns(np.array([1.0, 0.5])), (3, 2.5)):
        np.testing.assert_allclose([lower.lower, lower.upper, upper.lower, upper.upper], [2, cut, cut, 4], rtol=1e-12)
        assert (lower.impacts, upper.impacts) == (1, 0)


@pytest.mark.parametrize("change", [{"scene": None}, {"parameters": {"shape": jax.device_put(np.zeros(2))}}])
def test_maps_that_have_no_borders(surface, change):
    with pytest.raises(ValueError, match="Argument `result` must be a map of two axes"):
        rk.studies.overturning_borders(dataclasses.replace(surface, **change))


def test_map_with_borders(borders_of_small, with_curves):
    regions = borders_of_small.regions
    assert len(regions) == 2
    drawn = [line.get_ydata() for line in with_curves.lines[: 2 * len(regions)]]
    for region, lower, upper in zip(regions, drawn[::2], drawn[1::2]):
        np.testing.assert_array_equal(lower, region.lower)
        np.testing.assert_array_equal(upper, region.upper)
    legends = [child for child in with_curves.get_children() if type(child).__name__ == "Legend"]
    assert len(legends) == 2  # the map's, and that of the curves


@pytest.fixture(scope="module")
def too_few_steps():
    """A map whose columns cannot be searched: what a search asks takes more steps than a verdict."""
    grid = np.linspace(0.5, 8, 20), np.linspace(1.05, 9, 20)
    return rk.overturning_map(*grid, **LINEAR | {"restitution": 0.95, "engine": rk.Series(max_steps=15)})


def test_columns_without_a_result_are_drawn_by_pixels(too_few_steps, caplog):
    """They were taken for safe ones, although the map itself has its verdicts."""
    found = rk.studies.overturning_borders(too_few_steps)
    assert not found.regions and (found.crowded[0, 0], found.crowded[-1, 1]) == (0.5, 8)
    state = np.asarray(too_few_steps.state)
    assert (state >= 0).all() and (state > 0).sum() > 200
    shown = rk.plot.overturning(too_few_steps).collections[-1].get_array()
    np.testing.assert_array_equal(np.ma.filled(shown, 0), state)
    with caplog.at_level("INFO", "jaxrock"):
        rk.plot.borders(too_few_steps)
    assert "borders are left out" in caplog.text


def test_columns_that_the_map_contradicts_are_crowded(small, borders_of_small):
    """One point of the map has another verdict than the borders around it."""
    assert not borders_of_small.crowded.size
    state = np.array(small.state)
    row, column = np.argwhere(state == 0)[0]
    state[row, column] = 2
    other = dataclasses.replace(small, state=jnp.asarray(state))
    place = float(small.frequency_ratio[column])
    crowded = rk.studies.overturning_borders(other).crowded
    assert crowded.size and (np.min(abs(crowded - place), axis=1) == 0).all()


def test_survivors_are_coloured_up_to_the_border(surface):
    """By their peaks, and pixels of overturned blocks beside survivors, of which the border leaves a part, too."""
    axis = rk.plot.overturning(surface, exact=False)
    peaks = np.ma.filled(axis.collections[0].get_array(), np.nan).reshape(surface.state.shape)
    safe = np.asarray(surface.state) == 0
    np.testing.assert_array_equal(peaks[safe], np.asarray(surface.rotation_ratio)[safe])
    beside = ~safe[:, :-1] & safe[:, 1:]
    assert beside.any() and np.isfinite(peaks[:, :-1][beside]).all()


def test_borders_over_each_other(small, narrow):
    axis = rk.plot.borders(small, by_strength=True, color="red", label="one")
    highest = max(np.nanmax(line.get_ydata()) for line in axis.lines)
    assert highest < 1 and [line.get_label() for line in axis.lines].count("one") == 1
    assert {line.get_color() for line in axis.lines} == {"red"}
    assert (axis.get_xlabel(), axis.get_ylabel()) == (r"frequency ratio $\omega/p$", "uplift strength")
    assert rk.plot.borders(narrow, scale=2.0).get_ylabel() == "intensity times 2"


@pytest.mark.parametrize(
    "draw, given", [(rk.plot.borders, {}), (rk.plot.overturning, {"exact": True}), (rk.plot.overturning, {})]
)
def test_progress_of_a_figure(narrow, capsys, draw, given):
    draw(narrow, **given)
    assert capsys.readouterr().err == ""
    draw(narrow, progress=True, **given)
    assert "borders" in capsys.readouterr().err


def test_curves_reach_their_tips(with_curves):
    (curve,) = (line.get_xydata() for line in with_curves.lines if "1.2" in line.get_label())
    known = np.isfinite(curve[:, 1])
    np.testing.assert_allclose(curve[known, 0].max(), TIP, atol=1e-5)


def test_isolated_survivors_of_a_spectrum_are_seen():
    peaks = np.array([[np.inf, 0.7, np.inf, np.inf, 0.5, 0.4]])
    told = {"abscissa": np.arange(6.0), "rotation_ratio": peaks, "velocity_ratio": peaks, "margin": -peaks,
            "impact_count": np.zeros((1, 6), int), "overturned": np.isinf(peaks),
            "intensity": np.array([2.0])}  # fmt: skip
    spectrum = rk.studies.Spectrum(**jax.device_put(told), status=rk.Status.successful)
    axis, _ = rk.plot.spectrum(spectrum)
    dots = [line.get_xydata().tolist() for line in axis.lines if line.get_marker() == "."]
    assert dots == [[[1.0, 0.7]]]
