"""The free stage by steps: when a block that the ground no longer moves is certainly safe."""

from dataclasses import replace
from typing import Any

import jax.numpy as jnp

from jaxrock._core.types import Flag
from jaxrock.engines.state import State
from jaxrock.engines.stepper import AbstractStepper
from jaxrock.models.equation import Angle

_MANY_SWINGS = 20.0  # p t in which a block that leans on a tie has come closest to balance, and farthest from it


def settled(stepper: AbstractStepper, before: State, after: State) -> State:
    """Return the state, done where a step has turned a block that can only lose energy from now on.

    After the motion a block that has fallen back and turned below its saddle is safe. Of unequal sides, or ties that
    may hold one side and not the other, the other side must be unable to let it fall, too.
    """
    if not stepper.follows_free_stage:
        return after
    quiet = (before.piece >= stepper.scene.pieces) & (after.side != 0)
    turned = quiet & (before.velocity >= 0) & (after.velocity <= 0) & ~after.beyond & (after.opening > 0)
    back = after.impact_time > stepper.scene.motion.end
    if stepper.scene.moments.remembers:  # a tie may hold a block that leans on it, and swings for ever
        back = back | (after.local * stepper.scene.p > _MANY_SWINGS)
    turned = turned & back
    if stepper.scene.far is not None or stepper.scene.moments.remembers:
        turned = turned & _outdone(stepper, after)
    return replace(after, done=after.done | turned)


def _outdone(stepper: AbstractStepper, state: State) -> Flag:
    """Return whether a block that has turned back can neither fall on the other side, nor come higher or closer to
    balance there: its energy is too small to reach some angle below all that, or to leave this side."""
    scene = stepper.at(state).scene
    far: Any = scene.both_moments[1]
    if state.reached is not None:
        far = far.remembering(state.reached.on(stepper.scene.next_side(state.side)))
    here: Any = scene.moments
    whole = here.work(state.opening)
    left = scene.reset.most(jnp.sqrt(2 * whole)) ** 2 * whole
    outdone = jnp.zeros_like(state.done)
    if here.remembers:  # it leans on a tie, and cannot swing back over the balance that it has without the tie
        inner = here.free.saddle
        outdone = (state.opening > inner) & (here.work(inner) > whole)
    for share in (0.999, 0.7, 0.4, 0.1):
        opening = share * jnp.minimum(state.peak, far.saddle)
        least = (far.fall(Angle.of(opening)) / far.fall_at_rest) ** 2
        outdone = outdone | ((left < far.work(opening)) & (least >= state.closeness))
    return outdone
