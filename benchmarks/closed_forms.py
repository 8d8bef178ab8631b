"""Closed forms: error, and time of a million points: `python benchmarks/closed_forms.py` writes `closed_forms.md`."""

import os
import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import mpmath as mp  # noqa: E402
import numpy as np  # noqa: E402

from jaxrock.closed_form import sine_pulse, single_lobe  # noqa: E402

POINTS, JUDGED = 1_000_000, 300


def wall(duration, shape):
    """Voyagaki et al. (2012), equation 3.12 as printed, with digits to spare."""
    f, b = mp.mpf(duration), mp.mpf(shape)
    power = 2 * b / (f - 2 * b)
    return (1 - (mp.exp(f) * (f + 2 * b) / (2 * f * mp.exp(f / 2 + b) - (f - 2 * b))) ** power) / (1 - mp.exp(b))


def no_impact(ratio, found):
    """Root of Dimitrakopoulos & DeJong (2012), equation 3.10, from the value that is judged."""
    w = mp.mpf(ratio)
    return mp.findroot(lambda a: mp.sqrt(a**2 - 1) - a * mp.exp(-(2 * mp.pi - mp.asin(1 / a)) / w) - w, mp.mpf(found))


def seconds(function, *values):
    """Best of five, compiled before."""
    jax.block_until_ready(function(*values))
    times = []
    for _ in range(5):
        start = time.perf_counter()
        jax.block_until_ready(function(*values))
        times.append(time.perf_counter() - start)
    return min(times)


def main():
    """Write the table beside this script."""
    mp.mp.dps = 120
    rng = np.random.default_rng(0)
    duration, shape = 0.05 * 400 ** rng.uniform(0, 1, POINTS), rng.uniform(-100, 100, POINTS)
    bound = np.asarray(single_lobe.safety_wall(duration, shape))
    strength = bound + (1 - bound) * rng.uniform(0.01, 1, POINTS)
    ratio, restitution = rng.uniform(0.25, 8, POINTS), rng.uniform(0.8, 1, POINTS)
    limit = np.asarray(sine_pulse.no_impact_limit(ratio))
    off_wall = max(abs(float(bound[i] / wall(duration[i], shape[i]) - 1)) for i in range(JUDGED))
    off_limit = max(abs(float(limit[i] / no_impact(ratio[i], limit[i]) - 1)) for i in range(JUDGED))
    rows = [
        ("`single_lobe.safety_wall`", seconds(single_lobe.safety_wall, duration, shape), f"{off_wall:.0e}"),
        ("`single_lobe.peak_rotation`", seconds(single_lobe.peak_rotation, strength, duration, shape), "tests: 1e-13"),
        ("`sine_pulse.no_impact_limit`", seconds(sine_pulse.no_impact_limit, ratio), f"{off_limit:.0e}"),
        ("`sine_pulse.after_pulse_limits`", seconds(sine_pulse.after_pulse_limits, ratio, restitution), "tests: 1e-13"),
    ]
    text = f"""# Closed forms

Written by `python benchmarks/closed_forms.py`: {POINTS:,} random points, float64, {os.cpu_count()} cores, best of five;
durations 0.05 to 20, shapes -100 to 100, frequency ratios 0.25 to 8. Errors: worst relative one of {JUDGED} points
against the printed equation in 120 digits.

| function | time of all | error |
| --- | --- | --- |
"""
    text += "".join(f"| {name} | {spent:.3f} s | {error} |\n" for name, spent, error in rows)
    Path(__file__).with_suffix(".md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
