"""Response spectra that a change of a record leaves as they are: what an oscillator does at an instant is linear in it.

So a change that adds nothing to any of their responses at the instants of their peaks leaves the peaks; where it makes
a higher one at another instant, that instant is kept, too, and the search goes on.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

DAMPING = 0.05  # over critical, as usual
TOLERANCE = 0.05  # by which a spectrum may change
_HIGH = 0.85  # of a peak; instants whose response is as high are kept from the beginning


class KeptSpectrum(NamedTuple):
    """Oscillators under a record of `samples` (n,) [g], whose peaks are to stay; rows, (rows, n), whose products with a
    change vanish.

    They are looked at at the samples, and for a period after them.
    """

    period: Float[np.ndarray, " periods"]
    samples: Float[np.ndarray, " n"]
    dt: float
    rows: Float[np.ndarray, "rows n"]

    @classmethod
    def of(cls, period: np.ndarray, samples: np.ndarray, dt: float) -> "KeptSpectrum":
        """With rows for the peaks of the record as it is."""
        bare = cls(period, samples, dt, np.zeros((0, samples.size)))
        rows = []
        for each in period:
            size = np.abs(bare.displacement(each, samples))
            tops = 1 + np.flatnonzero((size[1:-1] >= size[:-2]) & (size[1:-1] > size[2:]))
            rows += [bare.row(each, int(top)) for top in tops if size[top] >= _HIGH * size.max()]
            rows.append(bare.row(each, int(np.argmax(size))))
        return bare._replace(rows=np.stack(rows))

    def displacement(self, period: float, samples: np.ndarray) -> np.ndarray:
        """Of an oscillator relative to the ground, over that of a slow load, at all instants."""
        from scipy.signal import lfilter

        s, first, second = self._lines(period)
        gain = np.zeros(samples.size + int(np.ceil(period / self.dt)), complex)
        gain[1 : samples.size] = samples[:-1] * first + samples[1:] * second
        return -np.asarray(lfilter([1.0], [1.0, -np.exp(s * self.dt)], gain)).imag * abs(s) ** 2 / s.imag

    def row(self, period: float, instant: int) -> np.ndarray:
        """How the displacement at an instant follows from all samples, as a vector of length 1."""
        s, first, second = self._lines(period)
        later = instant - np.arange(self.samples.size)
        row = np.zeros(self.samples.size, complex)
        since = np.where(later[1:] >= 0, np.exp(s * self.dt * np.maximum(later[1:], 0)), 0)  # the end of each line
        row[:-1] += first * since
        row[1:] += second * since
        return row.imag / np.linalg.norm(row.imag)

    def _lines(self, period: float) -> tuple[complex, complex, complex]:
        """The exponent of an oscillator, and what the sample before and after a line adds at its end."""
        s = 2 * np.pi / period * complex(-DAMPING, np.sqrt(1 - DAMPING**2))
        x = s * self.dt
        whole, end = np.expm1(x) / s, (np.expm1(x) / x - 1) / s
        return s, whole - end, end

    def change(self, samples: np.ndarray) -> float:
        """By which share the spectrum of other samples differs at most from that of the record."""
        return max(abs(self._growth(each, samples)[0]) for each in self.period)

    def _growth(self, period: float, samples: np.ndarray) -> tuple[float, int]:
        """By which share a peak grows, and where it is then."""
        size = np.abs(self.displacement(period, samples))
        return size.max() / np.abs(self.displacement(period, self.samples)).max() - 1, int(np.argmax(size))

    def kept_at(self, samples: np.ndarray) -> "KeptSpectrum | None":
        """With rows for the peaks that have grown under other samples; None where none has, by more than is allowed."""
        grown = [(each, *self._growth(each, samples)) for each in self.period]
        more = [self.row(each, instant) for each, growth, instant in grown if growth > TOLERANCE]
        return self._replace(rows=np.concatenate([self.rows, np.stack(more)])) if more else None
