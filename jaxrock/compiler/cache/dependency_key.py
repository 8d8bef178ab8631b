"""Find all that a user's function depends on besides its arguments, as a key for its traced jaxpr.

Without a key, a user's function is traced at every call, as its globals and closure may have changed. That takes a
millisecond, as long as a small map. Most functions read only numbers, immutable objects of this package, and functions
of JAX and of this package. For these there is a key, and an equal key means the same jaxpr. A function that reads
anything else has no key, such as lists, attributes, NumPy arrays, files or functions of other packages.
"""

import builtins
import dataclasses
import dis
import functools
import math
import types
from collections.abc import Callable, Hashable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrock._core.arrays import is_traced
from jaxrock._core.label import Label

# Modules of the package whose functions and classes compute from their arguments alone (they read no files, say), and
# modules whose dataclasses are immutable. `watch` sets both, at import only.
PURE: list[str] = []
IMMUTABLE: list[str] = []
_NUMBERS = (bool, int, float, complex, str, bytes, type(None))
_BUILTINS = (
    abs, bool, complex, dict, divmod, enumerate, float, int, isinstance, len, list, max, min, pow, range, reversed,
    round, set, sorted, str, sum, tuple, zip,
)  # fmt: skip
_OF_JAX = (
    jax.checkpoint, jax.grad, jax.hessian, jax.jacfwd, jax.jacrev, jax.jit, jax.jvp, jax.value_and_grad, jax.vjp,
    jax.vmap,
)  # fmt: skip
_OF_FILES = ("fromfile", "load", "save", "savez")  # in `jax.numpy`
# Parts of the names of bytecode instructions that look up or change a variable in a way that is not followed here.
_ELSEWHERE = ("CLASSDEREF", "DELETE_GLOBAL", "FROM_DICT", "IMPORT", "LOAD_NAME", "STORE_GLOBAL", "STORE_NAME")


class _NotTold(Exception):
    """The function depends on a value that may change undetected."""


class _Same:
    """A wrapper that compares an object by identity, and keeps it alive."""

    def __init__(self, value: Any):
        self.value = value

    def __hash__(self):
        return id(self.value)

    def __eq__(self, other):
        return isinstance(other, _Same) and self.value is other.value


def dependency_key(function: Callable) -> Hashable | None:
    """Return a key of a function's code and of all values that it reads; None where some may change undetected."""
    try:
        return tuple(_of_value(function, {}))
    except _NotTold:
        return None


def _of_function(function: Any, seen: dict[int, int]) -> Iterator[Hashable]:
    """Yield the parts of the key of a function; a function that is met again yields its number."""
    if type(function) is not types.FunctionType or function.__dict__:  # attributes of a function may change, too
        raise _NotTold
    if id(function) in seen:
        yield "again", seen[id(function)]
        return
    seen[id(function)] = len(seen)
    code = function.__code__
    yield _Same(code)
    held = [*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).values()]
    for value in held + [_content(cell) for cell in function.__closure__ or ()]:
        yield from _of_value(value, seen)
    for name, *attributes in _looked_up(code):
        if name in function.__globals__:
            yield from _of_value(_followed(function.__globals__[name], attributes), seen)
        elif getattr(builtins, name, None) not in _BUILTINS:
            raise _NotTold


def _of_value(value: Any, seen: dict[int, int]) -> Iterator[Hashable]:
    """Yield the parts of the key of a value. **Raises:** `_NotTold` where the value may change undetected."""
    kind = type(value)
    parts = _parts(value)
    if kind in _NUMBERS:
        yield kind, repr(value)  # -0.0 equals 0.0, and True equals 1
    elif kind is Label:
        yield (kind,)
    elif parts is not None:
        yield kind, len(parts)
        for part in parts:
            yield from _of_value(part, seen)
    elif _is_pure(value) or (isinstance(value, jax.Array | np.number | np.bool_) and not is_traced(value)):
        yield _Same(value)
    else:
        yield from _of_function(value, seen)


def _is_pure(value: Any) -> bool:
    """Return whether a value is a function or class that computes from its arguments alone."""
    name = getattr(value, "__name__", None)
    if name is None or isinstance(value, types.ModuleType):
        return False
    if isinstance(value, np.ufunc):
        return value is getattr(np, name, None)  # `numpy.frompyfunc` wraps a user's function
    if isinstance(value, type) and issubclass(value, np.generic):
        return value.__module__ == "numpy"
    if _is_within(value, PURE) and not isinstance(value, types.MethodType):
        return True
    at = getattr(jnp, name, None), getattr(jax.lax, name, None), getattr(jax.nn, name, None), getattr(math, name, None)
    return any(value is known for known in (*at, *_OF_JAX)) and name not in _OF_FILES


def _parts(value: Any) -> list | None:
    """Return the parts of a tuple, or the fields of an immutable dataclass of the package; else None."""
    if type(value) is tuple:
        return list(value)
    if dataclasses.is_dataclass(value) and _is_within(type(value), IMMUTABLE):
        return [getattr(value, field.name) for field in dataclasses.fields(value)]
    return None


def _is_within(value: Any, modules: list[str]) -> bool:
    package, _, module = (getattr(value, "__module__", None) or "").partition(".")
    return package == __name__.split(".")[0] and f"{module}.".startswith(tuple(f"{name}." for name in modules))


def _followed(value: Any, attributes: list[str]) -> Any:
    """Follow attributes as long as they lead through modules, and return the value that is found."""
    for name in attributes:
        if not isinstance(value, types.ModuleType):
            break
        value = getattr(value, name, None)
    return value


def _content(cell: types.CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # the cell is still empty
        raise _NotTold from None


@functools.lru_cache(maxsize=256)
def _looked_up(code: types.CodeType) -> tuple[tuple[str, ...], ...]:
    """Return the global names that a code object looks up, each with the attributes that follow it."""
    found: list[list[str]] = []
    follows = False
    for instruction in dis.get_instructions(code):
        kind = instruction.opname
        assigns = kind == "STORE_DEREF" and instruction.argval in code.co_freevars
        if assigns or any(word in kind for word in _ELSEWHERE):
            raise _NotTold
        if kind == "LOAD_GLOBAL":
            found.append([instruction.argval])
        elif follows and kind in ("LOAD_ATTR", "LOAD_METHOD"):
            found[-1].append(instruction.argval)
        follows = kind == "LOAD_GLOBAL" or (follows and kind in ("LOAD_ATTR", "LOAD_METHOD"))
    inner = (_looked_up(part) for part in code.co_consts if isinstance(part, types.CodeType))
    return tuple(dict.fromkeys([*map(tuple, found), *(names for part in inner for names in part)]))
