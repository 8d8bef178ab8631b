"""The free stage: what a rocking block does after the ground has come to rest, by energy alone.

Velocities are per dimensionless time p t. With x half the angle that is missing to the saddle, the free
equation is dx/dtau = sqrt(sin^2 x - k^2): its times are elliptic integrals of the first kind (logarithms
in the linear model), its peaks and verdicts follow from the energy.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Inexact, Int

from jaxrock.models import Table

Scalar = Inexact[ArrayLike, ""]


class FreeStage(eqx.Module):
    """Result of a free stage; times and velocities per p t, angles in rad."""

    overturned: Bool[Array, ""]
    impacts: Int[Array, ""]  # before overturning; a safe block's infinitely many are not counted
    peak: Scalar  # largest opening angle still to come
    peak_time: Scalar
    fastest: Scalar  # largest speed still to come
    closeness: Scalar  # smallest squared distance from standing still in balance still to come
    deficit: Scalar  # 2 (energy of the saddle - energy) of the excursion that decides [rad^2]
    share: Scalar  # of an error of the present energy that is left in it

    @classmethod
    def none(cls, like: Scalar) -> "FreeStage":
        """Of a block that does not move."""
        zero, one, no = jnp.zeros_like(like), jnp.ones_like(like), jnp.zeros_like(like, bool)
        return cls(no, jnp.zeros_like(like, jnp.int32), zero, zero, zero, jnp.full_like(like, jnp.inf), zero, one)


def carlson_rf(x: Scalar, y: Scalar, z: Scalar) -> Scalar:
    """Carlson's elliptic integral R_F by duplication (Carlson 1979; DLMF 19.36.1)."""
    for _ in range(14):
        roots = jnp.sqrt(x), jnp.sqrt(y), jnp.sqrt(z)
        shift = roots[0] * roots[1] + roots[1] * roots[2] + roots[2] * roots[0]
        x, y, z = (x + shift) / 4, (y + shift) / 4, (z + shift) / 4
    mean = (x + y + z) / 3
    dx, dy = 1 - x / mean, 1 - y / mean
    dz = -(dx + dy)
    e2, e3 = dx * dy - dz * dz, dx * dy * dz
    return (1 - e2 / 10 + e3 / 14 + e2 * e2 / 24 - 3 * e2 * e3 / 44) / jnp.sqrt(mean)


def _time_to_peak(table: Table, gap: Scalar, manifold: Scalar, speed: Scalar) -> Scalar:
    """Time from opening angle saddle - gap, moving outward below the manifold, to the turning point."""
    if not table.sinusoidal:
        return jnp.arctanh(speed / manifold)
    k = jnp.sqrt(jnp.maximum((manifold - speed) * (manifold + speed), 1e-280)) / 2
    tangent = speed / (2 * jnp.cos(gap / 2))
    ratio = tangent / k
    return ratio * carlson_rf(jnp.ones_like(k), 1 + tangent**2, 1 + ratio**2)


def _time_to_impact(table: Table, gap: Scalar, manifold: Scalar, speed: Scalar, base: Scalar, arrival: Scalar):
    """Time from opening angle saddle - gap, moving inward, to the impact at speed `arrival`."""
    if not table.sinusoidal:
        return jnp.log((base + arrival) / (manifold + speed))
    below = _time_to_peak(table, table.saddle, base, arrival) - _time_to_peak(table, gap, manifold, speed)

    kappa = jnp.sqrt(jnp.maximum((speed - manifold) * (speed + manifold), 1e-280)) / 2

    def from_saddle(angle):
        tangent = jnp.tan(angle / 2)
        ratio = (tangent / kappa) ** 2 * (1 + kappa**2)
        return tangent / kappa * carlson_rf(jnp.ones_like(kappa), 1 + tangent**2, 1 + ratio)

    above = from_saddle(table.saddle) - from_saddle(gap)
    return jnp.where(speed > jnp.abs(manifold), above, below)


def free_stage(table: Table, restitution: Scalar, opening: Scalar, velocity: Scalar, moving) -> FreeStage:
    """Follow an unforced block to its end.

    **Arguments:**

    - `opening`: opening angle [rad], 0 or more.
    - `velocity`: its derivative with respect to p t [rad], positive outward.
    - `moving`: whether the block rocks at all; if not, nothing comes.

    **Returns:** a `FreeStage`.

    **Source:** the energy argument of Housner (1963); D&D (2012), 4.12 corrected.
    """
    rate = jnp.sqrt(table.stiffness)
    weight = table.stiffness / table.restoring_at_rest**2  # velocity^2 to closeness
    gap = table.saddle - opening
    speed = velocity / rate
    manifold, base = table.manifold(opening) / rate, table.manifold(jnp.zeros_like(opening)) / rate
    deficit = (manifold - speed) * (manifold + speed)  # 2 (energy of the saddle - energy)

    def turning_closeness(gap2):
        """Squared acceleration at a turning point over that at rest; gap2: 4 sin^2(half the angle to the saddle)."""
        return weight * table.stiffness * (gap2 * (1 - gap2 / 4) if table.sinusoidal else gap2)

    def peak_of(deficit):
        missing = jnp.sqrt(jnp.maximum(deficit, 0.0))
        return table.saddle - (2 * jnp.arcsin(jnp.minimum(missing / 2, 1.0)) if table.sinusoidal else missing)

    lost_at_once = moving & (speed > manifold)
    outward = speed > 0
    arrival2 = jnp.maximum(base**2 - deficit, 0.0)  # squared speed at the next impact
    arrival = jnp.sqrt(arrival2)
    rebound = restitution * arrival
    lost_after_impact = moving & ~lost_at_once & ~outward & (rebound > base)

    # Peak: of this excursion if it is outward, else of the one after the impact.
    deficit_after = (base - rebound) * (base + rebound)
    peak_deficit = jnp.where(outward, deficit, deficit_after)
    swings = moving & ~lost_at_once & ~lost_after_impact
    safe_speed = jnp.where(swings & outward, speed, 0.0)
    safe_manifold = jnp.where(swings & outward, manifold, base)
    time_out = _time_to_peak(table, gap, safe_manifold, safe_speed)
    falling = swings & ~outward
    inward = jnp.where(falling, -speed, 0.0)
    time_in = _time_to_impact(
        table,
        jnp.where(falling, gap, table.saddle),
        jnp.where(falling, manifold, base),
        inward,
        base,
        jnp.where(falling, arrival, 0.0),
    ) + _time_to_peak(table, table.saddle, base, jnp.where(falling, rebound, 0.0))

    # Closeness: crossing the saddle at a speed, or turning at an acceleration.
    crossing = -deficit * weight
    turning = turning_closeness(jnp.abs(peak_deficit))
    past_inward = (gap < 0) & (speed < 0)
    lost_closeness = jnp.where(gap > 0, crossing, jnp.where(past_inward, turning_closeness(jnp.abs(deficit)), jnp.inf))
    safe_closeness = jnp.where(past_inward, jnp.minimum(crossing, turning), turning)
    closeness = jnp.where(
        lost_at_once,
        lost_closeness,
        jnp.where(lost_after_impact, -deficit_after * weight, jnp.where(swings, safe_closeness, jnp.inf)),
    )
    impacts_first = ~lost_at_once & ~outward
    turns_inside = past_inward & (jnp.abs(deficit) < jnp.abs(deficit_after))  # it has to pass the saddle first
    decisive = jnp.where(impacts_first & ~turns_inside, deficit_after, deficit)
    return FreeStage(
        overturned=lost_at_once | lost_after_impact,
        impacts=lost_after_impact.astype(jnp.int32),
        peak=jnp.where(swings, peak_of(peak_deficit), 0.0),
        peak_time=jnp.where(outward, time_out, time_in) / rate,
        fastest=jnp.where(swings, arrival * rate, 0.0),
        closeness=closeness,
        deficit=decisive * table.stiffness,
        share=jnp.where(impacts_first & ~turns_inside, restitution**2, 1.0),
    )
