"""A block at rest: waiting for the ground to lift it."""

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Inexact

from jaxrock.engines.state import State
from jaxrock.engines.stepper import AbstractStepper
from jaxrock.motions.shaking import Shaking
from jaxrock.numerics.polynomial import Watch, first_event, meet, step_length

Scalar = Inexact[Array, ""]
Flag = Bool[Array, ""]


def wait(
    stepper: AbstractStepper, state: State, shaking: Shaking, unit: Scalar, order: int, tolerance: float, branch
) -> State:
    """At rest: go on to the knot, or to where the ground lifts the block (`branch`: see `when`)."""
    scene, eps = stepper.scene, jnp.finfo(state.local.dtype).eps
    room = stepper.room(state) / unit
    length = longest_wait(stepper, shaking, room, order, tolerance)
    never = scene.outlook.is_over(state.piece)
    # How far a step goes changes nothing: it has no derivative.
    room, length = jax.lax.stop_gradient((room, jnp.where(jnp.isfinite(length), length, 0.0)))
    zero = jnp.zeros_like(length)
    lifted, found = [], []
    for drive, level in scene.drives_of(shaking.rescaled(length)):
        fixed, high = jax.lax.stop_gradient((drive, level))
        slope = fixed[1] if len(fixed) > 1 else zero
        slack = 8 * eps * high
        touching = jnp.abs(high - fixed[0]) <= slack
        lifts = (high - fixed[0] < -slack) | (touching & (slope > 0))
        # A threshold that is touched already counts as passed when it is left behind by more than rounding.
        least = high + jnp.where(touching, 2 * slack, 0.0)

        def search(found, needed, inside, fixed=fixed, least=least):
            series = [inside(c) for c in fixed] + [zero] * (2 - len(fixed))
            watch = Watch(0, -jnp.ones_like(zero), least, True)
            landing = first_event(series, [watch], zero, needed)
            return landing.x, landing.hits[0] & (landing.jet[1] > 0)

        reachable = ~lifts & ~never & (state.side == 0) & (sum(jnp.abs(c) for c in fixed) >= high)
        x, met = branch(reachable, search, (jnp.ones_like(length), jnp.zeros_like(lifts)))
        found.append((jnp.where(met, meet(x, drive, level), x), met, x))
        lifted.append((lifts, touching))
    (x, met, at), (x2, met2, at2) = found
    second = met2 & (~met | (at2 < at))
    met, early = met | met2, jnp.minimum(at, at2) < 1
    x = jnp.where(second, x2, jnp.where(met, x, jnp.minimum(at, at2)))
    full = (length >= room) & ~early
    piece, local, over = stepper.move_on(state, x * length * unit, full)
    piece = jnp.where(full & ~over & (not stepper.history), scene.after_quiet(piece), piece)
    waited = replace(state, piece=piece, local=local, done=over | (never & ~early))
    waited = lift(waited, jnp.where(second, -1.0, 1.0), met, met)
    (first, touching), (other, touching2) = lifted
    at_once = lift(state, jnp.where(first, 1.0, -1.0), first | other, jnp.where(first, touching, touching2))
    return jax.tree.map(lambda a, b: jnp.where(first | other, a, b), at_once, waited)


def longest_wait(stepper: AbstractStepper, shaking: Shaking, room: Scalar, order: int, tolerance: float) -> Scalar:
    """For how long the series tell what the ground does, at most `room`."""
    length = room
    parts: list[tuple] = [(shaking.horizontal, stepper.scene.threshold), (shaking.vertical, 1.0)]
    for terms, scale in parts:
        if terms is not None and len(terms) > order:  # else a polynomial: exact
            length = jnp.minimum(length, step_length(terms, tolerance * scale, room))
    return length


def lift(state: State, side: Scalar, lifts: Flag, continuous: Flag) -> State:
    """Leave rest to a side where `lifts`; `continuous`: with zero acceleration."""
    return replace(
        state,
        side=jnp.where(lifts, side, state.side),
        uplifting=jnp.where(lifts, continuous, state.uplifting),
        beyond=jnp.where(lifts, False, state.beyond),
        extremal=jnp.where(lifts, False, state.extremal),
    )
