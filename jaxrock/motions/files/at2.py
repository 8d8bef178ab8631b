"""AT2, the format of the PEER database: a header with NPTS and DT, then samples."""

import re

from jaxrock._core.text import check_end, file_error
from jaxrock.motions.files.format import AbstractFormat, Accelerogram, no_acceleration
from jaxrock.motions.files.headers import agreed_step, agreed_unit, no_column
from jaxrock.motions.files.parsing import (
    NUMBER,
    announced_samples,
    free_numbers,
    is_unit,
    printed_numbers,
    to_float,
    unit_named,
)
from jaxrock.motions.files.unit_words import SECONDS, SHORT, is_any_unit
from jaxrock.motions.record import Origin

_UNIT = re.compile(
    r"\bUNITS(?:\s*[:=]|\s+(?:ARE|OF|IN)\b)*\s*[(\[{]?\s*([^\s,;()\[\]{}]+)(.*)"
    r"|\bUNIT(?:\s*[:=]|\s+IS\b)\s*[(\[{]?\s*([^\s,;()\[\]{}]+)(.*)",
    re.IGNORECASE,
)
_UNIT_ALONE = re.compile(r"(?:\bIN\b|[(\[])\s*[(\[]?\s*([^\s,;()\[\]]+)(.*)", re.IGNORECASE)
_TIMES = re.compile(r"\s*[)\]]?\s*(?:[*×/^]|X\s*[-+.\d]|TIMES\b|DIVIDED\b)", re.IGNORECASE)  # a factor beside a unit
_VALUED = re.compile(r"\s*[)\]]?\s*[:=]\s*[-+.]?\d")  # "PGA (CM/S2) = 805" states no unit of the samples
_OTHER_KIND = re.compile(r"^\s*(VELOCITY|DISPLACEMENT)\s+(?:TIME|HISTORY|SERIES|IN\s+UNITS)\b", re.IGNORECASE)
_COUNT = re.compile(r"(?<![A-Z])NPTS\s*=?\s*(\d+)", re.IGNORECASE)
_STEP = re.compile(rf"(?<![A-Z])DT\s*=?\s*({NUMBER})\s*([A-Zµμ]*)", re.IGNORECASE)
_RATE = re.compile(rf"(?<![A-Z])DT\s*=?\s*{NUMBER}\s*(K?HZ|SPS|SAMPLES|POINTS|PTS|1/S)", re.IGNORECASE)
_BEFORE = re.compile(rf"^\s*(\d+)[\s,]+({NUMBER})[\s,]+NPTS[\s,]+DT\b", re.IGNORECASE)


class AT2(AbstractFormat):
    """PEER AT2."""

    name = "at2"
    suffixes = (".at2",)
    single = True

    def recognises(self, lines):
        return any(_counts(line) for line in lines if not line.lstrip().startswith("#"))

    def read(self, name, lines, dt, unit, column):
        no_column(name, column, "AT2")
        last = next((number for number, line in enumerate(lines) if _counts(line)), None)
        if last is None:
            raise file_error(name, "no header line states NPTS and DT, as an AT2 file must.")
        count, step = _counts(lines[last])
        _check_kind(name, lines[: last + 1])
        steps = _steps(lines[last])
        if len(set(steps)) > 1:
            raise file_error(name, f"line {last + 1} states time steps of {steps[0]:g} and {steps[1]:g} s.")
        again = [number for number in range(last + 1, len(lines)) if "NPTS" in lines[number].upper()]
        if again:
            raise file_error(name, f"line {again[0] + 1} announces samples once more: one record to a file.")
        dt = agreed_step(name, dt, step)
        at, written = _unit_of(name, lines[: last + 1])
        unit = agreed_unit(name, (at or 0) + 1, unit, written)
        samples = announced_samples(name, lines, last + 1, count, free_numbers)
        check_end(name, lines, printed_numbers(lines[last + 1 :]), by_program=True)
        # Event, station and component stand above the unit; the first line only names the database.
        title = " ".join(lines[at - 1].split()) if at is not None and at >= 2 else ""
        return Accelerogram(samples, dt, unit, title, _origin(title))


def _check_kind(name: str, header: list[str]) -> None:
    """Refuse a file whose header states another quantity than acceleration, or a sampling rate in place of a time
    step.
    """
    for number, line in enumerate(header, 1):
        kind, rate = _OTHER_KIND.search(line), _RATE.search(line)
        if kind:
            raise no_acceleration(name, number, kind[1])
        if rate:
            raise file_error(name, f"line {number} states DT in {rate[1]!r}, but it must be a time step.")


def _unit_of(name: str, header: list[str]) -> tuple[int | None, str]:
    """Return the line that states the unit, and the unit; a line with UNITS goes before one with brackets."""
    stated = [(number, unit) for number, line in enumerate(header) if (unit := _unit_in(line))]
    found = [each for each in stated if _UNIT.search(header[each[0]])] or stated
    for number, unit in found[1:]:
        if (unit_named(unit) or unit) != (unit_named(found[0][1]) or found[0][1]):
            told = f"line {found[0][0] + 1} states the unit {found[0][1]!r}, but line {number + 1} {unit!r}"
            raise file_error(name, f"{told}.")
    return found[0] if found else (None, "")


def _unit_in(line: str) -> str:
    """Return the unit that a header line states, with a factor beside it, which makes it another unit; or an empty
    text.
    """
    found = _UNIT.search(line)
    word, rest = [part for part in found.groups() if part is not None] if found else ("", "")
    for alone in () if found else _UNIT_ALONE.finditer(line):
        sure = is_any_unit(alone[1]) and alone[1].lower() not in SHORT and alone[1].lower() not in SECONDS
        # A word such as G is a unit beside the word acceleration only.
        sure = sure and not _VALUED.match(alone[2])
        if sure and (is_unit(alone[1]) and len(alone[1]) > 1 or re.search(r"\bACC", line, re.IGNORECASE)):
            word, rest = alone.groups()
            break
    return word + (rest.rstrip() if word and _TIMES.match(rest) else "")


def _origin(title: str) -> Origin:
    """Return event, station and component: the first, the middle and the last part between commas."""
    event, *station, component = [part.strip() for part in title.split(",")] if title.count(",") > 1 else (title, "")
    station = [part for part in station if not re.fullmatch(r"[\d/:. -]+", part)]
    return Origin(event, ", ".join(station), (component.split() or [""])[0])


def _counts(line: str) -> tuple[int, float] | None:
    """Return the number of samples and the time step of a header line [s]."""
    count, steps = _COUNT.search(line), _steps(line)
    if count and steps:
        return int(count[1]), steps[0]
    before = _BEFORE.match(line)
    return (int(before[1]), to_float(before[2])) if before else None


def _steps(line: str) -> list[float]:
    """Return all time steps that a line states [s]."""
    return [to_float(number) * SECONDS.get(unit.lower(), 1.0) for number, unit in _STEP.findall(line)]
