"""Spectra of a suite: time, memory, errors. `python -m benchmarks.suite_spectra` writes `suite_spectra.md`."""

import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from benchmarks.common import table

RECORDS, SIZES, SEED, JUDGED, TIMES = 100, 200, 11, 24, 3
ALPHA, PERIODS = float(np.arctan(1 / 5)), np.linspace(0.5, 8.0, SIZES)
WAYS = ("suite", "suite on two devices", "sweep", "sweep with scales")
SCALED, SCALES = 20, np.geomspace(0.5, 2.0, 10)  # records and scales of the last way


def suite_of(count):
    """The built-in record in `count` shapes: other lengths of 4,000 to 8,000 samples, steps and strengths."""
    import jaxrock as rk

    random, known = np.random.default_rng(SEED), rk.example_record()
    samples, found = np.asarray(known.samples), []
    for number in range(count):
        size = int(random.integers(4000, 8001))
        places = np.linspace(0, samples.size - 1, size)
        own = np.interp(places, np.arange(samples.size), samples) * random.uniform(0.3, 2.0)
        found.append(rk.Record(own, float(known.dt) * random.uniform(0.7, 1.4), f"record {number}"))
    return rk.motions.Suite(found)


def runs(way):
    """Function that computes the scenes of a way, and returns ratios of peaks, and which scenes are open."""
    import jaxrock as rk
    from jaxrock.status import is_decided

    suite = suite_of(SCALED if "scales" in way else RECORDS)

    def one(motion, period):
        return rk.outcome(rk.Block(ALPHA, 2 * np.pi / period), motion)

    def spectrum():
        found = rk.rocking_spectrum(ALPHA, suite, PERIODS, progress=False)
        found.percentiles()
        return np.asarray(found.rotation_ratio), np.asarray(found.is_open)

    def sweep():
        if "scales" in way:
            scaled = lambda motion, period, scale: one(scale * motion, period)  # noqa: E731
            axes = {"period": PERIODS[::4], "scale": SCALES}
            found = rk.sweep(scaled, motion=suite, progress=False, **axes).values
        else:
            found = rk.sweep(one, motion=suite, period=PERIODS, progress=False).values
        return np.asarray(found.max_rotation) / ALPHA, ~np.asarray(is_decided(found.status))

    return suite, spectrum if "suite" in way else sweep


def measure(way):
    """Times of a first call, of the best of some later ones, and the largest memory of the process; errors."""
    import jaxrock as rk

    if "two" in way:
        rk.studies.use_cpu_devices(2)
    suite, run = runs(way)
    times = []
    for _ in range(1 + TIMES):
        begin = time.perf_counter()
        ratio, is_open = run()
        times.append(time.perf_counter() - begin)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
    told = {"scenes": ratio.size, "first": times[0], "again": min(times[1:]), "memory": memory,
            "open": int(is_open.sum()), "lost": float(np.isinf(ratio).mean())}  # fmt: skip
    if way == "suite":
        told |= errors(suite, ratio, is_open)
    return told


def errors(suite, ratio, is_open):
    """Largest difference of peaks over alpha from SciPy's, cut at every sample; verdicts that differ."""
    from benchmarks.peers_solvers import scipy_loop

    random, off, wrong = np.random.default_rng(SEED), [], 0
    records, settings = list(suite.motions()), scipy_loop.settings_of(1e-11, 1e-14)
    restitution = 1 - 1.5 * np.sin(ALPHA) ** 2
    for _ in range(JUDGED):
        m, n = int(random.integers(len(records))), int(random.integers(SIZES))
        motion = scipy_loop.Record(np.asarray(records[m].samples).tolist(), float(records[m].dt))
        peak = scipy_loop.follow(ALPHA, 2 * np.pi / PERIODS[n], restitution, motion, False, settings)
        if is_open[m, n]:
            continue
        wrong += np.isinf(peak) != np.isinf(ratio[m, n])
        if np.isfinite(peak) and peak > 0:
            off.append(abs(peak - ratio[m, n]))
    return {"rocked": len(off), "worst": float(max(off)), "wrong": int(wrong)}


def main():
    """Each way in a process of its own, so that its memory is its own."""
    rows, judged = [], {}
    for way in WAYS:
        words = [sys.executable, "-m", "benchmarks.suite_spectra", way]
        done = subprocess.run(words, capture_output=True, text=True, check=True)
        told = json.loads(done.stdout.splitlines()[-1])
        judged = judged or told
        cells = f"{told['scenes']:,}", f"{told['lost']:.2f}", f"{told['open']}"
        times = f"{told['first']:.1f} s", f"{told['again']:.2f} s", f"{told['memory']:.2f} GB"
        rows.append((NAMES[way], *cells, *times))
        print(rows[-1], flush=True)
    lines = [
        "# Spectra of a suite",
        "",
        f"Written by `python -m benchmarks.suite_spectra` (seed {SEED}, double precision, the usual engine, two cores",
        "on which other work ran):",
        f"{RECORDS} records of 4,000 to 8,000 samples, made of the built-in one; {SIZES} sizes of slenderness 5.",
        f"The last row has {SCALED} records, {len(PERIODS[::4])} sizes, {SCALES.size} scales. Each row is a process;",
        "its memory is that of the whole process, JAX and compiling included.",
        "",
        table(("by", "scenes", "overturned", "open", "first call", "again", "memory"), rows),
        "",
        f"Of {JUDGED} scenes drawn from the first row {judged['wrong']} verdicts differ from those of SciPy's DOP853",
        f"(rtol 1e-11, cut at every sample). {judged['rocked']} of them rocked and stood: their peaks over alpha",
        f"differ by at most {judged['worst']:.0e}.",
    ]
    (Path(__file__).parent / "suite_spectra.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


NAMES = {
    "suite": "`rk.rocking_spectrum(alpha, suite, period)`",
    "suite on two devices": "the same, after `rk.studies.use_cpu_devices()`",
    "sweep": "`rk.sweep(function, motion=suite, period=period)`",
    "sweep with scales": "`rk.sweep(function, motion=suite, period=period, scale=scale)`",
}


if __name__ == "__main__":
    if len(sys.argv) > 1:
        print(json.dumps(measure(sys.argv[1])))
    else:
        main()
