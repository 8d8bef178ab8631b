"""jaxrock beside its peers, error against speed, in one run on one machine: `python benchmarks/peers.py`.

    python benchmarks/peers.py [--problems P1 P4 ...] [--peers taylor scipy ...] [--quick] [--repeat 3]

Seven problems (`references/peer_problems.py`), every peer with settings for errors of about 1e-6, 1e-10 and 1e-12 where
it can (of pulses the fastest two also 1e-4), all on all cores, timed after compilation. Errors are against references
of 30 digits (`references/peers.json`). And one block at a time under a record, on one core (`--problems one`).
Writes `peers.md`, `peers.png` and `peers.json` beside this file. `--quick`: fewer scenes, once each; `--draw`: table
and picture again from the numbers; `--keep`: measures some again and keeps the others. A peer that is not installed
is listed as skipped.
"""

import argparse
import importlib
import importlib.util
import json
import pathlib
import subprocess
import sys
import time

import common  # noqa: F401, the search path and double precision
import numpy as np
from peers_solvers import one_block, report

import jaxrock as rk
from references import peer_problems, peers as references

HERE = pathlib.Path(__file__).resolve().parent

# Name on the command line: module, what it needs, name in the tables.
PEERS = {
    "jaxrock": ("jaxrock_api", "jax", "jaxrock"),
    "jaxrock-diffrax": ("jaxrock_diffrax", "diffrax", "jaxrock, engine Diffrax"),
    "taylor": ("numba_taylor", "numba", "numba, Taylor series"),
    "closed": ("numba_closed", "numba", "numba, closed form"),
    "dopri5": ("numba_dopri5", "numba", "numba, DOPRI5"),
    "heyoka": ("heyoka_batch", "heyoka", "heyoka, batches"),
    "scipy": ("scipy_loop", "scipy", "SciPy, DOP853"),
    "diffrax": ("diffrax_loop", "diffrax", "diffrax.Event, vmapped"),
}
ONE_DEVICE = {"jaxrock", "jaxrock-diffrax"}
FEW, FEW_QUICK, LONG = 200, 20, 60.0  # scenes where a peer is slow; seconds after which it is not repeated


def measured(solve, few, known, problem, repeat):
    """Time and errors of one way: a row for `peers.json`.

    `few`: how many scenes with a reference to solve, None for all scenes of the problem.
    """
    index = np.array([answer["index"] for answer in known])
    chosen = slice(None) if few is None else index[:: max(1, len(index) // few)][:few]
    times, busy = [], []
    for _ in range(repeat + 1):
        start, work = time.perf_counter(), time.process_time()
        found = np.asarray(solve(chosen), float)
        times.append(time.perf_counter() - start)
        busy.append((time.process_time() - work) / times[-1])
        if times[-1] > LONG and len(times) > 1:
            break
    best = min(times[1:] or times)
    row = {"speed": found.size / best, "scenes": int(found.size), "seconds": best, "first": times[0] - best}
    row["cores"] = busy[times.index(best)]  # of this process: little where other processes do the work
    if problem.drawn:
        at = {int(i): peak for i, peak in zip(np.arange(problem.size)[chosen], found)} if few else None
        row |= errors(known if few is None else [a for a in known if a["index"] in at], found if few is None else at)
    return row


def errors(known, found):
    """Errors of peaks over alpha, and wrong verdicts, over scenes with a reference."""
    peak = np.array([np.inf if a["peak"] is None else float(a["peak"]) for a in known])
    condition = np.array([np.inf if a["condition"] is None else a["condition"] for a in known])
    own = np.array([found[a["index"]] for a in known])
    refused = np.isnan(own)
    wrong = (np.isinf(own) != np.isinf(peak)) & ~refused
    safe = np.isfinite(own) & np.isfinite(peak)
    judged = safe & (condition < 1e4)
    error, all_errors = np.abs(own[judged] - peak[judged]), np.abs(own[safe] - peak[safe])
    tame = wrong & ((condition < 1e4) | np.isinf(peak))
    row = {"judged": int(judged.sum()), "of": len(known), "refused": int(refused.sum()), "wrong": int(wrong.sum())}
    row |= {"wrong_tame": int(tame.sum()), "worst_all": float(all_errors.max()) if safe.any() else None}
    if judged.any():
        quantiles = np.quantile(error, [0.5, 0.99, 1.0])
        row |= dict(zip(("median", "p99", "worst"), quantiles.tolist()))
        row["worst_conditioned"] = float((error / np.maximum(condition[judged], 1)).max())
    return row


def rows_of(name, problem, known, options):
    """Rows of one peer on one problem."""
    module = importlib.import_module(f"peers_solvers.{PEERS[name][0]}")
    few = getattr(module, "FEW", None)
    if few is not None:
        few = min(few.get(problem.name, FEW), FEW_QUICK if options.quick else FEW)
        if not problem.drawn:
            return
    for goal, label, solve in module.ways(problem):
        if options.quick and goal == 1e-10:
            continue
        row = {"problem": problem.name, "title": problem.title, "peer": name, "goal": goal, "setting": label}
        try:
            row |= measured(solve, few, known, problem, 1 if options.quick else options.repeat)
        except Exception as error:  # a peer that fails is a result
            row |= {"failed": f"{type(error).__name__}: {error}"[:300]}
        print(f"{problem.title:56}{report.line(row)}", flush=True)
        yield row


def arguments():
    """What the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--problems", nargs="+", default=["P1", "P2", "P3", "P4", "P5", "P6", "P7", "one"])
    parser.add_argument("--peers", nargs="+", default=list(PEERS), choices=list(PEERS))
    parser.add_argument("--quick", action="store_true", help="fewer scenes, once each")
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--draw", action="store_true", help="table and picture from the numbers that are there")
    parser.add_argument("--keep", action="store_true", help="keep the numbers of other problems and peers")
    return parser.parse_args()


def parts(options):
    """What has a process of its own: one block on one core; jaxrock, whose machine code shares the cores of one device;
    and peers, some of which want a device of JAX a core."""
    problems = [name for name in options.problems if name != "one"]
    own = [name for name in options.peers if name in ONE_DEVICE]
    others = [name for name in options.peers if name not in ONE_DEVICE]
    last = [(["one"], options.peers)] if "one" in options.problems else []
    return [(problems, peers) for peers in (own, others) if problems and peers] + last


def main():
    """Measure, and write the report."""
    options, file = arguments(), HERE / "peers.json"
    keeps = (options.draw or options.keep) and file.exists()
    data = json.loads(file.read_text()) if keeps else {"rows": []}
    several = [] if options.draw else parts(options)
    if len(several) > 1:
        file.write_text(json.dumps(data, indent=0))
        for problems, peers in several:
            words = ["--quick"] * options.quick + ["--keep", "--repeat", str(options.repeat)]
            words += ["--problems", *problems, "--peers", *peers]
            subprocess.run([sys.executable, __file__, *words], check=True)
        return
    if options.problems == ["one"]:
        data["one"] = {"rows": one_block.measure(), "surroundings": report.surroundings()}
        file.write_text(json.dumps(data, indent=0))
    elif not options.draw:
        if set(options.peers) - ONE_DEVICE:
            rk.studies.use_cpu_devices()
        measure(options, data, file)
    report.write(data, {name: peer[2] for name, peer in PEERS.items()}, HERE)


def measure(options, data, file):
    """Every peer on every problem; the numbers are written after each."""
    there = [name for name in options.peers if importlib.util.find_spec(PEERS[name][1])]
    skipped = {PEERS[name][2]: name in there for name in options.peers}
    data["skipped"] = [name for name in data.get("skipped", []) if name not in skipped]
    data["skipped"] += [name for name, found in skipped.items() if not found]
    data["surroundings"], data["repeat"] = report.surroundings(), options.repeat
    data["runs"] = data.get("runs", 0) + 1
    answers = json.loads(references.FILE.read_text())
    done = [(p, name) for p in options.problems for name in there]
    data["rows"] = [row for row in data["rows"] if (row["problem"], row["peer"]) not in done]
    data["problems"] = data.get("problems", {})
    for code in options.problems:
        known = answers[code]
        data["problems"][code] = {
            "references": len(known), "overturned": sum(a["peak"] is None for a in known),
            "conditions": np.quantile([a["condition"] for a in known if a["condition"]], [0.5, 0.9, 1]).tolist(),
        }  # fmt: skip
        for problem in peer_problems.load(code, options.quick):
            for name in there:
                data["rows"] += rows_of(name, problem, known, options)
                file.write_text(json.dumps(data, indent=0))


if __name__ == "__main__":
    main()
