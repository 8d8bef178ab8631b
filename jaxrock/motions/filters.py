"""Butterworth filters of samples that are extended beyond both ends: by zeros, or by periodic mirror images.

NumPy and SciPy only; `processing` uses them. No filter steps through an extension, however long its response rings.
"""

from collections.abc import Callable

import numpy as np
import scipy.fft
import scipy.signal

LOWEST = 1e-6  # corner over sampling rate: below it, rounding destroys the filter coefficients
NARROWEST = 1e-6  # width of a band over its upper corner, for the same reason


def smoothed(values: np.ndarray, dt: float, corner: float | None, order: int, beyond: Callable) -> np.ndarray:
    """Apply a zero-phase low-pass (`corner` None: none) to values that `beyond` extends to a periodic signal."""
    return values if corner is None else beyond(values, lambda whole: _smoothed_period(whole, dt, corner, order))


def _smoothed_period(whole: np.ndarray, dt: float, corner: float, order: int) -> np.ndarray:
    """Filter one period of values (an even number) by the squared Butterworth gain at each discrete frequency."""
    ratio = np.tan(np.pi * np.arange(whole.size // 2 + 1) / whole.size) / np.tan(np.pi * corner * dt)
    with np.errstate(over="ignore"):
        gain = 1 / (1 + ratio ** (2 * order))
    return scipy.fft.irfft(scipy.fft.rfft(whole) * gain, whole.size)


def evenly(values: np.ndarray, smooth: Callable) -> np.ndarray:
    """Smooth values that are extended evenly (mirrored) at both ends."""
    return smooth(np.concatenate([values, values[-2:0:-1]]))[: values.size]


# The ground is at rest at first: its displacement is extended evenly before the beginning, and as an odd function about
# the end. Even extension keeps the velocity at zero under a zero-phase filter; extension by rest would make it jump.


def of_displacement(values: np.ndarray, smooth: Callable) -> np.ndarray:
    """Smooth values with an even extension at the beginning and an odd one about the end."""
    turned = 2 * values[-1] - values[-2::-1]
    return evenly(np.concatenate([values, turned]), smooth)[: values.size]


def of_velocity(values: np.ndarray, smooth: Callable) -> np.ndarray:
    """Smooth values with odd extensions about both ends: a straight line, which passes, plus an odd remainder."""
    line = np.linspace(values[0], values[-1], values.size)
    beside = values - line
    return line + smooth(np.concatenate([beside, -beside[-2:0:-1]]))[: values.size]


def butterworth(
    values: np.ndarray, dt: float, low: float | None, high: float | None, order: int, zero_phase: bool
) -> np.ndarray:
    """Apply a Butterworth filter to values that are zero before and after.

    A zero-phase response is a causal part plus its mirror image in time. Each part is a sum over poles that starts from
    rest, so no filter has to step beyond an end.
    """
    if not zero_phase:
        edges = [edge for edge in (low, high) if edge is not None]
        kind = "bandpass" if len(edges) == 2 else "lowpass" if low is None else "highpass"
        sections = scipy.signal.butter(order, edges if len(edges) == 2 else edges[0], kind, fs=1 / dt, output="sos")
        return scipy.signal.sosfilt(sections, values)
    if high is None:
        return values - butterworth(values, dt, None, low, order, True)
    return _causal_half(values, dt, low, high, order) + _causal_half(values[::-1], dt, low, high, order)[::-1]


def _causal_half(values: np.ndarray, dt: float, low: float | None, high: float, order: int) -> np.ndarray:
    """Return the causal part of a zero-phase response.

    The normalised variable S is s/w for a low-pass and (s^2 + l h)/(s (h - l)) for a band-pass; l, h and w are corners
    under the bilinear transform. The squared gain 1/(1 + (S/i)^2N) has the residue -p/2N at each pole p. Poles with a
    negative real part form this half, the others its mirror image in time.
    """
    upper = np.tan(np.pi * high * dt)
    lower = 0.0 if low is None else np.tan(np.pi * low * dt)
    total = np.zeros(values.size)
    for k in range((order + 1) // 2):  # one of each pair of conjugate poles
        pole = 1j * np.exp(1j * np.pi * (2 * k + 1) / (2 * order))
        size = -pole * (upper - lower) / (2 * order)
        if low is None:
            part = _one_pole(values, size, 1, pole * upper)
        else:
            middle = pole * (upper - lower) / 2
            root = np.sqrt(middle**2 - lower * upper)
            far = max(middle + root, middle - root, key=abs)  # the near pole, computed as a difference, would cancel
            part = _one_pole(_one_pole(values, 1, -1, lower * upper / far), size, 1, far)
        total += (1 if 2 * k + 1 == order else 2) * part.real
    return total


def _one_pole(values: np.ndarray, size: complex, sign: int, pole: complex) -> np.ndarray:
    """Pass values through size/(s - pole), sign 1, or size s/(s - pole), sign -1, with s = (1 - 1/z)/(1 + 1/z)."""
    return scipy.signal.lfilter([size, sign * size], [1 - pole, -(1 + pole)], values)
