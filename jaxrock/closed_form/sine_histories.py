"""Histories under one cycle of a sine, from uplift to the second impact; terms and conventions as in `sine_pulse`."""

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxrock._core.types import Floats, RealLike
from jaxrock.closed_form import _sine_arcs as arcs, _sine_formulas as formulas
from jaxrock.closed_form._sine_formulas import elementwise_in_sine

_PIECES = 3  # after an impact during the pulse: before, within and after the second driving stretch


def rotation(time: RealLike, intensity: RealLike, frequency_ratio: RealLike, restitution: RealLike) -> Floats:
    """Rotation over alpha, from uplift over the first impact to the second.

    **Arguments:**

    - `time`: p t from uplift; before it the block stands.
    - `intensity`: a_g/(g alpha), above 1.
    - `frequency_ratio`: omega_g/p, positive.
    - `restitution`: of the first impact, in [0, 1].

    **Returns:** theta/alpha, negative up to the first impact; NaN after the second, where an engine is needed.

    **Raises:** ValueError for arguments outside their ranges.

    **Source:** D&D 3.4 and 3.5, with the constants of each stage of figure 2.
    """
    return _history(time, intensity, frequency_ratio, restitution)[0]


def velocity(time: RealLike, intensity: RealLike, frequency_ratio: RealLike, restitution: RealLike) -> Floats:
    """Angular velocity over p alpha, with the arguments of `rotation`; at an impact, that before it.

    **Source:** D&D 3.4 and 3.5; 3.11 at the end of the pulse.
    """
    return _history(time, intensity, frequency_ratio, restitution)[1]


@elementwise_in_sine
def impact_velocity(intensity: RealLike, frequency_ratio: RealLike) -> Floats:
    """Angular velocity over p alpha just before the first impact; NaN where the block overturns before.

    **Arguments:** as in `rotation`.

    **Source:** D&D 3.22 (while the pulse lasts), 3.14 and 3.15 (after it).
    """
    time = formulas.first_impact(intensity, frequency_ratio)
    known = jnp.isfinite(time)
    speed = formulas.impact_speed(jnp.where(known, time, 1.0), intensity, frequency_ratio)
    return jnp.where(known, speed, jnp.nan)


@elementwise_in_sine
def _history(
    time: RealLike, intensity: RealLike, frequency_ratio: RealLike, restitution: RealLike
) -> tuple[Floats, Floats]:
    """Return rotation and velocity, computed together."""
    a, w, e = intensity, frequency_ratio, restitution
    end, impact = formulas.end_of_pulse(a, w), formulas.first_impact(a, w)
    hits = jnp.isfinite(impact)
    # At an impact, too, the time derivative is that before it; `jnp.clip` would halve it at a tie.
    before = jnp.where(time > 0, jnp.where(time <= impact, time, impact), 0.0)
    first = _flight(before, end, arcs.start(a), a, w)
    impact = jnp.where(hits, impact, end)
    speed = jnp.where(hits, formulas.impact_speed(impact, a, w), 0.0)
    start = arcs.start(a)
    angle = start.angle + w * jnp.minimum(impact, end)
    after = arcs.Lane(angle, -start.side, start.opening, e * speed, start.impacts, impact >= end)
    left = jnp.maximum(end - impact, 0.0)
    second = _flight(jnp.maximum(time - impact, 0.0), left, after, a, w)
    known = time - impact <= _return(*jax.lax.stop_gradient((after, left, a, w, e)))
    rocks = hits & (time > impact)
    values = [jnp.where(rocks, jnp.where(known, late, jnp.nan), -early) for early, late in zip(first, second)]
    return values[0], values[1]


def _flight(since: Array, left: Array, lane: arcs.Lane, a: Array, w: Array) -> tuple[Array, Array]:
    """Return opening and speed at a time since `lane`: D&D 3.4 for the `left` part of the pulse, then 3.5."""
    lasts = since <= left
    opening, speed = arcs.opening_and_speed(jnp.where(lasts, since, left), lane, a, w)
    free = jnp.where(lasts, 0.0, since - left)
    sinh, cosh, rise = jnp.sinh(free), jnp.cosh(free), 2 * jnp.sinh(free / 2) ** 2
    return opening * cosh + speed * sinh - rise, opening * sinh + speed * cosh - sinh


def _return(lane: arcs.Lane, left: Array, a: Array, w: Array, e: Array) -> Array:
    """Return the time from `lane` to the block's return to the ground; inf where it overturns."""

    def further(_, carry):
        lane, hit = carry
        after, lands = arcs.piece(lane, a, w, e)
        going = ~(hit | lane.done)
        return jax.tree.map(lambda x, y: jnp.where(going, x, y), after, lane), hit | (going & lands)

    new, hit = jax.lax.fori_loop(0, _PIECES, further, (lane, jnp.zeros_like(lane.done)))
    outward = new.opening - 1 + new.speed  # the growing part of 3.5
    product = outward * (new.opening - 1 - new.speed)
    falls = outward < 0
    free = jnp.log((1 + jnp.sqrt(1 - jnp.where(falls, product, 0.0))) / jnp.where(falls, -outward, 1.0))  # as 3.13
    return jnp.where(hit, (new.angle - lane.angle) / w, jnp.where(falls, left + free, jnp.inf))
