"""What two motions at once cost, beside one: a record with a vertical component, sums of records and pulses.

    python benchmarks/two_motions.py

Writes `two_motions.md`; about two minutes.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from common import least_time, table  # sets double precision
from peers_solvers.report import surroundings

import jaxrock as rk

SCALES = jnp.linspace(1.5, 3.5, 512)
BLOCK = rk.Block(0.25, 1.0, 0.9)
JUDGED = slice(0, 512, 64)


def motions():
    record = rk.example_record()
    samples = np.asarray(record.samples)
    strong, back = rk.Record(samples + 0.6 * samples[::-1], 0.01), rk.Record(0.6 * samples[::-1], 0.01)
    other = rk.Record(0.6 * samples[::-2], 0.02)
    return {
        "one record": lambda scale: scale * strong,
        "a record and its vertical component": lambda scale: (scale * strong).with_vertical(0.5 * record),
        "two records of one step": lambda scale: scale * record + back,
        "two records of other steps": lambda scale: scale * record + other,
        "a record and a sine": lambda scale: scale * strong + rk.SinePulse(0.05, 0.9),
    }


def row(name, make):
    @jax.jit
    def peaks(scales):
        return jax.vmap(lambda scale: rk.outcome(BLOCK, make(scale)).max_rotation)(scales)

    taken = least_time(lambda: peaks(SCALES).block_until_ready(), 7)
    judge = rk.Diffrax(rtol=1e-11, max_solves=100_000)
    exact = np.array([float(rk.outcome(BLOCK, make(x), engine=judge).max_rotation) for x in SCALES[JUDGED]])
    found = np.asarray(peaks(SCALES))[JUDGED]
    assert (np.isinf(exact) == np.isinf(found)).all()
    off = np.abs(found - exact)[np.isfinite(exact)].max() / float(BLOCK.alpha)
    knots = make(1.0).knots.size
    print(f"{name}: {1e6 * taken / SCALES.size:.1f} µs, {off:.1e}", flush=True)
    return [name, f"{knots:,}", f"{1e6 * taken / SCALES.size:.1f}", f"{SCALES.size / taken:,.0f}", f"{off:.0e}"]


def main():
    rows = [row(*each) for each in motions().items()]
    lines = [
        "# Two motions at once",
        "",
        f"Written by `python benchmarks/two_motions.py`, {surroundings()}",
        "",
        f"{SCALES.size} scales of the motion at once, a block of alpha 0.25 and p 1 rad/s that rocks through most of",
        "57 s; wall clock, all cores, the best of 7. The difference is that of the peaks over alpha from those of the",
        "Diffrax engine (relative tolerance 1e-11), of 8 of them.",
        "",
        table(["motion", "knots", "µs a response", "responses/s", "difference"], rows),
        "",
        "Before pieces were looked up in one table, and those without a length passed over (commit 644d81d), this",
        "script gave 25.1, 287 and 587 µs for the first three. Sums take six to ten times one record: what the ground",
        "may do from each piece on is found anew for every scale of one part, where one record has it once.",
    ]
    (Path(__file__).parent / "two_motions.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
