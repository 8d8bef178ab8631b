"""Chains with proposals that learn, on densities whose moments are known from grids or in closed form."""

import numpy as np
import pytest

from jaxrock.numerics.independence_sampler import Kernels, around, begin, learn

BOX = np.array([-10.0, -10.0]), np.array([10.0, 10.0])


def normal(x, mean, covariance):
    """Log-density of a normal distribution."""
    away = x - mean
    return -np.sum(away @ np.linalg.inv(covariance) * away, axis=1) / 2 - np.log(np.linalg.det(covariance)) / 2


def two_normals(x):
    """One part in four in a narrow, slanting one, far from the rest."""
    slanting = normal(x, [-6, 5], [[0.4, 0.35], [0.35, 0.4]])
    return np.logaddexp(np.log(0.25) + slanting, np.log(0.75) + normal(x, [4, -4], np.eye(2)))


def banana(x):
    """Normal across a parabola."""
    return -((x[:, 0] / 3) ** 2) / 2 - ((x[:, 1] - x[:, 0] ** 2 / 4 + 2) / 0.3) ** 2 / 2


def half_normal(x):
    """At the end of the box."""
    return normal(x, [-10, 0], np.diag([4, 0.25]))


def moments(log_density):
    """Mean and standard deviation of both coordinates and of the first one's sign, by a fine grid."""
    axis = np.linspace(-10, 10, 1001)
    x, y = np.meshgrid((axis[1:] + axis[:-1]) / 2, (axis[1:] + axis[:-1]) / 2)
    logarithm = log_density(np.stack([x.ravel(), y.ravel()], axis=1))
    share = np.exp(logarithm - logarithm.max())
    share /= share.sum()
    found = [(np.sum(share * z.ravel()), np.sum(share * z.ravel() ** 2)) for z in (x, y, np.sign(x))]
    return [(mean, np.sqrt(square - mean**2)) for mean, square in found]


@pytest.mark.parametrize("log_density", [two_normals, banana, half_normal])
def test_chains_have_the_moments_of_a_grid(log_density):
    random = np.random.default_rng(0)
    first = around(np.array([[0.0, 0.0]]), 0.05, 0.85, *BOX)
    # The first chains meet what the first points may have missed.
    early = begin(learn(log_density, first, 512, random), 8, random).follow(log_density, 1000, random)
    chains = begin(early.drawn, 8, random)
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
    kernels = Kernels(np.array([[-3.0, 2.0], [4.0, -1.0]]), roots, np.array([0.3, 0.5]), 0.2, *BOX)
    axis = np.linspace(-10, 10, 401)
    middle = (axis[1:] + axis[:-1]) / 2
    x, y = np.meshgrid(middle, middle)
    share = np.exp(kernels.log_density(np.stack([x.ravel(), y.ravel()], axis=1))) * 0.05**2
    assert abs(share.sum() - 1) < 2e-3  # tails of t beyond the box
    drawn = kernels.draw(np.random.default_rng(0), 40_000)
    for i, z in enumerate((x, y)):
        for level in (-4.0, -2.5, 0.0, 1.9, 4.0):
            assert abs(np.mean(drawn[:, i] < level) - share[z.ravel() < level].sum() / share.sum()) < 0.01


@pytest.mark.parametrize(
    "size, width, middle",
    [(2, 0.001, 0.4), (3, 0.005, 0.4), (5, 0.01, 0.4), (3, 0.005, 0.0), (5, 0.02, 1.0)],
    ids=["2-D, 1/1000", "3-D, 1/200", "5-D, 1/100", "3-D, in a corner, 1/200", "5-D, in a corner, 1/50"],
)
def test_narrow_summits_are_learned(size, width, middle):
    """Check a known summit many times narrower than the box; few or none of the first points are on its slopes."""

    def log_density(x):
        return -np.sum(((x - middle) / width) ** 2, axis=1) / 2

    random = np.random.default_rng(1)
    first = around(np.full((1, size), middle), 0.05, 0.85, np.zeros(size), np.ones(size))
    drawn = learn(log_density, first, 512, random)
    chains = begin(drawn, 8, random).follow(log_density, 500, random)
    taken = np.mean(np.any(np.diff(chains.places, axis=0) != 0, axis=2))
    assert taken > 0.4 and len(drawn.rounds) < 9
    away = np.abs(chains.places[1:] - middle) / width
    # One in eight of 4,000 samples or more is independent; distances are alike for half a normal distribution.
    np.testing.assert_allclose(away.mean(axis=(0, 1)), np.sqrt(2 / np.pi), atol=4 * 0.6 / np.sqrt(500))
    # What all points together say of the integral: weights are densities, and not only in proportion.
    half = 0.5 if middle in (0.0, 1.0) else 1.0
    integral = np.exp(drawn.log_weights).sum()
    assert abs(integral / (np.sqrt(2 * np.pi) * width * half) ** size - 1) < 0.3


def test_nowhere_to_begin():
    first = around(np.array([[0.0, 0.0]]), 0.05, 0.85, *BOX)
    with pytest.raises(ValueError, match="No place was found"):
        learn(lambda x: np.full(len(x), -np.inf), first, 64, np.random.default_rng(0))


def test_a_summit_that_was_missed_holds_chains():
    """The even share meets it, because it is wide, and nothing else is as probable: chains stay there."""

    def known(x):
        return normal(x, [0, 0], np.eye(2))

    def all_of_it(x):
        return np.where(np.max(np.abs(x - 8), axis=1) < 2, 20.0, known(x))

    random = np.random.default_rng(0)
    first = around(np.array([[0.0, 0.0]]), 0.05, 0.0001, *BOX)
    chains = begin(learn(known, first, 512, random), 4, random).follow(all_of_it, 4000, random)
    there = np.max(np.abs(chains.places - 8), axis=2) < 2
    assert not there[0].any() and there[-1].all()
