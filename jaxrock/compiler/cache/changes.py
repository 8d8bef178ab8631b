"""Detect changes of the package within this process: a test may patch it, and a notebook may reload a module.

Cached files are found by names and by the digest of the package's files, which miss such changes.
"""

import hashlib
import marshal
import sys
import types
import uuid
from collections.abc import Iterable
from itertools import repeat
from operator import attrgetter, is_
from typing import Any, NamedTuple

from jaxrock.compiler.cache import dependency_key

_OWN = __name__.split(".")[0]
_WITHOUT_PROGRAMS: list[str] = []  # modules on which no compiled program depends; set at import only
_PLAIN = (bool, int, float, str, bytes, type(None))
_CODE = attrgetter("__code__")


class _Space(NamedTuple):
    """Names of a module or of a class at the first look, for comparison."""

    of: str
    names: dict[str, Any] | types.MappingProxyType[str, Any]  # as they are now
    before: dict[str, Any]
    many: int  # number of names at the first look
    named: list[str]  # names of functions, and of objects that wrap one
    functions: list[types.FunctionType]  # these functions
    codes: list[types.CodeType]  # and their code

    @classmethod
    def at(cls, of: str, names: dict[str, Any] | types.MappingProxyType[str, Any]) -> "_Space":
        before = {name: value for name, value in names.copy().items() if not name.startswith("__") or _function(value)}
        found = {name: function for name, value in before.items() if (function := _function(value)) is not None}
        functions = list(found.values())
        return cls(of, names, before, len(names), list(found), functions, list(map(_CODE, functions)))

    def stays(self) -> bool:
        """Return whether all names are as at the first look.

        Tracing compares ten thousand names, so `map` does it without Python's loops.
        """
        return (
            len(self.names) == self.many
            and all(map(is_, map(self.names.get, self.before, repeat(self)), self.before.values()))
            and all(map(is_, map(_CODE, self.functions), self.codes))
        )

    def changed(self) -> list[str]:
        """Return a line for each name that differs; of new names only functions count, which may hide a base's."""
        names, before = self.names, self.before
        found = [name for name, value in before.items() if names.get(name, self) is not value]
        functions = zip(self.named, self.functions, self.codes)
        found += [name for name, function, code in functions if function.__code__ is not code]
        if len(names) != self.many:
            found += [name for name, value in names.copy().items() if name not in before and _function(value)]
        return [f"{self.of}.{name} {_digest(names.get(name, self))}" for name in found]


def watch(pure: Iterable[str], immutable: Iterable[str], without_programs: Iterable[str]) -> None:
    """Look at the package as imported, so that later changes are found.

    **Arguments:** names of modules and packages, such as `"models"` for `jaxrock.models`.

    - `pure`: their functions and classes compute from their arguments alone.
    - `immutable`: objects of their dataclasses do not change.
    - `without_programs`: nothing that is compiled depends on them.
    """
    dependency_key.PURE.extend(pure)
    dependency_key.IMMUTABLE.extend((*pure, *immutable))
    _WITHOUT_PROGRAMS.extend(f"{_OWN}.{name}" for name in without_programs)
    changes()


_seen: dict[str, tuple[types.ModuleType, list[_Space]]] = {}
_found: set[str] = set()


def any_seen() -> bool:
    """Return whether `changes` has ever found a difference."""
    return bool(_found)


def changes() -> str:
    """Return a digest of all differences of the package's modules from the first call; empty without a difference.

    The first call is made when the package is imported.
    """
    found = []
    # `copy` is atomic. A list of items is not: a garbage collection may run meanwhile, and import a module.
    for name, module in sys.modules.copy().items():
        if (
            name.partition(".")[0] != _OWN
            or name.startswith(tuple(_WITHOUT_PROGRAMS))
            or not isinstance(module, types.ModuleType)
        ):
            continue
        known = _seen.get(name)
        if getattr(module.__spec__, "_initializing", False):
            continue  # another thread is importing it
        if known is None:
            _seen[name] = module, _spaces(module)
        elif known[0] is not module:
            found.append(f"{name} {_digest(module)}")
        else:
            for space in known[1]:
                found += [] if space.stays() else space.changed()
    if not found:
        return ""
    told = hashlib.sha256("\n".join(sorted(found)).encode()).hexdigest()
    _found.add(told)
    return told


def _spaces(module: types.ModuleType) -> list[_Space]:
    names = vars(module)
    own = [x for x in names.copy().values() if isinstance(x, type) and x.__module__ == module.__name__]
    return [_Space.at(module.__name__, names), *(_Space.at(f"{x.__module__}.{x.__qualname__}", vars(x)) for x in own)]


def _function(value: Any) -> types.FunctionType | None:
    """Return the function that a value is or wraps, else None."""
    while not isinstance(value, types.FunctionType):
        if isinstance(value, property):
            value = value.fget
        elif isinstance(value, (type, types.ModuleType, *_PLAIN)):
            return None
        else:
            value = getattr(value, "__wrapped__", None)  # class methods, static methods, and functions of `jax.jit`
    return value


def _digest(value: Any) -> str:
    function = _function(value)
    if function is not None:
        return hashlib.sha256(marshal.dumps(function.__code__, 2)).hexdigest()
    return repr(value) if isinstance(value, _PLAIN) else uuid.uuid4().hex  # never equal to another digest
