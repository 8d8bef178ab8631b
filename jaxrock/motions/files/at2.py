"""AT2, the format of the database of PEER: a header with NPTS and DT, then samples."""

import re

from jaxrock._text import check_end, file_error
from jaxrock.motions.files.format import AbstractFormat, Accelerogram
from jaxrock.motions.files.parsing import (
    NUMBER,
    agreed_step,
    agreed_unit,
    announced_samples,
    no_column,
    plain_numbers,
    to_float,
)
from jaxrock.motions.files.titles import SECONDS
from jaxrock.motions.record import Origin

_UNIT = re.compile(r"\bUNITS\s*(?:OF|IN|[:=])?\s*\(?\s*([^\s,;()]+)", re.IGNORECASE)
_COUNT = re.compile(r"(?<![A-Z])NPTS\s*=?\s*(\d+)", re.IGNORECASE)
_STEP = re.compile(rf"(?<![A-Z])DT\s*=?\s*({NUMBER})\s*([A-Zµμ]*)", re.IGNORECASE)
_BEFORE = re.compile(rf"^\s*(\d+)[\s,]+({NUMBER})[\s,]+NPTS[\s,]+DT\b", re.IGNORECASE)

_MANY = 50  # lines that tell how numbers are printed

# Printed numbers may touch, but only a sign tells where the next begins: 1.234562.34567 is refused.
_NUMBERS = re.compile(rf"\s*{NUMBER}(?:(?:\s+|(?=[-+])){NUMBER})*\s*")


class AT2(AbstractFormat):
    """PEER AT2."""

    name = "at2"
    suffixes = (".at2",)

    def recognises(self, lines):
        return any(_counts(line) for line in lines if not line.lstrip().startswith("#"))

    def read(self, name, lines, dt, unit, column):
        no_column(name, column, "AT2")
        last = next((number for number, line in enumerate(lines) if _counts(line)), None)
        if last is None:
            raise file_error(name, "no header line states NPTS and DT, as an AT2 file must.")
        count, step = _counts(lines[last])
        steps = _steps(lines[last])
        if len(set(steps)) > 1:
            raise file_error(name, f"line {last + 1} states time steps of {steps[0]:g} and {steps[1]:g} s.")
        again = [number for number in range(last + 1, len(lines)) if "NPTS" in lines[number].upper()]
        if again:
            raise file_error(name, f"line {again[0] + 1} announces samples once more: one record to a file.")
        dt = agreed_step(name, dt, step)
        at = next((number for number in range(last + 1) if _UNIT.search(lines[number])), None)
        unit = agreed_unit(name, (at or 0) + 1, unit, "" if at is None else _UNIT.search(lines[at])[1])
        samples = announced_samples(name, lines, last + 1, count, _numbers, plain_numbers)
        check_end(name, lines, _printed(lines[last + 1 :]), by_program=True)
        # Event, station and component stand above the unit; the first line only names the database.
        title = " ".join(lines[at - 1].split()) if at is not None and at >= 2 else ""
        return Accelerogram(samples, dt, unit, title, _origin(title))


def _origin(title: str) -> Origin:
    """Event, station and component: the first, the middle and the last of what stands between commas."""
    event, *station, component = [part.strip() for part in title.split(",")] if title.count(",") > 1 else (title, "")
    station = [part for part in station if not re.fullmatch(r"[\d/:. -]+", part)]
    return Origin(event, ", ".join(station), (component.split() or [""])[0])


def _counts(line: str) -> tuple[int, float] | None:
    """The number of samples and the time step in a header line [s]."""
    count, steps = _COUNT.search(line), _steps(line)
    if count and steps:
        return int(count[1]), steps[0]
    before = _BEFORE.match(line)
    return (int(before[1]), to_float(before[2])) if before else None


def _steps(line: str) -> list[float]:
    """All time steps that a line states [s]."""
    return [to_float(number) * SECONDS.get(unit.lower(), 1.0) for number, unit in _STEP.findall(line)]


def _printed(lines: list[str]) -> list[str]:
    """Numbers as they are printed: many of the first, and the last."""
    samples = [line for line in lines if line.strip() and _NUMBERS.fullmatch(line)]
    samples = samples[:_MANY] + samples[max(_MANY, len(samples) - 2) :]
    return [text for line in samples for text in re.findall(NUMBER, line)]


def _numbers(line: str) -> list[float] | None:
    """The numbers in a line, or None if it holds anything else; they may touch before a sign."""
    if not _NUMBERS.fullmatch(line):
        return None
    return [to_float(text) for text in re.findall(NUMBER, line)]
