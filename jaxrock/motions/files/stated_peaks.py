"""Peaks that comments of text files state, such as "PGA (cm/s2): 251", compared with the samples."""

import re
import warnings
from typing import NamedTuple

import numpy as np

from jaxrock._core.precision import frames_of_the_package
from jaxrock._core.text import file_error
from jaxrock.motions.files.parsing import NUMBER, PER_G, is_unit, to_float, unit_named

_OF_ACCELERATION = re.compile(
    r"\bpga\b|\b(?:peak|max\w*\.?)(?:\s+(?:ground|abs\w*|value|of|the|horizontal|vertical))*\s+acc\w*\.?"
    r"|\bacc\w*\.?\s*:?\s*(?:peak|max\w*)\b",
    re.IGNORECASE,
)
_WORD = re.compile(r"[^\s=:,;()\[\]{}<>]+")
_AT = re.compile(r"\bat\s+[\d.]+\s*s?\w*|\(\s*\d+\s*\)", re.IGNORECASE)  # the time of the peak
_SHARE = 0.01  # a peak that agrees to this share tells the unit
_OTHER_PROCESSING = 0.05  # peaks of unfiltered samples may differ by as much, without a warning


class StatedPeak(NamedTuple):
    """A peak that a line states, and its unit, one of `PER_G`."""

    line: int
    peak: float
    unit: str


def stated_peaks(lines: list[str]) -> list[StatedPeak]:
    """Return the peaks that lines state, one a line, with the units behind or before them."""
    found = []
    for number, line in enumerate(lines, 1):
        begin = _OF_ACCELERATION.search(line)
        words = _WORD.findall(_AT.sub(" ", line[begin.end() :])) if begin else []
        values = [to_float(word) for word in words if re.fullmatch(NUMBER, word)]
        units = list(dict.fromkeys(unit_named(word) for word in words if is_unit(word)))
        if len(values) == 1 and len(units) == 1 and values[0]:
            found.append(StatedPeak(number, abs(values[0]), str(units[0])))
    return found


def check_stated_peaks(name: str, lines: list[str], table: np.ndarray, column: int, unit: str, given: bool) -> None:
    """Compare the largest sample of a column with the peaks that the lines of a header state.

    **Arguments:**

    - `table`: (rows, columns) of the file; a peak of any column agrees.
    - `unit`: of the samples; `given`: whether the user says it, or else the file.

    **Raises:** ValueError where a peak is that of the samples in another unit. A peak that differs otherwise warns: it
    may be that of another component, or of samples before they were processed.
    """
    largest = np.abs(table).max(axis=0)
    peaks = stated_peaks(lines)
    if any(_agrees(value / PER_G[unit], each, _OTHER_PROCESSING) for each in peaks for value in largest):
        return
    for each in peaks:
        told = f"line {each.line} states a peak of {each.peak:g} {each.unit}"
        other = next((word for word in PER_G if _agrees(largest[column] / PER_G[word], each, _SHARE)), None)
        if other and given:
            held = f"be {other!r} for text file `{name}`, whose {told}, as the largest sample is {largest[column]:g}"
            raise ValueError(f"Argument `unit` must {held}, but is {unit!r}.")
        if other:
            raise file_error(name, f"{told}, but the largest sample is {largest[column]:g} {unit}.")
        warnings.warn(
            f"File `{name}`: {told}, but the largest sample is {largest[column]:g} {unit}.",
            stacklevel=frames_of_the_package() + 1,
        )


def _agrees(in_g: float, stated: StatedPeak, share: float) -> bool:
    """Return whether a peak [g] is the stated one, to a share of it."""
    return abs(in_g * PER_G[stated.unit] - stated.peak) <= share * stated.peak
