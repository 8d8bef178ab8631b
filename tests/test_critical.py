"""Critical amplitudes and durations: every end of every overturning interval, against 40-digit bisection."""

import json
from pathlib import Path

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.engines.diffrax.guards import field_of_trials
from jaxrock.studies import ends
from jaxrock.studies.lowest_ends import _closed

SCENES = json.loads((Path(__file__).parents[1] / "references" / "critical.json").read_text())["scenes"]
PULSES = {"sine": rk.SinePulse, "exponential": rk.ExponentialPulse, "half sine": rk.HalfSinePulse}


def slow(*row):
    return pytest.param(*row, marks=pytest.mark.slow)


@pytest.mark.parametrize("kind", ["sine", slow("exponential"), slow("half sine")])
def test_all_ends(kind):
    """Housner's block: islands with up to 13 impacts and gaps between them, all at once."""
    scenes = [scene for scene in SCENES if scene["kind"] == kind]
    alpha, p, restitution = np.array([scene["block"] for scene in scenes]).T
    length = np.array([scene["length"] for scene in scenes])
    shape = [np.array([scene["shape"][0] for scene in scenes])] if kind == "exponential" else []
    pulses = PULSES[kind](np.ones_like(length), length, *shape)
    found = rk.critical_amplitudes(rk.Block(alpha, p, restitution), pulses, intensity=(1.001, 12.0))
    found = jax.tree.map(np.asarray, found)
    assert np.all(found.complete)
    derivatives = 0
    for k, scene in enumerate(scenes):
        ends = scene["ends"]
        assert found.count[k] == len(ends)
        row = [x[k, : len(ends)] for x in (found.value, found.rising, found.impacts)]
        np.testing.assert_allclose(row[0], [float(end["amplitude"]) for end in ends], rtol=1e-12)
        assert row[1].tolist() == [end["kind"] == "below" for end in ends]
        assert row[2].tolist() == [end["impacts"] for end in ends]
        assert np.all(found.balanced[k, : len(ends)])
        assert np.all(np.isinf(found.value[k, len(ends) :]))
        for slopes, end in zip(found.derivative[k], ends):
            if "gradient" in end:
                exact = np.array([float(c) for c in end["gradient"]])
                np.testing.assert_allclose(slopes[:4], exact, rtol=1e-8, atol=1e-9 * np.abs(exact).max())
                derivatives += 1
    assert found.names[:4] == ("alpha", "p", "restitution", "period" if kind == "sine" else "duration")
    assert derivatives >= 4


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_a_search_in_the_precision_of_its_margins(kind):
    """It does not go on where nothing is told any more, and takes for balance what rounding may leave."""
    asked = []

    def at(z, index):
        asked.append(z)
        margin = kind(30) * (kind(np.sqrt(0.5)) - z.astype(kind))
        return margin, np.full_like(margin, -30), (margin < 0).astype(int), np.zeros(z.shape, bool)

    found = ends.roots_of(at, ends.brackets_of(at, np.linspace(0, 1, 5)[None])[0])
    np.testing.assert_allclose(found["z"], [np.sqrt(0.5)], rtol=20 * np.finfo(kind).eps)
    assert found["balanced"].tolist() == [True] and len(asked) < 40


def test_what_is_not_known_is_no_end():
    """Beside a point without a result the verdict may change or not."""
    sides = [np.array([[0.0], [1.0]]), np.array([[-1.0], [1.0]]), np.ones((2, 1)), np.ones((2, 1), int)]
    sides.append(np.zeros((2, 1), bool))
    for margin, is_open in ((np.nan, False), (0.5, True)):
        values = (np.array([0.5]), np.array([margin]), np.ones(1), np.ones(1, int), np.array([is_open]))
        *_, single, more = ends.halved(np, sides, values, np.array([6]))
        assert not single.any() and not more.any()


def ramp(z, numbers):
    """Margins that fall through zero at the root of one half, and are not known close to it, but for a point there."""
    margin = numbers.asarray(30 * (np.sqrt(0.5) - z))
    margin = numbers.where((abs(margin) < 1e-4) & (abs(margin) > 1e-9), numbers.nan, margin)
    return margin, 0 * z - 30, 0 * z, z < 0


def test_points_on_the_way_to_an_end_that_are_not_known_are_told():
    grid = np.linspace(0, 1, 5)
    found = ends.roots_of(lambda z, index: ramp(z, np), ends.brackets_of(lambda z, index: ramp(z, np), grid[None])[0])
    assert found["known"].tolist() == [False]
    for here in (True, False):  # what is no bracket asks nothing
        z = jnp.array([[0.5], [1.0]])
        sides = [z, *ramp(z, jnp)]
        _, known = _closed(lambda z: ramp(z, jnp), sides, jnp.array([here]), z[0, 0])
        assert bool(known) != here


def least(numbers, amplitude):
    """The three lowest ends of a block under a sine, by slenderness, frequency parameter, restitution and period."""
    alpha, p, restitution, period = numbers
    pulse = rk.SinePulse(amplitude, period)
    return rk.critical_amplitudes(rk.Block(alpha, p, restitution), pulse, intensity=(1.001, 12.0), max_ends=3)


def test_lowest_ends_within_transformations():
    """jit, vmap and reverse mode: ends and their derivatives in 40 digits, and nothing where there are fewer."""
    scenes = [scene for scene in SCENES if scene["kind"] == "sine"]
    numbers = np.array([[*scene["block"], scene["length"]] for scene in scenes])

    def told(numbers, amplitude):
        found = least(numbers, amplitude)
        return found.value, found

    found = jax.jit(jax.vmap(jax.jacrev(told, has_aux=True)))(numbers, np.ones(len(scenes)))
    slopes, found = jax.tree.map(np.asarray, found)
    assert np.all(found.complete) and found.derivative.shape == (len(scenes), 3, 4)
    fewer, derivatives = 0, 0
    for k, scene in enumerate(scenes):
        ends = scene["ends"][:3]
        count, fewer = len(ends), fewer + (len(ends) < 3)
        assert found.count[k] == count
        np.testing.assert_allclose(found.value[k, :count], [float(end["amplitude"]) for end in ends], rtol=1e-12)
        assert found.impacts[k, :count].tolist() == [end["impacts"] for end in ends]
        assert np.all(np.isinf(found.value[k, count:])) and not np.any(slopes[k, count:])
        for row, end in zip(slopes[k], ends):
            if "gradient" in end:
                exact = np.array([float(c) for c in end["gradient"]])
                np.testing.assert_allclose(row, exact, rtol=1e-8, atol=1e-9 * np.abs(exact).max())
                derivatives += 1
    assert fewer >= 1 and derivatives >= 2


@pytest.mark.slow
def test_against_closed_forms():
    """Linear block: the same ends as the arcs in closed form; and a spectrum of least amplitudes in one call."""
    ratio = np.array([0.5, 0.8, 1.0, 2.0, 4.0])
    blocks = rk.Block(np.full(5, 0.1), np.ones(5), np.full(5, 0.9))
    pulses = rk.SinePulse(np.ones(5), 2 * np.pi / ratio)
    found = rk.critical_amplitudes(blocks, pulses, rk.Linear(), intensity=(1.001, 10.0))
    for k, w in enumerate(ratio):
        exact = rk.closed_form.sine_pulse.overturning_intervals(float(w), 0.9, searched_from=1.001)
        ends = np.stack([exact.lower, exact.upper], axis=1).ravel()
        ends = ends[ends < 10.0]
        np.testing.assert_allclose(found.intensity[k, : int(found.count[k])], ends, rtol=1e-10)
        assert float(found.lowest[k]) == pytest.approx(0.1 * ends[0], rel=1e-10)


@pytest.mark.slow
def test_one_scene_and_its_durations():
    """A duration is critical at an amplitude exactly if the amplitude is critical at the duration."""
    block = rk.Block(0.1, 2.0, 0.9)
    amplitudes = rk.critical_amplitudes(block, rk.SinePulse(1.0, 2.5), rk.Linear())
    assert amplitudes.value.shape == (int(amplitudes.count),)
    durations = rk.studies.critical_durations(
        block, rk.SinePulse(amplitudes.value[0], 2.5), rk.Linear(), factor=(0.2, 5.0)
    )
    assert float(np.abs(np.asarray(durations.value) - 2.5).min()) < 1e-10
    at = int(np.abs(np.asarray(durations.value) - 2.5).argmin())
    named = dict(zip(durations.names, np.asarray(durations.derivative[at])))
    assert named["p"] == pytest.approx(-2.5 / 2.0, rel=1e-9)  # only p times the duration counts
    # Along the boundary: d duration/d amplitude is one over d amplitude/d duration.
    across = dict(zip(amplitudes.names, np.asarray(amplitudes.derivative[0])))
    assert named["amplitude"] == pytest.approx(1 / across["period"], rel=1e-8)


def test_arguments_out_of_range():
    with pytest.raises(ValueError, match="Argument `intensity` must be rising"):
        rk.critical_amplitudes(rk.Block(0.2, 2.0), rk.SinePulse(1.0, 1.0), intensity=(3.0, 2.0))
    with pytest.raises(ValueError, match="must be numbers or lists"):
        rk.critical_amplitudes(rk.Block(np.full((2, 2), 0.2), 2.0), rk.SinePulse(1.0, 1.0))


# Where neither model nor digits are the point all searches ask the same: they share what is compiled.
QUICK = {"model": rk.Linear(), "engine": rk.Series(order=8)}


def test_a_motion_too_weak_has_no_ends():
    scene = rk.Block(0.2, 2.0, 0.9), rk.SinePulse(1.0, 0.05)
    found = rk.critical_amplitudes(*scene, intensity=(1.0, 1.5), **QUICK)
    assert found.count == 0 and np.isinf(found.lowest)
    assert found.value.shape == (0,) and found.derivative.shape == (0, 4)


def test_traced_arguments_need_a_number_of_ends():
    with pytest.raises(ValueError, match="Argument `max_ends` must be given where arguments are traced"):
        jax.jit(lambda alpha: rk.critical_amplitudes(rk.Block(alpha, 2.0), rk.SinePulse(0.3, 0.8)).value)(0.2)


@pytest.mark.slow
@pytest.mark.parametrize("known", [True, False])
def test_lowest_ends_are_those_of_all(known):
    """Compare the lowest ends of concrete and traced arguments, with derivatives: one block, many, and durations."""
    block, pulse = rk.Block(0.1, 2.0, 0.9), rk.SinePulse(0.3, np.array([1.5, 2.5]))
    cases = [
        (rk.critical_amplitudes, rk.Block(0.2, 2.0, 0.9), rk.SinePulse(1.0, 0.8), rk.Housner()),
        (rk.studies.critical_durations, block, pulse, rk.Linear()),
    ]
    for function, block, motion, model in cases:
        every = function(block, motion, model, progress=False)

        def lowest(p, function=function, motion=motion, model=model, block=block):
            scene = rk.Block(block.alpha, p, block.restitution), motion
            return function(*scene, model, max_ends=2, derivatives=True, progress=False)

        found = lowest(2.0) if known else jax.jit(lowest)(2.0)
        for name in ("value", "intensity", "rising", "impacts", "balanced", "derivative"):
            part = np.asarray(getattr(every, name))
            part = part[:2] if np.ndim(every.count) == 0 else part[:, :2]
            np.testing.assert_allclose(getattr(found, name), part, rtol=1e-9, atol=1e-12, err_msg=name)


@pytest.mark.slow
def test_derivatives_of_lowest_ends_against_a_closed_form():
    """Linear block without impact (Dimitrakopoulos & DeJong 3.10): forward mode, twice, and reverse over it."""

    def third(ratio):
        block, pulse = rk.Block(0.1, 1.0, 0.9), rk.SinePulse(1.0, 2 * jnp.pi / ratio)
        return rk.critical_amplitudes(block, pulse, rk.Linear(), intensity=(1.001, 10.0), max_ends=3).intensity[2]

    exact = rk.closed_form.sine_pulse.no_impact_limit
    assert float(third(5.0)) == pytest.approx(float(exact(5.0)), rel=1e-12)
    assert float(jax.jacfwd(third)(5.0)) == pytest.approx(float(jax.grad(exact)(5.0)), rel=1e-9)
    second = float(jax.grad(jax.grad(exact))(5.0))
    for derivative in (jax.jacfwd(jax.jacfwd(third)), jax.hessian(third)):
        assert float(derivative(5.0)) == pytest.approx(second, rel=1e-7)


@pytest.mark.slow
def test_an_end_without_balance_has_no_derivatives():
    """Under a record the verdict jumps: the amplitude is found, and its slope is not a number."""

    def lowest(alpha):
        found = rk.critical_amplitudes(rk.Block(alpha, 1.5), rk.example_record(), intensity=(1.001, 20.0), max_ends=1)
        return found.value[0], found

    (value, found), slope = jax.value_and_grad(lowest, has_aux=True)(0.25)
    assert not found.balanced[0] and np.isnan(slope)
    scene = rk.Block(0.25, 1.5), rk.example_record()
    factor = float(value) / float(rk.intensity.peak_acceleration(scene[1]))
    verdicts = [bool(rk.outcome(scene[0], x * factor * scene[1]).overturned) for x in (1 - 1e-12, 1 + 1e-12)]
    assert verdicts == [False, True]


def test_the_amplitude_of_a_sum_is_its_own_peak():
    """Which is far below what its parts add up to, where they take from each other."""
    block, first = rk.Block(0.2, 2.0, 0.9), rk.SinePulse(0.3, 0.8)
    asked = QUICK | {"intensity": (1.0, 8.0), "derivatives": False, "progress": False}
    found = rk.critical_amplitudes(block, first + rk.SinePulse(-0.25, 0.8), **asked)
    alone = rk.critical_amplitudes(block, rk.SinePulse(0.05, 0.8), **asked)
    assert alone.count == found.count > 1
    np.testing.assert_allclose(found.value, alone.value, rtol=1e-12)
    np.testing.assert_allclose(found.intensity, alone.intensity, rtol=1e-12)
    with pytest.raises(ValueError, match="Argument `motion` must move the ground"):
        rk.critical_amplitudes(block, first + rk.SinePulse(-0.3, 0.8), **asked)


def test_ends_of_a_sum_of_pulses_are_ends():
    """The verdict changes there, and derivatives are those of differences."""
    block, asked = rk.Block(0.2, 2.0, 0.9), QUICK | {"intensity": (4.0, 5.0), "progress": False}

    def motion(amplitude):
        return rk.SinePulse(amplitude, 0.6) + rk.SinePulse(0.2, 0.3)

    found = rk.critical_amplitudes(block, motion(0.3), **asked)
    peak = rk.intensity.peak_acceleration(motion(0.3))
    factor = float(found.lowest / peak)
    overturns = jax.vmap(lambda share: rk.outcome(block, share * factor * motion(0.3), **QUICK).overturned)
    assert overturns(np.array([1 - 1e-6, 1 + 1e-6])).tolist() == [False, True]
    ends = [rk.critical_amplitudes(block, motion(0.3 + x), **asked, derivatives=False).lowest for x in (-1e-5, 1e-5)]
    slope = np.asarray(found.derivative)[np.argmin(np.asarray(found.value)), found.names.index("first.amplitude")]
    np.testing.assert_allclose(slope, (float(ends[1]) - float(ends[0])) / 2e-5, rtol=1e-6)


def test_durations_of_a_block_of_two_sides():
    block, pulse = rk.blocks.AsymmetricBlock(0.2, 0.25, 2.0), rk.SinePulse(0.6, 1.0)
    found = rk.studies.critical_durations(block, pulse, **QUICK, max_ends=1, derivatives=False, progress=False)
    overturns = jax.vmap(lambda share: rk.outcome(block, rk.SinePulse(0.6, found.value[0] * share), **QUICK).overturned)
    assert sorted(overturns(np.array([1 - 1e-9, 1 + 1e-9])).tolist()) == [False, True]


def test_durations_are_refused_of_models_that_know_p():
    """A longer motion is taken as a larger p, which a damper of so many newtons a metre a second would feel."""
    block, pulse = rk.Block(0.2, 2.0, 0.9), rk.SinePulse(0.5, 1.5)
    moments = (lambda x, k: jnp.sin(k.alpha - x), lambda x, k: jnp.cos(k.alpha - x))
    with pytest.raises(ValueError, match="`model` must not depend on the block's p"):
        rk.studies.critical_durations(block, pulse, rk.models.Equation(*moments, lambda x, v, k: 0.3 / k.p * v))


def test_the_amplitude_of_what_is_made_of_a_pulse_is_its_peak():
    """Check that the amplitude of a scaled Mavroeidis-Papageorgiou pulse is its peak, a tenth below its bound."""
    block, motion = rk.Block(0.2, 2.0), 1.0 * rk.MavroeidisPapageorgiouPulse(0.3, 1.0)
    found = rk.critical_amplitudes(block, motion, **QUICK, max_ends=1, derivatives=False, progress=False)
    factor = float(found.value[0] / rk.intensity.peak_acceleration(motion))
    overturns = jax.vmap(lambda share: rk.outcome(block, share * factor * motion, **QUICK).overturned)
    assert sorted(overturns(np.array([0.9999, 1.0001])).tolist()) == [False, True]


@pytest.mark.parametrize("most", [None, 2])
def test_a_block_that_overturns_at_the_least_amplitude(most):
    """Its lowest end lies below what was looked at: no number, where infinity would say that it stands."""
    block, pulse = rk.Block(0.15, 2.5, 0.95), rk.SinePulse(1.0, 1.5)
    asked = QUICK | {"max_ends": most, "derivatives": False, "progress": False}
    found = rk.critical_amplitudes(block, pulse, intensity=(3.0, 20.0), **asked)
    assert found.from_the_least and np.isnan(found.lowest)
    found = rk.critical_amplitudes(block, pulse, intensity=(1.0, 20.0), **asked)
    assert not found.from_the_least and found.lowest < 3 * 0.15


def test_no_motion_is_unexceeded_where_the_least_topples_a_rock():
    rocks = rk.inverse.Observations([0.15, 0.2], [2.5, 2.0], ["survived"] * 2)
    found, below = (
        rk.inverse.unexceeded_motion(rocks, rk.SinePulse, [0.6, 1.5], intensity=(low, 20.0), progress=False, **QUICK)
        for low in (1.0, 3.0)
    )
    assert np.asarray(found.complete).all() and np.isfinite(found.amplitude).all()
    assert not np.asarray(below.complete).any() and np.isnan(below.amplitude).all()


# Scenes of one batch: a wide block and a large one, one without ends, an unknown one, and two alike.
ALPHA = np.array([0.2, 0.6, np.nan, 0.05, 0.2])
RATE = np.array([2.0, 0.5, 2.0, 8.0, 2.0])
HELD = rk.models.Equation(lambda x, block: jnp.sin(block.alpha - x), lambda x, block: jnp.cos(block.alpha - x))


def critical(alpha, p, options):
    block = rk.Block(alpha, p, 0.9, throw=False)
    search = rk.studies.critical_durations if "factor" in options else rk.critical_amplitudes
    return search(block, rk.SinePulse(0.4, 1.0), progress=False, **options)


SLOW = {"the lowest amplitudes", "of an equation"}
BATCHES = {
    "all amplitudes": {"intensity": (1.0, 4.0)},
    "the lowest amplitudes": {"intensity": (1.0, 4.0), "max_ends": 2},
    "all durations": {"factor": (0.2, 4.0)},
    "of an equation": {"intensity": (1.0, 4.0), "model": HELD, "derivatives": False},
}


@pytest.mark.parametrize(
    "options", [pytest.param(x, marks=[pytest.mark.slow] * (name in SLOW), id=name) for name, x in BATCHES.items()]
)
def test_a_scene_does_not_depend_on_its_neighbours(options):
    """A batch is a loop over its scenes; a scene that cannot be computed has a status of its own."""
    together = critical(ALPHA, RATE, options)
    np.testing.assert_array_equal(together.complete, [True, True, False, True, True])
    assert together.count[2] == 0
    for k in range(ALPHA.size):
        alone = critical(ALPHA[k : k + 1], RATE[k : k + 1], options)
        assert alone.count[0] == together.count[k] and alone.complete[0] == together.complete[k]
        count = int(alone.count[0])
        for name in ("value", "rising", "impacts", "balanced", "derivative"):
            both = (np.asarray(getattr(each, name)) for each in (alone, together))
            np.testing.assert_allclose(*(x[i, :count] for x, i in zip(both, (0, k))), rtol=1e-9, err_msg=name)


def test_a_motion_that_is_not_known_is_so_alone():
    pulses = rk.SinePulse(np.array([1.0, np.nan]), 1.0, throw=False)
    found = rk.critical_amplitudes(rk.Block(0.2, 2.0, 0.9), pulses, intensity=(1.0, 4.0), progress=False)
    np.testing.assert_array_equal(found.complete, [True, False])


# The acceleration is not a real number beyond 1.7 rad, where a trial of an implicit solver may go.
BOUNDED = rk.models.Equation(
    lambda x, block: jnp.sin(block.alpha - x) * jnp.sqrt(1 - x / 1.7), lambda x, block: jnp.cos(block.alpha - x)
)


@pytest.mark.slow
def test_a_trial_beyond_the_domain_of_an_equation_is_no_error_of_a_batch():
    """An implicit solver finds slopes of margins, which all searches need; an explicit one judges them."""
    amplitudes = jnp.array([3.28540898, 6.66409842, 2.28592764, 21.76111076, 0.61, 0.1015889])

    def slopes(engine):
        def margin(amplitude):
            found = rk.outcome(rk.Block(0.2, 2.0, 0.9), rk.SinePulse(amplitude, 1.0), BOUNDED, engine=engine)
            return found.margin, found.status._value

        given = (amplitudes,), (jnp.ones_like(amplitudes),)
        (_, status), (found, _) = jax.jvp(jax.vmap(margin), *given)
        return np.asarray(status) == 0, np.asarray(found)

    decided, found = slopes(rk.Diffrax(solver=diffrax.Kvaerno3(), rtol=1e-6))
    also, right = slopes(rk.Diffrax(rtol=1e-8))
    assert decided[-2:].all() and also.all()
    np.testing.assert_allclose(found[decided], right[decided], rtol=1e-5)


def test_an_implicit_solver_sees_no_slopes_beyond_the_domain():
    """The slopes are zero beyond the domain, and those of the field within it."""

    class Falling(eqx.Module):
        def flow(self, t, y):
            return jnp.stack([y[1], jnp.sqrt(1 - y[0])])

    for opening, right in ((0.75, -1.0), (2.0, 0.0)):
        y, along = jnp.array([opening, 0.5]), jnp.array([1.0, 0.0])
        _, change = jax.jvp(lambda y: field_of_trials(0.0, y, Falling()), (y,), (along,))
        np.testing.assert_allclose(change, [0.0, right])
