"""Symmetric cases against jaxrock's `outcome` and `simulate`, and mirrored cases against each other.

`python -m references.asymmetric.check_symmetric` (minutes: compiling)
"""

import json

import jax
import numpy as np

import jaxrock as rk
from references.asymmetric import cases
from references.asymmetric.reference import FILE, run

jax.config.update("jax_enable_x64", True)

LISTED = 12  # impacts compared


def motion_of(kind, *n):
    """The package's motion."""
    if kind == "record":
        return n[2] * rk.Record(n[0], n[1])
    return {"sine": rk.SinePulse, "exponential": rk.ExponentialPulse, "rectangle": rk.RectangularPulse}[kind](*n)


def mirrored(c):
    """The case seen from behind."""
    kind, *n = c["horizontal"]
    n[2 if kind == "record" else 0] *= -1
    block = {k: v[::-1] if isinstance(v, list) else v for k, v in c["block"].items()}
    return c | {"block": block, "horizontal": [kind, *n], "initial": [-x for x in c["initial"]]}


def mirror_error(c):
    """Largest difference of impacts between a case and its mirror image."""
    (_, one), (_, two) = run(c), run(mirrored(c))
    assert one.overturned == -two.overturned and len(one.impacts) == len(two.impacts), c["name"]
    return max([0, *(max(abs(a[0] - b[0]), abs(a[1] + b[1])) for a, b in zip(one.impacts, two.impacts))])


def relative(found, text):
    """Relative error of a number."""
    return abs(float(found) - float(text)) / float(text)


def errors(c):
    """The package's errors, by quantity, and its status."""
    b, r = c["block"], c["result"]
    block = rk.Block(b["alpha"][0], b["p"][0], b["restitution"][0])
    model = rk.Linear() if c["model"] == "linear" else rk.Housner()
    motion, initial = motion_of(*c["horizontal"]), tuple(c["initial"])
    out = rk.outcome(block, motion, model, initial=initial)
    history = rk.simulate(block, motion, model, initial=initial, duration=float(motion.end))
    assert bool(out.overturned) == bool(r["overturned"]), c["name"]
    assert len(history.impact_times) == r["impacts_in_motion"], c["name"]
    found = {}
    if not r["overturned"]:
        found["max_rotation"] = relative(out.max_rotation, r["max_rotation"])
        found["max_velocity"] = relative(out.max_velocity, r["max_velocity"])
    impacts = np.array(r["impacts"][:LISTED], float).reshape(-1, 2)
    n = len(impacts)
    if n:
        found["impact times"] = np.abs(np.array(history.impact_times)[:n] - impacts[:, 0]).max()
        found["impact velocities"] = np.abs(np.array(history.impact_velocities)[:n] - impacts[:, 1]).max()
    states = np.array(r["states"], float)
    found["rotation"] = np.abs(np.array(history(states[:, 0])[0]) - states[:, 1]).max()
    return found, out.status


def main():
    """All."""
    print(f"mirrored: {float(max(map(mirror_error, cases.CASES))):.0e}", flush=True)
    for c in json.loads(FILE.read_text())["cases"]:
        if c["body"] != "rectangle":
            continue
        found, status = errors(c)
        condition = max(c["result"]["condition"].values(), default=0)
        told = ", ".join(f"{name} {float(x):.0e}" for name, x in found.items())
        ended = "successful" if status == rk.Status.successful else "FAILED"
        print(f"{c['name'][:50]:50} condition {condition:.1e}: {told}; {ended}", flush=True)


if __name__ == "__main__":
    main()
