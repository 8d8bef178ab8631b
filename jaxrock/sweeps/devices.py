"""Devices that share a surface: CPU cores or GPUs of this process, and the other processes of a job."""

import contextlib
import functools
import itertools
import os
import threading
from collections.abc import Callable, Iterator
from typing import Annotated, Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import UInt8

from jaxrock._arguments.annotations import arguments, at_least
from jaxrock._core.precision import setting

# Wide vectors and fused multiply-add; NaN, infinity and division keep IEEE semantics. The engine's tests run with them.
_CPU_OPTIONS = {
    "xla_cpu_prefer_vector_width": 512,
    "xla_cpu_enable_fast_math": True,
    "xla_cpu_fast_math_honor_nans": True,
    "xla_cpu_fast_math_honor_infs": True,
    "xla_cpu_fast_math_honor_division": True,
    "xla_cpu_fast_math_honor_functions": True,
}

_PATIENCE = 7 * 24 * 3600  # seconds a process waits for the others: shares of a sweep may take long


@arguments
def use_cpu_devices(count: Annotated[int | None, at_least(1, 2**16)] = None) -> int:
    """Make every CPU core a device of JAX, so that surfaces are computed on all of them.

    Call it before the first computation. It changes nothing on GPUs.

    **Arguments:**

    - `count`: number of devices, at least 1; None: the cores this process may run on (its CPU affinity).

    **Returns:** the number of devices.

    **Raises:** ValueError for a count below 1; RuntimeError if JAX already computes with another number of devices.
    """
    if count is None:
        count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        jax.config.update("jax_num_cpu_devices", count)
    except RuntimeError as error:  # JAX has chosen its devices
        there = len(jax.local_devices(backend="cpu"))
        if there != count:
            raise RuntimeError(
                f"JAX already computes with {there} CPU device{'s' * (there > 1)}: call `use_cpu_devices` before the "
                f"first computation to have {count}."
            ) from error
    return count


def local_devices() -> tuple[jax.Device, ...]:
    """Return the devices of this process that share the work: those of the default backend, or the default device."""
    chosen = setting("jax_default_device")
    return (chosen,) if isinstance(chosen, jax.Device) else tuple(jax.local_devices(backend=chosen))


@functools.cache
def compiler_options(platform: str) -> dict | None:
    """Return options of a compiled call if this platform and this jaxlib support them."""
    if platform != "cpu":
        return None
    try:
        jax.jit(lambda x: x + 1, compiler_options=_CPU_OPTIONS)(1.0)
    except Exception:  # jaxlib reports an unknown option by an internal error type
        return None
    return _CPU_OPTIONS


# All processes of a job run the same program, and synchronise where it calls `barrier`.


def process() -> tuple[int, int]:
    """Return the index of this process, and the number of processes."""
    return jax.process_index(), jax.process_count()


_meetings = itertools.count()
_sharing = threading.RLock()


@contextlib.contextmanager
def shared_out() -> Iterator[None]:
    """Guard work that many processes share: each process runs one such piece of work at a time.

    Processes match their barriers by the order of the calls, so two threads must not mix theirs.

    **Raises:** RuntimeError where another thread is at such work.
    """
    if jax.process_count() == 1:
        yield
        return
    if not _sharing.acquire(blocking=False):
        raise RuntimeError("A job of many processes shares one sweep at a time, but another thread is at one.")
    try:
        yield
    finally:
        _sharing.release()


def barrier() -> None:
    """Wait until all processes have called this function."""
    if jax.process_count() == 1:
        return
    # A collective of devices gives up after some seconds; the service that started the processes waits.
    from jax._src.distributed import global_state

    client: Any = global_state.client
    client.wait_at_barrier(f"jaxrock-{next(_meetings)}", _PATIENCE * 1000)


_SAID = 400  # bytes of an error message that reach the other processes


@contextlib.contextmanager
def all_or_none() -> Iterator[None]:
    """Run a part in every process, then synchronise: an error in one process is raised in all.

    Without this the other processes would wait for the failed one. An interrupt is not passed on, because its process
    would have to wait for the others.

    **Raises:** RuntimeError where another process failed, with its message.
    """
    if jax.process_count() == 1:
        yield
        return
    try:
        yield
    except Exception as error:
        _heard(f"{type(error).__name__}: {error}")
        raise
    for number, said in enumerate(_heard("")):
        if said:
            raise RuntimeError(f"Process {number} of this job failed: {said}")


def _heard(said: str) -> list[str]:
    """Exchange a short message with all processes; return all messages."""
    barrier()
    brought = np.zeros(_SAID, np.uint8)
    told = np.frombuffer(said.encode()[:_SAID], np.uint8)
    brought[: told.size] = told
    return [row.tobytes().rstrip(b"\0").decode(errors="ignore") for row in exchange(brought)]


def exchange(own: UInt8[np.ndarray, " bytes"]) -> UInt8[np.ndarray, "processes bytes"]:
    """Return an array of every process to all of them; the length is equal everywhere."""
    mesh, copy = _one_device_each()
    dealt = NamedSharding(mesh, PartitionSpec("processes"))
    here = jax.device_put(own[None], mesh.local_devices[0])
    brought = jax.make_array_from_single_device_arrays((jax.process_count(), own.size), dealt, [here])
    return np.asarray(copy(brought).addressable_data(0))


@functools.cache
def _one_device_each() -> tuple[Mesh, Callable]:
    """Return a mesh of one device per process, and a function that copies an array across it to all.

    Processes may differ in their number of devices.
    """
    first = {device.process_index: device for device in reversed(jax.devices())}
    mesh = Mesh(np.array([first[number] for number in sorted(first)]), ("processes",))
    return mesh, jax.jit(lambda x: x, out_shardings=NamedSharding(mesh, PartitionSpec()))
