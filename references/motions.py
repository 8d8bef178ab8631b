"""Ground motions of the Taylor reference: pulses and records piece by piece, in numbers of `arithmetic`.

Every motion gives the Taylor coefficients of its acceleration [g] anywhere in a smooth piece, and the first time in a
piece at which the acceleration passes the uplift threshold. Nothing here is shared with jaxrock.
"""

import bisect
import math

from references.arithmetic import sign


class Motion:
    """A motion of smooth pieces; times are local to a piece [s]."""

    pieces = 1

    def length(self, piece):
        """Duration of a piece [s]."""
        return self.duration

    def start(self, piece):
        """Time at which a piece starts [s]."""
        return self.length(0) * piece

    def bound(self, piece):
        """Upper bound of |u| from the start of a piece to the end of the motion [g]."""
        return abs(self.amplitude)

    def turns(self, piece):
        """Local times of the extremes inside a piece, rising."""
        return []

    def reach(self, piece, local, order):
        """Longest step [s] over which a series of this order may be judged by its last terms."""
        return math.inf

    def uplift(self, piece, local, threshold):
        """First time in the piece, from `local` on, at which |u| exceeds the threshold (None: never).

        Between its extremes the acceleration is monotone, so each span has one crossing at most.
        """
        if self.bound(piece) <= threshold:
            return None
        end = self.length(piece)
        marks = [local, *(t for t in self.turns(piece) if local < t < end), end]
        for low, high in zip(marks, marks[1:]):
            if abs(self.series(piece, low, 1, 0)[0]) > threshold:
                return low
            last = self.series(piece, high, 1, 0)[0]
            if abs(last) > threshold:
                return self.crossing(piece, sign(last) * threshold, low, high)
        return None

    def crossing(self, piece, level, low, high):
        """Time at which the acceleration passes a level between two times: Newton inside a bracket."""
        upward = sign(self.series(piece, high, 1, 0)[0] - level)
        close = self.arithmetic.power_of_ten(2 - self.arithmetic.digits)
        time = (low + high) / 2
        for _ in range(1000):
            value, slope = self.series(piece, time, 1, 1)[:2]
            gap = sign(value - level) * upward
            if gap == 0:
                return time
            low, high = (low, time) if gap > 0 else (time, high)
            guess = time - (value - level) / slope if slope else low
            guess = guess if low < guess < high else (low + high) / 2
            if abs(guess - time) <= close * high:
                return guess
            time = guess
        raise ArithmeticError("The uplift time did not converge.")


class Sinusoid(Motion):
    """amplitude sin(rate t + phase) [g] for a duration: sine, cosine and half-sine pulses."""

    def __init__(self, arithmetic, amplitude, rate, quarters, duration):
        self.arithmetic, self.amplitude, self.rate, self.duration = arithmetic, amplitude, rate, duration
        self.quarters = quarters  # 0: sine, 1: cosine

    def turns(self, piece):
        quarter = self.arithmetic.pi / (2 * self.rate)
        return [quarter * k for k in range(1 + self.quarters, 4, 2)]

    def reach(self, piece, local, order):
        return order / 4 / float(self.rate)

    def series(self, piece, local, unit, order):
        sine, cosine = self.arithmetic.sin_cos(self.rate * local)
        value, slope = (cosine, -sine) if self.quarters else (sine, cosine)
        step = self.rate * unit
        square = -step * step
        terms = [self.amplitude * value, self.amplitude * slope * step]
        for k in range(2, order + 1):
            terms.append(terms[k - 2] * square / (k * (k - 1)))
        return terms


class Lines(Motion):
    """An accelerogram [g]: straight lines between samples dt apart, times a factor."""

    def __init__(self, arithmetic, samples, dt, factor=1):
        self.arithmetic = arithmetic
        self.samples, self.duration = [arithmetic.number(u) * factor for u in samples], arithmetic.number(dt)
        self.pieces = len(self.samples) - 1
        self.bounds = [abs(u) for u in self.samples]
        for i in range(self.pieces - 1, -1, -1):
            self.bounds[i] = max(self.bounds[i], self.bounds[i + 1])

    def bound(self, piece):
        return self.bounds[piece]

    def series(self, piece, local, unit, order):
        slope = (self.samples[piece + 1] - self.samples[piece]) / self.duration
        return [self.samples[piece] + slope * local, slope * unit]

    def uplift(self, piece, local, threshold):
        last = self.samples[piece + 1]
        if not local and abs(self.samples[piece]) <= threshold and abs(last) <= threshold:
            return None
        now, slope = self.series(piece, local, 1, 1)
        if abs(now) > threshold:
            return local
        return local + (sign(last) * threshold - now) / slope if abs(last) > threshold else None


class Constant(Motion):
    """A constant acceleration [g] for a duration [s]."""

    def __init__(self, arithmetic, amplitude, duration):
        self.arithmetic, self.amplitude, self.duration = arithmetic, amplitude, duration

    def series(self, piece, local, unit, order):
        return [self.amplitude, self.amplitude * 0]


class Exponential(Motion):
    """u = amplitude (e^(2 shape t/duration) - 1)/(e^shape - 1) up to half the duration, then mirrored."""

    pieces = 2

    def __init__(self, arithmetic, amplitude, duration, shape):
        self.arithmetic, self.amplitude, self.duration, self.shape = arithmetic, amplitude, duration / 2, shape
        self.rate = shape / self.duration

    def reach(self, piece, local, order):
        rate = abs(float(self.rate))
        if not rate:
            return math.inf
        # Far from where the exponential is 1 it is nothing: there its series may be bad.
        growing = (self.shape > 0) == (piece == 0)
        distance = float(self.duration - local if growing else local)
        return max(order / 4 / rate, distance - 2.4 * (self.arithmetic.digits + 5) / rate)

    def series(self, piece, local, unit, order):
        a = self.arithmetic
        foot = local if piece == 0 else self.duration - local  # time from the nearer end of the pulse
        step = self.rate * unit if piece == 0 else -self.rate * unit
        angle = self.rate * foot
        if self.shape == 0:
            slope = self.amplitude / self.duration
            return [slope * foot, slope * unit if piece == 0 else -slope * unit]
        if self.shape > 0:
            size = self.amplitude * a.exp(angle - self.shape) / -a.expm1(-self.shape)
            terms, term = [-size * a.expm1(-angle)], size
        else:
            size = self.amplitude / a.expm1(self.shape)
            terms, term = [size * a.expm1(angle)], size * a.exp(angle)
        for k in range(1, order + 1):
            term = term * step / k
            terms.append(term)
        return terms


class Ricker(Motion):
    """Minus the second or third derivative of e^(-y^2), y = rate (t - center), scaled to its peak."""

    def __init__(self, arithmetic, amplitude, rate, center, derivative):
        self.arithmetic, self.amplitude, self.rate, self.center = arithmetic, amplitude, rate, center
        self.duration, self.derivative = 2 * center, derivative
        root = arithmetic.sqrt(arithmetic.number(6))
        if derivative == 2:  # extremes where y^3 = 3 y/2
            self.levels, self.scale = [arithmetic.number(0), root / 2], -amplitude / 2
        else:  # 4 y^4 - 12 y^2 + 3 = 0
            self.levels = [arithmetic.sqrt((3 - root) / 2), arithmetic.sqrt((3 + root) / 2)]
            y = self.levels[0]
            self.scale = -amplitude / ((12 * y - 8 * y**3) * arithmetic.exp(-y * y))

    def turns(self, piece):
        marks = sorted({y * s for y in self.levels for s in (-1, 1)})
        return [self.center + y / self.rate for y in marks]

    def reach(self, piece, local, order):
        return order / 8 / float(self.rate) / max(1.0, abs(float(self.rate * (local - self.center))))

    def series(self, piece, local, unit, order):
        y, step = self.rate * (local - self.center), self.rate * unit
        gauss = [self.arithmetic.exp(-y * y)]
        gauss.append(-2 * step * y * gauss[0])
        for k in range(1, order + self.derivative):
            gauss.append(-2 * step * (y * gauss[k] + step * gauss[k - 1]) / (k + 1))
        n = self.derivative
        scale = self.scale / step**n
        return [scale * math.perm(k + n, n) * gauss[k + n] for k in range(order + 1)]


class Joined(Motion):
    """Motions one after the other."""

    def __init__(self, *parts):
        self.parts = parts
        self.firsts = [sum(part.pieces for part in parts[:i]) for i in range(len(parts))]
        self.pieces = sum(part.pieces for part in parts)

    def _find(self, piece):
        i = bisect.bisect_right(self.firsts, piece) - 1
        return self.parts[i], piece - self.firsts[i]

    def length(self, piece):
        part, own = self._find(piece)
        return part.length(own)

    def start(self, piece):
        return sum((self.length(i) for i in range(piece)), 0)

    def bound(self, piece):
        part, own = self._find(piece)
        later = self.parts[self.parts.index(part) + 1 :]
        return max([part.bound(own), *(other.bound(0) for other in later)])

    def turns(self, piece):
        part, own = self._find(piece)
        return part.turns(own)

    def reach(self, piece, local, order):
        part, own = self._find(piece)
        return part.reach(own, local, order)

    def series(self, piece, local, unit, order):
        part, own = self._find(piece)
        return part.series(own, local, unit, order)

    def uplift(self, piece, local, threshold):
        part, own = self._find(piece)
        return part.uplift(own, local, threshold)


class Sum(Motion):
    """A motion of one smooth piece that starts at once, and a constant acceleration that starts later."""

    def __init__(self, first, height, duration, delay):
        self.first, self.height, self.span = first, height, (delay, delay + duration)
        self.arithmetic = first.arithmetic
        self.knots = sorted({0 * delay, first.duration, *self.span})
        self.pieces = len(self.knots) - 1

    def length(self, piece):
        return self.knots[piece + 1] - self.knots[piece]

    def start(self, piece):
        return self.knots[piece]

    def bound(self, piece):
        return self.first.bound(0) + abs(self.height)

    def turns(self, piece):
        return [time - self.knots[piece] for time in self.first.turns(0)]

    def reach(self, piece, local, order):
        return self.first.reach(0, local, order) if self.first.amplitude else math.inf

    def series(self, piece, local, unit, order):
        start = self.knots[piece]
        terms = [0 * self.height] * (order + 1)
        if start < self.first.duration:
            terms = self.first.series(0, start + local, unit, order)
        if self.span[0] <= start < self.span[1]:
            terms = [terms[0] + self.height, *terms[1:]]
        return terms


def _ricker(a, amplitude, period, center, derivative):
    """A Ricker pulse; without a centre, the float64 product that leaves a tail below 1e-12 of the peak."""
    default = 5.7 / math.pi if derivative == 2 else 8.2 * math.sqrt(3) / (2 * math.pi)
    center = a.number(default * float(period)) if center is None else a.number(center)
    rate = a.pi / a.number(period)
    if derivative == 3:
        rate = rate * a.sqrt(a.number(2) / 3)
    return Ricker(a, amplitude, rate, center, derivative)


def motion(arithmetic, kind, numbers, factor=1, delay=0):
    """A motion from its kind and numbers.

    **Arguments:**

    - `kind`, `numbers`: "sine" or "cosine" (amplitude [g], period [s]; one cycle); "half sine", "rectangle" or
      "triangle" (amplitude, duration); "exponential" (amplitude, duration, shape); "ricker symmetric" or
      "ricker antisymmetric" (amplitude, period, centre or nothing); "record" (samples, dt); "quiet" (duration,);
      "sum" (amplitude and period of a cosine pulse; amplitude, duration and delay of a rectangular one).
    - `factor`: multiplies the acceleration.
    - `delay`: quiet time before the motion [s].
    """
    a = arithmetic
    if delay:
        quiet = Constant(a, a.number(0), a.number(delay))
        return Joined(quiet, motion(a, kind, numbers, factor))
    if kind == "record":
        return Lines(a, [float(u) for u in numbers[0]], float(numbers[1]), factor)
    if kind == "sum":
        cosine = motion(a, "cosine", numbers[:2], factor)
        return Sum(cosine, a.number(numbers[2]) * factor, a.number(numbers[3]), a.number(numbers[4]))
    if kind == "quiet":
        return Constant(a, a.number(0), a.number(numbers[0]))
    amplitude, duration = a.number(numbers[0]) * factor, a.number(numbers[1])
    if kind.startswith("ricker"):
        center = numbers[2] if len(numbers) > 2 else None
        return _ricker(a, amplitude, numbers[1], center, 2 if kind == "ricker symmetric" else 3)
    return {
        "sine": lambda: Sinusoid(a, amplitude, 2 * a.pi / duration, 0, duration),
        "cosine": lambda: Sinusoid(a, amplitude, 2 * a.pi / duration, 1, duration),
        "half sine": lambda: Sinusoid(a, amplitude, a.pi / duration, 0, duration),
        "rectangle": lambda: Constant(a, amplitude, duration),
        "triangle": lambda: Exponential(a, amplitude, duration, a.number(0)),
        "exponential": lambda: Exponential(a, amplitude, duration, a.number(numbers[2])),
    }[kind]()
