"""Accelerograms to files: AT2 and columns of text, which `read_record` reads again."""

import os
from typing import Annotated

import numpy as np

from jaxrock._arguments.annotations import arguments, path_of, word_of
from jaxrock._arguments.parameters import check_single
from jaxrock._arguments.ranges import as_meant
from jaxrock._core.atomic_files import written_atomically
from jaxrock.motions.files.parsing import PER_G
from jaxrock.motions.files.reading import accelerogram_of
from jaxrock.motions.record import Record


def _line(text: str) -> str:
    """Return a text in one line that a header may hold."""
    return " ".join("".join(each if each.isprintable() else " " for each in text).split())


@arguments
def write_at2(record: Record, path: str | os.PathLike) -> None:
    """Write a record as PEER writes AT2: in g, eight digits a sample.

    **Arguments:**

    - `record`: a `Record`; event, station and component come from its `origin`, or else its name.
    - `path`: the file; one that is there is replaced, and not before the new one is whole.

    **Raises:** OSError if the file cannot be written; ValueError for arguments of other kinds, and for a name that
    would be read as a header ("NPTS= 5, DT= .1").
    """
    check_single(record=record)
    samples, told = np.asarray(record.samples, float), record.origin
    parts = [told.event, told.station, told.component]
    title = ", ".join(parts) if all(parts) else record.name
    body = [f"{x:15.7E}" for x in samples]
    rows = ["".join(body[k : k + 5]) for k in range(0, len(body), 5)]
    head = ["PEER STRONG MOTION DATABASE RECORD", _line(title), "ACCELERATION TIME SERIES IN UNITS OF G"]
    step = f"DT= {as_meant(record.dt):.12g} SEC"
    _check_name(
        title, [*head, f"NPTS= {_TRIAL.size}, {step}", "".join(f"{x:15.7E}" for x in _TRIAL)], record, "at2", "g"
    )
    _write(path, [*head, f"NPTS= {samples.size:6d}, {step}", *rows])


@arguments
def write_csv(record: Record, path: str | os.PathLike, unit: Annotated[str, word_of(*PER_G)] = "g") -> None:
    """Write a record as two columns, time and acceleration, with all digits.

    **Arguments:**

    - `record`, `path`: as in `write_at2`.
    - `unit`: of the accelerations in the file, "g" (of 9.80665 m/s^2), "m/s2", "cm/s2" or "mm/s2". The file names it in
      the title of its column, where `read_record` finds it.

    **Raises:** OSError if the file cannot be written; ValueError for arguments of other kinds, for a record of one
    sample, which has no step between times, and for a name that reads as a header ("NPTS= 5, DT= .1").
    """
    check_single(record=record)
    samples, step = np.asarray(record.samples, float) * PER_G[unit], as_meant(record.dt)
    if samples.size < 2:
        raise ValueError("Argument `record` must have at least two samples, but has one: `write_at2` states the step.")
    head = [f"# {_line(record.name)}", f"# time [s], acceleration [{unit}]"]
    trial = [f"{step * k:.12g},{x!r}" for k, x in enumerate((_TRIAL * PER_G[unit]).tolist())]
    _check_name(record.name, [*head, *trial], record, "csv", unit)
    _write(path, [*head, *(f"{step * k:.12g},{x!r}" for k, x in enumerate(samples.tolist()))])


_TRIAL = np.array([0.125, -0.25, 0.5, -0.375])


def _check_name(title: str, lines: list[str], record: Record, kind: str, unit: str) -> None:
    """Raise ValueError where a title looks like a header, so that a short file with it is not read as it was
    written.
    """
    try:
        found = accelerogram_of("trial", [*lines, ""])
        good = found[0] == kind and found[1].unit == unit and np.allclose(found[1].samples, _TRIAL * PER_G[unit])
        good = good and np.isclose(found[1].dt, float(record.dt), rtol=1e-6, atol=0)
    except ValueError:
        good = False
    if not good:
        raise ValueError(
            f"Argument `record` must have a name that readers do not take for a header, but has {_line(title)!r}: "
            "give it another, as `Record(record.samples, record.dt, name)`."
        )


def _write(path, lines: list[str]) -> None:
    with written_atomically(path_of("path", path), replace=True) as aside:
        aside.write_text("\n".join(lines) + "\n", encoding="utf-8")
