"""Output of commands: aligned tables for people or one JSON object for programs, CSV files, figures."""

import contextlib
import csv
import json
import logging
import os
import sys
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np

import jaxrock as rk
from jaxrock._arguments.tables import items_of
from jaxrock.command_line.results import ResultFolder
from jaxrock.status import is_decided


class Entry(NamedTuple):
    """A line of a table: its key in the JSON object, its label for people, a value and its unit.

    `form`: Python's format specification of the value; `shown`: text to print in place of the value.
    """

    key: str
    label: str
    value: Any
    form: str = ""
    unit: str = ""
    shown: str | None = None

    @property
    def text(self) -> str:
        """The value as printed for people; zero has no minus sign."""
        if self.shown is not None:
            return self.shown
        text = format(self.value, self.form)
        is_zero = text.startswith("-") and not text.strip("-0.")
        return format(0.0, self.form) if is_zero else text


class Report:
    """The results of a command, printed at once for people, or at its end for programs.

    `as_json`: print one JSON object to standard output; `quiet`: print nothing there. Failures go to standard error in
    any case.
    """

    def __init__(self, command: str, as_json: bool = False, quiet: bool = False):
        self._speaks = not (as_json or quiet)
        self._as_json, self._status = as_json, 0
        self._unsaid: OSError | None = None
        self.results: dict[str, Any] = {}
        self._told: dict[str, Any] = {"command": command, "version": rk.__version__}
        self._units, self._files = {}, []

    def title(self, words: str) -> None:
        """Set and print the title of the report."""
        self._told["title"] = words
        self.say(words)

    def say(self, words: str) -> None:
        """Print words for people; programs read this information from `results`.

        If printing fails, the command still writes its results, and `finished` raises.
        """
        if self._speaks:
            try:
                print(words, flush=True)
            except OSError as error:
                self._speaks, self._unsaid = False, error

    def table(self, entries: list[Entry]) -> None:
        """Record and print names, values and units."""
        self.results |= {entry.key: plain(entry.value) for entry in entries}
        self._units |= {entry.key: entry.unit for entry in entries if entry.unit}
        widths = [max(len(text) for text in column) for column in zip(*((e.label, e.text) for e in entries))]
        for entry in entries:
            unit = "" if plain(entry.value) is None else entry.unit
            self.say(f"  {entry.label:<{widths[0]}}  {entry.text:>{widths[1]}}  {unit}".rstrip())

    def wrote(self, path: Path) -> None:
        """Record and print that a file was written."""
        self._files.append(str(path))
        self.say(f"wrote {path}")

    def failed(self, reason: str) -> None:
        """Record and print a failure to compute, and set the exit status to 1."""
        self._status = 1
        self._told.setdefault("failures", []).append(reason)
        complain(reason)

    def finished(self) -> int:
        """Return the exit status, after printing the JSON object if requested.

        **Raises:** OSError if an earlier print failed.
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
    """Convert a value to types of JSON; NaN and infinite numbers become null."""
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


def write_table(report: Report, folder: ResultFolder, name: str, header: str, *columns) -> None:
    """Write columns of numbers under a comma-separated header."""
    table = np.column_stack([np.asarray(column, dtype=float) for column in columns])
    with folder.whole(name) as aside:
        np.savetxt(aside, table, delimiter=",", header=header, comments="", fmt="%.12g")
    report.wrote(folder.path / name)


def write_named_table(report: Report, folder: ResultFolder, name: str, header: str, names, *columns) -> None:
    """Write a column of names, and columns of numbers, under a comma-separated header."""
    with folder.whole(name) as aside, aside.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header.split(","))
        for label, *numbers in zip(names, *(np.asarray(column, dtype=float) for column in columns)):
            writer.writerow([label, *(f"{number:.12g}" for number in numbers)])
    report.wrote(folder.path / name)


def save(report: Report, folder: ResultFolder, name: str, figure) -> None:
    """Write a figure."""
    with folder.whole(name) as aside:
        figure.savefig(aside, dpi=150)
    report.wrote(folder.path / name)


def check_surface(report: Report, status: rk.Status) -> None:
    """Report a failure for each kind of scenes of a surface that were not computed."""
    for word in items_of(status):
        kind = getattr(rk.Status, word)
        count = int(np.sum(np.asarray(status == kind)))
        if count and not is_decided(kind):
            report.failed(f"{count} scenes were not computed: {rk.Status[kind]}")


class _Once(logging.Handler):
    """Log handler that prints each message of the package once."""

    def __init__(self):
        super().__init__()
        self._said = set()

    def emit(self, record):
        """Print a message that was not printed before."""
        words = record.getMessage()
        if words not in self._said:
            self._said.add(words)
            complain(words)


@contextlib.contextmanager
def heard(quiet: bool, verbose: bool):
    """Print the package's log to standard error within the context: compilations, and on demand debug messages."""
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
