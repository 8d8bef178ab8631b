"""A flexible column on a spring by SciPy: what judges `FlexibleBlock`, and the columns of the paper."""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import eigh

import jaxrock as rk

TALL = dict(width=5.0, height=50.0, youngs_modulus=30e9, density=2500.0)  # Diamantopoulos & Fragiadakis, figure 22
SHORT = dict(width=5.0, height=25.0, youngs_modulus=30e9, density=2500.0)  # figure 23
PULSE = rk.SinePulse(0.5, 1.6)
# Options of XLA for columns that are many: by the hundred they run for longer than they are compiled.
FOR_LONG = {"xla_backend_optimization_level": 1}


def largest_survived(overturned, low, high):
    """Amplitude [g] between two just below which the verdict changes: of nine at a time, ten times over.
    `overturned`: verdicts (n,) at amplitudes (n,)."""
    for _ in range(10):
        tried = np.linspace(low, high, 9)
        lost = np.asarray(overturned(tried))
        assert lost[-1] and not lost[0]
        first = int(np.argmax(lost))
        low, high = tried[first - 1], tried[first]
    return low


def beam(masses, length, bending, mass):
    """Masses, heights and stiffness of a clamped cantilever, from its flexibility y^2 (3 Y - y)/(6 EI)."""
    elements = masses - 1
    y = length * np.arange(1, masses) / elements
    low, high = np.minimum.outer(y, y), np.maximum.outer(y, y)
    lumped = np.full(elements, mass / elements)
    lumped[-1] /= 2
    return lumped, y, np.linalg.inv(low**2 * (3 * high - low) / (6 * bending))


def independent(block, motion, duration):
    """Base rotation and displacements by SciPy: the matrix equations in displacements, phase by phase with events.

    The damping is in proportion to stiffness, so that the base's rotation has an equation of first order.
    """
    width, height, modulus, density, ratio = (
        float(getattr(block, k)) for k in ("width", "height", "youngs_modulus", "density", "damping_ratio")
    )
    length, alpha, g = np.hypot(width, height), np.arctan2(width, height), 9.81
    mass = density * width * height
    m, y, stiffness = beam(block.masses, length, modulus * width**3 / 12, mass)
    n, strength = len(y), mass * g * length / 2 * np.sin(alpha)
    lever, kappa = stiffness @ y, y @ stiffness @ y
    a1 = 2 * ratio / np.sqrt(np.linalg.eigvalsh(stiffness / np.sqrt(np.outer(m, m)))[0])
    ground = float(motion.amplitude) * g * np.cos(alpha)

    def rates(t, x, side):
        u, v, theta = x[:n], x[n:-1], x[-1]
        push = lever @ (u + a1 * v)
        turn = (push - (kappa - strength / alpha) * theta - side * strength) / (a1 * kappa) if side else 0.0
        load = ground * np.sin(2 * np.pi * t / float(motion.period)) if t < float(motion.period) else 0.0
        force = stiffness @ (u + a1 * v) - lever * (theta + a1 * turn)
        return np.concatenate([v, -force / m - load, [turn]])

    t, x, side, last = 0.0, np.zeros(2 * n + 1), 0, 0
    pieces, impacts = [], []
    while t < duration:
        stop = float(motion.period) if t < float(motion.period) else duration

        def edge(t, x, side=side):
            return side * x[-1] if side else strength - abs(lever @ (x[:n] + a1 * x[n:-1]))

        edge.terminal, edge.direction = True, -1
        path = solve_ivp(
            lambda t, x, side=side: rates(t, x, side), (t, stop), x, "DOP853", events=edge, rtol=1e-10, atol=1e-13,
            dense_output=True, max_step=0.02,
        )  # fmt: skip
        pieces.append((t, path.t[-1], path.sol))
        t, x = path.t[-1], path.y[:, -1].copy()
        if path.status == 1 and side:
            if side != last:
                impacts.append(t)
                x[n:-1] *= float(block.restitution)
            x[-1], last = 0.0, side
            pushed = lever @ (x[:n] + a1 * x[n:-1])
            side = int(np.sign(pushed)) if abs(pushed) > strength else 0
        elif path.status == 1:
            side = int(np.sign(lever @ (x[:n] + a1 * x[n:-1])))

    def at(time):
        found = next(path for start, end, path in reversed(pieces) if time >= start)(time)
        return found[-1], np.cos(alpha) * found[n - 1]

    return at, impacts


def pieces_of(motion):
    """Return start, end and acceleration [g] of each smooth piece of a pulse or a record, by its own formula."""
    if isinstance(motion, rk.Record):
        dt, samples = float(motion.dt), np.asarray(motion.samples)
        lines = zip(dt * np.arange(samples.size - 1), samples, samples[1:])
        return [(t, t + dt, lambda x, t=t, a=a, b=b: a + (b - a) * (x - t) / dt) for t, a, b in lines]
    size = float(motion.amplitude)
    if isinstance(motion, rk.RectangularPulse):
        return [(0.0, float(motion.duration), lambda t: size)]
    period = float(motion.period)
    wave = {rk.SinePulse: np.sin, rk.CosinePulse: np.cos}[type(motion)]
    return [(0.0, period, lambda t: size * wave(2 * np.pi * t / period))]


class Chain:
    """A column with any damping, finite rotations, any law of its base and its weight, by SciPy.

    It is a chain of rigid elements that springs hold straight, in the angles of its elements. Masses move by the sum of
    the elements below them. The Jacobian of places by angles turns forces into moments of the elements.
    """

    def __init__(self, block, motion):
        width, height, modulus, density, ratio = (
            float(getattr(block, k)) for k in ("width", "height", "youngs_modulus", "density", "damping_ratio")
        )
        self.length, self.alpha = np.hypot(width, height), np.arctan2(width, height)
        self.mass = density * width * height
        self.base, self.p_delta, self.finite = block.base, block.p_delta, block.rotations == "finite"
        self.masses, _, stiffness = beam(block.masses, self.length, modulus * width**3 / 12, self.mass)
        self.count = len(self.masses)
        self.arms = np.tri(self.count) * self.length / self.count  # of elements, on masses
        self.bend = self.arms.T @ stiffness @ self.arms
        self.drag, loss = damping_of(block.damping, ratio, self.masses, stiffness)
        self.loss = self.arms.T @ loss @ self.arms
        self.bend_of_base, self.loss_of_base = self.bend.sum(0), self.loss.sum(0)
        self.restitution, self.every = float(block.restitution), block.impacts == "every"
        self.pieces = pieces_of(motion)
        self.moment = self.mass * 9.81 * self.length / 2

    def places(self, angles):
        """How masses move with the angles, across and up."""
        sine, cosine = (np.sin(angles), np.cos(angles)) if self.finite else (angles, np.ones_like(angles))
        return self.arms * cosine, -self.arms * sine

    def spring(self, theta, side):
        """Moment of the base."""
        sine = np.sin(theta) if self.finite else theta
        x = side * theta
        law = {"sine": np.sin(self.alpha - x), "linear": np.sin(self.alpha) * (1 - x / self.alpha),
               "plastic": np.sin(self.alpha) - side * sine}[self.base]  # fmt: skip
        return self.moment * (side * law + self.p_delta * sine)

    def turn(self, angles, speeds, theta, side):
        """Velocity of the base, from the balance of moments there: damping holds it back."""
        held = self.bend_of_base @ angles - self.bend_of_base.sum() * theta - self.spring(theta, side)
        return (held + self.loss_of_base @ speeds) / self.loss_of_base.sum()

    def rates(self, x, side, ground):
        """Return rates of angles, their speeds and the base's rotation under the ground's acceleration [g]."""
        angles, speeds, theta = x[: self.count], x[self.count : -1], x[-1]
        turn = self.turn(angles, speeds, theta, side) if side else 0.0
        across, up = self.places(angles)
        push = -9.81 * ground * np.cos(self.alpha) * self.masses
        moments = across.T @ push - self.bend @ (angles - theta) - self.loss @ (speeds - turn)
        if self.p_delta:
            moments -= up.T @ (9.81 * self.masses) if self.finite else -self.arms.T @ (9.81 * self.masses) * angles
        inertia = across.T @ (self.masses[:, None] * across)
        if self.finite:
            inertia = inertia + up.T @ (self.masses[:, None] * up)
            # Masses on a circle: toward its centre.
            moments = (
                moments - across.T @ (self.masses * (up @ speeds**2)) + up.T @ (self.masses * (across @ speeds**2))
            )
        moments = moments - self.drag * (inertia @ speeds)
        return np.concatenate([speeds, np.linalg.solve(inertia, moments), [turn]])

    def held(self, x):
        """Moment at a locked base."""
        return self.bend_of_base @ x[: self.count] + self.loss_of_base @ x[self.count : -1]

    def follow(self, duration, tolerance=1e-10):
        """Paths (start, end, function) and times of impacts."""
        strength = self.moment * np.sin(self.alpha)
        t, x, side, last, stay, braked = 0.0, np.zeros(2 * self.count + 1), 0, 0, 0.0, 0.0
        paths, impacts = [], []
        quiet = (self.pieces[-1][1], np.inf, lambda t: 0.0)
        while t < duration:
            _, stop, ground = next(piece for piece in [*self.pieces, quiet] if t < piece[1] * (1 - 1e-15))

            def edge(t, x, side=side):
                return side * x[-1] if side else strength - abs(self.held(x))

            edge.terminal, edge.direction = True, -1
            path = solve_ivp(
                lambda t, x, side=side, ground=ground: self.rates(x, side, ground(t)), (t, min(stop, duration)), x,
                "DOP853", events=edge, rtol=tolerance, atol=tolerance / 1000, dense_output=True, max_step=0.02,
            )  # fmt: skip
            paths.append((t, path.t[-1], path.sol))
            stay = stay + path.t[-1] - t if side else 0.0
            t, x = path.t[-1], path.y[:, -1].copy()
            if path.status == 1 and side:
                if self.every or side != last or stay > braked:
                    impacts.append(t)
                    x[self.count : -1] *= self.restitution
                    braked = stay
                x[-1], last, stay = 0.0, side, 0.0
                pushed = self.held(x)
                side = int(np.sign(pushed)) if abs(pushed) > strength else 0
            elif path.status == 1:
                side = int(np.sign(self.held(x)))
        return paths, impacts

    def at(self, pieces, time):
        """Rotation of the base, and displacement of the top [m]."""
        found = next(path for start, end, path in reversed(pieces) if time >= start)(time)
        angles = found[: self.count]
        across = self.length / self.count * np.sum(np.sin(angles) if self.finite else angles)
        return found[-1], np.cos(self.alpha) * across

    def peak(self, paths):
        """Return the largest |rotation| of the base, at vertices of parabolas through points of all paths."""
        found = 0.0
        for start, end, path in paths:
            turned = np.abs(path(np.linspace(start, end, 800))[-1])
            k = int(np.clip(np.argmax(turned), 1, turned.size - 2))
            slope, bend = (turned[k + 1] - turned[k - 1]) / 2, turned[k + 1] - 2 * turned[k] + turned[k - 1]
            inside = bend < 0 and abs(slope) <= -bend
            found = max(found, turned.max(), turned[k] - slope**2 / (2 * bend) if inside else 0.0)
        return found


def damping_of(kind, ratio, masses, stiffness):
    """Return the decay rate of all masses, and the damping matrix of the column's bending."""
    squares, shapes = eigh(stiffness, np.diag(masses))
    rates = np.sqrt(squares)
    if kind == "stiffness":
        return 0.0, 2 * ratio / rates[0] * stiffness
    if kind == "modal":
        weighed = masses[:, None] * shapes
        return 0.0, weighed @ np.diag(2 * ratio * rates) @ weighed.T
    part = 2 * ratio / (rates[0] + rates[1])
    return part * rates[0] * rates[1], part * stiffness
