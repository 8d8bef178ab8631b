"""The bodies of the cases: corners from the centre of mass, inertia over mass; float64 numbers, exact."""

from references.asymmetric.rigid import Body

BODIES = {
    "rock": (0.25, 1.0, 0.15, 1.0, 0.35),
    "leaning": (0.30, 0.8, 0.08, 0.8, 0.22),
    "uneven": (0.20, 1.0, 0.12, 0.85, 0.3),
    "steep": (0.30, 0.9, 0.10, 0.8, 0.2),  # restitution above 1 from corner 1 to 2
    "stocky": (0.5, 0.7, 0.35, 0.7, 0.2),
    "column": (0.5, 4.0, 0.7, 4.0, 5.6),
    "rectangle": (0.2, 1.0, 0.2, 1.0, 1.04 / 3),
}


def body(name):
    """A body by its name."""
    return Body(*BODIES[name])


def numbers(name):
    """alpha1, alpha2, p1, p2, restitution12, restitution21, R1, R2 rounded to float64: the exact input of the cases."""
    alpha, p, r, e = body(name).parameters()
    return [float(x[s]) for x in (alpha, p, e, r) for s in (1, -1)]
