"""Programs in plain operations: without calls, with what is known computed, with what nobody needs left out.

Libraries write more than a program needs: calls within calls, operations of their own that only mark a value, buffers
for results nobody asks for, tables that a loop of seven turns looks into, flags that never change. Here a program is
traced once more, and all that is known before it runs is done with: constants are computed, cases that are known are
chosen, loops whose turns are known are unrolled, and what does not change in a loop is known in it.
"""

import functools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal
from jax.interpreters import partial_eval

from jaxrock._precision import setting
from jaxrock._programs import programs_of
from jaxrock.native.in_numpy import KNOWN, MOVES
from jaxrock.native.operations import NOTHING, Unsupported
from jaxrock.native.partition import needed_by

_CALLS = {"jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "checkpoint", "remat2"}
_TABLE = 256  # numbers of a constant that may be looked into: a solver's table
_MOST = 64  # of an array that is computed here
_TURNS, _OPERATIONS = 32, 1 << 14  # of a loop that is unrolled, at most
_SMALL = 4  # operations of a program that is gone through again rather than remembered


def plain(program: ClosedJaxpr) -> ClosedJaxpr:
    """The same program in plain operations."""

    def run(*leaves):
        return _Run(binds=True).of(program, leaves)

    return _traced(run, program)


def _traced(run: Callable, program: ClosedJaxpr) -> ClosedJaxpr:
    """A function of the inputs of a program, as a program without what nobody needs."""
    traced = jax.make_jaxpr(run)(*map(_like, program.in_avals))
    needed, _ = partial_eval.dce_jaxpr(traced.jaxpr, [True] * len(traced.jaxpr.outvars), instantiate=True)
    return ClosedJaxpr(needed, traced.consts)


@functools.cache
def is_foreign(primitive) -> bool:
    """Return whether an operation is another library's, written in Python."""
    rule = getattr(primitive, "impl", None)
    module = getattr(getattr(rule, "func", rule), "__module__", None) or "jax"
    return module.partition(".")[0] not in ("jax", "jaxlib", "jaxrock")


def has_foreign(jaxpr) -> bool:
    """Return whether a program holds an operation of another library."""
    return any(
        is_foreign(equation.primitive) or any(map(has_foreign, programs_of(equation))) for equation in jaxpr.eqns
    )


def _like(aval) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(aval.shape, aval.dtype)


class _Run:
    """Goes through a program with values that are known (of NumPy) or not: then they are traced; or, unless it `binds`,
    they are None, and it only tells which results are known."""

    def __init__(self, binds: bool, told: dict | None = None):
        self.binds = binds
        self.told = {} if told is None else told  # which results are known, by programs and what is given of them

    def of(self, program: ClosedJaxpr, given: Sequence) -> list:
        """The results of a program (closed)."""
        if self.binds or len(program.jaxpr.eqns) < _SMALL:
            return self._through(program, given)
        # Of a loop within loops the same is asked again and again.
        values = tuple(None if x is None else (x.dtype, x.shape, x.tobytes()) for x in given)
        key = id(program.jaxpr), tuple(map(id, program.consts)), values
        if key not in self.told:
            self.told[key] = program, self._through(program, given)  # the program, too: its number is not another's
        return self.told[key][1]

    def _through(self, program: ClosedJaxpr, given: Sequence) -> list:
        jaxpr = program.jaxpr
        values: dict[Any, Any] = dict(zip(jaxpr.invars, given, strict=True))
        consts = map(_known, program.consts)
        values.update(zip(jaxpr.constvars, consts if self.binds else _only_known(consts), strict=True))

        def read(atom):
            return np.asarray(atom.val, atom.aval.dtype) if isinstance(atom, Literal) else values[atom]

        for equation in jaxpr.eqns:
            found = self._apply(equation, [read(x) for x in equation.invars])
            values.update(zip(equation.outvars, found, strict=True))
        return [read(x) for x in jaxpr.outvars]

    def _apply(self, equation, given: list) -> list:
        name, parameters = equation.primitive.name, equation.params
        if name in _CALLS:
            inner = parameters["jaxpr"] if "jaxpr" in parameters else parameters["call_jaxpr"]
            return self.of(inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ()), given)
        if name == "cond":
            return self._cases(equation, given)
        if name == "while":
            return self._loop(equation, given)
        if name == "scan" and _is_short(parameters["length"], parameters["jaxpr"]):
            return self._scan(equation, given)
        if "callback" in name:  # which another library may have put where it is hardly ever called
            raise Unsupported(f"operation {name}")
        if name in NOTHING:
            return given[: len(equation.outvars)]  # what tells of a value comes after it
        found = _computed(equation, given)
        if found is not None:
            return found
        if is_foreign(equation.primitive):
            return self.of(_written_out(equation), given)
        return self._bound(equation, given)

    def _bound(self, equation, given: Sequence, parameters: dict | None = None) -> list:
        """What an operation gives that is left as it is."""
        if not self.binds:
            return [None] * len(equation.outvars)
        found = equation.primitive.bind(*given, **(parameters or equation.params))
        return list(found) if equation.primitive.multiple_results else [found]

    def _cases(self, equation, given: list) -> list:
        which, *operands = given
        branches = equation.params["branches"]
        if _is_known(which):
            return self.of(branches[int(np.clip(int(which), 0, len(branches) - 1))], operands)
        if not self.binds:
            results = [self.of(branch, operands) for branch in branches]
            return [first if all(_same(first, x) for x in others) else None for first, *others in zip(*results)]
        cases = [self._with_known(branch, operands) for branch in branches]
        kept = [any(needs) for needs in zip(*map(_needs, cases))]
        cases = tuple(_with_inputs(case, kept) for case in cases)
        operands = [x for x, keeps in zip(operands, kept) if keeps]
        return self._bound(equation, [which, *operands], equation.params | {"branches": cases})

    def _with_known(self, program: ClosedJaxpr, given: Sequence, keep: Sequence = ()) -> ClosedJaxpr:
        """A program of the same inputs, of which some are known; its results `keep` are given."""

        def run(*leaves):
            mixed = [x if _is_known(x) else leaf for x, leaf in zip(given, leaves)]
            found = _Run(binds=True, told=self.told).of(program, mixed)
            return [x if x is not None else y for x, y in zip(keep or [None] * len(found), found)]

        return _traced(run, program)

    def _scan(self, equation, given: list) -> list:
        """A loop over the rows of arrays, unrolled."""
        parameters, length = equation.params, equation.params["length"]
        carried = _alike(equation.outvars, parameters["jaxpr"].out_avals)
        consts = _alike(equation.invars, parameters["jaxpr"].in_avals) - carried
        fixed, carry, lists = given[:consts], given[consts : consts + carried], given[consts + carried :]
        rows = []
        for turn in range(length):
            place = length - 1 - turn if parameters["reverse"] else turn
            found = self.of(parameters["jaxpr"], [*fixed, *carry, *(_row(x, place) for x in lists)])
            carry = found[:carried]
            rows.append(found[carried:])
        if not rows:
            made = parameters["jaxpr"].out_avals[carried:]
            return [*carry, *(np.zeros((0, *x.shape), x.dtype) for x in made)]
        columns = zip(*(rows[::-1] if parameters["reverse"] else rows))
        return [*carry, *(_stacked(column) for column in columns)]

    def _loop(self, equation, given: list) -> list:
        parameters = equation.params
        n_cond, n_body = parameters["cond_nconsts"], parameters["body_nconsts"]
        of_cond, of_body, carry = given[:n_cond], given[n_cond : n_cond + n_body], given[n_cond + n_body :]
        cond, body = parameters["cond_jaxpr"], parameters["body_jaxpr"]
        asks = _Run(binds=False, told=self.told)
        for_cond, for_body, same = map(_only_known, (of_cond, of_body, carry))
        turns = _turns(lambda s: asks.of(cond, [*for_cond, *s])[0], lambda s: asks.of(body, [*for_body, *s]), same)
        if turns is not None and _is_short(turns, body):
            for _ in range(turns):
                carry = self.of(body, [*of_body, *carry])
            return carry
        # What is the same after a turn if it was before.
        while True:
            after = asks.of(body, [*for_body, *same])
            kept = [x if _is_known(x) and _same(x, y) else None for x, y in zip(same, after)]
            if [x is None for x in kept] == [x is None for x in same]:
                break
            same = kept
        if not self.binds:
            return same
        cond, body = self._with_known(cond, [*of_cond, *same]), self._with_known(body, [*of_body, *same], same)
        kept, needed = _needs(cond)[:n_cond], _needs(body)[:n_body]
        of_cond = [x for x, keeps in zip(of_cond, kept) if keeps]
        of_body = [x for x, keeps in zip(of_body, needed) if keeps]
        changed = parameters | {
            "cond_jaxpr": _with_inputs(cond, [*kept, *(True for _ in carry)]),
            "body_jaxpr": _with_inputs(body, [*needed, *(True for _ in carry)]),
            "cond_nconsts": len(of_cond),
            "body_nconsts": len(of_body),
        }
        found = self._bound(equation, [*of_cond, *of_body, *carry], changed)
        return [x if y is None else y for x, y in zip(found, same)]


def _alike(variables: Sequence, of_one: Sequence) -> int:
    """How many arrays around a scan are as within: what is constant or carried; of the others it takes, or makes, a row
    at a time. (How JAX tells it differs from version to version.)"""
    return sum(len(v.aval.shape) == len(x.shape) for v, x in zip(variables, of_one, strict=True))


def _needs(program: ClosedJaxpr) -> list[bool]:
    """Which inputs a program needs."""
    needed = needed_by(program.jaxpr.eqns, list(program.jaxpr.outvars))
    return [v in needed for v in program.jaxpr.invars]


def _with_inputs(program: ClosedJaxpr, kept: Sequence[bool]) -> ClosedJaxpr:
    """A program without the inputs that are not kept, which it does not need."""
    jaxpr = program.jaxpr
    inputs, told = [v for v, keeps in zip(jaxpr.invars, kept, strict=True) if keeps], jaxpr.debug_info
    return ClosedJaxpr(jaxpr.replace(invars=inputs, debug_info=told.with_unknown_names()), program.consts)


def _turns(goes_on: Callable, turn: Callable, carry: list) -> int | None:
    """How many turns a loop takes, if that is known."""
    state = carry
    for turns in range(_TURNS + 1):
        going = goes_on(state)
        if not _is_known(going):
            return None
        if not going:
            return turns
        state = turn(state)
    return None


def _row(x, place: int):
    return x if x is None else x[place] if _is_known(x) else jax.lax.index_in_dim(x, place, keepdims=False)


def _stacked(rows: Sequence):
    if any(x is None for x in rows):
        return None
    return np.stack(rows) if all(map(_is_known, rows)) else jnp.stack(rows)


def _is_short(turns: int, program: ClosedJaxpr) -> bool:
    """Return whether a loop is to be unrolled."""
    return turns <= _TURNS and turns * _size(program.jaxpr) <= _OPERATIONS


def _size(jaxpr) -> int:
    return sum(1 + sum(map(_size, programs_of(equation))) for equation in jaxpr.eqns)


def _only_known(values: Iterable) -> list:
    return [x if _is_known(x) else None for x in values]


def _is_known(x) -> bool:
    return isinstance(x, (np.ndarray, np.generic))


def _known(x):
    """A constant of a program, as it is known: small ones of concrete numbers are."""
    if isinstance(x, jax.core.Tracer) or math.prod(np.shape(x)) > _TABLE or not hasattr(x, "dtype"):
        return x
    return np.asarray(x) if np.asarray(x).dtype.kind in "fib" else x


def _same(x, y) -> bool:
    """Return whether both are known and the same, to the sign of a zero."""
    is_like = _is_known(x) and _is_known(y) and x.dtype == y.dtype and x.shape == y.shape
    return is_like and x.tobytes() == y.tobytes()


def _computed(equation, given: list) -> list | None:
    """The results of an operation that are known; None: they are not."""
    name, parameters, variable = equation.primitive.name, equation.params, equation.outvars[0]
    most = _TABLE if name in MOVES else _MOST
    if name not in KNOWN or math.prod(variable.aval.shape) > most or not all(map(_is_known, given)):
        return _chosen(name, parameters, given)
    with np.errstate(all="ignore"):
        found = KNOWN[name](parameters, *given)
    if found is None:
        return None
    found = found if isinstance(found, list) else [found]
    return [np.asarray(x, v.aval.dtype) for x, v in zip(found, equation.outvars)]


def _chosen(name: str, parameters: dict, given: list) -> list | None:
    """A result that follows from some of the operands, or is one of them."""
    if name.startswith("reduce_") and parameters.get("axes") == ():
        return given
    if name == "select_n" and _is_known(given[0]) and not given[0].ndim:
        return [given[1 + int(given[0])]]
    if name == "select_n" and all(_same(given[1], x) for x in given[2:]):
        return [given[1]]
    if name in ("and", "or"):
        decides = name == "or"
        for x, other in (given, given[::-1]):
            if _is_known(x) and x.dtype == np.bool_:
                if np.all(x == decides):
                    return [x]
                if np.all(x != decides) and other is not None:
                    return [other]
    return None


@functools.lru_cache(maxsize=256)
def _expanded(primitive, parameters: tuple, shapes: tuple, double: bool) -> ClosedJaxpr:
    like = [jax.ShapeDtypeStruct(*shape) for shape in shapes]  # integers follow the precision

    def run(*given):
        found = primitive.impl(*given, **dict(parameters))
        return found if primitive.multiple_results else [found]

    return jax.make_jaxpr(run)(*like)


def _written_out(equation) -> ClosedJaxpr:
    """What an operation of another library does, in operations of JAX."""
    shapes = tuple((x.aval.shape, x.aval.dtype) for x in equation.invars)
    try:
        return _expanded(equation.primitive, tuple(equation.params.items()), shapes, setting("jax_enable_x64"))
    except Exception as error:  # it does not consist of operations of JAX
        raise Unsupported(f"operation {equation.primitive.name}") from error
