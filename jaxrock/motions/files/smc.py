"""SMC, the format of the USGS: eleven lines of text, numbers of two headers in fixed places, comments, samples."""

import re

from jaxrock._core.text import check_end, file_error
from jaxrock.motions.files.format import AbstractFormat, Accelerogram, no_acceleration
from jaxrock.motions.files.headers import agreed_step, agreed_unit, no_column, text_after
from jaxrock.motions.files.parsing import announced_columns, check_peak, fields_of, fixed_numbers
from jaxrock.motions.record import Origin

_TEXT, _WHOLE, _REAL = 11, 6, 10  # lines of each header
_FIRST = re.compile(r"^\s*([0-9])\s+((?:UN)?CORRECTED ACCELEROGRAM|VELOCITY|DISPLACEMENT|.*SPECTR\w+)", re.IGNORECASE)
_COMMENTS, _COUNT = 15, 16  # places among the whole numbers
_RATE, _LARGEST, _SMALLEST = 1, 29, 31  # places among the real numbers: samples a second, peaks [cm/s2]
_UNKNOWN = 1e38
_WIDTH = 10


class SMC(AbstractFormat):
    """SMC of the USGS, in cm/s^2."""

    name = "smc"
    suffixes = (".smc",)
    single = True

    def recognises(self, lines):
        return len(lines) > 28 and bool(_FIRST.match(lines[0])) and _whole(lines) is not None

    def read(self, name, lines, dt, unit, column):
        no_column(name, column, "SMC")
        kind = _FIRST.match(lines[0])
        if not kind or len(lines) < _TEXT + _WHOLE + _REAL:
            raise file_error(name, "line 1 does not say what the file holds, as an SMC file must.")
        if "ACCELEROGRAM" not in kind[2].upper():
            raise no_acceleration(name, 1, kind[2])
        whole, real = _whole(lines), _real(lines)
        if whole is None or real is None:
            raise file_error(name, "lines 12 to 27 should hold the numbers of an SMC file's headers.")
        if real[_RATE] >= _UNKNOWN:
            said = "states no samples a second, so the file holds times and samples that are not equally spaced"
            told = "take its corrected file, or interpolate them at equal steps for a `Record`"
            raise file_error(name, f"line {_TEXT + _WHOLE + 1} {said}: {told}.")
        if not real[_RATE] > 0:
            raise file_error(name, f"line {_TEXT + _WHOLE + 1} states {real[_RATE]:g} samples a second.")
        unit = agreed_unit(name, 1, unit, "cm/s2")
        start = _TEXT + _WHOLE + _REAL + max(whole[_COMMENTS], 0)
        if any(not line.startswith("|") for line in lines[_TEXT + _WHOLE + _REAL : start]):
            raise file_error(name, f"header announces {whole[_COMMENTS]} lines of comments, which are not there.")
        samples = announced_columns(name, lines, start, whole[_COUNT], _WIDTH)
        last = next(line for line in reversed(lines) if line.strip()).rstrip()
        check_end(name, lines, [lines[start][:_WIDTH]] * 2 + [last[-_WIDTH:]], by_program=True)
        peaks = [abs(real[place]) for place in (_LARGEST, _SMALLEST) if abs(real[place]) < _UNKNOWN]
        if peaks:
            check_peak(name, 18, max(peaks), samples, "the header")
        return Accelerogram.named(samples, agreed_step(name, dt, 1 / real[_RATE]), unit, _origin(lines[:_TEXT]))


def _whole(lines: list[str]) -> list[int] | None:
    """Return the 48 whole numbers of the header; None if it is not valid."""
    rows = [line.rstrip() for line in lines[_TEXT : _TEXT + _WHOLE]]
    if any(len(row) % _WIDTH or not re.fullmatch(r"[\s\d-]+", row) for row in rows):
        return None
    fields = [field.strip() for row in rows for field in fields_of(row, _WIDTH)]
    if len(fields) != 48 or not all(re.fullmatch(r"-?\d+", field) for field in fields):
        return None
    return [int(field) for field in fields]


def _real(lines: list[str]) -> list[float] | None:
    """Return the 50 real numbers of the header; None if it is not valid."""
    rows = [fixed_numbers(line, 15) for line in lines[_TEXT + _WHOLE : _TEXT + _WHOLE + _REAL]]
    numbers = [x for row in rows if row is not None for x in row]
    return None if None in rows or len(numbers) != 50 else numbers


def _origin(lines: list[str]) -> Origin:
    """Return the origin from the text header, whose entries have fixed places."""
    event, named = [lines[3].rstrip()], [lines[5]]
    return Origin(
        text_after(r"^\s*\d+\s+\d+\s+\d+\s+\d+\s+(.*)", event),
        # The name has thirty characters, with or without a comma before the component, and blanks up to its end.
        text_after(r"^\s*station\s*=\s*(.*?)\s*(?:\bcomponent\s*=.*)?$", named),
        text_after(r"^\s*station\s*=.*?\bcomponent\s*=(.*)", named),
        text_after(r"^\s*(\d+\s+\d+\s+\d+\s+\d+)\s", event),
        lines[2].strip(),
    )
