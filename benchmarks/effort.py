"""What LLVM's effort costs and is worth: `python benchmarks/effort.py` writes `effort.md`.

Fresh processes, with nothing kept, in turns: machine code by effort 0 and by effort 3
(`jaxrock.compiler.llvm.jit.EFFORT`), with whether both answer the same to the bit.
"""

import hashlib
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
TIMES = 3
_PEAK = "lambda x: rk.outcome(rk.Block(x[0], x[1], x[2]), rk.SinePulse(x[3], x[4])).max_rotation"
_LOBE = "single_lobe.peak_rotation"
_POINT, _POINTS = "(0.6, 1.3, 0.4)", "(jnp.linspace(0.5, 0.6, 10_000), 1.3, 0.4)"
_SCENE = "(jnp.array([0.2, 2.0, 0.9, 0.3, 0.8]),)"
_SCENES = "(jnp.array([0.2, 2.0, 0.9, 0.3, 0.8]) * jnp.linspace(0.99, 1.01, 1000)[:, None],)"
# Question: (function, arguments).
QUESTIONS = {
    "closed form, one": (_LOBE, _POINT),
    "its gradient": (f"jax.grad({_LOBE}, (0, 1, 2))", _POINT),
    "its Hessian by two": (f"jax.hessian({_LOBE}, (0, 1))", _POINT),
    "closed form, 10,000": (_LOBE, _POINTS),
    "their gradients": (f"jax.vmap(jax.grad({_LOBE}, (0, 1, 2)), (0, None, None))", _POINTS),
    "scene, one": (_PEAK, _SCENE),
    "its gradient by five": (f"jax.grad({_PEAK})", _SCENE),
    "under a record, one": ("lambda a: rk.outcome(rk.Block(0.2, 2.0), a * rk.example_record()).margin", "(1.5,)"),
    "scenes, 1,000": (f"jax.vmap({_PEAK})", _SCENES),
    "their gradients by five": (f"jax.vmap(jax.grad({_PEAK}))", _SCENES),
}


def ask(question, effort):
    """In this process: processor seconds of the first answer, of LLVM within it, seconds of the next ones, a digest."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    jax.config.update("jax_enable_x64", True)
    import jaxrock as rk
    from jaxrock.closed_form import single_lobe
    from jaxrock.compiler.llvm import jit

    jit.EFFORT.update(dict.fromkeys(jit.EFFORT, effort))
    compiled, of_llvm = jit._Machine.object_of, []

    def timed(*given):
        begun = time.process_time()
        code = compiled(*given)
        of_llvm.append(time.process_time() - begun)
        return code

    jit._Machine.object_of = timed
    names = {"rk": rk, "jax": jax, "jnp": jnp, "single_lobe": single_lobe}
    function, given = (eval(text, names) for text in QUESTIONS[question])
    function, begun = jax.jit(function), time.process_time()
    answer = jax.block_until_ready(function(*given))
    first, next_ones = time.process_time() - begun, []
    for _ in range(200 if "000" not in question else 30):
        begun = time.perf_counter()
        jax.block_until_ready(function(*given))
        next_ones.append(time.perf_counter() - begun)
    content = b"".join(np.asarray(x).tobytes() for x in jax.tree.leaves(answer))
    return first, sum(of_llvm), min(next_ones), hashlib.sha256(content).hexdigest()


def asked(question, effort):
    """The same in a fresh process."""
    words = [sys.executable, __file__, question, str(effort)]
    run = subprocess.run(words, env=os.environ | {"JAXROCK_CACHE": "off"}, capture_output=True, text=True, check=True)
    return json.loads(run.stdout.splitlines()[-1])


def main():
    rows = []
    for question in QUESTIONS:
        found = {0: [], 3: []}
        for _ in range(TIMES):
            for effort in found:
                found[effort].append(asked(question, effort))
        same = len({each[3] for each in (*found[0], *found[3])}) == 1
        for effort, answers in found.items():
            first, of_llvm, then = (statistics.median(x) for x in list(zip(*answers, strict=True))[:3])
            numbers = f"{first:.2f}", f"{of_llvm:.2f}", f"{1e3 * then:.3f}"
            rows.append([question, str(effort), *numbers, "yes" if same else "no"])
    heads = ["question", "effort", "first answer [s]", "of it LLVM [s]", "the next [ms]", "same to the bit"]
    text = f"""# LLVM's effort

Written by `python benchmarks/effort.py`, {surroundings()}.

Machine code of one program, compiled by LLVM with effort 0 and 3: processor seconds of the first answer in a fresh
process with nothing kept, of LLVM within it, and the least time of the answers after it; medians of {TIMES}, in turns.
The package compiles what is of one lane with effort 0, all else with 3 (`jaxrock.compiler.llvm.jit.EFFORT`).

{table(heads, rows)}
"""
    (HERE / "effort.md").write_text(text)
    print(text)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        print(json.dumps(ask(sys.argv[1], int(sys.argv[2]))))
    else:
        main()
