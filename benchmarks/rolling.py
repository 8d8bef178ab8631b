"""Blocks that roll, under a record: time and what is undecided. `python -m benchmarks.rolling` writes `rolling.md`."""

import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import diffrax  # noqa: E402
import numpy as np  # noqa: E402

import jaxrock as rk  # noqa: E402
from benchmarks.common import table  # noqa: E402

COUNT, SEED = 400, 1
ANGLES = np.linspace(0.0, 0.5, 12)
EDGES = {"circle": 0.2, "12 angles": rk.blocks.Edge(np.full(12, 0.2) - 0.1 * ANGLES, ANGLES)}
ENGINES = {
    "Tsit5, 1e-8": (rk.Diffrax(), "circle"),
    "Tsit5, 1e-10 (the usual one)": (None, "circle"),
    "Dopri8, 1e-12": (rk.Diffrax(diffrax.Dopri8(), rtol=1e-12), "circle"),
    "Tsit5, 1e-10, radii at 12 angles": (None, "12 angles"),
}


def main() -> None:
    """Write the report."""
    random, record = np.random.default_rng(SEED), rk.example_record()
    alpha, scale, p = random.uniform(0.12, 0.3, COUNT), random.uniform(0.6, 1.6, COUNT), random.uniform(1.5, 4.0, COUNT)
    rows, known = [], None
    for name, (engine, edge) in ENGINES.items():
        given = rk.models.Rolling(EDGES[edge]), engine
        run = jax.jit(jax.vmap(lambda a, p, s, g=given: rk.outcome(rk.Block(a, p), s * record, g[0], engine=g[1])))
        times = []
        for _ in range(2):
            begin = time.process_time()
            found = jax.block_until_ready(run(alpha, p, scale))
            times.append(time.process_time() - begin)
        decided = np.asarray(found.status == rk.Status.successful)
        toppled = np.asarray(found.overturned)
        known = known or (decided, toppled)
        differ = int((toppled != known[1])[decided & known[0]].sum())
        cells = f"{1e3 * times[1] / COUNT:.1f} ms", f"{times[0]:.0f} s", f"{COUNT - decided.sum()}", f"{differ}"
        rows.append((name, *cells, f"{toppled[decided].mean():.2f}"))
        print(rows[-1], flush=True)
    header = "solver, tolerance", "a history", "first call", "undecided", "verdicts other than the first's", "toppled"
    lines = [
        "# Blocks that roll on rounded edges",
        "",
        f"Written by `python -m benchmarks.rolling` (seed {SEED}, {jax.device_count()} device, double precision):",
        f"{COUNT} blocks of slenderness 0.12 to 0.3 and p 1.5 to 4 rad/s on edges of radius 0.2 R (or from that",
        "to 0.15 R, on straight lines between angles up to 0.5) under 0.6 to 1.6 times the built-in record of",
        f"{record.samples.size} samples. Times are those of the processor.",
        "",
        table(header, rows),
        "",
        "A step goes from sample to sample: a tighter tolerance costs next to nothing, and decides more. The",
        "last row is of other edges, so that some fall otherwise.",
    ]
    (Path(__file__).parent / "rolling.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
