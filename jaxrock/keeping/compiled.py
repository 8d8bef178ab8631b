"""What XLA compiles is kept by JAX itself, in the same folder, if it is asked to; and compiled in less time."""

import os

import jax
import jaxlib

from jaxrock._precision import setting
from jaxrock.keeping.folder import LARGEST, OF_JAX, folder

_EMITTERS = "--xla_cpu_use_fusion_emitters"
_LAST = (0, 10)  # of the jaxlibs that know it; in 0.11.2 and 0.12 an option that is not known ends the program


def keep_compiled() -> None:
    """Let JAX compile in less time, and keep on disk what it compiles, for other sessions.

    Call it before the first computation; it keeps nothing where JAX does that already, where the folder cannot be
    written, and where the environment says `JAXROCK_CACHE=off`. Machine code and programs of the package's own are kept
    without it. It sets options of JAX (`jax_compilation_cache_dir` and its limits) and one of XLA (in `XLA_FLAGS`, if
    that says nothing of it), for all that this process compiles; last digits of what XLA computes may change by it.
    """
    compile_quickly()
    place = folder()
    if place is None or setting("jax_compilation_cache_dir"):
        return
    place = place / OF_JAX
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    if not os.access(place, os.W_OK):
        return
    jax.config.update("jax_compilation_cache_dir", str(place))
    jax.config.update("jax_compilation_cache_max_size", LARGEST)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def compile_quickly() -> None:
    """XLA's newer emitters of fused loops take a third to half of the time in which it compiles programs of scalars as
    these are (an outcome by Diffrax 9.8 s of processor time with them and 5.0 s without, the gradient of a closed form
    3.1 and 2.1 s), and what they emit is no faster."""
    flags = os.environ.get("XLA_FLAGS", "")
    if _EMITTERS not in flags and jaxlib.version.__version_info__[:2] <= _LAST:
        os.environ["XLA_FLAGS"] = f"{flags} {_EMITTERS}=false".strip()
