"""A block at rest: the wait until the ground uplifts it."""

import functools
import operator
from dataclasses import replace

import jax
import jax.numpy as jnp

from jaxrock._core.types import Flag, Scalar
from jaxrock.compiler.hints import select, stop_gradient
from jaxrock.engines.state import State
from jaxrock.engines.stepper import AbstractStepper
from jaxrock.models.equation import Angle
from jaxrock.motions.motion import is_of_several
from jaxrock.motions.shaking import Shaking
from jaxrock.numerics.derivatives_of import with_derivatives_of
from jaxrock.numerics.polynomial import Watch, first_event, longest, meet, step_length


def wait(
    stepper: AbstractStepper, state: State, shaking: Shaking, unit: Scalar, order: int, tolerance: float, branch
) -> State:
    """Advance a block at rest to the knot, or to the time at which the ground uplifts it (`branch`: see `when`)."""
    scene, eps = stepper.scene, jnp.finfo(state.local.dtype).eps
    room = stepper.room(state) / unit
    length = longest_wait(stepper, shaking, room, order, tolerance)
    never = scene.outlook.is_over(state.piece)
    # The state at rest does not depend on the length of a step: the length has no derivative.
    room, length = stop_gradient((room, select(jnp.isfinite(length), length, 0.0)))
    lasting = room > 0  # in a zero-length piece nothing happens
    zero = jnp.zeros_like(length)
    lifted, found = [], []
    # A constant ground is the same at any scale; powers of a long time would overflow.
    for drive, level in scene.drives_of(shaking.rescaled(select(_changes(shaking), length, 0.0))):
        held, high = stop_gradient((drive, level))
        slope = held[1] if len(held) > 1 else zero
        slack = 8 * eps * high
        touching = lasting & (jnp.abs(high - held[0]) <= slack)
        lifts = lasting & (high - held[0] < -slack) | (touching & (slope > 0))
        # A threshold that the drive touches at the start counts as passed only beyond rounding.
        least = high + select(touching, 2 * slack, 0.0)

        def search(found, needed, inside, held=held, least=least):
            series = [inside(c) for c in held] + [zero] * (2 - len(held))
            watch = Watch(0, -jnp.ones_like(zero), least, True)
            landing = first_event(series, [watch], zero, needed)
            return landing.x, landing.hits[0] & (landing.jet[1] > 0)

        # The comparison is negated, so that NaN takes the branch too and ends in a status.
        reachable = lasting & ~lifts & ~never & (state.side == 0) & ~(sum(jnp.abs(c) for c in held) < high)
        x, met = branch(reachable, search, (jnp.ones_like(length), jnp.zeros_like(lifts)))
        found.append((select(met, meet(x, drive, level), x), met, x))
        lifted.append((lifts, touching))
    (x, met, at), (x2, met2, at2) = found
    second = met2 & (~met | (at2 < at))
    met, early = met | met2, jnp.minimum(at, at2) < 1
    x = select(second, x2, select(met, x, jnp.minimum(at, at2)))
    full = (length >= room) & ~early
    piece, local, over = stepper.move_on(state, x * length * unit, full)
    piece = select(full & ~over & (not stepper.history), scene.after_quiet(piece), piece)
    waited = replace(state, piece=piece, local=local, done=over | (never & ~early))
    waited = lift(waited, select(second, -1.0, 1.0), met, met, zero > 0)
    (first, touching), (other, touching2) = lifted
    at_once = lift(state, select(first, 1.0, -1.0), first | other, select(first, touching, touching2), first | other)
    after = jax.tree.map(lambda a, b: select(first | other, a, b), at_once, waited)
    return _moved_by_ties(stepper, state, shaking, ~lasting, after) if is_of_several(scene.motion) else after


def _moved_by_ties(stepper: AbstractStepper, state: State, shaking: Shaking, tied: Flag, after: State) -> State:
    """Let a block at rest move with knots that coincide; between these nothing is lifted.

    Where the last of these knots lifts the block at once, the ground would lift it as soon as the knots part. The
    velocity of a block at rest therefore has a derivative, which ends with a wait that does not lift the block at once.
    """
    scene, eps = stepper.scene, jnp.finfo(state.local.dtype).eps
    velocity, zero = state.velocity, jnp.zeros_like(state.opening)
    push, weight = shaking.now
    gone = scene.p * stepper.room(state)
    eager = jnp.zeros_like(tied)
    for side, moments, (drive, level) in zip((1, -1), scene.both_moments, scene.drives_of(shaking)):
        lifts = tied & (drive[0] > level * (1 + 8 * eps))
        acceleration = moments.acceleration(Angle.of(zero), zero, side * push, weight)
        velocity = select(lifts, velocity + side * gone * acceleration, velocity)
        eager = eager | lifts
    return replace(
        after, velocity=select(eager, with_derivatives_of(stop_gradient(after.velocity), velocity), after.velocity)
    )


def longest_wait(stepper: AbstractStepper, shaking: Shaking, room: Scalar, order: int, tolerance: float) -> Scalar:
    """Return the time for which the series represent the ground motion, at most `room`."""
    length = room
    parts: list[tuple] = [(shaking.horizontal, stepper.scene.threshold), (shaking.vertical, 1.0)]
    for terms, scale in parts:
        if terms is not None and len(terms) > order:  # else a polynomial: exact
            cap = jnp.minimum(room, longest(len(terms), room.dtype))
            cap = select(_changes(shaking), cap, room)  # a constant needs no cap
            length = jnp.minimum(length, step_length(terms, tolerance * scale, cap))
    return length


def _changes(shaking: Shaking) -> Flag:
    """Return whether any Taylor coefficient of the ground acceleration after the first is nonzero."""
    later = [*shaking.horizontal[1:], *(shaking.vertical or [])[1:]]
    return functools.reduce(operator.or_, [c != 0 for c in later], jnp.zeros((), bool))


def lift(state: State, side: Scalar, lifts: Flag, continuous: Flag, at_once: Flag) -> State:
    """Leave rest to a side where `lifts`; `continuous`: with zero acceleration.

    Where uplift is `at_once`, the derivatives of the initial state continue, with the sign of that side. A wait ends
    them.
    """
    moving = select(at_once, side, 0.0)
    opening, velocity = (with_derivatives_of(stop_gradient(x), moving * x) for x in (state.opening, state.velocity))
    return replace(
        state,
        opening=opening,
        velocity=velocity,
        side=select(lifts, side, state.side),
        uplifting=select(lifts, continuous, state.uplifting),
        beyond=select(lifts, False, state.beyond),
        extremal=select(lifts, False, state.extremal),
    )
