"""Many threads and processes that do different things at once: every answer is that of one thread alone, bit for bit.

`python -m references.threads 300` does so for as many seconds, in four processes of eight threads each.
"""

import argparse
import collections
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
import traceback
import uuid
import warnings
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxrock as rk
from references.damage import record, swept

ROOT = Path(__file__).parents[1]


def told(tree) -> str:
    """Return a digest of all bits of an answer."""
    found = hashlib.sha256()
    for leaf in jax.tree.leaves(tree):
        array = np.asarray(leaf)
        found.update(f"{array.dtype}{array.shape}".encode() + array.tobytes())
    return found.hexdigest()


def message(function: Callable) -> str:
    """Return the message of a refusal; of JAX's error text, the line of the package."""
    try:
        function()
    except Exception as error:
        return next((line for line in str(error).splitlines() if "Argument" in line), repr(error))
    return "no refusal"


def checked(restitution: float) -> rk.studies.Grid:
    """A sweep whose arguments are checked within it."""
    return rk.sweep(
        lambda e, p: rk.Block(0.2, p, e).restitution * p, e=[0.5, restitution], p=[1.0, 2.0, 3.0], progress=False
    )


def stored(folder: Path) -> rk.studies.Grid:
    """A sweep of a store of its own, resumed."""
    path = folder / f"{uuid.uuid4().hex}.zarr"
    assert swept(path, load=False) is None
    return swept(path)


def shared(folder: Path) -> rk.studies.Grid:
    """A sweep of one store that all threads and processes write."""
    return swept(folder / "shared.zarr")


def saved(folder: Path, ending: str) -> rk.studies.Grid:
    """Results that were saved and loaded."""
    path = folder / f"{uuid.uuid4().hex}{ending}"
    axes = {"k": np.arange(50.0)}
    rk.studies.Grid(axes, {"square": axes["k"] ** 2, "even": axes["k"] % 2 == 0, "count": np.arange(50)}).save(path)
    return rk.studies.Grid.load(path)


def questions(folder: Path, few: bool = False) -> dict[str, Callable]:
    """Return questions by name: each returns a pytree, or a text."""
    block, motion, pulse = rk.Block(0.2, 2.0), record(), rk.SinePulse(0.6, 0.9)
    strengths = jnp.linspace(0.1, 1.5, 70)
    cheap = {
        "outcome": lambda: rk.outcome(block, motion),
        "sweep": lambda: checked(0.9).values,
        "refused sweep": lambda: message(lambda: checked(1.5)),
        "refused block": lambda: message(lambda: rk.Block(0.2, -1.0)),
        "refused under jit": lambda: message(lambda: jax.jit(lambda p: rk.Block(0.2, p).p)(-1.0).block_until_ready()),
        "store": lambda: stored(folder).values,
        "shared store": lambda: shared(folder).values,
        "NetCDF": lambda: saved(folder, ".nc").values,
        "Zarr": lambda: saved(folder, ".zarr").values,
    }
    if few:
        return cheap
    return cheap | {
        "outcome of another block": lambda: rk.outcome(rk.Block(0.31, 3.0), pulse, rk.Linear()),
        "outcomes": lambda: jax.vmap(lambda s: rk.outcome(block, s * motion))(strengths),
        "history": lambda: (lambda x: (x.time, x.rotation, x.impact_times, x.margin))(rk.simulate(block, pulse)),
        "derivative": lambda: jax.grad(lambda a: rk.outcome(rk.Block(a, 2.0), pulse).margin)(0.25),
        "critical amplitudes": lambda: rk.critical_amplitudes(block, pulse, derivatives=False, progress=False),
        "spectrum": lambda: rk.rocking_spectrum(0.2, motion, np.linspace(1.0, 3.0, 9), progress=False),
        "map": lambda: rk.overturning_map([0.5, 1.0, 4.0], [1.5, 3.0, 6.0], alpha=0.2, progress=False),
    }


def answer(question: Callable) -> str:
    """Return the digest, or the text, of an answer."""
    found = question()
    return found if isinstance(found, str) else told(found)


def asked_by_threads(seconds: float, threads: int, seed: int, right: dict[str, str], folder: Path, few: bool) -> dict:
    """Threads that ask at random until the time is over, each at least once: how often what was asked, and what was
    answered wrongly."""
    asked, wrong, end = collections.Counter(), [], time.monotonic() + seconds
    barrier, todo = threading.Barrier(threads), questions(folder, few)

    def asking(own: int) -> None:
        rng = np.random.default_rng([seed, own])
        barrier.wait()
        first = True
        while first or time.monotonic() < end:
            first, name = False, list(todo)[rng.integers(len(todo))]
            try:
                found = answer(todo[name])
            except Exception as error:
                found = "".join(traceback.format_exception(error)[-6:])
            asked[name] += 1
            if found != right[name]:
                wrong.append(f"{name}: {found}")

    running = [threading.Thread(target=asking, args=(own,)) for own in range(threads)]
    for thread in running:
        thread.start()
    for thread in running:
        thread.join()
    return {"asked": asked, "wrong": wrong}


def attack(seconds: float, processes: int = 4, threads: int = 8, seed: int = 0, few: bool = False) -> dict:
    """Processes and threads at once; half of the processes find nothing that was compiled before."""
    with tempfile.TemporaryDirectory() as folder:
        plan = {"seconds": seconds, "threads": threads, "folder": folder, "few": few}
        alone = _started({**plan, "seed": -1}, folder, "alone")
        right = _result(alone)
        started = [
            _started({**plan, "seed": seed + own, "right": right}, folder, "off" if own % 2 else "shared")
            for own in range(processes)
        ]
        results = [_result(process) for process in started]
    total = collections.Counter()
    for result in results:
        total.update(result["asked"])
    return {"asked": total, "wrong": [each for result in results for each in result["wrong"]]}


def _started(plan: dict, folder: str, cache: str) -> subprocess.Popen:
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("JAX_", "XLA_"))}
    environment = kept | {
        "JAX_PLATFORMS": "cpu", "JAXROCK_CACHE": cache if cache == "off" else f"{folder}/{cache}",
        "PYTHONPATH": os.pathsep.join([str(ROOT), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]),
    }  # fmt: skip
    words = [sys.executable, "-m", "references.threads", "0", "--work", json.dumps(plan)]
    return subprocess.Popen(
        words, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )


def _result(process: subprocess.Popen) -> dict:
    said = process.communicate()[0]
    assert process.returncode == 0, f"a process ended with {process.returncode}: {said}"
    return json.loads(said.splitlines()[-1])


def work(plan: dict) -> None:
    """Run the part of one process: alone, or with many threads at once."""
    warnings.simplefilter("error")
    jax.config.update("jax_enable_x64", True)
    folder = Path(plan["folder"])
    if "right" in plan:
        found = asked_by_threads(plan["seconds"], plan["threads"], plan["seed"], plan["right"], folder, plan["few"])
    else:
        found = {name: answer(question) for name, question in questions(folder, plan["few"]).items()}
    print(json.dumps(found))


def main() -> None:
    """Ask for so many seconds, and say how often what was asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("seconds", type=float)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--work", type=json.loads, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.work:
        try:
            return work(given.work)
        except BaseException as error:
            print(repr(error))  # where it is read; the error stream is full of what refusals say
            raise
    found = attack(given.seconds, seed=given.seed)
    for what, often in sorted(found["asked"].items()):
        print(f"{often:6d}  {what}")
    print(f"{len(found['wrong'])} of {sum(found['asked'].values())} are not what one thread alone finds")
    for each in found["wrong"][:20]:
        print(" ", each)
    sys.exit(bool(found["wrong"]))


if __name__ == "__main__":
    main()
