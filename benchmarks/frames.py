"""What room for Python's frames is worth in first answers: `python benchmarks/frames.py` writes `frames.md`.

Fresh processes, with nothing kept, in turns: as it is, and with `jaxrock.compiler.tracing.with_stack` as a plain
call. Pages that are touched for the first time tell what happens: there are no others.
"""

import json
import os
import resource
import statistics
import subprocess
import sys
from pathlib import Path

from common import table  # first: the search path
from peers_solvers.report import surroundings

HERE = Path(__file__).parent
TIMES = 7
QUESTIONS = {
    "`outcome`, sine pulse": "rk.outcome(block, rk.SinePulse(0.3, 0.8))",
    "`outcome`, record": "rk.outcome(block, rk.example_record())",
    "`jax.grad` by one number": "jax.grad(lambda a: rk.outcome(block, rk.SinePulse(a, 0.8)).max_rotation)(0.3)",
    "`vmap` of 1,000": "jax.vmap(lambda a: rk.outcome(block, rk.SinePulse(a, 0.8)))(jnp.linspace(0.25, 0.9, 1000))",
}


def ask(question, room):
    """In this process: processor time of the user and of the system [s], and pages, until there is an answer."""
    import jax
    import jax.numpy as jnp

    import jaxrock as rk
    from jaxrock.compiler import tracing
    from jaxrock.compiler.cache import changes

    if not room:
        code = tracing.with_stack.__code__
        tracing.with_stack.__code__ = code.replace(co_stacksize=16)
        changes._seen.clear()  # else the package looks, again and again, for what has changed in it
        changes.changes()
    told = {"rk": rk, "jax": jax, "jnp": jnp, "block": rk.Block(0.2, 2.0)}
    pages, before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt, os.times()
    jax.block_until_ready(eval(QUESTIONS[question], told))
    after = os.times()
    more = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - pages
    return after.user - before.user, after.system - before.system, more


def asked(question, room):
    """The same in a fresh process."""
    words = [sys.executable, __file__, question, str(int(room))]
    run = subprocess.run(words, env=os.environ | {"JAXROCK_CACHE": "off"}, capture_output=True, text=True, check=True)
    return json.loads(run.stdout.splitlines()[-1])


def main():
    rows = []
    for question in QUESTIONS:
        found = {True: [], False: []}
        for _ in range(TIMES):
            for room in found:
                found[room].append(asked(question, room))
        for room, word in ((False, "without"), (True, "with")):
            user, system, pages = map(statistics.median, zip(*found[room], strict=True))
            rows.append([question, word, f"{user:.2f}", f"{system:.2f}", f"{pages:,.0f}"])
    text = f"""# Room for Python's frames

Written by `python benchmarks/frames.py`, {surroundings()}.

First answers in fresh processes with nothing kept: medians of {TIMES}, in turns. CPython keeps frames in pieces of 16
kB; where a loop of calls stands at the end of one, the next is asked for and given back at every turn (in releases of
before 2026, gh-142183). While programs are traced and lowered all frames lie in one piece (`jaxrock.compiler.tracing`).

{table(["question", "room", "user [s]", "system [s]", "pages touched"], rows)}
"""
    (HERE / "frames.md").write_text(text)
    print(text)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        print(json.dumps(ask(sys.argv[1], bool(int(sys.argv[2])))))
    else:
        main()
