"""Many scenes by the diffrax engine: `python benchmarks/diffrax_lanes.py` writes `diffrax_lanes.md`.

2,000 nonlinear sine pulses drawn from a map of `peers.py`, and the same with a damper, in an `Equation` as users write
it; beside them a vmapped `diffrax.Event` loop (`peers_solvers/diffrax_loop.py`). Errors: against `rk.Series()`, of the
damper against `rtol=1e-13`. A minute.
"""

import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from common import least_time, table  # first: the search path and double precision
from peers_solvers import diffrax_loop
from peers_solvers.report import small, surroundings

import jaxrock as rk
from references import peer_problems as problems

SCENES = 2000
DAMPED = rk.models.Equation(
    lambda x, b: jnp.sin(b.alpha - x), lambda x, b: jnp.cos(b.alpha - x), lambda x, v, b: 0.05 * v
)


def solver(model, engine):
    """Peaks over alpha of scenes, NaN where one is refused."""

    def one(alpha, p, restitution, amplitude, rate):
        found = rk.outcome(
            rk.Block(alpha, p, restitution), rk.SinePulse(amplitude, 2 * jnp.pi / rate), model, engine=engine
        )
        return jnp.where(found.status == rk.Status.successful, found.max_rotation / alpha, jnp.nan)

    return jax.jit(jax.vmap(one))


def row(words, run, reference):
    """One line of the table."""
    start = time.perf_counter()
    found = np.asarray(run())
    first = time.perf_counter() - start
    both = np.isfinite(found) & np.isfinite(reference)
    refused, wrong = np.isnan(found), (np.isinf(found) != np.isinf(reference)) & ~np.isnan(found) & ~np.isnan(reference)
    best = least_time(lambda: np.asarray(run()), 5, 5.0)
    print(words, f"{SCENES / best:.3g}/s", flush=True)
    off = np.abs(found[both] - reference[both]).max()
    return [words, f"{SCENES / best:,.0f}", small(off), str(int(wrong.sum())), str(int(refused.sum())), f"{first:.1f}"]


def main():
    """Write the page."""
    problem = problems.load("P1")[0]
    chosen = np.random.default_rng(1).choice(problem.size, SCENES, replace=False)
    columns = [jnp.asarray(values) for values in problem.columns(chosen)]
    exact = np.asarray(solver(rk.Housner(), rk.Series())(*columns))
    damped = np.asarray(solver(DAMPED, rk.Diffrax(rtol=1e-13))(*columns))
    rows = []
    for words, model, reference in (("Housner", rk.Housner(), exact), ("`Equation` with a damper", DAMPED, damped)):
        for rtol in (1e-7, 1e-12):
            solve = solver(model, rk.Diffrax(rtol=rtol))
            rows.append(row(f"`rk.Diffrax(rtol={rtol:g})`, {words}", lambda: solve(*columns), reference))  # noqa: B023
    for _, label, solve in diffrax_loop.ways(problem):
        rows.append(row(f"`diffrax.Event`, vmapped, {label}", lambda: solve(chosen), exact))  # noqa: B023
    header = ["what", "scenes/s", "largest difference", "other verdicts", "refused", "first call [s]"]
    page = f"""# Many scenes by the diffrax engine

Written by `python benchmarks/diffrax_lanes.py`, {surroundings()}.

{SCENES:,} nonlinear sine pulses, wall clock, best of 5; the loop on one device of JAX. The largest difference is that
of peak/alpha to `rk.Series()`, with the damper to `rtol=1e-13`.

{table(header, rows)}
"""
    (Path(__file__).parent / "diffrax_lanes.md").write_text(page)


if __name__ == "__main__":
    main()
