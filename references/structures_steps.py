"""Two ways to step an ordinary differential equation, for `references.structures`: they share no method.

`Runge`: Dormand and Prince's rule of order 8 in SciPy, with its dense output. `Extrapolation`: the modified midpoint
rule in numbers of any type, extrapolated to order 16 by whole steps; it reads a step inside by Hermite's polynomial,
which only says where to look. Both give a state at an event by a step of just the right length.
"""

import numpy as np
from scipy.integrate import DOP853
from scipy.optimize import brentq

SHARES = [i / 12 for i in range(13)]  # of a step, where it is looked at
TOLERANCE, SMALL = 1e-13, 1e-17  # of `Runge`: relative, absolute


class Runge:
    """Steps of SciPy's DOP853 in float64."""

    kind = "float"

    def step(self, rates, t, y, length):
        """Step from a state by a length at most.

        **Returns:** the length, the state at the end, the state at a share of the step, a length to try next.
        """
        solver = self._solver(rates, t, y, length)
        solver.step()
        dense, made = solver.dense_output(), float(solver.t)
        known = dict(zip(SHARES, dense(made * np.array(SHARES)).T.tolist()))

        def inside(share):
            if share not in known:
                known[share] = dense(share * made).tolist()
            return known[share]

        return made, solver.y.tolist(), inside, solver.h_abs

    def exactly(self, rates, t, y, length):
        """State after a length within a step that was made."""
        if length <= 0:
            return y
        solver = self._solver(rates, t, y, length)
        while solver.status == "running":
            solver.step()
        return solver.y.tolist()

    def _solver(self, rates, t, y, length):
        length = float(length)
        return DOP853(
            lambda since, y: rates(t + float(since), y.tolist()), 0.0, y, length, rtol=TOLERANCE, atol=SMALL,
            first_step=length,
        )  # fmt: skip


class Extrapolation:
    """The modified midpoint rule, extrapolated."""

    rows = 8

    def __init__(self, kind, tolerance=None):
        self.kind = kind
        self.tolerance = tolerance or {"long": 1e-17, "mpmath": 1e-24}[kind]

    def _table(self, rates, t, y, length):
        """State after a length, and the difference of the last two columns of the table."""
        first, rows = rates(t, y), []
        for row in range(1, self.rows + 1):
            h = length / (2 * row)
            old, new = y, [a + h * b for a, b in zip(y, first)]
            for i in range(1, 2 * row):
                slope = rates(t + i * h, new)
                old, new = new, [a + 2 * h * b for a, b in zip(old, slope)]
            line = [new]
            for back in range(1, row):
                ratio = row * row - (row - back) ** 2
                weight = (row - back) ** 2
                line.append([a + (a - b) * weight / ratio for a, b in zip(line[-1], rows[-1][back - 1])])
            rows.append(line)
        best, other = rows[-1][-1], rows[-1][-2]
        return best, max(float(abs(a - b) / (abs(a) + self.small)) for a, b in zip(best, other)), first

    small = 1e-3

    def step(self, rates, t, y, length):
        """See `Runge.step`."""
        while True:
            end, error, first = self._table(rates, t, y, length)
            if error <= self.tolerance:
                break
            length = length * max(0.2, min(0.8, 0.9 * (self.tolerance / error) ** (1 / 15)))
        growth = 0.9 * (self.tolerance / max(error, 1e-40)) ** (1 / 15)
        return length, end, _hermite(y, first, end, rates(t + length, end), length), length * min(1.6, growth)

    def exactly(self, rates, t, y, length):
        """See `Runge.exactly`."""
        return self._table(rates, t, y, length)[0] if length > 0 else y


def _hermite(y, slope, end, slope_end, length):
    """State at a share of a step: cubic from the states and slopes; the first entry is the second's integral."""

    def cubic(share, i):
        h00, h10 = (1 + 2 * share) * (1 - share) ** 2, share * (1 - share) ** 2
        h01, h11 = share**2 * (3 - 2 * share), share**2 * (share - 1)
        return h00 * y[i] + h10 * length * slope[i] + h01 * end[i] + h11 * length * slope_end[i]

    def quintic(share):
        x, v, a = y[0], length * slope[0], length**2 * slope[1] / 2
        over, back, bend = end[0] - x - v - a, length * slope_end[0] - v - 2 * a, length**2 * slope_end[1] - 2 * a
        cube, fourth = 10 * over - 4 * back + bend / 2, -15 * over + 7 * back - bend
        fifth = 6 * over - 3 * back + bend / 2
        return x + share * (v + share * (a + share * (cube + share * (fourth + share * fifth))))

    return lambda share: [quintic(share), *(cubic(share, i) for i in range(1, len(y)))]


def scan(function, at_once=False):
    """First share of a step at which a function rises through zero, or None.

    A function that starts at zero or above must first fall below, unless it counts `at_once`. A maximum between the
    samples is looked for where the samples bend down near zero.
    """
    shares, points = SHARES, len(SHARES) - 1
    values = [float(function(share)) for share in shares]
    if values[0] >= 0 and values[1] > 0:
        if at_once:
            return 0.0
        below = next((t for t in (shares[1] * 0.5**k for k in range(1, 40)) if function(t) < 0), None)
        if below is not None:
            return _bracket(function, below, shares[1])
    for i in range(1, points + 1):
        if values[i] > 0 and values[i - 1] <= 0 and not (i == 1 and values[0] == 0):
            return _bracket(function, shares[i - 1], shares[i])
        if (
            1 < i < points
            and values[i - 1] < values[i] > values[i + 1]
            and 0 >= values[i] > -4 * abs(values[i - 1] - 2 * values[i] + values[i + 1])
        ):
            top = _maximum(function, shares[i - 1], shares[i + 1])
            if function(top) > 0:
                return _bracket(function, shares[i - 1], top)
    return None


def _bracket(function, low, high):
    """A share between a value below zero and one above."""
    return brentq(lambda share: float(function(share)), low, high, xtol=1e-12)


def _maximum(function, low, high):
    """Share of a maximum, by golden sections."""
    ratio = (5**0.5 - 1) / 2
    for _ in range(45):
        a, b = high - ratio * (high - low), low + ratio * (high - low)
        low, high = (low, b) if function(a) > function(b) else (a, high)
    return (low + high) / 2
