"""V2, the format of CSMIP (also of USC) for corrected acceleration: channels of columns of fixed width.

A V1 file (uncorrected) of evenly spaced samples announces them likewise; spectra (V3) are refused by what they are.
"""

import re

import numpy as np

from jaxrock._text import check_end, file_error
from jaxrock.motions.files.format import AbstractFormat, Accelerogram
from jaxrock.motions.files.parsing import (
    NUMBER,
    agreed_step,
    agreed_unit,
    announced_columns,
    check_peak,
    fixed_numbers,
    to_float,
)
from jaxrock.motions.record import Origin

# "5690 POINTS OF ACCEL DATA EQUALLY SPACED AT  .010 SEC.  (UNITS: CM/SEC/SEC)"; later files write
# ", in cm/sec2. (8f10.6)" and those of USC "IN UNITS CM/SEC/SEC".
_CHANNEL = re.compile(
    rf"^\s*(\d+)\s+POINTS OF ACC\w*\s+DATA,?\s+EQUALLY SPACED AT\s*({NUMBER})\s*SEC(?:ONDS?)?[\s.,]*"
    r"\(?\s*(?:IN\s+)?(?:UNITS\s*[:=]?\s*)?([^\s,;()]*)[\s).]*(?:\(\s*\d*[FEG](\d+)\.\d+\s*\))?",
    re.IGNORECASE,
)


_OTHER = re.compile(
    r"^\s*(?:UNCORRECTED ACCELEROGRAM|.*RESPONSE (?:AND FOURIER AMPLITUDE )?SPECTRA\b(?!.*:))", re.IGNORECASE
)


class CSMIP(AbstractFormat):
    """CSMIP V2, and V1 where it is evenly spaced."""

    name = "v2"
    suffixes = (".v2",)

    def recognises(self, lines):
        return any(map(_CHANNEL.match, lines)) or any(map(_OTHER.match, lines[:1]))

    def read(self, name, lines, dt, unit, column):
        channels = [number for number, line in enumerate(lines) if _CHANNEL.match(line)]
        if not channels:
            other = _OTHER.match(lines[0])
            if other:
                kind = "response spectra (V3)" if "SPECTRA" in other[0].upper() else "uncorrected pairs (V1)"
                raise file_error(name, f"holds {kind}, but not evenly spaced accelerations: take its V2 file.")
            raise file_error(name, "no line announces 'POINTS OF ACCEL DATA', as a corrected V2 file must.")
        channel = 0 if column is None else column
        if channel >= len(channels):
            allowed = f"be 0 to {len(channels) - 1}, a channel of V2 file `{name}`"
            raise ValueError(f"Argument `column` must {allowed}, but is {channel}.")
        at = channels[channel]
        count, step, written, width = _CHANNEL.match(lines[at]).groups()
        unit = agreed_unit(name, at + 1, unit, written)
        dt = agreed_step(name, dt, to_float(step))
        width = int(width or 10)
        samples = announced_columns(name, lines, at + 1, int(count), width)
        if channel == len(channels) - 1:
            _check_end(name, lines, at + 1, width)
        if unit == "cm/s2":
            _check_peak(name, lines, channels[channel - 1] + 1 if channel else 0, at, samples)
        return Accelerogram(samples, dt, unit, *_told(lines[:at]))


def _check_end(name: str, lines: list[str], start: int, width: int) -> None:
    """The last line of a channel, at which a file may end, is whole."""
    rows = [
        row for row, line in enumerate(lines[start:], start) if line.strip() and fixed_numbers(line, width) is not None
    ]
    if lines[-1].strip() and rows and rows[-1] == len(lines) - 1:
        last = lines[-1].rstrip()
        check_end(name, lines, [last[k : k + width] for k in range(0, len(last), width)])


_PEAK = re.compile(rf"\s*PEAK\s+ACCELERATION\s*=\s*({NUMBER})\s*CM/SEC/SEC", re.IGNORECASE)


def _check_peak(name: str, lines: list[str], start: int, at: int, samples: np.ndarray) -> None:
    """The largest sample is the peak that the header of a channel states, if it does."""
    for row in range(start, at):
        found = _PEAK.match(lines[row])
        if found:
            check_peak(name, row + 1, to_float(found[1]), samples)


def _told(lines: list[str]) -> tuple[str, Origin]:
    """Event, station and channel in the lines before a channel's samples: in a title, and as what they are."""
    # The text header of each channel starts with this line; the three have fixed places in it.
    starts = [row for row, line in enumerate(lines) if re.match(r"\s*CORRECTED ACCELEROGRAM", line, re.IGNORECASE)]
    header = lines[starts[-1] :] if starts else []
    parts = [re.split(r"(?<![:\s])\s{3,}|\s{2,}\(", header[row].strip())[0] for row in (2, 6, 7) if row < len(header)]
    parts = [" ".join(part.split()) for part in parts]
    event, station, channel = (*parts, "", "", "")[:3]
    text = "\n".join(header[:10])
    start = re.search(r"TRIGGER TIME:\s*(.*)", text, re.IGNORECASE)
    code = re.search(r"STATION NO\.?\s*(\S+)", text, re.IGNORECASE)
    component = re.sub(r"^CHAN\s*\w*\s*:\s*", "", channel, flags=re.IGNORECASE)
    told = (" ".join(found[1].split()) if found else "" for found in (start, code))
    return ", ".join(filter(None, parts)), Origin(event, station, component, *told)
