"""heyoka: batches of SIMD lanes with events, one process a core.

The impact is a terminal event whose callback resets the lane and goes on; turning points are non-terminal events. A
lane that is lost or at rest is frozen by a factor of its equations; lanes that uplift again go into a second round.
Lanes that are certain to be lost stop early, as in the numba peers. Records would need a call for every sample and are
left out.
"""

import functools
import math

import numpy as np

from . import scipy_loop

COOLDOWN = 1e-13  # of the impact: heyoka's own, about a step's error, hides the next impact of a small hop
START = 1e-4  # times 1/rate: the first moment after the uplift, in closed form, where the angle is not yet zero
NEGLIGIBLE = 1e-8  # speed over alpha below which a block rests


class Batch:
    """Compiled batches of one kind of problem at one tolerance."""

    def __init__(self, model, motion, tolerance):
        import heyoka as hy

        self.motion, self.lanes = motion, hy.recommended_simd_size()
        self.linear = model == "linear"
        x, v = hy.make_vars("x", "v")
        s, alpha, active, escape, first, second = (hy.par[k] for k in range(6))
        if motion == "sine":
            force = first * hy.sin(second * hy.time)
        else:  # scale (1 - e^(growth (time - shift)))
            force = first * (1.0 - hy.exp(second * (hy.time - hy.par[6])))
        if self.linear:
            acceleration, lost = x - alpha - s * force, x - alpha + v - escape
        else:
            acceleration, lost = -(hy.sin(alpha - x) + s * force * hy.cos(alpha - x)), x - escape
        falling, rising = hy.event_direction.negative, hy.event_direction.positive
        # Functions, not methods: heyoka copies its callbacks deeply.
        self.integrator = hy.taylor_adaptive_batch(
            [(x, active * v), (v, active * acceleration)],
            np.zeros((2, self.lanes)), pars=np.zeros((6 + (motion != "sine"), self.lanes)), tol=tolerance,
            t_events=[
                hy.t_event_batch(x, direction=falling, callback=lambda *a: self.impact(*a), cooldown=COOLDOWN),
                hy.t_event_batch(lost, direction=rising, callback=lambda *a: self.lost(*a)),
            ],
            nt_events=[hy.nt_event_batch(v, direction=falling, callback=lambda *a: self.turn(*a))],
        )  # fmt: skip
        self.peak, self.restitution = np.zeros(self.lanes), np.zeros(self.lanes)
        self.rested = np.full(self.lanes, np.inf)

    def impact(self, integrator, sign, lane):
        """Lose speed and change the side, or rest."""
        state, pars = integrator.state, integrator.pars
        state[0, lane] = 0.0
        state[1, lane] *= -self.restitution[lane]
        pars[0, lane] *= -1.0
        if state[1, lane] < NEGLIGIBLE * pars[1, lane] and not self.driven(float(integrator.time[lane]), lane):
            pars[2, lane] = state[1, lane] = 0.0
            self.rested[lane] = integrator.time[lane]
        return True

    def force(self, time, lanes):
        """The ground acceleration."""
        pars = self.integrator.pars
        if self.motion == "sine":
            return pars[4, lanes] * np.sin(pars[5, lanes] * time)
        return pars[4, lanes] * (1 - np.exp(pars[5, lanes] * (time - pars[6, lanes])))

    def driven(self, time, lane):
        """Return whether the ground acceleration exceeds the threshold."""
        alpha = self.integrator.pars[1, lane]
        return abs(self.force(time, lane)) > (alpha if self.linear else math.tan(alpha))

    def start(self, begin, rate):
        """The state shortly after the uplift, by Simpson's rule."""
        pars, step, lanes = self.integrator.pars, START / rate, slice(None)
        middle, late = (-pars[0] * self.force(begin + part * step, lanes) for part in (0.5, 1.0))
        if self.linear:
            middle, late = middle - pars[1], late - pars[1]
        else:
            middle, late = (a * np.cos(pars[1]) - np.sin(pars[1]) for a in (middle, late))
        self.integrator.set_time(begin + step)
        self.integrator.state[0] = step**2 / 3 * middle
        self.integrator.state[1] = step / 6 * (4 * middle + late)

    def lost(self, integrator, sign, lane):
        """Past every help."""
        integrator.pars[2, lane] = 0.0
        self.peak[lane] = math.inf
        return True

    def turn(self, integrator, time, sign, lane):
        """A turning point: the angle there, from the dense output."""
        integrator.update_d_output(np.full(self.lanes, time))
        self.peak[lane] = max(self.peak[lane], integrator.d_output[0, lane])

    def solve(self, alpha, restitution, amplitude, rate):
        """Peaks over alpha."""
        angle = np.arcsin(np.minimum((alpha if self.linear else np.tan(alpha)) / amplitude, 1.0))
        peak, begin, side = np.zeros(alpha.size), angle / rate, -np.ones(alpha.size)
        if self.motion == "exponential":
            begin = np.array([scipy_loop.Exponential(a, w).uplift(0.0, math.tan(b))[0]
                              for a, w, b in zip(amplitude, rate, alpha)])  # fmt: skip
        todo = np.arange(alpha.size)
        for _ in range(2):
            again = []
            for first in range(0, todo.size, self.lanes):
                some = todo[first : first + self.lanes]
                index = np.resize(some, self.lanes)
                found, rested = self.one(alpha, restitution, amplitude, rate, begin, side, index)
                peak[some] = np.maximum(peak[some], found[: some.size])
                again += [i for i, t in zip(some, rested) if math.isfinite(t)]
            todo = np.array(again, int)
            if self.motion != "sine" or not todo.size:
                break
            begin[todo], side[todo] = (math.pi + angle[todo]) / rate[todo], 1.0
        return peak / alpha

    def one(self, alpha, restitution, amplitude, rate, begin, side, index):
        """One batch to the end of the motion and of the free stage: peaks, and when lanes came to rest."""
        integrator, pars = self.integrator, self.integrator.pars
        integrator.reset_cooldowns()
        self.restitution[:] = restitution[index]
        self.peak[:], self.rested[:] = 0.0, np.inf
        reach = amplitude[index] if self.linear else alpha[index] + np.arctan(amplitude[index])
        pars[0], pars[1], pars[2], pars[3] = side[index], alpha[index], 1.0, np.minimum(reach, 1.57)
        end = 2 * math.pi / rate[index]
        if self.motion == "sine":
            pars[4], pars[5] = amplitude[index], rate[index]
            self.start(begin[index], rate[index])
            integrator.propagate_until(end)
        else:
            pulses = [scipy_loop.Exponential(a, w) for a, w in zip(amplitude[index], rate[index])]
            pars[4], pars[5], pars[6] = np.array([(p.scale, p.growth, 0.0) for p in pulses]).T
            self.start(begin[index], rate[index])
            integrator.propagate_until(end / 2)
            pars[5], pars[6] = -pars[5], end
            integrator.propagate_until(end)
        for lane, i in enumerate(index):
            if pars[2, lane]:
                x, v = (float(c) for c in integrator.state[:, lane])
                last = scipy_loop.free_peak(float(alpha[i]), float(restitution[i]), x, v, self.linear)
                self.peak[lane] = max(self.peak[lane], last)
        return self.peak, self.rested


@functools.cache
def batch(model, motion, tolerance):
    """A compiled batch, once in a process."""
    return Batch(model, motion, tolerance)


def solve_part(task):
    """Peaks over alpha of a part of the scenes (in a worker)."""
    model, motion, tolerance, columns = task
    return batch(model, motion, tolerance).solve(*columns)


SETTINGS = ((1e-6, 1e-7), (1e-10, 1e-12), (1e-12, 1e-16))


def ways(problem):
    """The ways to solve a problem under a pulse: (goal of the error, label, function of the chosen scenes)."""
    if problem.motion == "record":
        return []

    def solve(tolerance, chosen=slice(None)):
        alpha, _, *rest = problem.columns(chosen)
        parts = np.array_split(np.arange(alpha.size), 8 * scipy_loop.CORES)
        tasks = [(problem.model, problem.motion, tolerance, [c[part] for c in (alpha, *rest)]) for part in parts]
        return np.concatenate(list(scipy_loop.pool().map(solve_part, tasks)))

    return [(goal, f"tolerance {t:g}", functools.partial(solve, t)) for goal, t in SETTINGS]
