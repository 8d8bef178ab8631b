"""Many processes: a sweep gives the same bits however many share it, and goes on after one of them was killed.

The processes are those of one machine, which talk over its loopback as machines do over a network.
"""

import os
import shutil
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest

PATIENCE = 240  # seconds; all of it takes some ten

# Every process of a job runs this: own number, number of processes, port, folder, function, block at which to die.
WORKER = """
import os, signal, sys
import jax
jax.config.update("jax_enable_x64", True)
own, count, port, kill = int(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), int(sys.argv[6])
folder, kind = sys.argv[4:6]
import jaxrock as rk
if count > 1:
    jax.distributed.initialize(f"127.0.0.1:{port}", count, own, initialization_timeout=100)
rk.studies.use_cpu_devices(1 + own % 2)
import jax.numpy as jnp
import numpy as np
from jaxrock._checks import checked
from jaxrock.sweeps.store import Store

def chaotic(alpha, p):
    x, steps = jax.lax.while_loop(
        lambda s: (s[0] < 0.99) & (s[1] < 50), lambda s: (p * s[0] * (1 - s[0]), s[1] + 1), (alpha, 0)
    )
    return {"x": jnp.sin(x), "steps": steps, "above": x > 0.5, "pair": jnp.stack([x, alpha])}

motion = rk.Record(0.4 * np.sin(np.linspace(0, 14, 120)), 0.02)

def outcome(alpha, p):
    return rk.outcome(rk.Block(alpha, p), motion)

def refused(alpha, p):
    return chaotic(checked("p", p, "be below 3.85", lambda p: p < 3.85), 1.0)

store = None if folder == "-" else folder
if kind == "refused":  # one process fails, and the other hears of it
    side = dict(p=np.linspace(1.0, 3.9, 31), alpha=np.ones(31), outer=False, progress=False)
    def full(self, number, leaves):
        raise OSError(28, "No space left")
    for folder, own_write in ((None, Store.write), (store, full if own == 1 else Store.write)):
        Store.write = own_write
        try:
            rk.sweep(refused if folder is None else chaotic, store=folder, block=16, **side)
        except Exception as error:
            print(type(error).__name__, error, flush=True)
    store, kind = None, "chaotic"
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
axes = dict(alpha=np.linspace(0.05, 0.3, 23), p=np.linspace(1.0, 3.9, 31))
for _ in range(2 if store is None else 1):
    # Results of the job that dies stay in the store.
    grid = rk.sweep(globals()[kind], store=store, block=100, load=kill < 0, progress=False, **axes)
leaves = {f"a{k}": leaf for k, leaf in enumerate(jax.tree.leaves(grid.values))}
np.savez(f"{sys.argv[7]}/{own}.npz", resumed=grid.resumed, processes=jax.process_count(), **leaves)
"""


def job(count, folder, out, kind="chaotic", kill=-1):
    """Start all processes of a job; the last one may die. Results of each, or how many blocks there were at the end."""
    out.mkdir()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XLA_"))} | {"JAX_PLATFORMS": "cpu"}
    environment["JAXROCK_CACHE"] = str(out.parent / "kept")  # jobs of one test compile once
    processes = []
    for own in range(count):
        dies = kill if own == count - 1 else -1
        words = map(str, (own, count, port, folder, kind, dies, out))
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
    return [dict(np.load(out / f"{own}.npz")) for own in range(count)]


def bits(results):
    return {name: (values.dtype, values.shape, values.tobytes()) for name, values in results.items() if name[0] == "a"}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A store that one process has made, with its results."""
    pytest.importorskip("zarr")
    folder = tmp_path_factory.mktemp("job")
    return folder / "a.zarr", bits(job(1, folder / "a.zarr", folder / "alone")[0])


@pytest.fixture(scope="module")
def alone(finished):
    return finished[1]


@pytest.mark.parametrize("count", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_processes_share_a_sweep(tmp_path, alone, count):
    found = job(count, "-", tmp_path / "out")
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
    if kind == "chaotic":
        alone = request.getfixturevalue("alone")
    else:
        alone = bits(job(1, "-", tmp_path / "alone", kind)[0])
    store = tmp_path / "a.zarr"
    job(count, store, tmp_path / "first", kind, kill=1)
    for results in job(count, store, tmp_path / "second", kind):
        assert bits(results) == alone
        assert 0 < int(results["resumed"]) < 23 * 31
    if kind == "outcome":  # all is there
        for results in job(1, store, tmp_path / "third", kind):
            assert bits(results) == alone and int(results["resumed"]) == 23 * 31


def test_a_job_verifies_its_store_together(tmp_path, finished):
    """Each process looks at some of the blocks; all hear which are damaged, and the first names them."""
    whole, alone = finished
    store = shutil.copytree(whole, tmp_path / "a.zarr")
    for number in (0, 1, 4):
        (store / "x" / "c" / str(number) / "0").unlink()
    for own, results in enumerate(job(2, store, tmp_path / "second")):
        assert bits(results) == alone
        said = (tmp_path / "second" / f"{own}.log").read_text()
        assert all((str(store / "x" / "c" / f"{number}" / "0") in said) == (own == 0) for number in (0, 1, 4))
        assert int(results["resumed"]) == 23 * 31 - 3 * 93


def test_a_failure_in_one_process_is_one_in_all(tmp_path, alone):
    """No other process is left waiting, and the next sweep finds all of them at the same place."""
    for own, results in enumerate(job(2, tmp_path / "a.zarr", tmp_path / "out", "refused")):
        assert bits(results) == alone
        refused, full = (tmp_path / "out" / f"{own}.log").read_text().splitlines()[-2:]
        assert refused.startswith("ValueError" if own == 1 else "RuntimeError Process 1 of this job failed: ValueError")
        assert "Argument `p` must be below 3.85" in refused
        assert full.startswith("OSError" if own == 1 else "RuntimeError Process 1 of this job failed: OSError")
        assert "Blocks that are finished are kept" in full


@pytest.mark.slow
def test_processes_share_outcomes(tmp_path):
    alone = bits(job(1, "-", tmp_path / "alone", "outcome")[0])
    for results in job(2, "-", tmp_path / "out", "outcome"):
        assert bits(results) == alone
