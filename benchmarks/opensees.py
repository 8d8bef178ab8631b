"""OpenSees and jaxrock on the same rigid and flexible blocks: `python benchmarks/opensees.py` writes `opensees.md`.

Needs the extra `opensees` (openseespy, and the BLAS and LAPACK libraries of the system). The models are those of
Diamantopoulos & Fragiadakis (2017): SM1 (one mass on a rigid column), and mmSM with six masses on an elastic one,
with linear kinematics on both sides. OpenSees integrates by Newmark's method (1/2, 1/4); impacts as there: the
velocities of all degrees of freedom are multiplied by the restitution after the step in which the base returns.
"""

import sys
import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402
import openseespy.opensees as ops  # noqa: E402

import jaxrock as rk  # noqa: E402

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from test_flexible import beam, independent  # noqa: E402

GRAVITY, YIELD = 9.81, 1e-9  # m/s^2; rotation up to which the spring is stiff [rad]
DURATION, STEPS = 12.0, (1e-2, 1e-3, 1e-4)


def opensees(lumped, heights, inertia, bending, axial, block, pulse, damping, dt):
    """Rotation of the base at every step; a point mass may have a moment of inertia (SM1)."""
    alpha, length = float(block.alpha), float(block.length)
    strength = float(block.density * block.width * block.height) * GRAVITY * length / 2 * np.sin(alpha)
    ops.wipe()
    ops.model("basic", "-ndm", 2, "-ndf", 3)
    ops.node(0, 0.0, 0.0)
    ops.node(1, 0.0, 0.0)
    ops.fix(0, 1, 1, 1)
    ops.fix(1, 1, 1, 0)
    ops.geomTransf("Linear", 1)
    for i, (mass, y) in enumerate(zip(lumped, heights), start=2):
        ops.node(i, 0.0, float(y))
        ops.mass(i, float(mass), float(mass), float(inertia))
        ops.element("elasticBeamColumn", i, i - 1, i, axial, 1.0, bending, 1)
    ends, moments = [-9 * alpha, -YIELD, YIELD, 9 * alpha], []
    for rotation in ends:
        moments.append(strength * np.sign(rotation) * (1 - abs(rotation) / alpha))
    ops.uniaxialMaterial("ElasticMultiLinear", 1, "-strain", *ends, "-stress", *moments)
    ops.element("zeroLength", 1, 0, 1, "-mat", 1, "-dir", 6)
    ops.rayleigh(0.0, 0.0, damping, 0.0)
    period = float(pulse.period)
    ops.timeSeries("Trig", 1, 0.0, period, period, "-factor", float(pulse.amplitude) * GRAVITY * np.cos(alpha))
    ops.pattern("UniformExcitation", 1, 1, "-accel", 1)
    ops.constraints("Plain")
    ops.numberer("RCM")
    ops.system("BandGeneral")
    ops.test("NormUnbalance", 1e-7 * strength, 50)
    ops.algorithm("Newton")
    ops.integrator("Newmark", 0.5, 0.25)
    ops.analysis("Transient")
    return march(range(1, len(heights) + 2), float(block.restitution), dt)


def march(nodes, restitution, dt):
    """Step by step, with impacts; where Newton's method cycles at the contact, the base starts from zero again."""
    count = round(DURATION / dt)
    rotation, side, last = np.zeros(count + 1), 0.0, 0.0
    for k in range(count):
        if ops.analyze(1, dt) != 0:
            ops.setNodeDisp(1, 3, 0.0, "-commit")
            if ops.analyze(1, dt) != 0:
                return None
        theta = -ops.nodeDisp(1, 3)
        rotation[k + 1] = theta
        if side != 0 and theta * side <= 2 * YIELD:
            if side != last:
                for node in nodes:
                    for dof in (1, 2, 3):
                        velocity = 0.0 if node == 1 else restitution * ops.nodeVel(node, dof)
                        ops.setNodeVel(node, dof, velocity, "-commit")
                ops.domainChange()
            last, side = side, 0.0
        if abs(theta) > 2 * YIELD:
            side = np.sign(theta)
    return rotation


def best(function, repeats=3):
    """Seconds of the fastest of some runs, and its result."""
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        found = function()
        jax.block_until_ready(found)
        seconds.append(time.perf_counter() - start)
    return min(seconds), found


def rigid_response(block, pulse, duration):
    """SM1 with constant negative stiffness: a linear block with p^2 sin(alpha)/alpha under alpha/tan(alpha) motion."""
    alpha = float(block.alpha)
    p = np.sqrt(1.5 * GRAVITY / float(block.length) * np.sin(alpha) / alpha)
    rigid = rk.Block(alpha, p, restitution=float(block.restitution))
    return rk.simulate(rigid, (alpha / np.tan(alpha)) * pulse, rk.Linear(), duration=duration, samples=2)


def cases():
    """Name, OpenSees at a step, jaxrock's history, a judge of it, and its name."""
    pulse = rk.SinePulse(0.5, 1.6)
    block = rk.FlexibleBlock(5.0, 50.0, 30e9, 2500.0, 0.01)
    length, mass = float(block.length), float(block.density * block.width * block.height)
    bending = 30e9 * 5.0**3 / 12
    lumped, heights, _ = beam(6, length, bending, mass)
    a1 = 2 * 0.01 / float(block.frequencies[0])
    stiff = 1e4 * bending
    yield (
        "SM1 (50 m x 5 m, rigid)",
        lambda dt: opensees([mass], [length / 2], mass * length**2 / 12, stiff, stiff, block, pulse, 0.0, dt),
        lambda: rigid_response(block, pulse, DURATION),
        lambda t: None,
    )
    at, _ = independent(block, pulse, DURATION)
    yield (
        "mmSM (six masses, 30 GPa, 1 % damping)",
        lambda dt: opensees(lumped, heights, 0.0, bending, 30e9 * 5.0, block, pulse, a1, dt),
        lambda: rk.simulate_flexible(block, pulse, duration=DURATION, samples=2),
        lambda t: at(t)[0],
    )


def main():
    """Write the table beside this script."""
    rows = []
    for name, peer, ours, judge in cases():
        ours()
        seconds, response = best(ours, 10)
        times = np.linspace(0.0, DURATION, 1201)
        exact = np.asarray(response(times)[0])
        judged = [judge(t) for t in times[1:-1]]
        peak = np.abs(exact).max()
        error = "tests: 1e-12" if judged[0] is None else f"{np.abs(np.array(judged) - exact[1:-1]).max() / peak:.0e}"
        rows.append(f"| {name} | jaxrock | exact phases | {1e3 * seconds:.2f} ms | {error} |")
        for dt in STEPS:
            seconds, rotation = best(lambda peer=peer, dt=dt: peer(dt), 2)
            if rotation is None:
                rows.append(f"| {name} | OpenSees | {dt:g} s | {1e3 * seconds:.0f} ms | did not converge |")
                continue
            error = np.abs(rotation[:: round(0.01 / dt)] - exact).max() / peak
            rows.append(f"| {name} | OpenSees | {dt:g} s | {1e3 * seconds:.0f} ms | {error:.0e} |")
    table = "\n".join(rows)
    text = f"""# OpenSees

Written by `python benchmarks/opensees.py` (OpenSees {ops.version()}, one thread; jaxrock on one CPU, compiled before):
one block of 50 m by 5 m under a sine pulse of 0.5 g and 1.6 s, {DURATION:g} s of history. Errors: largest difference
of the base rotation over its peak; of jaxrock from the matrix equations integrated by SciPy's DOP853 with events
(relative tolerance 1e-10), of OpenSees from jaxrock. OpenSees scales the velocities after the step in which the base
returns, as in the paper; with impacts located inside the step it would need fewer steps.

| model | program | step | time of a history | error |
| --- | --- | --- | --- | --- |
{table}
"""
    Path(__file__).with_suffix(".md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
