"""Event-free steps: pieces of a record into which no event can fall, at a small part of the cost of a step.

Between two samples the opening angle is nearly a parabola. A piece is evaluated by its series alone, without roots or
certificates, in two cases:

- The terms beyond the parabola are too small to turn the block back.
- The block turns where nothing is recorded: below an earlier peak, or above an earlier clearance.

Error growth is accumulated, and applied when the glide ends.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Int

from jaxrock._core.types import Flag, Scalar
from jaxrock.compiler.hints import select, supports_divergence
from jaxrock.engines.bookkeeping import MOST_OFF, rounded
from jaxrock.engines.state import State
from jaxrock.engines.taylor.accurate import TaylorStepper
from jaxrock.engines.taylor.trial_step import TrialStep
from jaxrock.engines.uncertainty import GRAZING, StateCovariance

_ESCAPES = 16  # pieces between tests whether a block beyond its saddle is lost


class EventFreeSteps(NamedTuple):
    """Sums over the pieces of a glide, from its start or since the errors were last applied."""

    goes: Flag  # the next piece may be free of events, too
    time: Scalar  # p t
    repulsion: Scalar  # integral over that time
    missed: Scalar  # sum of the squares of truncation errors [rad^2]
    opening: Scalar  # largest at ends of pieces
    speed: Scalar  # largest at ends of pieces
    steps: Int[Array, ""]  # taken before the glide
    low: Scalar  # a turn inward below this angle changes neither closeness nor peaks
    high: Scalar  # a turn outward above this angle changes no clearance, and is no graze

    @classmethod
    def of(cls, stepper: TaylorStepper, state: State) -> "EventFreeSteps":
        """Begin a glide."""
        zero = jnp.zeros_like(state.opening)
        moments: Any = stepper.on(state.side).scene.moments
        # So far from balance that the error of the state cannot matter (see `record_extrema`).
        doubt = 1.5 * stepper.doubt * MOST_OFF * moments.saddle
        pull = jnp.maximum(jnp.sqrt(state.closeness) * moments.restoring_at_rest, doubt)
        low = jnp.minimum(state.second, (moments.restoring_at_rest - pull) / moments.steepest)
        high = jnp.maximum(state.clearance, GRAZING * MOST_OFF * moments.saddle)
        begun = state.opening, jnp.abs(state.velocity), state.steps
        return cls(state.side != 0, zero, zero, zero, *begun, low, high)


def flush_error(stepper: TaylorStepper, state: State, glide: EventFreeSteps, strongest: Scalar) -> State:
    """Return the state with the errors that have grown in a glide; `strongest`: bound of the ground acceleration
    [g]."""
    time = glide.time
    count = (state.steps - glide.steps).astype(time.dtype)
    per_time = 1 / select(time > 0, time, 1.0)  # some pieces have zero length
    largest = replace(state, opening=glide.opening, velocity=glide.speed)
    angle, velocity = rounded(stepper, largest, strongest, time / jnp.maximum(count, 1.0))
    missed, faster = 4 * glide.missed, stepper.order * count * per_time
    spread = state.spread.plus_variance(missed + count * angle**2, missed * faster**2 + count * velocity**2)
    spread = spread.after_flow(glide.repulsion * per_time, time)
    return replace(state, spread=StateCovariance.where(supports_divergence(), spread, state.spread))  # else no glides


def onward(stepper: TaylorStepper, state: State, glide: EventFreeSteps) -> tuple[State, EventFreeSteps]:
    """Advance to the end of a piece, or part of the way, if certainly nothing is to be recorded; else not at all."""
    stepper = stepper.on(state.side)
    scene, moments = stepper.scene, stepper.scene.moments
    reach = TrialStep.of(stepper, state)
    start, opening = reach.start, reach.opening
    swing = reach.room * jnp.abs(start.speed)  # no turning point is farther away
    quiet = select(reach.slows, start.opening + swing <= glide.low, start.opening - swing >= glide.high)
    unnoted = reach.one_way | (reach.steady & quiet & ~state.beyond)
    asked = state.piece % _ESCAPES < (1 if scene.following is None else 2)  # two: `following` may skip a piece
    escapes = state.beyond & (start.speed > 0) & asked  # possibly; tested at intervals
    stays = (opening > 0) & ((opening >= moments.saddle) == state.beyond) & ~escapes
    rocks = (state.side != 0) & ~state.uplifting
    sure = rocks & reach.holds & reach.no_faster(state.fastest) & unnoted & stays
    if scene.falls_flat:
        sure = sure & (opening < jnp.pi / 2)

    def moved(new, old):
        return select(sure, new, old)

    velocity = reach.speed * (1 / start.stretch)
    now = jnp.abs(velocity)
    push, weight = start.shaking.now
    repulsion = moments.repulsion(start.angle, state.side * push, weight)
    piece, local, over = stepper.move_on(state, reach.room * reach.unit, reach.full)
    after = replace(
        state,
        piece=moved(piece, state.piece),
        local=moved(local, state.local),
        opening=moved(opening, state.opening),
        velocity=moved(velocity, state.velocity),
        fastest=select(sure & (now > state.fastest), now, state.fastest),
        done=sure & over & (not stepper.follows_free_stage),
        steps=state.steps + sure,
    )
    return after, glide._replace(
        goes=sure,
        time=moved(glide.time + reach.time, glide.time),
        repulsion=moved(glide.repulsion + reach.time * repulsion, glide.repulsion),
        missed=moved(glide.missed + reach.missed**2, glide.missed),
        opening=select(sure & (opening > glide.opening), opening, glide.opening),
        speed=select(sure & (now > glide.speed), now, glide.speed),
    )
