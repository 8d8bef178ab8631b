"""Representation of blocks, motions and results in a notebook: with numbers, not only shapes."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxrock._core.arrays import is_traced
from jaxrock.status import Status

_Item = type(Status.successful)

_FEW = 6  # numbers that are shown; of more only dtype and shape
_LONG = 100  # characters of a line


def described(self: Any) -> str:
    """Return the name of a module's class with all fields; for `__repr__` of modules."""
    fields = [field for field in dataclasses.fields(self) if field.repr and not _is_absent(self, field)]
    parts = [f"{field.name}={_told(getattr(self, field.name))}" for field in fields]
    name, line = type(self).__name__, ", ".join(parts)
    if len(name) + len(line) < _LONG and "\n" not in line:
        return f"{name}({line})"
    return "\n".join([f"{name}(", *(f"  {part},".replace("\n", "\n  ") for part in parts), ")"])


def _is_absent(owner: Any, field: dataclasses.Field) -> bool:
    """Return whether a field is None that most modules of this class lack: the beam of a block, the side of a wall."""
    known = field.metadata.get("parameter")
    lacks = field.metadata.get("static", False) or known is not None and not known.is_free
    return lacks and getattr(owner, field.name) is None


def _told(value: Any) -> str:
    if isinstance(value, _Item):
        return _status(value)
    if isinstance(value, jax.core.Tracer):
        return str(jax.typeof(value))
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        return _numbers(value)
    if type(value) in (list, tuple, dict):
        return _several(value)
    if isinstance(value, eqx.Module) and type(value).__repr__ is eqx.Module.__repr__:  # of a user's own
        return described(value)
    return repr(value)


def _several(values: Any) -> str:
    """Return a list, tuple or dictionary with numbers in place of arrays."""
    if isinstance(values, dict):
        return f"{{{', '.join(f'{key!r}: {_told(each)}' for key, each in values.items())}}}"
    line = ", ".join(map(_told, values))
    if isinstance(values, list):
        return f"[{line}]"
    return f"({line},)" if len(values) == 1 else f"({line})"


def _numbers(value: Any) -> str:
    if not getattr(value, "is_fully_addressable", True) or np.size(value) > _FEW:
        return f"{np.dtype(value.dtype)}[{', '.join(map(str, np.shape(value)))}]"
    told = [f"{x:.7g}" if isinstance(x, float) else str(x) for x in np.ravel(value).tolist()]
    return told[0] if np.ndim(value) == 0 else f"[{', '.join(told)}]"


def _status(value: Any) -> str:
    kind, which = value._enumeration, value._value
    if which is None:  # as `eqx.filter` leaves it
        return f"{kind.__name__}.None"
    if not isinstance(which, jax.Array | np.ndarray | np.generic | int) or is_traced(which) or np.ndim(which) > 0:
        return f"{kind.__name__}{list(np.shape(which))}"  # also a `jax.ShapeDtypeStruct`
    return f"{kind.__name__}.{list(kind._name_to_item)[int(which)]}"
