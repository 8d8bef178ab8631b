"""Fits to histories: coverage, starts, cost. `python benchmarks/histories.py` writes `histories.md`.

Free rocking of a block whose parameters are known, with made-up errors. Takes some ten minutes on one core.
"""

import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

import jaxrock as rk  # noqa: E402

TRUTH = np.array([0.2, 2.5, 0.9, 0.12])
TIME = np.linspace(0.02, 6.0, 240)
ERROR, REPETITIONS = 2e-3, 400


def clean():
    """The history without errors, to rounding."""
    block, floor = rk.Block(*TRUTH[:3]), rk.RectangularPulse(0.0, 1.0)
    response = rk.simulate(block, floor, initial=(TRUTH[3], 0.0), duration=6.0, engine=rk.Series(order=8), samples=2)
    return np.asarray(response(TIME)[0])


def errors(seed, kept):
    """Errors that each keep a share of the one before."""
    fresh = ERROR * np.random.default_rng(seed).normal(size=TIME.size)
    found = [fresh[0]]
    for x in fresh[1:]:
        found.append(kept * found[-1] + np.sqrt(1 - kept**2) * x)
    return np.array(found)


def guess(seed, size):
    """Starting values that are off by a factor, up or down each."""
    signs = np.random.default_rng(seed).choice([-1, 1], 3)
    alpha, p = TRUTH[:2] * (1 + size) ** signs[:2]
    return rk.Block(alpha, p, min(TRUTH[2] * (1 + size / 4) ** signs[2], 0.99))


def coverage(truth, kept):
    """Share of 95 % intervals that hold the truth, as if independent and robust; and of fits told as correlated."""
    inside, told = [], []
    for seed in range(REPETITIONS):
        found = rk.inverse.fit_history(TIME, truth + errors(seed, kept), guess(seed, 0.05), starts=1)
        for robust in (False, True):
            low, high = found.intervals(robust=robust).T
            inside.append((low < TRUTH) & (TRUTH < high))
        told.append(found.correlated)
    inside = np.array(inside).reshape(REPETITIONS, 2, 4).mean(axis=0)
    return inside, np.mean(told)


def reached(truth, size, starts):
    """Share of 40 fits that come to the truth, and seconds for each, once compiled."""
    good, begin = [], None
    for seed in range(41):
        found = rk.inverse.fit_history(TIME, truth + errors(seed, 0.0), guess(seed, size), starts=starts, seed=seed)
        off = np.abs(found.values - TRUTH) / np.sqrt(np.diag(found.covariance))
        good.append(np.all(off < 5))
        begin = begin or time.perf_counter()  # the first one compiles
    return np.mean(good[1:]), (time.perf_counter() - begin) / 40


def main():
    truth = clean()
    lines = [
        "# Fits to histories",
        "",
        "Written by `python benchmarks/histories.py`. Free rocking of a block (alpha 0.2, p 2.5 rad/s, restitution",
        f"0.9, tilt 0.6 alpha), {TIME.size} samples of 6 s, errors of {1e3 * ERROR:g} mrad (1 % of alpha).",
        "",
        f"Share of 95 % intervals of alpha, p, restitution and tilt that hold the truth, of {REPETITIONS} repetitions",
        "(one standard deviation of such a share: 1.1 %). An error keeps that share of the one before:",
        "",
        "| keeps | as if independent | robust | told as correlated |",
        "| --- | --- | --- | --- |",
    ]
    for kept in (0.0, 0.5, 0.9):
        inside, told = coverage(truth, kept)
        shares = [", ".join(f"{100 * x:.1f}" for x in row) for row in inside]
        lines.append(f"| {kept:g} | {shares[0]} | {shares[1]} | {100 * told:.0f} % |")
        print(lines[-1], flush=True)
    lines += [
        "",
        "Starting values that are off by that much, up or down each: share of 40 fits within five standard errors of",
        "the truth in all four parameters, and time of one fit once it is compiled.",
        "",
        "| off by | starts | reached | time |",
        "| --- | --- | --- | --- |",
    ]
    for size in (0.1, 0.3, 0.6, 1.0):
        for starts in (1, 8):
            share, seconds = reached(truth, size, starts)
            lines.append(f"| {100 * size:.0f} % | {starts} | {100 * share:.0f} % | {seconds:.2f} s |")
            print(lines[-1], flush=True)
    (Path(__file__).parent / "histories.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
