"""Printed form of blocks, motions and results."""

import re

import equinox as eqx
import jax
import numpy as np
import pytest

import jaxrock as rk

RECORD = rk.Record(0.3 * np.sin(np.arange(50)), 0.02, name="made")

SHOWN = {
    "a block": (lambda: rk.Block(0.2, 2.0, 0.9), "Block(alpha=0.2, p=2, law=Constant(value=0.9))"),
    "a pulse, twice as strong": (
        lambda: 2.0 * rk.SinePulse(0.4, 0.6),
        "Scaled(motion=SinePulse(amplitude=0.4, period=0.6), factor=2)",
    ),
    "a record has its name": (lambda: RECORD, "Record(samples=float64[50], dt=0.02, label='made')"),
    "many blocks": (
        lambda: rk.Block(np.linspace(0.1, 0.3, 20), 2.0, 0.9),
        "Block(alpha=float64[20], p=2, law=Constant(value=0.9))",
    ),
    "few": (lambda: rk.Block(np.array([0.1, 0.2]), 2.0, 0.9), "Block(alpha=[0.1, 0.2], p=2, law=Constant(value=0.9))"),
}


@pytest.mark.parametrize("case", SHOWN)
def test_numbers_are_seen(case):
    made, wanted = SHOWN[case]
    assert repr(made()) == wanted


def test_results_are_seen_with_their_status():
    quick = {"model": rk.Linear(), "engine": rk.Series(order=4)}
    told = repr(rk.outcome(rk.Block(0.2, 2.0, 0.9), rk.SinePulse(0.1, 0.6), **quick))
    assert told.startswith("Outcome(\n  max_rotation=0,\n") and told.endswith("  status=Status.successful,\n)")
    many = jax.vmap(lambda a: rk.outcome(rk.Block(0.2, 2.0, 0.9), rk.SinePulse(a, 0.6), **quick))(
        np.linspace(0.1, 0.5, 7)
    )
    assert "margin=float64[7]" in repr(many) and "status=Status[7]" in repr(many)


def test_traced_numbers_are_seen_as_shapes():
    told = []
    jax.jit(lambda alpha: told.append(repr(rk.Block(alpha, 2.0, 0.9))))(0.2)
    assert told == ["Block(alpha=float64[], p=2, law=Constant(value=0.9))"]


PUBLIC = {
    "what a formula is made of": (
        lambda: rk.closed_form.sine_pulse.constants(1.5, 6.0),
        r"Constants\(A0=1\.154\d+, B0=0\.79",
    ),
    "a fragility": (
        lambda: rk.hazard.LogNormalFragility(0.4, 0.3),
        r"\(median=0\.4, dispersion=0\.3, measure=''\)",
    ),
    "a hazard curve": (
        lambda: rk.hazard.HazardCurve([0.1, 0.2], [0.1, 0.01]),
        r"levels=\[0\.1, 0\.2\], rates=\[0\.1, 0\.01\]",
    ),
    "what is to be found": (lambda: rk.inverse.Unknown(0.1, 2.0), r"Unknown\(low=0\.1, high=2"),
    "a suite": (
        lambda: rk.motions.Suite([rk.SinePulse(0.4, 0.6)]),
        r"amplitude=\[0\.4\], period=\[0\.6\]",
    ),
    "groups": (lambda: rk.similarity.groups(rk.Block(0.2, 2.0), 0.4, 5.0), r"frequency_ratio=2\.5"),
    "rocks": (lambda: rk.inverse.Observations([0.1], [2.0], ["fell"]), r"alpha=\[0\.1\]"),
}


@pytest.mark.parametrize("case", PUBLIC)
def test_numbers_of_what_is_public_are_seen(case):
    made, wanted = PUBLIC[case]
    assert re.search(wanted, repr(made()))


def test_nothing_public_that_holds_numbers_shows_their_shapes_alone():
    """Equinox would print `f64[]` for a number. Equations and engines hold settings; densities, functions."""
    settings = rk.models.AbstractEquation, rk.Series, rk.models.Coefficients, rk.models.Terms
    functions = rk.inverse.Likelihood, rk.inverse.LogDensity
    spaces = [rk, rk.studies, rk.motions, rk.blocks, rk.hazard, rk.inverse, rk.similarity, rk.responses, rk.models]
    kinds = {kind for space in spaces for kind in map(space.__dict__.get, dir(space)) if isinstance(kind, type)}
    bare = [k for k in kinds if issubclass(k, eqx.Module) and k.__repr__ is eqx.Module.__repr__]
    assert not [kind for kind in bare if not issubclass(kind, settings + functions)]


def test_results_without_values_can_be_seen():
    """Check that results without values, as `jax.eval_shape` and `eqx.filter` leave them, can be printed."""
    block, motion = rk.Block(0.3, 1.6), rk.SinePulse(0.5, 0.9)
    shapes = jax.eval_shape(lambda: rk.outcome(block, motion))
    assert "status=Status[]" in repr(shapes)
    assert "status=Status.None" in repr(eqx.filter(rk.outcome(block, motion), eqx.is_inexact_array))
