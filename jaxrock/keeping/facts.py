"""What tells a question from others beforehand, without tracing it: kinds, settings and shapes, and all versions.

Only what the package and a few libraries define is known by its class and its settings. What a user brings along (a
class, a function) may do anything: then there are no facts, and the question has to be traced.
"""

import dataclasses
import enum
import functools
import hashlib
import importlib.metadata
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
from jaxrock.keeping.folder import name_of

_OWN = __name__.split(".")[0]
_LIBRARIES = ("diffrax", "equinox", "lineax", "optimistix")  # whose objects may be settings
_VERSIONS = ("jax", "jaxlib", "numpy", "llvmlite", *_LIBRARIES)


class _Unknown(Exception):
    """Something that only tracing can tell."""


def facts(tree: Any) -> str | None:
    """A text that two trees share if they are alike but for the numbers in their arrays; None: nobody can tell."""
    try:
        return _told(tree)
    except _Unknown:
        return None


def _files() -> list[tuple[Path, int, int]]:
    paths = sorted(Path(__file__).parents[1].rglob("*.py"))
    return [(path, (about := path.stat()).st_mtime_ns, about.st_size) for path in paths]


_AT_IMPORT = _files()


@functools.cache
def code() -> str:
    """Digest of the package's own code; where the code on disk is not what this process has imported, something that is
    never asked for again."""
    if _files() != _AT_IMPORT:
        return uuid.uuid4().hex
    root = Path(__file__).parents[1]
    return name_of(
        *(f"{path.relative_to(root)} {hashlib.sha256(path.read_bytes()).hexdigest()}" for path, *_ in _AT_IMPORT)
    )


def version_of(name: str) -> str:
    """The version of a distribution, or that there is none."""
    try:
        return f"{name} {importlib.metadata.version(name)}"
    except importlib.metadata.PackageNotFoundError:
        return f"no {name}"


@functools.cache
def versions() -> str:
    """Digest of the package's own code, the versions of what it stands on, and the kind of this machine."""
    kind = (platform.machine(), platform.system(), platform.python_version())
    return name_of(*kind, *map(version_of, _VERSIONS), code())


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
