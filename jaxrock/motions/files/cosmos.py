"""COSMOS, the format of strong-motion centres, mostly for one channel a file: V1 (uncorrected) and V2 (also V2c)."""

import re

from jaxrock._text import check_end, file_error
from jaxrock.motions.files.csmip import chosen_channel
from jaxrock.motions.files.format import AbstractFormat, Accelerogram
from jaxrock.motions.files.parsing import (
    agreed_step,
    agreed_unit,
    announced_columns,
    check_peak,
    fixed_numbers,
)
from jaxrock.motions.record import Origin

# "   42000 acceleration pts, approx  210 secs, units=cm/sec2(04),Format=(1E15.6)"
_DATA = re.compile(
    r"^\s*(\d+)\s+(.*?)\s*(?:pts|points)\b.*?\bapprox\s+([\d.]+)\s*secs?.*?\bunits\s*=\s*([^\s(,]+)\s*(?:\(\s*\d+\s*\))?"
    r".*?\bformat\s*=\s*\(\s*(\d*)[FE](\d+)\.\d+",
    re.IGNORECASE,
)
_FIRST = re.compile(r"^\s*(RAW|UNCORRECTED|CORRECTED|RESPONSE)\b.*\(\s*FORMAT\s+V?\d", re.IGNORECASE)
_SPECTRA = re.compile(r"^\s*RESPONSE\b.*\(\s*FORMAT\s+V?\d", re.IGNORECASE)
_REALS = re.compile(r"^\s*(\d+)\s+Real-header values follow.*?\(\s*\d*F(\d+)\.\d+", re.IGNORECASE)
_ACCELERATION = re.compile(r"(uncor\w*\s+|raw\s+)?accel", re.IGNORECASE)
_STEP, _PEAK, _UNKNOWN = 61, 63, -999.0  # places in the real header: time step [ms], largest sample


def is_spectra(lines: list[str]) -> bool:
    """Return whether these are the lines of a COSMOS V3 file: response spectra, of which the package reads CSMIP's
    alone."""
    return any(map(_SPECTRA.match, lines[:3]))


class COSMOS(AbstractFormat):
    """COSMOS V1 and V2."""

    name = "cosmos"
    suffixes = (".v1c", ".v2c")

    def recognises(self, lines):
        if is_spectra(lines):  # recognised, so that `read` can say what it is
            return True
        return any(_FIRST.match(line) for line in lines[:3]) and any(map(_DATA.match, lines[:400]))

    def read(self, name, lines, dt, unit, column):
        records = _records(lines)
        if not records and is_spectra(lines):
            raise file_error(
                name, "holds response spectra (COSMOS V3), but no accelerations: read the record's V2 file."
            )
        if not records:
            raise file_error(name, "no line announces 'acceleration pts', as a COSMOS file must.")
        start, at, end = records[chosen_channel(name, "COSMOS", column, len(records))]
        lines = lines[:end]
        count, what, seconds, written, per_line, width = _DATA.match(lines[at]).groups()
        if not _ACCELERATION.match(what):
            raise file_error(name, f"line {at + 1} announces {what.lower()}, but samples must be accelerations.")
        unit = agreed_unit(name, at + 1, unit, written)
        reals = _reals(name, lines, start)
        step = reals[_STEP] / 1000
        # The line repeats the duration, in whole seconds.
        if abs(int(count) * step - float(seconds)) > 1 + 0.01 * float(seconds):
            found = f"{count} samples in {seconds} s, but the header a time step of {step:g} s"
            raise file_error(name, f"line {at + 1} states {found}.")
        width = int(width)
        samples = announced_columns(name, lines, at + 1, int(count), width)
        if not any(re.match(r"\s*End-of-data", line, re.IGNORECASE) for line in lines[at + 1 :][-20:]):
            check_end(name, lines, [line[-width:] for line in lines[at + 1 :] if line.strip()], by_program=True)
        if unit == "cm/s2" and reals[_PEAK] != _UNKNOWN:
            check_peak(name, at + 1, reals[_PEAK], samples, "the header")
        origin = _origin(lines[start:at])
        title = ", ".join(filter(None, (origin.event, origin.station, origin.component)))
        return Accelerogram(samples, agreed_step(name, dt, step), unit, title, origin)


def _records(lines: list[str]) -> list[tuple[int, int, int]]:
    """Return the begin, data line and end of each record of accelerations, or of all records where there are none."""
    starts = [number for number, line in enumerate(lines) if _FIRST.match(line)]
    found = {number: said[2] for number, line in enumerate(lines) if (said := _DATA.match(line))}
    chosen = [number for number, what in found.items() if _ACCELERATION.match(what)] or list(found)
    begins = [max((start for start in starts if start < at), default=0) for at in chosen]
    ends = [min((other for other in (*starts, *found) if other > at), default=len(lines)) for at in chosen]
    return list(zip(begins, chosen, ends))


def _reals(name: str, lines: list[str], start: int) -> list[float]:
    """Return the real header of the record that begins at a line."""
    numbered = enumerate(lines[start:], start)
    at, found = next(((n, found) for n, line in numbered if (found := _REALS.match(line))), (0, None))
    if found is None:
        raise file_error(name, "no line announces 'Real-header values', as a COSMOS file must.")
    count, width = map(int, found.groups())
    values = []
    for number, line in enumerate(lines[at + 1 :], at + 2):
        if len(values) >= count:
            break
        row = fixed_numbers(line, width)
        if row is None:
            raise file_error(
                name, f"line {number} should hold values of the real header, but is {line.strip()[:60]!r}."
            )
        values += row
    if len(values) != count or count <= _PEAK:
        raise file_error(name, f"line {at + 1} announces {count} values of a header, but {len(values)} follow.")
    return values


def _origin(lines: list[str]) -> Origin:
    """Return the origin from the text header, whose entries have fixed places."""

    def after(pattern: str) -> str:
        found = next((m for line in lines for m in [re.search(pattern, line, re.IGNORECASE)] if m), None)
        return " ".join(found[1].split()) if found else ""

    code = after(r"Code:\s*(\S+)")
    station = re.sub(r"^\S+\s+", "", after(r"Code:\s*\S+\s+(.*)")) or code
    event = re.sub(r"\s+of\s+\w{3}\s+\w{3}\s+\d+,.*$", "", after(r"^\s*Record of\s+(.*)"))
    component = after(r"Sta Chan\s+\S*?:\s*(.*?)\s*(?:\(|$)")
    channel = after(r"<SCNL>\s*(\S+)")
    if component.lower() in ("", "other") and channel.count(".") >= 1:
        component = channel.split(".")[1]
    start = after(r"Rcrd start time:\s*([\d/]+,?\s+[\d:.]+)").replace(",", "")
    return Origin(event, station, component, start, code)
