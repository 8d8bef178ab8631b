"""A function as the program it traces to: equal programs are compiled once, and known again in another process."""

import functools
import hashlib
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, jaxpr_as_fun

from jaxrock._checks import put_down


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


def traced(function: Callable, leaves: Sequence) -> tuple[ClosedJaxpr, Any, tuple[str, ...]]:
    """The program of `function(*leaves)` with its checks put down: (jaxpr, shapes of (results, failures), messages)."""

    def checked(*leaves):
        with put_down() as checks:
            found = function(*leaves)
        messages.extend(message for message, _ in checks)
        return found, tuple(failed for _, failed in checks)

    messages = []
    closed, shapes = jax.make_jaxpr(checked, return_shape=True)(*leaves)
    return closed, shapes, tuple(messages)


class Traced:
    """`function(**point)` of numbers as a `program` with `constants`: `program(*point, constants)`.

    Two of them are equal if they trace to the same program, whatever the constants (a record, say). `shapes` is what
    the function returns, `fingerprint` tells program and constants in any process.
    """

    def __init__(self, function: Callable, point: dict[str, jax.ShapeDtypeStruct]):
        closed, (self.shapes, failures), messages = traced(
            lambda *values: function(**dict(zip(point, values))), list(point.values())
        )
        self.program = Program(closed.jaxpr, jax.tree.structure((self.shapes, failures)), messages)
        self.messages, self.constants = messages, tuple(closed.consts)
        self.fingerprint = self.program.fingerprint(self.constants)

    def __call__(self, *arguments):
        """Evaluate at a point; the last argument are the constants."""
        return self.program(*arguments)

    def __hash__(self):
        return hash(self.program)

    def __eq__(self, other):
        return isinstance(other, Traced) and self.program == other.program


def _is_compiled(equation) -> bool:
    """Whether an operation is a call of a function under `jax.jit`."""
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
