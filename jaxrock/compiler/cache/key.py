"""Keys of computations, which need no tracing: classes, settings and shapes of arguments, and all versions.

Objects of the package and of a few libraries are known by their class and settings. A class or a function of a user may
do anything: a computation with one has no key, and has to be traced.
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

from jaxrock._core.label import Label
from jaxrock.compiler.cache import changes
from jaxrock.compiler.cache.store import name_of

_OWN = __name__.split(".")[0]
_LIBRARIES = ("diffrax", "equinox", "lineax", "optimistix")  # libraries whose objects may be settings
_VERSIONS = ("jax", "jaxlib", "numpy", "llvmlite", *_LIBRARIES)


class _Unknown(Exception):
    """The tree holds an object without a key."""


_CHANGED = " with changes "
_known: set[str] = set()  # keys that were made while the package is as imported


def key_of(tree: Any) -> str | None:
    """Return a text that two trees share if they differ only in the numbers of their arrays, and the code is the same.

    None where a tree holds an object without a key.
    """
    try:
        told = _told(tree)
    except _Unknown:
        return None
    # Looking for changes takes a millisecond: for each new key, and always once a change has been found.
    if told in _known and not changes.any_seen():
        return told
    found = changes.changes()
    if not found:
        _known.add(told)
    return f"{told}{_CHANGED}{found}" if found else told


def still_hold(told: str) -> bool:
    """Return whether the package is as it was when this key was made."""
    found = changes.changes()
    return f"{_CHANGED}{found}" in told if found else _CHANGED not in told


def _files(root: Path = Path(__file__).parents[2]) -> list[tuple[Path, int, int]]:
    """Return the files of the package: its modules, as text or compiled, or the archive that holds them."""
    found = sorted(root.rglob("*.py")) or sorted(x for x in root.rglob("*.pyc") if x.parent.name != "__pycache__")
    found = found or [x for x in root.parents if x.is_file()]
    return [(path, (about := path.stat()).st_mtime_ns, about.st_size) for path in found]


_AT_IMPORT = _files()


@functools.cache
def _on_disk() -> str:
    if not _AT_IMPORT or _files() != _AT_IMPORT:
        return uuid.uuid4().hex
    root = Path(__file__).parents[2]
    return name_of(
        *(f"{os.path.relpath(path, root)} {hashlib.sha256(path.read_bytes()).hexdigest()}" for path, *_ in _AT_IMPORT)
    )


def code_digest() -> str:
    """Return a digest of the package's code, and of changes to it in this process.

    Where the files differ from the imported ones, the digest is unique, so that nothing cached is found.
    """
    return _on_disk() + changes.changes()


@functools.cache
def version_of(name: str) -> str:
    """Return name and version of a distribution, or that it is not installed."""
    try:
        return f"{name} {importlib.metadata.version(name)}"
    except importlib.metadata.PackageNotFoundError:
        return f"no {name}"


@functools.cache
def _stood_on() -> str:
    return name_of(platform.machine(), platform.system(), platform.python_version(), *map(version_of, _VERSIONS))


def versions() -> str:
    """Return a digest of the package's code, of the versions of its dependencies, and of the kind of this machine."""
    return name_of(_stood_on(), code_digest())


def settings() -> str:
    """Return the settings of JAX that change how it traces and lowers, as text."""
    names = ("jax_enable_x64", "jax_default_matmul_precision", "jax_numpy_dtype_promotion", "jax_debug_nans")
    return str([(name, str(getattr(jax.config, name, None))) for name in names])


def _told(value: Any) -> str:
    if value is None or isinstance(value, (bool, int, float, complex, str, enum.Enum, np.dtype)):
        return repr(value)
    if isinstance(value, (np.ndarray, np.generic)):  # a static value: leaves are given as shapes
        array = np.asarray(value)
        return f"{array.dtype}{array.shape} {array.tobytes().hex()}"
    if isinstance(value, (jax.Array, jax.ShapeDtypeStruct)):
        weak = getattr(jax.typeof(value), "weak_type", False)
        return f"{jnp.result_type(value)}{list(np.shape(value))}{'w' * weak}"
    if isinstance(value, Label):  # compiled functions do not see labels
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
    """Return the full name of a class or function of the package or of a known library."""
    module, name = getattr(value, "__module__", "") or "", getattr(value, "__qualname__", "<")
    if module.split(".")[0] not in (_OWN, *_LIBRARIES) or "<" in name or getattr(value, "__closure__", None):
        raise _Unknown
    if getattr(sys.modules.get(module), name, None) is not value:  # another object has this name
        raise _Unknown
    return f"{module}.{name}"
