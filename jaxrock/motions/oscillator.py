"""Linear oscillators under piecewise linear acceleration: exact at the ends of all lines, in NumPy.

A line of many periods costs as much as one of two: see `_peaks_of_long_lines`.
"""

import numpy as np

from jaxrock.motions.piecewise_linear import PiecewiseLinear

_PARTS = 80  # parts of a period, for peaks
_AT_A_TIME = 1 << 16  # lines, or parts of lines, whose states are in memory together
_GONE = 40.0  # number of e-foldings after which an oscillation is below rounding


def peaks_of_oscillator(lines: PiecewiseLinear, period: float, damping: float) -> tuple[float, float]:
    """Return the peak displacement [m] and velocity [m/s] of an oscillator relative to the ground.

    With s = omega (-damping + i sqrt(1 - damping^2)) and z' = s z + ground acceleration, the displacement is
    -Im z/Im s: a recursion of one complex number.
    """
    lines = PiecewiseLinear(*(np.append(part, last) for part, last in zip(lines, (0.0, 0.0, period))))
    s = 2 * np.pi / period * complex(-damping, np.sqrt(1 - damping**2))
    state, peaks = 0j, np.zeros(2)
    for first in range(0, lines.length.size, _AT_A_TIME):
        some = PiecewiseLinear(*(part[first : first + _AT_A_TIME] for part in lines))
        states = _recursion(some, s, state)
        state = states[-1]
        peaks = np.maximum(peaks, _peaks_of_lines(some, states, s, period))
    return float(peaks[0]), float(peaks[1])


def _peaks_of_lines(lines: PiecewiseLinear, states: np.ndarray, s: complex, period: float) -> np.ndarray:
    """Return the peaks of displacement and velocity within some lines, from the states z at their ends."""
    window = 2 * np.pi / s.imag  # a period of the damped oscillation, or its decay if shorter
    window = min(window, max(_GONE / -s.real, period)) if s.real else window
    parts = np.maximum(1, np.ceil(_PARTS * lines.length / period)).astype(int)
    long = lines.length > 2 * window
    whole, cut = np.flatnonzero((parts == 1) & ~long), np.flatnonzero((parts > 1) & ~long)
    peaks = _peaks_between(_rows(lines, whole), states[:-1][whole], states[1:][whole], s)
    if cut.size:
        peaks = np.maximum(peaks, _peaks_of_parts(_rows(lines, cut), states[:-1][cut], parts[cut], s))
    if long.any():
        peaks = np.maximum(
            peaks, _peaks_of_long_lines(_rows(lines, np.flatnonzero(long)), states[:-1][long], s, window)
        )
    return peaks


def _peaks_of_long_lines(lines: PiecewiseLinear, states: np.ndarray, s: complex, window: float) -> np.ndarray:
    """Return peaks within lines of many periods: they lie in the first or in the last period.

    The oscillator follows a straight line and rings about it. Sampled at one phase, from period to period, its distance
    from zero is a straight line plus a decaying exponential. At phases where it is ahead of the line this sum is
    convex, so its largest value lies at an end. At the others, it is farther from zero half a period before or after.
    """
    a, b, length = lines
    slope, first = (b - a) / length, np.full_like(length, window)
    parts = np.full(length.size, int(np.ceil(_PARTS * window * abs(s) / (2 * np.pi))))
    peaks = _peaks_of_parts(PiecewiseLinear(a, a + slope * first, first), states, parts, s)
    last = _after(a, slope, states, length - first, s)
    return np.maximum(peaks, _peaks_of_parts(PiecewiseLinear(b - slope * first, b, first), last, parts, s))


def _peaks_of_parts(lines: PiecewiseLinear, states: np.ndarray, parts: np.ndarray, s: complex) -> np.ndarray:
    """Return peaks within lines cut into equal parts, from the states at the beginnings of the lines."""
    peaks, total = np.zeros(2), np.cumsum(parts)
    for group in np.split(np.arange(parts.size), np.flatnonzero(np.diff(total // _AT_A_TIME)) + 1):
        row = np.repeat(group, parts[group])
        place = np.arange(row.size) - np.repeat(np.cumsum(parts[group]) - parts[group], parts[group])
        a, b, length = _rows(lines, row)
        slope, step = (b - a) / length, length / parts[row]
        begin = a + slope * step * place
        after = _after(a, slope, states[row], step * (place + 1), s)
        before = np.where(place == 0, states[row], np.roll(after, 1))
        peaks = np.maximum(peaks, _peaks_between(PiecewiseLinear(begin, begin + slope * step, step), before, after, s))
    return peaks


def _peaks_between(lines: PiecewiseLinear, before: np.ndarray, after: np.ndarray, s: complex) -> np.ndarray:
    """Return peaks within lines much shorter than a period, from the states at their ends."""
    (place, next_place), (speed, next_speed), (slope, next_slope) = (
        (-(s**k * before).imag / s.imag, -(s**k * after).imag / s.imag) for k in range(3)
    )
    slope, next_slope = slope - lines.begin, next_slope - lines.end  # accelerations relative to the ground
    return np.array(
        [
            _top(place, next_place, speed, next_speed, lines.length),
            _top(speed, next_speed, slope, next_slope, lines.length),
        ]
    )


def _rows(lines: PiecewiseLinear, rows: np.ndarray) -> PiecewiseLinear:
    """Select some of the lines."""
    return PiecewiseLinear(*(part[rows] for part in lines))


def _recursion(lines: PiecewiseLinear, s: complex, state: complex) -> np.ndarray:
    """Return z at the ends of all lines, from its initial value."""
    from scipy.signal import lfilter

    x = s * lines.length
    first, second = integrals_of_exponential(x, lines.length)
    gain, factor = lines.begin * (first - second) + lines.end * second, np.exp(x)
    edges = np.flatnonzero(np.concatenate([[True], np.abs(np.diff(lines.length)) > 0, [True]]))
    if edges.size > x.size // 16:  # many runs of equal length: one filter per run would cost more than a loop
        states = [state]
        for each, more in zip(factor.tolist(), gain.tolist()):
            states.append(each * states[-1] + more)
        return np.array(states)
    found = [np.array([state])]
    for low, high in zip(edges[:-1], edges[1:]):  # a run of equally long lines
        part = lfilter([1.0], [1.0, -factor[low]], gain[low:high], zi=np.array([factor[low] * state]))[0]
        found.append(part)
        state = part[-1]
    return np.concatenate(found)


def _after(a: np.ndarray, slope: np.ndarray, state: np.ndarray, time: np.ndarray, s: complex) -> np.ndarray:
    """Return z at a time after the beginning of a line."""
    x = s * time
    first, second = integrals_of_exponential(x, time)
    return np.exp(x) * state + a * first + slope * time * second


def integrals_of_exponential(x: np.ndarray, time: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """Return the integrals over t from 0 to `time` of e^(x t/time), and of that times 1 - t/time."""
    small = np.abs(x) < 1e-2
    far = np.where(small, 1.0, x)
    first = np.expm1(far) / far
    return time * np.where(small, _series(x, 1), first), time * np.where(small, _series(x, 2), (first - 1) / far)


def _series(x: np.ndarray, first: int) -> np.ndarray:
    """Return the sum over k of x^k/(k + first)!"""
    x = np.where(np.abs(x) < 1e-2, x, 0.0)
    total, term = np.zeros_like(x), np.ones_like(x) / first
    for k in range(first, first + 8):
        total, term = total + term, term * x / (k + 1)
    return total


def _top(y0: np.ndarray, y1: np.ndarray, m0: np.ndarray, m1: np.ndarray, h: np.ndarray) -> float:
    """Return the largest magnitude of cubics with the given values and slopes at the ends of lines of lengths h."""
    sizes = np.maximum(np.abs(y0), np.abs(y1))
    largest = sizes.max(initial=0.0)
    # A cubic Hermite interpolant exceeds its end values at most by this much.
    rows = np.flatnonzero(sizes + 4 / 27 * h * (np.abs(m0) + np.abs(m1)) > largest)
    y0, y1, m0, m1 = (part[rows] for part in (y0, y1, h * m0, h * m1))
    # The slope over a share of the line is a t^2 + b t + m0.
    a, b = 6 * (y0 - y1) + 3 * (m0 + m1), 6 * (y1 - y0) - 4 * m0 - 2 * m1
    lead = -(b + np.copysign(np.sqrt(np.maximum(b * b - 4 * a * m0, 0.0)), b)) / 2
    with np.errstate(all="ignore"):
        roots = np.stack([lead / a, m0 / lead])
    t = np.where((roots > 0) & (roots < 1), roots, 0.0)
    return float(np.abs(y0 + m0 * t + b / 2 * t**2 + a / 3 * t**3).max(initial=largest))
