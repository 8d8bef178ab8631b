"""Fast pass for many scenes: it gives the results of the accurate pass, run on a few scenes at a time.

`test_suite_outcomes` compares few scenes, which the accurate pass takes in lanes, with each alone; `test_spectra`
compares many.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.compiler import lane_function
from jaxrock.numerics.elementary import logarithm
from jaxrock.numerics.lookup import take
from jaxrock.numerics.polynomial import root_of
from jaxrock.responses.arguments import start_of
from jaxrock.responses.outcome import _OutcomePasses, outcome_like
from references.edge_cases import GROUPS, kept_cases, solver

PULSES = {
    "sine": rk.SinePulse,
    "half sine": rk.HalfSinePulse,
    "cosine (starts with a jump)": rk.CosinePulse,
    "rectangle (ends with a jump)": rk.RectangularPulse,
    "triangle (kink at its top)": rk.TriangularPulse,
    "rounded lobe": lambda a, d: rk.ExponentialPulse(a, d, -2.0),
    "spike": lambda a, d: rk.ExponentialPulse(a, d, 5.0),
    "Ricker (quiet at first)": rk.RickerPulse,
    "two pulses, overlapping": lambda a, d: rk.SinePulse(a, d) + rk.SinePulse(-0.7 * a, 0.6 * d).shifted(0.5 * d),
}
QUICK = {
    ("sine", "nonlinear"),
    ("rectangle (ends with a jump)", "linear"),
    ("cosine (starts with a jump)", "nonlinear"),  # one impact of it needs its root to the last digit
}
MODELS = {"nonlinear": rk.Housner(), "linear": rk.Linear()}
FEW = 50  # up to 64 scenes go without the quick pass
SPAN = np.linspace(1.0498, 1.1, 20001)


def rows():
    """Pulses and models: the slow ones only compile more of the same."""
    for pair in itertools.product(PULSES, MODELS):
        yield pytest.param(*pair, id="-".join(pair), marks=() if pair in QUICK else pytest.mark.slow)


def scenes(count, seed=1):
    """alpha, p, restitution, intensity, frequency ratio: stocky and slender, gentle to violent, damped to elastic."""
    random = np.random.default_rng(seed)
    low, high = np.array([[0.03, 0.5, 0.2, 0.99, 0.15], [0.6, 5.0, 1.0, 12.0, 9.0]])
    return tuple(np.exp(random.uniform(np.log(low), np.log(high), (count, 5))).T)


def under(pulse, model):
    def one(alpha, p, restitution, intensity, ratio):
        block, start = rk.Block(alpha, p, restitution), (0 * alpha, 0 * alpha)  # given, as on an edge: compiled once
        motion = pulse(intensity * model.moments(block).threshold, 2 * jnp.pi / (ratio * p))
        return rk.outcome(block, motion, model, initial=start)

    return one


def quickly_and_carefully(one, *points):
    """The outcomes of many scenes, all at once and so few at a time that they go without the quick pass."""

    @jax.jit
    def both(*points):
        return jax.vmap(one)(*points), jax.lax.map(lambda point: one(*point), points, batch_size=FEW)

    return jax.tree.map(np.asarray, both(*points))


def compare(quick: rk.responses.Outcome, careful: rk.responses.Outcome, alpha):
    np.testing.assert_array_equal(quick.status._value, careful.status._value)
    for name in ("overturned", "impact_count", "differentiable"):
        np.testing.assert_array_equal(getattr(quick, name), getattr(careful, name), name)
    # Two computations differ by the errors of both: ten standard ones.
    atol = np.where(np.isfinite(careful.error), 10 * careful.error, 0) + 1e-13 * alpha
    safe = ~careful.overturned
    assert np.all(np.abs(quick.max_rotation[safe] - careful.max_rotation[safe]) <= atol[safe])
    np.testing.assert_allclose(quick.max_velocity, careful.max_velocity, rtol=1e-10)
    np.testing.assert_allclose(quick.margin, careful.margin, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(quick.clearance, careful.clearance, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("pulse, model", list(rows()))
def test_many_scenes_are_as_few(pulse, model):
    points = scenes(400)
    compare(*quickly_and_carefully(under(PULSES[pulse], MODELS[model]), *points), points[0])


def test_a_dip_within_a_step_counts():
    """A small hop turns back twice within a step, out and in, before the highest peak: its least height is noted."""
    alpha, p, restitution, intensity, ratio = (points[169] for points in scenes(400))

    @jax.jit
    def followed(block, pulse):
        rotation, _ = rk.simulate(block, pulse, engine=rk.Series(order=6), samples=2)(SPAN)
        return rotation, rk.outcome(block, pulse).clearance

    pulse = rk.RickerPulse(intensity * np.tan(alpha), 2 * np.pi / (ratio * p))
    rotation, clearance = jax.device_get(followed(rk.Block(alpha, p, restitution), pulse))
    rotation = np.abs(rotation)
    dip = rotation.min()
    assert 5e-4 < dip < rotation[0]
    np.testing.assert_allclose(clearance, dip, rtol=1e-6)


def test_many_blocks_in_an_earthquake_are_as_few():
    """In rounds: some are lost long before others; many come to rest and uplift again."""
    alpha, p, restitution, *_ = scenes(100)
    record = 1.2 * rk.example_record()

    def one(alpha, p, restitution):
        return rk.outcome(rk.Block(alpha, p, restitution), record)

    compare(*quickly_and_carefully(one, alpha, p, np.minimum(restitution, 0.95)), alpha)


def noise(count, dt, seed=0):
    """A record of smoothed noise."""
    samples = np.convolve(np.random.default_rng(seed).normal(size=count), np.ones(5) / 5, "same")
    return rk.Record(0.6 * samples / np.abs(samples).max(), dt)


GLIDES = {
    "asymmetric, with a vertical record": (noise(500, 0.01).with_vertical(0.5 * noise(300, 0.02, 1)), rk.Housner()),
    "linear, samples far apart": (noise(80, 0.15), rk.Linear()),
    "a record and a pulse": (noise(300, 0.01) + rk.SinePulse(0.3, 1.0), rk.Housner()),
    "a spring": (noise(500, 0.01), rk.Spring("SM1")),
}


@pytest.mark.parametrize(
    "case",
    [pytest.param(name, marks=() if "linear" in name else pytest.mark.slow) for name in GLIDES],
)
def test_gliding_blocks_are_as_few(case):
    """Tilted, moving or at rest at first, gentle to violent, under long pieces and short ones: to the errors told."""
    motion, model = GLIDES[case]
    alpha, p, restitution, *_ = scenes(200, seed=3)
    random = np.random.default_rng(5)
    tilt = np.where(random.random(200) < 0.4, random.uniform(-0.9, 0.9, 200) * alpha, 0.0)

    def one(alpha, p, restitution, scale, tilt, speed):
        block = rk.Block(alpha, p, restitution)
        if "asymmetric" in case:
            block = rk.blocks.AsymmetricBlock(alpha, 1.2 * alpha, p, restitution=(restitution, 0.9 * restitution))
        return rk.outcome(block, scale * motion, model, initial=(tilt, speed))

    points = alpha, p, np.minimum(restitution, 0.95), random.uniform(0.1, 1.5, 200), tilt, 0.3 * tilt * p
    quick, careful = quickly_and_carefully(one, *points)
    np.testing.assert_array_equal(quick.status._value, careful.status._value)
    for name in ("overturned", "impact_count"):
        np.testing.assert_array_equal(getattr(quick, name), getattr(careful, name), name)
    safe = ~quick.overturned & (quick.status._value == rk.Status.successful._value)
    assert 30 < safe.sum() < 200
    told, other, alpha = quick.error[safe], careful.error[safe], alpha[safe]
    assert np.all(np.abs(quick.max_rotation[safe] - careful.max_rotation[safe]) <= told + other + 1e-14 * alpha)
    # What the one and the other tell of errors is alike.
    assert np.median(told / np.maximum(other, 1e-15 * alpha)) < 30


@pytest.mark.parametrize(
    "model, kind",
    [
        ("nonlinear", "double"),
        pytest.param("linear", "double", marks=pytest.mark.slow),
        ("linear", "single"),
        pytest.param("nonlinear", "single", marks=pytest.mark.slow),
    ],
)
def test_few_scenes_are_postponed(model, kind):
    """Otherwise the quick pass would be right, and slow."""
    model = MODELS[model]
    passes = _OutcomePasses(rounds=False)

    def like(scene):
        return outcome_like(scene), jax.ShapeDtypeStruct((), bool)

    def one(alpha, p, restitution, intensity, ratio):
        block = rk.Block(alpha, p, restitution)
        pulse = rk.SinePulse(intensity * model.moments(block).threshold, 2 * jnp.pi / (ratio * p))
        scene = block, pulse, model, start_of((0.0, 0.0)), rk.Series()
        return lane_function(passes.fast_only, key="at once", results=like, in_lanes=True)(scene)[1]

    with jax.enable_x64(kind == "double"):
        postponed = jax.jit(jax.vmap(one))(*map(jnp.asarray, scenes(2000)))
    assert 0 < np.mean(postponed) < 0.02


@pytest.mark.parametrize("degree", [6, 8, 12, 16, 20, 31])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_rough_roots(degree, dtype):
    value = np.logspace(-30, 30, 1001, dtype=dtype)
    found = jax.jit(jax.vmap(lambda v: root_of(v, degree)))(value)
    np.testing.assert_allclose(found, value.astype(float) ** (1 / degree), rtol=0.003 + 0.065 / degree)


def test_logarithm():
    value = np.concatenate([np.logspace(-300, 300, 1001), 1 + np.linspace(-0.5, 1, 1001), 1 + np.logspace(-15, -1, 50)])
    np.testing.assert_allclose(logarithm(jnp.asarray(value)), np.log(value), rtol=2e-15, atol=0)


@pytest.mark.parametrize("count", [1, 3, 8, 9, 100])
def test_pick(count):
    values, index = np.arange(10.0, 10.0 + count), np.arange(-1, count + 3)
    expected = values[np.clip(index, 0, count - 1)]
    picked = jax.jit(jax.vmap(lambda i: take(jnp.asarray(values), jnp.maximum(i, 0))))(index)
    np.testing.assert_array_equal(picked, expected)


# ------------------------------------------------------------------------------------- ten thousand on an edge


@pytest.mark.parametrize(
    "model, kind",
    [
        ("nonlinear", "cosine"),
        ("linear", "cosine"),
        *(pytest.param(m, k, marks=pytest.mark.slow) for m in MODELS for k in ("sine", "exponential", "rectangle")),
    ],
)
def test_no_wrong_answer_on_an_edge(model, kind):
    """Scenes within 1e-14 to 1e-3 of overturning, or of a touch of the ground, all at once: refused or right.

    Some stand still at first, tilted; some turn back beyond pi/2.
    """
    groups, scenes, _, known = kept_cases(again=False)
    members = [i for i, g in enumerate(GROUPS) if (g.model, g.kind, g.delayed) == (model, kind, False)]
    chosen = np.flatnonzero(np.isin(groups, members))
    found = solver(model, kind, False, rk.Series())(scenes[chosen])
    fell, decided = known[chosen, 0], (known[chosen, 0] >= 0) & (found.status == rk.Status.successful)
    assert decided.mean() > 0.9
    np.testing.assert_array_equal(found.overturned[decided], fell[decided] == 1)
    alpha, safe = scenes[chosen, 0], decided & (fell == 0)
    with np.errstate(invalid="ignore"):
        off = np.abs((found.max_rotation - known[chosen, 1]) - known[chosen, 2]) / alpha
    assert np.all(off[safe] <= 10 * np.maximum(found.error / alpha, 1e-11)[safe])
