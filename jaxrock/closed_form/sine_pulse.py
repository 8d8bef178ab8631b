"""The linear block under one cycle of a sine: constants, limits of overturning, peaks, and the islands between them.

Everything is dimensionless: `intensity` is a_g/(g alpha), `frequency_ratio` is omega_g/p, times are p t counted from
*uplift*, rotations are over alpha and velocities over p alpha. The first excursion is to negative rotation.
Arguments broadcast; functions are smooth in all of them.

A block overturns without impact (case 2), after one impact that comes after the pulse (1.2) or while it lasts (1.1),
and, at frequency ratios below about 1, in further islands of intensity, after 3, 5, 7... impacts.

**Source:** Dimitrakopoulos & DeJong (2012), "D&D" below, corrected where `notebooks/errata` says so.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from jaxrock._arguments.repr import described
from jaxrock._core.types import Floats, RealLike
from jaxrock.closed_form import _sine_arcs as arcs, _sine_formulas as formulas
from jaxrock.closed_form._sine_formulas import elementwise_in_sine
from jaxrock.closed_form.sine_histories import (
    impact_velocity as impact_velocity,
    rotation as rotation,
    velocity as velocity,
)
from jaxrock.closed_form.sine_intervals import (
    OverturningIntervals as OverturningIntervals,
    overturning_intervals as overturning_intervals,
)
from jaxrock.closed_form.sine_limits import (
    after_pulse_limits as after_pulse_limits,
    approximate_during_pulse_limit as approximate_during_pulse_limit,
    during_pulse_limit as during_pulse_limit,
    impact_time_limit as impact_time_limit,
    no_impact_limit as no_impact_limit,
)
from jaxrock.numerics.roots import bracketed_root

__all__ = [
    "Constants", "OverturningIntervals", "after_pulse_limits", "approximate_during_pulse_limit",
    "approximate_impact_time", "constants", "during_pulse_limit", "first_peak", "impact_time",
    "impact_time_limit", "impact_velocity", "no_impact_limit", "overturning_intervals", "peak_after_pulse",
    "restitution_scale_law", "rotation", "velocity",
]  # fmt: skip


def __dir__() -> list[str]:
    return __all__


class Constants(eqx.Module):
    """The constants of D&D 3.9 (A0*, B0*, C0*, D0*), the phase psi at uplift, and the end p T_ex of the pulse."""

    __repr__ = described

    A0: Floats
    B0: Floats
    C0: Floats
    D0: Floats
    phase: Floats
    end: Floats


@elementwise_in_sine
def constants(intensity: RealLike, frequency_ratio: RealLike) -> Constants:
    """Constants in the formulas of the sine pulse.

    **Arguments:**

    - `intensity`: a_g/(g alpha), above 1.
    - `frequency_ratio`: omega_g/p, positive.

    **Source:** D&D 3.3, 3.7, 3.9 (D0* by its definition; the second line is printed with a factor to the wrong power).
    """
    a, w = intensity, frequency_ratio
    phase = arcs.uplift_phase(a)
    slope = jnp.sqrt((a - 1) * (a + 1))
    end = (2 * jnp.pi - phase) / w
    A0, B0, C0 = w * (w + slope) / (w**2 + 1), w * (w - slope) / (w**2 + 1), 2 * a / (w**2 + 1)
    decaying, growing = formulas.free_coordinates(A0, B0, C0, w, end)
    return Constants(A0, B0, C0, decaying * growing, phase, end)


@elementwise_in_sine
def impact_time(intensity: RealLike, frequency_ratio: RealLike) -> Floats:
    """Time at which the block first falls back to the ground, p t from uplift; inf where it overturns before.

    **Source:** D&D 3.21 (while the pulse lasts), 3.13 (after it).
    """
    return formulas.first_impact(intensity, frequency_ratio)


@elementwise_in_sine
def approximate_impact_time(intensity: RealLike, frequency_ratio: RealLike) -> Floats:
    """D&D's approximation of `impact_time` while the pulse lasts; NaN where the formula is not real.

    **Source:** D&D 3.29.
    """
    return formulas.approximate_impact(intensity, frequency_ratio)


@elementwise_in_sine
def peak_after_pulse(intensity: RealLike, frequency_ratio: RealLike, restitution: RealLike) -> Floats:
    """Largest rotation over alpha after the first impact, where that comes after the pulse.

    Exact between `impact_time_limit` and `no_impact_limit`. Below, the impact comes while the pulse lasts: the value is
    that of the formula (D&D draw it dashed), and predicts neither the peak nor overturning. The first excursion, before
    the impact, may be larger: see `first_peak`.

    **Returns:** inf where that impact overturns, and where the block overturns without one.

    **Source:** D&D 4.13, with D0* by its definition.
    """
    lost = _energy_after_impact(intensity, frequency_ratio, restitution)
    left = 1 - jnp.where(lost < 1, lost, 0.0)
    return jnp.where(lost < 1, 1 - jnp.sqrt(left), jnp.inf)


@elementwise_in_sine
def restitution_scale_law(intensity: RealLike, frequency_ratio: RealLike, restitution: RealLike) -> Floats:
    """`peak_after_pulse` for small peaks: proportional to the square of the restitution.

    **Returns:** inf where the block overturns without impact.

    **Source:** D&D 4.14 corrected: restitution^2 (1 - D0*)/2, without the square root that is printed.
    """
    return _energy_after_impact(intensity, frequency_ratio, restitution) / 2


def _energy_after_impact(a: Array, w: Array, e: Array) -> Array:
    """Return the energy after a first impact after the pulse, over that of balance: restitution^2 (1 - D0*).

    It is inf where no impact comes, which D0* does not show.
    """
    return jnp.where(a < formulas.no_impact(w), e**2 * (1 - formulas.coordinate_product(a, w)), jnp.inf)


@elementwise_in_sine
def first_peak(intensity: RealLike, frequency_ratio: RealLike) -> Floats:
    """Largest rotation over alpha before the first impact; inf where the block overturns without impact.

    **Source:** D&D 3.4, 3.5 where the velocity is zero.
    """
    a, w = intensity, frequency_ratio
    safe = a < formulas.no_impact(w)
    a = jnp.where(safe, a, (1 + formulas.no_impact(w)) / 2)
    end = formulas.end_of_pulse(a, w)
    outward = formulas.first_excursion(end, a, w)[1] > 0
    driving_ends = (jnp.pi - 2 * arcs.uplift_phase(a)) / w
    peak_while = bracketed_root(lambda t, a, w: formulas.first_excursion(t, a, w)[1], driving_ends, end, a, w)
    opening, speed = formulas.first_excursion(jnp.where(outward, end, peak_while), a, w)
    gap = (1 - opening - jnp.where(outward, speed, 0.0)) * (1 - opening + jnp.where(outward, speed, 0.0))
    free = 1 - jnp.sqrt(jnp.where(outward, gap, 1.0))
    return jnp.where(safe, jnp.where(outward, free, opening), jnp.inf)
