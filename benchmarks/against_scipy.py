"""jaxrock against the usual SciPy loop, both judged by 40-digit Taylor series: `python benchmarks/against_scipy.py`.

Prints a report and writes it to `against_scipy.md` beside this file. The peer is `scipy_peer.py`; the reference is
`reference_taylor.py`, whose answers are cached (without the cache this takes minutes more).
"""

import datetime
import importlib.metadata
import math
import pathlib
import platform
import subprocess
import sys
import time

import jax

jax.config.update("jax_platforms", "cpu")
jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402
from mpmath import mp, mpf  # noqa: E402

HERE = pathlib.Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

import reference_taylor  # noqa: E402
import scipy_peer  # noqa: E402

import jaxrock as rk  # noqa: E402

SIZES = ((1.0, 5.0), (0.5, 3.0), (0.8, 5.0))  # blocks under the record: width x height [m]
ALPHA, P, RESTITUTION = 0.2, 1.0, 0.9  # the block of the map
SIDE, POINTS, SEED = 256, 1024, 20261121
REPEATS_JAX, REPEATS_SCIPY = 20, 5


def fastest(function, repeats):
    """Least time of several calls [s], and the last result."""
    best = math.inf
    for _ in range(repeats):
        start = time.perf_counter()
        result = function()
        best = min(best, time.perf_counter() - start)
    return best, result


def seconds(value):
    """A duration as text."""
    for size, unit in ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs")):
        if value >= size:
            return f"{value / size:.3g} {unit}"
    return f"{value * 1e9:.3g} ns"


def error_of(peak, answer):
    """|peak - reference|; None where the reference overturns or the solver says so."""
    if answer["peak"] is None or math.isinf(peak):
        return None
    with mp.workdps(30):
        return float(abs(mpf(float(peak)) - mpf(answer["peak"])))


def table(header, rows):
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def record_rows():
    """Rows of the table of single responses under the record, and the time to the first result [s]."""
    record = rk.example_record()
    samples, dt = np.asarray(record.samples), float(record.dt)
    blocks = [rk.Block.from_dimensions(*size) for size in SIZES]
    numbers = [tuple(float(x) for x in (block.alpha, block.p, block.restitution)) for block in blocks]
    answers = reference_taylor.reference([(block, "record", (samples, dt)) for block in numbers])
    peers = [(True, 1e-6, 1e-8), (False, 1e-10, 1e-12), (False, 1e-6, 1e-8)]
    first, _ = fastest(lambda: jax.block_until_ready(rk.outcome(blocks[0], record)), 1)
    rows = []
    for size, block, (alpha, p, restitution), answer in zip(SIZES, blocks, numbers, answers):
        own, result = fastest(lambda: jax.block_until_ready(rk.outcome(block, record)), REPEATS_JAX)  # noqa: B023
        if result.status != rk.Status.successful:
            raise RuntimeError(f"jaxrock: {rk.Status[result.status]}")
        runs = [("jaxrock", "default", own, float(result.max_rotation), bool(result.overturned))]
        for cut, rtol, atol in peers:
            motion = scipy_peer.Record(samples, dt, cut)
            best, (peak, _, overturned) = fastest(
                lambda: scipy_peer.peak(alpha, p, restitution, motion, rtol, atol),  # noqa: B023
                REPEATS_SCIPY,
            )
            name = "SciPy, cut at samples" if cut else "SciPy, steps ≤ dt"
            runs.append((name, f"{rtol:.0e}/{atol:.0e}", best, peak, overturned))
        for name, tolerance, duration, peak, overturned in runs:
            error = error_of(peak, answer)
            rows.append([
                f"{size[0]} m x {size[1]} m" if name == "jaxrock" else "", name, tolerance,
                "overturned" if overturned else f"{peak / alpha:.6f}",
                "-" if error is None else f"{error / alpha:.1e}",
                "right" if overturned == answer["overturned"] else "WRONG",
                seconds(duration), f"{duration / own:.3g}",
            ])  # fmt: skip
    conditions = ", ".join("-" if a["condition"] is None else f"{a['condition']:.3g}" for a in answers)
    return rows, first, conditions


def grid():
    """Amplitudes [g] and periods [s] of the map, flat; neighbours differ in amplitude."""
    period, amplitude = np.meshgrid(
        2 * math.pi / (P * np.linspace(0.3, 8.0, SIDE)), np.linspace(1.05, 10.0, SIDE) * math.tan(ALPHA), indexing="ij"
    )
    return amplitude.ravel(), period.ravel()


def jaxrock_map():
    """The map by `rk.overturning_map`: time of the first call and of later ones [s], cores busy, peaks, verdicts."""
    ratio, intensity = np.linspace(0.3, 8.0, SIDE), np.linspace(1.05, 10.0, SIDE)

    def surface():
        return rk.overturning_map(ratio, intensity, alpha=ALPHA, restitution=RESTITUTION, progress=False)

    start = time.perf_counter()
    jax.block_until_ready(surface())
    first_time = time.perf_counter() - start
    processor = time.process_time()
    wall = time.perf_counter()
    run_time, result = fastest(lambda: jax.block_until_ready(surface()), REPEATS_JAX)
    cores = (time.process_time() - processor) / (time.perf_counter() - wall)
    if not bool(np.all(result.status == rk.Status.successful)):
        raise RuntimeError("jaxrock: lanes without success")
    # In the order of `grid`: neighbours differ in amplitude.
    peaks, verdicts = np.asarray(result.max_rotation).T.ravel() * ALPHA, np.asarray(result.state).T.ravel() > 0
    return first_time, run_time, cores, peaks, verdicts


def judge(name, tolerance, duration, own, peaks, verdicts, answers):
    """A row of the table of the map, and the indices of its largest errors."""
    errors = [error_of(peak, answer) for peak, answer in zip(peaks, answers)]
    judged = [i for i, error in enumerate(errors) if error is not None]
    scaled = {i: errors[i] / ALPHA for i in judged}
    relative = [errors[i] / float(answers[i]["peak"]) / max(answers[i]["condition"] or math.inf, 1.0) for i in judged]
    wrong = sum(bool(verdict) != answer["overturned"] for verdict, answer in zip(verdicts, answers))
    row = [
        name, tolerance, f"{np.median(list(scaled.values())):.1e}", f"{max(scaled.values()):.1e}",
        f"{max(relative):.1e}", str(wrong), seconds(duration), f"{duration / own:.3g}",
    ]  # fmt: skip
    return row, sorted(judged, key=lambda i: -scaled[i])[:2], scaled


def map_report():
    """Tables of the map, and the facts to state with them."""
    amplitude, period = grid()
    chosen = np.random.default_rng(SEED).choice(amplitude.size, POINTS, replace=False)
    points = [(float(amplitude[i]), float(period[i])) for i in chosen]
    answers = reference_taylor.reference([((ALPHA, P, RESTITUTION), "sine", point) for point in points])
    first_time, run_time, cores, peaks, verdicts = jaxrock_map()
    own = run_time / amplitude.size
    runs = [("jaxrock", "default", own, peaks[chosen], verdicts[chosen])]
    for rtol, atol in ((1e-12, 1e-14), (1e-10, 1e-12), (1e-6, 1e-8)):

        def loop(rtol=rtol, atol=atol):
            motions = [scipy_peer.SinePulse(*point) for point in points]
            return [scipy_peer.peak(ALPHA, P, RESTITUTION, motion, rtol, atol) for motion in motions]

        duration, results = fastest(loop, REPEATS_SCIPY)
        found, _, lost = zip(*results)
        runs.append(("SciPy", f"{rtol:.0e}/{atol:.0e}", duration / POINTS, found, lost))
    rows, worst = [], []
    for name, tolerance, duration, found, lost in runs:
        row, largest, scaled = judge(name, tolerance, duration, own, found, lost, answers)
        rows.append(row)
        for i in largest:
            condition = answers[i]["condition"]
            worst.append([
                name, tolerance, repr(points[i][0]), repr(points[i][1]), f"{float(answers[i]['peak']) / ALPHA:.6f}",
                f"{scaled[i]:.1e}", "infinite" if condition is None else f"{condition:.3g}",
            ])  # fmt: skip
    return rows, worst, first_time, run_time, cores, sum(not a["overturned"] for a in answers)


def surroundings():
    """Date, machine and versions."""
    lines = pathlib.Path("/proc/cpuinfo").read_text().splitlines() if pathlib.Path("/proc/cpuinfo").exists() else []
    facts = dict(line.split(":", 1) for line in lines if ":" in line)
    facts = {name.strip(): value.strip() for name, value in facts.items()}
    model = facts.get("model name", platform.processor())
    family = f" (family {facts['cpu family']}, model {facts['model']})" if "cpu family" in facts else ""
    cores = sum(line.startswith("processor") for line in lines)

    def git(*words):
        return subprocess.run(["git", "-C", str(HERE), *words], capture_output=True, text=True).stdout.strip()

    changed = ", with changes" if git("status", "--porcelain", "--", "../jaxrock") else ""
    names = ("jax", "jaxlib", "equinox", "scipy", "numpy", "mpmath")
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in names)
    return (
        f"{datetime.date.today()}; {model}{family}, {cores} cores; {platform.system()},\n"
        f"Python {platform.python_version()}, {versions};\n"
        f"jaxrock {rk.__version__} ({git('rev-parse', '--short', 'HEAD')}{changed})."
    )


def main():
    """Run both problems; print and write the report."""
    rows, first, conditions = record_rows()
    record_table = table(
        ["block", "solver", "rtol/atol", "peak/alpha", "error of peak/alpha", "verdict", "time", "time/jaxrock"], rows
    )
    rows, worst, first_time, run_time, cores, safe = map_report()
    map_table = table(
        ["solver", "rtol/atol", "error of peak/alpha: median", "max", "max relative error/condition",
         "wrong verdicts", "time a response", "time/jaxrock"], rows,
    )  # fmt: skip
    worst_table = table(
        ["solver", "rtol/atol", "amplitude [g]", "period [s]", "peak/alpha", "error of peak/alpha", "condition"], worst
    )
    text = f"""# jaxrock against a SciPy loop

Written by `python benchmarks/against_scipy.py`.
{surroundings()}

Every peak is over the motion and the free rocking after it. Errors are against 40-digit Taylor series
(`reference_taylor.py`). SciPy is `solve_ivp` with DOP853 from event to event (`scipy_peer.py`). Times are the
least of {REPEATS_JAX} (jaxrock, float64, after compilation) or {REPEATS_SCIPY} (SciPy) runs; both on one core
(jaxrock kept {cores:.2f} cores busy in the map). The condition is |d ln peak/d ln amplitude|.

## One response under the built-in record (5,690 samples)

`rk.outcome(block, rk.example_record())`, Housner's restitution. The first call, with compilation, took
{seconds(first)}. Conditions of the blocks: {conditions}.

{record_table}

"Cut at samples": one `solve_ivp` for each sample while the block rocks; even at this loose tolerance one step a
sample is exact to rounding. "Steps ≤ dt": the usual short cut, where steps run across the kinks of the record.

## A map of {SIDE} x {SIDE} responses to a sine pulse

alpha = {ALPHA}, p = {P:g} rad/s, restitution {RESTITUTION}, amplitude/tan(alpha) from 1.05 to 10, pulse frequency/p
from 0.3 to 8. jaxrock computes all {SIDE**2:,} in {seconds(run_time)} (`rk.overturning_map`);
the first call, with compilation, took {seconds(first_time)}. Errors, and SciPy's times, are over {POINTS:,}
points drawn at random, of which {safe} do not overturn.

{map_table}

The largest errors:

{worst_table}
"""
    (HERE / "against_scipy.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
