"""The steps of a history, and its summary: all outputs that require following the block.

The inputs are a block, a motion, a model, the initial state, the time to stop [s] and an engine. The code around the
loop over the steps is machine code where the steps are.
"""

from dataclasses import fields, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from equinox.internal import unvmap_any
from jaxtyping import Array, Bool, Int

from jaxrock._arguments.repr import described
from jaxrock._core.arrays import is_traced
from jaxrock._core.types import Real
from jaxrock.compiler import lane_function
from jaxrock.compiler.hints import jit_low_effort, stop_gradient
from jaxrock.engines.conclusion import Conclusion, conclude
from jaxrock.engines.copies import TOLD, conclude_with_copies
from jaxrock.engines.scene import Scene
from jaxrock.engines.state import Kept, State, initial_state, surpasses
from jaxrock.engines.stepper import FEW_PIECES
from jaxrock.engines.trajectory import rows_of, states_of
from jaxrock.responses.compile_setup import compile_setup, numbers_of
from jaxrock.responses.outcome import outcome_like
from jaxrock.status import Status


class Summary(eqx.Module):
    """Summary of a history as a whole (see `Response`)."""

    impact_count: Int[Array, "..."]
    large_impact_count: Int[Array, "..."]
    max_rotation: Real
    max_velocity: Real
    time_of_max: Real
    overturned: Bool[Array, "..."]
    overturned_share: Real
    margin: Real
    error: Real
    known_until: Real
    status: Status

    __repr__ = described


def history_like(told) -> tuple:
    """Return the shapes and dtypes of the results of `steps_followed`."""
    *_, engine = told

    def made(*told):
        stepper, state = started((*told, engine))
        rows = rows_of(engine, engine.budget(stepper.scene, history=True))
        nodes = jax.tree.map(lambda x: jnp.zeros((rows, *x.shape), x.dtype), Kept.of(state))
        return state.steps, nodes, numbers_of(stepper)

    steps, nodes, numbers = jax.eval_shape(made, *told[:-1])
    return steps, nodes, _summary_like(told), numbers


def steps_followed(told) -> tuple[Int[Array, ""], Kept, Summary, list]:
    """Follow a block, and return the number of steps, the kept states before all of them and after the last, the
    summary, and the numbers of the stepper.

    The numbers come without their derivatives: XLA need not compute these again.
    """
    engine, end = told[-1], _summary
    stepper, state = compile_setup(started, told) if engine.in_lanes else started(told)
    state, nodes = states_of(stepper, state, engine.budget(stepper.scene, history=True), keep=Kept.of)
    if engine.in_lanes:
        end = lane_function(_summary, key="summary", results=_summary_like, in_lanes=True, mode="jvp")
    return state.steps, nodes, end((stepper, state)), stop_gradient(numbers_of(stepper))


def steps_on_tape(told) -> tuple[Int[Array, ""], Kept, Summary, list]:
    """Return the results of `steps_followed`, computed so that reverse mode differentiates the steps."""
    stepper, state = started(told, taped=True)
    state, nodes = stepper.on_tape(state, stepper.engine.budget(stepper.scene, history=True))
    return state.steps, Kept.of(nodes), _summary((stepper, state)), stop_gradient(numbers_of(stepper))


def started(told, taped: bool = False) -> tuple[Any, State]:
    """Return the stepper that follows a history, and the state at its start."""
    block, motion, model, initial, stop, engine = told
    scene = Scene.of(block, motion, model)
    stepper = engine.stepper(scene, stop.astype(scene.p.dtype), history=True, taped=taped)
    return stepper, initial_state(scene, *(jnp.asarray(x, scene.p.dtype) for x in initial))


def _summary(given) -> Summary:
    stepper, state = given
    final = conclude(stepper, state)
    # The largest within the duration: the end may be on the way to a peak.
    higher = surpasses(state.opening, state.peak)
    lost = final.overturned
    return Summary(
        impact_count=state.impacts,
        large_impact_count=state.large_impacts,
        max_rotation=jnp.where(lost, jnp.inf, jnp.maximum(state.peak, state.opening)),
        max_velocity=jnp.where(lost, jnp.inf, state.fastest * stepper.scene.p),
        time_of_max=jnp.where(lost, jnp.inf, jnp.where(higher, stepper.time(state), state.peak_time)),
        overturned=lost,
        overturned_share=final.overturned_share,
        margin=final.margin,
        error=final.error,
        known_until=final.known_until,
        status=final.status,
    )


def with_copies(told, summary: Summary) -> Summary:
    """Return the summary with what copies of the scene tell, where it is undecided."""
    _, motion, *_ = told
    undecided = summary.status == Status.undecided
    if motion.knots.size - 1 <= FEW_PIECES:
        return summary
    if not is_traced(undecided):
        return _with_copies(told, summary) if bool(undecided) else summary

    def found():  # for all lanes, if any needs it
        return jax.tree.map(lambda a, b: jnp.where(undecided, a, b), _with_copies(told, summary), summary)

    return jax.lax.cond(unvmap_any(undecided), found, lambda: summary)


@jit_low_effort(follows_scenes=True)
def _with_copies(told, summary: Summary) -> Summary:
    *given, engine = told
    run = lane_function(
        _concluded, key="copies of a history", results=_conclusion_like, in_lanes=engine.forward.in_lanes
    )
    found = run(stop_gradient((*given, engine.forward)))
    names = [name for name in ("overturned", *TOLD) if name != "differentiable"]
    return replace(summary, **{name: getattr(found, name) for name in names})


def _concluded(told) -> Conclusion:
    block, motion, model, initial, stop, engine = told
    scene = Scene.of(block, motion, model)
    stepper = engine.stepper(scene, stop.astype(scene.p.dtype), history=False)
    return conclude_with_copies(stepper, initial_state(scene, *(jnp.asarray(x, scene.p.dtype) for x in initial)))


def _conclusion_like(told) -> Conclusion:
    return jax.eval_shape(lambda: Conclusion.blank(jnp.zeros((), jnp.result_type(*jax.tree.leaves(told[:2])))))


def _summary_like(given) -> Summary:
    """Return the shapes and dtypes of a summary."""

    def made(found):
        return Summary(*(getattr(found, field.name) for field in fields(Summary)))

    return jax.eval_shape(made, outcome_like(given))
