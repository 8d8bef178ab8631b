"""Slow difference between an accelerometer and a displacement sensor at one place, for `processing.fused`.

The accelerations are integrated twice before the comparison, and only the difference is differentiated twice.
Differentiated by itself, a noisy displacement ends with a jump of velocity, which a filter would spread over the last
seconds.
"""

import numpy as np
import scipy.interpolate

from jaxrock.motions.filters import evenly, smoothed


def spline_of_displacement(displacement: np.ndarray, dt: float) -> scipy.interpolate.CubicSpline:
    """Return a cubic spline through samples of a ground that starts from rest."""
    time = dt * np.arange(displacement.size)
    return scipy.interpolate.CubicSpline(time, displacement, bc_type=((1, 0.0), "not-a-knot"))


def slow_difference(
    samples: np.ndarray, step: float, displacement: np.ndarray, dt: float, corner: float, order: int
) -> np.ndarray:
    """Return a low-pass of the acceleration samples [m/s^2] less the second derivative of a displacement [m].

    The result stands at the accelerometer's samples. A constant and a ramp are exact; the rest is extended evenly
    beyond both ends.
    """
    if samples.size < 2:
        return np.zeros_like(samples)
    fine, own = min(step, dt), step * np.arange(samples.size)
    time = own if step <= dt else fine * np.arange(int(np.floor(own[-1] / fine * (1 + 1e-12))) + 1)
    other = spline_of_displacement(displacement, dt)(time) if step < dt else displacement[: time.size]
    apart = _twice_integrated(samples, step, time) - other
    # Displacements of a shift and of piecewise linear acceleration, from rest.
    terms = np.stack([np.ones_like(time), (time / time[-1]) ** 2 / 2, (time / time[-1]) ** 3 / 6], axis=1)
    told = min(3, time.size)  # two samples determine no ramp
    fit = np.concatenate([np.linalg.lstsq(terms[:, :told], apart, rcond=None)[0], np.zeros(3 - told)])
    rest = _second_difference(apart - terms @ fit, fine, 1 / corner)
    line = (fit[1] + fit[2] * time / time[-1]) / time[-1] ** 2
    slow = smoothed(rest, fine, corner, order, evenly) + line
    if step <= dt:
        return slow
    # The result is smooth at this rate; the last sample of the accelerometer may lie just beyond.
    return scipy.interpolate.make_interp_spline(time, slow, k=min(3, time.size - 1))(own)


def _twice_integrated(samples: np.ndarray, step: float, time: np.ndarray) -> np.ndarray:
    """Integrate a record twice from rest, at times within it; the displacement is cubic between samples."""
    velocity = step * np.concatenate([[0.0], np.cumsum((samples[1:] + samples[:-1]) / 2)])
    moved = step * velocity[:-1] + step**2 * (2 * samples[:-1] + samples[1:]) / 6
    place = np.concatenate([[0.0], np.cumsum(moved)])
    return scipy.interpolate.CubicHermiteSpline(step * np.arange(samples.size), place, velocity)(time)


def _second_difference(values: np.ndarray, dt: float, seconds: float) -> np.ndarray:
    """Return the second derivative of values extended evenly at both ends.

    They start from rest. The slope at the end is fitted by least squares over the last `seconds`, robust to noise of
    single values.
    """
    last = values[-max(2, min(values.size, int(seconds / dt) + 1)) :]
    place = np.linspace(-1.0, 0.0, last.size)
    cubic = np.polynomial.polynomial.polyfit(place, last, min(3, last.size - 1))
    slope = cubic[1] / ((last.size - 1) * dt)
    first, final = values[1] - values[0], values[-2] - values[-1] + slope * dt
    return np.concatenate([[2 * first], np.diff(values, 2), [2 * final]]) / dt**2
