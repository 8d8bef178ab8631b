"""User functions as pytrees: each is traced at call time, so that changes of the data it reads take effect.

`jax.jit` identifies a function by its object. The same object may compute something else later: it may read a global,
an attribute, or an array that is changed in place. So each call of an entry point of the package traces a user
function, which takes about a millisecond. It skips the trace if `dependency_key` shows that nothing the function reads
has changed.

The trace becomes a pytree: the captured arrays are its leaves, and the text of the jaxpr is its static part. JAX
compiles again only if the text changes. Arrays and tracers are arguments and have derivatives.

The function must depend only on its arguments and on what it reads. If `jax.jit` has compiled it before, JAX's cache
decides what it computes.
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

from jaxrock._core.arrays import is_traced
from jaxrock.compiler.cache.dependency_key import dependency_key
from jaxrock.compiler.jaxpr.fingerprint import Program, traced
from jaxrock.compiler.primitive.error_if import error_if


class StaticFunction(eqx.Module):
    """A function as the static part of a pytree: equal where it is the same object."""

    function: Callable = eqx.field(static=True)

    @property
    def __wrapped__(self) -> Callable:  # for `inspect.signature`
        return self.function

    def __call__(self, *arguments, **named):
        return self.function(*arguments, **named)


class TracedFunction(eqx.Module):
    """A function as of its trace, made by `trace_function`.

    Pickling stores the function by its name, and loading traces it anew.
    """

    program: Program = eqx.field(static=True)
    structure: Any = eqx.field(static=True)  # of its arguments
    dtypes: tuple = eqx.field(static=True)
    arrays: tuple  # leaves of the function itself as a pytree; `captured` holds the constants of its jaxpr
    captured: tuple

    @classmethod
    def of(cls, function: Callable, *arguments, **named) -> "TracedFunction":
        """Trace a function for such arguments: `jax.ShapeDtypeStruct`s of scalars, or pytrees of them."""
        arrays, rest = eqx.partition(function, eqx.is_array_like)
        arrays, held = jax.tree.flatten(arrays)
        leaves, structure = jax.tree.flatten((arguments, named))

        def call(*values):
            itself = eqx.combine(held.unflatten(values[: len(arrays)]), rest)
            arguments, named = structure.unflatten(values[len(arrays) :])
            return itself(*arguments, **named)

        values, known = [*arrays, *leaves], dependency_key(function)  # a function with a key holds no arrays
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

    @property
    def results(self) -> Any:
        """The pytree that a call returns, as `jax.ShapeDtypeStruct`s."""
        return self.program.results[0]

    @property
    def calls_back(self) -> bool:
        """Return whether the jaxpr calls Python functions, which no fingerprint identifies."""
        return self.program.calls_back

    @property
    def fingerprint(self) -> str:
        """Identify the jaxpr and the captured arrays in any process."""
        return self.program.fingerprint((*self.arrays, *self.captured))

    def __reduce__(self):
        origin = _origins.get(self.program)
        if origin is None or self.arrays:
            raise pickle.PicklingError("A function that holds arrays, or reads what may change, cannot be pickled.")
        return _loaded, (*origin, self.program.fingerprint(()), self.captured)

    def __copy__(self):
        return TracedFunction(self.program, self.structure, self.dtypes, self.arrays, self.captured)

    def __deepcopy__(self, memo):
        arrays, captured = copy.deepcopy((self.arrays, self.captured), memo)
        return TracedFunction(self.program, self.structure, self.dtypes, arrays, captured)

    def __call__(self, *arguments, **named):
        """Evaluate the jaxpr within a trace; its checks raise, or are collected, here."""
        leaves, structure = jax.tree.flatten((arguments, named))
        if structure != self.structure:
            raise TypeError(f"A function that was traced for {self.structure} is called with {structure}.")
        leaves = [jnp.asarray(x, dtype) for x, dtype in zip(leaves, self.dtypes)]
        found, failures = self.program(*self.arrays, *leaves, self.captured)
        for message, failed in zip(self.program.messages, failures):
            found = error_if(found, failed, message)
        return found


_known: weakref.WeakKeyDictionary[ClosedJaxpr, TracedFunction] = weakref.WeakKeyDictionary()


# The function and arguments of each of the latest jaxprs, for pickling. Only functions with a `dependency_key` are
# stored, which hold no tracers. The pytree cannot hold them: `jax.jit` keeps the first pytree of equal static parts.
_origins: dict[Program, tuple[Callable, tuple, dict]] = {}
_MOST_ORIGINS, _one_at_a_time = 64, threading.Lock()


def _note(program: Program, origin: tuple[Callable, tuple, dict]) -> None:
    with _one_at_a_time:
        _origins.pop(program, None)
        _origins[program] = origin
        for oldest in list(_origins)[:-_MOST_ORIGINS]:
            del _origins[oldest]


def _loaded(function: Callable, arguments: tuple, named: dict, told: str, captured: tuple) -> TracedFunction:
    """Restore a pickled function. **Raises:** ValueError if the function has another jaxpr now."""
    made = TracedFunction.of(function, *arguments, **named)
    if made.program.fingerprint(()) != told:
        raise ValueError(
            "A function that was pickled computes something else now, or is traced otherwise: by another version of "
            "JAX, or in another precision."
        )
    return TracedFunction(made.program, made.structure, made.dtypes, (), captured)


def trace_function(function: Callable, *arguments, **named) -> TracedFunction | StaticFunction:
    """Trace a function as it is now, as a pytree.

    **Arguments:**

    - `function`: any function that JAX can trace.
    - `arguments`, `named`: examples of its arguments, `jax.ShapeDtypeStruct`s of scalars. Without any, the function is
      not traced, and it equals another only if both are the same object.

    **Returns:** a pytree that is called like the function. Equal pytrees have the same jaxpr.

    **Example:**

    ```python
    import jax
    from jaxrock.compiler import trace_function

    factor = 2.0
    twice = trace_function(lambda x: factor * x, jax.ShapeDtypeStruct((), float))
    factor = 3.0
    six = jax.jit(lambda f, x: f(x))(twice, 3.0)  # as it was traced
    ```
    """
    if isinstance(function, TracedFunction):
        return function  # an outer entry point has traced it
    if not (arguments or named):
        return StaticFunction(function)
    if isinstance(function, StaticFunction):
        function = function.function
    # A class of the package never changes, so tracing it at every call would be wasted. A class of a user is traced
    # like any function.
    if isinstance(function, type) and function.__module__.split(".")[0] == __name__.split(".")[0]:
        return StaticFunction(function)
    return TracedFunction.of(function, *arguments, **named)


def _own(array):
    """Copy a NumPy array, which JAX would hold by reference and a caller could change in place."""
    return np.array(array) if isinstance(array, np.ndarray) else array


def _with_own_arrays(jaxpr: Jaxpr) -> Jaxpr:
    """Return the jaxpr with copies of its NumPy arrays; the same object if it has none."""

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
    """Return a key for custom derivative rules: the fingerprint of their jaxpr.

    The function's own jaxpr only names such rules. The key is empty if the jaxpr has none, and unique if the rules
    cannot be traced or have no fingerprint.
    """
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
    except Exception:  # no forward-mode rule: the jaxpr equals itself only
        return (object(),)
    program = Program(slopes.jaxpr, None, ())
    if program.calls_back or is_traced(slopes.consts):
        return (object(),)
    return (program.fingerprint(slopes.consts),)
