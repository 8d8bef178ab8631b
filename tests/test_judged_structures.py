"""Structures of one degree of freedom beside a judge that shares no code: `references.structures`."""

import json

import numpy as np
import pytest

import jaxrock as rk
from references import structures, structures_in_jaxrock as translated

TABLE = json.loads(structures.FILE.read_text())
EXACT = rk.Diffrax(rtol=1e-11)
# Kinds that the series engine solves to 1e-11, and the diffrax engine to 1e-8.
SERIES = ("block", "vertical", "one-sided", "frame", "pinned", "lasting", "tendon", "elastic tie", "damper")
DIFFRAX = ("inerter", "oscillator", "strip", "yielding tie", "breaking tie")
QUICK = {kind: 3 for kind in SERIES} | {kind: 1 for kind in DIFFRAX}  # a mechanism is compiled for each scene
PARTS = [(kind, 0, last) for kind, last in QUICK.items() if kind != "strip"]
PARTS += [pytest.param(kind, last, 20, marks=pytest.mark.slow) for kind, last in QUICK.items()]


def check(scene, engine, rtol, known):
    """Compare an outcome with the judge's; verdicts must be equal."""
    found = rk.outcome(*translated.scene(scene), engine=engine)
    assert found.status == rk.Status.successful
    assert bool(found.overturned) == known["overturned"]
    if known["overturned"]:
        return
    assert float(found.max_rotation) == pytest.approx(known["peak"], rel=rtol, abs=1e-13)
    assert float(found.max_velocity) == pytest.approx(known["max_velocity"], rel=rtol, abs=1e-13)
    assert float(found.time_of_max) == pytest.approx(known["time_of_peak"], abs=1e-9 + 1e2 * rtol)
    # The judge counts down to a speed between those of both counts.
    assert int(found.large_impact_count) <= known["impacts"] <= int(found.impact_count)


@pytest.mark.parametrize("kind, first, last", PARTS)
def test_table(kind, first, last):
    """Peaks, velocities, times, impacts and verdicts are those of an extrapolation in 80 bits."""
    for scene in TABLE[kind][first:last]:
        series = kind in SERIES
        check(scene, rk.Series() if series else EXACT, 1e-11 if series else 1e-8, scene["result"])


@pytest.mark.parametrize("kind", ["frame", "pinned", "inerter", "oscillator", "strip"])
def test_restitution_and_uplift(kind):
    """The law that follows is that of ideal impulses on all bodies, and the block uplifts where it is lifted."""
    for scene in TABLE[kind]:
        block, known = translated.scene(scene)[0], scene["result"]
        assert float(block.restitution) == pytest.approx(known["natural_restitution"], abs=1e-12)
        assert float(np.tan(block.alpha)) == pytest.approx(known["uplift"], rel=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("kind", SERIES + DIFFRAX)
def test_many_scenes(kind):
    """Verdicts of 200 random scenes are the judge's; a tie that may hold a block beyond its balance is refused."""
    refused = 0
    for scene in structures.random_scenes(kind, 200, seed=7):
        try:
            known = structures.solve(scene)
        except ArithmeticError:  # it stands on a second equilibrium
            continue
        found = rk.outcome(*translated.scene(scene))
        if found.status != rk.Status.successful:
            refused += 1
            continue
        assert bool(found.overturned) == known["overturned"]
        if not known["overturned"]:
            assert float(found.max_rotation) == pytest.approx(known["peak"], rel=1e-6, abs=1e-10)
    assert refused <= 10
