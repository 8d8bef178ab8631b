"""What tells a question from others beforehand, without tracing it: kinds, settings and shapes, and all versions.

Only what the package and a few libraries define is known by its class and its settings. What a user brings along (a
class, a function) may do anything: then there are no facts, and the question has to be traced.
"""

import dataclasses
import enum
import functools
import hashlib
import importlib.metadata
import os
import platform
import sys
import uuid
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxrock._label import Label
from jaxrock.keeping import changes
from jaxrock.keeping.folder import name_of

_OWN = __name__.split(".")[0]
_LIBRARIES = ("diffrax", "equinox", "lineax", "optimistix")  # whose objects may be settings
_VERSIONS = ("jax", "jaxlib", "numpy", "llvmlite", *_LIBRARIES)


class _Unknown(Exception):
    """Something that only tracing can tell."""


_CHANGED = " with changes "
_known: set[str] = set()  # what has been told while the package was as it was imported


def facts(tree: Any) -> str | None:
    """A text that two trees share if they are alike but for the numbers in their arrays, and the package is the same;
    None: nobody can tell."""
    try:
        told = _told(tree)
    except _Unknown:
        return None
    # To look takes a thousandth of a second: at what is asked for the first time, and always once anything was changed.
    if told in _known and not changes.any_seen():
        return told
    found = changes.changes()
    if not found:
        _known.add(told)
    return f"{told}{_CHANGED}{found}" if found else told


def still_hold(told: str) -> bool:
    """Return whether the package is as it was when these facts were told."""
    found = changes.changes()
    return f"{_CHANGED}{found}" in told if found else _CHANGED not in told


def _files(root: Path = Path(__file__).parents[1]) -> list[tuple[Path, int, int]]:
    """What the package is imported from: its modules, as text or compiled, or the archive that holds them."""
    found = sorted(root.rglob("*.py")) or sorted(x for x in root.rglob("*.pyc") if x.parent.name != "__pycache__")
    found = found or [x for x in root.parents if x.is_file()]
    return [(path, (about := path.stat()).st_mtime_ns, about.st_size) for path in found]


_AT_IMPORT = _files()


@functools.cache
def _on_disk() -> str:
    if not _AT_IMPORT or _files() != _AT_IMPORT:
        return uuid.uuid4().hex
    root = Path(__file__).parents[1]
    return name_of(
        *(f"{os.path.relpath(path, root)} {hashlib.sha256(path.read_bytes()).hexdigest()}" for path, *_ in _AT_IMPORT)
    )


def code() -> str:
    """Digest of the package's own code, and of what has been changed in it since; where the code on disk is not what
    this process has imported, something that is never asked for again."""
    return _on_disk() + changes.changes()


@functools.cache
def version_of(name: str) -> str:
    """The version of a distribution, or that there is none."""
    try:
        return f"{name} {importlib.metadata.version(name)}"
    except importlib.metadata.PackageNotFoundError:
        return f"no {name}"


@functools.cache
def _stood_on() -> str:
    return name_of(platform.machine(), platform.system(), platform.python_version(), *map(version_of, _VERSIONS))


def versions() -> str:
    """Digest of the package's own code, the versions of what it stands on, and the kind of this machine."""
    return name_of(_stood_on(), code())


def settings() -> str:
    """What a user may have set that changes how JAX traces and lowers."""
    names = ("jax_enable_x64", "jax_default_matmul_precision", "jax_numpy_dtype_promotion", "jax_debug_nans")
    return str([(name, str(getattr(jax.config, name, None))) for name in names])


def _told(value: Any) -> str:
    if value is None or isinstance(value, (bool, int, float, complex, str, enum.Enum, np.dtype)):
        return repr(value)
    if isinstance(value, (np.ndarray, np.generic)):  # a setting: leaves are shapes
        array = np.asarray(value)
        return f"{array.dtype}{array.shape} {array.tobytes().hex()}"
    if isinstance(value, (jax.Array, jax.ShapeDtypeStruct)):
        weak = getattr(jax.typeof(value), "weak_type", False)
        return f"{jnp.result_type(value)}{list(np.shape(value))}{'w' * weak}"
    if isinstance(value, Label):  # which compiled functions do not see
        return "label"
    if type(value) in (tuple, list):
        return f"{type(value).__name__}({', '.join(map(_told, value))})"
    if type(value) is dict:
        return f"dict({', '.join(f'{_told(key)}: {_told(part)}' for key, part in value.items())})"
    if isinstance(value, type) or callable(value) and hasattr(value, "__code__"):
        return _named(value)
    if isinstance(value, (eqx.Module, tuple)):
        kind = _named(type(value))
        named: Any = value
        names = named._fields if isinstance(value, tuple) else [field.name for field in dataclasses.fields(value)]
        return f"{kind}({', '.join(f'{name}={_told(getattr(value, name))}' for name in names)})"
    raise _Unknown


def _named(value: Any) -> str:
    """A class or a function that the package or a library defines, by where it is."""
    module, name = getattr(value, "__module__", "") or "", getattr(value, "__qualname__", "<")
    if module.split(".")[0] not in (_OWN, *_LIBRARIES) or "<" in name or getattr(value, "__closure__", None):
        raise _Unknown
    if getattr(sys.modules.get(module), name, None) is not value:  # something else of the same name
        raise _Unknown
    return f"{module}.{name}"
