"""Processes of a sweep that are killed at random moments: what they leave is gone on with, to the last bit.

`python -m references.kills 200` kills as many processes, four at a time, of which one half share a job and the other
half know nothing of each other; whenever a store is finished its files are held against those of an undisturbed run.
"""

import argparse
import collections
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax
import numpy as np

from references.damage import swept

AXES = {"alpha": np.linspace(0.08, 0.3, 40), "p": np.linspace(1.0, 4.5, 100)}
POINTS = 4000
ROOT = Path(__file__).parents[1]
PATIENCE = 300  # seconds for a job that nobody disturbs


class Job:
    """Some processes of one sweep; `shared`: they are a job of JAX, else each is alone."""

    def __init__(self, count: int, store: Path, shared: bool, block: int):
        self.begun = [store.parent / f"begun.{time.monotonic_ns()}.{own}" for own in range(count)]
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1] if shared else 0
        kept = {key: value for key, value in os.environ.items() if not key.startswith(("JAX_", "XLA_"))}
        environment = kept | {
            "JAX_PLATFORMS": "cpu", "JAXROCK_CACHE": str(store.parent / "cache"),
            "PYTHONPATH": os.pathsep.join([str(ROOT), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]),
        }  # fmt: skip
        self.logs = [store.parent / f"{begun.name}.log" for begun in self.begun]
        self.processes = []
        for own, (begun, log) in enumerate(zip(self.begun, self.logs)):
            words = [sys.executable, "-m", "references.kills", "0", "--work", own, count, port, block, store, begun]
            with log.open("w") as out:
                self.processes.append(
                    subprocess.Popen(list(map(str, words)), cwd=ROOT, env=environment, stdout=out, stderr=out)
                )

    def killed(self, delays: np.ndarray) -> int:
        """Kill each, so many seconds after all have come to their sweep; how many were alive to be killed."""
        end = time.monotonic() + PATIENCE
        while not all(file.exists() for file in self.begun) and time.monotonic() < end:
            if any(process.poll() for process in self.processes):
                break
            time.sleep(0.005)
        start = time.monotonic()
        for own in np.argsort(delays):
            time.sleep(max(0.0, start + delays[own] - time.monotonic()))
            self.processes[own].kill()
        return sum(process.wait() == -signal.SIGKILL for process in self.processes)

    def finished(self) -> float:
        """Wait for all of them; seconds since they came to their sweep."""
        try:
            for process, log in zip(self.processes, self.logs):
                assert process.wait(PATIENCE) == 0, log.read_text()
            return time.time() - max(file.stat().st_mtime for file in self.begun)
        finally:
            for process in self.processes:
                process.kill()
                process.wait()


def files(store: Path) -> dict[str, bytes]:
    """All files of a store; not what was under way when a process was killed."""
    found = [path for path in store.rglob("*") if path.is_file() and path.suffix != ".partial"]
    return {str(path.relative_to(store)): path.read_bytes() for path in found}


def attack(kills: int, seed: int = 0, count: int = 4, block: int = 100) -> collections.Counter:
    """Kill processes, some at a time, until so many were; after every few, finish the store and compare it.

    **Arguments:**

    - `count`: processes at a time.
    - `block`: points of a block; there are 4,000.
    """
    rng, found = np.random.default_rng(seed), collections.Counter()
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        Job(1, folder / "alone.zarr", False, block).finished()
        right = files(folder / "alone.zarr")
        longest = Job(count, folder / "undisturbed.zarr", True, block).finished()
        assert files(folder / "undisturbed.zarr") == right
        store = folder / "0.zarr"
        while found["kills"] < kills:
            shared = bool(found["rounds"] % 2)
            killed = Job(count, store, shared, block).killed(longest * rng.random(count))
            found["kills"] += killed
            found["kills of jobs"] += killed * shared
            found["rounds"] += 1
            there = files(store)
            done = sum(name.startswith("jaxrock_blocks/c/") for name in there)
            found["stores left unfinished"] += 0 < done < POINTS // block
            # What is finished may be looked at, or gone on with; one that is not has to be gone on with.
            if found["kills"] >= kills or done == POINTS // block or rng.random() < 0.25:
                job = Job(count, store, not shared, block)
                job.finished()
                assert files(store) == right, f"seed {seed}, round {found['rounds']}: other bytes"
                assert not any("damaged" in log.read_text() for log in job.logs), "something was damaged"
                found["stores compared"] += 1
                store = folder / f"{found['stores compared']}.zarr"
    return found


def work(own: int, count: int, port: int, block: int, store: str, begun: str) -> None:
    """Run the sweep in one of the processes."""
    jax.config.update("jax_enable_x64", True)
    import jaxrock as rk

    rk.keep_compiled()
    if port:
        jax.distributed.initialize(f"127.0.0.1:{port}", count, own, initialization_timeout=100)
    Path(begun).touch()
    swept(Path(store), axes=AXES, block=block, load=False)


def main() -> None:
    """Kill many, and say how many."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kills", type=int)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--work", nargs=6, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.work:
        *numbers, store, begun = given.work
        return work(*map(int, numbers), store, begun)
    for what, often in attack(given.kills, given.seed).items():
        print(f"{often:6d}  {what}")


if __name__ == "__main__":
    main()
