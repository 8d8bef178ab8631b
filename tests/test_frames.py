"""Frames of columns under a beam (Makris & Vassiliou 2013) and columns with a mass at the top.

The judge is `references.bodies`: Newton's law for column and beam, with the forces between them as unknowns.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.studies.parameters import named
from references import bodies

WIDTH, HEIGHT = 0.6, 3.0
ALPHA, RADIUS = np.arctan2(WIDTH, HEIGHT), np.hypot(WIDTH, HEIGHT) / 2
BEAMS = [0.0, 0.3, 1.0, 5.0, 100.0]
SINE = rk.SinePulse(0.25, 0.9)
DIPS = rk.SinePulse(0.2, 0.4) + rk.SinePulse(0.2, 0.4).shifted(0.4)


def frame(beam, width=WIDTH, restitution=None):
    return rk.Block.from_frame(width, HEIGHT, beam, restitution)


# ---- What a frame is ----


@pytest.mark.parametrize("beam", BEAMS)
def test_the_formulas_of_makris_and_vassiliou(beam):
    """Frequency parameter and restitution, as they print these for rectangular columns."""
    found, sine = frame(beam), np.sin(ALPHA) ** 2
    np.testing.assert_allclose(found.p**2, 3 * 9.81 / (4 * RADIUS) * (1 + 2 * beam) / (1 + 3 * beam), rtol=1e-14)
    printed = (1 - 1.5 * sine + 3 * beam * np.cos(2 * ALPHA)) / (1 + 3 * beam)
    np.testing.assert_allclose(found.restitution, printed, rtol=1e-14)
    assert found.alpha == ALPHA and found.beam == beam


@pytest.mark.parametrize("beam", BEAMS)
def test_the_impulses_on_column_and_beam(beam):
    np.testing.assert_allclose(frame(beam).restitution, bodies.Frame(ALPHA, RADIUS, beam).restitution, rtol=1e-13)


def test_without_a_beam_it_is_the_block():
    """To the last digit, in every number that a response depends on."""
    one, other = frame(0.0), rk.Block.from_dimensions(WIDTH, HEIGHT)
    assert (one.alpha, one.p, one.restitution) == (other.alpha, other.p, other.restitution)
    near = frame(1e-9)
    np.testing.assert_allclose([near.p, near.restitution], [other.p, other.restitution], rtol=2e-9)


def test_three_ratios_of_inertia():
    """A beam of five columns' mass: 0.516 in the dynamics, 0.984 at the impact, 0.945 in the base forces."""
    found = frame(5.0)
    np.testing.assert_allclose(found.p**2 * RADIUS / 9.81, 0.515625, rtol=1e-12)
    np.testing.assert_allclose([found.law.inertia_ratio, found.base_ratio], [0.984375, 0.9453125], rtol=1e-12)


@pytest.mark.parametrize("beam", BEAMS)
def test_it_uplifts_at_tan_alpha_however_heavy_the_beam(beam):
    below, above = (rk.outcome(frame(beam), rk.RectangularPulse(s * np.tan(ALPHA), 0.1)) for s in (1 - 1e-9, 1 + 1e-9))
    assert below.max_rotation == 0 and above.max_rotation > 0


def test_a_heavier_beam_is_a_slower_frame():
    """The limits of the frequency parameter: sqrt(2/3) of the columns' own under an infinite beam."""
    rates = [float(frame(beam).p) for beam in (*BEAMS, 1e8)]
    assert np.all(np.diff(rates) < 0)
    np.testing.assert_allclose(rates[-1] / rates[0], np.sqrt(2 / 3), rtol=1e-8)


# ---- How it rocks, and on what ----


@pytest.mark.parametrize("dips", [False, True], ids=["level", "vertical motion"])
@pytest.mark.parametrize("beam", [0.0, 5.0])
def test_beside_newton(beam, dips):
    """Rotation, velocity and base forces, through impacts."""
    motion = SINE.with_vertical(DIPS) if dips else SINE
    response = rk.simulate(frame(beam), motion, initial=(0.05, 0.1), duration=2.5, samples=51)
    push = lambda t: 0.25 * np.sin(2 * np.pi * t / 0.9) if t < 0.9 else 0.0
    lift = lambda t: 1 + (0.2 * np.sin(2 * np.pi * t / 0.4) if dips and t < 0.8 else 0.0)
    times = np.asarray(response.time)
    judge = bodies.Frame(ALPHA, RADIUS, beam)
    found, impacts = bodies.respond(judge, (0.05, 0.1), times, push, lift)
    assert len(impacts) >= 2 and response.impact_count == len(impacts)
    np.testing.assert_allclose(response.impact_times[: len(impacts)], impacts, atol=1e-8)
    np.testing.assert_allclose(response.rotation, found[:, 0], atol=1e-8)
    np.testing.assert_allclose(response.velocity, found[:, 1], atol=1e-7)
    contact = rk.responses.contact_forces(response, frame(beam))
    np.testing.assert_allclose(contact.horizontal, found[:, 2], atol=1e-7)
    np.testing.assert_allclose(contact.normal, found[:, 3], atol=1e-7)


@pytest.mark.parametrize("beam", [0.0, 0.3, 5.0])
def test_derivatives_by_the_beam(beam):
    """Through the constructor, beside differences of both sides (forward ones without a beam)."""

    def numbers(beam, width):
        found = rk.outcome(frame(beam, width), rk.SinePulse(0.26, 0.9))
        return jnp.stack([found.max_rotation, found.max_velocity, found.margin])

    step, start = 1e-5, max(beam, 1e-5)
    slopes = jax.jacfwd(numbers)(start, WIDTH)
    differences = (numbers(start + step, WIDTH) - numbers(start - step, WIDTH)) / (2 * step)
    np.testing.assert_allclose(slopes, differences, rtol=2e-6, atol=1e-8)
    by_width = jax.jacfwd(numbers, argnums=1)(start, WIDTH)  # the restitution follows alpha
    differences = (numbers(start, WIDTH + step) - numbers(start, WIDTH - step)) / (2 * step)
    np.testing.assert_allclose(by_width, differences, rtol=2e-6, atol=1e-8)
    by_beam = jax.grad(lambda b: frame(b).restitution)(start)
    np.testing.assert_allclose(by_beam, -1.5 * np.sin(ALPHA) ** 2 / (1 + 3 * start) ** 2, rtol=1e-12)


def test_a_given_restitution_stays():
    found = frame(5.0, restitution=0.9)
    assert found.restitution == 0.9 and found.beam == 5.0
    assert jax.grad(lambda b: rk.Block.from_frame(WIDTH, HEIGHT, b, 0.9).restitution)(5.0) == 0


def test_transformations():
    """Many beams at once, in a sweep and in sensitivities; no name appears that a frame does not have."""
    peak = lambda beam: rk.outcome(frame(beam), SINE).max_rotation
    alone = np.array([peak(beam) for beam in BEAMS])
    np.testing.assert_allclose(jax.jit(jax.vmap(peak))(jnp.array(BEAMS)), alone, rtol=1e-12)
    blocks = jax.vmap(frame)(jnp.array(BEAMS))
    np.testing.assert_allclose(jax.vmap(lambda b: rk.outcome(b, SINE).max_rotation)(blocks), alone, rtol=1e-12)
    np.testing.assert_allclose(rk.sweep(peak, beam=np.array(BEAMS)).values, alone, rtol=1e-12)
    friction = lambda b: rk.responses.contact_forces(rk.simulate(b, SINE, duration=1.0), b).largest_friction
    np.testing.assert_allclose(jax.vmap(friction)(blocks)[3], friction(frame(5.0)), rtol=1e-10)
    drawn = rk.blocks.draw_blocks(frame(5.0), 3, alpha=0.01)
    np.testing.assert_array_equal(drawn.beam, [5.0, 5.0, 5.0])
    names = rk.studies.sensitivity(frame(5.0), SINE).names
    assert names == ("alpha", "p", "restitution.inertia_ratio", "amplitude", "period", "uplift_strength")


def test_a_block_is_as_it_was():
    """It has no beam, no number or name more, and its representation none either."""
    block = rk.Block(0.2, 2.0, 0.9)
    assert block.beam is None and block.base_ratio is None and len(jax.tree.leaves(block)) == 3
    assert "beam" not in repr(block) and "beam=5" in repr(frame(5.0))
    assert list(named(block, SINE)) == ["alpha", "p", "restitution", "amplitude", "period"]


# ---- Columns with a mass ----


@pytest.mark.parametrize("top", [0.0, 0.4, 3.0, 1e6])
def test_a_column_with_a_mass_as_points(top):
    """Many small masses beside the formulas: centre, radius, inertia about a corner, and the impact."""
    n = 400
    x, y = np.meshgrid((np.arange(n) + 0.5) / n * WIDTH, (np.arange(n) + 0.5) / n * HEIGHT)
    x, y = np.append(x.ravel(), WIDTH / 2), np.append(y.ravel(), HEIGHT)
    mass = np.append(np.full(n * n, 1 / n**2), top)
    height, inertia = np.sum(mass * y) / mass.sum(), np.sum(mass * (x**2 + y**2))
    found = rk.Block.from_masses(WIDTH, HEIGHT, top)
    moment = mass.sum() * np.hypot(WIDTH / 2, height)
    np.testing.assert_allclose(
        [found.alpha, found.p], [np.arctan(WIDTH / 2 / height), np.sqrt(9.81 * moment / inertia)], rtol=2e-6
    )
    # Angular momentum about the new corner (x = 0), before (turning about x = WIDTH) and after.
    kept = np.sum(mass * (y * y + x * (x - WIDTH))) / inertia
    np.testing.assert_allclose(found.restitution, kept, rtol=5e-6)


def test_a_column_without_a_mass_is_the_block():
    one, other = rk.Block.from_masses(WIDTH, HEIGHT, 0.0), rk.Block.from_dimensions(WIDTH, HEIGHT)
    np.testing.assert_allclose(
        [one.alpha, one.p, one.restitution], [other.alpha, other.p, other.restitution], rtol=1e-14
    )


def test_base_forces_of_a_column_with_a_mass():
    """Momentum of the centre of mass along the response is the judge."""
    block = rk.Block.from_masses(WIDTH, HEIGHT, 2.0)
    response = rk.simulate(block, rk.SinePulse(0.15, 0.9), initial=(0.02, 0.1), duration=0.9, samples=10)
    contact = rk.responses.contact_forces(response, block)
    height = HEIGHT / 2 * 5 / 3
    radius, step, times = np.hypot(WIDTH / 2, height), 1e-4, np.asarray(response.time)[1:-1]

    def place(t):
        rotation = np.asarray(response(t)[0])
        side, angle = np.sign(rotation), block.alpha - np.abs(rotation)
        return side * (radius * np.sin(block.alpha) - radius * np.sin(angle)), radius * np.cos(angle)

    before, here, after = (np.array(place(times + k * step)) for k in (-1, 0, 1))
    x, y = (before - 2 * here + after) / step**2 / 9.81
    u = 0.15 * np.sin(2 * np.pi * times / 0.9)
    assert np.all(response.rotation[1:-1] != 0)
    np.testing.assert_allclose(contact.horizontal[1:-1], u + x, atol=1e-5)
    np.testing.assert_allclose(contact.normal[1:-1], 1 + y, atol=1e-5)


# ---- What is refused ----

BLOCK = rk.Block(0.2, 2.0, 0.9)
OWN = rk.models.Equation(lambda x, block: jnp.sin(block.alpha - x), lambda x, block: jnp.cos(block.alpha - x))


@pytest.mark.parametrize("model", [rk.Spring("SM1", "sine"), OWN], ids=["spring", "own"])
def test_no_forces_where_they_do_not_follow(model):
    response = rk.simulate(BLOCK, SINE, model, duration=0.5, samples=2)
    with pytest.raises(ValueError, match="do not: compute them from the momentum of your bodies"):
        rk.responses.contact_forces(response, BLOCK)


def test_forces_of_a_model_that_says_that_they_follow():
    """A user's class that is Housner's equation, and says so."""

    class Mine(rk.Housner):
        pass

    one, other = (
        rk.responses.contact_forces(rk.simulate(BLOCK, SINE, model, duration=0.5, samples=5), BLOCK)
        for model in (Mine(), rk.Housner())
    )
    np.testing.assert_array_equal(one.normal, other.normal)


def test_other_ratios_of_inertia_are_refused_or_told():
    response = rk.simulate(frame(5.0), SINE, duration=0.5, samples=2)
    with pytest.raises(ValueError, match="`inertia_ratio` must be 0.945312 as that of the frame"):
        rk.responses.contact_forces(response, frame(5.0), 0.984375)
    rk.responses.contact_forces(response, frame(5.0), 0.9453125)
    with pytest.raises(ValueError, match="the response, which is a frame, but is one body"):
        rk.responses.contact_forces(response, rk.Block(frame(5.0).alpha, frame(5.0).p, frame(5.0).law))
    with pytest.raises(ValueError, match="is a frame, whose columns do not roll"):
        rk.outcome(frame(5.0), SINE, rk.models.Rolling(0.1))
    with pytest.warns(UserWarning, match="has the inertia ratio 0.516, but that of its law of restitution is 0.984"):
        rk.Block.from_radius(0.2, 1.5, rk.restitution.Housner(0.984), inertia_ratio=0.516)


@pytest.mark.parametrize("name, value", [("beam", -0.1), ("beam", np.nan), ("width", 0.0), ("width", 5.0)])
def test_wrong_numbers(name, value):
    with pytest.raises(ValueError, match=f"`{'alpha' if value == 5.0 else name}` must"):
        rk.Block.from_frame(**{"width": WIDTH, "height": HEIGHT, "beam": 1.0} | {name: value})
    assert np.isnan(
        rk.outcome(
            rk.Block.from_frame(**{"width": WIDTH, "height": HEIGHT, "beam": 1.0} | {name: value}, throw=False), SINE,
            throw=False
        ).max_rotation
    )  # fmt: skip
