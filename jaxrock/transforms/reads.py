"""What a function reads besides its arguments, where all of it can be told.

A function of a user's is traced at every call, since what it reads may have changed. That takes a millisecond, as long
as a small map. Most functions read nothing but numbers, blocks and motions, and functions of JAX and of this package:
here that is told, and while it is the same, so is the program. Of all else (lists, attributes, arrays of NumPy, files,
functions of other packages) nothing is told, and it is traced as ever.
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

from jaxrock._checks import is_traced
from jaxrock._label import Label

# Modules of this package whose functions and classes compute from their arguments alone: they read no files, say.
_PURE = (
    "blocks.asymmetric", "blocks.flexible", "blocks.restitution", "blocks.rigid", "closed_form", "engines.diffrax",
    "engines.taylor", "models", "motions.pulses", "responses", "status",
)  # fmt: skip
_IMMUTABLE = (*_PURE, "blocks.edge", "blocks.rock", "motions.motion", "motions.record")
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
# Parts of names of instructions that look something up, or change it, in yet another way.
_ELSEWHERE = ("CLASSDEREF", "DELETE_GLOBAL", "FROM_DICT", "IMPORT", "LOAD_NAME", "STORE_GLOBAL", "STORE_NAME")


class _NotTold(Exception):
    """A function reads what may change unseen."""


class _Same:
    """An object that is like itself only; it lives as long as this."""

    def __init__(self, value: Any):
        self.value = value

    def __hash__(self):
        return id(self.value)

    def __eq__(self, other):
        return isinstance(other, _Same) and self.value is other.value


def reads(function: Callable) -> Hashable | None:
    """All that a function reads and is: equal as long as nothing of it changes. None where that cannot be told."""
    try:
        return tuple(_of_value(function, {}))
    except _NotTold:
        return None


def _of_function(function: Any, seen: dict[int, int]) -> Iterator[Hashable]:
    """What a function is; of one that was seen before, which one that was."""
    if type(function) is not types.FunctionType or function.__dict__:  # attributes may change, too
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
    """What a value is, if nobody can change it unseen."""
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
    """Return whether it is a function or class that computes from its arguments alone."""
    name = getattr(value, "__name__", None)
    if name is None or isinstance(value, types.ModuleType):
        return False
    if isinstance(value, np.ufunc):
        return value is getattr(np, name, None)  # others may call a user's function
    if isinstance(value, type) and issubclass(value, np.generic):
        return value.__module__ == "numpy"
    if _is_within(value, _PURE) and not isinstance(value, types.MethodType):
        return True
    at = getattr(jnp, name, None), getattr(jax.lax, name, None), getattr(jax.nn, name, None), getattr(math, name, None)
    return any(value is known for known in (*at, *_OF_JAX)) and name not in _OF_FILES


def _parts(value: Any) -> list | None:
    """What a tuple, a block, a motion or a model consists of."""
    if type(value) is tuple:
        return list(value)
    if dataclasses.is_dataclass(value) and _is_within(type(value), _IMMUTABLE):
        return [getattr(value, field.name) for field in dataclasses.fields(value)]
    return None


def _is_within(value: Any, modules: tuple[str, ...]) -> bool:
    package, _, module = (getattr(value, "__module__", None) or "").partition(".")
    return package == __name__.split(".")[0] and f"{module}.".startswith(tuple(f"{name}." for name in modules))


def _followed(value: Any, attributes: list[str]) -> Any:
    """What is found in a module, or one within it; further attributes are those of what is found."""
    for name in attributes:
        if not isinstance(value, types.ModuleType):
            break
        value = getattr(value, name, None)
    return value


def _content(cell: types.CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # there is nothing in it yet
        raise _NotTold from None


@functools.lru_cache(maxsize=256)
def _looked_up(code: types.CodeType) -> tuple[tuple[str, ...], ...]:
    """Names of what a piece of code looks up outside, each with the attributes that follow."""
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
