"""A flexible column on a spring by SciPy: what judges `FlexibleBlock`, and the columns of the paper."""

import numpy as np
from scipy.integrate import solve_ivp

import jaxrock as rk

TALL = dict(width=5.0, height=50.0, youngs_modulus=30e9, density=2500.0)  # Diamantopoulos & Fragiadakis, figure 22
SHORT = dict(width=5.0, height=25.0, youngs_modulus=30e9, density=2500.0)  # figure 23
PULSE = rk.SinePulse(0.5, 1.6)


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
