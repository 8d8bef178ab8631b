"""Flexible blocks: against an independent integration, known histories, the rigid limit, conservation of energy."""

import dataclasses
import functools
import operator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.blocks.cantilever import unit_column
from jaxrock.blocks.flexible import is_possible
from jaxrock.flexible.closeness import approached, still_to_come
from jaxrock.flexible.phases import Arc, Numbers, Phase, locked_phase, rocking_phase
from jaxrock.flexible.stepper import FlexibleScene
from references.flexible_column import FOR_LONG, PULSE, SHORT, TALL, beam, independent, largest_survived

# ---------------------------------------------------------------- the column


@pytest.mark.parametrize("masses", [2, 6, 20])
def test_the_unit_column_is_a_cantilever(masses):
    column = unit_column(masses)
    m, y, stiffness = beam(masses, 1.0, 1.0, 1.0)
    squares = np.linalg.eigvalsh(stiffness / np.sqrt(np.outer(m, m)))
    np.testing.assert_allclose(column.frequencies**2, squares, rtol=1e-7)
    np.testing.assert_allclose(column.shapes.T @ (m[:, None] * column.shapes), np.eye(masses - 1), atol=1e-11)
    # The block's own moment of inertia, and a little more.
    assert column.rotation @ column.rotation == pytest.approx((1 + 1 / (2 * (masses - 1) ** 2)) / 3, rel=1e-12)
    assert column.rotation @ column.tip == pytest.approx(1, rel=1e-12)


def test_first_period():
    """12.38 sqrt(density/modulus) h/tan(alpha); the column of masses is 2R long and tends to its own continuum."""
    block = rk.blocks.FlexibleBlock(**TALL, damping_ratio=0.0)
    assert block.first_period == pytest.approx(12.38 * np.sqrt(2500 / 30e9) * 25 / 0.1, rel=2e-4)
    lengthened = float(block.first_period) * (float(block.length) / 50) ** 1.5
    blocks = [rk.blocks.FlexibleBlock(**TALL, damping_ratio=0.0, masses=n) for n in (6, 11, 21)]
    errors = [2 * np.pi / np.asarray(each.frequencies)[0] / lengthened - 1 for each in blocks]
    assert errors[0] == pytest.approx(0.0185, abs=2e-3)
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1) and errors[1] / errors[2] == pytest.approx(4, rel=0.1)


numbers_of = eqx.filter_jit(Numbers.of)
phases = jax.jit(lambda numbers: (locked_phase(numbers), rocking_phase(numbers)))


@pytest.mark.parametrize("damping", ["stiffness", "modal", "rayleigh"])
def test_modes_span_the_motion_and_solve_the_equations(damping):
    """project undoes modes; each rocking mode satisfies the equations of column and base."""
    block = rk.blocks.FlexibleBlock(**TALL, damping_ratio=0.02, damping=damping)
    numbers = jax.device_get(numbers_of(block))
    locked, (rocking, whole) = jax.device_get(phases(numbers))
    n = numbers.rotation.size
    assert whole
    np.testing.assert_allclose(rocking.project @ rocking.modes, np.eye(2 * n + 1), atol=1e-11)
    real = np.abs(locked.project).sum(1) > 0  # not the one that only fills up
    np.testing.assert_allclose((locked.project @ locked.modes)[real][:, real], np.eye(2 * n), atol=1e-11)
    q, v, theta = np.split(np.asarray(rocking.modes), [n, 2 * n])
    rate, column = np.asarray(rocking.rates), np.asarray(numbers.rotation)[:, None]
    bend, bend_rate = q - column * theta, v - column * theta * rate
    stiff, damp = np.asarray(numbers.squares)[:, None], np.asarray(numbers.damping)[:, None]
    force = stiff * bend + damp * bend_rate
    size = np.abs(stiff).max() * np.abs(q).max() + np.abs(rate) ** 2 * np.abs(q).max()
    assert np.abs((rate * v + float(numbers.mass_damping) * v + force) / size).max() < 1e-13
    moment = (column * force).sum(0) + float(numbers.spring_rate) * theta[0]
    assert np.abs(moment / np.abs(column * stiff).sum()).max() < 1e-13


# ------------------------------------------------------------- histories


# peak rotation/alpha, displacement and bending of the top [m], impacts [s]; from the matrix equations of the column,
# phase by phase with their eigenvectors, in NumPy.
HISTORIES = {
    "tall, undamped": (TALL, dict(damping_ratio=0.0, restitution=1.0), (.685775033, 3.40355433, .115993410),
                       (2.33160572, 9.07118215, 15.66654802)),
    "tall": (TALL, dict(damping_ratio=0.0), (.646087561, 3.20725943, .0798637348),
             (2.33160572, 8.61887261, 14.68686782)),
    "short, rayleigh": (SHORT, dict(damping_ratio=0.01, damping="rayleigh"), (.370776344, 1.83154689, .0115913049),
                        (1.52765824, 4.32317654, 5.93067213, 7.09643430, 8.00636609, 8.74102191, 9.34960218)),
    "tall, ten masses": (TALL, dict(damping_ratio=0.01, masses=10), (.643104225, 3.21633476, .0712043527),
                         (2.33069047, 8.60484949, 14.23805287, 19.38760199)),
}  # fmt: skip


def test_undamped_columns_in_single_precision():
    """Rates of their modes, which rounding of a nearly singular matrix must not spoil, beside those in double."""

    def rates(damping):
        block = rk.blocks.FlexibleBlock(0.5, 3.0, 3e9, 2000.0, damping, masses=3)
        phase, whole = rocking_phase(Numbers.of(block))
        return phase.rates, whole

    expected, _ = jax.jit(rates)(0.0)
    with jax.enable_x64(False):
        found, whole = jax.jit(lambda damping: rates(damping))(np.float32(0.0))
    assert whole and found.dtype == np.complex64
    found, expected = np.sort_complex(found), np.sort_complex(expected)
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


def test_no_verdict_is_given_while_the_ground_shakes():
    """A base that is far beyond its balance; the ground, which still shakes, might bring it back."""
    block, motion = rk.blocks.FlexibleBlock(0.5, 3.0, 3e9, 2000.0, 0.02), rk.SinePulse(1.5, 3.0)
    for duration in (0.5, 0.8):
        found = rk.outcome(block, motion, duration=duration)
        assert found.status == rk.Status.undecided and found.margin < 0 and found.energy > 10
    found = rk.outcome(block, motion, duration=4.0)
    assert found.status == rk.Status.successful and found.overturned and found.margin < 0


def test_what_no_constructor_has_seen_has_a_status():
    """A step of an optimiser changes numbers of blocks and motions as they are."""
    block, motion = (
        rk.blocks.FlexibleBlock(0.5, 3.0, 3e9, 2000.0, 0.02),
        rk.SinePulse(1.5, 3.0),
    )  # as in the test before
    for name, value in (
        ("damping_ratio", -0.1), ("damping_ratio", 1.1), ("width", -0.5), ("density", -1.0), ("width", 4.5),
        ("youngs_modulus", 1e5), ("youngs_modulus", 1e21),
    ):  # fmt: skip
        changed = eqx.tree_at(operator.attrgetter(name), block, jnp.array(value, float))
        assert rk.outcome(changed, motion, duration=4.0).status == rk.Status.not_finite
    backwards = eqx.tree_at(lambda m: m.period, motion, jnp.array(-3.0, float))
    assert rk.outcome(block, backwards, duration=4.0).status == rk.Status.not_finite


def test_what_a_constructor_refuses_is_not_possible():
    """Check that `is_possible` refuses what constructors refuse: a column bent by its weight, a ratio above 1."""
    block = rk.blocks.FlexibleBlock(0.5, 3.0, 3e9, 2000.0, 0.02, masses=3, p_delta=True, restitution=0.9)
    possible = jax.jit(is_possible)
    assert possible(block)
    for name, value in (("youngs_modulus", 3e6), ("law.value", 1.1)):
        assert not possible(eqx.tree_at(operator.attrgetter(name), block, jnp.array(value, float)))


def test_the_verdict_of_a_base_that_has_little_energy_beyond_its_balance():
    """It falls if nothing moves the ground any more; whether something does is told by the duration, not by its sum."""
    block = rk.blocks.FlexibleBlock(0.5, 3.0, 3e9, 2000.0, 0.02, masses=2)
    motion = rk.SinePulse(0.01, 3.0)

    @jax.jit
    def found(stop, local):
        scene = FlexibleScene.of(block, motion, stop)
        beyond = {
            "side": jnp.asarray(1.0),
            "motion": 1.01 * scene.numbers.center,
            "local": local,
            "done": jnp.asarray(True),
        }
        return scene.conclude(dataclasses.replace(scene.start(), **beyond))

    end = motion.end
    shaking, ended, rounded = (found(*at) for at in ((end / 2, end / 2), (end, end), (end, end * (1 - 1e-15))))
    assert shaking.energy < 1 and not shaking.overturned and shaking.status == rk.Status.undecided
    for outcome in (ended, rounded):
        assert outcome.overturned and outcome.status == rk.Status.successful


@pytest.mark.parametrize(
    "case", [pytest.param(k, marks=pytest.mark.slow) if k != "tall, undamped" else k for k in HISTORIES]
)
def test_peaks_and_impacts(case):
    """Peaks of the source are those of 8001 samples: never above the true ones, and a little below them."""
    shape, more, peaks, impacts = HISTORIES[case]
    amplitude = 5.2974 / 9.81 if shape is SHORT else 0.5
    block = rk.blocks.FlexibleBlock(**shape, **more)
    response = rk.simulate(block, rk.SinePulse(amplitude, 1.6), duration=20.0, samples=2)
    assert response.status == rk.Status.successful
    found = response.outcome
    alpha = float(response.scene.block.alpha)
    for value, peak in zip((found.max_rotation / alpha, found.max_displacement, found.max_bending), peaks):
        assert -1e-8 < float(value) / peak - 1 < 2e-3
    np.testing.assert_allclose(response.impact_times[: len(impacts)], impacts, atol=2e-8)


@pytest.mark.slow
def test_against_an_independent_integration():
    """Histories to 1e-6 of the peak (the goal; 1e-8 here, the integrator's own), impacts to 1e-8 s."""
    block = rk.blocks.FlexibleBlock(**TALL, damping_ratio=0.01, masses=4)
    response = rk.responses.simulate_flexible(block, PULSE, duration=10.0)
    at, impacts = independent(block, PULSE, 10.0)
    times = np.linspace(0.01, 9.99, 300)
    theta, top = np.array([at(t) for t in times]).T
    rotation, displacement, _ = response(times)
    np.testing.assert_allclose(rotation, theta, atol=1e-7 * np.abs(theta).max())
    np.testing.assert_allclose(displacement, top, atol=1e-7 * np.abs(top).max())
    np.testing.assert_allclose(response.impact_times, impacts, atol=1e-7)


@pytest.mark.slow
def test_energy_is_conserved_between_impacts():
    """After the pulse, without damping: to 1e-10 of the whole between impacts; at an impact the kinetic part falls."""
    block = rk.blocks.FlexibleBlock(**TALL, damping_ratio=0.0)
    response = rk.responses.simulate_flexible(block, PULSE, duration=20.0, samples=2)
    edges = [1.6, *response.impact_times, 20.0]
    assert len(edges) == 5
    before = None
    for start, end in zip(edges, edges[1:]):
        times = np.linspace(start, end, 101)[:-1]
        kinetic, strain, base = map(np.asarray, response.energy(times))
        total = kinetic + strain + base
        np.testing.assert_allclose(total, total[0], rtol=1e-10)
        if before is not None:
            assert total[0] < before
        before = total[-1]


@pytest.mark.slow
def test_the_work_of_the_ground_is_the_gain_of_energy():
    """Under the pulse: energy = - integral of the ground's force times velocity, by Gauss's quadrature."""
    block = rk.blocks.FlexibleBlock(**TALL, damping_ratio=0.0)
    response = rk.responses.simulate_flexible(block, PULSE, duration=20.0, samples=2)
    nodes, weights = np.polynomial.legendre.leggauss(40)
    edges = np.linspace(0, 1.6, 9)
    numbers, scene = response.scene.numbers, response.scene
    total = 0.0
    unlock = float(response.trajectory.times[np.argmax(np.asarray(response.trajectory.nodes.side) != 0)])
    edges = np.unique(np.append(edges, unlock))
    for a, b in zip(edges, edges[1:]):
        times = (a + b) / 2 + (b - a) / 2 * nodes
        momentum = jax.vmap(lambda t: _momentum(response, t))(jnp.asarray(times))
        total -= (b - a) / 2 * np.sum(weights * np.asarray(PULSE.acceleration(times)) * np.asarray(momentum))
    gained = sum(float(part) for part in response.energy(1.6))
    scale = float(scene.block.density * scene.block.width * scene.block.height * scene.block.length**2)
    assert gained / scale == pytest.approx(total, rel=1e-10)
    assert numbers.load.shape == (5,)


def _momentum(response, t):
    """Sum of load times modal velocity, from the node before."""
    index = jnp.searchsorted(response.trajectory.times, t, side="right") - 1
    node = jax.tree.map(lambda x: x[index], response.trajectory.nodes)
    path, length, _, _ = response.scene.arc(node)
    state = path.state((t - response.trajectory.times[index]) / length)
    n = response.scene.numbers.rotation.size
    return jnp.sum(response.scene.numbers.load * state[n:-1])


def rigid_peak(block, amplitude, period):
    """Peak rotation by SciPy of the rigid block with the column's moment of inertia and the same spring."""
    solve = pytest.importorskip("scipy.integrate").solve_ivp
    alpha, length, restitution = float(block.alpha), float(block.length), float(block.restitution)
    strength, inertia = 9.81 * np.sin(alpha) / (2 * length), (1 + 1 / (2 * (block.masses - 1) ** 2)) / 3  # over m L^2
    push = amplitude * 9.81 * np.cos(alpha) / (2 * length)

    def rates(t, x, side):
        return [x[1], (-push * np.sin(2 * np.pi * t / period) * (t < period) - side * strength
                       + strength / alpha * x[0]) / inertia]  # fmt: skip

    def returns(t, x, side):
        return side * x[0] if t > start + 1e-6 else 1.0

    def turns(t, x, side):
        return x[1]

    returns.terminal, returns.direction = True, -1
    start = period / (2 * np.pi) * np.arcsin(strength / push)
    t, x, side, peak = start, [0.0, 0.0], -1.0, 0.0
    while t < 2 * period:
        path = solve(
            rates, (t, period if t < period else 2 * period), x, "DOP853", events=[returns, turns], args=(side,),
            rtol=1e-13, atol=1e-15, max_step=0.02,
        )  # fmt: skip
        peak = max(peak, np.abs(path.y[0]).max(), *(np.abs(y[0]) for y in path.y_events[1]))
        t, x = path.t[-1], path.y[:, -1]
        if path.status == 1:
            x, side = [0.0, restitution * x[1]], -side
    return peak


@pytest.mark.slow
@pytest.mark.parametrize("amplitude, duration", [(0.25, 1.1), (0.3, 1.6)])
def test_the_rigid_limit(amplitude, duration):
    """As the modulus grows the peak tends to the rigid block's, as 1/modulus.

    So do the column's bending under the motion and the time for which an impact locks the base. Without damping the
    factor varies with the modulus, because the column trembles when the base uplifts; at 0.25 g it may touch down
    again, which must not use up the impact. With damping the factor is a constant. The peak is within the duration.
    """
    moduli, pulse = np.array([1e11, 1e12, 1e13, 1e14, 1e15, 1e17]), rk.SinePulse(amplitude, 0.8)

    def errors(moduli, damping):
        blocks = [rk.blocks.FlexibleBlock(1.0, 5.0, E, 2500.0, damping) for E in moduli]
        rigid = rigid_peak(blocks[0], amplitude, 0.8)
        found = [rk.responses.outcome_flexible(b, pulse, duration=duration) for b in blocks]
        assert all(f.status == rk.Status.successful for f in found)
        return np.array([float(f.max_rotation) / rigid - 1 for f in found])

    trembling = errors(moduli[:4], 0.0)
    assert np.polyfit(np.log(moduli[:4]), np.log(np.abs(trembling)), 1)[0] == pytest.approx(-1, abs=0.1)
    calm = errors(moduli, 0.01)
    np.testing.assert_allclose(calm[3:] * moduli[3:], calm[-1] * moduli[-1], rtol=1e-2)
    assert np.abs(calm[-1]) < 1e-8


@pytest.mark.slow
def test_vibrations_do_not_hide_the_peak():
    """A million turns of the fastest mode within a step: the greatest rotation is found all the same."""
    block = rk.blocks.FlexibleBlock(1.0, 5.0, 1e16, 2500.0, 0.0)
    found = rk.responses.outcome_flexible(block, rk.SinePulse(0.3, 0.8), duration=1.6)
    assert float(found.max_rotation) == pytest.approx(rigid_peak(block, 0.3, 0.8), rel=1e-7)
    assert found.status == rk.Status.successful


# ---------------------------------------------------------------- the margin


@pytest.fixture(scope="module")
def by_amplitude():
    """Outcomes of nine columns of three masses by modulus [Pa], damping and amplitude of a pulse [g]; slope of the
    margin by the amplitude."""

    def margin(modulus, damping, amplitude):
        block = rk.blocks.FlexibleBlock(5.0, 50.0, modulus, 2500.0, damping, 3)
        found = rk.outcome(block, rk.SinePulse(amplitude, 1.6), duration=20.0)
        return found.margin, found

    def one(modulus, damping, amplitude):
        return jax.jvp(lambda a: margin(modulus, damping, a), (amplitude,), (1.0,), has_aux=True)

    compiled = jax.jit(jax.vmap(one, (None, None, 0)))
    return lambda amplitude, modulus=30e9, damping=0.01: compiled(modulus, damping, amplitude)


@functools.cache
def by_width(for_long=False):
    """Largest rotation, displacement and bending, and the margin, of columns by width [m]; and their slopes by it."""

    def results(width, amplitude, modulus, damping, duration):
        block = rk.blocks.FlexibleBlock(width, 5.0, modulus, 2400.0, damping, restitution=0.9)
        found = rk.outcome(block, rk.SinePulse(amplitude, 1.0), duration=duration)
        return jnp.stack([found.max_rotation, found.max_displacement, found.max_bending, found.margin])

    def one(width, *given):
        return jax.jvp(lambda width: results(width, *given), (width,), (1.0,))

    return jax.jit(jax.vmap(one), compiler_options=FOR_LONG if for_long else None)


@pytest.mark.parametrize("count", [16, pytest.param(200, marks=pytest.mark.slow)])
def test_slopes_of_largest_values_wherever_they_are(count):
    """At a top, at the kink of an impact, and where the history ends while they still grow, where they were wrong. That
    of the margin where the base stands still, too, where it was no number."""
    random = np.random.default_rng(1)
    given = (
        random.uniform(0.25, 0.6, count),
        10 ** random.uniform(8, 9.6, count),
        random.choice([0.005, 0.03, 0.1, 0.3, 0.9], count),
        random.choice([0.05, 0.4, 0.6, 0.9, 1.3], count),
    )
    at = by_width(count > 100)
    _, slopes = at(np.ones(count), *given)
    near, nearer = (
        (at(np.full(count, 1 + step), *given)[0] - at(np.full(count, 1 - step), *given)[0]) / (2 * step)
        for step in (1e-5, 1e-6)
    )
    smooth = np.isclose(near, nearer, rtol=1e-4, atol=1e-7)  # else there is a tie between, or the column is lost
    assert smooth.mean() > 0.8
    np.testing.assert_allclose(np.asarray(slopes)[smooth], np.asarray(nearer)[smooth], rtol=2e-4, atol=2e-7)


nearest_of_swing = jax.jit(still_to_come)


@pytest.mark.parametrize("amplitudes", [(-0.3, -0.01), (-0.01, -0.3), (0.01, -0.3), (0.3, -0.01), (0.0, -0.1)])
def test_the_nearest_of_a_free_swing(amplitudes):
    """From amplitudes of the growing and the decaying mode on, against a table of the distance."""
    grows, decays, time = 0.8, 0.9, np.linspace(0, 12, 200_001)
    outward, inward = amplitudes[0] * np.exp(grows * time), amplitudes[1] * np.exp(-decays * time)
    found = nearest_of_swing(*amplitudes, grows, decays)
    np.testing.assert_allclose(found, np.min(2 * (outward**2 + inward**2)), rtol=1e-8, atol=1e-10)


def test_second_derivatives_of_the_nearest():
    """Where it is nearest moves: beside the closed form 4 |outward inward|, within a step, too."""
    rates, rows, one = jnp.array([1.0 + 0j, -1.0]), jnp.zeros((4, 2)) + 0j, jnp.asarray(1.0)

    def within_a_step(z):
        phase = Phase(rates, rows, rows.T, rates, rows)
        path = Arc(phase, rows[:, 0].real, rows[:, 0].real, z + 0j, 2 * rates, rows[:1], rows[0].real)
        return approached(path, one, one, one, (10 * one, 10 * one))[0]

    ahead = lambda z: still_to_come(z[0], z[1], one, one)
    for nearest in (ahead, within_a_step):
        value, bend = jax.jit(lambda z, f=nearest: (f(z), jax.hessian(f)(z)))(jnp.array([0.1, -0.3]))
        assert float(value) == pytest.approx(0.12, rel=1e-9)
        np.testing.assert_allclose(bend, [[0.0, -4.0], [-4.0, 0.0]], atol=1e-8)


@pytest.mark.slow
def test_the_margin_of_a_rigid_column(by_amplitude):
    """(1 - peak/balance)^2, where nothing vibrates; 1 where nothing turns, negative where it overturns."""
    margin, _, found = by_amplitude(np.array([0.08, 0.3, 0.4, 0.5, 0.6, 0.65, 0.8, 0.9, 1.0]), 30e12, 0.0)
    peak, lost = found.max_rotation / np.arctan(0.1), np.asarray(found.overturned)
    assert peak[0] == 0 and margin[0] == 1
    np.testing.assert_array_equal(lost, np.arange(9) > 5)
    np.testing.assert_allclose(margin[~lost], (1 - peak[~lost]) ** 2, rtol=1e-3)
    assert (margin[lost] < 0).all() and (found.energy[~lost] < 1).all()


@pytest.mark.slow
def test_the_margin_is_zero_where_a_column_balances(by_amplitude):
    """It passes through zero with a slope, which is its derivative; on either side of every verdict that changes."""
    low = largest_survived(lambda amplitudes: by_amplitude(amplitudes)[2].overturned, 0.7, 0.8)
    away = np.array([-1e-3, -1e-4, -1e-5, -1e-6, 1e-6, 1e-5, 1e-4, 1e-3, 0.02])
    margin, slope, found = by_amplitude(low * (1 + away))
    np.testing.assert_array_equal(margin < 0, found.overturned)
    near = np.abs(away) < 2e-4
    np.testing.assert_allclose((margin / (low * away))[near], slope[near], rtol=2e-3)
    np.testing.assert_allclose(slope[near], slope[3], rtol=5e-3)


# ------------------------------------------------------- many, and derivatives


@pytest.mark.slow
def test_derivatives_and_finite_differences():
    """Compare forward-mode derivatives by modulus, density, damping and size with central differences of the values."""

    def peaks(x):
        block = rk.blocks.FlexibleBlock(x[3], x[4], 1e9 * x[0], 1e3 * x[1], x[2])
        found = rk.responses.outcome_flexible(block, PULSE, duration=12.0)
        return jnp.stack([found.max_rotation, found.max_displacement, found.max_bending])

    x = jnp.array([30.0, 2.5, 0.01, 5.0, 50.0])
    steps = 1e-5 * jnp.diag(x)
    values = jax.jit(jax.vmap(peaks))(jnp.concatenate([x + steps, x - steps]))
    slopes = (values[:5] - values[5:]) / (2e-5 * x[:, None])
    jacobian = jax.jit(jax.jacfwd(peaks))(x)
    np.testing.assert_allclose(jacobian.T, slopes, rtol=2e-6, atol=1e-6 * float(jnp.abs(slopes).max()))


@pytest.mark.slow
def test_derivatives_and_an_independent_integration():
    """Compare derivatives with differences of SciPy's peaks, after an impact; compiled and uncompiled values agree."""
    optimize = pytest.importorskip("scipy.optimize")

    def block(x):
        return rk.blocks.FlexibleBlock(x[3], x[4], 1e9 * x[0], 1e3 * x[1], x[2], masses=3)

    def peak(x):
        return rk.outcome(block(x), PULSE, duration=7.0).max_rotation

    def judged(x):
        at, _ = independent(block(x), PULSE, 7.0)
        times = np.linspace(2.5, 7.0, 451)[:-1]
        top = times[np.argmax([abs(at(t)[0]) for t in times])]
        return -optimize.minimize_scalar(lambda t: -abs(at(t)[0]), bounds=(top - 0.01, top + 0.01)).fun

    x = jnp.array([30.0, 2.5, 0.02, 5.0, 50.0])
    value, jitted = peak(x), jax.jit(jax.value_and_grad(peak))(x)
    assert float(value) == pytest.approx(float(jitted[0]), rel=1e-13)
    assert float(value) == pytest.approx(judged(x), rel=1e-7)
    steps = 1e-4 * np.diag(x)
    slopes = np.array([(judged(x + d) - judged(x - d)) / 2e-4 for d in steps])  # times the parameter
    np.testing.assert_allclose(jitted[1] * x, slopes, rtol=1e-3, atol=1e-4 * np.abs(slopes).max())


def test_neighbours_answer_alike():
    """Rounding decides whether a step ends with its piece, or a piece of no length is left: the motion is the same.

    Of these one in sixty had a peak that was 3e-8 of it too large, where such a piece was taken for one of a second.
    """
    block, near = rk.blocks.FlexibleBlock(0.6, 3.0, 30e9, 2500.0, 0.02), np.linspace(-5e-14, 5e-14, 121)
    # One by one: compiled above; until after its peak.
    found = [rk.outcome(block, rk.SinePulse(0.266 * (1 + x), 0.8), duration=1.6) for x in near]
    peaks, energies = np.array([(float(each.max_rotation), float(each.energy)) for each in found]).T
    assert np.ptp(peaks) < 1e-12 * peaks[0]
    assert np.ptp(energies) < 1e-10 and all(each.status == rk.Status.successful for each in found)


@pytest.mark.slow
def test_hundreds_of_blocks_at_once():
    """One call, with the answers of single calls; reverse mode agrees with forward mode."""
    moduli = jnp.linspace(10e9, 60e9, 200)

    def peak(E):
        return rk.responses.outcome_flexible(
            rk.blocks.FlexibleBlock(5.0, 50.0, E, 2500.0, 0.01), PULSE, duration=12.0
        )  # fmt: skip

    found = jax.jit(jax.vmap(peak))(moduli)
    assert (found.status == rk.Status.successful).all()
    for i in (0, 100, 199):
        assert found.max_rotation[i] == pytest.approx(float(peak(moduli[i]).max_rotation), rel=1e-12)
    forward = jax.jacfwd(lambda E: peak(E).max_rotation)(30e9)
    assert jax.grad(lambda E: peak(E).max_rotation)(30e9) == pytest.approx(float(forward), rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("damping", [0.0, 0.01, 0.05])
def test_stiff_columns(damping):
    """300 GPa, 5 m, 20 masses: the fastest mode turns 1e5 times a second, and steps do not notice it.

    The peak is within 0.3 % of a rigid block's on the same spring, and ten times nearer with ten times the modulus.
    With damping in proportion to stiffness the rates of many modes come close to one number; what rounding does there
    must not make the base chatter.
    """
    block = rk.blocks.FlexibleBlock(0.5, 5.0, 300e9, 2500.0, damping, 20)
    response = rk.responses.simulate_flexible(block, rk.SinePulse(0.15, 0.8), duration=1.6, samples=2)
    assert float(block.frequencies[-1]) > 1e5
    assert response.status == rk.Status.successful
    assert int(response.trajectory.nodes.steps.max()) < 200
    stiffer = rk.blocks.FlexibleBlock(0.5, 5.0, 3000e9, 2500.0, damping, 20)
    rigid = rigid_peak(block, 0.15, 0.8)
    off = float(response.max_rotation) / rigid - 1
    assert off == pytest.approx(0, abs=3e-3)
    peak = rk.responses.outcome_flexible(stiffer, rk.SinePulse(0.15, 0.8), duration=1.6).max_rotation
    assert float(peak) / rigid - 1 == pytest.approx(off / 10, rel=0.25)


# ----------------------------------------------------------------- arguments


@pytest.mark.slow
def test_small_budgets_have_a_status():
    found = rk.responses.outcome_flexible(
        rk.blocks.FlexibleBlock(**TALL, damping_ratio=0.0), PULSE, duration=12.0, max_steps=1
    )
    assert found.status == rk.Status.step_budget_exhausted


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(width=-1.0), "`width` must be positive"),
        (dict(masses=1), "`masses` must be a whole number from 2 to 60, but is 1"),
        (dict(masses=2, damping="rayleigh"), "from 3 to 60"),
        (dict(damping_ratio=1.0), r"`damping_ratio` must be in \[0, 1\), but is 1.0"),
        (dict(damping="viscous"), "`damping` must be one of"),
        (dict(youngs_modulus=1e5), "stiffer than its base"),
        (dict(youngs_modulus=1e21), "at most 1e12 times as stiff"),
        (dict(width=80.0), "at most 1.41 times the height"),
        (dict(width=80.0, restitution=rk.restitution.Housner()), "at most 1.41 times the height"),
        (dict(width=60.0, restitution=rk.restitution.Housner(1.0)), "`width` must be so small that Housner's"),
    ],
)
def test_wrong_arguments(change, message):
    with pytest.raises(ValueError, match=message):
        rk.blocks.FlexibleBlock(**(TALL | dict(damping_ratio=0.01) | change))


def test_wrong_durations():
    block = rk.blocks.FlexibleBlock(**TALL, damping_ratio=0.01)
    with pytest.raises(ValueError, match="`duration` must be positive"):
        rk.responses.simulate_flexible(block, PULSE, duration=0.0)
    with pytest.raises(ValueError, match="`samples` must be a whole number from 2"):
        rk.responses.simulate_flexible(block, PULSE, samples=1)


def test_vertical_motions_raise():
    with pytest.raises(ValueError, match="`motion` must not be vertical for a FlexibleBlock"):
        rk.outcome(rk.blocks.FlexibleBlock(**TALL, damping_ratio=0.01), PULSE.with_vertical(PULSE))


@pytest.mark.slow
def test_second_derivatives():
    """Where the greatest rotation is reached moves with the amplitude: differences of values and of slopes."""
    block = rk.blocks.FlexibleBlock(0.6, 3.0, 30e9, 2500.0, 0.02)

    def peak(amplitude):
        return rk.outcome(block, rk.SinePulse(amplitude, 0.8)).max_rotation

    value, slope, bent = (jax.jit(f) for f in (peak, jax.grad(peak), jax.hessian(peak)))
    at, step = 0.266, 1e-3
    assert float(bent(at)) == pytest.approx(float(slope(at + 1e-5) - slope(at - 1e-5)) / 2e-5, rel=1e-6)
    twice = (float(value(at + step)) - 2 * float(value(at)) + float(value(at - step))) / step**2
    assert float(bent(at)) == pytest.approx(twice, rel=5e-3)


def test_an_undamped_column_moves_with_its_damping():
    """As damped ones do, where less damping is computed with the least there is, too."""

    @jax.jit
    def slope(ratio):
        block = lambda ratio: rk.blocks.FlexibleBlock(0.5, 3.0, 3e9, 2000.0, ratio, masses=3)
        return jax.jvp(lambda ratio: Numbers.of(block(ratio)).damping, (ratio,), (jnp.ones(()),))[1]

    for ratio in (0.0, 1e-14, 1e-11):  # none, less than the least, less than is felt
        np.testing.assert_allclose(slope(ratio), slope(0.01), rtol=1e-12)


@pytest.mark.slow
def test_an_undamped_block_moves_with_its_damping():
    """Its peak, as that of one with very little damping, which is differentiated as it is."""

    def peak(ratio):
        block = rk.blocks.FlexibleBlock(5.0, 50.0, 30e9, 2500.0, ratio, masses=3)
        return rk.outcome(block, rk.SinePulse(0.5, 1.6), duration=8.0).max_rotation

    slope = jax.jit(jax.grad(peak))
    for ratio in (0.0, 1e-14, 1e-11):
        assert float(slope(ratio)) == pytest.approx(float(slope(2e-8)), rel=1e-4)
    assert float(slope(0.0)) == pytest.approx(float(peak(1e-5) - peak(0.0)) / 1e-5, rel=1e-2)


def _end(ratio):
    block = rk.blocks.FlexibleBlock(5.0, 50.0, 30e9, 2500.0, ratio, masses=3)
    return rk.simulate(block, rk.SinePulse(0.5, 1.6), duration=4.0, samples=2).rotation[-1]


def test_histories_have_a_reverse_mode():
    assert jax.eval_shape(jax.grad(_end), 0.05).shape == ()


@pytest.mark.slow
def test_slopes_of_histories_in_both_modes():
    """By the damping, and differences."""
    value = jax.jit(_end)
    forward, reverse = (float(jax.jit(mode(_end))(0.05)) for mode in (jax.jacfwd, jax.grad))
    assert reverse == pytest.approx(forward, rel=1e-12)
    assert forward == pytest.approx(float(value(0.05 + 1e-6) - value(0.05 - 1e-6)) / 2e-6, rel=1e-6)


def test_compiled_by_the_user():
    """`outcome` and `simulate` know a flexible block within `jax.jit`, too."""
    shape, more, _, _ = HISTORIES["tall, undamped"]
    scene = lambda width: (rk.blocks.FlexibleBlock(**shape | dict(width=width), **more), rk.SinePulse(0.5, 1.6))

    @jax.jit
    def found(width):
        response = rk.simulate(*scene(width), duration=20.0, samples=2)
        return rk.outcome(*scene(width), duration=20.0).max_rotation, response.max_rotation, response.rotation

    expected = rk.simulate(*scene(5.0), duration=20.0, samples=2)
    peaks = expected.max_rotation, expected.max_rotation
    for value, known in zip(found(5.0), (*peaks, expected.rotation), strict=True):
        np.testing.assert_allclose(value, known, rtol=1e-12)
    assert abs(float(expected.rotation[-1])) > 1e-3
