"""Reference responses of a Housner block: Taylor series in 40-digit arithmetic, with events isolated by sign counts.

    theta'' = -p^2 [sin(s alpha - theta) + u(t) cos(s alpha - theta)],     theta' *= restitution at theta = 0

It shares no code and no method with jaxrock: mpmath numbers, order 30, roots bracketed by Descartes' rule of signs
on Bernstein coefficients (no root of the series can be missed), hops followed one by one down to 1e-22 p alpha. Where
it cannot decide it raises. Inputs are float64 numbers taken as exact. Answers are kept in `reference_taylor.json`.

    python benchmarks/reference_taylor.py        # compute some answers again, at another order and precision
"""

import hashlib
import json
import pathlib
from dataclasses import dataclass, field

from mpmath import mp, mpf

DIGITS, ORDER = 40, 30
CACHE = pathlib.Path(__file__).with_suffix(".json")
FINITE_DIFFERENCE = "1e-10"  # relative change of the amplitude for condition numbers


class Sine:
    """One full cycle of amplitude sin(2 pi t/period) [g]: a motion of one piece."""

    pieces = 1

    def __init__(self, amplitude, period):
        self.amplitude, self.rate, self.period = mpf(amplitude), 2 * mp.pi / mpf(period), mpf(period)

    def length(self, piece):
        """Duration of a piece [s]."""
        return self.period

    def series(self, piece, local, order):
        """Taylor coefficients of the acceleration [g] about `local` seconds into a piece."""
        sine, cosine = mp.sin(self.rate * local), mp.cos(self.rate * local)
        terms = [self.amplitude * sine, self.amplitude * cosine * self.rate]
        for k in range(2, order + 1):
            terms.append(-terms[k - 2] * self.rate**2 / (k * (k - 1)))
        return terms

    def uplift(self, piece, local, threshold):
        """First time in the piece, from `local` on, at which |u| exceeds the threshold (None: never)."""
        if abs(self.amplitude) <= threshold:
            return None
        angle = mp.asin(threshold / abs(self.amplitude))
        now = self.rate * local
        starts = [angle, mp.pi + angle]
        if any(start < now < start + mp.pi - 2 * angle for start in starts):
            return local
        later = [start for start in starts if start >= now]
        return min(later) / self.rate if later else None


class Lines:
    """An accelerogram [g]: straight lines between samples dt apart, times a factor."""

    def __init__(self, samples, dt, factor=1):
        self.samples, self.dt = [mpf(float(u)) * factor for u in samples], mpf(float(dt))
        self.pieces = len(self.samples) - 1

    def length(self, piece):
        """Duration of a piece [s]."""
        return self.dt

    def series(self, piece, local, order):
        """Taylor coefficients of the acceleration [g] about `local` seconds into a piece."""
        slope = (self.samples[piece + 1] - self.samples[piece]) / self.dt
        return [self.samples[piece] + slope * local, slope]

    def uplift(self, piece, local, threshold):
        """First time in the piece, from `local` on, at which |u| exceeds the threshold (None: never)."""
        now, slope = self.series(piece, local, 1)
        if abs(now) > threshold:
            return local
        last = self.samples[piece + 1]
        if abs(last) <= threshold:
            return None
        return local + (mp.sign(last) * threshold - now) / slope


def expand(alpha, p, side, x, v, forcing, order, continuous):
    """Taylor coefficients of the opening angle x = side * theta [rad, s].

    `continuous`: the block leaves rest where |u| passes the threshold, so that its acceleration is zero by definition.
    """
    opening, slopes = [x, v], [v]  # slopes[k] = (k + 1) opening[k + 1]
    sine, cosine = [mp.sin(alpha - x)], [mp.cos(alpha - x)]
    for k in range(order - 1):
        if k > 0:
            sine.append(-mp.fdot(slopes[:k], cosine[k - 1 :: -1]) / k)
            cosine.append(mp.fdot(slopes[:k], sine[k - 1 :: -1]) / k)
        pushes = min(k + 1, len(forcing))
        push = mp.fdot(forcing[:pushes], cosine[k : k - pushes : -1] if pushes <= k else cosine[k::-1])
        term = -p * p * (sine[k] + side * push) / ((k + 1) * (k + 2))
        if k == 0 and continuous:
            term = mpf(0)
        opening.append(term)
        slopes.append((k + 2) * term)
    return opening


def step_length(coefficients):
    """Step for which the last two terms fall below the working tolerance."""
    order = len(coefficients) - 1
    tolerance = mpf(10) ** (4 - mp.dps)
    last = {order - 1: abs(coefficients[-2]), order: abs(coefficients[-1])}
    return min(((tolerance / size) ** (mpf(1) / k) for k, size in last.items() if size), default=mp.inf)


def without_roots_at_zero(coefficients):
    """The polynomial divided by t as often as it vanishes at t = 0 exactly."""
    lowest = next((k for k, c in enumerate(coefficients) if c), len(coefficients))
    return coefficients[lowest:]


def bernstein(coefficients, length):
    """Bernstein coefficients of a polynomial on [0, length]."""
    degree = len(coefficients) - 1
    scaled = [c * length**k / mp.binomial(degree, k) for k, c in enumerate(coefficients)]
    for level in range(1, degree + 1):  # a table of sums: b_i = sum_k binomial(i, k) scaled_k
        for i in range(degree, level - 1, -1):
            scaled[i] += scaled[i - 1]
    return scaled


def halves(values):
    """Bernstein coefficients on both halves of the interval (de Casteljau)."""
    left, right, row = [values[0]], [values[-1]], values
    while len(row) > 1:
        row = [(a + b) / 2 for a, b in zip(row, row[1:])]
        left.append(row[0])
        right.append(row[-1])
    return left, right[::-1]


def polish(coefficients, low, high):
    """The one root in [low, high] at whose ends the polynomial differs in sign: Newton inside a bracket."""
    slopes = [k * c for k, c in enumerate(coefficients)][:0:-1]
    downward = coefficients[::-1]
    sign_low = mp.sign(mp.polyval(downward, low))
    x = (low + high) / 2
    for _ in range(400):
        value, slope = mp.polyval(downward, x), mp.polyval(slopes, x)
        if value == 0:
            return x
        low, high = (x, high) if mp.sign(value) == sign_low else (low, x)
        guess = x - value / slope if slope else low
        guess = guess if low < guess < high else (low + high) / 2
        if abs(guess - x) <= mpf(10) ** (2 - mp.dps) * high:
            return guess
        x = guess
    raise ArithmeticError("A root did not converge.")


def first_root(coefficients, length):
    """Smallest root in (0, length] of a polynomial, roots at zero left out; None if there is none."""
    polynomial = without_roots_at_zero(coefficients)
    if not polynomial or abs(polynomial[0]) > sum(abs(c) * length**k for k, c in enumerate(polynomial) if k):
        return None
    pending = [(mpf(0), mpf(1), bernstein(polynomial, length))]
    while pending:
        low, high, values = pending.pop()
        signs = [mp.sign(b) for b in values if b]
        changes = sum(a != b for a, b in zip(signs, signs[1:]))
        if changes == 1:
            return polish(polynomial, low * length, high * length)
        if changes == 0 and values[-1] == 0:
            return high * length
        if changes > 1:
            if high - low < mpf(10) ** (-mp.dps // 2):
                raise ArithmeticError("Two roots too close to tell apart: a grazing impact.")
            middle, (left, right) = (low + high) / 2, halves(values)
            pending += [(middle, high, right), (low, middle, left)]
    return None


@dataclass
class Path:
    """A block on its way: where it is in the motion, its state, and what has happened."""

    piece: int = 0
    local: mpf = field(default_factory=mpf)
    side: int = 0  # 0 at rest
    x: mpf = field(default_factory=mpf)
    v: mpf = field(default_factory=mpf)
    peak: mpf = field(default_factory=mpf)
    impacts: int = 0
    continuous: bool = False
    overturned: bool = False


def wait(path, motion, threshold):
    """At rest: go to the uplift, or to the next piece."""
    time = motion.uplift(path.piece, path.local, threshold)
    if time is None:
        path.piece, path.local = path.piece + 1, mpf(0)
        return
    acceleration = motion.series(path.piece, time, 1)[0]
    path.local, path.side, path.x, path.v = time, -int(mp.sign(acceleration)), mpf(0), mpf(0)
    path.continuous = abs(abs(acceleration) - threshold) < mpf(10) ** (8 - mp.dps)


def rock(path, motion, alpha, p, restitution, order):
    """One Taylor step, cut at the first event: impact, turning point, fallen flat, or the end of the piece."""
    forcing = motion.series(path.piece, path.local, order)
    x = expand(alpha, p, path.side, path.x, path.v, forcing, order, path.continuous)
    v = [k * c for k, c in enumerate(x)][1:]
    path.continuous = False
    room = motion.length(path.piece) - path.local
    step = min(step_length(x), room)
    events = {"end": step}
    for name, polynomial in (("impact", x), ("turn", v), ("flat", [x[0] - mp.pi / 2] + x[1:])):
        root = first_root(polynomial, step)
        if root is not None:
            events[name] = root
    event = min(events, key=events.get)
    time = events[event]
    path.x, path.v = mp.polyval(x[::-1], time), mp.polyval(v[::-1], time)
    if path.x < 0 and event != "impact":
        raise ArithmeticError("The block fell through the floor.")
    path.local += time
    if event == "end" and step == room:
        path.piece, path.local = path.piece + 1, mpf(0)
    if event == "turn":
        path.v, path.peak = mpf(0), max(path.peak, path.x)
    if event == "flat":
        path.overturned = True
    if event == "impact":
        path.impacts += 1
        path.x, path.v, path.side = mpf(0), -restitution * path.v, -path.side
        if path.v < mpf(10) ** -22 * p * alpha:
            path.side, path.v = 0, mpf(0)


def free_rocking(path, alpha, p, restitution):
    """After the motion: 2 (energy of the balanced block - energy)/p^2 gives the verdict and the last peak."""
    missing = (2 * mp.sin((alpha - path.x) / 2)) ** 2 - (path.v / p) ** 2
    balanced = (2 * mp.sin(alpha / 2)) ** 2
    path.peak = max(path.peak, path.x)
    outward = path.v >= 0
    if not outward and (path.x < alpha or missing < 0):  # it gets to an impact
        missing = balanced - restitution**2 * (balanced - missing)
        path.impacts += missing < 0
    elif path.x >= alpha:  # outward, or turning back outward
        path.overturned = True
        return
    path.overturned = missing < 0
    if not path.overturned:
        path.peak = max(path.peak, alpha - 2 * mp.asin(mp.sqrt(missing) / 2))


def respond(alpha, p, restitution, motion, order=ORDER):
    """Follow a block at rest through a motion and the free rocking after it.

    **Returns:** a `Path`: its peak [rad] counts unless overturned.
    """
    alpha, p, restitution = mpf(alpha), mpf(p), mpf(restitution)
    path, threshold = Path(), mp.tan(alpha)
    while path.piece < motion.pieces and not path.overturned:
        if path.side == 0:
            wait(path, motion, threshold)
        else:
            rock(path, motion, alpha, p, restitution, order)
    if path.side != 0 and not path.overturned:
        free_rocking(path, alpha, p, restitution)
    return path


def _motion(kind, numbers, factor):
    return Sine(mpf(numbers[0]) * factor, numbers[1]) if kind == "sine" else Lines(*numbers, factor)


def _key(block, kind, numbers):
    """What the answer depends on, exactly."""
    if kind == "sine":
        return " ".join([kind, *(repr(float(x)) for x in (*block, *numbers))])
    digest = hashlib.sha256(repr([float(u) for u in numbers[0]]).encode()).hexdigest()[:16]
    return " ".join([kind, *(repr(float(x)) for x in block), digest, repr(float(numbers[1]))])


def compute(block, kind, numbers):
    """The answer of `reference`, computed."""
    with mp.workdps(DIGITS):
        path = respond(*block, _motion(kind, numbers, mpf(1)))
        answer = {"peak": None, "impacts": path.impacts, "overturned": bool(path.overturned), "condition": None}
        if not path.overturned:
            change = mpf(FINITE_DIFFERENCE)
            sides = [respond(*block, _motion(kind, numbers, 1 + s * change)) for s in (1, -1)]
            answer["peak"] = mp.nstr(path.peak, 28)
            if path.peak and not any(side.overturned for side in sides):
                answer["condition"] = float(abs(sides[0].peak - sides[1].peak) / (2 * change * path.peak))
    return answer


def reference(cases, announce=print):
    """Answers for many cases, from the cache where it has them; new ones are added to it.

    **Arguments:**

    - `cases`: (block, kind, numbers): block = (alpha, p, restitution); kind "sine" with (amplitude [g], period [s]),
      or "record" with (samples [g], dt [s]).

    **Returns:** a dict each: `peak` (28 digits as text, rad; None if overturned), `impacts`, `overturned`, and
    `condition`, |d ln peak/d ln amplitude| (None if overturned, or if it overturns within the difference of 1e-10).
    """
    cache = json.loads(CACHE.read_text()) if CACHE.exists() else {}
    keys = [_key(*case) for case in cases]
    missing = [(key, case) for key, case in zip(keys, cases) if key not in cache]
    for done, (key, case) in enumerate(missing):
        cache[key] = compute(*case)
        if done % 50 == 0 or case[1] == "record" or done + 1 == len(missing):
            announce(f"reference: {done + 1} of {len(missing)} new responses")
            CACHE.write_text(json.dumps(cache, indent=0, sort_keys=True))
    return [cache[key] for key in keys]


def check(count=20, digits=60, order=40):
    """Compute some cached pulse responses again, at another precision and order; return the worst difference."""
    cache = json.loads(CACHE.read_text())
    worst = 0.0
    for key in [key for key in sorted(cache) if key.startswith("sine")][:: max(1, len(cache) // count)]:
        numbers = [float(word) for word in key.split()[1:]]
        with mp.workdps(digits):
            path = respond(*numbers[:3], Sine(*numbers[3:]), order)
            if path.overturned != cache[key]["overturned"]:
                raise AssertionError(f"Another verdict: {key}")
            if not path.overturned:
                worst = max(worst, float(abs(path.peak - mpf(cache[key]["peak"])) / numbers[0]))
    return worst


if __name__ == "__main__":
    print(f"largest difference of peak/alpha against 60 digits and order 40: {check():.1e}")
