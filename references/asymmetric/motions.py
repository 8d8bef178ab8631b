"""Ground motions in 150-bit numbers: horizontal u, vertical v [g], smooth on common pieces. Inputs: float64, exact."""

import math

from gmpy2 import mpfr

from references import motions
from references.asymmetric.series import ARITHMETIC, step_length


def motion(kind, *numbers, factor=1):
    """A motion by its name: ("sine", amplitude, period), ("record", samples, dt, factor), ..."""
    if kind == "record":
        samples, dt, scale = numbers
        return motions.Lines(ARITHMETIC, samples, dt, mpfr(scale) * mpfr(factor))
    return motions.motion(ARITHMETIC, kind, numbers, mpfr(factor))


def knots_of(part):
    """Times between the pieces of a motion, with its start and end."""
    return [part.start(piece) + mpfr(0) for piece in range(part.pieces + 1)]


class Ground:
    """Horizontal and vertical motion on common pieces; `quiet`: seconds of rest that follow both as one more piece."""

    def __init__(self, horizontal, vertical=None, quiet=0):
        self.parts = [m and (m, knots_of(m)) for m in (horizontal, vertical)]
        self.knots = sorted({t for part in self.parts if part for t in part[1]})
        self.end = self.knots[-1]
        if quiet:
            self.knots.append(self.end + quiet)
        self.pieces = len(self.knots) - 1

    def length(self, piece):
        """Length of a piece [s]; that after the last is the quiet one, without end."""
        return self.knots[piece + 1] - self.knots[piece] if piece < self.pieces else mpfr("inf")

    def shaking(self, piece, t):
        """Yield, for both parts, the motion, its piece and the time in it, t after knot `piece`; None after its end."""
        for part in self.parts:
            middle = (self.knots[piece] + self.knots[piece + 1]) / 2 if part and piece < self.pieces else None
            if middle is None or middle >= part[1][-1]:
                yield None
                continue
            inner = max(i for i, knot in enumerate(part[1]) if knot < middle)
            yield part[0], inner, self.knots[piece] - part[1][inner] + t

    def reach(self, piece, t, order):
        """Longest step [s] over which series of this order may be judged by their last terms.

        A quarter of what the motion alone would allow: no term may be much larger than the sum.
        """
        steps = [m.reach(inner, local, order / 4) for m, inner, local in filter(None, self.shaking(piece, t))]
        return mpfr(min(steps, default=math.inf))

    def series(self, piece, t, order, unit=mpfr(1)):
        """Taylor coefficients of (u, 1 + v) in (time/unit), t after knot `piece`."""
        out = [
            list(part[0].series(part[1], part[2], unit, order)) if part else [mpfr(0)]
            for part in self.shaking(piece, t)
        ]
        out[1][0] = out[1][0] + 1
        return out

    def calm(self, piece, t, order):
        """The longest step for a block at rest, whether it ends the piece, and the series of (u, 1 + v) on it."""
        room = self.length(piece) - t
        h = min(room, self.reach(piece, t, order))
        part = step_length(*self.series(piece, t, order, h))
        if part < 1:
            h = h * part
        return h, h == room, self.series(piece, t, order, h)
