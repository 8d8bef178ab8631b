"""What commands say and write: aligned tables for people or one JSON object for programs, CSV files, figures."""

import contextlib
import json
import logging
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import jaxrock as rk
from jaxrock._aside import written_aside
from jaxrock._tables import items_of


class Entry(NamedTuple):
    """A line of a table: the name that programs know, the one that people read, a value and its unit.

    `form`: how the value is printed, in Python's language of formats; `shown`: what is printed in its place.
    """

    key: str
    label: str
    value: Any
    form: str = ""
    unit: str = ""
    shown: str | None = None

    @property
    def text(self) -> str:
        """The value as people read it; zero has no minus sign."""
        if self.shown is not None:
            return self.shown
        text = format(self.value, self.form)
        is_zero = text.startswith("-") and not text.strip("-0.")
        return format(0.0, self.form) if is_zero else text


class Report:
    """What a command has found, said at once to people, or at its end to programs.

    `as_json`: one JSON object on the standard output; `quiet`: nothing there. What could not be computed goes to the
    standard error in any case.
    """

    def __init__(self, command: str, as_json: bool = False, quiet: bool = False):
        self._speaks = not (as_json or quiet)
        self._as_json, self._status = as_json, 0
        self.results: dict[str, Any] = {}
        self._told: dict[str, Any] = {"command": command, "version": rk.__version__}
        self._units, self._files = {}, []

    def title(self, words: str) -> None:
        """What it is about."""
        self._told["title"] = words
        self.say(words)

    def say(self, words: str) -> None:
        """Something for people only; programs find the same in `results`."""
        if self._speaks:
            print(words, flush=True)

    def table(self, entries: list[Entry]) -> None:
        """Names, values and units."""
        self.results |= {entry.key: plain(entry.value) for entry in entries}
        self._units |= {entry.key: entry.unit for entry in entries if entry.unit}
        widths = [max(len(text) for text in column) for column in zip(*((e.label, e.text) for e in entries))]
        for entry in entries:
            unit = "" if plain(entry.value) is None else entry.unit
            self.say(f"  {entry.label:<{widths[0]}}  {entry.text:>{widths[1]}}  {unit}".rstrip())

    def wrote(self, path: Path) -> None:
        """A file is there."""
        self._files.append(str(path))
        self.say(f"wrote {path}")

    def failed(self, reason: str) -> None:
        """Something was not computed: the exit status is 1."""
        self._status = 1
        self._told.setdefault("failures", []).append(reason)
        print(f"jaxrock: {reason}", file=sys.stderr)

    def finished(self) -> int:
        """The exit status, after all is said."""
        if self._as_json:
            told = self._told | {"results": self.results, "units": self._units, "files": self._files}
            print(json.dumps(told | {"exit_status": self._status}, indent=2, allow_nan=False))
        return self._status


def plain(value: Any) -> Any:
    """A value as JSON has it; what is no finite number is null."""
    if isinstance(value, dict):
        return {name: plain(each) for name, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(each) for each in value]
    if value is None or isinstance(value, (str, bool, int)):
        return value
    value = np.asarray(value)
    if value.ndim:
        return [plain(each) for each in value]
    return value.item() if value.dtype.kind != "f" else float(value) if np.isfinite(value) else None


def write_csv(report: Report, path: Path, header: str, *columns) -> None:
    """Write columns of numbers, under a header of names with commas between them."""
    table = np.column_stack([np.asarray(column, dtype=float) for column in columns])
    with whole(path) as aside:
        np.savetxt(aside, table, delimiter=",", header=header, comments="", fmt="%.12g")
    report.wrote(path)


def save(report: Report, figure, path: Path) -> None:
    """Write a figure."""
    with whole(path) as aside:
        figure.savefig(aside, dpi=150, format=path.suffix[1:])
    report.wrote(path)


@contextlib.contextmanager
def whole(path: Path) -> Iterator[Path]:
    """Where to write a file that is there whole or not at all; an error says which file it was."""
    try:
        with written_aside(path, replace=True, lasting=False) as aside:
            yield aside
    except OSError as error:
        raise OSError(f"{path} cannot be written: {error.strerror or error}") from error


def check_surface(report: Report, status: rk.Status) -> None:
    """Some scenes of a surface may not have been computed."""
    for word in items_of(status):
        kind = getattr(rk.Status, word)
        count = int(np.sum(np.asarray(status == kind)))
        if count and word != "successful":
            report.failed(f"{count} scenes were not computed: {rk.Status[kind]}")


class _Once(logging.Handler):
    """Prints every message of the package once."""

    def __init__(self):
        super().__init__()
        self._said = set()

    def emit(self, record):
        """Print it, if it is new."""
        words = record.getMessage()
        if words not in self._said:
            self._said.add(words)
            print(f"jaxrock: {words}", file=sys.stderr, flush=True)


@contextlib.contextmanager
def heard(quiet: bool, verbose: bool):
    """Within it the package is heard: that it compiles, and on demand all that it says of itself."""
    logger, handler = logging.getLogger("jaxrock"), _Once()
    before = logger.level
    level = logging.WARNING if quiet else logging.DEBUG if verbose else logging.INFO
    logger.addHandler(handler)
    logger.setLevel(level)
    try:
        yield
    finally:
        logger.setLevel(before)
        logger.removeHandler(handler)
