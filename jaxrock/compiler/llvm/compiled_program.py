"""Compile the jaxpr of one point to machine code for a CPU's vector unit. Needs llvmlite.

XLA's CPU backend turns every few operations into a loop over all points, and passes arrays from loop to loop through
memory. Here the whole jaxpr runs for a few points at a time, one in each lane of a vector register, then for the next
few. XLA calls the code as a foreign function.
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

from jaxrock.compiler.jaxpr.form_fma import form_fma
from jaxrock.compiler.jaxpr.hoist import hoist
from jaxrock.compiler.jaxpr.inline_and_fold import has_foreign, inline_and_fold
from jaxrock.compiler.jaxpr.partition import Part, ahead, around_loop, computed
from jaxrock.compiler.jaxpr.strip_hints import strip_hints
from jaxrock.compiler.llvm.divergent_loop import emit_divergent, is_divergent_loop
from jaxrock.compiler.llvm.emitter import SMALL, is_known
from jaxrock.compiler.llvm.jit import (
    EFFORT,
    is_there as is_there,
    lanes_for as lanes_for,
    lanes_of,
    machine as machine,
    registered,
)
from jaxrock.compiler.llvm.kernels import emit, emit_loop, is_long
from jaxrock.compiler.llvm.operations import Unsupported
from jaxrock.compiler.llvm.threads import HAS_THREADS

_LOG = logging.getLogger("jaxrock")


class _Piece(NamedTuple):
    """A compiled part of a jaxpr: the name of its machine code, and its input and output variables."""

    name: str
    inputs: list
    outputs: list


class CompiledProgram:
    """The closed jaxpr of one point, compiled to machine code for many points.

    - `shared`: one flag per input; inputs that are not shared have a value for each point.
    - `refilled`: in the only loop of the jaxpr, a finished lane takes the next point and does not wait for others.
    - `alone`: there is only one point, whose long arrays all lanes may then index. It runs for microseconds, so LLVM
      spends little effort on it unless it is refilled.
    - `lanes`: of a vector. None: as many as run fastest.

    **Raises:** `Unsupported` if the jaxpr contains an operation that `operations` does not implement.
    """

    def __init__(
        self,
        program: ClosedJaxpr,
        shared: list[bool],
        refilled: bool = False,
        alone: bool = False,
        lanes: int | None = None,
    ):
        program = form_fma(strip_hints(inline_and_fold(program) if has_foreign(program.jaxpr) else program))
        program = hoist(program, _is_before_loops)
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
        # Keep only the names of machine code: jaxprs take more memory than all else here.
        for part in around_loop(rest) if refilled else [rest]:
            is_loop = refilled and [e.primitive.name for e in part.program.jaxpr.eqns] == ["while"]
            is_divergent = is_loop and is_divergent_loop(part.program.jaxpr.eqns[0])
            writes = emit_divergent if is_divergent else emit_loop if is_loop else functools.partial(emit, alone=alone)
            name = registered(part.program, [v not in own for v in part.inputs], writes, self._lanes, effort)
            own.update(v for v in part.outputs if not isinstance(v, Literal))
            self._pieces.append(_Piece(name, part.inputs, part.outputs))

    def _of_all(self, part: Part) -> _Piece | None:
        """Compile the part that all points share, for one point; None if there is none, or if XLA must compute it.

        XLA would compile many small kernels, one for every few operations on scalars.
        """
        if not part.outputs:
            return None
        shared, writes = [True] * len(part.inputs), functools.partial(emit, alone=True)
        try:
            name = registered(part.program, shared, writes, lanes_for(None, False, False), EFFORT["in a moment"])
        except Unsupported as reason:
            _LOG.debug("what all lanes share is left to XLA: %s", reason)
            return None
        return _Piece(name, part.inputs, part.outputs)

    @property
    def names(self) -> list[str]:
        """Names of all machine code that it calls."""
        return [piece.name for piece in [self._once, *self._pieces] if piece is not None]

    def _first_own(self) -> set:
        """Return the variables that differ between points before the machine code of `rest` runs."""
        inputs = {v for v, same in zip(self._inputs, self._shared) if not same}
        return inputs | {v for v in self._each.outputs if not (self._alone and is_long(v.aval.shape))}

    @property
    def _own_inputs(self) -> list:
        """The inputs of `rest`, after XLA has computed its parts, that differ between points."""
        own = self._first_own()
        return [v for v in self._rest if v in own]

    @property
    def own(self) -> list:
        """Shapes and dtypes, for one point, of the inputs of the machine code that differ between points."""
        return [v.aval for v in self._own_inputs]

    @property
    def results(self) -> list:
        """Shapes and dtypes of the results, for one point."""
        return [v.aval for v in self._outputs]

    @property
    def has_own_lists(self) -> bool:
        """Return whether points have long arrays of their own, or values that XLA computes for each point."""
        return bool(self._each.outputs) or any(is_long(x.shape) for x in self.own)

    def __call__(self, leaves: list, threads: int, count=None) -> list:
        """Return the results for the leaves, with a leading axis of points.

        `count`: number of leading points whose results are needed (at least 1; it may be traced). None: all.
        """
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
        """Return those of the leaves that `own` describes."""
        values = dict(zip(self._inputs, leaves))
        return [values[v] for v in self._own_inputs]

    def of_collected(self, leaves: list, own: list, sizes, room: int) -> list:
        """Return the results, with the axis of points last, for arrays `own` with the same axis last.

        `sizes`: the `room` for points, the number of leading points to compute, and the number of threads.
        """
        values = self._prepared(leaves)
        values.update(zip(self._own_inputs, own))
        return self._run(values, sizes, room)

    def _prepared(self, leaves: list) -> dict:
        """Return the values of all variables before the machine code of `rest` runs."""
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
        """Call the machine code of all pieces; return the results, with the axis of points last."""
        arrays = []
        for piece in self._pieces:
            arrays = self._add(piece, values, sizes, room)
        return arrays

    def _add(self, piece: _Piece, values: dict, sizes, room: int) -> list:
        """Call the machine code of a piece, add its results to `values`, and return them."""
        results = [jax.ShapeDtypeStruct((*v.aval.shape, room), v.aval.dtype) for v in piece.outputs]
        arrays = ran(piece.name, results, sizes, *(values[v] for v in piece.inputs))
        values.update((v, x) for v, x in zip(piece.outputs, arrays) if not isinstance(v, Literal))
        return arrays


def room_for(size: int) -> int:
    """Return the size of arrays for so many points: at least one vector."""
    return max(size, lanes_of())


def ran(name: str, results: list, *arrays, aliases: dict | None = None) -> list:
    """Call the machine code of this name; `aliases` maps inputs to the results that reuse their memory."""
    return list(jax.ffi.ffi_call(name, results, input_output_aliases=aliases)(*arrays))


# Operations as slow as many products: in a refilled loop they would run again whenever a lane takes the next point.
_DEAR = {
    "div", "sqrt", "rsqrt", "exp", "expm1", "log", "log1p", "sin", "cos", "tan", "asin", "atan", "atan2", "sinh",
    "cosh", "tanh", "pow",
}  # fmt: skip


def _is_before_loops(equation) -> bool:
    """Return whether a loop-invariant equation is computed before its loop, once for each point."""
    return equation.primitive.name in _DEAR or not is_known(equation) or any(map(_is_large, equation.outvars))


def _is_large(variable) -> bool:
    shape = variable.aval.shape
    return max(shape, default=0) > SMALL or math.prod(shape) > SMALL**2


def threads(devices: int) -> int:
    """Return the number of threads per device: the cores of this process, divided among devices that run at once."""
    if not HAS_THREADS:
        return 1
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    at_once = min(devices, len(jax.local_devices(backend="cpu")))
    return max(1, cores // max(1, at_once))
