"""First fits, rates, peaks, estimates, histories and columns: `python benchmarks/fits.py` writes `fits.md`.

Fresh processes, with nothing kept and XLA's own settings, in turns: compiled with low effort
(`jaxrock.compiler.hints.low_effort`), and as XLA compiles by itself.
"""

import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

if "without llvmlite" in "".join(sys.argv[1:2]):
    sys.modules["llvmlite"] = None  # before anything imports it

from common import table  # first: the search path
from peers_solvers.report import surroundings

HERE = Path(__file__).parent
TIMES, ROWS, OTHER = 3, 200, 190
WAYS = ("quickly", "by itself")
# Question: what is called of so many rows (n).
QUESTIONS = {
    "`fit_fragility`": "hazard.fit_fragility(x[:n], fell[:n])",
    "`fit_probit` by two measures, clusters": (
        "hazard.fit_probit({'PGA': x[:n], 'ratio': y[:n]}, fell[:n], clusters=np.arange(n) // 5)"
    ),
    "the same, jackknife": (
        "hazard.fit_probit({'PGA': x[:n], 'ratio': y[:n]}, fell[:n], clusters=np.arange(n) // 5, errors='jackknife')"
    ),
    "`fit_surface`": "hazard.fit_surface(x[:n], y[:n], fell[:n])",
    "`toppling_rate`": "hazard.toppling_rate(fragility, curve)",
    "`survival_probability` of two rocks": "hazard.survival_probability([fragility, fragility], [1e2, 1e3], curve)",
    "`log_density` at 64 points": "rk.inverse.log_density(*asked)(points)",
    "`estimate_motion`, 8 starts": "rk.inverse.estimate_motion(*asked, starts=8, progress=False).values",
    "`feasible_region`, 12 x 12": "rk.inverse.feasible_region(rk.inverse.Likelihood(*asked[:2]), grid, progress=False)",
    "`peak_velocity` of a pulse": "rk.intensity.peak_velocity(rk.RickerPulse(0.5, 0.6))",
    "`simulate`, a pulse": "rk.simulate(block, pulse).rotation",
    "`simulate`, a record": "rk.simulate(block, 1.5 * rk.example_record()).rotation",
    "`contact_forces` of a history": "rk.responses.contact_forces(rk.simulate(block, pulse), block)",
    "flexible column, `outcome`": "rk.outcome(column, rk.SinePulse(0.5, 1.6))",
    "its history": "rk.simulate(column, rk.SinePulse(0.5, 1.6)).rotation",
    "`sensitivity`": "rk.studies.sensitivity(block, pulse)",
    "map of 64 x 64": "rk.overturning_map(np.linspace(1, 8, 64), np.linspace(1, 10, 64), progress=False).margin",
    "map of 128 x 128, without llvmlite": (
        "rk.overturning_map(np.linspace(1, 8, 128), np.linspace(1, 10, 128), progress=False).margin"
    ),
    "spectrum of 200 blocks under a record, without llvmlite": (
        "rk.rocking_spectrum(0.2, rk.example_record(), np.linspace(0.5, 8, 200), progress=False).margin"
    ),
    "map of 32 x 32 by Diffrax, without llvmlite": (
        "rk.overturning_map(np.linspace(1, 8, 32), np.linspace(1, 10, 32), engine=rk.Diffrax(), progress=False).margin"
    ),
}


def ask(question, way):
    """In this process: processor seconds of the first answer, of one to another number of rows, seconds of the next
    ones, and all numbers of the first."""
    import jax
    import numpy as np

    jax.config.update("jax_enable_x64", True)
    import jaxrock as rk
    from jaxrock.compiler.hints import low_effort
    from jaxrock.sweeps import runner

    if way != WAYS[0]:
        low_effort.LOW_EFFORT_LIMIT = runner.LOW_EFFORT_LIMIT = -1
    draw = np.random.default_rng(1)
    x, y = (np.exp(draw.normal(mean, 0.5, ROWS)) for mean in (-1, -2))
    alpha, p = np.array([0.10, 0.13, 0.16, 0.20, 0.24]), np.array([3.0, 2.6, 3.4, 2.8, 3.2])
    rocks = rk.inverse.Observations(alpha, p, ["toppled"] * 2 + ["survived"] * 3, alpha_sd=0.04 * alpha)
    unknowns = {"amplitude": rk.inverse.Unknown(0.05, 2.0), "period": rk.inverse.Unknown(0.2, 3.0)}
    names = {
        "rk": rk, "hazard": rk.hazard, "np": np, "x": x, "y": y,
        "fell": np.log(x) + 0.5 * np.log(y) + draw.normal(0, 0.5, ROWS) > -2,
        "fragility": rk.hazard.LogNormalFragility(0.3, 0.4, "PGA"),
        "asked": (rocks, rk.SinePulse, unknowns), "points": draw.normal(0, 1, (64, 2)),
        "grid": {"amplitude": np.geomspace(0.1, 1.5, 12), "period": np.geomspace(0.3, 2.0, 12)},
        "block": rk.Block(0.2, 2.0), "pulse": rk.SinePulse(0.3, 0.8),
        "column": rk.blocks.FlexibleBlock(5.0, 50.0, 30e9, 2500.0, 0.01, 6),
        "curve": rk.hazard.HazardCurve([0.1, 0.2, 0.4, 0.8], [1e-2, 1e-3, 1e-4, 1e-5]),
    }  # fmt: skip

    def timed(clock, count):
        begun = clock()
        answer = jax.block_until_ready(jax.tree.leaves(eval(QUESTIONS[question], names | {"n": count})))
        return clock() - begun, answer

    first, answer = timed(time.process_time, ROWS)
    other = timed(time.process_time, OTHER)[0]
    often = 3 if "motion" in question or "without" in question else 50
    again = min(timed(time.perf_counter, ROWS)[0] for _ in range(often))
    numbers = [float(number) for leaf in answer for number in np.ravel(np.asarray(leaf, float))]
    return first, other, again, numbers


def asked(question, way):
    """The same in a fresh process."""
    words = [sys.executable, __file__, question, way]
    run = subprocess.run(words, env=os.environ | {"JAXROCK_CACHE": "off"}, capture_output=True, text=True, check=True)
    return json.loads(run.stdout.splitlines()[-1])


def main():
    rows = []
    for question in QUESTIONS:
        found = {way: [] for way in WAYS}
        for _ in range(TIMES):
            for way in WAYS:
                found[way].append(asked(question, way))
        pairs = zip(*(found[way][0][3] for way in WAYS), strict=True)
        off = max((abs(one - other) / abs(other) for one, other in pairs if other), default=0.0)
        for way, answers in found.items():
            first, other, again = (statistics.median(x) for x in list(zip(*answers, strict=True))[:3])
            rows.append([question, way, f"{first:.2f}", f"{other:.2f}", f"{1e3 * again:.2f}", f"{off:.0e}"])
    heads = ["question", "compiled", "first [s]", f"next, of {OTHER} rows [s]", "again [ms]", "relative difference"]
    text = f"""# Fits, rates, peaks, estimates, histories and columns

Written by `python benchmarks/fits.py`, {surroundings()}.

Processor seconds of the first answer in a fresh process with nothing kept, and of the next, in a fit one to
{OTHER} rows of outcomes after one to {ROWS}, which have room in one program; the least time of answers after that;
medians of {TIMES}, in turns. Of known numbers, few and on a CPU, the package has XLA compile such programs quickly
(`jaxrock.compiler.hints.low_effort`): without LLVM's effort and XLA's newer emitters. That holds also where such a
program follows scenes, if these are machine code, of flexible columns, which are not, and of sweeps of few points on
one device that have no loops, or follow rigid blocks without machine code. The difference is the largest of any number
of the answer, covariances too; of `estimate_motion` it is what a climb settles at.

{table(heads, rows)}
"""
    (HERE / "fits.md").write_text(text)
    print(text)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        print(json.dumps(ask(sys.argv[1], sys.argv[2])))
    else:
        main()
