"""One block at a time under the built-in record: `rk.outcome` and the SciPy loop, both on one core."""

import math

import jax
import numpy as np
from common import least_time, seconds, table
from mpmath import mp, mpf

import jaxrock as rk
from references import responses

from . import scipy_loop

SIZES = ((1.0, 5.0), (0.5, 3.0), (0.8, 5.0))  # width x height [m]
LOOPS = ((True, 1e-6), (False, 1e-10), (False, 1e-6))  # whether cut at samples, rtol; atol is a hundredth of it
REPEATS, REPEATS_SCIPY = 20, 5
HEADER = ["block", "solver", "rtol", "peak/alpha", "error of peak/alpha", "verdict", "time", "time/jaxrock"]


def error_of(peak, known):
    """|peak - reference| over alpha; None where one of them overturns."""
    if known["peak"] is None or math.isinf(peak):
        return None
    with mp.workdps(30):
        return float(abs(mpf(float(peak)) - mpf(known["peak"])))


def ways(block, numbers, record):
    """Solver, its tolerance, how often to time it, and a function that gives peak over alpha."""
    samples, dt = np.asarray(record.samples).tolist(), float(record.dt)

    def outcome():
        found = jax.block_until_ready(rk.outcome(block, record))
        if found.status != rk.Status.successful:
            raise RuntimeError(f"jaxrock: {rk.Status[found.status]}")
        return math.inf if found.overturned else float(found.max_rotation) / numbers[0]

    yield "jaxrock", "default", REPEATS, outcome
    for cut, rtol in LOOPS:
        motion, settings = scipy_loop.Record(samples, dt, cut), scipy_loop.settings_of(rtol, 1e-2 * rtol)
        name = "SciPy, cut at samples" if cut else "SciPy, steps ≤ dt"
        yield (
            name, f"{rtol:.0e}", REPEATS_SCIPY,
            lambda motion=motion, settings=settings: scipy_loop.follow(*numbers, motion, False, settings),
        )  # fmt: skip


def measure():
    """Rows for `peers.json`, a solver of a block each."""
    record, rows = rk.example_record(), []
    for size in SIZES:
        block = rk.Block.from_dimensions(*size)
        numbers = tuple(float(x) for x in (block.alpha, block.p, block.restitution))
        scene = (numbers, "record", (np.asarray(record.samples), float(record.dt)))
        known = responses.kept([scene])[0]
        for name, tolerance, repeats, solve in ways(block, numbers, record):
            peak, best = solve(), least_time(solve, repeats)
            error = error_of(peak * numbers[0], known)
            rows.append({
                "block": f"{size[0]} m x {size[1]} m", "solver": name, "rtol": tolerance, "seconds": best,
                "peak": None if math.isinf(peak) else peak, "error": error and error / numbers[0],
                "right": math.isinf(peak) == known["overturned"],
            })  # fmt: skip
            print(f"{rows[-1]}", flush=True)
    return rows


def text(rows):
    """The table of the rows."""
    own = {row["block"]: row["seconds"] for row in rows if row["solver"] == "jaxrock"}
    cells = [
        [
            row["block"] if row["solver"] == "jaxrock" else "", row["solver"], row["rtol"],
            "overturned" if row["peak"] is None else f"{row['peak']:.6f}",
            "-" if row["error"] is None else f"{row['error']:.1e}",
            "right" if row["right"] else "WRONG",
            seconds(row["seconds"]), f"{row['seconds'] / own[row['block']]:.3g}",
        ]
        for row in rows
    ]  # fmt: skip
    return table(HEADER, cells)
