"""Critical amplitudes and durations: every end of every overturning interval, against 40-digit bisection."""

import json
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxrock as rk

SCENES = json.loads((Path(__file__).parents[1] / "references" / "critical.json").read_text())["scenes"]
PULSES = {"sine": rk.SinePulse, "exponential": rk.ExponentialPulse, "half sine": rk.HalfSinePulse}


def slow(*row):
    return pytest.param(*row, marks=pytest.mark.slow)


@pytest.mark.parametrize("kind", ["sine", slow("exponential"), slow("half sine")])
def test_all_ends(kind):
    """Housner's block: islands with up to 13 impacts and gaps between them, all at once."""
    scenes = [scene for scene in SCENES if scene["kind"] == kind]
    alpha, p, restitution = np.array([scene["block"] for scene in scenes]).T
    length = np.array([scene["length"] for scene in scenes])
    shape = [np.array([scene["shape"][0] for scene in scenes])] if kind == "exponential" else []
    pulses = PULSES[kind](np.ones_like(length), length, *shape)
    found = rk.critical_amplitudes(rk.Block(alpha, p, restitution), pulses, intensity=(1.001, 12.0))
    assert np.all(found.complete)
    derivatives = 0
    for k, scene in enumerate(scenes):
        ends = scene["ends"]
        assert found.count[k] == len(ends)
        row = [np.asarray(x)[k, : len(ends)] for x in (found.value, found.rising, found.impacts)]
        np.testing.assert_allclose(row[0], [float(end["amplitude"]) for end in ends], rtol=1e-12)
        assert row[1].tolist() == [end["kind"] == "below" for end in ends]
        assert row[2].tolist() == [end["impacts"] for end in ends]
        assert np.all(found.balanced[k, : len(ends)])
        assert np.all(np.isinf(found.value[k, len(ends) :]))
        for slopes, end in zip(found.derivative[k], ends):
            if "gradient" in end:
                exact = np.array([float(c) for c in end["gradient"]])
                np.testing.assert_allclose(slopes[:4], exact, rtol=1e-8, atol=1e-9 * np.abs(exact).max())
                derivatives += 1
    assert found.names[:4] == ("alpha", "p", "restitution", "period" if kind == "sine" else "duration")
    assert derivatives >= 4


@pytest.mark.slow
def test_against_closed_forms():
    """Linear block: the same ends as the arcs in closed form; and a spectrum of least amplitudes in one call."""
    ratio = np.array([0.5, 0.8, 1.0, 2.0, 4.0])
    blocks = rk.Block(np.full(5, 0.1), np.ones(5), np.full(5, 0.9))
    pulses = rk.SinePulse(np.ones(5), 2 * np.pi / ratio)
    found = rk.critical_amplitudes(blocks, pulses, rk.Linear(), intensity=(1.001, 10.0))
    for k, w in enumerate(ratio):
        exact = rk.closed_form.sine_pulse.overturning_intervals(float(w), 0.9, searched_from=1.001)
        ends = np.stack([exact.lower, exact.upper], axis=1).ravel()
        ends = ends[ends < 10.0]
        np.testing.assert_allclose(found.intensity[k, : int(found.count[k])], ends, rtol=1e-10)
        assert float(found.lowest[k]) == pytest.approx(0.1 * ends[0], rel=1e-10)


@pytest.mark.slow
def test_one_scene_and_its_durations():
    """A duration is critical at an amplitude exactly if the amplitude is critical at the duration."""
    block = rk.Block(0.1, 2.0, 0.9)
    amplitudes = rk.critical_amplitudes(block, rk.SinePulse(1.0, 2.5), rk.Linear())
    assert amplitudes.value.shape == (int(amplitudes.count),)
    durations = rk.studies.critical_durations(
        block, rk.SinePulse(amplitudes.value[0], 2.5), rk.Linear(), factor=(0.2, 5.0)
    )
    assert float(np.abs(np.asarray(durations.value) - 2.5).min()) < 1e-10
    at = int(np.abs(np.asarray(durations.value) - 2.5).argmin())
    named = dict(zip(durations.names, np.asarray(durations.derivative[at])))
    assert named["p"] == pytest.approx(-2.5 / 2.0, rel=1e-9)  # only p times the duration counts
    # Along the boundary: d duration/d amplitude is one over d amplitude/d duration.
    across = dict(zip(amplitudes.names, np.asarray(amplitudes.derivative[0])))
    assert named["amplitude"] == pytest.approx(1 / across["period"], rel=1e-8)


def test_arguments_out_of_range():
    with pytest.raises(ValueError, match="Argument `intensity` must be rising"):
        rk.critical_amplitudes(rk.Block(0.2, 2.0), rk.SinePulse(1.0, 1.0), intensity=(3.0, 2.0))
    with pytest.raises(ValueError, match="must be numbers or lists"):
        rk.critical_amplitudes(rk.Block(np.full((2, 2), 0.2), 2.0), rk.SinePulse(1.0, 1.0))


def test_a_motion_too_weak_has_no_ends():
    found = rk.critical_amplitudes(rk.Block(0.2, 2.0, 0.9), rk.SinePulse(1.0, 0.05), rk.Linear(), intensity=(1.0, 1.5))
    assert (
        found.count == 0 and np.isinf(found.lowest) and found.value.shape == (0,) and found.derivative.shape == (0, 4)
    )


def test_a_search_cannot_be_traced():
    with pytest.raises(TypeError, match="give all scenes in one call, and take `derivative`"):
        jax.jit(lambda alpha: rk.critical_amplitudes(rk.Block(alpha, 2.0), rk.SinePulse(0.3, 0.8)).value)(0.2)
