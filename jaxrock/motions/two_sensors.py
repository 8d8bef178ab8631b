"""How an accelerometer and a displacement sensor at one place differ, as far as that is slow: `processing.fused` takes
it off.

What differs is integrated twice before it is filtered, and only its second difference is: noise of a displacement,
differentiated by itself, ends with a jump of velocity that a filter would spread over the last seconds.
"""

import numpy as np
import scipy.interpolate

from jaxrock.motions.filters import evenly, smoothed


def spline_of_displacement(displacement: np.ndarray, dt: float) -> scipy.interpolate.CubicSpline:
    """Through samples of a ground that is at rest at first."""
    time = dt * np.arange(displacement.size)
    return scipy.interpolate.CubicSpline(time, displacement, bc_type=((1, 0.0), "not-a-knot"))


def slow_difference(
    samples: np.ndarray, step: float, displacement: np.ndarray, dt: float, corner: float, order: int
) -> np.ndarray:
    """A low-pass of the samples of an accelerometer [m/s^2] less the second derivative of a displacement [m], at the
    accelerometer's samples; a constant and a ramp are told exactly, and beyond both ends the rest goes on evenly."""
    if samples.size < 2:
        return np.zeros_like(samples)
    fine, own = min(step, dt), step * np.arange(samples.size)
    time = own if step <= dt else fine * np.arange(int(np.floor(own[-1] / fine * (1 + 1e-12))) + 1)
    other = spline_of_displacement(displacement, dt)(time) if step < dt else displacement[: time.size]
    apart = _twice_integrated(samples, step, time) - other
    # Straight lines of acceleration, from rest.
    terms = np.stack([np.ones_like(time), (time / time[-1]) ** 2 / 2, (time / time[-1]) ** 3 / 6], axis=1)
    told = min(3, time.size)  # two samples tell no ramp
    fit = np.concatenate([np.linalg.lstsq(terms[:, :told], apart, rcond=None)[0], np.zeros(3 - told)])
    rest = _second_difference(apart - terms @ fit, fine, 1 / corner)
    line = (fit[1] + fit[2] * time / time[-1]) / time[-1] ** 2
    slow = smoothed(rest, fine, corner, order, evenly) + line
    if step <= dt:
        return slow
    # It is smooth at this rate, and the last sample of the accelerometer may come just after.
    return scipy.interpolate.make_interp_spline(time, slow, k=min(3, time.size - 1))(own)


def _twice_integrated(samples: np.ndarray, step: float, time: np.ndarray) -> np.ndarray:
    """The displacement from rest at times within a record of straight lines, where it is cubic between samples."""
    velocity = step * np.concatenate([[0.0], np.cumsum((samples[1:] + samples[:-1]) / 2)])
    moved = step * velocity[:-1] + step**2 * (2 * samples[:-1] + samples[1:]) / 6
    place = np.concatenate([[0.0], np.cumsum(moved)])
    return scipy.interpolate.CubicHermiteSpline(step * np.arange(samples.size), place, velocity)(time)


def _second_difference(values: np.ndarray, dt: float, seconds: float) -> np.ndarray:
    """The second derivative of values that go on evenly: from rest, and at the end with a slope by least squares over
    the last `seconds`, which noise of single values does not change."""
    last = values[-max(2, min(values.size, int(seconds / dt) + 1)) :]
    place = np.linspace(-1.0, 0.0, last.size)
    cubic = np.polynomial.polynomial.polyfit(place, last, min(3, last.size - 1))
    slope = cubic[1] / ((last.size - 1) * dt)
    first, final = values[1] - values[0], values[-2] - values[-1] + slope * dt
    return np.concatenate([[2 * first], np.diff(values, 2), [2 * final]]) / dt**2
