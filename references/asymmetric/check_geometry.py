"""Writes `geometry.json`: outlines with exact properties, checked by quadrature and by counting points.

`python -m references.asymmetric.check_geometry` (a minute)
"""

import math
import pathlib
import random
from fractions import Fraction

import numpy as np
from mpmath import mp, mpf, quad

from references.asymmetric.geometry import block_numbers, next_contact, properties, resting, simple, support
from references.asymmetric.reference import lines

FILE = pathlib.Path(__file__).with_name("geometry.json")
mp.dps = 30


def exact(vertices):
    """Float coordinates as fractions."""
    return [(Fraction(x), Fraction(y)) for x, y in vertices]


def strips(vertices, f):
    """Integral of the y-polynomial pieces: the outline cut at its vertices' heights, x integrated by quadrature."""
    heights = sorted({y for _, y in vertices})
    total = mpf(0)
    for low, high in zip(heights, heights[1:]):

        def width(y):
            cuts = []
            for (x, v), (a, b) in zip(vertices, vertices[1:] + vertices[:1]):
                if min(v, b) < y < max(v, b):
                    cuts.append(mpf(x) + (mpf(a) - x) * (y - v) / (mpf(b) - v))
            cuts.sort()
            return sum((f(right, y) - f(left, y) for left, right in zip(cuts[::2], cuts[1::2])), mpf(0))

        total += quad(width, [low, high])
    return total


def by_quadrature(vertices):
    """Area, centroid, polar moment over area about the centroid."""
    area = strips(vertices, lambda x, y: x)
    cx = strips(vertices, lambda x, y: x * x / 2) / area
    cy = strips(vertices, lambda x, y: x * y) / area
    return area, cx, cy, strips(vertices, lambda x, y: (x - cx) ** 3 / 3 + x * (y - cy) ** 2) / area


def by_counting(vertices, count=10_000_000):
    """Estimate the properties from random points, with standard errors (of the last: roughly)."""
    draw = np.random.default_rng(7)
    v = np.array(vertices)
    low, high = v.min(0), v.max(0)
    x, y = (low + (high - low) * draw.random((count, 2))).T
    inside = np.zeros(count, bool)
    for (a, b), (c, d) in zip(v, np.roll(v, -1, 0)):
        if b != d:
            inside ^= ((b > y) != (d > y)) & (x < (c - a) * (y - b) / (d - b) + a)
    share, box = inside.mean(), np.prod(high - low)
    x, y = x[inside], y[inside]
    square = (x - x.mean()) ** 2 + (y - y.mean()) ** 2
    errors = [box * math.sqrt(share * (1 - share) / count), x.std() / x.size**0.5, y.std() / x.size**0.5]
    return [box * share, x.mean(), y.mean(), square.mean()], [*errors, square.std() / x.size**0.5]


def rock(seed=3, corners=11):
    """A random star-shaped outline with a flat lowest edge, four decimals."""
    draw = random.Random(seed)
    points = []
    for k in range(corners):
        angle = -math.pi / 2 + 0.45 + (2 * math.pi - 0.9) * k / (corners - 1)
        r = draw.uniform(0.5, 1.0)
        points.append((round(0.6 * r * math.cos(angle), 4), round(1.0 + r * math.sin(angle), 4)))
    low = min(points[0][1], points[-1][1], *(y for _, y in points)) - 0.02
    points[0], points[-1] = (points[0][0], round(low, 4)), (points[-1][0], round(low, 4))
    return points


OUTLINES = {
    "rectangle": [(0.0, 0.0), (0.5, 0.0), (0.5, 2.0), (0.0, 2.0)],
    "triangle": [(0.0, 0.0), (0.75, 0.0), (0.25, 1.5)],
    "L-shape": [(0.0, 0.0), (1.0, 0.0), (1.0, 0.5), (0.5, 0.5), (0.5, 2.0), (0.0, 2.0)],
    "rock": rock(),
    "rock, clockwise, far away": [(x + 1024.0, y + 512.0) for x, y in rock()[::-1]],
}


def number(x):
    """A fraction as a number of mpmath."""
    return mpf(x.numerator) / x.denominator if isinstance(x, Fraction) else mpf(x)


def text(x):
    """25 digits."""
    return mp.nstr(number(x), 25)


def entry(vertices):
    """Return the entry of an outline: vertices, and properties as numbers."""
    fractions = exact(vertices)
    area, (cx, cy), polar = properties(fractions)
    right, left = support(fractions)
    center, *corners = (tuple(map(number, point)) for point in ((cx, cy), right, left))
    numbers = block_numbers(center, number(polar), *corners, mpf(9.81), mp.atan2, mp.sqrt)
    return {
        "vertices": vertices,
        "area": text(area),
        "centroid": [text(cx), text(cy)],
        "inertia_over_mass": text(polar),
        "exact": [str(x) for x in (area, cx, cy, polar)],
        "right_corner": [float(x) for x in right],
        "left_corner": [float(x) for x in left],
        "gravity": 9.81,
        "next_contact": next_contact(vertices, tuple(map(float, right)), tuple(map(float, left))),
        **{k: [text(x) for x in v] if isinstance(v, list) else text(v) for k, v in numbers.items()},
    }, [number(x) for x in (area, cx, cy, polar)]


def compare(name, vertices, mine):
    """Print differences to quadrature, to counting, and to float64."""
    assert simple(vertices), name
    quadrature = " ".join(f"{float(abs(a - b)):.0e}" for a, b in zip(mine, by_quadrature(vertices)))
    counted = zip(mine, *by_counting(vertices))
    counting = " ".join(f"{float(a - b) / max(float(e), 1e-15):.1f}" for a, b, e in counted)
    area, center, polar = properties(vertices)
    plain = " ".join(f"{float(abs(a - b) / abs(b)):.0e}" for a, b in zip([area, *center, polar], mine))
    poses = len(list(resting(vertices, center)))
    print(
        f"{name}: quadrature {quadrature}; counting {counting} standard errors; float64 {plain}; {poses} stable poses"
    )


def main():
    """All outlines."""
    out = {}
    for name, vertices in OUTLINES.items():
        out[name], mine = entry(vertices)
        compare(name, vertices, mine)
    b, h = 0.25, 1.0
    restitution, p = (float(out["rectangle"][key][0]) for key in ("restitution", "p"))
    error = restitution - (1 - 1.5 * b * b / (b * b + h * h)), p - math.sqrt(0.75 * 9.81 / math.hypot(b, h))
    print("rectangle: restitution", error[0], "p", error[1])
    FILE.write_text(lines(out, 1) + "\n")


if __name__ == "__main__":
    main()
