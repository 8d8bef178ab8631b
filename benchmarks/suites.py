"""Fragility by simulation: coverage of fits, cost. `python benchmarks/suites.py` writes `suites.md`; some minutes."""

import functools
import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import jaxrock as rk  # noqa: E402

MEDIAN, DISPERSION, REPETITIONS = 0.4, 0.35, 1000
LEVELS = np.geomspace(0.1, 1.6, 12)


def stripes(seed, motions):
    """Motions with lognormal capacities, at all levels alike."""
    capacity = MEDIAN * np.exp(DISPERSION * np.random.default_rng(seed).normal(size=motions))
    verdict = (LEVELS > capacity[:, None])[:, :, None].astype(np.int8)
    ones, names = jnp.ones(motions), tuple(map(str, range(motions)))
    return rk.hazard.SimulatedFragility(jnp.asarray(LEVELS), verdict, ones, ones, names, "PGA")


def coverage(motions):
    """Share of 95 % intervals that hold the truth (of median, dispersion): of clusters, and as if independent."""
    truth, inside, failed = np.log([MEDIAN, DISPERSION]), [], 0
    for seed in range(REPETITIONS):
        found = stripes(seed, motions)
        fit = found.fit()
        if fit.status != rk.hazard.FitStatus.successful:
            failed += 1
            continue
        plain = rk.hazard.fit_fragility(found.levels, found.counts().sum(axis=0), float(motions))
        off = np.log([float(fit.fragility.median), float(fit.fragility.dispersion)]) - truth
        inside.append([np.abs(off) < 1.96 * np.sqrt(np.diag(f.covariance)) for f in (fit, plain)])
    return np.mean(inside, axis=0), failed


def cost(run):
    """Seconds of a first call, and of the better of two more."""
    times = []
    for _ in range(3):
        begin = time.perf_counter()
        found = run()
        times.append(time.perf_counter() - begin)
    return found, times[0], min(times[1:])


def main():
    lines = [
        "# Fragility by simulation",
        "",
        "Written by `python benchmarks/suites.py`.",
        "",
        f"Share of 95 % intervals of the median and the dispersion that hold the truth, of {REPETITIONS} suites of",
        f"motions with lognormal capacities ({MEDIAN:g}, {DISPERSION:g}), each scaled to {LEVELS.size} levels:",
        "",
        "| motions | of clusters | as if independent | without a fit |",
        "| --- | --- | --- | --- |",
    ]
    for motions in (10, 20, 40, 100):
        inside, failed = coverage(motions)
        shares = [f"{100 * a:.1f}, {100 * b:.1f}" for a, b in inside]
        lines.append(f"| {motions} | {shares[0]} | {shares[1]} | {failed} |")
        print(lines[-1], flush=True)
    blocks = rk.blocks.draw_blocks(rk.Block.from_dimensions(0.5, 1.6, 0.92), 32, alpha=0.08, p=0.05, restitution=0.03)
    pulses = [rk.SinePulse, rk.CosinePulse, functools.partial(rk.RickerPulse, kind="symmetric")]
    grid = np.geomspace(0.1, 3.0, 48), np.geomspace(0.03, 0.4, 24)
    runs = {
        "surface: three pulses, 48 x 24 cells, 32 draws": lambda: rk.hazard.simulated_surface(blocks, pulses, *grid),
        "stripes: the built-in record, 24 levels, 32 draws": lambda: rk.hazard.simulated_fragility(
            blocks, [rk.example_record()], np.geomspace(0.1, 3.0, 24)
        ),
    }
    lines += ["", "| what | scenes | undecided | first call | again |", "| --- | --- | --- | --- | --- |"]
    for name, run in runs.items():
        found, first, again = cost(run)
        lines.append(f"| {name} | {found.verdict.size:,} | {found.undecided} | {first:.1f} s | {again:.2f} s |")
        print(lines[-1], flush=True)
    (Path(__file__).parent / "suites.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
