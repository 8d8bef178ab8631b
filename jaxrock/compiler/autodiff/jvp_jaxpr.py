"""Forward mode of a jaxpr, as one jaxpr: its values, and their tangents in a few directions at once.

`jax.vmap` of `jax.jvp` computes the same, but takes a few times as long to trace. Both trace every loop and every
branch of a condition until they know which numbers have tangents, and once more to write them. `_which_move` tells it
beforehand, without tracing.

- Common operations have rules in `jvp_rules`.
- JAX differentiates other operations of one result, one by one.
- JAX differentiates the whole jaxpr where it holds another operation of many results: only JAX knows which of these
  have tangents. Such operations are scans, checkpoints and functions with rules of their own.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import ClosedJaxpr, Literal, jaxpr_as_fun

from jaxrock.compiler.autodiff.jvp_rules import JVP_RULES, MINUS_ONE, MOVED, OF_SOME, ONE, STILL, Over, number
from jaxrock.compiler.primitive.macro import changed, is_macro

_SMALL = 20  # operations of an inner jaxpr that is inlined
_PARTS = ("split", "unstack", "lane_map", "single_jacobian")  # of many results, all with tangents
# Operations that only call an inner jaxpr, with the name of the parameter that holds it.
_WITHIN = {"jit": "jaxpr", "pjit": "jaxpr", "closed_call": "call_jaxpr"}


def jvp_jaxpr(
    program: ClosedJaxpr, values: Sequence, moves: Sequence[bool], directions: Sequence, count: int | None
) -> tuple[list, list]:
    """Return the results of a jaxpr, and their tangents.

    **Arguments:**

    - `values`: inputs. `moves`: for each of them, whether it has a tangent.
    - `directions`: tangents of the inputs that have one.
    - `count`: number of directions, in the leading axis of each tangent; None: one direction, without an axis.

    **Returns:** results and tangents, with arrays of zeros for zero. Tangents of integers have no meaning.
    """
    try:
        _which_move(program, tuple(moves))
    except _LeftToJax:
        return _by_jax_alone(program, values, moves, directions, count)
    pushing = _Pushing(count)
    values, changes = pushing.through(program, list(values), _spread(directions, moves))
    return values, [pushing.given(x, d) for x, d in zip(values, changes)]


def _by_jax_alone(program: ClosedJaxpr, values: Sequence, moves: Sequence[bool], directions: Sequence, count):
    def one(*direction):
        def function(*own):
            return jaxpr_as_fun(program)(*_merged(values, moves, own))

        return jax.jvp(function, tuple(x for x, move in zip(values, moves) if move), direction)

    return (one if count is None else jax.vmap(one, out_axes=(None, 0)))(*directions)


class _LeftToJax(Exception):
    """The jaxpr holds an operation that only JAX can differentiate."""


class _Pushing:
    """Forward mode along `count` directions, in the leading axis of tangents; None: one direction, without an axis.

    A tangent that is zero is None.
    """

    def __init__(self, count: int | None):
        self.axis = () if count is None else (count,)
        self._functions = {}  # jitted inner jaxprs, which may be called more than once

    def given(self, x, change):
        """Return a tangent; zeros for None."""
        return lax.full((*self.axis, *np.shape(x)), 0, x.dtype) if change is None else change

    def through(self, program, values: list, changes: list) -> tuple[list, list]:
        """Return results and tangents of a closed jaxpr."""
        jaxpr = program.jaxpr
        known, moved = dict(zip(jaxpr.constvars, program.consts)), {}
        _note(known, moved, jaxpr.invars, values, changes)

        def read(x):
            return number(x.aval, x.val) if isinstance(x, Literal) else known[x]

        def change(x):
            return None if isinstance(x, Literal) else moved.get(x)

        for equation in jaxpr.eqns:
            found = self.of(equation, [read(x) for x in equation.invars], [change(x) for x in equation.invars])
            _note(known, moved, equation.outvars, *found)
        return [read(x) for x in jaxpr.outvars], [change(x) for x in jaxpr.outvars]

    def of(self, equation, xs: list, ds: list) -> tuple[list, list]:
        """Return results and tangents of an equation."""
        name, parameters = equation.primitive.name, equation.params
        flags = tuple(d is not None for d in ds)
        if not any(flags) or (not _has_rules(equation) and not any(_moving_results(equation, flags))):
            values = _bound(equation, xs)
            return values, [None] * len(values)
        if name in _WITHIN:
            return self.within(parameters[_WITHIN[name]], xs, ds)
        if name == "while":
            return self.loop(equation, xs, ds)
        if name == "cond":
            return self.cases(equation, xs, ds)
        if is_macro(name) and not any(map(np.shape, xs)):
            return changed(name, xs, ds, parameters, self.through)
        if name in JVP_RULES:
            (z,) = _bound(equation, xs)
            return [z], [self.summed(JVP_RULES[name], parameters, z, xs, ds)]
        if name == "select_n" and not np.shape(xs[0]):
            return _bound(equation, xs), [lax.select_n(xs[0], *map(self.given, xs[1:], ds[1:]))]
        if name == "concatenate":
            parts, axis = list(map(self.given, xs, ds)), parameters["dimension"] + len(self.axis)
            return _bound(equation, xs), [lax.concatenate(parts, axis)]
        if name in MOVED and not flags[1:]:
            return _bound(equation, xs), [MOVED[name](ds[0], parameters) if self.axis else _bound(equation, ds)[0]]
        return self.by_jax(equation, xs, ds)

    def summed(self, partials: tuple, parameters: dict, z, xs: list, ds: list):
        """Return the tangent of a result z: partial derivatives times tangents of the operands.

        Scalar operands may stand beside arrays.
        """
        total = None
        for partial, d in zip(partials, ds):
            if d is None:
                continue
            if d.ndim < len(self.axis) + z.ndim:
                d = lax.broadcast_in_dim(d, (*self.axis, *z.shape), tuple(range(len(self.axis))))
            if partial is MINUS_ONE:
                total = lax.neg(d) if total is None else lax.sub(total, d)
                continue
            if partial is not ONE:
                is_divided = isinstance(partial, Over)
                factor = (partial.function if is_divided else partial)(parameters, z, *xs)
                factor = lax.broadcast(factor, self.axis) if np.shape(factor) else factor
                d = (lax.div if is_divided else lax.mul)(d, factor)
            total = d if total is None else lax.add(total, d)
        return total

    def within(self, program, xs: list, ds: list) -> tuple[list, list]:
        """Return results and tangents of an inner jaxpr; a large one is jitted, for later calls."""
        flags = tuple(d is not None for d in ds)
        if len(program.jaxpr.eqns) <= _SMALL and not any(map(_has_rules, program.jaxpr.eqns)):
            return self.through(program, xs, ds)
        key = id(program.jaxpr), flags
        if key not in self._functions:
            results = _which_move(program, flags)
            self._functions[key] = jax.jit(self.changing(program, flags, results)), results
        function, results = self._functions[key]
        values, changes = function(xs, [d for d in ds if d is not None])
        return values, _spread(changes, results)

    def changing(self, program, moves: Sequence[bool], results: Sequence[bool]) -> Callable:
        """Return a function from values and tangents to results and their tangents, all without those that are None."""

        def made(values, changes):
            values, changes = self.through(program, values, _spread(changes, moves))
            return values, [self.given(x, d) for x, d, moves in zip(values, changes, results) if moves]

        return made

    def loop(self, equation, xs: list, ds: list) -> tuple[list, list]:
        """Return results and tangents of a `while`, whose state gets its tangents appended."""
        parameters = equation.params
        n_cond, n_body = parameters["cond_nconsts"], parameters["body_nconsts"]
        of_cond, of_body, state = xs[:n_cond], xs[n_cond : n_cond + n_body], xs[n_cond + n_body :]
        of_body_moved, moved = ds[n_cond : n_cond + n_body], ds[n_cond + n_body :]
        flags = _moving_results(equation, tuple(d is not None for d in ds))
        constant = tuple(d is not None for d in of_body_moved)
        going = jaxpr_as_fun(parameters["cond_jaxpr"])
        step = self.changing(parameters["body_jaxpr"], (*constant, *flags), flags)
        same = [d for d in of_body_moved if d is not None]
        first = [self.given(x, d) for x, d, moves in zip(state, moved, flags) if moves]
        values, changes = lax.while_loop(
            lambda carry: going(*of_cond, *carry[0])[0],
            lambda carry: step([*of_body, *carry[0]], [*same, *carry[1]]),
            (state, first),
        )
        return values, _spread(changes, flags)

    def cases(self, equation, xs: list, ds: list) -> tuple[list, list]:
        """Return results and tangents of a `cond`, whose branches compute both."""
        which, *xs = xs
        moves = tuple(d is not None for d in ds[1:])
        flags = _moving_results(equation, (False, *moves))
        cases = [self.changing(program, moves, flags) for program in equation.params["branches"]]
        values, changes = lax.switch(
            lax.convert_element_type(which, np.int32), cases, xs, [d for d in ds[1:] if d is not None]
        )
        return values, _spread(changes, flags)

    def by_jax(self, equation, xs: list, ds: list) -> tuple[list, list]:
        """Return results and tangents by JAX's rules."""
        moves, xs = [d is not None for d in ds], list(map(jnp.asarray, xs))  # rules of JAX may demand arrays

        def one(*direction):
            def function(*own):
                return _bound(equation, _merged(xs, moves, own))

            return jax.jvp(function, tuple(x for x, move in zip(xs, moves) if move), direction)

        every = jax.vmap(one, out_axes=(None, 0)) if self.axis else one
        values, changes = every(*(d for d in ds if d is not None))
        return values, [d if _is_real(x) else None for x, d in zip(values, changes)]


def _note(known: dict, moved: dict, variables, values: list, changes: list) -> None:
    known.update(zip(variables, values))
    moved.update((v, d) for v, d in zip(variables, changes) if d is not None)


def _bound(equation, xs: list) -> list:
    """Return the results of an equation."""
    found = equation.primitive.bind(*xs, **equation.primitive.get_bind_params(equation.params))
    return list(found) if equation.primitive.multiple_results else [found]


def _merged(xs: Sequence, moves: Sequence[bool], own: Sequence) -> list:
    """Return the values, with those that have a tangent taken from `own`."""
    rest = iter(own)
    return [next(rest) if move else x for x, move in zip(xs, moves)]


def _has_rules(equation) -> bool:
    """Return whether an equation may hold functions with rules of their own.

    These may return other integers, too, where any input has a tangent.
    """
    return equation.primitive.name in ("while", "cond") or any(x in equation.params for x in ("jaxpr", "call_jaxpr"))


def _spread(changes: Sequence, flags: Sequence[bool]) -> list:
    """Return tangents at the flagged places, and None at the others."""
    rest = iter(changes)
    return [next(rest) if moves else None for moves in flags]


def _is_real(x: Any) -> bool:
    return jax.dtypes.issubdtype(x.dtype, np.inexact)


def _which_move(program: Any, flags: tuple[bool, ...]) -> tuple[bool, ...]:
    """Return for each result of a jaxpr whether it may have a tangent, given which inputs have one."""
    jaxpr = program.jaxpr
    moved = {v for v, moves in zip(jaxpr.invars, flags) if moves}
    for equation in jaxpr.eqns:
        own = tuple(not isinstance(x, Literal) and x in moved for x in equation.invars)
        moved.update(v for v, moves in zip(equation.outvars, _moving_results(equation, own)) if moves)
    return tuple(not isinstance(x, Literal) and x in moved for x in jaxpr.outvars)


def _moving_results(equation, flags: tuple[bool, ...]) -> tuple[bool, ...]:
    """Return for each result of an equation whether it may have a tangent, given which operands have one.

    **Raises:** `_LeftToJax` for an operation that only JAX can differentiate.
    """
    name, parameters = equation.primitive.name, equation.params
    by = OF_SOME[name](parameters, flags) if name in OF_SOME else flags
    if not any(by) or name in STILL:
        return (False,) * len(equation.outvars)
    if not _is_known(equation):
        raise _LeftToJax(name)
    if name in _WITHIN:
        return _which_move(parameters[_WITHIN[name]], flags)
    if name == "cond":
        each = [_which_move(program, flags[1:]) for program in parameters["branches"]]
        return tuple(map(any, zip(*each)))
    if name == "while":
        n_cond, n_body = parameters["cond_nconsts"], parameters["body_nconsts"]
        of_body, state = flags[n_cond : n_cond + n_body], flags[n_cond + n_body :]
        while True:
            after = _which_move(parameters["body_jaxpr"], (*of_body, *state))
            more = tuple(a or b for a, b in zip(after, state))
            if more == state:
                return state
            state = more
    return tuple(_is_real(v.aval) for v in equation.outvars)


def _is_known(equation) -> bool:
    """Return whether an operation is known here, or has one result.

    Of many results, all that are real would count as having a tangent.
    """
    name, parameters = equation.primitive.name, equation.params
    if any(jax.dtypes.issubdtype(v.aval.dtype, np.complexfloating) for v in (*equation.invars, *equation.outvars)):
        return False
    if name == "while":
        return not parameters["cond_jaxpr"].out_avals[0].shape
    is_own = name in _WITHIN or name in ("cond", "custom_tangent", *_PARTS) or is_macro(name)
    return is_own or (len(equation.outvars) == 1 and "jaxpr" not in parameters)
