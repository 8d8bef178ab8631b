"""The loop that is usually written: SciPy's `solve_ivp` (DOP853), from each impact or uplift to the next.

The opening angle x is integrated with the side frozen. From the ground the event is x over the time since then, whose
limit is the velocity, so that no hop is missed at its own start; the first step is a quarter of the hop at most. A
record is cut at its samples, one call each: even at a loose tolerance it then is exact to rounding. `cut=False` is the
usual short cut, steps of at most one sample across the kinks. A dip through the floor within one step is found at its
lowest point. After the motion the energy gives the verdict and the last peak, nothing is integrated. Many scenes go in
one process a core.
"""

import concurrent.futures
import functools
import math
import multiprocessing
import os

from references import peer_problems as problems

CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Sine:
    """One full cycle of a sine."""

    def __init__(self, amplitude, rate):
        self.amplitude, self.rate, self.end = amplitude, rate, 2 * math.pi / rate
        self.largest, self.longest = amplitude, 0.8 / rate

    def next_cut(self, t):
        """Where the smooth piece at t ends."""
        return self.end

    def __call__(self, t):
        return self.amplitude * math.sin(self.rate * t)

    def uplift(self, t, threshold):
        """First time from t on at which |u| exceeds the threshold, and the side; None if there is none."""
        if self.amplitude <= threshold:
            return None
        angle = math.asin(threshold / self.amplitude)
        for time, side in ((angle / self.rate, -1), ((math.pi + angle) / self.rate, 1)):
            if t < time:
                return time, side
        return None


class Exponential:
    """An exponential pulse of duration 2 pi/rate."""

    def __init__(self, amplitude, rate, shape=problems.SHAPE):
        self.end = 2 * math.pi / rate
        self.growth = 2 * shape / self.end
        self.scale = amplitude / (1 - math.exp(shape))
        self.largest, self.longest = amplitude, self.end / 8

    def next_cut(self, t):
        """As in `Sine`."""
        return self.end / 2 if t < self.end / 2 else self.end

    def __call__(self, t):
        return self.scale * (1 - math.exp(self.growth * min(t, self.end - t)))

    def uplift(self, t, threshold):
        """As in `Sine`."""
        time = math.log(1 - threshold / self.scale) / self.growth if self.largest > threshold else -1.0
        return (time, -1) if t < time else None


class Record:
    """Straight lines between samples; `cut`: integrated from sample to sample."""

    def __init__(self, samples, dt, cut=True):
        self.cut = cut
        self.samples, self.dt, self.end = samples, dt, dt * (len(samples) - 1)
        self.largest, self.longest = max(map(abs, samples)), dt

    def next_cut(self, t):
        """As in `Sine`: every sample, so that no step meets a kink."""
        if not self.cut:
            return self.end
        return min(self.dt * (int(t / self.dt + 1e-9) + 1), self.end)

    def __call__(self, t):
        i = min(int(t / self.dt), len(self.samples) - 2)
        return self.samples[i] + (self.samples[i + 1] - self.samples[i]) * (t / self.dt - i)

    def uplift(self, t, threshold):
        """As in `Sine`."""
        for i in range(min(int(t / self.dt), len(self.samples) - 2), len(self.samples) - 1):
            left, right = self.samples[i], self.samples[i + 1]
            if abs(right) > threshold:
                part = (math.copysign(threshold, right) - left) / (right - left)
                return max(t, (i + part) * self.dt), -1 if right > 0 else 1
        return None


def free_peak(alpha, restitution, x, v, linear):
    """After the motion: the largest angle still to come, infinite if it overturns; velocities over p."""
    distance = (lambda y: alpha - y) if linear else (lambda y: 2 * math.sin((alpha - y) / 2))
    missing, balanced = distance(x) ** 2 - v**2, distance(0.0) ** 2
    inward = v < 0 and (x < alpha or missing < 0)
    if inward:
        missing = balanced - restitution**2 * (balanced - missing)
    if missing < 0 or (x >= alpha and not inward):
        return math.inf
    return max(x, alpha - (math.sqrt(missing) if linear else 2 * math.asin(math.sqrt(missing) / 2)))


def flow_of(alpha, p, side, motion, linear):
    """Acceleration of the opening angle."""
    square, sin, cos = p * p, math.sin, math.cos
    if linear:
        return lambda t, x: square * (x - alpha - side * motion(t))
    return lambda t, x: -square * (sin(alpha - x) + side * motion(t) * cos(alpha - x))


def arc(acceleration, start, x, v, stop, escape, longest, settings):
    """Integrate to the next impact, escape or cut: time, x, v, the largest angle, and which it was."""
    from scipy.integrate import solve_ivp

    def impact(t, state):
        if x > 0:
            return state[0]
        return state[0] / (t - start) if t > start else v or 1.0

    impact.terminal, impact.direction = True, -1
    lost = lambda t, state: escape(state[0], state[1])  # noqa: E731
    lost.terminal, lost.direction = True, 1
    turn = lambda t, state: state[1]  # noqa: E731
    pull = -acceleration(start, 0.0)
    first = min(longest, stop - start)
    if x <= 0:
        first = min(first, v / (2 * pull) if v > 0 and pull > 0 else longest / 50)
    flow = lambda t, state: (state[1], acceleration(t, state[0]))  # noqa: E731
    found = solve_ivp(
        flow, (start, stop), (x, v), events=(impact, lost, turn), max_step=longest, first_step=first, **settings,
    )  # fmt: skip
    for time, state in zip(found.t_events[2], found.y_events[2]):
        if state[0] < 0:  # through the floor and back within a step: once more, up to the lowest point
            return arc(acceleration, start, x, v, float(time), escape, longest, settings)
    top = max([0.0, *(float(state[0]) for state in found.y_events[2])])
    which = "impact" if len(found.t_events[0]) else "lost" if len(found.t_events[1]) else "cut"
    return float(found.t[-1]), float(found.y[0, -1]), float(found.y[1, -1]), top, which


def settings_of(rtol, atol, method="DOP853"):
    """What `solve_ivp` is told."""
    return {"rtol": rtol, "atol": atol, "method": method}


def follow(alpha, p, restitution, motion, linear, settings):
    """Peak over alpha of one block, infinite if it overturns."""
    threshold = alpha if linear else math.tan(alpha)
    if linear:
        escape = lambda x, v: x - alpha + v / p - motion.largest  # noqa: E731
    else:
        escape = lambda x, v: x - min(math.pi / 2, alpha + math.atan(motion.largest))  # noqa: E731
    negligible = max(1e-9, settings["rtol"]) * p * alpha
    t, x, v, side, peak = 0.0, 0.0, 0.0, 0, 0.0
    while t < motion.end:
        if side == 0:
            found = motion.uplift(t, threshold)
            if found is None:
                return peak / alpha
            (t, side), x, v = found, 0.0, 0.0
        acceleration = flow_of(alpha, p, side, motion, linear)
        cut = motion.next_cut(t)
        t, x, v, top, which = arc(acceleration, t, x, v, cut, escape, motion.longest, settings)
        peak = max(peak, top)
        if which == "lost":
            return math.inf
        if which == "impact":
            x, v, side = 0.0, -restitution * v, -side
            if v < negligible and acceleration(t, 0.0) < 0 and abs(motion(t)) < threshold:
                side = 0
    last = free_peak(alpha, restitution, x, v / p, linear) if side else 0.0
    return max(peak, last) / alpha


def solve_one(name, settings, index):
    """Peak over alpha of one scene of a problem (in a worker)."""
    problem = loaded(name)
    alpha, p, restitution, amplitude, rate = (float(c[index]) for c in problem.columns())
    if problem.motion == "record":
        motion = Record(samples_of(name, amplitude), problem.dt)
    else:
        motion = (Sine if problem.motion == "sine" else Exponential)(amplitude, rate)
    return follow(alpha, p, restitution, motion, problem.model == "linear", settings)


@functools.cache
def loaded(name):
    """A problem, read once in a process."""
    return problems.load(name)[0]


@functools.cache
def samples_of(name, scale):
    """Samples of a record times a factor, as plain numbers."""
    return (scale * loaded(name).samples).tolist()


@functools.cache
def pool():
    """One process a core, for all calls."""
    return concurrent.futures.ProcessPoolExecutor(CORES, mp_context=multiprocessing.get_context("spawn"))


SETTINGS = ((1e-6, settings_of(1e-7, 1e-9)), (1e-10, settings_of(1e-11, 1e-13)), (1e-12, settings_of(1e-13, 1e-15)))
FEW = {"P4": 40, "P6": 40, "P7": 40}  # scenes; else 200


def ways(problem):
    """The ways to solve a problem: (goal of the error, label, function of the chosen scenes)."""

    def made(settings):
        task = functools.partial(solve_one, problem.name, settings)
        return lambda chosen: list(pool().map(task, chosen.tolist(), chunksize=1 if len(chosen) < 50 else 5))

    return [(goal, f"rtol {settings['rtol']:g}", made(settings)) for goal, settings in SETTINGS]
