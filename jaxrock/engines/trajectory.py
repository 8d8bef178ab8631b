"""The steps of a history: where each starts, so that the block can be followed again to any time after it."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from equinox.internal import unvmap_any
from jaxtyping import Array, Bool, Inexact, Int, PyTree, UInt

from jaxrock._checks import Values, checked, if_traced, is_at_hand, is_traced, placed
from jaxrock.numerics.choice import where
from jaxrock.status import still_where
from jaxrock.transforms.differentiation import differentiable


class Trajectory(eqx.Module):
    """The steps of one history.

    - `stepper`: what follows the block.
    - `nodes`: every step's start, one axis more; past the last the times are infinite.
    - `times`: theirs [s].
    - `impacted`: which of them an impact made.
    - `duration`: of the history [s].
    """

    stepper: Any
    nodes: PyTree
    times: Inexact[Array, "..."]
    impacted: Bool[Array, "..."]
    duration: Inexact[Array, "..."]

    def check_single(self) -> None:
        """Raise ValueError outside of `jax.vmap`, where it holds many histories."""
        if jnp.ndim(self.times) > 1:
            raise ValueError("This response holds many scenes: call it, and read its events, inside jax.vmap.")

    def checked(self, time: Values) -> Inexact[Array, "..."]:
        """Times within the history."""
        self.check_single()
        rounding = max(1e-12, 4 * float(jnp.finfo(self.duration.dtype).eps))
        end = if_traced(self.duration) * (1 + rounding)  # a time computed as the duration may round past it
        allowed = "be in the history [0, duration]"  # of one that is none (`throw=False`) any time, which tells nothing
        time = checked("time", time, allowed, lambda t: (t >= 0) & ~(t > end))
        return time.astype(jnp.result_type(time, self.duration))

    def equally_spaced(self, samples: int) -> Inexact[Array, " samples"]:
        """So many times from 0 to the duration, equal to the bit within `jax.jit` and outside."""
        shares = np.linspace(0, 1, samples).astype(self.duration.dtype)
        return placed(np.asarray(self.duration) * shares) if is_at_hand(self.duration) else self.duration * shares

    def before(
        self, time: Inexact[Array | np.ndarray, "..."], nodes: PyTree
    ) -> tuple[PyTree, Inexact[Array | np.ndarray, " n"]]:
        """What `nodes` (all, or what is read of them) tell of the one before each time, in a row, and how long after it
        that is [s]; not a number where no step was left for that.

        By NumPy where all is at hand: XLA would compile a program, which takes much longer than to look.
        """
        given = nodes, self.nodes.done, self.times, self.duration, time
        return _before(np, *jax.tree.map(np.asarray, given)) if is_at_hand(given) else _before(jnp, *given)

    def events(self, told: Callable) -> tuple:
        """Values at the nodes where something happened, in order; under jit filled up: infinite times, zeros beside
        them.

        `told(xp, trajectory)`: of every node, by NumPy or JAX, whether it did, what they are ordered by, and pairs of a
        value and what fills it up.
        """
        self.check_single()
        if is_at_hand(self):  # XLA would compile a program, which takes much longer than to look
            happened, order, *values = told(np, jax.tree.map(np.asarray, self))
            order = np.flatnonzero(happened)[np.argsort(order[happened], stable=True)]
            return tuple(placed(np.asarray(value)[order]) for value, _ in values)
        found, count = _in_order(self, told)
        if is_traced(count):
            return found
        return tuple(value[: int(count)] for value in found)  # known events, of which something moves


def _before(xp: Any, nodes: PyTree, done: Any, times: Any, duration: Any, time: Any) -> tuple[PyTree, Any]:
    """The same by NumPy or JAX."""
    last = times.size - 1

    def at(index):
        if xp is np:
            return lambda x: x[index]
        return lambda x: x.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)

    time = xp.ravel(time)
    index = xp.clip(xp.searchsorted(times, time, side="right") - 1, 0, last)
    elapsed = xp.where(time <= duration, time, duration) - at(index)(times)
    following = xp.where(index < last, at(xp.minimum(index + 1, last))(times), xp.inf)
    is_followed = at(index)(done) | xp.isfinite(following) | (elapsed <= 0)
    return jax.tree.map(at(index), nodes), xp.where(is_followed, elapsed, xp.nan)


def at_times(
    follow: Callable, node: PyTree, elapsed: Any, duration: Inexact[Array, ""], shape: tuple[int, ...]
) -> PyTree:
    """`follow(node, elapsed)` of all that `before` has found; the results have the shape of the times in front. Of a
    history that is none, not numbers."""
    found = jax.vmap(follow)(node, elapsed)
    return still_where(jnp.isnan(duration), jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), found))


@functools.partial(jax.jit, static_argnames="told")
def _in_order(path: Trajectory, told: Callable) -> tuple[tuple, Int[Array, ""]]:
    happened, order, *values = told(jnp, path)
    order = jnp.argsort(where(happened, order, jnp.inf), stable=True)
    found = []
    for value, filling in values:
        here = happened.reshape(happened.shape + (1,) * (value.ndim - 1))
        found.append(where(here, value, filling)[order])
    return tuple(found), happened.sum()


_STRIDE = 8  # steps at a time of machine code, where one alone takes less than keeping it


def _whole(state: PyTree) -> PyTree:
    return state


def states_of(
    stepper: Any,
    state: PyTree,
    room: int,
    limit: int | Int[Array, ""] | None = None,
    keep: Callable[[PyTree], PyTree] = _whole,
) -> tuple[PyTree, PyTree]:
    """Follow a block to the end, or until it has taken `limit` steps in all: the last state, and `keep(state)` of every
    state by the number of steps from the first; after the last it may stand again, or zeros.

    There is room for so many steps, which are the limit if none is told. `keep` is a function of a module.
    """
    engine, limit = stepper.engine, room if limit is None else limit
    if not engine.in_lanes:
        return _in_strides(lambda s: _stride(stepper.advance, s, limit, 1, keep), state, limit, engine.loop, room, keep)

    def stride(given):
        stepper, state, limit = given
        return _stride(stepper.advance, state, limit, _STRIDE, keep)

    def rows(given):
        _, state, _ = given
        kept = jax.eval_shape(keep, state)
        return state, jax.tree.map(lambda x: jax.ShapeDtypeStruct((_STRIDE, *x.shape), x.dtype), kept)

    name = f"stride, {keep.__qualname__}"
    many = differentiable(stride, name=name, results=rows, in_lanes=True, derivatives="in a direction")
    return _in_strides(lambda s: many((stepper, s, jnp.int32(limit))), state, limit, engine.loop, room, keep, _STRIDE)


def rows_of(engine: Any, budget: int) -> int:
    """For how many states there is room."""
    length = _STRIDE if engine.in_lanes else 1
    return -(-budget // length) * length + 1


def followed(advance: Callable, state: PyTree, budget: int, loop: Callable) -> tuple[PyTree, PyTree]:
    """Repeat `advance` until the state is done, at most `budget` times, and keep all states, as `states_of`.

    `loop(unfinished, step, carry, budget)` repeats.
    """
    return _in_strides(lambda s: _stride(advance, s, budget, 1, _whole), state, budget, loop, budget, _whole)


def _in_strides(
    stride: Callable,
    state: PyTree,
    limit: int | Int[Array, ""],
    loop: Callable,
    room: int,
    keep: Callable,
    length: int = 1,
) -> tuple[PyTree, PyTree]:
    most = -(-room // length)

    def step(carry):
        turn, state, nodes = carry
        state, rows = stride(state)
        place = (turn * length + 1).astype(jnp.uint32)  # of integers with a sign each leaf would ask which it has
        return turn + 1, state, _with_rows(nodes, rows, place)

    # At a place that it knows XLA would make of zeros and a row a program for each leaf, which pads; of
    # `zeros.at[0].set` a loop. It does not know that no steps are negative.
    rows, first = jax.tree.map(lambda x: x[None], keep(state)), (state.steps < 0).astype(jnp.uint32)
    zeros = jax.tree.map(lambda x: jnp.zeros((most * length + 1, *x.shape[1:]), x.dtype), rows)
    nodes = _with_rows(zeros, rows, first)
    # Under `jax.vmap` a condition of each lane would have JAX copy all that is kept at every step: lanes that are done
    # wait, and keep their last state once more.
    _, state, nodes = loop(
        lambda carry: unvmap_any(_unfinished(carry[1], limit)), step, (jnp.int32(0), state, nodes), most
    )
    return state, nodes


def _with_rows(nodes: PyTree, rows: PyTree, place: UInt[Array, ""]) -> PyTree:
    return jax.tree.map(lambda x, new: jax.lax.dynamic_update_slice_in_dim(x, new, place, 0), nodes, rows)


def _unfinished(state: PyTree, limit: int | Int[Array, ""]) -> Bool[Array, ""]:
    return ~state.done & (state.steps < limit)


def _stride(
    advance: Callable, state: PyTree, limit: int | Int[Array, ""], length: int, keep: Callable
) -> tuple[PyTree, PyTree]:
    """The state after so many steps, and what is kept of it after each of them; one that is done, or has taken `limit`
    in all, waits."""

    def step(state):
        going, after = _unfinished(state, limit), advance(state)
        return jax.tree.map(lambda new, old: where(going, new, old), after, state)

    def one_more(carry):
        left, state, kept = carry
        state = step(state)
        # The rows move up: at places of its own each would be a choice among all.
        return left - 1, state, jax.tree.map(lambda rows, x: jnp.concatenate([rows[1:], x[None]]), kept, keep(state))

    if length == 1:
        state = step(state)
        return state, jax.tree.map(lambda x: x[None], keep(state))
    kept = jax.tree.map(lambda x: jnp.broadcast_to(x, (length, *x.shape)), keep(state))
    return jax.lax.while_loop(lambda carry: carry[0] > 0, one_more, (jnp.int32(length), state, kept))[1:]


def times_of(time: Callable, nodes: PyTree, steps: Int[Array, ""]) -> Inexact[Array, " nodes"]:
    """Times of the nodes up to the last state, which is after so many steps; infinite past it."""
    return where(jnp.arange(nodes.done.size) <= steps, jax.vmap(time)(nodes), jnp.inf)
