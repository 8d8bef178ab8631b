"""Many scenes at once: however they are batched, each is the function of its own numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrock.compiler import TwoPass, lane_function
from jaxrock.compiler.primitive import lanes


@pytest.fixture(autouse=True, params=["machine code", "XLA"])
def compiler(request, monkeypatch):
    if request.param == "XLA":
        monkeypatch.setattr(lanes, "native", None)
    elif lanes.native is None:
        pytest.skip("needs llvmlite")


def alone(tree):
    x, samples = tree["x"], tree["samples"]
    return {"y": x * samples.sum(), "n": jnp.round(x).astype(int)}


def passes(round):
    """As `alone`, by counting down; the quick pass postpones every third, with a wrong result."""

    def follow(tree, state, limit, quick):
        def step(s):
            return s[0] + 1, s[1] + tree["samples"][0] + tree["samples"][1], s[2]

        x = jnp.round(tree["x"])
        count, total, _ = jax.lax.while_loop(lambda s: (s[0] < x) & (s[0] < limit), step, state)
        wrong = quick & (x - 3 * jnp.floor(x / 3) == 0) & (count >= x)
        return count, jnp.where(wrong, jnp.nan, total), wrong

    def conclude(tree, state):
        return {"y": state[1], "n": state[0].astype(int)}, state[2]

    class Passes(TwoPass):
        def init(self, tree):
            return tree, (jnp.zeros_like(tree["x"]), jnp.zeros_like(tree["x"]), jnp.array(False))

        def fast(self, point, state, limit):
            return follow(point, state, limit, True)

        def accurate(self, point, state):
            return conclude(point, follow(point, state, 1000, False))[0]

        def unfinished(self, point, state):
            return state[0] < jnp.round(point["x"])

        def result(self, point, state):
            return conclude(point, state)

    Passes.round = round
    return Passes()


@pytest.mark.parametrize("count", [1, 2, 63, 64, 65, 300])
@pytest.mark.parametrize("fast", [None, passes(None), passes(2)], ids=["alone", "two passes", "in rounds"])
def test_one_axis(count, fast):
    x, samples = np.arange(float(count)) % 7, np.array([1.0, 2.0])
    run = lane_function(fast or alone)
    found = jax.jit(jax.vmap(lambda x: run({"x": x, "samples": samples})))(x)
    np.testing.assert_array_equal(found["y"], 3 * x)
    np.testing.assert_array_equal(found["n"], x)


@pytest.mark.parametrize("fast", [None, passes(None), passes(2)], ids=["alone", "two passes", "in rounds"])
def test_more_axes(fast):
    """Both axes of numbers; an axis of what all share is taken one by one; an axis that only others have."""
    x, samples = np.arange(15.0).reshape(3, 5) % 7, np.arange(8.0).reshape(4, 2)
    run = lane_function(fast or alone)

    def over(x, samples):
        return run({"x": x, "samples": samples})["y"]

    def nested(*axes):
        function = over
        for axis in axes:
            function = jax.vmap(function, in_axes=axis)
        return function

    @jax.jit
    def found(x, samples, numbers):
        return [
            nested((0, None), (0, None))(x, samples[1]),
            nested((0, None), (1, None))(x, samples[1]),
            nested((0, None), (None, 0))(x[0], samples),
            nested((None, 0), (0, None))(x[0], samples),
            nested((0, None), (None, 0), (0, None))(numbers, samples[:3]),
        ]

    numbers, sums = np.arange(8.0).reshape(2, 4) % 7, samples.sum(1)
    expected = [
        x * sums[1],
        x.T * sums[1],
        sums[:, None] * x[0],
        x[0][:, None] * sums,
        numbers[:, None] * sums[:3, None],
    ]
    for one, other in zip(found(x, samples, numbers), expected, strict=True):
        np.testing.assert_array_equal(one, other, strict=True)
    np.testing.assert_array_equal(over(x[1, 2], samples[3]), x[1, 2] * sums[3])


def test_a_jacobian_is_traced_where_it_is_compiled():
    """Not where `vmap` puts something else in its place: tracing one takes seconds."""
    slopes = []

    @jax.custom_jvp
    def marked(x):
        return x

    @marked.defjvp
    def _(primals, tangents):
        slopes.append(1)
        return primals[0], tangents[0]

    run = lane_function(lambda x: jax.lax.while_loop(lambda y: y < 100, lambda y: y * x, marked(x) + 1))
    x = np.linspace(2.0, 3.0, 5)
    jax.make_jaxpr(jax.grad(run))(2.0)
    assert not slopes
    many = jax.vmap(jax.grad(run))(x)
    assert len(slopes) == 1
    alone = jax.jit(jax.grad(run))
    one = np.stack([alone(each) for each in x])
    steps = np.ceil(np.log(100 / (x + 1)) / np.log(x))
    exact = x**steps + (x + 1) * steps * x ** (steps - 1)
    np.testing.assert_allclose(many, exact, rtol=1e-14)
    np.testing.assert_allclose(one, exact, rtol=1e-14)


def test_no_scenes():
    run = lane_function(lambda x: {"y": jnp.sin(x[0]) * x[1], "n": jnp.int32(1)})
    for given in (run, jax.grad(lambda x: run(x)["y"])):
        found = jax.vmap(lambda a, given=given: given((a, 2.0)))(jnp.zeros(0))
        assert all(x.shape == (0,) for x in jax.tree.leaves(found))
