"""A `LaneFunction` at one point or at many: in machine code of `llvm`, or in lanes that XLA steps together.

`Lanes.__call__` takes one of these ways:

    points                      machine code of `llvm`              XLA, everywhere else
    ------                      ----------------------              --------------------
    one                         accurate, its numbers in one lane   accurate, without lanes
    up to _FEW; or any number   accurate, in lanes                  accurate, in chunks of _LANES, or of _WIDE where
      without a fast pass                                             lanes hardly wait for each other
    many, on a tape             -                                   one after the other
    more, with a fast pass      fast, in lanes; accurate for the    fast, in chunks of _FAST_LANES, formed anew after
                                  rejected lanes, compacted; in       every round (if there are any); accurate for
                                  chunks of _NATIVE_LANES where       the rejected lanes
                                  long arrays are batched

On accelerators XLA's chunks have _WIDE lanes. Exported batches of symbolic size (`jax.export.symbolic_shape`) take the
accurate pass only: in chunks of _LANES on CPUs, and all at once elsewhere. The fast and the accurate pass are methods
of a `TwoPass`; any other function is accurate as it is.

Machine code (`Lanes.in_machine_code`) needs llvmlite, and runs on the CPU of this process. XLA runs:

- programs that a user exports;
- functions that do not ask for machine code (`in_lanes`);
- jaxprs with operations that `llvm` does not know.

`lower` decides whether to trace a function or to reuse a cached program.
"""

import functools
import logging
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Literal

from jaxrock.compiler.checks import nan_where_inputs_are
from jaxrock.compiler.hints.materialize import with_hints
from jaxrock.compiler.jaxpr.traverse import following
from jaxrock.compiler.primitive.lane_function import LaneFunction, Mode

native: Any = None
Unsupported: Any = ()
Compaction: Any = None
try:  # an extra
    from jaxrock.compiler.llvm import compaction, compiled_program, operations

    native, Unsupported, Compaction = compiled_program, operations.Unsupported, compaction.Compaction
except (ImportError, OSError):
    pass

_LOG = logging.getLogger("jaxrock")
_LANES, _FAST_LANES = 64, 256  # lanes of a chunk on CPUs; in the fast pass they wait less for the slowest
_NATIVE_LANES = 256  # lanes of a chunk for rejected points in machine code, which skips unwanted lanes
_WIDE = 1 << 16  # lanes of a chunk on accelerators, and where they hardly wait for each other
_FEW = 64  # points for which compiling the fast pass does not pay
_ENDLESS = jnp.iinfo(jnp.int32).max


class Lanes:
    """A `LaneFunction` at `size` points (None: one, without an axis); called with leaves, it returns leaves.

    - `is_batched`: for each leaf, whether it has a leading axis with a value for each point.
    - `on_cpu`: whether it is compiled for a CPU. `devices`: number of devices that run it at the same time.
    - `portable`: whether it must run without machine code of `llvm`.
    """

    def __init__(
        self, fn: LaneFunction, is_batched: tuple[bool, ...], size: Any, on_cpu: bool, devices: int = 1, portable=False
    ):
        self.fn, self.is_batched, self.size, self.on_cpu, self.portable = fn, is_batched, size, on_cpu, portable
        self.threads = native.threads(devices) if native is not None else 1

    def __call__(self, *leaves) -> list:
        if self.size == 0:
            return [jnp.zeros((0, *x.shape), x.dtype) for x in jax.tree.leaves(self.fn.results)]
        if self.in_machine_code:
            return self._one_natively(leaves) if self.size is None else self._many_natively(leaves)
        with with_hints(self.on_cpu):
            found = list(self.fn(leaves)) if self.size is None else self._many_by_xla(leaves)
        return self._none_of_none(leaves, found) if self.portable else found

    def _none_of_none(self, leaves, found: list) -> list:
        """Return results that are NaN for points with a NaN input.

        Exported programs have no other sign of invalid inputs.
        """
        structure, count = jax.tree.structure(self.fn.results), len(leaves) - self.fn.directions
        leaves = list(leaves[:count])  # a NaN tangent does not make the point invalid

        def marked(given, found):
            return jax.tree.leaves(nan_where_inputs_are(structure.unflatten(found), given))

        if self.size is None:
            return marked(leaves, found)
        points = _Points(leaves, self.is_batched[:count], jax.tree.structure(leaves))
        return points.each(marked, points.own, found)

    @functools.cached_property
    def in_machine_code(self) -> bool:
        """Return whether machine code of `llvm` runs it."""
        if not self.on_cpu or self.portable or not self.fn.in_lanes:
            return False
        if native is None:
            _LOG.debug("%s is left to XLA: there is no llvmlite that can be loaded", self.fn)
            return False
        try:
            self._compiled_programs()
        except Unsupported as reason:
            _LOG.debug("%s is left to XLA: %s", self.fn, reason)
            return False
        return True

    @property
    def machine(self) -> str:
        """Return the description of the machine that machine code is made for; empty without `llvm`."""
        return native.machine() if native is not None else ""

    def codes(self) -> list[str]:
        """Return the names of the machine code that it calls."""
        if not self.in_machine_code:
            return []
        rejected = self._rejected if self._has_fast else None
        return [name for part in [*self._compiled_programs(), rejected] if part is not None for name in part.names]

    def found(self, code: str) -> bool:
        """Return whether machine code of this name is loaded or cached."""
        return native is not None and native.is_there(code)

    @property
    def _batched_of_one(self) -> tuple[bool, ...]:
        """Return which leaves of a single point get a leading axis: its numbers, but not its long arrays."""
        numbers = tuple(not x.shape for x in self.fn.in_avals)
        return numbers if any(numbers) else (True,) * len(numbers)

    @property
    def _has_fast(self) -> bool:
        has_quick = bool(self.fn.two_pass and self.fn.two_pass.fast)
        return has_quick and isinstance(self.size, int) and self.size > _FEW

    def _compiled_programs(self) -> list:
        own = self.is_batched if self.size is not None else self._batched_of_one
        return [self._compiled_program(fast, own) for fast in ([True, False] if self._has_fast else [False])]

    def _compiled_program(self, fast: bool, own: tuple[bool, ...]):
        alone, single = self.size is None, not any(x.dtype == jnp.float64 for x in self.fn.in_avals)
        lanes = native.lanes_for(self.size, fast, single)
        key = fast, own, alone
        if key not in self.fn.compiled:
            with with_hints(False):
                program = self.fn.fast if fast else self.fn.program
            self.fn.compiled[key] = native.CompiledProgram(
                program, [not mine for mine in own], self.fn.refill, alone, lanes
            )
        return self.fn.compiled[key]

    @property
    def _rejected(self) -> Any:
        """Return the accurate pass, compacted for the lanes that the fast pass rejects; None: these run in chunks."""
        key = "postponed", self.is_batched
        if key not in self.fn.compiled:
            self.fn.compiled[key] = Compaction.of(self._compiled_programs()[1])
        return self.fn.compiled[key]

    def _one_natively(self, leaves) -> list:
        (plan,) = self._compiled_programs()
        leaves = [jnp.asarray(x)[None] if mine else x for x, mine in zip(leaves, self._batched_of_one)]
        return [x[0] for x in plan(leaves, threads=1)]

    def _many_natively(self, leaves) -> list:
        """Run all passes in machine code of `llvm`."""
        compiled, threads = self._compiled_programs(), self.threads
        if len(compiled) == 1:
            return compiled[0](leaves, threads)
        *found, which = compiled[0](leaves, threads)
        if self._rejected is not None:
            return self._rejected(leaves, found, which, threads)

        def accurate(part, count):
            rest = iter(part)
            return compiled[1]([next(rest) if mine else x for x, mine in zip(leaves, self.is_batched)], threads, count)

        own = [x for x, mine in zip(leaves, self.is_batched) if mine]
        return self._again(accurate, own, found, which, _NATIVE_LANES)

    @property
    def _two_pass(self) -> Any:
        return self.fn.two_pass

    def _many_by_xla(self, leaves) -> list:
        """Run all passes by XLA, in chunks of lanes."""
        if self.fn.mode == Mode.TAPE:
            return self._one_after_the_other(leaves)
        two_pass, points = self._two_pass, _Points(leaves, self.is_batched, self.fn.structure)

        def function(own, _=None):
            return points.each(lambda tree: self.fn(jax.tree.leaves(tree)), own)

        if not self._has_fast:
            wait = self.fn.refill or not self.fn.in_lanes  # lanes wait for the slowest
            return self._chunked(function, points.own, _LANES if wait or not isinstance(self.size, int) else _WIDE)
        ready, begun = points.init(two_pass.init)

        def fast(limit, own, states):
            return ready.each(lambda point, state: two_pass.fast(point, state, limit), own, states)

        if two_pass.round is not None:
            followed = self._in_rounds(fast, ready, begun)
        else:
            followed = self._chunked(lambda part: fast(_ENDLESS, *part), (ready.own, begun), _FAST_LANES)
        # Outside of the chunks, so that XLA removes results that the caller does not use.
        found, which = ready.each(two_pass.result, ready.own, followed)
        return self._again(function, points.own, jax.tree.leaves(found), which)

    def _one_after_the_other(self, leaves) -> list:
        """Run points one after the other, on a tape.

        Lanes would all run to the end of the longest possible tape. On the way back a `cond` skips unused steps;
        `jax.vmap` would run both of its branches.
        """

        def one(own):
            rest = iter(own)
            return self.fn([next(rest) if mine else x for x, mine in zip(leaves, self.is_batched)])

        return jax.lax.map(one, [x for x, mine in zip(leaves, self.is_batched) if mine])

    def _in_rounds(self, fast: Callable, ready: "_Points", states):
        """Run all states to their end; after every round of steps, form new chunks of the unfinished ones."""

        def unfinished(states):
            return ready.each(self._two_pass.unfinished, ready.own, states)

        def body(carry):
            limit, states, left = carry
            states = self._again(lambda part, _: fast(limit, *part), (ready.own, states), states, left)
            return limit + self._two_pass.round, states, unfinished(states)

        carry = jnp.int32(self._two_pass.round), states, unfinished(states)
        return jax.lax.while_loop(lambda carry: carry[2].any(), body, carry)[1]

    def _width(self, most: int, size: int) -> int:
        if not isinstance(size, int):
            return most if self.on_cpu else size
        return min(most if self.on_cpu else _WIDE, size)

    def _chunked(self, function: Callable, leaves, most: int = _LANES):
        """Map `function` over leaves with a leading axis, in chunks; copies of the last point fill the last chunk."""
        size = self.size  # a single point is not chunked
        lanes = self._width(most, size)
        chunks = -(-size // lanes)

        def cut(x):
            x = jnp.concatenate([x, jnp.broadcast_to(x[-1:], (chunks * lanes - size, *x.shape[1:]))])
            return x.reshape(chunks, lanes, *x.shape[1:])

        results = jax.lax.map(function, jax.tree.map(cut, leaves))
        return jax.tree.map(lambda x: x.reshape(chunks * lanes, *x.shape[2:])[:size], results)

    def _again(self, function: Callable, leaves, found, which, most: int = _LANES):
        """Compact the lanes `which`, run `function(leaves, count)` on them in chunks, and scatter into `found`.

        Only the first `count` lanes of a chunk are wanted.
        """
        lanes = self._width(most, which.size)

        def some(found):
            count = which.sum()
            order = jnp.nonzero(which, size=which.size, fill_value=0)[0]
            order = jnp.concatenate([order, jnp.zeros(lanes, order.dtype)])

            def body(carry):
                done, found = carry
                places = jax.lax.dynamic_slice_in_dim(order, done, lanes)
                wanted = done + jnp.arange(lanes) < count
                more = function(jax.tree.map(lambda x: x[places], leaves), jnp.minimum(count - done, lanes))
                targets = jnp.where(wanted, places, which.size)  # out of range, which `drop` ignores
                return done + lanes, jax.tree.map(lambda x, new: x.at[targets].set(new, mode="drop"), found, more)

            return jax.lax.while_loop(lambda carry: carry[0] < count, body, (jnp.zeros_like(count), found))[1]

        return jax.lax.cond(which.any(), some, lambda found: found, found)


class _Points:
    """Pytrees, one for each point: batched leaves (`own`) have a leading axis, all points share the others."""

    def __init__(self, leaves: list, flags: tuple[bool, ...] | list[bool], structure):
        self.leaves, self.flags, self.structure = leaves, flags, structure

    @property
    def own(self) -> list:
        """Return the batched leaves."""
        return [x for x, flag in zip(self.leaves, self.flags) if flag]

    def _tree(self, own: list):
        rest = iter(own)
        return self.structure.unflatten([next(rest) if flag else x for x, flag in zip(self.leaves, self.flags)])

    def each(self, function: Callable, own: list, *more):
        """Map `function(tree, *more)` over points with these batched leaves."""
        return jax.vmap(lambda own, *more: function(self._tree(own), *more))(own, *more)

    def init(self, function: Callable) -> tuple["_Points", Any]:
        """Map `function(tree)`, which returns two trees, over all points.

        **Returns:** the first tree as `_Points`, whose shared leaves are computed once; the second for every point.
        """

        def flat(own):
            return jax.tree.leaves(function(self._tree(own)))

        first = [x[0] for x in self.own]
        shapes = jax.eval_shape(lambda own: function(self._tree(own)), first)
        structure, count = jax.tree.structure(shapes[0]), len(jax.tree.leaves(shapes[0]))
        flags = _follow_from(flat, first)[:count]
        every = jax.vmap(flat)(self.own)
        leaves = [many if flag else one for many, one, flag in zip(every, flat(first), flags)]
        return _Points(leaves, flags, structure), jax.tree.unflatten(jax.tree.structure(shapes[1]), every[count:])


def _follow_from(function: Callable, inputs: list) -> list[bool]:
    """Return for each result of a function whether it depends on its inputs."""
    program = jax.make_jaxpr(function)(inputs).jaxpr
    moved = following(program, program.invars)
    return [not isinstance(x, Literal) and x in moved for x in program.outvars]
