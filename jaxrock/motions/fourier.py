"""Squared Fourier amplitudes of piecewise linear accelerations over a band of frequencies, in NumPy.

Shocks far apart in time are transformed separately, so that the quiet between them costs nothing. Their cross terms
oscillate over frequency, faster for shocks farther apart: that factor is integrated in closed form.
"""

from typing import NamedTuple

import numpy as np

from jaxrock.motions.oscillator import integrals_of_exponential
from jaxrock.motions.piecewise_linear import PiecewiseLinear

_QUIET = 20.0  # shortest pause that separates two shocks [s]
_SHOCKS = 64  # largest number of shocks; with more, only longer pauses separate them
_APART = 5e-3  # largest spacing of frequencies [Hz]
_SHORT = 2.5e-4  # largest time step [s], except for lines of equal length
_MOST = 1 << 24  # largest number of time steps
_FINE = 8  # frequencies per independent frequency of a shock's length
_MANY = 1 << 20  # largest number of samples


class _Shock(NamedTuple):
    """Straight lines between two pauses, with their begin and length [s]."""

    lines: PiecewiseLinear
    begin: float
    length: float

    @property
    def middle(self) -> float:
        return self.begin + self.length / 2


def squared_amplitudes(lines: PiecewiseLinear, band: tuple[float, float]) -> tuple[float, float]:
    """Integrate C^2 and C^2/f over a band of frequencies f [Hz], with C the Fourier amplitude."""
    shocks = _shocks(lines)
    if not shocks:
        return 0.0, 0.0
    from scipy.integrate import simpson

    longest = max(shock.length for shock in shocks)
    fine = _FINE if longest / min(map(_step, shocks)) < _MANY else 1
    apart = min(_APART, 1 / (2 * fine * longest))
    grid = np.linspace(*band, int(np.ceil((band[1] - band[0]) / apart)) + 1)
    found = np.zeros(2)
    amplitudes = [_amplitudes(shock, grid) for shock in shocks]
    for number, (shock, one) in enumerate(zip(shocks, amplitudes)):
        power = np.abs(one) ** 2
        found += [simpson(power, x=grid), simpson(power / grid, x=grid)]
        for earlier, other in zip(shocks[:number], amplitudes):
            both = 2 * one * other.conj()
            found += _between(np.stack([both, both / grid]), grid, shock.middle - earlier.middle)
    return float(found[0]), float(found[1])


def _shocks(lines: PiecewiseLinear) -> list[_Shock]:
    """Split lines into shocks, at pauses."""
    lines = PiecewiseLinear(*(part[lines.length > 0] for part in lines))
    moving, times = (lines.begin != 0) | (lines.end != 0), lines.times
    places = np.flatnonzero(moving)
    if places.size == 0:
        return []
    pauses = times[places[1:]] - times[places[:-1] + 1]
    quiet = max(_QUIET, np.sort(pauses)[-_SHOCKS] if pauses.size >= _SHOCKS else 0.0)
    groups = np.split(places, np.flatnonzero(pauses > quiet) + 1)
    ends = ((group[0], group[-1] + 1) for group in groups)
    return [_Shock(PiecewiseLinear(*(x[a:b] for x in lines)), times[a], times[b] - times[a]) for a, b in ends]


def _step(shock: _Shock) -> float:
    """Return the time step [s]: the length of the lines, if they are equally long and continuous."""
    length = shock.lines.length
    joined = np.allclose(shock.lines.begin[1:], shock.lines.end[:-1], rtol=1e-9, atol=0)
    if length.size > 1 and joined and np.ptp(length) <= 1e-6 * length.max():
        return float(length.mean())
    step = max(min(_SHORT, shock.length / 1000, 8 * float(length.max())), shock.length / _MOST)
    return shock.length / np.ceil(shock.length / step)  # the end is one of the times


def _amplitudes(shock: _Shock, grid: np.ndarray) -> np.ndarray:
    """Return the Fourier transform at the frequencies `grid` [Hz], with time from the middle of the shock."""
    lines, step, times = shock.lines, _step(shock), shock.lines.times
    time = step * np.arange(int(np.floor(times[-1] / step * (1 + 1e-9))) + 1)
    knots = np.stack([times[:-1], times[1:] - 1e-9 * step], axis=1).ravel()
    values = np.stack([lines.begin, lines.end], axis=1).ravel()
    # At a jump take the mean of both sides, which centres the sample in time.
    samples = sum(np.interp(time + k * 2e-9 * step, knots, values, left=0.0, right=0.0) / 2 for k in (-1, 1))
    from scipy.signal import zoom_fft

    sums = zoom_fft(samples, [grid[0], grid[-1]], grid.size, fs=1 / step, endpoint=True)
    # Lines between samples transform to the samples' transform, periodic in the sampling rate, times a squared sinc.
    whole = step * sums * np.sinc(grid * step) ** 2
    # Interpolation puts half of the first and last sample into lines beyond the ends: move it inside.
    moved = (1 - np.sinc(2 * grid * step)) / (2j * np.pi * grid)
    ends = lines.begin[0] - lines.end[-1] * np.exp(-2j * np.pi * grid * time[-1])
    return (whole + moved * ends) * np.exp(1j * np.pi * grid * shock.length)


def _between(values: np.ndarray, grid: np.ndarray, later: float) -> np.ndarray:
    """Integrate values, linear between frequencies, times e^(-2 pi i later frequency); return the real parts."""
    apart = np.diff(grid)
    turn = -2j * np.pi * later
    whole, falling = integrals_of_exponential(turn * apart, apart)
    pieces = values[:, :-1] * falling + values[:, 1:] * (whole - falling)
    return (pieces * np.exp(turn * grid[:-1])).sum(axis=1).real
