"""The loop that a careful engineer writes today: a rocking block with `scipy.integrate.solve_ivp`.

    theta'' = -p^2 [sin(s alpha - theta) + u(t) cos(s alpha - theta)],     theta' *= restitution at theta = 0

One `solve_ivp` (DOP853) from each impact or uplift to the next, in the opening angle x = s theta:

- events: x = 0 downward and escape upward (both terminal), x' = 0 downward (turning points, for the peak);
- a solution that starts at x = 0 would meet its own start again, and a small hop falls through the floor: one
  Runge-Kutta step, at most a quarter of the hop, takes the block off the floor before the events are watched;
- a block whose rebound is negligible rests until the ground acceleration exceeds tan(alpha);
- beyond alpha + arctan(largest |u|), moving outward, no motion brings the block back: it stops there;
- a record is cut at its samples, one `solve_ivp` each, so that no step meets a kink: it then is exact to rounding.
  `Record(..., cut=False)` is the usual short cut, one `solve_ivp` with steps of at most one sample;
- after the motion the energy gives the verdict and the last peak, nothing is integrated.
"""

import math

from scipy.integrate import solve_ivp


class SinePulse:
    """One full cycle of amplitude sin(2 pi t/period) [g]."""

    longest_step = math.inf

    def __init__(self, amplitude: float, period: float):
        self.amplitude, self.rate, self.end = amplitude, 2 * math.pi / period, period
        self.largest = abs(amplitude)

    def __call__(self, time: float) -> float:
        return self.amplitude * math.sin(self.rate * time)

    def next_cut(self, time: float) -> float:
        """Where the smooth piece at `time` ends [s]."""
        return self.end

    def uplift(self, time: float, threshold: float) -> float | None:
        """First time from `time` on at which |u| exceeds the threshold [s]."""
        if self.largest <= threshold:
            return None
        angle = math.asin(threshold / self.largest)
        for start in (0.0, math.pi):
            if self.rate * time < start + math.pi - angle:
                return max(time, (start + angle) / self.rate)
        return None


class Record:
    """An accelerogram [g]: straight lines between samples dt apart; `cut`: integrated piece by piece."""

    def __init__(self, samples, dt: float, cut: bool = True):
        self.samples, self.dt, self.cut = [float(u) for u in samples], dt, cut
        self.last = len(self.samples) - 2
        self.end = dt * (len(self.samples) - 1)
        self.largest = max(abs(u) for u in self.samples)
        self.longest_step = math.inf if cut else dt

    def __call__(self, time: float) -> float:
        index = min(int(time / self.dt), self.last)
        left = self.samples[index]
        return left + (self.samples[index + 1] - left) * (time / self.dt - index)

    def next_cut(self, time: float) -> float:
        """Where the smooth piece at `time` ends [s]."""
        return min(self.dt * (int(time / self.dt + 1e-9) + 1), self.end) if self.cut else self.end

    def uplift(self, time: float, threshold: float) -> float | None:
        """First time from `time` on at which |u| exceeds the threshold [s]."""
        now = self(time)
        if abs(now) > threshold:
            return time
        for index in range(min(int(time / self.dt), self.last), self.last + 1):
            left, right = self.samples[index], self.samples[index + 1]
            if abs(right) > threshold:
                share = (math.copysign(threshold, right) - left) / (right - left)
                return max(time, (index + share) * self.dt)
        return None


def launch(acceleration, time, speed, longest):
    """Leave the floor by one classical Runge-Kutta step: at most `longest`, at most a quarter of the hop."""
    pull = -acceleration(time, 0.0)
    flight = 2 * speed / pull if pull > 0 and speed > 0 else math.inf
    h = min(longest, flight / 4)
    v1, a1 = speed, -pull
    v2, a2 = speed + h / 2 * a1, acceleration(time + h / 2, h / 2 * v1)
    v3, a3 = speed + h / 2 * a2, acceleration(time + h / 2, h / 2 * v2)
    v4, a4 = speed + h * a3, acceleration(time + h, h * v3)
    x, v = h / 6 * (v1 + 2 * v2 + 2 * v3 + v4), speed + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
    return time + h, x, v, flight


def equations(alpha, p, side, motion):
    """The acceleration x''(t, x), the right-hand side for `solve_ivp`, and the three events."""
    square, escape = p * p, min(math.pi / 2, alpha + math.atan(motion.largest))
    sin, cos = math.sin, math.cos

    def acceleration(t, x):
        return -square * (sin(alpha - x) + side * motion(t) * cos(alpha - x))

    def flow(t, state):
        x, v = state.tolist()
        return v, acceleration(float(t), x)

    def impact(t, state):
        return state[0]

    def lost(t, state):
        return state[0] - escape

    def turn(t, state):
        return state[1]

    impact.terminal, impact.direction = True, -1
    lost.terminal, lost.direction = True, 1
    turn.direction = -1
    return acceleration, flow, (impact, lost, turn)


def excursion(alpha, p, side, motion, time, speed, rtol, atol):
    """One excursion from the floor at `time` with `speed`, up to the next event or the end of the motion.

    **Returns:** time, x, x', the largest turning point, and "impact", "escape" or "end".
    """
    acceleration, flow, events = equations(alpha, p, side, motion)
    time, x, v, flight = launch(acceleration, time, speed, min(1e-4 / p, (motion.next_cut(time) - time) / 2))
    if x <= 0:  # a hop too short to be seen
        return time, 0.0, min(v, 0.0), 0.0, "impact"
    highest, first = 0.0, min(flight / 4, 0.05 / p)
    while time < motion.end:
        stop = motion.next_cut(time)
        solution = solve_ivp(
            flow, (time, stop), (x, v), "DOP853", events=events, rtol=rtol, atol=atol,
            first_step=min(first, motion.longest_step, stop - time), max_step=motion.longest_step,
        )  # fmt: skip
        if not solution.success:
            raise ArithmeticError(solution.message)
        time, (x, v), first = float(solution.t[-1]), solution.y[:, -1].tolist(), math.inf
        highest = max([highest, *(float(state[0]) for state in solution.y_events[2])])
        if solution.status == 1:
            return time, x, v, highest, "impact" if len(solution.t_events[0]) else "escape"
    return time, x, v, highest, "end"


def free_rocking(alpha, p, restitution, x, v):
    """After the motion: the largest x still to come (inf if the block overturns), and the impact that decides it."""
    missing = (2 * math.sin((alpha - x) / 2)) ** 2 - (v / p) ** 2  # energy up to balance, times 2/p^2
    balanced = (2 * math.sin(alpha / 2)) ** 2
    inward = v < 0 and (x < alpha or missing < 0)
    if inward:
        missing = balanced - restitution**2 * (balanced - missing)
    if missing < 0 or (x >= alpha and not inward):
        return math.inf, int(inward)
    return max(x, alpha - 2 * math.asin(math.sqrt(missing) / 2)), 0


def peak(alpha, p, restitution, motion, rtol, atol):
    """Largest |rotation| of a block at rest under a motion and in the free rocking after it.

    **Arguments:**

    - `alpha`, `p`, `restitution`: slenderness [rad], frequency parameter [rad/s], restitution [-].
    - `motion`: a `SinePulse` or a `Record`.
    - `rtol`, `atol`: tolerances of `solve_ivp`. A rebound below max(1e-9, rtol) p alpha counts as rest.

    **Returns:** peak [rad] (inf if overturned), impacts during the motion (and the one after it that overturns),
    whether it overturned.
    """
    negligible = max(1e-9, rtol) * p * alpha
    time, speed, side, highest, impacts = 0.0, 0.0, 0, 0.0, 0
    while time < motion.end:
        if speed < negligible:  # at rest
            lift = motion.uplift(time, math.tan(alpha))
            if lift is None or lift >= motion.end:
                return highest, impacts, False
            middle = min(lift + 1e-9 / p, motion.end)  # the sign of u at the threshold itself, beyond doubt
            time, speed, side = lift, 0.0, -1 if motion(middle) > 0 else 1
        time, x, v, turning, event = excursion(alpha, p, side, motion, time, speed, rtol, atol)
        highest = max(highest, turning)
        if event == "escape":
            return math.inf, impacts, True
        if event == "end":
            last, decisive = free_rocking(alpha, p, restitution, x, v)
            return max(highest, last), impacts + decisive, math.isinf(last)
        impacts, speed, side = impacts + 1, -restitution * min(v, 0.0), -side
    # An impact at the very end of the motion.
    last, decisive = free_rocking(alpha, p, restitution, 0.0, speed)
    return max(highest, last), impacts + decisive, math.isinf(last)
