"""Derivatives: against 40-digit differences, of every order, forward and reverse, and where they do not exist."""

import dataclasses
import functools
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.compiler import lane_function
from jaxrock.engines.conclusion import has_one_peak
from jaxrock.engines.taylor.expansion import End, Start, arrive, taylor_expansion
from jaxrock.engines.taylor.policy import POLICY
from jaxrock.motions.record import roomy
from jaxrock.motions.shaking import Shaking
from jaxrock.numerics.polynomial import jet
from jaxrock.studies.sensitivities import _told
from references.in_jaxrock import MODELS, PULSES
from references.smooth_differences import gradient

RESULTS = ("max_rotation", "max_velocity", "time_of_max")
QUICKLY = {"model": rk.Linear(), "engine": rk.Series(order=6)}  # compiles in half the time
SCENES = json.loads((Path(__file__).parents[1] / "references" / "derivatives.json").read_text())["scenes"]


def scene(kind, x):
    """Block and motion from alpha, p, restitution and the motion's own parameters."""
    block = rk.Block(x[0], x[1], x[2])
    if kind == "record":
        return block, x[3] * rk.example_record()
    return block, PULSES[kind](*[x[k] for k in range(3, x.size)])


def results(kind, model, x):
    found = rk.outcome(*scene(kind, x), MODELS[model])
    return jnp.stack([getattr(found, name) for name in RESULTS]), found


@functools.cache
def first(kind, model):
    """Derivatives (scenes, results, parameters) and outcomes, compiled once."""
    return jax.jit(jax.vmap(jax.jacfwd(functools.partial(results, kind, model), has_aux=True)))


def points(kind, model, having="max_rotation"):
    rows = [row for row in SCENES if row["kind"] == kind and row["model"] == model and having in row]
    return rows, np.array([row["block"] + row["motion"] for row in rows])


def slow(*row):
    return pytest.param(*row, marks=pytest.mark.slow)


EVERYWHERE = [(kind, model) for kind in dict.fromkeys(row["kind"] for row in SCENES) for model in MODELS]
QUICK = [("sine", "nonlinear"), ("exponential", "linear")]


@pytest.mark.parametrize("kind, model", [row if row in QUICK else slow(*row) for row in EVERYWHERE])
def test_first_derivatives(kind, model):
    """630 scenes with up to 150 impacts, each by all its parameters: alpha, p, restitution, and those of the motion."""
    rows, x = points(kind, model)
    assert len(rows) >= 15
    slopes, found = map(lambda part: jax.tree.map(np.asarray, part), first(kind, model)(x))
    assert np.all(found.status == rk.Status.successful) and np.all(found.differentiable)
    exact = np.array([[[float(c) for c in row[name]["gradient"]] for name in RESULTS] for row in rows])
    # Relative to the derivative; where that is small next to the others, to a thousandth of the largest.
    weight = np.where(x == 0, 1.0, np.abs(x))[:, None, :]
    sizes = np.abs(exact) * weight
    scale = np.maximum(sizes, 1e-3 * sizes.max(axis=2, keepdims=True)) / weight
    np.testing.assert_array_less(np.abs(slopes - exact), 1e-9 * scale + 1e-300)
    # A motion of another duration on a block of another size: only their product counts.
    if kind in ("sine", "half sine", "cosine"):
        np.testing.assert_allclose(x[:, 1] * slopes[:, 0, 1], x[:, 4] * slopes[:, 0, 4], rtol=1e-9, atol=1e-13)


@pytest.mark.parametrize("model", ["linear", pytest.param("nonlinear", marks=pytest.mark.slow)])
def test_second_derivatives(model):
    """Hessians of the peak of 30 and more scenes, by five parameters, against 40-digit differences."""
    rows, x = points("sine", model, "hessian")
    peak = functools.partial(results, "sine", model)
    found = jax.jit(jax.vmap(jax.hessian(lambda q: peak(q)[0][0])))(jnp.array(x))
    exact = np.array([[[float(c) for c in line] for line in row["hessian"]] for row in rows])
    sizes = np.abs(exact * x[:, None, :] * x[:, :, None])
    scale = np.maximum(sizes, 1e-3 * sizes.max(axis=(1, 2), keepdims=True)) / np.abs(x[:, None, :] * x[:, :, None])
    assert len(rows) >= 20
    np.testing.assert_array_less(np.abs(found - exact), 1e-6 * scale)


@pytest.mark.slow
def test_every_nesting_is_the_same():
    """Forward over reverse, reverse over reverse, forward over forward; and mapped."""
    x = jnp.array([0.2, 2.0, 0.9, 0.23, 1.4])

    def peak(q):
        return results("sine", "linear", q)[0][0]

    exact = jax.jit(jax.hessian(peak))(x)
    for nested in (jax.jacrev(jax.jacrev(peak)), jax.jacfwd(jax.jacfwd(peak)), jax.jacrev(jax.jacfwd(peak))):
        np.testing.assert_allclose(jax.jit(nested)(x), exact, rtol=1e-11)
    several = jax.jit(lambda x: jax.lax.map(jax.hessian(peak), x))
    np.testing.assert_allclose(several(jnp.stack([x, x]))[1], exact, rtol=1e-11)


def test_reverse_is_forward():
    """A gradient by a vector is the same in both modes, to rounding; and under vmap of a sum."""
    _, x = points("exponential", "linear")
    slopes, _ = first("exponential", "linear")(x)
    every = jax.vmap(functools.partial(results, "exponential", "linear"))
    summed = jax.jit(jax.grad(lambda x: jnp.sum(every(x)[0][:, 0])))
    np.testing.assert_allclose(summed(x), slopes[:, 0], rtol=1e-13)


SEEN = (*RESULTS, "margin", "clearance")
WEIGHTS = dict(zip(SEEN, np.eye(len(SEEN))))  # of one of them


def whole(kind, x, start=(0.0, 0.0)):
    """Return results of a block under a record in one of several settings, as a function of all other numbers."""
    samples, dt, numbers = x
    block, motion = rk.Block(*numbers[:3]), rk.Record(samples, dt)
    model = rk.Linear() if kind == "linear" else rk.Housner()
    if kind == "beside a pulse":
        motion = motion + rk.SinePulse(0.06, numbers[3])
    if kind == "vertical":
        motion = motion.with_vertical(0.4 * motion)
    if kind == "in motion":
        start = start[0] + 0.05 * numbers[3], start[1] + 0.01
    if kind == "asymmetric":
        block = rk.blocks.AsymmetricBlock(numbers[0], 0.9 * numbers[0], numbers[1], restitution=(numbers[2], 0.9))
    found = rk.outcome(block, motion, model, initial=start)
    return jnp.stack([jnp.where(jnp.isfinite(x), x, 0.0) for x in (getattr(found, name) for name in SEEN)])


@functools.cache
def by_all(kind):
    """Return the outcome at `x`, a start and weights, and its weighted gradient by all of `x`, in reverse mode.

    Compiled once for a length.
    """

    @jax.jit
    def pulled(x, start, weights):
        seen, pull = jax.vjp(lambda x: whole(kind, x, start), x)
        return seen, *pull(weights)

    return lambda *given: pulled(*jax.tree.map(np.asarray, given))


@pytest.mark.parametrize("model", ["linear", "nonlinear"])
def test_all_samples_of_a_record(model):
    """5,690 derivatives at once, in reverse: some against 40-digit differences, all of them summed along the record."""
    record = rk.example_record()
    samples = np.asarray(record.samples)
    rows, x = points("record", model, "samples")
    assert len(rows) >= 3
    for row, q in zip(rows, x):
        whole_x = q[3] * samples, record.dt, np.array([*q[:3], 0.7])
        (value, *_), (slopes, *_) = by_all(model)(whole_x, (0.0, 0.0), WEIGHTS["max_rotation"])
        known = row["samples"]
        exact = np.array([float(c) for c in known["max_rotation"]]) / q[3]  # by samples before they are scaled
        assert float(value) == pytest.approx(float(row["max_rotation"]["value"]), rel=1e-11)
        size = np.abs(exact).max()
        np.testing.assert_allclose(np.asarray(slopes)[known["indices"]], exact, rtol=1e-9, atol=1e-9 * size)
        # After the peak, and while the block rests, a sample changes nothing: exactly.
        quiet = np.isin(known["indices"], known["rest"] + known["after"])
        assert np.all(np.asarray(slopes)[np.array(known["indices"])[quiet]] == 0)
        summed = float(np.dot(slopes, samples))
        assert summed == pytest.approx(float(row["max_rotation"]["gradient"][3]), rel=1e-9)


@pytest.mark.parametrize("factor", [1.2, 2.0])
@pytest.mark.parametrize(
    "kind", ["linear", *map(slow, ["nonlinear", "beside a pulse", "vertical", "in motion", "asymmetric"])]
)
def test_along_the_steps_slopes_are_differences(kind, factor):
    """By all samples, their step and a block at once, along a change of all. (Forward mode takes the same way.)

    Under the end of a record as long as that above, which begins with quiet, but where the block starts in motion."""
    record = rk.example_record()
    samples = np.asarray(record.samples)
    part, quiet = factor * samples[500:1500], np.zeros(0 if kind == "in motion" else samples.size - 1000)
    x, start = (np.concatenate([quiet, part]), float(record.dt), np.array([0.2, 2.0, 0.9, 0.7])), (0.0, 0.0)
    random = np.random.default_rng(1)
    change = jax.tree.map(lambda value: 0.1 * value * random.normal(size=np.shape(value)), x)

    def moved(t):
        return np.asarray(by_all(kind)(jax.tree.map(lambda a, b: a + t * b, x, change), start, WEIGHTS["margin"])[0])

    differences = (moved(1e-5) - moved(-1e-5)) / 2e-5
    for weights, difference in zip(WEIGHTS.values(), differences):
        _, slopes = by_all(kind)(x, start, weights)
        along = sum(float(np.sum(slope * d)) for slope, d in zip(map(np.asarray, slopes), change))
        assert along == pytest.approx(float(difference), rel=1e-5, abs=1e-8)
    assert np.count_nonzero(differences) >= (5 if (kind, factor) == ("linear", 2.0) else 1)  # there a clearance, too


def test_all_samples_where_a_tape_is_longer_than_that_of_a_history():
    """A block that hops on and on until it is thrown down, after more steps than a history keeps: beside forward mode
    along the scale of the record."""
    samples = np.full(rk.example_record().samples.size, 0.002)
    samples[60:63] = -0.31, 0.35, 0.35
    numbers, start = np.array([0.3, 30.0, 0.9999, 0.7]), (0.03, 0.0)
    usual = POLICY.history_steps + 2 * roomy(samples.size)

    def margin(scale, **more):
        found = rk.outcome(rk.Block(*numbers[:3]), scale * rk.Record(samples, 1.0), rk.Linear(), initial=start, **more)
        return found.margin, found

    along, found = jax.jit(jax.grad(margin, has_aux=True))(1.0)
    assert found.overturned and found.status == rk.Status.successful
    assert margin(1.0, engine=rk.Series(max_steps=usual))[1].status == rk.Status.step_budget_exhausted
    _, (slopes, *_) = by_all("linear")((samples, 1.0, numbers), start, WEIGHTS["margin"])
    assert float(np.asarray(slopes) @ samples) == pytest.approx(float(along), rel=1e-8) != 0


def test_by_more_numbers_than_machine_code_takes_at_once(caplog):
    """Nine: a few directions at a time, in machine code; beside three of them, all at once."""
    caplog.set_level("DEBUG", "jaxrock")

    def peak(x):
        motion = rk.SinePulse(x[3], x[4]) + rk.HalfSinePulse(x[5], x[6]) + rk.CosinePulse(x[7], x[8])
        return rk.outcome(rk.Block(*x[:3]), motion, rk.Linear(), engine=rk.Series(order=6)).max_rotation

    x = np.array([0.2, 1.5, 0.9, 0.4, 1.0, 0.1, 1.4, 0.1, 0.6])
    all_at_once = jax.jit(jax.vmap(jax.grad(peak)))(x * np.array([[1.0], [1.01]]))
    assert "left to XLA" not in caplog.text
    places = [0, 4, 8]

    def of_few(t):
        numbers = dict(enumerate(x)) | dict(zip(places, t))
        return peak([numbers[k] for k in range(9)])

    alone = np.array(jax.jit(jax.grad(of_few))([x[k] for k in places]))
    assert np.all(alone != 0)
    np.testing.assert_allclose(np.asarray(all_at_once)[0, places], alone, rtol=1e-11)


SETTINGS = {"linear": {"model": rk.Linear(), "engine": rk.Series(order=6)}, "nonlinear": {}}


@pytest.mark.slow
@pytest.mark.parametrize("settings", SETTINGS)
def test_many_blocks_by_all_samples(settings):
    """Reverse mode through `jax.vmap` over blocks: beside differences along two changes of the record, `jax.vmap` of
    reverse mode, forward mode, and the gradient of a sum."""
    alpha, dt = jnp.array([0.1, 0.14, 0.2]), 0.02  # one overturns, one rocks, one hardly moves
    time = dt * jnp.arange(90)
    start = 0.24 * jnp.sin(2 * jnp.pi * time / 0.7)
    changes = jnp.stack([jnp.cos(2 * jnp.pi * time / 0.5), time**2])

    def one(angle, samples):
        found = rk.outcome(rk.Block(angle, 3.0), rk.Record(samples, dt), **SETTINGS[settings])
        return jnp.stack([found.margin, found.max_velocity / 3])

    def many(samples):
        return jax.vmap(one, in_axes=(0, None))(alpha, samples)

    rows = jax.jit(jax.jacrev(many))(start)
    step = 5e-6
    found = jax.jit(jax.vmap(many))(jnp.stack([start + k * step * d for d in changes for k in (-2, -1, 1, 2)]))
    assert set(np.sign(found[..., 0]).ravel()) == {-1.0, 1.0}
    values = jnp.where(jnp.isfinite(found), found, 0.0).reshape(2, 4, 3, 2)
    differences = (values[:, 0] - 8 * values[:, 1] + 8 * values[:, 2] - values[:, 3]) / (12 * step)
    rows = jnp.where(jnp.isfinite(found[0])[..., None], rows, 0.0)
    np.testing.assert_allclose(jnp.einsum("brn,cn->cbr", rows, changes), differences, rtol=1e-6, atol=1e-9)
    each = jax.jit(jax.vmap(jax.jacrev(one, argnums=1), in_axes=(0, None)))(alpha, start)
    np.testing.assert_allclose(each[:, 0], rows[:, 0], rtol=1e-10, atol=1e-12)
    pushed = jax.jit(lambda d: jax.jvp(many, (start,), (d,))[1])(changes[0])
    np.testing.assert_allclose(pushed[:, 0], rows[:, 0] @ changes[0], rtol=1e-10)
    of_sum = jax.jit(jax.grad(lambda x: many(x)[:, 0].sum()))(start)
    np.testing.assert_allclose(of_sum, rows[:, 0].sum(axis=0), rtol=1e-10, atol=1e-12)


def test_a_tape_within_vmap():
    """Reverse mode by many numbers, on a tape with a branch in it, at many scenes: beside the same without a tape."""

    def twice_where_positive(x):
        return jnp.where(x[0] > 0, 2.0, 1.0) * jnp.sum(jnp.sin(x) ** 2)

    def on_tape(x):
        def turned(y):
            return jax.lax.scan(lambda s, z: (s + 2 * jnp.sin(z) ** 2, None), 0.0, y)[0]

        return jax.lax.cond(x[0] > 0, turned, lambda y: jnp.sum(jnp.sin(y) ** 2), x)

    tree = np.linspace(0.1, 2.0, 70)
    scale = np.array([-1.0, 0.5, 1.0])
    taped = lane_function(twice_where_positive, reverse=on_tape)
    many = lambda function: lambda x: jax.vmap(lambda s: function(s * x))(scale)
    of_shared, plain = (np.asarray(jax.jit(jax.jacrev(many(f)))(tree)) for f in (taped, twice_where_positive))
    np.testing.assert_allclose(of_shared, plain, rtol=1e-13)
    of_sum = jax.jit(jax.grad(lambda x: many(taped)(x).sum()))
    np.testing.assert_allclose(of_sum(tree), plain.sum(axis=0), rtol=1e-13)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(many(taped)))(tree), plain, rtol=1e-13)
    each = jax.jit(jax.vmap(jax.grad(taped)))(scale[:, None] * tree)
    np.testing.assert_allclose(scale[:, None] * each, plain, rtol=1e-13)


@pytest.mark.slow
def test_a_history_in_both_modes():
    """Rotation at times fixed and moving, before and after impacts, linear: forward = reverse = differences."""
    x = jnp.array([0.2, 2.0, 0.9, 0.26, 1.4, 1.7])

    def rotations(q):
        response = rk.simulate(rk.Block(*q[:3]), rk.SinePulse(q[3], q[4]), rk.Linear(), samples=2)
        return response(jnp.stack([0.3 * q[4], 0.9 * q[4], q[5]]))[0]

    forward, reverse = jax.jit(lambda q: (jax.jacfwd(rotations)(q), jax.jacrev(rotations)(q)))(x)
    np.testing.assert_allclose(forward, reverse, rtol=1e-12, atol=1e-14)
    steps = 1e-4 * jnp.diag(x)
    values = jax.jit(jax.vmap(rotations))(jnp.concatenate([x + k * steps for k in (-2, -1, 1, 2)])).reshape(4, 6, 3)
    differences = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12e-4 * x[:, None])
    np.testing.assert_allclose(forward, differences.T, rtol=1e-7, atol=1e-9)


@functools.cache
def peak_by_start(engine):
    """The peak of a linear block under a lobe, and its slope by the start: rotation and velocity."""

    def peak(start, pulse):
        block, start = rk.Block(0.2, 2.0, 0.9), (start[0], start[1])
        return rk.outcome(block, pulse, rk.Linear(), initial=start, engine=engine).max_rotation

    return jax.jit(jax.value_and_grad(peak))


def test_a_block_at_rest_does_not_lean():
    """From rest a little rotation to either side falls back before the ground moves: its slope is zero."""
    rising = rk.ExponentialPulse(0.4, 0.6, 0.0)
    (peak, slope), *aside = (peak_by_start(QUICKLY["engine"])(np.array([x, 0.0]), rising) for x in (0.0, 1e-7, -1e-7))
    assert slope[0] == 0
    np.testing.assert_allclose([value for value, _ in aside], peak, rtol=1e-9)


@pytest.mark.parametrize("engine", [QUICKLY["engine"], pytest.param(rk.Diffrax(), marks=pytest.mark.slow)])
def test_a_block_that_is_lifted_at_once_leans_to_its_side(engine):
    """Where a pulse begins by a jump a start on the side to which the block goes, here -1, is one that it keeps."""
    jump, step = rk.RectangularPulse(0.3, 0.4), -1e-6
    (peak, slope), *moved = (peak_by_start(engine)(start, jump) for start in (np.zeros(2), *(step * np.eye(2))))
    aside = [(float(value) - float(peak)) / step for value, _ in moved]
    assert max(aside) < -0.1
    np.testing.assert_allclose(slope, aside, rtol=1e-4)


BY_HISTORY = ("alpha", "amplitude", "period", "rotation", "velocity", "time")  # what it is differentiated by
OF_HISTORY = ("rotation", "velocity", "second impact", "least normal", "largest friction")


def a_history(x, duration):
    """Return the results `OF_HISTORY` at a time, by the numbers `BY_HISTORY`; and all impacts."""
    block, start = rk.Block(x[0], 2.0, 0.9), (x[3], x[4])
    found = rk.simulate(block, rk.SinePulse(x[1], x[2]), duration=duration, initial=start, samples=2, **QUICKLY)
    forces = rk.responses.contact_forces(found, block)
    of = jnp.stack([*found(x[5]), found.impact_times[1], forces.least_normal, forces.largest_friction])
    return of, (found.impact_times, found.impact_velocities)


@jax.jit
def slopes_of_a_history(x, duration):
    """Values, slopes in forward and in reverse mode, and impacts."""
    value, pushed, impacts = jax.linearize(lambda x: a_history(x, duration), x, has_aux=True)
    pulled = jax.linear_transpose(pushed, x)  # of one linearization: twice it would be compiled twice
    forward = jax.vmap(pushed, out_axes=1)(np.eye(len(BY_HISTORY)))
    return value, forward, jax.vmap(lambda row: pulled(row)[0])(np.eye(len(OF_HISTORY))), impacts


def test_derivatives_at_the_end_of_a_history_and_of_its_events():
    """By time the velocity, also where the history ends in motion; events outside of jit as within."""
    for time in (1.0, 3.0):
        x = np.array([0.2, 0.4, 0.6, 0.0, 0.0, time])
        value, slopes = map(np.asarray, slopes_of_a_history(x, 3.0)[:2])
        assert time == 1.0 or abs(value[1]) > 0.01
        assert slopes[0, 5] == pytest.approx(float(value[1]), rel=1e-12)

    def second_impact(alpha):
        pulse = rk.SinePulse(0.4, 0.6)
        return rk.simulate(rk.Block(alpha, 2.0, 0.9), pulse, duration=3.0, samples=2, **QUICKLY).impact_times[1]

    assert jax.grad(second_impact)(0.2) == pytest.approx(float(slopes[2, 0]), rel=1e-12)


def test_a_history_of_the_diffrax_engine_moves_at_its_end():
    """Rotation and velocity: their derivatives by time there are those just before."""
    block, pulse = rk.Block(0.2, 2.0, 0.9), rk.SinePulse(0.4, 0.6)

    @jax.jit
    def slopes(times):
        response = rk.simulate(block, pulse, rk.Linear(), duration=3.0, samples=2, engine=rk.Diffrax())
        return jax.vmap(jax.jacrev(lambda t: jnp.stack(response(t))))(times)

    at_the_end, before = slopes(np.array([3.0, 3.0 - 1e-9]))
    np.testing.assert_allclose(at_the_end, before, rtol=1e-6)


def test_the_history_of_a_column_moves_at_its_end():
    block = rk.blocks.FlexibleBlock(1.0, 5.0, 3e9, 2000.0, 0.02, 3, restitution=0.9)

    @jax.jit
    def slopes(times):
        response = rk.simulate(block, rk.SinePulse(0.4, 0.9), duration=3.0, samples=2)
        return jax.vmap(jax.jacfwd(lambda t: jnp.stack(response(t))))(times)

    at_the_end, before = slopes(np.array([3.0, 3.0 - 1e-9]))
    np.testing.assert_allclose(at_the_end, before, rtol=1e-5)


def test_slopes_of_forces_in_both_modes():
    """By slenderness, amplitude and duration: steps that were not taken are no numbers, and have no part in it."""
    for amplitude, within in ((0.4, 1e-11), (1.5, 1e-9)):  # the second comes back from beyond its balance
        _, forward, reverse, _ = slopes_of_a_history(np.array([0.2, amplitude, 0.6, 0.0, 0.0, 1.0]), 2.0)
        forward, reverse = (np.asarray(x)[3:, :3] for x in (forward, reverse))
        assert amplitude > 1 or np.abs(forward).min() > 1e-4
        np.testing.assert_allclose(reverse, forward, rtol=within)


@pytest.mark.slow
def test_second_derivatives_of_a_history():
    """Compare Hessians of rotations and of the margin with differences of gradients; they must be symmetric."""
    x = jnp.array([0.2, 2.0, 0.9, 0.26, 1.4, 1.7])

    def results(q):
        response = rk.simulate(rk.Block(*q[:3]), rk.SinePulse(q[3], q[4]), samples=2)
        rotation, velocity = response(jnp.stack([0.3 * q[4], q[5]]))
        return jnp.concatenate([rotation, velocity, response.margin[None]])

    found = jax.jit(jax.hessian(results))(x)
    np.testing.assert_allclose(found, jnp.swapaxes(found, 1, 2), rtol=1e-11, atol=1e-10)
    steps = 1e-4 * jnp.diag(x)
    nearby = jnp.concatenate([x + k * steps for k in (-2, -1, 1, 2)])
    slopes = jax.jit(jax.vmap(jax.jacfwd(results)))(nearby).reshape(4, 6, 5, 6)
    differences = (slopes[0] - 8 * slopes[1] + 8 * slopes[2] - slopes[3]) / (12e-4 * x[:, None, None])
    np.testing.assert_allclose(found, jnp.moveaxis(differences, 0, 1), rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("engine", [None, slow(rk.Diffrax(rtol=1e-11, atol=1e-13))], ids=["series", "diffrax"])
def test_second_derivatives_of_a_speed_between_impacts(engine):
    """The largest speed, where it is an extremum within a step, which moves: differences of first derivatives."""
    record = rk.Record(0.35 * np.sin(0.3 * np.arange(40)), 0.025)
    x = np.array([0.2, 2.0, 1.0])

    def speed(q):
        return rk.outcome(rk.Block(q[0], q[1]), q[2] * record, engine=engine).max_velocity

    def sloped(q):
        slope = jax.grad(speed)(q)
        return slope, slope

    steps = 1e-4 * np.diag(x)
    nearby = np.concatenate([x[None], *(x + k * steps for k in (-2, -1, 1, 2))])
    (found, *_), slopes = map(np.asarray, jax.jit(jax.vmap(jax.jacfwd(sloped, has_aux=True)))(nearby))
    slopes = slopes[1:].reshape(4, 3, 3)
    differences = (slopes[0] - 8 * slopes[1] + 8 * slopes[2] - slopes[3]) / (12e-4 * x[:, None])
    np.testing.assert_allclose(found, differences, rtol=1e-6, atol=1e-6)
    assert np.abs(found).min() > 1e-3


WAVE = 0.35 * np.sin(0.13 * np.arange(90))
TWICE = {  # what is differentiated twice, and where
    "speed by 90 samples": (lambda s: rk.outcome(rk.Block(0.2, 2.0), rk.Record(s, 0.012)).max_velocity, WAVE),
    "rotation by 40 samples": (lambda s: rk.outcome(rk.Block(0.2, 2.0), rk.Record(s, 0.027)).max_rotation, WAVE[:80:2]),
    "margin by samples and dt": (
        lambda q: rk.outcome(rk.Block(q[0], q[1]), rk.Record(q[3:], q[2])).margin,
        np.array([0.2, 2.0, 0.012, *WAVE]),
    ),
    "both directions of two sides": (
        lambda q: (
            rk.outcome(
                rk.blocks.AsymmetricBlock(q[0], q[1], q[2]),
                rk.SinePulse(q[3], q[4]).with_vertical(rk.SinePulse(0.3 * q[3], 0.5 * q[4])),
            ).margin
        ),
        np.array([0.2, 0.25, 2.0, 0.3, 1.4]),
    ),
    "diffrax": (
        lambda q: (
            rk.outcome(rk.Block(*q[:3]), rk.SinePulse(q[3], q[4]), engine=rk.Diffrax(rtol=1e-11, atol=1e-13)).margin
        ),
        np.array([0.2, 2.0, 0.9, 0.23, 1.4]),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("what", TWICE)
def test_second_derivatives_in_every_nesting(what):
    """In one direction: differences of gradients, and gradients those of values."""
    result, x = TWICE[what]
    x = jnp.asarray(x)
    direction = 0.3 * jnp.cos(1.0 + jnp.arange(x.size)) * jnp.maximum(jnp.abs(x), 0.01)

    def along(function):
        return lambda x: jax.jvp(function, (x,), (direction,))[1]

    def sloped(function):
        return lambda x: jax.grad(function)(x) @ direction

    nested = {"ff": along(along(result)), "fr": along(sloped(result)), "rf": sloped(along(result))}
    nested["rr"] = sloped(sloped(result))
    found = {name: float(jax.jit(function)(x)) for name, function in nested.items()}
    value, slope, step = jax.jit(result), jax.jit(sloped(result)), 3e-4

    def difference(function):
        at = [function(x + k * step * direction) for k in (-2, -1, 1, 2)]
        return float(at[0] - 8 * at[1] + 8 * at[2] - at[3]) / (12 * step)

    assert found == pytest.approx(dict.fromkeys(found, difference(slope)), rel=1e-6, abs=1e-9)
    assert float(slope(x)) == pytest.approx(difference(value), rel=1e-6, abs=1e-9)


@pytest.mark.slow  # fast: `test_given_values_in_a_scan` of what was wrong
@pytest.mark.parametrize("of", ["margin", "history"])
def test_second_derivatives_by_all_samples(of):
    """The Hessian times a direction, forward over reverse and reverse over reverse: differences of gradients."""
    count = 100
    samples = 0.35 * jnp.sin(0.12 * jnp.arange(count)) * jnp.exp(-0.005 * jnp.arange(count))
    direction = jnp.cos(0.3 * jnp.arange(count))
    block = rk.Block(0.2, 2.0)

    def result(samples):
        record = rk.Record(samples, 0.01)
        if of == "margin":
            return rk.outcome(block, record).margin
        return jnp.sum(rk.simulate(block, record, samples=2)(jnp.linspace(0.0, 1.5, 30))[0] ** 2)

    slopes, step = jax.jit(jax.grad(result)), 1e-4
    at = [slopes(samples + k * step * direction) for k in (-2, -1, 1, 2)]
    differences = (at[0] - 8 * at[1] + 8 * at[2] - at[3]) / (12 * step)
    over_reverse = jax.jit(lambda x: jax.jvp(slopes, (x,), (direction,))[1])(samples)
    np.testing.assert_allclose(over_reverse, differences, rtol=1e-7, atol=1e-9)
    if of == "margin":
        twice = jax.jit(jax.grad(lambda x: slopes(x) @ direction))(samples)
        np.testing.assert_allclose(twice, differences, rtol=1e-7, atol=1e-9)


# ---- One step and one impact: independent formulas ----


@pytest.mark.parametrize("vertical", [False, True], ids=["horizontal", "also vertical"])
@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_a_step_against_its_own_series(model, vertical):
    """The end of a step at a fixed time moves as the polynomial does when JAX differentiates it term by term."""
    order = 6

    def start(q):
        table = model.moments(rk.Block(q[0], 2.0))
        forcing = [q[4 + k] for k in range(5)] + [0.0 * q[0]] * (order - 4)
        shaking = Shaking(forcing, [0.5 * q[4] - 0.1, q[5] * q[6], -q[7]] if vertical else None)
        return Start(table, q[1], jnp.ones(()), jnp.array(False), q[2], q[3], shaking, jnp.ones(()))

    def plainly(q):
        return jnp.stack(jet(taylor_expansion(start(q), order).opening, jnp.array(0.8), 1))

    def by_weights(q):
        opening, speed = jax.lax.stop_gradient(plainly(q))
        no = jnp.array(False)
        end = End(jnp.array(0.8), opening, speed, 0.0 * speed, 0.0 * speed, no, no, no)
        return jnp.stack(arrive(order, start(q), end)[1:])

    q = jnp.array([0.25, 0.7, 0.11, 0.05, 0.3, -0.2, 0.1, 0.05, -0.03])
    np.testing.assert_allclose(by_weights(q), plainly(q), rtol=1e-15)
    np.testing.assert_allclose(jax.jacfwd(by_weights)(q), jax.jacfwd(plainly)(q), rtol=1e-12, atol=1e-14)


def test_saltation():
    """Linear, three impacts: transition matrices of the flow, between them the saltation matrices of the impacts."""
    alpha, p, e, amplitude, period = 0.2, 2.0, 0.9, 0.21, 1.4
    x = np.array([alpha, amplitude, period, -0.01, 0.0, 1.2])
    _, found, _, impacts = slopes_of_a_history(x, 1.2)
    found = np.asarray(found)[:2, 3:5]  # rotation and velocity at the end by those at the start
    times, speeds = (x[np.isfinite(impacts[0])] for x in map(np.asarray, impacts))
    assert len(times) == 3

    def flow(duration):
        c, s = np.cosh(p * duration), np.sinh(p * duration)
        return np.array([[c, s / p], [p * s, c]])

    expected, last = np.eye(2), 0.0
    for time, speed in zip(times, speeds):
        u, side = amplitude * np.sin(2 * np.pi * time / period), -np.sign(speed)  # the corner it stood on
        before, after = (-(p**2) * (s * alpha + u) for s in (side, -side))
        jump = np.array([[e, 0.0], [(after - e * before) / speed, e]])
        expected, last = jump @ flow(time - last) @ expected, time
    expected = flow(1.2 - last) @ expected
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)


# ---- Where derivatives end ----


def bisected(function, lower, upper):
    """Where a flag that is false at `lower` becomes true."""
    for _ in range(60):
        middle = (lower + upper) / 2
        lower, upper = (lower, middle) if function(middle) else (middle, upper)
    return lower, upper


TIME = np.arange(0, 60, 0.02)  # of records that share what is compiled


@functools.cache
def without_motion():
    """Return sensitivities of a linear block under a ground that does not move."""
    return rk.studies.sensitivity(rk.Block(0.2, 2.0), rk.Record(0.0 * TIME, 0.02), rk.Linear())


def test_a_block_that_does_not_uplift_has_no_slopes():
    """Nor under a ground that does not move, in which there is no peak to scale."""
    found = without_motion()
    for slopes in (found.max_rotation, found.max_velocity):
        assert slopes.value == 0 and np.isinf(slopes.reach) and slopes.status == rk.studies.SlopeStatus.useful
        assert not np.any(slopes.derivative) and not np.any(slopes.elasticity)


def test_nothing_is_far_of_a_scene_that_was_not_computed():
    """NaN says that no distance is known: infinite would be safe. Nor is one known without a slope."""
    found = without_motion()
    assert found.boundary_distance == found.graze_distance == np.inf  # computed, and nothing moves it
    rows, names, result = np.zeros((4, 5)), found.names[:-1], found.outcome
    numbers = found.values[:-1], jnp.asarray(0.2)
    assert len(names) == 5

    def distances(rows, **known):
        told = of_rows(rows, dataclasses.replace(result, **known))
        return float(told.graze_distance), float(told.boundary_distance)

    of_rows, nan = jax.jit(functools.partial(_told, names, *numbers)), jnp.asarray(np.nan)
    failed = distances(rows, status=rk.Status.step_budget_exhausted, margin=nan, clearance=nan)
    assert np.isnan(failed).all()
    rows[2], rows[3] = np.nan, 0.1
    assert distances(rows)[0] == np.inf and np.isnan(distances(rows)[1])


def two_lobes(restitution, *numbers):
    """A linear block under half sines of size and duration, the second after a delay."""
    first_size, first_duration, size, duration, delay = numbers
    motion = rk.HalfSinePulse(first_size, first_duration) + rk.HalfSinePulse(size, duration).shifted(delay)
    return rk.outcome(rk.Block(0.2, 2.0, restitution), motion, **QUICKLY)


def test_a_planted_graze():
    """A block comes back; a second lobe turns it just above the ground, or it just touches: derivatives jump there."""

    def run(size):
        return two_lobes(0.6, 0.5, 0.35, size, 0.5, 1.05)

    assert int(run(0.644).impact_count) == 2 and int(run(0.646).impact_count) == 0
    for size in (0.64, 0.644, 0.646, 0.65):
        assert bool(run(size).differentiable) and run(size).status == rk.Status.successful
        assert 0 < float(run(size).clearance) < 1e-3
    for size in bisected(lambda size: int(run(size).impact_count) == 0, 0.644, 0.646):
        found = run(size)
        assert not bool(found.differentiable) or found.status == rk.Status.undecided
        assert float(found.clearance) < 1e-9


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_ties_and_grazes_within_rounding(kind):
    """Two peaks one unit of rounding apart are equal in single precision, too; so is a graze of a few."""
    eps = np.finfo(kind).eps
    for second, clearance, smooth in ((0.09, 0.01, True), (0.1 * (1 - eps), 0.01, False), (0.09, 0.2 * eps, False)):
        numbers = (jnp.asarray(x, kind) for x in (0.1, second, clearance, 0.2))
        assert bool(has_one_peak(*numbers)) == smooth


def test_a_tie_of_two_peaks():
    """Two equal lobes, far apart: two equal peaks, of which no one is the peak."""
    lower, equal, higher = (two_lobes(0.5, 0.4, 0.3, size, 0.3, 20.0) for size in (0.39, 0.4, 0.41))
    assert not bool(equal.differentiable)
    assert bool(higher.differentiable) and bool(lower.differentiable)
    assert float(higher.max_rotation) > float(lower.max_rotation)


@pytest.mark.slow
def test_an_impact_at_the_end_of_the_motion():
    """The forcing has a kink there, not a jump: derivatives are the same on both sides."""
    history = jax.jit(lambda amplitude: rk.simulate(rk.Block(0.2, 2.0, 0.9), rk.SinePulse(amplitude, 0.5), samples=2))
    _, amplitude = bisected(lambda size: bool(history(size).impact_times[0] > 0.5), 0.5, 0.8)
    assert float(history(amplitude).impact_times[0]) == pytest.approx(0.5, abs=1e-14)
    near = np.array([[0.2, 2.0, 0.9, amplitude * (1 + d), 0.5] for d in (-1e-8, 1e-8)])
    slopes, outcomes = first("sine", "nonlinear")(near)
    assert np.all(outcomes.status == rk.Status.successful)
    np.testing.assert_allclose(slopes[0, 0], slopes[1, 0], rtol=1e-5)


# ---- Sensitivities ----


def test_there_are_no_slopes_beyond_the_time_at_which_errors_outgrow_the_rotation():
    found = without_motion()
    result, names, numbers = found.outcome, found.names[:-1], (found.values[:-1], jnp.asarray(0.2))
    of_rows = jax.jit(functools.partial(_told, names, *numbers))
    cases = {  # what the copies said; status of slopes of the peak, and of the margin
        "known": ({"known_until": jnp.asarray(9.0)}, "useful", "useful"),
        "chaotic": ({"status": rk.Status.chaotic, "differentiable": jnp.asarray(False)}, "useless", "useless"),
        "a late peak": ({"known_until": jnp.asarray(4.0)}, "useless", "useless"),
        "chaotic, overturned": ({"status": rk.Status.chaotic, "overturned": jnp.asarray(True)}, "missing", "useless"),
        "open": ({"status": rk.Status.undecided, "known_until": jnp.asarray(4.0)}, "missing", "missing"),
    }
    like = {"time_of_max": jnp.asarray(5.0), "max_rotation": jnp.asarray(0.1), "differentiable": jnp.asarray(True)}
    for name, (changes, *expected) in cases.items():
        told = of_rows(np.full((4, 5), 0.1), dataclasses.replace(result, **(like | changes)))
        for slopes, status in zip((told.max_rotation, told.margin), expected):
            assert slopes.status == getattr(rk.studies.SlopeStatus, status), name
            assert np.isnan(slopes.derivative).all() == (status != "useful")
        assert bool(told.valid) == np.isfinite(told.boundary_distance) == (name == "known")


def test_an_overturned_block_has_no_peak_to_differentiate():
    found = rk.studies.sensitivity(rk.Block(0.2, 2.0), rk.ExponentialPulse(0.6, 0.8, -1.0), **QUICKLY)
    assert bool(found.outcome.overturned) and not bool(found.valid)
    assert np.all(np.isnan(found.max_rotation.elasticity)) and np.all(np.isfinite(found.margin.derivative))
    assert found.max_rotation.status == rk.studies.SlopeStatus.missing and np.isnan(found.max_rotation.reach)
    assert found.margin.status == rk.studies.SlopeStatus.useful


def test_sensitivity_of_a_scene():
    """Elasticities obey similarity, agree with the outcome's derivatives, and vanish with nothing to depend on."""
    pulse = rk.ExponentialPulse(0.3, 0.8, -1.0)
    found = rk.studies.sensitivity(rk.Block(0.2, 2.0), pulse, **QUICKLY)
    assert bool(found.valid)
    named = dict(zip(found.names, np.asarray(found.max_rotation.elasticity)))
    assert found.names == ("alpha", "p", "restitution", "amplitude", "duration", "shape", "uplift_strength")
    assert named["p"] == pytest.approx(named["duration"], rel=1e-10)  # only p t_d counts
    assert named["alpha"] + named["amplitude"] == pytest.approx(1.0, rel=1e-10)  # linear: rotation over alpha
    np.testing.assert_allclose(named["uplift_strength"], -named["amplitude"], rtol=1e-15)
    assert named["restitution"] == 0  # the peak comes before the first impact
    # The single lobe's peak has a closed form.
    exact = gradient(lambda x: rk.closed_form.single_lobe.peak_rotation(*x.T), [[0.2 / 0.3, 1.6, -1.0]])[0]
    rotation = float(found.max_rotation.value) / 0.2
    assert named["shape"] == pytest.approx(float(exact[2]) * -1.0 / rotation, rel=1e-9)
    assert named["duration"] == pytest.approx(float(exact[1]) * 1.6 / rotation, rel=1e-9)


def test_a_pulse_that_is_scaled_or_shifted_has_one_amplitude():
    pulse = rk.ExponentialPulse(0.25, 0.5, -1.0)
    alone, scaled, shifted = (
        rk.studies.sensitivity(rk.Block(0.2, 2.0), each, **QUICKLY) for each in (pulse, 1.0 * pulse, pulse.shifted(0.0))
    )
    for each in (scaled, shifted):
        np.testing.assert_allclose(each.condition, alone.condition, rtol=1e-9)
        np.testing.assert_allclose(each.boundary_distance, alone.boundary_distance, rtol=1e-9)


def one_sine():
    """A wave of 0.25 g and 1.4 s, and a minute of rest."""
    return rk.Record(np.where(TIME < 1.4, 0.25 * np.sin(2 * np.pi * TIME / 1.4), 0.0), 0.02)


def a_minute_of_shaking():
    """Thirty sines of random frequencies and phases, 0.2 g at their largest."""
    random = np.random.default_rng(3)
    angle = 2 * np.pi * random.uniform(0.3, 3, (30, 1)) * TIME + random.uniform(0, 2 * np.pi, (30, 1))
    acceleration = np.sin(angle).sum(axis=0)
    return rk.Record(0.2 * acceleration / np.abs(acceleration).max(), 0.02)


USES = {
    "a wave": (rk.Block(0.2, 2.0, 0.9), one_sine(), "useful"),
    "a minute of shaking": (rk.Block(0.12, 1.62625, 0.95), a_minute_of_shaking(), "useless"),
}


def moved(found, motion, changes):
    """The outcome of a scene of a record with its parameters changed, relative to them."""
    values = dict(zip(found.names, np.asarray(found.values)[:-1] * (1 + changes)))
    amplitude = float(np.asarray(found.values)[found.names.index("amplitude")])
    record = rk.Record(values["amplitude"] / amplitude * np.asarray(motion.samples), values["dt"])
    block = rk.Block(values["alpha"], values["p"], values["restitution"])
    return rk.studies.sensitivity(block, record, rk.Linear()).outcome


def test_distances_tell_how_far_is_too_far():
    """Moving the parameters by the distance to the boundary, along the steepest way, leads close to it."""
    block, motion, _ = USES["a wave"]
    found = rk.studies.sensitivity(block, motion, rk.Linear())
    way = np.asarray(found.margin.elasticity)[:-1]
    there = moved(found, motion, -float(found.boundary_distance) * way / np.linalg.norm(way))
    assert 0 < float(found.boundary_distance) < 0.05
    assert abs(float(there.margin)) < 0.1 * float(found.margin.value)
    assert float(found.condition) > 1 and float(found.graze_distance) > 0


@pytest.mark.parametrize("case", USES)
def test_whether_a_slope_can_be_followed(case):
    """Check the reach: steps of a thousandth of it, in the steepest direction, follow the slopes to a hundredth.

    Where slopes are useless, steps of 1e-6 do something else altogether.
    """
    block, motion, status = USES[case]
    found = rk.studies.sensitivity(block, motion, rk.Linear())
    assert found.outcome.status == rk.Status.successful and not bool(found.outcome.overturned)
    assert found.margin.status == getattr(rk.studies.SlopeStatus, status)
    way = np.asarray(found.margin.elasticity)[:-1]
    way = way / np.linalg.norm(way)
    here, reach = float(found.margin.value), float(found.margin.reach)
    assert reach == pytest.approx(1 / (here * np.linalg.norm(np.asarray(found.margin.elasticity)[:-1])), rel=1e-9)
    if status == "useful":
        assert 0.01 < reach < 1
        step = 1e-3 * reach
        assert float(moved(found, motion, step * way).margin) - here == pytest.approx(1e-3, rel=1e-2)
    else:
        assert reach < 1e-10
        foretold = 1e-6 / reach
        assert foretold > 1e3 and abs(float(moved(found, motion, 1e-6 * way).margin) - here) < 3
        assert "blocks with scatter" in rk.studies.SlopeStatus[found.margin.status]


@pytest.mark.slow
def test_sensitivity_map():
    found = rk.studies.sensitivity_map([0.7, 0.9], [0.5, 1.0, 1.5], -1.0, model=rk.Linear(), restitution=0.9)
    single = rk.studies.sensitivity(rk.Block(0.2, 1.0, 0.9), rk.ExponentialPulse(0.2 / 0.9, 1.0, -1.0), rk.Linear())
    assert found.sensitivity.max_rotation.elasticity.shape == (2, 3, 7)
    np.testing.assert_allclose(
        found.sensitivity.max_rotation.elasticity[1, 1], single.max_rotation.elasticity, rtol=1e-9, atol=1e-12
    )


WAVES = np.sin(0.3 * np.arange(70))
LAST, LIFTING = rk.RectangularPulse(-0.25, 0.4), rk.RectangularPulse(0.3, 0.25)


def one_after_the_other(x, _):
    return rk.HalfSinePulse(0.45, x[0]) + LAST.shifted(x[1])


def three(x, sizes):
    first, last = rk.RectangularPulse(sizes[0], x[0]).shifted(x[1]), rk.RectangularPulse(sizes[1], 0.4).shifted(x[3])
    return first + (rk.HalfSinePulse(0.45, x[2]) + last)


def two_later(x, _):
    return (rk.SinePulse(0.4, x[0]) + rk.RectangularPulse(0.1, x[1])).shifted(x[2])


def beside_a_record(x, numbers):
    size, another, duration, share = numbers
    pulse = rk.RectangularPulse(another, duration).shifted(x[1])
    return rk.HalfSinePulse(size, x[0]) + pulse + rk.Record(share * WAVES, x[2])


def with_vertical(x, _):
    return rk.SinePulse(0.4, x[0]).with_vertical(rk.CosinePulse(0.2, x[1]))


def lifted_there(x, _):
    return LIFTING.shifted(x[0]) + rk.TriangularPulse(-0.15, 0.5).shifted(x[1])


def record_upward(x, _):
    return rk.Record(0.4 * WAVES, x[0] / 25).with_vertical(rk.Record(WAVES, x[1] / 25))


# A motion, its durations and delays, linear in two of which knots come together, its other numbers, and where they do.
# What has no size is there for what others of its kind have.
TOGETHER = {
    "a pulse that begins where another ends": (one_after_the_other, lambda a, b: (a, b), (), 0.5),
    "the other way round": (three, lambda a, b: (0.4, b, a, 2.0), (-0.25, 0.0), 0.5),
    "pulses that end together": (two_later, lambda a, b: (a, b, 0), (), 0.6),
    "three": (three, lambda a, b: (b, 0, a, a + b - 0.5), (0.1, -0.25), 0.5),
    "with the vertical motion": (with_vertical, lambda a, b: (a, b), (), 0.6),
    "later": (two_later, lambda a, b: (a, b, a), (), 0.6),
    "beside a record": (beside_a_record, lambda a, b: (a, b, 0.02), (0.45, -0.25, 0.4, 0.1), 0.5),
    "lifted there": (lifted_there, lambda a, b: (a, b), (), 0.75),
    "lifted there, beside a record": (beside_a_record, lambda a, b: (2.5, a, b / 16), (0, 0.3, 0.25, 0.05), 0.75),
    "a record upward, too": (record_upward, lambda a, b: (a, b), (), 0.5),
}
NONLINEAR = (one_after_the_other, record_upward)  # the others compile in half the time


@functools.cache
def where_knots_come_together(make, engine):
    """Peak and margin of a motion's numbers, and their slopes in both modes (of the series engine) by two in which
    those are linear: compiled once for all motions of a kind."""
    exact, fully = isinstance(engine, rk.Series), isinstance(engine, rk.Series) and make in NONLINEAR
    model = rk.Housner() if fully else rk.Linear()
    engine = QUICKLY["engine"] if exact and not fully else engine

    def slopes(x, start, by, rest):
        def results(x):
            found = rk.outcome(rk.Block(0.2, 2.0, 0.9), make(start + by @ x, rest), model, engine=engine)
            return jnp.stack([found.max_rotation, found.margin])

        seen, pushed = jax.linearize(results, x)
        forward = jax.vmap(pushed, out_axes=1)(np.eye(2))
        pulled = jax.linear_transpose(pushed, x)  # of one linearization: twice it would be compiled twice
        return seen, forward, jax.vmap(lambda row: pulled(row)[0])(np.eye(2)) if exact else forward

    many = jax.jit(jax.vmap(slopes, in_axes=(0, None, None, None)))
    return lambda *given: tuple(map(np.asarray, many(*given)))


@pytest.mark.parametrize(
    "case, engine", [*((case, rk.Series()) for case in TOGETHER), (next(iter(TOGETHER)), rk.Diffrax(rtol=1e-10))]
)
def test_where_knots_come_together(case, engine):
    """Each has a slope of its own: what differences say, on both sides of the tie."""
    make, of, rest, at = TOGETHER[case]
    exact, x = isinstance(engine, rk.Series), np.array([at, at])
    start, *by = (np.array(of(*x), float) for x in ((0, 0), (1, 0), (0, 1)))
    linear = start, np.stack(by, axis=1) - start[:, None], np.array(rest, float)
    slopes = where_knots_come_together(make, engine)
    step = 1e-5 if exact else 1e-4
    ways = step * np.array([[0, 0], [1, 0], [0, 1], [-1, 0], [0, -1]])
    seen, forward, reverse = slopes(x + ways, *linear)
    found, differences = forward[0], (seen[1:3] - seen[3:]) / (2 * step)
    np.testing.assert_allclose(found, differences.T, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(reverse[0], found, rtol=1e-12, atol=1e-14)
    if exact and make in NONLINEAR:
        many = slopes(np.broadcast_to(x, (70, 2)), *linear)[1]
        np.testing.assert_allclose(many[3], found, rtol=1e-12, atol=1e-14)


def test_a_history_where_knots_come_together():
    """Within it, and where it stops just there."""

    def rotations(x, duration, times):
        motion = rk.SinePulse(0.4, x[0]) + rk.RectangularPulse(0.1, x[1])
        found = rk.simulate(rk.Block(0.2, 2.0, 0.9), motion, duration=duration, samples=2, **QUICKLY)(times)[0]
        return found, found

    both = jax.jit(jax.jacfwd(rotations, has_aux=True))
    x, step = np.array([0.6, 0.6]), 1e-5
    for until in ((3.0, np.array([0.5, 0.6, 1.0])), (0.6, np.array([0.5, 0.55, 0.6]))):
        ends = [[np.asarray(both(x + way * each, *until)[1]) for way in (step, -step)] for each in np.eye(2)]
        differences = [(above - below) / (2 * step) for above, below in ends]
        np.testing.assert_allclose(both(x, *until)[0], np.stack(differences, axis=1), atol=1e-5)


@pytest.mark.parametrize("kind", ["outcome", "history"])
def test_by_all_samples_where_all_knots_come_together(kind):
    """Two records of one step: in reverse mode by every number of both, beside differences."""
    # Of so few steps that there is one tape for all numbers of them.
    block, how = rk.Block(0.2, 2.0, 0.9), {"model": rk.Linear(), "engine": rk.Series(order=6, max_steps=1000)}

    @jax.jit
    @jax.value_and_grad
    def function(motion):
        if kind == "outcome":
            return rk.outcome(block, motion, **how).max_rotation
        return rk.simulate(block, motion, duration=2.0, samples=2, **how)(jnp.array([1.0, 1.5]))[0].sum()

    motion = rk.Record(0.4 * WAVES, 0.02) + rk.Record(0.2 * np.roll(WAVES, 7), 0.02)
    leaves, structure = jax.tree.flatten(motion)
    assert [x.size for x in leaves] == [70, 1, 70, 1]
    found, step = jax.tree.leaves(function(motion)[1]), 1e-7
    for k, at in ((0, 20), (1, 0), (2, 20), (3, 0)):
        way = np.zeros(leaves[k].shape)
        way.flat[at] = step
        ends = [function(structure.unflatten([*leaves[:k], leaves[k] + d, *leaves[k + 1 :]]))[0] for d in (way, -way)]
        np.testing.assert_allclose(found[k].ravel()[at], (ends[0] - ends[1]) / (2 * step), rtol=1e-5)


def test_nothing_is_lifted_between_knots_that_come_together():
    """Two pulses, each too weak, one of which ends as the other begins: never both at once."""
    first = rk.RectangularPulse(0.2, 0.4).shifted(0.1)
    second = rk.RectangularPulse(0.2, 0.4).shifted(0.5)
    factors = np.linspace(0.9, 1.0, 70)

    @jax.jit
    def each_way(motion):
        of = functools.partial(rk.outcome, rk.Block(0.3, 2.0), **QUICKLY)
        many = jax.vmap(lambda factor: of(factor * motion))(factors)
        history = rk.simulate(rk.Block(0.3, 2.0), motion, **QUICKLY, samples=2)
        found = of(1.0 * motion), jax.tree.map(lambda x: x[-1], many), history
        return motion.bounds, [(each.max_rotation, each.impact_count, each.margin) for each in found]

    for motion in (first + second, second + first):
        bounds, found = each_way(motion)
        np.testing.assert_array_less(bounds, 0.2 + 1e-12)
        for max_rotation, impact_count, margin in found:
            assert max_rotation == 0 and impact_count == 0
            np.testing.assert_allclose(margin, 2 - 0.2 / 0.3, rtol=1e-12)
