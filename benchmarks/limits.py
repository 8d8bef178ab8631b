"""How far from the machine's limit: `python benchmarks/limits.py` writes `limits.md`.

Counts the steps that the scenes of `peers.py` take, and the operations of a step, and times the scenes: so many
multiplications and additions a second, of those that the cores can do (a product of matrices).
"""

import collections
import functools
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from common import least_time, table  # first: the search path and double precision
from peers_solvers import jaxrock_api
from peers_solvers.report import surroundings

import jaxrock as rk
from jaxrock.compiler.primitive.macro import expand, is_macro
from jaxrock.engines.taylor import expansion, fast
from jaxrock.engines.taylor.event_free_step import EventFreeSteps, flush_error, onward
from jaxrock.engines.taylor.fast_loop import most_steps
from jaxrock.responses import outcome
from references import peer_problems as problems
from references.in_jaxrock import MODELS

HERE = Path(__file__).parent
SUMS, SLOW = ("mul", "add", "sub", "neg", "integer_pow"), ("div", "sqrt", "exp", "expm1", "log", "atan2")
CASES = (("P1", 0), ("P2", 0), ("P3", 0), ("P4", 0), ("P5", 0), ("P6", 0))
SAMPLE = 512  # scenes whose steps are counted


def operations(jaxpr, branches=False, found=None):
    """How often each operation stands in a program; with `branches`, also in those that a step may skip."""
    found = collections.Counter() if found is None else found
    for equation in jaxpr.eqns:
        values = [p for value in equation.params.values() for p in (value if isinstance(value, tuple) else (value,))]
        programs = [getattr(p, "jaxpr", p) for p in values if hasattr(getattr(p, "jaxpr", p), "eqns")]
        if is_macro(equation.primitive.name):
            programs = [expand(equation.primitive.name, [x.aval for x in equation.invars], equation.params).jaxpr]
        if equation.primitive.name == "cond" and not branches:
            continue
        if not programs:
            found[equation.primitive.name] += 1
        for program in programs:
            operations(program, branches, found)
    return found


def scene_of(problem):
    """One scene of a problem, from a row of its columns: block and motion."""
    if problem.motion == "record":
        record = rk.Record(problem.samples, problem.dt)
        return lambda alpha, p, restitution, amplitude, rate: (rk.Block(alpha, p, restitution), record)
    pulse = rk.SinePulse if problem.motion == "sine" else jaxrock_api.exponential

    def scene(alpha, p, restitution, amplitude, rate):
        return rk.Block(alpha, p, restitution), pulse(amplitude, 2 * np.pi / rate)

    return scene


def begun(problem, columns):
    """A scene at its start: what steps it, and its state."""
    passes = outcome._OutcomePasses(rounds=problem.motion == "record")
    block, motion = scene_of(problem)(*columns)
    return passes.init((block, motion, MODELS[problem.model], (0.0, 0.0), rk.Series()))


def steps(problem):
    """Mean numbers of steps of a scene: rocking, at rest, and of the first those that take care: under a record those
    that do not glide, else those that an event ends."""
    is_record = problem.motion == "record"

    def one(columns):
        stepper, state = begun(problem, columns)
        strongest = stepper.scene.outlook.strongest_drive

        def cared(state, glide):
            state = flush_error(stepper, state, glide, strongest)
            rests = state.side == 0
            after = jax.lax.cond(rests, lambda: fast.certain_wait(stepper, state), lambda: fast.advance(stepper, state))
            return after, EventFreeSteps.of(stepper, after)

        def step(carry):
            (state, glide), rocking, waiting, careful = carry
            if is_record:
                after = jax.lax.cond(glide.goes, lambda: onward(stepper, state, glide), lambda: cared(state, glide))
                moved, cares = after[0].steps > state.steps, ~glide.goes
            else:
                after = cared(state, glide)
                moved, cares = True, (after[0].impacts > state.impacts) | (after[0].piece == state.piece)
            rests = state.side == 0
            return after, rocking + (moved & ~rests), waiting + rests, careful + (cares & ~rests)

        zero = jnp.int32(0)
        limit = most_steps(stepper.scene.most_pieces)
        going = lambda carry: ~carry[0][0].done & (carry[0][0].steps < limit)  # noqa: E731
        first = (state, EventFreeSteps.of(stepper, state))
        return jax.lax.while_loop(going, step, (first, zero, zero, zero))[1:]

    drawn = np.random.default_rng(0).choice(problem.size, min(SAMPLE, problem.size), replace=False)
    columns = tuple(jnp.asarray(values) for values in problem.columns(np.sort(drawn)))
    return [float(np.mean(count)) for count in jax.jit(jax.vmap(one))(columns)]


def counts(problem):
    """Operations of a rocking step: of its series, of what it always does (under a record: of a glide over a piece),
    and with all that it may do."""
    columns = tuple(jnp.asarray(values[0]) for values in problem.columns(slice(1)))
    stepper, state = begun(problem, columns)
    state = jax.tree.map(jnp.asarray, state)

    def series(state):
        shaking, unit = stepper.shaking(state.piece, state.local)
        return expansion.taylor_expansion(stepper.start(state, shaking, unit), stepper.order).opening

    def glided(state):
        return onward(stepper, state, EventFreeSteps.of(stepper, state))

    whole = functools.partial(fast.advance, stepper)
    of_series, of_step = (jax.make_jaxpr(f)(state).jaxpr for f in (series, whole))
    always = jax.make_jaxpr(glided)(state).jaxpr if problem.motion == "record" else of_step
    return [operations(of_series), operations(always), operations(of_step, branches=True)]


def peak():
    """Multiplications and additions that the cores do in a second, in a product of matrices."""
    size = 2048
    a = jnp.asarray(np.random.default_rng(0).normal(size=(size, size)))
    product = jax.jit(lambda a: a @ a)
    return 2 * size**3 / least_time(lambda: product(a).block_until_ready(), 10, 5.0)


def number(count):
    """A counter's sums and products, and its slow operations."""
    return sum(count[name] for name in SUMS), sum(count[name] for name in SLOW)


def row(problem, most):
    """One line of the table."""
    rocking, waiting, careful = steps(problem)
    (series, _), (always, slow), (possible, _) = map(number, counts(problem))
    (_, _, solve), *_ = [way for way in jaxrock_api.ways(problem) if way[1] == "default"]
    solve()
    time.sleep(0.1)
    rate = problem.size / least_time(solve, 30, 3.0)
    done, bound = rate * rocking * always, most / (rocking * series)
    return [
        problem.name, f"{rocking:.3g}", f"{careful:.3g}", f"{waiting:.3g}", f"{series}", f"{always}", f"{slow}",
        f"{possible}", f"{rate:.3g}", f"{done / most:.0%}", f"{bound:.3g}", f"{bound / rate:.2g}",
    ]  # fmt: skip


HEADER = (
    "problem", "steps, rocking", "of them with care", "at rest", "+ and x of the series",
    "+ and x always done", "divisions and roots always done", "+ and x with all that a step may do", "scenes/s",
    "of the peak", "limit [scenes/s]", "limit over speed",
)  # fmt: skip

PAGE = """# How far from the machine's limit

Written by `python benchmarks/limits.py`, {machine}.

The problems of [peers](peers.md), by default settings (errors below 1e-11). Steps are means of {sample} scenes,
operations are counted in the program of one step (multiplications and additions; a product that is added at once counts
as two, as it does in the peak). With care: under a record those that do not glide, else those that an event ends. What
a step always does: under a record what a glide does. Peak: {peak:.3g} multiplications and additions a second, of all
cores in a product of matrices. "Of the peak": what all steps always do. The limit: nothing but the series of these
steps, at the peak.

{table}

What is between the limit and the speed: under pulses an event in some lane of a vector makes all of its 16 wait for
its root; under records lanes part for that, and are collected and put back, by code that does not fit the first cache
of instructions; a series is a chain in which every coefficient waits for the one before; signs are certified, errors
are carried along, and divisions and roots take as long as ten products. Linear blocks (P6) glide without a series, by
hyperbolic functions: there it counts for more that the slots of lanes that part are loaded every few pieces.
"""


def main():
    """Write the page."""
    rk.keep_compiled()
    most = peak()
    rows = []
    for name, place in CASES:
        rows.append(row(problems.load(name)[place], most))
        print(*rows[-1], sep=" | ", flush=True)
    page = PAGE.format(machine=surroundings(), sample=SAMPLE, peak=most, table=table(list(HEADER), rows))
    (HERE / "limits.md").write_text(page)


if __name__ == "__main__":
    main()
