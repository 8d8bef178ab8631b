"""Closed forms: error, first answers, and time of many points: `python benchmarks/closed_forms.py` writes a table.

What stands below the table in `closed_forms.md` is kept. With `-` it is only shown, so that another copy of the package
can be measured: `PYTHONPATH=folder python benchmarks/closed_forms.py -`.
"""

import functools
import os
import sys
import time
from pathlib import Path

os.environ["JAXROCK_CACHE"] = "off"  # first answers are those of a first session

import jax  # noqa: E402

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


def gradient(function, *values):
    """By all arguments, of every point."""
    return jax.jit(jax.vmap(jax.grad(lambda x: function(*x))))(tuple(map(jax.numpy.asarray, values)))


def row(name, function, *values, error):
    """Processor seconds of the first answers, of one point and of its gradient, and the best of five of all."""
    firsts = []
    for of in (function, functools.partial(gradient, function)):
        start = time.process_time()
        jax.block_until_ready(of(*(x[:1] for x in values)))
        firsts.append(time.process_time() - start)
    times = []
    for _ in range(6):  # the first compiles
        start = time.perf_counter()
        jax.block_until_ready(function(*values))
        times.append(time.perf_counter() - start)
    print(end=".", flush=True)
    return f"| `{name}` | {firsts[0]:.2f} | {firsts[1]:.2f} | {values[0].size:,} | {min(times):.3f} | {error} |\n"


def main():
    """Write the table beside this script."""
    mp.mp.dps = 120
    rng = np.random.default_rng(0)
    duration, shape = 0.05 * 400 ** rng.uniform(0, 1, POINTS), rng.uniform(-100, 100, POINTS)
    share, time_at = rng.uniform(0.01, 1, POINTS), rng.uniform(0, 1, POINTS)
    ratio, restitution = rng.uniform(0.25, 8, POINTS), rng.uniform(0.8, 1, POINTS)
    few = slice(POINTS // 100)
    text = row("sine_pulse.no_impact_limit", sine_pulse.no_impact_limit, ratio, error="{limit}")
    text = row("single_lobe.safety_wall", single_lobe.safety_wall, duration, shape, error="{wall}") + text
    bound, limit = np.asarray(single_lobe.safety_wall(duration, shape)), np.asarray(sine_pulse.no_impact_limit(ratio))
    strength, intensity = bound + (1 - bound) * share, 1 + (limit - 1) * share
    text += row("single_lobe.peak_rotation", single_lobe.peak_rotation, strength, duration, shape, error="1e-13, tests")
    text += row("single_lobe.rotation", single_lobe.rotation, time_at, strength, duration, shape, error="1e-12, tests")
    text += row("sine_pulse.impact_time", sine_pulse.impact_time, intensity, ratio, error="1e-12, tests")
    given = 10 * time_at, intensity, ratio, restitution
    text += row("sine_pulse.rotation", sine_pulse.rotation, *given, error="1e-11, tests")
    given = ratio[few], restitution[few]
    text += row("sine_pulse.during_pulse_limit", sine_pulse.during_pulse_limit, *given, error="1e-13, tests")
    off_wall = max(abs(float(bound[i] / wall(duration[i], shape[i]) - 1)) for i in range(JUDGED))
    off_limit = max(abs(float(limit[i] / no_impact(ratio[i], limit[i]) - 1)) for i in range(JUDGED))
    spent = []
    for _ in range(2):
        start = time.process_time()
        sine_pulse.overturning_intervals(0.5, 0.9)
        spent.append(time.process_time() - start)
    text = f"""# Closed forms

Written by `python benchmarks/closed_forms.py`: random points, float64, {os.cpu_count()} cores, nothing kept;
durations 0.05 to 20, shapes -100 to 100, frequency ratios 0.25 to 8. Errors: worst relative one of {JUDGED} points
against the printed equation in 120 digits, or what the tests allow.

| function | first answer [processor s] | first gradient | points | best of five [s] | error |
| --- | --- | --- | --- | --- | --- |
{text.format(wall=f"{off_wall:.0e}", limit=f"{off_limit:.0e}")}
`sine_pulse.overturning_intervals(0.5, 0.9)` took {spent[0]:.2f} s of processor time, and {spent[1]:.2f} s again.
"""
    print("\n" + text)
    if "-" not in sys.argv[1:]:
        Path(__file__).with_suffix(".md").write_text(text)


if __name__ == "__main__":
    main()
