"""The compiler beside ordinary JAX (`JAXROCK_COMPILER=off`) on the scenes of the references."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]

RUN = """
import json, sys
import jax, jax.numpy as jnp, numpy as np
import jaxrock as rk
from references.in_jaxrock import MODELS, PULSES

kind, model, derivatives = sys.argv[1], MODELS[sys.argv[2]], sys.argv[3] == "derivatives"
rows = json.load(open("references/derivatives.json"))["scenes"]
rows = [row for row in rows if (row["kind"], row["model"]) == (kind, sys.argv[2]) and "max_rotation" in row]
x = np.array([row["block"] + row["motion"] for row in rows])


def scene(x):
    motion = x[3] * rk.example_record() if kind == "record" else PULSES[kind](*[x[k] for k in range(3, x.size)])
    return rk.outcome(rk.Block(x[0], x[1], x[2]), motion, model)


def results(x):
    found = scene(x)
    return jnp.stack([found.max_rotation, found.max_velocity, found.time_of_max, found.margin])


found = jax.jit(jax.vmap(scene))(x)
told = {name: np.asarray(getattr(found, name)).tolist() for name in ("overturned", "impact_count")}
told["numbers"] = np.asarray(jax.jit(jax.vmap(results))(x)).tolist()
told["good"] = bool(np.all(found.status == rk.Status.successful))
if derivatives:
    told["slopes"] = np.asarray(jax.jit(jax.vmap(jax.jacfwd(results)))(x)).tolist()
print(json.dumps(told))
"""


def told(backend, *words):
    done = subprocess.run(
        [sys.executable, "-c", RUN, *words], cwd=ROOT, capture_output=True, text=True, timeout=1200,
        env=os.environ | {
            "JAXROCK_COMPILER": backend, "JAX_ENABLE_X64": "1", "JAX_PLATFORMS": "cpu", "JAXROCK_CACHE": "off",
            "PYTHONPATH": str(ROOT),
        },
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind, model, derivatives, tolerance",
    [
        ("sine", "nonlinear", "derivatives", 1e-13),
        ("exponential", "linear", "derivatives", 1e-13),
        ("cosine", "nonlinear", "", 1e-13),
        ("record", "nonlinear", "", 1e-12),
    ],
)
def test_ordinary_jax_gives_the_same_numbers(kind, model, derivatives, tolerance):
    """A difference of one rounding grows with every impact, of which scenes of the record have up to 150."""
    with_compiler, without = (told(backend, kind, model, derivatives) for backend in ("on", "off"))
    assert with_compiler["good"] and without["good"]
    assert with_compiler["overturned"] == without["overturned"]
    assert with_compiler["impact_count"] == without["impact_count"]
    one, other = (np.array(each["numbers"]) for each in (with_compiler, without))
    assert one.shape[0] >= 15
    np.testing.assert_allclose(one, other, rtol=tolerance)
    if derivatives:
        one, other = (np.array(each["slopes"]) for each in (with_compiler, without))
        scale = np.maximum(np.abs(one), 1e-3 * np.abs(one).max(axis=2, keepdims=True))
        assert np.max(np.abs(one - other) / scale) < 1e-11
