"""All tests run in double precision, on two devices, so that surfaces are shared out."""

import gc
import json
from pathlib import Path

import jax
import matplotlib
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 2)
matplotlib.use("Agg")


@pytest.fixture(autouse=True)
def few_compiled_programs():
    """Forget compiled programs before they are too many: each maps pages, and past 65,530 maps XLA crashes on Linux."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > 30_000:
        jax.clear_caches()
        gc.collect()


@pytest.fixture(scope="session")
def references():
    """Reference values from 200-bit integrations (see the file's `about`)."""
    return json.loads((Path(__file__).parent / "references.json").read_text())
