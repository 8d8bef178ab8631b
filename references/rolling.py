"""A block on circular edges under straight lines of ground acceleration: Newton's law, by steps of Runge and Kutta.

It shares no code and no method with jaxrock: the forces of the ground on a circle that rolls without slipping are
eliminated by hand, steps have a fixed length, and an impact is where a step of just the right length ends. Its own
error is told by half the length (`respond(..., parts=2 * parts)`).
"""

import math
from typing import NamedTuple

GRAVITY = 9.81
REST = 1e-9  # a block slower than this times p after an impact rests
AFTER = 40.0  # how long it is followed after the record, over 1/p; free rocking has died out, or it has fallen


class Rolling(NamedTuple):
    """A symmetric block: slenderness [rad], frequency parameter [rad/s], radius of its edges over R, restitution, and
    m R^2/I about the corner."""

    alpha: float
    p: float
    radius: float
    restitution: float
    ratio: float = 0.75

    def acceleration(self, opening, speed, push):
        """Angular acceleration, outward [1/s^2]; `push`: of the ground, towards the corner it stands on [g].

        With the centre of the circle r over the ground, and the centre of mass at (x, y) from there, the forces H and
        N on a mass of 1 follow from r t + y t - H = x v^2 - g push and -x t - N = y v^2 - g, and turn it about its
        centre of mass by t = (x N - (r + y) H)/I.
        """
        size = self.ratio * GRAVITY / self.p**2
        r, sine, cosine = self.radius * size, math.sin(opening), math.cos(opening)
        inward, up = -size * math.sin(self.alpha), size * math.cos(self.alpha) - r
        x, y = cosine * inward + sine * up, cosine * up - sine * inward
        about_contact = size**2 * (1 / self.ratio - 1) + (r + y) ** 2 + x**2
        return (r * x * speed**2 + GRAVITY * (x - (r + y) * push)) / about_contact

    def step(self, opening, speed, length, begin, slope):
        """Opening and speed after a time, by the rule of fourth order; the push is begin + slope t."""

        def change(share, x, v):
            return v, self.acceleration(x, v, begin + slope * share * length)

        a = change(0.0, opening, speed)
        b = change(0.5, opening + length / 2 * a[0], speed + length / 2 * a[1])
        c = change(0.5, opening + length / 2 * b[0], speed + length / 2 * b[1])
        d = change(1.0, opening + length * c[0], speed + length * c[1])
        return tuple(
            old + length / 6 * (i + 2 * j + 2 * k + m) for old, i, j, k, m in zip((opening, speed), a, b, c, d)
        )


class Found(NamedTuple):
    """Outcome of a block: whether it fell, its largest rotation until then [rad], its impacts."""

    overturned: bool
    peak: float
    impacts: int


def respond(block: Rolling, samples, dt: float, parts: int = 4) -> Found:
    """Follow a block from rest under samples [g], in so many steps between two of them, and on to its end."""
    quiet = [0.0] * (1 + math.ceil(AFTER / block.p / dt))
    run = _Run(block)
    for left, right in zip([*samples, *quiet], [*samples[1:], *quiet, 0.0]):
        slope = (right - left) / dt
        for part in range(parts):
            run.go(left + slope * part * dt / parts, slope, dt / parts)
            if run.opening > math.pi / 2:
                return Found(True, math.inf, run.impacts)
    return Found(False, run.peak, run.impacts)


class _Run:
    """A block on its way; `side` 0: at rest."""

    def __init__(self, block: Rolling):
        self.block, self.threshold = block, math.tan(block.alpha)
        self.side, self.opening, self.speed, self.peak, self.impacts = 0, 0.0, 0.0, 0.0, 0

    def go(self, begin: float, slope: float, left: float) -> None:
        """Follow it for a time under the acceleration begin + slope t [g]; a positive one drives it to side -1."""
        while left > 0:
            if self.side == 0:
                waits = self._waits(begin, slope, left)
                begin, left = begin + slope * waits, left - waits
                continue
            push = self.side * begin, self.side * slope
            end = self.block.step(self.opening, self.speed, left, *push)
            if end[0] > 0 or (self.opening == 0 and end[1] > 0):
                if self.speed > 0 > end[1]:
                    top = self._where(1, left, push)
                    self.peak = max(self.peak, self.block.step(self.opening, self.speed, top, *push)[0])
                self.opening, self.speed = end
                self.peak = max(self.peak, self.opening)
                return
            # Down to the ground; the root at the start of a hop is left out.
            first = self._where(1, left, push) if self.opening == 0 else 0.0
            used = self._where(0, left, push, first)
            _, speed = self.block.step(self.opening, self.speed, used, *push)
            self.peak = max(self.peak, self.block.step(self.opening, self.speed, first, *push)[0])
            begin, left = begin + slope * used, left - used
            self.opening, self.speed, self.side = 0.0, -self.block.restitution * speed, -self.side
            self.impacts += 1
            if self.speed < REST * self.block.p:
                self.side, self.speed = 0, 0.0

    def _waits(self, begin: float, slope: float, left: float) -> float:
        """How long the block stays at rest; then it stands on a side."""
        for sign in (1, -1):
            over, gain = sign * begin - self.threshold, sign * slope
            if over > 0 or over + gain * left > 0:
                self.side = -sign
                return 0.0 if over > 0 else min(-over / gain, left)
        return left

    def _where(self, part: int, last: float, push, first: float = 0.0) -> float:
        """The time at which the opening (0) or the speed (1) falls through zero, by bisection."""
        for _ in range(60):
            middle = (first + last) / 2
            above = self.block.step(self.opening, self.speed, middle, *push)[part] > 0
            first, last = (middle, last) if above else (first, middle)
        return first
