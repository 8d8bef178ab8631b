"""The impact: the one place where a block's state is reset, by its law of restitution.

After an impact at speed v the block hops for 2 v/a, a the deceleration on that side; the hops to come last
2 v (1/a + e'/a')/(1 - e e'), with a' and e' on the other side. They are replaced by rest where it is certain
that they end before the forcing has changed by half of the weaker deceleration (so all speeds stay below
e^(1/2) those of constant forcing, and all hops end within four times that time), and that none is higher,
faster or closer to overturning than what has been. Each is slower by e, so those above the rounding of alpha
can be counted.
"""

import functools
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Inexact, Int

from jaxrock.engines.state import State
from jaxrock.engines.stepper import AbstractStepper
from jaxrock.engines.uncertainty import Spread
from jaxrock.models.equation import Angle
from jaxrock.numerics.choice import where
from jaxrock.numerics.elementary import logarithm
from jaxrock.numerics.fixed import fixed
from jaxrock.numerics.xla_cpu import keep_flag

Scalar = Inexact[Array, ""]
Flag = Bool[Array, ""]


class _Rebound(NamedTuple):
    """A block that has just come down on its other side."""

    speed: Scalar  # outward, after the impact
    here: Scalar  # decelerations there,
    there: Scalar  # and on the side that it came from
    spread: Spread


def impact(
    stepper: AbstractStepper, state: State, hit: Flag, speed: Scalar, ground: tuple, steepest: tuple, reach: Scalar
) -> State:
    """Change side with the restitution; come to rest where the impacts to come no longer matter.

    `ground`: acceleration [g] and weight (`Shaking.at`); for `reach` seconds from now horizontal and vertical
    acceleration change by `steepest` [g/s] at most.
    """
    rebound = _rebound(stepper, state, speed, ground)
    slowed = hit & (rebound.there < 0)  # by the forcing, before it hit the ground: else it would have turned back
    depth = jax.lax.cond(
        slowed, lambda: speed**2 / (2 * where(slowed, -rebound.there, 1.0)), lambda: jnp.zeros_like(speed)
    )
    rests, more, wait = _rests_if_soon(stepper, state, hit, rebound, steepest, reach)
    fastest = state.fastest
    if stepper.scene.far is not None:  # of corners of unequal height an impact may hasten it about one
        fastest = where(hit & (rebound.speed > fastest), rebound.speed, fastest)
    return replace(
        state,
        impacts=state.impacts + (hit & (speed < 0)) + more,
        impact_time=where(hit, stepper.time(state), state.impact_time),
        impact_velocity=where(hit, state.side * speed, state.impact_velocity),
        side=where(rests, 0.0, where(hit, -state.side, state.side)),
        clearance=where(slowed, jnp.minimum(state.clearance, depth), state.clearance),
        fastest=fastest,
        opening=where(hit, 0.0, state.opening),
        velocity=where(rests, 0.0, where(hit, rebound.speed, state.velocity)),
        spread=Spread.where(rests, Spread.none(speed), Spread.where(hit, rebound.spread, state.spread)),
        local=state.local + wait,
        beyond=state.beyond & ~hit,
        uplifting=state.uplifting & ~hit,
        extremal=state.extremal & ~hit,
    )


def _rebound(stepper: AbstractStepper, state: State, speed: Scalar, ground: tuple) -> _Rebound:
    """What follows an impact at `speed` < 0."""
    scene, (moments, ahead), side = stepper.scene, stepper.scene.both_moments, -state.side
    before = jnp.abs(speed)
    ratio = scene.reset.ratio(before)
    rebound, rest = ratio * before, Angle(jnp.zeros_like(speed), 0.0, 1.0)
    here = -ahead.acceleration(rest, rebound, side * ground[0], ground[1])
    there = -moments.acceleration(rest, speed, state.side * ground[0], ground[1])
    spread = state.spread.after_impact(speed, -there, -here, ratio, scene.reset.slope(before))
    return _Rebound(rebound, here, there, fixed(spread))


def _rests_if_soon(
    stepper: AbstractStepper, state: State, hit: Flag, after: _Rebound, steepest: tuple, reach: Scalar
) -> tuple[Flag, Int[Array, ""], Scalar]:
    """As `_rests`, which is not asked where the next hop alone takes too long for that."""
    given = stepper, state, hit, after, steepest, reach
    stepper, state, hit, after, steepest, reach = fixed(given)
    # Of no speed it is; unless the ground throws the block on at once, which then moves on as from any speed.
    soon = hit & (8 * after.speed <= reach * stepper.scene.p * after.here)

    def never():
        return jnp.zeros_like(hit), jnp.zeros_like(state.impacts), jnp.zeros_like(reach)

    return jax.lax.cond(soon, lambda: _rests(stepper, state, soon, after, steepest, reach), never)


def _rests(
    stepper: AbstractStepper, state: State, hit: Flag, after: _Rebound, steepest: tuple, reach: Scalar
) -> tuple[Flag, Int[Array, ""], Scalar]:
    """Whether a block comes to rest by the impacts to come, the number of these, and how long they take [s]."""
    scene, rebound = stepper.scene, after.speed
    e, back = scene.reset.most(rebound), scene.far_reset.most(rebound)
    weaker = jnp.minimum(after.here, after.there)
    held = (weaker > 0) & (e * back < 1)
    here, there = where(held, after.here, 1.0), where(held, after.there, 1.0)
    remaining = 2 * rebound * (1 / here + back / there) / where(held, 1 - e * back, 1.0)
    window = 4 * remaining / scene.p
    change = functools.reduce(jnp.maximum, [m.change_at_rest(*steepest) for m in scene.different_moments])
    dies = held & (change * window <= weaker / 2) & (window <= reach)
    # Speed of a hop of rounding height; a history shows the hops down to there.
    low = jnp.sqrt(100 * jnp.finfo(scene.p.dtype).eps * scene.alpha * jnp.minimum(here, there))
    if stepper.history or scene.reset.depends_on_speed:  # the ratios of later impacts are not known
        dies = dies & (rebound <= low)
    if not stepper.history:
        highest = 3 * rebound**2 * jnp.maximum(1 / here, back * back / there)
        fastest = 2 * rebound if scene.far is None else 2 * rebound * jnp.maximum(back, 1)
        dies = dies & (highest <= state.peak) & (fastest <= state.fastest)
        for moments in scene.different_moments:
            top = Angle.of(jnp.minimum(highest, moments.saddle))
            dies = dies & ((moments.restoring(top) / moments.restoring_at_rest) ** 2 >= state.closeness)
    rests = keep_flag(hit & (dies | (rebound == 0)), state.local)
    slower = e if scene.far is None else jnp.sqrt(e * back)  # from hop to hop, in the mean
    more = logarithm(low / jnp.maximum(rebound, low)) / logarithm(jnp.clip(slower, 1e-3, 1 - 1e-9))
    more = where(rests, jnp.ceil(more).astype(state.impacts.dtype), 0)
    return rests, more, where(rests & (rebound > 0), remaining / scene.p, 0.0)
