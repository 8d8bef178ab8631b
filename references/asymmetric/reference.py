"""Writes `asymmetric.json`: `python -m references.asymmetric.reference [file]` (two minutes, one core).

ASYMMETRIC_BITS and ASYMMETRIC_ORDER (series.py) change precision and order: `compare.py` tells the digits.
"""

import json
import pathlib
import sys

import gmpy2
from gmpy2 import mpfr

from references.asymmetric import cases
from references.asymmetric.bodies import BODIES, body
from references.asymmetric.motions import Ground, motion
from references.asymmetric.scalar import Block, follow

FILE = pathlib.Path(__file__).with_name("asymmetric.json")
CHANGE = mpfr(10) ** -13  # relative change of the parameters for condition numbers
LISTED = 25  # impacts and turning points kept
ABOUT = (
    "Responses of an asymmetric block by Taylor series (scalar.py), checked against a free rigid body with contact "
    "forces (rigid.py). Inputs are float64, exact; results are texts of 25 digits (of which compare.py confirms 20 "
    "and more). Lists of two belong to side 1 (rotation > 0, corner 1) and side 2 (rotation < 0, corner 2). "
    "restitution: [from side 1 to 2, from 2 to 1]. Motions: sine (amplitude g, period s), rectangle (amplitude, "
    "duration), exponential (amplitude, duration, shape), record (samples g, dt, factor). vertical: factor times a "
    "motion, positive upward. x'' = -p_s^2 [(1+v) sin(alpha_s - x) + s u cos(alpha_s - x)]; linear: [(1+v)(alpha_s - "
    "x) + s u]. impacts: time, velocity before [rad/s, signed], the first 25; impacts_in_motion counts all down to "
    "speeds of 1e-25 p alpha. rests, uplifts: times (and side). end: rotation and velocity at the end of the motion. "
    "overturned: 0 or the side +1, -1; how: 'flat' (pi/2 in the motion, at time_flat) or 'energy' (in the free stage "
    "after impacts_after impacts). highest: largest opening per side over motion and free stage, with its time (on "
    "the side on which it falls: of turning points and the end of the motion only). max_rotation: the larger one, "
    "null if overturned. forces: H (to the right) and N of the ground on the block over m g, friction |H|/N; "
    "friction_max, normal_min: over the rocking parts of the motion. impact_friction: |impulse ratio| at an impact "
    "[from side 1 to 2, from 2 to 1]. condition: sum of |change of the quantity| per relative change of alpha1, "
    "alpha2, p1, p2, e12, e21, amplitude and time scale of the motion."
)


def text(x, digits=25):
    """A number as text."""
    return None if x is None else "inf" if gmpy2.is_infinite(x) else f"{mpfr(x):.{digits}g}"


def lines(tree, depth):
    """JSON with one line per entry down to a depth."""
    if depth == 0 or not isinstance(tree, (dict, list)):
        return json.dumps(tree)
    if isinstance(tree, dict):
        return "{\n" + ",\n".join(f"{json.dumps(k)}: {lines(v, depth - 1)}" for k, v in tree.items()) + "\n}"
    return "[\n" + ",\n".join(lines(v, depth - 1) for v in tree) + "\n]"


def scene(c, factors=(0,) * 8):
    """Block and ground of a case, its parameters changed by relative factors."""
    f = [1 + mpfr(x) for x in factors]
    b = c["block"]
    numbers = [mpfr(x) * y for x, y in zip([*b["alpha"], *b["p"], *b["restitution"]], f)]
    block = Block.of(*numbers, c["model"] == "linear", b["R"], b["gravity"])

    def changed(name, factor=1):
        kind, *rest = name
        rest = list(rest)
        amplitude, time = (2, 1) if kind == "record" else (0, 1)
        if amplitude < len(rest):
            rest[amplitude] = mpfr(rest[amplitude]) * f[6]
        rest[time] = mpfr(rest[time]) * f[7]
        return motion(kind, *rest, factor=factor)

    vertical = c["vertical"]
    return block, Ground(
        changed(c["horizontal"]), None if vertical is None else changed(vertical["motion"], vertical["factor"])
    )


def times_of(c):
    """Ten times within the motion at which forces are told."""
    end = float(scene(c)[1].end)
    return [round((k + 0.37) * end / 10, 6) for k in range(10)]


def run(c, factors=(0,) * 8, **options):
    """Follow a case."""
    block, ground = scene(c, factors)
    return block, follow(block, ground, initial=c["initial"], **options)


def quantities(block, out):
    """Return the quantities for which condition numbers are computed."""
    found = {}
    if not out.overturned:
        found["max_rotation"] = max(out.highest[s][0] for s in (1, -1))
    if out.end and out.end[0] != 0:
        found["end_rotation"], found["end_velocity"] = out.end
    listed = out.impacts[: min(out.impacts_in_motion, LISTED)]
    if listed:
        found["last_listed_impact_time"] = listed[-1][0]
    if out.rests:
        found["rest_time"] = out.rests[0]
    if out.time_flat is not None:
        found["time_flat"] = out.time_flat
    return found


def impact_friction(block):
    """|h_s - e h_t|/(b_s + e b_t) of an impact from side s to t."""
    sizes = {s: (block.size[s] * gmpy2.sin(block.alpha[s]), block.size[s] * gmpy2.cos(block.alpha[s])) for s in (1, -1)}
    out = []
    for s in (1, -1):
        (b, h), (other_b, other_h), e = sizes[s], sizes[-s], block.restitution[s]
        out.append(abs(h - e * other_h) / (b + e * other_b))
    return out


def told(out, base):
    """Return the events and results as texts."""
    return {
        "impacts_in_motion": out.impacts_in_motion,
        "impacts": [[text(t), text(v)] for t, v, _ in out.impacts[: min(out.impacts_in_motion, LISTED)]],
        "rests": [text(t) for t in out.rests],
        "uplifts": [[text(t), s] for t, s in out.uplifts],
        "end": out.end and [text(x) for x in out.end],
        "overturned": out.overturned,
        "how": out.decided or None,
        "time_flat": text(out.time_flat),
        "impacts_after": out.impacts_after,
        "highest": [[text(out.highest[s][0]), text(out.highest[s][1])] for s in (1, -1)],
        "max_rotation": text(base.get("max_rotation")),
        "max_velocity": None if out.overturned else text(out.fastest),
        "turning_points": [[text(t), text(x)] for t, x in out.peaks[:LISTED]],
        "states": [[text(e["time"]), text(e["rotation"]), text(e["velocity"])] for e in out.samples],
    }


def answer(c):
    """The case with its result."""
    block, out = run(c, times=times_of(c), forces=c["forces"])
    base = quantities(block, out)
    condition = {name: mpfr(0) for name in base}
    for j in range(8):
        other = run(c, [CHANGE if k == j else 0 for k in range(8)])
        changed = quantities(*other)
        for name in base:
            condition[name] += abs(changed[name] - base[name]) / CHANGE if name in changed else mpfr("inf")
    result = told(out, base) | {"condition": {name: float(f"{x:.3g}") for name, x in condition.items()}}
    if c["forces"]:
        names = "time", "horizontal", "normal", "friction"
        result["forces"] = [[text(e[name]) for name in names] for e in out.samples]
        result["friction_max"] = [text(x) for x in out.friction]
        result["normal_min"] = [text(x) for x in out.normal]
        result["airborne"] = text(out.airborne)
        result["impact_friction"] = [text(x) for x in impact_friction(block)]
    kept = {k: v for k, v in c.items() if k != "forces"}
    return {**kept, "result": result}


def critical(boundary):
    """The amplitude between the bracket's ends at which the verdict on one side changes, by bisection."""
    low, high = map(mpfr, boundary[3])
    side = boundary[4]

    def falls(a):
        return run(cases.boundary_case(boundary, a, ""))[1].overturned == side

    first = falls(low)
    assert falls(high) != first, boundary[0]
    while abs(high - low) > mpfr(10) ** -27:
        middle = (low + high) / 2
        low, high = (middle, high) if falls(middle) == first else (low, middle)
    return (low + high) / 2


def bodies():
    """Parameters of the bodies from corners and inertia."""
    out = {}
    for name, numbers in BODIES.items():
        alpha, p, r, e = body(name).parameters()
        pair = lambda x: [text(x[1]), text(x[-1])]  # noqa: E731
        out[name] = dict(zip(("b1", "h1", "b2", "h2", "inertia_over_mass"), numbers))
        out[name] |= {"gravity": 9.81, "alpha": pair(alpha), "p": pair(p), "R": pair(r), "restitution": pair(e)}
    return out


def limit(boundary):
    """A critical amplitude, with what it belongs to, and the cases 1e-6 below and above it."""
    name, _, horizontal, bracket, side, _ = boundary
    a = critical(boundary)
    entry = {k: v for k, v in cases.boundary_case(boundary, 0.0, "").items() if k in ("body", "model", "block")}
    entry = {"name": name, "motion": horizontal, "bracket": bracket, "side": side} | entry | {"amplitude": text(a)}
    changes = ("1e-6 below", -1e-6), ("1e-6 above", 1e-6)
    return entry, [answer(cases.boundary_case(boundary, float(a * (1 + mpfr(d))), label)) for label, d in changes]


def main(path=FILE):
    """All cases."""
    answers, limits = [], []
    for c in cases.CASES:
        answers.append(answer(c))
        print(".", end="", flush=True)
    for boundary in cases.BOUNDARIES:
        entry, near = limit(boundary)
        limits.append(entry)
        answers += near
        print(":", end="", flush=True)
    print()
    everything = {"about": ABOUT, "bodies": bodies(), "critical_amplitudes": limits, "cases": answers}
    pathlib.Path(path).write_text(lines(everything, 2) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
