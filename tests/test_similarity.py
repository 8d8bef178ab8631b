"""Scale laws: blocks and motions with equal groups respond alike."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.studies import similarity

TAU = np.linspace(0, 12, 400)


@pytest.mark.parametrize("form", [rk.SinePulse, rk.CosinePulse, lambda a, t: rk.RickerPulse(a, t)])
@pytest.mark.parametrize("amplitude, frequency", [(0.5, 16.0), (0.02, 0.7)])
def test_slender_blocks_collapse(form, amplitude, frequency):
    first = rk.Block(0.1, 2.0, 0.85)
    groups = similarity.groups(first, 0.25, 10.0, kind="slender")
    curves = []
    for block, peak in ((first, 0.25), (similarity.block(groups, amplitude, frequency), amplitude)):
        response = rk.simulate(block, similarity.motion(groups, block, form), rk.Linear(), duration=12 / block.p)
        curves.append(similarity.master_curve(response, similarity.scales(block, peak, "slender"), TAU))
    np.testing.assert_allclose(curves[0], curves[1], atol=1e-13)


def test_rigid_blocks_of_one_slenderness_collapse():
    first, second = rk.Block(0.35, 2.0), rk.Block(0.35, 5.0)
    groups = similarity.groups(first, 0.7, 9.0)
    curves = []
    for block in (first, second):
        pulse = similarity.motion(groups, block, rk.SinePulse)
        assert similarity.groups(block, pulse.amplitude, 2 * jnp.pi / pulse.period).strength == pytest.approx(
            float(groups.strength), rel=1e-15
        )
        response = rk.simulate(block, pulse, duration=12 / block.p)
        curves.append(similarity.master_curve(response, similarity.scales(block, pulse.amplitude), TAU))
    np.testing.assert_allclose(curves[0], curves[1], atol=1e-13)


@jax.jit
@functools.partial(jax.vmap, in_axes=(0, None, None))
def peak_of_sine(alpha, strength, ratio):
    """In both scales."""
    block, amplitude = rk.Block(alpha, 1.0, 0.85), jnp.tan(alpha) / strength
    found = rk.outcome(block, rk.SinePulse(amplitude, 2 * jnp.pi / ratio)).max_rotation
    return [found / similarity.scales(block, amplitude, kind).rotation for kind in ("rigid", "slender")]


@pytest.mark.parametrize("ratio, most", [(8.0, 0.004), (5.0, 0.009), (3.0, 0.019)])
@pytest.mark.parametrize("strength", [0.75, 0.9])
def test_small_rotations_nearly_collapse(ratio, strength, most):
    """D&D equation 6.1: the spread of peaks over slenderness angles of 0.02 to 0.35, restitution 0.85."""
    peaks = peak_of_sine(np.linspace(0.02, 0.35, 8), strength, ratio)
    rigid, slender = (np.ptp(found) / np.mean(found) for found in map(np.asarray, peaks))
    assert rigid < most < 0.04 < slender


def test_conversions_invert():
    block = rk.Block(0.12, 3.0, 0.9)
    groups = similarity.groups(block, 0.3, 7.0, kind="slender")
    back = similarity.block(groups, 0.3, 7.0)
    for name in ("alpha", "p", "restitution"):
        assert float(getattr(back, name)) == pytest.approx(float(getattr(block, name)), rel=1e-15)
    with pytest.raises(ValueError, match="must be of slender blocks"):
        similarity.block(similarity.groups(block, 0.3, 7.0), 0.3, 7.0)
    with pytest.raises(ValueError, match="must be one of 'slender', 'rigid'"):
        similarity.scales(block, kind="stocky")
