"""Helpers of all formats: numbers in text, units of acceleration, and samples in the number that a header announces."""

import functools
import re
from collections.abc import Callable

import numpy as np

from jaxrock._core.text import file_error, line_error

STANDARD_GRAVITY = 9.80665  # m/s^2, the g of accelerograms (not `rigid.GRAVITY`, the g of the papers)
PER_G = {"g": 1.0, "m/s2": STANDARD_GRAVITY, "cm/s2": 100 * STANDARD_GRAVITY, "mm/s2": 1000 * STANDARD_GRAVITY}
_SPELLINGS = (
    dict.fromkeys(["g", "g's"], "g")
    | dict.fromkeys(["m/s2", "m/s/s", "m s-2", "mps2"], "m/s2")
    | dict.fromkeys(["cm/s2", "cm/s/s", "cm s-2", "cmps2", "gal", "gals"], "cm/s2")
    | dict.fromkeys(["mm/s2", "mm/s/s", "mm s-2", "mmps2"], "mm/s2")
)
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[EeDd][-+]?\d+)?"

# A broken first line of data must not pass for a line of the header.
LIKE_DATA = re.compile(r"\s*[-+]?(?:\.?\d|nan\b|inf\b)", re.IGNORECASE)

# Numbers may touch, but only a sign marks the next: 1.234562.34567 is refused.
_NUMBERS = re.compile(rf"\s*{NUMBER}(?:(?:\s+|(?=[-+])){NUMBER})*\s*")
_MANY = 50  # lines from which the printed digits are read


def to_float(text: str) -> float:
    """Convert a number in text, with Fortran's exponents, too."""
    return float(text.upper().replace("D", "E"))


_SQUARED = re.compile(r"\s+squared$|\^|\*\*")
_LENGTH = re.compile(r"\b(c|m|centi|milli|)m(?:et(?:er|re))?s?(?=[/ ])")


def _spelling(written: str) -> str:
    """Return a unit with its words and marks as `_SPELLINGS` has them."""
    text = written.strip().lower().rstrip(".").replace("²", "2").replace("’", "'")
    text = _SQUARED.sub(lambda mark: "2" if mark[0].endswith("squared") else "", text)
    text = re.sub(r"\bsec(?:ond)?s?(?=\W|2|$)", "s", re.sub(r"\s*(?:/|\bper\b)\s*", "/", text)).replace("sec", "s")
    text = _LENGTH.sub(lambda length: f"{length[1][:1]}m", text)
    return re.sub(r"m\s*[.·⋅ ]\s*s\s*[-−⁻]\s*2$", "m s-2", text)


def unit_named(written: str) -> str | None:
    """Return the unit of acceleration, one of `PER_G`, that a word names; None for other words."""
    return _SPELLINGS.get(_spelling(written))


def is_unit(written: str) -> bool:
    """Return whether a word is a unit of acceleration."""
    return unit_named(written) is not None


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
    return _finite(np.array(text.upper().replace("D", "E").split(), dtype=np.bytes_))


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
    return _finite(np.frombuffer(data, f"S{width}"))


def _finite(texts: np.ndarray) -> np.ndarray | None:
    """Return the numbers in texts; None where one is no finite number."""
    try:
        values = texts.astype(float)
    except ValueError:
        return None
    return values if np.isfinite(values).all() else None


def data_lines(lines: list[str], start: int) -> list[str]:
    """Return the lines from number `start` on that look like data, up to one that holds a word."""
    for number in range(start, len(lines)):
        if _NOT_PLAIN.search(lines[number]):
            return lines[start:number]
    return lines[start:]


_ENDS = re.compile(r"POINTS OF|^\s*/&|^\s*End[-\s]+of[-\s]+data", re.IGNORECASE)  # lines that may follow the samples


def announced_samples(
    name: str,
    lines: list[str],
    start: int,
    count: int,
    parse: Callable[[str], list[float] | None],
    at_once: Callable[[list[str]], np.ndarray | None] = plain_numbers,
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
                raise line_error(name, number, "holds a number that is not finite:", line)
            values += row
        elif _ENDS.search(line):
            break
        elif LIKE_DATA.match(line) or 0 < len(values) < count:
            raise line_error(name, number, "should hold samples, but is", line)
        elif values:
            break
    return values


def announced_columns(
    name: str, lines: list[str], start: int, count: int, width: int, what: str = "samples"
) -> np.ndarray:
    """Return `announced_samples` from columns `width` wide, which may touch."""
    parse, at_once = functools.partial(fixed_numbers, width=width), functools.partial(numbers_of_width, width=width)
    return announced_samples(name, lines, start, count, parse, at_once, what)


def fields_of(line: str, width: int) -> list[str]:
    """Return the fields of a line, `width` wide; the last may be shorter."""
    line = line.rstrip()
    return [line[start : start + width] for start in range(0, len(line), width)]


def fixed_numbers(line: str, width: int) -> list[float] | None:
    """Return the numbers in a line of columns `width` wide, which may touch, or None if it holds anything else."""
    fields = fields_of(line, width)
    if len(line.rstrip()) % width or not all(re.fullmatch(NUMBER, field.strip()) for field in fields):
        return None
    return [to_float(field) for field in fields]


def free_numbers(line: str) -> list[float] | None:
    """Return the numbers in a line, or None if it holds anything else; they may touch before a sign."""
    return [to_float(text) for text in re.findall(NUMBER, line)] if _NUMBERS.fullmatch(line) else None


def printed_numbers(lines: list[str]) -> list[str]:
    """Return numbers as they are printed: many of the first, and the last."""
    samples = [line for line in lines if line.strip() and _NUMBERS.fullmatch(line)]
    samples = samples[:_MANY] + samples[max(_MANY, len(samples) - 2) :]
    return [text for line in samples for text in re.findall(NUMBER, line)]


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
