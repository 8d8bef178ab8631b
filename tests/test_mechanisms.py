"""Mechanisms from the positions of their bodies: closed forms of their equations, and Newton's law for every body.

Closed forms: Housner's block, Makris and Vassiliou's frame, an inerter, a wall tied to an oscillator, a strip wall.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.models import Mechanism, RigidBody
from jaxrock.models.equation import Angle
from references import bodies

WIDTH, HEIGHT, MASS = 0.6, 3.0, 1200.0
ALPHA, RADIUS = np.arctan2(WIDTH, HEIGHT), np.hypot(WIDTH, HEIGHT) / 2
SINE = rk.SinePulse(0.25, 0.9)
DIPS = rk.SinePulse(0.2, 0.4) + rk.SinePulse(0.2, 0.4).shifted(0.4)
EXACT = rk.Diffrax(rtol=1e-11)


class Column(eqx.Module):
    """A rectangle on its corner, and what the subclasses hang to it."""

    width: Any
    height: Any
    more: Any = 0.0

    def __call__(self, x):
        alpha, radius = jnp.arctan2(self.width, self.height), jnp.hypot(self.width, self.height) / 2
        aside, up = -radius * jnp.sin(alpha - x), radius * jnp.cos(alpha - x)
        return [RigidBody(MASS, aside, up, x, MASS * radius**2 / 3), *self.others(aside, up)]

    def others(self, aside, up):
        return []


class Frame(Column):
    """Beam: `more` times the mass, twice as far."""

    def others(self, aside, up):
        return [RigidBody(self.more * MASS, 2 * aside, 2 * up)]


class WithInerter(Column):
    """Inertance: `more` times the mass, against the displacement of the centre."""

    def others(self, aside, up):
        return [RigidBody(0.0, 0.0, 0.0, aside, self.more * MASS)]


class Tied(Column):
    """A mass that is tied to the top corner, and stays level: `more` times the mass."""

    def others(self, aside, up):
        return [RigidBody(self.more * MASS, 2 * aside, self.height)]


class Strip(Column):
    """The upper half of a wall whose top can only rise, mirrored over the crack."""

    def others(self, aside, up):
        radius = jnp.hypot(self.width, self.height) / 2
        return [RigidBody(MASS, aside, 3 * up, jnp.arcsin(aside / radius), MASS * radius**2 / 3)]


def column(kind, more=0.0):
    return kind(jnp.asarray(WIDTH), jnp.asarray(HEIGHT), jnp.asarray(more))


def outcome(mechanism, motion=SINE, engine=EXACT, **options):
    return rk.outcome(mechanism.block(), motion, mechanism, engine=engine, **options)


def numbers(found):
    return jnp.stack([found.max_rotation, found.max_velocity, found.time_of_max, found.margin])


# ---- Housner's block and the frame, which have engines of their own ----


@pytest.mark.parametrize("dips", [pytest.param(False, marks=pytest.mark.slow), True], ids=["level", "vertical motion"])
@pytest.mark.parametrize(
    "kind, block",
    [
        (column(Column), rk.Block.from_dimensions(WIDTH, HEIGHT)),
        (column(Frame, 5.0), rk.Block.from_frame(WIDTH, HEIGHT, 5.0)),
    ],
    ids=["block", "frame"],
)
def test_a_block_and_a_frame(kind, block, dips):
    """Peaks, their time, margin; alpha, p and restitution to rounding."""
    mechanism, motion = Mechanism(kind), SINE.with_vertical(DIPS) if dips else SINE
    made = mechanism.block()
    np.testing.assert_allclose(
        [made.alpha, made.p, made.restitution], [block.alpha, block.p, block.restitution], rtol=1e-14
    )
    found, wanted = outcome(mechanism, motion), rk.outcome(block, motion)
    assert found.status == rk.Status.successful and 0 < wanted.margin < 1
    np.testing.assert_allclose(numbers(found), numbers(wanted), rtol=1e-9)


@pytest.mark.slow
def test_under_a_record():
    """Impacts and peaks are those of Housner's block, under a real record."""
    record, block = rk.example_record(), rk.Block.from_dimensions(WIDTH, HEIGHT)
    found, wanted = outcome(Mechanism(column(Column)), record), rk.outcome(block, record)
    np.testing.assert_allclose(numbers(found), numbers(wanted), rtol=1e-8)
    assert found.large_impact_count == wanted.large_impact_count > 3


# ---- Equations in closed form ----

KAPPA = 0.75
OMEGA2, DAMPING = 30.0, 0.05  # [1/s^2], share of critical


def inerter(x, v, push, more):
    angle = ALPHA - x
    inertia = 1 + more * KAPPA * np.cos(angle) ** 2
    moment = np.sin(angle) + push * np.cos(angle) + more * KAPPA * np.sin(angle) * np.cos(angle) * v**2
    return -moment / inertia


def tied(x, v, push, more):
    angle, p = ALPHA - x, np.sqrt(KAPPA * 9.81 / RADIUS)
    stretch, rate = 2 * RADIUS * (np.sin(ALPHA) - np.sin(angle)), 2 * RADIUS * np.cos(angle) * v * p
    force = (OMEGA2 * stretch + 2 * DAMPING * np.sqrt(OMEGA2) * rate) / 9.81
    moment = np.sin(angle) + push * np.cos(angle) + 2 * more * np.cos(angle) * (push + force)
    moment += 4 * more * KAPPA * np.sin(angle) * np.cos(angle) * v**2
    return -moment / (1 + 4 * more * KAPPA * np.cos(angle) ** 2)


def spring_and_damper(more):
    def moment(x, velocity):
        angle = ALPHA - x
        stretch, rate = 2 * RADIUS * (np.sin(ALPHA) - jnp.sin(angle)), 2 * RADIUS * jnp.cos(angle) * velocity
        return more * MASS * (OMEGA2 * stretch + 2 * DAMPING * OMEGA2**0.5 * rate) * 2 * RADIUS * jnp.cos(angle)

    return moment


@pytest.mark.parametrize(
    "kind, formula, moment",
    [(WithInerter, inerter, None), (Tied, tied, spring_and_damper)],
    ids=["inerter", "tied to an oscillator"],
)
def test_equations_of_motion(kind, formula, moment):
    """Accelerations at many states, in the unit of time of the bare block."""
    more = 0.4
    mechanism = Mechanism(column(kind, more), None if moment is None else moment(more))
    block, bare = mechanism.block(), rk.Block.from_dimensions(WIDTH, HEIGHT)
    moments, unit = mechanism.moments(block), float(bare.p / block.p)
    for x in (0.0, 0.05, 0.19, 0.3):
        for v in (0.0, 0.1, -0.25):
            for push in (0.0, 0.3, -0.7):
                got = moments.acceleration(Angle.of(jnp.asarray(x)), jnp.asarray(unit * v), jnp.asarray(push)) / unit**2
                np.testing.assert_allclose(got, formula(x, v, push, more), rtol=1e-11, atol=1e-13)


SIN2, COS2 = np.sin(ALPHA) ** 2, np.cos(ALPHA) ** 2


@pytest.mark.parametrize(
    "kind, more, restitution, threshold",
    [
        (Column, 0.0, 1 - 1.5 * SIN2, 1),
        (Frame, 5.0, bodies.Frame(ALPHA, RADIUS, 5.0).restitution, 1),
        (WithInerter, 0.4, (1 - 1.5 * SIN2 + 0.3 * COS2) / (1 + 0.3 * COS2), 1),
        (Tied, 0.4, (1 - 1.5 * SIN2 + 1.2 * COS2) / (1 + 1.2 * COS2), 1 / 1.8),
        (Strip, 0.0, bodies.StripWall(ALPHA, RADIUS).restitution, 2),
        (Strip, 0.0, (2 / 0.75 - 12 * SIN2) / (2 / 0.75 + 8 * SIN2), 2),
    ],
    ids=["block", "frame", "inerter", "tied", "strip wall, impulses", "strip wall, energy"],
)
def test_restitution_and_threshold(kind, more, restitution, threshold):
    """Threshold over tan(alpha) of a column: 2 of a strip wall, whose halves lift each other."""
    block = Mechanism(column(kind, more)).block()
    np.testing.assert_allclose(block.restitution, restitution, rtol=1e-13)
    np.testing.assert_allclose(np.tan(block.alpha), threshold * np.tan(ALPHA), rtol=1e-13)


@pytest.mark.slow
def test_it_uplifts_at_its_threshold():
    mechanism = Mechanism(column(Strip))
    lowest = 2 * np.tan(ALPHA)
    peak = jax.jit(lambda a: outcome(mechanism, rk.RectangularPulse(a, 0.1)).max_rotation)
    assert peak(lowest * (1 - 1e-9)) == 0 and peak(lowest * (1 + 1e-6)) > 0


# ---- Beside Newton's law ----


@pytest.mark.slow
@pytest.mark.parametrize("dips", [False, True], ids=["level", "vertical motion"])
def test_a_strip_wall_beside_newton(dips):
    """Rotation and velocity through impacts, with forces between the halves as unknowns of the judge."""
    mechanism = Mechanism(column(Strip))
    motion = (2 * SINE).with_vertical(DIPS) if dips else 2 * SINE
    response = rk.simulate(
        mechanism.block(), motion, mechanism, initial=(0.05, 0.1), duration=1.5, samples=31, engine=EXACT
    )
    push = lambda t: 0.5 * np.sin(2 * np.pi * t / 0.9) if t < 0.9 else 0.0
    lift = lambda t: 1 + (0.2 * np.sin(2 * np.pi * t / 0.4) if dips and t < 0.8 else 0.0)
    found, impacts = bodies.respond(bodies.StripWall(ALPHA, RADIUS), (0.05, 0.1), np.asarray(response.time), push, lift)
    assert len(impacts) >= 2 and response.impact_count >= len(impacts)
    np.testing.assert_allclose(response.impact_times[: len(impacts)], impacts, atol=1e-8)
    np.testing.assert_allclose(response.rotation, found[:, 0], atol=1e-8)
    np.testing.assert_allclose(response.velocity, found[:, 1], atol=1e-7)


def energy(x, v):
    """Kinetic and potential energy of the tied wall without damping, per mass, v in rad/s."""
    angle, more = ALPHA - x, 0.4
    stretch = 2 * RADIUS * (np.sin(ALPHA) - np.sin(angle))
    kinetic = 0.5 * v**2 * (RADIUS**2 / KAPPA + more * (2 * RADIUS * np.cos(angle)) ** 2)
    return kinetic + 9.81 * RADIUS * (np.cos(angle) - np.cos(ALPHA)) + 0.5 * more * OMEGA2 * stretch**2


@pytest.mark.slow
def test_energy_between_impacts():
    """Free rocking keeps it between impacts, and loses 1 - e^2 of it at each."""

    def pull(x, velocity):
        angle = ALPHA - x
        return 1.6 * MASS * OMEGA2 * RADIUS**2 * (np.sin(ALPHA) - jnp.sin(angle)) * jnp.cos(angle)

    mechanism = Mechanism(column(Tied, 0.4), pull)
    quiet, block = rk.RectangularPulse(1e-9, 1e-3), mechanism.block()
    response = rk.simulate(block, quiet, mechanism, initial=(0.1, 0.0), duration=3.0, samples=301, engine=EXACT)
    level = energy(np.abs(response.rotation), np.asarray(response.velocity))
    impacts = np.asarray(response.impact_times)[:4]
    number = np.searchsorted(impacts, np.asarray(response.time))
    wanted = level[0] * float(block.restitution) ** (2 * number)
    known = response.time < impacts[3] - 1e-6
    assert number[known].max() == 3
    np.testing.assert_allclose(level[known], wanted[known], rtol=2e-8)
    # The free stage of an outcome knows the work of the weight and of the spring.
    moments = mechanism.moments(block)
    rise = energy(0.1, 0.0) / (RADIUS**2 / KAPPA + 1.6 * RADIUS**2 * COS2) / float(block.p) ** 2
    np.testing.assert_allclose(moments.work(jnp.asarray(0.1)), rise, rtol=1e-12)


# ---- Derivatives ----


@pytest.mark.slow
def test_derivatives_follow_positions_and_block():
    """By width, height and mass of the functions' modules, through threshold, p and restitution."""

    def peaks(width, more):
        mechanism = Mechanism(Tied(width, HEIGHT, more))
        return numbers(outcome(mechanism))

    at, step = (0.6, 0.1), 1e-5
    slopes = jax.jacfwd(peaks, argnums=(0, 1))(*at)
    fast = jax.jit(peaks)
    for slope, (one, other) in zip(slopes, (((at[0] + step, at[1]), (at[0] - step, at[1])),
                                            ((at[0], at[1] + step), (at[0], at[1] - step)))):  # fmt: skip
        np.testing.assert_allclose(slope, (fast(*one) - fast(*other)) / (2 * step), rtol=2e-6, atol=1e-7)


# ---- What is refused ----


def test_refusals():
    mechanism, block = Mechanism(column(Column)), rk.Block.from_dimensions(WIDTH, HEIGHT)
    refused = [
        (lambda: rk.outcome(rk.Block(0.2, 2.0), SINE, mechanism), "must be that of its method `block`"),
        (lambda: rk.outcome(rk.blocks.AsymmetricBlock(0.2, 0.3, 2.0), SINE, mechanism), "but is asymmetric"),
        (lambda: Mechanism(lambda x: x).block(), "returns a list of `RigidBody`"),
        (lambda: Mechanism(lambda x: [RigidBody(jnp.ones(2), x, x)]).block(), "`mass` of a `RigidBody` must be"),
        (lambda: Mechanism(lambda x: [RigidBody(1.0, x, -x)]).block(), "a weight that closes the mechanism"),
        (lambda: Mechanism(lambda x: [RigidBody(1.0, -x, x)]).block(), "move to the side of the opening"),
        (lambda: Mechanism(lambda x: [RigidBody(1.0, x, 2 * x)]).block(), "1 - 2 T_vertical/T, of 0 or more"),
        (lambda: rk.outcome(block, SINE, Mechanism(column(Column), lambda x, v: 1.0)), "must be zero at rest"),
        (lambda: rk.outcome(block, SINE, Mechanism(column(Column), lambda x, v: jnp.sign(v))), "must not jump"),
    ]  # fmt: skip
    for call, message in refused:
        with pytest.raises(ValueError, match=message):
            call()
    assert Mechanism(lambda x: [RigidBody(1.0, x, 2 * x)]).block(restitution=0.5).restitution == 0.5


def test_another_gravity():
    """On the Moon the same wall is slower, and its response to g-scaled motion the same in time p t."""
    moon = Mechanism(column(Column), gravity=1.62)
    assert moon.block().alpha == Mechanism(column(Column)).block().alpha
    np.testing.assert_allclose(moon.block().p, np.sqrt(0.75 * 1.62 / RADIUS), rtol=1e-14)


def test_no_durations_where_a_moment_has_a_size():
    """A longer motion is taken as a larger p, which a spring in N/m does not follow."""
    mechanism = Mechanism(column(Tied, 0.4), spring_and_damper(0.4))
    with pytest.raises(ValueError, match="must not depend on the block's p"):
        rk.studies.critical_durations(mechanism.block(), SINE, mechanism)
