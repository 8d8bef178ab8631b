"""The Runge-Kutta pair of Dormand and Prince in numba, with events, blocks in parallel on all cores.

The same loop as `numba_taylor`, with another step: the pair with its error control, and the quintic through angle,
velocity and acceleration at both ends, on which events are found. An impact is then met by Newton's method on the
length of the step itself, integrated anew each time, so that it is as accurate as the step.
"""

import functools

from . import numba_events, numba_taylor

NODES = (1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0)
ROWS = (
    (1 / 5,),
    (3 / 40, 9 / 40),
    (44 / 45, -56 / 15, 32 / 9),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
    (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)
ERROR = (71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40)

ACCELERATION = {"nonlinear": "-(math.sin(alpha - {x}) + {f} * math.cos(alpha - {x}))", "linear": "{x} - alpha - {f}"}
FORCE = {
    "sine": "(s * A * math.sin(w * {t}))",
    "exponential": "(s * K - s * K * math.exp(growth * (2.0 * half - {t} if t >= half else {t})))",
    "record": "(s * scale * (samples[i] + slope * {t}))",
}


def weighted(letter, weights):
    """A weighted sum of the stages."""
    return " + ".join(f"{w!r} * {letter}{j}" for j, w in enumerate(weights) if w)


def stages(model, motion, end):
    """Statements of a step of length h from x, v with acceleration a0: to xh, vh, and its stages."""
    accelerate = lambda x, t: ACCELERATION[model].format(x=x, f=FORCE[motion].format(t=t))  # noqa: E731
    lines = ["v0 = v", "a0 = start"]
    for k, (node, row) in enumerate(zip(NODES, ROWS), 1):
        lines.append(f"x{k} = x + h * ({weighted('v', row)})")
        lines.append(f"v{k} = v + h * ({weighted('a', row)})")
        lines.append(f"a{k} = {accelerate(f'x{k}', f'(t + {node!r} * h)')}")
    return "\n".join([*lines, f"x{end} = x6", f"v{end} = v6"])


# The quintic through both ends.
QUINTIC = """
c0 = x
c1 = v
c2 = 0.5 * start
g = max(h, 1e-40)
D = xe - x - h * (v + h * c2)
E = h * (ve - v - h * start)
F = h * h * (a6 - start)
c3 = (10.0 * D - 4.0 * E + 0.5 * F) / (g * g * g)
c4 = (-15.0 * D + 7.0 * E - F) / (g * g * g * g)
c5 = (6.0 * D - 3.0 * E + 0.5 * F) / (g * g * g * g * g)
whole_h = h
"""

CONTROLLED = """
h = min(step, stop - t)
for _try in range(100):
    {stages}
    error = h * max(abs({error_x}), abs({error_v})) / small
    if error <= 1.0:
        break
    h *= max(0.2, 0.9 * error**-0.2)
whole = h >= stop - t
step = min(longest, h * min(5.0, 0.9 * max(error, 1e-8) ** -0.2))
{quintic}
"""

FIXED = """
{stages}
{quintic}
"""

# The turning point and the impact, integrated anew.
TOP = """
keep = h
h = r
{stages}
top = xe
h = keep
"""
ARRIVAL = """
for _i in range(8):
    {stages}
    vh = ve
    n = h - xe / ve if ve < 0.0 else h
    d = abs(n - h)
    if not 0.0 <= n <= whole_h:
        break
    h = n
    if d <= tight * h or d <= 1e-16:
        break
"""
DEPART = """
if h != whole_h:
    {stages}
    xh = xe
    vh = ve
"""


def dopri5_parts(model, motion):
    """What makes a step of a template one of the pair."""
    words = {"stages": stages(model, motion, "e"), "quintic": QUINTIC.strip("\n")}
    words |= {"error_x": weighted("v", ERROR), "error_v": weighted("a", ERROR)}
    hooks = {name: numba_events.filled(text, words) for name, text in
             (("top", TOP), ("arrival", ARRIVAL), ("depart", DEPART))}  # fmt: skip
    start = f"start = {ACCELERATION[model].format(x='x', f=FORCE[motion].format(t='t'))}"
    parts = {"series": start, "events": numba_events.events_text(5, hooks)}
    if motion == "record":
        return parts | {"middle": numba_events.filled(FIXED, words)}
    return parts | {"length": numba_events.filled(CONTROLLED, words)}


@functools.cache
def kernel(model, motion):
    """The compiled function over arrays."""
    parts = dopri5_parts(model, motion)
    if motion == "record":
        return numba_taylor.over_blocks(
            numba_taylor.compiled(numba_taylor.record_source(model, parts), "record dopri5")
        )
    source = numba_taylor.pulse_source(model, motion, parts)
    source = source.replace("    fresh = True\n", "    fresh = True\n    step = 0.2 * longest\n", 1)
    return numba_taylor.over_pulses(numba_taylor.compiled(source, f"{motion} dopri5"))


# Tolerances for errors of about 1e-6, 1e-10 and 1e-12; steps a sample under a record.
SETTINGS = {
    "pulse": ((1e-6, 1e-7, (1e-7, False)), (1e-10, 1e-11, (1e-11, True)), (1e-12, 1e-13, (1e-13, True))),
    "record": ((1e-6, 1, (1, True)), (1e-10, 2, (2, True)), (1e-12, 4, (4, True))),
}


def ways(problem):
    """The ways to solve a problem: (goal of the error, label, function of the chosen scenes)."""
    found, record = [], problem.motion == "record"
    made = functools.partial(kernel, problem.model, problem.motion)
    for goal, number, setting in SETTINGS["record" if record else "pulse"]:
        solve = lambda chosen=slice(None), s=setting: numba_taylor.run(problem, made(), s, chosen)  # noqa: E731
        found.append((goal, f"{number} a sample" if record else f"tolerance {number:g}", solve))
    return found
