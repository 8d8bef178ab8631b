"""Gliding: pieces of a record into which no event can fall, in a small part of what a step takes.

Between two samples the opening angle is nearly a parabola. Where what is beyond that is too small to turn the block
back, a piece is its series, and nothing else: no root, no certificate, nothing to note. What errors grow to is told
for all pieces of a glide together.
"""

from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Inexact, Int

from jaxrock.engines.bookkeeping import rounded
from jaxrock.engines.state import State
from jaxrock.engines.taylor.careful import TaylorStepper
from jaxrock.engines.taylor.expansion import expand
from jaxrock.engines.uncertainty import Spread
from jaxrock.numerics.apart import lanes_part
from jaxrock.numerics.polynomial import horner
from jaxrock.numerics.xla_cpu import keep_by

Scalar = Inexact[Array, ""]
Flag = Bool[Array, ""]


class Glide(NamedTuple):
    """Pieces that a block has gone through since its errors were last told."""

    goes: Flag  # it is not known yet that the next piece needs care
    time: Scalar  # p t
    repulsion: Scalar  # integral over that time
    missed: Scalar  # sum of the squares of what the series left out [rad^2]
    opening: Scalar  # at the beginning
    velocity: Scalar
    steps: Int[Array, ""]  # taken up to there

    @classmethod
    def of(cls, state: State) -> "Glide":
        """One that begins."""
        zero = jnp.zeros_like(state.opening)
        return cls(state.side != 0, zero, zero, zero, state.opening, state.velocity, state.steps)


def settled(stepper: TaylorStepper, state: State, glide: Glide, strongest: Scalar) -> State:
    """The state with what errors have grown to in a glide; `strongest`: acceleration of the ground [g]."""
    time = glide.time
    count = (state.steps - glide.steps).astype(time.dtype)
    per_time = 1 / jnp.where(count > 0, time, 1.0)
    # Speeds on the way: those at the ends, or twice the mean where it gathers speed and loses it again.
    speed = jnp.abs(state.velocity) + jnp.abs(glide.velocity) + 2 * jnp.abs(state.opening - glide.opening) * per_time
    largest = replace(state, opening=jnp.maximum(state.opening, glide.opening), velocity=speed)
    angle, velocity = rounded(stepper, largest, strongest, time / jnp.maximum(count, 1.0))
    least = 2 * stepper.rounding * stepper.scene.alpha
    missed, faster = 4 * glide.missed, stepper.order * count * per_time
    spread = state.spread.plus_variance(
        missed + count * (angle + least) ** 2, missed * faster**2 + count * (velocity + least) ** 2
    )
    spread = spread.after_flow(glide.repulsion * per_time, time)
    return replace(state, spread=Spread.where(lanes_part(), spread, state.spread))  # else there are no glides


def onward(stepper: TaylorStepper, state: State, glide: Glide) -> tuple[State, Glide]:
    """Go to the end of a piece, or half way, if it is certain that nothing happens; else nowhere."""
    stepper = stepper.on(state.side)
    scene, order, moments = stepper.scene, stepper.order, stepper.scene.moments
    shaking, unit = stepper.shaking(state.piece, state.local)
    start = stepper.start(state, shaking, unit)
    one, series = start.one, expand(start, order)
    terms, speeds = series.opening, series.speed
    size = jnp.minimum(scene.alpha, jnp.abs(terms[0]) + jnp.abs(terms[1]))
    last = jnp.abs(terms[-1]) + jnp.abs(terms[-2]) + 0.02 * (jnp.abs(terms[-3]) + jnp.abs(terms[-4]))

    whole = stepper.room(state) * (1 / unit)
    full = last * whole**order <= stepper.tolerance * size
    room = keep_by(jnp.where(full, whole, 0.5 * whole), one)
    missed = last * room**order
    opening, speed = horner(terms, room), horner(speeds, room)

    # The acceleration is off its first value by no more than `change`, and the velocity off its chord by `bend`.
    change = room * horner([k * jnp.abs(c) for k, c in enumerate(speeds)][2:], room)
    bend = 0.5 * room * change
    first = jnp.abs(speeds[0])
    then = jnp.where(speeds[0] < 0, -1.0, 1.0) * (speeds[0] + room * speeds[1])
    turns_not = (first > bend) & (then > bend)
    fastest = state.fastest * start.stretch
    known = ((first + bend <= fastest) & (then + bend <= fastest)) | (jnp.abs(speeds[1]) > change)
    stays = (opening > 0) & ((opening >= moments.saddle) == state.beyond) & ~(state.beyond & (speeds[0] > 0))
    rocks = (state.side != 0) & ~state.uplifting & (room > 0)
    sure = rocks & turns_not & known & stays & (missed <= stepper.tolerance * size)
    if scene.falls_flat:
        sure = sure & (opening < jnp.pi / 2)

    def moved(new, old):
        return jnp.where(sure, new, old)

    time = room * start.stretch
    push, weight = shaking.now
    repulsion = moments.repulsion(start.angle, state.side * push, weight)
    piece, local, over = stepper.move_on(state, room * unit, full)
    after = replace(
        state,
        piece=moved(piece, state.piece),
        local=moved(local, state.local),
        opening=moved(opening, state.opening),
        velocity=moved(speed * (1 / start.stretch), state.velocity),
        fastest=jnp.where(sure & (jnp.abs(speed) > fastest), jnp.abs(speed) * (1 / start.stretch), state.fastest),
        done=sure & over,
        steps=state.steps + sure,
    )
    return after, glide._replace(
        goes=sure,
        time=moved(glide.time + time, glide.time),
        repulsion=moved(glide.repulsion + time * repulsion, glide.repulsion),
        missed=moved(glide.missed + missed * missed, glide.missed),
    )
