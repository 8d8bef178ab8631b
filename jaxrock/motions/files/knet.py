"""K-NET and KiK-net, the formats of NIED: lines of a header, then counts of a digitiser."""

import re
from datetime import datetime, timedelta

from jaxrock._text import check_end, file_error
from jaxrock.motions.files.format import AbstractFormat, Accelerogram
from jaxrock.motions.files.parsing import (
    NUMBER,
    agreed_step,
    agreed_unit,
    announced_samples,
    check_peak,
    no_column,
    plain_numbers,
)
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
        rate = _stated(name, header, "Sampling Freq(Hz)", rf"({NUMBER})\s*Hz")[0]
        duration = _stated(name, header, "Duration Time(s)", rf"({NUMBER})")[0]
        gal, counts = _stated(name, header, "Scale Factor", rf"({NUMBER})\s*\(gal\)\s*/\s*({NUMBER})")
        if not (rate > 0 and duration > 0 and gal > 0 and counts > 0):
            raise file_error(name, "header must state a positive frequency, duration and scale factor.")
        unit = agreed_unit(name, header["Scale Factor"][0], unit, "gal")
        start = max(line for line, _ in header.values())
        samples = announced_samples(name, lines, start, round(rate * duration), _counts, plain_numbers)
        check_end(name, lines, [word for line in (*lines[start : start + 50], *lines[-3:]) for word in line.split()])
        samples = (samples - samples.mean()) * (gal / counts)
        if "Max. Acc. (gal)" in header:
            line, value = header["Max. Acc. (gal)"]
            _stated(name, header, "Max. Acc. (gal)", rf"({NUMBER})")
            check_peak(name, line, value, samples)
        told = {key: value for key, (_, value) in header.items()}
        component = _CHANNELS.get(told.get("Dir.", ""), told.get("Dir.", ""))
        event = " ".join(filter(None, (told.get("Origin Time"), told.get("Mag.") and "M" + told["Mag."])))
        code = told.get("Station Code", "")
        title = ", ".join(filter(None, (event, code, component)))
        return Accelerogram(
            samples,
            agreed_step(name, dt, 1 / rate),
            unit,
            title,
            Origin(event, code, component, _start(told.get("Record Time", "")), code),
        )


def _start(recorded: str) -> str:
    """Return the time of the first sample, in Japan's time: the logger's delay makes the header state it 15 s late."""
    try:
        first = datetime.strptime(recorded, _TIME) - timedelta(seconds=15)
    except ValueError:
        return ""
    return f"{first.strftime(_TIME)} JST"


def _header(lines: list[str]) -> dict[str, tuple[int, str]]:
    """Return line number and value of every key."""
    found = {}
    for number, line in enumerate(lines[:17], 1):
        key = next((key for key in _KEYS if line.startswith(key)), None)
        if key is None:
            break
        found[key] = number, line[len(key) :].strip()
    return found


def _stated(name: str, header: dict, key: str, pattern: str) -> list[float]:
    """Return the numbers that the header must state."""
    line, value = header.get(key, (0, ""))
    found = re.fullmatch(pattern, value, re.IGNORECASE)
    if not found:
        raise file_error(name, f"header must state a number as {key!r}, but states {value!r}.")
    return [float(word) for word in found.groups()]


def _counts(line: str) -> list[float] | None:
    """Return the whole numbers in a line, or None if it holds anything else."""
    return [float(word) for word in line.split()] if re.fullmatch(r"\s*[-+]?\d+(\s+[-+]?\d+)*\s*", line) else None
