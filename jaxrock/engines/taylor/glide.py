"""Gliding: pieces of a record into which no event can fall, in a small part of what a step takes.

Between two samples the opening angle is nearly a parabola. Where what is beyond that is too small to turn the block
back, or it turns where nothing is to be noted (below a peak that was higher, above a height that was lower), a piece is
its series, and nothing else: no root, no certificate. What errors grow to is told for all pieces of a glide together.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Inexact, Int

from jaxrock.engines.bookkeeping import MOST_OFF, rounded
from jaxrock.engines.state import State
from jaxrock.engines.taylor.careful import TaylorStepper
from jaxrock.engines.taylor.reach import Reach
from jaxrock.engines.uncertainty import GRAZING, Spread
from jaxrock.numerics.apart import lanes_part
from jaxrock.numerics.choice import where

Scalar = Inexact[Array, ""]
Flag = Bool[Array, ""]

_ESCAPES = 16  # pieces after which a block beyond its saddle is asked whether it is lost


class Glide(NamedTuple):
    """Pieces that a block has gone through since its errors were last told."""

    goes: Flag  # it is not known yet that the next piece needs care
    time: Scalar  # p t
    repulsion: Scalar  # integral over that time
    missed: Scalar  # sum of the squares of what the series left out [rad^2]
    opening: Scalar  # the largest between pieces
    speed: Scalar
    steps: Int[Array, ""]  # taken before it began
    low: Scalar  # a block that turns back below here is as far from balance as ever, and its peak no news
    high: Scalar  # nor is it news, or a graze, that a block turns outward above here

    @classmethod
    def of(cls, stepper: TaylorStepper, state: State) -> "Glide":
        """One that begins."""
        zero = jnp.zeros_like(state.opening)
        moments: Any = stepper.on(state.side).scene.moments  # `Coefficients`: this engine solves no others
        # Not so near to balance that it could matter how far off the state is (see `note`).
        doubt = 1.5 * stepper.doubt * MOST_OFF * moments.saddle
        pull = jnp.maximum(jnp.sqrt(state.closeness) * moments.restoring_at_rest, doubt)
        low = jnp.minimum(state.second, (moments.restoring_at_rest - pull) / moments.steepest)
        high = jnp.maximum(state.clearance, GRAZING * MOST_OFF * moments.saddle)
        begun = state.opening, jnp.abs(state.velocity), state.steps
        return cls(state.side != 0, zero, zero, zero, *begun, low, high)


def settled(stepper: TaylorStepper, state: State, glide: Glide, strongest: Scalar) -> State:
    """The state with what errors have grown to in a glide; `strongest`: acceleration of the ground [g]."""
    time = glide.time
    count = (state.steps - glide.steps).astype(time.dtype)
    per_time = 1 / where(time > 0, time, 1.0)  # there are pieces without a length
    largest = replace(state, opening=glide.opening, velocity=glide.speed)
    angle, velocity = rounded(stepper, largest, strongest, time / jnp.maximum(count, 1.0))
    least = 2 * stepper.rounding * stepper.scene.alpha
    missed, faster = 4 * glide.missed, stepper.order * count * per_time
    spread = state.spread.plus_variance(
        missed + count * (angle + least) ** 2, missed * faster**2 + count * (velocity + least) ** 2
    )
    spread = spread.after_flow(glide.repulsion * per_time, time)
    return replace(state, spread=Spread.where(lanes_part(), spread, state.spread))  # else there are no glides


def onward(stepper: TaylorStepper, state: State, glide: Glide) -> tuple[State, Glide]:
    """Go to the end of a piece, or part of the way, if it is certain that nothing is to be noted; else nowhere."""
    stepper = stepper.on(state.side)
    scene, moments = stepper.scene, stepper.scene.moments
    reach = Reach.of(stepper, state)
    start, opening = reach.start, reach.opening
    swing = reach.room * jnp.abs(start.speed)  # no turning point is further off
    quiet = where(reach.slows, start.opening + swing <= glide.low, start.opening - swing >= glide.high)
    unnoted = reach.one_way | (reach.steady & quiet & ~state.beyond)
    asked = state.piece % _ESCAPES < (1 if scene.following is None else 2)  # of two pieces one may be passed over
    escapes = state.beyond & (start.speed > 0) & asked  # perhaps: now and then
    stays = (opening > 0) & ((opening >= moments.saddle) == state.beyond) & ~escapes
    rocks = (state.side != 0) & ~state.uplifting
    sure = rocks & reach.holds & reach.no_faster(state.fastest) & unnoted & stays
    if scene.falls_flat:
        sure = sure & (opening < jnp.pi / 2)

    def moved(new, old):
        return where(sure, new, old)

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
        fastest=where(sure & (now > state.fastest), now, state.fastest),
        done=sure & over,
        steps=state.steps + sure,
    )
    return after, glide._replace(
        goes=sure,
        time=moved(glide.time + reach.time, glide.time),
        repulsion=moved(glide.repulsion + reach.time * repulsion, glide.repulsion),
        missed=moved(glide.missed + reach.missed**2, glide.missed),
        opening=where(sure & (opening > glide.opening), opening, glide.opening),
        speed=where(sure & (now > glide.speed), now, glide.speed),
    )
