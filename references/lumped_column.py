"""A rigid rod with lumped masses on a rotational spring, by SciPy: what judges `Spring("mmSM", masses=n)`.

Written mass by mass, from the sums of their moments: nothing is known here of a moment of inertia.
"""

import numpy as np
from scipy.integrate import solve_ivp

GRAVITY = 9.81
MASS = 3.0  # of the whole block [kg]; plays no part


def masses_along(count, length):
    """Heights and masses of the part of a uniform rod that is nearest to each of its points."""
    edges = np.concatenate([[0.0], (np.arange(1, count) - 0.5) / (count - 1), [1.0]])
    return length * np.linspace(0, 1, count), MASS * np.diff(edges)


def history(alpha, radius, restitution, law, count, acceleration, breaks, time):
    """Rotation and velocity of the rod at given times, and the times of impacts.

    `acceleration(t)` is that of the ground over g, smooth but at `breaks`; `radius` half the block's diagonal [m].
    """
    height, mass = masses_along(count, 2 * radius)
    strength = MASS * GRAVITY * radius * np.sin(alpha)

    def turning(x, push):
        """Sum of the moments of all masses over that of their inertia; x opens, push drives it back."""
        held = {
            "sine": MASS * GRAVITY * radius * np.sin(alpha - x),
            "linear": strength * (1 - x / alpha),
            "plastic": strength - np.sum(mass * GRAVITY * height * np.sin(x)),
        }[law]
        driven = np.sum(mass * GRAVITY * np.cos(alpha) * push * height * np.cos(x))
        return -(held + driven) / np.sum(mass * height**2)

    def pushing(t):
        return abs(acceleration(t)) - np.tan(alpha)

    start = solve_ivp(lambda t, y: [0.0], (0, breaks[-1]), [0.0], events=_stop(lambda t, y: pushing(t)), max_step=1e-3)
    t, side = start.t[-1], -np.sign(acceleration(start.t[-1]))
    state, pieces, impacts = [0.0, 0.0], [], []
    ends = [*(b for b in breaks if b > t), time[-1]]
    while t < time[-1]:
        begin = t

        def flow(t, y, side=side):
            return [y[1], turning(y[0], side * acceleration(t))]

        found = solve_ivp(
            flow, (t, ends[0]), state, "DOP853", rtol=1e-12, atol=1e-15, dense_output=True, max_step=0.05,
            events=_stop(lambda t, y, begin=begin: y[0] if t > begin + 1e-6 else 1.0, -1),
        )  # fmt: skip
        pieces.append((begin, found.t[-1], side, found.sol))
        t, state = found.t[-1], [found.y[0, -1], found.y[1, -1]]
        if found.t_events[0].size:
            impacts.append(t)
            state, side = [0.0, -restitution * state[1]], -side
        else:
            ends.pop(0)
    values = np.zeros((2, len(time)))
    for begin, end, side, solution in pieces:
        inside = (time >= begin) & (time <= end)
        values[:, inside] = side * solution(time[inside])
    return values[0], values[1], np.array(impacts)


def _stop(function, direction=1):
    function.terminal, function.direction = True, direction
    return function
