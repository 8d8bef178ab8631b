"""Critical scales: factors on the motion as it was given, thin intervals merged, open verdicts, and the command."""

import itertools
import json

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.command_line.main import main
from jaxrock.status import Status
from jaxrock.studies import ends as search
from jaxrock.studies.critical_ends import intervals_of
from jaxrock.studies.lowest_ends import lowest_ends
from jaxrock.studies.search_axis import known_margin

QUICK = {"model": rk.Linear(), "engine": rk.Series(order=8), "derivatives": False, "progress": False}
STEPS = np.arange(60)
SHORT = rk.Record(0.5 * np.sin(0.3 * STEPS) * np.exp(-0.04 * STEPS), 0.05)


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


def critical(value, rising, **more):
    """Ends made by hand, of one scene or of many; infinite values are padding."""
    value, rising = np.asarray(value, float), np.asarray(rising, bool)
    numbers = {"value": value, "intensity": value, "rising": rising, "impacts": np.zeros(value.shape, int)}
    told = {"count": np.isfinite(value).sum(axis=-1), "complete": np.ones(value.shape[:-1], bool)}
    fields = numbers | {"balanced": rising, "derivative": value[..., None], "names": ("alpha",), "scale": value} | told
    names = fields.pop("names")
    return rk.studies.Critical(**{k: jnp.asarray(v) for k, v in (fields | more).items()}, names=names)


# The ratios of a block under one cycle of a sine whose amplitude has several intervals in closed form.
@pytest.mark.parametrize("ratio", [0.5, 0.8])
@pytest.mark.parametrize("given", [1.0, -0.3])
def test_scales_against_a_closed_form(ratio, given):
    """A scale times the amplitude that was given is the amplitude of the end, whatever was given, and in jit too."""
    block, pulse = rk.Block(0.1, 1.0, 0.9), rk.SinePulse(given, 2 * np.pi / ratio)
    asked = {"intensity": (1.001, 10.0), "derivatives": False, "progress": False}
    exact = rk.closed_form.sine_pulse.overturning_intervals(ratio, 0.9, searched_from=1.001)
    exact = np.stack([exact.lower, exact.upper], axis=1).ravel()
    exact = 0.1 * exact[exact < 10.0] / abs(given)
    found = rk.critical_amplitudes(block, pulse, rk.Linear(), **asked)
    np.testing.assert_allclose(found.scale, exact, rtol=1e-10)
    np.testing.assert_allclose(found.value, exact * abs(given), rtol=1e-10)
    assert found.complete and found.merged == 0


def test_scales_of_traced_amplitudes_and_their_derivatives():
    """The end stays where it is when the amplitude that is given grows, so the scale falls as one over it."""

    def lowest(amplitude):
        pulse = rk.SinePulse(amplitude, 0.8)
        return rk.critical_amplitudes(rk.Block(0.2, 2.0, 0.9), pulse, max_ends=2, narrowest=0.01, **QUICK).scale[0]

    scale, slope = jax.jit(jax.value_and_grad(lowest))(0.5)
    found = rk.critical_amplitudes(rk.Block(0.2, 2.0, 0.9), rk.SinePulse(0.5, 0.8), **QUICK)
    assert float(scale) == pytest.approx(float(found.scale[0]), rel=1e-12)
    assert float(slope) == pytest.approx(-float(scale) / 0.5, rel=1e-12)


def test_scales_of_durations():
    found = rk.studies.critical_durations(rk.Block(0.2, 2.0, 0.9), rk.SinePulse(0.5, 1.25), **QUICK)
    assert found.count >= 3
    np.testing.assert_allclose(found.scale * 1.25, found.value, rtol=1e-14)


def test_scales_of_a_record():
    """They are what to multiply the record by: beside each end the verdicts differ."""
    block = rk.Block.from_dimensions(0.6, 3.0)
    found = rk.critical_amplitudes(block, SHORT, intensity=(1.0, 20.0), **QUICK)
    peak = float(rk.intensity.peak_acceleration(SHORT))
    np.testing.assert_allclose(found.scale * peak, found.value, rtol=1e-14)
    assert found.count > 1 and found.complete
    for scale, rising in zip(np.asarray(found.scale), np.asarray(found.rising).tolist()):
        verdicts = [
            bool(rk.outcome(block, x * scale * SHORT, rk.Linear(), engine=QUICK["engine"]).overturned)
            for x in (1 - 1e-9, 1 + 1e-9)
        ]
        assert verdicts == [not rising, rising]


TURNS = [True, False, True, False, True]
# Values of ends in turn, the least width, and what is left.
MERGED = {
    "none is thin": ([1.0, 2.0, 3.0, 4.0, 5.0], 0.1, [1.0, 2.0, 3.0, 4.0, 5.0]),
    "no width": ([1.0, 1.0 + 1e-12, 3.0], 0.0, [1.0, 1.0 + 1e-12, 3.0]),
    "a thin interval": ([1.0, 1.001, 3.0], 0.01, [3.0]),
    "a thin gap": ([1.0, 2.0, 2.001], 0.01, [1.0]),
    "the width itself is not thin": ([1.0, 1.25, 3.0], 0.25, [1.0, 1.25, 3.0]),
    "the thinnest first": ([1.0, 1.003, 1.004, 2.0], 0.01, [1.0, 2.0]),
    "the thinnest first, from the other side": ([1.0, 1.001, 1.004, 2.0], 0.01, [1.004, 2.0]),
    "a thin one of thin ones": ([1.0, 1.002, 1.003, 1.005, 3.0], 0.01, [3.0]),
    "all but one": ([1.0, 1.001, 1.002, 1.003, 1.004], 0.01, [1.0]),
    "all": ([1.0, 1.001], 0.01, []),
    "one end": ([1.0], 10.0, [1.0]),
    "no end": ([], 10.0, []),
}


@pytest.mark.parametrize("value, narrowest, left", MERGED.values(), ids=MERGED)
def test_thin_intervals_and_gaps_are_merged(value, narrowest, left):
    given = critical(value, TURNS[: len(value)])
    found = given.without_thin(narrowest)
    assert found.value.tolist() == found.scale.tolist() == found.derivative[:, 0].tolist() == left
    assert int(found.count) == len(left) and 2 * int(found.merged) == len(value) - len(left)
    assert found.rising.tolist() == TURNS[: len(left)]
    traced = jax.jit(lambda ends: ends.without_thin(narrowest))(given)
    assert traced.value.shape == given.value.shape and traced.value[: len(left)].tolist() == left
    assert np.isinf(traced.value[len(left) :]).all() and int(traced.merged) == int(found.merged)


def test_merging_leaves_verdicts_outside_of_what_is_thin():
    """Random ends: what is left rises and falls in turn, is not thin, and differs only within thin stretches."""
    random = np.random.default_rng(0)
    for _ in range(5):
        ends = np.cumprod(1 + 10 ** random.uniform(-5, 0, 9))
        found = critical(ends, np.arange(9) % 2 == 0).without_thin(0.01)
        left = np.asarray(found.value)
        assert found.rising.tolist() == [k % 2 == 0 for k in range(left.size)]
        assert (left[1:] / left[:-1] - 1 >= 0.01).all()
        middles = np.sqrt(ends[1:] * ends[:-1])[ends[1:] / ends[:-1] > 1.1]  # too wide to be merged
        np.testing.assert_array_equal(*((np.searchsorted(x, middles) % 2) for x in (ends, left)))


def test_many_scenes_are_merged_each_by_itself():
    """Padded rows; scenes of no thin interval are as before, and a second time merges what is wider."""
    inf = np.inf
    given = critical([[1.0, 1.001, 3.0], [1.0, 2.0, 3.0], [5.0, inf, inf]], [TURNS[:3]] * 2 + [[True, False, False]])
    found = given.without_thin(0.01)
    np.testing.assert_array_equal(found.value, [[3.0, inf, inf], [1.0, 2.0, 3.0], [5.0, inf, inf]])
    assert found.count.tolist() == [1, 3, 1] and found.merged.tolist() == [1, 0, 0]
    again = found.without_thin(0.6)
    np.testing.assert_array_equal(again.value, [[3.0], [1.0], [5.0]])
    assert again.merged.tolist() == [1, 1, 0]


def test_a_stretch_that_is_not_bounded_is_not_thin():
    """Ends of one kind beside each other, where one between them was not found, are both left."""
    found = critical([1.0, 1.001, 1.002], [True, True, False]).without_thin(0.01)
    assert found.value.tolist() == [1.0] and found.rising.tolist() == [True]
    assert critical([1.0, 1.001], [True, True]).without_thin(0.01).count == 2


@pytest.mark.parametrize("most", [None, 5])
def test_searches_merge(most):
    """The gap below the limit without impacts, 0.3 % wide, is merged in one of two scenes; jit does the same."""
    pulses = rk.SinePulse(0.5, np.array([0.8, 2.5]))

    def asked(p, **more):
        asked = {"intensity": (1.0, 12.0), "derivatives": False, "progress": False, "max_ends": most}
        return rk.critical_amplitudes(rk.Block(0.2, p, 0.9), pulses, **asked | more)

    every, found = asked(2.0), asked(2.0, narrowest=0.02)
    width = np.asarray(every.scale[:, 2] / every.scale[:, 1] - 1)
    assert width[0] > 0.02 > width[1] > 1e-3
    assert found.count.tolist() == [3, 1] and found.merged.tolist() == [0, 1]
    np.testing.assert_array_equal(found.value[:, 0], every.value[:, 0])
    assert found.value.shape == (2, most or 3) and np.isinf(found.value[1, 1:]).all()
    if most:
        traced = jax.jit(lambda p: asked(p, narrowest=0.02))(2.0)
        np.testing.assert_allclose(traced.scale, found.scale, rtol=1e-12)
        assert traced.merged.tolist() == [0, 1]


def test_durations_merge():
    scene = rk.Block(0.2, 2.0, 0.9), rk.SinePulse(0.5, 1.0)
    every, found = (rk.studies.critical_durations(*scene, narrowest=x, **QUICK) for x in (None, 0.5))
    assert every.count - found.count == 2 * found.merged > 0
    assert set(found.value.tolist()) < set(every.value.tolist())


WRONG = {
    "negative": ({"narrowest": -1.0}, "Argument `narrowest` must be 0 or more and finite, but is -1.0."),
    "NaN": ({"narrowest": np.nan}, "Argument `narrowest` must be 0 or more and finite, but is nan."),
    "a word": ({"narrowest": "thin"}, "Argument `narrowest` must be a number, but is 'thin'"),
    "many": ({"narrowest": [0.1, 0.2]}, "Argument `narrowest` must be a number"),
    "reversed": ({"intensity": (3.0, 2.0)}, "Argument `intensity` must be rising, but is"),
    "a range of NaN": ({"intensity": (1.0, np.nan)}, "Argument `intensity` must be positive"),
}


@pytest.mark.parametrize("given, message", WRONG.values(), ids=WRONG)
def test_wrong_arguments(given, message):
    with pytest.raises(ValueError, match=message):
        rk.critical_amplitudes(rk.Block(0.2, 2.0), rk.SinePulse(1.0, 1.0), **given)
    if "narrowest" in given:
        with pytest.raises(ValueError, match=message):
            rk.studies.critical_durations(rk.Block(0.2, 2.0), rk.SinePulse(1.0, 1.0), **given)
        with pytest.raises(ValueError, match=message):
            critical([1.0], [True]).without_thin(**given)


def test_a_traced_width_is_refused():
    with pytest.raises(ValueError, match="Argument `narrowest` must be a number, but is a traced array"):
        jax.jit(lambda x: critical([1.0, 2.0], TURNS[:2]).without_thin(x).value)(0.1)


def test_a_record_without_shaking_is_refused():
    with pytest.raises(ValueError, match="Argument `motion` must move the ground"):
        rk.critical_amplitudes(rk.Block(0.2, 2.0), rk.Record(np.zeros(9), 0.01))
    with pytest.raises(ValueError, match="Argument `acceleration` must"):
        rk.critical_amplitudes(rk.Block(0.2, 2.0), rk.Record([], 0.01))


# Verdicts that hold and that are open.

STATUS = {  # status, margin, the margin that counts, whether the verdict is open
    "computed": (Status.successful, -0.3, -0.3, False),
    "chaotic, and its verdict holds": (Status.chaotic, -0.3, -0.3, False),
    "in balance": (Status.undecided, 1e-9, 1e-9, False),
    "near balance, for an engine of larger errors": (Status.undecided, -1e-4, -1e-4, False),
    "open, far from balance": (Status.undecided, -0.3, -0.3, True),
    "open, without a margin": (Status.undecided, np.nan, np.nan, True),
    "not computed": (Status.step_budget_exhausted, -0.3, np.nan, False),
    "no number": (Status.not_finite, np.nan, np.nan, False),
}


@pytest.mark.parametrize("status, margin, right, is_open", STATUS.values(), ids=STATUS)
def test_which_margins_count(status, margin, right, is_open):
    found, told = known_margin(jnp.asarray(margin), status)
    np.testing.assert_array_equal(found, right)
    assert bool(told) == is_open


def falling(numbers, hidden, root=0.7123):
    """Margin that falls through zero at `root`, with verdicts open in the stretches `hidden`; there it is wrong."""

    def at(z):
        z = numbers.asarray(z)
        is_open = z < -1
        for low, high in hidden:
            is_open |= (z > low) & (z < high)
        margin = numbers.where(is_open, 0.4, 3 * (root - z))
        return margin, 0 * z - 3.0, (margin < 0).astype(int), is_open

    return at


# Stretches in which the verdict is open, and whether a search from 0 to 1 is complete, and finds the end.
HIDDEN = {
    "none": ([], True, True),
    "about a sampled point": ([(0.7499, 0.7501)], True, True),
    "about the point between two": ([(0.62499, 0.62501)], True, True),
    "within the blur of the end": ([(0.7123, 0.7123 + 1e-11)], True, True),
    "within the bracket of the end": ([(0.71225, 0.7123)], False, None),
    "beside the end, and wide": ([(0.65, 0.7)], False, None),
    "about the least value": ([(-1.0, 1e-6)], False, True),
    "about the largest value": ([(0.9999, 2.0)], False, True),
}


@pytest.mark.parametrize("hidden, complete, finds", HIDDEN.values(), ids=HIDDEN)
def test_an_open_verdict_does_not_count(hidden, complete, finds):
    """A search goes round narrow stretches of open verdicts, and tells wide ones; numpy and traced."""
    grid = np.linspace(0, 1, 5)
    of_lines = falling(np, hidden)
    brackets, told = search.brackets_of(lambda z, index: of_lines(z), grid[None])
    found = search.roots_of(lambda z, index: of_lines(z), brackets)
    assert (told["complete"][0] and found["known"].all()) == complete
    lowest = lowest_ends(falling(jnp, hidden), jnp.asarray(grid), 1)
    assert bool(lowest["complete"]) == complete
    if finds:
        np.testing.assert_allclose(found["z"], [0.7123], atol=1e-10)
        np.testing.assert_allclose(lowest["z"], [0.7123], atol=1e-10)


# The command.


@pytest.fixture
def short(tmp_path):
    path = tmp_path / "short.csv"
    path.write_text(
        "time [s],acceleration [g]\n" + "".join(f"{0.05 * k:.2f},{a!r}\n" for k, a in enumerate(SHORT.samples.tolist()))
    )
    return str(path)


@pytest.fixture
def told(tmp_path, short, capsys):
    """Run the command on the short record; return its status, results and error stream."""

    def run(*words):
        capsys.readouterr()
        status = main(
            ["critical", short, "--model", "linear", "--json", *map(str, words), "--out", str(tmp_path / "out")]
        )
        printed = capsys.readouterr()
        return status, json.loads(printed.out)["results"] if printed.out else {}, printed.err

    return run


def test_the_command(told, tmp_path):
    status, results, errors = told("--range", "0.2", "8")
    block = rk.Block.from_dimensions(0.6, 3.0)
    limits = (1.0, 8 * float(np.abs(SHORT.samples).max()) / float(block.alpha))
    ends = rk.critical_amplitudes(block, SHORT, rk.Linear(), intensity=limits, derivatives=False, progress=False)
    assert status == 0 and not errors and results["complete"] and results["merged"] == 0
    pairs = intervals_of(ends)
    assert len(results["intervals"]) == len(pairs) == results["interval_count"] > 1
    for row, (low, high) in zip(results["intervals"], pairs):
        assert row["from_scale"] == pytest.approx(float(ends.scale[low]), rel=1e-9)
        assert row["from_g"] == pytest.approx(float(ends.value[low]), rel=1e-9)
        assert row["from_impacts"] == int(ends.impacts[low])
        assert (row["to_scale"] is None) == (high is None)
    assert results["lowest_scale"] == results["intervals"][0]["from_scale"]
    header, *rows = (tmp_path / "out" / "critical.csv").read_text().splitlines()
    assert header == "scale,peak_acceleration_g,intensity,overturns_above,impacts,balanced,merged"
    assert len(rows) == int(ends.count)
    assert (tmp_path / "out" / "critical.png").stat().st_size > 5000


def test_the_command_merges(told, tmp_path):
    """A thin interval or gap is listed apart, marked in the table, and merged in the intervals."""
    _, every, _ = told("--range", "0.2", "8")
    edges = [x for row in every["intervals"] for x in (row["from_scale"], row["to_scale"]) if x is not None]
    widths = [high / low - 1 for low, high in itertools.pairwise(edges)]
    narrowest = 1.001 * min(widths)
    status, results, _ = told("--range", "0.2", "8", "--narrowest", narrowest)
    assert status == 0 and results["merged"] == 1 and len(results["thin"]) == 1
    (thin,) = results["thin"]
    assert thin["relative_width"] == pytest.approx(min(widths), rel=1e-9)
    assert thin["from_scale"] == edges[int(np.argmin(widths))]
    assert thin["overturns"] == (int(np.argmin(widths)) % 2 == 0)
    rows = np.loadtxt(tmp_path / "out" / "critical.csv", delimiter=",", skiprows=1)
    assert rows[:, -1].sum() == 2 and len(rows) == len(edges)


def test_the_command_tells_what_lies_beyond_its_range(told):
    _, every, _ = told("--range", "0.2", "8")
    inside = 0.5 * (every["intervals"][0]["from_scale"] + every["intervals"][0]["to_scale"])
    status, results, _ = told("--range", inside, "8")
    assert status == 0 and results["intervals"][0]["from_scale"] is None and results["lowest_scale"] is None
    status, results, _ = told("--range", "0.01", "0.02")  # nothing moves
    assert status == 0 and results["intervals"] == [] and results["lowest_scale"] is None


def test_a_search_that_is_not_complete_is_told(told, monkeypatch):
    monkeypatch.setattr(
        rk, "critical_amplitudes", lambda *_, **__: critical([1.0, 2.0], TURNS[:2], complete=np.array(False))
    )
    status, results, errors = told()
    assert status == 1 and results["complete"] is False and "the search is not complete" in errors


def test_intervals_of_ends():
    assert intervals_of(critical([1.0, 2.0, 3.0], TURNS[:3])) == [(0, 1), (2, None)]
    below = critical([1.0, 2.0, 3.0, np.inf], [False, True, False, False], from_the_least=np.array(True))
    assert intervals_of(below) == [(None, 0), (1, 2)]
    assert intervals_of(critical([], [])) == []
    assert intervals_of(critical([1.0, 2.0, 3.0, 4.0], [True, True, False, False])) == [(0, 2)]  # ends are missing


def test_the_figure():
    ends = critical([1.0, 2.0, 3.0], TURNS[:3])
    axis = rk.plot.critical_scales(ends, between=(0.5, 4.0))
    assert axis.get_xlim() == (0.5, 4.0)
    assert [(patch.get_x(), patch.get_x() + patch.get_width()) for patch in axis.patches] == [(1.0, 2.0), (3.0, 4.0)]
    shown = {line.get_label(): line.get_xdata().tolist() for line in axis.lines}
    assert shown == {"overturns above": [1.0, 3.0], "stands above": [2.0]}
    assert rk.plot.critical_scales(critical([], [])).patches[:] == []
    with pytest.raises(ValueError, match="Argument `between` must be rising"):
        rk.plot.critical_scales(ends, between=(2.0, 1.0))
    with pytest.raises(ValueError, match="Argument `ends` must be of one scene"):
        rk.plot.critical_scales(critical([[1.0]], [[True]]))


@pytest.mark.slow
def test_scales_of_the_built_in_record():
    """Verdicts of a scan agree with the intervals that are left, but within what is thin."""
    block, record = rk.Block.from_dimensions(0.6, 3.0), rk.example_record()
    every = rk.critical_amplitudes(block, record, intensity=(1.5, 1.8), derivatives=False, progress=False)
    assert every.complete and every.count > 10
    found = every.without_thin(1e-3)
    assert 0 < found.count <= 9 and found.count + 2 * found.merged == every.count
    scales = np.linspace(0.97, 1.15, 181)
    overturned, status = jax.vmap(lambda x: (lambda o: (o.overturned, o.status._value))(rk.outcome(block, x * record)))(
        scales
    )
    for edges in (every.scale, found.scale):
        edges = np.asarray(edges)
        right = np.searchsorted(edges, scales) % 2 == 1
        near = np.abs(scales[:, None] / edges - 1).min(axis=1) < 1e-3
        known = (np.asarray(status) == 0) & ~near
        assert known.sum() > 150
        np.testing.assert_array_equal(np.asarray(overturned)[known], right[known])
