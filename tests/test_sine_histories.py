"""Histories under one sine in closed form: against the printed formulas in 60 digits, the engine, and derivatives."""

import functools

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.closed_form import sine_pulse

ALPHA = 0.1  # plays no part in the linear model, whose results are over alpha
SCENES = {  # intensity, frequency ratio, restitution
    "overturns without impact (2)": (10.0, 3.0, 0.8),
    "overturns after an impact during the pulse (1.1)": (2.5, 3.0, 0.85),
    "overturns after an impact after the pulse (1.2)": (3.2, 3.0, 0.9),
    "safe, impact during the pulse": (1.5, 3.0, 0.7),
    "safe, impact after the pulse": (3.2, 3.0, 0.7),
    "slow pulse, one bounce": (1.0863, 0.5, 0.8),
    "slow pulse, endless bounces": (1.05, 0.5, 0.7),
    "an impact that takes all": (2.0, 2.0, 0.0),
    "fast pulse": (3.0, 40.0, 0.9),
}
LANES = 128  # of which arrays are: XLA compiles every shape anew


class Printed:
    """D&D 3.4, 3.5, 3.7, 3.13, 3.21, 3.22, as they stand, stage by stage of figure 2."""

    def __init__(self, a, w, e, near):
        self.a, self.w, self.e = mp.mpf(a), mp.mpf(w), mp.mpf(e)
        a, w = self.a, self.w
        self.psi, self.C = mp.asin(1 / a), a / (w**2 + 1)
        self.end = (2 * mp.pi - self.psi) / w
        slope = mp.sqrt(a**2 - 1)
        self.A0, self.B0 = ((w**2 + s * w * slope) / (w**2 + 1) / 2 for s in (1, -1))  # 3.7, over alpha
        self.impact = None if near is None else mp.findroot(lambda t: self.at(t)[0], mp.mpf(near))  # 3.21, 3.12

    def constants(self, time, rotation, velocity, side, forced):
        """A e^-t and B e^t of a stage that begins with a rotation and a velocity."""
        sine = self.C * mp.sin(self.w * time + self.psi) if forced else 0
        cosine = self.C * self.w * mp.cos(self.w * time + self.psi) if forced else 0
        left, slope = rotation - side - sine, velocity - cosine
        return (left - slope) / 2 * mp.exp(time), (left + slope) / 2 * mp.exp(-time)

    def stage(self, time, A, B, side, forced):
        """3.4 and 3.5."""
        rotation = side + A * mp.exp(-time) + B * mp.exp(time)
        velocity = B * mp.exp(time) - A * mp.exp(-time)
        if forced:
            rotation += self.C * mp.sin(self.w * time + self.psi)
            velocity += self.C * self.w * mp.cos(self.w * time + self.psi)
        return rotation, velocity

    def through(self, time, A, B, side):
        """From a forced stage, over the end of the pulse."""
        if time <= self.end:
            return self.stage(time, A, B, side, True)
        free = self.constants(self.end, *self.stage(self.end, A, B, side, True), side, False)
        return self.stage(time, *free, side, False)

    def at(self, time):
        """Return rotation and velocity of the first excursion at a time."""
        return self.through(time, self.A0, self.B0, -1)

    def after(self, time):
        """Return rotation and velocity after the impact."""
        forced = self.impact < self.end
        A, B = self.constants(self.impact, 0, self.e * self.at(self.impact)[1], 1, forced)
        return self.through(time, A, B, 1) if forced else self.stage(time, A, B, 1, False)


def histories(time, a, w, e):
    """Rotation and velocity in closed form, of 1-d arrays of at most `LANES`."""
    given = [np.resize(x, LANES) for x in (time, a, w, e)]
    return [np.asarray(f(*given))[: len(time)] for f in (sine_pulse.rotation, sine_pulse.velocity)]


def first_impacts(a, w):
    """Times and velocities of the first impact of scenes, at most `LANES`."""
    given = [np.resize(x, LANES) for x in (a, w)]
    return [np.asarray(f(*given))[: len(a)] for f in (sine_pulse.impact_time, sine_pulse.impact_velocity)]


@functools.cache
def of_scenes():
    """Return histories of each named scene in closed form.

    These are twelve times, rotation and velocity then, its first impact, and how fast.
    """
    a, w, e = np.array(list(SCENES.values())).T
    end = (2 * np.pi - np.arcsin(1 / a)) / w
    time = np.linspace(0.01, end + 4.0, 12, axis=1)
    found = histories(time.ravel(), *(np.repeat(x, 12) for x in (a, w, e)))
    rows = zip(time, *(x.reshape(9, 12) for x in found), *first_impacts(a, w))
    return dict(zip(SCENES, rows))


@pytest.mark.parametrize("name", SCENES)
def test_printed_equations(name):
    times, rotation, velocity, impact, speed = of_scenes()[name]
    with mp.workdps(60):
        printed = Printed(*SCENES[name], impact if np.isfinite(impact) else None)
        for time, *found in zip(times, rotation, velocity):
            exact = (printed.at if printed.impact is None or time < printed.impact else printed.after)(mp.mpf(time))
            if not np.isnan(found[0]):
                np.testing.assert_allclose(found, [float(x) for x in exact], rtol=1e-11, atol=1e-13)
            else:
                assert time > printed.impact and printed.after(mp.mpf(time - 1e-3))[0] < 1
        assert (
            np.isnan(speed)
            if printed.impact is None
            else speed == pytest.approx(float(printed.at(printed.impact)[1]), rel=1e-13)
        )


@jax.jit
def engine(a, w, e, time):
    """Rotation and velocity at these times, the first two impacts and the speed of the first: of one scene."""
    block = rk.Block(ALPHA, 1.0, e)
    response = rk.simulate(block, rk.SinePulse(ALPHA * a, 2 * np.pi / w), rk.Linear(), duration=25.0, samples=2)
    rotation, velocity = (x / ALPHA for x in response(time))
    return rotation, velocity, response.impact_times[:2], jnp.abs(response.impact_velocities[0]) / ALPHA


def scenes(count, seed):
    rng = np.random.default_rng(seed)
    named = np.array(list(SCENES.values())).T
    ratio = 0.35 * 25 ** rng.uniform(0, 1, count)
    most = np.array([float(sine_pulse.no_impact_limit(float(w))) for w in ratio])
    drawn = 1 + (1.1 * most - 1) * rng.uniform(0.001, 1, count), ratio, rng.uniform(0, 1, count)
    return (np.concatenate(pair) for pair in zip(named, drawn))


def test_histories_of_the_engine():
    """Random intensities up to and over the limit of overturning, ratios of 0.35 to 9, restitutions of 0 to 1."""
    a, w, e = scenes(LANES - len(SCENES), 5)
    uplift = np.arcsin(1 / a) / w
    end = 2 * np.pi / w - uplift
    time = np.linspace(0, 1, 50) * (end + 3.0)[:, None]
    found = [engine(*scene) for scene in zip(a, w, e, uplift[:, None] + time)]
    rotation, velocity, impacts, speed = (np.array(x) for x in zip(*found))
    impacts -= uplift[:, None]
    found = np.stack([histories(each, a, w, e) for each in time.T], axis=-1)
    second = np.where(e > 0, impacts[:, 1], impacts[:, 0])[:, None]  # what takes all is the last
    near = np.abs(time - second) < 1e-7
    np.testing.assert_array_equal(np.isnan(found[0])[~near], (time > second)[~near])
    known = ~np.isnan(found[0]) & (np.abs(found[0]) < 1.5)  # beyond, the engine's block has overturned
    assert known.sum() > 3000 and (known & (time > impacts[:, :1])).sum() > 700
    np.testing.assert_allclose(found[0][known], rotation[known], atol=1e-12)
    np.testing.assert_allclose(found[1][known], velocity[known], atol=1e-12)
    hit = np.isfinite(impacts[:, 0])
    _, exact = first_impacts(a, w)
    np.testing.assert_allclose(exact[hit], speed[hit], rtol=1e-10)
    assert np.all(np.isnan(exact[~hit])) and 10 < (~hit).sum() < 60


@pytest.mark.slow  # fast: `test_sine_gradients` of what it is made of
def test_derivatives():
    """Compare slopes in all stages: by time with the velocity; by intensity, ratio and restitution with differences."""
    x = np.array(
        [
            (early, *scene)
            for scene in SCENES.values()
            for early in np.linspace(0.1, float(sine_pulse.constants(*scene[:2]).end) + 2.0, 9)
        ]
    )
    x[:, 3] = np.maximum(x[:, 3], 0.01)
    slopes = jax.vmap(jax.grad(lambda x: sine_pulse.rotation(*x)))(x)
    steps = 1e-5 * np.eye(4)[1:, None]
    upper, lower = (np.asarray(sine_pulse.rotation(*np.moveaxis(x + side * steps, -1, 0))) for side in (1, -1))
    near = np.isnan(upper + lower).any(0)
    assert (~near).sum() > 60
    np.testing.assert_allclose(slopes[~near, 0], sine_pulse.velocity(*x[~near].T), rtol=1e-11, atol=1e-12)
    size = 1 + np.abs(sine_pulse.rotation(*x[~near].T)) * 10
    assert np.max(np.abs(slopes[~near, 1:].T - ((upper - lower) / 2e-5)[:, ~near]) / size) < 1e-5


def test_before_the_uplift_and_bad_times():
    assert histories([-1.0], 2.0, 3.0, 0.9) == [0, 0]
    with pytest.raises(ValueError, match="Argument `time` must be finite, but is inf"):
        sine_pulse.rotation(np.inf, 2.0, 3.0, 0.9)
    with pytest.raises(ValueError, match="Argument `intensity` must be greater than 1"):
        sine_pulse.impact_velocity(0.9, 3.0)
