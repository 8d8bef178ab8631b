"""A rock from its outline: area, centroid, polar moment, corners, and which rotation brings other points to the ground.

Plain numbers in, plain numbers out; works with float, Fraction and mpfr coordinates alike. x to the right, y up.
"""

import math


def properties(vertices):
    """Area (positive), centroid, and polar moment of area about the centroid over the area, of a simple polygon.

    Green's theorem, with coordinates from the first vertex so that a far origin loses no digits.
    """
    x0, y0 = vertices[0]
    points = [(x - x0, y - y0) for x, y in vertices]
    twice = sx = sy = polar = 0
    for (x, y), (a, b) in zip(points, points[1:] + points[:1]):
        cross = x * b - a * y
        twice += cross
        sx += cross * (x + a)
        sy += cross * (y + b)
        polar += cross * (x * x + x * a + a * a + y * y + y * b + b * b)
    cx, cy = sx / (3 * twice), sy / (3 * twice)
    return abs(twice) / 2, (cx + x0, cy + y0), polar / (6 * twice) - cx * cx - cy * cy


def simple(vertices):
    """Return whether no two edges of the outline cross or touch except neighbours at their vertex."""
    n = len(vertices)

    def turn(p, q, r):
        d = (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])
        return (d > 0) - (d < 0)

    for i in range(n):
        for j in range(i + 2, n):
            if i == 0 and j == n - 1:
                continue
            p, q, r, s = vertices[i], vertices[(i + 1) % n], vertices[j], vertices[(j + 1) % n]
            if turn(p, q, r) * turn(p, q, s) <= 0 and turn(r, s, p) * turn(r, s, q) <= 0:
                return False
    return True


def support(vertices, tolerance=0):
    """The two extreme points of an outline on flat ground: (right, left) of those within `tolerance` of the lowest.

    One point alone, or a centroid not between them: the outline does not stand so; ValueError for one point.
    """
    low = min(y for _, y in vertices)
    touching = [v for v in vertices if v[1] <= low + tolerance]
    right, left = max(touching), min(touching)
    if right[0] == left[0]:
        raise ValueError("The outline stands on one point.")
    return right, left


def resting(vertices, center):
    """The outline and centre turned so that they stand: every hull edge whose ends lie on both sides of the centre.

    Yields (edge, angle by which to turn counter-clockwise [rad]) of each stable pose.
    """
    hull = convex_hull(vertices)
    for (x, y), (a, b) in zip(hull, hull[1:] + hull[:1]):
        share = ((center[0] - x) * (a - x) + (center[1] - y) * (b - y)) / ((a - x) ** 2 + (b - y) ** 2)
        if 0 < share < 1:
            yield ((x, y), (a, b)), -math.atan2(b - y, a - x)


def convex_hull(vertices):
    """Hull, counter-clockwise from the leftmost point (monotone chain)."""
    points = sorted(set(vertices))

    def half(points):
        out = []
        for r in points:
            while len(out) > 1 and (out[-1][0] - out[-2][0]) * (r[1] - out[-2][1]) <= (out[-1][1] - out[-2][1]) * (
                r[0] - out[-2][0]
            ):
                out.pop()
            out.append(r)
        return out

    return half(points)[:-1] + half(points[::-1])[:-1]


def block_numbers(center, inertia_over_mass, right, left, gravity=9.81, atan2=math.atan2, sqrt=math.sqrt):
    """alpha, p, R, restitution as pairs (side 1: right corner, side 2: left corner)."""
    arms = [(right[0] - center[0], center[1] - right[1]), (center[0] - left[0], center[1] - left[1])]
    if not all(b > 0 and h > 0 for b, h in arms):
        raise ValueError("The centre of mass must be above and between the two corners.")
    square = [b * b + h * h for b, h in arms]
    radius = [sqrt(s) for s in square]
    inertia = [inertia_over_mass + s for s in square]  # about the corners, over the mass
    (b1, h1), (b2, h2) = arms
    mixed = inertia_over_mass + h1 * h2 - b1 * b2  # R1 R2 cos(alpha1 + alpha2) = h1 h2 - b1 b2
    return {
        "alpha": [atan2(b, h) for b, h in arms],
        "p": [sqrt(gravity * r / i) for r, i in zip(radius, inertia)],
        "R": radius,
        "restitution": [mixed / inertia[1], mixed / inertia[0]],
        "energy_kept": mixed * mixed / (inertia[0] * inertia[1]),
        "normal_over_p2R": [r / i * r for r, i in zip(radius, inertia)],
    }


def next_contact(vertices, right, left):
    """Rotations [rad] to either side at which another point of the outline reaches flat ground: corner ceases to be
    the only contact. Below the side's alpha: it cannot fall about that corner."""

    def first(corner, s):
        return min(
            (math.atan2(y - corner[1], s * (x - corner[0])) for x, y in vertices if s * (x - corner[0]) > 0),
            default=math.pi / 2,
        )

    return [min(first(right, 1), math.pi / 2), min(first(left, -1), math.pi / 2)]
