"""Compact the points that the fast pass rejected, rerun them accurately, and scatter the results. Needs llvmlite.

XLA would do it in a loop over chunks, with a gather for every input and a scatter for every result. XLA takes longer to
compile these than all else around a map.
"""

import math
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from llvmlite import ir

from jaxrock.compiler.llvm.compiled_program import CompiledProgram, lanes_of, ran, room_for
from jaxrock.compiler.llvm.jit import EFFORT, kept
from jaxrock.compiler.llvm.kernels import Frame, is_long
from jaxrock.compiler.llvm.threads import count_up

_I1, _I8, _I32, _I64 = ir.IntType(1), ir.IntType(8), ir.IntType(32), ir.IntType(64)
_NUMBER = np.dtype(np.int32)


class Compaction:
    """A compiled program for those of many points that the fast pass rejected."""

    def __init__(self, plan: CompiledProgram):
        self._plan = plan
        own, results, effort = plan.own, plan.results, EFFORT["for long"]
        self._listed = kept(_listed(), 2, 3, effort)
        self._collected = kept(_moved(own, own, _collect), len(own), 2 + len(own), effort)
        put_back = _moved([*results, *results], results, _put_back)
        self._put_back = kept(put_back, len(results), 2 + 2 * len(results), effort)

    @classmethod
    def of(cls, plan: CompiledProgram) -> "Compaction | None":
        """Return the compaction, or None if points have long arrays of their own, which XLA computes chunk by chunk."""
        return None if plan.has_own_lists or any(is_long(x.shape) for x in plan.results) else cls(plan)

    @property
    def names(self) -> list[str]:
        """Names of the machine code that it calls, without that of the compiled program itself."""
        return [self._listed, self._collected, self._put_back]

    def __call__(self, leaves: list, found: list, which, threads: int) -> list:
        """Return `found`, the results of all points, with the accurate results at the points flagged in `which`."""
        size = which.size
        room = room_for(size)
        told = [jax.ShapeDtypeStruct((n,), jnp.int32) for n in (3, size)]
        sizes, places = ran(
            self._listed, told, np.array([size, 1, 1], np.int32), np.array([room, threads], np.int32), which
        )
        own = [jax.ShapeDtypeStruct((*x.shape, room), x.dtype) for x in self._plan.own]
        collected = ran(self._collected, own, sizes, places, *self._plan.own_of(leaves))
        results = self._plan.of_collected(leaves, collected, sizes, room)
        like = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in found]
        first = 2 + len(results)
        return ran(
            self._put_back, like, sizes, places, *results, *found, aliases={first + i: i for i in range(len(found))}
        )


def _listed() -> ir.Module:
    """Return a function that lists the flagged points: `(sizes, (room, threads), which)` to `(sizes, places)`.

    The resulting `sizes` are the first input of the functions that run these points (see `kernels.Frame`).
    """
    f = Frame([_NUMBER, np.dtype(bool)], [_NUMBER, _NUMBER], lanes_of(), "program")
    b, (told, which), (sizes, places) = f.b, f.sources, f.targets
    count = b.alloca(_I64)
    b.store(_I64(0), count)

    def look(point):
        here = b.load(count)
        b.store(b.trunc(point, _I32), b.gep(places, [here]))  # the next point overwrites it unless this one is flagged
        b.store(b.add(here, b.zext(b.load(b.gep(which, [point])), _I64)), count)
        return _I1(1)

    count_up(b, f.width, look)
    room, threads = (b.load(b.gep(told, [_I32(i)])) for i in (0, 1))
    for i, value in enumerate((room, b.trunc(b.load(count), _I32), threads)):
        b.store(value, b.gep(sizes, [_I32(i)]))
    b.ret_void()
    return f.module


def _moved(inputs: Sequence, outputs: Sequence, move: Callable) -> ir.Module:
    """Return a function that copies numbers between arrays of all points and arrays of the points in `places`."""
    f = Frame([_NUMBER, *(x.dtype for x in inputs)], [x.dtype for x in outputs], lanes_of(), "program")
    b, lanes = f.b, f.e.lanes
    head, inside, after = (b.append_basic_block(name) for name in ("points", "move", "end"))
    b.branch(head)
    b.position_at_end(head)
    first = f.take(lanes)
    b.cbranch(b.icmp_signed("<", first, f.count), inside, after)
    b.position_at_end(inside)

    def one(lane):
        # Copies of the last point fill up the vector, as far as the arrays have room.
        here, point = (_at_most(b, b.add(first, lane), b.sub(most, _I64(1))) for most in (f.width, f.count))
        place = b.zext(b.load(b.gep(f.sources[0], [point])), _I64)
        for source, target, like in zip(f.sources[1:], f.targets, outputs):
            size = math.prod(like.shape)
            for number in range(size):
                of_all = b.add(b.mul(place, _I64(size)), _I64(number))
                move(b, (source, target), of_all, f.place(number, here), f.place(number, point))
        return _I1(1)

    count_up(b, _I64(lanes), one)
    b.branch(head)
    b.position_at_end(after)
    b.ret_void()
    return f.module


def _at_most(b: ir.IRBuilder, number, most):
    return b.select(b.icmp_signed("<", number, most), number, most)


def _collect(b: ir.IRBuilder, pointers: tuple, of_all, here, _) -> None:
    source, target = pointers
    b.store(b.load(b.gep(source, [of_all])), b.gep(target, [here]))


def _put_back(b: ir.IRBuilder, pointers: tuple, of_all, _, point) -> None:
    source, target = pointers
    b.store(b.load(b.gep(source, [point])), b.gep(target, [of_all]))
