"""Inline calls, fold constants, unroll short loops and eliminate dead code, by tracing a jaxpr once more.

Libraries trace more than a result needs: nested calls, marker operations of their own, buffers for unused results,
tables that a loop of seven iterations indexes, flags that never change. This pass

- computes what depends on constants only, and takes the branch of a `cond` whose index is constant;
- unrolls short loops whose number of iterations is constant;
- replaces by constants the values of a loop's carry that no iteration changes.
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

from jaxrock._core.precision import setting
from jaxrock.compiler.jaxpr.constant_folding import KNOWN, MOVES
from jaxrock.compiler.jaxpr.partition import needed_by
from jaxrock.compiler.jaxpr.traverse import programs_of
from jaxrock.compiler.llvm.operations import NOTHING, Unsupported

_CALLS = {"jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "checkpoint", "remat2"}
_TABLE = 256  # elements of a constant that may be indexed here: a solver's table
_MOST = 64  # elements of an array that is folded
_TURNS, _OPERATIONS = 32, 1 << 14  # limits for unrolling: iterations, and equations in all of them
_SMALL = 4  # with fewer equations, evaluating a jaxpr again costs less than a memo


def inline_and_fold(program: ClosedJaxpr) -> ClosedJaxpr:
    """Return an equivalent jaxpr without calls and dead code, with constants folded and short loops unrolled."""

    def run(*leaves):
        return _Run(binds=True).of(program, leaves)

    return _traced(run, program)


def _traced(run: Callable, program: ClosedJaxpr) -> ClosedJaxpr:
    """Trace a function of the inputs of a jaxpr, and eliminate its dead code."""
    traced = jax.make_jaxpr(run)(*map(_like, program.in_avals))
    needed, _ = partial_eval.dce_jaxpr(traced.jaxpr, [True] * len(traced.jaxpr.outvars), instantiate=True)
    return ClosedJaxpr(needed, traced.consts)


@functools.cache
def is_foreign(primitive) -> bool:
    """Return whether a primitive belongs to a library other than JAX and jaxrock."""
    rule = getattr(primitive, "impl", None)
    module = getattr(getattr(rule, "func", rule), "__module__", None) or "jax"
    return module.partition(".")[0] not in ("jax", "jaxlib", "jaxrock")


def has_foreign(jaxpr) -> bool:
    """Return whether a jaxpr contains a primitive of another library."""
    return any(
        is_foreign(equation.primitive) or any(map(has_foreign, programs_of(equation))) for equation in jaxpr.eqns
    )


def _like(aval) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(aval.shape, aval.dtype)


class _Run:
    """Evaluate a jaxpr with constants (NumPy arrays) among its values.

    If it `binds`, the other values are tracers. Otherwise they are None, and the run only finds which results are
    constant.
    """

    def __init__(self, binds: bool, told: dict | None = None):
        self.binds = binds
        self.told = {} if told is None else told  # memo: {(jaxpr, constants, constant inputs): (jaxpr, results)}

    def of(self, program: ClosedJaxpr, given: Sequence) -> list:
        """Return the results of a closed jaxpr; without `binds`, from a memo if it is not tiny."""
        if self.binds or len(program.jaxpr.eqns) < _SMALL:
            return self._through(program, given)
        # The fixed-point iterations of nested loops repeat the same query many times.
        values = tuple(None if x is None else (x.dtype, x.shape, x.tobytes()) for x in given)
        key = id(program.jaxpr), tuple(map(id, program.consts)), values
        if key not in self.told:
            self.told[key] = program, self._through(program, given)  # the reference keeps its `id` unique
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
        if "callback" in name:  # of another library, perhaps in a rare branch: machine code cannot call it
            raise Unsupported(f"operation {name}")
        if name in NOTHING:
            return given[: len(equation.outvars)]  # hints take the values first, extra operands after them
        found = _computed(equation, given)
        if found is not None:
            return found
        if is_foreign(equation.primitive):
            return self.of(_written_out(equation), given)
        return self._bound(equation, given)

    def _bound(self, equation, given: Sequence, parameters: dict | None = None) -> list:
        """Return the results of an equation that stays as it is."""
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
        """Return a jaxpr of the same inputs with the constants among `given` folded in.

        Those results for which `keep` holds a constant return that constant.
        """

        def run(*leaves):
            mixed = [x if _is_known(x) else leaf for x, leaf in zip(given, leaves)]
            found = _Run(binds=True, told=self.told).of(program, mixed)
            return [x if x is not None else y for x, y in zip(keep or [None] * len(found), found)]

        return _traced(run, program)

    def _scan(self, equation, given: list) -> list:
        """Unroll a scan."""
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
        # Iterate to a fixed point: start from the constant carry, and drop each value that one iteration changes.
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
    """Count the operands, or results, of a scan that have the same rank in its body: constants and carried values.

    The scan reads, or stacks, all others row by row. Versions of JAX state these numbers in different ways, and the
    ranks avoid them.
    """
    return sum(len(v.aval.shape) == len(x.shape) for v, x in zip(variables, of_one, strict=True))


def _needs(program: ClosedJaxpr) -> list[bool]:
    """Return, for each input of a jaxpr, whether its equations or outputs read it."""
    needed = needed_by(program.jaxpr.eqns, list(program.jaxpr.outvars))
    return [v in needed for v in program.jaxpr.invars]


def _with_inputs(program: ClosedJaxpr, kept: Sequence[bool]) -> ClosedJaxpr:
    """Return a jaxpr with only the inputs flagged in `kept`; it must not read the others."""
    jaxpr = program.jaxpr
    inputs, told = [v for v, keeps in zip(jaxpr.invars, kept, strict=True) if keeps], jaxpr.debug_info
    return ClosedJaxpr(jaxpr.replace(invars=inputs, debug_info=told.with_unknown_names()), program.consts)


def _turns(goes_on: Callable, turn: Callable, carry: list) -> int | None:
    """Return the number of iterations of a loop if constants determine it and it is at most `_TURNS`, else None."""
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
    """Return whether a loop is short enough to be unrolled."""
    return turns <= _TURNS and turns * _size(program.jaxpr) <= _OPERATIONS


def _size(jaxpr) -> int:
    return sum(1 + sum(map(_size, programs_of(equation))) for equation in jaxpr.eqns)


def _only_known(values: Iterable) -> list:
    return [x if _is_known(x) else None for x in values]


def _is_known(x) -> bool:
    return isinstance(x, (np.ndarray, np.generic))


def _known(x):
    """Return a small concrete constant of a jaxpr as a NumPy array, and any other as it is."""
    if isinstance(x, jax.core.Tracer) or math.prod(np.shape(x)) > _TABLE or not hasattr(x, "dtype"):
        return x
    return np.asarray(x) if np.asarray(x).dtype.kind in "fib" else x


def _same(x, y) -> bool:
    """Return whether both are constants with equal bits, so that signs of zeros count and NaN equals itself."""
    is_like = _is_known(x) and _is_known(y) and x.dtype == y.dtype and x.shape == y.shape
    return is_like and x.tobytes() == y.tobytes()


def _computed(equation, given: list) -> list | None:
    """Return the folded results of an equation; None if constants do not determine them."""
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
    """Return a result that some of the operands determine, or that is one of them; else None."""
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
    like = [jax.ShapeDtypeStruct(*shape) for shape in shapes]  # `double` sets the type of integers

    def run(*given):
        found = primitive.impl(*given, **dict(parameters))
        return found if primitive.multiple_results else [found]

    return jax.make_jaxpr(run)(*like)


def _written_out(equation) -> ClosedJaxpr:
    """Return the jaxpr of an operation of another library in terms of JAX's operations."""
    shapes = tuple((x.aval.shape, x.aval.dtype) for x in equation.invars)
    try:
        return _expanded(equation.primitive, tuple(equation.params.items()), shapes, setting("jax_enable_x64"))
    except Exception as error:  # its Python implementation is not traceable
        raise Unsupported(f"operation {equation.primitive.name}") from error
