"""Columns of text with or without times and lines of a header, and series that are wrapped in rows."""

import re
import warnings
from collections.abc import Sequence

import numpy as np

from jaxrock._core.precision import frames_of_the_package
from jaxrock._core.text import file_error
from jaxrock.motions.files.format import AbstractFormat, Accelerogram
from jaxrock.motions.files.headers import agreed_step, agreed_unit
from jaxrock.motions.files.stated_peaks import check_stated_peaks
from jaxrock.motions.files.tables import (
    Counted,
    NumberRows,
    are_times,
    check_commas,
    check_commas_of_series,
    number_rows,
    without_count,
)
from jaxrock.motions.files.titles import Titles, titles_of
from jaxrock.motions.record import Origin


class Columns(AbstractFormat):
    """Columns of text: the format of a file without a known header.

    **Arguments:**

    - `with_headers`: the formats with headers, which the message names for a file that holds no columns.
    - `layout`: "rows" for one series in reading order, "columns" for a table; None asks where it is not clear.
    """

    name = "csv"

    def __init__(self, with_headers: tuple[AbstractFormat, ...], layout: str | None = None):
        self.with_headers = with_headers
        self.layout = layout

    def recognises(self, lines):
        return False  # any text may be columns

    def read(self, name, lines, dt, unit, column):
        numbers = self._numbers(name, lines)
        below, counted = without_count(name, lines, numbers)
        if counted and column is not None and counted.wrapped and below.width > 1:
            counted = None  # a column is of a table
        if counted:
            numbers = below
            dt = agreed_step(name, dt, counted.step)
        if self.layout == "rows" or self.layout is None and counted and counted.wrapped:
            return _series(name, lines, numbers, counted, dt, unit, column)
        check_commas(name, lines, numbers)
        titles = _titles(name, lines, numbers)
        if self.layout is None:
            _check_layout(name, numbers, titles, column)
        table, width = numbers.table(name), numbers.width
        if counted and counted.samples != len(table):
            raise _of_another_count(name, counted, f"{len(table)} rows")
        if column is None and width > 2 or column is not None and column >= width:
            allowed = f"be 0 to {width - 1}, the column of accelerations in text file `{name}`"
            raise ValueError(f"Argument `column` must {allowed}, but is {column}.")
        chosen = width - 1 if column is None else column
        if titles.is_time(chosen) or chosen == 0 < width - 1 and dt is not None and are_times(table[:, 0], dt):
            holds = f"be a column of accelerations, but column {chosen} of text file `{name}` holds times"
            raise ValueError(f"Argument `column` must {holds}.")
        stated, given = _unit(name, titles, chosen, unit), not titles.unit_of(name, chosen)[1]
        first = int(chosen > 0 and numbers.rises)  # times have no peak
        check_stated_peaks(name, lines[: numbers.header], table[:, first:], chosen - first, stated, given)
        # With `column` and `dt` given, column 0 may hold accelerations too; only times never fall.
        if chosen > 0 and (column is None or dt is None or numbers.rises):
            dt = _step_of(name, titles, numbers, dt)
        return Accelerogram(table[:, chosen], _given_step(name, dt), stated, "", _origin(titles, chosen))

    def components(self, name, lines):
        numbers = self._numbers(name, lines)
        width, titles = numbers.width, _titles(name, lines, numbers)
        table = numbers.table(name)
        first = int(titles.is_time(0) or titles.counts(0) or are_times(table[:, 0]))
        if width - first not in (2, 3):
            held = f"text file `{name}` has {width} columns" + (", the first of times" if first else "")
            raise ValueError(f"Argument `columns` must be given, because {held}, but is None.")
        return tuple(range(first, width))

    def _numbers(self, name: str, lines: list[str]) -> NumberRows:
        """Return the rows of numbers, or raise where there are none."""
        numbers = number_rows(name, lines, touching=self.layout == "rows")
        if len(numbers.rows) == 0:
            others = " nor ".join(each.name.upper() for each in self.with_headers)
            raise file_error(name, f"no line holds columns of numbers, and it is neither {others}.")
        return numbers


def _check_layout(name: str, numbers: NumberRows, titles: Titles, column: int | None) -> None:
    """Raise ValueError for rows that look like one series in reading order, and warn where a column of them is taken.

    A table has titles, or times in its first column.
    """
    width, is_short = numbers.width, numbers.is_short_at_end
    is_damaged = numbers.is_ragged and not is_short
    if width == 1 or is_damaged or numbers.rises or any(each.word or each.unit for each in titles.titles):
        return
    if is_short or column is None and width > 2:
        start = numbers.lines[0]
        held = f"whose rows from line {start} on have {width} numbers"
        if is_short:
            held = f"whose line {numbers.lines[-1]} has {len(numbers.rows[-1])} columns, but line {start} has {width}"
        allowed = f"be 'rows' for text file `{name}`, {held}, if they are one series in reading order"
        other = "" if is_short else ", or 'columns' if each column is one"
        raise ValueError(f"Argument `layout` must {allowed}{other}, but is None.")
    if column is not None and width > _COMPONENTS:
        told = f"File `{name}` has rows of {width} numbers from line {numbers.lines[0]} on, without titles and times"
        warnings.warn(
            f"{told}, of which column {column} is read. Are they one series in reading order? "
            'layout="rows" reads that; layout="columns" says that each column is one.',
            stacklevel=frames_of_the_package() + 1,
        )


def _series(
    name: str, lines: list[str], numbers: NumberRows, counted: Counted | None, dt, unit, column
) -> Accelerogram:
    """Read all numbers in reading order."""
    if column is not None:
        held = f"the rows of text file `{name}` are one series"
        raise ValueError(f"Argument `column` must be None, because {held}, but is {column}.")
    check_commas_of_series(name, lines, numbers)
    samples = numbers.series(name)
    if counted and counted.samples != samples.size:
        raise _of_another_count(name, counted, f"{samples.size} numbers")
    start = np.array([row[0] for row in numbers.rows])
    titles = titles_of(name, lines[: numbers.header], 1, 0)
    if titles.is_time(0) or numbers.width > 1 and are_times(start) and not are_times(samples):
        raise ValueError(f"Argument `layout` must be 'columns' for text file `{name}`, whose column 0 holds times.")
    stated, given = _unit(name, titles, 0, unit), not titles.unit_of(name, 0)[1]
    check_stated_peaks(name, lines[: numbers.header], samples[:, None], 0, stated, given)
    return Accelerogram(samples, _given_step(name, dt), stated, "", _origin(titles, 0))


def _of_another_count(name: str, counted: Counted, found: str) -> ValueError:
    """Return the error for a first row that states another number of samples than follow."""
    return file_error(name, f"line {counted.line} states {counted.samples} samples, but {found} follow.")


def _origin(titles: Titles, column: int) -> Origin:
    """Return the origin that the title of a column states."""
    return Origin(component=titles.direction(column))


def _unit(name: str, titles: Titles, column: int, unit: str | None) -> str:
    """Return the unit of a column, after a comparison of the user's and the titles'."""
    line, written = titles.unit_of(name, column)
    if written:
        return agreed_unit(name, line, unit, written)
    if unit is None:
        allowed = "be 'g', 'm/s2', 'cm/s2' or 'mm/s2'"
        raise ValueError(f"Argument `unit` must {allowed} for text file `{name}`, which states none, but is None.")
    return unit


def _given_step(name: str, dt: float | None) -> float:
    """Return the time step [s], or raise where there is none."""
    if dt is None:
        raise ValueError(f"Argument `dt` must be given for text file `{name}`, which has no times, but is None.")
    return dt


_COMPONENTS = 3  # columns without titles and times that may well be components
_LONG_STEP = 0.2  # [s]; accelerations are sampled more often: a step of 5 ms read as seconds is 5


def _step_of(name: str, titles: Titles, numbers: NumberRows, dt: float | None) -> float | None:
    """Return the time step of the first column [s], after a comparison with `dt`; `dt` itself if the column counts
    samples.
    """
    times = np.array([row[0] for row in numbers.rows])
    seconds = titles.seconds(name, times)
    if seconds is None:
        return dt
    factor, stated = seconds
    step = agreed_step(name, dt, float(f"{factor * _step(name, times, numbers.lines, numbers.first):.12g}"))
    if dt is None and not stated and step > _LONG_STEP:
        told = f"File `{name}` does not say in what its times are: taken for seconds, the time step is {step:g} s"
        warnings.warn(
            f"{told}, long for accelerations. Are they in ms? A title `time [ms]` says so.",
            stacklevel=frames_of_the_package() + 1,
        )
    return step


def _titles(name: str, lines: list[str], numbers: NumberRows) -> Titles:
    """Return the titles in the lines above all numbers."""
    row = lines[numbers.lines[0] - 1]
    return titles_of(name, lines[: numbers.header], numbers.width, numbers.spare, row)


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
        raise file_error(name, "the times in column 0 do not increase: if its rows are one series, say layout='rows'.")
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
