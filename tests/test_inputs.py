"""Bad input raises at once and says what is wrong; so it does under jit. What is allowed is allowed."""

import ctypes
import functools
import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh, NamedSharding, PartitionSpec

import jaxrock as rk
from jaxrock.compiler import xla_ffi
from jaxrock.compiler.primitive import error_if
from jaxrock.compiler.xla_ffi import CHECK
from jaxrock.engines.trajectory import Trajectory

NAN, INF, HALF_PI = np.nan, np.inf, np.pi / 2
BLOCK = rk.Block(0.2, 1.0)
SINE = rk.SinePulse(0.5, 1.0)
TWO = np.array([0.2, 0.3])

SLENDERNESS = "be in (0, pi/2)"
POSITIVE = "be positive and finite"
FINITE = "be finite"
SHARE = "be in [0, 1]"
HOUSNER = (
    "be at most 0.955, of a width of 1.41 heights, when `restitution` is None or Housner's: Housner's value is "
    "negative above"
)
LIST = "be a list of at least one value"
SCENE = "hold one scene"
ONE_SAMPLE = "hold at least one sample"
HISTORY = "be in the history [0, duration]"
ROTATION = "be a rotation in (-pi/2, pi/2)"


# Where an engine must run, the one that compiles fastest.
QUICK = {"model": rk.Linear(), "engine": rk.Series(order=4)}
FOLLOWED = rk.Series(order=4, tolerance=1e-6)  # to the end, in few steps


@functools.cache
def history():
    """A history of 4 s."""
    return rk.simulate(BLOCK, SINE, duration=4.0, samples=5, engine=FOLLOWED)


@functools.cache
def histories():
    """Two histories as jax.vmap returns them, of which neither is asked for under it."""
    return jax.device_put(jax.tree.map(lambda x: np.stack([x, x]), history()))


# What is called, and the argument, what is allowed and the value in the message.
BAD = {
    # Block
    "alpha 0": (lambda: rk.Block(0.0, 1.0), "alpha", SLENDERNESS, "0.0"),
    "alpha negative": (lambda: rk.Block(-0.1, 1.0), "alpha", SLENDERNESS, "-0.1"),
    "alpha pi/2": (lambda: rk.Block(HALF_PI, 1.0, 0.5), "alpha", SLENDERNESS, "1.5707963267948966"),
    "alpha NaN": (lambda: rk.Block(NAN, 1.0), "alpha", SLENDERNESS, "nan"),
    "alpha inf": (lambda: rk.Block(INF, 1.0), "alpha", SLENDERNESS, "inf"),
    "one alpha of many": (lambda: rk.Block(np.array([0.1, 2.5, 0.2]), 1.0), "alpha", SLENDERNESS, "2.5"),
    "stocky block": (lambda: rk.Block(1.0, 1.0), "alpha", HOUSNER, "1.0"),
    "stocky sizes": (lambda: rk.Block.from_dimensions(1.5, 1.0), "alpha", HOUSNER, "0.98279372324732"),
    "p 0": (lambda: rk.Block(0.2, 0.0), "p", POSITIVE, "0.0"),
    "p negative": (lambda: rk.Block(0.2, -2.0), "p", POSITIVE, "-2.0"),
    "p integer": (lambda: rk.Block(0.2, -2), "p", POSITIVE, "-2.0"),
    "p NaN": (lambda: rk.Block(0.2, NAN), "p", POSITIVE, "nan"),
    "p inf": (lambda: rk.Block(0.2, INF), "p", POSITIVE, "inf"),
    "restitution above 1": (lambda: rk.Block(0.2, 1.0, 1.001), "restitution", SHARE, "1.001"),
    "restitution negative": (lambda: rk.Block(0.2, 1.0, -0.1), "restitution", SHARE, "-0.1"),
    "restitution NaN": (lambda: rk.Block(0.2, 1.0, NAN), "restitution", SHARE, "nan"),
    "width 0": (lambda: rk.Block.from_dimensions(0.0, 3.0), "width", POSITIVE, "0.0"),
    "width negative": (lambda: rk.Block.from_dimensions(-0.6, 3.0), "width", POSITIVE, "-0.6"),
    "width NaN": (lambda: rk.Block.from_dimensions(NAN, 3.0), "width", POSITIVE, "nan"),
    "width inf": (lambda: rk.Block.from_dimensions(INF, 3.0), "width", POSITIVE, "inf"),
    "height 0": (lambda: rk.Block.from_dimensions(0.6, 0.0), "height", POSITIVE, "0.0"),
    "height negative": (lambda: rk.Block.from_dimensions(0.6, -3.0), "height", POSITIVE, "-3.0"),
    "gravity 0": (lambda: rk.Block.from_dimensions(0.6, 3.0, gravity=0.0), "gravity", POSITIVE, "0.0"),
    "sizes, restitution 2": (lambda: rk.Block.from_dimensions(0.6, 3.0, 2.0), "restitution", SHARE, "2.0"),
    "radius 0": (lambda: rk.Block.from_radius(0.2, 0.0), "R", POSITIVE, "0.0"),
    "radius, alpha 0": (lambda: rk.Block.from_radius(0.0, 2.0), "alpha", SLENDERNESS, "0.0"),
    "radius, gravity 0": (lambda: rk.Block.from_radius(0.2, 2.0, gravity=0.0), "gravity", POSITIVE, "0.0"),
    "inertia ratio above 1": (
        lambda: rk.Block.from_radius(0.2, 2.0, inertia_ratio=4 / 3),
        "inertia_ratio",
        "be in (0, 1]",
        "1.3333333333333333",
    ),
    "stocky and concentrated": (
        lambda: rk.Block.from_radius(0.8, 2.0, inertia_ratio=1.0),
        "alpha",
        "be so small that Housner's restitution 1 - 2 inertia_ratio sin^2(alpha) is not negative",
        "0.8",
    ),
    # Pulses
    "sine, period 0": (lambda: rk.SinePulse(0.5, 0.0), "period", POSITIVE, "0.0"),
    "sine, period negative": (lambda: rk.SinePulse(0.5, -1.0), "period", POSITIVE, "-1.0"),
    "sine, amplitude NaN": (lambda: rk.SinePulse(NAN, 1.0), "amplitude", FINITE, "nan"),
    "sine, amplitude inf": (lambda: rk.SinePulse(-INF, 1.0), "amplitude", FINITE, "-inf"),
    "cosine, period 0": (lambda: rk.CosinePulse(0.5, 0.0), "period", POSITIVE, "0.0"),
    "cosine, amplitude NaN": (lambda: rk.CosinePulse(NAN, 1.0), "amplitude", FINITE, "nan"),
    "half sine, duration negative": (lambda: rk.HalfSinePulse(0.5, -1.0), "duration", POSITIVE, "-1.0"),
    "half sine, amplitude inf": (lambda: rk.HalfSinePulse(INF, 1.0), "amplitude", FINITE, "inf"),
    "rectangle, duration NaN": (lambda: rk.RectangularPulse(0.5, NAN), "duration", POSITIVE, "nan"),
    "rectangle, amplitude NaN": (lambda: rk.RectangularPulse(NAN, 1.0), "amplitude", FINITE, "nan"),
    "triangle, duration inf": (lambda: rk.TriangularPulse(0.5, INF), "duration", POSITIVE, "inf"),
    "triangle, amplitude NaN": (lambda: rk.TriangularPulse(NAN, 1.0), "amplitude", FINITE, "nan"),
    "exponential, shape NaN": (lambda: rk.ExponentialPulse(0.5, 1.0, NAN), "shape", "be a number", "nan"),
    "exponential, duration 0": (lambda: rk.ExponentialPulse(0.5, 0.0, 1.0), "duration", POSITIVE, "0.0"),
    "exponential, amplitude NaN": (lambda: rk.ExponentialPulse(NAN, 1.0, 1.0), "amplitude", FINITE, "nan"),
    "ricker, kind": (
        lambda: rk.RickerPulse(0.5, 1.0, "mexican"),
        "kind",
        "be one of 'symmetric', 'antisymmetric'",
        "'mexican'",
    ),
    "ricker, period 0": (lambda: rk.RickerPulse(0.5, 0.0), "period", POSITIVE, "0.0"),
    "ricker, amplitude NaN": (lambda: rk.RickerPulse(NAN, 1.0), "amplitude", FINITE, "nan"),
    "ricker, center 0": (lambda: rk.RickerPulse(0.5, 1.0, center=0.0), "center", POSITIVE, "0.0"),
    "ricker, center negative": (lambda: rk.RickerPulse(0.5, 1.0, center=-1.0), "center", POSITIVE, "-1.0"),
    "near-fault, period negative": (
        lambda: rk.MavroeidisPapageorgiouPulse(0.5, -1.0),
        "period",
        POSITIVE,
        "-1.0",
    ),
    "near-fault, oscillations 1": (
        lambda: rk.MavroeidisPapageorgiouPulse(0.5, 1.0, 1.0),
        "oscillations",
        "be above 1 and finite",
        "1.0",
    ),
    "near-fault, oscillations inf": (
        lambda: rk.MavroeidisPapageorgiouPulse(0.5, 1.0, INF),
        "oscillations",
        "be above 1 and finite",
        "inf",
    ),
    "near-fault, amplitude NaN": (lambda: rk.MavroeidisPapageorgiouPulse(NAN, 1.0), "amplitude", FINITE, "nan"),
    "near-fault, phase inf": (lambda: rk.MavroeidisPapageorgiouPulse(0.5, 1.0, 2.0, INF), "phase", FINITE, "inf"),
    # Records, and motions made of motions
    "record, dt 0": (lambda: rk.Record([0.0, 0.1], 0.0), "dt", POSITIVE, "0.0"),
    "record, dt negative": (lambda: rk.Record([0.0, 0.1], -0.01), "dt", POSITIVE, "-0.01"),
    "record, dt NaN": (lambda: rk.Record([0.0, 0.1], NAN), "dt", POSITIVE, "nan"),
    "record, NaN": (lambda: rk.Record([0.0, NAN], 0.01), "acceleration", FINITE, "nan"),
    "record, inf": (lambda: rk.Record([0.0, -INF], 0.01), "acceleration", FINITE, "-inf"),
    "record, empty": (lambda: rk.Record([], 0.01), "acceleration", ONE_SAMPLE, "shape (0,)"),
    "record, two of no samples": (
        lambda: rk.Record(np.zeros((2, 0)), 0.01),
        "acceleration",
        ONE_SAMPLE,
        "shape (2, 0)",
    ),
    "record, scalar": (lambda: rk.Record(0.3, 0.01), "acceleration", ONE_SAMPLE, "shape ()"),
    "record, complex": (
        lambda: rk.Record(np.array([1j]), 0.01),
        "acceleration",
        "be real",
        "array([0.+1.j])",
    ),
    "delay negative": (lambda: SINE.shifted(-0.1), "delay", "be 0 or more and finite", "-0.1"),
    "delay NaN": (lambda: SINE.shifted(NAN), "delay", "be 0 or more and finite", "nan"),
    "delay inf": (lambda: SINE.shifted(INF), "delay", "be 0 or more and finite", "inf"),
    "factor NaN": (lambda: NAN * SINE, "factor", FINITE, "nan"),
    "factor inf": (lambda: SINE * INF, "factor", FINITE, "inf"),
    # outcome and simulate
    "rotation pi/2": (
        lambda: rk.outcome(BLOCK, SINE, initial=(HALF_PI, 0.0)),
        "initial[0]",
        ROTATION,
        "1.5707963267948966",
    ),
    "rotation -2": (lambda: rk.outcome(BLOCK, SINE, initial=(-2.0, 0.0)), "initial[0]", ROTATION, "-2.0"),
    "rotation NaN": (lambda: rk.simulate(BLOCK, SINE, initial=(NAN, 0.0)), "initial[0]", ROTATION, "nan"),
    "duration 0": (lambda: rk.simulate(BLOCK, SINE, duration=0.0), "duration", POSITIVE, "0.0"),
    "duration negative": (lambda: rk.simulate(BLOCK, SINE, duration=-1.0), "duration", POSITIVE, "-1.0"),
    "duration NaN": (lambda: rk.simulate(BLOCK, SINE, duration=NAN), "duration", POSITIVE, "nan"),
    "duration inf": (lambda: rk.simulate(BLOCK, SINE, duration=INF), "duration", POSITIVE, "inf"),
    "samples 1": (lambda: rk.simulate(BLOCK, SINE, samples=1), "samples", "be a whole number from 2 to 10000000", "1"),
    "samples 0": (lambda: rk.simulate(BLOCK, SINE, samples=0), "samples", "be a whole number from 2 to 10000000", "0"),
    # Engine
    "order 3": (lambda: rk.Series(order=3), "order", "be a whole number from 4 to 64", "3"),
    "order 0": (lambda: rk.Series(order=0), "order", "be a whole number from 4 to 64", "0"),
    "order True": (lambda: rk.Series(order=True), "order", "be a whole number from 4 to 64", "True"),
    "tolerance 0": (lambda: rk.Series(tolerance=0.0), "tolerance", "be in (0, 1)", "0.0"),
    "tolerance 1": (lambda: rk.Series(tolerance=1.0), "tolerance", "be in (0, 1)", "1.0"),
    "tolerance negative": (lambda: rk.Series(tolerance=-1e-9), "tolerance", "be in (0, 1)", "-1e-09"),
    "tolerance NaN": (lambda: rk.Series(tolerance=NAN), "tolerance", "be in (0, 1)", "nan"),
    "max_steps 0": (lambda: rk.Series(max_steps=0), "max_steps", "be a whole number from 1 to 1000000000", "0"),
    "max_steps negative": (
        lambda: rk.Series(max_steps=-5),
        "max_steps",
        "be a whole number from 1 to 1000000000",
        "-5",
    ),
    # Spectra and maps
    "spectrum, no period": (lambda: rk.rocking_spectrum(0.2, SINE, []), "period", LIST, "shape (0,)"),
    "spectrum, table of periods": (
        lambda: rk.rocking_spectrum(0.2, SINE, np.ones((2, 3))),
        "period",
        LIST,
        "shape (2, 3)",
    ),
    "spectrum, period 0": (lambda: rk.rocking_spectrum(0.2, SINE, [1.0, 0.0]), "period", POSITIVE, "0.0"),
    "spectrum, period negative": (lambda: rk.rocking_spectrum(0.2, SINE, [-1.0]), "period", POSITIVE, "-1.0"),
    "spectrum, period NaN": (lambda: rk.rocking_spectrum(0.2, SINE, [NAN]), "period", POSITIVE, "nan"),
    "spectrum, alpha 2": (lambda: rk.rocking_spectrum(2.0, SINE, [1.0]), "alpha", SLENDERNESS, "2.0"),
    "spectrum, restitution 2": (
        lambda: rk.rocking_spectrum(0.2, SINE, [1.0], 2.0),
        "restitution",
        SHARE,
        "2.0",
    ),
    "self-similar, no ratio": (
        lambda: rk.studies.self_similar_spectrum([], [2.0]),
        "frequency_ratio",
        LIST,
        "shape (0,)",
    ),
    "self-similar, ratio 0": (
        lambda: rk.studies.self_similar_spectrum([0.0, 1.0], [2.0]),
        "frequency_ratio",
        POSITIVE,
        "0.0",
    ),
    "self-similar, intensity 0": (lambda: rk.studies.self_similar_spectrum([1.0], [0.0]), "intensity", POSITIVE, "0.0"),
    "map, no ratio": (lambda: rk.overturning_map([], [2.0]), "frequency_ratio", LIST, "shape (0,)"),
    "map, no intensity": (lambda: rk.overturning_map([1.0], []), "intensity", LIST, "shape (0,)"),
    "map, no axis": (lambda: rk.overturning_map([1.0]), "intensity", "be given, or `uplift_strength` in", "neither is"),
    "map, two axes of one": (
        lambda: rk.overturning_map([1.0], [2.0], pulse_duration=[1.0]),
        "frequency_ratio",
        "be given, or `pulse_duration` in its place",
        "both are",
    ),
    "map, strength 0": (lambda: rk.overturning_map([1.0], uplift_strength=[0.0]), "uplift_strength", POSITIVE, "0.0"),
    "map, no duration": (
        lambda: rk.studies.self_similar_spectrum(pulse_duration=[], intensity=[1.0]),
        "pulse_duration",
        LIST,
        "shape (0,)",
    ),
    "map, shape NaN": (
        lambda: rk.overturning_map([1.0], [2.0], pulse=rk.ExponentialPulse, shape=NAN),
        "shape",
        "be a number",
        "nan",
    ),
    "map, many shapes in two axes": (
        lambda: rk.overturning_map([1.0], [2.0], pulse=rk.ExponentialPulse, shape=[[1.0]]),
        "shape",
        "be a number or a list",
        "shape (1, 1)",
    ),
    "map, ratio negative": (lambda: rk.overturning_map([-1.0], [2.0]), "frequency_ratio", POSITIVE, "-1.0"),
    "map, intensity negative": (lambda: rk.overturning_map([1.0], [2.0, -3.0]), "intensity", POSITIVE, "-3.0"),
    "map, intensity inf": (lambda: rk.overturning_map([1.0], [INF]), "intensity", POSITIVE, "inf"),
    "map, alpha 0": (lambda: rk.overturning_map([1.0], [2.0], alpha=0.0), "alpha", SLENDERNESS, "0.0"),
    "map, restitution negative": (
        lambda: rk.overturning_map([1.0], [2.0], restitution=-0.1),
        "restitution",
        SHARE,
        "-0.1",
    ),
    "map, alpha 1.2 and no restitution": (
        lambda: rk.overturning_map([1.0], [2.0], alpha=1.2),
        "alpha",
        HOUSNER,
        "1.2",
    ),
    # Many scenes where one is wanted
    "many alphas": (lambda: rk.outcome(rk.Block(TWO, 1.0), SINE), "block", SCENE, "`alpha` has shape (2,)"),
    "many p": (lambda: rk.outcome(rk.Block(0.2, TWO), SINE), "block", SCENE, "`p` has shape (2,)"),
    "many restitutions": (
        lambda: rk.outcome(rk.Block(0.2, 1.0, TWO), SINE),
        "block",
        SCENE,
        "`restitution` has shape (2,)",
    ),
    "many alphas, history": (
        lambda: rk.simulate(rk.Block(TWO, 1.0), SINE),
        "block",
        SCENE,
        "`alpha` has shape (2,)",
    ),
    "many amplitudes": (
        lambda: rk.outcome(BLOCK, rk.SinePulse(TWO, 1.0)),
        "motion",
        SCENE,
        "`amplitude` has shape (2,)",
    ),
    "many records": (
        lambda: rk.outcome(BLOCK, rk.Record(np.zeros((2, 3)), 0.01)),
        "motion",
        SCENE,
        "`samples` has shape (2, 3)",
    ),
    "many steps": (
        lambda: rk.outcome(BLOCK, rk.Record(np.zeros(3), TWO)),
        "motion",
        SCENE,
        "`dt` has shape (2,)",
    ),
    "many delays": (lambda: rk.outcome(BLOCK, (2 * SINE).shifted(TWO)), "motion", SCENE, "`delay` has shape (2,)"),
    "many amplitudes in a sum": (
        lambda: rk.outcome(BLOCK, SINE + rk.SinePulse(TWO, 1.0)),
        "motion",
        SCENE,
        "`second.amplitude` has shape (2,)",
    ),
    "spectrum of many alphas": (
        lambda: rk.rocking_spectrum(TWO, SINE, [1.0]),
        "block",
        SCENE,
        "`alpha` has shape (2,)",
    ),
    "map of many restitutions": (
        lambda: rk.overturning_map([1.0], [2.0], restitution=TWO),
        "block",
        SCENE,
        "`restitution` has shape (2,)",
    ),
    # Histories
    "time negative": (lambda: history()(-0.1), "time", HISTORY, "-0.1"),
    "time too late": (lambda: history()(4.001), "time", HISTORY, "4.001"),
    "one time of many": (lambda: history()(np.array([[1.0, 5.0], [2.0, 3.0]])), "time", HISTORY, "5.0"),
    "time NaN": (lambda: history()(NAN), "time", HISTORY, "nan"),
    "time inf": (lambda: history()(INF), "time", HISTORY, "inf"),
}


@pytest.mark.parametrize("call, argument, allowed, value", BAD.values(), ids=BAD)
def test_bad_input(call, argument, allowed, value):
    text = rf"^Argument `{re.escape(argument)}` must {re.escape(allowed)}.*, but .*{re.escape(value)}"
    with pytest.raises(ValueError, match=text) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_the_error_names_arrays_by_their_first_bad_value():
    with pytest.raises(ValueError, match=r"`p` must be positive and finite, from 1e-6 to 1e6, but is -3\.0\.$"):
        rk.Block(0.2, np.array([1.0, -3.0, NAN, 0.0]))


@pytest.mark.parametrize("name", ["impact_times", "impact_velocities", "peak_times", "peak_rotations"])
def test_events_of_many_histories(name):
    """The number of events differs between scenes: one table would need to be filled up."""
    with pytest.raises(ValueError, match=r"holds many scenes: .* its events, inside jax\.vmap\.$"):
        getattr(histories(), name)


def test_a_call_of_many_histories():
    """As with events: the times are those of one scene."""
    with pytest.raises(ValueError, match=r"holds many scenes.*jax\.vmap"):
        histories()(1.0)


# Checks under jit: argument and what is allowed; the compiled function cannot print the value.
TRACED = {
    "alpha": (lambda x: rk.Block(x, 1.0).alpha, -0.1, 0.2, "alpha", SLENDERNESS),
    "alpha of a stocky block": (lambda x: rk.Block(x, 1.0).alpha, 1.2, 0.2, "alpha", HOUSNER),
    "p": (lambda x: rk.Block(0.2, x).p, 0.0, 1.0, "p", POSITIVE),
    "restitution": (lambda x: rk.Block(0.2, 1.0, x).restitution, 1.5, 1.0, "restitution", SHARE),
    "width": (lambda x: rk.Block.from_dimensions(x, 3.0).alpha, -0.6, 0.6, "width", POSITIVE),
    "period": (lambda x: rk.SinePulse(0.5, x).end, 0.0, 1.0, "period", POSITIVE),
    "amplitude": (lambda x: rk.SinePulse(x, 1.0).bounds, NAN, 1.0, "amplitude", FINITE),
    "shape": (lambda x: rk.ExponentialPulse(0.5, 1.0, x).knots, NAN, INF, "shape", "be a number"),
    "samples": (lambda x: rk.Record(jnp.stack([x, x]), 0.01).samples, INF, 1.0, "acceleration", FINITE),
    "delay": (lambda x: SINE.shifted(x).end, -1.0, 0.0, "delay", "be 0 or more and finite"),
    "restitution of an outcome": (
        lambda x: rk.outcome(rk.Block(0.2, 1.0, x), SINE, **QUICK).margin,
        -0.5,
        0.5,
        "restitution",
        SHARE,
    ),
    "duration": (
        lambda x: rk.simulate(BLOCK, SINE, duration=x, engine=FOLLOWED).rotation,
        -1.0,
        2.0,
        "duration",
        POSITIVE,
    ),
}


@pytest.mark.parametrize("function, bad, good, argument, allowed", TRACED.values(), ids=TRACED)
def test_bad_input_under_jit(function, bad, good, argument, allowed):
    compiled = jax.jit(function)
    assert not np.isnan(compiled(good)).any()
    with pytest.raises(Exception, match=f"Argument `{argument}` must {re.escape(allowed)}"):
        compiled(bad).block_until_ready()


def area(alpha):
    return rk.Block(alpha, 1.0, 0.5).alpha ** 3


def mesh():
    return Mesh(np.array(jax.devices()[:2]), ("devices",))


def dealt(function):
    devices = PartitionSpec("devices")
    return jax.shard_map(function, mesh=mesh(), in_specs=devices, out_specs=devices)


def sharded(x):
    return jax.device_put(x, NamedSharding(mesh(), PartitionSpec("devices")))


RAISING = {
    "vmap": jax.vmap(jax.jit(area)),
    "vmap, inside": jax.jit(jax.vmap(area)),
    "grad": jax.vmap(jax.jit(jax.grad(area))),
    "hessian": jax.jit(jax.vmap(jax.hessian(area))),
    "checkpoint": jax.jit(jax.vmap(jax.grad(jax.checkpoint(area)))),
    "scan": jax.jit(lambda x: jax.lax.scan(lambda c, a: (c + area(a), None), 0.0, x)[0]),
    "grad of a scan": jax.jit(jax.grad(lambda x: jax.lax.scan(lambda c, a: (c + area(a), None), 0.0, x)[0])),
    "while": jax.jit(
        lambda x: jax.lax.while_loop(lambda c: c[0] < 2, lambda c: (c[0] + 1, c[1] + area(x[c[0]])), (0, 0.0))
    ),
    "cond": jax.jit(lambda x: jax.lax.cond(x[-1] < 1, area, lambda a: a, x[-1])),
    "shard_map": lambda x: jax.jit(dealt(jax.vmap(area)))(x),
    "sharded": lambda x: jax.jit(jax.vmap(area))(sharded(x)),
}


@pytest.mark.parametrize("way", RAISING.values(), ids=RAISING)
def test_bad_input_in_every_way(way):
    """The message as it is, and nothing where all is well."""
    assert np.all(np.isfinite(jax.tree.leaves(way(TWO))[-1]))
    with pytest.raises(Exception, match=r"^(INVALID_ARGUMENT: )?Argument `alpha` must be in \(0, pi/2\).*"):
        jax.block_until_ready(way(-TWO))


@pytest.mark.parametrize("turns", [0, 1])
def test_what_is_not_computed_does_not_raise(turns):
    def added(a, turns):
        return jax.lax.fori_loop(0, turns, lambda i, c: c + area(a), 0.0)

    assert jax.jit(lambda a: jax.lax.cond(a > 0, area, lambda a: a, a))(-1.0) == -1.0
    if turns:
        with pytest.raises(Exception, match="Argument `alpha` must"):
            jax.block_until_ready(jax.jit(added)(-1.0, turns))
    else:
        assert jax.jit(added)(-1.0, turns) == 0.0


def test_results_of_checked_values_stay_where_they_are():
    assert jax.jit(jax.vmap(area))(sharded(TWO)).sharding.spec == PartitionSpec("devices")


def test_checks_where_xla_has_no_function_for_them(monkeypatch):
    """Check that argument checks call back to Python where XLA has no function for them."""
    text = jax.jit(area).lower(0.2).as_text()
    assert CHECK in text and "callback" not in text
    monkeypatch.setattr(error_if, "has_check", lambda: False)
    compiled = jax.jit(lambda a: area(a) + 0.0)
    assert "callback" in compiled.lower(0.2).as_text()
    assert compiled(0.2) == area(0.2)
    with pytest.raises(Exception, match="Argument `alpha` must be in"):
        jax.block_until_ready(compiled(-0.2))


@pytest.mark.parametrize("failed", [False, True])
def test_what_failed_is_marked_where_no_error_can_be_made(failed):
    """Check that a failure is marked in the results if XLA returns no error when asked to make one."""
    flags = np.array([failed, not failed])
    buffers = [xla_ffi.Buffer(data=flags[i:].ctypes.data) for i in range(2)]
    tables = [(ctypes.c_void_p * 1)(ctypes.addressof(each)) for each in buffers]
    args, rets = (xla_ffi.Buffers(size=1, buffers=ctypes.addressof(table)) for table in tables)
    message = b"a message"
    text = xla_ffi._Text(ctypes.cast(message, ctypes.c_void_p), len(message))
    texts = (ctypes.c_void_p * 1)(ctypes.addressof(text))
    interface = xla_ffi.Interface(create_error=xla_ffi._Complain(lambda complaint: 0))
    frame = xla_ffi.Frame(api=ctypes.addressof(interface), stage=xla_ffi.EXECUTE, args=args, rets=rets)
    frame.attributes.values = ctypes.addressof(texts)
    assert not xla_ffi._check(ctypes.addressof(frame)) and flags[1] == failed


rotation_at = jax.jit(lambda response, time: response(time)[0])


@pytest.mark.parametrize("time", [-0.1, 4.1, NAN])
def test_times_outside_the_history_under_jit(time):
    response = history()
    assert rotation_at(response, 4.0) == np.asarray(response.rotation)[-1]
    with pytest.raises(Exception, match="Argument `time` must be in the history"):
        rotation_at(response, time).block_until_ready()


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_times_that_round_past_the_end(kind):
    """One unit past the duration is the duration, in single precision, too; more of it is not."""
    duration = kind(7.3)
    steps = Trajectory(None, None, jnp.zeros(1, kind), jnp.zeros(1, bool), jnp.asarray(duration))
    assert steps.checked(np.nextafter(duration, kind(8))) > duration
    with pytest.raises(ValueError, match="Argument `time` must be in the history"):
        steps.checked(duration * kind(1 + 1e-6))


def test_bad_input_under_vmap():
    """One bad lane is enough."""
    with pytest.raises(Exception, match=r"Argument `alpha` must be in \(0, pi/2\)"):
        jax.vmap(lambda alpha: rk.Block(alpha, 1.0).alpha)(jnp.array([0.2, 2.0])).block_until_ready()


@pytest.mark.parametrize("velocity", [NAN, INF, -INF])
def test_initial_velocity_that_is_not_finite(velocity):
    """Refused, or reported; never taken for a number."""
    try:
        result = rk.outcome(BLOCK, SINE, initial=(0.0, velocity), **QUICK)
    except ValueError as error:
        assert "Argument `initial[1]` must be finite, and at most 1e9 in size, but is" in str(error)
    else:
        assert result.status == rk.Status.not_finite


# ----------------------------------------------------------------------------------- what is allowed


@jax.jit
def accelerations_and_knots(pulse):
    return pulse.acceleration(np.linspace(-1, 3, 41)), pulse.knots


@pytest.mark.parametrize("shape", [-INF, INF, -1e300, 1e300, 0])
def test_any_shape_is_allowed(shape):
    found, knots = accelerations_and_knots(rk.ExponentialPulse(0.5, 2.0, shape))
    assert np.isfinite(found).all()
    assert np.isfinite(knots).all()
    assert np.asarray(found).max() == (0.5 if shape <= 0 else 0)


@pytest.mark.parametrize("restitution", [0, 0.0, 1, 1.0])
def test_ends_of_ranges_are_allowed(restitution):
    assert rk.Block(1.5, 1e-3, restitution).restitution == restitution
    assert (0.0 * SINE).shifted(0.0).end == 1.0
    assert rk.Record([0.3], 1e-9).end == 0.0
    assert rk.RickerPulse(-0.5, 1.0, center=1e-3).end == 2e-3


def test_ends_of_the_history_are_allowed():
    response = history()
    rotation, velocity = response([0.0, 4.0])
    np.testing.assert_array_equal(rotation, np.asarray(response.rotation)[[0, -1]])
    np.testing.assert_array_equal(velocity, np.asarray(response.velocity)[[0, -1]])


def test_numbers_may_be_integers():
    assert rk.Block(1, 2, 0).p.dtype == jnp.float64
    assert rk.Record(np.array([0, 1, 0]), 1).knots.dtype == jnp.float64
    assert rk.SinePulse(1, 2).acceleration(np.array([0, 1])).dtype == jnp.float64


def test_housner_restitution():
    alpha = np.array([1e-6, 0.1, 0.5, 0.9, np.arcsin(np.sqrt(2 / 3))])
    np.testing.assert_allclose(rk.Block(alpha, 1.0).restitution, 1 - 1.5 * np.sin(alpha) ** 2, rtol=1e-15, atol=1e-15)
    assert np.all(rk.Block(alpha, 1.0).restitution >= 0)


@pytest.mark.parametrize("alpha", [0.05, 0.2, 0.9])
def test_housner_restitution_follows_alpha(alpha):
    slope = jax.grad(lambda x: rk.Block(x, 1.0).restitution)(alpha)
    np.testing.assert_allclose(slope, -1.5 * np.sin(2 * alpha), rtol=1e-14)
    assert jax.grad(lambda x: rk.Block(x, 1.0, 0.9).restitution)(alpha) == 0


def test_block_from_dimensions():
    block = rk.Block.from_dimensions(0.6, 3.0)
    half_diagonal = np.hypot(0.6, 3.0) / 2
    np.testing.assert_allclose(np.tan(block.alpha), 0.2, rtol=1e-15)
    np.testing.assert_allclose(block.p, np.sqrt(3 * 9.81 / (4 * half_diagonal)), rtol=1e-15)
    np.testing.assert_allclose(block.half_diagonal, half_diagonal, rtol=1e-15)
    moon = rk.Block.from_dimensions(0.6, 3.0, gravity=1.62)
    np.testing.assert_allclose(moon.p / block.p, np.sqrt(1.62 / 9.81), rtol=1e-15)
    assert moon.alpha == block.alpha


@pytest.mark.parametrize(
    ("inertia", "frequency", "restitution"),
    [(None, np.sqrt(0.75 * 9.81 / 2), 1 - 1.5 * np.sin(0.3) ** 2),
     (0.75, np.sqrt(0.75 * 9.81 / 2), 1 - 1.5 * np.sin(0.3) ** 2),
     (1.0, np.sqrt(9.81 / 2), 1 - 2 * np.sin(0.3) ** 2), (0.5, np.sqrt(9.81 / 4), np.cos(0.3) ** 2)],
    ids=["rectangle", "as a number", "all mass at one point", "a ring through both corners"],
)  # fmt: skip
def test_block_from_radius(inertia, frequency, restitution):
    """p = sqrt(m g R/I); the momentum about the new corner decides what an impact leaves, and follows alpha."""
    block = rk.Block.from_radius(0.3, 2.0, inertia_ratio=inertia)
    np.testing.assert_allclose(block.p, frequency, rtol=1e-15)
    np.testing.assert_allclose(block.restitution, restitution, rtol=1e-15)
    np.testing.assert_allclose(
        block.restitution,
        rk.closed_form.restitution.housner(0.3, 1 / (0.75 if inertia is None else inertia)),
        rtol=1e-15,
    )
    slope = jax.grad(lambda alpha: rk.Block.from_radius(alpha, 2.0, inertia_ratio=inertia).restitution)(0.3)
    np.testing.assert_allclose(slope, (restitution - 1) * 2 / np.tan(0.3), rtol=1e-14)
    assert rk.Block.from_radius(0.3, 2.0, 0.9, inertia_ratio=inertia).restitution == 0.9


def test_block_from_radius_is_that_of_its_dimensions():
    block, radius = rk.Block.from_dimensions(0.6, 3.0), np.hypot(0.3, 1.5)
    assert rk.Block.from_radius(block.alpha, radius).p == block.p
    np.testing.assert_allclose(rk.Block.from_radius(0.2, 1.7).half_diagonal, 1.7, rtol=1e-15)


# ---------------------------------------------------------------------------------- single precision

SINGLE = """
import warnings
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    import jaxrock as rk
    block, quick = BLOCK
    before = len(caught)
    results = [rk.outcome(block, rk.SinePulse(amplitude, 1.1), **quick) for amplitude in (0.5, 0.6)]
for warning in caught:
    print(warning.category.__name__, warning.filename, warning.message)
print(before, len(caught), results[0].max_rotation.dtype)
"""


RIGID = 'rk.Block(0.2, 2.0), {"model": rk.Linear(), "engine": rk.Series(order=4)}'
FLEXIBLE = "rk.blocks.FlexibleBlock(1.0, 5.0, 1e9, 2500.0, 0.02, 2), {}"


@functools.cache
def by_itself(block):
    """Run a process that computes in single precision and then passes arguments of wrong types; return its output."""
    return subprocess.run(
        [sys.executable, "-c", SINGLE.replace("BLOCK", block) + WRONG_KINDS],
        cwd=Path(rk.__file__).parents[1],
        env=os.environ | {"JAX_ENABLE_X64": "0", "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        timeout=120,
    )


@pytest.mark.parametrize("block", [RIGID, pytest.param(FLEXIBLE, marks=pytest.mark.slow)], ids=["rigid", "flexible"])
def test_single_precision_warns_once(block):
    done = by_itself(block)
    *warned, counts = done.stdout.splitlines()[:-1]
    assert counts == "0 1 float32"
    assert len(warned) == 1
    # It points at the user's line, and says what to do.
    assert warned[0].startswith("UserWarning <string> jaxrock runs in single precision")
    assert 'jax.config.update("jax_enable_x64", True)' in warned[0]


@pytest.mark.parametrize("other", [3, 0.5, None, "motion"], ids=repr)
def test_only_motions_are_added(other):
    for add in (lambda: SINE + other, lambda: SINE - other):
        with pytest.raises(TypeError, match="unsupported operand"):
            add()


def test_an_array_times_a_motion_is_a_motion():
    found = np.array([1.0, 2.0]) * SINE
    assert isinstance(found, rk.motions.AbstractMotion)

    def rotation(motion):
        return rk.outcome(BLOCK, motion, **QUICK).max_rotation

    many = jax.vmap(rotation, in_axes=(found_axes(found),))(found)
    np.testing.assert_allclose(many, [rotation(factor * SINE) for factor in (1.0, 2.0)])


def found_axes(motion):
    return jax.tree.map(lambda x: 0 if x.ndim else None, motion)


WRONG_KINDS = """
import math
block, pulse = rk.Block(0.2, 2.0), rk.SinePulse(0.3, 0.8)
for make, words in (
    (lambda: rk.Series(order=8.0), "Argument `order` must be a whole number from 4 to 64, but is 8.0."),
    (lambda: rk.Series(order=math.nan), "Argument `order` must be a whole number from 4 to 64, but is nan."),
    (lambda: rk.Series(max_steps=1.5), "Argument `max_steps` must be a whole number from 1 to 1000000000, but is 1.5."),
    (lambda: rk.motions.Suite([1.0]), "Argument `motions` must be a list of motions, but holds 1.0."),
    (lambda: rk.SinePulse(0.3, 0.8).with_vertical(0.1), "Argument `vertical` must be a motion, but is 0.1."),
    (lambda: rk.models.Equation("x"), "Argument `restoring` must be a function, but is 'x'."),
    (lambda: rk.Diffrax(solver="x"), "Argument `solver` must be a solver, but is 'x'."),
    (lambda: rk.inverse.Unknown(0.1, 1.0, log="no"), "Argument `log` must be True or False, but is 'no'."),
    (lambda: rk.Block([], 1.0), "Argument `alpha` must hold at least one number, but has shape (0,)."),
    (lambda: rk.Block(0.1, True), "Argument `p` must be a number or an array of numbers, but is True."),
    (lambda: rk.Block(0.1, "2"), "Argument `p` must be a number or an array of numbers, but is '2'."),
    (lambda: rk.Block([0.1, 0.2], [1.0] * 3),
     "Arguments `alpha` and `p` must have shapes that go together, but have (2,) and (3,)."),
    (lambda: rk.outcome(block, pulse, "linear"),
     "Argument `model` must be an equation of motion, such as Housner(), but is 'linear'."),
    (lambda: rk.outcome(block, pulse, rk.Linear), "Argument `model` must be an equation of motion, such as Housner(), "
     "but is the class Linear (without parentheses)."),
    (lambda: rk.outcome(pulse, block),
     "Argument `block` must be a Block, an AsymmetricBlock or a FlexibleBlock, but is a SinePulse."),
    (lambda: rk.outcome(None, pulse),
     "Argument `block` must be a Block, an AsymmetricBlock or a FlexibleBlock, but is None."),
    (lambda: rk.outcome(block, pulse, initial=0.1), "Argument `initial` must be a pair, but is 0.1."),
    (lambda: rk.outcome(block, pulse, engine="x"), "Argument `engine` must be an engine, but is 'x'."),
    (lambda: rk.sweep(abs, p=[1.0], block=1.5), "Argument `block` must be a whole number, at least 1, but is 1.5."),
    (lambda: rk.critical_amplitudes(block, 0 * pulse),
     "Argument `motion` must move the ground, but its peak is 0 g."),
    (lambda: rk.hazard.LogNormalFragility(0.3, 0.4)(-1.0), "Argument `level` must be 0 or more, but is -1.0."),
    (lambda: rk.hazard.HazardCurve([0.1, 0.2], [0.02, 0.01]).rate(math.nan),
     "Argument `level` must be 0 or more, but is nan."),
):
    try:
        make()
    except ValueError as error:
        assert str(error) == words, error
    else:
        raise AssertionError(words)
print("all kinds are named")
"""


def test_wrong_kinds_are_named():
    """Where annotations are not checked, as tests do."""
    done = by_itself(RIGID)
    assert (done.returncode, done.stdout.splitlines()[-1:]) == (0, ["all kinds are named"]), done.stderr


@pytest.mark.parametrize("model", [rk.Housner(), rk.Linear()], ids=["Housner", "Linear"])
def test_a_block_that_is_balanced_exactly_is_too_close_to_call(model):
    """It would go nowhere until all steps are used up, which says nothing."""
    engine = rk.Series(order=4, max_steps=100)
    result = rk.outcome(BLOCK, 0 * SINE, model, initial=(0.2, 0.0), engine=engine)
    assert result.status == rk.Status.undecided


def test_single_precision_among_double():
    """Numbers of less precision go with the others."""
    ratio = np.array([0.5, 2.0], np.float32)
    found = rk.closed_form.sine_pulse.after_pulse_limits(ratio, np.array(0.9))
    expected = rk.closed_form.sine_pulse.after_pulse_limits(ratio.astype(float), np.array(0.9))
    np.testing.assert_array_equal(found, expected)
    response = history()
    np.testing.assert_array_equal(response(ratio), response(ratio.astype(float)))


@pytest.mark.parametrize("model", [rk.Housner(), rk.Linear()], ids=["Housner", "Linear"])
def test_a_record_in_single_precision_among_double(model):
    """Every number is of single precision, and what comes of it, too."""
    samples = (0.3 * np.random.default_rng(0).normal(size=200)).astype(np.float32)
    short, exact = (
        rk.outcome(rk.Block(*map(kind, (0.2, 2.0, 0.9))), rk.Record(samples.astype(kind), kind(0.02)), model)
        for kind in (np.float32, np.float64)
    )
    assert short.max_rotation.dtype == jnp.float32 and not exact.overturned
    np.testing.assert_allclose(short.max_rotation, exact.max_rotation, rtol=1e-4)


@pytest.mark.parametrize("kind", [">f8", ">f4", ">i4", np.longdouble, np.float16])
def test_numbers_in_any_order_of_bytes_and_of_any_precision(kind):
    samples = np.array([0, 1, 3, 2], kind)
    np.testing.assert_array_equal(rk.Record(samples, 0.1).samples, [0, 1, 3, 2])
    np.testing.assert_array_equal(rk.sweep(lambda x: 2.0 * x, x=samples, progress=False).values, [0, 2, 6, 4])


def test_masked_values_are_no_numbers():
    samples = np.ma.masked_values([0.1, 0.3, 999.0, 0.2], 999.0)
    with pytest.raises(ValueError, match="Argument `acceleration` must have a value everywhere, but some are masked"):
        rk.Record(samples, 0.1)
    with pytest.raises(ValueError, match="Argument `p` must have a value everywhere, but some are masked"):
        rk.sweep(lambda p: p, p=samples, progress=False)
    np.testing.assert_array_equal(rk.Record(np.ma.array([0.1, 0.3]), 0.1).samples, [0.1, 0.3])  # none is


def test_a_length_of_time_is_no_number():
    with pytest.raises(ValueError, match="Argument `count` must be a whole number"):
        rk.studies.use_cpu_devices(np.timedelta64(1, "s"))


def test_a_hazard_curve_is_not_extended_beyond_numbers():
    curve = rk.hazard.HazardCurve(np.array([0.1, 0.2]), np.array([0.1, 0.01]))
    with pytest.raises(ValueError, match="Argument `lowest` and `highest` must be levels up to which"):
        curve.extended(1e-223, 1.0)
