"""Samplers of NumPyro and BlackJAX, and our own in their manner, on densities with known moments, and of motions."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.inverse.samplers import rounds_of
from jaxrock.numerics.independence_sampler import independent_proposals

numpyro = pytest.importorskip("numpyro")
blackjax = pytest.importorskip("blackjax")

MEAN, DEVIATION = np.array([1.0, -2.0]), np.array([0.5, 2.0])


def normal(point):
    return -(((point - MEAN) / DEVIATION) ** 2).sum(axis=-1) / 2


def nuts_of_numpyro(density):
    return numpyro.infer.NUTS(potential_fn=lambda point: -density(point))


def nuts(density):
    return blackjax.nuts(density, 0.7, jnp.asarray(DEVIATION) ** 2)


def walk(density):
    return blackjax.rmh(density, lambda key, x: x + 1.5 * jnp.asarray(DEVIATION) * jax.random.normal(key, x.shape))


SAMPLERS = {"NumPyro NUTS": nuts_of_numpyro, "BlackJAX NUTS": nuts, "BlackJAX random walk": walk}


QUICKLY = ("BlackJAX NUTS", "BlackJAX random walk")
rows = [
    pytest.param(make, id=name, marks=() if name in QUICKLY else pytest.mark.slow) for name, make in SAMPLERS.items()
]


@functools.cache
def rounds_from(make, seed):
    """Three of them."""
    return list(itertools.islice(rounds_of(make, normal, np.tile(MEAN + DEVIATION, (8, 1)), seed), 3))


@pytest.mark.parametrize("make", rows)
def test_a_normal_distribution(make):
    rounds = rounds_from(make, 3)
    points = np.concatenate([each.points for each in rounds])
    assert points.shape == (750, 8, 2)
    np.testing.assert_allclose(np.concatenate([each.log_density for each in rounds]), normal(points), rtol=1e-6)
    flat = points.reshape(-1, 2)
    assert (abs(flat.mean(axis=0) - MEAN) < 0.15 * DEVIATION).all()
    np.testing.assert_allclose(flat.std(axis=0), DEVIATION, rtol=0.12)
    assert not np.array_equal(rounds[0].points, rounds[1].points)
    assert sum(each.gradients for each in rounds) >= 6000


def test_seeds():
    one, other = (rounds_from(walk, seed)[0].points for seed in (3, 4))
    assert not np.array_equal(one, other)


@pytest.mark.parametrize("make", [lambda density: 3, lambda density: density])
def test_what_is_no_sampler(make):
    with pytest.raises(ValueError, match="`sampler` must make a kernel of NumPyro or an algorithm of BlackJAX"):
        rounds_of(make, normal, np.zeros((8, 2)), 0)


def test_a_kernel_of_a_model():
    def model():
        numpyro.sample("x", numpyro.distributions.Normal(0, 1))

    with pytest.raises(ValueError, match="must make a kernel with a `potential_fn`"):
        rounds_of(lambda density: numpyro.infer.NUTS(model), normal, np.zeros((8, 2)), 0)


def test_own_chains_in_the_manner_of_blackjax():
    """By keys of JAX: states are values, so that the same step from the same state is the same."""
    sampler = independent_proposals(normal, MEAN - 8 * DEVIATION, MEAN + 8 * DEVIATION)
    key = jax.random.key(4)
    state = begun = sampler.init(MEAN[None], key)
    for number in range(20):
        state, taken = sampler.step(jax.random.fold_in(key, number), state)
    again, _ = sampler.step(jax.random.fold_in(key, 0), begun)
    np.testing.assert_array_equal(again.places, state.places[: len(again.places)])
    assert taken.places.shape == (64, 8, 2) and 0.5 < taken.acceptance_rate <= 1
    np.testing.assert_array_equal(taken.places, state.places[-64:])
    np.testing.assert_allclose(taken.log_density, normal(taken.places))
    flat = state.places[1:].reshape(-1, 2)
    assert (abs(flat.mean(axis=0) - MEAN) < 0.1 * DEVIATION).all()
    np.testing.assert_allclose(flat.std(axis=0), DEVIATION, rtol=0.1)
    anew = sampler.anew(key, state)
    assert anew.steps == 0 and len(anew.drawn.places) == len(state.drawn.places)


ALPHA, P = np.array([0.12, 0.16, 0.20, 0.26]), np.array([3.0, 2.2, 3.6, 2.6])
ROCKS = rk.inverse.Observations(ALPHA, P, ["toppled", "toppled", "survived", "survived"], alpha_sd=0.04 * ALPHA)
UNKNOWNS = {
    "amplitude": rk.inverse.Unknown(0.05, 1.0, prior=(0.3, 0.5)),
    "period": rk.inverse.Unknown(0.3, 1.5, prior=(0.8, 0.3)),
}
QUICK = {"model": rk.Linear(), "engine": rk.Series(order=12), "progress": False}


def moved(key, point):
    return point + 0.8 * jax.random.normal(key, point.shape)


@pytest.mark.slow
def test_motions():
    """Means of own chains, within their errors; densities are those of the samples."""
    estimate = rk.inverse.estimate_motion(ROCKS, rk.SinePulse, UNKNOWNS, 0.2, starts=4, **QUICK)
    own, other = (
        rk.inverse.sample_motion(
            ROCKS, rk.SinePulse, UNKNOWNS, 0.2, estimate=estimate, effective_size=400, steps=8000, sampler=each, **QUICK
        )
        for each in (None, lambda density: blackjax.rmh(density, moved))
    )
    assert other.samples.shape[0] == 8 and other.samples.shape[1] % 250 == 0
    for name in UNKNOWNS:
        error = float(own[name].std()) * np.sqrt(2 / 400)
        assert abs(float(own[name].mean() - other[name].mean())) < 4 * error
    density = rk.inverse.log_density(ROCKS, rk.SinePulse, UNKNOWNS, 0.2, model=QUICK["model"], engine=QUICK["engine"])
    values = {name: other.samples[:, -1, i] for i, name in enumerate(UNKNOWNS)}
    np.testing.assert_allclose(density.objective(density.point(values)), other.log_density[:, -1], atol=1e-8)
    assert bool(other.status != rk.inverse.PosteriorStatus.not_converged)


def posterior():
    """A posterior made by hand."""
    samples = jnp.arange(12.0).reshape(2, 3, 2)
    made = object.__new__(rk.inverse.Posterior)
    for name, value in {
        "names": ("amplitude", "period"),
        "samples": samples,
        "log_density": samples.sum(axis=2),
    }.items():
        object.__setattr__(made, name, value)
    return made


@pytest.mark.filterwarnings("ignore")  # ArviZ tells of its next release
def test_samples_for_arviz():
    arviz = pytest.importorskip("arviz")
    found = posterior().to_arviz()
    np.testing.assert_array_equal(found.posterior["period"].values, np.arange(12.0).reshape(2, 3, 2)[..., 1])
    assert found.sample_stats["lp"].shape == (2, 3)
    assert "amplitude" in arviz.summary(found).index
