"""The impact: the one place where a block's state is reset, by its law of restitution.

The block goes on to its other side; a wall that opens to one side goes on to the same side again.

After an impact at speed v the block hops for 2 v/a, where a is the deceleration on that side. All hops to come last 2 v
(1/a + e'/a')/(1 - e e'), with a' and e' on the other side.

They are replaced by rest on two conditions:

- They certainly end before the forcing has changed by half of the weaker deceleration. Then all speeds stay below
  e^(1/2) those of constant forcing, and all hops end within four times that time.
- No hop is higher, faster or closer to overturning than the block has been. Beside ties with a memory, hops of rounding
  height may be closer.

Each hop is slower by e, so those above the rounding of alpha can be counted.
"""

import functools
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from jaxrock._core.types import Flag, Scalar
from jaxrock.compiler.hints import materialize_flag, select, stop_gradient
from jaxrock.engines.state import LARGE, State
from jaxrock.engines.stepper import AbstractStepper
from jaxrock.engines.uncertainty import StateCovariance
from jaxrock.models.equation import Angle
from jaxrock.numerics.elementary import logarithm


class _Rest(NamedTuple):
    """The impacts to come, where they bring the block to rest."""

    rests: Flag
    more: Int[Array, ""]  # down to hops of rounding height
    large: Int[Array, ""]  # of these, faster than a fall from `LARGE` alpha
    wait: Scalar  # time that they take [s]


class _Rebound(NamedTuple):
    """A block just after an impact, on its other side; a wall that opens to one side stays on it."""

    speed: Scalar  # outward, after the impact
    here: Scalar  # decelerations on its side,
    there: Scalar  # and on the side from which it came
    spread: StateCovariance


def impact(
    stepper: AbstractStepper, state: State, hit: Flag, speed: Scalar, ground: tuple, steepest: tuple, reach: Scalar
) -> State:
    """Go on after an impact, with the restitution; come to rest where the impacts to come no longer matter.

    `ground`: acceleration [g] and weight (`Shaking.at`). Within `reach` seconds from now the horizontal and vertical
    acceleration change by `steepest` [g/s] at most.
    """
    rebound = _rebound(stepper, state, speed, ground)
    slowed = hit & (rebound.there < 0)  # by the forcing, before the impact: otherwise it would have turned back
    depth = jax.lax.cond(
        slowed, lambda: speed**2 / (2 * select(slowed, -rebound.there, 1.0)), lambda: jnp.zeros_like(speed)
    )
    least = jnp.sqrt(2 * LARGE * stepper.scene.alpha * stepper.scene.moments.restoring_at_rest)
    rests, more, large, wait = _rests_if_soon(stepper, state, hit, rebound, steepest, reach, least)
    fastest = state.fastest
    if stepper.scene.far is not None:  # with unequal corners the rebound may be faster than the approach
        fastest = select(hit & (rebound.speed > fastest), rebound.speed, fastest)
    return replace(
        state,
        impacts=state.impacts + (hit & (speed < 0)) + more,
        large_impacts=state.large_impacts + (hit & (speed < -least)) + large,
        impact_time=select(hit, stepper.time(state), state.impact_time),
        impact_velocity=select(hit, state.side * speed, state.impact_velocity),
        side=select(rests, 0.0, select(hit, stepper.scene.next_side(state.side), state.side)),
        clearance=select(slowed, jnp.minimum(state.clearance, depth), state.clearance),
        fastest=fastest,
        opening=select(hit, 0.0, state.opening),
        velocity=select(rests, 0.0, select(hit, rebound.speed, state.velocity)),
        spread=StateCovariance.where(
            rests, StateCovariance.none(speed), StateCovariance.where(hit, rebound.spread, state.spread)
        ),
        local=state.local + wait,
        beyond=state.beyond & ~hit,
        uplifting=state.uplifting & ~hit,
        extremal=state.extremal & ~hit,
    )


def _rebound(stepper: AbstractStepper, state: State, speed: Scalar, ground: tuple) -> _Rebound:
    """Compute the state just after an impact at `speed` < 0."""
    scene, (moments, ahead), side = stepper.scene, stepper.scene.both_moments, stepper.scene.next_side(state.side)
    before = jnp.abs(speed)
    ratio = scene.reset.ratio(before)
    rebound, rest = ratio * before, Angle(jnp.zeros_like(speed), 0.0, 1.0)
    here = -ahead.acceleration(rest, rebound, side * ground[0], ground[1])
    there = -moments.acceleration(rest, speed, state.side * ground[0], ground[1])
    spread = state.spread.after_impact(speed, -there, -here, ratio, scene.reset.slope(before))
    return _Rebound(rebound, here, there, stop_gradient(spread))


def _rests_if_soon(
    stepper: AbstractStepper, state: State, hit: Flag, after: _Rebound, steepest: tuple, reach: Scalar, least: Scalar
) -> _Rest:
    """Call `_rests` only where the next hop is short enough for it."""
    given = stepper, state, hit, after, steepest, reach, least
    stepper, state, hit, after, steepest, reach, least = stop_gradient(given)
    # Zero speed counts as soon, unless the ground throws the block on at once; then it moves on as from any speed.
    soon = hit & (8 * after.speed <= reach * stepper.scene.p * after.here)

    def never():
        none = jnp.zeros_like(state.impacts)
        return _Rest(jnp.zeros_like(hit), none, none, jnp.zeros_like(reach))

    return jax.lax.cond(soon, lambda: _rests(stepper, state, soon, after, steepest, reach, least), never)


def _rests(
    stepper: AbstractStepper, state: State, hit: Flag, after: _Rebound, steepest: tuple, reach: Scalar, least: Scalar
) -> _Rest:
    """Return whether the impacts to come bring the block to rest, their number, and the time they take."""
    scene, rebound = stepper.scene, after.speed
    e, back = scene.reset.most(rebound), scene.far_reset.most(rebound)
    weaker = jnp.minimum(after.here, after.there)
    held = (weaker > 0) & (e * back < 1)
    here, there = select(held, after.here, 1.0), select(held, after.there, 1.0)
    remaining = 2 * rebound * (1 / here + back / there) / select(held, 1 - e * back, 1.0)
    window = 4 * remaining / scene.p
    change = functools.reduce(jnp.maximum, [m.change_at_rest(*steepest) for m in scene.different_moments])
    dies = held & (change * window <= weaker / 2) & (window <= reach)
    # Speed of a hop of rounding height; a history shows the hops down to that speed.
    low = jnp.sqrt(100 * jnp.finfo(scene.p.dtype).eps * scene.alpha * jnp.minimum(here, there))
    if stepper.history or scene.reset.depends_on_speed or scene.moments.is_damped:  # later speeds are unknown
        dies = dies & (rebound <= low)
    if not stepper.history:
        highest = 3 * rebound**2 * jnp.maximum(1 / here, back * back / there)
        fastest = 2 * rebound if scene.far is None else 2 * rebound * jnp.maximum(back, 1)
        dies = dies & (highest <= state.peak) & (fastest <= state.fastest)
        for moments in scene.different_moments:
            top = Angle.of(jnp.minimum(highest, moments.saddle))
            far_from_balance = (moments.fall(top) / moments.fall_at_rest) ** 2 >= state.closeness
            if moments.remembers:  # where a tie has broken, a block at rest may be closer to balance than ever before
                far_from_balance = far_from_balance | (rebound <= low)
            dies = dies & far_from_balance
    rests = materialize_flag(hit & (dies | (rebound == 0)), state.local)
    slower = e if scene.far is None else jnp.sqrt(e * back)  # mean ratio of speeds from hop to hop
    per_impact = logarithm(jnp.clip(slower, 1e-3, 1 - 1e-9))

    def above(limit):
        count = logarithm(limit / jnp.maximum(rebound, limit)) / per_impact
        return select(rests, jnp.ceil(count).astype(state.impacts.dtype), 0)

    return _Rest(rests, above(low), above(least), select(rests & (rebound > 0), remaining / scene.p, 0.0))
