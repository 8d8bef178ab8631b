"""A scalar Taylor integrator in numba, its source generated as straight lines, blocks in parallel on all cores.

Time is p t, x the opening angle |theta|, s the side. The series of order N of sin(alpha - x), cos(alpha - x) and of
the acceleration are unrolled sums; the step follows from the last coefficients; impacts and turning points are roots
of the step's polynomial, by Newton's method in a bracket until it converges. Around it, everything that is exact and
saves work: a start at the uplift; an early end where even the strongest opposing acceleration still to come cannot
bring the block back; rest where the hops still to come are certain to die before the acceleration changes; the free
stage by energy.
"""

import functools
import math

import numba
import numpy as np

from references import peer_problems as problems

from .numba_events import events_text, filled
from .numba_templates import (
    ESCAPE,
    EXPONENTIAL,
    FLAT,
    FREE_LINEAR,
    FREE_NONLINEAR,
    LENGTH,
    LEVERS,
    PULSE,
    RECORD,
    RECORD_WORDS,
    REST,
    SINE,
)  # fmt: skip

FAST = {"nsz", "contract", "afn", "reassoc"}  # no reciprocals: times must stay equal where they are
THREADS_CHUNK = 64


def series_lines(order, model, motion):
    """Statements for the coefficients c0... of x from x, v, alpha's phase and the forcing f0...; local time 0."""
    lines = ["c0 = x", "c1 = v"]
    terms = 2 if motion == "record" else order - 1
    lines += {"sine": sine_lines, "exponential": exponential_lines, "record": lambda n: []}[motion](terms)
    if model == "linear":
        for k in range(order - 1):
            force = f" - f{k}" if k < terms else ""
            lines.append(f"c{k + 2} = (c{k}{' - alpha' if k == 0 else ''}{force}) * {1 / ((k + 1) * (k + 2))!r}")
        return lines
    lines += ["S0 = math.sin(alpha - x)", "C0 = math.cos(alpha - x)"]
    for k in range(order - 1):
        if k:
            pairs = [f"d{j} * {{}}{k - j}" for j in range(1, k + 1)]
            lines.append(f"d{k} = c1" if k == 1 else f"d{k} = {float(k)} * c{k}")
            lines.append(f"S{k} = -({' + '.join(pairs).format(*'C' * k)}) * {1 / k!r}")
            lines.append(f"C{k} = ({' + '.join(pairs).format(*'S' * k)}) * {1 / k!r}")
        force = " + ".join(f"f{j} * C{k - j}" for j in range(min(k + 1, terms)))
        lines.append(f"c{k + 2} = -(S{k} + {force}) * {1 / ((k + 1) * (k + 2))!r}")
    return lines


def sine_lines(terms):
    """Forcing of a sine: s A sin(w (t + time))."""
    lines = ["f0 = s * A * math.sin(w * t)", "f1 = s * A * w * math.cos(w * t)"]
    return lines + [f"f{k} = mww * f{k - 2} * {1 / (k * (k - 1))!r}" for k in range(2, terms)]


def exponential_lines(terms):
    """Forcing of an exponential pulse: s (K - K e^(g t)) rising, mirrored falling."""
    lines = [
        "falling = t >= half",
        "g = -growth if falling else growth",
        "e0 = -s * K * math.exp(growth * (2.0 * half - t if falling else t))",
        "f0 = s * K + e0",
        "e1 = e0 * g",
        "f1 = e1",
    ]
    for k in range(2, terms):
        lines += [f"e{k} = e{k - 1} * g * {1 / k!r}", f"f{k} = e{k}"]
    return lines


def taylor_parts(order, model, motion):
    """What makes a step of a template a Taylor step."""
    numbers = {"N": str(order), "N1": str(order - 1), "invN": repr(1 / order), "invN1": repr(1 / (order - 1))}
    series = "\n".join(series_lines(order, model, motion))
    return {"series": series, "length": filled(LENGTH, numbers), "events": events_text(order)}


def pulse_source(model, motion, step):
    """Source of `one(alpha, restitution, amplitude, rate, shape, tolerance, precise)`, the peak over alpha."""
    parts = dict(SINE if motion == "sine" else EXPONENTIAL)
    parts["prepare"] = parts["prepare"].replace("{levers}", LEVERS[model])
    parts |= {"rest": filled(REST, parts), "escape": ESCAPE[model], "flat": FLAT[model]}
    return filled(PULSE, parts | {"free": FREE_LINEAR if model == "linear" else FREE_NONLINEAR} | step)


def record_source(model, step):
    """Source of `one(alpha, p, restitution, scale, samples, dt, rightward, leftward, precise, pieces)`."""
    parts = {"rest": filled(REST, RECORD_WORDS), "escape": ESCAPE[model], "flat": FLAT[model]}
    parts |= {"free": FREE_LINEAR if model == "linear" else FREE_NONLINEAR, "levers": LEVERS[model]}
    return filled(RECORD, parts | step)


def compiled(source, name, **names):
    """A function compiled from its source."""
    space = {"math": math, "np": np, **names}
    exec(compile(source, f"<{name}>", "exec"), space)
    return numba.njit(fastmath=FAST, error_model="numpy")(space["one"])


@functools.cache
def pulse_map(model, motion, order):
    """`peaks(alpha, restitution, amplitude, rate, shape, tolerance, precise)` over arrays, on all cores."""
    return over_pulses(compiled(pulse_source(model, motion, taylor_parts(order, model, motion)), f"{motion} {order}"))


@functools.cache
def record_map(model, order):
    """`peaks(alpha, p, restitution, scale, samples, ...)` over arrays, on all cores; the rest as `record_source`."""
    step = taylor_parts(order, model, "record") | {"middle": "pass"}
    return over_blocks(compiled(record_source(model, step), f"record {order}"))


def over_pulses(one):
    """A function of one pulse and block over arrays, on all cores."""

    @numba.njit(parallel=True, fastmath=FAST, error_model="numpy")
    def peaks(alpha, restitution, amplitude, rate, shape, tolerance, precise):
        found = np.empty(alpha.size)
        for i in numba.prange(alpha.size):
            found[i] = one(alpha[i], restitution[i], amplitude[i], rate[i], shape, tolerance, precise)
        return found

    return peaks


def over_blocks(one):
    """A function of one block under a record over arrays, on all cores."""

    @numba.njit(parallel=True, fastmath=FAST, error_model="numpy")
    def peaks(alpha, p, restitution, scale, samples, dt, rightward, leftward, precise, pieces):
        found = np.empty(alpha.size)
        for i in numba.prange(alpha.size):
            found[i] = one(alpha[i], p[i], restitution[i], scale[i], samples, dt, rightward, leftward, precise, pieces)
        return found

    return peaks


def run(problem, kernel, setting, chosen=slice(None)):
    """Peaks over alpha of the chosen scenes; `setting`: tolerance (of a record: steps a sample) and `precise`."""
    alpha, p, restitution, amplitude, rate = problem.columns(chosen)
    accuracy, precise = setting
    if problem.motion == "record":
        numba.set_parallel_chunksize(4)
        ahead = [np.maximum.accumulate(np.maximum(side * problem.samples, 0)[::-1])[::-1].copy() for side in (1, -1)]
        return kernel(alpha, p, restitution, amplitude, problem.samples, problem.dt, *ahead, precise, accuracy)
    numba.set_parallel_chunksize(THREADS_CHUNK)
    return kernel(alpha, restitution, amplitude, rate, problems.SHAPE, accuracy, precise)


# Orders and tolerances for errors of about 1e-6, 1e-10 and 1e-12, of pulses also 1e-4, found by trial.
SETTINGS = {
    "pulse": (
        (1e-4, 10, (1e-6, False)),
        (1e-6, 12, (1e-8, False)),
        (1e-10, 16, (1e-13, True)),
        (1e-12, 20, (1e-16, True)),
    ),
    "record": ((1e-6, 6, (1, True)), (1e-10, 8, (1, True)), (1e-12, 10, (1, True))),
}


def ways(problem):
    """The ways to solve a problem: (goal of the error, label, function of the chosen scenes)."""
    found = []
    for goal, order, setting in SETTINGS["record" if problem.motion == "record" else "pulse"]:
        if problem.motion == "record":
            kernel = functools.partial(record_map, problem.model, order)
        else:
            kernel = functools.partial(pulse_map, problem.model, problem.motion, order)
        solve = lambda chosen=slice(None), kernel=kernel, s=setting: run(problem, kernel(), s, chosen)  # noqa: E731
        found.append((goal, f"order {order}", solve))
    return found
