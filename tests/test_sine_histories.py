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
over_scenes = pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)


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
        """Of the first excursion."""
        return self.through(time, self.A0, self.B0, -1)

    def after(self, time):
        """After the impact."""
        forced = self.impact < self.end
        A, B = self.constants(self.impact, 0, self.e * self.at(self.impact)[1], 1, forced)
        return self.through(time, A, B, 1) if forced else self.stage(time, A, B, 1, False)


@over_scenes
def test_printed_equations(scene):
    impact = float(sine_pulse.impact_time(*scene[:2]))
    with mp.workdps(60):
        printed = Printed(*scene, impact if np.isfinite(impact) else None)
        last = float(printed.end) + 4.0
        for time in np.linspace(0.01, last, 12):
            exact = (printed.at if printed.impact is None or time < printed.impact else printed.after)(mp.mpf(time))
            found = [float(f(time, *scene)) for f in (sine_pulse.rotation, sine_pulse.velocity)]
            if not np.isnan(found[0]):
                np.testing.assert_allclose(found, [float(x) for x in exact], rtol=1e-11, atol=1e-13)
            else:
                assert time > printed.impact and printed.after(mp.mpf(time - 1e-3))[0] < 1
        speed = float(sine_pulse.impact_velocity(*scene[:2]))
        assert (
            np.isnan(speed)
            if printed.impact is None
            else speed == pytest.approx(float(printed.at(printed.impact)[1]), rel=1e-13)
        )


@jax.jit
@functools.partial(jax.vmap, in_axes=(0, 0, 0, 0))
def engine(a, w, e, time):
    block = rk.Block(ALPHA, 1.0, e)
    response = rk.simulate(block, rk.SinePulse(ALPHA * a, 2 * jnp.pi / w), rk.Linear(), duration=45.0, samples=2)
    rotation, velocity = response(time)
    return rotation / ALPHA, velocity / ALPHA, response.impact_times[:2], jnp.abs(response.impact_velocities[0]) / ALPHA


def scenes(count, seed):
    rng = np.random.default_rng(seed)
    named = np.array(list(SCENES.values())).T
    ratio = 0.35 * 25 ** rng.uniform(0, 1, count)
    most = np.asarray(sine_pulse.no_impact_limit(ratio))
    drawn = 1 + (1.1 * most - 1) * rng.uniform(0.001, 1, count), ratio, rng.uniform(0, 1, count)
    return (np.concatenate(pair) for pair in zip(named, drawn))


def test_histories_of_the_engine():
    """Random intensities up to and over the limit of overturning, ratios of 0.35 to 9, restitutions of 0 to 1."""
    a, w, e = scenes(119, 5)
    uplift = np.arcsin(1 / a) / w
    end = 2 * np.pi / w - uplift
    time = np.linspace(0, 1, 50) * (end + 3.0)[:, None]
    rotation, velocity, impacts, speed = (np.asarray(x) for x in engine(a, w, e, uplift[:, None] + time))
    impacts = np.where(np.isfinite(impacts), impacts, np.inf) - uplift[:, None]
    found = [np.asarray(f(time, *(x[:, None] for x in (a, w, e)))) for f in (sine_pulse.rotation, sine_pulse.velocity)]
    second = np.where(e > 0, impacts[:, 1], impacts[:, 0])[:, None]  # what takes all is the last
    near = np.abs(time - second) < 1e-7
    np.testing.assert_array_equal(np.isnan(found[0])[~near], (time > second)[~near])
    known = ~np.isnan(found[0]) & (np.abs(found[0]) < 1.5)  # beyond, the engine's block has overturned
    assert known.sum() > 3000 and (known & (time > impacts[:, :1])).sum() > 700
    np.testing.assert_allclose(found[0][known], rotation[known], atol=1e-12)
    np.testing.assert_allclose(found[1][known], velocity[known], atol=1e-12)
    hit = np.isfinite(impacts[:, 0])
    np.testing.assert_allclose(sine_pulse.impact_velocity(a, w)[hit], speed[hit], rtol=1e-10)
    assert np.all(np.isnan(sine_pulse.impact_velocity(a, w)[~hit])) and 10 < (~hit).sum() < 60


@pytest.mark.slow  # fast: `test_sine_gradients` of what it is made of
def test_derivatives():
    """By time the velocity; by intensity, frequency ratio and restitution as central differences, in every stage."""
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
    assert float(sine_pulse.rotation(-1.0, 2.0, 3.0, 0.9)) == 0 == float(sine_pulse.velocity(-1.0, 2.0, 3.0, 0.9))
    with pytest.raises(ValueError, match="Argument `time` must be finite, but is inf"):
        sine_pulse.rotation(np.inf, 2.0, 3.0, 0.9)
    with pytest.raises(ValueError, match="Argument `intensity` must be greater than 1"):
        sine_pulse.impact_velocity(0.9, 3.0)
