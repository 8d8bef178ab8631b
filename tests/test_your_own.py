"""Motions and models of a user's own, with arrays and parameters, in all that takes those of the package.

Judges: the same motion as a record, the same model as one of the package.
"""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.engines.bookkeeping import escaped
from jaxrock.engines.scene import Scene
from jaxrock.engines.state import initial_state
from jaxrock.models.equation import Angle
from jaxrock.responses.current_model import current_model
from jaxrock.responses.outcome import _outcome
from jaxrock.studies.parameters import declarations, named

BLOCK = rk.Block(0.2, 2.0)
QUICK = {"model": rk.Linear(), "engine": rk.Series(order=6)}  # compiles in half the time
CORNERS = np.array([0.0, 0.3, -0.25, 0.35, -0.1, 0.0])


class Ramps(rk.motions.AbstractMotion):
    """Straight lines between corners at equal times, times a height; an array that nobody declares."""

    height: jax.Array = rk.parameter("g")
    corners: jax.Array
    step: jax.Array = rk.parameter("s", "positive", symbol="h")
    more: jax.Array | float = 1.0  # a number that nobody declares

    @property
    def knots(self):
        return self.step * jnp.arange(self.corners.shape[0])

    @property
    def scales(self):
        return jnp.full(self.corners.shape[0] - 1, jnp.inf)

    @property
    def bounds(self):
        size = jnp.abs(self.more * self.height * self.corners)
        return jnp.maximum(size[:-1], size[1:])

    def series(self, piece, local, unit, order):
        left, right = self.more * self.corners[piece], self.more * self.corners[piece + 1]
        slope = (right - left) / self.step
        return [self.height * (left + slope * local), self.height * slope * unit][: order + 1]


class Damped(rk.models.AbstractEquation):
    """Housner's equation with a damper, as functions."""

    damping: jax.Array

    def moments(self, block):
        return rk.models.Equation(
            lambda x, b: jnp.sin(b.alpha - x), lambda x, b: jnp.cos(b.alpha - x), lambda x, v, b: self.damping * v
        ).moments(block)

    @property
    def is_series(self):
        return False


class Softer(rk.models.AbstractEquation):
    """A sinusoid that is weaker than the block's own, by a number: the series engine solves it."""

    strength: jax.Array = rk.parameter("-", "share")

    def moments(self, block):
        sine, cosine = jnp.sin(block.alpha), jnp.cos(block.alpha)
        restoring = rk.models.Terms(sine=-self.strength * cosine, cosine=self.strength * sine)
        return rk.models.Coefficients(restoring, rk.models.Terms(sine=sine, cosine=cosine))


def test_what_is_declared_has_its_range():
    """Where an object is made, of numbers that are known."""
    corners = jnp.asarray(CORNERS)
    with pytest.raises(ValueError, match="Argument `step` must be positive and finite, but is -0.7"):
        Ramps(1.0, corners, -0.7)
    with pytest.raises(ValueError, match=r"Argument `strength` must be in \[0, 1\], but is 1.5"):
        Softer(np.array([0.5, 1.5]))
    with pytest.raises(ValueError, match="Argument `strength` must be a number or an array, as of `numpy.asarray`"):
        Softer([0.5, 0.6])
    with pytest.raises(ValueError, match=r"Argument `range` must be one of 'positive', .*, but is \(0, 1\)"):
        rk.parameter("-", (0, 1))
    made = jax.vmap(lambda step: Ramps(1.0, corners, step))(jnp.array([0.2, -0.2]))
    assert made.step.shape == (2,)


def ramps(height=1.0):
    return Ramps(jnp.asarray(height), jnp.asarray(CORNERS), jnp.asarray(0.25), jnp.asarray(1.0))


def record(height=1.0):
    return rk.Record(height * CORNERS, 0.25)


def test_a_motion_with_an_array():
    """As the record of the same samples: outcomes, gradients by height and by all samples."""
    heights = np.linspace(0.8, 2.5, 9)

    def of_own(height, corners):
        return eqx.tree_at(lambda motion: motion.corners, ramps(height), corners)

    def of_record(height, samples):
        return rk.Record(height * samples, 0.25)

    def answers(motion):
        def peak(height, corners):
            found = rk.outcome(BLOCK, motion(height, corners), **QUICK)
            return found.max_rotation, (found.margin, found.impact_count)

        both = jax.value_and_grad(peak, (0, 1), has_aux=True)
        return jax.device_get(jax.jit(jax.vmap(both, in_axes=(0, None)))(heights, CORNERS))

    (own, slopes), (theirs, their_slopes) = answers(of_own), answers(of_record)
    (peaks, (margins, impacts)), (their_peaks, (their_margins, counts)) = own, theirs
    np.testing.assert_allclose(margins, their_margins, rtol=1e-11)
    np.testing.assert_allclose(peaks, their_peaks, rtol=1e-12)
    np.testing.assert_array_equal(impacts, counts)
    assert counts.max() > 0
    known = np.isfinite(peaks) & (peaks > 0)
    (by_height, by_corners), (_, by_samples) = slopes, their_slopes
    assert known.sum() > 2 and np.all(np.any(by_samples[known], axis=1))
    np.testing.assert_allclose(by_corners[known], by_samples[known], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(heights[known] * by_height[known], by_samples[known] @ CORNERS, rtol=1e-9)


WHOLE = np.array([0, 3, -2, 3, -1, 0])  # times 0.1: the corners, about


@pytest.mark.parametrize("kind", [jnp.int32, jnp.int64, jnp.uint8])
def test_whole_numbers_are_numbers(kind):
    """Check that whole numbers of any type count as real ones: in a block, a motion, or a record made of them."""

    def answer(kind):
        signed = jnp.asarray(WHOLE, jnp.int8 if kind is jnp.uint8 else kind)
        block = eqx.tree_at(lambda block: block.p, BLOCK, jnp.asarray(2, kind))
        own = Ramps(jnp.asarray(0.1), signed, jnp.asarray(1, kind), jnp.asarray(1, kind))
        other = eqx.tree_at(lambda motion: motion.samples, record(), signed)
        found = [rk.outcome(block, motion, **QUICK) for motion in (own, other, 0.1 * rk.Record(signed, 0.25))]
        return [(each.max_rotation, each.margin, each.impact_count) for each in found]

    np.testing.assert_allclose(answer(kind), answer(float), rtol=1e-14)
    assert answer(kind)[2][0] > 0


class Tabled(rk.models.AbstractEquation):
    """An equation of known coefficients."""

    table: rk.models.Coefficients

    def moments(self, block):
        return self.table


class Misnamed(rk.motions.SinePulse):
    """A motion with a parameter of the block's name."""

    alpha: jax.Array = rk.parameter("-")

    def __init__(self, amplitude, period, alpha):
        super().__init__(amplitude, period)
        self.alpha = jnp.asarray(alpha)


def test_a_motion_does_not_replace_numbers_of_the_block():
    with pytest.raises(ValueError, match="`motion` has a parameter 'alpha', as the block has"):
        rk.studies.sensitivity(rk.Block(0.2, 2.0), Misnamed(0.4, 1.0, 0.5))


class Picked(rk.motions.AbstractMotion):
    """One of many lists of corners, by its number."""

    lists: jax.Array
    number: jax.Array = rk.parameter("-", is_whole=True)
    scales = None

    @property
    def _own(self):
        return rk.Record(self.lists[self.number], 0.25, throw=False)

    @property
    def knots(self):
        return self._own.knots

    @property
    def bounds(self):
        return self._own.bounds

    def series(self, piece, local, unit, order):
        return self._own.series(piece, local, unit, order)


@pytest.mark.parametrize("kind", [jnp.int32, jnp.int64])
def test_what_is_declared_whole_stays_so(kind):
    """Check that a whole number, such as a place in a list, stays so: no solver varies it."""
    motion = Picked(jnp.stack([CORNERS, 2 * CORNERS]), jnp.asarray(1, kind))
    assert rk.outcome(BLOCK, motion, **QUICK).max_rotation == rk.outcome(BLOCK, record(2.0), **QUICK).max_rotation
    assert "number" not in named(BLOCK, motion)


def test_its_parameters():
    """Check declared parameters, with unit and range, and undeclared numbers; arrays are none."""
    found = declarations(BLOCK, ramps())
    assert tuple(found) == ("amplitude", "alpha", "p", "restitution", "height", "step", "more")
    assert set(named(BLOCK, ramps())) == set(found)
    assert (found["step"].unit, found["step"].range.low, found["step"].symbol) == ("s", 0.0, "h")
    assert found["height"].unit == "g"
    assert found["alpha"].range.high == np.pi / 2


def test_a_motion_of_ones_own_in_sweeps():
    grid, theirs = (
        rk.sweep(
            lambda height, motion=motion: rk.outcome(BLOCK, motion(height), **QUICK),
            height=np.linspace(0.8, 2.5, 9),
            progress=False,
        )
        for motion in (ramps, lambda height: height * record())
    )
    np.testing.assert_allclose(grid.values.margin, theirs.values.margin, rtol=1e-11)


def ends_of(block, motion):
    return rk.critical_amplitudes(block, motion, intensity=(1.0, 6.0), derivatives=False, progress=False, **QUICK)


def test_a_motion_of_ones_own_has_critical_amplitudes():
    own, theirs = ends_of(BLOCK, ramps()), ends_of(BLOCK, record())
    assert int(own.count) == int(theirs.count) > 0
    np.testing.assert_allclose(own.value, theirs.value, rtol=1e-12)


@pytest.mark.slow
def test_critical_amplitudes_of_many_blocks_and_derivatives():
    """The corners are shared by all blocks; of one scene the derivative by the height is that of a scale."""
    many = ends_of(rk.Block(jnp.array([0.2, 0.25]), jnp.asarray(2.0)), ramps())
    one = rk.critical_amplitudes(BLOCK, ramps(), intensity=(1.0, 6.0), progress=False, **QUICK)
    np.testing.assert_allclose(many.value[0][: int(one.count)], one.value, rtol=1e-12)
    assert {"height", "step", "more"} <= set(one.names)


def test_a_suite_of_ones_own():
    suite = rk.motions.Suite([Ramps(jnp.array([0.5, 1.0]), jnp.asarray(CORNERS), jnp.asarray(0.25), jnp.asarray(1.0))])
    np.testing.assert_allclose(suite.peak_acceleration, [0.175, 0.35], rtol=1e-12)


def test_batches_are_refused_where_one_scene_is_meant():
    motion = Ramps(jnp.asarray(1.0), jnp.asarray(CORNERS), jnp.array([0.25, 0.3]), jnp.asarray(1.0))
    with pytest.raises(ValueError, match=r"`motion` must hold one scene, but `step` has shape \(2,\)"):
        rk.outcome(BLOCK, motion)


def test_a_model_of_ones_own_in_series():
    """Half the moment is half the threshold; at the full one it is Housner's block, derivatives too."""
    motion = rk.SinePulse(0.3, 0.8)
    engine = QUICK["engine"]
    theirs = rk.outcome(BLOCK, motion, engine=engine)
    half = Softer(jnp.asarray(0.5)).moments(BLOCK)
    assert float(half.threshold) == pytest.approx(np.tan(0.2) / 2)

    def answer(strength):
        found = rk.outcome(BLOCK, motion, Softer(strength), engine=engine)
        return found.max_rotation, found.margin

    strengths = np.array([0.9 - 1e-6, 0.9, 0.9 + 1e-6, 1.0])
    found = jax.jit(jax.vmap(jax.value_and_grad(answer, has_aux=True)))(strengths)
    (peaks, margins), slopes = jax.device_get(found)
    assert float(slopes[1]) == pytest.approx(float(peaks[2] - peaks[0]) / 2e-6, rel=1e-6)
    assert float(peaks[3]) == pytest.approx(float(theirs.max_rotation), rel=1e-12)
    assert float(margins[3]) == pytest.approx(float(theirs.margin), rel=1e-11)


@pytest.mark.slow
def test_a_model_of_ones_own_by_arcs():
    motion, model = rk.SinePulse(0.3, 0.8), Softer(jnp.asarray(0.9))
    peaks = [float(rk.outcome(BLOCK, motion, model, engine=e).max_rotation) for e in (None, rk.Diffrax(rtol=1e-10))]
    assert peaks[0] == pytest.approx(peaks[1], rel=1e-7)


def test_a_model_of_ones_own_as_functions():
    motion = rk.SinePulse(0.3, 0.8)
    engine = rk.Diffrax(rtol=1e-9)
    peaks = [float(rk.outcome(BLOCK, motion, Damped(jnp.asarray(c)), engine=engine).max_rotation) for c in (0.0, 0.1)]
    assert peaks[0] == pytest.approx(float(rk.outcome(BLOCK, motion, engine=QUICK["engine"]).max_rotation), rel=1e-6)
    assert peaks[1] < peaks[0]


@pytest.mark.parametrize(
    "terms",
    [
        rk.models.Terms(constant=1.0),
        rk.models.Terms(cosine=1.0),
        rk.models.Terms(line=-1.0, sine=1.0),
        rk.models.Terms(),
    ],
    ids=["constant", "cosine", "line and sine", "nothing"],
)
def test_moments_whose_balance_is_not_known_are_refused(terms):
    with pytest.raises(ValueError, match="`restoring_terms` must be"):
        rk.models.Coefficients(terms, rk.models.Terms(constant=1.0))


@pytest.mark.parametrize(
    "arm",
    [
        rk.models.Terms(constant=1.0),
        rk.models.Terms(constant=1.0, line=-0.3),
        rk.models.Terms(cosine=0.9, line=0.1),
        rk.models.Terms(cosine=1.0),
    ],
    ids=["constant", "line", "cosine and line", "cosine"],
)
def test_any_arm_in_both_engines(arm):
    """Arms that no model of the package has, with their derivatives."""

    class WithArm(rk.models.AbstractEquation):
        strength: jax.Array

        def moments(self, block):
            restoring = rk.models.Terms(sine=-jnp.cos(block.alpha), cosine=jnp.sin(block.alpha))
            return rk.models.Coefficients(restoring, jax.tree.map(lambda c: self.strength * c, arm))

    def peak(strength, engine):
        return rk.outcome(BLOCK, rk.SinePulse(0.3, 0.9), WithArm(strength), engine=engine).max_rotation

    around = np.array([1.0 - 1e-6, 1.0, 1.0 + 1e-6])
    values, slopes = jax.device_get(jax.jit(jax.vmap(jax.value_and_grad(lambda s: peak(s, QUICK["engine"]))))(around))
    assert float(values[1]) == pytest.approx(float(peak(around[1], rk.Diffrax(rtol=1e-10))), rel=1e-7)
    assert float(slopes[1]) == pytest.approx(float(values[2] - values[0]) / 2e-6, rel=1e-6)


def test_slopes_where_the_arm_alone_is_no_constant():
    """A straight restoring moment, and an arm that shrinks: the moment grows with the angle as the ground shakes."""

    def peak(x):
        shape = rk.models.Terms(constant=1.0, line=x[1])
        model = rk.models.Coefficients(rk.models.Terms(constant=jnp.asarray(0.2), line=-1.0), shape)
        return rk.outcome(BLOCK, rk.SinePulse(x[0], 0.9), Tabled(model), engine=QUICK["engine"]).max_rotation

    ways = 1e-6 * np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])
    values, slopes = jax.device_get(jax.jit(jax.vmap(jax.value_and_grad(peak)))(np.array([0.3, -0.3]) + ways))
    np.testing.assert_allclose(slopes[0], (values[1::2] - values[2::2]) / 2e-6, rtol=1e-6)


def test_a_controller_with_arrays():
    """Settings of the diffrax engine may be arrays, one for each lane; judged in closed form."""
    amplitude, lasts, alpha, p = 0.3, 0.4, 0.2, 2.0

    def peak(rtol):
        engine = rk.Diffrax(diffrax.Bosh3(), controller=diffrax.PIDController(rtol=rtol, atol=1e-14))
        return rk.outcome(BLOCK, rk.RectangularPulse(amplitude, lasts), rk.Linear(), engine=engine).max_rotation

    rotation, speed = (amplitude - alpha) * (np.cosh(p * lasts) - 1), (amplitude - alpha) * np.sinh(p * lasts)
    exact = alpha - np.sqrt((alpha - rotation) ** 2 - speed**2)  # on the way of constant energy after the pulse
    found = np.asarray(jax.vmap(peak)(np.array([1e-4, 1e-9])))
    assert abs(float(found[1]) / exact - 1) < 1e-7 < abs(float(found[0]) / exact - 1)


def test_a_class_that_closes_over_a_traced_number():
    """It is an input of the program like any other: values and derivatives."""
    block, pulse = rk.Block(0.2, 1.0, 0.9), rk.RectangularPulse(1.0, 0.2)

    def peak(factor):
        class Scaled(rk.Linear):
            def moments(self, block):
                return super().moments(block).times(factor)

        return rk.outcome(block, pulse, Scaled(), engine=QUICK["engine"]).max_rotation

    step = 1e-6
    below, above = float(peak(1 - step)), float(peak(1 + step))  # each closes over a number of its own
    expected = (above - below) / (2 * step)
    assert expected != 0
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(peak)))(np.array([1 - step, 1.0, 1 + step]))
    assert float(np.asarray(slopes)[1]) == pytest.approx(expected, rel=1e-6)
    np.testing.assert_allclose(np.asarray(values)[[0, 2]], [below, above], rtol=1e-12)


@pytest.mark.slow
def test_the_orbit_of_functions_is_drawn():
    """Check the orbit of functions: no manifold is known, so the equilibria stand alone."""
    model = rk.models.Equation(lambda x, b: jnp.sin(b.alpha - x), lambda x, b: jnp.cos(b.alpha - x))
    axis = rk.plot.phase(rk.simulate(BLOCK, rk.SinePulse(0.3, 0.6), model))
    assert axis.get_legend() is None and len(axis.lines) == 4
    plt.close(axis.figure)


def falling(x, block):
    return jnp.sin(x - block.alpha)


def standing(x, block):
    return jnp.sin(block.alpha - x)


@pytest.mark.parametrize(
    ("parts", "what"), [((falling,), "restoring moment"), ((standing, lambda x, block: x - 1.0), "overturning arm")]
)
@pytest.mark.parametrize("call", [rk.outcome, rk.simulate], ids=lambda call: call.__name__)
def test_what_does_not_stand_by_its_equation_raises(call, parts, what):
    """Check that an equation without a stable upright position raises when it is used, alone and under `jax.vmap`.

    Compiled code makes no calls back, so JAX can keep it.
    """
    model = rk.models.Equation(*parts)

    def scene(a):
        return call(BLOCK, rk.SinePulse(a, 1.0), model)

    for scenes, amplitude in ((scene, 0.5), (jax.vmap(scene), jnp.ones(2))):
        with pytest.raises(ValueError, match=f"The {what} must be positive at rotation 0"):
            scenes(amplitude)


def test_what_is_no_smooth_linear_equation_raises():
    """Check that equations that are not smooth and linear raise: dry friction jumps at rest and hides impacts.

    Its smooth form and a damper do not.
    """

    def equation(dissipation):
        return rk.models.Equation(standing, dissipation=dissipation)

    for dry in (lambda x, v, block: 1e-6 * jnp.sign(v), lambda x, v, block: 0.02 * jnp.sign(v)):
        with pytest.raises(ValueError, match="The dissipation must not jump"):
            rk.outcome(BLOCK, rk.SinePulse(0.5, 1.0), equation(dry))
    for bent in (lambda x, push: push**3, lambda x, push: push + 5 * x * push**2):  # at rest, and beyond
        model = rk.models.Equation(acceleration=lambda x, v, push, block, f=bent: x - block.alpha - f(x, push))
        with pytest.raises(ValueError, match="must be linear in the push"):
            rk.outcome(BLOCK, rk.SinePulse(0.5, 1.0), model)
    for smooth in (lambda x, v, block: 0.02 * jnp.tanh(v / 1e-3), lambda x, v, block: 5.0 * v + jnp.abs(v) * v):
        assert not any(equation(smooth).faults(BLOCK).values())


@pytest.mark.slow  # compiles an arc of diffrax
def test_programs_of_ones_own_equation_call_back_to_nothing():
    """Else JAX would not keep them."""
    model = rk.models.Equation(standing)
    scene = BLOCK, rk.SinePulse(0.3, 1.0), current_model(model, BLOCK)
    text = _outcome.lower(*scene, (jnp.zeros(()), jnp.zeros(())), rk.Diffrax()).as_text()
    assert "callback" not in text


class Leaning(rk.models.AbstractEquation):
    """A column on a spring about its corner, for rotations that are not large: a constant and a line."""

    stiffness: jax.Array = rk.parameter("-")

    def moments(self, block):
        terms = rk.models.Terms(constant=jnp.sin(block.alpha), line=self.stiffness - jnp.cos(block.alpha))
        return rk.models.Coefficients(terms, arm_terms=rk.models.Terms(constant=jnp.cos(block.alpha)))


@pytest.mark.parametrize("amplitude", [1.30, 1.33, 1.5])
def test_a_block_falls_flat_before_a_balance_beyond(amplitude):
    """Its balance is at 2.48 rad: on its way there it lies on its side, in the free stage, too."""
    block, model = rk.Block(0.2, 2.0, 0.9), Leaning(jnp.asarray(0.9))
    pulse = rk.SinePulse(amplitude, 1.5)
    found, judge = (rk.outcome(block, pulse, model, engine=each) for each in (QUICK["engine"], rk.Diffrax(rtol=1e-10)))
    assert bool(found.overturned) == bool(judge.overturned) == (amplitude > 1.31)
    np.testing.assert_allclose(found.margin, judge.margin, rtol=1e-6)
    np.testing.assert_allclose(found.max_rotation, judge.max_rotation, rtol=1e-7)


def test_the_end_where_a_block_comes_to_lie_flat():
    """By energy: a block that is thrown from rest lies flat if its speed carries it there, and is not lost before."""
    block, model = rk.Block(0.2, 2.0, 0.9), Leaning(jnp.asarray(0.9))
    slope = np.cos(0.2) - 0.9
    speed = np.sqrt(2 * (np.sin(0.2) * np.pi / 2 - slope * np.pi**2 / 8))  # of the energy at pi/2, over p
    still = rk.SinePulse(0.0, 1e-3)
    for share, falls in ((1 - 1e-9, False), (1 + 1e-9, True)):
        found = rk.outcome(block, still, model, initial=(0.0, share * speed * 2.0), engine=QUICK["engine"])
        assert found.status == rk.Status.successful and bool(found.overturned) == falls
    at_the_end = rk.outcome(block, still, model, initial=(0.0, speed * 2.0), engine=QUICK["engine"])
    assert at_the_end.status == rk.Status.undecided


def test_a_moment_that_never_vanishes_is_for_diffrax():
    block, pulse = rk.Block(0.2, 2.0, 0.9), rk.SinePulse(0.5, 0.9)
    with pytest.raises(ValueError, match="restoring moment of `model` must fall to zero at some rotation"):
        rk.outcome(block, pulse, Leaning(jnp.asarray(1.0)))
    found = rk.outcome(block, pulse, Leaning(jnp.asarray(1.0)), engine=rk.Diffrax(rtol=1e-10))
    np.testing.assert_allclose(found.max_rotation, 0.2044127, rtol=1e-6)  # by SciPy's DOP853


def test_a_moment_that_rights_again_is_for_diffrax():
    """The free stage of the series engine knows one balance."""
    model = OfTerms(RISING, rk.models.Terms(constant=1.0))
    with pytest.raises(ValueError, match="must not right the block again between its balance and pi/2"):
        rk.outcome(BLOCK, rk.SinePulse(0.5, 0.9), model)


@pytest.mark.slow
def test_what_no_help_is_needed_for_comes_back():
    """Check a return from far out, where the arm is negative and the driving push helps; by SciPy's DOP853."""
    model = rk.models.Equation(
        restoring=lambda x, b: jnp.sin(b.alpha) + 1.5 * x, arm=lambda x, b: jnp.cos(b.alpha - x), falls_flat=False
    )
    found = rk.outcome(rk.Block(0.2, 2.0, 0.9), rk.SinePulse(6.0, 1.6), model)
    assert not found.overturned
    np.testing.assert_allclose(found.max_rotation, 2.66638, rtol=1e-5)


def test_a_law_says_that_it_depends_on_the_speed():
    class Quiet(rk.restitution.AbstractRestitution):
        depends_on_speed = False

        def ratio(self, corners, speed):
            return 0.9 - 0.3 * speed

    with pytest.raises(ValueError, match="ratio of a Quiet depends on the speed of the impact, so its property"):
        Quiet()


def rights_itself(x, block):
    """Housner's moment and a tether that tightens from 0.3 on."""
    return jnp.sin(block.alpha - x) + 5 * jnp.maximum(x - 0.3, 0.0) ** 2


class OfTerms(rk.models.AbstractEquation):
    """Any terms."""

    restoring: rk.models.Terms
    arm: rk.models.Terms

    def moments(self, block):
        return rk.models.Coefficients(*jax.tree.map(lambda c: 0 * block.alpha + c, (self.restoring, self.arm)))


HOUSNER = rk.models.Terms(sine=-np.cos(0.2), cosine=np.sin(0.2))
RISING = rk.models.Terms(constant=0.99, sine=-np.cos(1.2), cosine=-np.sin(1.2))  # below zero from 0.23 to 0.51 only


@eqx.filter_jit
def _is_lost(model, ceiling, opening):
    scene = Scene.of(BLOCK, rk.RectangularPulse(ceiling, 0.9), model)
    engine = rk.Series() if model.is_series else rk.Diffrax()
    state = initial_state(scene, opening, jnp.asarray(1e-3))
    return escaped(engine.stepper(scene, None, history=False), state, Angle.of(state.opening))


@pytest.mark.parametrize(
    "model, ceiling, opening, lost",
    [
        (rk.models.Rolling(rk.blocks.Edge([0.0, 0.0, 2.0, 2.0], [0.0, 0.21, 0.22, 1.5])), 1e-4, 0.205, False),
        (rk.models.Rolling(0.01), 1e-4, 0.3, True),
        (rk.models.Equation(rights_itself), 1e-4, 0.3, False),
        (rk.models.Equation(lambda x, b: jnp.sin(b.alpha - x)), 1e-4, 0.3, True),
        (OfTerms(RISING, rk.models.Terms(constant=1.0)), 1e-4, 0.3, False),
        (OfTerms(HOUSNER, rk.models.Terms(cosine=1.0, sine=-3.0)), 0.5, 0.32, False),
        (OfTerms(HOUSNER, rk.models.Terms(cosine=1.0, sine=-3.0)), 0.01, 0.32, True),
        (OfTerms(HOUSNER, rk.models.Terms(constant=1.0, line=10.0)), 0.12, 0.9, False),
    ],
    ids=["edge", "circle", "tether", "no tether", "rising terms", "turning arm", "little help", "growing arm"],
)
def test_what_may_be_held_further_on_is_not_lost(model, ceiling, opening, lost):
    """Check loss past the balance: the block is lost only if nothing can hold it up to pi/2."""
    assert bool(_is_lost(model, jnp.asarray(ceiling), jnp.asarray(opening))) == lost


@pytest.mark.parametrize(
    "restoring, arm, push, opening",
    [
        (rk.models.Terms(constant=-0.9, sine=-np.cos(1.3), cosine=np.sin(1.3)), (1.0, 0.0, 0.0), 0.05, 0.2),
        (rk.models.Terms(constant=0.2, sine=-0.9, cosine=0.1), (1.0, 0.0, 0.0), 0.2, 0.4),
        (RISING, (1.0, 0.0, 0.0), 0.05, 0.235),
        (HOUSNER, (0.0, -5.0, 1.0), 0.5, 0.5),
        (HOUSNER, (0.0, -5.0, 1.0), 0.5, 0.1),
        (HOUSNER, (0.0, -0.3, 1.0), 0.2, 0.3),
        (HOUSNER, (2.0, None, -1.0), 0.2, 0.3),
    ],
)
def test_speed_that_is_enough_under_the_most_helpful_forcing(restoring, arm, push, opening):
    """No less than by the work of what holds, under a forcing of the one sign or the other, up to where that ends."""
    arm = rk.models.Terms(*(None if c == 0.0 else c for c in (arm[0], None, *arm[1:])))
    angles = np.linspace(opening, np.pi / 2, 200_001)

    def summed(terms, x):
        constant, _, sine, cosine, *_ = (0.0 if c is None else c for c in terms.coefficients)
        return constant + sine * np.sin(x) + cosine * np.cos(x)

    holds = summed(restoring, angles) + push * np.abs(summed(arm, angles))
    work = np.concatenate([[0.0], np.cumsum((holds[1:] + holds[:-1]) / 2)]) * (angles[1] - angles[0])
    moments = rk.models.Coefficients(*jax.tree.map(jnp.asarray, (restoring, arm)))
    at = Angle.of(jnp.asarray(opening))
    push = jnp.asarray(push)
    hold = moments.held(at, jnp.zeros(()), push)
    assert float(hold) == pytest.approx(holds[0], rel=1e-12)
    assert float(hold) > 0 and float(moments.held_manifold(at, hold, push)) >= np.sqrt(2 * work.max()) * (1 - 1e-6)


def test_factors_of_functions_multiply():
    """Check that factors of functions multiply, as those of other moments."""

    @jax.jit
    def found(x):
        moments = rk.models.Equation(rights_itself).moments(BLOCK)
        return moments.times(2.0).times(3.0).restoring(Angle.of(x)), moments.restoring(Angle.of(x))

    times, once = found(jnp.asarray(0.1))
    assert float(times) == pytest.approx(6 * float(once), rel=1e-15)


class Halved(rk.Linear):
    """Half of all moments."""

    def moments(self, block):
        return super().moments(block).times(0.5)


class HalvedTwice(rk.Linear):
    """A model equal to `Halved`, from double of the moments."""

    def moments(self, block):
        return super().moments(block).times(jax.lax.fori_loop(0, 2, lambda _, part: part / 2, 2.0 + 0.0 * block.alpha))


def test_a_model_of_ones_own_may_take_turns(caplog):
    """It is machine code, and differentiated, as the same without a loop."""

    def peak_and_slope(model):
        def peak(a):
            pulse, engine = rk.RectangularPulse(a, 0.3), rk.Series(order=8)
            return rk.outcome(rk.Block(0.2, 2.0, 0.9), pulse, model, engine=engine).max_rotation

        return jax.value_and_grad(peak)(0.25)

    with caplog.at_level("DEBUG", "jaxrock"):
        found = peak_and_slope(HalvedTwice())
    assert "left to XLA" not in caplog.text
    np.testing.assert_allclose(found, peak_and_slope(Halved()), rtol=1e-13)
