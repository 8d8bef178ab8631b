"""The stroboscopic map, bifurcations, basins and the rest of a motion, beside closed forms, SciPy and histories."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxrock as rk
from jaxrock.studies.settled_states import orbits_of

ALPHA, P = 0.2, 2.0
THRESHOLD = math.tan(ALPHA)
BLOCK = rk.Block(ALPHA, P, 0.85)
SOFT = rk.Block(ALPHA, P, 0.5)


def harmonic(strength, ratio, phase=0.0, cycles=1):
    """Harmonic motion of an amplitude over the threshold and a frequency over p."""
    return rk.HarmonicMotion(strength * THRESHOLD, 2 * math.pi / (ratio * P), cycles, phase)


# ------------------------------------------------------------------------------------------ the rest of a motion

MOTIONS = {
    "harmonic": rk.HarmonicMotion(0.32, 0.7, 12, 0.2),
    "a sum": 1.5 * rk.SinePulse(0.3, 0.6) + rk.RickerPulse(0.3, 0.5).shifted(0.7),
    "a sum of many": sum(rk.SinePulse(0.25, 0.5 + 0.02 * k).shifted(0.4 * k) for k in range(7)),
    "with a vertical part": rk.HarmonicMotion(0.3, 0.7, 12).with_vertical(rk.HarmonicMotion(0.1, 0.3, 20)),
    "a record": 1.2 * rk.Record(np.sin(np.arange(0, 6, 0.02) * 7) * 0.28, 0.02),
}


@pytest.mark.parametrize("name", MOTIONS)
@pytest.mark.parametrize("start", [0.0, 0.76, 1.13])
def test_the_rest_of_a_motion_continues_a_response(name, start):
    motion, end = MOTIONS[name], 3.4
    whole = rk.simulate(BLOCK, motion, duration=end)
    rest = rk.simulate(BLOCK, motion.from_time(start), initial=whole(start), duration=end - start)
    later = np.linspace(0.0, end - start, 60)
    for found, expected in zip(rest(later), whole(start + later)):
        np.testing.assert_allclose(found, expected, atol=1e-13)
    assert rest.impact_count > 1


@pytest.mark.parametrize("name", MOTIONS)
def test_the_rest_of_a_motion_is_the_motion(name):
    motion = MOTIONS[name]
    later = np.linspace(0.0, 2.0, 77)
    np.testing.assert_allclose(motion.from_time(0.5).acceleration(later), motion.acceleration(0.5 + later), atol=1e-13)
    np.testing.assert_allclose(motion.from_time(0.5).end, motion.end - 0.5, rtol=1e-14)
    twice = motion.from_time(0.2).from_time(0.3)
    np.testing.assert_allclose(twice.acceleration(later), motion.acceleration(0.5 + later), atol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["harmonic", "a record"])
def test_derivative_by_the_time_from_which_a_response_continues(name):
    """The state later does not depend on where the response was cut: two derivatives cancel."""
    motion = MOTIONS[name]
    whole = rk.simulate(BLOCK, motion, duration=2.5)

    def later(time):
        return jnp.stack(
            rk.simulate(BLOCK, motion.from_time(time), initial=whole(time), duration=2.5 - time)(2.5 - time)
        )

    np.testing.assert_allclose(jax.jacfwd(later)(1.13), 0.0, atol=1e-9)

    def by_cut(time):  # of the motion alone, from a state that stays: beside differences
        return jnp.stack(rk.simulate(BLOCK, motion.from_time(time), initial=(0.02, 0.1), duration=1.0)(1.0))

    step = 1e-6
    expected = (by_cut(1.13 + step) - by_cut(1.13 - step)) / (2 * step)
    np.testing.assert_allclose(jax.jacfwd(by_cut)(1.13), expected, rtol=1e-6, atol=1e-7)
    assert np.abs(expected).max() > 1e-3


def test_after_its_end_no_motion_is_left():
    motion = rk.SinePulse(0.5, 1.0).from_time(1.5)
    assert motion.end == 0
    alone, free = (rk.outcome(BLOCK, each, initial=(0.05, 0.2)) for each in (motion, rk.SinePulse(1e-12, 1.0)))
    assert alone.status == rk.Status.successful
    np.testing.assert_allclose(alone.max_rotation, free.max_rotation, rtol=1e-8)


# ------------------------------------------------------------------------------------------ the map


def by_scipy(block, strength, ratio, phase, state, end):
    """Housner's block from impact to impact; it must not come to rest."""
    amplitude, rate = strength * THRESHOLD, ratio * P
    side, time, state = float(np.sign(state[0] or state[1])), 0.0, list(state)

    def landing(t, y):
        return side * y[0]

    landing.terminal, landing.direction = True, -1
    while time < end:

        def flow(t, y, side=side):
            angle, ground = side * ALPHA - y[0], amplitude * math.sin(rate * t + phase)
            return [y[1], -(P**2) * (math.sin(angle) + ground * math.cos(angle))]

        found = solve_ivp(flow, (time, end), state, "DOP853", events=landing, rtol=1e-12, atol=1e-14)
        time, state = found.t[-1], list(found.y[:, -1])
        if found.status == 1:
            state, side = [0.0, float(block.restitution) * state[1]], -side
            assert abs(state[1]) > 1e-3
    return state


@pytest.mark.parametrize("periods", [1, 2, 5])
@pytest.mark.parametrize("start", [(0.05, 0.2), (-0.03, 0.4)])
def test_the_map_by_scipy(periods, start):
    found = rk.studies.stroboscopic_map(BLOCK, harmonic(1.6, 4.0, 0.3), start, periods=periods)
    expected = by_scipy(BLOCK, 1.6, 4.0, 0.3, start, periods * 2 * math.pi / (4.0 * P))
    np.testing.assert_allclose(found.state, expected, atol=1e-9)
    assert found.known_periods == periods and found.impact_count > 0


def test_periods_continue_a_history():
    one, many = (rk.HarmonicMotion(0.32, 0.7, cycles, 0.2) for cycles in (1, 12))
    history = rk.simulate(BLOCK, many)
    for periods in (1, 4, 12):
        found = rk.studies.stroboscopic_map(BLOCK, one, periods=periods)
        np.testing.assert_allclose(found.state, history(0.7 * periods), atol=1e-11)


def test_engines_agree():
    motion, start = harmonic(1.6, 4.0, 0.3), (0.05, 0.2)
    found = [
        rk.studies.stroboscopic_map(BLOCK, motion, start, periods=2, engine=engine)
        for engine in (rk.Series(), rk.Diffrax(rtol=1e-11, atol=1e-13))
    ]
    np.testing.assert_allclose(found[0].state, found[1].state, atol=1e-8)


def test_derivatives_go_through_impacts():
    """By the state at the start, and by the numbers of the motion: forward, reverse and differences."""

    def mapped(numbers):
        rotation, velocity, amplitude, period = numbers
        motion = rk.HarmonicMotion(amplitude, period, 1, 0.2)
        return rk.studies.stroboscopic_map(BLOCK, motion, (rotation, velocity), periods=3).state

    numbers, step = jnp.array([0.01, 0.1, 0.32, 0.7]), 1e-6
    forward, reverse = (by(mapped)(numbers) for by in (jax.jacfwd, jax.jacrev))
    expected = [(mapped(numbers + e) - mapped(numbers - e)) / (2 * step) for e in step * np.eye(4)]
    np.testing.assert_allclose(forward, np.transpose(expected), rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-12)


def test_an_impact_shrinks_areas_by_the_square_of_restitution():
    """Liouville: the flow keeps areas of (rotation, velocity); an impact multiplies them by e^2."""
    for periods in (1, 2, 4):
        motion = harmonic(1.6, 4.0, 0.3)

        def mapped(state, periods=periods, motion=motion):
            return rk.studies.stroboscopic_map(BLOCK, motion, state, periods=periods).state

        start = jnp.array([0.05, 0.2])
        impacts = rk.studies.stroboscopic_map(BLOCK, motion, start, periods=periods).impact_count
        assert impacts > 0
        area = jnp.linalg.det(jax.jacfwd(mapped)(start))
        np.testing.assert_allclose(area, 0.85 ** (2 * impacts), rtol=1e-9)


def test_mirrored_starts_under_mirrored_motions():
    found, mirrored = (
        rk.studies.stroboscopic_map(BLOCK, harmonic(way * 1.6, 4.0, 0.3), (way * 0.05, way * 0.2), periods=6)
        for way in (1, -1)
    )
    np.testing.assert_allclose(mirrored.state, -found.state, rtol=1e-12)


def test_many_starts_and_amplitudes_at_once():
    starts, amplitudes = jnp.array([[0.01, 0.1], [-0.05, 0.3], [0.0, 0.0]]), jnp.array([0.25, 0.3, 0.35])

    def mapped(start, amplitude):
        return rk.studies.stroboscopic_map(BLOCK, rk.HarmonicMotion(amplitude, 0.7, 1), start, periods=7)

    many = jax.jit(jax.vmap(mapped))(starts, amplitudes)
    for k in range(3):
        np.testing.assert_allclose(many.state[k], mapped(starts[k], amplitudes[k]).state, atol=1e-12)


# ------------------------------------------------------------------------------------------ Hogan's orbit


def hogan(strength, ratio, restitution):
    """Symmetric (1, 1) orbits of the linear block: phases at an impact, velocities after it, and multipliers.

    Side s: x'' = p^2 (x - s alpha - u), so x = s alpha + a cosh + b sinh + B sin(w t + phase) from the impact on. It
    lands half a period later, and rebounds with the mirrored velocity.
    """
    w, half = ratio * P, math.pi / ratio  # the half period in p t
    forced = strength * ALPHA / (1 + ratio**2)
    c, s, e = math.cosh(half), math.sinh(half), restitution
    # a = -alpha - B sin, b = [(c - 1) alpha + (c + 1) B sin]/s; p (a s + b (c + 1/e)) = B w cos (1 - 1/e)
    constant = P * ALPHA * (-s + (c + 1 / e) * (c - 1) / s)
    of_sine = P * forced * (-s + (c + 1 / e) * (c + 1) / s)
    of_cosine = -forced * w * (1 - 1 / e)
    middle, size = math.atan2(of_cosine, of_sine), math.hypot(of_sine, of_cosine)
    for phase in (math.asin(-constant / size) - middle, math.pi - math.asin(-constant / size) - middle):
        a = -ALPHA - forced * math.sin(phase)
        b = ((c - 1) * ALPHA + (c + 1) * forced * math.sin(phase)) / s
        times = np.linspace(0, half, 401)
        arc = ALPHA + a * np.cosh(times) + b * np.sinh(times) + forced * np.sin(ratio * times + phase)
        if (arc[1:-1] <= 0).any():
            continue
        velocity = P * b + forced * w * math.cos(phase)
        flow = np.array([[c, s / P], [P * s, c]])
        before, ground = -velocity / e, -strength * ALPHA * math.sin(phase)  # where it lands, half a period later
        push = [P**2 * (-side * ALPHA - ground) for side in (1, -1)]
        impact = np.array([[e, 0], [(push[1] - e * push[0]) / before, e]])
        turn = -impact @ flow
        top = arc.max()
        yield phase, velocity, turn @ turn, top


@pytest.mark.parametrize("strength, ratio, e", [(2.0, 4.0, 0.85), (3.0, 6.0, 0.7), (5.0, 8.0, 0.925)])
def test_the_orbit_of_hogan(strength, ratio, e):
    """Hogan (1989): symmetric orbits of one impact in half a period, with the multipliers of their period."""
    block, found = rk.Block(ALPHA, P, e), list(hogan(strength, ratio, e))
    assert found
    for phase, velocity, turn, top in found:
        # A quarter of a period after the impact nothing happens, so the map is smooth there.
        quarter, forced = math.pi / (2 * ratio), strength * ALPHA / (1 + ratio**2)
        a, b = -ALPHA - forced * math.sin(phase), (velocity - forced * ratio * P * math.cos(phase)) / P
        c, s, swing = math.cosh(quarter), math.sinh(quarter), phase + math.pi / 2
        start = jnp.array(
            [
                ALPHA + a * c + b * s + forced * math.sin(swing),
                P * (a * s + b * c) + forced * ratio * P * math.cos(swing),
            ]
        )
        motion = rk.HarmonicMotion(strength * ALPHA, 2 * math.pi / (ratio * P), 1, swing)

        def mapped(state, block=block, motion=motion):
            return rk.studies.stroboscopic_map(block, motion, state, rk.Linear()).state

        np.testing.assert_allclose(mapped(start), start, atol=1e-12)
        jacobian = jax.jacfwd(mapped)(start)
        assert top < np.pi / 2
        np.testing.assert_allclose(np.trace(jacobian), np.trace(turn), rtol=1e-9)
        np.testing.assert_allclose(np.linalg.det(jacobian), e**4, rtol=1e-9)


# ------------------------------------------------------------------------------------------ overturned and at rest


def test_a_block_that_overturns_is_told():
    found = rk.studies.stroboscopic_map(BLOCK, harmonic(6.0, 1.0), periods=5)
    assert found.overturned and found.status == rk.Status.successful
    assert jnp.isinf(found.state).all() and jnp.sign(found.rotation) == jnp.sign(found.velocity)
    gentle = rk.studies.stroboscopic_map(BLOCK, harmonic(0.9, 1.0), periods=5)
    assert (gentle.state == 0).all() and gentle.impact_count == 0 and not gentle.overturned


def test_a_later_period_may_bring_a_block_back():
    """The quiet at the end of a period is not the end of the shaking."""
    pulse = rk.RectangularPulse(-0.9, 0.15) + rk.RectangularPulse(0.9, 0.15).shifted(0.15)
    once = pulse + rk.RectangularPulse(1e-9, 0.1).shifted(0.9)  # 0.7 s of quiet before it ends
    history = jax.jit(
        lambda rotation: rk.simulate(BLOCK, once + once.shifted(1.0), initial=(rotation, 0.0), duration=2.0)(
            jnp.array([1.0, 2.0])
        )
    )
    saved = 0
    for rotation in np.linspace(-0.29, -0.26, 7):
        found = rk.studies.stroboscopic_map(BLOCK, once, (rotation, 0.0), periods=2)
        (middle, end), (_, speed) = history(rotation)
        if abs(end) < ALPHA:
            np.testing.assert_allclose(found.state, [end, speed], atol=1e-9)
            saved += bool(abs(middle) > ALPHA)
    assert saved


def test_chaos_is_told_by_known_periods():
    start = (-0.1036, 0.5595)  # on the chaotic attractor
    found = rk.studies.stroboscopic_map(SOFT, harmonic(2.5, 2.0), start, periods=400)
    assert found.status == rk.Status.successful and not found.overturned
    assert 10 < found.known_periods < 400
    calm = rk.studies.stroboscopic_map(SOFT, harmonic(1.5, 2.0), (-0.05, 0.3), periods=400)
    assert calm.known_periods == 400


@pytest.mark.parametrize(
    "wrong, said",
    [({"periods": 0}, "periods"), ({"state": (2.0, 0.0)}, "rotation in"), ({"state": (0.0,)}, "state")],
)
def test_wrong_arguments_are_refused(wrong, said):
    with pytest.raises(ValueError, match=said):
        rk.studies.stroboscopic_map(BLOCK, harmonic(1.5, 2.0), **wrong)


def test_an_asymmetric_block():
    block = rk.blocks.AsymmetricBlock(0.2, 0.25, 2.0)
    one, four = (rk.HarmonicMotion(0.4, 0.7, cycles) for cycles in (1, 4))
    found = rk.studies.stroboscopic_map(block, one, (0.02, 0.1), periods=4)
    np.testing.assert_allclose(found.state, rk.simulate(block, four, initial=(0.02, 0.1))(2.8), atol=1e-11)


@pytest.mark.parametrize("model", [rk.Linear(), rk.Housner()])
def test_a_record_that_repeats(model):
    time = np.arange(0, 0.8, 0.01)
    record = rk.Record(0.32 * np.sin(2 * np.pi * time / 0.79), 0.01)
    twice = record + record.shifted(0.79)
    found = rk.studies.stroboscopic_map(BLOCK, record, (0.02, 0.1), model, periods=2)
    expected = rk.simulate(BLOCK, twice, model, initial=(0.02, 0.1), duration=1.58)(1.58)
    np.testing.assert_allclose(found.state, expected, atol=1e-10)


def test_a_state_that_is_not_finite_is_told():
    found = rk.studies.stroboscopic_map(BLOCK, harmonic(1.5, 2.0), (math.nan, 0.0), throw=False)
    assert found.status == rk.Status.not_finite and jnp.isnan(found.state).all()
    short = rk.studies.stroboscopic_map(BLOCK, harmonic(1.5, 2.0), (0.02, 0.1), engine=rk.Series(max_steps=2))
    assert short.status == rk.Status.step_budget_exhausted and jnp.isnan(short.state).all()


# ------------------------------------------------------------------------------------------ bifurcations and basins


def test_a_bifurcation_by_the_map():
    values = np.array([1.5, 2.2, 2.42])
    found = rk.studies.bifurcation(
        SOFT, lambda strength: harmonic(strength, 2.0), values, (-0.05, 0.3), transient=50, periods=12, progress=False
    )
    for k, value in enumerate(values):
        for turn in (0, 7):
            expected = rk.studies.stroboscopic_map(SOFT, harmonic(value, 2.0), (-0.05, 0.3), periods=50 + turn)
            np.testing.assert_allclose(found.rotation[k, turn], expected.rotation, atol=1e-9)
            np.testing.assert_allclose(found.velocity[k, turn], expected.velocity, atol=1e-9)


def test_periods_double_before_the_block_is_lost():
    values = np.array([2.1, 2.2, 2.3, 2.35, 2.4, 2.455, 2.5, 2.6, 2.7])
    found = rk.studies.bifurcation(SOFT, lambda strength: harmonic(strength, 2.0), values, (-0.05, 0.3), follow=True)
    assert found.period.tolist() == [1, 1, 1, 1, 2, 4, 0, 0, 0]
    assert found.overturned.tolist() == [False] * 7 + [True] * 2
    assert jnp.isinf(found.rotation[-1]).all() and jnp.isfinite(found.rotation[:7]).all()


def test_a_multiplier_leaves_through_minus_one_where_the_period_doubles():
    def mapped(state, strength):
        return rk.studies.stroboscopic_map(SOFT, harmonic(strength, 2.0), state).state

    state, least = rk.studies.stroboscopic_map(SOFT, harmonic(2.1, 2.0), (-0.05, 0.3), periods=200).state, []
    for strength in (2.1, 2.3, 2.42):
        for _ in range(20):  # Newton
            slope = jax.jacfwd(mapped)(state, strength)
            state = state - jnp.linalg.solve(slope - jnp.eye(2), mapped(state, strength) - state)
        np.testing.assert_allclose(mapped(state, strength), state, atol=1e-12)
        least.append(np.linalg.eigvals(slope).real.min())
        np.testing.assert_allclose(np.linalg.det(slope), 0.5**4, rtol=1e-8)
    assert least[0] > -1 and least[1] > -1 > least[2]


def test_basins_of_two_orbits():
    motion = rk.HarmonicMotion(0.32, 0.7, 1)
    found = rk.studies.basins(
        BLOCK, motion, np.linspace(-0.25, 0.25, 41), np.linspace(-0.6, 0.6, 31), periods=120, progress=False
    )
    assert [orbit.shape[0] for orbit in found.orbits] == [1, 3]
    for orbit in found.orbits:
        for here, there in zip(orbit, jnp.roll(orbit, -1, axis=0)):
            image = rk.studies.stroboscopic_map(BLOCK, motion, here).state
            np.testing.assert_allclose(image, there, atol=1e-6)
    for row, column in ((3, 20), (15, 12), (20, 30), (28, 8)):
        start = float(found.rotation[column]), float(found.velocity[row])
        late = rk.studies.stroboscopic_map(BLOCK, motion, start, periods=2000)
        number = int(found.attractor[row, column])
        assert (number == -1) == bool(late.overturned)
        if number > 0:
            assert jnp.abs(found.orbits[number - 1] - late.state).max(axis=1).min() < 1e-6
    assert sum(found.shares.values()) == pytest.approx(1.0)
    assert found.shares[1] > 0.2 > found.shares[2] > 0.02 and found.shares[-1] > 0.5


def test_basins_of_gentle_and_of_violent_shaking():
    grid = np.linspace(-0.1, 0.1, 5), np.linspace(-0.1, 0.1, 4)
    gentle = rk.studies.basins(BLOCK, harmonic(0.05, 2.0), *grid, progress=False)
    assert (gentle.attractor == 1).all() and (gentle.orbits[0] == 0).all()
    violent = rk.studies.basins(BLOCK, harmonic(20.0, 2.0), *grid, progress=False)
    assert (violent.attractor == -1).all() and violent.orbits == ()


def test_orbits_among_states_of_maps_in_closed_form():
    """A slow way is no orbit, though it comes close to itself at every step; a turn by 120 degrees is one of three."""
    starts = np.random.default_rng(3).uniform(-0.5, 0.5, (60, 2))

    def slow(states, periods):
        return states * 0.9999 ** np.asarray(periods)[:, None]

    numbers, orbits = orbits_of(starts, 60, slow, 1e-16)
    assert (numbers == 0).all() and orbits == []

    def turned(states, periods):  # outside of a circle it contracts onto three points, inside onto the origin
        angle, size = np.arctan2(states[:, 1], states[:, 0]), np.hypot(*states.T)
        goal = np.round(angle / (2 * np.pi / 3)) * 2 * np.pi / 3
        nearer = 0.5 ** np.asarray(periods)
        angle = goal + (angle - goal) * nearer + 2 * np.pi / 3 * (np.asarray(periods) % 3)
        size = np.where(size > 0.3, 0.4 + (size - 0.4) * nearer, size * nearer)
        return size[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)

    final = turned(starts, np.full(60, 40))
    numbers, orbits = orbits_of(final, 40, turned, 1e-16)
    outside = np.hypot(*starts.T) > 0.3
    assert sorted(orbit.shape[0] for orbit in orbits) == [1, 3]
    np.testing.assert_array_equal(numbers, np.where(outside, numbers[outside][0], numbers[~outside][0]))
    assert np.sum(numbers == 1) >= np.sum(numbers == 2) > 0


def test_what_is_no_motion_is_refused():
    with pytest.raises(ValueError, match="`motion` must return a motion"):
        rk.studies.bifurcation(BLOCK, lambda strength: strength, [1.0, 2.0])
    with pytest.raises(ValueError, match="`rotation` must be known"):
        jax.jit(lambda x: rk.studies.basins(BLOCK, harmonic(1.5, 2.0), x, [0.0]).attractor)(jnp.zeros(2))


# ------------------------------------------------------------------------------------------ figures


def test_a_bifurcation_diagram_is_drawn():
    values = np.array([2.1, 2.3, 2.4, 2.9])
    found = rk.studies.bifurcation(SOFT, lambda strength: harmonic(strength, 2.0), values, (-0.05, 0.3), follow=True)
    axis = rk.plot.bifurcation_diagram(found)
    across, up = axis.lines[0].get_data()
    assert set(across) == {2.1, 2.3, 2.4} and len(np.unique(np.round(up[across == 2.4], 6))) == 2
    (shaded,) = axis.patches
    assert shaded.get_x() == pytest.approx(2.65)
    above = rk.plot.bifurcation_diagram(found, velocity=True).lines[0].get_data()[1]
    np.testing.assert_allclose(above[0], found.velocity[0, 0])


def test_basins_are_drawn():
    found = rk.studies.basins(
        BLOCK, harmonic(1.5, 2.0), np.linspace(-0.2, 0.2, 9), np.linspace(-0.8, 0.8, 7), progress=False
    )
    axis = rk.plot.basins_of_attraction(found)
    drawn = axis.collections[0].get_array()
    np.testing.assert_array_equal(np.asarray(drawn).reshape(7, 9), found.attractor)
    labels = {text.get_text() for text in axis.get_legend().get_texts()}
    assert labels >= {"overturned", "orbit of one period"}
    np.testing.assert_allclose(axis.lines[0].get_xydata(), found.orbits[0])
