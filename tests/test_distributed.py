"""Many processes: a sweep gives the same bits however many share it, and goes on after one of them was killed.

The processes are those of one machine, which talk over its loopback as machines do over a network.
"""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time

import jax
import numpy as np
import pytest

import jaxrock as rk

PATIENCE = 240  # seconds; all of it takes some ten

# Sweeps: a function and its axes, as text in which jaxrock is `rk`.
SWEEPS = """
import jax, jax.numpy as jnp, numpy as np

def chaotic(alpha, p):
    x, steps = jax.lax.while_loop(
        lambda s: (s[0] < 0.99) & (s[1] < 50), lambda s: (p * s[0] * (1 - s[0]), s[1] + 1), (alpha, 0)
    )
    return {"x": jnp.sin(x), "steps": steps, "above": x > 0.5, "pair": jnp.stack([x, alpha])}

motion = rk.Record(0.4 * np.sin(np.linspace(0, 14, 120)), 0.02)

def outcome(alpha, p):
    return rk.outcome(rk.Block(alpha, p), motion)

axes = dict(alpha=np.linspace(0.05, 0.3, 23), p=np.linspace(1.0, 3.9, 31))
"""

# Every process of a job runs this: own number, number of processes, port, block at which to die, folder of results, and
# sweeps one after the other, each a function, a folder, and files that vanish before it: of a sweep that all have left.
WORKER = (
    """
import json, os, signal, sys
import jax
jax.config.update("jax_enable_x64", True)
own, count, port, kill = map(int, sys.argv[1:5])
results, sweeps = sys.argv[5], json.loads(sys.argv[6])
import jaxrock as rk
if count > 1:
    jax.distributed.initialize(f"127.0.0.1:{port}", count, own, initialization_timeout=100)
rk.studies.use_cpu_devices(1 + own % 2)
from jaxrock._arguments.ranges import checked
from jaxrock.sweeps.store import Store
"""
    + SWEEPS
    + """
def refused(alpha, p):
    return chaotic(checked("p", p, "be below 3.85", lambda p: p < 3.85), 1.0)

def full(self, number, leaves):
    raise OSError(28, "No space left")

def fail(store):  # one process fails, and the other hears of it
    side = dict(p=np.linspace(1.0, 3.9, 31), alpha=np.ones(31), outer=False, progress=False)
    own_write = Store.write
    for function, folder, write in ((refused, None, own_write), (chaotic, store, full if own == 1 else own_write)):
        Store.write = write
        try:
            rk.sweep(function, store=folder, block=16, **side)
        except Exception as error:
            print(type(error).__name__, error, flush=True)
    Store.write = own_write

if kill >= 0:
    write, done = Store.write, []
    class Deadly:
        def __setitem__(self, place, leaf):
            os.kill(os.getpid(), signal.SIGKILL)
    def dying(self, place, leaves):
        if len(done) == kill:  # dies between its first array and its second
            self._arrays[1] = Deadly()
        write(self, place, leaves)
        done.append(place)
    Store.write = dying
for number, (kind, store, lost) in enumerate(sweeps):
    print("sweep", number, file=sys.stderr, flush=True)
    for file in lost if own == 0 else ():
        os.remove(file)
    if kind == "refused":
        fail(store)
        store, kind = None, "chaotic"
    # Results of the job that dies stay in the store.
    for _ in range(2 if store is None else 1):
        grid = rk.sweep(globals()[kind], store=store, block=100, load=kill < 0, progress=False, **axes)
    leaves = {f"a{k}": leaf for k, leaf in enumerate(jax.tree.leaves(grid.values))}
    np.savez(f"{results}/{own}.{number}.npz", resumed=grid.resumed, processes=jax.process_count(), **leaves)
"""
)


def job(count, out, *sweeps, kill=-1):
    """Start all processes of a job, which do some sweeps; the last one may die. Of every sweep: the results of each
    process, with what it said."""
    out.mkdir()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    environment = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")} | {"JAX_PLATFORMS": "cpu"}
    environment["JAXROCK_CACHE"] = str(out.parent / "kept")  # jobs of one test compile once
    todo = json.dumps([[kind, store and str(store), [*map(str, lost)]] for kind, store, *lost in sweeps])
    processes = []
    for own in range(count):
        words = map(str, (own, count, port, kill if own == count - 1 else -1, out, todo))
        with (out / f"{own}.log").open("w") as log:
            processes.append(
                subprocess.Popen([sys.executable, "-c", WORKER, *words], env=environment, stdout=log, stderr=log)
            )
    try:
        end = time.monotonic() + PATIENCE
        if kill >= 0:
            assert processes[-1].wait(PATIENCE) == -signal.SIGKILL, (out / f"{count - 1}.log").read_text()
            return None
        for own, process in enumerate(processes):
            code = process.wait(max(end - time.monotonic(), 1))
            assert code == 0, (out / f"{own}.log").read_text()
    finally:  # as a scheduler does
        for process in processes:
            process.kill()
            process.wait()
    said = [re.split(r"^sweep \d+\n", (out / f"{own}.log").read_text(), flags=re.M)[1:] for own in range(count)]
    return [
        [dict(np.load(out / f"{own}.{number}.npz")) | {"said": said[own][number]} for own in range(count)]
        for number in range(len(sweeps))
    ]


def bits(results):
    return {name: (values.dtype, values.shape, values.tobytes()) for name, values in results.items() if name[0] == "a"}


ALL = 23 * 31
DAMAGED = (0, 1, 4)  # blocks


@pytest.fixture(scope="module")
def alone():
    """Return the result that one process finds, this one."""
    given = {"rk": rk}
    exec(SWEEPS, given)
    grid = rk.sweep(given["chaotic"], block=100, progress=False, **given["axes"])
    return bits({f"a{k}": np.asarray(leaf) for k, leaf in enumerate(jax.tree.leaves(grid.values))})


def block_of(store, number):
    return store / "x" / "c" / str(number) / "0"


@pytest.fixture(scope="module")
def of_two(tmp_path_factory):
    """Sweeps that a job of two processes does one after the other, by name; and its stores. One of them is of a job
    that was killed, another is damaged once it is finished."""
    pytest.importorskip("zarr")
    folder = tmp_path_factory.mktemp("two")
    stores = {name: folder / f"{name}.zarr" for name in ("killed", "damaged", "refused")}
    job(2, folder / "first", ("chaotic", stores["killed"]), kill=1)
    lost = [block_of(stores["damaged"], number) for number in DAMAGED]
    sweeps = {
        "shared": ("chaotic", stores["damaged"]), "refused": ("refused", stores["refused"]),
        "killed": ("chaotic", stores["killed"], *lost), "damaged": ("chaotic", stores["damaged"]),
    }  # fmt: skip
    return dict(zip(sweeps, job(2, folder / "second", *sweeps.values()))), stores


@pytest.mark.parametrize("count", [2, 4])
def test_processes_share_a_sweep(request, tmp_path, alone, count):
    if count == 2:
        found = request.getfixturevalue("of_two")[0]["shared"]
    else:
        (found,) = job(count, tmp_path / "out", ("chaotic", None))
    assert [int(results["processes"]) for results in found] == [count] * count
    for results in found:
        assert bits(results) == alone


@pytest.mark.parametrize(
    "count, kind",
    [
        (2, "chaotic"),
        pytest.param(2, "outcome", marks=pytest.mark.slow),
        pytest.param(4, "chaotic", marks=pytest.mark.slow),
    ],
)
def test_a_killed_job_goes_on(tmp_path, request, count, kind):
    """The last process dies in the middle of its second block; started again, the job computes only what is missing."""
    pytest.importorskip("zarr")
    store = tmp_path / "a.zarr"
    if kind == "chaotic":
        alone = request.getfixturevalue("alone")
    else:
        alone = bits(job(1, tmp_path / "alone", (kind, None))[0][0])
    if (count, kind) == (2, "chaotic"):
        found = request.getfixturevalue("of_two")[0]["killed"]
    else:
        job(count, tmp_path / "first", (kind, store), kill=1)
        (found,) = job(count, tmp_path / "second", (kind, store))
    for results in found:
        assert bits(results) == alone
        assert 0 < int(results["resumed"]) < ALL
    if kind == "outcome":  # all is there
        for results in job(1, tmp_path / "third", (kind, store))[0]:
            assert bits(results) == alone and int(results["resumed"]) == ALL


def test_a_job_verifies_its_store_together(of_two, alone):
    """Each process looks at some of the blocks; all hear which are damaged, and the first names them."""
    found, stores = of_two
    for own, results in enumerate(found["damaged"]):
        assert bits(results) == alone
        for number in DAMAGED:
            assert (str(block_of(stores["damaged"], number)) in str(results["said"])) == (own == 0)
        assert int(results["resumed"]) == ALL - len(DAMAGED) * 93


def test_a_failure_in_one_process_is_one_in_all(of_two, alone):
    """No other process is left waiting, and the next sweep finds all of them at the same place."""
    for own, results in enumerate(of_two[0]["refused"]):
        assert bits(results) == alone
        refused, full = str(results["said"]).splitlines()[-2:]
        assert refused.startswith("ValueError" if own == 1 else "RuntimeError Process 1 of this job failed: ValueError")
        assert "Argument `p` must be below 3.85" in refused
        assert full.startswith("OSError" if own == 1 else "RuntimeError Process 1 of this job failed: OSError")
        assert "Blocks that are finished are kept" in full


@pytest.mark.slow
def test_processes_share_outcomes(tmp_path):
    alone = bits(job(1, tmp_path / "alone", ("outcome", None))[0][0])
    for results in job(2, tmp_path / "out", ("outcome", None))[0]:
        assert bits(results) == alone
