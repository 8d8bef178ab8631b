"""The asymmetric block by its scalar equation (README.md), Taylor series of order 44 in 150-bit numbers.

x'' = -p_s^2 [(1 + v) restoring_s(x) + s u arm_s(x)],  x = s rotation >= 0, side s = +1 (corner 1) or -1 (corner 2)
Housner: sin(alpha_s - x), cos(alpha_s - x);           linear: alpha_s - x, 1
uplift to side s where -s u > (1 + v) restoring_s(0)/arm_s(0);  x' *= restitution[s] at an impact from side s
"""

from dataclasses import dataclass, field

import gmpy2
from gmpy2 import mpfr

from references.arithmetic import dot
from references.asymmetric.series import DIGITS, ORDER, onset, product, product_term, roots, step_length
from references.roots import slopes_of as slopes, value_at as value

REST = mpfr(10) ** (16 - DIGITS)  # a block slower than this times p alpha after an impact rests


@dataclass
class Block:
    """Numbers per side, keyed +1 and -1; size[s] = R_s [m] only for the contact forces."""

    alpha: dict
    p: dict
    restitution: dict  # [s]: of an impact that ends an excursion on side s
    linear: bool = False
    size: dict | None = None
    gravity: object = mpfr("9.81")

    @classmethod
    def of(cls, alpha1, alpha2, p1, p2, e12, e21, linear=False, size=None, gravity=9.81):
        """From plain numbers (float64, exact, or mpfr)."""
        pair = lambda a, b: {1: mpfr(a), -1: mpfr(b)}  # noqa: E731
        return cls(pair(alpha1, alpha2), pair(p1, p2), pair(e12, e21), linear, size and pair(*size), mpfr(gravity))

    def threshold(self, s):
        """Horizontal over vertical acceleration at which it leaves the ground on side s."""
        return self.alpha[s] if self.linear else gmpy2.tan(self.alpha[s])

    def deficit(self, s, x, v):
        """2 (energy of the balanced block - energy)/(I_s p_s^2)."""
        away = self.alpha[s] - x
        away = away if self.linear else 2 * gmpy2.sin(away / 2)
        return away**2 - (v / self.p[s]) ** 2


@dataclass
class Result:
    """Events and results; `peaks`: outward turns (time, rotation); `impacts`: (time, velocity, side) before."""

    impacts: list = field(default_factory=list)
    peaks: list = field(default_factory=list)
    rests: list = field(default_factory=list)  # times at which it came to rest
    uplifts: list = field(default_factory=list)
    end: tuple | None = None  # rotation, velocity at the end of the motion
    impacts_in_motion: int = 0
    overturned: int = 0  # 0, or the side
    time_flat: object = None
    decided: str = ""  # "flat", "energy"
    impacts_after: int = 0  # impacts of the free stage before it overturns
    highest: dict = field(default_factory=lambda: {1: (mpfr(0), None), -1: (mpfr(0), None)})  # opening, time
    fastest: object = mpfr(0)
    samples: list = field(default_factory=list)
    friction: tuple = (mpfr(0), None)  # largest |H|/N while rocking during the motion, time
    normal: tuple = (mpfr("inf"), None)  # smallest N/mg likewise
    airborne: object = None  # first time at which N would have to pull


class Run:
    """One block on its way."""

    def __init__(self, block, ground, initial=(0, 0), times=(), order=ORDER, forces=False):
        self.block, self.ground, self.order, self.forces = block, ground, order, forces
        rotation, velocity = mpfr(initial[0]), mpfr(initial[1])
        side = (rotation > 0) - (rotation < 0) or (velocity > 0) - (velocity < 0)
        self.piece, self.t, self.side, self.x, self.v = 0, mpfr(0), side, side * rotation, side * velocity
        self.zeros = 1 if side and not rotation else 0
        self.out, self.times = Result(), [mpfr(t) for t in times]
        if side:
            self.note(self.x, mpfr(0))

    @property
    def now(self):
        """Time from the start [s]."""
        return self.ground.knots[self.piece] + self.t

    def note(self, x, time):
        """An opening angle that may be the largest on its side."""
        if x > self.out.highest[self.side][0]:
            self.out.highest[self.side] = x, time

    # One Taylor step

    def expand(self, h):
        """Series in time/h: opening, sine, cosine of alpha - x, s u, 1 + v."""
        b, s, n = self.block, self.side, self.order
        u, w = self.ground.series(self.piece, self.t, n, h)
        u = [s * a for a in u]
        square = -((b.p[s] * h) ** 2)
        c, sine, cosine = [self.x, self.v * h], [], []
        if not b.linear:
            sine, cosine = ([a] for a in gmpy2.sin_cos(b.alpha[s] - self.x))
        for k in range(n - 1):
            if b.linear:
                sine.append((b.alpha[s] if k == 0 else 0) - c[k])
                cosine.append(mpfr(k == 0))
            elif k:
                d = [j * a for j, a in enumerate(c[: k + 1])][1:]
                sine_k = -dot(d, cosine[::-1]) / k
                cosine.append(dot(d, sine[::-1]) / k)
                sine.append(sine_k)
            term = product_term(w, sine, k) + product_term(u, cosine, k)
            if k == 0 and self.zeros == 3:
                term = mpfr(0)  # left the ground where the threshold is passed: zero by definition
            c.append(square * term / ((k + 1) * (k + 2)))
        return c, sine, cosine, u, w

    def sized(self):
        """Length of the next step, whether it reaches the end of the piece, and its series."""
        b, s = self.block, self.side
        room = self.ground.length(self.piece) - self.t
        h = min(room, 2 / b.p[s], self.ground.reach(self.piece, self.t, self.order))
        if self.zeros == 1:  # a hop: twice its flight
            u, w = self.ground.series(self.piece, self.t, 1)
            a = self.gravity_term(u[0], w[0])
            if a > 0:
                h = min(h, 4 * self.v / a)
        whole = h == room
        series = self.expand(h)
        part = step_length(*series[:1] if b.linear else series[:3])
        if part < 1:
            h, whole = h * part, False
            series = self.expand(h)
        return h, whole, series

    def ending(self, c):
        """Where a step ends, as a part of it, and how: "impact", "flat", or "" after the whole step."""
        impact = next(roots(c, self.zeros), None)
        flat = None
        if not self.block.linear and sum(map(abs, c)) > 1.5:
            flat = next(roots([c[0] - gmpy2.const_pi() / 2, *c[1:]]), None)
        if flat is not None and (impact is None or flat < impact):
            return flat, "flat"
        return (mpfr(1), "") if impact is None else (impact, "impact")

    def turns(self, h, end, c, d):
        """Outward turning points and extreme velocities of a step."""
        curve = slopes(d)
        for turn in roots(d, max(self.zeros - 1, 0)):
            if turn > end:
                break
            if value(curve, turn) < 0:
                x, time = value(c, turn), self.now + turn * h
                self.note(x, time)
                self.out.peaks.append((time, self.side * x))
        for bend in roots(curve, max(self.zeros - 2, 0)):
            if bend <= end:
                self.out.fastest = max(self.out.fastest, abs(value(d, bend)) / h)

    def step(self):
        """One step, cut at the first of: impact, fallen flat, end of the piece. False once fallen flat."""
        h, whole, series = self.sized()
        c, d = series[0], slopes(series[0])
        end, event = self.ending(c)
        self.turns(h, end, c, d)
        self.sample(self.now, h, end, c, d)
        if self.forces and self.piece < self.ground.pieces:
            self.extreme_forces(self.now, h, end, series)
        self.x, self.v, self.t = value(c, end), value(d, end) / h, self.t + end * h
        self.out.fastest = max(self.out.fastest, abs(self.v))
        self.zeros = 0
        if event == "flat":
            self.out.overturned, self.out.time_flat, self.out.decided = self.side, self.now, "flat"
            return False
        if event == "impact":
            self.land()
        elif self.x < 0:
            raise ArithmeticError("fell through the floor")
        elif whole:
            self.piece, self.t = self.piece + 1, mpfr(0)
        return True

    def gravity_term(self, u, w):
        """Inward acceleration at x = 0."""
        b, s = self.block, self.side
        if b.linear:
            return b.p[s] ** 2 * (w * b.alpha[s] + s * u)
        sine, cosine = gmpy2.sin_cos(b.alpha[s])
        return b.p[s] ** 2 * (w * sine + s * u * cosine)

    def land(self):
        """Impact: the speed changes by the factor of this direction, the side changes; or rest."""
        s = self.side
        self.out.impacts.append((self.now, s * self.v, s))
        self.x, self.v, self.side, self.zeros = mpfr(0), -self.block.restitution[s] * self.v, -s, 1
        self.out.fastest = max(self.out.fastest, self.v)
        if self.v < REST * self.block.p[-s] * self.block.alpha[-s]:
            self.out.rests.append(self.now)
            self.side, self.v = 0, mpfr(0)

    def wait(self):
        """At rest: to the first uplift, or to the next piece."""
        h, whole, (u, w) = self.ground.calm(self.piece, self.t, self.order)
        pushes = {}
        for s in (1, -1):
            level, n = self.block.threshold(s), max(len(u), len(w))
            pushes[s] = [-s * (u[k] if k < len(u) else 0) - level * (w[k] if k < len(w) else 0) for k in range(n)]
        found = onset(pushes)
        start = self.now
        until = h if found is None else found[0] * h
        self.sample_rest(start, until)
        if found is not None:
            self.t += until
            _, self.side, self.zeros = found
            self.x, self.v = mpfr(0), mpfr(0)
            self.out.uplifts.append((self.now, self.side))
        elif whole:
            self.piece, self.t = self.piece + 1, mpfr(0)
        else:
            self.t += h

    # Samples and contact forces

    def contact(self, x, w2, a, u, vertical):
        """H/mg and N/mg of the ground on the block (H to the right) from opening, (v/p)^2, x''/p^2 on this side."""
        s, b = self.side, self.block
        sine, cosine = gmpy2.sin_cos(b.alpha[s] - x)
        k = b.size[s] * b.p[s] ** 2 / b.gravity
        return u + s * k * (cosine * a + sine * w2), vertical + k * (sine * a - cosine * w2)

    def sample(self, start, h, end, c, d):
        """States, and contact forces, at the times asked for."""
        curve = slopes(d)
        while self.times and self.times[0] <= start + end * h:
            time = self.times.pop(0)
            r = (time - start) / h
            x, v = value(c, r), value(d, r) / h
            entry = {"time": time, "rotation": self.side * x, "velocity": self.side * v}
            if self.block.size:
                p = self.block.p[self.side]
                u, w = (q[0] for q in self.ground.series(self.piece, self.t + r * h, 2))
                horizontal, normal = self.contact(x, (v / p) ** 2, value(curve, r) / (h * p) ** 2, u, w)
                entry |= {"horizontal": horizontal, "normal": normal, "friction": abs(horizontal) / normal}
            self.out.samples.append(entry)

    def sample_rest(self, start, until):
        """Take the samples that fall into a rest."""
        while self.times and self.times[0] <= start + until:
            time, zero = self.times.pop(0), mpfr(0)
            entry = {"time": time, "rotation": zero, "velocity": zero}
            if self.block.size:
                u, w = (q[0] for q in self.ground.series(self.piece, self.t + time - start, 2))
                entry |= {"horizontal": u, "normal": w, "friction": abs(u) / w}
            self.out.samples.append(entry)

    def extreme_forces(self, start, h, end, series):
        """Largest |H|/N and smallest N on a step, at its ends or where the derivative vanishes."""
        c, sine, cosine, u, w = series
        b, s = self.block, self.side
        k = b.size[s] / (b.gravity * h * h)
        d = slopes(c)
        curve, square = slopes(d), product(d, d)
        n = len(curve)
        su = u  # already s u: H is s times this series
        first = product(cosine, curve)
        second = product(sine, square)
        third, fourth = product(sine, curve), product(cosine, square)

        def at(a, i):
            return a[i] if i < len(a) else mpfr(0)

        horizontal = [at(su, i) + k * (first[i] + second[i]) for i in range(n)]
        normal = [at(w, i) + k * (third[i] - fourth[i]) for i in range(n)]
        bend = [x - y for x, y in zip(product(slopes(horizontal), normal), product(horizontal, slopes(normal)))]
        if self.out.airborne is None:
            if normal[0] <= 0:
                self.out.airborne = start
            else:
                gone = next((r for r in roots(normal) if r <= end), None)
                self.out.airborne = None if gone is None else start + gone * h
        points = [mpfr(0), end]
        points += [r for r in roots(bend) if r < end] + [r for r in roots(slopes(normal)) if r < end]
        for r in points:
            up = value(normal, r)
            demand = abs(value(horizontal, r)) / up if up > 0 else mpfr("inf")
            if demand > self.out.friction[0]:
                self.out.friction = demand, start + r * h
            if up < self.out.normal[0]:
                self.out.normal = up, start + r * h

    # The whole

    def follow(self):
        """Through the motion, then the free stage until its verdict and its largest rotations are known."""
        out = self.out
        while self.piece < self.ground.pieces:
            if self.side == 0:
                self.wait()
            elif self.t >= self.ground.length(self.piece):
                self.piece, self.t = self.piece + 1, mpfr(0)
            elif not self.step():
                out.impacts_in_motion = len(out.impacts)
                return out
        out.impacts_in_motion = len(out.impacts)
        out.end = self.side * self.x, self.side * self.v
        out.end_deficit = self.block.deficit(self.side, self.x, self.v) if self.side else None
        if self.side:
            self.note(self.x, self.now)
            self.free()
        return out

    def free(self):
        """At most three excursions matter: this one, the next, and that after it (energy falls over two impacts)."""
        out, b = self.out, self.block
        for _ in range(3):
            s = self.side
            if s == 0:
                return
            missing = b.deficit(s, self.x, self.v)
            beyond = self.x >= b.alpha[s]
            if (missing < 0 and self.v > 0) or (missing > 0 and beyond):
                out.overturned, out.decided = s, "energy"
                out.impacts_after = len(out.impacts) - out.impacts_in_motion
                return
            count = len(out.impacts)
            for _ in range(2000):
                self.step()
                if len(out.impacts) > count:
                    break
            else:
                raise ArithmeticError("did not come back")


def follow(block, ground, **options):
    """Run one scene."""
    return Run(block, ground, **options).follow()
