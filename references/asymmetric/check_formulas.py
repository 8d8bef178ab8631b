"""The closed forms of README.md that nothing else checks: differences, near zero.

`python -m references.asymmetric.check_formulas` (seconds)
"""

import math

from gmpy2 import cos, mpfr, sin, sin_cos

from references.asymmetric.bodies import BODIES, body
from references.asymmetric.check_geometry import OUTLINES
from references.asymmetric.geometry import properties, resting
from references.asymmetric.motions import Ground, motion
from references.asymmetric.scalar import Block, follow


def restitutions(b):
    """Errors of the restitutions' other forms, of what relates the two sides, and of the energy kept."""
    alpha, p, r, e = b.parameters()
    kappa = {s: p[s] ** 2 * r[s] / b.gravity for s in (1, -1)}
    inertia = {s: b.i2 + r[s] ** 2 for s in (1, -1)}
    both = alpha[1] + alpha[-1]
    for s, t in ((1, -1), (-1, 1)):
        yield e[s] - (1 - kappa[t] * (1 - r[s] / r[t] * cos(both)))
        yield e[s] ** 2 * inertia[t] / inertia[s] - e[1] * e[-1]
        if b.h1 == b.h2:
            yield e[s] - (1 - kappa[t] * sin(alpha[t]) * sin(both) / cos(alpha[s]))
            k = (cos(alpha[s]) / cos(alpha[t])) ** 2 * kappa[s] / (1 - kappa[s])
            yield kappa[t] - k / (1 + k)
            yield p[t] ** 2 - p[s] ** 2 * kappa[t] / kappa[s] * cos(alpha[t]) / cos(alpha[s])


def forces():
    """Errors of the contact forces' closed forms against the sums of gravity and inertia."""
    alpha, kappa, u, v, w2, x = map(mpfr, ("0.3", "0.7", "-0.4", "0.2", "0.05", "0.1"))
    sine, cosine = sin_cos(alpha - x)
    for s in (1, -1):
        a = -((1 + v) * sine + s * u * cosine)
        h = u + s * kappa * (cosine * a + sine * w2)
        n = 1 + v + kappa * (sine * a - cosine * w2)
        yield h - (u * (1 - kappa * cosine**2) - s * kappa * (1 + v) * sine * cosine + s * kappa * sine * w2)
        yield n - ((1 + v) * (1 - kappa * sine**2) - s * u * kappa * sine * cosine - kappa * cosine * w2)


def hops(name, push, vertical, v):
    """Hops that die out under a constant push: their number, and the relative error of the time they take."""
    alpha, p, _, e = body(name).parameters()
    lift = {s: (1 + mpfr(vertical)) * sin(alpha[s]) + s * mpfr(push) * cos(alpha[s]) for s in (1, -1)}
    a = {s: p[s] ** 2 * lift[s] for s in (1, -1)}
    ground = Ground(motion("rectangle", push, 1.0), motion("rectangle", vertical, 1.0))
    out = follow(Block(alpha, p, e), ground, initial=(0, v))
    first = 2 * v / a[1]  # flight on side 1, then impacts from 1 to 2 and back
    rest = first + 2 * e[1] * v * (1 / a[-1] + e[-1] / a[1]) / (1 - e[1] * e[-1])
    return len(out.impacts), abs(out.rests[0] - rest) / rest


def poses(angle):
    """Angles that make an outline stand, once it is turned by an angle."""
    cosine, sine = math.cos(angle), math.sin(angle)
    vertices = [(x * cosine - y * sine, x * sine + y * cosine) for x, y in OUTLINES["rock"]]
    return [round(a, 12) for _, a in resting(vertices, properties(vertices)[1])]


def main():
    """Print differences."""
    for name in BODIES:
        b = body(name)
        _, p, r, e = b.parameters()
        kappa = " ".join(f"{float(p[s] ** 2 * r[s] / b.gravity):.4f}" for s in (1, -1))
        barriers = f"{float(r[1] - b.h1):.4f} {float(r[-1] - b.h2):.4f}"
        error = float(max(map(abs, restitutions(b))))
        print(f"{name}: kappa {kappa} barriers {barriers} m kept {float(e[1] * e[-1]):.4f} formulas {error:.0e}")
    print(f"forces {float(max(map(abs, forces()))):.0e}")
    for name, push, vertical in (("rock", 0.05, 0.0), ("steep", -0.03, 0.3)):
        for v in ("1e-7", "1e-9"):
            count, error = hops(name, push, vertical, mpfr(v))
            print(f"{name}: {count} hops from {v} rad/s, relative {float(error):.1e}")
    print("poses", poses(0.3), poses(0.0))


if __name__ == "__main__":
    main()
