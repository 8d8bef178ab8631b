"""What XLA compiles is kept by JAX itself, in the same folder, if it is asked to."""

import os

import jax

from jaxrock._precision import setting
from jaxrock.keeping.folder import LARGEST, OF_JAX, folder


def keep_compiled() -> None:
    """Let JAX keep on disk what it compiles, so that it need not compile it again in another session.

    Call it before the first computation; it does nothing where JAX keeps that already, where the folder cannot be
    written, and where the environment says `JAXROCK_CACHE=off`. Machine code and programs of the package's own are kept
    without it. It sets options of JAX (`jax_compilation_cache_dir` and its limits), for all that this process compiles.
    """
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
