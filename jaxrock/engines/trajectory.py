"""The steps of a history: the start of each, from which the block can be followed again to any later time."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from equinox.internal import unvmap_any
from jaxtyping import Array, Bool, Inexact, Int, PyTree, UInt

from jaxrock._arguments.ranges import checked
from jaxrock._core.arrays import Values, if_traced, is_concrete, is_traced, to_device
from jaxrock.compiler import lane_function
from jaxrock.compiler.hints import select
from jaxrock.status import still_where


class Trajectory(eqx.Module):
    """The steps of one history.

    - `stepper`: the stepper that follows the block.
    - `nodes`: the start of every step, along a leading axis; times past the last are infinite.
    - `times`: times of the nodes [s].
    - `impacted`: whether an impact made the node.
    - `duration`: duration of the history [s].
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
        """Check that times lie within the history, and return them in its precision."""
        self.check_single()
        rounding = max(1e-12, 4 * float(jnp.finfo(self.duration.dtype).eps))
        end = if_traced(self.duration) * (1 + rounding)  # a time computed as the duration may round past it
        allowed = "be in the history [0, duration]"  # NaN (`throw=False`) allows any time, which yields NaN
        time = checked("time", time, allowed, lambda t: (t >= 0) & ~(t > end))
        return time.astype(jnp.result_type(time, self.duration))

    def equally_spaced(self, samples: int) -> Inexact[Array, " samples"]:
        """Return `samples` times from 0 to the duration, bitwise equal within `jax.jit` and outside."""
        shares = np.linspace(0, 1, samples).astype(self.duration.dtype)
        return to_device(np.asarray(self.duration) * shares) if is_concrete(self.duration) else self.duration * shares

    def before(
        self, time: Inexact[Array | np.ndarray, "..."], nodes: PyTree
    ) -> tuple[PyTree, Inexact[Array | np.ndarray, " n"]]:
        """Return the leaves of `nodes` at the last node before each time, flattened, and the time since it [s].

        The elapsed time is NaN where the step budget ended before that time. For concrete values NumPy does the lookup:
        XLA would compile a program, which takes much longer than the lookup.
        """
        given = nodes, self.nodes.done, self.times, self.duration, time
        return _before(np, *jax.tree.map(np.asarray, given)) if is_concrete(given) else _before(jnp, *given)

    def events(self, told: Callable) -> tuple:
        """Return values at the nodes where an event happened, in order. Under jit they are padded: infinite times,
        zeros beside them.

        `told(xp, trajectory)` runs under NumPy or JAX. It returns, for every node, whether the event happened, the key
        that orders the events, and pairs of a value and its padding.
        """
        self.check_single()
        if is_concrete(self):  # XLA would compile a program, which takes much longer than the lookup
            happened, order, *values = told(np, jax.tree.map(np.asarray, self))
            order = np.flatnonzero(happened)[np.argsort(order[happened], stable=True)]
            return tuple(to_device(np.asarray(value)[order]) for value, _ in values)
        found, count = _in_order(self, told)
        if is_traced(count):
            return found
        return tuple(value[: int(count)] for value in found)  # concrete events, some values traced


def _before(xp: Any, nodes: PyTree, done: Any, times: Any, duration: Any, time: Any) -> tuple[PyTree, Any]:
    """Do the work of `Trajectory.before` under NumPy or JAX."""
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
    """Map `follow(node, elapsed)` over the results of `Trajectory.before`. The shape of the times leads in the results.

    A history that was not computed (NaN duration) yields NaN.
    """
    found = jax.vmap(follow)(node, elapsed)
    return still_where(jnp.isnan(duration), jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), found))


@functools.partial(jax.jit, static_argnames="told")
def _in_order(path: Trajectory, told: Callable) -> tuple[tuple, Int[Array, ""]]:
    happened, order, *values = told(jnp, path)
    order = jnp.argsort(select(happened, order, jnp.inf), stable=True)
    found = []
    for value, filling in values:
        here = happened.reshape(happened.shape + (1,) * (value.ndim - 1))
        found.append(select(here, value, filling)[order])
    return tuple(found), happened.sum()


_STRIDE = 8  # steps per call of machine code, where storing one state takes longer than computing it


def _whole(state: PyTree) -> PyTree:
    return state


def states_of(
    stepper: Any,
    state: PyTree,
    room: int,
    limit: int | Int[Array, ""] | None = None,
    keep: Callable[[PyTree], PyTree] = _whole,
) -> tuple[PyTree, PyTree]:
    """Follow a block to the end, or until it has taken `limit` steps in all.

    Return the last state, and `keep(state)` of every state by the number of steps from the first. Rows after the last
    hold it again, or zeros. `room` is the number of steps for which there are rows, and the default of `limit`. `keep`
    is a function of a module.
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
    many = lane_function(stride, key=name, results=rows, in_lanes=True, mode="jvp")
    return _in_strides(lambda s: many((stepper, s, jnp.int32(limit))), state, limit, engine.loop, room, keep, _STRIDE)


def rows_of(engine: Any, budget: int) -> int:
    """Return the number of states for which `states_of` has rows."""
    length = _STRIDE if engine.in_lanes else 1
    return -(-budget // length) * length + 1


def followed(advance: Callable, state: PyTree, budget: int, loop: Callable) -> tuple[PyTree, PyTree]:
    """Repeat `advance` until the state is done, at most `budget` times, and keep all states, as `states_of`.

    `loop(unfinished, step, carry, budget)` is the loop primitive.
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
        place = (turn * length + 1).astype(jnp.uint32)  # a signed index would cost each leaf a test of its sign
        return turn + 1, state, _with_rows(nodes, rows, place)

    # With a constant index, XLA compiles one padding program per leaf; `zeros.at[0].set` becomes a loop. XLA cannot
    # know that `steps` is never negative, so `first` is no constant.
    rows, first = jax.tree.map(lambda x: x[None], keep(state)), (state.steps < 0).astype(jnp.uint32)
    zeros = jax.tree.map(lambda x: jnp.zeros((most * length + 1, *x.shape[1:]), x.dtype), rows)
    nodes = _with_rows(zeros, rows, first)
    # Under `jax.vmap` a condition of each lane makes JAX copy all rows at every step. With one condition for all lanes,
    # lanes that are done wait, and store their last state again.
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
    """Return the state after `length` steps, and `keep` of the state after each of them. A state that is done, or has
    taken `limit` steps in all, waits."""

    def step(state):
        going, after = _unfinished(state, limit), advance(state)
        return jax.tree.map(lambda new, old: select(going, new, old), after, state)

    def one_more(carry):
        left, state, kept = carry
        state = step(state)
        # The rows move up: a write at a varying index is a select among all rows.
        return left - 1, state, jax.tree.map(lambda rows, x: jnp.concatenate([rows[1:], x[None]]), kept, keep(state))

    if length == 1:
        state = step(state)
        return state, jax.tree.map(lambda x: x[None], keep(state))
    kept = jax.tree.map(lambda x: jnp.broadcast_to(x, (length, *x.shape)), keep(state))
    return jax.lax.while_loop(lambda carry: carry[0] > 0, one_more, (jnp.int32(length), state, kept))[1:]


def times_of(time: Callable, nodes: PyTree, steps: Int[Array, ""]) -> Inexact[Array, " nodes"]:
    """Return the times of the nodes up to the last state, after `steps` steps; infinite past it."""
    return select(jnp.arange(nodes.done.size) <= steps, jax.vmap(time)(nodes), jnp.inf)
