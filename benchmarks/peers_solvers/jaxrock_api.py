"""jaxrock by its public functions: overturning maps, and a sweep of blocks under a record."""

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
    pulse = {"pulse": rk.SinePulse} if problem.motion == "sine" else {"pulse": rk.ExponentialPulse, "shape": problems.SHAPE}
    maps = [
        rk.overturning_map(
            problem.rates, problem.intensities, alpha=problems.ALPHA, restitution=restitution,
            model=MODELS[problem.model], engine=engine, progress=False, **pulse,
        )
        for restitution in problem.restitutions
    ]  # fmt: skip
    return np.concatenate([np.where(m.status == rk.Status.successful, m.max_rotation, np.nan).ravel() for m in maps])


def blocks(problem, engine, chosen):
    """The blocks under the record, or one block under it at many scales."""
    record, model = rk.Record(problem.samples, problem.dt), MODELS[problem.model]

    def one(alpha, p):
        return rk.outcome(rk.Block(alpha, p, problems.RESTITUTION), record, model, engine=engine)

    def of_scale(scale):
        block = rk.Block(problem.alpha[0], problem.p[0], problems.RESTITUTION)
        return rk.outcome(block, scale * record, model, engine=engine)

    alpha, p, _, scale, _ = problem.columns(chosen)
    if problem.name == "P7":
        found = rk.sweep(of_scale, outer=False, progress=False, scale=scale).values
        return np.where(found.status == rk.Status.successful, found.max_rotation, np.nan) / problem.alpha[0]
    if hasattr(rk, "sweep"):
        found = rk.sweep(one, outer=False, progress=False, alpha=alpha, p=p).values
    else:
        found = jax.jit(jax.vmap(one))(alpha, p)
    return np.where(found.status == rk.Status.successful, found.max_rotation, np.nan) / alpha


def scenes(problem, engine, chosen):
    """Single scenes of a map, side by side."""

    def one(restitution, amplitude, rate):
        block = rk.Block(problems.ALPHA, 1.0, restitution)
        pulse = rk.SinePulse if problem.motion == "sine" else exponential
        return rk.outcome(block, pulse(amplitude, 2 * np.pi / rate), MODELS[problem.model], engine=engine)

    alpha, _, *rest = problem.columns(chosen)
    names = ("restitution", "amplitude", "rate")
    found = rk.sweep(one, outer=False, progress=False, **dict(zip(names, rest))).values
    return np.where(found.status == rk.Status.successful, found.max_rotation, np.nan) / alpha


SETTINGS = {
    "pulse": (
        (1e-6, "tolerance 1e-8", {"tolerance": 1e-8}),
        (1e-10, "tolerance 1e-12", {"tolerance": 1e-12}),
        (1e-12, "default", {}),
    ),
    "record": (
        (1e-6, "tolerance 1e-6", {"tolerance": 1e-6}),
        (1e-10, "tolerance 1e-8", {"tolerance": 1e-8}),
        (1e-12, "default", {}),
    ),
}


def ways(problem):
    """The ways to solve a problem: (goal of the error, label, function of the chosen scenes)."""

    def made(engine):
        if problem.motion == "record":
            return lambda chosen=slice(None): blocks(problem, engine, chosen)
        return lambda chosen=slice(None): surface(problem, engine)[chosen]

    settings = SETTINGS["record" if problem.motion == "record" else "pulse"]
    return [(goal, label, made(rk.Series(**words) if words else None)) for goal, label, words in settings]
