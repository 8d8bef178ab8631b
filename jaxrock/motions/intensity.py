"""Intensity measures of ground motions: peaks, integrals over time, response spectra, and measures of rocking.

`peak_acceleration`, `peak_velocity` and their ratios to a block's values are functions of JAX. The others take known
motions and use NumPy and SciPy. They are exact for records (straight lines between samples), and within about 1e-7 for
pulses. A pulse of thousands of cycles is sampled as finely as one cycle. Pulses of more than 5,000 cycles are refused,
and under tracing those of more than 20. Quiet within a motion costs nothing. g is 9.81 m/s^2.
"""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Inexact

from jaxrock._arguments.annotations import arguments
from jaxrock._arguments.parameters import check_single
from jaxrock._arguments.ranges import below_one, checked, inner_share, scalar
from jaxrock._core.arrays import Values, is_traced
from jaxrock._core.one_program import check_known
from jaxrock._core.precision import frames_of_the_package
from jaxrock.blocks.rigid import GRAVITY, Block
from jaxrock.motions.fourier import squared_amplitudes
from jaxrock.motions.motion import AbstractMotion
from jaxrock.motions.oscillator import peaks_of_oscillator
from jaxrock.motions.peaks import peaks_and_last_velocity
from jaxrock.motions.piecewise_linear import PiecewiseLinear, piecewise_linear
from jaxrock.motions.record import Record

__all__ = [
    "arias", "average_spectral_acceleration", "cumulative_absolute_velocity", "mean_period",
    "peak_acceleration", "peak_displacement", "peak_velocity", "significant_duration", "spectral_acceleration",
    "spectral_velocity", "uplift_ratio", "velocity_ratio", "velocity_to_acceleration",
]  # fmt: skip


def __dir__() -> list[str]:
    return __all__


_LONG = 100  # samples; a longer record is checked for drift, a shorter one may be a pulse


@arguments
def peak_acceleration(motion: AbstractMotion) -> Inexact[Array, ""]:
    """Peak ground acceleration (PGA) [g].

    **Arguments:**

    - `motion`: a motion of scalar parameters (use `jax.vmap` for many).

    **Returns:** the largest |acceleration|: exact for records and straight lines, to about 1e-9 for smooth pulses.

    **Raises:** ValueError for a motion of too many cycles within a piece.
    """
    check_single(motion=motion)
    return peaks_and_last_velocity(motion)[0]


@arguments
def peak_velocity(motion: AbstractMotion) -> Inexact[Array, ""]:
    """Peak ground velocity (PGV) [m/s] of a ground that starts from rest, with g = 9.81 m/s^2.

    **Arguments:**

    - `motion`: as in `peak_acceleration`; a record should have been corrected so that its velocity ends near zero.

    **Returns:** the largest |velocity|: exact for records and straight lines, to about 1e-9 for smooth pulses.

    A record of 100 samples or more whose last velocity exceeds a quarter of the peak raises a warning: its baseline
    drifts.
    """
    check_single(motion=motion)
    peak, last = peaks_and_last_velocity(motion)[1:]
    known = not isinstance(peak, jax.core.Tracer)
    if known and _is_long(motion) and abs(float(last)) > float(peak) / 4:
        _warn_of_drift(motion, f"ends with {abs(float(last)):.3g} m/s, its peak is {float(peak):.3g} m/s")
    return peak


def _is_long(motion: AbstractMotion) -> bool:
    return isinstance(motion, Record) and motion.samples.size >= _LONG


def _warn_of_drift(motion: AbstractMotion, how: str) -> None:
    name = motion.name if isinstance(motion, Record) and motion.name else "a record"
    warnings.warn(
        f"The ground of {name} {how}: its baseline drifts. See `jaxrock.processing`.",
        stacklevel=frames_of_the_package() + 1,
    )


@arguments
def peak_displacement(motion: AbstractMotion) -> float:
    """Peak ground displacement (PGD) [m] of a ground that starts from rest.

    **Arguments:**

    - `motion`: one known motion; a record needs a correction of its baseline.

    **Returns:** the largest |displacement|, also between samples.

    A record of 100 samples or more whose last displacement exceeds half of the peak raises a warning: its baseline
    drifts. (A fault may have moved the ground.)

    **Raises:** ValueError for a motion of too many cycles within its pieces.
    """
    lines = piecewise_linear(motion)
    velocity, places = lines.velocity[:-1], lines.displacement
    largest = np.abs(places).max(initial=0.0)
    # Within a line, the velocity v + a t + j t^2/2 passes zero at these times, also from rest.
    slope = (lines.end - lines.begin) / lines.length
    root = np.sqrt(np.maximum(lines.begin**2 - 2 * slope * velocity, 0.0))
    lead = lines.begin + np.copysign(root, lines.begin)
    with np.errstate(all="ignore"):
        times = -2 * velocity / lead, -lead / slope
    for time in times:
        time = np.where((time > 0) & (time < lines.length), time, 0.0)
        there = places[:-1] + velocity * time + lines.begin * time**2 / 2 + slope * time**3 / 6
        largest = max(largest, np.abs(there).max(initial=0.0))
    last = abs(float(places[-1]))
    if _is_long(motion) and last > largest / 2:
        _warn_of_drift(motion, f"ends {last:.3g} m away, its peak is {largest:.3g} m")
    return float(largest)


@arguments
def velocity_to_acceleration(motion: AbstractMotion) -> float:
    """PGV/PGA [s]: how long the ground pushes.

    **Arguments:** as `peak_displacement`.

    **Raises:** ValueError for a motion that does not move.
    """
    check_known(motion=motion)
    acceleration = float(peak_acceleration(motion))
    if not acceleration > 0:
        raise ValueError("Argument `motion` must move, but does not.")
    return float(peaks_and_last_velocity(motion)[1]) / (GRAVITY * acceleration)


@arguments
def arias(motion: AbstractMotion) -> float:
    """Arias intensity [m/s]: pi/(2 g) times the integral of the squared acceleration.

    **Arguments:** as `peak_displacement`.

    **Source:** Arias (1970).
    """
    return float(np.pi / (2 * GRAVITY) * _squares(piecewise_linear(motion)).sum())


@arguments
def cumulative_absolute_velocity(motion: AbstractMotion) -> float:
    """Cumulative absolute velocity (CAV) [m/s]: the integral of the absolute acceleration.

    **Arguments:** as `peak_displacement`.

    **Source:** EPRI (1988).
    """
    a, b, length = piecewise_linear(motion)
    size = np.abs(a) + np.abs(b)
    crossing = (a * a + b * b) / np.where(size > 0, size, 1.0)
    return float(np.sum(length * np.where(a * b < 0, crossing, size)) / 2)


@arguments
def significant_duration(motion: AbstractMotion, begin: ArrayLike = 0.05, end: ArrayLike = 0.95) -> float:
    """Time between two shares of the Arias intensity [s].

    **Arguments:**

    - `motion`: as in `peak_displacement`.
    - `begin`, `end`: the shares, in (0, 1), rising: 0.05 and 0.95 for D5-95, 0.75 for D5-75.

    **Raises:** ValueError for other shares, or a motion that does not move.

    **Source:** Trifunac & Brady (1975).
    """
    begin, end = (float(scalar(name, inner_share(name, x))) for name, x in (("begin", begin), ("end", end)))
    if begin >= end:
        raise ValueError(f"Argument `end` must be above `begin`, {begin}, but is {end}.")
    lines = piecewise_linear(motion)
    sums = np.concatenate([[0.0], np.cumsum(_squares(lines))])
    if not sums[-1] > 0:
        raise ValueError("Argument `motion` must move, but does not.")
    return _time_of(lines, sums, end * sums[-1]) - _time_of(lines, sums, begin * sums[-1])


def _squares(lines: PiecewiseLinear) -> np.ndarray:
    """Integrate the squared acceleration over each line."""
    a, b, length = lines
    return length * (a * a + a * b + b * b) / 3


def _time_of(lines: PiecewiseLinear, sums: np.ndarray, wanted: float) -> float:
    """Return the time at which the integral of the squared acceleration reaches a value, by bisection within a line."""
    row = min(max(int(np.searchsorted(sums, wanted)) - 1, 0), lines.length.size - 1)
    a, b, length = (float(part[row]) for part in lines)
    low, high = 0.0, 1.0
    for _ in range(60):
        share = (low + high) / 2
        c = a + (b - a) * share
        below = sums[row] + share * length * (a * a + a * c + c * c) / 3 < wanted
        low, high = (share, high) if below else (low, share)
    return float(lines.times[row] + low * length)


@arguments
def mean_period(motion: AbstractMotion) -> float:
    """Mean period [s]: periods from 0.05 to 4 s, weighted with the squared Fourier amplitude.

    **Arguments:** as `peak_displacement`; quiet around the motion does not change the result.

    **Returns:** the integral of C^2/f over that of C^2 from 0.25 to 20 Hz, C the Fourier amplitude of the motion (of a
    record: of the straight lines between samples).

    **Raises:** ValueError for a motion without any amplitude there.

    **Source:** Rathje, Abrahamson & Bray (1998), whose sums over frequencies are these integrals.
    """
    lines = piecewise_linear(motion)
    if not (lines.length > 0).any():
        raise ValueError("Argument `motion` must last, but ends where it begins.")
    total, weighted = squared_amplitudes(lines, (0.25, 20.0))
    if not total > 0:
        raise ValueError("Argument `motion` must move between 0.25 and 20 Hz, but does not.")
    return weighted / total


@arguments
def spectral_acceleration(
    motion: AbstractMotion, period: Values, damping: ArrayLike = 0.05
) -> Float[np.ndarray, "..."]:
    """Pseudo-spectral acceleration [g]: omega^2 times the peak displacement of an oscillator.

    **Arguments:**

    - `motion`: as in `peak_displacement`.
    - `period`: of any shape [s], from 0.001 to 10,000.
    - `damping`: over critical, in [0, 1).

    **Returns:** of the shape of `period`. The oscillator is followed for a period after the motion, exactly over
    straight lines; peaks between their ends are found to fourth order.

    **Raises:** ValueError for arguments outside their ranges.

    **Source:** Nigam & Jennings (1969).
    """
    period, damping = _oscillators(period, damping)
    lines = piecewise_linear(motion)
    found = [
        peaks_of_oscillator(lines, float(each), damping)[0] * (2 * np.pi / each) ** 2 / GRAVITY for each in period.flat
    ]
    return np.reshape(found, period.shape)


@arguments
def spectral_velocity(
    motion: AbstractMotion, period: Values, damping: ArrayLike = 0.05, pseudo: bool = True
) -> Float[np.ndarray, "..."]:
    """Spectral velocity of an oscillator [m/s].

    **Arguments:**

    - `motion`, `period`, `damping`: as in `spectral_acceleration`.
    - `pseudo`: omega times the peak displacement; False: the peak of the velocity relative to the ground.

    **Returns:** of the shape of `period`.

    **Raises:** as `spectral_acceleration`.
    """
    period, damping = _oscillators(period, damping)
    lines = piecewise_linear(motion)
    found = [peaks_of_oscillator(lines, float(each), damping) for each in period.flat]
    found = [peaks[0] * 2 * np.pi / each if pseudo else peaks[1] for peaks, each in zip(found, period.flat)]
    return np.reshape(found, period.shape)


@arguments
def average_spectral_acceleration(motion: AbstractMotion, period: Values, damping: ArrayLike = 0.05) -> float:
    """Average spectral acceleration (AvgSA) [g]: the geometric mean over periods.

    **Arguments:** as `spectral_acceleration`; often periods from 0.2 to 2 times one of interest.

    **Source:** Baker & Cornell (2006).
    """
    with np.errstate(divide="ignore"):
        return float(np.exp(np.mean(np.log(spectral_acceleration(motion, period, damping)))))


@arguments
def uplift_ratio(motion: AbstractMotion, block: Block) -> float | Float[Array, ""]:
    """PGA/(g tan alpha) [-]: above 1 the block uplifts.

    **Arguments:**

    - `motion`: a motion of scalar parameters.
    - `block`: one `Block`.

    **Returns:** the ratio; under tracing, an array with derivatives.
    """
    check_single(block=block)
    ratio = peak_acceleration(motion) / jnp.tan(block.alpha)
    return ratio if is_traced(ratio) else float(ratio)


@arguments
def velocity_ratio(motion: AbstractMotion, block: Block) -> float | Float[Array, ""]:
    """p PGV/(g tan alpha) [-]: the ground's velocity over the velocity that overturns the block in an instant.

    **Arguments:** as `uplift_ratio`.

    **Returns:** as `uplift_ratio`.

    **Source:** Dimitrakopoulos & Paraskeva (2015), the measure.
    """
    check_single(motion=motion, block=block)
    ratio = peaks_and_last_velocity(motion)[1] * block.p / (GRAVITY * jnp.tan(block.alpha))
    return ratio if is_traced(ratio) else float(ratio)


def _oscillators(period: Values, damping: ArrayLike) -> tuple[np.ndarray, float]:
    damping = below_one("damping", damping)
    period = checked("period", period, "be from 0.001 to 10,000 s", lambda x: (x >= 1e-3) & (x <= 1e4))
    if period.size == 0:
        raise ValueError("Argument `period` must hold at least one period, but is empty.")
    return np.asarray(period, float), float(scalar("damping", damping))
