"""Attacks: bad arguments for every public name, and damaged files for every reader (see `references`).

Each call is right, or refused by name; never an internal error, and never silence. Attacks run in processes of their
own, because the annotation checks that tests switch on would raise before the package does.
"""

import functools
import json
import subprocess
import sys
from pathlib import Path

import pytest

import jaxrock

ROOT = Path(jaxrock.__file__).parents[1]


ATTACKS = """
import importlib, json, sys
for module, *words in json.loads(sys.argv[1]):
    importlib.import_module(f"references.{module}").main(words)
    print(end="\\0", flush=True)
"""
FEW = ("bad_inputs", 60, 1, "cheap"), ("damaged_files", 330, 1, 7)


@functools.cache
def attacked(*attacks: tuple) -> list[dict]:
    """Attacks by one process, each a module of `references` with its words: how many were tried, and what was found."""
    done = subprocess.run(
        [sys.executable, "-c", ATTACKS, json.dumps([[*map(str, each)] for each in attacks])],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=7200,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    *told, _ = done.stdout.split("\0")
    return list(map(json.loads, told))


@pytest.mark.parametrize("count", [60, pytest.param(300, marks=pytest.mark.slow)])
def test_bad_arguments(count):
    """Attack functions that compile little; every public name is attacked or listed as never called with arguments."""
    found, *_ = attacked(*FEW) if count == 60 else attacked(("bad_inputs", count, 1, "cheap"))
    assert found["tried"] >= count
    assert not found["found"], json.dumps(found["found"], indent=1)
    assert not found["forgotten"]


@pytest.mark.slow
def test_many_bad_arguments():
    """Attack functions that compile much, too; 5,000 manual attacks on each of the first two found no fault either."""
    for found in attacked(*(("bad_inputs", 800, seed) for seed in (101, 102, 103, 104))):
        assert found["tried"] >= 800
        assert not found["found"], json.dumps(found["found"], indent=1)


def test_damaged_files():
    """Every file cut after every 7th byte and in its last number, written differently, and struck at random."""
    found = attacked(*FEW)[1]
    assert found["tried"] > 1000
    assert not found["found"], json.dumps(found["found"], indent=1)


@pytest.mark.slow
def test_many_damaged_files():
    for found in attacked(*(("damaged_files", 3000, seed) for seed in (201, 202))):
        assert found["tried"] > 4000
        assert not found["found"], json.dumps(found["found"], indent=1)
