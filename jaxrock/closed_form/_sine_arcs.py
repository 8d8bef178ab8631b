"""The linear block under one cycle of a sine, arc by arc: each arc in closed form, each impact a root in a bracket.

On one side the opening y (rotation over alpha, positive) obeys y'' = y - 1 - s a sin(angle). Where the right-hand side
without y has one sign, y has at most two zeros, because the operator y'' - y is disconjugate. So there is none inside a
restoring stretch that starts and ends above ground. In a stretch that drives the block outward there is at most one
dip, found at the zero of the velocity. So no impact is missed, however small.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Inexact, Int

from jaxrock._core.types import Floats
from jaxrock.compiler import elementwise
from jaxrock.numerics.roots import search_root

Given = Inexact[ArrayLike, "..."]

_MOST_PIECES = 4096


class Lane(eqx.Module):
    """State of the block; speeds are outward and per p t."""

    angle: Floats  # of the sine
    side: Floats  # of the rotation
    opening: Floats
    speed: Floats
    impacts: Int[Array, "..."]
    done: Bool[Array, "..."]


def opening_and_speed(time: Floats, lane: Lane, intensity: Floats, ratio: Floats) -> tuple[Floats, Floats]:
    """Return opening and speed at a time after `lane`; D&D 3.4, written so that nothing cancels."""
    push = lane.side * intensity / (1 + ratio**2)
    sine, cosine = push * jnp.sin(lane.angle), push * jnp.cos(lane.angle)
    phase = ratio * time
    sinh, cosh, rise = jnp.sinh(time), jnp.cosh(time), 2 * jnp.sinh(time / 2) ** 2
    turn = 2 * jnp.sin(phase / 2) ** 2
    opening = lane.opening * cosh + lane.speed * sinh - rise - sine * (rise + turn)
    opening -= cosine * (ratio * sinh - jnp.sin(phase))
    speed = lane.opening * sinh + lane.speed * cosh - sinh - sine * (sinh + ratio * jnp.sin(phase))
    speed -= cosine * ratio * (rise + turn)
    return opening, speed


def start(intensity: Floats) -> Lane:
    """Return the state at uplift, where the sine first reaches the threshold."""
    zero = jnp.zeros_like(intensity)
    count = jnp.zeros(intensity.shape, jnp.int32)
    return Lane(uplift_phase(intensity), zero - 1, zero, zero, count, zero > 0)


def uplift_phase(intensity: Floats) -> Floats:
    """Return psi, the phase of the sine at uplift; D&D 3.3."""
    return jnp.arctan2(1.0, jnp.sqrt((intensity - 1) * (intensity + 1)))


@elementwise(refill=True)  # some blocks take thousands of arcs, most only a few
def at_pulse_end(intensity: Given, ratio: Given, restitution: Given) -> Lane:
    """Return the state at the end of the pulse; not `done` where the impacts exceed the limit."""

    def going(carry):
        count, lane = carry
        return (count < _MOST_PIECES) & ~lane.done

    def step(carry):
        count, lane = carry
        return count + 1, _next(lane, intensity, ratio, restitution)

    return jax.lax.while_loop(going, step, (0, start(intensity)))[1]


def _next(lane: Lane, intensity: Floats, ratio: Floats, restitution: Floats) -> Lane:
    """Advance to the next impact or change of sign of the driving; a block at rest goes to its next uplift."""
    new, hit = piece(lane, intensity, ratio, restitution)
    return _rested(new, hit, intensity, ratio, restitution, uplift_phase(intensity))


def piece(lane: Lane, intensity: Floats, ratio: Floats, restitution: Floats) -> tuple[Lane, Bool[Array, "..."]]:
    """Advance to the next impact or change of sign of the driving; return the state, and whether it is an impact."""
    psi = uplift_phase(intensity)
    on, off = (jnp.where(lane.side < 0, angle, jnp.pi + angle) for angle in (psi, jnp.pi - psi))
    end = 2 * jnp.pi + 0 * psi
    edge = jnp.where(lane.angle < on, on, jnp.where(lane.angle < off, off, end))
    driven = (lane.angle >= on) & (lane.angle < off)
    span = (edge - lane.angle) / ratio
    opening, speed = opening_and_speed(span, lane, intensity, ratio)

    # The lowest point of a dip of a driven block: there its speed is zero.
    dips = driven & (lane.speed < 0) & (speed > 0)
    lowest = jax.lax.cond(
        jnp.any(dips),
        lambda: search_root(
            lambda t: opening_and_speed(t, lane, intensity, ratio)[1], 0 * span, jnp.where(dips, span, 0.0)
        ),
        lambda: span,
    )
    lowest = jnp.where(dips, lowest, span)
    down = opening_and_speed(lowest, lane, intensity, ratio)[0] <= 0
    hit = down & jnp.where(driven, lane.speed < 0, True)

    # After an impact, opening over time has no zero at the start.
    grounded = lane.opening == 0

    def height(time):
        value = opening_and_speed(time, lane, intensity, ratio)[0]
        divided = grounded & (time > 0)
        return jnp.where(divided, value / jnp.where(divided, time, 1.0), jnp.where(grounded, lane.speed, value))

    # A small hop lasts about 2 speed/restoring.
    hop = 2 * lane.speed / jnp.maximum(1 + lane.side * intensity * jnp.sin(lane.angle), 1e-30)
    after = jnp.where(hit, lowest, 0.0)
    early, late = jnp.where(grounded, 0.7 * hop, 0.0), jnp.where(grounded, 1.5 * hop, after)
    before = jnp.where((early < after) & (height(jnp.minimum(early, span)) > 0), early, 0.0)
    after = jnp.where((late < after) & (height(jnp.minimum(late, span)) <= 0), late, after)
    time = search_root(height, jnp.where(hit, before, 0.0), after)
    arrival = -opening_and_speed(time, lane, intensity, ratio)[1]
    landed = Lane(
        angle=lane.angle + ratio * time,
        side=-lane.side,
        opening=0 * opening,
        speed=jnp.maximum(restitution * arrival, 0.0),
        impacts=lane.impacts + 1,
        done=lane.done,
    )
    passed = Lane(edge, lane.side, jnp.maximum(opening, 0.0), speed, lane.impacts, edge >= end)
    return jax.tree.map(lambda a, b: jnp.where(hit, a, b), landed, passed), hit


def _rested(lane: Lane, hit, intensity: Floats, ratio: Floats, restitution: Floats, psi: Floats) -> Lane:
    """Advance a block to its next uplift, if it is at rest or will be before the ground can drive it."""
    sine = intensity * jnp.sin(lane.angle)
    # Lower bound of the restoring between the two driving stretches; hops end after 2 speed/(restoring (1 - e)).
    first = lane.angle < jnp.pi
    until = jnp.where(first, 2 * jnp.pi - lane.angle, (lane.angle + jnp.pi + psi) / 2)
    restoring = 1 - intensity * jnp.abs(jnp.sin(jnp.where(first, lane.angle, until)))
    room = (until - lane.angle) / ratio
    between = (lane.angle >= jnp.pi - psi) & (lane.angle < jnp.pi + psi)
    settles = between & (restoring > 0) & (4 * lane.speed < room * restoring * (1 - restitution))
    settles &= lane.speed < 0.1 * restoring
    at_rest = hit & (settles | (lane.speed == 0))
    again = jnp.where(jnp.abs(sine) > 1, lane.angle, jnp.pi + psi)
    # After the last driving stretch the ground only calms down: a slow block is safe.
    over = hit & (lane.angle >= 2 * jnp.pi - psi) & (lane.speed <= 0.5 * (1 + jnp.minimum(sine, 0.0)))
    return Lane(
        angle=jnp.where(at_rest, again, lane.angle),
        side=jnp.where(at_rest, jnp.where(sine > 1, -1.0, 1.0), lane.side),
        opening=lane.opening,
        speed=jnp.where(at_rest, 0.0, lane.speed),
        impacts=lane.impacts,
        done=lane.done | over,
    )


def growth(lane: Lane, restitution: float) -> np.ndarray:
    """Return a number that is positive where the block overturns after the pulse, at once or after one more impact.

    It is -1 where the block was not followed to the end.
    """
    directly = lane.opening + lane.speed - 1
    arrival = np.sqrt(np.maximum(lane.speed**2 + lane.opening * (2 - lane.opening), 0.0))
    return np.where(lane.done, np.maximum(directly, restitution * arrival - 1), -1.0)
