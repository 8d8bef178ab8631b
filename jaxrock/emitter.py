"""From a program of scalars, traced by JAX, to LLVM's language: every scalar becomes a vector of lanes. Needs llvmlite.

Loops go on until the last lane is done, and what is done does not change any more. A case of a condition is skipped
if no lane is in it. What no loop changes is computed before it.
"""

from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend.core import Literal
from llvmlite import ir

from jaxrock.operations import OPERATIONS, Unsupported

SMALL = 8  # numbers in an array that is kept in registers
_KINDS = {"f8": ir.DoubleType(), "f4": ir.FloatType(), "i4": ir.IntType(32), "i8": ir.IntType(64), "b1": ir.IntType(1)}
_I32, _I64 = ir.IntType(32), ir.IntType(64)
_WITH_PROGRAMS = {"while", "cond", "jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call"}


class Array(NamedTuple):
    """A small array: a vector for each of its numbers."""

    elements: list


class Memory(NamedTuple):
    """An array in memory, of which single numbers are looked up."""

    pointer: Any
    size: int
    starts: list | None  # where each lane's own begins; None: all look up the same


class Emitter:
    """Writes the instructions of programs into a function of LLVM."""

    def __init__(self, builder: ir.IRBuilder, lanes: int):
        self.b, self.lanes = builder, lanes
        self._before = []  # the blocks before the loops that are being written
        self._depths = {}  # in how many of them a value is made anew, by the identity of the value
        self._alive = []  # so that identities are not used again

    # Types and small things

    def kind(self, dtype) -> ir.Type:
        """LLVM's type of one number."""
        name = np.dtype(dtype).str[1:]
        if name not in _KINDS:
            raise Unsupported(f"numbers of type {dtype}")
        return _KINDS[name]

    def vector(self, dtype) -> ir.VectorType:
        """LLVM's type of a number per lane."""
        return ir.VectorType(self.kind(dtype), self.lanes)

    def constant(self, value, dtype):
        """One number for all lanes."""
        return self.constant_of(np.asarray(value, dtype)[()], self.vector(dtype))

    def constant_of(self, value, kind: ir.VectorType):
        """One number for all lanes, of a known type."""
        value = int(value) if isinstance(kind.element, ir.IntType) else float(value)
        return ir.Constant(kind, [ir.Constant(kind.element, value)] * self.lanes)

    def intrinsic(self, name: str, *values):
        """One of LLVM's own functions."""
        kind = values[0].type
        short = "f64" if isinstance(kind.element, ir.DoubleType) else "f32"
        return self.b.call(self._declared(f"llvm.{name}.v{self.lanes}{short}", kind, len(values)), values)

    def each(self, name: str, *values):
        """A function of the mathematical library, lane by lane."""
        kind = values[0].type.element
        function = self._declared(name if isinstance(kind, ir.DoubleType) else name + "f", kind, len(values))
        return self._gather([self.b.call(function, [self._lane(v, i) for v in values]) for i in range(self.lanes)])

    def _declared(self, name: str, kind, count: int) -> ir.Function:
        module = self.b.module
        return module.globals.get(name) or ir.Function(module, ir.FunctionType(kind, [kind] * count), name)

    def splat(self, scalar):
        """A number in all lanes."""
        kind = ir.VectorType(scalar.type, self.lanes)
        first = self.b.insert_element(ir.Constant(kind, ir.Undefined), scalar, _I32(0))
        zeros = ir.Constant(ir.VectorType(_I32, self.lanes), [_I32(0)] * self.lanes)
        return self.b.shuffle_vector(first, ir.Constant(kind, ir.Undefined), zeros)

    def _lane(self, vector, i: int):
        return self.b.extract_element(vector, _I32(i))

    def _gather(self, scalars: list):
        total = ir.Constant(ir.VectorType(scalars[0].type, self.lanes), ir.Undefined)
        for i, scalar in enumerate(scalars):
            total = self.b.insert_element(total, scalar, _I32(i))
        return total

    def _any(self, mask):
        bits = ir.IntType(self.lanes)
        return self.b.icmp_unsigned("!=", self.b.bitcast(mask, bits), bits(0))

    # Programs

    def run(self, program, arguments: list, active) -> list:
        """The results of a program (closed) of these arguments; loops in it serve the lanes that are `active`."""
        jaxpr = getattr(program, "jaxpr", program)
        values = dict(zip(jaxpr.invars, arguments))
        for variable, value in zip(jaxpr.constvars, getattr(program, "consts", ())):
            values[variable] = self._known(value)

        def read(atom):
            return self._known(atom.val) if isinstance(atom, Literal) else values[atom]

        for equation in jaxpr.eqns:
            found = self._place(equation, [read(x) for x in equation.invars], active)
            values.update(zip(equation.outvars, found))
        return [read(x) for x in jaxpr.outvars]

    def _known(self, value):
        if isinstance(value, jax.core.Tracer):
            raise Unsupported("a number from outside")
        value = np.asarray(value)
        if value.ndim == 0:
            return self.constant(value, value.dtype)
        if value.ndim > 1 or value.size > SMALL:
            raise Unsupported("a large array in the program")
        return Array([self.constant(x, value.dtype) for x in value])

    def _place(self, equation, inputs: list, active) -> list:
        """Apply an operation, before the loops that do not change its operands."""
        if equation.primitive.name in _WITH_PROGRAMS:
            return self._apply(equation, inputs, active)
        depth = max((self._depth(x) for x in inputs), default=0)
        if depth == len(self._before):
            found = self._apply(equation, inputs, active)
        else:
            with self.b.goto_block(self._before[depth]):
                found = self._apply(equation, inputs, active)
        self._remember(found, depth)
        return found

    def _depth(self, value) -> int:
        if isinstance(value, Array):
            return max((self._depth(x) for x in value.elements), default=0)
        return self._depths.get(id(value), 0)

    def _remember(self, values: list, depth: int) -> None:
        for value in values:
            self._alive.append(value)
            self._depths[id(value)] = depth
            if isinstance(value, Array):
                self._remember(value.elements, depth)

    def _apply(self, equation, inputs: list, active) -> list:
        name, parameters = equation.primitive.name, equation.params
        if name == "while":
            return self._loop(parameters, inputs, active)
        if name == "cond":
            return self._branch(parameters["branches"], inputs, active)
        if name in _WITH_PROGRAMS:
            return self.run(parameters.get("jaxpr") or parameters["call_jaxpr"], inputs, active)
        if any(isinstance(x, (Array, Memory)) for x in inputs):
            return [self._of_array(name, parameters, *inputs)]
        if name not in OPERATIONS:
            raise Unsupported(f"operation {name}")
        if equation.outvars[0].aval.shape:
            raise Unsupported("an array that is made")
        return [OPERATIONS[name](self, equation, *inputs)]

    def _of_array(self, name: str, parameters: dict, array, *more):
        if name == "slice" and not parameters["strides"]:
            (start,), (stop,) = parameters["start_indices"], parameters["limit_indices"]
            if isinstance(array, Array):
                return Array(array.elements[start:stop])
            return Memory(self.b.gep(array.pointer, [_I64(start)]), stop - start, array.starts)
        if name == "squeeze" and isinstance(array, Array):
            return array.elements[0]
        if name == "squeeze":
            return self._look_up(array, self.constant(0, np.int32))
        if name == "dynamic_slice" and isinstance(array, Memory) and parameters["slice_sizes"] == (1,):
            return Array([self._look_up(array, *more)])
        if name in ("stop_gradient", "copy", "reshard", "pvary", "pcast"):
            return array
        raise Unsupported(f"{name} of an array")

    def _look_up(self, memory: Memory, index):
        # An index outside is moved to the nearest inside, as `dynamic_slice` does.
        zero, last = (self.constant_of(k, index.type) for k in (0, memory.size - 1))
        index = self.b.select(self.b.icmp_signed("<", index, zero), zero, index)
        index = self.b.select(self.b.icmp_signed(">", index, last), last, index)
        found = []
        for i in range(self.lanes):
            place = self._lane(index, i)
            place = self.b.sext(place, _I64) if place.type != _I64 else place
            place = place if memory.starts is None else self.b.add(place, memory.starts[i])
            found.append(self.b.load(self.b.gep(memory.pointer, [place])))
        return self._gather(found)

    def _loop(self, parameters: dict, inputs: list, active) -> list:
        n_cond, n_body = parameters["cond_nconsts"], parameters["body_nconsts"]
        of_cond, of_body, carry = inputs[:n_cond], inputs[n_cond : n_cond + n_body], inputs[n_cond + n_body :]
        before = self.b.block
        head, inside, after = (self.b.append_basic_block(name) for name in ("head", "body", "after"))
        self.b.branch(head)
        self.b.position_at_end(head)
        phis = [self.b.phi(x.type) for x in carry]
        self._before.append(before)
        self._remember(phis, len(self._before))
        (going,) = self.run(parameters["cond_jaxpr"], [*of_cond, *phis], active)
        going = self.b.and_(going, active)
        self.b.cbranch(self._any(going), inside, after)
        self.b.position_at_end(inside)
        found = self.run(parameters["body_jaxpr"], [*of_body, *phis], going)
        kept = [phi if new is phi else self.b.select(going, new, phi) for new, phi in zip(found, phis)]
        for phi, first, later in zip(phis, carry, kept):
            phi.add_incoming(first, before)
            phi.add_incoming(later, self.b.block)
        self.b.branch(head)
        self.b.position_at_end(after)
        self._before.pop()
        self._remember(phis, len(self._before))  # they change no more
        return phis

    def _branch(self, branches, inputs: list, active) -> list:
        which, *inputs = inputs
        if len(branches) != 2:
            raise Unsupported("a choice of many")
        if not isinstance(which.type.element, ir.IntType) or which.type.element.width > 1:
            which = self.b.icmp_signed("!=", which, self.constant_of(0, which.type))
        first, second = branches
        none = [None] * len(second.jaxpr.outvars)
        found = none if first.jaxpr.eqns else self.run(first, inputs, active)
        if found is none:
            found = self._case(first, inputs, self.b.and_(self.b.not_(which), active), none)
        found = self._case(second, inputs, self.b.and_(which, active), found)
        self._remember(found, len(self._before))
        return found

    def _case(self, program, inputs: list, mask, others: list) -> list:
        """The results of a case in the lanes of `mask`, `others` in the rest (None: it does not matter)."""
        before = self.b.block
        inside, after = self.b.append_basic_block("case"), self.b.append_basic_block("join")
        self.b.cbranch(self._any(mask), inside, after)
        self.b.position_at_end(inside)
        # What only depends on values from outside the loops goes before them, even if it is not needed there.
        found = self.run(program, inputs, mask)
        chosen = [
            new if old is None or new is old else self.b.select(mask, new, old) for new, old in zip(found, others)
        ]
        end = self.b.block
        self.b.branch(after)
        self.b.position_at_end(after)
        joined = []
        for new, old in zip(chosen, others):
            phi = self.b.phi(new.type)
            phi.add_incoming(new, end)
            phi.add_incoming(ir.Constant(new.type, ir.Undefined) if old is None else old, before)
            joined.append(phi)
        return joined


def emit(program, shared: list[bool], lanes: int, name: str) -> ir.Module:
    """A function `void name(void **outputs, void **inputs)` that runs a program over arrays of many lanes.

    The first input is the number of lanes (int32, a multiple of `lanes`), then follow those of the program. What is
    not `shared` has an axis of lanes: for arrays of up to `SMALL` numbers the last, for others the first.
    """
    module, byte = ir.Module(name), ir.IntType(8)
    table = byte.as_pointer().as_pointer()
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [table, table]), name)
    outputs, inputs = function.args
    b = ir.IRBuilder(function.append_basic_block("entry"))
    e = Emitter(b, lanes)

    def array(of, index, dtype):
        kind = byte if dtype == np.bool_ else e.kind(dtype)
        return b.bitcast(b.load(b.gep(of, [_I32(index)])), kind.as_pointer())

    jaxpr = program.jaxpr
    sources = [array(inputs, i, v.aval.dtype) for i, v in enumerate(jaxpr.invars, 1)]
    targets = [array(outputs, i, v.aval.dtype) for i, v in enumerate(jaxpr.outvars)]
    count = b.sext(b.load(array(inputs, 0, np.int32)), _I64)
    entry, head, inside, after = b.block, *(b.append_basic_block(name) for name in ("lanes", "program", "end"))
    b.branch(head)
    b.position_at_end(head)
    first = b.phi(_I64)
    b.cbranch(b.icmp_signed("<", first, count), inside, after)
    b.position_at_end(inside)

    def vector(pointer, place):
        return b.bitcast(b.gep(pointer, [place]), ir.VectorType(pointer.type.pointee, lanes).as_pointer())

    def load(source, place, is_shared):
        value = e.splat(b.load(b.gep(source, [place]))) if is_shared else b.load(vector(source, place), align=1)
        return b.icmp_unsigned("!=", value, e.constant_of(0, value.type)) if source.type.pointee == byte else value

    def argument(variable, source, is_shared):
        shape = variable.aval.shape
        if not shape:
            return load(source, _I64(0) if is_shared else first, is_shared)
        if len(shape) > 1:
            raise Unsupported(f"an array of shape {shape}")
        if shape[0] <= SMALL:
            places = [_I64(k) if is_shared else b.add(b.mul(count, _I64(k)), first) for k in range(shape[0])]
            return Array([load(source, place, is_shared) for place in places])
        rows = [b.mul(b.add(first, _I64(i)), _I64(shape[0])) for i in range(lanes)]
        return Memory(source, shape[0], None if is_shared else rows)

    arguments = [argument(*each) for each in zip(jaxpr.invars, sources, shared, strict=True)]
    found = e.run(program, arguments, e.constant(True, bool))
    for value, target in zip(found, targets):
        if target.type.pointee == byte:
            value = b.zext(value, ir.VectorType(byte, lanes))
        b.store(value, vector(target, first), align=1)
    first.add_incoming(_I64(0), entry)
    first.add_incoming(b.add(first, _I64(lanes)), b.block)
    b.branch(head)
    b.position_at_end(after)
    b.ret_void()
    return module
