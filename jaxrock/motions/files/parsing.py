"""Helpers of all formats: numbers in text, units, and the comparison of header and arguments.

Nothing is guessed: where a header announces a count, a unit or a time step, contradictions raise.
"""

import functools
import re
from collections.abc import Callable

import numpy as np

from jaxrock._text import file_error

STANDARD_GRAVITY = 9.80665  # m/s^2, the g of accelerograms (not `rigid.GRAVITY`, the g of the papers)
PER_G = {"g": 1.0, "m/s2": STANDARD_GRAVITY, "cm/s2": 100 * STANDARD_GRAVITY}
_SPELLINGS = (
    {"g": "g"}
    | dict.fromkeys(["m/s2", "m/s/s", "m s-2", "mps2"], "m/s2")
    | dict.fromkeys(["cm/s2", "cm/s/s", "cm s-2", "cmps2", "gal", "gals"], "cm/s2")
)
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[EeDd][-+]?\d+)?"

# A broken first line of data must not pass for a line of the header.
LIKE_DATA = re.compile(r"\s*[-+]?(?:\.?\d|nan\b|inf\b)", re.IGNORECASE)


def to_float(text: str) -> float:
    """Convert a number in text, with Fortran's exponents, too."""
    return float(text.upper().replace("D", "E"))


def agreed_step(name: str, given: float | None, stated: float) -> float:
    """Return the time step [s], after a comparison of the user's and the file's."""
    if not 0 < stated < np.inf:
        raise file_error(name, f"states a time step of {stated:g} s, which is not positive.")
    if given is None:
        return stated
    if abs(given - stated) > 1e-3 * stated:
        raise ValueError(f"Argument `dt` must agree with file `{name}`, which has {stated:g} s, but is {given}.")
    return given


def _spelling(written: str) -> str:
    text = re.sub(r"\^|\*\*", "", written.lower().rstrip(".")).replace("sec", "s").replace("²", "2")
    return re.sub(r"m\s*[.·⋅ ]\s*s\s*[-−⁻]\s*2$", "m s-2", text)


def unit_named(written: str) -> str | None:
    """Return the unit of acceleration, one of `PER_G`, that a word names; None for other words."""
    return _SPELLINGS.get(_spelling(written))


def is_unit(written: str) -> bool:
    """Return whether a word is a unit of acceleration."""
    return unit_named(written) is not None


def agreed_unit(name: str, line: int, given: str | None, written: str) -> str:
    """Return the unit, after a comparison of the user's and the header's (`written`, which may be empty)."""
    if not written:
        if given is None:
            told = f"Argument `unit` must be given for file `{name}`, whose header states none, but is None."
            raise ValueError(told)
        return given
    stated = unit_named(written)
    if stated is None:
        known = "g, m/s2, cm/s2 or gal"
        raise file_error(name, f"line {line} states the unit {written!r}, but accelerations must be in {known}.")
    if given not in (None, stated):
        raise ValueError(f"Argument `unit` must agree with file `{name}`, which is in {stated!r}, but is {given!r}.")
    return stated


_PLAIN = re.compile(r"[-+.0-9EeDd \t\n]*")
_NOT_PLAIN = re.compile(r"[^-+.0-9EeDd \t]")
_TOUCHING = re.compile(r"(?<=[0-9.])(?=[-+])")


def plain_numbers(lines: list[str]) -> np.ndarray | None:
    """Return all numbers in lines of numbers only, parsed at once; None where lines have to be parsed one by one.

    Parsing at once is quick, as files are read over and over. A text that it does not accept may still be valid.
    """
    text = "\n".join(lines)
    if not _PLAIN.fullmatch(text):
        return None
    if _TOUCHING.search(text):  # numbers may touch before a sign
        text = _TOUCHING.sub(" ", text)
    words = text.upper().replace("D", "E").split()
    try:
        values = np.array(words, dtype=np.bytes_).astype(float) if words else np.zeros(0)
    except ValueError:
        return None
    return values if np.isfinite(values).all() else None


def numbers_of_width(lines: list[str], width: int) -> np.ndarray | None:
    """Return all numbers in fields of one width, which may touch; None where lines have to be parsed one by one."""
    lines = [line.rstrip() for line in lines if line.strip()]
    text = "".join(lines)
    if not text or "\t" in text or any(len(line) % width for line in lines) or not _PLAIN.fullmatch(text):
        return None
    data = text.upper().replace("D", "E").encode()
    written = np.frombuffer(data, np.uint8).reshape(-1, width) != ord(" ")
    if not (np.sum(written[:, 1:] > written[:, :-1], axis=1) + written[:, 0] == 1).all():
        return None  # an empty field, or two numbers in one
    try:
        values = np.frombuffer(data, f"S{width}").astype(float)
    except ValueError:
        return None
    return values if np.isfinite(values).all() else None


def data_lines(lines: list[str], start: int) -> list[str]:
    """Return the lines from number `start` on that look like data, up to one that holds a word."""
    for number in range(start, len(lines)):
        if _NOT_PLAIN.search(lines[number]):
            return lines[start:number]
    return lines[start:]


_ENDS = re.compile(r"POINTS OF|^\s*/&|^\s*End-of-data", re.IGNORECASE)  # lines that may follow the samples


def announced_samples(
    name: str,
    lines: list[str],
    start: int,
    count: int,
    parse: Callable[[str], list[float] | None],
    at_once: Callable[[list[str]], np.ndarray | None] = lambda lines: None,
    what: str = "samples",
) -> np.ndarray:
    """Return the `count` samples that must follow line number `start`, and nothing more.

    `parse(line)`: the numbers in a line, or None if it holds anything else. `at_once(lines)`: the numbers of all lines,
    or None where lines have to be parsed one by one. `what`: the meaning of the numbers, for messages.
    """
    block = data_lines(lines, start)
    rest = lines[start + len(block) :]
    if not rest or _ENDS.search(rest[0]):
        values = at_once(block)
        if values is not None and len(values) == count > 0:
            return values
    values = _one_by_one(name, lines, start, count, parse)
    if len(values) != count or count == 0:
        raise file_error(name, f"header announces {count} {what}, but {len(values)} follow.")
    return np.array(values)


def _one_by_one(name: str, lines: list[str], start: int, count: int, parse: Callable) -> list[float]:
    """Return the numbers line by line, or raise for the first bad line."""
    values = []
    for number, line in enumerate(lines[start:], start + 1):
        if not line.strip():
            continue
        row = parse(line)
        if row is not None:
            if not np.isfinite(row).all():
                raise file_error(name, f"line {number} holds a number that is not finite: {line.strip()[:60]!r}.")
            values += row
        elif _ENDS.search(line):
            break
        elif LIKE_DATA.match(line) or 0 < len(values) < count:
            raise file_error(name, f"line {number} should hold samples, but is {line.strip()[:60]!r}.")
        elif values:
            break
    return values


def announced_columns(
    name: str, lines: list[str], start: int, count: int, width: int, what: str = "samples"
) -> np.ndarray:
    """Return `announced_samples` from columns `width` wide, which may touch."""
    parse, at_once = functools.partial(fixed_numbers, width=width), functools.partial(numbers_of_width, width=width)
    return announced_samples(name, lines, start, count, parse, at_once, what)


def fixed_numbers(line: str, width: int) -> list[float] | None:
    """Return the numbers in a line of columns `width` wide, which may touch, or None if it holds anything else."""
    line = line.rstrip()
    if len(line) % width:
        return None
    fields = [line[start : start + width].strip() for start in range(0, len(line), width)]
    if not all(re.fullmatch(NUMBER, field) for field in fields):
        return None
    return [to_float(field) for field in fields]


def no_column(name: str, column: int | None, kind: str) -> None:
    """Raise ValueError where a column is asked for in a file with one record."""
    if column is not None:
        one = f"{kind} file `{name}` has one record"
        raise ValueError(f"Argument `column` must be None, because {one}, but is {column}.")


def check_peak(
    name: str, line: int, stated: str | float, samples: np.ndarray, where: str = "", *, unit="cm/s2", share=1e-3
) -> None:
    """Check the largest sample against the stated peak, to a share of it and, in text, its last digit."""
    peak, largest = abs(to_float(str(stated))), float(np.abs(samples).max())
    if abs(largest - peak) > share * peak + max(1e-6, _last_digit(stated) if isinstance(stated, str) else 0.0):
        told = f"a peak of {peak:g} {unit}, but the largest sample is {largest:g}"
        raise file_error(name, f"{where or f'line {line}'} states {told}.")


def _last_digit(printed: str) -> float:
    """Return the value of one unit in the last digit of a printed number."""
    digits, _, power = printed.upper().replace("D", "E").partition("E")
    return 10.0 ** (int(power or 0) - len(digits.partition(".")[2]))
