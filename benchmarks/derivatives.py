"""Derivatives: error and cost. `python benchmarks/derivatives.py` writes `derivatives.md`.

Errors: against 40-digit differences (`references/derivatives.py`). Costs: times the value alone, both compiled, on one
core, best of several. Takes some ten minutes, most of them compiling.
"""

import functools
import json
import os
import time
from pathlib import Path

if hasattr(os, "sched_setaffinity"):  # before JAX counts cores
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

import common  # noqa: F401, the search path and double precision
import jax
import jax.numpy as jnp
import numpy as np

import jaxrock as rk
from references.in_jaxrock import MODELS, PULSES

HERE = Path(__file__).parent
SCENES = json.loads((HERE.parent / "references" / "derivatives.json").read_text())["scenes"]
KINDS = ("sine", "exponential", "half sine", "cosine", "triangle", "ricker symmetric", "record")
LANES, POINTS = 64, 4096


def peak(kind, model, x):
    """Peak rotation from alpha, p, restitution and the motion's parameters."""
    motion = x[3] * rk.example_record() if kind == "record" else PULSES[kind](*[x[k] for k in range(3, x.size)])
    return rk.outcome(rk.Block(x[0], x[1], x[2]), motion, MODELS[model]).max_rotation


def errors(derivative, key, motions=KINDS):
    """Relative errors of all scenes of each kind: rows of (kind, model, scenes, median, worst)."""
    for kind in motions:
        for model in MODELS:
            rows = [r for r in SCENES if (r["kind"], r["model"]) == (kind, model) and key(r) is not None]
            if not rows:
                continue
            x = np.array([r["block"] + r["motion"] for r in rows])
            task = derivative(functools.partial(peak, kind, model))
            found = np.asarray(jax.jit(lambda x, task=task: jax.lax.map(task, x))(jnp.array(x)))
            exact = np.array([np.array(key(r), float) for r in rows])
            weight = x if exact.ndim == 2 else x[:, :, None] * x[:, None, :]
            axes = tuple(range(1, exact.ndim))
            sizes = np.abs(exact * weight)
            scale = np.maximum(sizes, 1e-3 * sizes.max(axis=axes, keepdims=True))
            worst = (np.abs(found - exact) * np.abs(weight) / scale).max(axis=axes)
            yield f"| {kind}, {model} | {len(rows)} | {np.median(worst):.0e} | {worst.max():.0e} |"


def seconds(function, *arguments, repeats=10):
    """Best of several, compiled before; and the time of the first call."""
    start = time.perf_counter()
    jax.block_until_ready(function(*arguments))
    first, best = time.perf_counter() - start, np.inf
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        best = min(best, time.perf_counter() - start)
    return best, first


def map_costs():
    """Value, gradient and Hessian of 4,096 nonlinear blocks under sine pulses, in chunks as surfaces are computed."""
    rng = np.random.default_rng(0)
    low, high = [0.1, 1.0, 0.85, 1.1, 0.5], [0.3, 3.0, 0.95, 4.0, 2.0]
    x = rng.uniform(low, high, (POINTS, 5))
    x[:, 3] *= np.tan(x[:, 0])
    x = x[np.argsort(x[:, 3])]
    value = functools.partial(peak, "sine", "nonlinear")

    def some(count):
        return lambda q: jax.value_and_grad(lambda part: value(jnp.concatenate([part, q[count:]])))(q[:count])

    tasks = {"value": value, "value and 1 derivative": some(1), "value and 3 derivatives": some(3)}
    tasks["value and 5 derivatives"] = some(5)
    alone = None
    for name, task in tasks.items():
        chunks = x.reshape(-1, LANES, 5)
        run = jax.jit(lambda chunks, task=task: jax.lax.map(jax.vmap(task), chunks))
        best, first = seconds(run, chunks)
        alone = alone or best
        yield f"| {name}, in chunks | {best / POINTS * 1e6:.1f} µs | {best / alone:.1f} | {first:.0f} s |"
    # A Hessian of a batch compiles for many minutes: one scene after the other.
    alone = None
    for name, task in (("value", value), ("Hessian of 5", jax.hessian(value))):
        best, first = seconds(jax.jit(lambda x, task=task: jax.lax.map(task, x)), x[:: POINTS // 256])
        alone = alone or best
        yield f"| {name}, one by one | {best / 256 * 1e6:.0f} µs | {best / alone:.1f} | {first:.0f} s |"


def many_numbers():
    """Value and gradient of 1,024 blocks under sums of pulses of four parameters, by all of these."""
    rng = np.random.default_rng(0)
    for pulses in (1, 2, 3, 5):
        x = np.array([0.2, 1.5, 0.9] + pulses * [0.2, 1.0, 2.0, 0.3]) * (
            1 + 0.02 * rng.uniform(-1, 1, (1024, 3 + 4 * pulses))
        )

        def of(x, pulses=pulses):
            motion = sum(
                (rk.MavroeidisPapageorgiouPulse(*x[k : k + 4]) for k in range(7, 3 + 4 * pulses, 4)),
                rk.MavroeidisPapageorgiouPulse(*x[3:7]),
            )
            return rk.outcome(rk.Block(*x[:3]), motion).max_rotation

        value, _ = seconds(jax.jit(jax.vmap(of)), x)
        both, first = seconds(jax.jit(jax.vmap(jax.value_and_grad(of))), x)
        count = x.shape[1]
        row = f"{value / 1024 * 1e6:.1f} µs | {both / 1024 * 1e6:.1f} µs | {both / value:.1f} | {first:.0f} s |"
        yield f"| {count} | {row}"


def record_costs():
    """All 5,690 samples of the record in reverse, for three blocks."""
    record = rk.example_record()

    def of(samples, block):
        return rk.outcome(rk.Block(*block), rk.Record(samples, record.dt)).max_rotation

    gradient = jax.jit(jax.value_and_grad(of))
    for block, factor in (((0.2, 1.5, 0.92), 1.5), ((0.15, 2.0, 0.9), 0.7), ((0.25, 2.5, 0.9), 2.0)):
        samples = factor * record.samples
        value, _ = seconds(jax.jit(of), samples, jnp.array(block))
        both, first = seconds(gradient, samples, jnp.array(block))
        memory = gradient.lower(samples, jnp.array(block)).compile().memory_analysis().temp_size_in_bytes / 1e6
        impacts = int(rk.outcome(rk.Block(*block), factor * record).impact_count)
        row = f"{value * 1e3:.1f} ms | {both * 1e3:.1f} ms | {both / value:.1f} | {memory:.0f} MB | {first:.0f} s |"
        yield f"| {block}, {factor} | {impacts} | {row}"


def main():
    """Measure and write."""
    lines = [
        "# Derivatives: error and cost",
        "",
        "Written by `python benchmarks/derivatives.py`; float64, one core. Errors of derivatives of the peak rotation",
        "by all parameters of a scene, relative to each derivative (or to a thousandth of the largest elasticity),",
        "worst of a scene: median and worst over the scenes. Judge: differences in 40 digits.",
        "",
        "| first derivatives | scenes | median | worst |",
        "| --- | --- | --- | --- |",
        *errors(jax.jacfwd, lambda r: r["max_rotation"]["gradient"]),
        "",
        "| second derivatives | scenes | median | worst |",
        "| --- | --- | --- | --- |",
        *errors(jax.hessian, lambda r: r.get("hessian"), ("sine",)),
        "",
        f"{POINTS:,} nonlinear blocks under sine pulses, intensities 1.1 to 4:",
        "",
        "| task | a response | times the value | first call |",
        "| --- | --- | --- | --- |",
        *map_costs(),
        "",
        "1,024 nonlinear blocks under sums of pulses, value and all derivatives; by more than eight numbers a few",
        "directions at a time:",
        "",
        "| numbers | value | value and gradient | times | first call |",
        "| --- | --- | --- | --- | --- |",
        *many_numbers(),
        "",
        "Peak rotation by every one of 5,690 samples of the record, in reverse:",
        "",
        "| block (alpha, p, e), factor | impacts | value | value and gradient | times | memory | first call |",
        "| --- | --- | --- | --- | --- | --- | --- |",
        *record_costs(),
    ]
    (HERE / "derivatives.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
