"""ObsPy traces as records, without an import of ObsPy: a trace carries all that is needed."""

from typing import Annotated, Any

import numpy as np

from jaxrock._arguments.annotations import arguments, word_of
from jaxrock._core.arrays import shown
from jaxrock.motions.files.parsing import PER_G
from jaxrock.motions.record import Origin, Record


@arguments
def record_of_trace(trace: Any, unit: Annotated[str, word_of(*PER_G)]) -> Record:
    """Convert an ObsPy trace to a record: `[rk.motions.record_of_trace(trace, "m/s2") for trace in stream]`.

    **Arguments:**

    - `trace`: an `obspy.Trace` of accelerations without gaps, its instrument's response removed.
    - `unit`: of its samples, which a trace does not tell: "g", "m/s2", "cm/s2" or "mm/s2".

    **Returns:** a `Record`, whose `origin` holds the trace's station, channel and start.

    **Raises:** ValueError for another kind of value, for a trace with gaps, or with samples that are not finite.
    """
    stats, data = getattr(trace, "stats", None), getattr(trace, "data", None)
    if stats is None or data is None or not hasattr(stats, "delta"):
        raise ValueError(f"Argument `trace` must be a trace of ObsPy, but is {shown(trace)}.")
    if np.ma.is_masked(data):
        raise ValueError("Argument `trace` must have no gaps, but has: fill or cut them first.")
    told = [str(getattr(stats, name, "") or "") for name in ("network", "station", "location", "channel")]
    code = ".".join(told[:2]).strip(".")
    origin = Origin("", code, told[3], str(getattr(stats, "starttime", "") or ""), told[1], "obspy", unit, "")
    samples = np.asarray(np.ma.getdata(data), float) / PER_G[unit]
    return Record(samples, float(stats.delta), ".".join(told).strip("."), origin)
