"""The scalar equation against the free rigid body, for every case whose block is a body (exact geometry, not rounded).

Prints, per case, the largest difference of impact times, velocities, states, and contact forces over m g; then the
impact law and the friction of an impact. `python -m references.asymmetric.check_rigid` (minutes)
"""

from gmpy2 import mpfr

from references.asymmetric import cases
from references.asymmetric.bodies import BODIES, body
from references.asymmetric.motions import Ground, motion
from references.asymmetric.reference import impact_friction, times_of
from references.asymmetric.rigid import RigidRun
from references.asymmetric.scalar import Block, follow


def both(c, b):
    """Block, what the scalar equation says, and the rigid body's run."""
    alpha, p, r, e = b.parameters()
    block = Block(alpha, p, e, False, r, b.gravity)
    vertical = c["vertical"] and motion(*c["vertical"]["motion"], factor=c["vertical"]["factor"])
    ground, times = Ground(motion(*c["horizontal"]), vertical), times_of(c)
    out = follow(block, ground, initial=c["initial"], times=times, forces=True)
    return block, out, RigidRun(b, ground, c["initial"], times).follow()


def impact_law(block, impacts):
    """Largest difference of restitution and friction at impacts."""
    worst, friction = mpfr(0), dict(zip((1, -1), impact_friction(block)))
    for _, before, side, jx, jy, _, after in impacts:
        if abs(before) < 1e-9:  # the last hops: their speeds are lost in the ground's
            continue
        worst = max(worst, abs(after / before - block.restitution[side]), abs(abs(jx / jy) - friction[side]))
    return worst


def differences(c):
    """Number of impacts compared; differences of motion, forces, impact law; how well the corner kept its place."""
    b = body(c["body"])
    block, out, rigid = both(c, b)
    n = min(out.impacts_in_motion, len(rigid.impacts))
    assert abs(out.impacts_in_motion - len(rigid.impacts)) <= (20 if n > 100 else 0), c["name"]
    errors = [abs(x[k] - y[k]) for x, y in zip(out.impacts[:n], rigid.impacts[:n]) for k in (0, 1)]
    if out.end:
        errors += [abs(out.end[0] - rigid.q), abs(out.end[1] - rigid.w)]
    else:
        errors.append(abs(out.time_flat - rigid.flat))
    forces = [mpfr(0)]
    for x, y in zip(out.samples, rigid.samples):
        errors += [abs(x["rotation"] - y[1]), abs(x["velocity"] - y[2])]
        if y[3] is not None:
            forces += [abs(x["horizontal"] - y[3] / b.gravity), abs(x["normal"] - y[4] / b.gravity)]
    return n, max(errors), max(forces), impact_law(block, rigid.impacts[:n]), rigid.residual


def main():
    """All bodies, all cases of the nonlinear model."""
    overall = mpfr(0)
    for c in cases.CASES:
        if c["body"] is None or c["model"] != "housner":
            continue
        n, *errors = differences(c)
        moved, forces, law, residual = map(float, errors)
        overall = max(overall, moved, forces, law)
        print(
            f"{c['name'][:58]:58} impacts {n:4d}  motion {moved:.0e}  forces {forces:.0e}  "
            f"impact law and friction {law:.0e}  constraint {residual:.0e}",
            flush=True,
        )
    print(f"largest difference {float(overall):.0e}")
    for name in BODIES:
        b = body(name)
        _, _, r, e = b.parameters()
        ratio = (b.i2 + r[-1] ** 2) / (b.i2 + r[1] ** 2)
        print(
            f"{name} restitution {float(e[1]):.6f} {float(e[-1]):.6f} product {float(e[1] * e[-1]):.6f} "
            f"energy kept {float(e[1] ** 2 * ratio):.6f} {float(e[-1] ** 2 / ratio):.6f}"
        )


if __name__ == "__main__":
    main()
