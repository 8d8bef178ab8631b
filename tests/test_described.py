"""What one sees of blocks, motions and results when they are printed."""

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
    told = repr(rk.outcome(rk.Block(0.2, 2.0, 0.9), rk.SinePulse(0.1, 0.6)))
    assert told.startswith("Outcome(\n  max_rotation=0,\n") and told.endswith("  status=Status.successful,\n)")
    many = jax.vmap(lambda a: rk.outcome(rk.Block(0.2, 2.0, 0.9), rk.SinePulse(a, 0.6)))(np.linspace(0.1, 0.5, 7))
    assert "margin=float64[7]" in repr(many) and "status=Status[7]" in repr(many)


def test_traced_numbers_are_seen_as_shapes():
    told = []
    jax.jit(lambda alpha: told.append(repr(rk.Block(alpha, 2.0, 0.9))))(0.2)
    assert told == ["Block(alpha=float64[], p=2, law=Constant(value=0.9))"]
