"""ESM, the ASCII format of the Engineering Strong-Motion database: lines `KEY: value`, then a sample a line."""

import re

import numpy as np

from jaxrock._text import check_end, file_error
from jaxrock.motions.files.format import AbstractFormat, Accelerogram
from jaxrock.motions.files.parsing import (
    NUMBER,
    PER_G,
    agreed_step,
    agreed_unit,
    announced_samples,
    check_peak,
    no_column,
    plain_numbers,
    to_float,
)
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
        step, count = (_stated(name, header, key) for key in (_STEP, _COUNT))
        kind = header.get(_KIND, (0, ""))[1].upper()
        if kind not in ("", "ACCELERATION"):
            raise file_error(name, f"line {header[_KIND][0]} states {kind.lower()}, but samples must be accelerations.")
        at, written = header.get(_UNIT, (0, ""))
        dt, unit = agreed_step(name, dt, step), agreed_unit(name, at, unit, written)
        _check_duration(name, header, step, int(count))
        start = max(line for line, _ in header.values())
        samples = announced_samples(name, lines, start, int(count), _number, plain_numbers)
        printed = [line.strip() for line in (*lines[start : start + 60], *lines[max(start + 60, len(lines) - 60) :])]
        check_end(name, lines, [line for line in printed if _number(line) is not None], by_program=True)
        _check_peak(name, header, samples, unit)
        keys = "EVENT_NAME", "STATION_NAME", "STREAM", "DATE_TIME_FIRST_SAMPLE_YYYYMMDD_HHMMSS", "STATION_CODE"
        told = [header.get(key, (0, ""))[1] for key in keys]
        return Accelerogram(samples, dt, unit, ", ".join(filter(None, told[:3])), Origin(*told))


def _header(lines: list[str]) -> dict[str, tuple[int, str]]:
    """Return line number and value of every key; the header ends with the first line without a key."""
    header = {}
    for number, line in enumerate(lines, 1):
        found = _KEY.fullmatch(line.strip())
        if not found:
            break
        header.setdefault(found[1], (number, found[2].strip()))
    return header


def _stated(name: str, header: dict, key: str) -> float:
    """Return a number that the header must state."""
    line, value = header.get(key, (0, ""))
    if not re.fullmatch(NUMBER, value):
        raise file_error(name, f"header must state a number as {key}, but states {value!r}.")
    return to_float(value)


def _number(line: str) -> list[float] | None:
    return [to_float(line.strip())] if re.fullmatch(NUMBER, line.strip()) else None


def _check_peak(name: str, header: dict, samples: np.ndarray, unit: str) -> None:
    """Check that the largest sample is the peak that the header states."""
    line, value = header.get(_PEAK, (0, ""))
    if re.fullmatch(NUMBER, value):
        check_peak(name, line, value, samples * (PER_G["cm/s2"] / PER_G[unit]))


def _check_duration(name: str, header: dict, step: float, count: int) -> None:
    """Check that the samples take the duration that the header states [s]."""
    line, value = header.get(_DURATION, (0, ""))
    if re.fullmatch(NUMBER, value) and abs(count * step - to_float(value)) > 2 * step + 0.01 * to_float(value):
        raise file_error(
            name, f"line {line} states {value} s, but {count} samples {step:g} s apart take {count * step:g}."
        )
