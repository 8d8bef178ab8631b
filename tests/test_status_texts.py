"""Advice of status texts holds: the setting that a text names decides."""

import numpy as np
import pytest

import jaxrock as rk

TIME = np.arange(0.0, 60.0, 0.01)
LONG = rk.Record(0.5 * np.sin(2 * np.pi * TIME / 0.5) + 0.5 * np.sin(2 * np.pi * TIME / 0.37), 0.01)
DECIDED = {"by a higher order": (0.26030150753768844, True), "by nothing": (0.27035175879396983, False)}


def test_no_setting_is_said_to_decide_all():
    text = rk.Status[rk.Status.undecided]
    assert "may decide; where chaotic rocking makes rounding grow as large, no setting of an engine decides." in text


@pytest.mark.slow
@pytest.mark.parametrize("alpha, decided", DECIDED.values(), ids=DECIDED)
def test_settings_that_decide_a_minute_of_rocking(alpha, decided):
    """Truncation of a low order is larger than rounding; where rounding has grown large, no order and tolerance
    decides."""
    block = rk.Block(alpha, 3.0, 0.95)
    for engine in (rk.Series(), rk.Series(tolerance=1e-15)):
        assert rk.outcome(block, LONG, engine=engine).status == rk.Status.undecided
    found = [rk.outcome(block, LONG, engine=rk.Series(order=order)) for order in (16, 30)]
    for each in found:
        assert (each.status == rk.Status.successful) == decided
    if decided:
        np.testing.assert_allclose(found[0].margin, found[1].margin, rtol=1e-3)
