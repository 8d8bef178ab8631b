"""Error against time of every way to solve a rocking block: `python benchmarks/work_precision.py`.

The series engine at several orders, the diffrax engine with explicit and implicit solvers, and the usual SciPy loop
(`peers_solvers/scipy_loop.py`) on four problems; errors are against 40-digit Taylor series (`references/taylor.py`).
Writes the table `work_precision.md`, the picture `work_precision.png` and the numbers `work_precision.json` beside
this file. `work_precision.py draw` makes table and picture again from the numbers; `work_precision.py record batch`
measures these two again and keeps the others.
"""

import functools
import json
import math
import pathlib
import sys
import time

import diffrax
import jax
import numpy as np
from common import least_time, seconds, table
from mpmath import mp, mpf
from peers_solvers import scipy_loop

import jaxrock as rk
from references import responses
from references.in_jaxrock import MODELS, PULSES

HERE = pathlib.Path(__file__).resolve().parent
NUMBERS = HERE / "work_precision.json"
SEED, SCENES, LANES = 20261121, 5, 1000
PATIENCE, MOST_REPEATS = 0.3, 30  # seconds to repeat a measurement of one scene, and how often at most
SIZE = (1.0, 5.0)  # block under the record: width x height [m]
# A block chatters to rest under the first half of a slow pulse, and uplifts again: alpha, restitution, amplitude over
# the threshold, pulse frequency over p.
CHATTERING = ((0.1, 0.8, 1.0143, 0.75), (0.2, 0.85, 1.03, 0.5), (0.2, 0.8, 1.05, 0.6), (0.2, 0.7, 1.05, 0.4))
PROBLEMS = {
    "sine": "Sine pulses, nonlinear",
    "exponential": "Exponential pulses, linear",
    "record": "A record of 5,690 samples, nonlinear",
    "chattering": "Chattering to rest and uplift again, nonlinear",
}
SOLVERS = {
    "Tsit5": (diffrax.Tsit5, (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)),
    "Dopri5": (diffrax.Dopri5, (1e-4, 1e-8, 1e-12)),
    "Dopri8": (diffrax.Dopri8, (1e-4, 1e-8, 1e-12)),
    "Kvaerno5": (diffrax.Kvaerno5, (1e-4, 1e-8, 1e-12)),
}
ORDERS = ((4, 1e-4), (8, 1e-8), (12, 1e-12), (16, None), (20, None))
PEER_TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)


# Problems: scenes as the reference takes them


def safe_ones(draw, impacts):
    """The first few random scenes that lean out to a fifth of alpha and more, and come back; with their references."""
    random, scenes, answers = np.random.default_rng(SEED), [], []
    while len(scenes) < SCENES:
        scene = draw(random)
        known = responses.answer(scene)
        if known["peak"] and float(known["peak"]) > scene[0][0] / 5 and known["impacts"] >= impacts:
            scenes.append(scene)
            answers.append(known)
    return scenes, answers


def sine_scene(random):
    """A sine pulse on a nonlinear block, as in a map."""
    alpha, restitution = random.uniform(0.1, 0.4), random.uniform(0.7, 0.95)
    amplitude, ratio = math.tan(alpha) * random.uniform(1.05, 6.0), random.uniform(1.0, 6.0)
    return (alpha, 1.0, restitution), "sine", (amplitude, 2 * math.pi / ratio), {"model": "nonlinear"}


def exponential_scene(random):
    """An exponential pulse on a linear block."""
    alpha, restitution = random.uniform(0.1, 0.4), random.uniform(0.7, 0.95)
    numbers = alpha * random.uniform(1.05, 3.0), random.uniform(1.0, 4.0), random.uniform(-6.0, 6.0)
    return (alpha, 1.0, restitution), "exponential", numbers, {"model": "linear"}


def problem(name):
    """Scenes of a problem and their references."""
    if name == "sine":
        return safe_ones(sine_scene, 1)
    if name == "exponential":
        return safe_ones(exponential_scene, 0)
    if name == "record":
        block, record = rk.Block.from_dimensions(*SIZE), rk.example_record()
        numbers = tuple(float(x) for x in (block.alpha, block.p, block.restitution))
        scenes = [(numbers, "record", (np.asarray(record.samples), float(record.dt)))]
        return scenes, responses.kept(scenes)
    scenes = [
        ((alpha, 1.0, e), "sine", (a * math.tan(alpha), 2 * math.pi / ratio)) for alpha, e, a, ratio in CHATTERING
    ]
    return scenes, responses.answers(scenes)


# Measuring


def error_of(peak, scene, answer):
    """|peak - reference|/alpha; infinite for a block that overturns, which none of the references does."""
    if not math.isfinite(peak):
        return math.inf
    with mp.workdps(30):
        return float(abs(mpf(float(peak)) - mpf(answer["peak"]))) / scene[0][0]


def measured(label, setting, scenes, answers, solve):
    """One point: `solve(scene)` gives a function to call; it returns the peak [rad], or None where it is refused."""
    times, errors, refused = [], [], 0
    start = time.perf_counter()
    first = solve(scenes[0])()
    compiling = time.perf_counter() - start
    for k, (scene, answer) in enumerate(zip(scenes, answers)):
        run = solve(scene)
        peak = run() if k else first
        times.append(least_time(run, MOST_REPEATS, PATIENCE))
        if peak is None:
            refused += 1
        else:
            errors.append(error_of(peak, scene, answer))
    point = {
        "label": label,
        "setting": setting,
        "time": sum(times) / len(times),
        "error": max(errors) if errors else None,
        "refused": refused,
        "scenes": len(scenes),
        "first": compiling,
    }
    shown = "all refused" if not errors else f"error {point['error']:.1e}, refused {refused} of {len(scenes)}"
    print(f"{label} {setting}: {seconds(point['time'])}, {shown}; first call {seconds(compiling)}", flush=True)
    return point


# jaxrock


@functools.cache
def compiled(model, engine):
    """The compiled outcome of one scene by an engine."""
    return jax.jit(lambda block, moving: rk.outcome(block, moving, MODELS[model], engine=engine))


def by_engine(engine):
    """How `measured` is to solve a scene with an engine of jaxrock."""

    def solve(scene):
        block, kind, numbers, *options = scene
        run = compiled(options[0]["model"] if options else "nonlinear", engine)
        moving = rk.Record(*numbers) if kind == "record" else PULSES[kind](*numbers)
        given = jax.tree.map(jax.numpy.asarray, (rk.Block(*block), moving))

        def once():
            found = jax.block_until_ready(run(*given))
            return float(found.max_rotation) if found.status == rk.Status.successful else None

        return once

    return solve


def engines():
    """Label, setting and engine of every curve of jaxrock."""
    for order, tolerance in ORDERS:
        yield "series", f"order {order}, {tolerance or 2**-53:.0e}", rk.Series(order=order, tolerance=tolerance)
    for name, (solver, tolerances) in SOLVERS.items():
        for rtol in tolerances:
            yield f"diffrax {name}", f"rtol {rtol:.0e}", rk.Diffrax(solver=solver(), rtol=rtol)


# The SciPy loop


def by_scipy(method, rtol):
    """How `measured` is to solve a scene with SciPy's `method` from event to event."""
    settings = scipy_loop.settings_of(rtol, 1e-2 * rtol, method)

    def solve(scene):
        (alpha, p, restitution), kind, numbers, *_ = scene
        if kind == "record":
            moving = scipy_loop.Record(numbers[0].tolist(), numbers[1])
        elif kind == "exponential":
            moving = scipy_loop.Exponential(numbers[0], 2 * math.pi / numbers[1], numbers[2])
        else:
            moving = scipy_loop.Sine(numbers[0], 2 * math.pi / numbers[1])
        return lambda: alpha * scipy_loop.follow(alpha, p, restitution, moving, kind == "exponential", settings)

    return solve


# Running


def measure(name):
    """All points of a problem."""
    scenes, answers = problem(name)
    print(f"{PROBLEMS[name]}: {len(scenes)} scenes", flush=True)
    points = [measured(label, setting, scenes, answers, by_engine(engine)) for label, setting, engine in engines()]
    for method in ("DOP853", "RK45"):
        for rtol in PEER_TOLERANCES if name != "record" else PEER_TOLERANCES[::2]:
            label = f"SciPy {method}"
            points.append(measured(label, f"rtol {rtol:.0e}", scenes, answers, by_scipy(method, rtol)))
    return points


def measure_batch():
    """Sine pulses in one batch: compile times [s] and times a response [s] of both engines."""
    random = np.random.default_rng(SEED)
    amplitude, ratio = math.tan(0.2) * random.uniform(1.05, 10, LANES), random.uniform(0.3, 8.0, LANES)
    given = jax.numpy.asarray(amplitude), jax.numpy.asarray(2 * np.pi / ratio)
    rows = []
    for label, engine in (("Series()", rk.Series()), ("Diffrax(rtol=1e-8)", rk.Diffrax(rtol=1e-8))):

        def one(amplitude, period, engine=engine):
            return rk.outcome(rk.Block(0.2, 1.0, 0.9), rk.SinePulse(amplitude, period), engine=engine)

        row = {"label": label}
        for kind, function, arguments in (
            ("one", one, [x[0] for x in given]),
            ("batch", jax.vmap(one), given),
        ):
            start = time.perf_counter()
            run = jax.jit(function).lower(*arguments).compile()
            row[f"{kind} compile"] = time.perf_counter() - start
            row[kind] = least_time(lambda: jax.block_until_ready(run(*arguments)), MOST_REPEATS, PATIENCE)  # noqa: B023
        row["refused"] = int((np.asarray(run(*arguments).status != rk.Status.successful)).sum())
        rows.append(row)
        print(row, flush=True)
    return rows


# Report


STYLES = {  # colours of Okabe and Ito; every curve has its own marker too
    "series": ("#000000", "o", "-"),
    "diffrax Tsit5": ("#0072B2", "s", "-"),
    "diffrax Dopri5": ("#56B4E9", "^", "--"),
    "diffrax Dopri8": ("#009E73", "D", "-"),
    "diffrax Kvaerno5": ("#CC79A7", "v", "--"),
    "SciPy DOP853": ("#D55E00", "P", "-"),
    "SciPy RK45": ("#E69F00", "X", "--"),
}
FLOOR = 1e-17  # where an error of zero is drawn


def picture(results):
    """The four panels."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import NullFormatter

    figure, panels = plt.subplots(2, 2, figsize=(11, 9), sharex=True, layout="constrained")
    for panel, (name, title) in zip(panels.ravel(), PROBLEMS.items()):
        for label, (colour, marker, line) in STYLES.items():
            points = [x for x in results[name] if x["label"] == label and x["error"] is not None]
            x, y = [max(point["error"], FLOOR) for point in points], [point["time"] for point in points]
            panel.plot(x, y, line, color=colour, marker=marker, markersize=7, linewidth=1.5, label=label)
            some = [k for k, point in enumerate(points) if point["refused"]]
            panel.plot([x[k] for k in some], [y[k] for k in some], marker, color="white", markeredgecolor=colour,
                       markersize=7, markeredgewidth=1.5, linestyle="")  # fmt: skip
        silent = [f"{x['label'].split()[-1]} {x['setting']}" for x in results[name] if x["error"] is None]
        if silent:
            panel.text(0.02, 0.02, "refused altogether:\n" + "\n".join(silent), transform=panel.transAxes, fontsize=8)
        for point in results[name]:
            if point["label"] == "series" and point["error"] is not None:
                order = int(point["setting"].split()[1].rstrip(","))
                at, where = (max(point["error"], FLOOR), point["time"]), {12: (-8, 6), 20: (8, 6)}.get(order, (0, -14))
                panel.annotate(str(order), at, where, textcoords="offset points", ha="center", fontsize=8)
        times = [point["time"] for point in results[name] if point["error"] is not None]
        panel.set(xscale="log", yscale="log", title=title, ylim=(min(times) / 2.0, max(times) * 1.5))
        panel.yaxis.set_minor_formatter(NullFormatter())
        panel.grid(True, which="major", color="0.85")
        panel.set_axisbelow(True)
    for panel in panels[1]:
        panel.set_xlabel("largest error of peak/α")
    for panel in panels[:, 0]:
        panel.set_ylabel("time of one response [s]")
    panels[0, 0].invert_xaxis()
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    figure.savefig(HERE / "work_precision.png", dpi=110)


def batch_text(rows):
    """The batch as a table and its two figures of merit."""
    lines = [
        [f"`{x['label']}`", seconds(x["one"]), seconds(x["batch"] / LANES), seconds(x["one compile"]),
         seconds(x["batch compile"]), str(x["refused"])]
        for x in rows
    ]  # fmt: skip
    header = ["engine", "one response", f"a response of {LANES:,}", "compiling one", "compiling the batch", "refused"]
    ratio = rows[1]["batch"] / rows[0]["batch"]
    return table(header, lines) + f"\n\nIn a batch the diffrax engine takes {ratio:.1f} times as long as the series."


def report(results):
    """Write the table and the picture."""
    parts = []
    for name, title in PROBLEMS.items():
        rows = [
            [x["label"], x["setting"], "-" if x["error"] is None else f"{x['error']:.1e}",
             f"{x['refused']} of {x['scenes']}", seconds(x["time"])]
            for x in results[name]
        ]  # fmt: skip
        header = ["solver", "setting", "largest error of peak/alpha", "refused", "time of one response"]
        parts.append(f"## {title}\n\n{table(header, rows)}\n")
    text = f"""# Error against time

Written by `python benchmarks/work_precision.py`.

![Error against time](work_precision.png)

Errors are the largest over the scenes of a problem, against 40-digit Taylor series; times are the mean over the scenes
of the least of several runs of one compiled response, float64. What an engine refuses (a status other than successful)
counts neither as an error nor as an answer; hollow marks in the picture are points with refusals, the small numbers are
orders of the series. The SciPy loop never refuses; its record is cut at the samples, its absolute tolerance is a
hundredth of the relative one.{chr(10) + results["note"] if "note" in results else ""}

## Sine pulses in a batch

{LANES:,} sine pulses, 1.05 to 10 times the threshold, frequency/p from 0.3 to 8, alpha 0.2, restitution 0.9; verdicts
of both kinds.

{batch_text(results["batch"])}

{chr(10).join(parts)}"""
    (HERE / "work_precision.md").write_text(text)
    picture(results)
    print(text)


def main():
    """Measure what is asked for, or all; write the report."""
    results = json.loads(NUMBERS.read_text()) if NUMBERS.exists() else {}
    if not sys.argv[1:]:
        results = {}
    for name in sys.argv[1:] or [*PROBLEMS, "batch"]:
        if name != "draw":
            results[name] = measure_batch() if name == "batch" else measure(name)
            NUMBERS.write_text(json.dumps(results, indent=1))
    report(results)


if __name__ == "__main__":
    main()
