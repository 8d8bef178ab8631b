"""Let JAX cache what XLA compiles in the package's cache folder, and let XLA compile in less time."""

import os
from pathlib import Path

import jax
import jaxlib

from jaxrock._core.precision import setting
from jaxrock.compiler.cache.ownership import is_open, warn_once
from jaxrock.compiler.cache.store import LARGEST, OF_JAX, folder, folder_of, of_jax, remove

_EMITTERS = "--xla_cpu_use_fusion_emitters"
_LAST = (0, 10)  # jaxlib with this option; 0.11.2 and 0.12 end the process at an unknown option


def keep_compiled() -> None:
    """Let JAX compile in less time, and cache on disk what it compiles, for other sessions.

    Call it before the first computation. It does nothing where JAX has a cache already, where the folder cannot be
    written, and under `JAXROCK_CACHE=off`. The package's own machine code and programs are cached without it.

    It sets options of JAX (`jax_compilation_cache_dir` and its limits) and one of XLA (in `XLA_FLAGS`, unless that
    already sets it). They hold for all that this process compiles. The last digits of XLA's results may change.

    Cached code runs as a part of later programs. So the folder must belong to the user, or to root, and only its owner
    may write in it. Others must not be able to write in its parents. Otherwise nothing is cached, and a warning says
    why.
    """
    compile_quickly()
    if setting("jax_compilation_cache_dir"):
        return
    place = _place_of_jax()
    if place is None or not os.access(place, os.W_OK):
        return
    jax.config.update("jax_compilation_cache_dir", str(place))
    jax.config.update("jax_compilation_cache_max_size", LARGEST)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def _place_of_jax() -> Path | None:
    """Return the cache folder of JAX; None where JAX would run files of other users there.

    JAX reads all files in it, of any owner, and deletes those that have its names. So files that lay there while others
    could write in it are removed first.
    """
    place = folder()
    if place is None:
        return None
    was_open = is_open(place / OF_JAX)
    place = folder_of(OF_JAX, make=True)
    made, others = of_jax()
    for path in made if was_open else ():
        remove(path)
    if others:
        return warn_once(f"{others[0]} was not made by jaxrock, or belongs to another user")
    return place


def compile_quickly() -> None:
    """Switch off XLA's newer emitters of fused loops, for the whole process.

    They take a third to half of the time in which XLA compiles programs of scalars, and their code is no faster. An
    ODE solve by Diffrax compiles in 9.8 s of processor time with them and in 5.0 s without. The gradient of a closed
    form takes 3.1 and 2.1 s.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if _EMITTERS not in flags and jaxlib.version.__version_info__[:2] <= _LAST:
        os.environ["XLA_FLAGS"] = f"{flags} {_EMITTERS}=false".strip()
