"""Derivatives of responses of the Taylor reference: central differences with Richardson's extrapolation.

The parameters of a scene are changed in all digits by a small part of their size; where the differences of the step
and of twice the step agree, no impact appears and no other peak takes over within it.
"""

import itertools
import math

import jax
import numpy as np

import jaxrock
from references.motions import Lines, motion
from references.taylor import ORDER, Block, respond

STEP = -9  # log10 of the relative step
RICKER = 5.7 / math.pi  # centre over period of jaxrock's symmetric Ricker pulse
OUTPUTS = ("max_rotation", "max_velocity", "time_of_max")
NAMES = {
    "sine": ("amplitude", "period"),
    "cosine": ("amplitude", "period"),
    "ricker symmetric": ("amplitude", "period"),
    "half sine": ("amplitude", "duration"),
    "triangle": ("amplitude", "duration"),
    "exponential": ("amplitude", "duration", "shape"),
    "record": ("factor",),
}


def record():
    """Samples [g] and time step [s] of the built-in record."""
    jax.config.update("jax_enable_x64", True)
    found = jaxrock.example_record()
    return [float(u) for u in np.asarray(found.samples)], float(found.dt)


class Scene:
    """A model, a kind of motion and float64 parameters; it runs with others too."""

    def __init__(self, arithmetic, model, kind, parameters, samples=None, order=ORDER):
        self.a, self.model, self.kind, self.order = arithmetic, model, kind, order
        self.parameters = [arithmetic.number(x) for x in parameters]
        self.samples = samples
        self.names = ("alpha", "p", "restitution") + NAMES[kind]

    def block(self, *numbers):
        """The block of these numbers."""
        return Block(self.a, *numbers, self.model == "linear", self.order)

    def run(self, parameters=None, samples=None, times=()):
        """The path with these numbers."""
        a = self.a
        alpha, p, restitution, *numbers = parameters or self.parameters
        if self.kind == "record":
            values, dt = samples or self.samples[0], self.samples[1]
            moving = Lines(a, values, dt, numbers[0])
        else:
            if self.kind == "ricker symmetric":
                numbers = [*numbers, a.number(RICKER) * numbers[1]]
            moving = motion(a, self.kind, numbers)
        return respond(self.block(alpha, p, restitution), moving, (0, 0), times)

    def outputs(self, *arguments):
        """(Greatest rotation, greatest velocity, time), or None if it overturns; and the number of impacts."""
        path = self.run(*arguments)
        if path.overturned or path.peak_time is None:
            return None, path.impacts
        return (path.peak, path.fastest, path.peak_time + 0 * path.peak), path.impacts

    def steps(self, exponent=STEP):
        """Change of each parameter."""
        h = self.a.power_of_ten(exponent)
        return [h * (abs(x) if x else 1) for x in self.parameters]


def differences(outputs, size, count):
    """Central differences of functions of the multiple of a step.

    **Arguments:** `outputs(k)`: three numbers and a count, with the parameter changed by k steps of this `size`.

    **Returns:** the extrapolated derivatives and, per output, the change by the extrapolation; None where an
    impact count is not `count` or the block overturns.
    """
    found = {}
    for k in (1, -1, 2, -2):
        found[k], impacts = outputs(k)
        if found[k] is None or impacts != count:
            return None
    best, change = [], []
    for i in range(3):
        near, far = ((found[k][i] - found[-k][i]) / (2 * k * size) for k in (1, 2))
        best.append((4 * near - far) / 3)
        change.append(abs(near - far))
    return best, change, found


def gradient(scene, path, exponent=STEP):
    """Derivatives (output by parameter), the runs they came from, and the worst disagreement; or None."""
    rows, runs, worst = [], [], 0.0
    values = (path.peak, path.fastest, path.peak_time + 0 * path.peak)
    for j, step in enumerate(scene.steps(exponent)):

        def outputs(k):
            return scene.outputs([x + k * step * (i == j) for i, x in enumerate(scene.parameters)])  # noqa: B023

        found = differences(outputs, step, path.impacts)
        if found is None:
            return None
        best, change, sides = found
        rows.append(best)
        runs.append(sides)
        x = abs(scene.parameters[j]) or 1
        scales = [max(abs(b), abs(v / x) / 100) for b, v in zip(best, values)]
        worst = max(worst, *(float(c / s) for c, s in zip(change, scales)))
    return list(zip(*rows)), runs, worst


def hessian(scene, path, runs, exponent=STEP):
    """Second derivatives of the greatest rotation for the first five parameters, and the worst disagreement."""
    steps, middle = scene.steps(exponent)[:5], path.peak
    table, worst = [[None] * 5 for _ in range(5)], 0.0
    for i, j in itertools.combinations_with_replacement(range(5), 2):
        found = []
        for k in (1, 2):
            single = [runs[n][s * k][0] for n in (i, j) for s in (1, -1)]
            if i == j:
                found.append((single[0] + single[1] - 2 * middle) / (k * steps[i]) ** 2)
                continue
            both = []
            for s in (1, -1):
                change = [s * k * steps[n] if n in (i, j) else 0 for n in range(len(scene.parameters))]
                outputs, impacts = scene.outputs([x + d for x, d in zip(scene.parameters, change)])
                if outputs is None or impacts != path.impacts:
                    return None
                both.append(outputs[0])
            found.append((sum(both) - sum(single) + 2 * middle) / (2 * k * k * steps[i] * steps[j]))
        table[i][j] = table[j][i] = (4 * found[0] - found[1]) / 3
        scale = max(abs(table[i][j]), abs(middle / scene.parameters[i] / scene.parameters[j]) / 100)
        worst = max(worst, float(abs(found[0] - found[1]) / scale))
    return table, worst


def single_samples(scene, path, exponent=STEP):
    """Derivatives with respect to eight samples: six that move the peak, one at rest before it and one after it."""
    a, (samples, dt) = scene.a, scene.samples
    last = int(float(path.peak_time) / dt)  # index of the sample before the peak
    times = [i * a.number(dt) for i in range(last + 1)]
    states = scene.run(times=times).states
    resting = [i for i, (x, v) in enumerate(states) if x == 0 and v == 0]
    calm = [i for i in resting if {i - 1, i + 1} <= set(resting)]
    first = max(resting)
    if last - first < 7 or not calm or last + 20 >= len(samples):
        return None
    moving = [first + 1 + round(k * (last - first) / 5) for k in range(6)]  # to the sample after the peak
    chosen = {"moving": moving, "rest": [calm[len(calm) // 2]], "after": [last + 12]}
    size = a.power_of_ten(exponent) * max(abs(u) for u in samples)
    base, found, worst = [a.number(u) for u in samples], [], 0.0
    values = (path.peak, path.fastest, path.peak_time + 0 * path.peak)
    for index in itertools.chain(*chosen.values()):

        def outputs(k):
            changed = list(base)
            changed[index] += k * size  # noqa: B023
            return scene.outputs(None, changed)

        one = differences(outputs, size, path.impacts)
        if one is None:
            return None
        best, change, _ = one
        peak = max(abs(u) for u in samples)
        scales = [max(abs(b), abs(v) / peak / 100) for b, v in zip(best, values)]
        worst = max(worst, *(float(c / s) for c, s in zip(change, scales)))
        found.append((index, best))
    return chosen, found, worst


def texts(a, values, digits=20):
    return [a.text(value, digits) if value else "0" for value in values]


def deviations(a, known, scene, path, rows):
    """Relative differences of the values of a path, and of their gradients, from those that are stored."""
    values = (path.peak, path.fastest, path.peak_time + 0 * path.peak)
    errors = [float(abs(v / a.number(known[name]["value"]) - 1)) for v, name in zip(values, OUTPUTS)]
    for row, value, name in zip(rows, values, OUTPUTS):
        pairs = zip(row, known[name]["gradient"], scene.parameters)
        floor = [(abs(b - a.number(c)), max(abs(b), abs(value / (x or 1)) * 1e-4)) for b, c, x in pairs]
        errors += [float(e / s) for e, s in floor]
    return errors
