"""Columns of text, separated by commas, semicolons, tabs or blanks, with or without times and lines of a header."""

import re
import warnings
from collections.abc import Sequence

import numpy as np

from jaxrock._core.precision import frames_of_the_package
from jaxrock._core.text import check_end, file_error, line_error
from jaxrock.motions.files.format import AbstractFormat, Accelerogram
from jaxrock.motions.files.headers import agreed_step, agreed_unit
from jaxrock.motions.files.parsing import LIKE_DATA, NUMBER, to_float
from jaxrock.motions.files.titles import Titles, titles_of
from jaxrock.motions.record import Origin

_COMMA = r"[-+]?\d+(?:,\d+)?(?:[EeDd][-+]?\d+)?"
_DECIMAL_COMMAS = re.compile(rf"(?=.*\d,\d){_COMMA}(?:[;\s]+{_COMMA})+[;\s]*")
_FIELD = re.compile(NUMBER + r"|[-+]?(?:nan|inf|infinity)", re.IGNORECASE)


class Columns(AbstractFormat):
    """Columns of text: the format of a file without a known header.

    **Arguments:**

    - `with_headers`: the formats with headers, which the message names for a file that holds no columns.
    """

    name = "csv"

    def __init__(self, with_headers: tuple[AbstractFormat, ...]):
        self.with_headers = with_headers

    def recognises(self, lines):
        return False  # any text may be columns

    def read(self, name, lines, dt, unit, column):
        table, numbers, printed = _table(name, lines)
        if not numbers:
            others = " nor ".join(each.name.upper() for each in self.with_headers)
            raise file_error(name, f"no line holds columns of numbers, and it is neither {others}.")
        width = table.shape[1]
        _check_commas(name, lines, table, numbers)
        if column is None and width > 2 or column is not None and column >= width:
            allowed = f"be 0 to {width - 1}, the column of accelerations in text file `{name}`"
            raise ValueError(f"Argument `column` must {allowed}, but is {column}.")
        chosen = width - 1 if column is None else column
        titles = _titles(name, lines, numbers[0], width)
        if titles.is_time(chosen) or chosen == 0 < width - 1 and dt is not None and _are_times(table[:, 0], dt):
            holds = f"be a column of accelerations, but column {chosen} of text file `{name}` holds times"
            raise ValueError(f"Argument `column` must {holds}.")
        line, written = titles.unit_of(name, chosen)
        if written:
            unit = agreed_unit(name, line, unit, written)
        if unit is None:
            allowed = "be 'g', 'm/s2' or 'cm/s2'"
            raise ValueError(f"Argument `unit` must {allowed} for text file `{name}`, which states none, but is None.")
        times = table[:, 0]
        # With `column` and `dt` given, column 0 may hold accelerations too; only times never fall.
        rising = times[-1] > times[0] and (np.diff(times) >= 0).all()
        if chosen > 0 and (column is None or dt is None or rising):
            dt = _step_of(name, titles, table[:, 0], numbers, printed, dt)
        if dt is None:
            raise ValueError(f"Argument `dt` must be given for text file `{name}`, which has no times, but is None.")
        return Accelerogram(table[:, chosen], dt, unit, "", Origin(component=titles.direction(chosen)))

    def components(self, name, lines):
        table, numbers, _ = _table(name, lines)
        if not numbers:
            return super().components(name, lines)  # `read` raises the error
        width = table.shape[1]
        titles = _titles(name, lines, numbers[0], width)
        first = int(titles.is_time(0) or titles.counts(0) or _are_times(table[:, 0]))
        if width - first not in (2, 3):
            held = f"text file `{name}` has {width} columns" + (", the first of times" if first else "")
            raise ValueError(f"Argument `columns` must be given, because {held}, but is None.")
        return tuple(range(first, width))


_LONG_STEP = 0.2  # [s]; accelerations are sampled more often: a step of 5 ms read as seconds is 5


def _step_of(name: str, titles: Titles, times: np.ndarray, numbers, printed, dt: float | None) -> float | None:
    """Return the time step of the first column [s], after a comparison with `dt`; `dt` itself if the column counts
    samples.
    """
    seconds = titles.seconds(name, times)
    if seconds is None:
        return dt
    factor, stated = seconds
    step = agreed_step(name, dt, float(f"{factor * _step(name, times, numbers, printed):.12g}"))
    if dt is None and not stated and step > _LONG_STEP:
        told = f"File `{name}` does not say in what its times are: taken for seconds, the time step is {step:g} s"
        warnings.warn(
            f"{told}, long for accelerations. Are they in ms? A title `time [ms]` says so.",
            stacklevel=frames_of_the_package() + 1,
        )
    return step


def _are_times(values: np.ndarray, dt: float | None = None) -> bool:
    """Return whether numbers rise evenly, by `dt` if that is given, as times do."""
    steps = np.diff(values)
    step = dt or (float(np.median(steps)) if steps.size else 0.0)
    return steps.size > 1 and step > 0 and bool((np.abs(steps - step) <= 0.01 * step).all())


def _titles(name: str, lines: list[str], first: int, width: int) -> Titles:
    """Return the titles in the lines above line number `first`, the first line of numbers."""
    return titles_of(name, lines[: first - 1], width, lines[first - 1].rstrip().endswith((",", ";")))


_ONE_COMMA = re.compile(r"\s*[-+]?\d+,\d+(?:[EeDd][-+]?\d+)?\s*")


def _check_commas(name: str, lines: list[str], table: np.ndarray, numbers: Sequence[int]) -> None:
    """Refuse numbers with decimal commas, one to a line, that look like two columns of whole numbers."""
    if table.shape[1] != 2 or not _ONE_COMMA.fullmatch(lines[numbers[0] - 1]):
        return
    rising = len(table) > 1 and (np.diff(table[:, 0]) > 0).all()
    if not rising and all(_ONE_COMMA.fullmatch(lines[number - 1].split("#")[0]) for number in numbers):
        raise line_error(name, numbers[0], "holds decimal commas, which must be points:", lines[numbers[0] - 1])


def _fields(line: str) -> list[str]:
    """Return the fields of a line of columns."""
    # With semicolons as separators, commas are decimal: such numbers are refused, not split.
    separator = next((mark for mark in ";," if mark in line), None)
    fields = [field.strip() for field in line.split(separator)]
    return fields[:-1] if not fields[-1] else fields


def _table(name: str, lines: list[str]) -> tuple[np.ndarray, Sequence[int], list[str]]:
    """Return the numbers in columns of text, the line number of each row, and some first fields as written."""
    found = _table_at_once(name, lines)
    if found is not None:
        return found
    rows, numbers, first, last = [], [], [], []
    for number, line in enumerate(lines, 1):
        line = line.split("#")[0].strip()
        fields = _fields(line) if line else []
        if not fields:
            continue
        if not all(_FIELD.fullmatch(field) for field in fields):
            if rows:
                raise line_error(name, number, "should hold numbers only, but is", line)
            _check_header(name, number, line)
            continue
        row = [to_float(field) if field[-1].isdigit() or field[-1] == "." else np.nan for field in fields]
        if not np.isfinite(row).all():
            raise line_error(name, number, "holds a number that is not finite:", line)
        if rows and len(row) != len(rows[0]):
            columns = "columns" if len(row) > 1 else "column"
            raise file_error(name, f"line {number} has {len(row)} {columns}, but line {numbers[0]} has {len(rows[0])}.")
        rows.append(row)
        numbers.append(number)
        first.append(fields[0])
        last.append(fields[-1])
    if rows:
        check_end(name, lines, last)
    return np.array(rows), numbers, first


def _check_header(name: str, number: int, line: str) -> None:
    """Refuse a header line that looks like numbers."""
    if _DECIMAL_COMMAS.fullmatch(line):
        raise line_error(name, number, "holds decimal commas, which must be points:", line)
    if LIKE_DATA.match(line):
        hint = "if it belongs to a header, let it start with #"
        raise line_error(name, number, f"holds more than numbers ({hint}):", line)


_MARKS = re.compile(r"[^-+.0-9EeDd \t\n,]")
_SOME = 200  # rows from which the printed digits are read


def _table_at_once(name: str, lines: list[str]) -> tuple[np.ndarray, range, list[str]] | None:
    """Return the results of `_table` for many rows of numbers only; None where lines have to be parsed one by one."""
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
    fields = [_fields(line) for line in ends]
    check_end(name, lines, [each[-1] for each in fields])
    return table, range(start + 1, end + 1), [each[0] for each in fields]


def _rounding(times: np.ndarray, printed: list[str]) -> float:
    """Bound the rounding error of times: one unit in the last printed digit, and single precision [s]."""
    digits = max(len(re.sub(r"[ED].*|[-+.]", "", text.upper()).lstrip("0")) for text in printed)
    largest = np.abs(times).max()
    return 10.0 ** (np.floor(np.log10(largest)) + 1 - digits) + 1e-7 * largest


def _step(name: str, times: np.ndarray, numbers: Sequence[int], printed: list[str]) -> float:
    """Return the time step of equally spaced times [s]."""
    if times.size < 2:
        raise file_error(name, "has one row only, so its times give no time step.")
    step = (times[-1] - times[0]) / (times.size - 1)
    if not step > 0:
        raise file_error(name, "the times in column 0 do not increase.")
    # A tolerance of half a step would hide a missing row, so there the tolerance is zero.
    rounding = _rounding(times, printed)
    rounding = rounding if rounding < 0.45 * step else 0.0
    slack = 1e-3 * step
    steps, drift = np.diff(times), times - times[0] - step * np.arange(times.size)
    if np.abs(drift).max() > slack + rounding or np.abs(steps - step).max() > 2 * slack + rounding:
        usual = np.median(steps)
        worst = int(np.abs(steps - usual).argmax())
        where = f"{steps[worst]:g} s before line {numbers[worst + 1]}, but {usual:g} s elsewhere"
        raise file_error(name, f"the times in column 0 are not equally spaced: {where}.")
    return float(f"{step:.12g}")  # 0.01, not 0.010000000000000002
