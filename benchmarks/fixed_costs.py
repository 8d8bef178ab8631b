"""What a warm call costs before its first scene: `python benchmarks/fixed_costs.py` writes `fixed_costs.md`.

A surface of one point and of a hundred, and what remains of it when a hundred points more cost what they do where many
are computed; and one scene as a call of its own, and in a batch of one. Best of many calls: nothing else may work.
"""

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from common import least_time, seconds, table  # first: the search path and double precision
from peers_solvers.report import surroundings

import jaxrock as rk

HERE = Path(__file__).parent
CALLS = 400
QUIET = {"progress": False}


def warm(function, argument):
    """Least time of a call whose program there is [s]."""
    np.asarray(function(argument))
    return least_time(lambda: np.asarray(function(argument)), CALLS, 2.0)


def of_sine(slenderness, amplitude):
    """One outcome under a sine."""
    return rk.outcome(rk.Block(slenderness, 2.0, 0.9), rk.SinePulse(amplitude, 1.0))


FREQUENCIES = [2.0]


def of_frequency(slenderness, amplitude):
    """The same; it reads a list."""
    return rk.outcome(rk.Block(slenderness, FREQUENCIES[0], 0.9), rk.SinePulse(amplitude, 1.0))


def surfaces():
    """Functions of the number of points along both axes of what is asked."""

    def over(count):
        return np.linspace(1.1, 5.0, count), np.linspace(1.1, 4.0, count)

    def a_map(count):
        return rk.overturning_map(*over(count), alpha=0.2, restitution=0.9, **QUIET).margin

    def spectrum(count):
        return rk.studies.self_similar_spectrum(*over(count), alpha=0.2, restitution=0.9, **QUIET).margin

    def swept(function, count):
        lists = {"slenderness": np.linspace(0.1, 0.2, count), "amplitude": np.linspace(0.3, 0.5, count)}
        return rk.sweep(function, **lists, **QUIET).values.margin

    swept, traced = functools.partial(swept, of_sine), functools.partial(swept, of_frequency)
    return {
        "`rk.overturning_map`": a_map, "`self_similar_spectrum`": spectrum,
        "`rk.sweep`": swept, "`rk.sweep`, traced": traced,
    }  # fmt: skip


def of_surfaces():
    """Rows of the table of surfaces."""
    for name, surface in surfaces().items():
        one, hundred, many = (warm(surface, count) for count in (1, 10, 64))
        fixed = hundred - 100 * (many - hundred) / (64**2 - 100)
        yield [name, *map(seconds, (one, hundred, many, fixed))]


def of_one():
    """Rows of the table of single scenes: in a compiled function, in a batch of one, and their ratio; and as a call."""
    block, record = rk.Block(0.2, 2.0, 0.9), rk.example_record()
    ways = {
        "a record": lambda scale: rk.outcome(block, scale * record).margin,
        "a sine": lambda scale: rk.outcome(block, rk.SinePulse(scale, 1.0)).margin,
    }
    for name, scene in ways.items():
        single, of_batch = warm(jax.jit(scene), np.array(1.5)), warm(jax.jit(jax.vmap(scene)), np.array([1.5]))
        plain = warm(scene, 1.5)
        yield [name, seconds(single), seconds(of_batch), f"{single / of_batch:.2f}", seconds(plain)]


def restoring(x, block):
    """Of a rigid block, as a user writes it."""
    return jnp.sin(block.alpha - x)


def by_an_equation():
    """Least time of a call with a model of a user's function, less that of the same by a model of the package [s]."""
    block, pulse, engine = rk.Block(0.2, 2.0, 0.9), rk.SinePulse(0.4, 1.2), rk.Diffrax(rtol=1e-4)
    models = rk.models.Equation(restoring), rk.Linear()
    own, known = (warm(lambda model: rk.outcome(block, pulse, model, engine=engine).margin, model) for model in models)
    return seconds(own - known)


PAGE = """# What a call costs before its first scene

Written by `python benchmarks/fixed_costs.py`, {machine}.

Warm calls, the best of up to {calls}. Fixed: of 10 x 10 points, without what these cost where 4,096 are computed.

{surfaces}

`rk.sweep` looks whether what its function reads is what it was, and traces it again if not, or where that cannot be
told (of a function that reads a list, an attribute, an array of NumPy): `rk.sweep`, traced.

One scene in a compiled function, and as a batch of one; as a plain call of a new block or motion, whose numbers are
looked at and placed one by one.

{scenes}

A call by an `Equation` with a function of a user's takes {equation} more than one by a model of the package, of the
same objects again and again.
"""


def main():
    """Write the page."""
    header = ["surface", "1 point", "10 x 10", "64 x 64", "fixed"]
    of_scenes = ["one scene under", "`jit`", "`jit` of `vmap`, one", "ratio", "plain call"]
    page = PAGE.format(
        machine=surroundings(), calls=CALLS,
        surfaces=table(header, list(of_surfaces())), scenes=table(of_scenes, list(of_one())),
        equation=by_an_equation(),
    )  # fmt: skip
    (HERE / "fixed_costs.md").write_text(page)


if __name__ == "__main__":
    main()
