"""The free rigid body once more, in float64: SciPy's DOP853 (rtol 1e-13) with its own motions and events.

Unknowns X Y q X' Y' q' and the ground's Gx Gy Gx' Gy'; forces from the 5 x 5 system of rigid.py at every call.
"""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from references.asymmetric.bodies import BODIES
from references.asymmetric.rigid import balance

GRAVITY = 9.81
OPTIONS = {"rtol": 1e-13, "atol": 1e-15, "method": "DOP853"}
MOST_IMPACTS = 40


def numpy_motion(name):
    """Acceleration in g as a float function, and its knots."""
    kind, *n = name
    if kind == "sine":
        return lambda t: n[0] * np.sin(2 * np.pi * t / n[1]) if 0 <= t <= n[1] else 0.0, [0, n[1]]
    if kind == "rectangle":
        return lambda t: n[0] if 0 <= t <= n[1] else 0.0, [0, n[1]]
    if kind == "exponential":

        def value(t):
            x = min(t, n[1] - t) / n[1]
            return n[0] * np.expm1(2 * n[2] * x) / np.expm1(n[2]) if x >= 0 else 0.0

        return value, [0, n[1] / 2, n[1]]
    times = n[1] * np.arange(len(n[0]))
    return lambda t: float(np.interp(t, times, np.multiply(n[2], n[0]), right=0.0)), list(times)


def numpy_ground(c):
    """Horizontal and vertical acceleration [g] as a pair, and the knots of both."""
    horizontal, knots = numpy_motion(c["horizontal"])
    if not c["vertical"]:
        return lambda t: (horizontal(t), 0.0), knots
    vertical, more = numpy_motion(c["vertical"]["motion"])
    return lambda t: (horizontal(t), c["vertical"]["factor"] * vertical(t)), sorted({*knots, *more})


def turned(q, rho):
    """A vector of the body, turned clockwise."""
    return np.array([[np.cos(q), np.sin(q)], [-np.sin(q), np.cos(q)]]) @ rho


class FloatRun:
    """One body on its way through the motion."""

    def __init__(self, c):
        b1, h1, b2, h2, self.inertia = BODIES[c["body"]]
        self.corner = {1: np.array([b1, -h1]), -1: np.array([-b2, -h2])}
        self.acceleration, self.knots = numpy_ground(c)
        self.low = self.high = self.t = 0.0
        self.impacts, self.y = [], np.zeros(10)
        self.y[2], self.y[5] = c["initial"]
        self.side = int(np.sign(self.y[2]) or np.sign(self.y[5]))
        self.place()

    def place(self):
        """Centre of mass and its velocity from the rotation about the corner."""
        y, rho = self.y, self.corner[self.side or 1]
        d = turned(y[2], rho)
        y[:2] = y[6:8] + rho - d
        y[3:5] = y[8:10] + y[5] * np.array([-d[1], d[0]])

    def ground(self, t):
        """Acceleration of the ground [g] within the piece: its limits at the knots."""
        margin = 1e-13 * (self.high - self.low)
        return np.array(self.acceleration(min(max(t, self.low + margin), self.high - margin)))

    def push(self, t, s):
        """Positive where the block at rest leaves the ground to side s."""
        (b, h), (u, v) = np.abs(self.corner[s]), self.ground(t)
        return -s * h * u - b * (1 + v)

    def rates(self, t, y):
        """Velocities and accelerations of body and ground."""
        dx, dy = turned(y[2], self.corner[self.side])
        ground = GRAVITY * self.ground(t)
        right = np.array([0, -GRAVITY, 0, *(ground + y[5] ** 2 * np.array([dx, dy]))])
        z = np.linalg.solve(np.array(balance(self.inertia, dx, dy)), right)
        return [*y[3:6], *z[:3], y[8], y[9], *ground]

    def carry(self, until):
        """The ground alone, the block at rest on it."""
        if until > self.t:
            rates = lambda t, y: [*y[2:], *(GRAVITY * self.ground(t))]  # noqa: E731
            self.y[6:] = solve_ivp(rates, (self.t, until), self.y[6:], **OPTIONS).y[:, -1]
        self.t = until

    def wait(self):
        """At rest: to the first uplift, or to the end of the piece."""
        grid = np.linspace(self.t, self.high, 4001)
        push = {s: np.array([self.push(t, s) for t in grid]) for s in (1, -1)}
        first = {s: np.argmax(x > 0) for s, x in push.items() if (x > 0).any()}
        if not first:
            self.carry(self.high)
            return
        s = min(first, key=first.get)
        i = first[s]
        self.carry(grid[i] if i == 0 else brentq(self.push, grid[i - 1], grid[i], args=(s,), xtol=1e-16))
        self.side = s
        self.place()

    def land(self):
        """Impulse and momentum with the other corner caught by the ground."""
        y = self.y
        self.impacts.append((self.t, y[5]))
        self.side = -self.side
        matrix = np.array(balance(self.inertia, *self.corner[self.side]))
        y[2], y[5] = 0.0, np.linalg.solve(matrix, np.array([*y[3:5], self.inertia * y[5], *y[8:10]]))[2]
        self.place()

    def arc(self):
        """To the next impact or the end of the piece. False once fallen flat, or after too many impacts."""
        impact = lambda t, y: self.side * y[2] + 1e-300  # noqa: E731
        flat = lambda t, y: self.side * y[2] - np.pi / 2  # noqa: E731
        impact.terminal, impact.direction, flat.terminal = True, -1, True
        found = solve_ivp(self.rates, (self.t, self.high), self.y, events=[impact, flat], **OPTIONS)
        self.t, self.y = found.t[-1], found.y[:, -1].copy()
        if found.t_events[0].size:
            self.land()
        return not found.t_events[1].size and len(self.impacts) <= MOST_IMPACTS

    def follow(self):
        """Impacts (time, velocity before), time at the end, and the state there (None if it was not reached)."""
        for low, high in zip(self.knots, self.knots[1:]):
            self.low, self.high, self.t = low, high, low
            while self.t < self.high - 1e-12:
                if self.side == 0:
                    self.wait()
                elif not self.arc():
                    return self.impacts, self.t, None
        return self.impacts, self.t, (self.y[2], self.y[5])
