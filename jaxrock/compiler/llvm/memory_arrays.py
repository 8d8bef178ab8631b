"""Emit indexing of long arrays, which stay in memory, and sorts of short ones, in registers. Needs llvmlite.

`e` is the emitter.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from llvmlite import ir

from jaxrock.compiler.llvm.operations import NOTHING, OPERATIONS, Unsupported, is_float

_I8, _I64 = ir.IntType(8), ir.IntType(64)


class Memory(NamedTuple):
    """A long array in memory, to be indexed; or a table of a few such arrays, row by row."""

    pointer: Any
    size: int
    starts: list | None  # where the array of each lane begins; None: all lanes share one
    rows: int | None = None  # None: one array, and not a table of one row
    stride: int = 0  # from row to row

    def row(self, b: ir.IRBuilder, number: int) -> "Memory":
        """Return one row of a table."""
        return Memory(b.gep(self.pointer, [_I64(number * self.stride)]), self.size, self.starts)


def boxed(x) -> np.ndarray:
    """Return an object array of vectors; `np.asarray` would iterate over a single one."""
    if isinstance(x, np.ndarray):
        return x
    box = np.empty(len(x) if isinstance(x, list) else (), object)
    box[...] = x
    return box


def unboxed(x):
    return x[()] if isinstance(x, np.ndarray) and not x.ndim else x


def for_each(function: Callable, *inputs):
    """Apply a function of single vectors to every element of arrays, which are broadcast."""
    for x in inputs:
        if isinstance(x, np.ndarray):
            break
    else:
        return function(*inputs)
    inputs = np.broadcast_arrays(*map(boxed, inputs))
    results = np.empty(inputs[0].shape, object)
    for place in np.ndindex(results.shape):
        results[place] = function(*(x[place] for x in inputs))
    return results


def of_memory(e, equation, memory: Any, *more):
    """Emit an operation on a long array, or a select between two long arrays."""
    name, inputs = equation.primitive.name, [memory, *more]
    if name == "select_n" and [type(x) for x in more] == [Memory, Memory]:
        return _one_of_two(e, memory, *more)
    if isinstance(memory, Memory) and (found := _part_of_memory(e, equation, memory, *more)) is not None:
        return found
    # Parts of long arrays may be as short as those in registers.
    inputs = [_loaded(e, x) if isinstance(x, Memory) and x.rows is None and x.size <= e.small else x for x in inputs]
    if any(isinstance(x, Memory) for x in inputs):
        raise Unsupported(f"{name} of a long list")
    return e.applied(equation, inputs)


def _part_of_memory(e, equation, memory: Memory, *more):
    """Emit the choice of a part, or of one element, of a long array; None for another operation."""
    name, parameters = equation.primitive.name, equation.params
    sizes = parameters.get("slice_sizes", ())
    if name == "slice" and not parameters["strides"]:
        (*first, start), (*last, stop) = parameters["start_indices"], parameters["limit_indices"]
        if memory.rows is None or (first, last) == ([0], [memory.rows]):
            return memory._replace(pointer=e.b.gep(memory.pointer, [_I64(start)]), size=stop - start)
    if name == "squeeze" and memory.size == 1:
        return _looked_up(e, memory, e.constant(0, np.int32)).reshape(() if memory.rows is None else -1)
    if name == "dynamic_slice" and sizes[-1] == 1 and sizes[:-1] in ((), (memory.rows,)):
        return _looked_up(e, memory, more[-1])
    if name == "gather" and _is_column(parameters, memory):
        return _looked_up(e, memory, boxed(more[0])[0])
    return memory if name in NOTHING else None


def _loaded(e, memory: Memory) -> np.ndarray:
    """Emit the load of a whole array."""
    return boxed([_look_up(e, memory, e.constant(k, np.int32)) for k in range(memory.size)])


def _one_of_two(e, which, other: Memory, one: Memory) -> Memory:
    """Select a long array per lane: the result keeps the first pointer, and each lane's start is relative to it."""
    like = [(x.size, x.rows, x.stride, x.pointer.type) for x in (other, one)]
    if like[0] != like[1]:
        raise Unsupported("a choice of lists of other shapes")
    kind, none = one.pointer.type.pointee, [_I64(0)] * e.lanes
    size = {ir.DoubleType(): 8, ir.FloatType(): 4}.get(kind) or kind.width // 8
    places = [e.b.ptrtoint(x.pointer, _I64) for x in (one, other)]
    away = e.b.sdiv(e.b.sub(*places), _I64(size))
    starts = []
    for i, (here, there) in enumerate(zip(other.starts or none, one.starts or none)):
        starts.append(e.b.select(e.lane(which, i), e.b.add(there, away), here))
    return other._replace(starts=starts)


def _looked_up(e, memory: Memory, index) -> np.ndarray:
    """Emit the look-up of one element, or of one in each row of a table."""
    if memory.rows is None:
        return boxed([_look_up(e, memory, index)])
    return boxed([_look_up(e, memory.row(e.b, k), index) for k in range(memory.rows)]).reshape(-1, 1)


def _look_up(e, memory: Memory, index):
    # An index is clamped to the bounds, as in `dynamic_slice`.
    zero, last = (e.constant_of(k, index.type) for k in (0, memory.size - 1))
    index = e.b.select(e.b.icmp_signed("<", index, zero), zero, index)
    index = e.b.select(e.b.icmp_signed(">", index, last), last, index)
    numbers = []
    for i in range(e.lanes):
        place = e.lane(index, i)
        place = e.b.sext(place, _I64) if place.type != _I64 else place
        place = place if memory.starts is None else e.b.add(place, memory.starts[i])
        numbers.append(e.b.load(e.b.gep(memory.pointer, [place])))
    found = e.gather(numbers)
    is_flag = memory.pointer.type.pointee == _I8  # a byte in memory
    return e.b.icmp_unsigned("!=", found, e.constant_of(0, found.type)) if is_flag else found


def _is_column(parameters: dict, memory: Memory) -> bool:
    """Return whether a gather takes one element of each row: `jax.vmap` turns a look-up into such a gather."""
    told = parameters["dimension_numbers"]
    maps = tuple(told.offset_dims), tuple(told.collapsed_slice_dims), tuple(told.start_index_map)
    inside = parameters["mode"] == jax.lax.GatherScatterMode.CLIP
    return inside and maps == ((0, 1), (), (1,)) and parameters["slice_sizes"] == (memory.rows, 1)


def sorted_list(e, equation, *arrays) -> np.ndarray:
    """Emit a sort of a short array by exchanging neighbours."""
    if len(arrays) > 1 or boxed(arrays[0]).ndim != 1:
        raise Unsupported("a sort of more than one list")
    numbers = list(boxed(arrays[0]))
    less, chosen = (OPERATIONS[name] for name in ("lt", "select_n"))
    for last in range(len(numbers) - 1, 0, -1):
        for i in range(last):
            one, other = numbers[i : i + 2]
            swapped = less(e, equation, other, one)
            if is_float(one):  # NaN comes last
                ordered = e.b.fcmp_ordered("ord", other, other)
                swapped = e.b.or_(swapped, e.b.and_(ordered, e.b.fcmp_unordered("uno", one, one)))
            numbers[i] = chosen(e, equation, swapped, one, other)
            numbers[i + 1] = chosen(e, equation, swapped, other, one)
    return boxed(numbers)
