"""Laws of restitution: what an impact leaves of the velocity, wherever an impact is.

Judges: free rocking by energy (the speed of every impact is that after the one before), SciPy with a law of its own, a
law that only seems to depend on the speed, and the other engine.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

import jaxrock as rk
from jaxrock.blocks.restitution import Corners, Reset, on_sides, tells_sides
from jaxrock.engines.impact import impact
from jaxrock.engines.scene import Scene
from jaxrock.engines.state import initial_state
from jaxrock.studies.parameters import named, rebuilt

SOFT = rk.restitution.SpeedDependent(0.95, 0.6, 0.3)  # changes much within the speeds that occur here
PULSE = rk.SinePulse(0.4, 0.8)
DIFFRAX = rk.Diffrax(rtol=1e-10)
SHORT = rk.Series(order=6)  # a shorter program
QUICK = {"model": rk.Linear(), "engine": SHORT}  # for what is no matter of the model: one for this file
ENGINES = {"series": SHORT, "diffrax": DIFFRAX}


class Brittle(rk.restitution.AbstractRestitution):
    """The law of the module's docstring: one class."""

    firm: jax.Array
    speed: jax.Array

    def ratio(self, corners, speed):
        return self.firm / (1 + speed / self.speed)


class Gaining(rk.restitution.AbstractRestitution):
    """No law: an impact gains energy."""

    def ratio(self, corners, speed):
        return 1.1 + 0 * speed


BRITTLE = Brittle(jnp.asarray(0.95), jnp.asarray(1.5))
LAWS = {"speed-dependent": SOFT, "of the user": BRITTLE}


def after(law, speed: float) -> float:
    """Speed after an impact, by the formulas in the docstrings."""
    if isinstance(law, Brittle):
        return speed * float(law.firm) / (1 + speed / float(law.speed))
    gentle, violent, scale = (float(x) for x in (law.gentle, law.violent, law.scale))
    return speed * (violent + (gentle - violent) * np.exp(-speed / scale))


def outcomes(found) -> list[np.ndarray]:
    names = ("max_rotation", "max_velocity", "time_of_max", "margin", "impact_count", "overturned")
    return [np.asarray(getattr(found, name)) for name in names]


@jax.jit
def history(law, engine, amplitude, period, speed, duration):
    """Impacts and peak of a block under a sine, the impacts' times and velocities, and what friction they need."""
    block = rk.Block(0.2, 2.0, law)
    motion, initial = rk.SinePulse(amplitude, period), (0.0, speed)
    found = rk.simulate(block, motion, initial=initial, duration=duration, engine=engine, samples=2)
    friction = rk.responses.contact_forces(found, block).friction_at_impact
    return found.impact_count, found.max_rotation, found.impact_times, found.impact_velocities, friction


def under_the_pulse(law):
    return history(law, SHORT, 0.4, 0.8, 0.0, 2.8)  # `PULSE`


@pytest.mark.parametrize(
    "law, engine",
    [
        (SOFT, "series"),
        (BRITTLE, "series"),
        pytest.param(BRITTLE, "diffrax", marks=pytest.mark.slow),
        pytest.param(SOFT, "diffrax", marks=pytest.mark.slow),
    ],
)
def test_free_rocking(law, engine):
    """A free block comes back as fast as it left, after the time in which its moment takes all of that away twice."""
    alpha, p, speed, engine = 0.2, 2.0, 0.3, ENGINES[engine]
    _, _, impact_times, velocities, _ = jax.device_get(history(law, engine, 0.0, 1e-3, speed, 4.0))

    def flight(speed):
        """By the moment at each speed, which tells the rotation."""
        cosine = lambda v: np.cos(alpha) + (speed**2 - v**2) / (2 * p**2)  # noqa: E731
        return 2 * quad(lambda v: 1 / (p**2 * np.sqrt(1 - cosine(v) ** 2)), 0.0, speed, epsabs=0.0, epsrel=2e-14)[0]

    time, times, speeds = 0.0, [], []
    while True:
        time += flight(speed)
        if time > 4.0:
            break
        times, speeds, speed = [*times, time], [*speeds, speed], after(law, speed)
    accuracy = 1e-13 if isinstance(engine, rk.Series) else 1e-7
    count = len(times)
    assert count >= 5
    np.testing.assert_allclose(impact_times[:count], times, rtol=accuracy)
    np.testing.assert_allclose(np.abs(velocities[:count]), speeds, rtol=accuracy)


def by_scipy(law, alpha, p, amplitude, period, until) -> tuple[float, int]:
    """Peak and impacts of a Housner block under a sine; hops here are large enough for a plain event."""
    side = -1.0 if amplitude > 0 else 1.0
    omega = 2 * np.pi / period
    begin = np.arcsin(np.tan(alpha) / abs(amplitude)) / omega
    state, time, peak, impacts = np.array([0.0, 0.0]), begin, 0.0, 0

    def flow(t, y):
        u = amplitude * np.sin(omega * t) if t < period else 0.0
        return [y[1], -(p**2) * (np.sin(side * alpha - y[0]) + u * np.cos(side * alpha - y[0]))]

    while time < until:
        ends = [end for end in (period, until) if end > time]

        def ground(t, y, start=time, side=side):
            return side * y[0] if t > start + 1e-3 else 1.0

        ground.terminal, ground.direction = True, -1
        found = solve_ivp(flow, (time, ends[0]), state, "DOP853", events=ground, rtol=1e-12, atol=1e-14, max_step=0.01,
                          dense_output=True)  # fmt: skip
        fine = found.sol(np.linspace(time, found.t[-1], 20001))
        peak = max(peak, np.abs(fine[0]).max())
        time, state = found.t[-1], found.y[:, -1]
        if found.t_events[0].size:
            impacts += 1
            state = np.array([0.0, np.sign(state[1]) * after(law, abs(state[1]))])
            side = -side
    return peak, impacts


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_under_a_pulse_beside_scipy(law):
    count, found, *_ = jax.device_get(under_the_pulse(law))
    peak, impacts = by_scipy(law, 0.2, 2.0, 0.4, 0.8, until=2.8)
    assert int(count) == impacts >= 2
    np.testing.assert_allclose(float(found), peak, rtol=1e-10)


def scenes(count: int, seed: int = 0):
    """Random blocks and sine pulses under which much happens."""
    draw = np.random.default_rng(seed)
    alpha, p = draw.uniform(0.1, 0.35, count), draw.uniform(1.0, 4.0, count)
    return alpha, p, np.tan(alpha) * draw.uniform(1.2, 5.0, count), draw.uniform(0.4, 2.5, count)


@jax.jit
def followed(law, numbers, engine=SHORT):
    """Compiled once for every kind of law."""

    def one(alpha, p, amplitude, period):
        return rk.outcome(rk.Block(alpha, p, law), rk.SinePulse(amplitude, period), rk.Linear(), engine=engine)

    return jax.vmap(one)(*numbers)


def test_a_law_that_does_not_change_is_a_number():
    """Compare a constant law, in the code for changing laws, with a number: peaks, margins and errors agree."""
    plain, seeming = (followed(law, scenes(200)) for law in (0.9, rk.restitution.SpeedDependent(0.9, 0.9, 1.0)))
    lost = np.asarray(plain.overturned)
    assert 20 < lost.sum() < 180
    for one, other in zip(outcomes(plain), outcomes(seeming)):
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-11)
    np.testing.assert_allclose(plain.error, seeming.error, rtol=1e-6)


def test_both_engines_agree():
    """Free stages by energy and by arcs, verdicts, peaks and margins."""
    few = [x[:40] for x in scenes(200)]
    one, other = jax.tree.map(lambda x: x[:40], followed(SOFT, scenes(200))), followed(SOFT, few, rk.Diffrax(rtol=1e-9))
    assert (np.asarray(one.status == rk.Status.successful)).all()
    np.testing.assert_array_equal(one.overturned, other.overturned)
    safe = ~np.asarray(one.overturned)
    assert 5 < safe.sum() < 35
    np.testing.assert_allclose(one.max_rotation[safe], other.max_rotation[safe], rtol=1e-5)
    np.testing.assert_allclose(one.margin, other.margin, rtol=1e-4, atol=1e-5)


def test_many_scenes_are_as_one():
    many = jax.device_get(followed(SOFT, scenes(200)))
    for k in (0, 7, 31):
        alpha, p, amplitude, period = (x[k] for x in scenes(200))
        one = rk.outcome(rk.Block(alpha, p, SOFT), rk.SinePulse(amplitude, period), **QUICK)
        np.testing.assert_allclose(float(one.margin), float(many.margin[k]), rtol=1e-9)
        assert int(one.impact_count) == int(many.impact_count[k])


def test_derivatives_by_its_parameters():
    """Forward and reverse mode beside differences."""

    def peak(x):
        return rk.outcome(rk.Block(0.2, 2.0, rk.restitution.SpeedDependent(*x)), PULSE, **QUICK).max_rotation

    at = np.array([0.95, 0.6, 0.3])
    found = jax.jit(lambda x: (peak(x), jax.jacfwd(peak)(x), jax.grad(peak)(x)))
    _, forward, reverse = jax.device_get(found(at))
    differences = np.array([float(found(at + h)[0] - found(at - h)[0]) / 2e-6 for h in 1e-6 * np.eye(3)])
    assert np.abs(forward).min() > 1e-4
    np.testing.assert_allclose(forward, differences, rtol=1e-6)
    np.testing.assert_allclose(forward, reverse, rtol=1e-12)


def test_sensitivities_name_its_parameters():
    block = rk.Block(0.2, 2.0, SOFT)
    names = tuple(named(block, PULSE))
    assert names == ("alpha", "p", "restitution.gentle", "restitution.violent", "restitution.scale", "amplitude",
                     "period")  # fmt: skip
    again, _ = rebuilt(block, PULSE, named(block, PULSE))
    assert jax.tree.leaves(again) == jax.tree.leaves(block)


@pytest.mark.slow
def test_sensitivities_by_its_parameters():
    """As derivatives of the peak."""
    found = rk.studies.sensitivity(rk.Block(0.2, 2.0, SOFT), PULSE)
    slopes = dict(zip(found.names, np.asarray(found.max_rotation.derivative)))

    def peak(gentle):
        return rk.outcome(rk.Block(0.2, 2.0, rk.restitution.SpeedDependent(gentle, 0.6, 0.3)), PULSE).max_rotation

    difference = float(peak(0.95 + 1e-6) - peak(0.95 - 1e-6)) / 2e-6
    assert slopes["restitution.gentle"] == pytest.approx(difference, rel=1e-6)


def test_impacts_that_end_rocking():
    """A block that comes to rest in a record, again and again: hops are followed to the last digit."""
    record = rk.example_record()
    found = rk.outcome(rk.Block(0.25, 2.5, SOFT), record, **QUICK)
    number = rk.restitution.SpeedDependent(0.95, 0.95, 0.3)  # the same, as above, and compiled once
    constant = rk.outcome(rk.Block(0.25, 2.5, number), record, **QUICK)
    assert found.status == rk.Status.successful
    assert 0 < int(found.impact_count) < int(constant.impact_count)


@pytest.mark.parametrize("engine", [ENGINES["series"], ENGINES["diffrax"]], ids=ENGINES)
def test_a_law_that_gains_energy_has_no_result(engine):
    found = rk.outcome(rk.Block(0.2, 2.0, Gaining()), PULSE, rk.Linear(), engine=engine)
    assert found.status == rk.Status.not_finite


class Fixed(rk.restitution.AbstractRestitution):
    """A number, whatever it is."""

    value: jax.Array

    def ratio(self, corners, speed):
        return self.value

    @property
    def depends_on_speed(self):
        return False


def test_a_number_that_is_no_ratio_has_no_result():
    for value, status in {1.1: "not_finite", -0.1: "not_finite", 0.9: "successful"}.items():
        found = rk.outcome(rk.Block(0.2, 2.0, Fixed(jnp.asarray(value))), PULSE, rk.Linear(), engine=SHORT)
        assert found.status == getattr(rk.Status, status)


def test_the_laws_of_momentum():
    """Housner's is that of a rectangle, on one side as on two."""
    alpha = np.linspace(0.05, 0.9, 9)
    corners = Corners(alpha, alpha, np.ones(9))
    laws = rk.restitution.AngularMomentum(), rk.restitution.Housner()
    general, housner = jax.jit(lambda corners: [law.ratio(corners, jnp.zeros(9)) for law in laws])(corners)
    np.testing.assert_allclose(general, housner, atol=1e-15)
    np.testing.assert_allclose(housner, 1 - 1.5 * np.sin(alpha) ** 2, atol=1e-15)
    both = rk.blocks.AsymmetricBlock(0.2, 0.2, 2.0)
    np.testing.assert_allclose([both.restitution1, both.restitution2], rk.Block(0.2, 2.0).restitution, rtol=1e-15)


def test_a_pair_and_its_mirror():
    block = rk.blocks.AsymmetricBlock(0.2, 0.3, 2.0, restitution=(0.9, 0.8))
    assert (float(block.restitution1), float(block.restitution2)) == (0.9, 0.8)
    assert float(block.mirrored.restitution1) == 0.8
    one = rk.outcome(block, rk.SinePulse(0.6, 1.0), **QUICK)
    other = rk.outcome(block.mirrored, rk.SinePulse(-0.6, 1.0), **QUICK)
    np.testing.assert_allclose(float(one.margin), float(other.margin), rtol=1e-12)


class Leaning(rk.restitution.AbstractRestitution):
    """A law of one's own that tells sides apart."""

    first: jax.Array

    def ratio(self, corners, speed):
        return jnp.where(corners.side < 0, 0.7, self.first) + 0 * speed


def tabulated(values):
    return jax.jit(lambda speed: jnp.interp(speed, jnp.arange(2.0), values))


class Tabulated(rk.restitution.AbstractRestitution):
    """One whose sides differ by the arrays that two functions under `jax.jit` hold."""

    depends_on_speed = True
    sides: tuple = eqx.field(static=True, default=(tabulated(jnp.array([0.9, 0.8])), tabulated(jnp.array([0.7, 0.6]))))

    def ratio(self, corners, speed):
        return self.sides[0 if corners.side > 0 else 1](speed)


def test_arrays_within_functions_tell_sides_apart():
    """The text of both programs is the same."""
    corners = rk.Block(0.2, 2.0).corners
    assert tells_sides(Tabulated(), corners) and not tells_sides(rk.restitution.Housner(), corners)


@pytest.mark.parametrize("law", [rk.restitution.PerSide(0.9, 0.7), Leaning(jnp.asarray(0.9))])
def test_a_symmetric_block_whose_law_tells_sides_apart(law):
    """It is an asymmetric block of equal sides, also where many are asked for at once."""
    block, pair = rk.Block(0.2, 2.0, law), rk.blocks.AsymmetricBlock(0.2, 0.2, 2.0, restitution=law)

    def peaks(block):
        signs = jnp.array([1.0, -1.0])
        return jax.vmap(lambda sign: rk.outcome(block, sign * PULSE, **QUICK).max_rotation)(signs)

    one = np.asarray(jax.jit(peaks)(block))
    other = [float(rk.outcome(pair, sign * PULSE, **QUICK).max_rotation) for sign in (1, -1)]
    np.testing.assert_allclose(one, other, rtol=1e-12)
    assert abs(one[0] - one[1]) > 1e-3
    engine = rk.Diffrax(rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(rk.outcome(block, -PULSE, rk.Linear(), engine=engine).max_rotation, one[1], rtol=1e-7)


def test_turned_round_a_block_does_as_with_its_ratios_exchanged():
    """Mirror images, on corners of one height and of two; so is a suite both ways round."""
    law, pulse = rk.restitution.PerSide(0.9, 0.7), rk.SinePulse(0.4, 0.6)

    def peak(make, law, sign):
        return float(rk.outcome(make(law), sign * pulse, **QUICK).max_rotation)

    for make in (
        lambda law: rk.Block(0.2, 2.0, law),
        lambda law: rk.blocks.AsymmetricBlock(0.2, 0.2, 2.0, restitution=law),
    ):
        assert peak(make, law, 1) == pytest.approx(peak(make, law.mirrored, -1), rel=1e-13)
        assert abs(peak(make, law, 1) - peak(make, law, -1)) > 0.02
    block = rk.Block(0.2, 2.0, law)
    ways = rk.hazard.suite_outcomes(block, [pulse], facing="both", progress=False, **QUICK).rotation_ratio.ravel()
    np.testing.assert_allclose(ways * 0.2, [peak(lambda law: rk.Block(0.2, 2.0, law), law, s) for s in (1, -1)])


def test_what_a_symmetric_block_of_two_ratios_is_refused():
    """A ratio above 1, which it needs no other height for; and what takes one number for both sides."""
    with pytest.raises(ValueError, match=r"`restitution\[1\]` must be in \[0, 1\], but is 1.2"):
        rk.Block(0.2, 2.0, rk.restitution.PerSide(0.8, 1.2))
    with pytest.raises(ValueError, match=r"`restitution\[1\]` must be in \[0, 1\], but is 1.2"):
        rk.blocks.FlexibleBlock(5.0, 25.0, 30e9, 2500.0, 0.01, restitution=rk.restitution.PerSide(0.8, 1.2))
    block = rk.Block(0.2, 2.0, rk.restitution.PerSide(0.9, 0.7))
    with pytest.raises(ValueError, match="the same on both sides"):
        rk.studies.similarity.groups(block, 0.3, 6.0)
    with pytest.raises(ValueError, match="`restitution` must be 0"):
        rk.blocks.draw_blocks(block, 3, restitution=0.1)
    assert rk.blocks.draw_blocks(block, 3, alpha=0.1).law.second.shape == (3,)


class Written(rk.restitution.AbstractRestitution):
    """One without parameters."""

    def ratio(self, corners, speed):
        return (0.7 if corners.side < 0 else 0.9) + 0 * speed

    @property
    def depends_on_speed(self):
        return False


class Falling(rk.restitution.AbstractRestitution):
    """One without parameters that depends on the speed."""

    def ratio(self, corners, speed):
        return 0.95 - 0.3 * jnp.tanh(speed)


@pytest.mark.parametrize(
    "law, names", [(rk.restitution.PerSide(0.9, 0.7), ["first", "second"]), (Written(), []), (Falling(), [])]
)
def test_parameters_of_laws_that_are_more_than_a_number(law, names):
    """A scene that is made again of its parameters does the same."""
    block, pulse = rk.Block(0.2, 2.0, law), rk.SinePulse(0.4, 0.6)
    values = named(block, pulse)
    assert [name for name in values if "restitution" in name] == [f"restitution.{name}" for name in names]
    again = rebuilt(block, pulse, values)[0]
    one, other = (float(rk.outcome(each, pulse, **QUICK).max_rotation) for each in (block, again))
    assert one == pytest.approx(other, rel=1e-13)


def test_laws_that_do_not_ask_for_the_side_take_one():
    corners = rk.Block(0.2, 2.0).corners
    for law in (*LAWS.values(), rk.restitution.Constant(0.9), rk.restitution.Housner()):
        one, other = on_sides(law, corners)
        assert one is other


def test_a_flexible_block_whose_law_tells_sides_apart():
    """It falls back on one side first, and after that impact the pulse is over: the ratio is that of this side."""

    def peak(restitution, sign):
        block = rk.blocks.FlexibleBlock(1.0, 5.0, 3e9, 2000.0, 0.02, 3, restitution=restitution)
        return float(rk.outcome(block, sign * rk.SinePulse(0.4, 0.9), duration=6.0).max_rotation)

    law = rk.restitution.PerSide(0.9, 0.7)
    alike = [peak(rk.restitution.PerSide(ratio, ratio), 1) for ratio in (0.7, 0.9)]  # as the law: compiled once
    assert [peak(law, 1), peak(law, -1)] == alike and alike[0] != alike[1]


def test_a_rock_with_a_law():
    """An asymmetric block whose sides are alike is a block."""
    one = rk.outcome(rk.blocks.AsymmetricBlock(0.2, 0.2, 2.0, restitution=SOFT), PULSE, **QUICK)
    other = rk.outcome(rk.Block(0.2, 2.0, SOFT), PULSE, **QUICK)
    for a, b in zip(outcomes(one), outcomes(other)):
        np.testing.assert_allclose(a, b, rtol=1e-12)


def test_errors_grow_with_its_slope():
    """Two blocks that hit a little apart: the difference after the impact is as the saltation matrix says."""

    @jax.jit
    def impact(speed):
        reset = Reset.of(SOFT, rk.Block(0.2, 2.0).corners, jnp.asarray(2.0))
        return reset.ratio(speed) * speed, reset.slope(speed)

    speed, h = 0.1, 1e-6
    rebound, slopes = np.array([impact(v) for v in (speed - h, speed, speed + h)]).T
    np.testing.assert_allclose(slopes[1], (rebound[2] - rebound[0]) / (2 * h), rtol=1e-8)
    np.testing.assert_allclose(rebound[0], after(SOFT, 2 * (speed - h)) / 2, rtol=1e-12)


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_friction_at_impacts(law):
    """A more violent impact keeps less and needs more friction."""
    *_, speeds, needed = jax.device_get(under_the_pulse(law))
    for side, friction in zip((1, -1), needed):
        ratios = [after(law, abs(v)) / abs(v) for v in speeds if np.sign(v) == -side and v != 0]
        e = min(ratios)
        np.testing.assert_allclose(float(friction), (1 - e) / (1 + e) / np.tan(0.2), rtol=1e-9)


class Base(rk.models.AbstractEquation):
    """A rigid column on the base of a flexible one: small rotations."""

    kind: str = eqx.field(static=True)

    def moments(self, block):
        sine, one = jnp.sin(block.alpha), jnp.ones_like(block.alpha)
        slope = -sine / block.alpha if self.kind == "linear" else -one
        return rk.models.Coefficients(
            rk.models.Terms(constant=sine, line=slope), rk.models.Terms(constant=jnp.cos(block.alpha))
        )


@pytest.mark.parametrize(
    "law, base",
    [
        pytest.param(0.9, "linear", marks=pytest.mark.slow),
        pytest.param(0.9, "plastic", marks=pytest.mark.slow),
        pytest.param(SOFT, "linear", marks=pytest.mark.slow),
        (SOFT, "plastic"),
    ],
    ids=["a number, linear", "a number, plastic", "speed-dependent, linear", "speed-dependent, plastic"],
)
def test_a_stiff_column_rocks_as_the_rigid_block_on_its_base(law, base):
    """The base's speed sets the ratio, and its law the moment: as the series engine has it of the rigid block."""
    motion = rk.SinePulse(0.3, 0.8)
    column = rk.blocks.FlexibleBlock(5.0, 25.0, 1e18, 2500.0, 0.01, restitution=law, base=base)
    found = rk.responses.outcome_flexible(column, motion, duration=6.0)
    p = float(column.p) / np.sqrt(1 + 1 / (2 * 5**2))  # the lumped masses' moment of inertia

    @jax.jit
    def of_rigid(block):
        rigid = rk.simulate(block, motion, Base(base), duration=6.0, engine=SHORT, samples=2)
        return rigid.impact_count, rigid.max_rotation

    impacts, peak = of_rigid(rk.Block(float(column.alpha), p, law))
    assert found.status == rk.Status.successful
    assert int(found.impact_count) == int(impacts) >= 1
    np.testing.assert_allclose(float(found.max_rotation), float(peak), rtol=1e-6)


@pytest.mark.parametrize(
    "refused",
    [
        lambda: rk.blocks.draw_blocks(rk.Block(0.2, 2.0, SOFT), 3, restitution=0.1),
        lambda: rk.studies.critical_durations(rk.Block(0.2, 2.0, SOFT), PULSE),
        lambda: rk.similarity.groups(rk.Block(0.2, 2.0, SOFT), 0.3, 6.0),
    ],
    ids=["drawn", "longer motions", "similarity"],
)
def test_what_a_law_with_a_scale_of_its_own_has_not(refused):
    with pytest.raises(ValueError, match="depend"):
        refused()


def test_an_elastic_pair_in_single_precision():
    """Check an elastic pair in single precision, whose product rounding makes larger than 1."""
    with jax.enable_x64(False):
        assert rk.restitution.PerSide(1.7, 1 / 1.7).first == np.float32(1.7)
        with pytest.raises(ValueError, match="at most 1"):
            rk.restitution.PerSide(1.7, 1.00001 / 1.7)


def test_a_block_that_keeps_no_velocity_is_thrown_on():
    """By the ground at once: by how much the velocity changes with the restitution is the speed of the impact."""

    @jax.jit
    def after(ground, restitution):
        scene = Scene.of(rk.Block(0.2, 2.0, restitution), PULSE, rk.Linear())
        stepper = SHORT.stepper(scene, None, history=True)
        state = initial_state(scene, jnp.asarray(0.1), jnp.asarray(0.0))
        still = jnp.zeros(()), None
        state = impact(stepper, state, jnp.asarray(True), jnp.asarray(-0.3), (ground, None), still, jnp.asarray(0.1))
        return state.velocity, state.side

    for ground, slope, side in ((0.5, 0.3, -1.0), (0.0, 0.0, 0.0)):  # the second holds it down
        (velocity, found), (moved, _) = jax.jvp(functools.partial(after, ground), (0.0,), (1.0,))
        assert (float(velocity), float(found)) == (0.0, side)
        assert float(moved) == pytest.approx(slope, abs=1e-15)


@pytest.mark.parametrize("given", [(1.2, 0.5, 1.0), (0.9, -0.1, 1.0), (0.9, 0.5, 0.0)])
def test_parameters_have_ranges(given):
    with pytest.raises(ValueError, match="must be"):
        rk.restitution.SpeedDependent(*given)


def _with(where, number):
    return lambda owner: eqx.tree_at(where, owner, jnp.array(np.float64(number)))


PLAIN = rk.Block(0.2, 2.0, 0.9)
BOTH = rk.SinePulse(0.45, 0.5).shifted(0.1) + rk.Record([0.3, -0.4, 0.2], 0.2)  # one kind of motion for all cases
CHANGED = {
    "a restitution above 1": (_with(lambda b: b.law.value, 1.3)(PLAIN), BOTH),
    "a restitution below 0": (_with(lambda b: b.law.value, -0.5)(PLAIN), BOTH),
    "a negative slenderness": (_with(lambda b: b.alpha, -0.2)(PLAIN), BOTH),
    "a negative p": (_with(lambda b: b.p, -2.0)(PLAIN), BOTH),
    "a negative period": (PLAIN, _with(lambda m: m.first.motion.period, -0.5)(BOTH)),
    "a negative delay": (PLAIN, _with(lambda m: m.first.delay, -0.1)(BOTH)),
    "a negative time between samples": (PLAIN, _with(lambda m: m.second.dt, -0.2)(BOTH)),
}


@pytest.mark.parametrize("case", CHANGED)
def test_what_no_constructor_has_seen_has_a_status(case):
    """A step of an optimiser changes numbers of blocks and motions as they are."""
    block, motion = CHANGED[case]
    assert rk.outcome(block, motion, **QUICK).status == rk.Status.not_finite
    assert rk.simulate(block, motion, throw=False, samples=2, **QUICK).status == rk.Status.not_finite
