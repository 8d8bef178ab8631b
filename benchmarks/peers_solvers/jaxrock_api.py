"""jaxrock by its public functions: overturning maps, and outcomes of many blocks under a record."""

import jax
import numpy as np

import jaxrock as rk
from references import peer_problems as problems
from references.in_jaxrock import MODELS


def exponential(amplitude, duration):
    """The pulse of a map; `duration` is 2 pi/(rate p)."""
    return rk.ExponentialPulse(amplitude, duration, problems.SHAPE)


def surface(problem, engine):
    """A map, one restitution after the other, as a flat array of peaks over alpha."""
    is_sine = problem.motion == "sine"
    pulse = {"pulse": rk.SinePulse} if is_sine else {"pulse": rk.ExponentialPulse, "shape": problems.SHAPE}
    maps = [
        rk.overturning_map(
            problem.rates, problem.intensities, alpha=problems.ALPHA, restitution=restitution,
            model=MODELS[problem.model], engine=engine, progress=False, **pulse,
        )
        for restitution in problem.restitutions
    ]  # fmt: skip
    return np.concatenate([np.where(m.status == rk.Status.successful, m.rotation_ratio, np.nan).ravel() for m in maps])


def under_record(problem, engine):
    """The blocks under the record, or one block under it at many scales: a function of which scenes, compiled once."""
    record, model = rk.Record(problem.samples, problem.dt), MODELS[problem.model]

    @jax.jit
    @jax.vmap
    def each(alpha, p):
        return rk.outcome(rk.Block(alpha, p, problems.RESTITUTION), record, model, engine=engine)

    @jax.jit
    @jax.vmap
    def of_scale(scale):
        block = rk.Block(problem.alpha[0], problem.p[0], problems.RESTITUTION)
        return rk.outcome(block, scale * record, model, engine=engine)

    def solve(chosen=slice(None)):
        alpha, p, _, scale, _ = problem.columns(chosen)
        found = of_scale(scale) if problem.name == "P7" else each(alpha, p)
        return np.where(found.status == rk.Status.successful, found.max_rotation, np.nan) / alpha

    return solve


def under_pulses(problem, engine):
    """Single scenes of a map, side by side: a function of which, compiled once."""

    @jax.jit
    @jax.vmap
    def each(restitution, amplitude, rate):
        block = rk.Block(problems.ALPHA, 1.0, restitution)
        pulse = rk.SinePulse if problem.motion == "sine" else exponential
        return rk.outcome(block, pulse(amplitude, 2 * np.pi / rate), MODELS[problem.model], engine=engine)

    def solve(chosen=slice(None)):
        alpha, _, *rest = problem.columns(chosen)
        found = each(*rest)
        return np.where(found.status == rk.Status.successful, found.max_rotation, np.nan) / alpha

    return solve


SETTINGS = {
    "pulse": (
        (1e-4, "tolerance 1e-6", {"tolerance": 1e-6}),
        (1e-6, "tolerance 1e-8", {"tolerance": 1e-8}),
        (1e-10, "tolerance 1e-12", {"tolerance": 1e-12}),
        (1e-12, "default", {}),
    ),
    "record": (
        (1e-6, "tolerance 1e-8", {"tolerance": 1e-8}),
        (1e-10, "tolerance 1e-10", {"tolerance": 1e-10}),
        (1e-12, "default", {}),
    ),
}


def ways(problem):
    """The ways to solve a problem: (goal of the error, label, function of the chosen scenes)."""

    def made(engine):
        if problem.motion == "record":
            return under_record(problem, engine)
        return lambda chosen=slice(None): surface(problem, engine)[chosen]

    settings = SETTINGS["record" if problem.motion == "record" else "pulse"]
    return [(goal, label, made(rk.Series(**words) if words else None)) for goal, label, words in settings]
