"""Types of results in a store, and the attribute that marks missing values under NetCDF's conventions.

Readers such as xarray take a value equal to the attribute `_FillValue` as missing. To say so they turn whole numbers
into floating-point numbers. An unfinished store has whole numbers in a wider type, so no value of its own equals the
fill value. A finished store and a saved grid have no fill value: nothing is missing in them.
"""

from typing import Any, NamedTuple

import numpy as np

_WIDER: dict[int, np.dtype[Any]] = {1: np.dtype(np.int16), 2: np.dtype(np.int32), 4: np.dtype(np.int64)}  # by bytes


class Stored(NamedTuple):
    """Type of a result in a store, its fill value, and attributes of the array."""

    kind: np.dtype
    fill: Any
    unfinished: dict[str, Any]
    finished: dict[str, Any]


def stored(kind: np.dtype[Any], whole: bool) -> Stored:
    """Return how a result of a type is stored; `whole`: all of it is written at once, so nothing can be missing.

    No type holds all 64-bit whole numbers and one more. So their least (greatest, if unsigned) is the fill value. While
    values may be missing, readers round the others beyond 2^53.
    """
    kind = kind.newbyteorder("=")
    if kind.kind in "fc":  # readers take NaN as missing
        return Stored(kind, np.nan, {}, {})
    if kind.kind == "b":
        if whole:
            return Stored(kind, False, {}, {})
        return Stored(np.dtype(np.int8), -1, {"_FillValue": -1}, {"dtype": "bool"})  # xarray's attribute for booleans
    wide: np.dtype[Any] = kind if whole else _WIDER.get(kind.itemsize, kind)
    fill = int(np.iinfo(wide).min if wide.kind == "i" else np.iinfo(wide).max)
    return Stored(wide, fill, {} if whole else {"_FillValue": fill}, {})
