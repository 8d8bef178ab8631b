"""Rows of numbers in text: separators, comments, empty cells of spreadsheets, and a first row of count and step."""

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxrock._core.text import check_end, file_error, line_error
from jaxrock.motions.files.parsing import LIKE_DATA, NUMBER, free_numbers, to_float

_COMMA = r"[-+]?\d+(?:,\d+)?(?:[EeDd][-+]?\d+)?"
_DECIMAL_COMMAS = re.compile(rf"(?=.*\d,\d){_COMMA}(?:[;\s]+{_COMMA})+[;\s]*")
_FIELD = re.compile(NUMBER + r"|[-+]?(?:nan|inf|infinity)", re.IGNORECASE)
_ONE_COMMA = re.compile(r"\s*[-+]?\d+,\d+(?:[EeDd][-+]?\d+)?\s*")
_SOME_COMMAS = re.compile(r"\s*[-+]?\d+,\d+(?:\s*,\s*[-+]?\d+,\d+)*[,\s]*")


class NumberRows(NamedTuple):
    """The rows of numbers in a text file.

    - `rows`: an array (rows, columns), or a list of lists where they differ in length; `lines`: the line of each.
    - `first`: some of the first fields, as printed; `spare`: the empty fields at the end of the first row.
    - `header`: how many lines stand above all numbers.
    """

    rows: np.ndarray | list[list[float]]
    lines: Sequence[int]
    first: list[str]
    header: int = 0
    spare: int = 0

    @property
    def width(self) -> int:
        """Return how many numbers the first row has."""
        return len(self.rows[0])

    @property
    def is_ragged(self) -> bool:
        """Return whether rows differ in length."""
        return not isinstance(self.rows, np.ndarray)

    @property
    def is_short_at_end(self) -> bool:
        """Return whether the last row is shorter than all others, which are of one length."""
        *before, last = map(len, self.rows)
        return bool(before) and set(before) == {self.width} and last < self.width

    @property
    def rises(self) -> bool:
        """Return whether the first numbers of the rows never fall, as times do, and rise."""
        start = np.array([row[0] for row in self.rows])
        return bool(start[-1] > start[0] and (np.diff(start) >= 0).all())

    def table(self, name: str) -> np.ndarray:
        """Return the rows as an array, or raise for the first of another length."""
        for row, line in zip(self.rows, self.lines):
            if len(row) != self.width:
                columns = "columns" if len(row) > 1 else "column"
                told = f"line {line} has {len(row)} {columns}, but line {self.lines[0]} has {self.width}"
                raise file_error(name, f"{told}.")
        return np.array(self.rows)

    def series(self, name: str) -> np.ndarray:
        """Return all numbers in reading order, or raise for a row of another length that is not the last."""
        for row, line in zip(self.rows, self.lines):
            if len(row) > self.width or len(row) < self.width and line != self.lines[-1]:
                told = f"line {line} has {len(row)} numbers, but line {self.lines[0]} has {self.width}"
                raise file_error(name, f"{told}: of rows of one series only the last may be shorter.")
        return np.concatenate([np.asarray(row) for row in self.rows])


class Counted(NamedTuple):
    """A first row that states the number of samples and the time step [s], in `line`.

    `wrapped`: whether the samples are all numbers below it, or else as many as there are rows.
    """

    line: int
    samples: int
    step: float
    wrapped: bool


def fields_of_row(line: str) -> tuple[list[str], int]:
    """Return the fields of a row, without empty ones at its end, and how many those are."""
    # With semicolons as separators, commas are decimal: such numbers are refused, not split.
    separator = next((mark for mark in ";," if mark in line), None)
    fields = [field.strip() for field in line.split(separator)]
    full = len(fields)
    while fields and not fields[-1]:
        fields.pop()
    return fields, full - len(fields)


def number_rows(name: str, lines: list[str], touching: bool = False) -> NumberRows:
    """Return the rows of numbers in a text.

    `touching`: whether numbers may touch before a sign, as those of fixed width do.
    """
    found = _at_once(name, lines)
    if found is not None:
        return found
    rows, numbers, first, last, empty, spares = [], [], [], [], 0, []
    for number, line in enumerate(lines, 1):
        line = line.split("#")[0].strip()
        fields, spare = fields_of_row(line) if line else ([], 0)
        if not fields:
            empty = empty or (number if line and rows else 0)
            continue
        if touching and free_numbers(line):
            fields = re.findall(NUMBER, line)
        if not all(_FIELD.fullmatch(field) for field in fields):
            if rows:
                raise line_error(name, number, "should hold numbers only, but is", line)
            _check_header(name, number, line)
            continue
        row = [to_float(field) if field[-1].isdigit() or field[-1] == "." else np.nan for field in fields]
        if not np.isfinite(row).all():
            raise line_error(name, number, "holds a number that is not finite:", line)
        if empty:
            raise line_error(name, empty, "has empty fields only, but numbers follow:", lines[empty - 1])
        rows.append(row)
        numbers.append(number)
        first.append(fields[0])
        last.append(fields[-1])
        spares.append(spare)
    if rows:
        check_end(name, lines, last)
    same = len({len(row) for row in rows}) == 1
    header, spare = (numbers[0] - 1, spares[0]) if rows else (0, 0)
    return NumberRows(np.array(rows) if same else rows, numbers, first, header, spare)


def _check_header(name: str, number: int, line: str) -> None:
    """Refuse a header line that looks like numbers."""
    if _DECIMAL_COMMAS.fullmatch(line):
        raise line_error(name, number, "holds decimal commas, which must be points:", line)
    if LIKE_DATA.match(line):
        hint = "if it belongs to a header, let it start with #"
        raise line_error(name, number, f"holds more than numbers ({hint}):", line)


_MARKS = re.compile(r"[^-+.0-9EeDd \t\n,]")
_SOME = 200  # rows from which the printed digits are read


def _at_once(name: str, lines: list[str]) -> NumberRows | None:
    """Return what `number_rows` does for many rows of one length; None where lines are to be parsed one by one."""
    if len(lines) < _SOME:
        return None
    end = len(lines) - next((k for k, line in enumerate(reversed(lines)) if line.strip()), 0)
    start = next((k for k, line in enumerate(lines) if line.strip() and not _MARKS.search(line)), end)
    text = "\n".join(lines[start:end])
    if start == end or _MARKS.search(text) or any(LIKE_DATA.match(line) for line in lines[:start]):
        return None
    commas = lines[start].count(",")
    text = text.upper().replace("D", "E")
    try:
        table = np.loadtxt(text.split("\n"), delimiter="," if commas else None, comments=None, ndmin=2)
    except ValueError:
        return None
    if len(table) != end - start or not np.isfinite(table).all():
        return None
    ends = [*lines[start : start + _SOME], *lines[max(start + _SOME, end - _SOME) : end]]
    fields = [fields_of_row(line)[0] for line in ends]
    check_end(name, lines, [each[-1] for each in fields])
    return NumberRows(table, range(start + 1, end + 1), [each[0] for each in fields], start)


def are_times(values: np.ndarray, dt: float | None = None) -> bool:
    """Return whether numbers rise evenly, by `dt` if that is given, as times do."""
    steps = np.diff(values)
    step = dt or (float(np.median(steps)) if steps.size else 0.0)
    return steps.size > 1 and step > 0 and bool((np.abs(steps - step) <= 0.01 * step).all())


def without_count(name: str, lines: list[str], numbers: NumberRows) -> tuple[NumberRows, Counted | None]:
    """Split a first row of count and step, or step and count, from the rows below it.

    **Raises:** ValueError where a row of two numbers can be nothing else, but as many samples do not follow.
    """
    fields = fields_of_row(lines[numbers.lines[0] - 1].split("#")[0])[0]
    whole = [each.isdigit() for each in fields]
    rest = numbers._replace(rows=numbers.rows[1:], lines=numbers.lines[1:], first=numbers.first[1:])
    if whole == [True] and [*map(len, numbers.rows[:2])] == [1, 1]:
        return _without_two_rows(numbers)
    if len(rest.rows) == 0 or len(fields) != 2 or sum(whole) != 1:
        return numbers, None
    line, (count, step) = numbers.lines[0], map(float, numbers.rows[0] if whole[0] else numbers.rows[0][::-1])
    if count < 1 or not 0 < step < 1:
        return numbers, None
    if len({len(row) for row in rest.rows}) == 1:
        rest = rest._replace(rows=np.array(rest.rows))
    total, times = sum(map(len, rest.rows)), np.array([row[0] for row in rest.rows])
    if rest.width > 1 and len(rest.rows) == count and are_times(times, step):
        return rest, Counted(line, int(count), step, False)
    if total == count and not (rest.width == 2 and are_times(times)):
        return rest, Counted(line, int(count), step, True)
    if rest.width != 2 and whole[0]:
        found = f"states {int(count)} samples {step:g} s apart, but {total} numbers follow"
        raise file_error(name, f"line {line} {found}.")
    return numbers, None


_FEWEST = 4  # a count in a row of its own; a smaller one may be a sample


def _without_two_rows(numbers: NumberRows) -> tuple[NumberRows, Counted | None]:
    """Split count and step, each in a row of its own, from as many samples below them."""
    count, step, rest = numbers.rows[0][0], numbers.rows[1][0], numbers.rows[2:]
    if count < _FEWEST or not 0 < step < 1 or sum(map(len, rest)) != count:
        return numbers, None
    rows = np.array(rest) if len({len(row) for row in rest}) == 1 else rest
    below = numbers._replace(rows=rows, lines=numbers.lines[2:], first=numbers.first[2:])
    return below, Counted(numbers.lines[0], int(count), float(step), True)


def check_commas(name: str, lines: list[str], numbers: NumberRows) -> None:
    """Refuse numbers with decimal commas that look like twice as many whole numbers."""
    start = numbers.lines[0]
    if numbers.width == 2 and _ONE_COMMA.fullmatch(lines[start - 1]):
        rows = np.array([row[0] for row in numbers.rows])
        rising = len(rows) > 1 and (np.diff(rows) > 0).all()
        if not rising and all(_ONE_COMMA.fullmatch(lines[number - 1].split("#")[0]) for number in numbers.lines):
            raise line_error(name, start, "holds decimal commas, which must be points:", lines[start - 1])


def check_commas_of_series(name: str, lines: list[str], numbers: NumberRows) -> None:
    """Refuse rows of one series that may hold decimal commas: every other whole number has no sign."""
    if all(_SOME_COMMAS.fullmatch(lines[number - 1].split("#")[0]) for number in numbers.lines):
        start = numbers.lines[0]
        raise line_error(name, start, "may hold decimal commas, which must be points:", lines[start - 1])
