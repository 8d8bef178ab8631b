"""Emit LLVM functions that run a jaxpr over arrays of many points, a vector of lanes at a time. Needs llvmlite.

The axis of points is the last of an array; it is the first of long arrays, which are indexed element by element.
Several threads may call such a function with the same arguments: each claims points that no other has claimed.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jax.extend.core import Literal
from llvmlite import ir

from jaxrock.compiler.llvm.builder import Builder
from jaxrock.compiler.llvm.emitter import SMALL, Emitter, flat, like, remember
from jaxrock.compiler.llvm.memory_arrays import Memory, boxed, unboxed
from jaxrock.compiler.llvm.operations import Unsupported

_I1, _I8, _I32, _I64 = (ir.IntType(bits) for bits in (1, 8, 32, 64))


def kind_of(variable: Any) -> np.dtype:
    """Return the dtype of a variable."""
    return variable.aval.dtype


def is_long(shape: tuple[int, ...]) -> bool:
    """Return whether an array stays in memory, to be indexed: a long array, or a table of a few long rows.

    **Raises:** Unsupported for any other large array.
    """
    if len(shape) == 2 and shape[0] <= SMALL and math.prod(shape) > SMALL**2:
        return True
    if len(shape) > 1 and math.prod(shape) > SMALL**2:
        raise Unsupported(f"an array of shape {shape}")
    return len(shape) == 1 and shape[0] > SMALL


class Frame:
    """The frame of a function `void name(void **outputs, void **inputs, int64 *next)`.

    The first input holds three int32 numbers: the size of the arrays along the axis of points, the number of points to
    compute, and the number of threads. `next` is the first unclaimed point.
    """

    def __init__(self, inputs: Sequence[np.dtype], outputs: Sequence[np.dtype], lanes: int, name: str):
        self.module = ir.Module(name)
        table = _I8.as_pointer().as_pointer()
        kinds = [table, table, _I64.as_pointer()]
        function = ir.Function(self.module, ir.FunctionType(ir.VoidType(), kinds), name)
        # Without the alignment LLVM spills vectors across cache lines, which takes twice as long.
        function.attributes.add("nounwind")  # llvmlite writes the alignment only after another attribute
        function.attributes.alignstack = 64
        to, of, self.next = function.args
        self.b = Builder(function.append_basic_block("entry"))
        self.e = Emitter(self.b, lanes)
        self.sources = [self._array(of, i, kind) for i, kind in enumerate(inputs, 1)]
        self.targets = [self._array(to, i, kind) for i, kind in enumerate(outputs)]
        self.sizes = self._array(of, 0, np.int32)
        self.width, self.count = (self.b.sext(self.b.load(self.b.gep(self.sizes, [_I32(i)])), _I64) for i in (0, 1))

    @classmethod
    def of(cls, jaxpr, lanes: int, name: str) -> "Frame":
        """Return the frame of a function for a jaxpr."""
        return cls([v.aval.dtype for v in jaxpr.invars], [v.aval.dtype for v in jaxpr.outvars], lanes, name)

    def _array(self, of, index: int, dtype):
        kind = _I8 if dtype == np.bool_ else self.e.kind(dtype)
        return self.b.bitcast(self.b.load(self.b.gep(of, [_I32(index)])), kind.as_pointer())

    def take(self, more: int):
        """Emit the claim of the next `more` points; return the first of them."""
        return self.b.atomic_rmw("add", self.next, _I64(more), "monotonic")

    def place(self, number: int, lane):
        """Return the index, in an array, of element `number` of a point."""
        return self.b.add(self.b.mul(self.width, _I64(number)), lane)

    def vector(self, pointer, at):
        """Return a pointer to the vector that starts at an index of an array."""
        return self.b.bitcast(self.b.gep(pointer, [at]), ir.VectorType(pointer.type.pointee, self.e.lanes).as_pointer())

    def load(self, pointer, at):
        """Load one number per lane; flags are bytes in memory."""
        return self.as_flag(pointer, self.b.load(self.vector(pointer, at), align=1))

    def load_shared(self, pointer, at):
        """Load one number for all lanes."""
        return self.as_flag(pointer, self.e.splat(self.b.load(self.b.gep(pointer, [at]))))

    def as_flag(self, pointer, value):
        """Return a loaded vector, as a vector of flags if the memory holds bytes."""
        is_flag = pointer.type.pointee == _I8
        return self.b.icmp_unsigned("!=", value, self.e.constant_of(0, value.type)) if is_flag else value

    def store(self, value, pointer, at):
        """Store one number per lane."""
        if pointer.type.pointee == _I8:
            value = self.b.zext(value, ir.VectorType(_I8, self.e.lanes))
        self.b.store(value, self.vector(pointer, at), align=1)

    def store_first(self, value, pointer, at):
        """Store the number of the first lane only."""
        value = self.e.lane(value, 0)
        self.b.store(self.b.zext(value, _I8) if pointer.type.pointee == _I8 else value, self.b.gep(pointer, [at]))

    def argument(self, variable, source, shared: bool, load, starts):
        """Return the value of an input: a vector, an array of vectors, or `Memory` for a long array.

        `load(source, number)` loads an element that differs between lanes. `starts(size)` returns where the long array
        of each lane begins.
        """
        shape = variable.aval.shape
        if is_long(shape):
            rows = shape[0] if len(shape) == 2 else None
            return Memory(source, shape[-1], None if shared else starts(math.prod(shape)), rows, shape[-1])
        count = range(math.prod(shape))
        numbers = boxed([self.load_shared(source, _I64(k)) if shared else load(source, k) for k in count])
        return unboxed(numbers.reshape(shape))


def emit(program, shared: list[bool], lanes: int, name: str, alone: bool = False) -> ir.Module:
    """Emit a function that runs a jaxpr over arrays of many points (see `Frame`).

    The arrays have room for at least `lanes` points, and at least 1 point is computed. Inputs that are not `shared`
    have an axis of points. With `alone` there is one point, and room for one, which all lanes compute.
    """
    jaxpr = program.jaxpr
    f = Frame.of(jaxpr, lanes, name)
    b, e = f.b, f.e
    head, inside, after = (b.append_basic_block(name) for name in ("lanes", "program", "end"))
    b.branch(head)
    b.position_at_end(head)
    first = f.take(lanes)
    b.cbranch(b.icmp_signed("<", first, f.count), inside, after)
    b.position_at_end(inside)
    if not alone:  # the last vector repeats some points instead of reading past the arrays
        last = b.sub(f.width, _I64(lanes))
        first = b.select(b.icmp_signed("<", first, last), first, last)

    def load(source, number):
        return f.load_shared(source, f.place(number, first)) if alone else f.load(source, f.place(number, first))

    def starts(size):
        return [b.mul(b.add(first, _I64(0 if alone else i)), _I64(size)) for i in range(lanes)]

    given = zip(jaxpr.invars, f.sources, shared, strict=True)
    results = e.run(program, [f.argument(*each, load, starts) for each in given], e.constant(True, bool))
    for values, target in zip(results, f.targets):
        for number, value in enumerate(flat([values])):
            (f.store_first if alone else f.store)(value, target, f.place(number, first))
    b.branch(head)
    b.position_at_end(after)
    b.ret_void()
    return f.module


def emit_loop(program, shared: list[bool], lanes: int, name: str) -> ir.Module:
    """Emit a jaxpr that is one loop, as `emit` does: a finished lane takes the next point and waits for no other."""
    return Refilled(Frame.of(program.jaxpr, lanes, name), program, shared).module()


class Refilled:
    """A loop whose lanes take a new point when they finish one.

    The values that depend on the point are on the stack between runs of the loop, in one slot per lane or more.
    """

    def __init__(self, frame: Frame, program, shared: list[bool], slots: int | None = None):
        self.slots = slots or frame.e.lanes
        self.f, self.b, self.e, jaxpr = frame, frame.b, frame.e, program.jaxpr
        (self.equation,) = jaxpr.eqns
        self.shared = dict(zip(jaxpr.invars, shared, strict=True))
        self.constants = dict(zip(jaxpr.constvars, program.consts, strict=True))
        self.of = dict(zip(jaxpr.invars, frame.sources))
        parameters = self.equation.params
        consts = parameters["cond_nconsts"] + parameters["body_nconsts"]
        self.consts, self.carry = self.equation.invars[:consts], self.equation.invars[consts:]
        # Loaded before all loops: values that depend on shared inputs only are computed there, too.
        given = dict.fromkeys(v for v in self.consts if self._is_given(v) and self.shared[v])
        self.known = {v: frame.argument(v, self.of[v], True, None, None) for v in given}
        self.point, self.active, self.ready = (self._room(kind) for kind in (_I64, _I8, _I8))
        # Stack memory for each number that differs between lanes: (variable, element, memory).
        own = dict.fromkeys(v for v in self.consts if self._is_own(v))
        self.own = [each for v in own for each in self._rooms(v)]
        self.changing = [each for v in self.carry for each in self._rooms(v)]

    def _room(self, kind):
        room = self.b.alloca(kind, self.slots)
        room.align = 64
        return room

    def _is_given(self, variable) -> bool:
        return not isinstance(variable, Literal) and variable not in self.constants

    def _constant(self, variable) -> np.ndarray:
        value = variable.val if isinstance(variable, Literal) else self.constants[variable]
        return np.asarray(value, kind_of(variable))

    def _is_own(self, variable) -> bool:
        return self._is_given(variable) and not self.shared[variable] and not is_long(variable.aval.shape)

    def _rooms(self, variable) -> list:
        if is_long(variable.aval.shape):
            raise Unsupported("a long list that changes")
        kind = _I8 if variable.aval.dtype == np.bool_ else self.e.kind(variable.aval.dtype)
        return [(variable, k, self._room(kind)) for k in range(math.prod(variable.aval.shape))]

    def module(self) -> ir.Module:
        """Emit the function and return its module."""
        f, b, e = self.f, self.b, self.e
        self._each_lane(self._clear)
        outer, run, end = (b.append_basic_block(name) for name in ("refill", "run", "end"))
        e.before.append(b.basic_block)
        b.branch(outer)
        b.position_at_end(outer)
        self._each_of(f.load(self.ready, _I64(0)), self._exchange)
        active = f.load(self.active, _I64(0))
        b.cbranch(e.any(active), run, end)
        b.position_at_end(run)
        carry = self._state(self._take)
        more = b.icmp_signed("<", b.load_atomic(f.next, "monotonic", 8), f.count)

        def leaves(going):
            return b.and_(more, e.any(b.and_(active, b.not_(going))))

        state, going = e.loop(self.equation.params, self._consts(self._take) + carry, active, leaves)
        for value, (_, _, room) in zip(flat(state), self.changing, strict=True):
            f.store(value, room, _I64(0))
        f.store(b.not_(going), self.ready, _I64(0))
        b.branch(outer)
        b.position_at_end(end)
        b.ret_void()
        return f.module

    def _take(self, room):
        value = self.f.load(room, _I64(0))
        remember([value], 1)
        return value

    def _like(self, variable):
        shape = variable.aval.shape
        return np.empty(shape, object) if shape else None

    def _state(self, take: Callable) -> list:
        """Return the state of the loop; `take(room)` loads one number per lane from its slot."""
        return like([self._like(v) for v in self.carry], [take(room) for *_, room in self.changing])

    def _consts(self, take: Callable) -> list:
        """Return the constants of the loop; `take(room)` loads one number per lane from its slot."""
        rooms = iter([room for *_, room in self.own])
        values = dict(self.known)

        def starts(size):
            return self._starts(take, size)

        for v in self.consts:
            if self._is_given(v) and v not in values:
                values[v] = self.f.argument(v, self.of[v], False, lambda *_: take(next(rooms)), starts)
        return [values[v] if self._is_given(v) else self.e.known(self._constant(v), kind_of(v)) for v in self.consts]

    def _starts(self, take: Callable, size: int) -> list:
        point = take(self.point)
        starts = [self.b.mul(self.e.lane(point, i), _I64(size)) for i in range(self.e.lanes)]
        remember(starts, 1)
        return starts

    def _clear(self, lane) -> None:
        self.b.store(_I64(-1), self.b.gep(self.point, [lane]))
        self.b.store(_I8(1), self.b.gep(self.ready, [lane]))

    def _each_lane(self, function, first=_I64(0), count=None) -> None:
        """Emit `function(slot)` for each of `count` slots (None: one per lane) from `first` on."""
        b = self.b
        before, head, after = b.basic_block, b.append_basic_block("lane"), b.append_basic_block("lanes")
        b.branch(head)
        b.position_at_end(head)
        lane = b.phi(_I64)
        function(b.add(first, lane))
        following = b.add(lane, _I64(1))
        lane.add_incoming(_I64(0), before)
        lane.add_incoming(following, b.basic_block)
        b.cbranch(b.icmp_signed("<", following, _I64(self.e.lanes) if count is None else count), head, after)
        b.position_at_end(after)

    def _each_of(self, mask, function, first=_I64(0)) -> None:
        """Emit `function(slot)` for each lane set in `mask`; `first` is the slot of the first lane."""
        b = self.b
        flags = b.zext(b.bitcast(mask, ir.IntType(self.e.lanes)), _I64)
        before, head, inside, after = b.basic_block, *(b.append_basic_block(name) for name in ("set", "lane", "lanes"))
        b.branch(head)
        b.position_at_end(head)
        left = b.phi(_I64)
        b.cbranch(b.icmp_signed("!=", left, _I64(0)), inside, after)
        b.position_at_end(inside)
        function(b.add(first, b.cttz(left, ir.Constant(_I1, 1))))
        left.add_incoming(flags, before)
        left.add_incoming(b.and_(left, b.sub(left, _I64(1))), b.basic_block)
        b.branch(head)
        b.position_at_end(after)

    def _exchange(self, lane) -> None:
        """Emit: store the result of a lane and load its next point.

        When no point is left, the lane loads the last point again, and its result is discarded.
        """
        b, count = self.b, self.f.count
        point, active = b.gep(self.point, [lane]), b.gep(self.active, [lane])
        old = b.load(point)
        with b.if_then(b.icmp_signed(">=", old, _I64(0))), b.if_then(b.icmp_signed("!=", b.load(active), _I8(0))):
            targets = [t for v, t in zip(self.carry, self.f.targets) for _ in range(math.prod(v.aval.shape))]
            for (_, k, room), target in zip(self.changing, targets, strict=True):
                b.store(b.load(b.gep(room, [lane])), b.gep(target, [self.f.place(k, old)]))
        new = self.f.take(1)
        there = b.icmp_signed("<", new, count)
        b.store(b.zext(there, _I8), active)
        new = b.select(there, new, b.sub(count, _I64(1)))
        b.store(new, point)
        for variable, k, room in self.own + self.changing:
            b.store(self._of_point(variable, k, new), b.gep(room, [lane]))

    def _of_point(self, variable, k: int, point):
        """Emit the load of one element of a variable for a point."""
        if not self._is_given(variable):
            value = self._constant(variable).ravel()[k]
            kind = _I8 if value.dtype == np.bool_ else self.e.kind(value.dtype)
            return kind(int(value) if isinstance(kind, ir.IntType) else float(value))
        at = _I64(k) if self.shared[variable] else self.f.place(k, point)
        return self.b.load(self.b.gep(self.of[variable], [at]))
