"""Tendons, ties and dampers: their moments and limits, both engines, and a judge that shares no code."""

import copy
import itertools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.models.equation import Angle
from references import structures, structures_in_jaxrock as translated

BLOCK = rk.Block(0.2, 2.0, 0.9)
PULSE = rk.SinePulse(0.4, 0.8)
HOUSNER = rk.Housner()
EXACT = rk.Diffrax(rtol=1e-11)
TENDON, HINGE = rk.models.Tendon(4.0, 0.2), rk.models.Damper(0.05)
EVERYTHING = HOUSNER + TENDON + HINGE + rk.models.Damper(0.3, centre=True) + rk.models.Tie(1.5, 0.1, damping=0.02)


def slow(*row):
    return pytest.param(*row, marks=pytest.mark.slow)


# ---- Moments and limits ----

MOMENTS = {  # over m g R, at an opening angle x and velocity w
    "tendon": (rk.models.Tendon(3.0, 0.2), lambda x, w, s: (0.2 + 3.0 * 2 * s * np.sin(x / 2)) * s * np.cos(x / 2)),
    "tie": (rk.models.Tie(1.4, 0.7), lambda x, w, s: 0.7 * 1.4 * np.sin(x) * 1.4 * np.cos(x)),
    "hinge": (rk.models.Damper(0.3), lambda x, w, s: 0.3 * w),
    "damper along the centre line": (
        rk.models.Damper(0.3, centre=True),
        lambda x, w, s: 0.3 * (s * np.cos(x / 2)) ** 2 * w,
    ),
    "horizontal damper": (rk.models.Damper(0.3, height=1.4), lambda x, w, s: 0.3 * (1.4 * np.cos(x)) ** 2 * w),
    "tie that yields": (
        rk.models.Tie(1.4, 0.7, yields=0.1),
        lambda x, w, s: np.minimum(0.7 * 1.4 * np.sin(x), 0.1) * 1.4 * np.cos(x),
    ),
    "tie that breaks": (
        rk.models.Tie(1.4, 0.7, breaks=0.5, damping=0.2),
        lambda x, w, s: np.where(
            0.98 * np.sin(x) < 0.5, 0.98 * np.sin(x) * 1.4 * np.cos(x) + 0.2 * (1.4 * np.cos(x)) ** 2 * w, 0.0
        ),
    ),
}


@pytest.mark.parametrize("name", MOMENTS)
def test_moment(name):
    """A restraint adds its moment, which neither the weight nor the ground changes; its slope is the derivative."""
    restraint, expected = MOMENTS[name]
    free, held = HOUSNER.moments(BLOCK), (HOUSNER + restraint).moments(BLOCK)
    for x, w, push, weight in itertools.product((0.0, 0.07, 0.3, 1.3), (-0.2, 0.4), (-0.3, 0.5), (None, 0.7)):
        if name == "tie that breaks":
            held = held.remembering(jnp.asarray(x))
        weight = None if weight is None else jnp.asarray(weight)
        at = Angle.of(jnp.asarray(x)), jnp.asarray(w), jnp.asarray(push), weight
        added = free.acceleration(*at) - held.acceleration(*at)
        assert float(added) == pytest.approx(float(expected(x, w, np.sin(0.2))), abs=2e-15)
        still = at[0], at[2], weight
        slope = (expected(x + 1e-6, 0.0, np.sin(0.2)) - expected(x - 1e-6, 0.0, np.sin(0.2))) / 2e-6
        assert float(free.repulsion(*still) - held.repulsion(*still)) == pytest.approx(float(slope), abs=2e-9)


@pytest.mark.parametrize("restraint", [TENDON, rk.models.Tie(1.2, 0.5), rk.models.Tie(1.2, 5.0, yields=0.05)])
def test_saddle(restraint):
    """At the saddle nothing pulls, and it lies beyond that of the free block; the moment falls at `stiffness` there."""
    moments = (HOUSNER + restraint).moments(BLOCK)
    saddle = float(moments.saddle)
    assert saddle > 0.2
    assert float(moments.restoring(Angle.of(jnp.asarray(saddle)))) == pytest.approx(0, abs=4e-16)
    slope = [float(moments.restoring(Angle.of(jnp.asarray(saddle + h)))) for h in (-1e-5, 1e-5)]
    assert float(moments.stiffness) == pytest.approx((slope[0] - slope[1]) / 2e-5, rel=1e-8)


@pytest.mark.parametrize("height, breaks, saddle", [(1.2, 0.9, 0.62), (1.2, 0.05, 0.2), (1.2, 0.2, 0.28)])
def test_saddle_of_a_tie_that_breaks(height, breaks, saddle):
    """It is where the tie holds the block no longer: in balance, where it breaks, or that of the free block."""
    moments = (HOUSNER + rk.models.Tie(height, 0.6, breaks=breaks)).moments(BLOCK)
    assert float(moments.saddle) == pytest.approx(saddle, abs=0.05)
    limit = np.arcsin(min(breaks / (0.6 * height), 1.0))
    zero = float((HOUSNER + rk.models.Tie(height, 0.6)).moments(BLOCK).saddle)
    assert float(moments.saddle) == pytest.approx(max(0.2, min(zero, limit if limit < 1.5 else 9.0)), abs=1e-15)


def test_uplift_and_slope():
    """A prestress raises the threshold by 1 + P0; a tendon of E A = 2 m g/tan^2(alpha) makes the moment level."""
    moments = (HOUSNER + rk.models.Tendon(7.0, 0.3)).moments(BLOCK)
    assert float(moments.threshold) == pytest.approx(np.tan(0.2) * 1.3, rel=1e-15)
    axial = 2 / np.tan(0.2) ** 2  # E A [m g]; its length is 2 R cos(alpha)
    level = (HOUSNER + rk.models.Tendon(axial / (2 * np.cos(0.2)))).moments(BLOCK)
    zero = jnp.zeros(())
    assert float(level.repulsion(Angle.of(zero), zero)) == pytest.approx(0, abs=1e-15)


@pytest.mark.parametrize("zero", [rk.models.Tendon(0.0), rk.models.Tendon(0.0, 0.0), rk.models.Damper(0.0)])
@pytest.mark.parametrize("amplitude", [0.35, 0.6])
def test_none(zero, amplitude):
    """A restraint of zero force leaves the block free."""
    pulse = rk.SinePulse(amplitude, 0.8)
    free, held = (rk.outcome(BLOCK, pulse, model) for model in (HOUSNER, HOUSNER + zero))
    assert bool(free.overturned) == bool(held.overturned)
    np.testing.assert_allclose(held.max_rotation, free.max_rotation, rtol=1e-13)
    np.testing.assert_allclose(held.margin, free.margin, rtol=1e-11)
    assert int(held.impact_count) == int(free.impact_count)


def test_linear_damped_block():
    """A hinge on the linear block: between impacts x - alpha is a sum of two exponentials."""
    c, start = 0.3, 0.15
    found = rk.simulate(
        rk.Block(0.2, 1.0, 0.9),
        rk.RectangularPulse(1e-6, 0.1),
        rk.Linear() + rk.models.Damper(c),
        initial=(start, 0.0),
        duration=1.0,
    )
    fast, slow_ = (-c + np.sqrt(c * c + 4)) / 2, (-c - np.sqrt(c * c + 4)) / 2
    first = slow_ / (slow_ - fast) * (start - 0.2)
    expected = 0.2 + first * np.exp(fast * found.time) + (start - 0.2 - first) * np.exp(slow_ * found.time)
    np.testing.assert_allclose(found.rotation, expected, atol=2e-6)  # the push of 1e-6


def test_energy():
    """Between impacts a tendon keeps the energy of weight and tendon; a hinge takes its work."""
    for model, c in ((HOUSNER + TENDON, 0.0), (HOUSNER + TENDON + HINGE, 0.05)):
        found = rk.simulate(
            BLOCK, rk.RectangularPulse(1e-9, 0.01), model, initial=(0.15, 0.0), duration=0.7, samples=4001
        )
        x, w = np.array(found.rotation), np.array(found.velocity) / 2.0
        assert x.min() > 0
        s = np.sin(0.2)
        energy = w**2 / 2 + np.cos(0.2 - x) - np.cos(0.2) + 2 * s * np.sin(x / 2) * (0.2 + 4.0 * s * np.sin(x / 2))
        lost = c * np.concatenate([[0], np.cumsum((w[1:] ** 2 + w[:-1] ** 2) / 2)]) * (found.time[1] * 2.0)
        np.testing.assert_allclose(energy + lost, energy[0], atol=1e-8)


# ---- Memory ----


@pytest.mark.slow
def test_broken_tie_stays_broken():
    """A block beyond the limit of its tie is free from then on; the same moment in an `Equation` heals."""
    tie = rk.models.Tie(1.5, 1.0, breaks=0.06)
    limit = np.arcsin(0.06 / 1.5)
    quiet = rk.RectangularPulse(1e-9, 0.1)
    for start in (1.05 * limit, -1.5 * limit):
        free = rk.simulate(BLOCK, quiet, HOUSNER, initial=(start, 0.0), duration=0.3)
        held = rk.simulate(BLOCK, quiet, HOUSNER + tie, initial=(start, 0.0), duration=0.3, engine=EXACT)
        assert float(np.abs(free.rotation).min()) < limit  # where a tie that heals would pull
        np.testing.assert_allclose(held.rotation, free.rotation, atol=1e-11)

    def healing(x, block):
        return jnp.sin(block.alpha - x) + jnp.where(x < limit, 1.5 * jnp.sin(x), 0.0) * 1.5 * jnp.cos(x)

    heals = rk.models.Equation(healing, arm=lambda x, block: jnp.cos(block.alpha - x), bends=[limit])
    one, other = (rk.outcome(BLOCK, rk.SinePulse(0.32, 0.6), model) for model in (heals, HOUSNER + tie))
    assert float(one.max_velocity) - float(other.max_velocity) > 0.02  # the healed wire pulls the block down


@pytest.mark.parametrize("yields", [0.03, 0.1])
def test_yielded_tie_is_slack(yields):
    """A tie that has yielded is slack on the way back; each side has its own, and elastic ties never yield."""
    tie = rk.models.Tie(1.5, 4.0, yields=yields)
    link = tie.link(BLOCK)
    limit = float(link.limit)
    assert limit == pytest.approx(np.arcsin(yields / 6.0), rel=1e-15)
    reached = jnp.asarray(limit + 0.05)
    slack = np.sin(limit + 0.05) - yields / 6.0
    for x in (0.5 * np.arcsin(slack), 0.5 * (np.arcsin(slack) + limit + 0.05), limit + 0.08):
        expected = np.clip(6.0 * (np.sin(x) - slack), 0, yields)
        assert float(link.tension(Angle.of(jnp.asarray(x)), link.onset(reached))) == pytest.approx(expected, abs=1e-15)
    angles = np.linspace(0, 0.4, 20001)
    work = np.trapezoid(np.clip(6.0 * (np.sin(angles) - slack), 0, yields) * 1.5 * np.cos(angles), angles)
    assert float(link.work(jnp.asarray(0.4), link.onset(reached))) == pytest.approx(work, rel=1e-6)


@pytest.mark.parametrize("memory", [{"yields": 0.05}, {"breaks": 0.05}])
def test_a_tie_acts_from_the_ground(memory):
    """A block that just leaves the ground, with zero acceleration, meets the angle at which its tie yields or breaks.

    Rounding turns the first acceleration inward in some of these scenes.
    """
    amplitudes = np.linspace(0.98, 1.07, 9)
    restraint = {"kind": "tie", "height": 1.5, "stiffness": 2.0, **memory}
    found = jax.vmap(lambda a: rk.outcome(BLOCK, rk.SinePulse(a, 0.8), HOUSNER + translated.restraint(restraint)))(
        jnp.asarray(amplitudes)
    )
    for i, amplitude in enumerate(amplitudes):
        known = structures.solve(
            {
                "alpha": 0.2,
                "p": 2.0,
                "restitution": 0.9,
                "structure": {"kind": "block", "sides": 2, "restraints": [restraint]},
                "motion": {"kind": "sine", "amplitude": float(amplitude), "period": 0.8},
            }
        )
        assert bool(found.overturned[i]) == known["overturned"]
        if not known["overturned"]:
            assert float(found.max_rotation[i]) == pytest.approx(known["peak"], rel=1e-7)


# ---- The judge ----

TABLE = json.loads(structures.FILE.read_text())


@pytest.mark.parametrize("amplitude, period, breaks", [(0.25, 0.7, 0.133), (0.26, 1.04, 0.155), (0.18, 1.85, 0.074)])
def test_a_wall_comes_to_rest_whose_tie_has_broken(amplitude, period, breaks):
    """Without its tie a wall at rest is closer to balance than it was with the tie; its hops end all the same."""
    wall = rk.Block.from_dimensions(0.6, 6.0, restitution=0.4, opens="right")
    tie = {"kind": "tie", "height": 1.8, "stiffness": 19.0, "breaks": breaks}
    found = rk.outcome(wall, rk.SinePulse(-amplitude, period), HOUSNER + translated.restraint(tie))
    known = structures.solve(
        {
            "alpha": float(wall.alpha),
            "p": float(wall.p),
            "restitution": 0.4,
            "structure": {"kind": "block", "sides": 1, "side": 1, "restraints": [tie]},
            "motion": {"kind": "sine", "amplitude": -amplitude, "period": period},
        }
    )
    assert not known["overturned"] and not found.overturned
    assert found.status == rk.Status.successful
    assert float(found.max_rotation) == pytest.approx(known["peak"], rel=1e-7)
    assert int(found.impact_count) < 40


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["tendon", "elastic tie", "damper"])
def test_engines_agree(kind):
    """The series engine and the diffrax engine give the same response."""
    for scene in TABLE[kind][:2]:
        one, other = (rk.outcome(*translated.scene(scene), engine=engine) for engine in (rk.Series(), EXACT))
        assert bool(one.overturned) == bool(other.overturned)
        for name in ("max_rotation", "max_velocity", "margin"):
            assert float(getattr(one, name)) == pytest.approx(float(getattr(other, name)), rel=1e-8)


def test_vertical_motion():
    """A vertical acceleration changes the weight, and no restraint: the engines agree, and so does the threshold."""
    motion = PULSE.with_vertical(rk.SinePulse(0.3, 0.5))
    one, other = (rk.outcome(BLOCK, motion, EVERYTHING, engine=engine) for engine in (rk.Series(), EXACT))
    assert float(one.max_rotation) == pytest.approx(float(other.max_rotation), rel=1e-10)
    tendon = rk.models.Tendon(2.0, 0.4)
    lifts = np.tan(0.2) * (1 - 0.5 + 0.4)  # |u| = [(1 + v) + P0] tan(alpha), v = -0.5
    for factor, moved in ((1 - 1e-9, False), (1 + 1e-9, True)):
        down = rk.RectangularPulse(factor * lifts, 0.3).with_vertical(rk.RectangularPulse(-0.5, 0.3))
        for engine in (rk.Series(), EXACT):
            assert (float(rk.outcome(BLOCK, down, HOUSNER + tendon, engine=engine).max_rotation) > 0) is moved


# ---- Derivatives and transformations ----


def with_numbers(x):
    """Return a block and a model of every restraint with a series."""
    model = HOUSNER + rk.models.Tendon(x[0], x[1]) + rk.models.Damper(x[2]) + rk.models.Damper(x[3], centre=True)
    return rk.Block(x[6], x[7], 0.9), model + rk.models.Tie(1.4, x[4], damping=x[5])


NUMBERS = jnp.array([4.0, 0.2, 0.05, 0.3, 0.1, 0.02, 0.2, 2.0])


@pytest.mark.parametrize("vertical", [False, True])
def test_derivatives(vertical):
    """Forward and reverse derivatives are equal, and those of the other engine and of differences."""
    motion = PULSE.with_vertical(rk.SinePulse(0.2, 0.5)) if vertical else PULSE

    def peak(x, engine=None):
        block, model = with_numbers(x)
        return rk.outcome(block, motion, model, engine=engine).max_rotation

    forward = jax.jacfwd(peak)(NUMBERS)
    np.testing.assert_allclose(jax.grad(peak)(NUMBERS), forward, rtol=1e-12)
    np.testing.assert_allclose(jax.jacfwd(lambda x: peak(x, EXACT))(NUMBERS), forward, rtol=1e-8)
    steps = 1e-6 * jnp.eye(len(NUMBERS))
    differences = jnp.array([(peak(NUMBERS + step) - peak(NUMBERS - step)) / 2e-6 for step in steps])
    np.testing.assert_allclose(differences, forward, rtol=1e-7, atol=1e-9)


def test_derivatives_by_a_record():
    """Reverse mode by every sample goes through the steps, the free stage by steps included."""
    samples = jnp.asarray(0.5 * np.sin(2 * np.pi * np.arange(0, 0.81, 0.02) / 0.8))

    def peak(samples):
        return rk.outcome(BLOCK, rk.Record(samples, 0.02), EVERYTHING).max_rotation

    slope = jax.grad(peak)(samples)
    direction = jnp.cos(jnp.arange(samples.size))
    along = (peak(samples + 1e-6 * direction) - peak(samples - 1e-6 * direction)) / 2e-6
    assert float(slope @ direction) == pytest.approx(float(along), rel=1e-6)


@pytest.mark.parametrize("kind", ["yielding tie", "breaking tie"])
def test_derivatives_of_ties(kind):
    """Derivatives by stiffness, strength and height, through yielding or breaking, are differences of the judge."""
    scene = next(s for s in TABLE[kind] if not s["result"]["overturned"] and s["result"]["impacts"] <= 8)
    (tie,) = scene["structure"]["restraints"]
    names = [name for name in ("height", "stiffness", "yields", "breaks") if tie.get(name)]
    block, motion, _ = translated.scene(scene)

    def peak(values):
        own = tie | dict(zip(names, values))
        return rk.outcome(block, motion, HOUSNER + translated.restraint(own), engine=EXACT).max_rotation

    slopes = jax.jacfwd(peak)(jnp.array([tie[name] for name in names]))
    for name, slope in zip(names, slopes):
        step, peaks = 3e-5 * tie[name], []
        for sign in (1, -1):
            changed = copy.deepcopy(scene)
            changed["structure"]["restraints"][0][name] += sign * step
            peaks.append(structures.solve(changed)["peak"])
        known = (peaks[0] - peaks[1]) / (2 * step)
        assert float(slope) == pytest.approx(known, rel=1e-5, abs=1e-8)


def test_transformations():
    """Many scenes at once, under `jax.jit`, are those of a loop; restraints may differ from lane to lane."""
    stiffness = jnp.linspace(0.5, 20.0, 6)

    def of(stiffness):
        return rk.outcome(BLOCK, PULSE, HOUSNER + rk.models.Tendon(stiffness) + HINGE)

    many = jax.jit(jax.vmap(of))(stiffness)
    for i, k in enumerate(stiffness):
        one = of(k)
        for name in ("max_rotation", "margin", "impact_count", "max_velocity"):
            np.testing.assert_allclose(getattr(many, name)[i], getattr(one, name), rtol=1e-12)


def test_history():
    """A history ends where its outcome does: peak, impacts, verdict."""
    record = rk.Record(0.5 * np.sin(2 * np.pi * np.arange(0, 1.61, 0.02) / 0.8), 0.02)
    whole = rk.simulate(BLOCK, record, EVERYTHING)
    found = rk.outcome(BLOCK, record, EVERYTHING)
    assert bool(whole.overturned) == bool(found.overturned) is False
    assert float(whole.max_rotation) == pytest.approx(float(found.max_rotation), rel=1e-13)
    assert float(whole.margin) == pytest.approx(float(found.margin), rel=1e-12)


def test_single_precision():
    """In single precision a tendon and a damper keep five digits."""
    single = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (BLOCK, PULSE))
    model = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), HOUSNER + TENDON + HINGE)
    found = rk.outcome(*single, model)
    assert found.max_rotation.dtype == jnp.float32
    assert float(found.max_rotation) == pytest.approx(
        float(rk.outcome(BLOCK, PULSE, HOUSNER + TENDON + HINGE).max_rotation), rel=2e-5
    )


# ---- Units and mistakes ----


def test_units():
    """From newtons and metres: a block, and a frame, whose tendons are stretched twice as far."""
    tendon = rk.models.Tendon.from_units(2e6, 3e4, mass=5e3, R=2.0)
    assert float(tendon.stiffness) == pytest.approx(2e6 * 2.0 / (5e3 * 9.81), rel=1e-15)
    assert float(tendon.prestress) == pytest.approx(3e4 / (5e3 * 9.81), rel=1e-15)
    frame = rk.models.Tendon.from_units(2e6, 3e4, mass=5e3, R=2.0, beam=3.0)
    assert float(frame.stiffness) == pytest.approx(4 * 2e6 * 2.0 / (7 * 5e3 * 9.81), rel=1e-15)
    assert float(frame.prestress) == pytest.approx(2 * 3e4 / (7 * 5e3 * 9.81), rel=1e-15)
    tie = rk.models.Tie.from_units(2.4, 1e5, yields=900.0, damping=50.0, mass=1e3, R=2.0, p=1.9)
    numbers = [float(x) for x in (tie.height, tie.stiffness, tie.yields, tie.damping)]
    weight = 1e3 * 9.81
    np.testing.assert_allclose(numbers, [1.2, 2e5 / weight, 900 / weight, 50 * 2 * 1.9 / weight], rtol=1e-15)


@pytest.mark.slow
def test_tendons_of_a_frame():
    """A frame whose columns have tendons through both joints, beside the mechanism of column, beam and spring."""
    width, height, beam, stiffness = 0.6, 3.0, 2.0, 60.0  # [N/m], for a column of 1 kg
    alpha, size = np.arctan2(width, height), np.hypot(width, height) / 2

    def bodies(x):
        aside, up = -size * jnp.sin(alpha - x), size * jnp.cos(alpha - x)
        column = rk.models.RigidBody(1.0, aside, up, rotation=x, inertia=size**2 / 3)
        return [column, rk.models.RigidBody(beam, 2 * aside, 2 * up)]

    def moment(x, velocity):  # both joints open by width sin(x/2)
        return stiffness * 2 * width * jnp.sin(x / 2) * width * jnp.cos(x / 2)

    mechanism = rk.models.Mechanism(bodies, moment)
    tendon = rk.models.Tendon.from_units(stiffness, mass=1.0, R=size, beam=beam)
    pulse = rk.SinePulse(0.38, 0.9)
    one = rk.outcome(mechanism.block(), pulse, mechanism, engine=EXACT)
    other = rk.outcome(rk.Block.from_frame(width, height, beam), pulse, HOUSNER + tendon)
    free = rk.outcome(rk.Block.from_frame(width, height, beam), pulse)
    assert not other.overturned and abs(float(other.max_rotation) - float(free.max_rotation)) > 1e-3
    assert float(one.max_rotation) == pytest.approx(float(other.max_rotation), rel=1e-9)


MISTAKES = {
    "Argument `stiffness` must be 0 or more and finite, but is -1": lambda: rk.models.Tendon(-1.0),
    "`yields` and `breaks` must not both": lambda: rk.models.Tie(1.0, 1.0, yields=0.1, breaks=0.2),
    "`height` must be None for a damper along": lambda: rk.models.Damper(0.1, centre=True, height=1.0),
    "must have moments with a Taylor series": lambda: rk.models.Rolling(0.1) + TENDON,
    "must be `Housner\\(\\)` for restraints that are no dampers": lambda: rk.Linear() + TENDON,
    "at most one tie that breaks": lambda: HOUSNER + rk.models.Tie(1, 1, breaks=1) + rk.models.Tie(2, 1, breaks=1),
    "must be a symmetric `Block`": lambda: rk.outcome(
        rk.blocks.AsymmetricBlock(0.2, 0.25, 2.0), PULSE, HOUSNER + TENDON
    ),
    "must be a Diffrax": lambda: rk.outcome(
        BLOCK, PULSE, HOUSNER + rk.models.Tie(1.0, 1.0, yields=0.1), engine=rk.Series()
    ),
    "`p` must be given with `damping`": lambda: rk.models.Tie.from_units(1.0, 1.0, damping=1.0, mass=1.0, R=1.0),
}


@pytest.mark.parametrize("message", MISTAKES)
def test_mistakes(message):
    """An argument that does not apply raises ValueError."""
    with pytest.raises(ValueError, match=message):
        MISTAKES[message]()


def test_sum():
    """A sum reads as it is written; no other thing is added to a model."""
    told = repr(HOUSNER + TENDON + HINGE)
    assert told.startswith("Housner() + Tendon(") and "Damper(" in told
    with pytest.raises(TypeError):
        HOUSNER + 1.0
