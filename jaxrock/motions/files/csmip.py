"""V2, the format of CSMIP (also of USC) for corrected acceleration: channels of columns of fixed width.

Spectra (V3) are recognised and refused: see `spectra`. Uncorrected accelerograms (V1) are read by `csmip_v1`.
"""

import re

import numpy as np

from jaxrock._core.text import check_end, file_error
from jaxrock.motions.files.format import AbstractFormat, Accelerogram
from jaxrock.motions.files.headers import agreed_step, agreed_unit, chosen_channel, places_of, text_after
from jaxrock.motions.files.parsing import (
    NUMBER,
    PER_G,
    announced_columns,
    check_peak,
    data_lines,
    fields_of,
    fixed_numbers,
    numbers_of_width,
    to_float,
    unit_named,
)
from jaxrock.motions.record import Origin

# "5690 POINTS OF ACCEL DATA EQUALLY SPACED AT  .010 SEC.  (UNITS: CM/SEC/SEC)"; later files write
# ", in cm/sec2. (8f10.6)" and those of USC "IN UNITS CM/SEC/SEC".
_CHANNEL = re.compile(
    rf"^\s*(\d+)\s+POINTS OF ACC\w*\s+DATA,?\s+EQUALLY SPACED AT\s*({NUMBER})\s*SEC(?:ONDS?)?[\s.,]*"
    r"\(?\s*(?:IN\s+)?(?:UNITS\s*(?:[:=]|OF\b)?\s*)?(?!\d*[FEG]\d)([^\s,;()]*)[\s).]*(?:\(\s*\d*[FEG](\d+)\.\d+\s*\))?",
    re.IGNORECASE,
)


_SPECTRA = re.compile(r"^.*RESPONSE (?:AND FOURIER AMPLITUDE )?SPECTRA\b(?!.*:)", re.IGNORECASE)


def announces(line: str) -> bool:
    """Return whether a line announces the samples of a channel."""
    return _CHANNEL.match(line) is not None


def announced(lines: list[str], at: int) -> tuple[int, float, str, int]:
    """Return the count, the time step [s], the unit and the width of the samples that a line announces.

    Where the line states no width, it is 10, unless another gives as many numbers as it announces.
    """
    found = _CHANNEL.match(lines[at])
    assert found is not None  # the caller has matched the line
    count, step, unit, width = found.groups()
    block = data_lines(lines, at + 1)
    widths = [int(width)] if width else [10, *range(7, 16)]
    read = ((each, numbers_of_width(block, each)) for each in widths if len(widths) > 1)
    fitting = (each for each, numbers in read if numbers is not None and len(numbers) == int(count))
    return int(count), to_float(step), unit, next(fitting, widths[0])


class CSMIP(AbstractFormat):
    """CSMIP V2."""

    name = "v2"
    suffixes = (".v2",)

    def recognises(self, lines):
        return any(map(_CHANNEL.match, lines)) or any(map(_SPECTRA.match, lines[:1]))

    def read(self, name, lines, dt, unit, column):
        channels = places_of(_CHANNEL, lines)
        if not channels:
            if _SPECTRA.match(lines[0]):
                said = "take its V2 file, or `jaxrock.motions.read_spectra`"
                raise file_error(name, f"holds response spectra (V3), but no accelerations: {said}.")
            raise file_error(name, "no line announces 'POINTS OF ACCEL DATA', as a corrected V2 file must.")
        channel = chosen_channel(name, "V2", column, len(channels))
        at = channels[channel]
        count, step, written, width = announced(lines, at)
        unit = agreed_unit(name, at + 1, unit, written)
        dt = agreed_step(name, dt, step)
        samples = announced_columns(name, lines, at + 1, count, width)
        if channel == len(channels) - 1:
            check_last_columns(name, lines, at + 1, width)
        _check_peak(name, lines, channels[channel - 1] + 1 if channel else 0, at, samples, unit)
        return Accelerogram(samples, dt, unit, *told(lines[:at], r"\s*CORRECTED ACCELEROGRAM", (2, 6, 7)))


def check_last_columns(name: str, lines: list[str], start: int, width: int) -> None:
    """Check that the last line of a channel, at which a file may end, is whole."""
    rows = [
        row for row, line in enumerate(lines[start:], start) if line.strip() and fixed_numbers(line, width) is not None
    ]
    if lines[-1].strip() and rows and rows[-1] == len(lines) - 1:
        check_end(name, lines, fields_of(lines[-1], width))


_PEAK = re.compile(rf"\s*PEAK\s+ACCELERATION\s*[=:]\s*({NUMBER})\s*([A-Z]\S*?)[,.;]?(?:\s|$)", re.IGNORECASE)


def _check_peak(name: str, lines: list[str], start: int, at: int, samples: np.ndarray, unit: str) -> None:
    """Check that the largest sample is the peak that the header of a channel states, if it states one."""
    for row in range(start, at):
        found = _PEAK.match(lines[row])
        stated = unit_named(found[2]) if found else None
        if found and stated:
            check_peak(name, row + 1, found[1], samples * (PER_G[stated] / PER_G[unit]), unit=stated)


# CSMIP writes "CHAN  2: 360 DEG", USC "COMP N08W".
_BEFORE_COMPONENT = re.compile(r"^(?:CHAN\s*\w*\s*:|COMP(?:ONENT)?\b[.:=]?)\s*", re.IGNORECASE)


def told(lines: list[str], first: str, places: tuple[int, int, int]) -> tuple[str, Origin]:
    """Return event, station and channel in the lines before a channel's samples: as one title, and as an `Origin`.

    `first`: pattern of the first line of a channel's text header; `places` of the three in it, counted in lines.
    """
    starts = places_of(re.compile(first, re.IGNORECASE), lines)
    header = lines[starts[-1] :] if starts else []
    parts = [re.split(r"(?<![:\s])\s{3,}|\s{2,}\(", header[row].strip())[0] for row in places if row < len(header)]
    parts = [" ".join(part.split()) for part in parts]
    event, station, channel = (*parts, "", "", "")[:3]
    text = ["\n".join(header[:10])]
    start = text_after(r"(?:TRIGGER|START) TIME:\s*(.*)", text)
    code = text_after(r"STATION (?:NO\.?|ID\.)\s*(\S+)", text)
    component = _BEFORE_COMPONENT.sub("", channel)
    return ", ".join(filter(None, parts)), Origin(event, station, component, start, code)
