"""All tests run in double precision."""

import json
from pathlib import Path

import jax
import matplotlib
import pytest

jax.config.update("jax_enable_x64", True)
matplotlib.use("Agg")


@pytest.fixture(scope="session")
def references():
    """Reference values from 200-bit integrations (see the file's `about`)."""
    return json.loads((Path(__file__).parent / "references.json").read_text())
