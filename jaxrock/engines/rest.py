"""A block at rest: waiting for the ground to lift it."""

import functools
import operator
from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Inexact

from jaxrock.engines.state import State
from jaxrock.engines.stepper import AbstractStepper
from jaxrock.models.equation import Angle
from jaxrock.motions.motion import is_of_several
from jaxrock.motions.shaking import Shaking
from jaxrock.numerics.choice import where
from jaxrock.numerics.fixed import fixed
from jaxrock.numerics.polynomial import Watch, first_event, longest, meet, step_length
from jaxrock.transforms.differentiation import with_derivatives_of

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
    room, length = fixed((room, where(jnp.isfinite(length), length, 0.0)))
    lasting = room > 0  # in a piece without a length nothing happens
    zero = jnp.zeros_like(length)
    lifted, found = [], []
    # A ground that does not change is the same at any scale; powers of a long time would overflow.
    for drive, level in scene.drives_of(shaking.rescaled(where(_changes(shaking), length, 0.0))):
        held, high = fixed((drive, level))
        slope = held[1] if len(held) > 1 else zero
        slack = 8 * eps * high
        touching = lasting & (jnp.abs(high - held[0]) <= slack)
        lifts = lasting & (high - held[0] < -slack) | (touching & (slope > 0))
        # A threshold that is touched already counts as passed when it is left behind by more than rounding.
        least = high + where(touching, 2 * slack, 0.0)

        def search(found, needed, inside, held=held, least=least):
            series = [inside(c) for c in held] + [zero] * (2 - len(held))
            watch = Watch(0, -jnp.ones_like(zero), least, True)
            landing = first_event(series, [watch], zero, needed)
            return landing.x, landing.hits[0] & (landing.jet[1] > 0)

        # What is not a number is looked for, too: it ends in a status.
        reachable = lasting & ~lifts & ~never & (state.side == 0) & ~(sum(jnp.abs(c) for c in held) < high)
        x, met = branch(reachable, search, (jnp.ones_like(length), jnp.zeros_like(lifts)))
        found.append((where(met, meet(x, drive, level), x), met, x))
        lifted.append((lifts, touching))
    (x, met, at), (x2, met2, at2) = found
    second = met2 & (~met | (at2 < at))
    met, early = met | met2, jnp.minimum(at, at2) < 1
    x = where(second, x2, where(met, x, jnp.minimum(at, at2)))
    full = (length >= room) & ~early
    piece, local, over = stepper.move_on(state, x * length * unit, full)
    piece = where(full & ~over & (not stepper.history), scene.after_quiet(piece), piece)
    waited = replace(state, piece=piece, local=local, done=over | (never & ~early))
    waited = lift(waited, where(second, -1.0, 1.0), met, met, zero > 0)
    (first, touching), (other, touching2) = lifted
    at_once = lift(state, where(first, 1.0, -1.0), first | other, where(first, touching, touching2), first | other)
    after = jax.tree.map(lambda a, b: where(first | other, a, b), at_once, waited)
    return _moved_by_ties(stepper, state, shaking, ~lasting, after) if is_of_several(scene.motion) else after


def _moved_by_ties(stepper: AbstractStepper, state: State, shaking: Shaking, tied: Flag, after: State) -> State:
    """Between knots that come together nothing is lifted; but where the ground would lift the block there, and does so
    at the last of them, it does as soon as one of them goes. So the velocity of a block at rest has a derivative, which
    does not outlast a wait in which it is not lifted at once."""
    scene, eps = stepper.scene, jnp.finfo(state.local.dtype).eps
    velocity, zero = state.velocity, jnp.zeros_like(state.opening)
    push, weight = shaking.now
    gone = scene.p * stepper.room(state)
    eager = jnp.zeros_like(tied)
    for side, moments, (drive, level) in zip((1, -1), scene.both_moments, scene.drives_of(shaking)):
        lifts = tied & (drive[0] > level * (1 + 8 * eps))
        acceleration = moments.acceleration(Angle.of(zero), zero, side * push, weight)
        velocity = where(lifts, velocity + side * gone * acceleration, velocity)
        eager = eager | lifts
    return replace(after, velocity=where(eager, with_derivatives_of(fixed(after.velocity), velocity), after.velocity))


def longest_wait(stepper: AbstractStepper, shaking: Shaking, room: Scalar, order: int, tolerance: float) -> Scalar:
    """For how long the series tell what the ground does, at most `room`."""
    length = room
    parts: list[tuple] = [(shaking.horizontal, stepper.scene.threshold), (shaking.vertical, 1.0)]
    for terms, scale in parts:
        if terms is not None and len(terms) > order:  # else a polynomial: exact
            cap = jnp.minimum(room, longest(len(terms), room.dtype))
            cap = where(_changes(shaking), cap, room)  # zeros need none
            length = jnp.minimum(length, step_length(terms, tolerance * scale, cap))
    return length


def _changes(shaking: Shaking) -> Flag:
    """Whether the acceleration of the ground has more terms than its first."""
    later = [*shaking.horizontal[1:], *(shaking.vertical or [])[1:]]
    return functools.reduce(operator.or_, [c != 0 for c in later], jnp.zeros((), bool))


def lift(state: State, side: Scalar, lifts: Flag, continuous: Flag, at_once: Flag) -> State:
    """Leave rest to a side where `lifts`; `continuous`: with zero acceleration.

    Where that is `at_once` the state that was given at time 0 moves on, of one side; it does not outlast a wait.
    """
    moving = where(at_once, side, 0.0)
    opening, velocity = (with_derivatives_of(fixed(x), moving * x) for x in (state.opening, state.velocity))
    return replace(
        state,
        opening=opening,
        velocity=velocity,
        side=where(lifts, side, state.side),
        uplifting=where(lifts, continuous, state.uplifting),
        beyond=where(lifts, False, state.beyond),
        extremal=where(lifts, False, state.extremal),
    )
