"""A function as the program it traces to: equal programs are compiled once, and known again in another process."""

import functools
import hashlib
import weakref
from collections.abc import Callable, Hashable, Iterable, Iterator
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, jaxpr_as_fun

from jaxrock._checks import put_down, throws
from jaxrock.transforms.reads import reads


class Program:
    """What a function traces to, but for the arrays that it captures: these are arguments, `program(*leaves, arrays)`.

    Two are equal if they have the same text, whatever made them, and are compiled once. Checks of arguments do not
    raise: a call returns the results, and for each of `messages` whether it applies.
    """

    def __init__(self, jaxpr: Jaxpr, structure, messages: tuple[str, ...], more: tuple = ()):
        self.messages, self._jaxpr, self._structure = messages, jaxpr, structure
        # JAX prints no addresses and no arrays here: the arrays follow one by one.
        self._told = hashlib.sha256(_text(jaxpr).encode())
        callbacks = []
        for part in _hidden(jaxpr):
            if callable(part):
                callbacks.append(_same_callback(part))
            else:
                _tell(self._told, part)
        self.calls_back = any(map(callable, callbacks))  # to what no fingerprint tells from others
        self._key = (self._told.hexdigest(), structure, messages, tuple(callbacks), *more)

    def __call__(self, *arguments):
        """Evaluate at leaves; the last argument are the arrays that were captured."""
        *leaves, captured = arguments
        found = jaxpr_as_fun(ClosedJaxpr(self._jaxpr, list(captured)))(*leaves)
        return jax.tree.unflatten(self._structure, found)

    def fingerprint(self, captured: Iterable) -> str:
        """What tells the program with such arrays in any process."""
        told = self._told.copy()
        for array in captured:
            _tell(told, array)
        return told.hexdigest()

    def __hash__(self):
        return hash(self._key)

    def __eq__(self, other):
        return isinstance(other, Program) and self._key == other._key


class Checked(eqx.Module):
    """What a function returns, and for each of the messages of its checks whether it applies."""

    results: Any
    failed: tuple
    messages: tuple[str, ...] = eqx.field(static=True)


def with_checks(function: Callable) -> Callable[..., Checked]:
    """The same function, whose checks of arguments do not raise: they are `Checked`."""

    def checked(*arguments):
        with put_down() as checks:
            results = function(*arguments)
        return Checked(results, tuple(failed for _, failed in checks), tuple(message for message, _ in checks))

    return checked


def traced(function: Callable, key: Hashable | None, leaves: Iterable) -> tuple[ClosedJaxpr, Checked]:
    """The program of a function of leaves with its checks, and what it returns.

    `key`: what tells the function from others; it is the same program then as when a like one was traced before. None:
    nothing does, and it is traced.
    """
    if key is None:
        return jax.make_jaxpr(with_checks(function), return_shape=True)(*leaves)
    found = _under_jit(_Keyed(function, (key, throws()))).trace(*leaves)
    return found.jaxpr, found.out_info


class _Keyed:
    """A function that is like others with the same key."""

    def __init__(self, function: Callable, key: Hashable):
        self.function, self.key = function, key

    def __hash__(self):
        return hash(self.key)

    def __eq__(self, other):
        return isinstance(other, _Keyed) and self.key == other.key


# JAX traces again where its settings, or types of numbers, are others: it knows of all of them.
@functools.lru_cache(maxsize=64)
def _under_jit(keyed: _Keyed) -> Any:
    return jax.jit(with_checks(keyed.function))


class Traced:
    """`function(**point)` of numbers as a `program` with `constants`: `program(*point, constants)`.

    Two of them are equal if they trace to the same program, whatever the constants (a record, say). `shapes` is what
    the function returns, `fingerprint` tells program and constants in any process.
    """

    _known: weakref.WeakKeyDictionary[ClosedJaxpr, "Traced"] = weakref.WeakKeyDictionary()

    def __init__(self, closed: ClosedJaxpr, told: Checked):
        self.program = Program(closed.jaxpr, jax.tree.structure((told.results, told.failed)), told.messages)
        self.shapes, self.constants = told.results, tuple(closed.consts)
        self.fingerprint = self.program.fingerprint(self.constants)

    @classmethod
    def of(cls, function: Callable, point: dict[str, jax.ShapeDtypeStruct]) -> "Traced":
        """From the function as it is now."""
        told, names = reads(function), tuple(point)
        key = None if told is None else (told, names)
        closed, results = traced(lambda *values: function(**dict(zip(names, values))), key, point.values())
        if closed not in cls._known:
            cls._known[closed] = cls(closed, results)
        return cls._known[closed]

    def __call__(self, *arguments):
        """Evaluate at a point; the last argument are the constants."""
        return self.program(*arguments)

    def __hash__(self):
        return hash(self.program)

    def __eq__(self, other):
        return isinstance(other, Traced) and self.program == other.program


def _is_compiled(equation) -> bool:
    """Return whether an operation is a call of a function under `jax.jit`."""
    return equation.primitive.name in ("jit", "pjit") and isinstance(equation.params.get("jaxpr"), ClosedJaxpr)


_known = weakref.WeakKeyDictionary()


def _known_of(jaxpr: Jaxpr) -> tuple[str, tuple]:
    """The digest of a program's text, and what that does not show: each program is printed and searched once."""
    if jaxpr not in _known:
        _known[jaxpr] = hashlib.sha256(f"{jaxpr}".encode()).hexdigest(), tuple(_hidden(jaxpr))
    return _known[jaxpr]


def _text(jaxpr: Jaxpr) -> str:
    """A program in words; functions under `jax.jit`, which JAX traces once, stand in it as digests."""
    digests, short = [], []
    for equation in jaxpr.eqns:
        if _is_compiled(equation):
            inner = equation.params["jaxpr"]
            digests.append(_known_of(inner.jaxpr)[0])
            empty = ClosedJaxpr(inner.jaxpr.replace(eqns=[]), inner.consts)
            equation = equation.replace(params=equation.params | {"jaxpr": empty})
        short.append(equation)
    return f"{jaxpr.replace(eqns=short)} {digests}"


def _tell(told, value) -> None:
    array = np.asarray(value)
    told.update(f"{array.dtype}{array.shape}".encode() + array.tobytes())


def _hidden(jaxpr: Jaxpr) -> Iterator:
    """What the print of a program does not show: arrays within it, and functions it calls back."""
    for equation in jaxpr.eqns:
        if _is_compiled(equation):
            yield from equation.params["jaxpr"].consts
            yield from _known_of(equation.params["jaxpr"].jaxpr)[1]
            continue
        for value in equation.params.values():
            for part in value if isinstance(value, (tuple, list)) else (value,):
                if isinstance(part, ClosedJaxpr):
                    yield from part.consts
                    yield from _hidden(part.jaxpr)
                elif isinstance(part, Jaxpr):
                    yield from _hidden(part)
                elif getattr(part, "facts", "") is None:  # a recipe that only its program tells
                    yield from part.program.consts
                    yield from _hidden(part.program.jaxpr)
                elif "callback" in equation.primitive.name and callable(part):
                    yield getattr(part, "callback_func", part)


def _same_callback(function: Callable):
    """What tells a function that a program calls back from others.

    Checks of arguments (`equinox.error_if`) are made anew whenever they are traced; they are alike if they say the
    same. Any other function is only like itself.
    """
    inner = function.func if isinstance(function, functools.partial) else function
    if not getattr(inner, "__module__", "").startswith("equinox."):
        return function
    cells = [cell.cell_contents for cell in getattr(inner, "__closure__", None) or ()]
    said = tuple(text for cell in cells for text in (cell if isinstance(cell, (list, tuple)) else [cell]))
    return inner.__qualname__, tuple(text for text in said if isinstance(text, str))
