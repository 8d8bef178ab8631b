"""Trends: monotonic under a single lobe (Voyagaki et al., conclusion 3), but not under a full cycle."""

import functools

import jax
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.closed_form import single_lobe

SCENES = 1024
CHANGES = {  # of alpha, p, amplitude and restitution
    "smaller": lambda r: (1.0, 1 + r, 1.0, 1.0),
    "slenderer": lambda r: (1 / (1 + r), 1.0, 1.0, 1.0),
    "shaken harder": lambda r: (1.0, 1.0, 1 + r, 1.0),
    "with less restitution": lambda r: (1.0, 1.0, 1.0, 1 / (1 + r)),
}


def drawn(seed):
    """Scenes about the boundary of overturning: alpha, p, restitution, duration, shape; and the amplitude."""
    rng = np.random.default_rng(seed)
    alpha, p = 10 ** rng.uniform(-2, -0.5, SCENES), 10 ** rng.uniform(-0.5, 0.7, SCENES)
    shape, duration = rng.uniform(-1, 1, SCENES) * 10 ** rng.uniform(-1, 1.3, SCENES), rng.uniform(0.1, 6, SCENES) / p
    wall = np.asarray(single_lobe.safety_wall(p * duration, shape))
    return alpha, p, rng.uniform(0.5, 1, SCENES), duration, shape, alpha / wall * 10 ** rng.uniform(-0.3, 0.7, SCENES)


@functools.partial(jax.jit, static_argnums=0)
def overturned(of_lobe, scenes):
    def one(alpha, p, e, duration, shape, amplitude):
        if of_lobe:
            pulse = rk.ExponentialPulse(amplitude, duration, shape)
        else:
            pulse = rk.SinePulse(amplitude, 2 * duration)
        found = rk.outcome(rk.Block(alpha, p, e), pulse, rk.Linear(), engine=rk.Series(order=6))  # compiles sooner
        return found.overturned & (found.status == rk.Status.successful)

    return jax.vmap(one)(*scenes)


def exceptions(of_lobe, change, seed):
    """How many blocks overturn, and how many of these stand after the change."""
    scenes, share = drawn(seed), 10 ** np.random.default_rng(seed).uniform(-4, 0.5, SCENES)
    alpha, p, amplitude, restitution = CHANGES[change](share)
    changed = tuple(x * factor for x, factor in zip(scenes, (alpha, p, restitution, 1.0, 1.0, amplitude)))
    before, after = (np.asarray(overturned(of_lobe, each)) for each in (scenes, changed))
    return before.sum(), np.sum(before & ~after)


@pytest.mark.parametrize("change", CHANGES)
def test_lobes_are_monotonic(change):
    """Conclusion 3: who overturns under a single lobe does so all the more if smaller, slenderer or shaken harder.

    The restitution plays no part: the block is lost before it ever comes back.
    """
    count, spared = exceptions(True, change, 0)
    assert count > SCENES / 3 and spared == 0


@pytest.mark.parametrize("change", CHANGES)
def test_full_cycles_are_not(change):
    """Trends (a), (b) and (c) of the introduction: each has its exceptions under one cycle of a sine."""
    count, spared = exceptions(False, change, 1)
    assert count > SCENES / 8 and spared > 0


def test_the_wall_is_monotonic():
    """It rises with the duration and falls with the shape, all the way; the rectangle's is the highest."""
    duration, shape = (
        x.ravel() for x in np.meshgrid(0.05 * 240 ** np.linspace(0, 1, 40), [-40, -8, -2, -0.3, 0, 0.3, 2, 8, 40])
    )
    both = jax.jit(jax.vmap(jax.value_and_grad(single_lobe.safety_wall, argnums=(0, 1))))
    given = np.concatenate([[duration, shape], [duration, np.full_like(shape, -np.inf)]], axis=1)
    found = jax.device_get(both(*given))
    (wall, by_duration, by_shape), (highest, _, _) = zip(*(np.split(x, 2) for x in jax.tree.leaves(found)))
    assert np.all(by_duration > 0) and np.all(by_shape < 0)
    assert np.all(wall < highest)
