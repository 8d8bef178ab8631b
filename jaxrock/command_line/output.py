"""What commands say and write: aligned tables for people or one JSON object for programs, CSV files, figures."""

import contextlib
import json
import logging
import os
import sys
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np

import jaxrock as rk
from jaxrock._tables import items_of
from jaxrock.command_line.results import ResultFolder


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
        self._unsaid: OSError | None = None
        self.results: dict[str, Any] = {}
        self._told: dict[str, Any] = {"command": command, "version": rk.__version__}
        self._units, self._files = {}, []

    def title(self, words: str) -> None:
        """What it is about."""
        self._told["title"] = words
        self.say(words)

    def say(self, words: str) -> None:
        """Print words for people; programs read the same from `results`.

        Where printing fails, results are written all the same, and `finished` raises.
        """
        if self._speaks:
            try:
                print(words, flush=True)
            except OSError as error:
                self._speaks, self._unsaid = False, error

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
        complain(reason)

    def finished(self) -> int:
        """Return the exit status, after printing what is left.

        **Raises:** OSError where something could not be printed.
        """
        if self._unsaid is not None:
            raise self._unsaid
        if self._as_json:
            told = self._told | {"results": self.results, "units": self._units, "files": self._files}
            print(json.dumps(told | {"exit_status": self._status}, indent=2, allow_nan=False))
        return self._status


def complain(words: str) -> None:
    """Print a message to standard error, if that can be written."""
    try:
        print(f"jaxrock: {words}", file=sys.stderr, flush=True)
    except OSError:
        drop(sys.stderr)


def drop(stream: TextIO) -> None:
    """Discard the buffer of a stream that cannot be written: Python would raise again at exit."""
    try:
        stream.flush()
    except OSError:
        with contextlib.suppress(OSError):  # a stream without a descriptor has nothing to drop
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, stream.fileno())
            os.close(nowhere)


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


def write_csv(report: Report, folder: ResultFolder, name: str, header: str, *columns) -> None:
    """Write columns of numbers under a comma-separated header."""
    table = np.column_stack([np.asarray(column, dtype=float) for column in columns])
    with folder.whole(name) as aside:
        np.savetxt(aside, table, delimiter=",", header=header, comments="", fmt="%.12g")
    report.wrote(folder.path / name)


def save(report: Report, folder: ResultFolder, name: str, figure) -> None:
    """Write a figure."""
    with folder.whole(name) as aside:
        figure.savefig(aside, dpi=150)
    report.wrote(folder.path / name)


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
            complain(words)


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
