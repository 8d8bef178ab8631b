"""V2, the format of CSMIP (also of USC) for corrected acceleration: channels of columns of fixed width.

Spectra (V3) are recognised and refused: see `spectra`. Uncorrected accelerograms (V1) are read by `csmip_v1`.
"""

import re

import numpy as np

from jaxrock._core.text import check_end, file_error
from jaxrock.motions.files.format import AbstractFormat, Accelerogram
from jaxrock.motions.files.headers import agreed_step, agreed_unit, chosen_channel, places_of, text_after
from jaxrock.motions.files.parsing import NUMBER, announced_columns, check_peak, fields_of, fixed_numbers, to_float
from jaxrock.motions.record import Origin

# "5690 POINTS OF ACCEL DATA EQUALLY SPACED AT  .010 SEC.  (UNITS: CM/SEC/SEC)"; later files write
# ", in cm/sec2. (8f10.6)" and those of USC "IN UNITS CM/SEC/SEC".
_CHANNEL = re.compile(
    rf"^\s*(\d+)\s+POINTS OF ACC\w*\s+DATA,?\s+EQUALLY SPACED AT\s*({NUMBER})\s*SEC(?:ONDS?)?[\s.,]*"
    r"\(?\s*(?:IN\s+)?(?:UNITS\s*(?:[:=]|OF\b)?\s*)?(?!\d*[FEG]\d)([^\s,;()]*)[\s).]*(?:\(\s*\d*[FEG](\d+)\.\d+\s*\))?",
    re.IGNORECASE,
)


_SPECTRA = re.compile(r"^.*RESPONSE (?:AND FOURIER AMPLITUDE )?SPECTRA\b(?!.*:)", re.IGNORECASE)


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
        count, step, written, width = _CHANNEL.match(lines[at]).groups()
        unit = agreed_unit(name, at + 1, unit, written)
        dt = agreed_step(name, dt, to_float(step))
        width = int(width or 10)
        samples = announced_columns(name, lines, at + 1, int(count), width)
        if channel == len(channels) - 1:
            check_last_columns(name, lines, at + 1, width)
        if unit == "cm/s2":
            _check_peak(name, lines, channels[channel - 1] + 1 if channel else 0, at, samples)
        return Accelerogram(samples, dt, unit, *told(lines[:at], r"\s*CORRECTED ACCELEROGRAM", (2, 6, 7)))


def check_last_columns(name: str, lines: list[str], start: int, width: int) -> None:
    """Check that the last line of a channel, at which a file may end, is whole."""
    rows = [
        row for row, line in enumerate(lines[start:], start) if line.strip() and fixed_numbers(line, width) is not None
    ]
    if lines[-1].strip() and rows and rows[-1] == len(lines) - 1:
        check_end(name, lines, fields_of(lines[-1], width))


_PEAK = re.compile(rf"\s*PEAK\s+ACCELERATION\s*=\s*({NUMBER})\s*CM/SEC/SEC", re.IGNORECASE)


def _check_peak(name: str, lines: list[str], start: int, at: int, samples: np.ndarray) -> None:
    """Check that the largest sample is the peak that the header of a channel states, if it states one."""
    for row in range(start, at):
        found = _PEAK.match(lines[row])
        if found:
            check_peak(name, row + 1, found[1], samples)


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
