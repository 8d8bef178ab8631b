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

from . import problems

FAST = {"nsz", "contract", "afn", "reassoc"}  # no reciprocals: times must stay equal where they are
THREADS_CHUNK = 64


def horner(names, t):
    """A polynomial at t as an expression: even and odd powers apart, two chains that run side by side."""

    def chain(part):
        text = part[-1]
        for name in part[-2::-1]:
            text = f"({text}) * q + {name}"
        return text

    odd = names[1::2]
    return chain(names[0::2]) + (f" + {t} * ({chain(odd)})" if odd else "")


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


PULSE = """
def one(alpha, restitution, A, rate, shape, tolerance, precise):
    {prepare}
    t, side_of_uplift = {uplift_first}
    if t < 0.0:
        return 0.0
    s = side_of_uplift
    x = 0.0
    v = 0.0
    peak = 0.0
    fresh = True
    small = tolerance * alpha
    for _ in range(100000):
        stop = {piece_end}
        if x == 0.0 or v <= 0.0:  # no further than the crest: beyond it the acceleration may change its sign again
            stop = {crest}
        {series}
        {length}
        {events}
        if impact:
            t += h
            if t >= end:
                x = 0.0
                break
            {rest}
            if dies:
                {uplift_again}
                if lift < 0.0:
                    return peak / alpha
                t = lift
                v = 0.0
                s = side_of_uplift
                fresh = True
            continue
        fresh = False
        t = stop if whole else t + h
        if t >= end:
            break
        if v > 0.0:
            {opposing}
            if {escape}:
                return math.inf
        {flat}
    {free}
"""

# rightward, leftward: the largest u and -u from each sample on.
RECORD = """
def one(alpha, p, restitution, samples, dt, rightward, leftward, precise, pieces):
    {levers}
    near = 1e-8 if precise else 1e-4
    tight = 4e-16 if precise else 1e-10
    end = p * dt
    part = end / pieces
    last = samples.size - 1
    i = 0
    t = 0.0
    x = 0.0
    v = 0.0
    s = 0.0
    peak = 0.0
    fresh = False
    while i < last:
        if s == 0.0:
            while i < last and abs(samples[i + 1]) <= threshold:
                i += 1
                t = 0.0
            if i == last:
                return peak / alpha
            s = -1.0 if samples[i + 1] > 0.0 else 1.0
            t = max(t, (-s * threshold - samples[i]) / (samples[i + 1] - samples[i]) * end)
            x = 0.0
            v = 0.0
            fresh = True
        slope = (samples[i + 1] - samples[i]) / end
        f0 = s * (samples[i] + slope * t)
        f1 = s * slope
        {series}
        whole = part * 1.000001 >= end - t
        h = end - t if whole else part
        {middle}
        {events}
        if impact:
            t += h
            {rest}
            if dies:
                s = 0.0
            if t >= end:
                i += 1
                t = 0.0
            continue
        fresh = False
        t += h
        if whole:
            i += 1
            t = 0.0
        if v > alpha - x:
            U = rightward[i] if s > 0.0 else leftward[i]
            if {escape}:
                return math.inf
        {flat}
    if s == 0.0:
        return peak / alpha
    {free}
"""
RECORD_WORDS = {"u_now": "samples[i] + slope * t", "steady": "abs(slope) * window * lever1 <= least"}

EVENTS = """
vh = {v_h}
xh = {x_h}
impact = False
if fresh:  # driven outwards up to the crest
    pass
elif v > 0.0:
    if vh > 0.0:
        if c2 < 0.0:
            bend = {a_h}
            # It may have been down and up again: a shorter step tells.
            while vh > 0.0 and bend <= 0.0 and v < -2.0 * c2 * h:
                h *= 0.5
                whole = False
                q = h * h
                vh = {v_h}
                xh = {x_h}
                bend = {a_h}
            if bend > 0.0 and vh > 0.0:
                lo = 0.0
                hi = h
                r = 0.5 * h
                for _i in range(60):
                    q = r * r
                    a = {a_r}
                    if a < 0.0:
                        lo = r
                    else:
                        hi = r
                    b = {j_r}
                    n = r - a / b if b != 0.0 else lo
                    if not (lo < n < hi):
                        n = 0.5 * (lo + hi)
                    if abs(n - r) < 1e-3 * h:
                        break
                    r = n
                q = r * r
                if {v_r} < 0.0:
                    h = r
                    whole = False
                    q = h * h
                    vh = {v_h}
                    xh = {x_h}
    if vh <= 0.0:
        lo = 0.0
        hi = h
        r = h * v / (v - vh)
        for _i in range(60):
            q = r * r
            a = {v_r}
            if a > 0.0:
                lo = r
            else:
                hi = r
            b = {a_r}
            n = r - a / b if b != 0.0 else lo
            if not (lo <= n <= hi):
                n = 0.5 * (lo + hi)
            d = abs(n - r)
            r = n
            if d <= near * r:
                break
        q = r * r
        {top}
        peak = max(peak, top)
        if xh <= 0.0:
            impact = True
            lo = r
            hi = h
            r = 2.0 * r if x == 0.0 and 2.0 * r < h else h
else:
    if vh > 0.0:
        lo = 0.0
        hi = h
        r = h * v / (v - vh)
        for _i in range(60):
            q = r * r
            a = {v_r}
            if a < 0.0:
                lo = r
            else:
                hi = r
            b = {a_r}
            n = r - a / b if b != 0.0 else lo
            if not (lo <= n <= hi):
                n = 0.5 * (lo + hi)
            d = abs(n - r)
            r = n
            if d <= near * r:
                break
        q = r * r
        if {x_r} <= 0.0:
            impact = True
            lo = 0.0
            hi = r
            r = hi
    elif c2 > 0.0 and xh > 0.0:
        bend = {a_h}
        while vh <= 0.0 and xh > 0.0 and bend >= 0.0 and -v < 2.0 * c2 * h:
            h *= 0.5
            whole = False
            q = h * h
            vh = {v_h}
            xh = {x_h}
            bend = {a_h}
        if bend < 0.0 and vh <= 0.0:
            lo = 0.0
            hi = h
            r = 0.5 * h
            for _i in range(60):
                q = r * r
                a = {a_r}
                if a > 0.0:
                    lo = r
                else:
                    hi = r
                b = {j_r}
                n = r - a / b if b != 0.0 else lo
                if not (lo < n < hi):
                    n = 0.5 * (lo + hi)
                if abs(n - r) < 1e-3 * h:
                    break
                r = n
            q = r * r
            if {v_r} > 0.0:
                h = r
                whole = False
                q = h * h
                vh = {v_h}
                xh = {x_h}
                lo = 0.0
                hi = h
                for _i in range(60):
                    r = 0.5 * (lo + hi)
                    q = r * r
                    if {v_r} < 0.0:
                        lo = r
                    else:
                        hi = r
                q = r * r
                if {x_r} <= 0.0:
                    impact = True
                    lo = 0.0
                    hi = r
    if xh <= 0.0 and not impact:
        impact = True
        lo = 0.0
        hi = h
        r = h
if impact:
    if x <= 0.0 and v <= 0.0:
        h = 0.0
        vh = v
    else:
        for _i in range(100):
            q = r * r
            a = {x_r}
            if a > 0.0:
                lo = r
            else:
                hi = r
            b = {v_r}
            n = r - a / b if b < 0.0 else lo
            if not (lo <= n <= hi):
                n = 0.5 * (lo + hi)
            d = abs(n - r)
            r = n
            if d <= tight * r:
                break
        h = r
        q = h * h
        {arrival}
    x = 0.0
    v = restitution * abs(vh)
    s = -s
else:
    {depart}
    x = xh
    v = vh
"""

FREE_NONLINEAR = """
away = 2.0 * math.sin(0.5 * (alpha - x))
missing = away * away - v * v
if v < 0.0 and (x < alpha or missing < 0.0):
    balanced = 4.0 * math.sin(0.5 * alpha) ** 2
    missing = balanced - restitution * restitution * (balanced - missing)
elif x >= alpha:
    return math.inf
if missing < 0.0:
    return math.inf
return max(peak, x, alpha - 2.0 * math.asin(0.5 * math.sqrt(missing))) / alpha
"""
FREE_LINEAR = """
missing = (alpha - x) * (alpha - x) - v * v
if v < 0.0 and (x < alpha or missing < 0.0):
    balanced = alpha * alpha
    missing = balanced - restitution * restitution * (balanced - missing)
elif x >= alpha:
    return math.inf
if missing < 0.0:
    return math.inf
return max(peak, x, alpha - math.sqrt(missing)) / alpha
"""

# Rest: with all decelerations at least `least` for `window`, the hops last 2 v/((1 - e) least) at most.
REST = """
dies = False
if v < 0.3 * alpha:
    now = abs({u_now})
    least = 0.5 * (lever0 - now * lever1)
    if least > 0.0:
        window = 2.02 * v / ((1.0 - restitution) * least)
        dies = {steady} and v * v <= 1e-3 * least * alpha and v * v <= 1.9 * least * peak and t + window <= end
"""

SINE = {
    "prepare": """
w = rate
longest = 1.6 / w
end = 2.0 * math.pi / w
mww = -w * w
{levers}
if A <= threshold:
    return 0.0
angle = math.asin(threshold / A)
near = 1e-8 if precise else 1e-4
tight = 4e-16 if precise else 1e-10
""",
    "uplift_first": "angle / w, -1.0",
    "piece_end": "end",
    "crest": "0.5 * math.pi / w if w * t < 1.5707963 else (1.5 * math.pi / w if w * t < 4.7123889 else end)",
    "u_now": "A * math.sin(w * t)",
    "steady": "A * w * window * lever1 <= least",
    "uplift_again": """
side_of_uplift = 1.0
lift = -1.0
if w * t < angle:
    lift = angle / w
    side_of_uplift = -1.0
elif w * t < math.pi + angle:
    lift = (math.pi + angle) / w
""",
    # The largest acceleration still to come that pushes inwards: s u > 0.
    "opposing": """
turn = w * t * (2.0 / math.pi)
U = A
if s < 0.0:
    if turn > 3.0:
        U = -A * math.sin(w * t)
elif turn > 2.0:
    U = 0.0
elif turn > 1.0:
    U = A * math.sin(w * t)
""",
}

EXPONENTIAL = {
    "prepare": """
end = 2.0 * math.pi / rate
half = 0.5 * end
longest = half
growth = shape / half
K = A / (1.0 - math.exp(shape))
{levers}
if A <= threshold:
    return 0.0
near = 1e-8 if precise else 1e-4
tight = 4e-16 if precise else 1e-10
""",
    "uplift_first": "math.log(1.0 - threshold / K) / growth, -1.0",
    "piece_end": "half if t < half else end",
    "crest": "half if t < half else end",
    "u_now": "K - K * math.exp(growth * (end - t if t >= half else t))",
    "steady": "abs(K * growth) * math.exp(max(shape, 0.0)) * window * lever1 <= least",
    "uplift_again": """
lift = -1.0
if t < half:
    crossing = math.log(1.0 - threshold / K) / growth
    if t <= crossing:
        lift = crossing
""",
    "opposing": """
U = 0.0
if s > 0.0:
    U = A if t < half else K - K * math.exp(growth * (end - t))
""",
}

LEVERS = {
    "nonlinear": "lever0 = math.sin(alpha)\nlever1 = math.cos(alpha)\nthreshold = lever0 / lever1",
    "linear": "lever0 = alpha\nlever1 = 1.0\nthreshold = alpha",
}
# Even under constant opposition U the block passes the balance: x'' >= k sin(x - alpha - atan U), k^2 = 1 + U^2.
ESCAPE = {
    "nonlinear": "U < 1e3 and v > math.sqrt(math.sqrt(1.0 + U * U)) * max(alpha + math.atan(U) - x, 0.0)",
    "linear": "x - alpha + v > U",
}
FLAT = {"nonlinear": "if max(x, peak) >= 0.5 * math.pi:\n    return math.inf", "linear": "pass"}


# The next step: by the last two coefficients, and no more than a quarter of a cycle, so that none hides two events.
LENGTH = """
h = stop - t
whole = True
size = max(abs(c{N}), 1e-300)
size1 = max(abs(c{N1}), 1e-300)
step = min(math.exp(min(math.log(small / size) * {invN}, math.log(small / size1) * {invN1})), longest)
if step < h:
    h = step
    whole = False
"""


def indented(text, depth):
    """Text moved in by `depth` levels, without blank ends."""
    return ("\n" + "    " * depth).join(text.strip("\n").split("\n"))


def events_text(order, hooks=None):
    """Statements that find the first impact and the turning points of a step; `hooks` replace some of them."""
    c = [f"c{k}" for k in range(order + 1)]
    v = ["c1"] + [f"{float(k)} * c{k}" for k in range(2, order + 1)]
    a = [f"{float(k * (k - 1))} * c{k}" for k in range(2, order + 1)]
    j = [f"{float(k * (k - 1) * (k - 2))} * c{k}" for k in range(3, order + 1)]
    table = {f"{letter}_{at}": horner(p, at) for letter, p in zip("xvaj", (c, v, a, j)) for at in "hr"}
    table |= {"top": f"top = {table['x_r']}", "arrival": f"vh = {table['v_h']}", "depart": "pass"} | (hooks or {})
    return "q = h * h\n" + filled(EVENTS, table)


def filled(template, parts):
    """A template with every `{name}` replaced by its text at the depth of its line."""
    lines = []
    for line in template.strip("\n").split("\n"):
        bare = line.strip()
        if bare.startswith("{") and bare.endswith("}") and bare[1:-1] in parts:
            lines.append(line.replace(bare, indented(parts[bare[1:-1]], (len(line) - len(bare)) // 4)))
        else:
            for name, text in parts.items():
                line = line.replace("{" + name + "}", text)
            lines.append(line)
    return "\n".join(lines) + "\n"


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


def record_source(step):
    """Source of `one(alpha, p, restitution, samples, dt, rightward, leftward, precise, pieces)` (nonlinear)."""
    parts = {"rest": filled(REST, RECORD_WORDS), "escape": ESCAPE["nonlinear"], "flat": FLAT["nonlinear"]}
    parts |= {"free": FREE_NONLINEAR, "levers": LEVERS["nonlinear"]}
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
def record_map(order):
    """`peaks(alpha, p, restitution, samples, dt, rightward, leftward, precise, pieces)` over arrays, on all cores."""
    step = taylor_parts(order, "nonlinear", "record") | {"middle": "pass"}
    return over_blocks(compiled(record_source(step), f"record {order}"))


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
    def peaks(alpha, p, restitution, samples, dt, rightward, leftward, precise, pieces):
        found = np.empty(alpha.size)
        for i in numba.prange(alpha.size):
            found[i] = one(alpha[i], p[i], restitution[i], samples, dt, rightward, leftward, precise, pieces)
        return found

    return peaks


def run(problem, kernel, setting, chosen=slice(None)):
    """Peaks over alpha of the chosen scenes; `setting`: tolerance (of a record: steps a sample) and `precise`."""
    alpha, p, restitution, amplitude, rate = problem.columns(chosen)
    accuracy, precise = setting
    if problem.motion == "record":
        numba.set_parallel_chunksize(4)
        ahead = [np.maximum.accumulate(np.maximum(side * problem.samples, 0)[::-1])[::-1].copy() for side in (1, -1)]
        return kernel(alpha, p, restitution, problem.samples, problem.dt, *ahead, precise, accuracy)
    numba.set_parallel_chunksize(THREADS_CHUNK)
    return kernel(alpha, restitution, amplitude, rate, problems.SHAPE, accuracy, precise)


# Orders and tolerances for errors of about 1e-6, 1e-10 and 1e-12, found by trial.
SETTINGS = {
    "pulse": ((1e-6, 12, (1e-8, False)), (1e-10, 16, (1e-13, True)), (1e-12, 20, (1e-16, True))),
    "record": ((1e-6, 6, (1, True)), (1e-10, 8, (1, True)), (1e-12, 10, (1, True))),
}


def ways(problem):
    """The ways to solve a problem: (goal of the error, label, function of the chosen scenes)."""
    found = []
    for goal, order, setting in SETTINGS["record" if problem.motion == "record" else "pulse"]:
        if problem.motion == "record":
            kernel = functools.partial(record_map, order)
        else:
            kernel = functools.partial(pulse_map, problem.model, problem.motion, order)
        solve = lambda chosen=slice(None), kernel=kernel, s=setting: run(problem, kernel(), s, chosen)  # noqa: E731
        found.append((goal, f"order {order}", solve))
    return found
