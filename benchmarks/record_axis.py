"""Records as an axis: of `sweep`, under `jax.vmap`, and a suite's own loop. `python -m benchmarks.record_axis` writes
`record_axis.md`."""

import resource
import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import jaxrock as rk  # noqa: E402
from benchmarks.common import table  # noqa: E402

COUNT, SEED = 150, 3
ALPHA, P, WAYS = jnp.array([0.15, 0.25]), jnp.array([2.5, 3.5]), (1.0, -1.0)


def motions() -> list[rk.Record]:
    """Smooth noise under envelopes, of 2,000 to 10,000 samples and three steps."""
    random, found = np.random.default_rng(SEED), []
    for number in range(COUNT):
        samples, dt = int(random.integers(2000, 10_000)), float(random.choice([0.0025, 0.005, 0.01]))
        share = np.arange(samples) / (samples - 1)
        noise = np.convolve(random.normal(size=samples + 20), np.ones(21) / 21, "valid")
        noise *= np.exp(-(((share - 0.45) / 0.2) ** 2))
        found.append(rk.Record(noise * random.uniform(0.2, 0.8) / np.abs(noise).max(), dt, f"motion {number}"))
    return found


def memory() -> float:
    """Largest memory until now [GB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


def main() -> None:
    """Write the report."""
    suite = rk.motions.Suite(motions())

    def one(motion, rock, way):
        return rk.outcome(rk.Block(ALPHA[rock], P[rock]), way * motion)

    def by_sweep():
        return rk.sweep(one, motion=suite, rock=[0, 1], way=WAYS, progress=False).values.overturned

    def by_vmap():
        points = np.meshgrid(np.arange(COUNT), [0, 1], WAYS, indexing="ij")
        run = jax.vmap(lambda number, rock, way: one(suite[number], rock, way).overturned)
        return np.asarray(run(*(x.ravel() for x in points))).reshape(COUNT, 2, 2)

    def by_loop():
        found = rk.hazard.suite_outcomes(rk.Block(ALPHA, P), suite, facing="both", progress=False)
        return found.verdict[:, 0].swapaxes(1, 2)

    rows, known = [], None
    ways = {"`rk.sweep(..., motion=suite)`": by_sweep, "`jax.vmap` over `suite[number]`": by_vmap,
            "`suite_outcomes`": by_loop}  # fmt: skip
    for name, run in ways.items():
        before, times = memory(), []
        for _ in range(2):
            begin = time.process_time()
            found = run()
            times.append(time.process_time() - begin)
        known = found if known is None else known
        differ = int((found != known)[found >= 0].sum())
        rows.append((name, f"{times[0]:.1f} s", f"{times[1]:.2f} s", f"{memory() - before:.2f} GB", f"{differ}"))
        print(rows[-1], flush=True)
    samples = sum(motion.samples.size for motion in suite)
    lines = [
        "# Records as an axis",
        "",
        f"Written by `python -m benchmarks.record_axis` (seed {SEED}, {jax.device_count()} device, double precision):",
        f"{COUNT} records of {samples:,} samples in all, as recorded, on 2 blocks, both ways round. Times are those of",
        "the processor; memory is by how much the process grew, compiling included.",
        "",
        table(("by", "first call", "again", "memory", "decided verdicts other than the first's"), rows),
    ]
    (Path(__file__).parent / "record_axis.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
