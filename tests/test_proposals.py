"""Chains with proposals that learn, on densities that are known in closed form."""

import numpy as np
import pytest

from jaxrock.proposals import Kernels, around, begin, learn

BOX = np.array([-10.0, -10.0]), np.array([10.0, 10.0])


def normal(x, mean, covariance):
    """Log-density of a normal distribution."""
    away = x - mean
    return -np.einsum("ni,ij,nj->n", away, np.linalg.inv(covariance), away) / 2 - np.log(np.linalg.det(covariance)) / 2


def two_normals(x):
    """One part in four in a narrow, slanting one, far from the rest."""
    slanting = normal(x, [-6, 5], [[0.04, 0.035], [0.035, 0.04]])
    return np.logaddexp(np.log(0.25) + slanting, np.log(0.75) + normal(x, [4, -4], np.eye(2)))


def banana(x):
    """Normal across a parabola."""
    return -((x[:, 0] / 3) ** 2) / 2 - ((x[:, 1] - x[:, 0] ** 2 / 4 + 2) / 0.3) ** 2 / 2


def half_normal(x):
    """At the end of the box."""
    return normal(x, [-10, 0], np.diag([4, 0.25]))


def moments(log_density):
    """Mean and standard deviation of both coordinates and of the first one's sign, by a fine grid."""
    axis = np.linspace(-10, 10, 2001)
    x, y = np.meshgrid((axis[1:] + axis[:-1]) / 2, (axis[1:] + axis[:-1]) / 2)
    logarithm = log_density(np.stack([x.ravel(), y.ravel()], axis=1))
    share = np.exp(logarithm - logarithm.max())
    share /= share.sum()
    found = [(np.sum(share * z.ravel()), np.sum(share * z.ravel() ** 2)) for z in (x, y, np.sign(x))]
    return [(mean, np.sqrt(square - mean**2)) for mean, square in found]


@pytest.mark.parametrize("log_density", [two_normals, banana, half_normal])
def test_chains_have_the_moments_of_a_grid(log_density):
    random = np.random.default_rng(3)
    first = around(np.array([[0.0, 0.0]]), 0.05, 0.85, *BOX)
    chains = begin(learn(log_density, first, 512, random), 8, random)
    for _ in range(10):
        chains = chains.follow(log_density, 200, random)
    assert chains.steps == 2000
    places = chains.places[1:]
    np.testing.assert_array_equal(log_density(places.reshape(-1, 2)), chains.log_density[1:].ravel())
    taken = np.mean(np.any(np.diff(places, axis=0) != 0, axis=2))
    assert taken > 0.4
    for values, (mean, sd) in zip((places[..., 0], places[..., 1], np.sign(places[..., 0])), moments(log_density)):
        # Of 16,000 samples one in eight is independent, or more.
        assert abs(values.mean() - mean) < 4 * sd / np.sqrt(2000)
        assert abs(values.std() - sd) < 0.1 * sd + 0.002


def test_kernels_are_a_density_and_draws_have_it():
    roots = np.array([[[0.5, 0.0], [0.4, 0.2]], [[1.0, 0.0], [0.0, 0.3]]])
    kernels = Kernels(np.array([[-3.0, 2.0], [4.0, -1.0]]), roots, 0.2, *BOX)
    axis = np.linspace(-10, 10, 401)
    middle = (axis[1:] + axis[:-1]) / 2
    x, y = np.meshgrid(middle, middle)
    share = np.exp(kernels.log_density(np.stack([x.ravel(), y.ravel()], axis=1))) * 0.05**2
    assert abs(share.sum() - 1) < 2e-3  # tails of t beyond the box
    drawn = kernels.draw(np.random.default_rng(0), 40_000)
    for i, z in enumerate((x, y)):
        for level in (-4.0, -2.5, 0.0, 1.9, 4.0):
            assert abs(np.mean(drawn[:, i] < level) - share[z.ravel() < level].sum() / share.sum()) < 0.01


def test_a_summit_that_was_missed_holds_chains():
    """The even share finds it, and nothing else is as probable: chains that stay there tell."""

    def known(x):
        return normal(x, [0, 0], np.eye(2))

    def all_of_it(x):
        return np.where(np.max(np.abs(x - 8), axis=1) < 2, 20.0, known(x))

    random = np.random.default_rng(0)
    first = around(np.array([[0.0, 0.0]]), 0.05, 0.0001, *BOX)
    chains = begin(learn(known, first, 512, random), 4, random).follow(all_of_it, 4000, random)
    there = np.max(np.abs(chains.places - 8), axis=2) < 2
    assert not there[0].any() and there[-1].all()
