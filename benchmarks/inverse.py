"""What the inverse estimates are worth: coverage of intervals, errors, times, and the fit beside a brute-force grid.

    python benchmarks/inverse.py coverage --rocks 20 --repetitions 400
    python benchmarks/inverse.py times
    python benchmarks/inverse.py grid
    python benchmarks/inverse.py posterior

Synthetic rocks are drawn anew in every repetition: sizes and shapes, then their true alpha, p and the factor on the
motion at each of them, by the same rules by which the likelihood takes them to scatter. Truth is judged by the verdict
of `outcome` alone.
"""

import argparse
import time

import jax
import numpy as np

import jaxrock as rk
from jaxrock.problem import Evaluator, Problem

TRUTH = {"amplitude": 0.35, "period": 0.8}


def unknowns() -> dict[str, rk.Unknown]:
    """What is looked for, and where; made when numbers are double."""
    return {"amplitude": rk.Unknown(0.05, 2.0), "period": rk.Unknown(0.2, 3.0)}


def _fallen(alpha, p, amplitude, period):
    return {"fallen": rk.outcome(rk.Block(alpha, p), rk.SinePulse(amplitude, period)).overturned}


def synthetic(count: int, rng: np.random.Generator, scatter: float) -> rk.Observations:
    """Rocks of many shapes and sizes, and what became of them."""
    alpha, p = rng.uniform(0.08, 0.35, count), rng.uniform(1.8, 5.0, count)
    e = rng.normal(size=(3, count))
    found = rk.sweep(
        _fallen,
        outer=False,
        progress=False,
        alpha=alpha * np.exp(0.03 * e[0]),
        p=p * np.exp(0.02 * e[1]),
        amplitude=TRUTH["amplitude"] * np.exp(scatter * e[2]),
        period=np.full(count, TRUTH["period"]),
    )
    words = ["toppled" if x else "survived" for x in found.values["fallen"]]
    return rk.Observations(alpha, p, words, alpha_sd=0.03 * alpha, p_sd=0.02 * p)


def coverage(rocks: int, repetitions: int, scatter: float, starts: int, seed: int) -> None:
    """How often 95 % intervals hold the truth, and how far off estimates are."""
    rng, begun = np.random.default_rng(seed), time.monotonic()
    held, errors, status, contradictory = [], [], [], 0
    for number in range(1, repetitions + 1):
        found = rk.estimate_motion(
            synthetic(rocks, rng, scatter), rk.SinePulse, unknowns(), scatter, starts=starts, progress=False
        )
        contradictory += bool(found.status == rk.EstimateStatus.contradictory)
        truth = np.array([TRUTH[name] for name in found.names])
        held.append((np.asarray(found.interval)[:, 0] <= truth) & (truth <= np.asarray(found.interval)[:, 1]))
        errors.append(np.log(np.asarray(found.values) / truth))
        status.append(bool(found.open.any()))
        if number % 20 == 0 or number == repetitions:
            size = np.median(np.abs(errors), axis=0)
            print(
                f"{number} repetitions of {rocks} rocks, scatter {scatter:g}: held {np.mean(held, axis=0)}, median "
                f"|ln error| {size}, open {np.mean(status):.2f}, contradictory {contradictory}, "
                f"{time.monotonic() - begun:.0f} s",
                flush=True,
            )


def times(rocks: int, starts: int) -> None:
    """A full fit of an exponential pulse: three parameters."""
    rng = np.random.default_rng(0)
    seen = synthetic(rocks, rng, 0.2)
    three = {
        "amplitude": rk.Unknown(0.05, 2.0),
        "duration": rk.Unknown(0.1, 3.0),
        "shape": rk.Unknown(-6, 6, log=False),
    }
    for name in ("first", "again"):
        begun = time.monotonic()
        found = rk.estimate_motion(seen, rk.ExponentialPulse, three, 0.2, starts=starts, progress=False)
        spent = time.monotonic() - begun
        print(f"{name}: {rocks} rocks, 3 parameters, {starts} starts: {spent:.1f} s, {found.responses:,} responses")


def grid(rocks: int, points: int) -> None:
    """The maximum of the likelihood by the fit, and by a grid that is refined around its best point."""
    seen = synthetic(rocks, np.random.default_rng(4), 0.2)
    found = rk.estimate_motion(seen, rk.SinePulse, unknowns(), 0.2, starts=64, progress=False)
    evaluate = Evaluator(Problem(rk.Likelihood(seen, rk.SinePulse, 0.2), unknowns()))
    low, high = (x.copy() for x in evaluate.ends)
    for _ in range(9):
        axes = [np.linspace(a, b, points) for a, b in zip(low, high)]
        places = np.stack([x.ravel() for x in np.meshgrid(*axes)], axis=1)
        values = evaluate(evaluate.points(places))[0]
        best, size = places[np.argmax(values)], (high - low) / 8
        low, high = np.maximum(best - size, evaluate.ends[0]), np.minimum(best + size, evaluate.ends[1])
    ratio = evaluate.count / (found.responses / (13 * rocks))
    print(
        f"fit {float(found.log_likelihood):.9f}, grid {values.max():.9f}; the grid took {ratio:.0f} times the "
        f"responses (and the fit's include its intervals)"
    )


def posterior(rocks: int) -> None:
    """Samples of a posterior distribution."""
    seen = synthetic(rocks, np.random.default_rng(5), 0.2)
    begun = time.monotonic()
    found = rk.sample_motion(seen, rk.SinePulse, unknowns(), 0.2)
    print(
        f"{time.monotonic() - begun:.0f} s, effective size {np.asarray(found.effective_size)}, "
        f"R-hat {np.asarray(found.r_hat)}, {found.divergences} divergences, intervals {found.interval()}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("coverage", "times", "grid", "posterior"))
    parser.add_argument("--rocks", type=int, default=20)
    parser.add_argument("--repetitions", type=int, default=400)
    parser.add_argument("--scatter", type=float, default=0.1)
    parser.add_argument("--starts", type=int, default=16)
    parser.add_argument("--points", type=int, default=64)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if given.what == "coverage":
        coverage(given.rocks, given.repetitions, given.scatter, given.starts, given.seed)
    elif given.what == "times":
        times(100, 64)
    elif given.what == "grid":
        grid(given.rocks, given.points)
    else:
        posterior(given.rocks)


if __name__ == "__main__":
    main()
