"""All tests run in double precision, on two devices, so that surfaces are shared out.

Shapes in annotations are checked on every call, where a module states any, and but for the innermost arithmetic: its
functions are called thousands of times while a program is traced, and a check takes longer than what it checks. With
JAXROCK_CHECK_ALL=1 they are checked everywhere.

XLA compiles as after `keep_compiled`, which takes a quarter less time; with `XLA_FLAGS=` as it does by itself.
"""

import gc
import importlib
import importlib.util
import json
import os
from pathlib import Path

import jax
import matplotlib
import pytest
from jaxtyping import install_import_hook

INNERMOST = {"polynomial", "expansion", "lookup", "elementary"}


def checked_modules():
    """Modules of the package (not imported yet) whose annotations are checked."""
    package = Path(importlib.util.find_spec("jaxrock").origin).parent
    for path in sorted(package.rglob("*.py")):
        shapes = "from jaxtyping import" in path.read_text()
        if os.environ.get("JAXROCK_CHECK_ALL") == "1" or (shapes and path.stem not in INNERMOST):
            yield ".".join(["jaxrock", *path.relative_to(package).with_suffix("").parts])


install_import_hook(list(checked_modules()), "beartype.beartype")

# Programs of a hundred thousand operations are traced, and little of what that makes is garbage: look less often.
gc.set_threshold(200_000, 10, 10)

if "XLA_FLAGS" not in os.environ:
    importlib.import_module("jaxrock.keeping.compiled").compile_quickly()
os.environ["JAXROCK_CACHE"] = "off"  # tests compile anew what they test
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 2)
matplotlib.use("Agg")


_MOST_GROWTH = 2.5e9  # bytes of compiled programs
_held = [0.0]  # by the process when they were last forgotten


def _memory() -> float:
    """Bytes that this process holds; zero where that cannot be told."""
    told = Path("/proc/self/statm")
    return int(told.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") if told.exists() else 0.0


@pytest.fixture(autouse=True)
def few_compiled_programs():
    """Forget compiled programs before they are too many: each takes memory, and maps pages, and past 65,530 maps XLA
    crashes on Linux."""
    yield
    maps = Path("/proc/self/maps")
    many = maps.exists() and maps.read_bytes().count(b"\n") > 30_000
    if many or _memory() > _held[0] + _MOST_GROWTH:
        jax.clear_caches()
        gc.collect()
        _held[0] = _memory()


@pytest.fixture(scope="session")
def references():
    """Reference values from 200-bit integrations (see the file's `about`)."""
    return json.loads((Path(__file__).parents[1] / "references" / "papers.json").read_text())
