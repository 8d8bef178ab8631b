"""Reference responses: Taylor series in multiple precision (gmpy2), every event isolated before it is polished.

Time is p t. A step is a polynomial; the roots of opening angle and velocity on it are isolated by subdivision in
float64 until the polynomial has one sign or one slope, then polished by Newton in full precision. Known roots at the
start of an arc are divided out. Hops are followed one by one down to 10^-REST.
"""

import math
from operator import mul

import gmpy2
from gmpy2 import mpfr

BITS, REST, DIGITS = 135, 24, 36
CHANGE = 1e-13  # relative change of the parameters for condition numbers


def dot(first, second):
    """Sum of products, to the end of the shorter one."""
    return sum(map(mul, first, second))


def value(c, t):
    """A polynomial at t."""
    total = c[-1]
    for a in c[-2::-1]:
        total = total * t + a
    return total


def slopes(c):
    """Coefficients of the derivative."""
    return [k * a for k, a in enumerate(c)][1:]


# Motions: pieces on which the acceleration is smooth, in time p t


class Sine:
    """One full cycle of amplitude sin(rate t)."""

    def __init__(self, amplitude, rate, shape=None):
        self.amplitude, self.rate = amplitude, rate
        self.ends = [2 * gmpy2.const_pi() / rate]
        self.bounds = [amplitude]

    def series(self, piece, t, order):
        """Taylor coefficients at local time t."""
        sine, cosine = gmpy2.sin_cos(self.rate * t)
        terms = [self.amplitude * sine, self.amplitude * cosine * self.rate]
        for k in range(order - 1):
            terms.append(-(self.rate**2) * terms[k] / ((k + 1) * (k + 2)))
        return terms

    def uplift(self, piece, t, threshold):
        """First local time from t on at which |u| exceeds the threshold, or None; the side it goes to."""
        angle = gmpy2.asin(threshold / self.amplitude) if self.amplitude > threshold else None
        for half, side in ((0, -1), (1, 1)):
            if angle is not None and self.rate * t < half * gmpy2.const_pi() + angle:
                return (half * gmpy2.const_pi() + angle) / self.rate, side
        return None


class Exponential:
    """amplitude (1 - e^(2 shape x))/(1 - e^shape), x = t/duration, up to x = 1/2, then mirrored."""

    def __init__(self, amplitude, rate, shape):
        self.duration = 2 * gmpy2.const_pi() / rate
        self.ends = [self.duration / 2, self.duration / 2]
        self.scale = amplitude / (1 - gmpy2.exp(mpfr(shape)))
        self.growth, self.bounds = 2 * shape / self.duration, [amplitude, amplitude]

    def series(self, piece, t, order):
        """Taylor coefficients at local time t."""
        rate = self.growth if piece == 0 else -self.growth
        from_foot = t if piece == 0 else self.duration / 2 - t
        term = -self.scale * gmpy2.exp(self.growth * from_foot)
        terms = [self.scale + term]
        for k in range(1, order + 1):
            term = term * rate / k
            terms.append(term)
        return terms

    def uplift(self, piece, t, threshold):
        """As in `Sine`; a block that has come to rest on the falling piece stays there."""
        if piece or self.series(0, self.ends[0], 0)[0] <= threshold:
            return None
        return gmpy2.log(1 - threshold / self.scale) / self.growth, -1


class Lines:
    """A record: straight lines between samples `dt` apart."""

    def __init__(self, samples, dt):
        self.samples, self.dt = samples, dt
        self.ends = [dt] * (len(samples) - 1)
        self.bounds = [0] * (len(samples) - 1)
        largest = 0
        for i in range(len(samples) - 2, -1, -1):
            largest = max(largest, abs(samples[i]), abs(samples[i + 1]))
            self.bounds[i] = largest

    def series(self, piece, t, order):
        """Taylor coefficients at local time t."""
        slope = (self.samples[piece + 1] - self.samples[piece]) / self.dt
        return [self.samples[piece] + slope * t, slope]

    def uplift(self, piece, t, threshold):
        """As in `Sine`."""
        left, right = self.samples[piece], self.samples[piece + 1]
        if abs(right) <= threshold:
            return None
        level = threshold if right > 0 else -threshold
        return max(t, (level - left) / (right - left) * self.dt), -1 if right > 0 else 1


# Roots on a step, which runs from 0 to 1


def shifted(c, middle, radius):
    """Coefficients in s of a polynomial at middle + radius s (float64)."""
    c = list(c)
    for k in range(len(c) - 1):
        for j in range(len(c) - 2, k - 1, -1):
            c[j] += middle * c[j + 1]
    power = 1.0
    for k in range(len(c)):
        c[k] *= power
        power *= radius
    return c


def isolated(c, low=0.0, high=1.0, depth=0):
    """Intervals with one simple root each, rising (float64)."""
    rest = sum(map(abs, c[1:])) if depth == 0 else None
    if rest is not None and abs(c[0]) > rest * (1 + 1e-12):
        return
    q = shifted(c, (low + high) / 2, (high - low) / 2)
    if abs(q[0]) > sum(map(abs, q[1:])) * (1 + 1e-12):
        return
    if abs(q[1]) > sum(k * abs(a) for k, a in enumerate(q[2:], 2)) * (1 + 1e-12):
        if (value(q, -1.0) > 0) != (value(q, 1.0) > 0):
            yield low, high
        return
    if depth > 45:
        raise ArithmeticError("two events too close to be told apart")
    middle = (low + high) / 2
    yield from isolated(c, low, middle, depth + 1)
    yield from isolated(c, middle, high, depth + 1)


def roots(exact, rough, zeros):
    """Roots in (0, 1] after dividing out the `zeros` known ones at 0, in full precision."""
    exact, rough = exact[zeros:], rough[zeros:]
    for low, high in isolated(rough):
        rising = value(rough, high) > value(rough, low)
        while high - low > 1e-6:
            middle = (low + high) / 2
            low, high = (low, middle) if (value(rough, middle) > 0) == rising else (middle, high)
        root, derivative = mpfr((low + high) / 2), slopes(exact)
        for _ in range(5):
            root -= value(exact, root) / value(derivative, root)
        if 0 < root <= 1:
            yield root


# The block


class Run:
    """One block on its way; `follow` gives peak over alpha, or infinity."""

    def __init__(self, alpha, restitution, linear, motion, order):
        self.alpha, self.e, self.linear, self.motion, self.order = alpha, restitution, linear, motion, order
        self.threshold = alpha if linear else gmpy2.tan(alpha)
        self.piece, self.t, self.x, self.v, self.side, self.peak = 0, mpfr(0), mpfr(0), mpfr(0), 0, mpfr(0)
        self.zeros = 0  # known leading zeros of the opening angle's series
        self.impacts = 0
        self.tolerance = mpfr(10) ** -DIGITS

    def expand(self):
        """Taylor coefficients of the opening angle."""
        order, side = self.order, self.side
        force = [side * f for f in self.motion.series(self.piece, self.t, order)]
        c, d = [self.x, self.v], [self.v]
        sine, cosine = ([], []) if self.linear else ([s] for s in gmpy2.sin_cos(self.alpha - self.x))
        for k in range(order - 1):
            if self.linear:
                term = (self.alpha if k == 0 else 0) - c[k] + (force[k] if k < len(force) else 0)
            else:
                if k:
                    back = cosine[::-1]
                    cosine.append(dot(d, sine[::-1]) / k)
                    sine.append(-dot(d, back) / k)
                term = sine[k] + dot(force, cosine[::-1])
            term = mpfr(0) if self.zeros == 3 and k == 0 else -term / ((k + 1) * (k + 2))
            c.append(term)
            d.append((k + 2) * term)
        return c

    def length(self, c):
        """Step: to the tolerance, to the end of the piece at most, and no more than two flights of a hop."""
        h = self.motion.ends[self.piece] - self.t
        whole = True
        for k in (len(c) - 2, len(c) - 1):
            if c[k] != 0:
                bound = math.exp((math.log(1e-37) - float(gmpy2.log(abs(c[k])))) / k)
                if bound < h:
                    h, whole = mpfr(bound), False
        if self.zeros == 1 and c[2] < 0 and -2 * self.v / c[2] < h:
            h, whole = -2 * self.v / c[2], False
        return h, whole

    def step(self):
        """One step, cut at the first impact; True when the block is lost."""
        c = self.expand()
        h, whole = self.length(c)
        power = mpfr(1)
        for k in range(1, len(c)):
            power = power * h
            c[k] = c[k] * power
        rough = [float(a) for a in c]
        size = max(map(abs, rough)) or 1.0
        rough = [float(a / size) for a in c]
        impact = next(roots(c, rough, self.zeros), None)
        end = mpfr(1) if impact is None else impact
        d, rough_d = slopes(c), slopes(rough)
        for turn in roots(d, rough_d, max(self.zeros - 1, 0)):
            if turn <= end:
                self.peak = max(self.peak, value(c, turn))
        self.x, self.v, self.t = value(c, end), value(d, end) / h, self.t + end * h
        self.zeros = 0
        if not self.linear and max(self.x, self.peak) >= gmpy2.const_pi() / 2:
            return True
        if impact is not None:
            self.land()
        elif whole:
            self.piece, self.t = self.piece + 1, mpfr(0)
        return False

    def land(self):
        """Impact: the speed falls, the side changes; or rest."""
        self.impacts += 1
        self.x, self.v, self.side, self.zeros = mpfr(0), -self.e * self.v, -self.side, 1
        if self.v < mpfr(10) ** -REST:
            self.side, self.v = 0, mpfr(0)

    def wait(self):
        """At rest: to the uplift, or to the next piece."""
        found = self.motion.uplift(self.piece, self.t, self.threshold)
        if found is None:
            self.piece, self.t = self.piece + 1, mpfr(0)
            return
        time, self.side = found
        self.zeros = 3 if abs(abs(self.motion.series(self.piece, time, 1)[0]) - self.threshold) < 1e-30 else 2
        self.t = time

    def lost(self):
        """Whether no motion still to come can bring the block back."""
        if self.side == 0:
            return False
        bound, beyond = self.motion.bounds[self.piece], self.x - self.alpha
        if self.linear:
            return beyond + self.v > bound
        return self.v > 0 and beyond > gmpy2.atan(mpfr(bound))

    def free(self):
        """After the motion: the largest opening angle still to come, or infinity."""

        def deficit(x, v):
            away = self.alpha - x if self.linear else 2 * gmpy2.sin((self.alpha - x) / 2)
            return away * away - v * v

        missing, balanced = deficit(self.x, self.v), deficit(mpfr(0), mpfr(0))
        inward = self.v < 0 and (self.x < self.alpha or missing < 0)
        if inward:
            missing = balanced - self.e**2 * (balanced - missing)
        if missing < 0 or (self.x >= self.alpha and not inward):
            return mpfr("inf")
        root = gmpy2.sqrt(missing)
        return max(self.x, self.alpha - (root if self.linear else 2 * gmpy2.asin(root / 2)))

    def follow(self):
        """Peak over alpha."""
        while self.piece < len(self.motion.ends):
            if self.side == 0:
                self.wait()
            elif self.lost():
                return mpfr("inf")
            elif self.x <= 0 and self.v < 0:
                self.x = mpfr(0)
                self.land()
            elif self.t >= self.motion.ends[self.piece]:
                self.piece, self.t = self.piece + 1, mpfr(0)
            elif self.step():
                return mpfr("inf")
        last = self.free() if self.side else mpfr(0)
        return max(self.peak, last) / self.alpha


def solve(problem, index, factors=(0, 0, 0, 0)):
    """Peak over alpha and impacts of one scene, its parameters changed by relative `factors`.

    The factors are for alpha, restitution, amplitude and frequency (of a record: p).
    """
    from . import problems

    one = [1 + mpfr(f) for f in factors]
    alpha, e = mpfr(problem.alpha[index]) * one[0], mpfr(problem.restitution[index]) * one[1]
    linear = problem.model == "linear"
    if problem.motion == "record":
        p = mpfr(problem.p[index]) * one[3]
        motion = Lines([mpfr(u) * one[2] for u in problem.samples.tolist()], mpfr(problem.dt) * p)
        order = 18
    else:
        base = mpfr(problem.alpha[index])
        amplitude = mpfr(problem.intensity[index]) * (base if linear else gmpy2.tan(base)) * one[2]
        kind = Sine if problem.motion == "sine" else Exponential
        motion = kind(amplitude, mpfr(problem.rate[index]) * one[3], problems.SHAPE)
        order = 30
    run = Run(alpha, e, linear, motion, order)
    return run.follow(), run.impacts


def answer(problem, index):
    """The reference of one scene.

    **Returns:** a dict: `index`; `peak` over alpha (text of 30 digits, None if overturned); `condition`, the sum of
    |d peak/alpha| for small relative changes of alpha, restitution, amplitude and frequency, each; `impacts`.
    """
    with gmpy2.context(gmpy2.get_context(), precision=BITS):
        peak, impacts = solve(problem, index)
        safe = gmpy2.is_finite(peak)
        condition = None
        if safe:
            parts = [tuple(CHANGE if k == j else 0 for k in range(4)) for j in range(4)]
            changed = [solve(problem, index, factors)[0] for factors in parts]
            condition = float(sum(abs(other - peak) for other in changed) / CHANGE)
        text = f"{peak:.30g}" if safe else None
        return {"index": int(index), "peak": text, "condition": condition, "impacts": impacts}
