"""GeoNet (GNS Science, New Zealand), V1A and V2A: for each component 16 lines of text, 10 of numbers, then samples.

Samples are in mm/s^2, ten to a row. In V2A files the rows of velocities and displacements follow them.

**Source:** GNS Science, accelerogram data file format (2012).
"""

import re

from jaxrock._core.text import check_end, file_error
from jaxrock.motions.files.format import AbstractFormat, Accelerogram
from jaxrock.motions.files.headers import agreed_step, agreed_unit, chosen_channel, first_match, places_of, text_after
from jaxrock.motions.files.parsing import NUMBER, announced_columns, check_peak, fields_of, fixed_numbers, to_float
from jaxrock.motions.record import Origin

_FIRST = re.compile(r"\s*(un)?corrected accelerogram\b.*\bGNS Science\b", re.IGNORECASE)
_TEXT, _HEADER, _WIDTH, _IN_A_ROW = 16, 26, 8, 10  # lines of text, lines before the samples, columns and numbers
_COUNT = re.compile(r"Number of points\s+(\d+)", re.IGNORECASE)
_STEP = re.compile(rf"\bat\s+(?:intervals of\s+|(?=\S+\s*sec\s+intervals))({NUMBER})\s*s", re.IGNORECASE)
_UNIT = re.compile(rf"Raw readings in units of\s+({NUMBER})\s+(\S+)", re.IGNORECASE)
_PEAK = re.compile(rf"Acceleration:\s+peak\s+({NUMBER})\s+(\S+)", re.IGNORECASE)
_COUNTS = 3  # row of the whole numbers with the counts; of V2A acceleration, velocity and displacement from place 3 on


class GeoNet(AbstractFormat):
    """GeoNet V1A and V2A, in mm/s^2."""

    name = "geonet"
    suffixes = (".v1a", ".v2a")

    def recognises(self, lines):
        return bool(_FIRST.match(lines[0])) and len(lines) > _HEADER

    def read(self, name, lines, dt, unit, column):
        starts = places_of(_FIRST, lines)
        if not starts or starts[0]:
            raise file_error(name, "line 1 does not name an accelerogram of GNS Science, as a GeoNet file must.")
        channel = chosen_channel(name, "GeoNet", column, len(starts))
        first = starts[channel]
        stop = starts[channel + 1] if channel + 1 < len(starts) else len(lines)
        if stop - first < _HEADER:
            raise file_error(
                name, f"the component in line {first + 1} has {stop - first} lines, but its header {_HEADER}."
            )
        text = lines[first : first + _TEXT]
        count, step = int(_stated(name, first, text, _COUNT)[1]), to_float(_stated(name, first, text, _STEP)[1])
        number, scale = first_match(_UNIT, text, first) or (first + 1, None)
        if scale is not None and to_float(scale[1]) != 1:
            raise file_error(name, f"line {number} states readings in units of {scale[1]} {scale[2]}, but 1 is known.")
        unit = agreed_unit(name, number, unit, "mm/s2" if scale is None else scale[2])
        rows = -(-count // _IN_A_ROW)
        begin = first + _HEADER
        _check_rows(name, lines, first, begin + rows, stop, count)
        samples = announced_columns(name, lines[: begin + rows], begin, count, _WIDTH)
        if stop == len(lines):
            last = [line for line in lines[begin:] if line.strip()][-2:]
            check_end(name, lines, [field for line in last for field in fields_of(line, _WIDTH)], by_program=True)
        peak = first_match(_PEAK, text, first)
        if peak is not None:
            check_peak(name, peak[0], peak[1][1], samples, unit="mm/s2")
        return Accelerogram.named(samples, agreed_step(name, dt, step), unit, _origin(text))

    def components(self, name, lines):
        """Return the channels, of which GeoNet's files have three: two horizontal ones and the vertical one."""
        count = len(places_of(_FIRST, lines))
        if count < 2:
            told = f"GeoNet file `{name}` holds one component"
            raise ValueError(f"Argument `paths` must be a file for each component, because {told}.")
        return tuple(range(count))


def _stated(name: str, first: int, text: list[str], pattern: re.Pattern) -> re.Match:
    """Return what the text of a component must state."""
    found = first_match(pattern, text, first)
    if found is None:
        what = "number of points" if pattern is _COUNT else "interval of its samples"
        raise file_error(name, f"lines {first + 1} to {first + _TEXT} state no {what}, as a GeoNet file must.")
    return found[1]


def _check_rows(name: str, lines: list[str], first: int, end: int, stop: int, count: int) -> None:
    """Check the rows of numbers in the header, and the rows after the samples, against what the header announces."""
    rows = [fixed_numbers(line, _WIDTH) for line in lines[first + _TEXT : first + _HEADER]]
    if any(row is None or len(row) != _IN_A_ROW for row in rows):
        raise file_error(name, f"lines {first + _TEXT + 1} to {first + _HEADER} should hold ten numbers each.")
    counts = [int(x) for x in rows[_COUNTS] or ()]
    corrected = _FIRST.match(lines[first])[1] is None  # type: ignore[index]
    stated = counts[3] if corrected else counts[0]
    if stated not in (0, count):
        raise file_error(name, f"the header announces {count} samples in words, but {stated} in numbers.")
    more = [x for x in counts[4:6] if x > 0] if corrected else []
    wanted = sum(-(-x // _IN_A_ROW) for x in more)
    there = sum(bool(line.strip()) for line in lines[end:stop])
    if there != wanted:
        told = f"{there} rows follow its {count} samples, but the header announces {wanted}"
        raise file_error(name, f"of the component in line {first + 1}, {told}.")


def _origin(text: list[str]) -> Origin:
    """Return the origin from the text of a component."""
    return Origin(
        text[6].strip(),
        text[2].strip(),
        text_after(r"^\s*Component\s+(\S+)", text),
        text[7].strip(),
        text_after(r"^\s*Site\s+(\S+)", text),
    )
