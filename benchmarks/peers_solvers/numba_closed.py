"""The linear block under a sine, in closed form between events, in numba, blocks in parallel on all cores.

    x = alpha + P e^t + Q e^-t + B sin(w t),     B = s A/(1 + w^2)

The loop is that of `numba_taylor`; a step reaches over half a crest-to-crest interval at most and is exact.
"""

import functools

from . import numba_events, numba_taylor

STATE = """
B = s * A / (1.0 + w * w)
sine = B * math.sin(w * t)
cosine = B * w * math.cos(w * t)
P = 0.5 * (x - alpha - sine + v - cosine)
Q = 0.5 * (x - alpha - sine - v + cosine)
c2 = 0.5 * (P + Q - w * w * sine)
"""
LENGTH = """
whole = stop - t <= 1.6 / w
h = stop - t if whole else 1.6 / w
"""
AT = """
E = math.exp({at})
G = Q / E
E = P * E
sine = B * math.sin(w * (t + {at}))
cosine = B * w * math.cos(w * (t + {at}))
"""


def events_text():
    """The search for events, with the closed form in the place of a polynomial."""
    table = {}
    for at in "hr":
        table |= {f"x_{at}": "(alpha + E + G + sine)", f"v_{at}": "(E - G + cosine)"}
        table |= {f"a_{at}": "(E + G - w * w * sine)", f"j_{at}": "(E - G - w * w * cosine)"}
    lines = []
    for line in numba_events.events_of(table).split("\n"):
        bare, depth = line.strip(), (len(line) - len(line.lstrip())) // 4
        if bare in ("q = h * h", "q = r * r"):
            lines.append("    " * depth + numba_events.indented(AT.format(at=bare[4]), depth))
        else:
            lines.append(line)
    return "\n".join(lines)


@functools.cache
def kernel():
    """The compiled function over arrays."""
    step = {"series": STATE.strip("\n"), "length": LENGTH.strip("\n"), "events": events_text()}
    return numba_taylor.over_pulses(numba_taylor.compiled(numba_taylor.pulse_source("linear", "sine", step), "closed"))


SETTINGS = ((1e-6, "loose roots", (0.0, False)), (1e-12, "exact", (0.0, True)))


def ways(problem):
    """The ways to solve a problem, if it is a linear block under a sine."""
    if (problem.model, problem.motion) != ("linear", "sine"):
        return []
    made = lambda s: lambda chosen=slice(None): numba_taylor.run(problem, kernel(), s, chosen)  # noqa: E731
    return [(goal, label, made(setting)) for goal, label, setting in SETTINGS]
