"""Public functions under the settings of JAX that users have, each in a process without anything that tests set.

    python -m references.users_settings debug_nans                 # all calls under one setting, as JSON
    python -m references.users_settings usual,transfer_guard "outcome;jit"    # some of them, under one after the other
    python -m references.users_settings late                       # in single precision, in double, and caches cleared

Every call returns numbers, which a setting must not change.
"""

import contextlib
import json
import os
import sys
import warnings
from collections.abc import Callable, Iterator

os.environ.setdefault("JAXROCK_CACHE", "off")

import jax
import jax.numpy as jnp
import numpy as np

import jaxrock as rk

TIMES = np.linspace(0.0, 2.0, 41)
LEVELS, RATES = [0.1, 0.2, 0.5, 1.0], [1e-2, 4e-3, 5e-4, 1e-5]


def block():
    return rk.Block(0.2, 2.0, 0.9)


def pulse(amplitude=0.3):
    return rk.SinePulse(amplitude, 0.8)


def at(value):
    """Return numbers placed on a device explicitly, as `jax.transfer_guard` asks for."""
    return jax.device_put(np.asarray(value, jnp.result_type(float)))


def record():
    return rk.Record(0.4 * np.sin(5 * TIMES), 0.05)


def column(**more):
    return rk.blocks.FlexibleBlock(0.6, 3.0, 30e9, 2500.0, 0.02, 2, **more)


def margin(amplitude):
    return rk.outcome(block(), pulse(amplitude)).margin


def curve():
    return rk.hazard.HazardCurve(LEVELS, RATES)


def fragility():
    return rk.hazard.LogNormalFragility(0.3, 0.4)


def rocks():
    return rk.inverse.Observations([0.12, 0.2], [2.0, 3.0], ["toppled", "survived"])


def unknowns():
    return {"amplitude": rk.inverse.Unknown(0.1, 1.0), "period": rk.inverse.Unknown(0.2, 2.0)}


def forces():
    found = rk.responses.contact_forces(rk.simulate(block(), pulse(), duration=2.0, samples=20), block())
    return found.largest_friction, found.friction_at_impact


def intensities():
    measures = rk.intensity
    names = "peak_acceleration peak_velocity peak_displacement arias significant_duration mean_period".split()
    return [getattr(measures, name)(record()) for name in names]


def laws():
    known = [
        rk.restitution.Housner(), rk.restitution.AngularMomentum(), rk.restitution.PerSide(0.9, 0.85),
        rk.restitution.SpeedDependent(0.95, 0.8, 1.0),
    ]  # fmt: skip
    return [rk.outcome(rk.Block(0.2, 2.0, law), pulse()).margin for law in known]


def found(result, *names):
    return [getattr(result, name) for name in names]


def fit(levels, toppled):
    made = rk.hazard.fit_fragility(levels, toppled, trials=3)
    return made.fragility.median, made.fragility.dispersion


def nan_of_users(x):
    return jnp.log(x) * margin(0.3)


CALLS: dict[str, Callable] = {
    "outcome": lambda: found(rk.outcome(block(), pulse()), "max_rotation", "margin", "clearance", "error"),
    "overturned": lambda: found(rk.outcome(block(), pulse(2.0)), "max_rotation", "margin", "time_of_max"),
    "outcome of a record": lambda: found(rk.outcome(block(), record()), "max_rotation", "margin"),
    "outcome of no numbers": lambda: rk.outcome(rk.Block(-1.0, 2.0, throw=False), pulse(), throw=False).margin,
    "NaN by contract, in a program of the user": lambda: jax.jit(
        lambda alpha: rk.outcome(rk.Block(alpha, 2.0, throw=False), pulse(), throw=False).margin
    )(at(-1.0)),
    "NaN of the user": lambda: jax.jit(nan_of_users)(at(-1.0)),
    "infinity by contract, in a program of the user": lambda: jax.jit(
        lambda alpha: rk.outcome(rk.Block(alpha, 2.0), pulse(2.0)).max_rotation
    )(at(0.2)),
    "simulate": lambda: found(rk.simulate(block(), pulse(), duration=2.0, samples=20), "rotation", "impact_times"),
    "response(t)": lambda: rk.simulate(block(), record(), samples=20)(TIMES),
    "diffrax": lambda: rk.outcome(block(), pulse(), engine=rk.Diffrax(rtol=1e-6)).max_rotation,
    "equation": lambda: (
        rk.outcome(
            block(),
            pulse(),
            rk.models.Equation(lambda opening, block: block.alpha - opening, lambda opening, block: 1.0),
        ).max_rotation
    ),
    "asymmetric": lambda: rk.outcome(rk.blocks.AsymmetricBlock(0.2, 0.25, 2.0), pulse()).margin,
    "rolling": lambda: rk.outcome(block(), pulse(), rk.models.Rolling(rk.blocks.Edge(0.1))).margin,
    "laws": laws,
    "contact_forces": forces,
    "jit": lambda: jax.jit(margin)(at(0.3)),
    "jit of a block": lambda: jax.jit(lambda block, motion: rk.outcome(block, motion).margin)(block(), record()),
    "vmap": lambda: jax.vmap(margin)(at(np.linspace(0.2, 0.4, 3))),
    "jit(vmap) of many": lambda: jax.jit(jax.vmap(margin))(at(np.linspace(0.2, 0.4, 70))),
    "grad": lambda: jax.grad(margin)(at(0.3)),
    "jit(grad)": lambda: jax.jit(jax.value_and_grad(margin))(at(0.3)),
    "vmap(grad)": lambda: jax.vmap(jax.grad(margin))(at(np.linspace(0.2, 0.4, 3))),
    "hessian": lambda: jax.hessian(margin)(at(0.3)),
    "jacrev of a history": lambda: jax.jacrev(
        lambda a: rk.simulate(block(), pulse(a), duration=1.0, samples=5).rotation
    )(0.3),
    "grad by samples": lambda: jax.grad(lambda x: rk.outcome(block(), rk.Record(x, 0.05)).margin)(
        jnp.asarray(0.4 * np.sin(2.5 * np.arange(100) * 0.05))
    ),
    "scan": lambda: jax.lax.scan(lambda total, a: (total + margin(a), total), at(0.0), at(np.linspace(0.2, 0.3, 3)))[0],
    "FlexibleBlock": lambda: found(column(), "first_period", "frequencies"),
    "flexible outcome": lambda: rk.outcome(column(), pulse(0.25), duration=2.0).max_rotation,
    "flexible history": lambda: rk.simulate(column(), pulse(0.4), duration=2.0, samples=10).rotation,
    "flexible with P-Delta": lambda: rk.outcome(column(p_delta=True), pulse(0.25), duration=1.0).max_rotation,
    "sweep": lambda: rk.sweep(margin, amplitude=[0.2, 0.3], progress=False).values,
    "rocking_spectrum": lambda: rk.rocking_spectrum(0.2, pulse(), [2.0, 3.0], progress=False).rotation_ratio,
    "overturning_map": lambda: rk.overturning_map([2.0, 4.0], [1.5, 3.0], alpha=0.2, progress=False).rotation_ratio,
    "critical_amplitudes": lambda: rk.critical_amplitudes(block(), pulse(), intensity=(1.0, 4.0), progress=False).value,
    "sensitivity": lambda: rk.studies.sensitivity(block(), pulse()).margin.value,
    "single_lobe": lambda: [
        rk.closed_form.single_lobe.peak_rotation(0.4, 1.0, 1.0),
        rk.closed_form.single_lobe.safety_wall(2.0, [0.5, 1.0]),
    ],
    "sine_pulse": lambda: rk.closed_form.sine_pulse.first_peak([1.5, 2.0], 6.0),
    "pushover": lambda: [rk.closed_form.pushover.force(0.1, 0.2), rk.closed_form.pushover.period([0.2, 0.5])],
    "similarity": lambda: jax.tree.leaves(rk.similarity.groups(block(), 0.4, 8.0)),
    "intensity": intensities,
    "spectra of a record": lambda: rk.intensity.spectral_acceleration(record(), [0.5, 1.0]),
    "processing": lambda: rk.processing.filtered(record(), 0.5, 4.0).samples,
    "suite": lambda: jax.vmap(
        lambda number, suite=rk.motions.Suite([record(), 2 * record()]): rk.outcome(block(), suite[number]).margin
    )(np.arange(2)),
    "fit_pulse": lambda: list(rk.motions.fit_pulse(record(), rk.SinePulse, starts=1).values.values()),
    "fit_fragility": lambda: fit([0.1, 0.2, 0.3, 0.4], [0, 1, 2, 3]),
    "fit_fragility, separable": lambda: fit([0.1, 0.2, 0.3, 0.4], [0, 0, 3, 3]),
    "fragility_intervals": lambda: found(
        rk.hazard.fragility_intervals([0.1, 0.2, 0.3, 0.4], [0, 1, 1, 3], trials=3), "median", "dispersion"
    ),
    "toppling_rate": lambda: rk.hazard.toppling_rate(fragility(), curve()),
    "toppling_rate, tabulated": lambda: rk.hazard.toppling_rate(
        rk.hazard.TabulatedFragility([0.1, 0.3, 0.6], [0.0, 0.5, 1.0]), curve()
    ),
    "survival_probability": lambda: rk.hazard.survival_probability([fragility()], [1e3], curve()),
    "allowed_scale": lambda: rk.hazard.allowed_scale([fragility()], [1e3], curve()),
    "fit_probit, separable": lambda: rk.hazard.fit_probit({"PGA": [0.1, 0.2, 0.3, 0.4]}, [0, 0, 1, 1]).slopes,
    "simulated_fragility": lambda: (
        rk.hazard.simulated_fragility(
            block(), rk.motions.Suite([pulse(), record()]), [0.2, 0.6], progress=False
        ).verdict
    ),
    "log_density": lambda: rk.inverse.log_density(rocks(), rk.SinePulse, unknowns())(at(np.zeros(2))),
    "estimate_motion": lambda: (
        rk.inverse.estimate_motion(rocks(), rk.SinePulse, unknowns(), starts=2, progress=False).log_likelihood
    ),
    "feasible_region": lambda: (
        rk.inverse.feasible_region(
            rk.inverse.Likelihood(rocks(), rk.SinePulse), {"amplitude": [0.2, 0.6], "period": [1.0]}, progress=False
        ).log_likelihood
    ),
}


@contextlib.contextmanager
def _settled(name: str, value) -> Iterator[None]:
    """Set a setting that JAX has no context for."""
    before = getattr(jax.config, name)
    jax.config.update(name, value)
    try:
        yield
    finally:
        jax.config.update(name, before)


SETTINGS: dict[str, Callable] = {
    "usual": contextlib.nullcontext,
    "debug_nans": lambda: jax.debug_nans(True),
    "debug_infs": lambda: jax.debug_infs(True),
    "global debug_nans": lambda: _settled("jax_debug_nans", True),
    "global debug_infs": lambda: _settled("jax_debug_infs", True),
    "disable_jit": jax.disable_jit,
    "strict promotion of types": lambda: jax.numpy_dtype_promotion("strict"),
    "no promotion of ranks": lambda: jax.numpy_rank_promotion("raise"),
    "transfer_guard": lambda: jax.transfer_guard("disallow"),
    "checking_leaks": jax.checking_leaks,
    "second device": lambda: jax.default_device(jax.devices()[1]),
    "matmul in bfloat16": lambda: jax.default_matmul_precision("bfloat16"),
    "custom_prng": lambda: _settled("jax_enable_custom_prng", True),
    "key reuse": lambda: _settled("jax_debug_key_reuse", True),
    "log_compiles": lambda: jax.log_compiles(True),
    "explain_cache_misses": lambda: _settled("jax_explain_cache_misses", True),
    "traceback_filtering": lambda: _settled("jax_traceback_filtering", "off"),
}


def numbers(call: Callable) -> list | str:
    """Return the numbers of a call, or the error that it raises."""
    try:
        result = call()
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    leaves = [np.asarray(x) for x in jax.tree.leaves(result)]
    return [np.asarray(x, float).ravel().tolist() for x in leaves]


def tried(names: list[str]) -> dict[str, list | str]:
    return {name: numbers(CALLS[name]) for name in names}


def late(names: list[str]) -> dict[str, dict[str, list | str]]:
    """Return the numbers in single precision, in double, again after caches are cleared, and in both by turns."""
    told = {"single": tried(names)}
    jax.config.update("jax_enable_x64", True)
    told["double"] = tried(names)
    jax.clear_caches()
    told["cleared"] = tried(names)
    with jax.enable_x64(False):
        told["single within"] = tried(names)
    told["double again"] = tried(names)
    return told


def main(words: list[str]) -> int:
    settings, names = words[0].split(","), words[1].split(";") if len(words) > 1 else list(CALLS)
    warnings.simplefilter("ignore")
    if settings == ["late"]:
        told = late(names)
    else:
        jax.config.update("jax_enable_x64", True)
        jax.config.update("jax_num_cpu_devices", 2)
        told = {}
        for setting in settings:
            with SETTINGS[setting]():
                told[setting] = tried(names)
    print(json.dumps(told))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
