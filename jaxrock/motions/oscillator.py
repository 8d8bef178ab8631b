"""Linear oscillators under straight lines of acceleration: exact from end to end of each, in NumPy."""

import numpy as np

from jaxrock.motions.straight import Straight


def peaks_of_oscillator(lines: Straight, period: float, damping: float) -> tuple[float, float]:
    """Peak displacement [m] and velocity [m/s] of an oscillator relative to the ground.

    With s = omega (-damping + i sqrt(1 - damping^2)) and z' = s z + ground acceleration, the displacement is
    -Im z/Im s: a recursion of one complex number.
    """
    lines = Straight(*(np.append(part, last) for part, last in zip(lines, (0.0, 0.0, period))))
    lines = _parted(lines, np.maximum(1, np.ceil(80 * lines.length / period)).astype(int))
    s = 2 * np.pi / period * complex(-damping, np.sqrt(1 - damping**2))
    states = _recursion(lines, s)
    places, speeds = -states.imag / s.imag, -(s * states).imag / s.imag
    slopes = -(s * (s * states)).imag / s.imag
    before, after = slopes[:-1] - lines.begin, slopes[1:] - lines.end  # accelerations relative to the ground
    return _top(places, speeds[:-1], speeds[1:], lines.length), _top(speeds, before, after, lines.length)


def _parted(lines: Straight, parts: np.ndarray) -> Straight:
    """Every line in so many."""
    row = np.repeat(np.arange(parts.size), parts)
    place = np.arange(row.size) - np.repeat(np.cumsum(parts) - parts, parts)
    slope = ((lines.end - lines.begin) / parts)[row]
    begin = lines.begin[row] + slope * place
    return Straight(begin, begin + slope, (lines.length / parts)[row])


def _recursion(lines: Straight, s: complex) -> np.ndarray:
    """z at the ends of all lines."""
    from scipy.signal import lfilter

    x = s * lines.length
    first = np.where(np.abs(x) < 1e-2, lines.length * _series(x, 1), np.expm1(x) / s)
    second = np.where(np.abs(x) < 1e-2, lines.length * _series(x, 2), (np.expm1(x) / x - 1) / s)
    gain, factor = lines.begin * (first - second) + lines.end * second, np.exp(x)
    state, found = 0j, [np.zeros(1, complex)]
    edges = np.flatnonzero(np.concatenate([[True], np.abs(np.diff(lines.length)) > 0, [True]]))
    for low, high in zip(edges[:-1], edges[1:]):  # of one length
        if low == high:
            continue
        part = lfilter([1.0], [1.0, -factor[low]], gain[low:high], zi=np.array([factor[low] * state]))[0]
        found.append(part)
        state = part[-1]
    return np.concatenate(found)


def _series(x: np.ndarray, first: int) -> np.ndarray:
    """sum over k of x^k/(k + first)!"""
    total, term = np.zeros_like(x), np.ones_like(x) / first
    for k in range(first, first + 8):
        total, term = total + term, term * x / (k + 1)
    return total


def _top(values: np.ndarray, before: np.ndarray, after: np.ndarray, length: np.ndarray) -> float:
    """The largest size of what has these values and slopes at the ends of lines: by a cubic where a slope turns."""
    turning = np.flatnonzero(before * after < 0)
    largest = np.abs(values).max(initial=0.0)
    if turning.size:
        y0, y1, h = values[turning], values[turning + 1], length[turning]
        m0, m1 = h * before[turning], h * after[turning]
        # Slope of the cubic of Hermite over a share of the line: a quadratic with one root inside.
        a, b = 6 * (y0 - y1) + 3 * (m0 + m1), 6 * (y1 - y0) - 4 * m0 - 2 * m1
        root = np.sqrt(np.maximum(b * b - 4 * a * m0, 0.0))
        lead = -(b + np.copysign(root, b)) / 2
        with np.errstate(all="ignore"):
            roots = np.stack([lead / a, m0 / lead])
        t = np.clip(np.where((roots[0] > 0) & (roots[0] < 1), roots[0], np.nan_to_num(roots[1])), 0, 1)
        there = y0 + m0 * t + b / 2 * t**2 + a / 3 * t**3
        largest = max(largest, np.abs(there).max())
    return float(largest)
