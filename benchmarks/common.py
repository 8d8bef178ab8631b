"""What the benchmarks share: where `references` is found, double precision on the CPU, times and tables."""

import math
import pathlib
import sys
import time

import jax

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent.parent))
jax.config.update("jax_platforms", "cpu")
jax.config.update("jax_enable_x64", True)


def least_time(function, most, patience=math.inf):
    """Least time of several calls [s]: two at least, `most` at most, no new one after `patience` seconds."""
    best, spent, count = math.inf, 0.0, 0
    while count < 2 or (spent < patience and count < most):
        start = time.perf_counter()
        function()
        taken = time.perf_counter() - start
        best, spent, count = min(best, taken), spent + taken, count + 1
    return best


def seconds(value):
    """A duration as text."""
    for size, unit in ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs")):
        if value >= size:
            return f"{value / size:.3g} {unit}"
    return f"{value * 1e9:.3g} ns"


def table(header, rows):
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
