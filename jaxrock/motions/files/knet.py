"""K-NET and KiK-net, the formats of NIED: lines of a header, then counts of a digitiser."""

import re
from datetime import datetime, timedelta

from jaxrock._core.text import check_end, file_error
from jaxrock.motions.files.format import AbstractFormat, Accelerogram
from jaxrock.motions.files.headers import Header, agreed_step, agreed_unit, no_column, stated_numbers, value_of
from jaxrock.motions.files.parsing import NUMBER, announced_samples, check_peak, printed_numbers
from jaxrock.motions.record import Origin

_KEYS = (
    "Origin Time", "Lat.", "Long.", "Depth. (km)", "Mag.", "Station Code", "Station Lat.", "Station Long.",
    "Station Height(m)", "Record Time", "Sampling Freq(Hz)", "Duration Time(s)", "Dir.", "Scale Factor",
    "Max. Acc. (gal)", "Last Correction", "Memo.",
)  # fmt: skip
_TIME = "%Y/%m/%d %H:%M:%S"
# KiK-net numbers its channels: first those in the borehole, then those at the surface.
_CHANNELS = {"1": "N-S", "2": "E-W", "3": "U-D", "4": "N-S", "5": "E-W", "6": "U-D"}


class KNET(AbstractFormat):
    """K-NET and KiK-net, without their offset: the mean of all samples is subtracted, as it is in the stated peak."""

    name = "knet"
    suffixes = (".ew", ".ns", ".ud", ".ew1", ".ns1", ".ud1", ".ew2", ".ns2", ".ud2")
    single = True

    def recognises(self, lines):
        header = _header(lines)
        return {"Sampling Freq(Hz)", "Scale Factor", "Duration Time(s)"} <= set(header)

    def read(self, name, lines, dt, unit, column):
        no_column(name, column, "K-NET")
        header = _header(lines)
        (rate,) = stated_numbers(name, header, "Sampling Freq(Hz)", rf"({NUMBER})\s*Hz")
        (duration,) = stated_numbers(name, header, "Duration Time(s)")
        gal, counts = stated_numbers(name, header, "Scale Factor", rf"({NUMBER})\s*\(gal\)\s*/\s*({NUMBER})")
        if not (rate > 0 and duration > 0 and gal > 0 and counts > 0):
            raise file_error(name, "header must state a positive frequency, duration and scale factor.")
        unit = agreed_unit(name, header["Scale Factor"][0], unit, "gal")
        start = max(line for line, _ in header.values())
        samples = announced_samples(name, lines, start, round(rate * duration), _counts)
        check_end(name, lines, printed_numbers(lines[start:]))
        samples = (samples - samples.mean()) * (gal / counts)
        if "Max. Acc. (gal)" in header:
            stated_numbers(name, header, "Max. Acc. (gal)")
            check_peak(name, *header["Max. Acc. (gal)"], samples)
        return Accelerogram.named(samples, agreed_step(name, dt, 1 / rate), unit, _origin(header))


def _origin(header: Header) -> Origin:
    """Return the origin that the header states."""
    keys = "Origin Time", "Mag.", "Station Code", "Dir.", "Record Time"
    time, magnitude, code, direction, recorded = (value_of(header, key)[1] for key in keys)
    event = " ".join(filter(None, (time, magnitude and "M" + magnitude)))
    return Origin(event, code, _CHANNELS.get(direction, direction), _start(recorded), code)


def _start(recorded: str) -> str:
    """Return the time of the first sample, in Japan's time: the logger's delay makes the header state it 15 s late."""
    try:
        first = datetime.strptime(recorded, _TIME) - timedelta(seconds=15)
    except ValueError:
        return ""
    return f"{first.strftime(_TIME)} JST"


def _header(lines: list[str]) -> Header:
    """Return line number and value of every key."""
    found = {}
    for number, line in enumerate(lines[:17], 1):
        key = next((key for key in _KEYS if line.startswith(key)), None)
        if key is None:
            break
        found[key] = number, line[len(key) :].strip()
    return found


def _counts(line: str) -> list[float] | None:
    """Return the whole numbers in a line, or None if it holds anything else."""
    return [float(word) for word in line.split()] if re.fullmatch(r"\s*[-+]?\d+(\s+[-+]?\d+)*\s*", line) else None
