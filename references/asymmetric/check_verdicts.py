"""Verdicts by going on: the rigid body is followed through 25 s of quiet after the motion.

It falls flat where the energy says so, on that side, after as many impacts. And impacts and states by dop853.py.
`python -m references.asymmetric.check_verdicts` (minutes)
"""

from references.asymmetric import cases
from references.asymmetric.bodies import body
from references.asymmetric.dop853 import MOST_IMPACTS, FloatRun
from references.asymmetric.motions import Ground, motion
from references.asymmetric.rigid import RigidRun
from references.asymmetric.scalar import Block, follow

QUIET = 25  # seconds


def continued(c, parts, out):
    """The fall that the rigid body comes to in the end, as text; it must be the one foretold."""
    long = RigidRun(body(c["body"]), Ground(*parts, QUIET), c["initial"], rest=1e-8).follow()
    assert (long.flat is not None) == bool(out.overturned), c["name"]
    if not out.overturned:
        return "stays"
    assert long.side == out.overturned, c["name"]
    foretold = out.impacts_in_motion + out.impacts_after
    assert len(long.impacts) == foretold or out.impacts_in_motion > 100, c["name"]
    return f"flat at {float(long.flat):.3f} s on side {long.side:+d}"


def in_float64(c, out):
    """The largest difference to DOP853, as text."""
    if out.impacts_in_motion >= MOST_IMPACTS:
        return ""
    impacts, t, end = FloatRun(c).follow()
    assert len(impacts) == out.impacts_in_motion, c["name"]
    errors = [abs(x[k] - float(y[k])) for x, y in zip(impacts, out.impacts) for k in (0, 1)]
    if end and out.end:
        errors += [abs(float(out.end[k]) - end[k]) for k in (0, 1)]
    elif out.time_flat is not None:
        errors.append(abs(t - float(out.time_flat)))
    return f"DOP853 {max(errors):.0e}"


def main():
    """All nonlinear cases of bodies."""
    for c in cases.CASES:
        if c["body"] is None or c["model"] != "housner":
            continue
        b = body(c["body"])
        alpha, p, r, e = b.parameters()
        vertical = c["vertical"] and motion(*c["vertical"]["motion"], factor=c["vertical"]["factor"])
        parts = motion(*c["horizontal"]), vertical
        out = follow(Block(alpha, p, e, False, r, b.gravity), Ground(*parts), initial=c["initial"])
        print(f"{c['name'][:58]:58} {continued(c, parts, out):32} {in_float64(c, out)}", flush=True)


if __name__ == "__main__":
    main()
