"""Detect changes of the package within this process: a test may patch it, a notebook load a module anew.

What is kept on disk is found by names and by the digest of the package's files, which tell nothing of that.
"""

import hashlib
import marshal
import sys
import types
import uuid
from itertools import repeat
from operator import attrgetter, is_
from typing import Any, NamedTuple

_OWN = __name__.split(".")[0]
_OTHERS = tuple(f"{_OWN}.{each}" for each in ("keeping", "sweeps", "plot", "command_line"))  # make no programs
_PLAIN = (bool, int, float, str, bytes, type(None))
_CODE = attrgetter("__code__")


class _Space(NamedTuple):
    """The names of a module or of a class, as they were when they were first looked at."""

    of: str
    names: dict[str, Any] | types.MappingProxyType[str, Any]  # now
    before: dict[str, Any]
    many: int  # how many names there were
    named: list[str]  # names of functions, and of what wraps them
    functions: list[types.FunctionType]  # these
    codes: list[types.CodeType]  # of these

    @classmethod
    def at(cls, of: str, names: dict[str, Any] | types.MappingProxyType[str, Any]) -> "_Space":
        before = {name: value for name, value in names.copy().items() if not name.startswith("__") or _function(value)}
        found = {name: function for name, value in before.items() if (function := _function(value)) is not None}
        functions = list(found.values())
        return cls(of, names, before, len(names), list(found), functions, list(map(_CODE, functions)))

    def stays(self) -> bool:
        """Return whether nothing differs now. It is asked of ten thousand names where a scene is traced, so by `map`
        alone."""
        return (
            len(self.names) == self.many
            and all(map(is_, map(self.names.get, self.before, repeat(self)), self.before.values()))
            and all(map(is_, map(_CODE, self.functions), self.codes))
        )

    def changed(self) -> list[str]:
        """What differs now; a name that is new matters if it stands for a function, which may hide one of a base."""
        names, before = self.names, self.before
        found = [name for name, value in before.items() if names.get(name, self) is not value]
        functions = zip(self.named, self.functions, self.codes)
        found += [name for name, function, code in functions if function.__code__ is not code]
        if len(names) != self.many:
            found += [name for name, value in names.copy().items() if name not in before and _function(value)]
        return [f"{self.of}.{name} {_digest(names.get(name, self))}" for name in found]


_seen: dict[str, tuple[types.ModuleType, list[_Space]]] = {}
_found: set[str] = set()


def any_seen() -> bool:
    """Return whether `changes` has ever found any."""
    return bool(_found)


def changes() -> str:
    """Digest of what differs in the package's modules from when this function first looked at them, which it does when
    the package is imported; empty: nothing."""
    found = []
    # A list of items is made item by item, and garbage is collected meanwhile, which may have others import something.
    for name, module in sys.modules.copy().items():
        if name.partition(".")[0] != _OWN or name.startswith(_OTHERS) or not isinstance(module, types.ModuleType):
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
    """The function that a value is, or wraps."""
    while not isinstance(value, types.FunctionType):
        if isinstance(value, property):
            value = value.fget
        elif isinstance(value, (type, types.ModuleType, *_PLAIN)):
            return None
        else:
            value = getattr(value, "__wrapped__", None)  # a method of a class or a static one, what JAX compiles
    return value


def _digest(value: Any) -> str:
    function = _function(value)
    if function is not None:
        return hashlib.sha256(marshal.dumps(function.__code__, 2)).hexdigest()
    return repr(value) if isinstance(value, _PLAIN) else uuid.uuid4().hex  # of which nothing is ever asked for again
