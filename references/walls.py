"""Judge of walls that open to one side: SciPy's DOP853 from sample to sample of a record, and roots of its steps.

It shares no code with the package. With opening angle x >= 0 on side s and a ground acceleration that is a straight
line between samples,

    x''/p^2 = -[sin(alpha - x) + s u(t) cos(alpha - x)],   uplift where -s u > tan(alpha),   x'+ = -e x'- at x = 0.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.integrate import DOP853
from scipy.optimize import brentq

_EXACT = {"rtol": 3e-14, "atol": 1e-17}
_ROOT = {"xtol": 1e-16, "rtol": 1e-15}
_CREEP = 1e-11  # speed over alpha p below which a wall that the ground holds counts as at rest


class Judged(NamedTuple):
    """A followed wall: its highest peak [rad] and the time of it [s], its verdict, and the speeds of its impacts."""

    peak: float
    time: float
    overturned: bool
    speeds: list

    def large_impacts(self, alpha, p):
        """Number of impacts faster than a fall from a rotation of 1e-6 alpha."""
        return sum(speed > p * math.sqrt(2e-6 * alpha * math.sin(alpha)) for speed in self.speeds)


def _root(path, which, low, high):
    return brentq(lambda t: path(t)[which], low, high, **_ROOT)


class _Wall:
    def __init__(self, alpha, p, e, side, samples, step):
        self.alpha, self.p, self.e, self.side = alpha, p, e, side
        self.samples, self.step, self.pieces = np.append(samples, 0.0), step, len(samples) - 1
        self.peak = self.time = 0.0
        self.speeds = []

    def ground(self, piece):
        """Acceleration [g] at the start of a piece, and its slope [g/s]; the ground rests after the record."""
        if piece >= self.pieces:
            return 0.0, 0.0
        return self.samples[piece], (self.samples[piece + 1] - self.samples[piece]) / self.step

    def lifts(self, piece, t, stop):
        """Time from t on at which the ground lifts the wall within a piece; None: it does not."""
        begin, slope = self.ground(piece)
        first, last = (-self.side * (begin + slope * (x - piece * self.step)) for x in (t, stop))
        level = math.tan(self.alpha)
        if first > level * (1 + 1e-15):
            return t
        return max(t, piece * self.step + (-self.side * level - begin) / slope) if last > level else None

    def flow(self, piece):
        begin, slope = self.ground(piece)

        def field(t, y):
            u, left = begin + slope * (t - piece * self.step), self.alpha - y[0]
            return [y[1], -(self.p**2) * (math.sin(left) + self.side * u * math.cos(left))]

        return field

    def note(self, x, t):
        if x > self.peak * (1 + 1e-12):
            self.peak, self.time = x, t

    def rock(self, piece, t, x, v, stop, quiet):
        """Follow the wall to its impact, to the end of the piece, or, after the record, to its turn or fall."""
        solver = DOP853(self.flow(piece), t, [x, v], stop, max_step=min(0.25 / self.p, self.step), **_EXACT)
        while solver.status == "running":
            (old, before), begins = solver.y, solver.t
            solver.step()
            path, t = solver.dense_output(), solver.t
            parts = [begins, t]
            if before * solver.y[1] < 0:
                turn = _root(path, 1, begins, t)
                parts.insert(1, turn)
                if before > 0:
                    self.note(path(turn)[0], turn)
                    if quiet and path(turn)[0] < self.alpha:
                        return "stands", turn, 0.0, 0.0
            for low, high in zip(parts, parts[1:]):
                # A wall that leaves the ground does so with zero opening.
                low = low + 1e-3 * (high - low) if low == begins and old == 0 else low
                if path(low)[0] > 0 >= path(high)[0]:
                    at = _root(path, 0, low, high)
                    self.speeds.append(-path(at)[1])
                    return "impact", at, 0.0, -self.e * path(at)[1]
            if solver.y[0] > math.pi / 2:
                return "overturns", t, *solver.y
        assert solver.status == "finished"
        return "goes on", t, *solver.y

    def result(self, overturned):
        peak, time = (math.inf, math.inf) if overturned else (self.peak, self.time)
        return Judged(peak, time, overturned, self.speeds)


def followed(alpha, p, e, side, samples, step, initial=(0.0, 0.0)):
    """Follow a wall on a side (1 or -1) under samples [g], `step` seconds apart, and after them to its end."""
    wall = _Wall(alpha, p, e, side, samples, step)
    x, v, t, piece = side * initial[0], side * initial[1], 0.0, 0
    moves = x > 0 or v > 0
    wall.note(x, t)
    while True:
        quiet = piece >= wall.pieces
        stop = t + 100 / p if quiet else (piece + 1) * step
        if not moves:
            lifted = wall.lifts(piece, t, stop)
            if quiet:
                return wall.result(False)
            if lifted is None:
                piece, t = piece + 1, stop
                continue
            t, moves = lifted, True
        ends, t, x, v = wall.rock(piece, t, x, v, stop, quiet)
        if ends in ("stands", "overturns"):
            return wall.result(ends == "overturns")
        if ends == "goes on":
            piece += 1
        elif v < _CREEP * alpha * p and wall.flow(piece)(t, [0.0, 0.0])[1] < 0:
            x, v, moves = 0.0, 0.0, False
