"""Many scenes at once: however they are batched, each is the function of its own numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrock.lanes import Quick, in_lanes


def careful(tree):
    x, samples = tree["x"], tree["samples"]
    return {"y": x * samples.sum(), "n": jnp.round(x).astype(int)}


def quick(round):
    """As `careful`, by counting down; every third is postponed with a wrong result."""

    def follow(tree, state, limit):
        def step(s):
            return s[0] + 1, s[1] + tree["samples"].sum()

        return jax.lax.while_loop(lambda s: (s[0] < jnp.round(tree["x"])) & (s[0] < limit), step, state)

    def conclude(tree, state):
        postponed = jnp.round(tree["x"]) % 3 == 0
        return {"y": jnp.where(postponed, jnp.nan, state[1]), "n": state[0].astype(int)}, postponed

    return Quick(
        begin=lambda tree: (jnp.zeros_like(tree["x"]), jnp.zeros_like(tree["x"])),
        follow=follow,
        unfinished=lambda tree, state: state[0] < jnp.round(tree["x"]),
        conclude=conclude,
        round=round,
    )


@pytest.mark.parametrize("count", [1, 2, 63, 64, 65, 300])
@pytest.mark.parametrize("fast", [None, quick(None), quick(2)], ids=["careful", "quick first", "in rounds"])
def test_one_axis(count, fast):
    x, samples = jnp.arange(float(count)) % 7, jnp.array([1.0, 2.0])
    run = in_lanes(careful, fast)
    found = jax.jit(jax.vmap(lambda x: run({"x": x, "samples": samples})))(x)
    np.testing.assert_array_equal(found["y"], 3 * x)
    np.testing.assert_array_equal(found["n"], x)


@pytest.mark.parametrize("fast", [None, quick(None), quick(2)], ids=["careful", "quick first", "in rounds"])
def test_more_axes(fast):
    """Both axes of numbers; an axis of what all share is taken one by one; an axis that only others have."""
    x, samples = jnp.arange(15.0).reshape(3, 5) % 7, jnp.arange(8.0).reshape(4, 2)
    run = in_lanes(careful, fast)

    def over(x, samples):
        return run({"x": x, "samples": samples})["y"]

    def nested(*axes):
        function = over
        for axis in axes:
            function = jax.vmap(function, in_axes=axis)
        return jax.jit(function)

    expected = np.asarray(x) * np.asarray(samples[1]).sum()
    np.testing.assert_array_equal(nested((0, None), (0, None))(x, samples[1]), expected)
    np.testing.assert_array_equal(nested((0, None), (1, None))(x, samples[1]), expected.T)
    np.testing.assert_array_equal(
        nested((0, None), (None, 0))(x[0], samples), np.asarray(samples).sum(1)[:, None] * np.asarray(x[0])
    )
    np.testing.assert_array_equal(
        nested((None, 0), (0, None))(x[0], samples), np.asarray(x[0])[:, None] * np.asarray(samples).sum(1)
    )
    np.testing.assert_array_equal(over(x[1, 2], samples[3]), x[1, 2] * samples[3].sum())
