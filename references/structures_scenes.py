"""Random scenes of rocking structures, seeded, for `references.structures`."""

import copy
import random

from references.structures_physics import Structure, numbers

NATURAL = ("frame", "pinned", "inerter", "oscillator", "strip")  # their restitution is that of ideal impulses


def uplift(scene, side=None):
    """Horizontal acceleration [g] that lifts a structure at rest, without vertical motion."""
    n = numbers("float")
    structure = Structure(scene, n)
    side = side or structure.sides[0]
    memories = [{} for _ in structure.restraints]
    branches = [r.landed(m) for r, m in zip(structure.restraints, memories)]
    still, pushed = (structure.acceleration(0.0, 0.0, side, -side * u, 0.0, branches, memories) for u in (0.0, 1.0))
    return -still / (pushed - still)


def scaled(scene, factor):
    """Return the scene under a motion multiplied by a factor, both components."""
    new = copy.deepcopy(scene)
    for motion in (new["motion"], new.get("vertical")):
        motion = motion.get("ground", motion) if motion else None
        if motion and motion["kind"] == "record":
            motion["samples"] = [factor * u for u in motion["samples"]]
        elif motion:
            motion["amplitude"] *= factor
    return new


class _Draw:
    """Random numbers of few digits."""

    def __init__(self, kind, seed):
        self.random = random.Random(f"{kind} {seed}")

    def __call__(self, low, high, digits=3):
        return float(f"{self.random.uniform(low, high):.{digits}g}")

    def motion(self, level, p, kinds=("sine", "half sine", "ricker", "record")):
        """A motion of about a level [g]."""
        kind = self.random.choice(kinds)
        period = self(0.6, 3.5) / p
        period = float(f"{period:.3g}")
        if kind == "record":
            dt = self.random.choice((0.02, 0.04, 0.05))
            middle = [self.random.gauss(0, 1.0 * level) for _ in range(37)]
            smooth = [0.0, *(float(f"{(a + b + c) / 1.7:.3f}") for a, b, c in zip(middle, middle[1:], middle[2:])), 0.0]
            return {"kind": kind, "dt": dt, "samples": smooth}
        amplitude = self(1.05, 2.3) * level
        if kind == "half sine":
            amplitude *= 1.3
        motion = {"kind": kind, "amplitude": float(f"{amplitude:.3g}"), "period": period}
        if kind == "ricker":
            motion["center"] = float(f"{1.8 * period:.3g}")
        if kind == "harmonic":
            motion["cycles"] = self.random.randint(6, 25)
        return motion


def _tendon(draw):
    # The first kind hardens, so large openings stay possible; the second gives only prestress.
    if draw.random.random() < 0.3:
        return {"kind": "tendon", "prestress": draw(0.05, 1)}
    return {"kind": "tendon", "stiffness": draw(0.5, 20), "prestress": draw(0, 0.5)}


def _tie(draw, alpha):
    return {"kind": "tie", "height": draw(0.6, 1.8), "stiffness": draw(0.1, 3)}


def _yielding(draw, alpha):
    tie = {"kind": "tie", "height": draw(0.6, 1.8), "stiffness": draw(1, 20)}
    return {**tie, "yields": draw(0.1 * alpha, 0.4 * alpha)}


def _breaking(draw, alpha):
    tie = {"kind": "tie", "height": draw(0.6, 1.8), "stiffness": draw(0.2, 4)}
    return {**tie, "breaks": float(f"{tie['stiffness'] * tie['height'] * alpha * draw(0.1, 0.7):.3g}")}


def _link(draw, alpha):
    link = {"kind": "link", "ground": [draw(-3, -1), draw(0, 2)], "body": [draw(-0.1, 0), draw(0.6, 1.9)]}
    return {**link, "stiffness": draw(0.1, 1), "prestress": draw(0, 0.05), "damping": draw(0, 0.05)}


def _damper(draw, alpha):
    choice = draw.random.randrange(3)
    if choice == 0:
        return {"kind": "damper", "rotational": draw(0.01, 0.3)}
    if choice == 1:
        return {"kind": "damper", "centre": draw(0.2, 6)}
    return {"kind": "damper", "horizontal": draw(0.01, 0.3), "height": draw(0.5, 1.9)}


def _structure(kind, draw, alpha):
    """The structure of a kind."""
    block = {"kind": "block", "sides": 2}
    if kind == "frame":
        return {"kind": kind, "columns": draw.random.randint(1, 8), "beam_ratio": draw(0, 6)}
    if kind == "pinned":
        return {"kind": kind, "mass_ratio": draw(0.05, 3)}
    if kind == "inerter":
        return {"kind": kind, "inertance_ratio": draw(0.05, 1.5)}
    if kind == "oscillator":
        ratios = {"mass_ratio": draw(0.05, 0.6), "frequency_ratio": draw(0.3, 3), "damping": draw(0, 0.2)}
        return {"kind": kind, **ratios}
    if kind == "strip":
        return {"kind": kind, "height_ratio": draw(1, 1.6), "load_ratio": draw(0, 2)}
    restraint = {
        "tendon": lambda: _tendon(draw),
        "elastic tie": lambda: _tie(draw, alpha),
        "yielding tie": lambda: _yielding(draw, alpha),
        "breaking tie": lambda: _breaking(draw, alpha),
        "link": lambda: _link(draw, alpha),
        "damper": lambda: _damper(draw, alpha),
    }.get(kind)
    if restraint:
        block["restraints"] = [restraint()]
        tie = block["restraints"][0]
        if tie["kind"] == "tie" and draw.random.random() < 0.4:
            tie["damping"] = draw(0.01, 0.2)
    sided = 1.0 if kind in ("one-sided", "link") else 0.3 if restraint else 0.0
    if draw.random.random() < sided:
        block |= {"sides": 1, "side": draw.random.choice((1, -1)) if kind != "link" else 1}
    return block


def _scene(kind, draw):
    """One scene of a kind."""
    alpha, p = draw(0.1, 0.35), draw(1, 4)
    scene = {"alpha": alpha, "p": p, "restitution": draw(0.6, 0.96), "structure": _structure(kind, draw, alpha)}
    if scene["structure"].get("sides") == 1:
        scene["restitution"] = draw(0.1, 0.8)
    if kind in NATURAL:
        scene["restitution"] = max(0.0, float(Structure(scene, numbers("long")).natural_restitution()))
    level = uplift(scene)
    if kind == "lasting":
        scene["motion"] = draw.motion(0.6 * level, p, ("harmonic",))
        scene["motion"]["period"] = float(f"{draw(0.5, 2) / p:.3g}")
        scene["motion"]["amplitude"] = float(f"{draw(1.05, 2.2) * level:.3g}")
    elif kind == "floor":
        ground = draw.motion(0.7 * level, p)
        scene["motion"] = {"kind": "floor", "ground": ground, "after": draw(0.2, 2), **_storeys(draw, p)}
    else:
        scene["motion"] = draw.motion(level, p)
    if scene["structure"].get("sides") == 1 and scene["motion"]["kind"] in ("half sine", "ricker"):
        scene["motion"]["amplitude"] *= -scene["structure"]["side"]  # towards the side that opens
    if (
        kind in ("vertical", "frame", "tendon", "strip", "yielding tie")
        and draw.random.random() < (kind == "vertical") + 0.4
    ):
        scene["vertical"] = draw.motion(0.25, p, ("sine", "ricker"))
    return scene


def _storeys(draw, p):
    """A floor: an oscillator or a chain of two or three storeys."""
    if draw.random.random() < 0.6:
        return {"period": float(f"{draw(0.5, 3) / p:.3g}"), "damping_ratio": draw(0.01, 0.1)}
    count = draw.random.randint(2, 3)
    rate = (6 / draw(1, 3) * p) ** 2
    spring = [float(f"{rate * draw(0.7, 1.3):.3g}") for _ in range(count)]
    damper = [float(f"{0.02 * k / rate**0.5:.3g}") for k in spring]
    storey = draw.random.randint(1, count)
    return {"masses": [1.0] * (count - 1) + [draw(0.4, 1)], "stiffnesses": spring, "dampings": damper, "storey": storey}


KINDS = (
    "block", "vertical", "one-sided", "tendon", "elastic tie", "yielding tie", "breaking tie", "damper", "link",
    "frame", "pinned", "inerter", "oscillator", "strip", "floor", "lasting",
)  # fmt: skip


def random_scenes(kind, count, seed):
    """Random scenes of a kind (one of `KINDS`); a seed gives the same ones for ever."""
    if kind not in KINDS:
        raise ValueError(f"There is no kind {kind!r}; the kinds are {', '.join(KINDS)}.")
    draw = _Draw(kind, seed)
    return [_scene(kind, draw) for _ in range(count)]
