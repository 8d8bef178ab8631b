"""Records of a response in progress: peaks, the distance from overturning, errors, and the status."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from jaxrock._core.types import Flag, Scalar
from jaxrock.compiler.hints import materialize, select, stop_gradient
from jaxrock.engines.state import Counts, State, surpasses
from jaxrock.engines.stepper import AbstractStepper
from jaxrock.engines.uncertainty import GRAZING, StateCovariance
from jaxrock.models.equation import Angle
from jaxrock.status import Status

MOST_OFF = 1e-2  # standard error over the saddle's angle beyond which a state is meaningless


def checked_step(stepper: AbstractStepper, before: State, after: State) -> State:
    """Count the step. Stop where the state is not finite.

    Where the error of the state is too large, the status is `undecided`, and the state goes on as one of the motions
    that this error allows: its error starts again from zero.
    """
    good = jnp.isfinite(after.opening) & jnp.isfinite(after.velocity) & jnp.isfinite(after.local)
    # Beyond its saddle a block moves away as fast as its error grows.
    allowed = MOST_OFF * jnp.maximum(jnp.abs(stepper.scene.moments.saddle), after.opening)
    lost = (after.side != 0) & ~(after.spread.square <= allowed**2)
    if not stepper.history:
        # In the free stage only the next peak or passage counts, which `record_extrema` judges.
        lost = lost & (before.piece < stepper.scene.pieces)
    undecided = lost & (after.status == Status.successful)
    if after.counts is not None:  # impacts of the free stage count only if the block overturns after them
        moving, now = before.piece < stepper.scene.pieces, Counts(after.impacts, after.large_impacts)
        after = replace(after, counts=jax.tree.map(lambda a, b: select(moving, a, b), now, before.counts))
    status = Status.where(undecided, Status.undecided, after.status)
    return replace(
        after,
        spread=StateCovariance.where(lost, StateCovariance.none(after.opening), after.spread),
        steps=before.steps + 1,
        status=Status.where(good, status, Status.not_finite),
        done=after.done | ~good,
    )


def escaped(stepper: AbstractStepper, state: State, angle: Angle) -> Flag:
    """Return whether no forcing still to come can bring the block back.

    The most helpful forcing is the bound of the forcing to come, applied for ever. The block is lost if it is past the
    stable manifold even then, and if nothing holds it here or further on.
    """
    moments = stepper.scene.moments
    ceiling, weight = stepper.scene.outlook.most_helpful(state.piece)
    hold = moments.held(angle, state.velocity, ceiling, weight)
    forced = angle, hold, ceiling, weight
    needed = select(hold > 0, moments.held_manifold(*forced), moments.unheld_manifold(*forced))
    certain = state.velocity - needed > stepper.doubt * state.spread.error_of(1.0, 1.0)
    return state.beyond & (state.velocity >= 0) & certain


def errors_after(
    stepper: AbstractStepper, state: State, angle: Angle, ground: tuple, elapsed: Scalar, step: tuple
) -> StateCovariance:
    """Return the errors after `elapsed` seconds of rocking, rounding included.

    `ground`: acceleration [g] and weight (`Shaking.at`); `step`: errors of angle and velocity [rad] that the engine's
    own approximation adds.
    """
    given = stepper, state, angle, ground, elapsed, step
    stepper, state, angle, (acceleration, weight), elapsed, step = stop_gradient(given)
    push = state.side * acceleration
    moments, time = stepper.scene.moments, stepper.scene.p * elapsed  # an error has no derivative
    of_angle, of_velocity = rounded(stepper, state, jnp.abs(push), time)
    spread = state.spread.after_flow(moments.repulsion(angle, push, weight), time)
    return spread.plus(step[0] + of_angle, step[1] + of_velocity)


def rounded(stepper: AbstractStepper, state: State, push: Scalar, time: Scalar) -> tuple[Scalar, Scalar]:
    """Return the errors of angle and velocity that rounding adds in a step of `time` (p t), for |ground acceleration|
    `push` [g]."""
    moments, p = stepper.scene.moments, stepper.scene.p
    eps, speed = 2 * jnp.finfo(p.dtype).eps, jnp.abs(state.velocity)
    clock = p * state.local  # the time of a state is rounded, too
    pull = eps * (moments.restoring_at_rest + push * moments.arm_at_rest)  # its terms may cancel
    of_angle = eps * (jnp.abs(state.opening) + speed * (time + clock)) + pull * time**2
    return of_angle, eps * speed + pull * (time + clock)


def record_extrema(
    stepper: AbstractStepper, state: State, outward, turning, crossing, opening, speed, acceleration
) -> State:
    """Update peaks, clearances and the closeness to standing still in balance (see `Outcome.margin`)."""
    moments = stepper.scene.moments
    # Take the larger acceleration, with or without the shaking. A block that the ground holds for an instant, far from
    # its saddle, is not in balance.
    pull = jnp.maximum(jnp.abs(acceleration), jnp.abs(moments.fall(Angle.of(opening))))
    per_rest = 1 / moments.fall_at_rest**2  # `keep` below has XLA compute the product once
    stillness = materialize((moments.stiffness * speed**2 + pull**2) * per_rest, state.local)
    turn = turning & (outward | state.beyond)
    closeness = select(turn, jnp.minimum(state.closeness, stillness), state.closeness)
    closeness = select(crossing, jnp.minimum(closeness, stillness), closeness)
    beyond = select(crossing, select(state.beyond, stillness, jnp.inf), state.closeness_beyond)
    beyond = select(turning & state.beyond, jnp.minimum(beyond, stillness), beyond)
    higher = turning & outward
    first = higher & surpasses(opening, state.peak)
    # A turn back just above the ground, within the error of the angle, may have been an impact.
    angle = state.spread.angle
    off = jnp.abs(opening) + angle
    grazing = turning & ~outward & (off <= GRAZING * angle)
    graze = select(grazing, 8 * jnp.abs(acceleration) * off, 0.0)
    # Standing still in balance, within the error of the state in the direction in which it leaves.
    balanced = (turning | crossing) & (speed**2 + pull**2 <= stepper.doubt**2 * state.spread.variance(1.0, 1.0))
    if stepper.scene.falls_flat:
        balanced = balanced | (higher & (jnp.abs(opening - jnp.pi / 2) <= stepper.doubt * angle))
    undecided = balanced & (state.status == Status.successful)
    highest = higher & (opening > state.peak)
    clearance = select(turning & ~outward, jnp.minimum(state.clearance, opening), state.clearance)
    return replace(
        state,
        peak=select(highest, opening, state.peak),
        second=select(higher, jnp.maximum(state.second, jnp.minimum(opening, state.peak)), state.second),
        clearance=clearance,
        peak_clearance=select(highest, clearance, state.peak_clearance),
        peak_time=select(first, stepper.time(state), state.peak_time),
        error=select(first, stop_gradient(angle), state.error),
        closeness=closeness,
        closeness_beyond=beyond,
        spread=stop_gradient(state.spread.plus_variance(0.0, graze)),
        status=Status.where(undecided, Status.undecided, state.status),
    )
