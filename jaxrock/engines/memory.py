"""The memory of ties: how far the block has opened on either side, and whether a tie has broken."""

from dataclasses import replace
from typing import Any

import jax.numpy as jnp

from jaxrock._core.types import Flag
from jaxrock.compiler.hints import select, stop_gradient
from jaxrock.engines.state import State
from jaxrock.engines.stepper import AbstractStepper
from jaxrock.models.equation import Angle


def remembered(stepper: AbstractStepper, before: State, after: State) -> tuple[State, Flag]:
    """Return the state with what ties remember of a step, and whether a tie that broke lets the block go beyond its
    saddle.

    Angle and velocity are continuous where a tie breaks, but not the acceleration. An error in the angle there is an
    error in time, and so in the velocity.
    """
    assert before.reached is not None
    reached = before.reached.with_opening(before.side, after.opening)
    held: Any = stepper.scene.moments
    free = held.remembering(reached.on(before.side))
    breaks = free.has_broken & ~held.has_broken & (after.side != 0)
    beyond = select(breaks, after.opening >= free.saddle, after.beyond)
    angle, speed = stop_gradient((Angle.of(after.opening), jnp.abs(after.velocity)))
    tension = stop_gradient(select(breaks, free.largest_drop(angle), 0.0))
    kick = tension * after.spread.angle / jnp.maximum(speed, jnp.finfo(speed.dtype).tiny)
    lets_go = breaks & beyond & ~after.beyond
    spread = after.spread.plus(0.0, select(breaks, kick, 0.0))
    return replace(after, reached=reached, beyond=beyond, spread=spread), lets_go
