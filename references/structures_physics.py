"""Rocking structures from their bodies, restraints and memory, for `references.structures`; nothing is of jaxrock.

Lengths are over R, masses over m, forces over m g, moments over m g R, and w = dx/d(p t). R, m, p are those of the
block alone (of one column in a frame), so p^2 = kappa g/R. A structure obeys

    kappa [M x'' + M' x'^2/2] = moment,    M = sum[m (X'^2 + Y'^2) + I phi'^2]
"""

import math
from typing import Any, NamedTuple

import mpmath
import numpy as np


class Numbers(NamedTuple):
    """A type of number and its functions."""

    of: Any
    sin: Any
    cos: Any
    asin: Any
    acos: Any
    atan: Any
    sqrt: Any
    exp: Any
    pi: Any
    close: float  # relative distance below which two numbers count as equal


def numbers(kind):
    """Return `Numbers` of a kind: "float", "long" (80 bits) or "mpmath" (30 digits)."""
    if kind == "float":
        m = math
        return Numbers(float, m.sin, m.cos, m.asin, m.acos, m.atan, m.sqrt, m.exp, m.pi, 4e-16)
    if kind == "long":
        long, n = np.longdouble, np
        pi = long("3.14159265358979323846264338327950288")
        return Numbers(long, n.sin, n.cos, n.arcsin, n.arccos, n.arctan, n.sqrt, n.exp, pi, 4e-19)
    mpmath.mp.dps = 30
    m = mpmath
    return Numbers(m.mpf, m.sin, m.cos, m.asin, m.acos, m.atan, m.sqrt, m.exp, +m.pi, 1e-28)


# Bodies: how they move with the opening


class Body(NamedTuple):
    """Inertia and loads of a body that moves with the opening; `path` gives X', Y', phi', X'', Y'', phi''."""

    across: Any  # mass that resists X
    up: Any  # mass that resists Y
    inertia: Any  # about the centre
    pushed: Any  # mass that the ground's acceleration pushes
    weight: Any
    path: Any


def carried(a, c, turns):
    """Path of the point (a, c) from the pivot of a block that opens; its body turns or stays level."""

    def path(sine, cosine):
        return (
            c * cosine - a * sine, -a * cosine - c * sine, turns,
            -a * cosine - c * sine, a * sine - c * cosine, 0,
        )  # fmt: skip

    return path


def bodies_of(structure, alpha, kappa, n):
    """Bodies of a structure, the block itself first."""
    b, h = n.sin(alpha), n.cos(alpha)
    one, kind = n.of(1), structure["kind"]
    block = Body(one, one, 1 / kappa - 1, one, one, carried(-b, h, 1))
    if kind == "block":
        return [block]
    if kind == "frame":  # all columns move alike: the beam's share of each rides on its far top corner, level
        columns = structure["columns"]
        beam = n.of(structure["beam_ratio"]) * columns  # over the mass of a column
        column = Body(*(columns * value for value in block[:5]), block.path)
        return [column, Body(beam, beam, 0 * beam, beam, beam, carried(-2 * b, 2 * h, 0))]
    if kind == "pinned":
        top = n.of(structure["mass_ratio"])
        return [block, Body(top, top, 0 * top, top, top, carried(-b, 2 * h, 0))]
    if kind == "inerter":
        device = n.of(structure["inertance_ratio"])
        return [block, Body(device, 0 * device, 0 * device, 0 * device, 0 * device, carried(-b, h, 0))]
    if kind == "oscillator":
        tied = n.of(structure["mass_ratio"])
        return [block, Body(tied, 0 * tied, 0 * tied, tied, 0 * tied, carried(-2 * b, 2 * h, 0))]
    if kind == "strip":
        return strip(structure, b, h, block, n)
    raise ValueError(f"There is no structure of the kind {kind!r}.")


def strip(structure, b, h, lower, n):
    """Bodies of a wall that spans from floor to floor, cracked between: both parts rock, the top stays above the foot.

    The lower part turns by x about its foot, the upper one back by phi about the opposite corner of the crack, and its
    far top corner stays on the foot's vertical: b cos(phi) - k sin(phi) = b cos x - h sin x.
    """
    ratio, load = n.of(structure["height_ratio"]), n.of(structure.get("load_ratio", 0))
    k = ratio * h
    size, turned = n.sqrt(b * b + k * k), n.acos(b / n.sqrt(b * b + k * k))

    def angles(sine, cosine):
        rise, run = b * sine + h * cosine, b * cosine - h * sine
        phi = n.acos(run / size) - turned
        rate = rise / (b * n.sin(phi) + k * n.cos(phi))
        bend = run * (1 - rate * rate) / (b * n.sin(phi) + k * n.cos(phi))
        return rise, run, rate, bend

    def upper(sine, cosine):
        rise, run, rate, bend = angles(sine, cosine)
        return rise, run * (2 + rate), -rate, run, run * bend - rise * (2 + rate), -bend

    def top(sine, cosine):
        rise, run, rate, bend = angles(sine, cosine)
        return 0, 2 * run * (1 + rate), 0, 0, 2 * (run * bend - rise * (1 + rate)), 0

    own = ratio * (b * b + k * k) / 3
    above = Body(ratio, ratio, own, ratio, ratio, upper)
    return [lower, above, Body(0 * load, load, 0 * load, 0 * load, load, top)]


# Restraints: moments against the opening, and what they remember


class Restraint:
    """A restraint without memory; `branch` is None. `remembers`: the two sides may hold differently."""

    remembers = False

    def landed(self, memory):
        """Return the branch on which the restraint starts at x = 0."""
        return None

    def levels(self, branch, memory):
        """List (opening, direction, next branch) at which the branch ends."""
        return []

    def topped(self, branch, opening, memory):
        """Return the branch after an outward turning point, and remember."""
        return branch


class Tendon(Restraint):
    """A tendon along the centre line, from the ground below the base to the block; its length comes from geometry."""

    def __init__(self, given, alpha, n):
        self.n, self.half_base = n, n.sin(alpha)
        self.stiffness, self.prestress = n.of(given.get("stiffness", 0)), n.of(given.get("prestress", 0))
        self.damping = n.of(given.get("damping", 0))

    def moment(self, x, w, sine, cosine, side, branch, memory):
        half = self.n.sin(x / 2)
        across, up = 2 * self.half_base * half * half, self.half_base * sine  # the base's centre from the ground's
        length = self.n.sqrt(across * across + up * up)
        if x <= 0:
            rate, length = self.half_base, 0 * length  # continued straight below the ground, where no block goes
        else:
            rate = (across * self.half_base * sine + up * self.half_base * cosine) / length
        return (self.prestress + self.stiffness * length + self.damping * rate * w) * rate


class Link(Restraint):
    """A spring and damper from a ground point to a body point, both from the base's centre, to side +1 and up."""

    remembers = True

    def __init__(self, given, alpha, n):
        self.n, self.half_base = n, n.sin(alpha)
        self.ground, self.body = ([n.of(value) for value in given[name]] for name in ("ground", "body"))
        self.stiffness, self.prestress = n.of(given.get("stiffness", 0)), n.of(given.get("prestress", 0))
        self.damping = n.of(given.get("damping", 0))

    def moment(self, x, w, sine, cosine, side, branch, memory):
        (p, q), (a, c) = ((side * point[0] - self.half_base, point[1]) for point in (self.ground, self.body))
        rest = self.n.sqrt((a - p) ** 2 + (c - q) ** 2)
        across, up = a * cosine + c * sine - p, c * cosine - a * sine - q
        length = self.n.sqrt(across * across + up * up)
        rate = (across * (c * cosine - a * sine) - up * (a * cosine + c * sine)) / length
        return (self.prestress + self.stiffness * (length - rest) + self.damping * rate * w) * rate


class Damper(Restraint):
    """Viscous dampers: of the rotation, along the centre line, horizontal at a height."""

    def __init__(self, given, alpha, n):
        self.n, self.half_base = n, n.sin(alpha)
        self.rotational, self.centre = n.of(given.get("rotational", 0)), n.of(given.get("centre", 0))
        self.horizontal, self.height = n.of(given.get("horizontal", 0)), n.of(given.get("height", 0))

    def moment(self, x, w, sine, cosine, side, branch, memory):
        arm, lever = self.half_base * self.n.cos(x / 2), self.height * cosine
        return (self.rotational + self.centre * arm * arm + self.horizontal * lever * lever) * w


class Tie(Restraint):
    """A horizontal tie on each side, tension only; it may yield (slack remains) or break (for good)."""

    def __init__(self, given, alpha, n):
        self.n, self.height, self.stiffness = n, n.of(given["height"]), n.of(given["stiffness"])
        self.damping = n.of(given.get("damping", 0))
        self.yields, self.breaks = (n.of(given[k]) if k in given else None for k in ("yields", "breaks"))
        self.remembers = self.yields is not None or self.breaks is not None

    def landed(self, memory):
        if memory.get("broken"):
            return "broken"
        return "slack" if memory.get("slack", 0) > 0 else "elastic"

    def levels(self, branch, memory):
        def opening(elongation, direction, then):
            share = elongation / self.height
            return [(self.n.asin(share), direction, then)] if share < 1 else []

        slack = memory.get("slack", self.n.of(0))
        if branch == "slack":
            return opening(slack, 1, "elastic")
        found = []
        if branch == "elastic" and slack > 0:
            found += opening(slack, -1, "slack")
        if branch == "elastic" and self.yields is not None:
            found += opening(slack + self.yields / self.stiffness, 1, "plastic")
        if branch == "elastic" and self.breaks is not None:
            found += opening(self.breaks / self.stiffness, 1, "broken")
        return found

    def topped(self, branch, opening, memory):
        if branch != "plastic":
            return branch
        memory["slack"] = self.height * self.n.sin(opening) - self.yields / self.stiffness
        return "elastic"

    def moment(self, x, w, sine, cosine, side, branch, memory):
        if branch == "broken":
            return 0 * x
        tension = 0 * x
        if branch == "elastic":
            tension = self.stiffness * (self.height * sine - memory.get("slack", 0))
        if branch == "plastic":
            tension = self.yields
        return (tension + self.damping * self.height * cosine * w) * self.height * cosine


class Oscillator(Restraint):
    """Spring and damper to the ground of a mass tied to the top corner; `Body` has its inertia."""

    def __init__(self, given, alpha, kappa, n):
        self.n, self.start = n, n.sin(alpha)
        self.cos = n.cos(alpha)
        rate = n.of(given["frequency_ratio"])  # omega/p
        self.stiffness = n.of(given["mass_ratio"]) * kappa * rate**2
        self.damping = 2 * n.of(given["damping"]) * n.of(given["mass_ratio"]) * kappa * rate

    def moment(self, x, w, sine, cosine, side, branch, memory):
        half = self.n.sin(x / 2)
        moved = 2 * (2 * self.start * half * half + self.cos * sine)
        rate = 2 * (self.start * sine + self.cos * cosine)
        return (self.stiffness * moved + self.damping * rate * w) * rate


RESTRAINTS = {"tendon": Tendon, "link": Link, "damper": Damper, "tie": Tie}


class Structure:
    """A structure of a scene in numbers of a type."""

    def __init__(self, scene, n):
        given = scene["structure"]
        self.n, self.alpha, self.kappa = n, n.of(scene["alpha"]), n.of(given.get("inertia_ratio", 0.75))
        self.bodies, self.columns = bodies_of(given, self.alpha, self.kappa, n), given.get("columns", 1)
        self.restraints = [RESTRAINTS[r["kind"]](r, self.alpha, n) for r in given.get("restraints", ())]
        if given["kind"] == "oscillator":
            self.restraints.append(Oscillator(given, self.alpha, self.kappa, n))
        self.sides = (1, -1) if given.get("sides", 2) == 2 else (given.get("side", 1),)
        stated = scene.get("restitution")
        self.restitution = self.natural_restitution() if stated is None else n.of(stated)

    def natural_restitution(self):
        """Return the restitution of ideal impulses: none works on velocities of the mirrored mechanism."""
        inertia = kept = self.n.of(0)
        for body in self.bodies:
            across, up, turn, *_ = body.path(self.n.of(0), self.n.of(1))
            before = (-across, -up, -turn)  # side 1, w = -1
            after = (-across, up, -turn)  # side -1, w = 1
            for mass, old, new in zip((body.across, body.up, body.inertia), before, after):
                kept, inertia = kept + mass * old * new, inertia + mass * new * new
        return kept / inertia

    def acceleration(self, x, w, side, u, v, branches, memories):
        """Angular acceleration d2x/d(p t)2 at an opening, under ground accelerations u and v [g]."""
        sine, cosine = self.n.sin(x), self.n.cos(x)
        inertia = bend = moment = 0 * x
        for body in self.bodies:
            across, up, turn, across2, up2, turn2 = body.path(sine, cosine)
            inertia = inertia + body.across * across * across + body.up * up * up + body.inertia * turn * turn
            bend = bend + body.across * across * across2 + body.up * up * up2 + body.inertia * turn * turn2
            moment = moment - body.weight * (1 + v) * up - side * u * body.pushed * across
        for restraint, branch, memory in zip(self.restraints, branches, memories):
            moment = moment - self.columns * restraint.moment(x, w, sine, cosine, side, branch, memory)
        return (moment / self.kappa - bend * w * w) / inertia
