"""Accelerograms from files: PEER AT2, CSMIP V2, and columns of text.

A reader trusts only what the file says or the user states: it never guesses a unit or a time step,
and where a header announces a count, a unit or a time step, contradictions raise.
"""

import os
import re
from importlib import resources
from pathlib import Path

import numpy as np
from jaxtyping import ArrayLike

from jaxrock._checks import one_of, positive
from jaxrock._text import file_error, text_lines
from jaxrock.motions.record import Record

STANDARD_GRAVITY = 9.80665  # m/s^2, the g of accelerograms (not `block.GRAVITY`, the g of the papers)


_PER_G = {"g": 1.0, "m/s2": STANDARD_GRAVITY, "cm/s2": 100 * STANDARD_GRAVITY}


_SPELLINGS = {"g": "g", "m/s2": "m/s2", "m/s/s": "m/s2"} | dict.fromkeys(["cm/s2", "cm/s/s", "gal", "gals"], "cm/s2")


_SUFFIXES = {".at2": "at2", ".v2": "v2"}


_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[EeDd][-+]?\d+)?"


_FIELD = re.compile(_NUMBER + r"|[-+]?(?:nan|inf|infinity)", re.IGNORECASE)


# A broken first line of data must not pass for a line of the header.
_LIKE_DATA = re.compile(r"\s*[-+]?(?:\.?\d|nan\b|inf\b)", re.IGNORECASE)


# Printed numbers may touch, but only a sign tells where the next begins: 1.234562.34567 is refused.
_NUMBERS = re.compile(rf"\s*{_NUMBER}(?:(?:\s+|(?=[-+])){_NUMBER})*\s*")


_AT2_UNIT = re.compile(r"\bUNITS\s*(?:OF|IN|[:=])?\s*\(?\s*([^\s,;()]+)", re.IGNORECASE)


_AT2_COUNT = re.compile(r"(?<![A-Z])NPTS\s*=?\s*(\d+)", re.IGNORECASE)


_AT2_STEP = re.compile(rf"(?<![A-Z])DT\s*=?\s*({_NUMBER})", re.IGNORECASE)


_AT2_BEFORE = re.compile(rf"^\s*(\d+)[\s,]+({_NUMBER})[\s,]+NPTS[\s,]+DT\b", re.IGNORECASE)


# "5690 POINTS OF ACCEL DATA EQUALLY SPACED AT  .010 SEC.  (UNITS: CM/SEC/SEC)"; later files write
# ", in cm/sec2. (8f10.6)" and those of USC "IN UNITS CM/SEC/SEC".
_V2_BLOCK = re.compile(
    rf"^\s*(\d+)\s+POINTS OF ACC\w*\s+DATA,?\s+EQUALLY SPACED AT\s*({_NUMBER})\s*SEC(?:ONDS?)?[\s.,]*"
    r"\(?\s*(?:IN\s+)?(?:UNITS\s*[:=]?\s*)?([^\s,;()]*)[\s).]*(?:\(\s*\d*[FEG](\d+)\.\d+\s*\))?",
    re.IGNORECASE,
)


def read_record(
    path: str | os.PathLike,
    *,
    format: str | None = None,
    dt: ArrayLike | None = None,
    unit: str | None = None,
    column: int | np.integer | None = None,
) -> Record:
    """Read an accelerogram from a file.

    **Arguments:**

    - `path`: the file.
    - `format`: "at2" (PEER), "v2" (CSMIP, also USC: corrected acceleration), or "csv" (columns of text
      separated by commas, semicolons, tabs or blanks). None recognises it from the content, then from
      the suffix.
    - `dt`: time between samples [s], positive. Needed for text without times; elsewhere it must agree
      with the file to 1e-3.
    - `unit`: of the accelerations in the file, "g", "m/s2" or "cm/s2". Needed for text; elsewhere it
      must agree with the header.
    - `column`: counted from 0. Text: the column of accelerations, needed when there are more than two;
      column 0 then holds the times, unless `column` is 0, or `dt` is given and column 0 also falls.
      V2: the channel (None: the first). Not for AT2.

    **Returns:** a `Record` in units of g = 9.80665 m/s^2, named after the header (or the file). Its first
    sample is at time 0, whatever the times in the file.

    **Raises:** OSError if the file cannot be opened; ValueError, with file and line, for one that is
    empty, binary or damaged; ValueError for an argument that is missing, not allowed, of no use for
    the format, or contradicted by the file.
    """
    if format is not None:
        one_of("format", format, ("at2", "v2", "csv"))
    if unit is not None:
        one_of("unit", unit, tuple(_PER_G))
    if dt is not None:
        if np.ndim(dt) != 0:
            raise ValueError(f"Argument `dt` must be one number, but has shape {np.shape(dt)}.")
        positive("dt", dt)
        dt = float(dt)
    if column is not None and (isinstance(column, bool) or not isinstance(column, (int, np.integer)) or column < 0):
        raise ValueError(f"Argument `column` must be an integer, 0 or more, but is {column!r}.")
    path = Path(path)
    lines = text_lines(path)
    reader = {"at2": _read_at2, "v2": _read_v2, "csv": _read_csv}[format or _format(lines, path.suffix)]
    samples, found, written, name = reader(path.name, lines, dt, unit, column)
    return Record(samples / _PER_G[written], found, name or path.stem)


def example_record() -> Record:
    """The record that comes with the package: a near-fault pulse of the Imperial Valley earthquake.

    **Returns:** a `Record` of 5690 samples, 0.01 s apart, with a peak of 0.311 g (305.02 cm/s^2) at 4.06 s.

    **Source:** Imperial Valley earthquake of 15 October 1979; El Centro - Highway 8/Meloland Overpass,
    free field, 360 degrees; CSMIP station 1336, processed by USGS. Data from the Center for Engineering
    Strong Motion Data (strongmotioncenter.org).
    """
    with resources.as_file(resources.files("jaxrock") / "data" / "meloland_1979_chan15.v2") as path:
        return read_record(path)


def _format(lines: list[str], suffix: str) -> str:
    if any(map(_V2_BLOCK.match, lines)):
        return "v2"
    if any(_at2_counts(line) for line in lines if not line.lstrip().startswith("#")):
        return "at2"
    return _SUFFIXES.get(suffix.lower(), "csv")


def _float(text: str) -> float:
    return float(text.upper().replace("D", "E"))


def _agreed_step(name: str, given: float | None, found: float) -> float:
    """The time step, after a comparison of what the user and the file say [s]."""
    if not 0 < found < np.inf:
        raise file_error(name, f"states a time step of {found:g} s, which is not positive.")
    if given is None:
        return found
    if abs(given - found) > 1e-3 * found:
        raise ValueError(f"Argument `dt` must agree with file `{name}`, which has {found:g} s, but is {given}.")
    return given


def _agreed_unit(name: str, line: int, given: str | None, written: str) -> str:
    """The unit, after a comparison of what the user and the header say (`written`, perhaps nothing)."""
    if not written and given is None:
        raise ValueError(f"Argument `unit` must be given for file `{name}`, whose header states none, but is None.")
    if not written:
        return given
    spelling = re.sub(r"\^|\*\*", "", written.lower().rstrip(".")).replace("sec", "s")
    found = _SPELLINGS.get(spelling)
    if found is None:
        known = "g, m/s2, cm/s2 or gal"
        raise file_error(name, f"line {line} states the unit {written!r}, but accelerations must be in {known}.")
    if given not in (None, found):
        raise ValueError(f"Argument `unit` must agree with file `{name}`, which is in {found!r}, but is {given!r}.")
    return found


def _free(line: str) -> list[float] | None:
    """The numbers in a line, or None if it holds anything else; they may touch before a sign."""
    if not _NUMBERS.fullmatch(line):
        return None
    return [_float(text) for text in re.findall(_NUMBER, line)]


def _fixed(line: str, width: int) -> list[float] | None:
    """The numbers in a line of columns `width` wide, which may touch, or None if it holds anything else."""
    line = line.rstrip()
    fields = [line[start : start + width].strip() for start in range(0, len(line), width)]
    if not all(re.fullmatch(_NUMBER, field) for field in fields):
        return None
    return [_float(field) for field in fields]


def _block(name: str, lines: list[str], start: int, count: int, parse) -> np.ndarray:
    """The `count` numbers that must follow line number `start`, and nothing more."""
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
        elif _LIKE_DATA.match(line) or 0 < len(values) < count:
            raise file_error(name, f"line {number} should hold samples, but is {line.strip()[:60]!r}.")
        elif values:
            break
    if len(values) != count or count == 0:
        raise file_error(name, f"header announces {count} samples, but {len(values)} follow.")
    return np.array(values)


def _at2_counts(line: str) -> tuple[int, float] | None:
    """The number of samples and the time step in a header line of an AT2 file [s]."""
    count, step = _AT2_COUNT.search(line), _AT2_STEP.search(line)
    if count and step:
        return int(count[1]), _float(step[1])
    before = _AT2_BEFORE.match(line)
    return (int(before[1]), _float(before[2])) if before else None


def _read_at2(name, lines, dt, unit, column):
    """Samples, time step, unit and title of a PEER AT2 file."""
    if column is not None:
        raise ValueError(f"Argument `column` must be None, because AT2 file `{name}` has one record, but is {column}.")
    last = next((number for number, line in enumerate(lines) if _at2_counts(line)), None)
    if last is None:
        raise file_error(name, "no header line states NPTS and DT, as an AT2 file must.")
    count, found = _at2_counts(lines[last])
    found = _agreed_step(name, dt, found)
    at = next((number for number in range(last + 1) if _AT2_UNIT.search(lines[number])), None)
    unit = _agreed_unit(name, (at or 0) + 1, unit, "" if at is None else _AT2_UNIT.search(lines[at])[1])
    samples = _block(name, lines, last + 1, count, _free)
    # Event, station and component stand above the unit; the first line only names the database.
    title = " ".join(lines[at - 1].split()) if at is not None and at >= 2 else ""
    return samples, found, unit, title


def _read_v2(name, lines, dt, unit, column):
    """Samples, time step, unit and title of one channel of a CSMIP V2 file."""
    channels = [number for number, line in enumerate(lines) if _V2_BLOCK.match(line)]
    if not channels:
        raise file_error(name, "no line announces 'POINTS OF ACCEL DATA', as a corrected V2 file must.")
    channel = 0 if column is None else column
    if channel >= len(channels):
        allowed = f"be 0 to {len(channels) - 1}, a channel of V2 file `{name}`"
        raise ValueError(f"Argument `column` must {allowed}, but is {channel}.")
    at = channels[channel]
    count, found, written, width = _V2_BLOCK.match(lines[at]).groups()
    unit = _agreed_unit(name, at + 1, unit, written)
    found = _agreed_step(name, dt, _float(found))
    width = int(width or 10)
    samples = _block(name, lines, at + 1, int(count), lambda line: _fixed(line, width))
    # The text header of each channel starts with this line; event, station and channel have fixed places.
    starts = [number for number in range(at) if re.match(r"\s*CORRECTED ACCELEROGRAM", lines[number], re.IGNORECASE)]
    header = lines[starts[-1] : at] if starts else []
    parts = [re.split(r"(?<![:\s])\s{3,}|\s{2,}\(", header[row].strip())[0] for row in (2, 6, 7) if row < len(header)]
    return samples, found, unit, ", ".join(" ".join(part.split()) for part in parts if part)


def _fields(line: str) -> list[str]:
    """The fields of a line of columns."""
    # Beside semicolons, commas are decimal: such numbers are refused, not parted.
    separator = next((mark for mark in ";," if mark in line), None)
    fields = [field.strip() for field in line.split(separator)]
    return fields[:-1] if not fields[-1] else fields


def _table(name: str, lines: list[str]) -> tuple[np.ndarray, list[int], list[str]]:
    """The numbers in columns of text, the line number of each row, and its first field as written."""
    rows, numbers, first = [], [], []
    for number, line in enumerate(lines, 1):
        line = line.split("#")[0].strip()
        fields = _fields(line) if line else []
        if not fields:
            continue
        if not all(_FIELD.fullmatch(field) for field in fields):
            if rows:
                raise file_error(name, f"line {number} should hold numbers only, but is {line[:60]!r}.")
            if _LIKE_DATA.match(line):
                hint = "if it belongs to a header, let it start with #"
                raise file_error(name, f"line {number} holds more than numbers ({hint}): {line[:60]!r}.")
            continue
        row = [_float(field) if field[-1].isdigit() or field[-1] == "." else np.nan for field in fields]
        if not np.isfinite(row).all():
            raise file_error(name, f"line {number} holds a number that is not finite: {line[:60]!r}.")
        if rows and len(row) != len(rows[0]):
            columns = "columns" if len(row) > 1 else "column"
            raise file_error(name, f"line {number} has {len(row)} {columns}, but line {numbers[0]} has {len(rows[0])}.")
        rows.append(row)
        numbers.append(number)
        first.append(fields[0])
    if not rows:
        raise file_error(name, "no line holds columns of numbers, and it is neither AT2 nor V2.")
    return np.array(rows), numbers, first


def _rounding(times: np.ndarray, printed: list[str]) -> float:
    """By how much times may be off through rounding: one in the last digit, and single precision [s]."""
    digits = max(len(re.sub(r"[ED].*|[-+.]", "", text.upper()).lstrip("0")) for text in printed)
    largest = np.abs(times).max()
    return 10.0 ** (np.floor(np.log10(largest)) + 1 - digits) + 1e-7 * largest


def _step(name: str, times: np.ndarray, numbers: list[int], printed: list[str]) -> float:
    """The time step of equally spaced times [s]."""
    if times.size < 2:
        raise file_error(name, "has one row only, so its times give no time step.")
    step = (times[-1] - times[0]) / (times.size - 1)
    if not step > 0:
        raise file_error(name, "the times in column 0 do not increase.")
    # Where rounding is half a step, to allow for it would hide a missing row.
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


def _read_csv(name, lines, dt, unit, column):
    """Samples, time step, unit and no title of a file of columns."""
    table, numbers, printed = _table(name, lines)
    width = table.shape[1]
    if column is None and width > 2 or column is not None and column >= width:
        allowed = f"be 0 to {width - 1}, the column of accelerations in text file `{name}`"
        raise ValueError(f"Argument `column` must {allowed}, but is {column}.")
    if unit is None:
        allowed = "be 'g', 'm/s2' or 'cm/s2'"
        raise ValueError(f"Argument `unit` must {allowed} for text file `{name}`, which states none, but is None.")
    chosen = width - 1 if column is None else column
    times = table[:, 0]
    # Beside `column` and `dt`, column 0 may hold accelerations too; only times never fall.
    rising = times[-1] > times[0] and (np.diff(times) >= 0).all()
    if chosen > 0 and (column is None or dt is None or rising):
        dt = _agreed_step(name, dt, _step(name, times, numbers, printed))
    if dt is None:
        raise ValueError(f"Argument `dt` must be given for text file `{name}`, which has no times, but is None.")
    return table[:, chosen], dt, unit, ""
