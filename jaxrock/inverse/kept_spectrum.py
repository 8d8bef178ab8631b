"""Linear constraints on a change of a record that preserve its response spectrum at given periods.

The response of an oscillator at an instant is linear in the record. A change that adds nothing to the response at the
instant of its peak preserves that peak. Where the change makes a higher peak at another instant, that instant becomes
a further constraint, and the search continues.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

DAMPING = 0.05  # share of critical damping, the usual value
TOLERANCE = 0.05  # largest relative change of a spectrum
_HIGH = 0.85  # share of the highest peak; all peaks at least as high are constrained from the beginning


class KeptSpectrum(NamedTuple):
    """Oscillators under a record of `samples` (n,) [g], whose peak responses shall be preserved.

    An allowed change has a product of zero with every row of `rows`, (rows, n). Responses are evaluated at the samples,
    and for one period after them.
    """

    period: Float[np.ndarray, " periods"]
    samples: Float[np.ndarray, " n"]
    dt: float
    rows: Float[np.ndarray, "rows n"]

    @classmethod
    def of(cls, period: np.ndarray, samples: np.ndarray, dt: float) -> "KeptSpectrum":
        """Return constraints with rows for the peaks under the given record."""
        bare = cls(period, samples, dt, np.zeros((0, samples.size)))
        rows = []
        for each in period:
            size = np.abs(bare.displacement(each, samples))
            tops = 1 + np.flatnonzero((size[1:-1] >= size[:-2]) & (size[1:-1] > size[2:]))
            rows += [bare.row(each, int(top)) for top in tops if size[top] >= _HIGH * size.max()]
            rows.append(bare.row(each, int(np.argmax(size))))
        return bare._replace(rows=np.stack(rows))

    def displacement(self, period: float, samples: np.ndarray) -> np.ndarray:
        """Return the displacement of an oscillator relative to the ground, over the static one, at all instants."""
        from scipy.signal import lfilter

        s, first, second = self._lines(period)
        gain = np.zeros(samples.size + int(np.ceil(period / self.dt)), complex)
        gain[1 : samples.size] = samples[:-1] * first + samples[1:] * second
        return -np.asarray(lfilter([1.0], [1.0, -np.exp(s * self.dt)], gain)).imag * abs(s) ** 2 / s.imag

    def row(self, period: float, instant: int) -> np.ndarray:
        """Return the coefficients of the displacement at an instant by all samples, as a vector of length 1."""
        s, first, second = self._lines(period)
        later = instant - np.arange(self.samples.size)
        row = np.zeros(self.samples.size, complex)
        since = np.where(later[1:] >= 0, np.exp(s * self.dt * np.maximum(later[1:], 0)), 0)  # the end of each line
        row[:-1] += first * since
        row[1:] += second * since
        return row.imag / np.linalg.norm(row.imag)

    def _lines(self, period: float) -> tuple[complex, complex, complex]:
        """Return the exponent of an oscillator, and the contributions of both samples of a line at the line's end."""
        s = 2 * np.pi / period * complex(-DAMPING, np.sqrt(1 - DAMPING**2))
        x = s * self.dt
        whole, end = np.expm1(x) / s, (np.expm1(x) / x - 1) / s
        return s, whole - end, end

    def change(self, samples: np.ndarray) -> float:
        """Return the largest relative difference between the spectrum of other samples and that of the record."""
        return max(abs(self._growth(each, samples)[0]) for each in self.period)

    def _growth(self, period: float, samples: np.ndarray) -> tuple[float, int]:
        """Return the relative growth of the peak of an oscillator under other samples, and the instant of that peak."""
        size = np.abs(self.displacement(period, samples))
        return size.max() / np.abs(self.displacement(period, self.samples)).max() - 1, int(np.argmax(size))

    def kept_at(self, samples: np.ndarray) -> "KeptSpectrum | None":
        """Return constraints with further rows for peaks that grow by more than the tolerance; None if none does."""
        grown = [(each, *self._growth(each, samples)) for each in self.period]
        more = [self.row(each, instant) for each, growth, instant in grown if growth > TOLERANCE]
        return self._replace(rows=np.concatenate([self.rows, np.stack(more)])) if more else None
