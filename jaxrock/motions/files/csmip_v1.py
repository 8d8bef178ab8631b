"""V1, the CSMIP format for uncorrected accelerograms: columns of samples, or of times and samples from a film."""

import re
from typing import NamedTuple

import numpy as np

from jaxrock._core.text import file_error
from jaxrock.motions.files.csmip import announced, announces, check_last_columns, told
from jaxrock.motions.files.format import AbstractFormat, Accelerogram
from jaxrock.motions.files.headers import agreed_step, agreed_unit, chosen_channel, first_match, places_of
from jaxrock.motions.files.parsing import (
    NUMBER,
    PER_G,
    announced_columns,
    check_peak,
    fixed_numbers,
    to_float,
    unit_named,
)

_FIRST = re.compile(r"^\s*UNCORRECTED ACCELEROGRAM DATA\b", re.IGNORECASE)
# " 13200 Accelerogram points at 200 pts/sec in units of g .      Format: (8f9.6)"
_SAMPLES = re.compile(
    rf"^\s*(\d+)\s+ACCELEROGRAM POINTS AT\s+({NUMBER})\s+(?:PTS|POINTS)/SEC\s+IN UNITS OF\s+([^\s.,;]+)[\s.,]*"
    r"FORMAT:\s*\(\s*\d*[FE](\d+)\.\d+\s*\)",
    re.IGNORECASE,
)
# Times and samples have no such line: the text header states their number and unit.
_COUNT = re.compile(r"NO\.\s*OF POINTS\s*=\s*(\d+)", re.IGNORECASE)
_RATE = re.compile(rf"\bAT\s+({NUMBER})\s+SAMPLES/SEC", re.IGNORECASE)
_UNIT = re.compile(r"UNITS\s+(?:OF UNCOR\w*\s+(?:ACCEL\w*|DATA)\s+)?ARE SEC\w*\s+AND\s+([^\s.,;]+)", re.IGNORECASE)
_PEAK = re.compile(rf"\bMAX\s*=\s*({NUMBER})\s*(\S+?)\s*,", re.IGNORECASE)
_TEXT, _WHOLE, _REAL = 13, 7, 7  # lines of each header
_PAIR = 7  # characters of a time, and of a sample
_TENTHS = re.compile(r"g/10", re.IGNORECASE)


class CSMIPUncorrected(AbstractFormat):
    """CSMIP V1."""

    name = "v1"
    suffixes = (".v1",)

    def recognises(self, lines):
        return bool(lines) and bool(_FIRST.match(lines[0]))

    def read(self, name, lines, dt, unit, column):
        starts = places_of(_FIRST, lines)
        if not starts:
            raise file_error(name, "no line begins with 'Uncorrected accelerogram data', as a V1 file must.")
        channel = chosen_channel(name, "V1", column, len(starts))
        at, end = starts[channel], (*starts[1:], len(lines))[channel]
        place = next((row for row in range(at, end) if _SAMPLES.match(lines[row]) or announces(lines[row])), None)
        if place is None:
            block = _pairs(name, lines, at)
        else:
            block = _as_corrected(name, lines, at, place) if announces(lines[place]) else _samples(name, lines, place)
        if channel == len(starts) - 1:
            check_last_columns(name, lines, block.start, block.width)
        unit = agreed_unit(name, block.line, unit, "g" if _TENTHS.fullmatch(block.unit) else block.unit)
        samples = block.samples / 10 if _TENTHS.fullmatch(block.unit) else block.samples
        _check_peak(name, lines, at, samples, unit)
        if block.times is None:
            dt = agreed_step(name, dt, block.step)
        else:
            dt, samples = _even(name, dt, block.times, samples)
        return Accelerogram(samples, dt, unit, *told(lines[at : block.start], _FIRST.pattern, (1, 5, 6)))


class _Block(NamedTuple):
    """Samples in `unit`, which `line` states; their time step, or their times [s]; their first line and field width."""

    samples: np.ndarray
    unit: str
    line: int
    start: int
    width: int
    step: float = 0.0
    times: np.ndarray | None = None


def _samples(name: str, lines: list[str], at: int) -> _Block:
    """Return a block that is announced as samples alone."""
    said = _SAMPLES.match(lines[at])
    assert said is not None  # the caller has matched the line
    count, rate, unit, width = said.groups()
    if not to_float(rate) > 0:
        raise file_error(name, f"line {at + 1} states {rate} samples a second.")
    samples = announced_columns(name, lines, at + 1, int(count), int(width))
    return _Block(samples, unit, at + 1, at + 1, int(width), 1 / to_float(rate))


def _as_corrected(name: str, lines: list[str], start: int, at: int) -> _Block:
    """Return a block that is announced as those of corrected files are; `start`: of the text header, which agrees."""
    count, step, unit, width = announced(lines, at)
    header = lines[start : start + _TEXT]
    for pattern, what, value in ((_COUNT, "samples", count), (_RATE, "samples a second", 1 / step if step else 0.0)):
        found = first_match(pattern, header, start)
        if found and abs(to_float(found[1][1]) - value) > 1e-3 * value:
            told = f"line {found[0]} states {found[1][1]} {what}, but line {at + 1} {value:g}"
            raise file_error(name, f"{told}.")
    samples = announced_columns(name, lines, at + 1, count, width)
    return _Block(samples, unit, at + 1, at + 1, width, step)


def _pairs(name: str, lines: list[str], at: int) -> _Block:
    """Return times and samples, which follow three headers."""
    header, start = lines[at : at + _TEXT], at + _TEXT + _WHOLE + _REAL
    points, units = first_match(_COUNT, header, at), first_match(_UNIT, header, at)
    if points is None or units is None:
        raise file_error(name, "header must state 'No. of points' and 'Units ... are sec and', as that of a V1 file.")
    (_, count), (line, unit) = points, units
    wholes, reals = lines[at + _TEXT : start - _REAL], lines[start - _REAL : start]
    if not all(re.fullmatch(r"[\s\d-]+", row) for row in wholes) or None in (fixed_numbers(row, 10) for row in reals):
        raise file_error(name, f"lines {at + _TEXT + 1} to {start} should hold the numbers of a V1 file's headers.")
    values = announced_columns(name, lines, start, 2 * int(count[1]), _PAIR, "times and samples")
    return _Block(values[1::2], unit[1], line, start, _PAIR, times=values[::2])


def _even(name: str, dt: float | None, times: np.ndarray, samples: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the time step [s] and equally spaced samples: the given ones, or points on the lines between them."""
    if times.size < 2 or not (np.diff(times) > 0).all():
        raise file_error(name, "the times of its samples do not increase.")
    step = (times[-1] - times[0]) / (times.size - 1)
    rounding = 1e-3 if step > 2e-3 else 0.0  # three digits are printed
    if np.abs(times - times[0] - step * np.arange(times.size)).max() <= rounding + 1e-9:
        return agreed_step(name, dt, float(f"{step:.12g}")), samples
    if dt is None:
        said = "whose samples are not equally spaced (straight lines between them are followed)"
        raise ValueError(f"Argument `dt` must be given for file `{name}`, {said}, but is None.")
    even = dt * np.arange(int(np.floor((times[-1] - times[0]) / dt * (1 + 1e-12))) + 1)
    return dt, np.interp(even, times - times[0], samples)


def _check_peak(name: str, lines: list[str], at: int, samples: np.ndarray, unit: str) -> None:
    """Check the largest sample against the text header, to the digits that it prints and a twentieth."""
    for row, line in enumerate(lines[at : at + _TEXT], at + 1):
        found = _PEAK.search(line)
        stated = unit_named(found[2]) if found else None
        if found and stated:
            check_peak(name, row, found[1], samples * (PER_G[stated] / PER_G[unit]), unit=stated, share=0.05)
