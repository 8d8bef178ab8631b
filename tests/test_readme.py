"""CI runs the commands that README.md shows, and sees where one of them leaves nothing to look at."""

import importlib.machinery
import importlib.util
import shlex
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

CI = Path(__file__).parents[1] / ".ci"
pytestmark = pytest.mark.skipif(not CI.exists(), reason="needs the folder .ci of the repository")
VERDICT = "  verdict                      stands\n"


@pytest.fixture(scope="module")
def readme():
    """The script of CI, as a module."""
    loader = importlib.machinery.SourceFileLoader("ci_readme", str(CI / "readme"))
    module = importlib.util.module_from_spec(importlib.util.spec_from_loader("ci_readme", loader))
    loader.exec_module(module)
    return module


def test_ci_runs_the_commands_of_the_readme(readme):
    asked = readme.commands()
    assert asked["run"].startswith("python -m pip install") and asked["run"].endswith("jaxrock run")
    assert asked["test"].startswith("python -m pip install") and asked["test"].endswith(
        "python -m pytest -n auto tests"
    )
    assert "python3 .ci/readme" in (CI / "run").read_text()


@pytest.fixture
def place(tmp_path):
    """Return a folder as the first command leaves it, with this Python as the newcomer's."""
    results = tmp_path / "copy" / "results"
    results.mkdir(parents=True)
    (tmp_path / "environment" / "bin").mkdir(parents=True)
    python = tmp_path / "environment" / "bin" / "python"
    python.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} "$@"\n')
    python.chmod(0o755)
    figure, axes = plt.subplots()
    axes.plot([0, 1, 0.5], [1, 0, 2])
    figure.savefig(results / "history.png")
    plt.close(figure)
    (results / "history.csv").write_text("# made\ntime_s,rotation_rad\n0.0,0.1\n0.5,-0.2\n")
    return tmp_path


def test_results_are_looked_at(readme, place):
    readme.look_at_results(place, VERDICT)


def empty_figure(results):
    figure = plt.figure()
    figure.savefig(results / "history.png")
    plt.close(figure)


BROKEN = {
    "an empty figure": (empty_figure, "history.png is empty"),
    "no figure": (lambda results: (results / "history.png").unlink(), "AssertionError"),
    "an empty table": (lambda results: (results / "history.csv").write_text("time_s,rotation_rad\n"), "is empty"),
    "a table of NaN": (lambda results: (results / "history.csv").write_text("time_s,angle\n0,nan\n"), "has NaN"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_what_is_empty_is_seen(readme, place, name, capfd):
    broken, said = BROKEN[name]
    broken(place / "copy" / "results")
    with pytest.raises(readme.subprocess.CalledProcessError):
        readme.look_at_results(place, VERDICT)
    assert said in capfd.readouterr().err


def test_a_verdict_is_asked_for(readme, place):
    with pytest.raises(AssertionError, match="the verdict was not printed"):
        readme.look_at_results(place, "wrote results/history.png\n")
