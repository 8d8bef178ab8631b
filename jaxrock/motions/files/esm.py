"""ESM, the ASCII format of the Engineering Strong-Motion database: lines `KEY: value`, then a sample a line."""

import re

import numpy as np

from jaxrock._core.text import check_end, file_error
from jaxrock.motions.files.format import AbstractFormat, Accelerogram, no_acceleration
from jaxrock.motions.files.headers import Header, agreed_step, agreed_unit, no_column, stated_numbers, value_of
from jaxrock.motions.files.parsing import NUMBER, PER_G, announced_samples, check_peak, to_float
from jaxrock.motions.record import Origin

_KEY = re.compile(r"([A-Z][A-Z0-9_/^]*):\s*(.*)")
_STEP, _COUNT, _KIND, _UNIT, _PEAK = "SAMPLING_INTERVAL_S", "NDATA", "DATA_TYPE", "UNITS", "PGA_CM/S^2"
_DURATION = "DURATION_S"


class ESM(AbstractFormat):
    """ESM ASCII."""

    name = "esm"
    single = True

    def recognises(self, lines):
        return {_STEP, _COUNT} <= set(_header(lines))

    def read(self, name, lines, dt, unit, column):
        no_column(name, column, "ESM")
        header = _header(lines)
        (step,), (count,) = (stated_numbers(name, header, key) for key in (_STEP, _COUNT))
        at, kind = value_of(header, _KIND)
        if kind.upper() not in ("", "ACCELERATION"):
            raise no_acceleration(name, at, kind)
        at, written = value_of(header, _UNIT)
        dt, unit = agreed_step(name, dt, step), agreed_unit(name, at, unit, written)
        _check_duration(name, header, step, int(count))
        start = max(line for line, _ in header.values())
        samples = announced_samples(name, lines, start, int(count), _number)
        printed = [line.strip() for line in (*lines[start : start + 60], *lines[max(start + 60, len(lines) - 60) :])]
        check_end(name, lines, [line for line in printed if _number(line) is not None], by_program=True)
        _check_peak(name, header, samples, unit)
        keys = "EVENT_NAME", "STATION_NAME", "STREAM", "DATE_TIME_FIRST_SAMPLE_YYYYMMDD_HHMMSS", "STATION_CODE"
        return Accelerogram.named(samples, dt, unit, Origin(*(value_of(header, key)[1] for key in keys)))


def _header(lines: list[str]) -> Header:
    """Return line number and value of every key; the header ends with the first line without a key."""
    header = {}
    for number, line in enumerate(lines, 1):
        found = _KEY.fullmatch(line.strip())
        if not found:
            break
        header.setdefault(found[1], (number, found[2].strip()))
    return header


def _number(line: str) -> list[float] | None:
    return [to_float(line.strip())] if re.fullmatch(NUMBER, line.strip()) else None


def _check_peak(name: str, header: Header, samples: np.ndarray, unit: str) -> None:
    """Check that the largest sample is the peak that the header states."""
    line, value = value_of(header, _PEAK)
    if re.fullmatch(NUMBER, value):
        check_peak(name, line, value, samples * (PER_G["cm/s2"] / PER_G[unit]))


def _check_duration(name: str, header: Header, step: float, count: int) -> None:
    """Check that the samples take the duration that the header states [s]."""
    line, value = value_of(header, _DURATION)
    if re.fullmatch(NUMBER, value) and abs(count * step - to_float(value)) > 2 * step + 0.01 * to_float(value):
        raise file_error(
            name, f"line {line} states {value} s, but {count} samples {step:g} s apart take {count * step:g}."
        )
