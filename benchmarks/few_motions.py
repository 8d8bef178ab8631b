"""Do intervals of fragilities hold for few outcomes and few motions?

    python benchmarks/few_motions.py [--samples 2000]

Writes `few_motions.md`; about ten minutes.
"""

import argparse
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import jaxrock as rk  # noqa: E402

MEDIAN, DISPERSION = 0.4, 0.35
LEVELS = np.geomspace(0.1, 1.6, 12)
COUNTS = (5, 10, 20, 40)
GOOD = rk.hazard.FitStatus.successful


def single(seed, count):
    """Outcomes under shakings of lognormal intensity, each of another motion."""
    random = np.random.default_rng(seed)
    level = np.log(MEDIAN) + 0.5 * random.normal(size=count)
    toppled = level > np.log(MEDIAN) + DISPERSION * random.normal(size=count)
    return np.exp(level), toppled


def stripes(seed, motions, between, within, draws):
    """Motions with lognormal capacities, of which blocks of their own scatter have other ones, at all levels alike."""
    random = np.random.default_rng(seed)
    capacity = between * random.normal(size=(motions, 1, 1)) + within * random.normal(size=(motions, 1, draws))
    verdict = (LEVELS[:, None] > MEDIAN * np.exp(capacity)).astype(np.int8)
    ones, names = jnp.ones(motions), tuple(map(str, range(motions)))
    return rk.hazard.SimulatedFragility(jnp.asarray(LEVELS), verdict, ones, ones, names, "PGA")


def held(fit, intervals, dispersion):
    """Return whether the truth lies in the intervals (median, dispersion); and by standard errors, NaN without a
    fit."""
    ends = np.array([intervals.median, intervals.dispersion])
    truth = np.array([MEDIAN, dispersion])
    inside = (ends[:, 0] <= truth) & (truth <= ends[:, 1])
    off = np.log([float(fit.fragility.median), float(fit.fragility.dispersion)]) - np.log(truth)
    by_errors = np.abs(off) <= 1.96 * np.sqrt(np.diag(fit.covariance))
    missing = np.nan if fit.status != GOOD else 0.0
    return inside + (np.nan if intervals.status != GOOD else 0.0), by_errors + missing, np.isfinite(ends[:, 1])


def row(words, cases, dispersion):
    inside, by_errors, ended = (np.array(each) for each in zip(*(held(*case, dispersion) for case in cases)))
    shares = [f"{a:.1f}, {b:.1f}" for a, b in 100 * np.array([np.nanmean(by_errors, 0), np.nanmean(inside, 0)])]
    fits, told = 100 * np.mean(~np.isnan(by_errors[:, 0])), 100 * np.mean(~np.isnan(inside[:, 0]))
    ends = ", ".join(f"{x:.0f}" for x in 100 * np.mean(ended, 0))
    line = f"| {words} | {shares[0]} | {fits:.1f} | {shares[1]} | {told:.1f} | {ends} |"
    print(line, flush=True)
    return line


def header(samples):
    return [
        "# Intervals of fragilities for few motions",
        "",
        "Written by `python benchmarks/few_motions.py`.",
        "",
        f"Share [%] of 95 % intervals of median and dispersion that hold the truth ({MEDIAN:g}; {DISPERSION:g} in",
        f"all, 0.38 and 0.36 of many blocks), of {samples:,} made samples each: by 1.96 standard errors of the",
        "logarithms, where there is a fit, and by `fragility_intervals` (single outcomes) or",
        "`SimulatedFragility.intervals` (suites at 12 levels, where there is a fit). The last column: how often the",
        "upper end of the median and of the dispersion is finite.",
        "",
        "| outcomes | standard errors | with a fit [%] | intervals | told [%] | upper ends [%] |",
        "| --- | --- | --- | --- | --- | --- |",
    ]


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--samples", type=int, default=2000)
    samples = parser.parse_args().samples
    lines = header(samples)
    for between, within, draws in ((DISPERSION, 0.0, 1), (0.35, 0.15, 32), (0.2, 0.3, 32)):
        for count in COUNTS:
            suites = (stripes(seed, count, between, within, draws) for seed in range(samples))
            cases = ((found.fit(), found.intervals()) for found in suites)
            blocks = "one block" if draws == 1 else f"{draws} blocks, {between:g} between motions, {within:g} within"
            lines.append(row(f"{count} motions, {blocks}", cases, np.hypot(between, within)))
    for count in COUNTS:
        shakings = (single(seed, count) for seed in range(samples))
        cases = ((rk.hazard.fit_fragility(*each), rk.hazard.fragility_intervals(*each)) for each in shakings)
        lines.append(row(f"{count} single ones", cases, DISPERSION))
    (Path(__file__).parent / "few_motions.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
