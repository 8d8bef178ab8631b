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


def test_every_public_name_is_attacked():
    """Or stands among those that nobody calls with arguments."""
    code = "import references.bad_inputs as bad\n"
    code += "print(sorted(bad.public_names() - bad.NOT_CALLED - {name.split('.')[0] for name in bad.CALLS}))\n"
    code += "print(sorted(bad.NOT_CALLED - bad.public_names()))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.stdout == "[]\n[]\n", done.stdout + done.stderr[-2000:]


@pytest.mark.parametrize("seed", [1])
def test_bad_arguments(seed):
    """Of what compiles little."""
    found = attacked("bad_inputs", 300, seed, "cheap")
    assert found["tried"] >= 300
    assert not found["found"], json.dumps(found["found"], indent=1)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [101, 102, 103, 104])
def test_many_bad_arguments(seed):
    found = attacked("bad_inputs", 5000, seed)
    assert found["tried"] >= 5000
    assert not found["found"], json.dumps(found["found"], indent=1)


def test_damaged_files():
    """Every file cut after every 7th byte and in its last number, written differently, and struck at random."""
    found = attacked("damaged_files", 330, 1, 7)
    assert found["tried"] > 1000
    assert not found["found"], json.dumps(found["found"], indent=1)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [201, 202])
def test_many_damaged_files(seed):
    found = attacked("damaged_files", 11000, seed)
    assert found["tried"] > 14000
    assert not found["found"], json.dumps(found["found"], indent=1)
