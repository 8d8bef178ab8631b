"""Flexible blocks whose phases are not linear: any law of the base, finite rotations, P-Delta.

Judged by SciPy's integration of a chain of elements, by energy, by rigid columns on the same spring, by the linear
phases, and by the curvature of the energy at the balance.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.blocks.cantilever import unit_column
from jaxrock.flexible.column import ColumnConstants
from jaxrock.flexible.nonlinear import NonlinearScene, scene_of
from jaxrock.flexible.phases import rocking_phase
from jaxrock.flexible.remainder import Tangents
from references.flexible_column import PULSE, SHORT, TALL, Chain, largest_survived

WHOLE = dict(base="sine", rotations="finite", p_delta=True)
SAMPLES = 301  # of all histories: XLA compiles every number of times anew
STRONG = rk.SinePulse(5.2974 / 9.81, 1.6)  # Diamantopoulos & Fragiadakis, figure 23


def beside_scipy(shape, motion, duration, **more):
    """Largest differences of rotation and top over their peaks, and of impacts [s]."""
    block = rk.blocks.FlexibleBlock(**shape, **more)
    found = rk.simulate(block, motion, duration=duration, samples=SAMPLES)
    assert found.status == rk.Status.successful
    chain = Chain(block, motion)
    pieces, impacts = chain.follow(duration)
    time = np.linspace(0, duration, SAMPLES)
    expected = np.array([chain.at(pieces, t) for t in time]).T
    off = np.abs(np.stack(found(time)[:2]) - expected).max(1) / np.abs(expected).max(1)
    # The last return may be one that SciPy does not come to any more.
    np.testing.assert_allclose(found.impact_times[: len(impacts)], impacts, atol=3e-7)
    assert len(impacts) > 0
    return off


def test_against_an_independent_chain():
    """All three at once, with damping: two masses, one impact and more."""
    rotation, top = beside_scipy(SHORT, STRONG, 4.0, damping_ratio=0.01, masses=2, restitution=0.9, **WHOLE)
    assert rotation < 2e-6 and top < 5e-7  # SciPy's own rotation is no better


@pytest.mark.slow
@pytest.mark.parametrize("base", ["sine", "linear", "plastic"])
@pytest.mark.parametrize(
    "rotations, p_delta, masses", [("finite", False, 3), ("small", True, 3), ("finite", True, 3), ("finite", True, 6)]
)
def test_every_law_against_an_independent_chain(base, rotations, p_delta, masses):
    more = dict(damping_ratio=0.01, masses=masses, base=base, rotations=rotations, p_delta=p_delta)
    rotation, top = beside_scipy(TALL, PULSE, 10.0, **more)
    assert rotation < 2e-6 and top < 5e-7


def drift(masses, duration, **more):
    """By how much the energy varies after the pulse, over its mean, without damping and loss at impacts."""
    block = rk.blocks.FlexibleBlock(**SHORT, damping_ratio=0.0, masses=masses, restitution=1.0, **more)
    motion = rk.SinePulse(0.3, 1.0)
    found = rk.simulate(block, motion, duration=duration, samples=SAMPLES)
    assert found.status == rk.Status.successful and found.impact_count > 0
    energy = sum(np.asarray(part) for part in found.energy(np.linspace(1.01, duration, SAMPLES)))
    return np.ptp(energy) / energy.mean()


def test_energy_is_conserved():
    assert drift(2, 4.0, **WHOLE) < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("base", ["sine", "linear", "plastic"])
@pytest.mark.parametrize("rotations", ["small", "finite"])
def test_energy_is_conserved_with_every_law(base, rotations):
    assert drift(6, 8.0, base=base, rotations=rotations, p_delta=True) < 1e-9


def peaks(modulus, base, p_delta):
    """Peak of a stiff column of three masses over the rigid column's on the same spring, less 1."""
    block = rk.blocks.FlexibleBlock(
        5.0, 25.0, modulus, 2500.0, 0.01, 3, base=base, rotations="finite", p_delta=p_delta, restitution=0.9
    )
    rigid = rk.outcome(rk.Block(block.alpha, block.p, 0.9), STRONG, model=rk.Spring("mmSM", base, masses=3))
    found = rk.outcome(block, STRONG, duration=8.0)
    assert found.status == rk.Status.successful
    return float(found.max_rotation / rigid.max_rotation) - 1


@pytest.mark.slow
@pytest.mark.parametrize("base, p_delta", [("sine", False), ("sine", True), ("linear", False), ("plastic", True)])
def test_the_rigid_limit(base, p_delta):
    """Equations 13 to 15 of Diamantopoulos & Fragiadakis, as 1/modulus: by the series of rigid columns."""
    off = [peaks(modulus, base, p_delta) for modulus in (30e13, 30e14)]
    assert abs(off[1]) < 4e-7 and off[0] / off[1] == pytest.approx(10, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("base", ["linear", "plastic"])
@pytest.mark.parametrize("damping", [0.0, 0.01])
def test_what_is_linear_stays_so(base, damping):
    """Check that the nonlinear stepper without nonlinear terms gives the linear block's own answer."""
    block = rk.blocks.FlexibleBlock(**TALL, damping_ratio=damping, base=base)
    scene = NonlinearScene.of(block, PULSE, jnp.asarray(20.0))

    @jax.jit
    def run(scene):
        return scene.conclude(jax.lax.while_loop(lambda s: ~s.done, lambda s: scene.advance(s), scene.start()))

    found, expected = run(scene), rk.outcome(block, PULSE, duration=20.0)
    for name in ("max_rotation", "max_displacement", "max_bending", "margin", "energy"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-8)
    assert found.impact_count == expected.impact_count


@pytest.mark.slow
def test_small_rotations_are_a_limit():
    """Check columns ever more slender, with pulses and stiffness in proportion: the difference falls as alpha^2."""
    off = []
    for alpha in (0.04, 0.02):
        shape = dict(width=50 * alpha, height=50.0, youngs_modulus=30e9 * (0.1 / alpha) ** 2, density=2500.0)
        pulse = rk.SinePulse(5 * alpha, 1.6)
        small, finite = (
            rk.outcome(rk.blocks.FlexibleBlock(**shape, damping_ratio=0.01, rotations=kind), pulse, duration=5.0)
            for kind in ("small", "finite")
        )
        off.append(float(finite.max_rotation / small.max_rotation) - 1)
    assert 0 < abs(off[0]) < 1e-3 and off[0] / off[1] == pytest.approx(4, rel=0.1)


# ---------------------------------------------------------------- the balance


@pytest.mark.parametrize("base", ["sine", pytest.param("plastic", marks=pytest.mark.slow)])
def test_the_balance_is_a_saddle_of_the_energy(base):
    """No force there; one way down, at the rate of the growing mode; the others up."""
    block = rk.blocks.FlexibleBlock(**TALL, damping_ratio=0.0, masses=4, base=base, rotations="finite", p_delta=True)

    @jax.jit
    def found(block):
        tangents = Tangents.of(ColumnConstants.of(block))
        n, center = tangents.numbers.rotation.size, tangents.numbers.center

        def energy(x):
            q = tangents.turn @ x[:n]
            return tangents.column.strain(q, x[n]) + tangents.column.potential(q, x[n])

        at = jnp.append(center[:n], center[-1])
        rates = rocking_phase(tangents.numbers)[0].rates
        return at, jax.grad(energy)(at), jax.hessian(energy)(at), tangents.numbers.spring_rate, rates

    at, force, bent, scale, rates = (np.asarray(x) for x in found(block))
    assert 0.98 * float(block.alpha) < at[-1] < float(block.alpha)
    assert np.abs(force).max() < 1e-12 * np.abs(bent).max()
    # The base has no mass: it is where the energy is stationary.
    left = bent[:-1, :-1] - np.outer(bent[:-1, -1], bent[-1, :-1]) / bent[-1, -1]
    squares = np.linalg.eigvalsh(left)
    assert squares[0] < 0 < squares[1]
    assert rates.real.max() == pytest.approx(np.sqrt(-squares[0]), rel=1e-9)
    np.testing.assert_allclose(np.sort(rates.imag)[-2:], np.sqrt(squares[1:]), rtol=1e-9)


@pytest.mark.parametrize("masses, factor", [(2, 6.0), (60, 7.837)])
def test_the_weight_under_which_a_column_buckles(masses, factor):
    """3 E I/L^2 against half of the weight at its top; of a continuous column Greenhill's (1881) 7.837."""
    assert unit_column(masses).buckling == pytest.approx(factor, rel=2e-3)


# ------------------------------------------------------- verdicts, derivatives


@pytest.fixture(scope="module")
def by_amplitude():
    """Outcomes by amplitude [g], and slopes of peak and margin."""

    def one(amplitude):
        def numbers(a):
            block = rk.blocks.FlexibleBlock(**TALL, damping_ratio=0.01, masses=3, **WHOLE)
            found = rk.outcome(block, rk.SinePulse(a, 1.6), duration=20.0)
            return (found.max_rotation, found.margin), found

        return jax.jvp(numbers, (amplitude,), (1.0,), has_aux=True)

    return jax.jit(jax.vmap(one))


@pytest.mark.slow
def test_the_margin_is_zero_where_a_column_balances(by_amplitude):
    """It passes through zero with a slope, which is its derivative, where the verdict changes."""
    low = largest_survived(lambda amplitudes: by_amplitude(amplitudes)[2].overturned, 0.7, 0.8)
    away = np.array([-1e-3, -1e-4, -1e-5, 1e-5, 1e-4, 1e-3])
    (_, margin), (_, slope), found = by_amplitude(low * (1 + away))
    np.testing.assert_array_equal(margin < 0, found.overturned)
    near = np.abs(away) < 2e-4
    np.testing.assert_allclose((margin / (low * away))[near], slope[near], rtol=5e-3)


@pytest.mark.slow
def test_derivatives_and_differences(by_amplitude):
    """Compare derivatives with differences: of the peak by the amplitude, forward; by modulus and damping, reverse."""
    at, step = 0.5, 1e-5
    (peak, _), (slope, _), _ = by_amplitude(np.array([at - step, at, at + step]))
    assert float(slope[1]) == pytest.approx(float(peak[2] - peak[0]) / (2 * step), rel=1e-6)

    @jax.jit
    @jax.vmap
    def peak_of(x):
        block = rk.blocks.FlexibleBlock(5.0, 50.0, 30e9 * x[0], 2500.0, 0.01 * x[1], 3, **WHOLE)
        return rk.outcome(block, PULSE, duration=8.0).max_rotation

    x = np.ones(2)
    steps = 1e-5 * np.eye(2)
    differences = (peak_of(x + steps) - peak_of(x - steps)) / 2e-5
    np.testing.assert_allclose(jax.jacrev(lambda x: peak_of(x[None])[0])(x), differences, rtol=2e-6)


@pytest.mark.parametrize("law", [{}, WHOLE], ids=["linear", "whole"])
def test_numbers_of_single_precision_among_others(law):
    """All is computed in the usual precision, whatever was given: steps keep it."""
    shape = {name: np.float32(value) for name, value in TALL.items()}
    block, pulse = (
        rk.blocks.FlexibleBlock(**shape, damping_ratio=0.01, masses=2, **law),
        rk.SinePulse(np.float32(0.5), 1.6),
    )

    def step(block, pulse, stop):
        scene = scene_of(block, pulse, stop)
        start = scene.start()
        return scene, start, scene.advance(start)

    scene, *states = jax.eval_shape(step, block, pulse, np.float32(4.0))
    kinds = [jax.tree.map(lambda x: x.dtype, state) for state in states]
    assert kinds[0] == kinds[1]
    assert not {x.dtype for x in jax.tree.leaves((scene, states))} & {np.dtype(np.float32), np.dtype(np.complex64)}


@pytest.mark.filterwarnings("ignore:jaxrock runs in single precision")
def test_single_precision_is_refused():
    """Which would be wrong in the third digit, and not say so."""
    with jax.enable_x64(False):
        block = rk.blocks.FlexibleBlock(**TALL, damping_ratio=0.01, masses=2, **WHOLE)
        with pytest.raises(ValueError, match="^Argument `block` must be linear in single precision"):
            rk.outcome(block, rk.SinePulse(0.5, 1.6))


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(base="cosine"), "`base` must be one of 'sine', 'linear', 'plastic'"),
        (dict(rotations="large"), "`rotations` must be one of 'small', 'finite'"),
        (dict(p_delta=True, youngs_modulus=0.35e9), "bear twice its own weight"),
    ],
)
def test_wrong_arguments(change, message):
    with pytest.raises(ValueError, match=message):
        rk.blocks.FlexibleBlock(**(TALL | dict(damping_ratio=0.01) | change))
