"""The free stage: the response after the ground has come to rest, from energy alone.

Velocities are per dimensionless time p t. With x half the angle that is missing to the saddle, the free equation is
dx/dtau = sqrt(sin^2 x - k^2). Its times are elliptic integrals of the first kind, or logarithms in the linear model.
Where a constant adds to the sinusoid, `skewed` computes them by quadrature. Peaks and verdicts follow from the energy.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from jaxrock._core.types import Flag, Scalar
from jaxrock.blocks.restitution import Reset
from jaxrock.compiler import MacroPrimitive
from jaxrock.compiler.hints import select
from jaxrock.engines.state import surpasses
from jaxrock.models import free_swing as skewed
from jaxrock.models.coefficients import Coefficients
from jaxrock.models.equation import Angle


class FreeStage(eqx.Module):
    """Result of a free stage; times and velocities per p t, angles in rad."""

    overturned: Bool[Array, ""]
    impacts: Int[Array, ""]  # before overturning; a safe block's infinitely many are not counted
    peak: Scalar  # largest opening angle still to come
    peak_time: Scalar
    peak_steepness: Scalar  # -2 (change of the energy with the peak)
    peak_share: Scalar  # share of an error of the present energy that remains in that of the peak
    fastest: Scalar  # largest speed still to come
    closeness: Scalar  # smallest squared distance from standing still in balance still to come
    deficit: Scalar  # 2 (energy of the saddle - energy) of the excursion that decides [rad^2]
    share: Scalar  # share of an error of the present energy that remains in `deficit`

    @classmethod
    def none(cls, like: Scalar) -> "FreeStage":
        """Return the result for a block that does not move."""
        zero, one, no = jnp.zeros_like(like), jnp.ones_like(like), jnp.zeros_like(like, bool)
        return cls(
            overturned=no,
            impacts=jnp.zeros_like(like, jnp.int32),
            peak=zero,
            peak_time=zero,
            peak_steepness=one,
            peak_share=one,
            fastest=zero,
            closeness=jnp.full_like(like, jnp.inf),
            deficit=jnp.full_like(like, jnp.inf),
            share=one,
        )


def carlson_rf(x: Scalar, y: Scalar, z: Scalar) -> Scalar:
    """Compute Carlson's elliptic integral R_F by duplication (Carlson 1979; DLMF 19.36.1)."""
    return _carlson_rf(x, y, z)[0]


def _carlson_rf_written(x, y, z):
    def doubled(carry):
        left, x, y, z = carry
        roots = jnp.sqrt(x), jnp.sqrt(y), jnp.sqrt(z)
        shift = roots[0] * roots[1] + roots[1] * roots[2] + roots[2] * roots[0]
        return left - 1, (x + shift) / 4, (y + shift) / 4, (z + shift) / 4

    start = 14, *jnp.broadcast_arrays(x, y, z)
    _, x, y, z = jax.lax.while_loop(lambda carry: carry[0] > 0, doubled, start)
    mean = (x + y + z) / 3
    dx, dy = 1 - x / mean, 1 - y / mean
    dz = -(dx + dy)
    e2, e3 = dx * dy - dz * dz, dx * dy * dz
    return [(1 - e2 / 10 + e3 / 14 + e2 * e2 / 24 - 3 * e2 * e3 / 44) / jnp.sqrt(mean)]


_carlson_rf = MacroPrimitive("carlson_rf", _carlson_rf_written)


def _time_to_peak(moments: Coefficients, gap: Scalar, manifold: Scalar, speed: Scalar) -> Scalar:
    """Return the time from opening angle saddle - gap, moving outward below the manifold, to the turning point."""
    if not moments.sinusoidal:
        return jnp.arctanh(speed / manifold)
    if moments.skew is not None:
        turn = skewed.turning_gap((manifold - speed) * (manifold + speed), moments.skew, moments.saddle)
        return skewed.time_to_turning(gap, speed, turn, moments.skew)
    deficit = (manifold - speed) * (manifold + speed)
    k = jnp.sqrt(jnp.maximum(deficit, skewed.least(deficit))) / 2
    tangent = speed / (2 * jnp.cos(gap / 2))
    ratio = tangent / k
    return ratio * carlson_rf(jnp.ones_like(k), 1 + tangent**2, 1 + ratio**2)


def _time_to_impact(moments: Coefficients, gap: Scalar, manifold: Scalar, speed: Scalar, base: Scalar, arrival: Scalar):
    """Return the time from opening angle saddle - gap, moving inward, to the impact at speed `arrival`."""
    if not moments.sinusoidal:
        return jnp.log((base + arrival) / (manifold + speed))

    def below():
        return _time_to_peak(moments, moments.saddle, base, arrival) - _time_to_peak(moments, gap, manifold, speed)

    def above():
        excess = (speed - manifold) * (speed + manifold)
        kappa = jnp.sqrt(jnp.maximum(excess, skewed.least(excess))) / 2

        def from_saddle(angle):
            if moments.skew is not None:
                return skewed.time_from_balance(angle, excess, moments.skew)
            tangent = jnp.tan(angle / 2)
            ratio = (tangent / kappa) ** 2 * (1 + kappa**2)
            return tangent / kappa * carlson_rf(jnp.ones_like(kappa), 1 + tangent**2, 1 + ratio)

        return from_saddle(moments.saddle) - from_saddle(gap)

    return jax.lax.cond(speed > jnp.abs(manifold), above, below)


class Visit(NamedTuple):
    """A stay on one side, until the impact that ends it."""

    moments: Coefficients
    reset: Reset  # the impact that ends the stay


def free_stage(
    visits: tuple[Visit, ...], opening: Scalar, velocity: Scalar, moving, known: Scalar, *, falls_flat: bool = False
) -> FreeStage:
    """Follow an unforced block to its end.

    **Arguments:**

    - `visits`: the sides on which it stands, the present one first: two for a symmetric block, three for an asymmetric
      one. The last decides nothing if the block moves outward now: it comes back to the same side with less energy.
    - `opening`: opening angle [rad], 0 or more.
    - `velocity`: its derivative with respect to p t [rad], positive outward.
    - `moving`: whether the block rocks at all; if not, nothing happens.
    - `known`: the largest opening angle so far [rad]: the time of a lower peak is not computed.
    - `falls_flat`: whether it overturns at pi/2, if a saddle lies beyond.

    **Returns:** a `FreeStage`.

    **Source:** the energy argument of Housner (1963); D&D (2012), 4.12 corrected.
    """
    present = _present(visits[0].moments, opening, velocity, moving, falls_flat, comes_back=len(visits) > 2)
    outward, share, lost, impacts = velocity > 0, jnp.ones_like(opening), present.lost, jnp.zeros_like(opening, int)
    arrival, found = present.arrival, [present]
    shares = [share]
    for i, visit in enumerate(visits[1:], 1):
        happens = moving & ~lost & ~outward if i == len(visits) - 1 else moving & ~lost
        reset = visits[i - 1].reset
        ratio = reset.ratio(arrival)
        rebound = ratio * arrival
        share = share * jnp.abs(ratio * reset.slope(arrival))  # share of a change of the energy
        stay = _after_impact(visit.moments, rebound, happens, falls_flat)
        lost, impacts = lost | stay.lost, select(stay.lost, i, impacts)
        arrival = rebound
        found.append(stay)
        shares.append(share)

    # Take the highest of several peaks, and the first of equal ones.
    zero = jnp.zeros_like(opening)
    peak, best, steepness, peak_share, highest = zero, known, jnp.ones_like(opening), share, []
    closeness = deficit = narrowest = jnp.full_like(opening, jnp.inf)
    decisive, fastest = share, jnp.zeros_like(opening)
    for stay, share in zip(found, shares):
        higher = stay.safe & surpasses(stay.peak, peak)
        highest.append(stay.safe & surpasses(stay.peak, best))
        best = select(highest[-1], stay.peak, best)
        steepness = select(higher, stay.steepness, steepness)
        peak_share = select(higher, share, peak_share)
        peak = select(stay.safe & (stay.peak > peak), stay.peak, peak)
        fastest = select(stay.safe, jnp.maximum(fastest, stay.arrival), fastest)
        closeness = select(stay.lost, stay.closeness, jnp.minimum(closeness, stay.closeness))
        # Compare the deficits in terms of the present energy.
        missing = jnp.abs(stay.deficit) / select(share > 0, share, 1.0)
        narrow = stay.decides & (missing < narrowest)
        deficit, decisive = select(narrow, stay.deficit, deficit), select(narrow, share, decisive)
        narrowest = select(narrow, missing, narrowest)

    def time():
        at = since = zero
        for stay, higher in zip(found, highest):
            top, since = stay.times(since)
            at = select(higher, top, at)
        return at

    # Elliptic integrals cost more than all the rest, and most peaks come before the free stage.
    peak_time = jax.lax.cond(functools.reduce(jnp.logical_or, highest), time, lambda: zero)
    return FreeStage(
        overturned=lost,
        impacts=impacts.astype(jnp.int32),
        peak=select(lost, 0.0, peak),
        peak_time=peak_time,
        peak_steepness=steepness,
        peak_share=peak_share,
        fastest=select(lost, 0.0, fastest),
        closeness=closeness,
        deficit=deficit,
        share=decisive,
    )


class _Stay(NamedTuple):
    """The motion of a block on one side in the free stage."""

    lost: Flag  # the block falls on this side
    safe: Flag  # the block moves on this side and comes back
    decides: Flag  # whether it falls here depends on its energy
    deficit: Scalar  # 2 (energy at which it falls - energy)
    peak: Scalar  # highest opening angle; zero if the block only comes back
    steepness: Scalar  # -2 (change of energy with the peak)
    closeness: Scalar
    arrival: Scalar  # speed at the impact that ends it
    times: Callable  # map the start time to the times of the peak and of the impact that ends it


def _peak_of(moments: Coefficients, deficit: Scalar) -> Scalar:
    """Return the opening angle at which a block turns back.

    `deficit`: 4 sin^2(half the angle to the saddle), or the square of that angle in the linear model.
    """
    if moments.skew is not None:
        return moments.saddle - skewed.turning_gap(deficit, moments.skew, moments.saddle)
    missing = jnp.sqrt(jnp.maximum(deficit, 0.0))
    return moments.saddle - (2 * jnp.arcsin(jnp.minimum(missing / 2, 1.0)) if moments.sinusoidal else missing)


def _weight(moments: Coefficients) -> Scalar:
    """Return the factor from squared velocities and accelerations, in units of the stiffness, to a closeness."""
    return (moments.stiffness / moments.restoring_at_rest) ** 2


def _turning_closeness(moments: Coefficients, gap2: Scalar, beyond: bool = False) -> Scalar:
    """Return the squared acceleration at a turning point over that at rest; gap2: 4 sin^2(half the angle to the
    saddle)."""
    if moments.skew is not None:
        skew, reach = (-moments.skew, jnp.pi / 2 - moments.saddle) if beyond else (moments.skew, moments.saddle)
        return _weight(moments) * skewed.moment(skewed.turning_gap(gap2, skew, reach), skew) ** 2
    shape = gap2 * (1 - gap2 / 4) if moments.sinusoidal else gap2
    return _weight(moments) * shape


def _steepness(moments: Coefficients, peak: Scalar) -> Scalar:
    return 2 * jnp.abs(moments.restoring(Angle.of(peak)))


def _flat(moments: Coefficients, falls_flat: bool) -> tuple[Scalar | float, Flag | bool]:
    """Return the `deficit` of lying flat below a saddle beyond pi/2, and whether the saddle is beyond."""
    if not falls_flat:
        return 0.0, False
    saddle = moments.saddle
    level = moments.manifold(jnp.full_like(saddle, jnp.pi / 2)) ** 2 / moments.stiffness
    return select(saddle > jnp.pi / 2, level, 0.0), saddle > jnp.pi / 2


def _present(
    moments: Coefficients, opening: Scalar, velocity: Scalar, moving: Flag, falls_flat: bool, comes_back: bool
) -> _Stay:
    """Compute the stay on the side where the block is when the motion ends; `comes_back`: whether its return
    matters."""
    level, flat = _flat(moments, falls_flat)
    rate = jnp.sqrt(moments.stiffness)
    gap, speed = moments.saddle - opening, velocity / rate
    manifold, base = moments.manifold(opening) / rate, moments.manifold(jnp.zeros_like(opening)) / rate
    deficit = (manifold - speed) * (manifold + speed)
    outward = speed > 0
    lost = moving & ((speed > manifold) | (flat & outward & (deficit < level)))
    safe = moving & ~lost
    arrival = jnp.sqrt(jnp.maximum(base**2 - deficit, 0.0))
    rises, falls = safe & outward, safe & ~outward

    def times(_):
        out = _time_to_peak(moments, gap, select(rises, manifold, base), select(rises, speed, 0.0))
        back = _time_to_peak(moments, moments.saddle, base, select(rises, arrival, 0.0)) if comes_back else jnp.inf
        falling = _time_to_impact(
            moments,
            select(falls, gap, moments.saddle),
            select(falls, manifold, base),
            select(falls, -speed, 0.0),
            base,
            select(falls, arrival, 0.0),
        )
        return out / rate, select(outward, out + back, falling) / rate

    # Closeness: crossing the saddle at a speed, or turning at an acceleration.
    crossing, turning = -deficit * _weight(moments), _turning_closeness(moments, jnp.abs(deficit))
    past_inward = (gap < 0) & (speed < 0)
    beyond = select(past_inward, _turning_closeness(moments, jnp.abs(deficit), beyond=True), jnp.inf)
    lost_closeness = select(gap > 0, crossing, beyond)
    safe_closeness = select(outward, turning, select(past_inward, crossing, jnp.inf))
    peak = _peak_of(moments, select(rises, deficit, base**2))
    lost_closeness = select(flat, jnp.inf, lost_closeness)
    return _Stay(
        lost=lost,
        safe=safe,
        decides=moving & (outward | past_inward),
        deficit=(deficit - level) * moments.stiffness,
        peak=select(rises, peak, 0.0),
        steepness=_steepness(moments, peak),
        closeness=select(lost, lost_closeness, select(safe, safe_closeness, jnp.inf)),
        arrival=arrival * rate,
        times=times,
    )


def _after_impact(moments: Coefficients, rebound: Scalar, happens: Flag, falls_flat: bool) -> _Stay:
    """Compute the stay on the side that the block enters by an impact, where that happens."""
    level, flat = _flat(moments, falls_flat)
    rate = jnp.sqrt(moments.stiffness)
    base, speed = moments.manifold(jnp.zeros_like(rebound)) / rate, rebound / rate
    deficit = (base - speed) * (base + speed)
    lost = happens & ((speed > base) | (flat & (deficit < level)))
    safe = happens & ~lost

    def times(since):
        out = _time_to_peak(moments, moments.saddle, base, select(safe, speed, 0.0)) / rate
        return since + out, since + 2 * out

    peak = _peak_of(moments, select(safe, deficit, base**2))
    turning = _turning_closeness(moments, jnp.abs(deficit))
    crossing = select(flat, jnp.inf, -deficit * _weight(moments))
    return _Stay(
        lost=lost,
        safe=safe,
        decides=happens,
        deficit=(deficit - level) * moments.stiffness,
        peak=peak,
        steepness=_steepness(moments, peak),
        closeness=select(lost, crossing, select(safe, turning, jnp.inf)),
        arrival=rebound,
        times=times,
    )
