"""What nobody meant: bad arguments for every public name, and damaged files for every reader (see `references`).

Each is right, or refused by name; never an internal error, and never silence. In processes of their own, because the
checks of annotations that tests switch on would speak before the package does.
"""

import json
import subprocess
import sys
from pathlib import Path

import pytest

import jaxrock

ROOT = Path(jaxrock.__file__).parents[1]


def attacked(module: str, *words) -> dict:
    """How many were tried, and what was found."""
    done = subprocess.run(
        [sys.executable, "-m", f"references.{module}", *map(str, words)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=7200,
    )
    assert done.stdout.startswith("{"), done.stderr[-2000:]
    return json.loads(done.stdout)


@pytest.mark.parametrize("count", [60, pytest.param(300, marks=pytest.mark.slow)])
def test_bad_arguments(count):
    """Of what compiles little; every public name is attacked, or stands among those nobody calls with arguments."""
    found = attacked("bad_inputs", count, 1, "cheap")
    assert found["tried"] >= count
    assert not found["found"], json.dumps(found["found"], indent=1)
    assert not found["forgotten"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [101, 102, 103, 104])
def test_many_bad_arguments(seed):
    """Of what compiles much, too. By hand none was found among 5,000 of each of the first two either."""
    found = attacked("bad_inputs", 800, seed)
    assert found["tried"] >= 800
    assert not found["found"], json.dumps(found["found"], indent=1)


def test_damaged_files():
    """Every file cut after every 7th byte and in its last number, written differently, and struck at random."""
    found = attacked("damaged_files", 330, 1, 7)
    assert found["tried"] > 1000
    assert not found["found"], json.dumps(found["found"], indent=1)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [201, 202])
def test_many_damaged_files(seed):
    found = attacked("damaged_files", 3000, seed)
    assert found["tried"] > 4000
    assert not found["found"], json.dumps(found["found"], indent=1)
