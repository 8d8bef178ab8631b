"""Identify a function by its jaxpr: equal jaxprs compile once, and a fingerprint identifies them in any process."""

import functools
import hashlib
import weakref
from collections.abc import Callable, Hashable, Iterable, Iterator
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, jaxpr_as_fun

from jaxrock._core.throwing import throws
from jaxrock.compiler.checks import Checked, with_checks


class Program:
    """A jaxpr without the arrays that its function captures: these are an argument, `program(*leaves, arrays)`.

    Two are equal if their jaxprs print alike, so that JAX compiles equal ones once. Checks of arguments do not raise:
    a call returns the results and, for each of `messages`, whether that check fails.
    """

    def __init__(self, jaxpr: Jaxpr, structure, messages: tuple[str, ...], more: tuple = ()):
        self.messages, self._jaxpr, self._structure = messages, jaxpr, structure
        # The print of a jaxpr holds no addresses and no arrays, so the digest takes each array separately.
        self._told = hashlib.sha256(_text(jaxpr).encode())
        callbacks = []
        for part in _hidden(jaxpr):
            if callable(part):
                callbacks.append(_same_callback(part))
            else:
                _tell(self._told, part)
        self.calls_back = any(map(callable, callbacks))  # some callback has no fingerprint across processes
        self._key = (self._told.hexdigest(), structure, messages, tuple(callbacks), *more)

    def __call__(self, *arguments):
        """Evaluate at leaves; the last argument is the sequence of captured arrays."""
        *leaves, captured = arguments
        found = jaxpr_as_fun(ClosedJaxpr(self._jaxpr, list(captured)))(*leaves)
        return jax.tree.unflatten(self._structure, found)

    @property
    def results(self) -> Any:
        """Shapes and types of what a call returns."""
        avals: list[Any] = [v.aval for v in self._jaxpr.outvars]
        like = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in avals]
        return jax.tree.unflatten(self._structure, like)

    def fingerprint(self, captured: Iterable) -> str:
        """Return a digest that identifies the jaxpr together with these captured arrays in any process."""
        told = self._told.copy()
        for array in captured:
            _tell(told, array)
        return told.hexdigest()

    def __hash__(self):
        return hash(self._key)

    def __eq__(self, other):
        return isinstance(other, Program) and self._key == other._key


def traced(function: Callable, key: Hashable | None, leaves: Iterable) -> tuple[ClosedJaxpr, Checked]:
    """Trace a function of leaves, with its checks collected, and return its jaxpr and the types of its results.

    `key` identifies the function: functions with equal keys share one trace, so the returned jaxpr is the same object.
    With None the function has no such key and is traced at every call.
    """
    if key is None:
        return jax.make_jaxpr(with_checks(function), return_shape=True)(*leaves)
    found = _under_jit(_Keyed(function, (key, throws()))).trace(*leaves)
    return found.jaxpr, found.out_info


class _Keyed:
    """A function that equals others with the same key."""

    def __init__(self, function: Callable, key: Hashable):
        self.function, self.key = function, key

    def __hash__(self):
        return hash(self.key)

    def __eq__(self, other):
        return isinstance(other, _Keyed) and self.key == other.key


# The cache of `jax.jit` also depends on JAX's settings and on the leaves' dtypes: a change in either traces anew.
@functools.lru_cache(maxsize=64)
def _under_jit(keyed: _Keyed) -> Any:
    return jax.jit(with_checks(keyed.function))


def _is_compiled(equation) -> bool:
    """Return whether an equation calls a function compiled by `jax.jit`."""
    return equation.primitive.name in ("jit", "pjit") and isinstance(equation.params.get("jaxpr"), ClosedJaxpr)


_known = weakref.WeakKeyDictionary()


def _known_of(jaxpr: Jaxpr) -> tuple[str, tuple]:
    """Return the digest of a jaxpr's text and its hidden parts; each jaxpr is printed and searched once."""
    if jaxpr not in _known:
        _known[jaxpr] = hashlib.sha256(f"{jaxpr}".encode()).hexdigest(), tuple(_hidden(jaxpr))
    return _known[jaxpr]


def _text(jaxpr: Jaxpr) -> str:
    """Return the text of a jaxpr, with digests in place of functions under `jax.jit`, whose jaxprs JAX shares."""
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
    """Yield the parts of a jaxpr that its print omits: its inner arrays and its callback functions."""
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
                elif getattr(part, "key", "") is None:  # a lane function that only its jaxpr identifies
                    yield from part.program.consts
                    yield from _hidden(part.program.jaxpr)
                elif "callback" in equation.primitive.name and callable(part):
                    yield getattr(part, "callback_func", part)


def _same_callback(function: Callable):
    """Return a hashable value that identifies a callback function of a jaxpr.

    Every trace makes new function objects for the checks of `equinox.error_if`: their messages identify them. Any
    other function equals only itself.
    """
    inner = function.func if isinstance(function, functools.partial) else function
    if not getattr(inner, "__module__", "").startswith("equinox."):
        return function
    cells = [cell.cell_contents for cell in getattr(inner, "__closure__", None) or ()]
    said = tuple(text for cell in cells for text in (cell if isinstance(cell, (list, tuple)) else [cell]))
    return inner.__qualname__, tuple(text for text in said if isinstance(text, str))
