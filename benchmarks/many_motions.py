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
    """What a function gives, seconds of its first call, and of its second, also of the processor."""
    times = []
    for _ in range(2):
        begin, busy = time.perf_counter(), time.process_time()
        found = run()
        times.append((time.perf_counter() - begin, time.process_time() - busy))
    return found, times[0][0], *times[1]


def by_scipy(found: rk.hazard.SuiteOutcomes, count: int) -> tuple[float, int, int]:
    """Seconds a history of the loop that is usually written, and how many verdicts of how many decided ones differ."""
    random, wrong, decided = np.random.default_rng(SEED), 0, 0
    records, settings = list(found.suite.motions()), scipy_loop.settings_of(1e-8, 1e-11)
    begin = time.process_time()
    for _ in range(count):
        m, s, b = (int(random.integers(n)) for n in (len(records), found.scale.size, found.verdict.shape[3]))
        samples, dt = found.scale[s] * np.trim_zeros(np.asarray(records[m].samples), "b"), float(records[m].dt)
        block = (float(x[b]) for x in (found.blocks.alpha, found.blocks.p, found.blocks.restitution))
        motion = scipy_loop.Record(samples, dt, cut=False)
        lost = np.isinf(scipy_loop.follow(*block, motion, False, settings))
        verdict = found.verdict[m, s, 0, b]
        decided, wrong = decided + (verdict >= 0), wrong + (verdict >= 0 and lost != (verdict == 1))
    return (time.process_time() - begin) / count, wrong, decided


def main():
    """The largest first, so that its memory is its own."""
    rows = []
    suite = rk.motions.Suite(motions(100, 2000, 10_000))
    blocks = rk.blocks.draw_blocks(rk.Block(0.2, 2.5), 20, alpha=0.2, p=0.2)
    scale = np.geomspace(0.2, 5.0, 50)
    many, first, again, cpu = timed(lambda: rk.hazard.suite_outcomes(blocks, suite, scale, progress=False))
    rows.append(("100 motions x 50 scales x 20 blocks", many, first, again, cpu))
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
    each, wrong, decided = by_scipy(many, 60)

    suite = rk.motions.Suite(motions(500, 2000, 10_000))
    rocks = rk.Block(np.array([0.15, 0.25]), np.array([2.5, 3.5]))
    sides = rk.blocks.AsymmetricBlock(np.array([0.15, 0.25]), np.array([0.2, 0.3]), np.array([2.5, 3.5]))
    for name, two in (("blocks", rocks), ("asymmetric blocks", sides)):
        run = timed(lambda two=two: rk.hazard.suite_outcomes(two, suite, facing="both", progress=False))
        rows.append((f"500 motions as recorded x 2 {name} x 2 facings", *run))
    report = [
        "# Suites of hundreds of motions",
        "",
        f"Written by `python -m benchmarks.many_motions` (seed {SEED}, {jax.device_count()} device, double precision,",
        "the usual engine), on a machine that did other work at the same time: the processor's time tells more.",
        "",
        "| what | scenes | toppled | undecided | first call | again | processor, again |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name, found, first, again, cpu in rows:
        toppled = f"{(found.verdict == 1).mean():.2f}"
        cells = f"{found.verdict.size:,} | {toppled} | {found.undecided} | {first:.1f} s | {again:.2f} s | {cpu:.2f} s"
        report.append(f"| {name} | {cells} |")
    times = each * many.verdict.size / rows[0][4]
    report += [
        "",
        f"Memory of the first at most {memory:.2f} GB. SciPy's DOP853 with events at 1e-8 takes {each:.2f} s of a",
        f"processor for a history, {times:.0f} times as long; of {decided} decided scenes drawn from the first row",
        f"{wrong} verdicts differ.",
    ]
    (Path(__file__).parent / "many_motions.md").write_text("\n".join(report) + "\n")
    print("\n".join(report))


if __name__ == "__main__":
    main()
