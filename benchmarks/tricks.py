"""Measure each trick of the compiler by leaving it out: `python benchmarks/tricks.py` writes `tricks.md`.

Fresh processes with an empty cache, in turns: as it is, and without one of the tricks. Processor seconds of the first
answer, and the least wall time of later ones.
"""

import contextlib
import importlib
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

from common import table  # first: the search path
from peers_solvers.report import surroundings

HERE = Path(__file__).parent
TIMES = 2
PULSES = "jnp.linspace(0.25, 0.9, 2000)"
QUESTIONS = {
    "`outcome`, record": "one(1.1)",
    "`vmap` of 2,000 pulses": f"pulses({PULSES})",
    "`vmap` of 2,000 scales of a record": "records(jnp.linspace(0.5, 2.0, 2000))",
    "history, its gradient by two": "slopes(jnp.array([0.2, 2.0]))",
    "`Diffrax`, 2,000 pulses, damper": f"damped({PULSES})",
}
WITHOUT = {
    "nothing": "",
    "one piece of memory for frames": """
tracing.with_stack.__code__ = tracing.with_stack.__code__.replace(co_stacksize=16)
changes._seen.clear()
changes.changes()""",
    "the collector's pause": "tracing._not_collected = contextlib.nullcontext",
    "less effort for few numbers": "low_effort.LOW_EFFORT_LIMIT = -1",
    "less effort of LLVM for one lane": 'jit.EFFORT["in a moment"] = 3',
    "XLA's older emitters": "",  # by the flag below
    "machine code for Diffrax": """
def refuse(jaxpr):
    raise operations.Unsupported("primitives of other libraries")
original = compiled_program.has_foreign
compiled_program.has_foreign = lambda jaxpr: original(jaxpr) and refuse(jaxpr)""",
    "the fast pass": "lanes._FEW = 10**9",
    "machine code": "lanes.native = None",
}
OLDER = "XLA's older emitters"  # which `keep_compiled` and the command choose
SLOW = {"machine code", "machine code for Diffrax"}  # tried once


def ask(question, trick):
    """Return processor seconds of the first answer in this process, and the least seconds of later ones."""
    os.environ["XLA_FLAGS"] = f"--xla_cpu_use_fusion_emitters={str(trick == OLDER).lower()}"
    import jax

    jax.config.update("jax_enable_x64", True)
    import jax.numpy as jnp

    import jaxrock as rk

    compiler = "jaxrock.compiler."
    modules = ("tracing", "cache.changes", "hints.low_effort", "llvm.compiled_program", "llvm.jit", "llvm.operations",
               "primitive.lanes")  # fmt: skip
    names: dict = {each.split(".")[-1]: importlib.import_module(compiler + each) for each in modules}
    names |= {"os": os, "contextlib": contextlib}
    exec(WITHOUT[trick], names)
    block, record = rk.Block(0.2, 2.0), rk.example_record()

    damped_model = rk.models.Equation(
        restoring=lambda rotation, block: jnp.sin(block.alpha - rotation),
        arm=lambda rotation, block: jnp.cos(block.alpha - rotation),
        dissipation=lambda rotation, velocity, block: 0.02 * velocity,
    )
    names |= {
        "block": block,
        "record": record,
        "jnp": jnp,
        "rk": rk,
        "jax": jax,
        "one": jax.jit(lambda a: rk.outcome(block, a * record).margin),
        "pulses": jax.jit(jax.vmap(lambda a: rk.outcome(block, rk.SinePulse(a, 0.8)).margin)),
        "records": jax.jit(jax.vmap(lambda a: rk.outcome(block, a * record).margin)),
        "slopes": jax.jit(
            jax.grad(
                lambda x: rk.simulate(rk.Block(x[0], x[1]), rk.SinePulse(0.3, 0.8))(jnp.linspace(0, 2, 64))[0].sum()
            )
        ),
        "damped": jax.jit(jax.vmap(lambda a: rk.outcome(block, rk.SinePulse(a, 0.8), damped_model).margin)),
    }
    before = time.process_time()
    jax.block_until_ready(eval(QUESTIONS[question], names))
    first, best = time.process_time() - before, float("inf")
    for _ in range(3):
        begin = time.perf_counter()
        jax.block_until_ready(eval(QUESTIONS[question], names))
        best = min(best, time.perf_counter() - begin)
    return first, best


def asked(question, trick):
    """Return the same of a fresh process."""
    words = [sys.executable, __file__, question, trick]
    run = subprocess.run(words, env=os.environ | {"JAXROCK_CACHE": "off"}, capture_output=True, text=True)
    if run.returncode:
        raise RuntimeError(run.stderr[-2000:])
    return json.loads(run.stdout.splitlines()[-1])


def main():
    found = {(question, trick): [] for question in QUESTIONS for trick in WITHOUT}
    for turn in range(TIMES):
        for question, trick in found:
            if turn == 0 or trick not in SLOW:
                found[question, trick].append(asked(question, trick))
    rows = []
    for question in QUESTIONS:
        base = [statistics.median(each) for each in zip(*found[question, "nothing"], strict=True)]
        for trick in WITHOUT:
            first, later = (statistics.median(each) for each in zip(*found[question, trick], strict=True))
            ratios = f"{first / base[0]:.2f}", f"{later / base[1]:.2f}"
            rows.append([question, trick, f"{first:.2f}", ratios[0], f"{1e3 * later:.2f}", ratios[1]])
    heads = ["question", "without", "first answer [s]", "ratio", "later [ms]", "ratio"]
    text = f"""# What tricks are worth

Written by `python benchmarks/tricks.py`, {surroundings()}.

Each row leaves out one trick. First answers are processor seconds in fresh processes with an empty cache, medians of
{TIMES}; later ones are the least wall time of three. Rows without machine code ran once.

{table(heads, rows)}
"""
    (HERE / "tricks.md").write_text(text)
    print(text)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        print(json.dumps(ask(*sys.argv[1:])))
    else:
        main()
