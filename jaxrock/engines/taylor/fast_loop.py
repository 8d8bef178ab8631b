"""The loop of the fast pass: a lane glides, steps or waits, until its motion ends or a step is not certain."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from jaxrock.compiler.hints import divergent, supports_divergence
from jaxrock.engines.scene import Scene
from jaxrock.engines.state import State
from jaxrock.engines.taylor.accurate import TaylorStepper
from jaxrock.engines.taylor.event_free_step import EventFreeSteps, flush_error, onward
from jaxrock.engines.taylor.fast import advance, certain_wait
from jaxrock.engines.taylor.policy import POLICY


def most_steps(scene: Scene) -> Int[Array, ""] | int:
    """Return the number of steps after which a scene is left to the accurate pass."""
    most = POLICY.fast_steps + 3 * scene.most_pieces
    if scene.cycles is None:
        return most
    more = POLICY.steps_per_cycle * scene.cycles
    return (most + jnp.minimum(more, POLICY.outcome_steps - POLICY.fast_steps)).astype(jnp.int32)


def fast_loop(stepper: TaylorStepper, state: State, limit: Int[Array, ""] | int) -> State:
    """Follow a block to the end of the motion, until it is rejected, or until it has taken `limit` steps in all."""
    limit = jnp.minimum(limit, most_steps(stepper.scene))
    is_record = POLICY.is_record(stepper.scene.pieces_of_part)
    return (_under_record if is_record else _under_pulse)(stepper, state, limit)


def _under_pulse(stepper: TaylorStepper, state: State, limit: Int[Array, ""]) -> State:
    """Advance lanes that rest, and lanes that rock, in two inner loops."""

    def until(condition, step):
        return lambda s: jax.lax.while_loop(lambda s: condition(s) & ~s.done & (s.steps < limit), step, s)

    def resting(state):
        return state.side == 0

    rest = until(resting, lambda s: certain_wait(stepper, s))
    rock = until(lambda s: ~resting(s), lambda s: advance(stepper, s))
    return until(lambda s: True, lambda s: rock(rest(s)))(state)


def _under_record(stepper: TaylorStepper, state: State, limit: Int[Array, ""]) -> State:
    """Glide while no event can happen; where one may, lanes diverge, because that step takes many times as long."""
    strongest = stepper.scene.outlook.strongest_drive

    def turn(carry):
        state, glide = carry

        def of(step):
            def stepped():
                after = step(stepper, flush_error(stepper, state, glide, strongest))
                return after, EventFreeSteps.of(stepper, after)

            return stepped

        def with_care():
            return jax.lax.cond(divergent(state.side == 0), of(certain_wait), of(advance))

        return jax.lax.cond(
            divergent(supports_divergence() & glide.goes), lambda: onward(stepper, state, glide), with_care
        )

    def going(carry):
        state, _ = carry
        return ~state.done & (state.steps < limit)

    last = jax.lax.while_loop(going, turn, (state, EventFreeSteps.of(stepper, state)))
    return flush_error(stepper, *last, strongest)
