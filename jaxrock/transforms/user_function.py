"""Functions of a user's as part of a pytree: as what they are now, even if what they read has changed meanwhile.

`jax.jit` takes a function for the same as long as it is the same object. What it computes may change all the same: it
may read a global, an attribute, an array that is changed in place. So a function of a user's is traced whenever an
entry point of the package is called, which takes about a millisecond, unless all that it reads is known to be the same
(`reads`), and goes on as the program that it traces to: a pytree with the arrays that it captures as leaves, and the
text of the program as the static part. Nothing is compiled again while the text is the same, and arrays and traced
values are arguments, with derivatives.

It has to be a function of its arguments and of what it reads. A function that was compiled by `jax.jit` before is what
JAX has kept of it.
"""

import copy
import pickle
import threading
import weakref
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from jaxrock._checks import is_traced, watched
from jaxrock.transforms.fingerprint import Program, traced
from jaxrock.transforms.reads import reads


class ByIdentity(eqx.Module):
    """A function as the static part of a pytree: equal where it is the same object."""

    function: Callable = eqx.field(static=True)

    def __call__(self, *arguments, **named):
        return self.function(*arguments, **named)


class UserFunction(eqx.Module):
    """A function as it was when it was traced. Made by `current_function`.

    It is pickled as the function is, by its name, and traced anew where it is loaded.
    """

    program: Program = eqx.field(static=True)
    structure: Any = eqx.field(static=True)  # of its arguments
    dtypes: tuple = eqx.field(static=True)
    arrays: tuple  # numbers that the function holds as a pytree, and arrays that it captures
    captured: tuple

    @classmethod
    def of(cls, function: Callable, *arguments, **named) -> "UserFunction":
        """Trace it for such arguments: `jax.ShapeDtypeStruct`s of numbers, or pytrees of them."""
        arrays, rest = eqx.partition(function, eqx.is_array_like)
        arrays, held = jax.tree.flatten(arrays)
        leaves, structure = jax.tree.flatten((arguments, named))

        def call(*values):
            itself = eqx.combine(held.unflatten(values[: len(arrays)]), rest)
            arguments, named = structure.unflatten(values[len(arrays) :])
            return itself(*arguments, **named)

        values, known = [*arrays, *leaves], reads(function)  # what is told so holds no arrays
        closed, told = traced(call, None if known is None else (known, structure), values)
        if closed in _known:
            _note(_known[closed].program, (function, arguments, named))
            return _known[closed]
        jaxpr, rules = _with_own_arrays(closed.jaxpr), _rules(closed, call, values)
        program = Program(jaxpr, jax.tree.structure((told.results, told.failed)), told.messages, rules)
        dtypes = tuple(leaf.dtype for leaf in leaves)
        made = cls(program, structure, dtypes, tuple(map(_own, arrays)), tuple(map(_own, closed.consts)))
        if known is not None:
            _known[closed] = made
            _note(program, (function, arguments, named))
        return made

    def __reduce__(self):
        origin = _origins.get(self.program)
        if origin is None or self.arrays:
            raise pickle.PicklingError("A function that holds arrays, or reads what may change, cannot be pickled.")
        return _loaded, (*origin, self.program.fingerprint(()), self.captured)

    def __copy__(self):
        return UserFunction(self.program, self.structure, self.dtypes, self.arrays, self.captured)

    def __deepcopy__(self, memo):
        arrays, captured = copy.deepcopy((self.arrays, self.captured), memo)
        return UserFunction(self.program, self.structure, self.dtypes, arrays, captured)

    def __call__(self, *arguments, **named):
        """Evaluate it within a trace; checks that it makes are made, or put down, here."""
        leaves, structure = jax.tree.flatten((arguments, named))
        if structure != self.structure:
            raise TypeError(f"A function that was traced for {self.structure} is called with {structure}.")
        leaves = [jnp.asarray(x, dtype) for x, dtype in zip(leaves, self.dtypes)]
        found, failures = self.program(*self.arrays, *leaves, self.captured)
        for message, failed in zip(self.program.messages, failures):
            found = watched(found, message, failed)
        return found


_known: weakref.WeakKeyDictionary[ClosedJaxpr, UserFunction] = weakref.WeakKeyDictionary()


# What a program was traced from the last time, of the latest programs, for pickling: all that such a function reads is
# known, and nothing of it is traced. Not in the pytree, of which `jax.jit` keeps the first that has the same program.
_origins: dict[Program, tuple[Callable, tuple, dict]] = {}
_MOST_ORIGINS, _one_at_a_time = 64, threading.Lock()


def _note(program: Program, origin: tuple[Callable, tuple, dict]) -> None:
    with _one_at_a_time:
        _origins.pop(program, None)
        _origins[program] = origin
        for oldest in list(_origins)[:-_MOST_ORIGINS]:
            del _origins[oldest]


def _loaded(function: Callable, arguments: tuple, named: dict, told: str, captured: tuple) -> UserFunction:
    """A function that was pickled. **Raises:** ValueError where it computes something else now."""
    made = UserFunction.of(function, *arguments, **named)
    if made.program.fingerprint(()) != told:
        raise ValueError(
            "A function that was pickled computes something else now, or is traced otherwise: by another version of "
            "JAX, or in another precision."
        )
    return UserFunction(made.program, made.structure, made.dtypes, (), captured)


def current_function(function: Callable, *arguments, **named) -> UserFunction | ByIdentity:
    """A function as it is now, as a pytree.

    **Arguments:**

    - `function`: anything that JAX can trace.
    - `arguments`, `named`: examples of what it will be called with, `jax.ShapeDtypeStruct`s of numbers.

    **Returns:** a pytree that is called like the function. Equal ones have the same program.
    """
    if isinstance(function, UserFunction):
        return function  # an entry point further out has made it
    if isinstance(function, ByIdentity):
        function = function.function
    # Classes of the package are what they are: tracing `SinePulse` at every call would tell nothing new. A class of the
    # user's is traced as any function is.
    if isinstance(function, type) and function.__module__.split(".")[0] == __name__.split(".")[0]:
        return ByIdentity(function)
    return UserFunction.of(function, *arguments, **named)


def _own(array):
    """An array that nobody changes in place: JAX keeps those of NumPy as they are."""
    return np.array(array) if isinstance(array, np.ndarray) else array


def _with_own_arrays(jaxpr: Jaxpr) -> Jaxpr:
    """A program whose numbers nobody changes in place; the same object where nobody can."""

    def of(part):
        if isinstance(part, ClosedJaxpr):
            inner, arrays = _with_own_arrays(part.jaxpr), [_own(x) for x in part.consts]
            same = inner is part.jaxpr and all(a is b for a, b in zip(arrays, part.consts))
            return part if same else ClosedJaxpr(inner, arrays)
        if isinstance(part, Jaxpr):
            return _with_own_arrays(part)
        if isinstance(part, Literal) and isinstance(part.val, np.ndarray):
            return Literal(np.array(part.val), part.aval)
        if type(part) in (tuple, list):
            parts = [of(x) for x in part]
            return part if all(a is b for a, b in zip(parts, part)) else type(part)(parts)
        return part

    def of_equation(equation):
        inputs, params = of(equation.invars), {name: of(value) for name, value in equation.params.items()}
        same = inputs is equation.invars and all(params[name] is value for name, value in equation.params.items())
        return equation if same else equation.replace(invars=inputs, params=params)

    equations, outputs = [of_equation(equation) for equation in jaxpr.eqns], of(jaxpr.outvars)
    if outputs is jaxpr.outvars and all(a is b for a, b in zip(equations, jaxpr.eqns)):
        return jaxpr
    return jaxpr.replace(eqns=equations, outvars=outputs)


def _rules(closed: ClosedJaxpr, function: Callable, leaves: list) -> tuple:
    """What tells derivatives that a function states itself: their program, because that of the function names them
    only."""
    if "custom_" not in f"{closed.jaxpr}":
        return ()
    real = [jnp.issubdtype(jnp.result_type(leaf), jnp.inexact) for leaf in leaves]

    def changes(leaves, moves):
        moves = iter(moves)
        return [next(moves) if is_real else np.zeros((), jax.dtypes.float0) for is_real in real]

    def forward(leaves, moves):
        return jax.jvp(function, leaves, changes(leaves, moves))

    try:
        slopes = jax.make_jaxpr(forward)(leaves, [leaf for leaf, is_real in zip(leaves, real) if is_real])
    except Exception:  # reverse mode only, or not at all: the program is like itself only
        return (object(),)
    program = Program(slopes.jaxpr, None, ())
    if program.calls_back or is_traced(slopes.consts):
        return (object(),)
    return (program.fingerprint(slopes.consts),)
