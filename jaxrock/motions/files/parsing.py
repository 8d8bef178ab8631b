"""What the formats have in common: numbers in text, units, and the comparison of header and arguments.

Nothing is guessed: where a header announces a count, a unit or a time step, contradictions raise.
"""

import re
from collections.abc import Callable

import numpy as np

from jaxrock._text import file_error

STANDARD_GRAVITY = 9.80665  # m/s^2, the g of accelerograms (not `rigid.GRAVITY`, the g of the papers)
PER_G = {"g": 1.0, "m/s2": STANDARD_GRAVITY, "cm/s2": 100 * STANDARD_GRAVITY}
_SPELLINGS = {"g": "g", "m/s2": "m/s2", "m/s/s": "m/s2"} | dict.fromkeys(["cm/s2", "cm/s/s", "gal", "gals"], "cm/s2")
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[EeDd][-+]?\d+)?"

# A broken first line of data must not pass for a line of the header.
LIKE_DATA = re.compile(r"\s*[-+]?(?:\.?\d|nan\b|inf\b)", re.IGNORECASE)


def to_float(text: str) -> float:
    """A number in text, with the exponents of Fortran, too."""
    return float(text.upper().replace("D", "E"))


def agreed_step(name: str, given: float | None, stated: float) -> float:
    """The time step, after a comparison of what the user and the file say [s]."""
    if not 0 < stated < np.inf:
        raise file_error(name, f"states a time step of {stated:g} s, which is not positive.")
    if given is None:
        return stated
    if abs(given - stated) > 1e-3 * stated:
        raise ValueError(f"Argument `dt` must agree with file `{name}`, which has {stated:g} s, but is {given}.")
    return given


def agreed_unit(name: str, line: int, given: str | None, written: str) -> str:
    """The unit, after a comparison of what the user and the header say (`written`, perhaps nothing)."""
    if not written and given is None:
        raise ValueError(f"Argument `unit` must be given for file `{name}`, whose header states none, but is None.")
    if not written:
        return given
    spelling = re.sub(r"\^|\*\*", "", written.lower().rstrip(".")).replace("sec", "s")
    stated = _SPELLINGS.get(spelling)
    if stated is None:
        known = "g, m/s2, cm/s2 or gal"
        raise file_error(name, f"line {line} states the unit {written!r}, but accelerations must be in {known}.")
    if given not in (None, stated):
        raise ValueError(f"Argument `unit` must agree with file `{name}`, which is in {stated!r}, but is {given!r}.")
    return stated


def announced_samples(
    name: str, lines: list[str], start: int, count: int, parse: Callable[[str], list[float] | None]
) -> np.ndarray:
    """The `count` samples that must follow line number `start`, and nothing more.

    `parse(line)`: the numbers in a line, or None if it holds anything else.
    """
    values = []
    for number, line in enumerate(lines[start:], start + 1):
        if not line.strip():
            continue
        row = parse(line)
        if row is not None:
            if not np.isfinite(row).all():
                raise file_error(name, f"line {number} holds a number that is not finite: {line.strip()[:60]!r}.")
            values += row
        elif re.search(r"POINTS OF|^\s*/&", line, re.IGNORECASE):
            break
        elif LIKE_DATA.match(line) or 0 < len(values) < count:
            raise file_error(name, f"line {number} should hold samples, but is {line.strip()[:60]!r}.")
        elif values:
            break
    if len(values) != count or count == 0:
        raise file_error(name, f"header announces {count} samples, but {len(values)} follow.")
    return np.array(values)


def check_peak(name: str, line: int, stated: float, samples: np.ndarray) -> None:
    """The largest sample is the peak that a header states in a line [cm/s2]."""
    stated, largest = abs(stated), float(np.abs(samples).max())
    if abs(largest - stated) > 1e-3 * stated + 1e-6:
        raise file_error(name, f"line {line} states a peak of {stated:g} cm/s2, but the largest sample is {largest:g}.")
