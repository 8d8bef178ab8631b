"""Statements of headers: lines of a pattern, texts, numbers behind keys; and their comparison with arguments.

Nothing is guessed: where a header announces a count, a unit or a time step, contradictions raise.
"""

import re

import numpy as np

from jaxrock._core.text import file_error
from jaxrock.motions.files.parsing import NUMBER, to_float, unit_named

Header = dict[str, tuple[int, str]]  # the line number and the value of each key


def places_of(pattern: re.Pattern, lines: list[str]) -> list[int]:
    """Return the places of the lines that begin with a pattern, counted from 0."""
    return [row for row, line in enumerate(lines) if pattern.match(line)]


def first_match(pattern: re.Pattern, lines: list[str], before: int = 0) -> tuple[int, re.Match] | None:
    """Return the first line that holds a pattern, counted from 1 after `before` others, and the match; or None."""
    numbered = enumerate(lines, before + 1)
    return next(((number, found) for number, line in numbered if (found := pattern.search(line))), None)


def text_after(pattern: str, lines: list[str]) -> str:
    """Return the first group of a pattern in the first line that holds it, with single blanks; else an empty text."""
    found = first_match(re.compile(pattern, re.IGNORECASE), lines)
    return " ".join(found[1][1].split()) if found else ""


def value_of(header: Header, key: str) -> tuple[int, str]:
    """Return the line number and the value of a key; 0 and an empty text where the header lacks it."""
    return header.get(key, (0, ""))


def stated_numbers(name: str, header: Header, key: str, pattern: str = rf"({NUMBER})") -> list[float]:
    """Return the numbers that the header must state: the groups of a pattern."""
    value = value_of(header, key)[1]
    found = re.fullmatch(pattern, value, re.IGNORECASE)
    if not found:
        quoted = repr(key) if " " in key else key
        raise file_error(name, f"header must state a number as {quoted}, but states {value!r}.")
    return [to_float(word) for word in found.groups()]


def chosen_channel(name: str, kind: str, column: int | None, count: int) -> int:
    """Return the channel that is asked for, in a file with `count` channels; None asks for the first."""
    channel = 0 if column is None else column
    if channel >= count:
        allowed = f"be 0 to {count - 1}, a channel of {kind} file `{name}`"
        raise ValueError(f"Argument `column` must {allowed}, but is {channel}.")
    return channel


def no_column(name: str, column: int | None, kind: str) -> None:
    """Raise ValueError where a column is asked for in a file with one record."""
    if column is not None:
        one = f"{kind} file `{name}` has one record"
        raise ValueError(f"Argument `column` must be None, because {one}, but is {column}.")


def agreed_step(name: str, given: float | None, stated: float) -> float:
    """Return the time step [s], after a comparison of the user's and the file's."""
    if not 0 < stated < np.inf:
        raise file_error(name, f"states a time step of {stated:g} s, which is not positive.")
    if given is None:
        return stated
    if abs(given - stated) > 1e-3 * stated:
        raise ValueError(f"Argument `dt` must agree with file `{name}`, which has {stated:g} s, but is {given}.")
    return given


def agreed_unit(name: str, line: int, given: str | None, written: str) -> str:
    """Return the unit, after a comparison of the user's and the header's (`written`, which may be empty)."""
    if not written:
        if given is None:
            told = f"Argument `unit` must be given for file `{name}`, whose header states none, but is None."
            raise ValueError(told)
        return given
    stated = unit_named(written)
    if stated is None:
        known = "g, m/s2, cm/s2, gal or mm/s2"
        raise file_error(name, f"line {line} states the unit {written!r}, but accelerations must be in {known}.")
    if given not in (None, stated):
        raise ValueError(f"Argument `unit` must agree with file `{name}`, which is in {stated!r}, but is {given!r}.")
    return stated
