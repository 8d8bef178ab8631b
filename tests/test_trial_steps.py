"""Trial steps outside of a range: with `throw=False` they give NaN, which a status reports, and nothing raises."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

import jaxrock as rk
from jaxrock.blocks import AsymmetricBlock
from jaxrock.responses.current_model import standing

QUICK = {"model": rk.Linear(), "engine": rk.Series(order=6)}
BLOCK, SINE = rk.Block(0.2, 2.0, 0.9), rk.SinePulse(0.3, 1.0)
NAN, INF = np.nan, np.inf

# What makes a part of a scene of one number, a good one and a bad one.
NUMBERS = {
    "alpha": (lambda x, **k: rk.Block(x, 2.0, 0.9, **k), 0.2, -0.1),
    "alpha beyond Housner's value": (lambda x, **k: rk.Block(x, 2.0, **k), 0.2, 1.2),
    "p": (lambda x, **k: rk.Block(0.2, x, 0.9, **k), 2.0, 0.0),
    "restitution": (lambda x, **k: rk.Block(0.2, 2.0, x, **k), 0.9, 1.3),
    "width": (lambda x, **k: rk.Block.from_dimensions(x, 3.0, 0.9, **k), 0.5, -0.5),
    "radius": (lambda x, **k: rk.Block.from_radius(0.2, x, 0.9, **k), 1.0, INF),
    "inertia ratio": (lambda x, **k: rk.restitution.Housner(x, **k), 0.75, 1.2),
    "scale of a law": (lambda x, **k: rk.restitution.SpeedDependent(0.9, 0.5, x, **k), 0.5, -0.5),
    "restitution of two sides": (lambda x, **k: rk.restitution.PerSide(x, 1.2, **k), 0.8, 0.9),
    "inertia of two sides": (lambda x, **k: AsymmetricBlock(0.2, 0.3, 2.0, x, **k), 0.75, 2.0),
    "second frequency": (lambda x, **k: AsymmetricBlock.from_frequencies(0.2, 0.3, 2.0, x, 0.9, **k), 2.0, 9.0),
    "distance of a corner": (lambda x, **k: AsymmetricBlock.from_radii(0.2, 0.3, x, 1.0, 0.5, **k), 1.0, -1.0),
    "place of a corner": (
        lambda x, **k: AsymmetricBlock.from_corners(x * jnp.array([1.0, 0.0]), [-0.2, 0.0], [0.0, 1.0], 0.5, **k),
        0.2, -0.2,
    ),
    "stiffness": (lambda x, **k: rk.blocks.FlexibleBlock(0.5, 3.0, x, 2000.0, 0.05, **k), 1e9, 0.0),
    "amplitude": (lambda x, **k: rk.SinePulse(x, 1.0, **k), 0.3, NAN),
    "period": (lambda x, **k: rk.SinePulse(0.3, x, **k), 1.0, -1.0),
    "duration": (lambda x, **k: rk.HalfSinePulse(0.3, x, **k), 1.0, 0.0),
    "cosine": (lambda x, **k: rk.CosinePulse(0.3, x, **k), 1.0, 0.0),
    "rectangle": (lambda x, **k: rk.RectangularPulse(0.3, x, **k), 1.0, 0.0),
    "triangle": (lambda x, **k: rk.TriangularPulse(0.3, x, **k), 1.0, 0.0),
    "shape": (lambda x, **k: rk.ExponentialPulse(0.3, 1.0, x, **k), 1.0, NAN),
    "centre": (lambda x, **k: rk.RickerPulse(0.3, 1.0, center=x, **k), 1.0, -1.0),
    "oscillations": (lambda x, **k: rk.MavroeidisPapageorgiouPulse(0.3, 1.0, x, **k), 2.0, 0.5),
    "sample": (lambda x, **k: rk.Record(jnp.stack([jnp.asarray(0.1), jnp.asarray(x)]), 0.1, **k), 0.3, INF),
    "time step": (lambda x, **k: rk.Record([0.1, 0.3], x, **k), 0.1, 0.0),
    "delay": (lambda x, **k: SINE.shifted(x, **k), 0.5, -0.5),
}  # fmt: skip


def is_number(part) -> bool:
    return not any(np.isnan(x).any() for x in jax.tree.leaves(jax.device_get(part)))


@pytest.fixture(scope="module")
def traced():
    """All parts, of good numbers and of bad ones, by one program."""
    made = jax.jit(lambda numbers: {name: make(numbers[name], throw=False) for name, (make, *_) in NUMBERS.items()})
    return [made({name: float(row[which]) for name, row in NUMBERS.items()}) for which in (1, 2)]


@pytest.mark.parametrize("name", NUMBERS)
def test_parts_of_a_scene(name, traced):
    """Known, and traced."""
    make, good, bad = NUMBERS[name]
    with pytest.raises(ValueError, match="must"):
        make(bad)
    for good_one, bad_one in ((make(good, throw=False), make(bad, throw=False)), [each[name] for each in traced]):
        assert is_number(good_one)
        assert not is_number(bad_one)
    assert jax.tree.all(jax.tree.map(np.array_equal, make(good, throw=False), make(good)))
    with pytest.raises(ValueError, match="must"):  # as before
        make(bad)


def test_all_that_makes_a_scene_takes_throw():
    spaces, ends = (rk, rk.blocks, rk.motions), ("Block", "Pulse")
    named = {name: space for space in spaces for name in dir(space) if name.endswith(ends) or name == "Record"}
    offered = [getattr(space, name) for name, space in named.items()]
    classes = [kind for kind in offered if isinstance(kind, type)]
    made = [kind for kind in classes if not inspect.isabstract(kind)]
    made += [getattr(kind, name) for kind in classes for name in dir(kind) if name.startswith("from_")]
    made += [rk.outcome, rk.simulate, rk.responses.outcome_flexible, rk.responses.simulate_flexible]
    assert len(made) > 18
    for each in made:
        assert "throw" in inspect.signature(each).parameters, each


def no_result(result, reals) -> bool:
    return bool(result.status == rk.Status.not_finite) and not any(np.isfinite(np.asarray(x)).any() for x in reals)


SCENES = {
    "alpha": (rk.Block(-0.2, 2.0, 0.9, throw=False), SINE, {}),
    "restitution": (rk.Block(0.2, 2.0, 1.3, throw=False), SINE, {}),
    "period": (BLOCK, rk.SinePulse(0.3, -1.0, throw=False), {}),
    "amplitude": (BLOCK, rk.SinePulse(INF, 1.0, throw=False), {}),
    "initial": (BLOCK, SINE, {"initial": (2.0, 0.0)}),
}


@pytest.mark.parametrize(("block", "motion", "more"), SCENES.values(), ids=SCENES)
def test_scenes(block, motion, more):
    """Check scenes without a restitution, which look like results as long as they do not come to an impact."""
    outcome = rk.outcome(block, motion, **QUICK, **more, throw=False)
    assert no_result(outcome, [outcome.margin, outcome.max_rotation, outcome.time_of_max, outcome.error])
    history = rk.simulate(block, motion, **QUICK, **more, duration=2.0, samples=5, throw=False)
    assert no_result(history, [history.rotation, history.velocity, history.max_rotation, history.margin])


class Softer(rk.models.AbstractEquation):
    """A model of a user's own, which balances where its strength is positive."""

    strength: jax.Array = rk.parameter("-")

    def moments(self, b):
        s, c = jnp.sin(b.alpha), jnp.cos(b.alpha)
        restoring = rk.models.Terms(sine=-self.strength * c, cosine=self.strength * s)
        return rk.models.Coefficients(restoring, rk.models.Terms(sine=s, cosine=c))


def test_a_model_of_ones_own_does_not_raise():
    """Check that a model of a user does not raise, for an invalid block or a parameter without a balance."""
    none, series = SCENES["alpha"][0], rk.Series()
    for block, strength in ((none, 0.9), (BLOCK, -0.9), (BLOCK, 0.9)):
        model = Softer(jnp.asarray(strength))
        found = standing(block, model, series, throw=False)
        if block is BLOCK and strength > 0:
            np.testing.assert_array_equal(jax.tree.leaves(found), jax.tree.leaves(block))
            continue
        assert np.isnan(found.alpha)
        with pytest.raises(ValueError, match="must fall to zero"):
            standing(block, model, series)


class Chosen(rk.restitution.AbstractRestitution):
    """A law that takes its ratio from a list."""

    place: jax.Array = rk.parameter("-", is_whole=True)

    def ratio(self, corners, speed):
        return jnp.array([0.9, 0.8])[self.place] + 0 * speed


def test_whole_numbers_of_a_law_stay_whole():
    block = rk.Block(0.2, 2.0, Chosen(jnp.array(1)))
    for strength in (0.9, -0.9):
        found = standing(block, Softer(jnp.asarray(strength)), rk.Series(), throw=False)
        assert np.isnan(found.alpha) == (strength < 0) and found.restitution == 0.8


def test_a_history_that_is_none_tells_no_numbers_and_has_no_slopes():
    """Check that an invalid history has NaN numbers and no slopes, at any time in both modes.

    A fit that steps out of the ranges therefore goes on.
    """

    def rotations(x):
        block = rk.Block(x[0], 2.0, x[1], throw=False)
        return rk.simulate(block, SINE, **QUICK, duration=2.0, samples=5, throw=False)(jnp.array([0.3, 0.8]))[0]

    def values_and_slopes(x):
        values, pushed = jax.linearize(rotations, x)
        pulled = jax.linear_transpose(pushed, x)
        return values, jax.vmap(pushed, out_axes=1)(jnp.eye(2)), jax.vmap(lambda row: pulled(row)[0])(jnp.eye(2))

    values, *slopes = jax.jit(jax.vmap(values_and_slopes))(jnp.array([[0.2, 0.9], [0.2, 1.1], [-0.2, 0.9]]))
    np.testing.assert_array_equal(np.isnan(values), [[False] * 2, [True] * 2, [True] * 2])
    for each in slopes:
        assert (each[0] != 0).any() and (each[1:] == 0).all()
    assert np.isnan(rotations([-0.2, 0.9])).all()


def test_a_duration():
    history = rk.simulate(BLOCK, SINE, **QUICK, duration=-1.0, samples=5, throw=False)
    assert no_result(history, [history.rotation, history.max_rotation])


def test_an_asymmetric_block_without_a_duration():
    """The motion, and 10/p of free rocking."""
    duration = jax.jit(lambda p: rk.simulate(AsymmetricBlock(0.2, 0.3, p), SINE, **QUICK, samples=5).duration)(2.0)
    np.testing.assert_allclose(duration, 1.0 + 10 / 2.0)


def test_a_margin_that_is_no_number_is_never_successful():
    """Check that a NaN margin is never successful, with or without `throw`."""
    result = rk.outcome(rk.Block(0.2, 2.0, 1.3, throw=False), rk.SinePulse(0.5, 1.0), **QUICK)
    assert np.isnan(result.margin) and bool(result.status == rk.Status.not_finite)


def margin(x):
    block = rk.Block(x[3], x[0], x[1], throw=False)
    return rk.outcome(block, rk.SinePulse(0.3, x[2], throw=False), **QUICK, throw=False).margin


margins_and_slopes = jax.jit(jax.vmap(jax.value_and_grad(margin)))


def test_lanes():
    points = np.array([[2.0, 0.9, 1.0, 0.2]] * 7)
    points[1:6] += np.vstack([np.diag([-4.0, 0.2, -1.0, -0.4]), [0, 0, 0, np.nan]])
    found, slopes = jax.device_get(margins_and_slopes(points))
    np.testing.assert_array_equal(np.isnan(found), [False, *[True] * 5, False])
    assert (slopes[1:6] == 0).all() and (slopes[0] != 0).all()
    with_throw = rk.outcome(rk.Block(0.2, 2.0, 0.9), SINE, **QUICK).margin
    np.testing.assert_allclose(found[0], with_throw, rtol=1e-13)


def test_scenes_go_on_to_share_a_record():
    """Check that scenes, any of which may be invalid, share a record: a copy for each would be gigabytes."""
    record = rk.Record(0.1 * np.sin(np.arange(123)), 0.02)

    def margin(alpha):
        return rk.outcome(rk.Block(alpha, 2.0, throw=False), record, throw=False).margin

    program = jax.make_jaxpr(jax.vmap(margin))(jnp.linspace(-0.1, 0.4, 77))
    assert "f64[77]" in str(program) and "f64[77,123]" not in str(program)


def test_what_is_no_number_at_all_raises():
    with pytest.raises(ValueError, match="`alpha` must be a number"):
        rk.Block(True, 2.0, throw=False)
    with pytest.raises(ValueError, match="shapes that go together"):
        rk.Block(np.ones(2) / 5, np.ones(3), throw=False)


def test_an_optimiser_without_bounds():
    """Its first steps, as long as the slope is steep, leave the range of the restitution. It finds the least margin of
    a grid, or a lower one."""
    tried = []

    def of(x):
        points = np.tile([*x, 0.2], (7, 1))  # as many as above: one program
        values, slopes = jax.device_get(margins_and_slopes(points))
        return values[0], slopes[0, :3]

    def loss(x):
        value, slope = of(x)
        tried.append(bool(np.isnan(value)))
        return (1.0, np.zeros(3)) if tried[-1] else (value, slope)

    found = minimize(loss, [2.0, 0.97, 1.0], jac=True, method="L-BFGS-B", options={"maxiter": 8})
    assert any(tried)
    assert found.fun < of([2.0, 0.97, 1.0])[0]


def test_the_log_density_of_any_point():
    """Check the log-density of any point: infinite ones are ends of ranges; NaN has no likelihood."""
    rocks = rk.inverse.Observations([0.2], [2.0], ["survived"])
    unknowns = {"amplitude": rk.inverse.Unknown(0.1, 1.0), "period": rk.inverse.Unknown(-0.5, 1.0, log=False)}
    density = rk.inverse.log_density(rocks, rk.SinePulse, unknowns, **QUICK)
    points = np.array([[0.0, 0.5], [0.0, -3.0], [INF, 1.0], [0.0, -INF], [NAN, 0.0], [1e9, -1e9]])
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(lambda x: density(x))))(points)
    for found in map(np.asarray, (density.objective(points), values)):
        assert np.isfinite(found[0])
        assert (found[[1, 3, 4, 5]] == -INF).all()
    assert np.isfinite(np.asarray(slopes)[:2]).all()
