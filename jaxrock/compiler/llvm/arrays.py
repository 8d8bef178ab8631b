"""Emit operations on small arrays as a whole: slices, gathers, scatters, products and sorts. Needs llvmlite.

A small array is a NumPy array of vectors. A constant index takes or sets elements without any instruction. An index
that differs between lanes becomes selects among all its possible values. `e` is the emitter.
"""

import functools
import itertools
import math
from collections.abc import Callable, Sequence

import jax
import numpy as np
from llvmlite import ir

from jaxrock.compiler.llvm.memory_arrays import boxed, for_each, sorted_list
from jaxrock.compiler.llvm.operations import OPERATIONS, Unsupported, is_float, multiply_add


def _number(index) -> int | None:
    """Return an index that is constant and the same in all lanes, else None."""
    if not isinstance(index, ir.Constant):
        return None
    numbers = {x.constant for x in index.constant}
    return int(numbers.pop()) if len(numbers) == 1 else None


def _part(x: np.ndarray, axis: int, start: int, size: int) -> np.ndarray:
    return x[(slice(None),) * axis + (slice(start, start + size),)]


def _taken(e, equation, x, *starts) -> np.ndarray:
    return _part_of(e, boxed(x), starts, equation.params["slice_sizes"])


def _gathered(e, equation, x, indices) -> np.ndarray:
    """Emit a gather of one slice of an array, with its collapsed axes removed."""
    told, mode, x = equation.params["dimension_numbers"], equation.params["mode"], boxed(x)
    axes, whole = told.start_index_map, len(told.offset_dims) == equation.outvars[0].aval.ndim
    inside = mode in (jax.lax.GatherScatterMode.CLIP, jax.lax.GatherScatterMode.PROMISE_IN_BOUNDS)
    if not inside or told.operand_batching_dims or not whole or boxed(indices).shape != (len(axes),):
        raise Unsupported("more than one part looked up at a time")
    part = _part_of(e, x, _starts(e, x, axes, indices), equation.params["slice_sizes"])
    return np.squeeze(part, tuple(told.collapsed_slice_dims))


def _starts(e, x: np.ndarray, axes: Sequence[int], indices) -> list:
    """Return where a slice starts along every axis: at `indices` along `axes`, at zero along the others."""
    starts = [e.constant_of(0, ir.VectorType(ir.IntType(32), e.lanes))] * x.ndim
    for axis, start in zip(axes, boxed(indices), strict=True):
        starts[axis] = start
    return starts


def _part_of(e, x: np.ndarray, starts: Sequence, sizes: Sequence[int]) -> np.ndarray:
    """Emit a slice of an array; its start is clamped so that the slice lies inside."""
    for axis, (start, size) in enumerate(zip(starts, sizes, strict=True)):
        last, number = x.shape[axis] - size, _number(start)
        if number is not None:
            x = _part(x, axis, min(max(number, 0), last), size)
            continue
        found = _part(x, axis, 0, size)
        for place in range(1, last + 1):
            choice = functools.partial(e.b.select, e.b.icmp_signed(">=", start, e.constant_of(place, start.type)))
            found = for_each(choice, _part(x, axis, place, size), found)
        x = found
    return x


def _with_part(e, x: np.ndarray, part: np.ndarray, starts: Sequence, moves: bool) -> np.ndarray:
    """Emit an array with a slice of it set. Where the slice lies partly outside, `moves` clamps its start, or nothing
    is set."""
    lasts = [n - size for n, size in zip(x.shape, part.shape, strict=True)]
    numbers = [_number(start) for start in starts]
    if moves:
        numbers = [n if n is None else min(max(n, 0), last) for n, last in zip(numbers, lasts)]
    possible = [
        range(last + 1) if n is None else [n] if 0 <= n <= last else [] for n, last in zip(numbers, lasts, strict=True)
    ]
    found = x
    for places in itertools.product(*possible):
        new = x.copy()
        new[tuple(slice(start, start + size) for start, size in zip(places, part.shape))] = part
        masks = []
        for place, start, number, last in zip(places, starts, numbers, lasts):
            if number is None and (last or not moves):
                sign = "==" if not moves or 0 < place < last else "<=" if place == 0 else ">="
                masks.append(e.b.icmp_signed(sign, start, e.constant_of(place, start.type)))
        if not masks:
            return new
        here = functools.reduce(e.b.and_, masks)
        found = for_each(lambda a, b, here=here: b if a is b else e.b.select(here, a, b), new, found)
    return found


def _set(e, equation, x, part, *starts) -> np.ndarray:
    return _with_part(e, boxed(x), boxed(part), starts, moves=True)


def _scattered(e, equation, x, indices, part) -> np.ndarray:
    """Emit a scatter of one slice into an array."""
    told, mode, x, part = equation.params["dimension_numbers"], equation.params["mode"], boxed(x), boxed(part)
    axes = told.scatter_dims_to_operand_dims
    batched = told.operand_batching_dims or told.scatter_indices_batching_dims
    if batched or boxed(indices).shape != (len(axes),) or len(told.update_window_dims) != part.ndim:
        raise Unsupported("more than one part set at a time")
    part = np.expand_dims(part, tuple(told.inserted_window_dims))
    starts = _starts(e, x, axes, indices)
    return _with_part(e, x, part, starts, moves=mode == jax.lax.GatherScatterMode.CLIP)


def _product(e, equation, x, y) -> np.ndarray:
    """Emit `dot_general`: sums of products along axes."""
    (along, of_other), batched = equation.params["dimension_numbers"]
    if any(batched) or not all(is_float(v) for v in boxed(x).ravel()):
        raise Unsupported("products of many arrays, or of whole numbers")

    def rows(x, axes):
        free = [axis for axis in range(x.ndim) if axis not in axes]
        shape = [x.shape[axis] for axis in free]
        return x.transpose([*free, *axes]).reshape(math.prod(shape), math.prod(x.shape[axis] for axis in axes)), shape

    (first, shape), (second, more) = rows(boxed(x), along), rows(boxed(y), of_other)
    results, none = np.empty((len(first), len(second)), object), e.constant(0, equation.outvars[0].aval.dtype)
    for place in np.ndindex(results.shape):
        pairs = list(zip(first[place[0]], second[place[1]], strict=True))
        # Products of two constant zeros, say of unfilled rows of a buffer, add nothing.
        pairs = [pair for pair in pairs if not all(map(_is_zero, pair))] or pairs
        found = OPERATIONS["mul"](e, equation, *pairs[0]) if pairs else none
        results[place] = functools.reduce(
            lambda total, pair: multiply_add(e, pair[0], pair[1], total), pairs[1:], found
        )
    return results.reshape([*shape, *more])


def _is_zero(x) -> bool:
    return isinstance(x, ir.Constant) and all(number.constant == 0 for number in x.constant)


def _place_of(name: str) -> Callable:
    """Return the operation `argmin` ("lt") or `argmax` ("gt") of a short array: the first NaN wins, as in JAX."""

    def operation(e, equation, x):
        if boxed(x).ndim != 1 or not boxed(x).size:
            raise Unsupported(f"{name} of an array")
        (best, *others), dtype = boxed(x), equation.params["index_dtype"]
        found = e.constant(0, dtype)
        for place, number in enumerate(others, 1):
            better = OPERATIONS[name](e, equation, number, best)
            if is_float(number):
                unlike = e.b.fcmp_unordered("uno", number, number)
                known = e.b.fcmp_ordered("ord", best, best)
                better = e.b.and_(known, e.b.or_(better, unlike))
            best, found = e.b.select(better, number, best), e.b.select(better, e.constant(place, dtype), found)
        return found

    return operation


def is_one_place(equation) -> bool:
    """Return whether an equation gathers or scatters a single slice, or is a product without batch axes."""
    name, parameters = equation.primitive.name, equation.params
    if name == "dot_general":
        return not any(parameters["dimension_numbers"][1])
    return name not in ("gather", "scatter") or len(equation.invars[1].aval.shape) == 1


# Operations on small arrays: functions of the emitter, the equation, and its operands.
OF_FEW = {
    "dynamic_slice": _taken,
    "dynamic_update_slice": _set,
    "gather": _gathered,
    "scatter": _scattered,
    "dot_general": _product,
    "argmin": _place_of("lt"),
    "argmax": _place_of("gt"),
    "sort": sorted_list,
}
