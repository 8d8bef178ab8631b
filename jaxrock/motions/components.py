"""Components of one record: two horizontal ones, and perhaps a vertical one."""

import os
import re
import warnings
from collections.abc import Iterable, Sequence
from typing import Annotated, Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from jaxrock._arguments.annotations import arguments, list_of, word_of
from jaxrock._arguments.ranges import direction, scalar
from jaxrock._arguments.repr import described
from jaxrock._core.arrays import shown
from jaxrock._core.one_program import one_program
from jaxrock._core.precision import frames_of_the_package
from jaxrock._core.settings import called_by_users
from jaxrock.motions.files.parsing import PER_G
from jaxrock.motions.files.reading import component_columns, read_record
from jaxrock.motions.files.traces import record_of_trace
from jaxrock.motions.motion import AbstractMotion
from jaxrock.motions.record import Record, record_in_g

_DOWN = re.compile(r"\W*D((OW|W)?N)?\W*", re.IGNORECASE)
# PEER also writes VRT, VT, V1, UPDN and 000V.
_VERTICAL = re.compile(
    r"\W*(U(P|D|-D|P[-/ ]?(DN|DWN|DOWN))?\d?|D((OW|W)?N)?|\d*V(ER\w*|R?T)?\d?|..?Z|Z)\W*", re.IGNORECASE
)
# Azimuths, points of the compass, SEED channel codes, words. Any other number of one or two digits is a channel number.
_HORIZONTAL = re.compile(
    r"\W*(0|90|[0-2]\d\d|3[0-5]\d|360|\d{1,3} ?(°|DEG\w*)|[NS][-/ ]?(\d{1,2} ?(°|DEG)? ?)?[EW]|[NESW]"
    r"|N[-/ ]?S|S[-/ ]?N|E[-/ ]?W|W[-/ ]?E|(NORTH|EAST|SOUTH|WEST)\W*(NORTH|EAST|SOUTH|WEST)?|[A-Z][GHLN][NE]"
    r"|(LONG|TRANS|RADIAL|HORIZ)\w*)\W*",
    re.IGNORECASE,
)


class Components(eqx.Module):
    """Components recorded at one station: two horizontal ones at right angles, and perhaps the vertical one.

    **Arguments:**

    - `first`, `second`: `Record`s of one time step.
    - `vertical`: positive upward; None: there is none.

    Components of different lengths are cut to the shortest one.

    **Raises:** ValueError for components of different time steps, or whose files state different start times.
    """

    __repr__ = described

    first: Record
    second: Record
    vertical: Record | None

    @arguments
    def __init__(self, first: Record, second: Record, vertical: Record | None = None):
        parts = [each for each in (first, second, vertical) if each is not None]
        steps = [float(each.dt) for each in parts]
        if max(steps) > (1 + 1e-9) * min(steps):
            raise ValueError(f"Arguments `first`, `second`, `vertical` must have one time step, but have {steps} s.")
        starts = {each.origin.start for each in parts} - {""}
        if len(starts) > 1:
            raise ValueError(
                f"Arguments `first`, `second`, `vertical` must begin at one time, but begin at {sorted(starts)}."
            )
        count = min(each.samples.shape[-1] for each in parts)
        self.first, self.second, *rest = (
            record_in_g(each.samples[:count], each.dt, each.name, each.origin) for each in parts
        )
        self.vertical = rest[0] if rest else None

    @arguments
    def along(self, angle: ArrayLike) -> Record:
        """Return the horizontal component in one direction.

        **Arguments:**

        - `angle`: from the first component towards the second [rad].

        **Returns:** a `Record`: cos(angle) first + sin(angle) second. `with_vertical(components.vertical)` adds the
        vertical component.

        **Raises:** ValueError for an angle beyond a full turn.
        """
        angle = scalar("angle", direction("angle", angle))
        samples = _combined(angle, self.first.samples, self.second.samples)
        name = "" if not self.first.name else f"{self.first.name}, turned"
        return record_in_g(samples, self.first.dt, name, self.first.origin._replace(component=""))

    @called_by_users
    def in_plane(self, angle: ArrayLike, vertical: bool) -> AbstractMotion:
        """Return the motion of one vertical plane: `along` the angle, with the `vertical` component if it is wanted."""
        horizontal = self.along(angle)
        return horizontal.with_vertical(self.vertical) if vertical and self.vertical is not None else horizontal


def is_vertical(record: Record) -> bool:
    """Return whether the component code of a record names the vertical direction."""
    return bool(_VERTICAL.fullmatch(record.origin.component))


@arguments
def read_components(
    paths: str | os.PathLike | Sequence[str | os.PathLike],
    *,
    columns: Annotated[
        Sequence[int] | None, list_of((lambda each: isinstance(each, (int, np.integer))), "columns")
    ] = None,
    **given: Any,
) -> Components:
    """Read the components of one record together.

    **Arguments:**

    - `paths`: two or three files, one for each component; or one file that holds them all.
    - `columns`: the two or three columns or channels of a single file; None: the first three, or all columns of a text
      file after a first column of times.
    - `given`: `format`, `dt` and `unit`, as in `read_record`.

    The files say which component is vertical (UP, UD, Z, ...). Where they do not, it is the last of three, unless that
    one says that it is horizontal (090, N-S, E, HNE, ...).

    **Returns:** `Components`, the horizontal ones in the order of the files.

    **Raises:** as `read_record`; ValueError for another number of components, for two that say they are vertical, for
    three of which none can be, and as `Components`.
    """
    if isinstance(paths, (str, os.PathLike)):
        chosen = component_columns(paths, given.get("format")) if columns is None else columns
        records = [read_record(paths, column=int(column), **given) for column in chosen]
    elif columns is not None:
        raise ValueError("Argument `columns` must be None where there is a file for each component.")
    elif not isinstance(paths, Sequence) or len(paths) not in (2, 3):
        raise ValueError(f"Argument `paths` must be one file, or two or three, but is {shown(paths)}.")
    else:
        records = [read_record(path, **given) for path in paths]
    if len(records) not in (2, 3):
        raise ValueError(f"Argument `columns` must hold two or three columns, but holds {len(records)}.")
    return _together("paths", records)


def _together(name: str, records: list[Record]) -> Components:
    """Combine two or three records into components; the vertical one names itself, or is the last of three."""
    upward = [k for k, record in enumerate(records) if is_vertical(record)]
    if len(upward) > 1 or len(records) == 2 and upward:
        said = [records[k].origin.component for k in upward]
        raise ValueError(f"Argument `{name}` must hold two horizontal components, but {said} are vertical.")
    if len(records) == 3 and not upward and _HORIZONTAL.fullmatch(records[2].origin.component):
        said = [record.origin.component for record in records]
        raise ValueError(
            f"Argument `{name}` must hold a vertical component among three, or two horizontal ones alone, but they say "
            f"{said}: give two, or `Components(first, second, vertical)` of what each of them is."
        )
    vertical = records.pop(upward[0] if upward else 2) if len(records) == 3 else None
    if vertical is not None and _DOWN.fullmatch(vertical.origin.component):
        warnings.warn(
            f"The vertical component says {vertical.origin.component!r}, and is taken as it stands, positive upward: "
            "if its numbers are positive downward, take `Components(first, second, processing.scaled(vertical, -1))`.",
            stacklevel=frames_of_the_package() + 1,
        )
    first, second = records
    return Components(first, second, vertical)


@arguments
def components_of_stream(stream: Any, unit: Annotated[str, word_of(*PER_G)]) -> Components:
    """Combine the traces of one station in an ObsPy stream into components.

    **Arguments:**

    - `stream`: an `obspy.Stream`, or a list, of two or three traces: one of each channel.
    - `unit`: as in `record_of_trace`.

    **Returns:** `Components`, the horizontal ones in the order of the traces. For a stream of many stations, write
    `[components_of_stream(stream.select(station=each), unit) for each in stations]`.

    **Raises:** as `record_of_trace` and `Components`; ValueError for another number of traces, for two stations, and
    for components as in `read_components`.
    """
    several = isinstance(stream, Iterable) and not isinstance(stream, (str, bytes))
    several = several and getattr(stream, "shape", None) != ()  # excludes a zero-dimensional array
    traces = list(stream) if several else []
    if len(traces) not in (2, 3):
        said = f"has {len(traces)}" if traces else f"is {shown(stream)}"
        raise ValueError(f"Argument `stream` must hold two or three traces of ObsPy, but {said}.")
    records = [record_of_trace(trace, unit) for trace in traces]
    stations = {(record.origin.station, record.origin.code) for record in records}
    if len(stations) > 1:
        raise ValueError(f"Argument `stream` must be of one station, but is of {sorted(each for each, _ in stations)}.")
    return _together("stream", records)


@one_program
def _combined(angle, first, second):
    return jnp.cos(angle) * first + jnp.sin(angle) * second
