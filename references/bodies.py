"""Frames and strip walls by Newton's law for every body, with the forces between them as unknowns, and DOP853.

It shares no code and no method with jaxrock, which eliminates the forces by energy. The same unknowns, as impulses,
give the impact. In a mechanism that opens to side s, horizontal lengths count to that side.
"""

from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

GRAVITY = 9.81


class Frame(NamedTuple):
    """One of alike columns (mass 1, slenderness, half diagonal [m], m R^2/I) and its share of the beam."""

    alpha: float
    radius: float
    beam: float
    ratio: float = 0.75

    def accelerate(self, opening, speed, push, lift):
        """Acceleration of the opening [1/s^2], horizontal and vertical force under the column over all weight."""
        x, y = -self.radius * np.sin(self.alpha - opening), self.radius * np.cos(self.alpha - opening)
        inertia = self.radius**2 * (1 / self.ratio - 1)
        # Unknown: acceleration, base (horizontal, vertical), beam on column (horizontal, vertical).
        matrix = [
            [y, -1, 0, -1, 0],
            [-x, 0, -1, 0, -1],
            [inertia, y, -x, -y, x],
            [2 * self.beam * y, 0, 0, 1, 0],
            [-2 * self.beam * x, 0, 0, 0, 1],
        ]
        inward, down = -x * speed**2, -y * speed**2
        known = [
            -inward - push * GRAVITY,
            -down - lift * GRAVITY,
            0.0,
            self.beam * (-2 * inward - push * GRAVITY),
            self.beam * (-2 * down - lift * GRAVITY),
        ]
        found = np.linalg.solve(matrix, known)
        return found[0], *(found[1:3] / (GRAVITY * (1 + self.beam)))

    @property
    def restitution(self):
        """Speed after an impact at speed 1: columns turn about their other corners, under the beam's other points."""
        x, y = self.radius * np.sin(self.alpha), self.radius * np.cos(self.alpha)  # half width and height
        inertia = self.radius**2 * (1 / self.ratio - 1)
        # Velocities before: -y, -x, turning by 1; after: -y e, x e, e. Impulses at (-x, -y) and (x, y).
        matrix = [
            [-y, -1, 0, -1, 0],
            [x, 0, -1, 0, -1],
            [inertia, -y, x, y, -x],
            [-2 * self.beam * y, 0, 0, 1, 0],
            [2 * self.beam * x, 0, 0, 0, 1],
        ]
        return np.linalg.solve(matrix, [-y, -x, inertia, -2 * self.beam * y, -2 * self.beam * x])[0]


class StripWall(NamedTuple):
    """A wall of two alike halves, hinged where it cracks, whose top can only rise: slenderness and half diagonal [m] of
    a half (of mass 1), m R^2/I."""

    alpha: float
    radius: float
    ratio: float = 0.75

    def accelerate(self, opening, speed, push, lift):
        """Acceleration of the opening [1/s^2]."""
        x, y = -self.radius * np.sin(self.alpha - opening), self.radius * np.cos(self.alpha - opening)
        inertia = self.radius**2 * (1 / self.ratio - 1)
        # Unknown: acceleration, base (2), upper half on lower half (2), top (horizontal).
        matrix = [
            [y, -1, 0, -1, 0, 0],
            [-x, 0, -1, 0, -1, 0],
            [inertia, y, -x, -y, x, 0],
            [y, 0, 0, 1, 0, -1],
            [-3 * x, 0, 0, 0, 1, 0],
            [inertia, 0, 0, y, x, y],
        ]
        inward, down = -x * speed**2, -y * speed**2
        weigh, shake = lift * GRAVITY, push * GRAVITY
        known = [-inward - shake, -down - weigh, 0.0, -inward - shake, -3 * down - weigh, 0.0]
        return (np.linalg.solve(matrix, known)[0],)

    @property
    def restitution(self):
        """Speed after an impact at speed 1: the hinges change the face of the wall."""
        x, y = self.radius * np.sin(self.alpha), self.radius * np.cos(self.alpha)
        inertia = self.radius**2 * (1 / self.ratio - 1)
        # Before: both move by -y, the halves sink by x and 3 x, and turn by 1 and -1. Impulses: base (-x, -y), middle
        # (x, y) of the lower half and (x, -y) of the upper, top (-x, y) of the upper.
        matrix = [
            [-y, -1, 0, -1, 0, 0],
            [x, 0, -1, 0, -1, 0],
            [inertia, -y, x, y, -x, 0],
            [-y, 0, 0, 1, 0, -1],
            [3 * x, 0, 0, 0, 1, 0],
            [-inertia, 0, 0, y, x, y],
        ]
        return np.linalg.solve(matrix, [-y, -x, inertia, -y, -3 * x, -inertia])[0]


def respond(body, start, times, push, lift=lambda t: 1.0):
    """Rotation, velocity [rad/s] and forces at times, and the times of impacts, from a start that is not at rest.

    `push`: acceleration of the ground [g]; `lift`: 1 + its vertical acceleration.
    """
    side = np.sign(start[0]) or np.sign(start[1])
    state, begin = np.abs(start[0]), times[0]
    state = np.array([state, side * start[1]])
    found, impacts = np.full((len(times), 1 + len(body.accelerate(0.1, 0.0, 0.0, 1.0))), np.nan), []

    def ground(t, y):
        return y[0] if t > begin + 1e-9 else 1.0

    ground.terminal, ground.direction = True, -1
    while begin < times[-1]:

        def flow(t, y, side=side):
            return [y[1], body.accelerate(y[0], y[1], side * push(t), lift(t))[0]]

        arc = solve_ivp(flow, (begin, times[-1]), state, "DOP853", events=ground, rtol=1e-12, atol=1e-14,
                        dense_output=True, max_step=0.05)  # fmt: skip
        for k in np.flatnonzero((times >= begin) & (times <= arc.t[-1])):
            angle, speed = arc.sol(times[k])
            forces = body.accelerate(angle, speed, side * push(times[k]), lift(times[k]))[1:]
            found[k] = side * angle, side * speed, *(f * (side if n == 0 else 1) for n, f in enumerate(forces))
        if arc.status != 1:
            break
        begin, state = arc.t[-1], np.array([0.0, -body.restitution * arc.y[1, -1]])
        side = -side
        impacts.append(begin)
    return found, np.array(impacts)
