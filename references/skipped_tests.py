"""Every skipped test names what is missing; any other skip is a failure.

`tests/conftest.py` registers this plugin. A test may be skipped for want of a package of `pyproject.toml` that is not
installed (`pytest.importorskip`, or "needs llvmlite"), or of a folder that a source distribution leaves out ("needs the
folder notebooks"). `--no-skips` allows neither. The tests that were skipped are kept in pytest's own cache, under
`CACHED`: an environment that has all packages runs these.
"""

import importlib
import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
CACHED = "jaxrock/skipped"
MODULE_OF = {"openseespy": "openseespy.opensees"}  # what a package is imported by, if not by its name


def name_of(requirement: str) -> str:
    """Return the name of a package, as it is imported: "imageio-ffmpeg>=0.5" is `imageio_ffmpeg`."""
    return re.match(r"[\w.-]+", requirement)[0].replace("-", "_").lower()


def packages_of(extra: str) -> set[str]:
    """Return all packages that an extra of `pyproject.toml` asks for, those of the extras within it included."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    found = set()
    for requirement in extras[extra]:
        within = re.match(r"jaxrock\[(.*)\]", requirement)
        found |= set().union(*map(packages_of, within[1].split(","))) if within else {name_of(requirement)}
    return found


def optional_packages() -> set[str]:
    """Return the packages of all extras."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    return set().union(*map(packages_of, project["optional-dependencies"])) - set(map(name_of, project["dependencies"]))


def is_missing(package: str) -> bool:
    """Return whether a package cannot be imported here."""
    try:
        importlib.import_module(MODULE_OF.get(package, package))
    except Exception:  # a package may also lack libraries of the system, and say so in its own way
        return True
    return False


def package_in(reason: str) -> str | None:
    """Return the package that the reason of a skip names, or None."""
    said = re.search(r"could not import '([\w.]+)'|needs ([\w-]+)", reason)
    if said is None:
        return None
    return name_of((said[1] or said[2]).split(".")[0])


def complaint(reason: str) -> str | None:
    """Return why a skip for this reason is not allowed, or None where it is."""
    folder = re.search(r"needs the folder ([\w.]+)", reason)
    if folder is not None:
        return f"The folder `{folder[1]}` is there." if (ROOT / folder[1]).exists() else None
    package = package_in(reason)
    if package not in optional_packages():
        return "A skipped test must name the optional package that is missing."
    return None if is_missing(package) else f"Package `{package}` is installed."


class SkippedTests:
    """A plugin of pytest; `allowed` says whether any test may be skipped."""

    def __init__(self, allowed: bool):
        self.allowed, self.skipped = allowed, []

    def judge(self, report) -> None:
        """Turn a skip that is not allowed into a failure."""
        if not report.skipped or hasattr(report, "wasxfail"):
            return
        reason = str(report.longrepr[2])
        found = complaint(reason) if self.allowed else "No test may be skipped here."
        if found is not None:
            report.outcome, report.longrepr = "failed", f"{report.nodeid}: {found} It says: {reason}"

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_makereport(self):
        """Judge a test that is skipped while it runs."""
        self.judge((yield).get_result())

    @pytest.hookimpl(hookwrapper=True)
    def pytest_make_collect_report(self):
        """Judge a module that is skipped while it is imported."""
        self.judge((yield).get_result())

    def pytest_runtest_logreport(self, report):
        """Note a test that was skipped."""
        if report.skipped and not hasattr(report, "wasxfail"):
            self.skipped.append(report.nodeid)

    def pytest_collectreport(self, report):
        """Note a module that was skipped."""
        if report.skipped:
            self.skipped.append(report.nodeid)

    def pytest_sessionfinish(self, session):
        """Keep what was skipped; workers of xdist leave that to the process that started them.

        `-p no:cacheprovider` leaves pytest without a cache.
        """
        cache = getattr(session.config, "cache", None)
        if cache is not None and not hasattr(session.config, "workerinput"):
            cache.set(CACHED, sorted(set(self.skipped)))
