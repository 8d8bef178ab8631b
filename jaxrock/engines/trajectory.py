"""The steps of a history: where each starts, so that the block can be followed again to any time after it."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from equinox.internal import unvmap_any
from jaxtyping import Array, Bool, Inexact, Int, PyTree

from jaxrock._checks import Values, checked
from jaxrock.numerics.choice import where


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
        end = self.duration * (1 + 1e-12)  # a time computed as the duration may round past it
        time = checked("time", time, "be in the history [0, duration]", lambda t: (t >= 0) & (t <= end))
        return time.astype(jnp.result_type(time, self.duration))

    def at_times(self, time: Inexact[Array, "..."], follow: Callable) -> PyTree:
        """`follow(node, elapsed)` from the node before each time; results have the shape of `time` in front."""

        def at(t):
            return follow(*self.before(t))

        return jax.tree.map(lambda x: x.reshape(*time.shape, *x.shape[1:]), jax.vmap(at)(time.ravel()))

    def before(self, time: Inexact[Array, ""]) -> tuple[PyTree, Inexact[Array, ""]]:
        """The node before a time, and how long after it that is [s]; not a number where no step was left for that."""
        index = jnp.clip(jnp.searchsorted(self.times, time, side="right") - 1, 0, self.times.size - 1)
        node = jax.tree.map(lambda x: x[index], self.nodes)
        elapsed = where(time <= self.duration, time, self.duration) - self.times[index]
        is_followed = node.done | (index < self.times.size - 1) | (elapsed <= 0)
        return node, where(is_followed, elapsed, jnp.nan)

    def events(self, happened: Bool[Array, " nodes"], order: Inexact[Array, " nodes"], *values) -> tuple:
        """The values where something happened, in this order; under jit filled up: infinite times, zeros beside them.

        Each of `values` comes with what fills it up.
        """
        found, count = _in_order(happened, order, values)
        if isinstance(count, jax.core.Tracer):
            return found
        traced = any(isinstance(value, jax.core.Tracer) for value in found)  # known events, of which something moves
        return tuple(value[: int(count)] if traced else jnp.asarray(np.asarray(value)[: int(count)]) for value in found)


@jax.jit
def _in_order(happened, order, values) -> tuple[tuple, Int[Array, ""]]:
    order = jnp.argsort(where(happened, order, jnp.inf), stable=True)
    found = []
    for value, filling in values:
        here = happened.reshape(happened.shape + (1,) * (value.ndim - 1))
        found.append(where(here, value, filling)[order])
    return tuple(found), happened.sum()


def followed(advance: Callable, state: PyTree, budget: int, loop: Callable) -> tuple[PyTree, PyTree]:
    """Repeat `advance` until the state is done, at most `budget` times, and keep all states.

    `loop(unfinished, step, carry, budget)` repeats. **Returns:** the last state, and every state by its number of
    steps.
    """

    def store(nodes, state):
        return jax.tree.map(lambda buffer, x: buffer.at[state.steps].set(x), nodes, state)

    def unfinished(state):
        return ~state.done & (state.steps < budget)

    def step(carry):
        before, nodes = carry
        going, after = unfinished(before), advance(before)
        state = jax.tree.map(lambda new, old: where(going, new, old), after, before)
        return state, store(nodes, state)

    nodes = jax.tree.map(lambda x: jnp.zeros((budget + 1,) + x.shape, x.dtype), state)
    start = state, store(nodes, state)
    # Under `jax.vmap` a condition of each lane would have JAX copy all that is kept at every step: lanes that are done
    # wait, and keep their last state once more.
    return loop(lambda carry: unvmap_any(unfinished(carry[0])), step, start, budget)


def times_of(time: Callable, nodes: PyTree, last: PyTree) -> Inexact[Array, " nodes"]:
    """Times of the nodes up to the last state; infinite past it."""
    number = jnp.arange(nodes.steps.size)
    return where(number <= last.steps, jax.vmap(time)(nodes), jnp.inf)
