"""Ground motions in 150-bit numbers: horizontal u, vertical v [g], smooth on common pieces. Inputs: float64, exact."""

import gmpy2
from gmpy2 import mpfr
from series import rescaled


class Sine:
    """One cycle: amplitude sin(2 pi t/period)."""

    def __init__(self, amplitude, period):
        self.amplitude, self.rate = mpfr(amplitude), 2 * gmpy2.const_pi() / mpfr(period)
        self.knots, self.scale = [mpfr(0), mpfr(period)], 1 / self.rate

    def series(self, piece, t, order):
        """Taylor coefficients in seconds, t after the knot `piece`."""
        sine, cosine = gmpy2.sin_cos(self.rate * t)
        terms = [self.amplitude * sine, self.amplitude * cosine * self.rate]
        for k in range(order - 1):
            terms.append(-(self.rate**2) * terms[k] / ((k + 1) * (k + 2)))
        return terms


class Rectangle:
    """Constant amplitude."""

    def __init__(self, amplitude, duration):
        self.amplitude, self.knots, self.scale = mpfr(amplitude), [mpfr(0), mpfr(duration)], mpfr("inf")

    def series(self, piece, t, order):
        """As in `Sine`."""
        return [self.amplitude]


class Exponential:
    """amplitude (1 - e^(2 shape x))/(1 - e^shape), x = t/duration, up to x = 1/2, then mirrored; shape not 0."""

    def __init__(self, amplitude, duration, shape):
        duration, shape = mpfr(duration), mpfr(shape)
        self.knots = [mpfr(0), duration / 2, duration]
        self.size, self.rate = mpfr(amplitude) / (1 - gmpy2.exp(shape)), 2 * shape / duration
        self.scale = 1 / abs(self.rate)

    def series(self, piece, t, order):
        """As in `Sine`."""
        rate, foot = (self.rate, t) if piece == 0 else (-self.rate, self.knots[1] - t)
        term = -self.size * gmpy2.exp(self.rate * foot)
        terms = [self.size + term]
        for k in range(1, order + 1):
            term = term * rate / k
            terms.append(term)
        return terms


class Lines:
    """A record: straight lines between samples dt apart."""

    def __init__(self, samples, dt, factor=1.0):
        self.samples, self.dt = [mpfr(factor) * mpfr(u) for u in samples], mpfr(dt)
        self.knots, self.scale = [k * self.dt for k in range(len(samples))], mpfr("inf")

    def series(self, piece, t, order):
        """As in `Sine`."""
        slope = (self.samples[piece + 1] - self.samples[piece]) / self.dt
        return [self.samples[piece] + slope * t, slope]


class Scaled:
    """factor times a motion."""

    def __init__(self, motion, factor):
        self.motion, self.factor, self.knots, self.scale = motion, mpfr(factor), motion.knots, motion.scale

    def series(self, piece, t, order):
        """As in `Sine`."""
        return [self.factor * a for a in self.motion.series(piece, t, order)]


KINDS = {"sine": Sine, "rectangle": Rectangle, "exponential": Exponential, "record": Lines}


def motion(kind, *numbers):
    """A motion by its name: ("sine", amplitude, period), ("record", samples, dt, factor), ..."""
    return KINDS[kind](*numbers)


class Ground:
    """Horizontal and vertical motion on common pieces; the ground rests after the end of both."""

    def __init__(self, horizontal, vertical=None):
        self.parts = [horizontal, vertical]
        self.knots = sorted({t for m in self.parts if m is not None for t in m.knots})
        self.pieces = len(self.knots) - 1
        self.end = self.knots[-1]
        self.scale = min(m.scale for m in self.parts if m is not None)

    def length(self, piece):
        """Length of a piece [s]; that after the last is the quiet one, without end."""
        return self.knots[piece + 1] - self.knots[piece] if piece < self.pieces else mpfr("inf")

    def series(self, piece, t, order, unit=mpfr(1)):
        """Taylor coefficients of (u, 1 + v) in (time/unit), t after knot `piece`."""
        out = []
        for part in self.parts:
            terms = [mpfr(0)]
            if part is not None and piece < self.pieces:
                middle = (self.knots[piece] + self.knots[piece + 1]) / 2
                if middle < part.knots[-1]:
                    inner = max(i for i, k in enumerate(part.knots) if k < middle)
                    terms = part.series(inner, self.knots[piece] - part.knots[inner] + t, order)
            out.append(rescaled(terms, unit))
        out[1][0] = out[1][0] + 1
        return out
