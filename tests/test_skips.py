"""A test is skipped only for want of an optional package, which it names; the extra `dev` brings all of them."""

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from references import skipped_tests

ROOT = Path(__file__).parents[1]
# Two slow tests compare with programs that few people have: `heyoka` is large, OpenSees needs libraries of the system.
OF_SLOW_TESTS = {"heyoka", "openseespy"}

REASONS = {
    "a package": ("could not import 'zarr.storage': No module named 'zarr'", None),
    "a package by its word": ("needs zarr: its libraries are missing", None),
    "machine code": ("needs llvmlite", None),
    "a package that is there": ("could not import 'xarray': broken", "Package `xarray` is installed."),
    "a package that no extra asks for": ("could not import 'unheard_of': No module", "must name the optional package"),
    "something else": ("takes long", "must name the optional package"),
    "a folder": ("needs the folder nowhere of the repository", None),
    "a folder that is there": ("needs the folder tests of the repository", "The folder `tests` is there."),
}


@pytest.mark.parametrize("name", REASONS)
def test_reasons(name, monkeypatch):
    """Zarr and llvmlite are missing, all else is installed."""
    monkeypatch.setattr(skipped_tests, "is_missing", lambda package: package in ("zarr", "llvmlite"))
    reason, wanted = REASONS[name]
    found = skipped_tests.complaint(reason)
    assert (found is None) == (wanted is None) and re.search(wanted or "", found or "")


MODULE = """
import pytest

@pytest.mark.skipif(True, reason="takes long")
def test_silent():
    pass

@pytest.mark.skipif(True, reason="needs the folder nowhere")
def test_away():
    pass

@pytest.mark.xfail
def test_expected():
    assert False
"""
CONFTEST = """
from references.skipped_tests import SkippedTests

def pytest_configure(config):
    config.pluginmanager.register(SkippedTests(allowed={allowed}))
"""


@pytest.mark.parametrize("allowed", [True, False], ids=["skips allowed", "none allowed"])
def test_a_skip_without_a_reason_is_a_failure(tmp_path, allowed):
    """Two workers run, one of which skips a whole module."""
    (tmp_path / "conftest.py").write_text(CONFTEST.format(allowed=allowed))
    (tmp_path / "pytest.ini").write_text("[pytest]")
    (tmp_path / "test_tests.py").write_text(MODULE)
    (tmp_path / "test_module.py").write_text("import pytest\npytest.importorskip('an_unheard_of_module')\n")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-n", "2", "."],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert "1 xfailed" in done.stdout and done.returncode == 1
    assert "test_tests.py::test_silent" in done.stdout and "It says: Skipped: takes long" in done.stdout
    assert "test_module.py: A skipped test must name" in done.stdout or not allowed
    assert ("1 skipped" in done.stdout) == allowed
    cached = tmp_path / ".pytest_cache" / "v" / skipped_tests.CACHED
    assert ("test_tests.py::test_away" in cached.read_text()) == allowed


def test_pytest_without_a_cache(tmp_path):
    (tmp_path / "conftest.py").write_text(CONFTEST.format(allowed=True))
    (tmp_path / "pytest.ini").write_text("[pytest]")
    (tmp_path / "test_tests.py").write_text("def test_nothing():\n    pass\n")
    program = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "."]
    surroundings = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(program, cwd=tmp_path, env=surroundings, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0 and "1 passed" in done.stdout, done.stderr


def packages_that_tests_need() -> dict[str, str]:
    """Return every optional package that a test is skipped for, with its file."""
    found = {}
    for path in sorted((ROOT / "tests").glob("test_*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            named = isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "importorskip"
            if named and isinstance(node.args[0], ast.Constant):
                found[skipped_tests.name_of(node.args[0].value.split(".")[0])] = path.name
    return found


def test_dev_brings_every_package_that_tests_need():
    """`skipped_tests` also knows the modules whose names differ from those of packages."""
    needed, brought = packages_that_tests_need(), skipped_tests.packages_of("dev")
    assert len(needed) > 8 and OF_SLOW_TESTS.isdisjoint(brought)
    known = skipped_tests.optional_packages()
    assert {name: file for name, file in needed.items() if name in known and name not in brought} == {}
