"""Writes `peers_references.json`: `python benchmarks/peers_references.py [problem ...]` (minutes, one core)."""

import json
import pathlib
import sys
import time

HERE = pathlib.Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

import jax  # noqa: E402

jax.config.update("jax_enable_x64", True)

from peers_solvers import problems, reference  # noqa: E402

FILE = HERE / "peers_references.json"
ABOUT = (
    "References of the problems in peers_solvers/problems.py by peers_solvers/reference.py (Taylor series, 135 bits): "
    "index of the scene; peak |theta|/alpha, null if overturned; condition, the sum of |d peak/alpha| over relative "
    "changes of alpha, restitution, amplitude and frequency (or p); impacts during the motion."
)


def main(names):
    """Answers of every point drawn, problem by problem."""
    known = json.loads(FILE.read_text()) if FILE.exists() else {"about": ABOUT}
    for name in names or ("P1", "P2", "P3", "P5", "P4"):
        problem = problems.load(name)[0]
        start, answers = time.perf_counter(), []
        for count, index in enumerate(problem.points, 1):
            answers.append(reference.answer(problem, index))
            if count % 50 == 0:
                spent = time.perf_counter() - start
                print(f"\r{name}: {count} of {problem.points.size}, {spent:.0f} s", end="", flush=True)
        print()
        known[name] = answers
        FILE.write_text(json.dumps(known, indent=0))


if __name__ == "__main__":
    main(sys.argv[1:])
