"""Compiled programs that are kept between calls of the command line, and the command `jaxrock cache`."""

import argparse
import os
import shutil
from pathlib import Path

import jax
import platformdirs

from jaxrock.command_line.command import Command

_LARGEST = 2**30  # bytes; what has not been used for longest goes first


def folder() -> Path | None:
    """Where compiled programs are kept: the user's cache folder, or what JAXROCK_CACHE says; None if that is `off`."""
    said = os.environ.get("JAXROCK_CACHE", "")
    if said == "off":
        return None
    return Path(said) if said else platformdirs.user_cache_path("jaxrock") / "compiled"


def keep_compiled() -> None:
    """Let JAX keep what it compiles, for the next call, unless it keeps that already or cannot."""
    place = folder()
    if place is None or jax.config.jax_compilation_cache_dir:
        return
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    if not os.access(place, os.W_OK):
        return
    jax.config.update("jax_compilation_cache_dir", str(place))
    jax.config.update("jax_compilation_cache_max_size", _LARGEST)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--clear", action="store_true", help="delete them")


def _run(arguments: argparse.Namespace) -> int:
    place = folder()
    if place is None:
        print("nothing is kept: JAXROCK_CACHE is off")
        return 0
    files = [file for file in place.rglob("*") if file.is_file()] if place.is_dir() else []
    size = sum(file.stat().st_size for file in files) / 2**20
    programs = sum(file.name.endswith("-cache") for file in files)
    if arguments.clear:
        shutil.rmtree(place, ignore_errors=True)
    print(f"{programs} compiled programs, {size:.1f} MiB, {'deleted from' if arguments.clear else 'in'} {place}")
    return 0


CACHE = Command("cache", "compiled programs that are kept between calls", _add_options, _run, computes=False)
