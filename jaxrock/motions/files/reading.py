"""Accelerograms from files of any format: the table of formats, and `read_record`.

A reader trusts only the file's and the user's statements. It never guesses a unit or a time step. Where a header of a
known format announces a count, a unit or a time step, contradictions raise. Columns of text get units from titles, and
time steps from a column of times. A time step in a comment ("# dt = 0.02") is not read.
"""

import os
import re
import warnings
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import ArrayLike

from jaxrock._arguments.annotations import arguments, at_least, path_of, word_of
from jaxrock._arguments.ranges import one_of, scalar, size
from jaxrock._core.precision import frames_of_the_package
from jaxrock._core.text import text_lines
from jaxrock.motions.files.at2 import AT2
from jaxrock.motions.files.columns import Columns
from jaxrock.motions.files.cosmos import COSMOS
from jaxrock.motions.files.csmip import CSMIP
from jaxrock.motions.files.csmip_v1 import CSMIPUncorrected
from jaxrock.motions.files.esm import ESM
from jaxrock.motions.files.format import AbstractFormat, Accelerogram
from jaxrock.motions.files.geonet import GeoNet
from jaxrock.motions.files.knet import KNET
from jaxrock.motions.files.parsing import PER_G
from jaxrock.motions.files.smc import SMC
from jaxrock.motions.record import STRONGEST, Record, record_in_g

# Formats with headers; a new format is a line here. Later ones are asked first: a V2 file may hold a line that looks
# like AT2, but hardly the other way round.
_WITH_HEADERS = (
    AT2(),
    CSMIP(),
    CSMIPUncorrected(),
    ESM(),
    COSMOS(),
    SMC(),
    KNET(),
    GeoNet(),
)

_HEADER = 400  # lines in which headers of fixed places end
_WORDS = re.compile(r"[A-CF-Za-cf-z]")

_COLUMNS = Columns(_WITH_HEADERS)
FORMATS = {each.name: each for each in (*_WITH_HEADERS, _COLUMNS)}


def _known_format(name: str, value: str) -> str:
    return one_of(name, value, tuple(FORMATS))  # read at the call, as formats may be added


@arguments
def read_record(
    path: str | os.PathLike,
    *,
    format: Annotated[str | None, _known_format] = None,
    dt: ArrayLike | None = None,
    unit: Annotated[str | None, word_of(*PER_G)] = None,
    column: Annotated[int | None, at_least(0)] = None,
    layout: Annotated[str | None, word_of("columns", "rows")] = None,
) -> Record:
    """Read an accelerogram from a file.

    **Arguments:**

    - `path`: the file.
    - `format`: "at2" (PEER), "v2" (CSMIP, also USC), "v1" (CSMIP, uncorrected), "esm" (ASCII of the Engineering
      Strong-Motion database), "cosmos" (V1, V2, V2c), "smc" (USGS), "knet" (K-NET and KiK-net, without their offset),
      "geonet" (V1A and V2A of New Zealand), or "csv" (text: numbers separated by commas, semicolons, tabs or blanks).
      None recognises it from the content, then from the suffix.
    - `dt`: time between samples [s], positive. Needed for text without times or a row of count and step. Needed
      for V1 files whose samples are not equally spaced: the record follows the straight lines between them.
      Elsewhere it must agree with the file to 1e-3.
    - `unit`: of the accelerations in the file, "g", "m/s2", "cm/s2" or "mm/s2". Needed for text; elsewhere it
      must agree with the header.
    - `column`: counted from 0. Text: the column of accelerations, needed when there are more than two;
      column 0 then holds the times, unless `column` is 0, or `dt` is given and column 0 also falls. Titles in a header
      count: units of times and accelerations, and which columns are times.
      V1, V2, COSMOS, GeoNet: the channel (None: the first). The others hold one record.
    - `layout`: of text. "rows": all numbers are one series in reading order, such as eight to a row. "columns": a
      table. None: a table if it has titles or times, or if `column` is given; a series if a first row of count and
      step says so. Other formats have one layout.

    **Returns:** a `Record` in units of g = 9.80665 m/s^2, named after the header (or the file); its `origin` holds the
    file's metadata. Its first sample is at time 0, whatever the times in the file.

    Samples beyond 3 g raise a warning, and so do times without a unit that are more than 0.2 s apart.

    **Raises:** OSError if the file cannot be opened; ValueError, with file and line, for one that is
    empty, binary or damaged; ValueError for an argument that is missing, not allowed, of no use for
    the format, or contradicted by the file.
    """
    dt = None if dt is None else float(scalar("dt", size("dt", dt)))
    path = path_of("path", path)
    lines = text_lines(path)
    chosen = _format_of(lines, path.suffix) if format is None else FORMATS[format]
    if layout is not None:
        chosen = _laid_out(path.name, chosen, layout)
    return _record(path, chosen, chosen.read(path.name, lines, dt, unit, column))


def _laid_out(name: str, chosen: AbstractFormat, layout: str) -> AbstractFormat:
    """Return the format of text with a layout, or raise for another format."""
    if not isinstance(chosen, Columns):
        told = f"{chosen.name.upper()} file `{name}` has one layout"
        raise ValueError(f"Argument `layout` must be None, because {told}, but is {layout!r}.")
    return Columns(_WITH_HEADERS, layout)


def accelerogram_of(name: str, lines: list[str]) -> tuple[str, Accelerogram]:
    """Return the format and the accelerogram of some lines, without arguments of the user."""
    chosen = _format_of(lines, "")
    return chosen.name, chosen.read(name, lines, None, None, None)


def component_columns(path: str | os.PathLike, format: str | None = None) -> tuple[int, ...]:
    """Return the default columns or channels of a file for the components of one record, without times."""
    path = path_of("path", path)
    lines = text_lines(path)
    chosen = _format_of(lines, path.suffix) if format is None else FORMATS[_known_format("format", format)]
    return chosen.components(path.name, lines)


def _record(path: Path, kind: AbstractFormat, found: Accelerogram) -> Record:
    samples = found.samples / PER_G[found.unit]
    largest = np.abs(samples).max()
    if largest > STRONGEST:
        told = f"File `{path.name}` holds an acceleration of {largest:.4g} g, more than all but a few records"
        smaller = [unit for unit in PER_G if PER_G[unit] > PER_G[found.unit]]
        likely = next((unit for unit in smaller if largest * PER_G[found.unit] <= STRONGEST * PER_G[unit]), None)
        factor = PER_G[likely] / PER_G[found.unit] if likely else 1.0
        instead = f" If its unit is {likely}, it holds {largest / factor:.3g} g ({factor:.4g} times less)."
        warnings.warn(
            f"{told}: is its unit {found.unit}, and does no such number mark a gap?{instead if likely else ''}",
            stacklevel=frames_of_the_package() + 1,
        )
    origin = found.origin._replace(format=kind.name, unit=found.unit, file=path.name)
    return record_in_g(samples, found.dt, found.title or path.stem, origin)


def _format_of(lines: list[str], suffix: str) -> AbstractFormat:
    """Return the format of a file: by its content, else by its suffix, else columns."""
    # Most lines of a long file hold numbers only, which no header line does.
    worded = lines[:_HEADER] + [line for line in lines[_HEADER:] if _WORDS.search(line)]
    for each in reversed(FORMATS.values()):
        if each.recognises(worded):
            return each
    return next((each for each in FORMATS.values() if suffix.lower() in each.suffixes), _COLUMNS)
