"""COSMOS, the format of strong-motion centres, mostly for one channel a file: V1 (uncorrected) and V2 (also V2c)."""

import re

from jaxrock._core.text import check_end, file_error, line_error
from jaxrock.motions.files.format import AbstractFormat, Accelerogram, no_acceleration
from jaxrock.motions.files.headers import agreed_step, agreed_unit, chosen_channel, first_match, places_of, text_after
from jaxrock.motions.files.parsing import PER_G, announced_columns, check_peak, fixed_numbers
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
            raise no_acceleration(name, at + 1, what, "announces")
        unit = agreed_unit(name, at + 1, unit, written)
        reals = _reals(name, lines, start)
        step = reals[_STEP] / 1000
        # The line repeats the duration, in whole seconds.
        if abs(int(count) * step - float(seconds)) > 1 + 0.01 * float(seconds):
            found = f"{count} samples in {seconds} s, but the header a time step of {step:g} s"
            raise file_error(name, f"line {at + 1} states {found}.")
        width = int(width)
        samples = announced_columns(name, lines, at + 1, int(count), width)
        last = [line for line in lines[at + 1 :] if line.strip()]
        if fixed_numbers(last[-1], width) is not None:  # no line such as "End-of-data" follows
            check_end(name, lines, [line[-width:] for line in last], by_program=True)
        largest = float(abs(samples).max())
        if reals[_PEAK] != _UNKNOWN and abs(largest - abs(reals[_PEAK])) > 1e-3 * largest:  # in the unit of the samples
            check_peak(name, at + 1, reals[_PEAK], samples * (PER_G["cm/s2"] / PER_G[unit]), "the header")
        return Accelerogram.named(samples, agreed_step(name, dt, step), unit, _origin(lines[start:at]))


def _records(lines: list[str]) -> list[tuple[int, int, int]]:
    """Return the begin, data line and end of each record of accelerations, or of all records where there are none."""
    starts = places_of(_FIRST, lines)
    found = {number: said[2] for number, line in enumerate(lines) if (said := _DATA.match(line))}
    chosen = [number for number, what in found.items() if _ACCELERATION.match(what)] or list(found)
    begins = [max((start for start in starts if start < at), default=0) for at in chosen]
    ends = [min((other for other in (*starts, *found) if other > at), default=len(lines)) for at in chosen]
    return list(zip(begins, chosen, ends))


def _reals(name: str, lines: list[str], start: int) -> list[float]:
    """Return the real header of the record that begins at a line."""
    found = first_match(_REALS, lines[start:], start)
    if found is None:
        raise file_error(name, "no line announces 'Real-header values', as a COSMOS file must.")
    at, (count, width) = found[0], map(int, found[1].groups())
    values = []
    for number, line in enumerate(lines[at:], at + 1):
        if len(values) >= count:
            break
        row = fixed_numbers(line, width)
        if row is None:
            raise line_error(name, number, "should hold values of the real header, but is", line)
        values += row
    if len(values) != count or count <= _PEAK:
        raise file_error(name, f"line {at} announces {count} values of a header, but {len(values)} follow.")
    return values


def _origin(lines: list[str]) -> Origin:
    """Return the origin from the text header, whose entries have fixed places."""
    code = text_after(r"Code:\s*(\S+)", lines)
    station = re.sub(r"^\S+\s+", "", text_after(r"Code:\s*\S+\s+(.*)", lines)) or code
    event = re.sub(r"\s+of\s+\w{3}\s+\w{3}\s+\d+,.*$", "", text_after(r"^\s*Record of\s+(.*)", lines))
    component = text_after(r"Sta Chan\s+\S*?:\s*(.*?)\s*(?:\(|$)", lines)
    channel = text_after(r"<SCNL>\s*(\S+)", lines)
    if component.lower() in ("", "other") and channel.count(".") >= 1:
        component = channel.split(".")[1]
    start = text_after(r"Rcrd start time:\s*([\d/]+,?\s+[\d:.]+)", lines).replace(",", "")
    return Origin(event, station, component, start, code)
