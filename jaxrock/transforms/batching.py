"""A recipe at one scene or at many: in machine code of our own, or in lanes that XLA steps together.

Which way `Lanes.__call__` takes:

    scenes                      machine code of our own             XLA, everywhere else
    ------                      -----------------------             --------------------
    one                         careful, its numbers in one lane    careful, without lanes
    up to _FEW; or any number   careful, in lanes                   careful, in chunks of _LANES, or of _WIDE where
      without a quick pass                                            lanes hardly wait for each other
    many, on a tape             -                                   one after the other
    more, with a quick pass     quick, in lanes; careful what it    quick, in chunks of _QUICK_LANES, which after
                                  postpones, collected; in            every round (if there are any) are made up
                                  chunks of _NATIVE_LANES where       anew; careful what it postpones
                                  scenes have lists of their own

On accelerators XLA's chunks have _WIDE lanes. Exported batches of symbolic size (`jax.export.symbolic_shape`) are all
careful, in chunks of _LANES on CPUs, and at once elsewhere. *Careful* is the function as given, *quick* a part of its
`Passes`. Machine code (`Lanes.in_machine_code`) needs llvmlite, and runs on the CPU of this process. Exported programs
have none, nor have functions that do not ask for it (`in_lanes`: flexible columns and whole histories do not), nor
programs with operations that `native` does not know. `lowering` decides whether to trace a program or to reuse a kept
one.
"""

import functools
import logging
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Literal

from jaxrock._programs import following
from jaxrock.numerics.xla_cpu import marking
from jaxrock.status import marked_result
from jaxrock.transforms.recipe import Recipe

native: Any = None
Unsupported: Any = ()
Postponed: Any = None
try:  # an extra
    from jaxrock.native import call, operations, postponed

    native, Unsupported, Postponed = call, operations.Unsupported, postponed.Postponed
except (ImportError, OSError):
    pass

_LOG = logging.getLogger("jaxrock")
_LANES, _QUICK_LANES = 64, 256  # of a chunk on CPUs; the quick version waits less for the slowest, so it takes more
_NATIVE_LANES = 256  # of a chunk of the postponed in machine code, which leaves out what is not wanted
_WIDE = 1 << 16  # on accelerators, and of what lanes hardly wait for each other in
_FEW = 64  # scenes for which it is not worth compiling the quick version
_ENDLESS = jnp.iinfo(jnp.int32).max


class Lanes:
    """A recipe at `size` scenes (None: one, without an axis), of which some leaves are their `own`.

    Called with leaves it returns leaves. `on_cpu`: what it is compiled for; `devices`: that run it at the same time;
    `portable`: whether it has to go without machine code of our own.
    """

    def __init__(
        self, recipe: Recipe, own: tuple[bool, ...], size: Any, on_cpu: bool, devices: int = 1, portable=False
    ):
        self.recipe, self.own, self.size, self.on_cpu, self.portable = recipe, own, size, on_cpu, portable
        self.threads = native.threads(devices) if native is not None else 1

    def __call__(self, *leaves) -> list:
        if self.size == 0:
            return [jnp.zeros((0, *x.shape), x.dtype) for x in jax.tree.leaves(self.recipe.results)]
        if self.in_machine_code:
            return self._one_natively(leaves) if self.size is None else self._many_natively(leaves)
        with marking(self.on_cpu):
            found = list(self.recipe(leaves)) if self.size is None else self._many_by_xla(leaves)
        return self._none_of_none(leaves, found) if self.portable else found

    def _none_of_none(self, leaves, found: list) -> list:
        """Results, of which those of scenes with a number that is none are none: in exported programs nothing else says
        that it is nonsense that was asked for."""
        structure, count = jax.tree.structure(self.recipe.results), len(leaves) - self.recipe.directions
        leaves = list(leaves[:count])  # a direction of change says nothing of the scene

        def marked(given, found):
            return jax.tree.leaves(marked_result(structure.unflatten(found), given))

        if self.size is None:
            return marked(leaves, found)
        scenes = _Scenes(leaves, self.own[:count], jax.tree.structure(leaves))
        return scenes.each(marked, scenes.own, found)

    @functools.cached_property
    def in_machine_code(self) -> bool:
        """Return whether machine code of our own runs it."""
        if not self.on_cpu or self.portable or not self.recipe.in_lanes:
            return False
        if native is None:
            _LOG.debug("%s is left to XLA: there is no llvmlite that can be loaded", self.recipe)
            return False
        try:
            self._plans()
        except Unsupported as reason:
            _LOG.debug("%s is left to XLA: %s", self.recipe, reason)
            return False
        return True

    @property
    def machine(self) -> str:
        """What machine code is made for."""
        return native.machine() if native is not None else ""

    def codes(self) -> list[str]:
        """Names of the machine code that it calls."""
        if not self.in_machine_code:
            return []
        postponed = self._postponed if self._is_quick else None
        return [name for part in [*self._plans(), postponed] if part is not None for name in part.names]

    def found(self, code: str) -> bool:
        """Return whether such machine code is there, or kept."""
        return native is not None and native.is_there(code)

    @property
    def _own_of_one(self) -> tuple[bool, ...]:
        """What is a lane's own where there is one scene: its numbers, as if there were many; not its lists."""
        numbers = tuple(not x.shape for x in self.recipe.like)
        return numbers if any(numbers) else (True,) * len(numbers)

    @property
    def _is_quick(self) -> bool:
        has_quick = bool(self.recipe.passes and self.recipe.passes.quickly)
        return has_quick and isinstance(self.size, int) and self.size > _FEW

    def _plans(self) -> list:
        own = self.own if self.size is not None else self._own_of_one
        return [self._plan(quick, own) for quick in ([True, False] if self._is_quick else [False])]

    def _plan(self, quick: bool, own: tuple[bool, ...]):
        alone, single = self.size is None, not any(x.dtype == jnp.float64 for x in self.recipe.like)
        lanes = native.lanes_for(self.size, quick, single)
        key = quick, own, alone
        if key not in self.recipe.plans:
            with marking(False):
                program = self.recipe.quick if quick else self.recipe.program
            self.recipe.plans[key] = native.Plan(
                program, [not mine for mine in own], self.recipe.refilled, alone, lanes
            )
        return self.recipe.plans[key]

    @property
    def _postponed(self) -> Any:
        """The careful plan for those that the quick one postpones; None: in chunks."""
        key = "postponed", self.own
        if key not in self.recipe.plans:
            self.recipe.plans[key] = Postponed.of(self._plans()[1])
        return self.recipe.plans[key]

    def _one_natively(self, leaves) -> list:
        (plan,) = self._plans()
        leaves = [jnp.asarray(x)[None] if mine else x for x, mine in zip(leaves, self._own_of_one)]
        return [x[0] for x in plan(leaves, threads=1)]

    def _many_natively(self, leaves) -> list:
        """From beginning to end in machine code of our own."""
        plans, threads = self._plans(), self.threads
        if len(plans) == 1:
            return plans[0](leaves, threads)
        *found, which = plans[0](leaves, threads)
        if self._postponed is not None:
            return self._postponed(leaves, found, which, threads)

        def carefully(part, count):
            rest = iter(part)
            return plans[1]([next(rest) if mine else x for x, mine in zip(leaves, self.own)], threads, count)

        own = [x for x, mine in zip(leaves, self.own) if mine]
        return self._again(carefully, own, found, which, _NATIVE_LANES)

    @property
    def _passes(self) -> Any:
        return self.recipe.passes

    def _many_by_xla(self, leaves) -> list:
        """In chunks of lanes."""
        if self.recipe.derivatives == "on a tape":
            return self._one_after_the_other(leaves)
        passes, scenes = self._passes, _Scenes(leaves, self.own, self.recipe.structure)

        def function(own, _=None):
            return scenes.each(lambda tree: self.recipe(jax.tree.leaves(tree)), own)

        if not self._is_quick:
            wait = self.recipe.refilled or not self.recipe.in_lanes  # for the slowest among them
            return self._chunked(function, scenes.own, _LANES if wait or not isinstance(self.size, int) else _WIDE)
        ready, begun = scenes.begin(passes.begin)

        def quickly(limit, own, states):
            return ready.each(lambda scene, state: passes.quickly(scene, state, limit), own, states)

        if passes.round is not None:
            followed = self._in_rounds(quickly, ready, begun)
        else:
            followed = self._chunked(lambda part: quickly(_ENDLESS, *part), (ready.own, begun), _QUICK_LANES)
        # Outside the chunks, so that what nobody asks for is not computed.
        found, which = ready.each(passes.conclude, ready.own, followed)
        return self._again(function, scenes.own, jax.tree.leaves(found), which)

    def _one_after_the_other(self, leaves) -> list:
        """Lanes would all go on to the end of the longest tape there may be, and the way back is cut where JAX makes
        "both" of a branch."""

        def one(own):
            rest = iter(own)
            return self.recipe([next(rest) if mine else x for x, mine in zip(leaves, self.own)])

        return jax.lax.map(one, [x for x, mine in zip(leaves, self.own) if mine])

    def _in_rounds(self, quickly: Callable, ready: "_Scenes", states):
        """Follow all states to their end; after every so many steps the unfinished ones make up new chunks."""

        def unfinished(states):
            return ready.each(self._passes.unfinished, ready.own, states)

        def body(carry):
            limit, states, left = carry
            states = self._again(lambda part, _: quickly(limit, *part), (ready.own, states), states, left)
            return limit + self._passes.round, states, unfinished(states)

        carry = jnp.int32(self._passes.round), states, unfinished(states)
        return jax.lax.while_loop(lambda carry: carry[2].any(), body, carry)[1]

    def _width(self, most: int, size: int) -> int:
        if not isinstance(size, int):
            return most if self.on_cpu else size
        return min(most if self.on_cpu else _WIDE, size)

    def _chunked(self, function: Callable, leaves, most: int = _LANES):
        """`function` of leaves with a leading axis, in chunks; the last is filled up with its last scene."""
        size = self.size  # a single scene is not chunked
        lanes = self._width(most, size)
        chunks = -(-size // lanes)

        def cut(x):
            x = jnp.concatenate([x, jnp.broadcast_to(x[-1:], (chunks * lanes - size, *x.shape[1:]))])
            return x.reshape(chunks, lanes, *x.shape[1:])

        results = jax.lax.map(function, jax.tree.map(cut, leaves))
        return jax.tree.map(lambda x: x.reshape(chunks * lanes, *x.shape[2:])[:size], results)

    def _again(self, function: Callable, leaves, found, which, most: int = _LANES):
        """`found`, with the results of `function(leaves, count)` in the places `which`, in chunks; of a chunk the first
        `count` are wanted."""
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
                targets = jnp.where(wanted, places, which.size)  # nowhere
                return done + lanes, jax.tree.map(lambda x, new: x.at[targets].set(new, mode="drop"), found, more)

            return jax.lax.while_loop(lambda carry: carry[0] < count, body, (jnp.zeros_like(count), found))[1]

        return jax.lax.cond(which.any(), some, lambda found: found, found)


class _Scenes:
    """Pytrees, one for each lane: leaves that are a lane's `own` have a leading axis, the others are shared."""

    def __init__(self, leaves: list, flags: tuple[bool, ...] | list[bool], structure):
        self.leaves, self.flags, self.structure = leaves, flags, structure

    @property
    def own(self) -> list:
        """Leaves that differ from lane to lane."""
        return [x for x, flag in zip(self.leaves, self.flags) if flag]

    def _tree(self, own: list):
        rest = iter(own)
        return self.structure.unflatten([next(rest) if flag else x for x, flag in zip(self.leaves, self.flags)])

    def each(self, function: Callable, own: list, *more):
        """`function(tree, *more)` of lanes with these leaves of their own."""
        return jax.vmap(lambda own, *more: function(self._tree(own), *more))(own, *more)

    def begin(self, function: Callable) -> tuple["_Scenes", Any]:
        """Two results of `function(tree)`: the first as lanes, of which what all share is made once; the second of
        every lane."""

        def flat(own):
            return jax.tree.leaves(function(self._tree(own)))

        first = [x[0] for x in self.own]
        shapes = jax.eval_shape(lambda own: function(self._tree(own)), first)
        structure, count = jax.tree.structure(shapes[0]), len(jax.tree.leaves(shapes[0]))
        flags = _follow_from(flat, first)[:count]
        every = jax.vmap(flat)(self.own)
        leaves = [many if flag else one for many, one, flag in zip(every, flat(first), flags)]
        return _Scenes(leaves, flags, structure), jax.tree.unflatten(jax.tree.structure(shapes[1]), every[count:])


def _follow_from(function: Callable, inputs: list) -> list[bool]:
    """Which results of a function depend on its inputs."""
    program = jax.make_jaxpr(function)(inputs).jaxpr
    moved = following(program, program.invars)
    return [not isinstance(x, Literal) and x in moved for x in program.outvars]
