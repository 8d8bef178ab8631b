"""Writes `peers.json`: `python -m references.peers [problem ...]` (some ten minutes, one core)."""

import json
import pathlib
import sys
import time

import jax

from references import peer_problems
from references.arithmetic import Arithmetic
from references.motions import Exponential, Lines, Sinusoid
from references.taylor import Block, respond

FILE = pathlib.Path(__file__).with_suffix(".json")
CHANGE = "1e-13"  # relative change of the parameters for condition numbers
RECORD_ORDER = 18  # of the series between two samples
ABOUT = (
    "References of the problems in references/peer_problems.py by references/taylor.py (Taylor series, 40 digits): "
    "index of the scene; peak |theta|/alpha, null if overturned; condition, the sum of |d peak/alpha| over relative "
    "changes of alpha, restitution, amplitude and frequency (or p)."
)


def path_of(a, problem, index, factors=(0, 0, 0, 0)):
    """Block and path of one scene, its parameters changed by relative `factors`.

    The factors are for alpha, restitution, amplitude and frequency (of a record: p).
    """
    by_alpha, by_restitution, by_amplitude, by_frequency = (1 + a.number(x) for x in factors)
    base, p, e, intensity, rate = (
        a.number(float(values[index]))
        for values in (problem.alpha, problem.p, problem.restitution, problem.intensity, problem.rate)
    )
    linear = problem.model == "linear"
    if problem.motion == "record":
        motion, p = Lines(a, problem.samples.tolist(), problem.dt, by_amplitude * intensity), p * by_frequency
        block = Block(a, base * by_alpha, p, e * by_restitution, linear, RECORD_ORDER)
        return block, respond(block, motion)
    amplitude, rate = intensity * (base if linear else a.tan(base)) * by_amplitude, rate * by_frequency
    duration = 2 * a.pi / rate
    if problem.motion == "sine":
        motion = Sinusoid(a, amplitude, rate, 0, duration)
    else:
        motion = Exponential(a, amplitude, duration, a.number(peer_problems.SHAPE))
    block = Block(a, base * by_alpha, p, e * by_restitution, linear)
    return block, respond(block, motion)


def answer(problem, index):
    """The reference of one scene: `index`, `peak` over alpha (30 digits as text), `condition`."""
    a = Arithmetic(40)
    with a.context():
        block, path = path_of(a, problem, index)
        found = {"index": int(index), "peak": None, "condition": None}
        if path.overturned:
            return found
        peak, change, total = path.peak / block.alpha, a.number(CHANGE), 0
        for j in range(4):
            other, moved = path_of(a, problem, index, [change if k == j else 0 for k in range(4)])
            if moved.overturned:
                total = a.number("inf")
                break
            total += abs(moved.peak / other.alpha - peak)
        return found | {"peak": a.text(peak + 0 * change, 30), "condition": float(total / change)}


def main(names):
    """Answers of every point drawn, problem by problem."""
    jax.config.update("jax_enable_x64", True)
    known = json.loads(FILE.read_text()) if FILE.exists() else {}
    known = {"about": ABOUT} | {name: part for name, part in known.items() if name != "about"}
    for name in names or ("P1", "P2", "P3", "P5", "P4", "P6", "P7"):
        problem = peer_problems.load(name)[0]
        start, answers = time.perf_counter(), []
        for count, index in enumerate(problem.points, 1):
            answers.append(answer(problem, index))
            if count % 50 == 0:
                spent = time.perf_counter() - start
                print(f"\r{name}: {count} of {problem.points.size}, {spent:.0f} s", end="", flush=True)
        print()
        known[name] = answers
        FILE.write_text(json.dumps(known, indent=0))


if __name__ == "__main__":
    main(sys.argv[1:])
