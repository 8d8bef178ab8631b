"""Equations of a user's own whose derivatives jump at known angles, beside integrals of mpmath."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

import jaxrock as rk


def test_slopes_across_a_stop():
    """Judge the time of the first impact, and its slopes by stiffness and angle, for a spring touched at an angle.

    The judge is the integral of 1/speed, with the speed by conservation of energy.
    """
    alpha, p, stop, stiffness, start = 0.3, 2.0, 0.06, 1.5, 0.2

    def by_energy(stiffness, stop):
        work = lambda x: mp.cos(alpha - x) + stiffness * max(x - stop, 0) ** 2 / 2
        return mp.quad(lambda x: 1 / mp.sqrt(2 * (work(start) - work(x))), [0, stop, start]) / p

    def falls(stiffness, stop):
        spring = lambda x, block: jnp.sin(block.alpha - x) + stiffness * jnp.where(x > stop, x - stop, 0.0)
        model = rk.models.Equation(spring, bends=stop[None])
        motion = rk.RectangularPulse(0.0, 0.01)
        return rk.simulate(rk.Block(alpha, p), motion, model, initial=(start, 0.0), duration=3.0).impact_times[0]

    with mp.workdps(30):
        exact = [
            by_energy(mp.mpf(stiffness), mp.mpf(stop)),
            *(mp.diff(by_energy, (stiffness, stop), order) for order in ((1, 0), (0, 1))),
        ]
    found = jax.value_and_grad(falls, (0, 1))(stiffness, jnp.asarray(stop))
    np.testing.assert_allclose(jax.tree.leaves(found), [float(x) for x in exact], rtol=3e-7)


@pytest.mark.parametrize(
    "bends, message",
    [
        ([0.2, 0.1], "`bends` must grow from each to the next"),
        ([0.0, 0.1], "`bends` must be positive"),
        (0.1, "`bends` must be a list"),
    ],
)
def test_bends_that_are_refused(bends, message):
    with pytest.raises(ValueError, match=message):
        rk.models.Equation(lambda x, block: jnp.sin(block.alpha - x), bends=bends)
