"""The door of the compiler: its examples, and functions whose values and slopes have closed forms."""

import importlib.util
import inspect
import logging
import math
import os
import re
import subprocess
import sys
import types
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock.compiler
import jaxrock.numerics.elementary  # what machine code computes sines by
from jaxrock.compiler import checks, cond_any, custom_tangent, elementwise, hints, lane_function

README = (Path(jaxrock.compiler.__file__).parent / "README.md").read_text()
SNIPPETS = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
FUNCTIONS = ("lane_function", "elementwise", "custom_tangent", "MacroPrimitive", "cond_any", "trace_function")
has_llvm = importlib.util.find_spec("llvmlite") is not None


@pytest.fixture(scope="module")
def told():
    """Return the names that the README's snippets define, run one after the other as a module."""
    module = sys.modules["readme"] = types.ModuleType("readme")  # where rules find their functions
    for snippet in SNIPPETS:
        exec(compile(snippet, "README.md", "exec"), module.__dict__)
    return module


def bounces(v, e):
    """Return how often a ball bounces higher than a millimetre."""
    return np.ceil(np.log(math.sqrt(2 * 9.81e-3) / v) / math.log(e))


def test_a_ball_bounces_as_the_sum_of_a_geometric_series(told):
    v, e = np.asarray(told.speeds), told.restitution
    expected = 2 * v / 9.81 * (1 - e ** bounces(v, e)) / (1 - e)
    np.testing.assert_allclose(told.times, expected, rtol=1e-13)
    np.testing.assert_allclose(told.slopes, expected / v, rtol=1e-13)


def test_kepler(told):
    mean, e = np.linspace(0.0, 3.0, 500), 0.6
    found = np.asarray(told.anomalies)
    np.testing.assert_allclose(found - e * np.sin(found), mean, atol=2e-14)
    root = float(told.eccentric_anomaly(1.0, 0.6))
    assert float(told.slope) == pytest.approx(math.sin(root) / (1 - 0.6 * math.cos(root)), rel=1e-13)
    second = jax.grad(jax.grad(told.eccentric_anomaly))(1.0, 0.6)
    assert float(second) == pytest.approx(-0.6 * math.sin(root) / (1 - 0.6 * math.cos(root)) ** 3, rel=1e-12)


@pytest.mark.skipif(not has_llvm, reason="needs llvmlite")
def test_the_examples_are_machine_code(told, caplog):
    with caplog.at_level(logging.DEBUG, "jaxrock"):
        jax.jit(jax.vmap(lambda v: lane_function(told.bouncing, in_lanes=True, refill=True)((v, 0.8))))(jnp.ones(70))
    assert "left to XLA" not in caplog.text


@pytest.mark.parametrize("name", FUNCTIONS)
def test_docstrings_of_the_door_say_all(name):
    """One sentence, arguments, and an example that runs, as a module of its own."""
    said = inspect.getdoc(getattr(jaxrock.compiler, name))
    assert said and said.split("\n")[0].endswith(".") and "**Arguments:**" in said
    assert "**Returns:**" in said or name == "MacroPrimitive"
    (example,) = re.findall(r"```python\n(.*?)```", said, re.DOTALL)
    module = sys.modules[f"example_{name}"] = types.ModuleType(f"example_{name}")
    exec(compile(example, name, "exec"), module.__dict__)


def collatz(n):
    """Return how many steps the sequence of Collatz takes from a whole number, held as a float."""

    def step(state):
        n, count = state
        return jnp.where(n % 2 == 0, n / 2, 3 * n + 1), count + 1

    return jax.lax.while_loop(lambda state: state[0] > 1, step, (n, jnp.zeros((), jnp.int32)))[1]


def steps_of_collatz(n):
    count = 0
    while n > 1:
        n, count = (n // 2 if n % 2 == 0 else 3 * n + 1), count + 1
    return count


@pytest.mark.parametrize("refill", [False, True], ids=["in step", "refilled"])
@pytest.mark.parametrize("count", [1, 7, 65, 1000])
def test_lanes_that_take_very_different_numbers_of_steps(count, refill):
    run = lane_function(collatz, in_lanes=True, refill=refill)
    found = jax.jit(jax.vmap(run))(jnp.arange(1.0, count + 1))
    np.testing.assert_array_equal(found, [steps_of_collatz(n) for n in range(1, count + 1)])


def logistic(tree):
    """Return x after 20 turns of x <- r x (1 - x)."""
    return jax.lax.while_loop(lambda s: s[0] < 20, lambda s: (s[0] + 1, tree["r"] * s[1] * (1 - s[1])), (0, tree["x"]))[
        1
    ]


def unrolled(tree):
    x = tree["x"]
    for _ in range(20):
        x = tree["r"] * x * (1 - x)
    return x


TREE = {"r": 3.2, "x": 0.3}


@pytest.mark.parametrize("transform", [jax.grad, jax.jacfwd, jax.hessian, lambda f: jax.jacrev(jax.grad(f))])
@pytest.mark.parametrize("mode", ["jacobian", "jacobian or jvp", "jacobian by columns"])
def test_derivatives_are_those_of_jax(transform, mode):
    found = transform(lane_function(logistic, mode=mode, in_lanes=True))(TREE)
    expected = transform(unrolled)(TREE)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-11)


def test_a_mode_is_known():
    with pytest.raises(ValueError, match="'sideways' is not a valid Mode"):
        lane_function(logistic, mode="sideways")


def _cubed(values, by, tangents):
    (tangent,) = tangents
    return None if tangent is None else 3 * by[0] ** 2 * tangent


def test_closures_are_no_two_names_for_one():
    """Functions of one maker share their qualified name."""

    def adder(c):
        @elementwise()
        def added(x):
            return x + c

        return added

    assert [float(f(1.0)) for f in map(adder, (1.0, 2.0))] == [2.0, 3.0]


def test_numbers_of_python_may_enter_a_branch():
    def of(x):
        return cond_any(x > 0, lambda value, needed, inside: value + inside(2.0), x)

    np.testing.assert_array_equal(jax.vmap(of)(jnp.array([-1.0, 1.0])), [-1.0, 3.0])


def test_a_rule_is_used_for_all_orders():
    def cube(x):
        return custom_tangent(_cubed, jax.lax.stop_gradient(x**3), (x,))

    assert [float(f(2.0)) for f in (cube, jax.grad(cube), jax.grad(jax.grad(cube)))] == [8.0, 12.0, 12.0]


def test_checks_raise_or_are_collected():
    def root(x):
        return jnp.sqrt(checks.error_if(x, x < 0, "Argument `x` must not be negative"))

    with pytest.raises(ValueError, match="^Argument `x` must not be negative.$"):
        root(-1.0)
    found = jax.jit(checks.with_checks(root))(-1.0)
    assert found.messages == ("Argument `x` must not be negative",) and bool(found.failed[0])


def test_elementwise_broadcasts_and_checks():
    def positive(name, value):
        if np.min(value) <= 0:
            raise ValueError(f"Argument `{name}` must be positive.")
        return jnp.asarray(value, float)

    @elementwise(b=positive)
    def ratio(a, b):
        return a / b

    np.testing.assert_array_equal(ratio(np.ones((3, 1)), np.array([1.0, 2.0])), np.ones((3, 1)) / [1.0, 2.0])
    with pytest.raises(ValueError, match="Argument `b` must be positive"):
        ratio(1.0, [1.0, -2.0])


def test_hints_change_no_value():
    x = jnp.linspace(0.1, 1.0, 5)
    np.testing.assert_array_equal(hints.materialize(x, x), x)
    np.testing.assert_array_equal(hints.divergent(x > 0.5), x > 0.5)
    np.testing.assert_array_equal(hints.select(x > 0.5, x, -x), jnp.where(x > 0.5, x, -x))
    assert not bool(hints.supports_divergence())
    assert float(jax.grad(lambda x: hints.stop_gradient((x, x))[0] * x)(3.0)) == 3.0


OFF = """
import jax
from jaxrock.compiler import lane_function
from test_door import TREE, logistic
hessian = jax.jit(jax.hessian(lane_function(logistic, in_lanes=True)))
print([float(x) for x in jax.tree.leaves(hessian(TREE))])
print("lane_map" in str(jax.make_jaxpr(lane_function(logistic, in_lanes=True))(TREE)))
"""


def test_off_is_ordinary_jax():
    """Check that `jax.custom_jvp` alone gives these numbers."""
    told = []
    for state in ("on", "off"):
        done = subprocess.run(
            [sys.executable, "-c", OFF], cwd=Path(__file__).parent, capture_output=True, text=True, timeout=300,
            env=os.environ | {
                "JAXROCK_COMPILER": state, "JAX_ENABLE_X64": "1", "JAX_PLATFORMS": "cpu",
                "PYTHONPATH": str(Path(jaxrock.compiler.__file__).parents[2]),
            },
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        numbers, is_compiled = done.stdout.splitlines()
        assert is_compiled == str(state == "on")
        told.append([float(x) for x in numbers.strip("[]").split(", ")])
    np.testing.assert_allclose(told[1], told[0], rtol=1e-11)
