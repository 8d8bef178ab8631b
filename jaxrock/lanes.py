"""Many scenes at once: under `jax.vmap` a function of one scene runs in chunks of lanes that step together.

A quick version of the function, where there is one, goes first; the scenes that it postpones are gathered and done
by the careful one, again in chunks.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

from jaxrock._one_function import as_one_function

_LANES, _QUICK_LANES = 64, 64  # of a chunk on CPUs; the quick version waits less for the slowest, so it takes more
_WIDE = 1 << 16  # on accelerators


class Quick(NamedTuple):
    """A quick version of a function of one scene.

    - `begin(tree)`: a first state.
    - `follow(tree, state, limit)`: the state where it is finished, or after `limit` steps in all.
    - `unfinished(tree, state)`: whether it has to be followed further.
    - `conclude(tree, state)`: the result, and whether that is postponed to the careful function.
    - `round`: steps after which chunks are made up anew of the scenes that are unfinished; None: never.
    """

    begin: Callable
    follow: Callable
    unfinished: Callable
    conclude: Callable
    round: int | None


def _lanes(most: int, size: int) -> int:
    return min(most if jax.default_backend() == "cpu" else _WIDE, size)


def in_lanes(careful: Callable, quick: Quick | None = None) -> Callable:
    """`careful(tree)`, which under `jax.vmap` runs in chunks of lanes, after `quick` where that is given."""

    @custom_vmap
    def one(tree):
        return careful(tree)

    @one.def_vmap
    def _(size, batched, tree):
        found = _Batch(careful, quick, size, batched[0])(tree)
        return found, jax.tree.map(lambda _: True, found)

    return one


class _Batch:
    """A function of one scene at `size` scenes: leaves that are `batched` have a leading axis."""

    def __init__(self, careful, quick, size, batched):
        self.careful, self.quick, self.size = careful, quick, size
        self.flags, self.structure = jax.tree.flatten(batched)

    def __call__(self, tree):
        @custom_vmap
        def run(leaves):
            return self._run(leaves)

        @run.def_vmap
        def _(size, batched, leaves):
            found = self._one_more_axis(size, batched[0], leaves)
            return found, jax.tree.map(lambda _: True, found)

        return run(self.structure.flatten_up_to(tree))

    def _one_more_axis(self, size, batched, leaves):
        """One more axis: both become one, unless arrays that all scenes share would be copied for each."""
        shared = any(new and not old and jnp.ndim(x) > 1 for new, old, x in zip(batched, self.flags, leaves))
        if shared:
            moving = [x for x, new in zip(leaves, batched) if new]

            def one(moving):
                rest = iter(moving)
                return self._run([next(rest) if new else x for x, new in zip(leaves, batched)])

            return jax.lax.map(one, moving)

        def merged(x, new, old):
            if not (new or old):
                return x
            x = x if new else x[None]
            x = x if old else x[:, None]
            return jnp.broadcast_to(x, (size, self.size, *x.shape[2:])).reshape(size * self.size, *x.shape[2:])

        flags = [new or old for new, old in zip(batched, self.flags)]
        batch = _Batch(self.careful, self.quick, size * self.size, self.structure.unflatten(flags))
        found = batch(self.structure.unflatten([merged(*each) for each in zip(leaves, batched, self.flags)]))
        return jax.tree.map(lambda x: x.reshape(size, self.size, *x.shape[1:]), found)

    def _run(self, leaves):
        moving = [x for x, flag in zip(leaves, self.flags) if flag]
        fixed = [x for x, flag in zip(leaves, self.flags) if not flag]

        def scenes(function, moving, *more):
            def one(moving, *more):
                moving, rest = iter(moving), iter(fixed)
                tree = self.structure.unflatten([next(moving if flag else rest) for flag in self.flags])
                return function(tree, *more)

            return jax.vmap(one)(moving, *more)

        def careful(part):
            return scenes(self.careful, part)

        if self.quick is None:
            return _chunked(careful, moving, self.size)
        quick, begun = self.quick, scenes(self.quick.begin, moving)

        def follow(limit, part, states):
            return scenes(lambda tree, state: quick.follow(tree, state, limit[0]), part, states)

        def unfinished(states):
            return scenes(quick.unfinished, moving, states)

        if quick.round is None:
            endless = jnp.array([jnp.iinfo(jnp.int32).max])
            followed = _chunked(lambda parts: follow(endless, *parts), (moving, begun), self.size, _QUICK_LANES)
        else:
            followed = _in_rounds(follow, unfinished, moving, begun, quick.round)
        # Outside the chunks, so that what nobody asks for is not computed.
        found, postponed = scenes(quick.conclude, moving, followed)
        return _again(careful, moving, found, postponed)


def _chunked(function: Callable, leaves, size: int, most: int = _LANES):
    """`function` of leaves with a leading axis of `size`, in chunks; the last is filled up with its last scene."""
    lanes = _lanes(most, size)
    chunks = -(-size // lanes)

    def cut(x):
        x = jnp.concatenate([x, jnp.repeat(x[-1:], chunks * lanes - size, axis=0)])
        return x.reshape(chunks, lanes, *x.shape[1:])

    found = as_one_function(lambda parts: jax.lax.map(function, parts))(jax.tree.map(cut, leaves))
    return jax.tree.map(lambda x: x.reshape(chunks * lanes, *x.shape[2:])[:size], found)


def _again(function: Callable, leaves, found, which):
    """`found`, with the results of `function(leaves)` in the places `which`, in chunks."""
    lanes = _lanes(_LANES, which.size)
    count = which.sum()
    order = jnp.nonzero(which, size=which.size, fill_value=0)[0]
    order = jnp.concatenate([order, jnp.zeros(lanes, order.dtype)])

    def body(carry):
        done, found = carry
        places = jax.lax.dynamic_slice_in_dim(order, done, lanes)
        # What is past the last is done again, with the same result.
        places = jnp.where(done + jnp.arange(lanes) < count, places, places[0])
        more = function(jax.tree.map(lambda x: x[places], leaves))
        return done + lanes, jax.tree.map(lambda x, new: x.at[places].set(new), found, more)

    return jax.lax.while_loop(lambda carry: carry[0] < count, body, (jnp.zeros_like(count), found))[1]


def _in_rounds(follow: Callable, unfinished: Callable, leaves, states, steps: int):
    """Follow all states to their end; after every so many steps the unfinished ones make up new chunks."""

    def body(carry):
        limit, states, left = carry
        run = as_one_function(follow)
        states = _again(lambda parts: run(limit[None], *parts), (leaves, states), states, left)
        return limit + steps, states, unfinished(states)

    carry = jnp.int32(steps), states, unfinished(states)
    return jax.lax.while_loop(lambda carry: carry[2].any(), body, carry)[1]
