"""The asymmetric block as a free rigid body in an inertial frame, without any scalar rocking equation.

Unknowns: centre of mass X, Y [m], rotation q (positive clockwise) and the force (FX, FY) on the corner it stands on.
Mass 1. The corner i is at rho_i in the body; d = Rot(q) rho_i. At every point of time the 5 x 5 system

    X'' = FX,  Y'' = -g + FY,  J q'' = -(dx FY - dy FX),  (X, Y)'' + d'' = G'' (the corner moves with the ground)

is solved for accelerations and forces, as power series. The ground moves: G'' = g (u, v). Impact: 5 x 5 system of
impulse and momentum with the other corner caught by the ground. The contact opens where its force vanishes.
"""

from dataclasses import dataclass

import gmpy2
from gmpy2 import mpfr

from references.asymmetric.series import ORDER, onset, product_term, roots, step_length
from references.roots import slopes_of as slopes, value_at as value


@dataclass
class Body:
    """Corner 1 at (b1, -h1) from the centre of mass (right), corner 2 at (-b2, -h2); inertia over mass i2 [m^2]."""

    b1: object
    h1: object
    b2: object
    h2: object
    i2: object
    gravity: object = 9.81

    def __post_init__(self):
        for name in ("b1", "h1", "b2", "h2", "i2", "gravity"):
            setattr(self, name, mpfr(getattr(self, name)))
        self.corner = {1: (self.b1, -self.h1), -1: (-self.b2, -self.h2)}

    def parameters(self):
        """alpha, p, R, restitution of both sides: the formulas of README.md (for the scalar equation only)."""
        r = {s: gmpy2.hypot(*self.corner[s]) for s in (1, -1)}
        alpha = {1: gmpy2.atan2(self.b1, self.h1), -1: gmpy2.atan2(self.b2, self.h2)}
        inertia = {s: self.i2 + r[s] ** 2 for s in (1, -1)}
        p = {s: gmpy2.sqrt(self.gravity * r[s] / inertia[s]) for s in (1, -1)}
        mixed = self.i2 + r[1] * r[-1] * gmpy2.cos(alpha[1] + alpha[-1])
        return alpha, p, r, {1: mixed / inertia[-1], -1: mixed / inertia[1]}


def solve(matrix, right):
    """Gaussian elimination with pivoting."""
    n = len(right)
    rows = [list(map(mpfr, row)) + [mpfr(b)] for row, b in zip(matrix, right)]
    for i in range(n):
        best = max(range(i, n), key=lambda j: abs(rows[j][i]))
        rows[i], rows[best] = rows[best], rows[i]
        for j in range(i + 1, n):
            factor = rows[j][i] / rows[i][i]
            rows[j] = [a - factor * b for a, b in zip(rows[j], rows[i])]
    out = [mpfr(0)] * n
    for i in reversed(range(n)):
        out[i] = (rows[i][n] - sum(rows[i][j] * out[j] for j in range(i + 1, n))) / rows[i][i]
    return out


def inverse(matrix):
    """Columns of the inverse, transposed into rows."""
    n = len(matrix)
    columns = [solve(matrix, [mpfr(i == j) for i in range(n)]) for j in range(n)]
    return [[columns[j][i] for j in range(n)] for i in range(n)]


def balance(inertia, dx, dy):
    """The 5 x 5 matrix of accelerations (velocities) and forces (impulses), the corner at (dx, dy)."""
    return [[1, 0, 0, -1, 0], [0, 1, 0, 0, -1], [0, 0, inertia, -dy, dx], [1, 0, dy, 0, 0], [0, 1, -dx, 0, 0]]


def extend_trigonometry(q, sine, cosine):
    """One more coefficient of the sine and cosine of a series."""
    k = len(sine)
    sine_k = sum((j * q[j] * cosine[k - j] for j in range(1, k + 1)), mpfr(0)) / k
    cosine.append(-sum((j * q[j] * sine[k - j] for j in range(1, k + 1)), mpfr(0)) / k)
    sine.append(sine_k)


class RigidRun:
    """One body on its way through the motion (not the free stage)."""

    def __init__(self, body, ground, initial=(0, 0), times=(), order=ORDER, rest=mpfr(10) ** -25):
        self.body, self.ground, self.order, self.rest = body, ground, order, rest
        self.piece, self.t = 0, mpfr(0)
        self.q, self.w = mpfr(initial[0]), mpfr(initial[1])
        self.side = (self.q > 0) - (self.q < 0) or (self.w > 0) - (self.w < 0)
        self.zeros = 1 if self.side and self.q == 0 else 0
        self.g, self.gv = [mpfr(0)] * 2, [mpfr(0)] * 2  # the ground's displacement and velocity
        self.place()
        self.impacts, self.samples, self.times = [], [], [mpfr(t) for t in times]
        self.flat, self.residual = None, mpfr(0)

    def turned(self, rho, q=None):
        """Rot(q) rho, clockwise."""
        sine, cosine = gmpy2.sin_cos(self.q if q is None else q)
        return rho[0] * cosine + rho[1] * sine, -rho[0] * sine + rho[1] * cosine

    def place(self):
        """Centre of mass and its velocity from the rotation about the corner; at rest: on both corners."""
        rho = self.body.corner[self.side or 1]
        d = self.turned(rho)
        self.at = [self.g[i] + rho[i] - d[i] for i in range(2)]
        self.speed = [self.gv[0] - d[1] * self.w, self.gv[1] + d[0] * self.w]

    @property
    def now(self):
        """Time from the start [s]."""
        return self.ground.knots[self.piece] + self.t

    def ground_series(self, h):
        """G and G'' in time/h."""
        b = self.body
        u, v = self.ground.series(self.piece, self.t, self.order, h)
        v = [v[0] - 1, *v[1:]]
        second = [[b.gravity * a for a in part] for part in (u, v)]
        first = []
        for i in range(2):
            c = [self.g[i], self.gv[i] * h]
            c += [a * h * h / ((k + 1) * (k + 2)) for k, a in enumerate(second[i])]
            first.append(c)
        return first, second

    def expand(self, h):
        """Series in time/h: X, Y, q, force, ground; accelerations per second^2."""
        b, n = self.body, self.order
        rho = b.corner[self.side]
        ground, second = self.ground_series(h)
        x, y, q = [self.at[0], self.speed[0] * h], [self.at[1], self.speed[1] * h], [self.q, self.w * h]
        sine, cosine = ([a] for a in gmpy2.sin_cos(self.q))
        dx, dy, square, z = [], [], [], [[] for _ in range(5)]
        for k in range(n - 1):
            if k:
                extend_trigonometry(q, sine, cosine)
            dx.append(rho[0] * cosine[k] + rho[1] * sine[k])
            dy.append(-rho[0] * sine[k] + rho[1] * cosine[k])
            rate = [(j + 1) * q[j + 1] / h for j in range(k + 1)]
            square.append(product_term(rate, rate, k))
            push = [c[k] if k < len(c) else mpfr(0) for c in second]
            right = [
                mpfr(0),
                -b.gravity if k == 0 else mpfr(0),
                mpfr(0),
                push[0] + product_term(square, dx, k),
                push[1] + product_term(square, dy, k),
            ]
            if k == 0:
                rows = inverse(balance(b.i2, dx[0], dy[0]))
            else:  # what the moving corner adds: the series of the matrix times the solution so far
                late = range(1, k + 1)
                right[2] -= sum((dx[j] * z[4][k - j] - dy[j] * z[3][k - j] for j in late), mpfr(0))
                right[3] -= sum((dy[j] * z[2][k - j] for j in late), mpfr(0))
                right[4] += sum((dx[j] * z[2][k - j] for j in late), mpfr(0))
            found = [sum((a * r for a, r in zip(row, right)), mpfr(0)) for row in rows]
            for i in range(5):
                z[i].append(found[i])
            for c, a in ((x, found[0]), (y, found[1]), (q, found[2])):
                c.append(a * h * h / ((k + 1) * (k + 2)))
        return x, y, q, z[3], z[4], ground

    def gap(self, series, h):
        """Height of the other corner over its place on the ground, as a series."""
        x, y, q, *_, ground = series
        rho = self.body.corner[-self.side]
        sine, cosine = ([a] for a in gmpy2.sin_cos(q[0]))
        for _ in range(1, len(q) - 1):
            extend_trigonometry(q, sine, cosine)
        n = len(sine)
        g = ground[1] + [mpfr(0)] * n
        out = [y[k] - rho[0] * sine[k] + rho[1] * cosine[k] - g[k] for k in range(n)]
        out[0] -= rho[1]
        return out

    def sized(self):
        """Length of the next step, whether it reaches the end of the piece, and its series."""
        room = self.ground.length(self.piece) - self.t
        h = min(room, mpfr("0.5"), self.ground.reach(self.piece, self.t, self.order))
        if self.zeros == 1:
            _, _, a, *_ = self.accelerations()
            if self.side * a < 0:
                h = min(h, 4 * abs(self.w / a))
        whole = h == room
        series = self.expand(h)
        part = step_length(series[2], series[0], series[1])
        if part < 1:
            h, whole = h * part, False
            series = self.expand(h)
        return h, whole, series

    def ending(self, series, h):
        """Where a step ends, as a part of it, and how: "impact", "flat", or "" after the whole step."""
        impact = next(roots(self.gap(series, h), self.zeros), None)
        q, flat = series[2], None
        if sum(map(abs, q)) > 1.5:
            flat = next(roots([q[0] - self.side * gmpy2.const_pi() / 2, *q[1:]]), None)
        if flat is not None and (impact is None or flat < impact):
            return flat, "flat"
        return (mpfr(1), "") if impact is None else (impact, "impact")

    def advance(self, series, h, end):
        """To the end of a step, with the samples on it; notes how far the corner is off its place."""
        q = series[2]
        while self.times and self.times[0] <= self.now + end * h:
            time = self.times.pop(0)
            r = (time - self.now) / h
            force = value(series[3], r), value(series[4], r)
            self.samples.append((time, value(q, r), value(slopes(q), r) / h, *force))
        self.at = [value(series[0], end), value(series[1], end)]
        self.speed = [value(slopes(series[0]), end) / h, value(slopes(series[1]), end) / h]
        self.q, self.w = value(q, end), value(slopes(q), end) / h
        self.g = [value(c, end) for c in series[5]]
        self.gv = [value(slopes(c), end) / h for c in series[5]]
        self.t += end * h
        rho = self.body.corner[self.side]
        d = self.turned(rho)
        self.residual = max(self.residual, *(abs(self.at[i] + d[i] - self.g[i] - rho[i]) for i in range(2)))

    def step(self):
        """One step, cut at the first event. False once fallen flat."""
        h, whole, series = self.sized()
        end, event = self.ending(series, h)
        self.advance(series, h, end)
        self.zeros = 0
        if event == "flat":
            self.flat = self.now
            return False
        if event == "impact":
            self.land()
        elif whole:
            self.piece, self.t = self.piece + 1, mpfr(0)
        return True

    def accelerations(self):
        """X'', Y'', q'' and the force now, from the 5 x 5 system."""
        b, rho = self.body, self.body.corner[self.side]
        dx, dy = self.turned(rho)
        _, second = self.ground_series(mpfr(1))
        right = [0, -b.gravity, 0, second[0][0] + self.w**2 * dx, second[1][0] + self.w**2 * dy]
        return solve(balance(b.i2, dx, dy), right)

    def land(self):
        """Impulse and momentum with the other corner caught by the ground, the old one free."""
        b, new = self.body, -self.side
        dx, dy = b.corner[new]
        # X+ - FX = X-, Y+ - FY = Y-, J w+ + dx FY - dy FX = J w-, corner: X+ + dy w+ = G', Y+ - dx w+ = G'
        right = [*self.speed, b.i2 * self.w, *self.gv]
        vx, vy, w, jx, jy = solve(balance(b.i2, dx, dy), right)
        ox, oy = b.corner[self.side]
        # the old corner's velocity after: it must go up, or both corners stay
        lifts = vy - ox * w - self.gv[1]
        self.impacts.append((self.now, self.w, self.side, jx, jy, lifts, w))
        self.side, self.q, self.w, self.zeros = new, mpfr(0), w, 1
        if lifts <= 0 or abs(w) < self.rest:
            self.side, self.w, self.zeros = 0, mpfr(0), 0
        self.place()

    def wait(self):
        """On both corners: one lets go where its force would vanish (gravity and inertia about the other)."""
        h, whole, (u, w) = self.ground.calm(self.piece, self.t, self.order)
        pushes = {}
        for s in (1, -1):
            b, height = (self.body.b1, self.body.h1) if s == 1 else (self.body.b2, self.body.h2)
            n = max(len(u), len(w))
            pushes[s] = [-s * height * (u[k] if k < len(u) else 0) - b * (w[k] if k < len(w) else 0) for k in range(n)]
        found = onset(pushes)
        until = h if found is None else found[0] * h
        ground, _ = self.ground_series(h)
        r = until / h
        self.g, self.gv = [value(c, r) for c in ground], [value(slopes(c), r) / h for c in ground]
        self.t += until
        while self.times and self.times[0] <= self.now:
            self.samples.append((self.times.pop(0), mpfr(0), mpfr(0), None, None))
        if found is not None:
            _, self.side, self.zeros = found
            self.q, self.w = mpfr(0), mpfr(0)
            self.place()
        elif whole:
            self.piece, self.t = self.piece + 1, mpfr(0)

    def follow(self):
        """Through the motion."""
        while self.piece < self.ground.pieces:
            if self.side == 0:
                self.wait()
            elif self.t >= self.ground.length(self.piece):
                self.piece, self.t = self.piece + 1, mpfr(0)
            elif not self.step():
                break
        return self
