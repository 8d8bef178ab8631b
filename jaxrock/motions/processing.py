"""Processing of records before an analysis, for known records only, in NumPy and SciPy rather than JAX.

Records are made from displacement or velocity, fused with a displacement, corrected for their baseline, tapered,
filtered, resampled, cut and scaled. Every function returns a new `Record` that keeps the name and the origin.
"""

from fractions import Fraction
from typing import Annotated

import jax
import numpy as np
import scipy.interpolate
import scipy.signal
from jaxtyping import ArrayLike

from jaxrock._arguments.annotations import arguments, at_least, known, word_of
from jaxrock._arguments.parameters import check_single
from jaxrock._arguments.ranges import (
    Range,
    as_meant,
    delay,
    factor as any_factor,
    not_negative,
    positive,
    scalar,
    size,
    strength,
)
from jaxrock._core.arrays import Values
from jaxrock._core.one_program import check_known
from jaxrock.blocks.rigid import GRAVITY, LENGTHS
from jaxrock.motions.filters import LOWEST, NARROWEST, butterworth, of_displacement, of_velocity, smoothed
from jaxrock.motions.intensity import peak_acceleration, peak_velocity
from jaxrock.motions.record import Record, record_in_g
from jaxrock.motions.two_sensors import slow_difference, spline_of_displacement

__all__ = [
    "baseline_corrected", "cut", "filtered", "from_displacement", "from_velocity", "fused", "resampled",
    "scaled", "tapered",
]  # fmt: skip


def __dir__() -> list[str]:
    return __all__


def _samples(record: Record) -> tuple[np.ndarray, float]:
    check_single(record=record)
    check_known(record=record)
    return np.asarray(record.samples, float), as_meant(record.dt)


def _number(name: str, value: ArrayLike, allowed: Range) -> float:
    """Return an argument as one checked number, in all digits that were given."""
    checked = allowed(name, value)
    check_known(**{name: checked})
    scalar(name, checked)
    # `checked` may be a single-precision array of JAX: take the given value.
    return as_meant(checked if isinstance(value, jax.Array) else value)


def _slack(record: Record) -> float:
    """Relative tolerance of a ratio of times, for rounding of the time step."""
    return max(1e-12, 4 * float(np.finfo(np.asarray(record.dt).dtype).eps))


def _like(record: Record, samples: np.ndarray, dt: float | None = None) -> Record:
    return record_in_g(samples, record.dt if dt is None else dt, record.name, record.origin)


def _corner(name: str, value: float | None, dt: float) -> float | None:
    if value is not None and value < LOWEST / dt:
        raise ValueError(
            f"Argument `{name}` must be at least a millionth of the sampling rate, {LOWEST / dt:g} Hz, but is {value}."
        )
    if value is not None and not value < 0.5 / dt:
        raise ValueError(
            f"Argument `{name}` must be above 0 and below half the sampling rate, {0.5 / dt:g} Hz, but is {value}."
        )
    return value


Corner = Annotated[float | None, known(positive)]
Order = Annotated[int, at_least(1, 20)]


def _series(name: str, values: Values, dt: ArrayLike, unit: str) -> tuple[np.ndarray, float]:
    checked = strength(name, values)
    check_known(**{name: checked})
    # Keep all digits that were given: the second derivative of values rounded to single precision is noise.
    array = np.asarray(checked if isinstance(values, jax.Array) else values, float)
    if array.ndim != 1 or array.size < 4:
        raise ValueError(f"Argument `{name}` must be a list of at least 4 samples, but has shape {array.shape}.")
    return array * LENGTHS[unit], _number("dt", dt, size)


@arguments
def from_displacement(
    displacement: Values,
    dt: ArrayLike,
    *,
    unit: Annotated[str, word_of(*LENGTHS)] = "m",
    corner: Corner = None,
    order: Order = 4,
    name: str = "",
) -> Record:
    """Make a record from the ground's displacement, such as a shake table's.

    **Arguments:**

    - `displacement`: (n,) samples, n at least 4; the ground is at rest at first.
    - `dt`: time between samples [s], positive.
    - `unit`: of the displacement: "m", "cm" or "mm".
    - `corner`: of a Butterworth low-pass of this `order`, run forwards and backwards before the differentiation [Hz];
      None: no filter, and noise grows with the square of the frequency. Where the ground still moves at the end, the
      acceleration fades over the last 1/corner.
    - `name`: of the record.

    **Returns:** a `Record`: the second derivative, over 9.81 m/s^2, of the cubic spline through the samples. The
    spline is at rest at first, and its second derivative is straight between samples. Integrated twice, the record
    therefore returns to every sample.

    All is done in double precision. Samples given in single precision (JAX arrays where that is the default) are noisy.

    **Raises:** ValueError for arguments outside their ranges.
    """
    values, dt = _series("displacement", displacement, dt, unit)
    values = smoothed(values - values[0], dt, _corner("corner", corner, dt), order, of_displacement)
    return record_in_g(spline_of_displacement(values, dt)(dt * np.arange(values.size), 2) / GRAVITY, dt, name)


@arguments
def from_velocity(
    velocity: Values,
    dt: ArrayLike,
    *,
    unit: Annotated[str, word_of(*LENGTHS)] = "m",
    corner: Corner = None,
    order: Order = 4,
    name: str = "",
) -> Record:
    """Make a record from the ground's velocity.

    **Arguments:**

    - `velocity`: (n,) samples, n at least 4.
    - `dt`, `corner`, `order`, `name`: as in `from_displacement`.
    - `unit`: "m", "cm" or "mm", a second.

    **Returns:** a `Record`: the first derivative, over 9.81 m/s^2, of the cubic spline through the samples, taken at
    the samples.

    **Raises:** ValueError for arguments outside their ranges.
    """
    values, dt = _series("velocity", velocity, dt, unit)
    values = smoothed(values, dt, _corner("corner", corner, dt), order, of_velocity)
    spline = scipy.interpolate.CubicSpline(dt * np.arange(values.size), values)
    return record_in_g(spline(dt * np.arange(values.size), 1) / GRAVITY, dt, name)


@arguments
def fused(
    record: Record,
    displacement: Values,
    dt: ArrayLike,
    *,
    unit: Annotated[str, word_of(*LENGTHS)] = "m",
    corner: Annotated[float, known(positive)] = 0.5,
    order: Order = 4,
) -> Record:
    """Combine an accelerometer's record with a displacement sensor's, which gives its slow part.

    **Arguments:**

    - `record`: of the accelerometer, whose baseline may drift.
    - `displacement`: (n,) samples of the ground at the same place, n at least 4, the first at the record's first; at
      rest at first. The result ends with the shorter of the two.
    - `dt`: time between its samples [s], positive.
    - `unit`: of the displacement: "m", "cm" or "mm".
    - `corner`: of the Butterworth filters of this `order`, run forwards and backwards [Hz]: the displacement decides
      below it, the accelerometer above. It lies below half of both sampling rates.

    **Returns:** a `Record` of the accelerometer's time step: the record less a low-pass of its difference from the
    second derivative of the displacement's spline. Where both sensors agree, the record is unchanged. A constant and a
    ramp of the baseline are removed exactly; other differences are extended evenly beyond both ends for the filter.

    **Raises:** ValueError for arguments outside their ranges.

    **Source:** Smyth & Wu (2007), the two sensors; complementary filters.
    """
    samples, step = _samples(record)
    values, dt = _series("displacement", displacement, dt, unit)
    _corner("corner", corner, max(step, dt))
    slack = _slack(record)
    count = min(samples.size, int(np.floor((values.size - 1) * dt / step * (1 + slack))) + 1)
    last = max(4, int(np.ceil((count - 1) * step / dt * (1 - slack))) + 1)
    samples, values = samples[:count], values[:last] - values[0]
    drift = slow_difference(GRAVITY * samples, step, values, dt, corner, order)
    return _like(record, samples - drift / GRAVITY)


@arguments
def baseline_corrected(record: Record, degree: Annotated[int, at_least(1, 10)] = 2) -> Record:
    """Remove the drift of a record's velocity: subtract the derivative of a polynomial fitted to the velocity.

    **Arguments:**

    - `record`: a `Record` of two samples or more.
    - `degree`: of the polynomial in velocity, which is zero at time 0; 1 subtracts a constant from the acceleration.

    **Returns:** a `Record`.

    **Raises:** ValueError for arguments outside their ranges.
    """
    samples, dt = _samples(record)
    if samples.size <= degree:
        raise ValueError(f"Argument `record` must have more samples than `degree`, {degree}, but has {samples.size}.")
    time = np.linspace(0.0, 1.0, samples.size)
    velocity = np.concatenate([[0.0], np.cumsum((samples[1:] + samples[:-1]) / 2)]) / max(samples.size - 1, 1)
    powers = np.arange(1, degree + 1)
    terms = np.linalg.lstsq(time[:, None] ** powers, velocity, rcond=None)[0]
    return _like(record, samples - (powers * terms * time[:, None] ** (powers - 1)).sum(axis=1))


@arguments
def tapered(record: Record, seconds: ArrayLike) -> Record:
    """Taper a record: it rises from zero and falls to zero as half a cosine.

    **Arguments:**

    - `seconds`: duration of the taper at either end [s], 0 or more, at most half the record.

    **Returns:** a `Record`: times Tukey's window.

    **Raises:** ValueError for arguments outside their ranges.
    """
    samples, dt = _samples(record)
    seconds, whole = _number("seconds", seconds, not_negative), (samples.size - 1) * dt
    if 2 * seconds > whole:
        raise ValueError(f"Argument `seconds` must be at most half the record, {whole / 2:g} s, but is {seconds}.")
    return _like(record, samples * scipy.signal.windows.tukey(samples.size, 2 * seconds / whole if whole else 0.0))


@arguments
def filtered(
    record: Record, low: Corner = None, high: Corner = None, *, order: Order = 4, zero_phase: bool = True
) -> Record:
    """Pass a record through a Butterworth filter.

    **Arguments:**

    - `low`, `high`: corners of the band that passes [Hz]; None: no corner at that end. At least one is needed.
    - `order`: of the filter.
    - `zero_phase`: whether it runs forwards and backwards (which doubles its order); the ground rests before and after.

    **Returns:** a `Record` of as many samples; ringing before its beginning and after its end is cut off.

    **Raises:** ValueError for corners that are not in order, or not from a millionth to half of the sampling rate, or
    within a millionth of one another.
    """
    samples, dt = _samples(record)
    low, high = _corner("low", low, dt), _corner("high", high, dt)
    if low is None and high is None:
        raise ValueError("Arguments `low` and `high` must not both be None.")
    if low is not None and high is not None and low >= high:
        raise ValueError(f"Argument `high` must be above `low`, {low} Hz, but is {high}.")
    if low is not None and high is not None and high - low < NARROWEST * high:
        raise ValueError(f"Argument `high` must be above `low`, {low} Hz, by a millionth of itself, but is {high}.")
    return _like(record, butterworth(samples, dt, low, high, order, zero_phase))


@arguments
def resampled(record: Record, dt: ArrayLike) -> Record:
    """Resample a record with another time step.

    **Arguments:**

    - `dt`: the new time step [s], positive.

    **Returns:** a `Record`. A shorter step samples the old one's straight lines; a step that is a whole number of times
    shorter gives the same motion. A longer step follows a linear-phase low-pass below half the new sampling rate
    (`scipy.signal.resample_poly`). That filter takes the ground as at rest before and after: samples at the ends of a
    record that does not begin or end at zero become smaller.

    **Raises:** ValueError for arguments outside their ranges, or a longer step that is no ratio of small numbers.
    """
    samples, old = _samples(record)
    new = _number("dt", dt, size)
    slack = _slack(record)
    if new <= old * (1 + slack):
        time = new * np.arange(int(np.floor((samples.size - 1) * old / new * (1 + slack))) + 1)
        return _like(record, np.interp(time, old * np.arange(samples.size), samples), new)
    ratio = Fraction(old / new).limit_denominator(10_000)
    if ratio == 0 or abs(float(ratio) * new / old - 1) > max(1e-9, slack):
        raise ValueError(f"Argument `dt` must be to the old step, {old:g} s, as small whole numbers are, but is {new}.")
    return _like(record, scipy.signal.resample_poly(samples, ratio.numerator, ratio.denominator), new)


@arguments
def cut(record: Record, begin: ArrayLike = 0.0, end: ArrayLike | None = None) -> Record:
    """Cut a record to the samples between two times, those at the times included.

    **Arguments:**

    - `begin`, `end`: times [s]; `end` None: the record's.

    **Returns:** a `Record` that begins at time 0.

    **Raises:** ValueError for a part without samples.
    """
    samples, dt = _samples(record)
    begin = _number("begin", begin, delay)
    end = (samples.size - 1) * dt if end is None else _number("end", end, delay)
    slack = 1e-9 + _slack(record) * np.array([begin, end]) / dt
    first, last = int(np.ceil(begin / dt - slack[0])), int(np.floor(min(end / dt + slack[1], samples.size)))
    part = samples[first : last + 1]
    if last < first or part.size == 0:
        raise ValueError(f"Arguments `begin` and `end` must leave a sample, but are {begin:g} and {end:g} s.")
    return _like(record, part)


@arguments
def scaled(
    record: Record,
    factor: ArrayLike | None = None,
    *,
    acceleration: ArrayLike | None = None,
    velocity: ArrayLike | None = None,
) -> Record:
    """Scale a record by a factor, or to a peak.

    **Arguments:** one of

    - `factor`: any number.
    - `acceleration`: peak acceleration of the result [g], positive.
    - `velocity`: peak velocity of the result [m/s], positive.

    **Returns:** a `Record`.

    **Raises:** ValueError where not just one is given, and for a peak of a record that does not move.
    """
    samples, _ = _samples(record)
    given = {"factor": factor, "acceleration": acceleration, "velocity": velocity}
    given = {name: value for name, value in given.items() if value is not None}
    if len(given) != 1:
        raise ValueError("Just one of the arguments `factor`, `acceleration` and `velocity` must be given.")
    ((name, value),) = given.items()
    if name == "factor":
        return _like(record, samples * _number(name, value, any_factor))
    value = _number(name, value, positive)
    peak = float((peak_acceleration if name == "acceleration" else peak_velocity)(record))
    if not peak > 0:
        raise ValueError("Argument `record` must move, but does not.")
    return _like(record, samples * (value / peak))
