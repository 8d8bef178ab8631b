"""Blocks calibrated from made verdicts: how often intervals hold the truth, and what it costs.

    python benchmarks/calibration.py [--repetitions 400]

Writes `calibration.md`; some minutes. Times are processor seconds of all threads, and seconds on the wall.
"""

import argparse
import os
import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

import jaxrock as rk  # noqa: E402

TRUTH, P = {"alpha": 0.2, "alpha_sd": 0.3}, 3.0
UNKNOWNS, SCATTER = {"alpha": rk.inverse.Unknown(0.05, 0.5)}, {"alpha": rk.inverse.Unknown(0.03, 0.8)}


def pulses(count, seed=1):
    """Sine pulses, amplitudes [g] and periods [s]."""
    random = np.random.default_rng(seed)
    return random.uniform(0.2, 0.6, count), random.uniform(0.2, 0.9, count)


def verdicts(amplitudes, periods, repetitions, seed=2):
    """(repetitions, tests) who toppled: the slenderness of every test is drawn anew."""
    drawn = np.random.default_rng(seed).normal(size=(repetitions, amplitudes.size))
    alphas = TRUTH["alpha"] * np.exp(TRUTH["alpha_sd"] * drawn)

    def one(alpha, a, t):
        return rk.outcome(rk.Block(alpha, P), rk.SinePulse(a, t)).overturned

    many = jax.jit(jax.vmap(jax.vmap(one), in_axes=(0, None, None)))
    return np.asarray(many(alphas, amplitudes, periods))


def calibrated(suite, toppled, unknowns=UNKNOWNS, make=lambda alpha: rk.Block(alpha, P), cells=64):
    """The fit to one list of verdicts."""
    return rk.inverse.calibrate_block(make, suite, toppled, unknowns, SCATTER, cells=cells, progress=False)


def coverage(tests, repetitions):
    """Share of 95 % intervals that hold the truth, by name; bias in standard errors; how many fits failed; seconds."""
    amplitudes, periods = pulses(tests)
    suite, fell = rk.motions.Suite([rk.SinePulse(amplitudes, periods)]), verdicts(amplitudes, periods, repetitions)
    calibrated(suite, fell[0])
    begin, off, failed = (time.process_time(), time.perf_counter()), [], 0
    for toppled in fell:
        found = calibrated(suite, toppled)
        if found.status != rk.inverse.CalibrationStatus.successful:
            failed += 1
            continue
        errors = found.standard_errors
        off.append([np.log(float(found.values[n]) / TRUTH[n]) / float(errors[n]) for n in TRUTH])
    took = time.process_time() - begin[0], time.perf_counter() - begin[1]
    off = np.array(off)
    return (np.abs(off) < 1.96).mean(axis=0), off.mean(axis=0), failed, np.array(took) / repetitions


def made_records(count, samples=500, seed=4):
    """Records that are made: noise of an earthquake's spectrum and duration."""
    random, dt = np.random.default_rng(seed), 0.02
    time_, frequency = dt * np.arange(samples), np.fft.rfftfreq(samples, dt)
    found = []
    for number in range(count):
        corner = random.uniform(0.15, 0.8)
        noise = np.fft.rfft(random.normal(size=samples) * (time_ / 2) ** 2 * np.exp(2 - time_))
        shape = frequency**2 / (frequency**2 + corner**2) / np.hypot(1, (frequency / 8) ** 2) * (frequency > 0.1)
        ground = np.fft.irfft(shape * noise, samples)
        ground *= random.uniform(0.2, 1.0) / np.abs(ground).max() * np.hanning(samples) ** 0.1
        found.append(rk.Record(ground, dt, f"made {number}"))
    return found


def verdicts_of_records(suite):
    """(tests,) who toppled."""
    alphas = TRUTH["alpha"] * np.exp(TRUTH["alpha_sd"] * np.random.default_rng(6).normal(size=len(suite)))
    grounds = np.stack([np.asarray(each.samples) for each in suite.motions()])

    def one(alpha, ground):
        return rk.outcome(rk.Block(alpha, P), rk.Record(ground, 0.02)).overturned

    return np.asarray(jax.jit(jax.vmap(one))(alphas, grounds))


def cost(count=500):
    """Rows of a table: what is calibrated, scenes, first call and again, in processor and wall seconds."""
    amplitudes, periods = pulses(count)
    by_pulse = rk.motions.Suite([rk.SinePulse(amplitudes, periods)])
    by_record = rk.motions.Suite(made_records(count))
    two = UNKNOWNS | {"p": rk.inverse.Unknown(1.5, 6.0)}
    cases = {
        "alpha and its scatter, pulses": (by_pulse, UNKNOWNS, lambda alpha: rk.Block(alpha, P), 64),
        "alpha and its scatter, records of 500 samples": (by_record, UNKNOWNS, lambda alpha: rk.Block(alpha, P), 64),
        "alpha, its scatter and p, pulses": (by_pulse, two, rk.Block, {"alpha": 64, "p": 16}),
    }
    for name, (suite, unknowns, make, cells) in cases.items():
        fell = verdicts(amplitudes, periods, 1)[0] if suite is by_pulse else verdicts_of_records(suite)
        times = []
        for _ in range(2):
            begin = time.process_time(), time.perf_counter()
            found = calibrated(suite, fell, unknowns, make, cells)
            times += [time.process_time() - begin[0], time.perf_counter() - begin[1]]
        scenes = count * (64 if isinstance(cells, int) else int(np.prod(list(cells.values()))))
        values = ", ".join(f"{n} {float(v):.3f}" for n, v in found.values.items())
        yield f"| {name} | {scenes:,} | " + " | ".join(f"{t:.1f}" for t in times) + f" | {values} |"


HEAD = """# Blocks calibrated from verdicts

Written by `python benchmarks/calibration.py --repetitions {repetitions}`, on {cores} cores that other work shared.

Share of 95 % intervals (estimate, and 1.96 standard errors of its logarithm) that hold the truth, in {repetitions}
repetitions of made verdicts: slenderness lognormal with median {alpha} and deviation {alpha_sd}, drawn anew for every
test, under sine pulses. Errors: the mean of estimate less truth, in standard errors. Seconds are those of one fit.

| tests | holds the median | holds the deviation | errors | without a fit | processor [s] | wall [s] |
|---|---|---|---|---|---|---|
"""
COST = """
One calibration from 500 tests, the first call of a session and again, in seconds:

| what | scenes | first, processor | wall | again, processor | wall | found |
|---|---|---|---|---|---|---|
"""


def main():
    """Print the rows, and write the file."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--repetitions", type=int, default=400)
    repetitions = parser.parse_args().repetitions
    text = HEAD.format(repetitions=repetitions, cores=os.cpu_count(), **TRUTH)
    for tests in (200, 500):
        inside, bias, failed, took = coverage(tests, repetitions)
        shares = " | ".join(f"{100 * x:.1f} %" for x in inside)
        row = f"| {tests} | {shares} | {bias[0]:+.2f}, {bias[1]:+.2f} | {failed} | {took[0]:.2f} | {took[1]:.2f} |"
        print(row, flush=True)
        text += row + "\n"
    text += COST
    for row in cost():
        print(row, flush=True)
        text += row + "\n"
    (Path(__file__).parent / "calibration.md").write_text(text)


if __name__ == "__main__":
    main()
