"""V2, the format of CSMIP (also of USC) for corrected acceleration: channels of columns of fixed width."""

import re

from jaxrock._text import file_error
from jaxrock.motions.files.format import AbstractFormat, Accelerogram
from jaxrock.motions.files.parsing import NUMBER, agreed_step, agreed_unit, announced_samples, to_float

# "5690 POINTS OF ACCEL DATA EQUALLY SPACED AT  .010 SEC.  (UNITS: CM/SEC/SEC)"; later files write
# ", in cm/sec2. (8f10.6)" and those of USC "IN UNITS CM/SEC/SEC".
_CHANNEL = re.compile(
    rf"^\s*(\d+)\s+POINTS OF ACC\w*\s+DATA,?\s+EQUALLY SPACED AT\s*({NUMBER})\s*SEC(?:ONDS?)?[\s.,]*"
    r"\(?\s*(?:IN\s+)?(?:UNITS\s*[:=]?\s*)?([^\s,;()]*)[\s).]*(?:\(\s*\d*[FEG](\d+)\.\d+\s*\))?",
    re.IGNORECASE,
)


class CSMIP(AbstractFormat):
    """CSMIP V2."""

    name = "v2"
    suffixes = (".v2",)

    def recognises(self, lines):
        return any(map(_CHANNEL.match, lines))

    def read(self, name, lines, dt, unit, column):
        channels = [number for number, line in enumerate(lines) if _CHANNEL.match(line)]
        if not channels:
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
        samples = announced_samples(name, lines, at + 1, int(count), lambda line: _numbers(line, width))
        return Accelerogram(samples, dt, unit, _title(lines[:at]))


def _numbers(line: str, width: int) -> list[float] | None:
    """The numbers in a line of columns `width` wide, which may touch, or None if it holds anything else."""
    line = line.rstrip()
    fields = [line[start : start + width].strip() for start in range(0, len(line), width)]
    if not all(re.fullmatch(NUMBER, field) for field in fields):
        return None
    return [to_float(field) for field in fields]


def _title(lines: list[str]) -> str:
    """Event, station and channel in the lines before a channel's samples."""
    # The text header of each channel starts with this line; the three have fixed places in it.
    starts = [row for row, line in enumerate(lines) if re.match(r"\s*CORRECTED ACCELEROGRAM", line, re.IGNORECASE)]
    header = lines[starts[-1] :] if starts else []
    parts = [re.split(r"(?<![:\s])\s{3,}|\s{2,}\(", header[row].strip())[0] for row in (2, 6, 7) if row < len(header)]
    return ", ".join(" ".join(part.split()) for part in parts if part)
