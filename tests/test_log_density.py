"""The log-density for other libraries: its derivatives, its coordinates, and every recipe of `docs/inverse.md`."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk

BLOCKS = re.findall(r"```python\n(.*?)```", (Path(__file__).parents[1] / "docs" / "inverse.md").read_text(), re.S)
OPTIMISERS = {"optax.adam": 1, "optax.lbfgs": 2, "optimistix.BFGS": 3, "SciPy": 5}
OF_RESIDUALS = 4
SAMPLERS = {"NumPyro": 6, "AutoLaplace": 7, "BlackJAX": 8, "tempered": 9}


@pytest.fixture(scope="module")
def names():
    """Names that the first recipe defines."""
    known = {}
    exec(BLOCKS[0], known)
    return known


@pytest.fixture(scope="module")
def density(names):
    return names["density"]


@pytest.fixture(scope="module")
def grid(density):
    """Densities on a fine grid of the ranges' shares, and the values there."""
    share = (np.arange(50) + 0.5) / 50
    point = np.stack(np.meshgrid(*[np.log(share / (1 - share))] * 2, indexing="ij"), -1).reshape(-1, 2)
    found = np.concatenate([density.objective(part) for part in np.split(point, 5)])
    return density.values(point), found


def test_the_objective_is_that_of_the_likelihood(names, density):
    values = {"amplitude": np.array([0.2, 0.4]), "period": np.array([0.5, 1.1])}
    likelihood = rk.inverse.Likelihood(names["rocks"], rk.SinePulse, 0.2)
    prior = sum(-((np.log(values[k] / m) / s) ** 2) / 2 for k, m, s in (("amplitude", 0.3, 0.4), ("period", 0.8, 0.4)))
    found = density.objective(density.point(values))
    terms = np.asarray(likelihood.log_terms(values))
    np.testing.assert_allclose(found, terms.sum(axis=-1) + prior, rtol=1e-12)


def test_no_points_have_no_densities(density):
    for points in (np.zeros((0, 2)), np.zeros((3, 0, 2))):
        assert density(points).shape == density.objective(points).shape == points.shape[:-1]


def test_points_and_values_are_each_others_inverse(density):
    points = density.starts(8)
    values = jax.device_get(density.values(points))
    np.testing.assert_allclose(density.point(values), points, atol=1e-12)
    for name, (low, high) in {"amplitude": (0.05, 2.0), "period": (0.2, 3.0)}.items():
        value = values[name]
        assert (value > low).all() and (value < high).all()


def test_the_volume_is_that_of_the_coordinates(density):
    """A flat density over the ranges' logarithms would have this density over points."""
    point = np.array([[-3.0, 0.5], [1.0, 2.0]])
    share = 1 / (1 + np.exp(-point))
    expected = np.log(share * (1 - share)).sum(axis=-1)
    found, objective = np.asarray(density(point)), np.asarray(density.objective(point))
    np.testing.assert_allclose(found - objective, expected, rtol=1e-12)


def test_slopes(density):
    """Beside differences of values."""
    point = np.array([-0.2, 0.3])
    above, below = (np.asarray(density(point + side * 1e-6 * np.eye(2))) for side in (1, -1))
    np.testing.assert_allclose(jax.jit(jax.grad(density))(point), (above - below) / 2e-6, rtol=1e-6, atol=1e-7)


@pytest.mark.slow
def test_second_derivatives(density):
    """Beside differences of slopes."""
    point, slope = jnp.array([-0.2, 0.3]), jax.jit(jax.grad(density))
    second = jax.jit(jax.hessian(density))(point)
    by_slopes = [(slope(point + 1e-6 * e) - slope(point - 1e-6 * e)) / 2e-6 for e in np.eye(2)]
    assert np.abs(second).min() > 1e-3
    np.testing.assert_allclose(second, by_slopes, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(second, second.T, rtol=1e-10)


def test_a_motion_that_cannot_be_is_impossible():
    rocks = rk.inverse.Observations([0.2], [2.0], ["survived"])
    density = rk.inverse.log_density(
        rocks, rk.SinePulse, {"period": rk.inverse.Unknown(-1.0, 1.0, log=False)} | AMPLITUDE
    )
    assert density(density.point({"period": -0.5, "amplitude": 0.3})) == -jnp.inf


AMPLITUDE = {"amplitude": rk.inverse.Unknown(0.1, 1.0)}


@pytest.mark.parametrize("words, point", [("`point` must end with an axis of 2", [1.0, 2.0, 3.0])])
def test_what_is_refused(density, words, point):
    with pytest.raises(ValueError, match=words):
        density(jnp.array(point))


def run(recipe, names):
    pytest.importorskip(re.search(r"(?:import|from) (\w+)", BLOCKS[recipe])[1])  # an extra
    known = dict(names)
    exec(BLOCKS[recipe], known)
    return known


@pytest.mark.slow
def test_residuals(names):
    """Levenberg and Marquardt come back to the block that was measured."""
    np.testing.assert_allclose(run(OF_RESIDUALS, names)["best"], [0.2, 2.5, 0.9], rtol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("recipe", OPTIMISERS)
def test_optimisers(recipe, names, density, grid):
    """They find a maximum that is as high as the highest of a fine grid."""
    best = run(OPTIMISERS[recipe], names)["best"]
    assert density.objective(best) > grid[1].max() - 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("recipe", SAMPLERS)
def test_samplers(recipe, names, grid):
    """Means and standard deviations of logarithms are those of a grid (of a normal at the maximum, about)."""
    samples, (values, found) = run(SAMPLERS[recipe], names)["samples"], grid
    weight = np.exp(found - found.max())
    weight /= weight.sum()
    for name in ("amplitude", "period"):
        logarithm = np.log(values[name])
        mean = weight @ logarithm
        deviation = np.sqrt(weight @ (logarithm - mean) ** 2)
        off = (np.log(samples[name]).mean() - mean) / deviation
        assert abs(off) < (0.6 if recipe == "AutoLaplace" else 0.2), name
        assert 0.7 < np.log(samples[name]).std() / deviation < 1.3, name


def test_recipes_are_short():
    assert len(BLOCKS) == 2 + len(OPTIMISERS) + len(SAMPLERS)
    for block in BLOCKS[1:]:
        assert sum(bool(line.strip()) for line in block.splitlines()) <= 15
