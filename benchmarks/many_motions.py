"""Suites of many motions: time, memory, verdicts. `python -m benchmarks.many_motions` writes `many_motions.md`."""

import resource
import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

import jaxrock as rk  # noqa: E402
from benchmarks.peers_solvers import scipy_loop  # noqa: E402

SEED = 7


def motions(count: int, fewest: int, most: int) -> list[rk.Record]:
    """Noise under envelopes, of 2 to 20 s and many lengths and steps: each with a spectrum of its own."""
    random, found = np.random.default_rng(SEED), []
    for number in range(count):
        samples, dt = int(random.integers(fewest, most)), float(random.choice([0.0025, 0.005, 0.01]))
        time = dt * np.arange(samples)
        noise = rk.processing.filtered(
            rk.Record(random.normal(size=samples), dt), random.uniform(0.1, 0.4), random.uniform(3.0, 12.0)
        )
        middle, width = time[-1] * random.uniform(0.3, 0.6), time[-1] * random.uniform(0.1, 0.25)
        record = rk.Record(
            np.asarray(noise.samples) * np.exp(-(((time - middle) / width) ** 2)), dt, f"motion {number}"
        )
        found.append(rk.processing.scaled(record, acceleration=random.uniform(0.1, 0.8)))
    return found


def timed(run):
    """What a function gives, seconds of its first call, and of its second."""
    times = []
    for _ in range(2):
        begin = time.perf_counter()
        found = run()
        times.append(time.perf_counter() - begin)
    return found, *times


def differing(found: rk.SuiteOutcomes, tight: rk.SuiteOutcomes) -> int:
    """Verdicts that are not those of a tighter tolerance, of those decided in both."""
    both = (found.verdict >= 0) & (tight.verdict >= 0)
    return int(np.sum(both & (found.verdict != tight.verdict)))


def by_scipy(found: rk.SuiteOutcomes, count: int) -> tuple[float, int]:
    """Seconds a history of the loop that is usually written, and how many verdicts of a sample differ."""
    random, wrong = np.random.default_rng(SEED), 0
    records, settings = list(found.suite.motions()), scipy_loop.settings_of(1e-8, 1e-11)
    begin = time.perf_counter()
    for _ in range(count):
        m, s, b = (int(random.integers(n)) for n in (len(records), found.scale.size, found.verdict.shape[3]))
        samples, dt = found.scale[s] * np.trim_zeros(np.asarray(records[m].samples), "b"), float(records[m].dt)
        block = (float(x[b]) for x in (found.blocks.alpha, found.blocks.p, found.blocks.restitution))
        motion = scipy_loop.Record(samples, dt, cut=False)
        wrong += np.isinf(scipy_loop.follow(*block, motion, False, settings)) != (found.verdict[m, s, 0, b] == 1)
    return (time.perf_counter() - begin) / count, wrong


def main():
    rows = []
    suite = rk.Suite(motions(500, 2000, 10_000))
    rocks = rk.Block(np.array([0.15, 0.25]), np.array([2.5, 3.5]))
    found, first, again = timed(lambda: rk.suite_outcomes(rocks, suite, facing="both", progress=False))
    rows.append(("500 motions as recorded x 2 blocks x 2 facings", found, first, again))
    sides = rk.AsymmetricBlock(np.array([0.15, 0.25]), np.array([0.2, 0.3]), np.array([2.5, 3.5]))
    found, first, again = timed(lambda: rk.suite_outcomes(sides, suite, facing="both", progress=False))
    rows.append(("the same of asymmetric blocks", found, first, again))
    print(rows[0][2:], rows[1][2:], flush=True)

    suite = rk.Suite(motions(100, 2000, 10_000))
    blocks = rk.draw_blocks(rk.Block(0.2, 2.5), 20, alpha=0.2, p=0.2)
    scale = np.geomspace(0.2, 5.0, 50)
    engine = rk.Series(tolerance=1e-8)
    found, first, again = timed(lambda: rk.suite_outcomes(blocks, suite, scale, engine=engine, progress=False))
    rows.append(("100 motions x 50 scales x 20 blocks at 1e-8", found, first, again))
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
    tight = rk.suite_outcomes(blocks, suite, scale, progress=False)
    each, wrong = by_scipy(found, 60)
    report = [
        "# Suites of hundreds of motions",
        "",
        f"Written by `python -m benchmarks.many_motions` (seed {SEED}, {jax.device_count()} device, double precision).",
        "",
        "| what | scenes | toppled | undecided | first call | again |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for name, each_found, first, again in rows:
        toppled = f"{(each_found.verdict == 1).mean():.2f}"
        cells = f"{each_found.verdict.size:,} | {toppled} | {each_found.undecided} | {first:.1f} s | {again:.2f} s"
        report.append(f"| {name} | {cells} |")
    rate = found.verdict.size / rows[-1][3]
    other, times = differing(found, tight), each * rate
    report += [
        "",
        f"Memory at most {memory:.2f} GB. Verdicts that the usual tolerance decides otherwise: {other} of",
        f"{found.verdict.size:,}. SciPy's DOP853 with events at 1e-8 takes {each:.2f} s a history, {times:.0f} times",
        f"as long; of 60 scenes drawn from the last row {wrong} verdicts differ.",
    ]
    (Path(__file__).parent / "many_motions.md").write_text("\n".join(report) + "\n")
    print("\n".join(report))


if __name__ == "__main__":
    main()
