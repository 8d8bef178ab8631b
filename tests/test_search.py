"""Searches of an estimate by optimisers of other libraries: the same maxima and intervals; and their traces."""

import functools

import jax
import matplotlib.pyplot as plt
import numpy as np
import pytest

import jaxrock as rk

optax = pytest.importorskip("optax")
optimistix = pytest.importorskip("optimistix")

ALPHA, P = np.array([0.12, 0.16, 0.20, 0.26]), np.array([3.0, 2.2, 3.6, 2.6])
ROCKS = rk.inverse.Observations(ALPHA, P, ["toppled", "toppled", "survived", "survived"], alpha_sd=0.04 * ALPHA)
UNKNOWNS = {"amplitude": rk.inverse.Unknown(0.05, 1.0), "period": rk.inverse.Unknown(0.3, 1.5, prior=(0.8, 0.3))}
QUICK = {"model": rk.Linear(), "engine": rk.Series(order=12), "progress": False}

OPTIMIZERS = {
    "own": lambda: None,
    "optimistix.BFGS": lambda: optimistix.BFGS(rtol=1e-6, atol=1e-6),
    "optimistix.LBFGS": lambda: optimistix.LBFGS(rtol=1e-6, atol=1e-6),
    "optax.adam": lambda: optax.adam(0.1),
    "optax.sgd without extra arguments": lambda: optax.GradientTransformation(*optax.sgd(0.02, momentum=0.8)),
    "optax.lbfgs": lambda: optax.lbfgs(),
}
QUICKLY = ("own", "optimistix.BFGS")
rows = [pytest.param(name, marks=() if name in QUICKLY else pytest.mark.slow) for name in OPTIMIZERS]


@functools.cache
def found(name):
    return rk.inverse.estimate_motion(
        ROCKS, rk.SinePulse, UNKNOWNS, 0.2, starts=4, optimizer=OPTIMIZERS[name](), **QUICK
    )


@pytest.mark.parametrize("name", rows)
def test_maxima_and_intervals(name):
    """Compare maxima and intervals with those of the package's own climbers, whose maximum a grid judges elsewhere."""
    best, other = jax.device_get((found("own"), found(name)))
    assert abs(other.log_likelihood - best.log_likelihood) < 1e-5
    np.testing.assert_allclose(other.values, best.values, rtol=5e-3)
    np.testing.assert_allclose(other.interval, best.interval, rtol=0.03)
    assert str(other.status) == str(best.status) and other.remarks == best.remarks


@pytest.mark.parametrize("name", rows)
def test_traces(name):
    """Values are those of the likelihood where it has been; each ends once, and none rises above the maximum."""
    estimate = jax.device_get(found(name))
    values, heights = np.asarray(estimate.trace.values), np.asarray(estimate.trace.log_likelihood)
    assert values.shape == (*heights.shape, 2) and heights.shape[1] == 4 and len(heights) > 3
    gone = np.isnan(heights)
    assert (np.diff(gone.astype(int), axis=0) >= 0).all() and not gone[0].any()
    np.testing.assert_array_equal(np.isnan(values).any(axis=-1), gone)
    assert np.nanmax(heights) <= estimate.log_likelihood + 1e-9
    assert (np.nanmax(heights, axis=0) > heights[0]).sum() >= 3
    low, high = ([float(getattr(x, end)) for x in UNKNOWNS.values()] for end in ("low", "high"))
    known = values[~gone]
    assert (known >= np.array(low) * (1 - 1e-12)).all() and (known <= np.array(high) * (1 + 1e-12)).all()
    step = len(heights) // 2
    # All four, so that one program serves: those that are gone are where they began.
    there = np.where(gone[step][:, None], values[0], values[step])
    expected = np.where(gone[step], heights[0], heights[step])
    density = rk.inverse.log_density(ROCKS, rk.SinePulse, UNKNOWNS, 0.2, model=QUICK["model"], engine=QUICK["engine"])
    found_there = density.objective(density.point(dict(zip(UNKNOWNS, there.T))))
    np.testing.assert_allclose(found_there, expected, atol=1e-9)


def test_the_picture_of_a_search():
    estimate = found("own")
    axis = rk.plot.search(estimate)
    lines = [line.get_xydata() for line in axis.lines if len(line.get_xydata()) > 1]
    assert len(lines) == 4 and (axis.get_ylabel(), axis.get_xlabel()) == ("amplitude [g]", "period [s]")
    np.testing.assert_allclose(lines[0][0], np.asarray(estimate.trace.values)[0, 0, ::-1])
    assert [text.get_text() for text in axis.get_legend().get_texts()] == ["from a start", "to where it ended"]
    plt.close("all")


@pytest.mark.parametrize("optimizer", [0.1, "adam", dict, np.ones(3)])
def test_what_is_no_optimiser(optimizer):
    with pytest.raises(ValueError, match="`optimizer` must be an optax.GradientTransformation or an optimistix"):
        rk.inverse.estimate_motion(ROCKS, rk.SinePulse, UNKNOWNS, optimizer=optimizer)
