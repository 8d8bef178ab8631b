"""The margin where a restoring moment rises before it falls: below 1 once the block uplifts, and zero at the balance.

The judge is the total variation of the moment up to the balance, integrated apart.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

import jaxrock as rk
from jaxrock.models.equation import Angle

BLOCK, RISE, BALANCE = rk.Block(0.2, 2.0, 0.9), 4.0, 0.4
QUIET = rk.RectangularPulse(1e-9, 1e-3)


def equation(rise):
    return rk.models.Equation(
        lambda x, block: 0.1 * (1 + rise * x) * (1 - x / BALANCE), lambda x, block: jnp.ones_like(x)
    )


RISING, FALLING = equation(RISE), equation(0.0)


def variation(x, rise=RISE):
    """Integral of |slope| of the moment from an angle to the balance."""
    slope = lambda y: abs(0.1 * (rise - 1 / BALANCE - 2 * rise * y / BALANCE))
    top = (rise - 1 / BALANCE) * BALANCE / (2 * rise) if rise else 0.0
    return quad(slope, x, BALANCE, points=[max(x, top)])[0]


@pytest.fixture(scope="module")
def released():
    """The margin of the rising moment, released at rest from an angle."""
    return jax.jit(lambda x: rk.outcome(BLOCK, QUIET, RISING, initial=(x, 0.0)).margin)


@pytest.mark.parametrize("x", [1e-4, 0.02, 0.074, 0.076, 0.2, 0.39])
def test_margin_of_a_block_that_is_released(released, x):
    np.testing.assert_allclose(released(x), (variation(x) / variation(0.0)) ** 2, rtol=1e-8)


def test_margin_falls_from_1_to_0_without_a_jump(released):
    angles = np.linspace(1e-6, BALANCE - 1e-6, 80)
    margins = np.array([released(x) for x in angles])
    assert np.all(np.diff(margins) < 0) and margins[0] < 1 and margins[0] > 1 - 1e-5 and 0 < margins[-1] < 1e-9
    assert np.abs(np.diff(margins)).max() < 0.03  # the slope is at most 2.5


def test_slopes(released):
    step = 1e-5
    for x in (0.02, 0.2):
        difference = (released(x + step) - released(x - step)) / (2 * step)
        np.testing.assert_allclose(jax.grad(released)(x), difference, rtol=1e-6)


def test_under_a_pulse_that_just_uplifts():
    """Just below 1 for a pulse just above the threshold, above 1 for one below it."""
    margin = jax.jit(lambda amplitude: rk.outcome(BLOCK, rk.RectangularPulse(amplitude, 0.5), RISING).margin)
    assert 1 < margin(0.0999) < 1.002 and 0.999 < margin(0.1001) < 1


def test_a_moment_that_only_falls_is_measured_by_itself():
    moments = FALLING.moments(BLOCK)
    for x in (0.0, 0.1, 0.5):
        assert moments.fall(Angle.of(jnp.asarray(x))) == moments.restoring(Angle.of(jnp.asarray(x)))
    assert moments.fall_at_rest == moments.restoring_at_rest
    found = rk.outcome(BLOCK, QUIET, FALLING, initial=(0.1, 0.0)).margin
    np.testing.assert_allclose(found, (1 - 0.1 / BALANCE) ** 2, rtol=1e-9)
