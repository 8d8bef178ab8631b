"""Frames, walls, tendons, ties and dampers: speed beside free blocks, and error.

`python -m benchmarks.structures` writes `structures.md`.
"""

import json
import time
from pathlib import Path

from benchmarks.common import least_time, table

import jax  # isort: skip
import jax.numpy as jnp
import numpy as np

import jaxrock as rk
from references import structures, structures_in_jaxrock as translated

PULSES, RECORDS, SEED = 8192, 1024, 1
TIE = {"height": 1.5, "stiffness": 2.0}
HOUSNER, SERIES, DIFFRAX = rk.Housner(), rk.Series(), rk.Diffrax()
# A model, an engine, whether it opens to both sides, and its kind in the table of references.
CASES = {
    "free block": (HOUSNER, SERIES, "both", "block"),
    "frame, beam of 4 times the columns": (HOUSNER, SERIES, "frame", "frame"),
    "wall of one side": (HOUSNER, SERIES, "right", "one-sided"),
    "tendon": (HOUSNER + rk.models.Tendon(2.0), SERIES, "both", None),
    "tendon with prestress": (HOUSNER + rk.models.Tendon(2.0, 0.1), SERIES, "both", "tendon"),
    "elastic tie": (HOUSNER + rk.models.Tie(1.5, 0.3), SERIES, "both", "elastic tie"),
    "hinge with damping": (HOUSNER + rk.models.Damper(0.05), SERIES, "both", "damper"),
    "free block, diffrax 1e-8": (HOUSNER, DIFFRAX, "both", None),
    "tie that yields, diffrax 1e-8": (HOUSNER + rk.models.Tie(**TIE, yields=0.05), DIFFRAX, "both", "yielding tie"),
    "tie that breaks, diffrax 1e-8": (HOUSNER + rk.models.Tie(**TIE, breaks=0.05), DIFFRAX, "both", "breaking tie"),
}


def block(alpha, sides):
    """Return a block of a slenderness, as a frame or a wall."""
    size = 2 * 0.75 * 9.81 / 4  # p of 2 rad/s
    if sides == "frame":
        return rk.Block.from_frame(size * jnp.sin(alpha), size * jnp.cos(alpha), beam=4.0)
    return rk.Block(alpha, 2.0, 0.9, opens=None if sides == "both" else sides)


def largest_error(kind, engine):
    """Return the largest relative error of the peaks of the table of references, and the number of wrong verdicts."""
    found, wrong = [0.0], 0
    for scene in json.loads(structures.FILE.read_text())[kind] if kind else ():
        outcome, known = rk.outcome(*translated.scene(scene), engine=engine), scene["result"]
        wrong += bool(outcome.overturned) != known["overturned"]
        if not known["overturned"]:
            found.append(abs(float(outcome.max_rotation) / known["peak"] - 1))
    return max(found), wrong


def main() -> None:
    """Write the report."""
    random, record = np.random.default_rng(SEED), rk.example_record()
    amplitude, period = random.uniform(0.25, 0.8, PULSES), random.uniform(0.4, 1.5, PULSES)
    alpha, scale = random.uniform(0.12, 0.3, RECORDS), random.uniform(0.6, 1.6, RECORDS)
    runs, firsts = {}, {}
    for name, (model, engine, sides, _) in CASES.items():
        given = model, engine, sides
        pulses = jax.jit(
            jax.vmap(lambda a, t, g=given: rk.outcome(block(0.2, g[2]), rk.SinePulse(a, t), g[0], engine=g[1]))
        )
        records = jax.jit(jax.vmap(lambda x, s, g=given: rk.outcome(block(x, g[2]), s * record, g[0], engine=g[1])))
        begin = time.perf_counter()
        jax.block_until_ready(rk.outcome(block(0.2, sides), rk.SinePulse(0.4, 0.8), model, engine=engine))
        firsts[name] = time.perf_counter() - begin
        runs[name] = (
            lambda f=pulses: jax.block_until_ready(f(amplitude, period)),
            lambda f=records: jax.block_until_ready(f(alpha, scale)),
        )
        print(name, f"{firsts[name]:.1f} s", flush=True)
    rows = []
    for name, (_, engine, _, kind) in CASES.items():
        of_pulses, of_records = (least_time(run, 5, 20.0) for run in runs[name])
        error, wrong = largest_error(kind, engine) if kind else (None, None)
        told = ("", "") if kind is None else (f"{error:.0e}", f"{wrong}")
        rows.append(
            (name, f"{firsts[name]:.1f} s", f"{PULSES / of_pulses:,.0f}", f"{RECORDS / of_records:,.0f}", *told)
        )
        print(rows[-1], flush=True)
    header = (
        "structure",
        "first answer",
        "pulses a second",
        "records a second",
        "largest error of peaks",
        "wrong verdicts",
    )
    lines = [
        "# Structures that rock",
        "",
        f"Written by `python -m benchmarks.structures` (seed {SEED}, {jax.device_count()} device, double precision),",
        "on two cores.",
        "",
        f"{PULSES:,} blocks, frames or walls of p 2 rad/s and slenderness 0.2 under sine pulses of 0.25 to 0.8 g and",
        f"0.4 to 1.5 s; {RECORDS:,} of slenderness 0.12 to 0.3 under 0.6 to 1.6 times the built-in record of",
        f"{record.samples.size} samples. Restitution 0.9. The first answer is that of one scene in a new session,",
        "with programs that an earlier one has kept. Errors are those of 20 scenes of each kind in",
        "`references/structures.json`.",
        "",
        table(header, rows),
    ]
    (Path(__file__).parent / "structures.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
