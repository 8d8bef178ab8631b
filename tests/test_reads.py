"""Dependencies of a function: known where no hidden change is possible, and then traced once; else at every call."""

import functools
import math
import os

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock._core.throwing import throwing
from jaxrock.compiler import trace_function
from jaxrock.compiler.cache.dependency_key import dependency_key
from jaxrock.compiler.jaxpr.traced_function import TracedFunction

BLOCK, RECORD = rk.Block(0.2, 2.0, 0.9), rk.Record([0.1, 0.2], 0.1)
SIZE, ARRAY, PAIR = 2.0, jnp.ones(2), (1, (2.0, "b"))
CHANGING, LIST = np.ones(2), [1.0]
SCALED, BENT = 2.0 * RECORD, rk.models.Equation(lambda x, block: jnp.sin(block.alpha - x))
LISTED = rk.models.Equation(lambda x, block: reading_lists(block.alpha - x))
UFUNC = np.frompyfunc(lambda x: LIST[0] * x, 1, 1)
POINT = {"x": jax.ShapeDtypeStruct((), np.dtype(float))}


class Holder:
    size = 1.0

    def method(self, x):
        return self.size * x


class Sized(eqx.Module):
    size: jax.Array

    def __call__(self, x):
        return self.size * x


HOLDER, SIZED = Holder(), Sized(jnp.ones(1))


def helper(x):
    return SIZE * x


def with_attribute(x):
    return with_attribute.size * x


with_attribute.size = 2.0


def reading_lists(x):
    return x * LIST[0]


def closing(*values):
    return lambda x: x * len(values)


def with_default(x, factor=2.0, *, other=SIZE):
    return factor * other * x


def of_itself(x, depth=2):
    return x if depth == 0 else of_itself(x, depth - 1)


TOLD = {
    "an outcome": lambda x: rk.outcome(rk.Block(0.2, x), rk.SinePulse(0.4, 1.0)),
    "a block, a record": lambda x: rk.outcome(BLOCK, x * RECORD, rk.Linear(), engine=rk.Series(order=6)).margin,
    "a scaled record": lambda x: rk.simulate(BLOCK, SCALED, samples=3).rotation * x,
    "numbers and mathematics": lambda x: jnp.sin(x) * math.pi + np.pi * SIZE + math.cos(SIZE) + np.float64(1.0),
    "an array of JAX": lambda x: ARRAY * x,
    "a status, an engine": lambda x: (
        rk.outcome(BLOCK, rk.SinePulse(x, 1.0), engine=rk.Diffrax(rtol=1e-6)).status == rk.Status.successful
    ),
    "a pair": lambda x: PAIR[0] * x,
    "a function that it calls": lambda x: helper(x),
    "a model of functions": lambda x: rk.outcome(BLOCK, rk.SinePulse(x, 1.0), BENT).margin,
    "functions within": lambda x: sum([(lambda y: y * SIZE + x)(k) for k in range(3)]),
    "what encloses it": closing(1, 2),
    "defaults": with_default,
    "itself": of_itself,
    "derivatives": lambda x: jax.grad(lambda y: rk.outcome(rk.Block(0.2, y), rk.SinePulse(0.4, 1.0)).margin)(x),
}  # fmt: skip
# Variables of these functions may change where tracing cannot see it.
NOT_TOLD = {
    "a list": reading_lists,
    "an array of NumPy": lambda x: CHANGING * x,
    "a list through a function": lambda x: reading_lists(x),
    "an attribute": lambda x: HOLDER.size * x,
    "an object": HOLDER.method,
    "a module of Equinox": SIZED,
    "a model whose functions read lists": lambda x: rk.outcome(BLOCK, rk.SinePulse(x, 1.0), LISTED).margin,
    "a list in what encloses it": closing([1.0]),
    "a part": functools.partial(with_default, factor=3.0),
    "a ufunc of its own": lambda x: UFUNC(SIZE) * x,
    "the environment": lambda x: len(os.environ) * x,
    "a file": lambda x: rk.example_record().dt * x,
    "another file": lambda x: jnp.load("x.npy") * x,
    "random numbers": lambda x: np.random.rand() * x,
    "what is imported": lambda x: __import__("time").time() * x,
    "what it says by name": lambda x: globals()["SIZE"] * x,
    "what is compiled": jax.jit(helper),
    "no such name": lambda x: x * nowhere,  # noqa: F821
    "a function's attribute": lambda x: with_attribute(x),
}  # fmt: skip


@pytest.mark.parametrize("name", TOLD)
def test_told(name):
    assert dependency_key(TOLD[name]) == dependency_key(TOLD[name]) is not None
    assert hash(dependency_key(TOLD[name])) == hash(dependency_key(TOLD[name]))


@pytest.mark.parametrize("name", NOT_TOLD)
def test_not_told(name):
    assert dependency_key(NOT_TOLD[name]) is None


def test_which_function_is_called_again_is_told():
    """Check that the function called again is identified among functions that hold the same others in another order."""

    def held(a, b, c):
        return lambda x: a(x) + b(x) * c(x)

    def same(x):
        return x

    def tenfold(x):
        return 10 * x

    orders = [(same, tenfold, same), (same, tenfold, tenfold), (same, same, tenfold)]
    assert len({dependency_key(held(*order)) for order in orders}) == 3
    for order in orders:
        assert float(rk.sweep(held(*order), x=[2.0]).values[0]) == held(*order)(2.0)


def test_not_told_where_it_imports_or_assigns():
    def importing(x):
        import time

        return time.time() * x

    def assigning(x):
        global SIZE
        SIZE = 3.0
        return x

    count = 0

    def counting(x):
        nonlocal count
        count += 1
        return x

    assert dependency_key(importing) is dependency_key(assigning) is dependency_key(counting) is None


def test_what_is_traced_is_not_told():
    jax.jit(lambda size: dependency_key(lambda x: size * x) is None or pytest.fail())(1.0)


@pytest.mark.parametrize("name", ["a block, a record", "functions within", "defaults"])
def test_traced_once(name):
    assert TracedFunction.of(TOLD[name], **POINT) is TracedFunction.of(TOLD[name], **POINT)


def test_functions_of_models_are_traced_once():
    number = POINT["x"]
    assert trace_function(helper, number) is trace_function(helper, number)
    assert trace_function(reading_lists, number) is not trace_function(reading_lists, number)


def test_traced_again_under_other_settings():
    def function(x):
        return x * jnp.ones(1)

    single = {"x": jax.ShapeDtypeStruct((), np.dtype("float32"))}
    double = TracedFunction.of(function, **POINT)
    with jax.enable_x64(False):
        assert TracedFunction.of(function, **single).results.dtype == np.float32
    assert TracedFunction.of(function, **POINT) is double and double.results.dtype == np.float64
    assert TracedFunction.of(function, **single).results.dtype == np.float64  # of the array


def test_traced_again_where_nothing_is_raised():
    """Checks are put down in one program, and mark what fails in the other."""

    def function(x):
        return rk.Block(x, 1.0).alpha

    raising = TracedFunction.of(function, **POINT)
    with throwing(False):
        marking = TracedFunction.of(function, **POINT)
    assert raising is TracedFunction.of(function, **POINT) and raising.program.messages and not marking.program.messages
    assert np.isnan(jax.tree.leaves(marking(x=-1.0))[0])


@pytest.mark.parametrize(
    "name, change",
    [("SIZE", 3.0), ("SIZE", 2), ("BLOCK", rk.Block(0.2, 2.0, 0.9)), ("ARRAY", jnp.ones(2)), ("helper", lambda x: x)],
)
def test_what_changes_is_seen(name, change, monkeypatch):
    def function(x):
        return helper(x * ARRAY * BLOCK.alpha)

    before = dependency_key(function)
    monkeypatch.setitem(globals(), name, change)
    assert before is not None and dependency_key(function) not in (before, None)
    monkeypatch.undo()
    assert dependency_key(function) == before


def test_code_that_changes_is_seen():
    """As notebooks do when they load a module again."""

    def function(x):
        return x

    before = dependency_key(function)
    function.__code__ = (lambda x: 2 * x).__code__
    assert dependency_key(function) not in (before, None)


def test_signs_of_zero_and_kinds_of_numbers_are_told_apart():
    def of(size):
        return dependency_key(lambda x: x / size)

    told = [of(size) for size in (0.0, -0.0, 0, False, 0.0 + 0.0j)]
    assert len(set(told)) == len(told) and None not in told
