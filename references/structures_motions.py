"""Ground motions and floors for `references.structures`, piece by piece, in numbers of any type."""

import math
from typing import Any, NamedTuple

GRAVITY = 9.81


class Segment(NamedTuple):
    """A smooth stretch of a motion: acceleration [g] from `start` to `end` [s], and the time over which it varies."""

    start: Any
    end: Any
    acceleration: Any
    scale: float = math.inf


def segments_of(given, n):
    """Segments of a motion of a scene; see `references.structures` for its kinds."""
    if given is None:
        return []
    kind, zero = given["kind"], n.of(0)
    if kind == "record":
        dt, u = n.of(given["dt"]), [n.of(value) for value in given["samples"]]

        def line(i):
            slope = (u[i + 1] - u[i]) / dt
            return lambda t: u[i] + slope * (t - i * dt)

        return [Segment(i * dt, (i + 1) * dt, line(i)) for i in range(len(u) - 1)]
    amplitude, period = n.of(given["amplitude"]), n.of(given["period"])
    if kind == "ricker":
        center, rate = n.of(given["center"]), n.pi / period

        def ricker(t):
            y = rate * (t - center)
            return amplitude * (1 - 2 * y * y) * n.exp(-y * y)

        return [Segment(zero, 2 * center, ricker, float(period) / 2)]
    rate = 2 * n.pi / period
    cycles = {"sine": n.of(1), "half sine": n.of(1) / 2, "cosine": n.of(1)}.get(kind) or n.of(given["cycles"])
    function = n.cos if kind == "cosine" else n.sin
    return [Segment(zero, cycles * period, lambda t: amplitude * function(rate * t), float(period))]


class Piece(NamedTuple):
    """A smooth piece of both components; `straight`: both are straight lines."""

    start: Any
    end: Any
    u: Any
    v: Any
    scale: float
    straight: bool


def _nothing(t):
    return 0 * t


def pieces_of(horizontal, vertical, n, after=0):
    """Smooth pieces of a ground motion of two components, and a quiet one of a length after it."""
    both = [segments_of(horizontal, n), segments_of(vertical, n)]
    knots = [n.of(0)]
    for knot in sorted(time for segments in both for s in segments for time in (s.start, s.end)):
        if knot - knots[-1] > 8 * n.close * (1 + knot):  # knots of both components that differ by rounding are one
            knots.append(knot)
    pieces = []
    for start, end in zip(knots, knots[1:]):
        middle = (start + end) / 2
        inside = [next((s for s in segments if s.start <= middle < s.end), None) for segments in both]
        scale = min((s.scale for s in inside if s), default=math.inf)
        u, v = (s.acceleration if s else _nothing for s in inside)
        pieces.append(Piece(start, end, u, v, scale, scale == math.inf))
    if after:
        end = knots[-1] + n.of(after)
        pieces.append(Piece(knots[-1], end, _nothing, _nothing, math.inf, True))
    return pieces


class Floor:
    """A linear chain of storeys under the ground; the block stands on one. State: displacements, then rates (d/dt).

    Storey i has m_i, a spring k_i and a damper c_i to the one below it. Displacements z are relative to the ground, in
    units of g s^2: m z'' = -m u - sum of spring and damper forces.
    """

    def __init__(self, given, n):
        self.count = len(given["masses"]) if "masses" in given else 1
        if self.count > 1 or "masses" in given:
            self.mass, self.spring, self.damper = (
                [n.of(value) for value in given[name]] for name in ("masses", "stiffnesses", "dampings")
            )
        else:
            omega = 2 * n.pi / n.of(given["period"])
            self.mass, self.spring = [n.of(1)], [omega**2]
            self.damper = [2 * n.of(given["damping_ratio"]) * omega]
        self.storey = given.get("storey", self.count) - 1
        fastest = max(2 * math.sqrt(float(k / m)) for k, m in zip(self.spring, self.mass))
        self.scale = 2 * math.pi / fastest * (1 if self.count == 1 else 0.7) * (2 if self.count == 1 else 1)

    def rates(self, state, u):
        """Rates of the state, and the absolute acceleration of the block's storey [g]."""
        z, rate = state[: self.count], state[self.count :]
        force = []
        for i in range(self.count):
            below = (z[i - 1], rate[i - 1]) if i else (0, 0)
            force.append(self.spring[i] * (z[i] - below[0]) + self.damper[i] * (rate[i] - below[1]))
        total = [(-force[i] + (force[i + 1] if i + 1 < self.count else 0)) / self.mass[i] for i in range(self.count)]
        return [*rate, *(value - u for value in total)], total[self.storey]
