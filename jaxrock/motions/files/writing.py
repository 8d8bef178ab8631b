"""Accelerograms to files: AT2 and columns of text, which `read_record` reads again."""

import os
from typing import Annotated

import numpy as np

from jaxrock._arguments import arguments, path_of, word_of
from jaxrock._aside import written_aside
from jaxrock._parameters import check_single
from jaxrock.motions.files.parsing import PER_G
from jaxrock.motions.record import Record


def _line(text: str) -> str:
    """A text in one line that a header may hold."""
    return " ".join(text.split())


@arguments
def write_at2(record: Record, path: str | os.PathLike) -> None:
    """Write a record as PEER writes AT2: in g, eight digits a sample.

    **Arguments:**

    - `record`: a `Record`; event, station and component come from its `origin`, or else its name.
    - `path`: the file; one that is there is replaced, and not before the new one is whole.

    **Raises:** OSError if the file cannot be written; ValueError for arguments of other kinds.
    """
    check_single(record=record)
    samples, told = np.asarray(record.samples, float), record.origin
    parts = [told.event, told.station, told.component]
    title = ", ".join(parts) if all(parts) else record.name
    body = [f"{x:15.7E}" for x in samples]
    rows = ["".join(body[k : k + 5]) for k in range(0, len(body), 5)]
    head = ["PEER STRONG MOTION DATABASE RECORD", _line(title), "ACCELERATION TIME SERIES IN UNITS OF G"]
    counts = f"NPTS= {samples.size:6d}, DT= {float(record.dt):.12g} SEC"
    _write(path, [*head, counts, *rows])


@arguments
def write_csv(record: Record, path: str | os.PathLike, unit: Annotated[str, word_of(*PER_G)] = "g") -> None:
    """Write a record as two columns, time and acceleration, with all digits.

    **Arguments:**

    - `record`, `path`: as in `write_at2`.
    - `unit`: of the accelerations in the file, "g" (of 9.80665 m/s^2), "m/s2" or "cm/s2". The file names it in the
      title of its column, where `read_record` finds it.

    **Raises:** OSError if the file cannot be written; ValueError for arguments of other kinds.
    """
    check_single(record=record)
    samples, step = np.asarray(record.samples, float) * PER_G[unit], float(record.dt)
    head = [f"# {_line(record.name)}", f"# time [s], acceleration [{unit}]"]
    _write(path, [*head, *(f"{step * k:.12g},{x!r}" for k, x in enumerate(samples.tolist()))])


def _write(path, lines: list[str]) -> None:
    with written_aside(path_of("path", path), replace=True) as aside:
        aside.write_text("\n".join(lines) + "\n")
