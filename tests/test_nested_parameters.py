"""Parameters of laws and motions of the user's own, wherever they are: dictionaries, lists, tuples, modules."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock._arguments.parameters import in_real_numbers
from jaxrock.studies.parameters import named, rebuilt

FIRM, SPEED = 0.9, 5.0
PULSE = rk.SinePulse(0.3, 1.0)


class Inner(eqx.Module):
    firm: jax.Array


class Law(rk.restitution.AbstractRestitution):
    """Brittle: the ratio falls with the speed of an impact."""

    held: object
    speed: object
    firm: object = eqx.field(static=True)  # the parameter in `held`

    def ratio(self, corners, speed):
        return self.firm(self.held) / (1 + speed / self.speed)


def law(held, firm, speed=SPEED):
    return Law(held, jnp.asarray(speed), firm)


CASES = {
    "a dictionary": ({"firm": FIRM}, lambda held: held["firm"], "firm"),
    "in one another": ({"a": {"b": (FIRM, None)}, "n": None}, lambda held: held["a"]["b"][0], "a.b.0"),
    "a list of modules": ([Inner(jnp.asarray(FIRM))], lambda held: held[0].firm, "0.firm"),
    "beside an array and a flag": (
        {"firm": jnp.asarray(FIRM), "on": True, "table": jnp.arange(3.0)}, lambda held: held["firm"], "firm"
    ),
}  # fmt: skip


@pytest.mark.parametrize("held, firm, name", CASES.values(), ids=CASES)
def test_a_number_is_named_and_replaced_wherever_it_is(held, firm, name):
    """A flag and an array beside it are no parameters, and stay."""
    block = rk.Block(0.2, 2.0, restitution=law(held, firm))
    known = named(*in_real_numbers(block, PULSE))
    assert list(known) == ["alpha", "p", f"restitution.held.{name}", "restitution.speed", "amplitude", "period"]
    values = known | {f"restitution.held.{name}": jnp.asarray(0.7)}
    changed, motion = rebuilt(block, PULSE, values, known["amplitude"])
    assert firm(changed.law.held) == 0.7 and changed.law.speed == SPEED and eqx.tree_equal(motion, PULSE)
    assert eqx.tree_equal(jax.tree.leaves(changed.law.held)[1:], jax.tree.leaves(held)[1:])


def test_a_sensitivity_names_a_number_in_a_dictionary():
    """Differences of outcomes are the judge."""

    def block(number):
        return rk.Block(0.2, 2.0, restitution=law({"a": {"b": (number, None)}}, lambda held: held["a"]["b"][0]))

    found = rk.studies.sensitivity(block(FIRM), PULSE)
    assert found.names[2] == "restitution.held.a.b.0"
    margins = [float(rk.outcome(block(FIRM + off), PULSE).margin) for off in (-1e-4, 1e-4)]
    np.testing.assert_allclose(found.margin.derivative[2], np.diff(margins)[0] / 2e-4, rtol=1e-6)


@pytest.mark.slow
def test_critical_amplitudes_of_a_law_with_a_dictionary():
    """Differences judge derivatives by a number of the law; a whole number is a parameter too."""

    def found(number):
        block = rk.Block(0.2, 2.0, restitution=law({"firm": number, "count": 1}, lambda held: held["firm"]))
        return rk.critical_amplitudes(block, PULSE, max_ends=1, progress=False)

    both = found(FIRM)
    assert both.names == (
        "alpha",
        "p",
        "restitution.held.count",
        "restitution.held.firm",
        "restitution.speed",
        "period",
    )
    by_differences = (found(FIRM + 1e-5).value[0] - found(FIRM - 1e-5).value[0]) / 2e-5
    np.testing.assert_allclose(both.derivative[0, 3], by_differences, rtol=1e-6)
    assert both.derivative[0, 2] == 0


@pytest.mark.slow
def test_a_fit_finds_a_number_in_a_dictionary():
    true, start = ({"e": jnp.asarray(e), "more": [jnp.asarray(1.0)]} for e in (0.9, 0.85))
    time = np.linspace(0.0, 4.0, 200)
    seen = rk.simulate(rk.Block(0.2, 2.0, restitution=law(true, lambda h: h["e"])), PULSE, duration=4.0)(time)[0]
    guess = rk.Block(0.2, 2.0, restitution=law(start, lambda h: h["e"]))
    found = rk.inverse.fit_history(time, seen, guess, PULSE, parameters=["restitution.held.e"])
    np.testing.assert_allclose(found.values, [0.9], rtol=1e-8)


class Held(rk.motions.AbstractMotion):
    """A sine pulse whose numbers are in a dictionary."""

    held: dict

    @property
    def pulse(self):
        return rk.SinePulse(self.held["size"], self.held["times"][0])

    knots = property(lambda self: self.pulse.knots)
    scales = property(lambda self: self.pulse.scales)
    bounds = property(lambda self: self.pulse.bounds)

    def series(self, piece, local, unit, order):
        return self.pulse.series(piece, local, unit, order)


def test_a_motion_with_a_dictionary():
    block, motion = rk.Block(0.2, 2.0), Held({"size": jnp.asarray(0.3), "times": [jnp.asarray(1.0)]})
    known = named(block, motion)
    assert list(known) == ["alpha", "p", "restitution", "held.size", "held.times.0", "amplitude"]
    values = known | {"held.times.0": jnp.asarray(2.0), "amplitude": 2 * known["amplitude"]}
    _, changed = rebuilt(block, motion, values, known["amplitude"])
    np.testing.assert_allclose(changed.acceleration(0.5), 2 * 0.3 * np.sin(np.pi / 2), rtol=1e-12)


def test_two_parameters_of_one_name_are_refused():
    held = {"a.b": jnp.asarray(FIRM), "a": {"b": jnp.asarray(1.0)}}
    block = rk.Block(0.2, 2.0, restitution=law(held, lambda held: held["a.b"]))
    with pytest.raises(ValueError, match="has 2 parameters 'restitution.held.a.b': they need names of their own"):
        rk.studies.sensitivity(block, PULSE)
