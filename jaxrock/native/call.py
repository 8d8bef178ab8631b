"""Programs of one lane as machine code for the vector unit of a CPU. Needs llvmlite.

XLA's CPU backend makes a loop over all lanes of every few operations, and hands arrays from loop to loop through
memory. Here a program runs from its first to its last operation for a few lanes at a time, one in each element of a
vector register, and then for the next few. XLA calls it as a foreign function.
"""

import functools
import logging
import math
import os
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal

from jaxrock.native.emitter import SMALL, is_known
from jaxrock.native.fused import fused
from jaxrock.native.hoisting import hoisted
from jaxrock.native.kernels import emit, emit_loop, is_long
from jaxrock.native.machine import (
    EFFORT,
    is_there as is_there,
    lanes_for as lanes_for,
    lanes_of,
    machine as machine,
    registered,
)
from jaxrock.native.operations import Unsupported
from jaxrock.native.parted import emit_parted, has_parts
from jaxrock.native.partition import Part, ahead, around_loop, computed
from jaxrock.native.plain import has_foreign, plain
from jaxrock.native.pool import HAS_THREADS
from jaxrock.native.unmarked import unmarked

_LOG = logging.getLogger("jaxrock")


class _Piece(NamedTuple):
    """A part of a program by the name of its machine code, with the variables that it takes and makes."""

    name: str
    inputs: list
    outputs: list


class Plan:
    """A program (closed, of one lane) as machine code for many: leaves that are not `shared` are a lane's own.

    `refilled`: in the program's one loop a lane that is done does not wait for others. `alone`: whether there is only
    one lane, whose long lists all lanes of a vector may then look up, and whose program LLVM compiles in a moment if it
    is not refilled: it runs for microseconds. `lanes`: of a vector (None: as many as run best).
    Raises `Unsupported` if the program does what is not known in `operations`.
    """

    def __init__(
        self,
        program: ClosedJaxpr,
        shared: list[bool],
        refilled: bool = False,
        alone: bool = False,
        lanes: int | None = None,
    ):
        program = fused(unmarked(plain(program) if has_foreign(program.jaxpr) else program))
        program = hoisted(program, _is_before_loops)
        self._inputs, self._outputs = program.jaxpr.invars, program.jaxpr.outvars
        self._shared, self._alone, self._lanes = shared, alone, lanes or lanes_of()
        first, once, self._each, rest = ahead(program, shared, is_known, _is_large)
        before = self._each.program.jaxpr.eqns
        if unknown := {equation.primitive.name for equation in before if not is_known(equation)}:
            _LOG.debug(
                "%d operations are done before by XLA: not known are %s", len(before), ", ".join(sorted(unknown))
            )
        self._first, self._once = [first], self._of_all(once)
        if once.outputs and self._once is None:
            self._first.append(once)
        self._rest, own, self._pieces = rest.inputs, self._first_own(), []
        effort = EFFORT["in a moment" if alone and not refilled else "for long"]
        # Of what becomes machine code only names stay: programs take more memory than all else.
        for part in around_loop(rest) if refilled else [rest]:
            is_loop = refilled and [e.primitive.name for e in part.program.jaxpr.eqns] == ["while"]
            parted = is_loop and has_parts(part.program.jaxpr.eqns[0])
            writes = emit_parted if parted else emit_loop if is_loop else functools.partial(emit, alone=alone)
            name = registered(part.program, [v not in own for v in part.inputs], writes, self._lanes, effort)
            own.update(v for v in part.outputs if not isinstance(v, Literal))
            self._pieces.append(_Piece(name, part.inputs, part.outputs))

    def _of_all(self, part: Part) -> _Piece | None:
        """What all lanes share, in one lane: of numbers XLA would compile every few operations for themselves."""
        if not part.outputs:
            return None
        shared, writes = [True] * len(part.inputs), functools.partial(emit, alone=True)
        try:
            name = registered(part.program, shared, writes, lanes_for(None, False, False), EFFORT["in a moment"])
        except Unsupported as reason:
            _LOG.debug("what all scenes share is left to XLA: %s", reason)
            return None
        return _Piece(name, part.inputs, part.outputs)

    @property
    def names(self) -> list[str]:
        """Of all machine code that it calls."""
        return [piece.name for piece in [self._once, *self._pieces] if piece is not None]

    def _first_own(self) -> set:
        """Variables that a lane has of its own before its machine code runs."""
        inputs = {v for v, same in zip(self._inputs, self._shared) if not same}
        return inputs | {v for v in self._each.outputs if not (self._alone and is_long(v.aval.shape))}

    @property
    def _own_inputs(self) -> list:
        """Of what is left when XLA has computed its part: what a lane has of its own."""
        own = self._first_own()
        return [v for v in self._rest if v in own]

    @property
    def own(self) -> list:
        """Shapes and types of these."""
        return [v.aval for v in self._own_inputs]

    @property
    def results(self) -> list:
        """Shapes and types of what it returns, of one lane."""
        return [v.aval for v in self._outputs]

    @property
    def has_own_lists(self) -> bool:
        """Return whether a lane has long lists of its own, or what XLA computes for it."""
        return bool(self._each.outputs) or any(is_long(x.shape) for x in self.own)

    def __call__(self, leaves: list, threads: int, count=None) -> list:
        """Results, with a leading axis of lanes, of leaves; `count`: of how many lanes, the first, there have to be
        results (at least 1; known at run time only)."""
        values = self._prepared(leaves)
        size = next(x.shape[0] for x, same in zip(leaves, self._shared) if not same)
        more = 0 if self._alone else max(size, self._lanes) - size
        told = size + more, size if count is None else count, threads
        sizes = np.array(told, np.int32) if count is None else jnp.stack([jnp.asarray(x, jnp.int32) for x in told])
        for v in self._own_inputs:
            x = values[v]
            x = jnp.concatenate([x, jnp.repeat(x[-1:], more, axis=0)]) if more else x
            values[v] = x if is_long(v.aval.shape) else jnp.moveaxis(x, 0, -1)
        return [jnp.moveaxis(x, -1, 0)[:size] for x in self._run(values, sizes, size + more)]

    def own_of(self, leaves: list) -> list:
        """Of leaves those that are `own`."""
        values = dict(zip(self._inputs, leaves))
        return [values[v] for v in self._own_inputs]

    def of_collected(self, leaves: list, own: list, sizes, room: int) -> list:
        """Results, the axis of lanes behind, of lanes whose `own` have it there, too. `sizes`: `room` for lanes, how
        many are wanted (the first), and threads."""
        values = self._prepared(leaves)
        values.update(zip(self._own_inputs, own))
        return self._run(values, sizes, room)

    def _prepared(self, leaves: list) -> dict:
        """Values of variables before machine code runs."""
        values = dict(zip(self._inputs, leaves))
        for part in self._first:
            computed(part, values, batched=False)
        if self._once is not None:
            self._add(self._once, values, np.ones(3, np.int32), 1)
            values.update((v, values[v].reshape(v.aval.shape)) for v in self._once.outputs)
        computed(self._each, values, batched=True)
        own = self._first_own()
        values.update((v, values[v][0]) for v in self._each.outputs if v not in own)
        return values

    def _run(self, values: dict, sizes, room: int) -> list:
        """The machine code: what the program returns, the axis of lanes behind."""
        arrays = []
        for piece in self._pieces:
            arrays = self._add(piece, values, sizes, room)
        return arrays

    def _add(self, piece: _Piece, values: dict, sizes, room: int) -> list:
        """Results of a piece of machine code, which are added to the values of variables."""
        results = [jax.ShapeDtypeStruct((*v.aval.shape, room), v.aval.dtype) for v in piece.outputs]
        arrays = ran(piece.name, results, sizes, *(values[v] for v in piece.inputs))
        values.update((v, x) for v, x in zip(piece.outputs, arrays) if not isinstance(v, Literal))
        return arrays


def room_for(size: int) -> int:
    """How many lanes arrays of so many have: no fewer than a vector."""
    return max(size, lanes_of())


def ran(name: str, results: list, *arrays, aliases: dict | None = None) -> list:
    """What machine code of this name makes of arrays; `aliases`: which of them become which results."""
    return list(jax.ffi.ffi_call(name, results, input_output_aliases=aliases)(*arrays))


# What takes as long as many products: it is not done again whenever a lane takes the next scene.
_DEAR = {
    "div", "sqrt", "rsqrt", "exp", "expm1", "log", "log1p", "sin", "cos", "tan", "asin", "atan", "atan2", "sinh",
    "cosh", "tanh", "pow",
}  # fmt: skip


def _is_before_loops(equation) -> bool:
    """Return whether what stays the same in a loop is computed before it, once for each scene."""
    return equation.primitive.name in _DEAR or not is_known(equation) or any(map(_is_large, equation.outvars))


def _is_large(variable) -> bool:
    shape = variable.aval.shape
    return max(shape, default=0) > SMALL or math.prod(shape) > SMALL**2


def threads(devices: int) -> int:
    """How many threads run a program: all cores of this process, dealt to the devices that run it at the same time."""
    if not HAS_THREADS:
        return 1
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    at_once = min(devices, len(jax.local_devices(backend="cpu")))
    return max(1, cores // max(1, at_once))
