"""Emit LLVM IR for the jaxpr of one point: every scalar becomes a vector of lanes. Needs llvmlite.

- A small array is a NumPy array of vectors, so that moving its elements takes no instructions.
- A loop runs until its last lane is finished; selects keep the state of finished lanes.
- A branch of a condition is skipped if no lane takes it.
- Loop-invariant values are computed before the loop.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import Literal
from llvmlite import ir

from jaxrock.compiler.jaxpr.constant_folding import MOVES
from jaxrock.compiler.jaxpr.form_fma import kept_fma
from jaxrock.compiler.jaxpr.traverse import programs_of
from jaxrock.compiler.llvm.arrays import OF_FEW, is_one_place
from jaxrock.compiler.llvm.memory_arrays import Memory, boxed, for_each, of_memory, unboxed
from jaxrock.compiler.llvm.operations import OPERATIONS, SUMS, Unsupported, operation_of
from jaxrock.compiler.primitive.macro import expand, is_macro

_HOLDERS = {np.ndarray, Memory}  # values with more than one element
SMALL = 8  # elements of a one-dimensional array in registers; of other arrays its square
_ARRAY = 2 * SMALL**2  # elements of any array: Diffrax keeps two of seven stages for up to eight tangents
_KINDS = {"f8": ir.DoubleType(), "f4": ir.FloatType(), "i4": ir.IntType(32), "i8": ir.IntType(64), "b1": ir.IntType(1)}
_I32, _I64 = ir.IntType(32), ir.IntType(64)
WITH_PROGRAMS = {"while", "cond", "jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call"}


class Emitter:
    """Emit the instructions of jaxprs into one LLVM function."""

    small = SMALL

    def __init__(self, builder: ir.IRBuilder, lanes: int):
        self.b, self.lanes = builder, lanes
        self.before = []  # the basic_block before each enclosing loop
        self._constants = {}  # cache by value and type
        self._vectors = {}  # vector types by dtype

    # Types, constants, calls and lanes

    def kind(self, dtype) -> ir.Type:
        """Return LLVM's scalar type for a dtype."""
        name = np.dtype(dtype).str[1:]
        if name not in _KINDS:
            raise Unsupported(f"numbers of type {dtype}")
        return _KINDS[name]

    def vector(self, dtype) -> ir.VectorType:
        """Return LLVM's type of one number per lane."""
        if dtype not in self._vectors:
            self._vectors[dtype] = ir.VectorType(self.kind(dtype), self.lanes)
        return self._vectors[dtype]

    def constant(self, value, dtype):
        """Return a constant vector with one value in all lanes, by dtype."""
        number = np.asarray(value, dtype)
        key = number.tobytes(), number.dtype.char
        if key not in self._constants:
            self._constants[key] = self.constant_of(number[()], self.vector(dtype))
        return self._constants[key]

    def constant_of(self, value, kind: ir.VectorType):
        """Return a constant vector with one value in all lanes, by LLVM's vector type."""
        value = int(value) if isinstance(kind.element, ir.IntType) else float(value)
        key = repr(value), type(kind.element), getattr(kind.element, "width", 0)
        if key not in self._constants:
            self._constants[key] = ir.Constant(kind, [ir.Constant(kind.element, value)] * self.lanes)
        return self._constants[key]

    def intrinsic(self, name: str, *values):
        """Emit a call of an LLVM intrinsic."""
        kind = values[0].type
        short = "f64" if isinstance(kind.element, ir.DoubleType) else "f32"
        return self.b.called(self._declared(f"llvm.{name}.v{self.lanes}{short}", kind, len(values)), values)

    def each(self, name: str, *values):
        """Emit calls of a function of the C mathematical library, lane by lane."""
        kind = values[0].type.element
        function = self._declared(name if isinstance(kind, ir.DoubleType) else name + "f", kind, len(values))
        return self.gather([self.b.call(function, [self.lane(v, i) for v in values]) for i in range(self.lanes)])

    def _declared(self, name: str, kind, count: int) -> ir.Function:
        module = self.b.module
        return module.globals.get(name) or ir.Function(module, ir.FunctionType(kind, [kind] * count), name)

    def splat(self, scalar):
        """Emit a vector with one scalar in all lanes."""
        kind = ir.VectorType(scalar.type, self.lanes)
        first = self.b.insert_element(ir.Constant(kind, ir.Undefined), scalar, _I32(0))
        zeros = ir.Constant(ir.VectorType(_I32, self.lanes), [_I32(0)] * self.lanes)
        return self.b.shuffle_vector(first, ir.Constant(kind, ir.Undefined), zeros)

    def lane(self, vector, i: int):
        """Emit the extraction of one lane."""
        return self.b.extract_element(vector, _I32(i))

    def gather(self, scalars: list):
        """Emit a vector of one scalar per lane."""
        total = ir.Constant(ir.VectorType(scalars[0].type, self.lanes), ir.Undefined)
        for i, scalar in enumerate(scalars):
            total = self.b.insert_element(total, scalar, _I32(i))
        return total

    def any(self, mask):
        """Emit whether any lane of a mask is set."""
        bits = ir.IntType(self.lanes)
        return self.b.icmp_unsigned("!=", self.b.bitcast(mask, bits), bits(0))

    # Jaxprs

    def run(self, program, arguments: list, active) -> list:
        """Emit a jaxpr, open or closed, and return its results; its loops run for the `active` lanes."""
        jaxpr = getattr(program, "jaxpr", program)
        values = dict(zip(jaxpr.invars, arguments))
        for variable, value in zip(jaxpr.constvars, getattr(program, "consts", ())):
            values[variable] = self.known(value, variable.aval.dtype)

        def read(atoms):
            return [self.known(x.val, x.aval.dtype) if isinstance(x, Literal) else values[x] for x in atoms]

        for equation in jaxpr.eqns:
            inputs, operation = read(equation.invars), operation_of(equation.primitive.name)
            if operation is not None and not _HOLDERS.intersection(map(type, inputs)):
                values[equation.outvars[0]] = self._number(operation, equation, inputs)
            else:
                values.update(zip(equation.outvars, self._place(equation, inputs, active)))
        return read(jaxpr.outvars)

    def known(self, value, dtype):
        """Return a constant scalar or small array of the jaxpr as vectors."""
        if isinstance(value, jax.core.Tracer):
            raise Unsupported("a number from outside")
        value = np.asarray(value, dtype)
        if value.size > _ARRAY:
            raise Unsupported("a large array in the program")
        return for_each(lambda x: self.constant(x, dtype), value if value.ndim else value[()])

    def _number(self, operation: Callable, equation, inputs: list):
        """Emit an operation on scalars as `_place` does, but faster: a jaxpr has thousands of them."""
        depth = 0
        for x in inputs:
            depth = max(depth, getattr(x, "depth", None) or 0)
        if depth == len(self.before):
            result = operation(self, equation, *inputs)
        else:
            result = self._in_loops(depth, equation, lambda: operation(self, equation, *inputs))
        if id(result) not in map(id, inputs):
            remember((result,), depth)
        return result

    def _place(self, equation, inputs: list, active) -> list:
        """Emit an operation, before the loops in which its operands are invariant."""
        name = equation.primitive.name
        if name in WITH_PROGRAMS:
            return self._apply(equation, inputs, active)
        if is_macro(name) and name not in OPERATIONS:
            return self.run(_parts_of(equation), inputs, active)
        depth = max(map(_depth_of, inputs), default=0)
        results = self._in_loops(depth, equation, lambda: self._apply(equation, inputs, active))
        given = set(map(id, _loose(inputs)))  # operands that are passed through keep their depth
        remember([value for value in _loose(results) if id(value) not in given], depth)
        return results

    def _in_loops(self, depth: int, equation, write: Callable):
        """Return the result of `write`, which emits inside the outermost `depth` loops and before the others."""
        if depth == len(self.before):
            return write()
        if depth > len(self.before):
            raise Unsupported(f"{equation.primitive.name} of what another loop makes")
        with self.b.goto_block(self.before[depth]):
            return write()

    def _apply(self, equation, inputs: list, active) -> list:
        name, parameters = equation.primitive.name, equation.params
        if name == "while":
            return self.loop(parameters, inputs, active)[0]
        if name == "cond":
            return self._branch(parameters["branches"], inputs, active)
        if name in WITH_PROGRAMS:
            return self.run(parameters.get("jaxpr") or parameters["call_jaxpr"], inputs, active)
        if any(isinstance(x, Memory) for x in inputs):
            return [unboxed(of_memory(self, equation, *inputs))]
        if math.prod(equation.outvars[0].aval.shape) > _ARRAY:
            raise Unsupported(f"{name} of a long array")
        if name in MOVES:
            moved = MOVES[name](parameters, *map(boxed, inputs))
            return [unboxed(x) for x in (moved if isinstance(moved, list) else [moved])]
        if name in SUMS and boxed(inputs[0]).size:
            return [_total(self, equation, boxed(inputs[0]))]
        if name in OF_FEW:
            return [unboxed(OF_FEW[name](self, equation, *inputs))]
        if (operation := operation_of(name)) is None:
            raise Unsupported(f"operation {name}")
        return [for_each(lambda *values: operation(self, equation, *values), *inputs)]

    def applied(self, equation, inputs: list):
        """Emit an operation on vectors and arrays in registers."""
        return self._apply(equation, inputs, None)[0]

    def loop(self, parameters: dict, inputs: list, active, leaves: Callable | None = None) -> tuple[list, Any]:
        """Emit a loop; return the final state and the mask of unfinished lanes.

        The mask is empty unless `leaves(mask)` ends the loop earlier.
        """
        n_cond, n_body = parameters["cond_nconsts"], parameters["body_nconsts"]
        of_cond, of_body, carry = inputs[:n_cond], inputs[n_cond : n_cond + n_body], inputs[n_cond + n_body :]
        before, firsts = self.b.basic_block, flat(carry)
        head, inside, after = (self.b.append_basic_block(name) for name in ("head", "body", "after"))
        self.b.branch(head)
        self.b.position_at_end(head)
        phis = [self.b.phi(x.type) for x in firsts]
        state = like(carry, phis)
        self.before.append(before)
        remember(phis, len(self.before))
        (going,) = self.run(parameters["cond_jaxpr"], [*of_cond, *state], active)
        going = self.b.and_(going, active)
        goes = self.any(going)
        if leaves is not None:
            goes = self.b.and_(goes, self.b.not_(leaves(going)))
        self.b.cbranch(goes, inside, after)
        self.b.position_at_end(inside)
        changed = flat(self.run(parameters["body_jaxpr"], [*of_body, *state], going))
        kept = [phi if new is phi else self.b.select(going, new, phi) for new, phi in zip(changed, phis)]
        for phi, first, later in zip(phis, firsts, kept):
            phi.add_incoming(first, before)
            phi.add_incoming(later, self.b.basic_block)
        self.b.branch(head)
        self.b.position_at_end(after)
        self.before.pop()
        remember(phis, len(self.before))  # after the loop they are constant
        return state, going

    def _branch(self, branches, inputs: list, active) -> list:
        which, *inputs = inputs
        if len(branches) != 2:
            raise Unsupported("a choice of many")
        if not isinstance(which.type.element, ir.IntType) or which.type.element.width > 1:
            which = self.b.icmp_signed("!=", which, self.constant_of(0, which.type))
        first, second = branches
        if first.jaxpr.eqns:
            of_first = self._case(first, inputs, self.b.and_(self.b.not_(which), active), None)
        else:
            of_first = self.run(first, inputs, active)
        return self._case(second, inputs, self.b.and_(which, active), of_first)

    def _case(self, program, inputs: list, mask, others: list | None) -> list:
        """Emit one branch of a condition: its results in the lanes of `mask`, `others` in the rest (None: any)."""
        before = self.b.basic_block
        inside, after = self.b.append_basic_block("case"), self.b.append_basic_block("join")
        self.b.cbranch(self.any(mask), inside, after)
        self.b.position_at_end(inside)
        # Loop-invariant values are computed before the loops, even if no lane takes this branch.
        results = self.run(program, inputs, mask)
        vectors = flat(results)
        others = [ir.Constant(x.type, ir.Undefined) for x in vectors] if others is None else flat(others)
        chosen = [new if new is old else self.b.select(mask, new, old) for new, old in zip(vectors, others)]
        end = self.b.basic_block
        self.b.branch(after)
        self.b.position_at_end(after)
        joined = [self.b.phi(x.type) for x in vectors]
        for phi, new, old in zip(joined, chosen, others):
            phi.add_incoming(new, end)
            phi.add_incoming(old, before)
        remember(joined, len(self.before))
        return like(results, joined)


def _parts_of(equation):
    """Return the jaxpr that a macro primitive stands for."""
    return kept_fma(expand(equation.primitive.name, [x.aval for x in equation.invars], equation.params))


def remember(values: Sequence, depth: int) -> None:
    """Note the number of enclosing loops in which values are recomputed.

    A value that has a depth already keeps the smaller one.
    """
    for value in values:
        if not isinstance(value, ir.Constant):  # constants are shared and have no depth
            known = getattr(value, "depth", None)
            value.depth = depth if known is None else min(depth, known)


def _depth_of(value) -> int:
    """Return the number of enclosing loops in which a value is recomputed."""
    if isinstance(value, np.ndarray):
        return max(map(_depth_of, value.flat), default=0)
    if isinstance(value, Memory):
        return max(map(_depth_of, value.starts or ()), default=0)
    return getattr(value, "depth", None) or 0


def _total(e: Emitter, equation, array: np.ndarray):
    """Emit a reduction along axes of an array."""
    operation = SUMS[equation.primitive.name]
    for axis in sorted(equation.params["axes"], reverse=True):
        parts = list(np.moveaxis(array, axis, 0))
        array = functools.reduce(lambda x, y: for_each(lambda *v: operation(e, equation, *v), x, y), parts)
    return unboxed(array)


def flat(values: list) -> list:
    """Return all vectors in vectors and arrays, in order."""
    vectors = []
    for value in values:
        if isinstance(value, np.ndarray):
            vectors += value.ravel().tolist()
        elif isinstance(value, Memory):
            raise Unsupported("a long list that changes")
        else:
            vectors.append(value)
    return vectors


def _loose(values: list) -> list:
    """Return all vectors in values, and the starts of long arrays."""
    starts = [start for value in values if isinstance(value, Memory) for start in value.starts or ()]
    return starts + flat([value for value in values if not isinstance(value, Memory)])


def like(values: list, vectors: list) -> list:
    """Return vectors and arrays of the shapes of `values`, made of other vectors."""
    rest, alike = iter(vectors), []
    for value in values:
        if isinstance(value, np.ndarray):
            array = np.empty(value.shape, object)
            array.ravel()[:] = [next(rest) for _ in range(value.size)]
            alike.append(array)
        else:
            alike.append(next(rest))
    return alike


_LISTS = [(n,) for n in range(SMALL + 1)]


def is_known(equation) -> bool:
    """Return whether an equation looks supported; emitting it may still raise `Unsupported`."""
    if equation.primitive.name not in WITH_PROGRAMS:
        name = equation.primitive.name
        if name == "sort":
            return len(equation.invars) == 1 and equation.invars[0].aval.shape in _LISTS
        if name in SUMS:
            shape = equation.invars[0].aval.shape
            return math.prod(shape) <= (SMALL if len(shape) == 1 else SMALL**2)
        if name in OF_FEW and name != "dynamic_slice":
            return is_one_place(equation) and all(math.prod(x.aval.shape) <= SMALL**2 for x in equation.invars)
        return operation_of(name) is not None or name in MOVES or name in OF_FEW or is_macro(name)
    return all(is_known(inner) for program in programs_of(equation) for inner in program.eqns)
