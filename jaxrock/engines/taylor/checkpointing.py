"""A run of steps on tape: derivatives by many numbers at once, such as all samples of a record, in reverse mode.

A first run tells where the steps start. The motion is then expanded at all of them in one go, so that a motion of
many numbers is looked into once and not in every step; and the steps are taken again, of which JAX keeps some states
(checkpoints) and computes those between them again on the way back.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Inexact

from jaxrock.engines.state import State
from jaxrock.engines.taylor.policy import POLICY
from jaxrock.numerics.choice import where

Scalar = Inexact[Array, ""]
_BETWEEN = POLICY.between_checkpoints


def on_tape(advance: Callable, shaking: Callable, state: State, budget: int) -> tuple[State, State]:
    """Repeat `state = advance(state, *shaking(piece, local))` until done, at most `budget` times.

    `shaking` gives the motion's series at a time `local` after the start of a piece, and their unit of time.

    **Returns:** the last state, and the states before every step (past the end the last one, again and again).
    """
    stretches = -(-budget // _BETWEEN)
    pieces, locals_ = _starts(lambda s: advance(s, *shaking(s.piece, s.local)), state, stretches * _BETWEEN)
    terms, units = jax.vmap(shaking)(pieces, locals_)

    def step(state, here):
        local, terms, unit = here
        # The same numbers; but the start of the step moves with what came before.
        moved = terms.shifted((state.local - local) / unit)
        after = advance(state, moved, unit)
        return jax.tree.map(lambda a, b: where(state.done, a, b), state, after), state

    @jax.checkpoint
    def stretch(state, here):
        def rest(state):
            return state, jax.tree.map(lambda x: jnp.broadcast_to(x, (_BETWEEN, *x.shape)), state)

        return jax.lax.cond(state.done, rest, lambda state: jax.lax.scan(step, state, here), state)

    grid = jax.tree.map(lambda x: x.reshape(stretches, _BETWEEN), (locals_, terms, units))
    last, nodes = jax.lax.scan(stretch, state, grid)
    return last, jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), nodes)


def _starts(advance: Callable, state: State, budget: int):
    """Pieces and times in them at which the steps start; no derivatives."""

    def note(carry):
        state, pieces, locals_ = carry
        starts = pieces.at[state.steps].set(state.piece), locals_.at[state.steps].set(state.local)
        return jax.lax.stop_gradient((advance(state), *starts))

    state = jax.lax.stop_gradient(state)
    empty = jnp.zeros(budget, state.piece.dtype), jnp.zeros(budget, state.local.dtype)
    return jax.lax.while_loop(lambda c: ~c[0].done & (c[0].steps < budget), note, (state, *empty))[1:]
