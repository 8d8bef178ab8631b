"""Parameters of a model by name: in sensitivities, critical amplitudes, fits and calibrations; models of any fields.

Judges: central differences of outcomes of models that are made anew; the other engine.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.motions.suite import Suite
from jaxrock.studies.parameters import declarations, named, rebuilt_model
from jaxrock.studies.suite_scenes import scenes_of_suite, stacked

BLOCK, PULSE = rk.Block(0.2, 2.0), rk.SinePulse(0.25, 1.0)
UNEQUAL = rk.blocks.AsymmetricBlock(0.2, 0.25, 2.0, 0.75, restitution=(0.9, 0.9))
EXACT = rk.Diffrax(rtol=1e-11, atol=1e-13)
Terms, Coefficients, Equation = rk.models.Terms, rk.models.Coefficients, rk.models.Equation


def weakened(block, strength):
    """Housner's equation with a restoring moment times a number, for the series engine."""
    sine, cosine = jnp.sin(block.alpha), jnp.cos(block.alpha)
    restoring = Terms(sine=-strength * cosine, cosine=strength * sine)
    return Coefficients(restoring, Terms(sine=sine, cosine=cosine))


class Softer(rk.models.AbstractEquation):
    strength: jax.Array = rk.parameter("-", "share")

    def moments(self, block):
        return weakened(block, self.strength)


class Number(eqx.Module):
    value: jax.Array


class Nested(rk.models.AbstractEquation):
    """Numbers in a dictionary, a tuple and a module; a flag, a count and an array are no parameters."""

    held: dict
    more: tuple
    table: jax.Array = eqx.field(default_factory=lambda: jnp.arange(3.0))

    def moments(self, block):
        return weakened(block, self.held["k"] * self.more[0].value + 0.0 * self.table[self.held["count"]])


class Stiff(eqx.Module):
    k: jax.Array = rk.parameter("-", "not_negative")

    def __call__(self, x, block):
        return jnp.sin(block.alpha - x) + self.k * x


class Damper(eqx.Module):
    terms: list

    def __call__(self, x, v, block):
        return self.terms[0] * v + self.terms[1] * v * jnp.abs(v)


def lever(x, block):
    return jnp.cos(block.alpha - x)


class Damped(rk.models.AbstractEquation):
    """Functions that a method makes, of numbers in a dictionary."""

    held: dict

    def moments(self, block):
        return Equation(lambda x, b: jnp.sin(b.alpha - x), lever, lambda x, v, b: self.held["c"] * v).moments(block)

    @property
    def is_series(self):
        return False


class Restrained(rk.models.AbstractEquation):
    """A model of a model and restraints, which says short names."""

    model: rk.models.AbstractEquation
    restraints: tuple

    def moments(self, block):
        return weakened(block, self.model.strength + self.restraints[0].value + self.restraints[1].value)

    def parameter_path(self, path):
        field, *rest = path
        return tuple(rest) if field == "model" else (f"tie{int(rest[0]) + 1}",)


def functions(k, c, d):
    return Equation(Stiff(jnp.asarray(k)), lever, Damper([jnp.asarray(c), jnp.asarray(d)]))


CASES = {  # block, engine, model of numbers, numbers by their names
    "declared": (BLOCK, None, lambda k: Softer(jnp.asarray(k)), {"strength": 0.9}),
    "nested": (
        BLOCK, None, lambda k, v: Nested({"k": k, "on": True, "count": 2}, (Number(jnp.asarray(v)), None)),
        {"held.k": 0.9, "more.0.value": 1.05},
    ),
    "short names": (
        BLOCK, None, lambda k, *ties: Restrained(Softer(jnp.asarray(k)), tuple(map(Number, ties))),
        {"strength": 0.8, "tie1": 0.05, "tie2": 0.06},
    ),
    "modules as functions": (
        BLOCK, EXACT, functions,
        {"restoring.k": 0.1, "dissipation.terms.0": 0.05, "dissipation.terms.1": 0.1},
    ),
    "functions of a method": (UNEQUAL, EXACT, lambda c: Damped({"c": jnp.asarray(c)}), {"held.c": 0.1}),
    "edges": (
        BLOCK, EXACT, lambda r, k: rk.models.Rolling(r, inertia_ratio=k), {"edge.radius": 0.1, "inertia_ratio": 0.7}
    ),
    "two edges": (
        UNEQUAL, EXACT, lambda r, other, k: rk.models.Rolling(r, other, inertia_ratio=k),
        {"edge.radius": 0.1, "other.radius": 0.15, "inertia_ratio": 0.7},
    ),
}  # fmt: skip


SLOW = ("functions of a method", "edges", "two edges")


@pytest.mark.parametrize(
    "block, engine, made, numbers",
    [pytest.param(*case, marks=pytest.mark.slow) if name in SLOW else case for name, case in CASES.items()],
    ids=CASES,
)
def test_derivatives_by_every_number_of_a_model(block, engine, made, numbers):
    """Central differences of outcomes are the judge; the names of block and motion stay in front."""
    pulse = PULSE if block is BLOCK else rk.SinePulse(0.3, 1.0)
    found = rk.studies.sensitivity(block, pulse, made(*numbers.values()), engine=engine)
    own = [f"model.{name}" for name in numbers]
    usual = list(named(block, pulse))
    assert list(found.names) == [*usual, *own, "uplift_strength"]
    np.testing.assert_array_equal(found.values[len(usual) : -1], list(numbers.values()))
    assert found.outcome.impact_count > 0 and bool(found.valid)

    def margins(values):
        model = made(*values)
        result = rk.outcome(block, pulse, model, engine=engine)
        return np.array([result.margin, result.max_rotation])

    step, base = 1e-5, np.array(list(numbers.values()))
    for k, name in enumerate(own):
        move = step * (np.arange(base.size) == k)
        by_differences = (margins(base + move) - margins(base - move)) / (2 * step)
        place = found.names.index(name)
        slopes = found.margin.derivative[place], found.max_rotation.derivative[place]
        np.testing.assert_allclose(slopes, by_differences, rtol=2e-5, atol=1e-8, err_msg=name)


def test_a_model_without_numbers_changes_nothing():
    """Names stay, and the model of a changed scene is the same object."""
    for model in (rk.Housner(), rk.Linear(), rk.models.Spring(), Equation(lambda x, b: jnp.sin(b.alpha - x))):
        assert list(named(BLOCK, PULSE, model)) == ["alpha", "p", "restitution", "amplitude", "period"]
        assert rebuilt_model(model, named(BLOCK, PULSE, model)) is model


def test_ranges_of_a_model_are_those_that_its_class_declares():
    known = declarations(BLOCK, PULSE, rk.models.Rolling(0.1))
    assert known["model.edge.radius"].range.low == 0 and known["model.inertia_ratio"].range.high == 1
    assert declarations(BLOCK, PULSE, functions(0.1, 0.2, 0.3))["model.restoring.k"].range.low == 0


@pytest.mark.slow
def test_critical_amplitudes_have_derivatives_by_numbers_of_a_model():
    """Differences of critical amplitudes are the judge."""

    def found(strength):
        return rk.critical_amplitudes(BLOCK, PULSE, Softer(jnp.asarray(strength)), max_ends=1, progress=False)

    told = found(0.9)
    assert told.names == ("alpha", "p", "restitution", "period", "model.strength")
    by_differences = (found(0.9 + 1e-5).value[0] - found(0.9 - 1e-5).value[0]) / 2e-5
    np.testing.assert_allclose(told.derivative[0, -1], by_differences, rtol=1e-6)


def test_a_fit_finds_numbers_of_block_and_model():
    time = np.linspace(0.0, 3.0, 150)
    seen = rk.simulate(BLOCK, PULSE, Softer(jnp.asarray(0.9)), duration=3.0)(time)[0]
    start = rk.Block(0.21, 2.0), PULSE, Softer(jnp.asarray(0.85))
    found = rk.inverse.fit_history(time, seen, *start, parameters=["alpha", "model.strength"], starts=2)
    np.testing.assert_allclose(found.values, [0.2, 0.9], rtol=1e-7)
    np.testing.assert_allclose(found.model.strength, found["model.strength"], rtol=1e-15)
    with pytest.raises(ValueError, match="must be different names out of .*, model.strength, .* but is .*model.stiff"):
        rk.inverse.fit_history(time, seen, *start, parameters=["model.stiffness"])


@pytest.mark.slow
def test_a_fit_finds_the_radius_of_an_edge():
    """The fitted model is as the user gave it, with another radius."""
    time = np.linspace(0.0, 1.5, 40)
    pulse, names = rk.SinePulse(0.3, 1.0), ["model.edge.radius"]
    seen = rk.simulate(BLOCK, pulse, rk.models.Rolling(0.1), duration=1.5)(time)[0]
    found = rk.inverse.fit_history(time, seen, BLOCK, pulse, rk.models.Rolling(0.08), parameters=names, starts=1)
    np.testing.assert_allclose(found.values, [0.1], rtol=1e-6)
    assert isinstance(found.model, rk.models.Rolling)


def test_scenes_of_a_calibration_have_models_of_their_own():
    """Each cell of a grid has the model of its numbers: single outcomes are the judge."""
    strengths, pulses = np.array([0.8, 0.9, 0.95]), [rk.SinePulse(size, 1.0) for size in (0.25, 0.35)]
    blocks = stacked(rk.Block(np.full(3, 0.2), np.full(3, 2.0)))
    varied = {"model.strength": strengths}
    found = scenes_of_suite(blocks, Suite(pulses), np.ones(1), Softer(jnp.asarray(0.5)), None, False, varied)
    for row, pulse in zip(found.margin, pulses):
        margins = [rk.outcome(BLOCK, pulse, Softer(jnp.asarray(strength))).margin for strength in strengths]
        np.testing.assert_allclose(row.ravel(), margins, rtol=1e-12)


def test_a_calibration_finds_a_number_of_the_model():
    """The share that topples is that of strengths below the critical one of each pulse; the block may be known."""
    pulses = [rk.SinePulse(size, 1.0) for size in np.linspace(0.26, 0.31, 24)]
    strengths = 0.9 * np.exp(0.05 * np.random.default_rng(1).standard_normal(24))
    toppled = [rk.outcome(BLOCK, pulse, Softer(jnp.asarray(x))).overturned for pulse, x in zip(pulses, strengths)]
    unknown, name = rk.inverse.Unknown(0.7, 0.99), "model.strength"
    told = {"scatter": {name: 0.05}, "model": Softer(jnp.asarray(0.8)), "cells": 32, "facing": 1, "progress": False}
    found = rk.inverse.calibrate_block(lambda: BLOCK, pulses, toppled, {name: unknown}, **told)
    assert abs(np.log(found.values[name] / 0.9)) < 3 * found.standard_errors[name] < 0.2
    told["scatter"] = {"alpha": 0.05}
    wrong = {"alpha": rk.inverse.Unknown(0.19, 0.21), "model.force": unknown}
    with pytest.raises(ValueError, match="must name parameters of `model`, which has model.strength, but .*model.for"):
        rk.inverse.calibrate_block(lambda alpha: rk.Block(alpha, 2.0), pulses, toppled, wrong, **told)


class Pulse(rk.motions.AbstractMotion):
    """A pulse whose field has the name of the model's parameters."""

    model: dict

    @property
    def pulse(self):
        return rk.SinePulse(self.model["strength"], 1.0)

    knots = property(lambda self: self.pulse.knots)
    scales = property(lambda self: self.pulse.scales)
    bounds = property(lambda self: self.pulse.bounds)

    def series(self, piece, local, unit, order):
        return self.pulse.series(piece, local, unit, order)


def test_two_parameters_of_one_name_are_refused():
    twice = Nested({"a.b": 1.0, "a": {"b": 1.0}, "k": 0.9, "count": 0}, (Number(jnp.asarray(1.0)),))
    with pytest.raises(ValueError, match="Argument `model` has 2 parameters 'model.held.a.b'"):
        rk.studies.sensitivity(BLOCK, PULSE, twice)
    moving = Pulse({"strength": jnp.asarray(0.3)})
    with pytest.raises(ValueError, match="`motion` has a parameter 'model.strength', as the model has: it needs"):
        rk.studies.sensitivity(BLOCK, moving, Softer(jnp.asarray(0.9)))


def test_a_model_of_many_scenes_is_refused_outside_of_vmap():
    many = Softer(jnp.array([0.9, 0.95]))
    for function in (rk.outcome, rk.simulate, rk.studies.sensitivity, rk.critical_amplitudes):
        with pytest.raises(ValueError, match=r"Argument `model` must hold one scene, but `strength` has shape \(2,\)"):
            function(BLOCK, PULSE, many)
    margins = jax.vmap(lambda model: rk.outcome(BLOCK, PULSE, model).margin)(many)
    np.testing.assert_allclose(margins[0], rk.outcome(BLOCK, PULSE, Softer(jnp.asarray(0.9))).margin, rtol=1e-12)


class DeclaredLaw(rk.restitution.AbstractRestitution):
    held: dict = rk.parameter("-", "share")

    def ratio(self, corners, speed):
        return self.held["e"] / (1 + self.held["more"][0].value * speed)


def test_a_dictionary_may_be_declared():
    """Each of its numbers has the range; what is declared further in has its own."""
    law = DeclaredLaw({"e": jnp.asarray(0.9), "more": (Number(jnp.asarray(0.1)),)})
    block = rk.Block(0.2, 2.0, law)
    assert repr(block) == "Block(alpha=0.2, p=2, law=DeclaredLaw(held={'e': 0.9, 'more': (Number(value=0.1),)}))"
    with pytest.raises(ValueError, match=r"Argument `held.e` must be in \[0, 1\], but is 1.5"):
        DeclaredLaw({"e": 1.5, "more": (Number(jnp.asarray(0.1)),)})
    assert declarations(block, PULSE)["restitution.held.e"].range.high == 1
    usual = rk.outcome(rk.Block(0.2, 2.0, Same()), PULSE)
    np.testing.assert_array_equal(rk.outcome(block, PULSE).margin, usual.margin)


class Same(rk.restitution.AbstractRestitution):
    """The law of `DeclaredLaw` without fields."""

    def ratio(self, corners, speed):
        return 0.9 / (1 + 0.1 * speed)


@pytest.mark.parametrize("block", [BLOCK, pytest.param(UNEQUAL, marks=pytest.mark.slow)], ids=["one", "two sides"])
def test_functions_of_a_method_have_histories(block):
    """On an asymmetric block, too: without damping, Housner's equation in the other engine is the judge."""
    own, usual = (
        rk.simulate(block, PULSE, model, duration=2.0) for model in (Damped({"c": jnp.asarray(0.0)}), rk.Housner())
    )
    np.testing.assert_allclose(own.rotation, usual.rotation, rtol=1e-5, atol=1e-7)
    assert own.summary.impact_count > 0


class Sides(rk.models.AbstractEquation):
    """Housner's moments on side 1, a plastic spring on side 2: terms of different kinds."""

    k: jax.Array
    as_functions: bool = eqx.field(static=True)

    def moments(self, block):
        raise NotImplementedError

    def moments_of_sides(self, block):
        first, second = block.sides
        if self.as_functions:
            return self._functions(first, jnp.asarray(True)), self._functions(second, jnp.asarray(False))
        plastic = Terms(constant=self.k * jnp.sin(second.alpha), sine=-self.k)
        return rk.Housner().moments(first), Coefficients(plastic, Terms(cosine=jnp.cos(second.alpha)))

    def _functions(self, side, is_first):
        def restoring(x, block):
            plastic = self.k * (jnp.sin(block.alpha) - jnp.sin(x))
            return jnp.where(is_first, jnp.sin(block.alpha - x), plastic)

        def arm(x, block):
            return jnp.where(is_first, jnp.cos(block.alpha - x), jnp.cos(block.alpha) * jnp.cos(x))

        return Equation(restoring, arm).moments(side)

    @property
    def is_series(self):
        return not self.as_functions


@pytest.mark.slow
def test_sides_may_have_terms_of_different_kinds():
    """The other engine, whose functions choose between the sides, is the judge; safe and overturned."""
    sizes, k = np.array([0.25, 0.3, 0.32, -0.25, -0.3, -0.5]), jnp.asarray(0.9)

    def found(as_functions):
        engine = EXACT if as_functions else None
        return jax.vmap(lambda a: rk.outcome(UNEQUAL, rk.SinePulse(a, 1.0), Sides(k, as_functions), engine=engine))(
            sizes
        )

    series, diffrax = found(False), found(True)
    np.testing.assert_allclose(series.max_rotation, diffrax.max_rotation, rtol=1e-8)
    np.testing.assert_array_equal(series.impact_count, diffrax.impact_count)
    assert 0 < series.overturned.sum() < sizes.size and (series.status == rk.Status.successful).all()


class Unlike(rk.models.AbstractEquation):
    pair: tuple = eqx.field(static=True)

    def moments(self, block):
        raise NotImplementedError

    def moments_of_sides(self, block):
        return tuple(model.moments(side) for model, side in zip(self.pair, block.sides))

    @property
    def is_series(self):
        return self.pair[1].is_series


def test_sides_without_a_common_form_are_refused():
    straight, other = Equation(lambda x, b: b.alpha - x), Equation(lambda x, b: jnp.sin(b.alpha - x))
    cases = {
        "a straight line on one and a sinusoid on the other": (rk.Linear(), rk.Housner()),
        "two different programs of FunctionMoments": (straight, other),
        "has Coefficients and FunctionMoments": (rk.Housner(), other),
    }
    for message, pair in cases.items():
        with pytest.raises(ValueError, match=f"Argument `model` must have .*of one kind on both sides.*{message}"):
            rk.outcome(UNEQUAL, PULSE, Unlike(pair))


@pytest.mark.parametrize("block", [BLOCK, UNEQUAL], ids=["one", "two sides"])
def test_dissipation_that_jumps_at_an_open_angle_is_told(block):
    """Dry friction beyond an angle, or that grows from zero; steep but continuous friction passes."""

    def with_dissipation(dissipation):
        return rk.outcome(block, PULSE, Equation(lambda x, b: jnp.sin(b.alpha - x), lever, dissipation))

    for jumps in (
        lambda x, v, b: jnp.where(x > 0.08, 0.05 * jnp.sign(v), 0.0),
        lambda x, v, b: x * jnp.sign(v),
        lambda x, v, b: jnp.where(v > 0, 0.1 * jnp.maximum(x - 0.19, 0.0), 0.0),
    ):
        with pytest.raises(ValueError, match="The dissipation must not jump where the velocity changes its sign"):
            with_dissipation(jumps)
    smooth = with_dissipation(lambda x, v, b: jnp.where(v > 0, 0.1, 0.2) * v + 0.01 * v * jnp.abs(v))
    assert smooth.status == rk.Status.successful
