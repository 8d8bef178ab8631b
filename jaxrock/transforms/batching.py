"""Many scenes at once: under `jax.vmap` a function of one scene runs in chunks of lanes that step together.

A quick version of the function, where there is one, goes first; the scenes that it postpones are gathered and done
by the careful one, again in chunks.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jax.extend.core import Literal, jaxpr_as_fun

try:  # an extra
    from jaxrock.native import call as native
    from jaxrock.native.operations import Unsupported
except (ImportError, OSError):
    native, Unsupported = None, ()


_LANES, _QUICK_LANES = 64, 256  # of a chunk on CPUs; the quick version waits less for the slowest, so it takes more
_NATIVE_LANES = 256  # of a chunk of the postponed in machine code, which leaves out what is not wanted
_WIDE = 1 << 16  # on accelerators
_FEW = 64  # scenes for which it is not worth compiling the quick version
_ENDLESS = jnp.iinfo(jnp.int32).max


class Passes(NamedTuple):
    """A function of one scene in parts.

    - `begin(tree)`: the scene as the other parts take it, and a first state.
    - `quickly(scene, state, limit)`: the state where it is finished or given up, or after `limit` steps in all; None:
      there is no quick pass.
    - `carefully(scene, state)`: the state where it is finished.
    - `unfinished(scene, state)`: whether the quick pass has to go on.
    - `conclude(scene, state)`: the result, and whether the quick pass has postponed it to the careful one.
    - `round`: steps after which chunks are made up anew of the scenes that are unfinished; None: never.
    """

    begin: Callable
    quickly: Callable | None
    carefully: Callable
    unfinished: Callable | None
    conclude: Callable
    round: int | None


def _lanes(most: int, size: int) -> int:
    return min(most if jax.default_backend() == "cpu" else _WIDE, size)


def in_lanes(function: Callable, passes: Passes | None = None, alone: Callable | None = None) -> Callable:
    """`function(tree)`, which under `jax.vmap` runs in chunks of lanes, quickly where it can; `alone`: the same for one
    scene without `jax.vmap`."""

    @custom_vmap
    def one(tree):
        return (alone or function)(tree)

    @one.def_vmap
    def _(size, batched, tree):
        results = _Batch(function if passes else _traced_apart(function), passes, size, batched[0])(tree)
        return results, jax.tree.map(lambda _: True, results)

    return one


def _traced_apart(function: Callable) -> Callable:
    """`function(tree)`, within a `shard_map` traced as if outside of it.

    Equinox compares the types of arguments when it differentiates the solves of Diffrax, and takes those that tell of
    the mesh of a `shard_map`, and those that do not, for different ones.
    """

    def run(tree):
        if jax.sharding.get_abstract_mesh().empty:
            return function(tree)
        leaves, structure = jax.tree.flatten(tree)
        leaves = [jnp.asarray(x) for x in leaves]
        types = [jax.ShapeDtypeStruct(x.shape, x.dtype, weak_type=x.weak_type) for x in leaves]
        with jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((), ())):
            program, shapes = jax.make_jaxpr(lambda *x: function(structure.unflatten(x)), return_shape=True)(*types)
        return jax.tree.unflatten(jax.tree.structure(shapes), jaxpr_as_fun(program)(*leaves))

    return run


class _Batch:
    """A function of one scene at `size` scenes: leaves that are `batched` have a leading axis."""

    def __init__(self, function, passes, size, batched):
        self.function, self.passes, self.size = function, passes, size
        self.flags, self.structure = jax.tree.flatten(batched)

    def __call__(self, tree):
        @custom_vmap
        def run(leaves):
            return self._run(leaves)

        @run.def_vmap
        def _(size, batched, leaves):
            results = self._one_more_axis(size, batched[0], leaves)
            return results, jax.tree.map(lambda _: True, results)

        return run(self.structure.flatten_up_to(tree))

    def _one_more_axis(self, size, batched, leaves):
        """One more axis: both become one, unless arrays that all scenes share would be copied for each."""
        shared = any(new and not old and jnp.ndim(x) > 1 for new, old, x in zip(batched, self.flags, leaves))
        if shared:
            moving = [x for x, new in zip(leaves, batched) if new]

            def one(moving):
                rest = iter(moving)
                return self(self.structure.unflatten([next(rest) if new else x for x, new in zip(leaves, batched)]))

            return jax.lax.map(one, moving)

        def merged(x, new, old):
            if not (new or old):
                return x
            x = x if new else x[None]
            x = x if old else x[:, None]
            return jnp.broadcast_to(x, (size, self.size, *x.shape[2:])).reshape(size * self.size, *x.shape[2:])

        flags = [new or old for new, old in zip(batched, self.flags)]
        batch = _Batch(self.function, self.passes, size * self.size, self.structure.unflatten(flags))
        results = batch(self.structure.unflatten([merged(*each) for each in zip(leaves, batched, self.flags)]))
        return jax.tree.map(lambda x: x.reshape(size, self.size, *x.shape[1:]), results)

    def _run(self, leaves):
        scenes = _Lanes(leaves, self.flags, self.structure)
        if self.passes is not None and native is not None and jax.default_backend() == "cpu":
            try:
                return self._natively(scenes)
            except Unsupported:
                pass

        def function(own):
            return scenes.each(self.function, own)

        if self.passes is None or self.passes.quickly is None or self.size <= _FEW:
            return _chunked(function, scenes.own, self.size)
        ready, begun = scenes.begin(self.passes.begin)

        def quickly(limit, own, states):
            return ready.each(lambda scene, state: self.passes.quickly(scene, state, limit), own, states)

        if self.passes.round is not None:
            followed = self._in_rounds(quickly, ready, begun)
        else:
            followed = _chunked(lambda part: quickly(_ENDLESS, *part), (ready.own, begun), self.size, _QUICK_LANES)
        # Outside the chunks, so that what nobody asks for is not computed.
        return _again(lambda own, _: function(own), scenes.own, *ready.each(self.passes.conclude, ready.own, followed))

    def _natively(self, scenes: "_Lanes"):
        """From beginning to end in machine code of our own."""
        passes, refilled = self.passes, self.passes.round is not None

        def with_all(follow):
            def function(tree):
                scene, state = passes.begin(tree)
                return passes.conclude(scene, follow(scene, state))

            return function

        def carefully(own, count=None):
            return scenes.each_natively(with_all(passes.carefully), own, refilled, count)[0]

        if passes.quickly is None or self.size <= _FEW:
            return carefully(scenes.own)
        quickly = with_all(lambda scene, state: passes.quickly(scene, state, _ENDLESS))
        return _again(carefully, scenes.own, *scenes.each_natively(quickly, scenes.own, refilled), _NATIVE_LANES)

    def _in_rounds(self, quickly: Callable, ready: "_Lanes", states):
        """Follow all states to their end; after every so many steps the unfinished ones make up new chunks."""

        def unfinished(states):
            return ready.each(self.passes.unfinished, ready.own, states)

        def body(carry):
            limit, states, left = carry
            states = _again(lambda part, _: quickly(limit, *part), (ready.own, states), states, left)
            return limit + self.passes.round, states, unfinished(states)

        carry = jnp.int32(self.passes.round), states, unfinished(states)
        return jax.lax.while_loop(lambda carry: carry[2].any(), body, carry)[1]


class _Lanes:
    """Pytrees, one for each lane: leaves that are a lane's `own` have a leading axis, the others are shared."""

    def __init__(self, leaves: list, flags: list[bool], structure):
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

    def each_natively(self, function: Callable, own: list, refilled: bool, count=None):
        """`function(tree)` in machine code of our own; `refilled` and `count`: see `native.run`."""
        rest, structures = iter(own), []
        leaves = [next(rest) if flag else x for x, flag in zip(self.leaves, self.flags)]

        def flat(leaves):
            results, structure = jax.tree.flatten(function(self.structure.unflatten(leaves)))
            structures.append(structure)
            return results

        results = native.run(flat, leaves, [not flag for flag in self.flags], refilled, count)
        return structures[0].unflatten(results)

    def begin(self, function: Callable) -> tuple["_Lanes", Any]:
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
        return _Lanes(leaves, flags, structure), jax.tree.unflatten(jax.tree.structure(shapes[1]), every[count:])


def _follow_from(function: Callable, inputs: list) -> list[bool]:
    """Which results of a function depend on its inputs."""
    program = jax.make_jaxpr(function)(inputs).jaxpr
    moved = set(program.invars)
    for equation in program.eqns:
        if any(not isinstance(x, Literal) and x in moved for x in equation.invars):
            moved.update(equation.outvars)
    return [not isinstance(x, Literal) and x in moved for x in program.outvars]


def _chunked(function: Callable, leaves, size: int, most: int = _LANES):
    """`function` of leaves with a leading axis of `size`, in chunks; the last is filled up with its last scene."""
    lanes = _lanes(most, size)
    chunks = -(-size // lanes)

    def cut(x):
        x = jnp.concatenate([x, jnp.repeat(x[-1:], chunks * lanes - size, axis=0)])
        return x.reshape(chunks, lanes, *x.shape[1:])

    results = jax.lax.map(function, jax.tree.map(cut, leaves))
    return jax.tree.map(lambda x: x.reshape(chunks * lanes, *x.shape[2:])[:size], results)


def _again(function: Callable, leaves, found, which, most: int = _LANES):
    """`found`, with the results of `function(leaves, count)` in the places `which`, in chunks; of a chunk the first
    `count` are wanted."""
    lanes = _lanes(most, which.size)

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
