"""Programs of one lane as machine code for the vector unit of a CPU. Needs llvmlite.

XLA's CPU backend makes a loop over all lanes of every few operations, and hands arrays from loop to loop through
memory. Here a program runs from its first to its last operation for a few lanes at a time, one in each element of a
vector register, and then for the next few. XLA calls it as a foreign function.
"""

import math
import os
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Literal

from jaxrock.native.emitter import SMALL, is_known
from jaxrock.native.hoisting import hoisted
from jaxrock.native.kernels import emit, emit_loop, is_long
from jaxrock.native.machine import is_there as is_there, lanes_of, machine as machine, registered
from jaxrock.native.parted import emit_parted, has_parts
from jaxrock.native.partition import Part, ahead, around_loop, computed
from jaxrock.native.plain import has_foreign, plain
from jaxrock.native.pool import HAS_THREADS
from jaxrock.native.unmarked import unmarked


class _Piece(NamedTuple):
    """A part of a program, and the name of its machine code."""

    part: Part
    name: str


class Plan:
    """A program (closed, of one lane) as machine code for many: leaves that are not `shared` are a lane's own.

    `refilled`: in the program's one loop a lane that is done does not wait for others. `alone`: whether there is only
    one lane, whose long lists all lanes of a vector may then look up.
    Raises `Unsupported` if the program does what is not known in `operations`.
    """

    def __init__(self, program: ClosedJaxpr, shared: list[bool], refilled: bool = False, alone: bool = False):
        program = unmarked(plain(program) if has_foreign(program.jaxpr) else program)
        program = hoisted(program, _is_before_loops)
        self._program, self._shared, self._alone = program, shared, alone
        self._once, self._each, self._rest = ahead(program, shared, is_known, _is_large)
        own = self._first_own()
        self._pieces = []
        for part in around_loop(self._rest) if refilled else [self._rest]:
            is_loop = refilled and [e.primitive.name for e in part.program.jaxpr.eqns] == ["while"]
            parted = is_loop and has_parts(part.program.jaxpr.eqns[0])
            writes = emit_parted if parted else emit_loop if is_loop else emit
            name = registered(part.program, [v not in own for v in part.inputs], writes)
            own.update(v for v in part.outputs if not isinstance(v, Literal))
            self._pieces.append(_Piece(part, name))

    @property
    def names(self) -> list[str]:
        """Of all machine code that it calls."""
        return [piece.name for piece in self._pieces]

    def _first_own(self) -> set:
        """Variables that a lane has of its own before its machine code runs."""
        inputs = {v for v, same in zip(self._program.jaxpr.invars, self._shared) if not same}
        return inputs | {v for v in self._each.outputs if not (self._alone and is_long(v.aval.shape))}

    def __call__(self, leaves: list, threads: int, count=None) -> list:
        """Results, with a leading axis of lanes, of leaves; `count`: of how many lanes, the first, there have to be
        results (at least 1; known at run time only)."""
        values = dict(zip(self._program.jaxpr.invars, leaves))
        computed(self._once, values, batched=False)
        computed(self._each, values, batched=True)
        size = next(x.shape[0] for x, same in zip(leaves, self._shared) if not same)
        more = -size % lanes_of()
        told = size + more, size if count is None else count, threads
        sizes = jnp.stack([jnp.asarray(x, jnp.int32) for x in told])
        own = self._first_own()
        values.update((v, values[v][0]) for v in self._each.outputs if v not in own)
        for v in [v for v in self._rest.inputs if v in own]:
            x = values[v]
            x = jnp.concatenate([x, jnp.repeat(x[-1:], more, axis=0)]) if more else x
            values[v] = x if is_long(v.aval.shape) else jnp.moveaxis(x, 0, -1)
        for part, name in self._pieces:
            shapes = [(*v.aval.shape, size + more) for v in part.outputs]
            results = [jax.ShapeDtypeStruct(shape, v.aval.dtype) for shape, v in zip(shapes, part.outputs)]
            arrays = jax.ffi.ffi_call(name, results)(sizes, *(values[v] for v in part.inputs))
            values.update((v, x) for v, x in zip(part.outputs, arrays) if not isinstance(v, Literal))
        return [jnp.moveaxis(x, -1, 0)[:size] for x in arrays]


# What takes as long as many products: it is not done again whenever a lane takes the next scene.
_DEAR = {"div", "sqrt", "rsqrt", "exp", "expm1", "log", "sin", "cos", "tan", "asin", "atan", "atan2", "tanh", "pow"}


def _is_before_loops(equation) -> bool:
    """Whether what stays the same in a loop is computed before it, once for each scene."""
    return equation.primitive.name in _DEAR or not is_known(equation) or any(map(_is_large, equation.outvars))


def _is_large(variable) -> bool:
    return math.prod(variable.aval.shape) > SMALL


def threads(devices: int) -> int:
    """How many threads run a program: all cores of this process, dealt to the devices that run it at the same time."""
    if not HAS_THREADS:
        return 1
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    at_once = min(devices, len(jax.local_devices(backend="cpu")))
    return max(1, cores // max(1, at_once))
