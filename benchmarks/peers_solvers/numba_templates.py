"""Source of the numba integrators, as templates: a pulse, a record, the length of a step, rest, the free stage.

`numba_events.filled` puts text in place of every `{name}`.
"""

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
def one(alpha, p, restitution, scale, samples, dt, rightward, leftward, precise, pieces):
    {levers}
    lifting = threshold / scale
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
            while i < last and abs(samples[i + 1]) <= lifting:
                i += 1
                t = 0.0
            if i == last:
                return peak / alpha
            s = -1.0 if samples[i + 1] > 0.0 else 1.0
            t = max(t, (-s * lifting - samples[i]) / (samples[i + 1] - samples[i]) * end)
            x = 0.0
            v = 0.0
            fresh = True
        slope = (samples[i + 1] - samples[i]) / end
        f0 = s * scale * (samples[i] + slope * t)
        f1 = s * scale * slope
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
            U = scale * (rightward[i] if s > 0.0 else leftward[i])
            if {escape}:
                return math.inf
        {flat}
    if s == 0.0:
        return peak / alpha
    {free}
"""
RECORD_WORDS = {"u_now": "scale * (samples[i] + slope * t)", "steady": "scale * abs(slope) * window * lever1 <= least"}

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
