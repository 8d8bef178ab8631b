"""How long the first answer takes: every question in a fresh process, with nothing kept (cold) and once more (warm).

    python benchmarks/first_answer.py [--only QUESTIONS] [--package FOLDER]

Times are processor seconds of all threads, and seconds on the wall, from after the imports of the package to the
answer; of the command line, the whole process. Every question starts with an empty folder of kept programs; the second
process finds what the first has left. `rk.keep_compiled()` is called. `--package` measures another copy. Peers are
those of `peers.py`, from after their own imports to their answers.
"""

import argparse
import json
import os
import pathlib
import subprocess
import sys
import tempfile

HERE = pathlib.Path(__file__).resolve().parent

_BEGIN = """
import json, resource, time
def spent():
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(u.ru_utime + u.ru_stime for u in used), time.perf_counter()
begun = spent()
import jax, numpy as np, jax.numpy as jnp, equinox
jax.config.update("jax_platforms", "cpu")
jax.config.update("jax_enable_x64", True)
of_jax = spent()
import jaxrock as rk
getattr(rk, "keep_compiled", lambda: None)()  # before the first computation; earlier copies have none
imported = spent()
jax.block_until_ready(jax.device_put(np.ones(3)))
block, pulse = rk.Block(0.2, 2.0), rk.SinePulse(0.3, 0.8)
ready = spent()
"""
_END = """
jax.block_until_ready([x for x in jax.tree.leaves(answer) if isinstance(x, jax.Array)])
done = spent()
found = {"jax": of_jax[0] - begun[0], "import": imported[0] - of_jax[0], "answer": done[0] - ready[0],
         "wall": done[1] - ready[1], "memory": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}
print(json.dumps(found))
"""

# Question: (the table's words, code, bars cold and warm [s], if there are any).
QUESTIONS = {
    "import": ("import beyond JAX and Equinox", "answer = 0", None, 0.3),
    "pulse": ("`outcome`, sine pulse", "answer = rk.outcome(block, pulse)", 2.5, 0.4),
    "record": ("`outcome`, record", "answer = rk.outcome(block, 1.5 * rk.example_record())", 2.5, 0.4),
    "simulate": (
        "`simulate`, 2,001 samples, picture",
        "import matplotlib; matplotlib.use('Agg')\n"
        "answer = rk.simulate(block, pulse); rk.plot.history(answer)[0].figure.savefig('/dev/null', format='png')",
        5.0, 1.2,
    ),
    "vmap": (
        "`vmap` of 1,000",
        "answer = jax.vmap(lambda a: rk.outcome(block, rk.SinePulse(a, 0.8)))(jnp.linspace(0.25, 0.9, 1000))",
        4.0, 0.6,
    ),
    "scaled": (
        "`vmap` of 1,000 scales of a record",
        "record = rk.example_record()\n"
        "answer = jax.vmap(lambda a: rk.outcome(block, a * record))(jnp.linspace(0.5, 2.0, 1000))",
        4.0, 0.6,
    ),
    "map": (
        "map of 128 x 128",
        "answer = rk.overturning_map(np.linspace(1, 8, 128), np.linspace(1, 10, 128), progress=False)",
        4.0, 0.6,
    ),
    "grad": (
        "`jax.grad` by one number",
        "answer = jax.grad(lambda a: rk.outcome(block, rk.SinePulse(a, 0.8)).max_rotation)(0.3)",
        6.0, 1.0,
    ),
    "grad5": (
        "`jax.grad` by 5 numbers, one scene",
        "def peak(x): return rk.outcome(rk.Block(x[0], x[1], x[2]), rk.SinePulse(x[3], x[4])).max_rotation\n"
        "answer = jax.grad(peak)(jnp.array([0.2, 2.0, 0.9, 0.3, 0.8]))",
        None, None,
    ),
    "slopes": (
        "value and 5 derivatives of 1,000",
        "def peak(x): return rk.outcome(rk.Block(x[0], x[1], x[2]), rk.SinePulse(x[3], x[4])).max_rotation\n"
        "x = jnp.array([0.2, 2.0, 0.9, 0.3, 0.8]) * jnp.linspace(0.99, 1.01, 1000)[:, None]\n"
        "answer = jax.vmap(jax.value_and_grad(peak))(x)",
        6.0, 1.0,
    ),
    "hessian": (
        "Hessian of 5 under `vmap`",
        "def peak(x): return rk.outcome(rk.Block(x[0], x[1], x[2]), rk.SinePulse(x[3], x[4])).max_rotation\n"
        "x = jnp.array([0.2, 2.0, 0.9, 0.3, 0.8]) * jnp.linspace(0.99, 1.01, 100)[:, None]\n"
        "answer = jax.vmap(jax.hessian(peak))(x)",
        30.0, 1.5,
    ),
    "history_slopes": (
        "gradient of a history by 5",
        "def misfit(x):\n"
        "    history = rk.simulate(rk.Block(x[0], x[1], x[2]), rk.SinePulse(x[3], x[4]))\n"
        "    return jnp.sum(history(jnp.linspace(0.0, 2.0, 200))[0] ** 2)\n"
        "answer = jax.grad(misfit)(jnp.array([0.2, 2.0, 0.9, 0.3, 0.8]))",
        None, None,
    ),
    "history_hessian": (
        "its Hessian",
        "def misfit(x):\n"
        "    history = rk.simulate(rk.Block(x[0], x[1], x[2]), rk.SinePulse(x[3], x[4]))\n"
        "    return jnp.sum(history(jnp.linspace(0.0, 2.0, 200))[0] ** 2)\n"
        "answer = jax.hessian(misfit)(jnp.array([0.2, 2.0, 0.9, 0.3, 0.8]))",
        None, None,
    ),
    "history_diffrax": (
        "history by the diffrax engine",
        "answer = rk.simulate(block, pulse, engine=rk.Diffrax())",
        None, None,
    ),
    "histories": (
        "`sweep` of two histories under a record",
        "record = 1.5 * rk.example_record()\n"
        "answer = rk.sweep(lambda p: rk.simulate(rk.Block(0.2, p), record).rotation, p=[1.0, 2.0], progress=False)",
        None, None,
    ),
    "samples": (
        "gradient by all samples of a record",
        "samples, dt = 1.5 * rk.example_record().samples, rk.example_record().dt\n"
        "answer = jax.grad(lambda s: rk.outcome(block, rk.Record(s, dt)).max_rotation)(samples)",
        None, None,
    ),
    "asymmetric": (
        "asymmetric rock, vertical shaking, `vmap`",
        "rock = rk.blocks.AsymmetricBlock(0.15, 0.25, 2.0)\n"
        "motion = rk.SinePulse(0.3, 0.8).with_vertical(rk.SinePulse(0.1, 0.3))\n"
        "answer = jax.vmap(lambda a: rk.outcome(rock, a * motion))(jnp.linspace(0.5, 2.0, 1000))",
        6.0, 0.8,
    ),
    "spring": (
        "plastic spring",
        "answer = rk.outcome(block, pulse, rk.Spring('SM1', 'plastic'))",
        None, None,
    ),
    "own": (
        "model of one's own with `fori_loop`",
        "class Model(rk.Linear):\n"
        "    def moments(self, block):\n"
        "        part = jax.lax.fori_loop(0, 9, lambda k, part: part + 1 / 9, 0.0 * block.alpha)\n"
        "        return super().moments(block).times(part)\n"
        "answer = rk.outcome(block, pulse, Model())",
        None, None,
    ),
    "critical": ("`critical_amplitudes`", "answer = rk.critical_amplitudes(block, pulse, progress=False)", None, None),
    "sensitivity": ("`sensitivity`", "answer = rk.studies.sensitivity(block, pulse)", None, None),
    "diffrax": ("Diffrax engine, `outcome`", "answer = rk.outcome(block, pulse, engine=rk.Diffrax())", 5.0, 1.0),
    "column": (
        "flexible column, `outcome`",
        "answer = rk.outcome(rk.blocks.FlexibleBlock(5.0, 50.0, 30e9, 2500.0, 0.01, 6), rk.SinePulse(0.5, 1.6))",
        None, None,
    ),
    "column_history": (
        "its history",
        "answer = rk.simulate(rk.blocks.FlexibleBlock(5.0, 50.0, 30e9, 2500.0, 0.01, 6), rk.SinePulse(0.5, 1.6))",
        None, None,
    ),
    "column_grad": (
        "its gradient by one number",
        "column = rk.blocks.FlexibleBlock(5.0, 50.0, 30e9, 2500.0, 0.01, 6)\n"
        "answer = jax.grad(lambda a: rk.outcome(column, rk.SinePulse(a, 1.6)).max_rotation)(0.5)",
        None, None,
    ),
    "column_law": (
        "with finite rotations, P-Delta and a plastic base, `outcome`",
        "law = dict(base='plastic', rotations='finite', p_delta=True)\n"
        "answer = rk.outcome(rk.blocks.FlexibleBlock(5.0, 50.0, 30e9, 2500.0, 0.01, 6, **law), rk.SinePulse(0.5, 1.6))",
        None, None,
    ),
    "closed": (
        "gradient of a closed form",
        "from jaxrock.closed_form import sine_pulse\n"
        "answer = jax.grad(lambda w: sine_pulse.during_pulse_limit(w, 0.9))(2.0)",
        2.0, 0.5,
    ),
    "closed2": (
        "its Hessian",
        "from jaxrock.closed_form import sine_pulse\n"
        "answer = jax.hessian(lambda w: sine_pulse.during_pulse_limit(w, 0.9))(2.0)",
        8.0, 0.5,
    ),
    "bare": (
        "map of 128 x 128 without llvmlite",
        "answer = rk.overturning_map(np.linspace(1, 8, 128), np.linspace(1, 10, 128), progress=False)",
        15.0, 3.0,
    ),
    "run": ("`jaxrock run`, whole process", ["run"], 8.0, 3.0),
    "invert": ("`jaxrock invert`, whole process", ["invert", "rocks.csv"], 20.0, 8.0),
}  # fmt: skip
# Peers, of `peers_solvers`: the table's words, what is imported before, and the code.
_LOOP, _MANY = (
    (
        "from peers_solvers import scipy_loop as loop\n"
        "motion, settings = loop.Sine(0.3, 2 * np.pi / 0.8), loop.settings_of(1e-6, 1e-8)\n"
        "numbers = float(block.alpha), 2.0, float(block.restitution)\n"
    ),
    (
        "from references.peer_problems import Problem\n"
        "one = np.ones(1000)\n"
        "scenes = 0.2 * one, 2 * one, 0.9 * one, np.linspace(1.25, 4.5, 1000), 2 * np.pi / 0.8 / 2 * one\n"
        "problem = Problem('', '', 'nonlinear', 'sine', *scenes)\n"
    ),
)
PEERS = {
    "scipy": (
        "a loop by SciPy, DOP853 at 1e-6, one pulse",
        _LOOP,
        "answer = loop.follow(*numbers, motion, False, settings)",
    ),
    "scipy_record": (
        "the same, record",
        _LOOP + "record = rk.example_record()\n"
        "motion = loop.Record((1.5 * np.asarray(record.samples)).tolist(), float(record.dt), False)\n",
        "answer = loop.follow(*numbers, motion, False, settings)",
    ),
    "numba": (
        "Taylor series by hand in numba, 1,000 pulses",
        _MANY + "from peers_solvers import numba_taylor as peer\n",
        "answer = peer.ways(problem)[1][2]()",
    ),
    "event": (
        "`diffrax.Event` under `vmap`, 1,000 pulses",
        _MANY + "from peers_solvers import diffrax_loop as peer\n",
        "answer = peer.ways(problem)[0][2](slice(None))",
    ),
}
QUESTIONS |= {name: (words, code, None, None) for name, (words, _, code) in PEERS.items()}
_ROCKS = "alpha_rad,p_rad_per_s,observed\n0.15,2.0,survived\n0.2,2.5,survived\n0.1,3.0,toppled\n0.25,1.8,survived\n"


def measure(question: str, package: pathlib.Path, kept: str, folder: str) -> dict:
    """Times of one process."""
    code = QUESTIONS[question][1]
    places = os.pathsep.join([str(package), str(HERE), str(HERE.parent)])
    environment = os.environ | {"JAXROCK_CACHE": kept, "PYTHONPATH": places, "MPLBACKEND": "Agg"}
    if isinstance(code, list):
        pathlib.Path(folder, "rocks.csv").write_text(_ROCKS)
        words = [sys.executable, "-c", _COMMAND, *code, "--out", str(pathlib.Path(folder, "out"))]
    else:
        without = "import sys\nsys.modules['llvmlite'] = None\n" if question == "bare" else ""
        peer = f"{PEERS[question][1]}\nready = spent()\n" if question in PEERS else ""
        words = [sys.executable, "-c", without + _BEGIN + peer + code + _END]
    done = subprocess.run(words, env=environment, cwd=folder, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{question}: {done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


_COMMAND = """
import json, resource, sys, time
start = time.perf_counter()
from jaxrock.command_line.main import main
status = main(sys.argv[1:])
used = resource.getrusage(resource.RUSAGE_SELF)
print(json.dumps({"answer": used.ru_utime + used.ru_stime, "wall": time.perf_counter() - start,
                  "memory": used.ru_maxrss / 1024}))
sys.exit(status)
"""


def table(questions: list[str], package: pathlib.Path) -> str:
    """A table of cold and warm answers."""
    head = "question", "cold [s]", "wall", "bar", "warm [s]", "wall", "bar", "memory [MB]"
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for question in questions:
        words, _, cold, warm = QUESTIONS[question]
        with tempfile.TemporaryDirectory() as kept, tempfile.TemporaryDirectory() as folder:
            first, last = (measure(question, package, kept, folder) for _ in range(2))
        key, wall = ("import", "import") if question == "import" else ("answer", "wall")
        cells = f"{first[key]:.2f}", f"{first[wall]:.2f}", f"{cold or ''}", f"{last[key]:.2f}", f"{last[wall]:.2f}"
        lines.append("| " + " | ".join((words, *cells, f"{warm or ''}", f"{first['memory']:.0f}")) + " |")
        print(lines[-1], flush=True)
    return "\n".join(lines)


def main():
    """Print the table, and write it if it is whole."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--only", nargs="*", choices=list(QUESTIONS), default=None)
    parser.add_argument("--package", type=pathlib.Path, default=HERE.parent)
    arguments = parser.parse_args()
    # As an installer does: Python need not do it in every process where the environment forbids to keep it.
    subprocess.run([sys.executable, "-m", "compileall", "-q", str(arguments.package / "jaxrock")], check=True)
    found = table(arguments.only or list(QUESTIONS), arguments.package)
    if arguments.only is None and arguments.package == HERE.parent:
        path = HERE / "first_answer.md"
        before, _, after = path.read_text().partition("| question")
        rest = after.partition("\n\n")[2]
        path.write_text(f"{before}{found}\n\n{rest}")


if __name__ == "__main__":
    main()
