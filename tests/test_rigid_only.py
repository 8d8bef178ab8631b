"""Where only rigid blocks are known, a flexible one is refused in one sentence.

In a fresh process: here annotations are checked, and refuse it before.
"""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ASKED = {
    "sensitivity": "rk.studies.sensitivity(column, pulse)",
    "critical amplitudes": "rk.critical_amplitudes(column, pulse)",
    "critical durations": "rk.studies.critical_durations(column, pulse)",
    "fragility": "rk.hazard.simulated_fragility(column, [pulse], [0.1, 0.2])",
    "fragility surface": "rk.hazard.simulated_surface(column, [pulse], [0.1, 0.2], [0.5, 1.0])",
    "random blocks": "rk.blocks.draw_blocks(column, 3, alpha=0.1)",
    "contact forces": "rk.responses.contact_forces(response, column)",
    "phase plane": "rk.plot.phase(response)",
}
SCRIPT = """
import matplotlib
matplotlib.use("Agg")
import jaxrock as rk
column = rk.blocks.FlexibleBlock(5.0, 50.0, 30e9, 2500.0, 0.01, masses=2)
pulse = rk.SinePulse(0.5, 1.6)
response = object.__new__(rk.responses.FlexibleResponse)
for words in {words!r}:
    try:
        eval(words)
        print("no error")
    except Exception as error:
        print(type(error).__name__, error)
"""


@pytest.fixture(scope="module")
def answers():
    script = SCRIPT.format(words=list(ASKED.values()))
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", script], capture_output=True, text=True, cwd=Path(__file__).parents[1]
    )
    assert done.returncode == 0, done.stderr
    return dict(zip(ASKED, done.stdout.splitlines(), strict=True))


@pytest.mark.parametrize("name", ASKED)
def test_flexible_blocks_are_refused(answers, name):
    if "rk.plot" in ASKED[name]:
        assert answers[name].startswith("ValueError Argument `response` must be of a rigid block, but is a Flexible")
    else:
        assert re.match("ValueError Argument `(block|response)` must be a .*, but is a Flexible", answers[name])
