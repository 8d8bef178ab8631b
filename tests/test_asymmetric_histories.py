"""Fits to histories of asymmetric blocks, against free rocking integrated by SciPy."""

import jax
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxrock as rk
from jaxrock.inverse.history_scene import FittedScene
from jaxrock.studies.parameters import declarations, named, rebuilt

TRUTH = {"alpha1": 0.20, "alpha2": 0.32, "p1": 2.5, "restitution1": 0.88, "restitution2": 0.92, "initial": 0.13}
KAPPA = 0.72  # m R1^2/I1
TIME = np.linspace(0.02, 4.0, 200)


def free_rocking():
    """Housner's equation about either corner, an event at each impact; a flat base, R2/R1 = cos(alpha1)/cos(alpha2)."""
    radii = np.cos(TRUTH["alpha1"]) / np.cos(TRUTH["alpha2"])
    p2 = TRUTH["p1"] * np.sqrt(radii / (KAPPA * (radii**2 + 1 / KAPPA - 1)))  # p^2 = g R/(R^2 + k^2)
    alpha, p = (TRUTH["alpha1"], TRUTH["alpha2"]), (TRUTH["p1"], p2)
    restitution = TRUTH["restitution1"], TRUTH["restitution2"]
    rotation, begin, state, side = np.zeros_like(TIME), 0.0, np.array([TRUTH["initial"], 0.0]), 0
    while begin < TIME[-1]:

        def slope(_, y, side=side):
            sign = 1 - 2 * side
            return [y[1], -sign * p[side] ** 2 * np.sin(alpha[side] - sign * y[0])]

        def floor(t, y, side=side, begin=begin):
            return (1 - 2 * side) * y[0] if t > begin + 1e-6 else 1.0

        floor.terminal, floor.direction = True, -1
        arc = solve_ivp(
            slope, (begin, TIME[-1]), state, "DOP853", events=floor, rtol=1e-12, atol=1e-14, dense_output=True
        )
        inside = (TIME >= begin) & (TIME <= arc.t[-1])
        rotation[inside] = arc.sol(TIME[inside])[0]
        begin, state, side = arc.t[-1], np.array([0.0, arc.y[1, -1] * restitution[side]]), 1 - side
        if arc.status == 0:
            break
    return rotation


@pytest.mark.slow
def test_both_sides_are_told():
    size = 1e-4
    data = free_rocking()
    assert data.min() < -0.02 and np.sum(np.diff(np.sign(data)) != 0) >= 5
    data = data + size * np.random.default_rng(0).normal(size=TIME.size)
    guess = rk.blocks.AsymmetricBlock(0.18, 0.35, 2.7, KAPPA, restitution=(0.9, 0.9))
    found = rk.inverse.fit_history(TIME, data, guess, starts=2, spread=0.05)
    assert found.status == rk.inverse.HistoryStatus.successful, found.warnings
    assert found.names == tuple(TRUTH)
    errors = np.sqrt(np.diag(found.covariance))
    assert np.all(np.abs(found.values - list(TRUTH.values())) < 4 * errors)
    assert np.all(errors / found.values < 0.05)
    assert found.scatter == pytest.approx(size, rel=0.2)
    assert isinstance(found.block, rk.blocks.AsymmetricBlock) and float(found.block.alpha1) == found["alpha1"]


def test_names_are_those_of_the_block():
    block = rk.blocks.AsymmetricBlock(0.2, 0.3, 2.5)
    with pytest.raises(ValueError, match="be different names out of alpha1, alpha2, p1"):
        rk.inverse.fit_history(TIME, np.cos(TIME), block, parameters=("alpha", "p"))


@pytest.mark.parametrize(
    "law, names",
    [
        (None, ["restitution"]),
        (rk.restitution.PerSide(0.9, 0.8), ["restitution.first", "restitution.second"]),
        (rk.restitution.SpeedDependent(0.9, 0.8, 0.3), [f"restitution.{x}" for x in ("gentle", "violent", "scale")]),
    ],
)
def test_what_is_fitted_of_itself_are_the_parameters_of_the_law(law, names):
    scene = FittedScene.of(rk.Block(0.2, 2.5, law), None, rk.Housner(), None, None, np.cos(TIME), None)
    assert scene.names == ("alpha", "p", *names, "initial")


def test_one_number_is_the_restitution_of_both_sides():
    """Check one restitution for both sides of an asymmetric block: by name, with its range, and as a fitted value."""
    law, motion = rk.restitution.Constant(0.9), rk.SinePulse(0.4, 0.6)
    block = rk.blocks.AsymmetricBlock(0.2, 0.3, 2.5, restitution=law)
    values = named(block, motion)
    assert values["restitution"] == 0.9 and {"restitution1", "restitution2"}.isdisjoint(values)
    assert declarations(block, motion)["restitution"].range.high == 1
    again, _ = rebuilt(block, motion, values | {"restitution": 0.8})
    assert float(again.restitution1) == float(again.restitution2) == 0.8
    assert jax.tree.structure(again.law) == jax.tree.structure(block.law)
    scene = FittedScene.of(block, None, rk.Housner(), None, None, np.cos(TIME), None)
    assert scene.names == ("alpha1", "alpha2", "p1", "restitution", "initial")
