"""Blocks on rounded edges: beside Newton's law for a body on a rolling circle, by energy, and on meshes.

The judge knows no height of the centre of mass as a function of the angle: it solves for the forces of the ground, for
a circle that rolls without slipping (`Wheel`).
"""

import json
import warnings
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import mpmath as mp
import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

import jaxrock as rk
from jaxrock.engines.scene import Scene
from jaxrock.models.equation import Angle
from jaxrock.responses.arguments import engine_of
from jaxrock.responses.contact import _ratio_of
from references import rolling

GRAVITY = 9.81
EXACT = {"engine": rk.Diffrax(rtol=1e-11)}


class Wheel(NamedTuple):
    """One side of a block: slenderness, frequency parameter, m R^2/I, radius of the edge over R, restitution."""

    alpha: float
    p: float
    ratio: float
    radius: float
    restitution: float

    def forces(self, opening, speed, push, lift):
        """Angular acceleration [1/s^2], horizontal and normal force of the ground over m g, outward and up.

        Newton's law for the centre of mass and about it; the centre of the circle moves on a level line by radius
        times angle.
        """
        R = self.ratio * GRAVITY / self.p**2
        inertia, edge = R**2 * (1 / self.ratio - 1), self.radius * R
        away = np.array([-R * np.sin(self.alpha), R * np.cos(self.alpha) - edge])
        sine, cosine = np.sin(opening), np.cos(opening)
        x, y = cosine * away[0] + sine * away[1], -sine * away[0] + cosine * away[1]  # turned outward
        matrix = [[edge + y, -1.0, 0.0], [-x, 0.0, -1.0], [inertia, edge + y, -x]]
        right = [x * speed**2 - push * GRAVITY, y * speed**2 - (1 + lift) * GRAVITY, 0.0]
        turning, horizontal, normal = np.linalg.solve(matrix, right)
        return turning, horizontal / GRAVITY, normal / GRAVITY


@jax.jit
def of_rolling(radius, alpha, p, ratio, states, openings):
    """Return accelerations at states, threshold, balance, its slope by the radius, and the work up to given angles."""
    moments = rk.models.Rolling(radius, inertia_ratio=ratio).moments(rk.Block(alpha, p))

    def told(state):
        opening, speed, push, lift = state
        return p**2 * moments.acceleration(Angle.of(opening), speed / p, push, 1 + lift)

    slope = jax.grad(lambda r: rk.models.Rolling(r).moments(rk.Block(alpha, p)).saddle)(radius)
    return jax.vmap(told)(states), moments.threshold, moments.saddle, slope, jax.vmap(moments.work)(openings)


@pytest.mark.parametrize("radius", [0.0, 0.3, 0.8])
def test_the_equation_is_newtons(radius):
    """At states below and beyond its balance, under horizontal and vertical shaking; what follows from it at rest."""
    alpha, p, ratio = 0.3, 2.5, 0.7
    wheel = Wheel(alpha, p, ratio, radius, 0.9)
    states = np.array([(0.0, 0.4, 0.5, 0.0), (0.25, 1.0, -0.2, 0.3), (0.7, 2.0, 0.1, -0.4)])
    balance = float(np.arctan2(np.sin(alpha), np.cos(alpha) - radius))
    openings = np.array([1e-8, 0.2, balance])
    told, threshold, saddle, slope, work = jax.device_get(of_rolling(radius, alpha, p, ratio, states, openings))
    for acceleration, state in zip(told, states):
        assert float(acceleration) == pytest.approx(wheel.forces(*state)[0], rel=1e-12)
    assert float(threshold) == pytest.approx(np.tan(alpha), rel=1e-14)
    assert float(saddle) == pytest.approx(balance, rel=1e-12)
    assert float(slope) == pytest.approx(np.sin(balance) ** 2 / np.sin(alpha), rel=1e-10)
    rises = 2 * np.sin(openings / 2) * np.sin(alpha - openings / 2) + 2 * radius * np.sin(openings / 2) ** 2
    np.testing.assert_allclose(work, rises, rtol=1e-12)  # of the centre of mass over where it was at rest


def test_the_balance_has_second_derivatives():
    """Compare second derivatives of the balance, along slenderness and radius, with its closed form.

    An `Equation` of which only values are known is compared, too.
    """

    def closed(z):
        return jnp.arctan2(jnp.sin(z[0]), jnp.cos(z[0]) - z[1])

    def rolled(z):
        return rk.models.Rolling(z[1]).moments(rk.Block(z[0], 2.0)).saddle

    def written(z):
        reach = lambda x, b: jnp.sin(b.alpha - x) + z[1] * jnp.sin(x)
        return rk.models.Equation(reach).moments(rk.Block(z[0], 2.0)).saddle

    at, way = jnp.array([0.2, 0.2]), jnp.array([1.0, 0.5])

    @jax.jit
    def bends(at):
        along = lambda f: lambda z: jax.jvp(f, (z,), (way,))[1]
        return [along(along(found))(at) for found in (closed, rolled, written)]

    np.testing.assert_allclose(*np.broadcast_arrays(bends(at)[0], bends(at)[1:]), rtol=1e-9)


def test_the_judge_of_records_is_newtons():
    """Check the judge of records against Newton's law: the elimination by hand, and halved steps (errors of 1/16)."""
    block, wheel = rolling.Rolling(0.3, 2.5, 0.3, 0.9, 0.7), Wheel(0.3, 2.5, 0.7, 0.3, 0.9)
    for opening, speed, push in ((0.0, 0.4, 0.5), (0.25, 1.0, -0.2), (0.7, 2.0, 0.1)):
        assert block.acceleration(opening, speed, push) == pytest.approx(
            wheel.forces(opening, speed, push, 0.0)[0], rel=1e-12
        )
    samples = [0.5 * np.sin(2 * np.pi * k / 40) for k in range(41)]
    coarse, fine, finest = (rolling.respond(block, samples, 0.02, parts).peak for parts in (1, 2, 16))
    assert 0.1 < finest < 1.0 and abs(fine - finest) < abs(coarse - finest) / 10 < 1e-7


def by_newton(wheels, horizontal, vertical, start, times, until):
    """Rotation, angular velocity and forces [m g] at times under a smooth motion [g], and whether it fell."""
    side, state, begin = 1 if start[0] > 0 or start[1] > 0 else -1, np.array(start, float), 0.0
    found = np.full((4, len(times)), np.nan)
    while begin < until:
        wheel = wheels[0 if side > 0 else 1]

        def flow(t, y, wheel=wheel, side=side):
            return [y[1], side * wheel.forces(side * y[0], y[1], side * horizontal(t), vertical(t))[0]]

        def ground(t, y, begin=begin, side=side):
            return side * y[0] if t > begin + 1e-5 else 1.0

        ground.terminal, ground.direction = True, -1
        flat = lambda t, y: np.pi / 2 - abs(y[0])
        flat.terminal = True
        arc = solve_ivp(flow, (begin, until), state, "DOP853", events=(ground, flat), rtol=1e-12, atol=1e-14,
                        dense_output=True, max_step=0.05)  # fmt: skip
        inside = (times >= begin) & (times < arc.t[-1])
        found[:2, inside] = arc.sol(times[inside])
        for k in np.flatnonzero(inside):
            t, (angle, speed) = times[k], found[:2, k]
            _, outward, normal = wheel.forces(side * angle, speed, side * horizontal(t), vertical(t))
            found[2:, k] = side * outward, normal
        if arc.t_events[1].size:
            return found, True
        begin, state = arc.t[-1], np.array([0.0, wheel.restitution * arc.y[1, -1]])
        side = -side
    return found, False


SINE = rk.SinePulse(0.35, 0.9)
DIPS = {"level": lambda t: 0.0, "vertical": lambda t: 0.2 * np.sin(2 * np.pi * t / 0.4)}


@pytest.mark.slow
@pytest.mark.parametrize(
    "alpha, radius, dip",
    [(0.2, 0.3, "level"), (0.35, 0.8, "vertical"), (0.15, 0.05, "level")],
    ids=["round", "rounder, and vertical motion", "nearly sharp"],
)
def test_beside_newton(alpha, radius, dip):
    """Rotation, velocity and forces of the ground under a sine; at rest its own edge starts it."""
    block, p = rk.Block(alpha, 2.5, 0.9), 2.5
    motion = (
        SINE if dip == "level" else SINE.with_vertical(rk.SinePulse(0.2, 0.4) + rk.SinePulse(0.2, 0.4).shifted(0.4))
    )
    until = 0.8
    wheel = Wheel(alpha, p, 0.75, radius, 0.9)
    response = rk.simulate(block, motion, rk.models.Rolling(radius), initial=(0.08, 0.1), duration=until, **EXACT)
    contact = rk.responses.contact_forces(response, block)
    push = lambda t: 0.35 * np.sin(2 * np.pi * t / 0.9)
    times = np.asarray(response.time)[:-1]
    found, fell = by_newton([wheel, wheel], push, DIPS[dip], (0.08, 0.1), times, until)
    assert not fell and np.isfinite(found).all() and response.impact_times.size >= 1
    np.testing.assert_allclose(response.rotation[:-1], found[0], atol=2e-9)
    np.testing.assert_allclose(response.velocity[:-1], found[1], atol=2e-8)
    np.testing.assert_allclose(contact.horizontal[:-1], found[2], atol=1e-7)
    np.testing.assert_allclose(contact.normal[:-1], found[3], atol=1e-7)


def test_the_tolerance_under_a_record():
    """A step goes from sample to sample in any case: a tight tolerance costs nothing, and decides more."""
    model = rk.models.Rolling(0.2)
    usual = [engine_of(None, model, motion) for motion in (rk.example_record(), SINE)]
    assert [engine.rtol for engine in usual] == [1e-10, 1e-8]
    assert engine_of(None, rk.Housner(), SINE) == rk.Series() and engine_of(usual[1], model, SINE) is usual[1]


@pytest.mark.slow
def test_long_rocking_is_decided():
    """Check long rocking under the built-in record: of 40 blocks at most one is too close to call.

    Verdicts and peaks of the others agree with Newton's law by Runge-Kutta steps, peaks within their stated errors.
    """
    random, record, count = np.random.default_rng(1), rk.example_record(), 40
    alpha, scale, p = random.uniform(0.12, 0.3, count), random.uniform(0.6, 1.6, count), random.uniform(1.5, 4.0, count)
    one = lambda a, p, s: rk.outcome(rk.Block(a, p), s * record, rk.models.Rolling(0.2))
    found = jax.vmap(one)(alpha, p, scale)
    good = np.flatnonzero(np.asarray(found.status == rk.Status.successful))
    assert good.size >= count - 1 and np.asarray(found.impact_count)[good].max() > 500
    for k in good:
        block = rolling.Rolling(alpha[k], p[k], 0.2, 1 - 1.5 * np.sin(alpha[k]) ** 2)
        judge = rolling.respond(block, (scale[k] * np.asarray(record.samples)).tolist(), float(record.dt))
        assert bool(found.overturned[k]) == judge.overturned
        if not judge.overturned:
            assert abs(float(found.max_rotation[k]) - judge.peak) < 3 * float(found.error[k]) + 1e-10


@pytest.mark.slow
def test_sides_of_their_own():
    """Different edges, slenderness and size on either side."""
    block = rk.blocks.AsymmetricBlock(0.2, 0.3, 2.5, 0.7, restitution=(0.9, 0.85))
    model = rk.models.Rolling(0.4, 0.1)
    wheels = [
        Wheel(0.2, 2.5, 0.7, 0.4, 0.9),
        Wheel(0.3, float(block.p2), float(block.inertia_ratio2), 0.1, 0.85),
    ]
    response = rk.simulate(block, SINE, model, initial=(0.05, 0.2), duration=0.9, **EXACT)
    times = np.linspace(0.0, 0.9, 60)[:-1]
    found, _ = by_newton(wheels, lambda t: 0.35 * np.sin(2 * np.pi * t / 0.9), DIPS["level"], (0.05, 0.2), times, 0.9)
    assert (found[0] < -0.01).any() and (found[0] > 0.01).any()
    np.testing.assert_allclose(response(times), found[:2], atol=2e-8)


@pytest.mark.slow
def test_it_may_fall_to_the_side_from_which_it_came():
    """Over a still ground, to the stronger side and back: with sharp edges as Housner's block."""
    block = rk.blocks.AsymmetricBlock(0.5, 0.2, 2.0, restitution=(0.95, 0.95))
    scene = block, rk.RectangularPulse(0.0, 0.01)
    for velocity, lost in ((0.83, True), (-0.3, False)):
        usual = rk.outcome(*scene, initial=(-0.02, velocity))
        found = rk.outcome(*scene, rk.models.Rolling(0.0), initial=(-0.02, velocity), **EXACT)
        assert bool(found.overturned) == bool(usual.overturned) == lost
        np.testing.assert_allclose(found.margin, usual.margin, rtol=1e-7)


@pytest.mark.slow
def test_a_damper_on_two_sides():
    """A moment that depends on the velocity is told in the unit of time of its own side."""
    block = rk.blocks.AsymmetricBlock(0.2, 0.3, 2.5, 0.7, 1.6, restitution=(0.9, 0.8))
    model = rk.models.Equation(
        lambda x, b: jnp.sin(b.alpha - x), lambda x, b: jnp.cos(b.alpha - x), lambda x, v, b: 0.5 * v
    )
    response = rk.simulate(block, rk.RectangularPulse(0.0, 0.1), model, initial=(-0.2, 0.0), duration=0.5, **EXACT)
    p2 = float(block.p2)
    arc = solve_ivp(lambda t, y: [y[1], -(p2**2) * np.sin(0.3 - y[0]) - 0.5 * p2 * y[1]], (0, 0.5), [0.2, 0.0],
                    rtol=1e-11, atol=1e-13)  # fmt: skip
    assert abs(p2 / 2.5 - 1) > 0.1 and arc.y[0, -1] > 0
    np.testing.assert_allclose(-response.rotation[-1], arc.y[0, -1], rtol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("above", [False, True])
@pytest.mark.parametrize("edge", [0.5, rk.blocks.Edge([0.6, 0.2, 0.0], [0.0, 0.15, 0.3])], ids=["circle", "profile"])
def test_what_topples_it_by_energy(edge, above):
    """Check toppling by the height gained up to the balance: slightly less speed returns, slightly more does not."""
    alpha, p, model = 0.2, 2.0, rk.models.Rolling(edge)
    known = edge if isinstance(edge, rk.blocks.Edge) else rk.blocks.Edge(edge)
    arm = lambda x: np.sin(alpha - x) + quad(lambda y: np.cos(x - y) * float(known.at(y)), 0, x, points=(0.15, 0.3))[0]
    grid = np.linspace(0, 1.2, 241)
    balance = grid[np.argmax([arm(x) <= 0 for x in grid])]
    low, high = balance - 0.005, balance
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if arm(middle) > 0 else (low, middle)
    rise = quad(arm, 0, low, points=(0.15, 0.3), limit=200, epsabs=1e-13)[0]
    speed = p * np.sqrt(2 * rise) * (1 + (1e-7 if above else -1e-7))
    found = rk.outcome(rk.Block(alpha, p), rk.RectangularPulse(0.0, 0.01), model, initial=(0.0, speed), **EXACT)
    assert low > alpha + 0.02
    assert bool(found.overturned) == above
    assert abs(float(found.margin)) < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("radius", [0.0, 0.5])
def test_energy_on_the_way(radius):
    """Check the energy of a rolling body in motion; a sharp edge gives Housner's block."""
    block, model = rk.Block(0.25, 2.0), rk.models.Rolling(radius)
    response = rk.simulate(block, rk.RectangularPulse(0.0, 0.01), model, initial=(0.2, 0.0), duration=1.5, **EXACT)
    x, v = np.abs(np.asarray(response.rotation)), np.asarray(response.velocity) / 2.0
    centre = np.array([-np.sin(0.25), np.cos(0.25) - radius])
    height = radius - centre[0] * np.sin(x) + centre[1] * np.cos(x)
    reach = -centre[0] * np.cos(x) - centre[1] * np.sin(x)
    energy = height + v**2 / 2 * (1 + 0.75 * (height**2 + reach**2 - 1))
    parts = np.searchsorted(np.asarray(response.impact_times), np.asarray(response.time))
    assert parts.max() >= 1
    for part in range(parts.max()):
        np.testing.assert_allclose(energy[parts == part], energy[parts == part][0], atol=1e-10)
    if radius == 0:
        plain = rk.simulate(block, rk.RectangularPulse(0.0, 0.01), initial=(0.2, 0.0), duration=1.5)
        np.testing.assert_allclose(response.rotation, plain.rotation, atol=1e-9)


@pytest.mark.slow
def test_a_rounder_edge_helps():
    """Slopes by the radius, in an outcome and by differences; a rounder block balances later, and rocks less."""
    peak = lambda radius: rk.outcome(rk.Block(0.25, 2.5), SINE, rk.models.Rolling(radius), **EXACT).max_rotation
    value, slope = jax.jit(jax.value_and_grad(peak))(jnp.asarray(0.3))
    ends = [float(jax.jit(peak)(jnp.asarray(0.3 + sign * 1e-4))) for sign in (1, -1)]
    assert 0 < float(value) < 0.25
    assert float(slope) == pytest.approx((ends[0] - ends[1]) / 2e-4, rel=1e-5)
    assert float(slope) < 0


@pytest.mark.parametrize("opening", [0.0, 0.1, 0.25, 0.6])
@pytest.mark.parametrize(
    "edge, radius",
    [
        (rk.blocks.Edge(0.4), lambda y: 0.4),
        (rk.blocks.Edge([0.5, 0.1, 0.3], [0.05, 0.2, 0.4]), lambda y: np.interp(y, [0.05, 0.2, 0.4], [0.5, 0.1, 0.3])),
    ],
    ids=["circle", "profile"],
)
def test_what_an_edge_adds(edge, radius, opening):
    """The integrals that its docstring names."""
    for told, weight in ((edge.rise, np.sin), (edge.run, np.cos)):
        known = quad(lambda y, f=weight: f(opening - y) * radius(y), 0, opening, points=(0.05, 0.2, 0.4))[0]
        assert float(told(opening)) == pytest.approx(known, abs=1e-12)
    assert float(edge.at(opening)) == pytest.approx(radius(opening), abs=1e-14)


def piecewise(weight, radius, angle, opening):
    """The integral of weight(y) times radii on straight lines between angles, in 30 digits."""
    knots = [mp.mpf(0), *(mp.mpf(a) for a in angle if 0 < a < opening), mp.mpf(opening)]

    def at(y):
        k = int(np.clip(np.searchsorted(angle, float(y), side="right") - 1, 0, len(angle) - 2))
        share = (min(max(y, angle[0]), angle[-1]) - mp.mpf(angle[k])) / (mp.mpf(angle[k + 1]) - mp.mpf(angle[k]))
        return radius[k] + share * (mp.mpf(radius[k + 1]) - mp.mpf(radius[k]))

    return sum(mp.quad(lambda y: weight(y) * at(y), ends) for ends in zip(knots, knots[1:]))


@pytest.mark.parametrize("count", [2, 5, 30])
@pytest.mark.parametrize("first", [0.0, 0.05])
def test_an_edge_of_many_angles_is_exact(count, first):
    """Check an edge of many angles against piecewise integrals: from tiny openings to a lying block, to rounding."""
    random = np.random.default_rng(count)
    angle = first + np.concatenate([[0.0], np.cumsum(random.uniform(0.002, 2.4 / count, count - 1))])
    radius = random.uniform(0.0, 0.8, count)
    edge, openings = rk.blocks.Edge(radius, angle), np.array([1e-9, 1e-3, angle[1], 0.3, 0.9, 1.57])
    with mp.workdps(30):
        for told, weight in ((edge.rise, mp.sin), (edge.run, mp.cos), (edge.length, lambda x: mp.mpf(1))):
            known = [float(piecewise(lambda y, f=weight, x=x: f(x - y), radius, angle, x)) for x in openings]
            np.testing.assert_allclose(told(openings), known, rtol=2e-15)
    np.testing.assert_allclose(edge.at(openings), np.interp(openings, angle, radius), rtol=1e-14)


def test_slopes_by_the_numbers_of_an_edge():
    """By radii, by angles and by the opening, forward and in reverse; the second of a rise is its equation."""
    radius, angle = jnp.array([0.5, 0.1, 0.3, 0.2]), jnp.array([0.05, 0.2, 0.4, 0.9])

    def told(radius, angle, opening):
        edge = rk.blocks.Edge(radius, angle)
        return jnp.stack([edge.rise(opening), edge.run(opening), edge.length(opening)])

    @jax.jit
    def all_told(*at):
        both = [f(told, (0, 1, 2))(*at) for f in (jax.jacfwd, jax.jacrev)]
        bend = jax.grad(jax.grad(lambda x: rk.blocks.Edge(*at[:2]).rise(x)))(at[2])
        ends = []
        for k, of in enumerate(at):
            steps = 1e-5 * jnp.eye(of.size).reshape(of.size, *of.shape)
            moved = [
                jax.vmap(lambda d, k=k: told(*(x + d if i == k else x for i, x in enumerate(at))))(s * steps)
                for s in (1, -1)
            ]
            ends.append(((moved[0] - moved[1]) / 2e-5).T.reshape(3, *of.shape))
        return *both, ends, bend

    for opening in (0.03, 0.3, 1.2):
        forward, back, differences, bend = all_told(radius, angle, opening)
        for one, other, expected in zip(forward, back, differences, strict=True):
            np.testing.assert_allclose(one, other, atol=1e-15)
            np.testing.assert_allclose(one, expected, atol=2e-9)
        edge = rk.blocks.Edge(radius, angle)
        np.testing.assert_allclose(bend, edge.at(opening) - edge.rise(opening), rtol=1e-14)


@pytest.mark.slow
def test_slopes_of_an_outcome_by_a_radius_of_many():
    """Compare slopes by radii of a block with different edges with differences."""
    angle, block = np.linspace(0.0, 0.5, 10), rk.blocks.AsymmetricBlock(0.25, 0.3, 2.5)

    @jax.jit
    @jax.value_and_grad
    def peak(scale):
        edges = (rk.blocks.Edge(scale * 0.3 * np.cos(k * angle), angle) for k in (1, 2))
        return rk.outcome(block, SINE, rk.models.Rolling(*edges), **EXACT).max_rotation

    (value, slope), (above, _), (below, _) = map(peak, (1.0, 1.0005, 0.9995))
    assert 0.005 < float(value) < 0.2
    assert float(slope) == pytest.approx(float(above - below) / 1e-3, rel=1e-5)


KNOWN = json.loads((Path(rolling.__file__).parent / "rolling_lists.json").read_text())["scenes"]
PULSES = {"sine": rk.SinePulse, "cosine": rk.CosinePulse, "ricker symmetric": rk.RickerPulse}


def scene_of(known):
    """Return a function from the numbers of a reference, in its order, to block, motion and model; and these
    numbers."""
    first = known["block"] + known["motion"]
    end = len(first) + len(known["radius"])

    def made(numbers):
        alpha, p, restitution, ratio, amplitude, length = numbers[: len(first)]
        edge = rk.blocks.Edge(numbers[len(first) : end], numbers[end:]) if known["angle"] else numbers[len(first)]
        motion = PULSES[known["kind"]](amplitude, length)
        return rk.Block(alpha, p, restitution), motion, rk.models.Rolling(edge, inertia_ratio=ratio)

    return made, np.array(first + known["radius"] + known["angle"])


def agrees(known, names, found, slopes, within, slopes_within):
    """Compare values, and slopes by all numbers but an angle of zero.

    Slopes are relative to themselves, or to the value over the number.
    """
    numbers = scene_of(known)[1]
    moving = np.flatnonzero(numbers)
    for name, value, row in zip(names, found, slopes, strict=True):
        exact, gradient = float(known[name]["value"]), np.array(known[name]["gradient"], float)[moving]
        near = within / 100 if name == "margin" else 0  # a margin near zero has the digits of 1
        assert float(value) == pytest.approx(exact, rel=within, abs=near), name
        scale = np.maximum(np.abs(gradient), np.abs(exact / numbers[moving]) / 100)
        np.testing.assert_allclose((np.asarray(row)[moving] - gradient) / scale, 0, atol=slopes_within, err_msg=name)


@pytest.mark.parametrize("index", [8, *(pytest.param(k, marks=pytest.mark.slow) for k in range(len(KNOWN)) if k != 8)])
def test_slopes_on_lists_beside_more_digits(index):
    """Peak, its time and margin, by block, pulse, and every radius and angle of the edge, agree with 40 digits."""
    known, names = KNOWN[index], ("max_rotation", "time_of_max", "margin")
    made, numbers = scene_of(known)

    def told(numbers):
        found = rk.outcome(*made(numbers), **EXACT)
        told = jnp.stack([getattr(found, name) for name in names])
        return told, (told, found.status)

    slopes, (found, status) = jax.jit(jax.jacfwd(told, has_aux=True))(numbers)
    assert bool(status == rk.Status.successful)
    agrees(known, names, found, slopes, 1e-9, 3e-8)


@pytest.mark.slow
@pytest.mark.parametrize("index", [1, 6, 17])
def test_histories_on_lists_beside_more_digits(index):
    """A rotation before the peak, and the last impact, agree with 40 digits."""
    known, names = KNOWN[index], ("rotation", "last_impact")
    made, numbers = scene_of(known)

    def told(numbers):
        response = rk.simulate(*made(numbers), duration=known["at"], **EXACT)
        told = jnp.stack([response.rotation[-1], response.impact_times[known["impacts"] - 1]])
        return told, (told, response.impact_count)

    slopes, (found, count) = jax.jacfwd(told, has_aux=True)(numbers)
    assert int(count) == known["impacts"]
    agrees(known, names, found, slopes, 1e-9, 1e-8)


def test_slopes_do_not_depend_on_the_tolerance():
    """Steps end at angles of the list: a step across one leaves slopes 3e-4 off. Lanes give the same."""
    pulse, edge = (
        rk.MavroeidisPapageorgiouPulse(0.6, 0.9, 6.0),
        rk.blocks.Edge([0.795, 0.335, 0.732], [0, 0.051, 0.163]),
    )
    peak = lambda alpha: rk.outcome(rk.Block(alpha, 2.77), pulse, rk.models.Rolling(edge)).max_rotation
    for slope in (jax.jacfwd(peak)(0.3442), *jax.vmap(jax.grad(peak))(jnp.array([0.3442, 0.3442]))):
        assert float(slope) == pytest.approx(-6.1191421, rel=3e-7)


def test_a_free_block_passes_its_balance_on_a_list():
    """The acceleration is zero at the balance, and angles of the list follow soon after: all 200 blocks are
    computed."""
    random, angle = np.random.default_rng(1), np.linspace(0.0, 0.5, 12)
    alpha, scale, p = random.uniform(0.12, 0.3, 200), random.uniform(0.6, 1.6, 200), random.uniform(1.5, 4.0, 200)
    model = rk.models.Rolling(rk.blocks.Edge(0.3 + 0.15 * np.cos(7 * angle), angle))
    pulse = lambda scale: rk.SinePulse(0.4 * scale, 0.9) + rk.SinePulse(0.3, 0.5)
    found = jax.vmap(lambda a, p, s: rk.outcome(rk.Block(a, p), pulse(s), model))(alpha, p, scale)
    assert bool((found.status == rk.Status.successful).all())
    assert int(found.overturned.sum()) == 168


trimesh = pytest.importorskip("trimesh")


def prism(outline, depth=0.6):
    """A convex outline in the plane of the first and the third axis, drawn out along the second."""
    ends = [np.column_stack([outline[:, 0], np.full(len(outline), y), outline[:, 1]]) for y in (0.0, depth)]
    return trimesh.convex.convex_hull(np.concatenate(ends))


def round_edged(radius=0.25, flat=0.2, height=1.5, sides=60):
    """A rectangle whose lower edges are quarter circles."""
    turns = np.linspace(0, np.pi / 2, sides)
    right = np.stack([flat + radius * np.sin(turns), radius * (1 - np.cos(turns))], axis=1)
    top = np.array([[flat + radius, height], [-flat - radius, height]])
    return np.concatenate([right, top, (right * [-1, 1])[::-1]])


def test_a_mesh_of_a_round_edge():
    """Its edge is found again, with its radius, its balance and its arms."""
    rock = rk.blocks.Rock.from_mesh(prism(round_edged()), tolerance=1e-6)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        edges = rock.edges(0.0)
    section = rock.section(0.0)
    R = np.hypot(0.2, rock.centre[2])
    angles = np.linspace(0, 0.25, 9)
    for edge, rolls in zip(edges, section.rolls):
        assert rolls
        np.testing.assert_allclose(R * edge.run(angles), 0.25 * np.sin(angles), atol=0.002)
    model = rk.models.Rolling(*edges)
    with pytest.warns(UserWarning, match="The base is rounded"):
        block = rk.blocks.AsymmetricBlock.from_mesh(rock, 0.0)
    balance = np.arctan2(0.2, rock.centre[2] - 0.25)
    for moments in model.moments_of_sides(block):
        assert float(moments.saddle) == pytest.approx(balance, rel=3e-3)
    opening = np.linspace(0, 0.3, 7)
    known = 0.2 * np.cos(opening) - (rock.centre[2] - 0.25) * np.sin(opening)
    np.testing.assert_allclose(rock.arms(0.0, opening), [known, known], atol=0.25 * np.pi / 2 / 59)
    axis = rk.plot.righting(rock, 0.0)
    assert [line.get_label() for line in axis.lines[:4]] == [
        "narrow base", "wide base", "the rock, rolling", "smooth edge"
    ]  # fmt: skip
    plt.close("all")


@pytest.mark.slow
def test_a_rock_that_rolls_topples_between_its_bounds():
    """Least sine pulse that topples it, of the narrow block, of the rolling one, of the wide one."""
    rock = rk.blocks.Rock.from_mesh(prism(round_edged()), tolerance=1e-6)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        narrow, wide = (rk.blocks.AsymmetricBlock.from_mesh(rock, 0.0, base=base) for base in ("narrow", "wide"))
    amplitudes = np.linspace(0.15, 1.2, 43)

    def least(block, model):
        fell = jax.vmap(lambda a: rk.outcome(block, rk.SinePulse(a, 1.0), model).overturned)(amplitudes)
        return amplitudes[np.argmax(fell)]

    rolls = least(narrow, rk.models.Rolling(*rock.edges(0.0)))
    assert least(narrow, rk.Housner()) < rolls < least(wide, rk.Housner())


def test_a_base_of_faces_warns():
    outline = np.array([[-0.2, 0.0], [0.2, 0.0], [0.5, 0.03], [0.5, 1.6], [-0.5, 1.6], [-0.5, 0.03]])
    rock = rk.blocks.Rock.from_mesh(prism(outline), tolerance=1e-6)
    with pytest.warns(UserWarning, match="The base is made of faces"):
        rock.edges(0.0)


def test_rocks_that_a_mesh_allows():
    """Known tolerance: the block itself. Open: between its ends. Noise: scatters, and always stands."""
    rock = rk.blocks.Rock.from_mesh(prism(round_edged()), tolerance=0.005)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        same = rk.blocks.AsymmetricBlock.from_mesh(rock, 0.0)
    known = rk.blocks.draw_rocks(rock, 0.0, 3, tolerance=(0.005, 0.005))
    np.testing.assert_allclose(known.alpha1, same.alpha1, rtol=1e-12)
    np.testing.assert_allclose(known.p2, same.p2, rtol=1e-12)
    ends = [rk.blocks.draw_rocks(rock, 0.0, 1, tolerance=(each, each)).alpha1[0] for each in (0.002, 0.02)]
    drawn = rk.blocks.draw_rocks(rock, 0.0, 200, tolerance=(0.002, 0.02))
    assert ends[0] <= drawn.alpha1.min() < drawn.alpha1.max() <= ends[1] and drawn.alpha1.std() > 0.01
    noisy = rk.blocks.draw_rocks(rock, 0.0, 200, tolerance=(0.005, 0.005), resolution=0.002, seed=1)
    assert float(noisy.alpha1.std()) > 1e-3 and (np.asarray(noisy.alpha1) > 0).all()
    wild = rk.blocks.draw_rocks(rock, 0.0, 50, tolerance=(0.001, 0.001), resolution=0.03)  # many draws do not stand
    assert wild.alpha1.shape == (50,) and (np.asarray(wild.alpha2) > 0).all()
    with pytest.raises(ValueError, match="`tolerance` must be a pair of which the second is not smaller"):
        rk.blocks.draw_rocks(rock, 0.0, 3, tolerance=(0.02, 0.005))


def test_the_plane_that_rocks_share():
    def turned(azimuth):
        box = trimesh.creation.box((0.4, 0.8, 2.0))
        box.apply_transform(trimesh.transformations.rotation_matrix(azimuth, [0, 0, 1]))
        return rk.blocks.Rock.from_mesh(box)

    shared = rk.blocks.shared_plane([turned(0.0), turned(0.06), turned(1.2)], planes=90)
    assert shared.rocks.tolist() == [True, True, False]
    assert 0 <= shared.azimuth <= 0.07
    np.testing.assert_allclose(shared.weakest, [0.0, 0.06, 1.2], atol=np.pi / 90)
    assert shared.slenderness.min() == pytest.approx(np.arctan2(0.4, 2.0), rel=1e-3)


def test_forces_by_its_own_inertia_ratio():
    """Check forces: a symmetric block that rolls uses the inertia ratio of its model, whatever its restitution uses."""
    block = rk.Block(0.2, 2.0, rk.restitution.Housner(0.7))
    scene = jax.jit(Scene.of)(block, SINE, rk.models.Rolling(0.1, inertia_ratio=0.6))
    assert [float(_ratio_of(scene, block, given)) for given in (None, 0.6)] == [0.6, 0.6]
    with pytest.raises(ValueError, match="Argument `inertia_ratio` must be 0.6 as that of the `Rolling`, but is 0.75"):
        _ratio_of(scene, block, 0.75)


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: rk.models.Rolling(-0.1), "`radius` must be 0 or more"),
        (lambda: rk.models.Rolling(0.1, inertia_ratio=1.5), r"`inertia_ratio` must be in \(0, 1\]"),
        (lambda: rk.blocks.Edge([0.1, 0.2]), "`radius` must be one number without `angle`"),
        (lambda: rk.blocks.Edge([0.1, 0.2], [0.0]), "`radius` and `angle` must be lists of one length"),
        (lambda: rk.blocks.Edge([0.1, 0.2], [0.3, 0.1]), "`angle` must grow"),
        (lambda: rk.outcome(rk.Block(0.2, 2.0), SINE, rk.models.Rolling(0.1, 0.2)), "`other` must be None"),
        (
            lambda: rk.outcome(rk.Block(0.2, 2.0), SINE, rk.models.Rolling(0.1), engine=rk.Series()),
            r"must be a Diffrax\(...\)",
        ),
        (lambda: rk.blocks.shared_plane([]), "`rocks` must hold at least one"),
    ],
)
def test_what_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
