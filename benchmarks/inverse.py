"""What the inverse estimates are worth: coverage of intervals, errors, times, and the fit beside a brute-force grid.

    python benchmarks/inverse.py coverage --repetitions 400 [--spanning]
    python benchmarks/inverse.py times
    python benchmarks/inverse.py grid
    python benchmarks/inverse.py posterior --rocks 100
    python benchmarks/inverse.py samplers
    python benchmarks/inverse.py probabilities
    python benchmarks/inverse.py optimizers [--rocks 100 --starts 64]

Each adds what it measured to inverse.json and writes inverse.md from all of it; what is done of a coverage is kept,
and goes on from there. Synthetic rocks are drawn anew in every repetition: sizes and shapes, then their true alpha, p
and the factor on the motion at each of them, by the same rules by which the likelihood takes them to scatter. Truth is
judged by the verdict of `outcome` alone. Rocks that span the boundary are those, of many drawn like this, that stand
under 3/4 of the true amplitude and fall under 4/3 of it, as they are stated. Beside the errors stands what no unbiased
estimate can do better (Cramer-Rao, by the likelihood at the truth).
"""

import argparse
import json
import time
from pathlib import Path

import inverse_report
import jax
import jax.numpy as jnp
import numpy as np

import jaxrock as rk
from jaxrock.inverse.scatter import rocks_at
from jaxrock.inverse.unknowns import Problem

TRUTH = {"amplitude": 0.35, "period": 0.8}
KEPT = Path(__file__).with_suffix(".json")
WHAT = ("coverage", "times", "grid", "posterior", "samplers", "probabilities", "optimizers")


def unknowns() -> dict[str, rk.inverse.Unknown]:
    """What is looked for, and where; made when numbers are double."""
    return {"amplitude": rk.inverse.Unknown(0.05, 2.0), "period": rk.inverse.Unknown(0.2, 3.0)}


def _fallen(alpha, p, amplitude, period):
    return {"fallen": rk.outcome(rk.Block(alpha, p), rk.SinePulse(amplitude, period)).overturned}


def fallen(alpha: np.ndarray, p: np.ndarray, factor: np.ndarray) -> np.ndarray:
    """The verdict on rocks under so many times the true motion."""
    lists = {"alpha": alpha, "p": p, "amplitude": TRUTH["amplitude"] * factor}
    lists["period"] = np.full(alpha.size, TRUTH["period"])
    return rk.sweep(_fallen, outer=False, progress=False, **lists).values["fallen"]


def synthetic(count: int, rng: np.random.Generator, scatter: float, spanning: bool = False) -> rk.inverse.Observations:
    """Rocks of many shapes and sizes, and what became of them."""
    drawn = 20 * count if spanning else count
    alpha, p = rng.uniform(0.08, 0.35, drawn), rng.uniform(1.8, 5.0, drawn)
    if spanning:
        falls = [fallen(alpha, p, np.full(drawn, factor)) for factor in (3 / 4, 4 / 3)]
        kept = np.flatnonzero(~falls[0] & falls[1])[:count]
        alpha, p = alpha[kept], p[kept]
    e = rng.normal(size=(3, count))
    lost = fallen(alpha * np.exp(0.03 * e[0]), p * np.exp(0.02 * e[1]), np.exp(scatter * e[2]))
    words = ["toppled" if x else "survived" for x in lost]
    return rk.inverse.Observations(alpha, p, words, alpha_sd=0.03 * alpha, p_sd=0.02 * p)


def least_deviation(seen: rk.inverse.Observations, scatter: float) -> np.ndarray:
    """Of the logarithm of each parameter: no unbiased estimate has less (Cramer & Rao)."""
    step = 0.02 * np.concatenate([np.zeros((1, 2)), np.eye(2), -np.eye(2)])
    places = {name: x * np.exp(d) for (name, x), d in zip(TRUTH.items(), step.T)}
    share = np.exp(np.asarray(rk.inverse.Likelihood(seen, rk.SinePulse, scatter).log_terms(places, slopes=False)))
    slope = (share[1:3] - share[3:]) / 0.04
    information = (slope / (share[0] * (1 - share[0]))) @ slope.T
    return np.sqrt(np.diagonal(np.linalg.inv(information)))


def coverage(kept: dict, rocks: int, repetitions: int, scatter: float, starts: int, spanning: bool) -> None:
    """Fit until there are so many repetitions; a number seeds each, so that they can go on later."""
    key = f"{rocks} rocks{' that span the boundary' if spanning else ''}, scatter {scatter:g}, {starts} starts"
    rows = kept.setdefault("coverage", {}).setdefault(key, [])
    for number in range(len(rows), repetitions):
        seen = synthetic(rocks, np.random.default_rng([number, rocks]), scatter, spanning)
        begun = time.process_time()
        found = rk.inverse.estimate_motion(seen, rk.SinePulse, unknowns(), scatter, starts=starts, progress=False)
        # The first one compiles.
        spent = time.process_time() - begun if rows else None
        rows.append(
            {
                "values": np.asarray(found.values).tolist(),
                "interval": np.asarray(found.interval).tolist(),
                "open": bool(found.open.any()),
                "contradictory": bool(found.status == rk.inverse.EstimateStatus.contradictory),
                "points": found.responses // rk.inverse.Likelihood(seen, rk.SinePulse, scatter).scenes,
                "cpu": spent,
                "least": least_deviation(seen, scatter).tolist(),
            }
        )
        if (number + 1) % 10 == 0 or number + 1 == repetitions:
            write(kept)


def three() -> dict[str, rk.inverse.Unknown]:
    """What is looked for of an exponential pulse."""
    return {
        "amplitude": rk.inverse.Unknown(0.05, 2.0),
        "duration": rk.inverse.Unknown(0.1, 3.0),
        "shape": rk.inverse.Unknown(-6, 6, log=False),
    }


def times(kept: dict, rocks: int, starts: int) -> None:
    """A full fit of an exponential pulse, three parameters: with compilation, then without."""
    seen = synthetic(rocks, np.random.default_rng(0), 0.2)
    for name in ("first", "again"):
        begun, used = time.monotonic(), time.process_time()
        found = rk.inverse.estimate_motion(seen, rk.ExponentialPulse, three(), 0.2, starts=starts, progress=False)
        row = {"wall": time.monotonic() - begun, "cpu": time.process_time() - used, "responses": found.responses}
        kept.setdefault("times", {})[f"{rocks} rocks, {starts} starts, {name}"] = row
        write(kept)


def posterior(kept: dict, rocks: int) -> None:
    """Samples of the same posterior: with compilation, but without the fit in whose maxima they begin."""
    seen = synthetic(rocks, np.random.default_rng(0), 0.2)
    found = rk.inverse.estimate_motion(seen, rk.ExponentialPulse, three(), 0.2, starts=16, progress=False)
    begun, used = time.monotonic(), time.process_time()
    drawn = rk.inverse.sample_motion(seen, rk.ExponentialPulse, three(), 0.2, estimate=found, progress=False)
    kept.setdefault("posterior", {})[f"{rocks} rocks"] = {
        "wall": time.monotonic() - begun,
        "cpu": time.process_time() - used,
        "samples": int(np.prod(drawn.samples.shape[:2])),
        "responses": drawn.responses,
        "size": float(drawn.effective_size.min()),
        "r_hat": float(drawn.r_hat.max()),
    }
    write(kept)


def samplers(kept: dict, rocks: int = 20) -> None:
    """Effective samples a second of `sample_motion`, by own chains and by samplers of other libraries, and of tempered
    particles; everything from the same maxima, compilation in it. Each is stored when it has ended."""
    import blackjax
    from numpyro.infer import NUTS

    seen = synthetic(rocks, np.random.default_rng(0), 0.2)
    given = {"scatter": 0.2, "progress": False}
    found = rk.inverse.estimate_motion(seen, rk.ExponentialPulse, three(), starts=16, **given)

    def drawn_by(sampler, steps):
        drawn = rk.inverse.sample_motion(
            seen, rk.ExponentialPulse, three(), estimate=found, sampler=sampler, steps=steps, **given
        )
        size, r_hat = float(drawn.effective_size.min()), float(drawn.r_hat.max())
        return (
            size,
            r_hat,
            drawn.responses // rk.inverse.Likelihood(seen, rk.ExponentialPulse, 0.2).scenes,
            np.asarray(drawn[drawn.names[0]]),
        )

    def nuts_of_blackjax(density):
        scale = jnp.asarray(np.std(of_own[1], axis=0) ** 2)  # what its own warm-up would have to find
        return blackjax.nuts(density, 0.4, scale)

    density = rk.inverse.log_density(seen, rk.ExponentialPulse, three(), scatter=0.2)
    own = rk.inverse.sample_motion(seen, rk.ExponentialPulse, three(), estimate=found, **given)
    of_own = own, np.asarray(density.point({name: own[name] for name in own.names}))
    methods = {
        "own chains": lambda: drawn_by(None, 4000),
        "tempered SMC of BlackJAX, 500 particles": lambda: _tempered(density, 500),
        "NUTS of NumPyro, 8 chains": lambda: drawn_by(lambda d: NUTS(potential_fn=lambda x: -d(x)), 250),
        "NUTS of BlackJAX, 8 chains, scaled by own samples": lambda: drawn_by(nuts_of_blackjax, 250),
    }
    rows = kept["samplers"] = {}
    for name, method in methods.items():
        jax.clear_caches()
        begun, used = time.monotonic(), time.process_time()
        size, r_hat, points, first = method()
        spent = {"wall": time.monotonic() - begun, "cpu": time.process_time() - used}
        told = {"mean": float(np.log(first).mean()), "sd": float(np.log(first).std())}
        rows[name] = {"size": size, "r_hat": r_hat, "points": points, **spent, **told}
        write(kept)


def _tempered(density: rk.inverse.LogDensity, particles: int) -> tuple[float, None, int, np.ndarray]:
    """The recipe of docs/inverse.md; particles that are alike count once, others as if they were independent."""
    import blackjax
    from blackjax.smc import resampling

    size, moves, steps = len(density.names), 5, 5

    def prior(point):
        return jnp.sum(jax.nn.log_sigmoid(point) + jax.nn.log_sigmoid(-point), axis=-1)

    settings = {"step_size": 0.3, "inverse_mass_matrix": jnp.eye(size), "num_integration_steps": steps}
    kernel = blackjax.hmc.build_kernel(), blackjax.hmc.init, blackjax.smc.extend_params(settings)
    smc = blackjax.adaptive_tempered_smc(
        prior, density.objective, *kernel, resampling.systematic, 0.5, num_mcmc_steps=moves
    )
    state, key, step, points = smc.init(density.starts(particles)), jax.random.key(0), jax.jit(smc.step), 0
    while state.tempering_param < 1:
        key, one = jax.random.split(key)
        state, _ = step(one, state)
        points += particles * moves * (steps + 1)
    distinct = len(np.unique(np.asarray(state.particles), axis=0))
    return float(distinct), None, points, np.asarray(density.values(state.particles)[density.names[0]])


def probabilities(kept: dict, rocks: int = 60, draws: int = 10_000) -> None:
    """Probabilities that rocks stand, beside the share of drawn scenes in which they do, by the verdict."""
    kept["probabilities"] = []
    known = (0.1, 0, 0), (0.3, 0, 0), (1, 0, 0), (0.1, 0.03, 0.02), (0.1, 0.1, 0.05), (0.3, 0.2, 0.1)
    for scatter, alpha_sd, p_sd in known:
        rng = np.random.default_rng(11)
        alpha, p = rng.uniform(0.08, 0.35, rocks), rng.uniform(1.8, 5.0, rocks)
        period, strength = np.exp(rng.uniform(np.log(0.3), np.log(2.5), rocks)), np.exp(rng.uniform(0, 1.5, rocks))
        found, counted = [], []
        for a, b, t, x in zip(alpha, p, period, np.tan(alpha) * strength):
            seen = rk.inverse.Observations([a], [b], ["survived"], alpha_sd=alpha_sd * a, p_sd=p_sd * b)
            e = rng.normal(size=(3, draws))
            scenes = rocks_at(seen, np.stack([alpha_sd * e[0], p_sd * e[1], 0 * e[1]])[..., None])
            lists = dict(zip(("alpha", "p", "restitution"), (np.ravel(y) for y in scenes)))
            lists |= {"amplitude": x * np.exp(scatter * e[2]), "period": np.full(draws, t)}
            counted.append(1 - rk.sweep(_fallen_block, outer=False, progress=False, **lists).values["fallen"].mean())
            likelihood = rk.inverse.Likelihood(seen, rk.SinePulse, scatter, lapse=0.0)
            found.append(float(likelihood.survival({"amplitude": x, "period": t})[0]))
        error = np.array(found) - np.array(counted)
        row = {"scatter": scatter, "alpha": alpha_sd, "p": p_sd, "rms": float(np.sqrt(np.mean(error**2)))}
        kept["probabilities"].append(row | {"worst": float(np.max(np.abs(error))), "mean": float(error.mean())})
    write(kept)


def _fallen_block(alpha, p, restitution, amplitude, period):
    return {"fallen": rk.outcome(rk.Block(alpha, p, restitution), rk.SinePulse(amplitude, period)).overturned}


def grid(kept: dict, rocks: int, points: int) -> None:
    """The maximum of the likelihood by the fit, and by two grids.

    A plain one of so many points along each axis. And one so fine that its best point is no more than 1e-6 below the
    maximum wherever that lies between its points: its spacing comes from the covariance at the maximum. Of that grid
    only the points around the maximum are computed.
    """
    seen = synthetic(rocks, np.random.default_rng([5, rocks]), 0.1)
    found = rk.inverse.estimate_motion(seen, rk.SinePulse, unknowns(), 0.1, starts=16, progress=False)
    problem = Problem(rk.inverse.Likelihood(seen, rk.SinePulse, 0.1), unknowns())
    density = jax.jit(lambda problem, places: problem.log_density(places, slopes=False))
    low, high = np.asarray(problem.ends).T

    def best(axes):
        places = np.stack([x.ravel() for x in np.meshgrid(*axes)], axis=1)
        parts = places.reshape(-1, places.shape[0] // points, places.shape[1])
        return max(float(density(problem, part).max()) for part in parts)

    plain = best([np.linspace(a, b, points) for a, b in zip(low, high)])
    curvature = np.linalg.inv(np.asarray(found.covariance))
    spacing = 2 * np.sqrt(2e-6 / curvature.sum())  # from the middle of a cell to its corners 1e-6
    summit = np.log(np.asarray(found.values))
    near = [a + spacing * (np.round((x - a) / spacing) + np.arange(points) - points // 2) for a, x in zip(low, summit)]
    kept["grid"] = {
        "rocks": rocks,
        "points": points,
        "fit": float(found.log_likelihood),
        "plain": plain,
        "fine": best(near),
        "fit_points": found.responses // problem.likelihood.scenes,
        "fine_points": float(np.prod((high - low) / spacing)),
        "spacing": float(spacing),
    }
    write(kept)


def optimizers(kept: dict, rocks: int, starts: int) -> None:
    """Own climbers beside optimisers of other libraries, from the same starts: how high they come, points, and
    processor time of a search when everything is compiled. Each is stored when it has ended."""
    import optax
    import optimistix

    from jaxrock.inverse.scan import scan, starts as best_of_a_scan
    from jaxrock.inverse.search import summits_of
    from jaxrock.inverse.unknowns import Evaluator

    many = rocks > 50
    pulse, sought, scatter = (rk.ExponentialPulse, three(), 0.2) if many else (rk.SinePulse, unknowns(), 0.1)
    seen = synthetic(rocks, np.random.default_rng(0 if many else [5, rocks]), scatter)
    problem = Problem(rk.inverse.Likelihood(seen, pulse, scatter), sought)
    scanned = Evaluator(problem)
    scan(scanned, 16 * starts)  # as an estimate does
    begin = best_of_a_scan(scanned, starts)
    methods = {
        "own climbers": None,
        "optimistix.BFGS": optimistix.BFGS(rtol=1e-6, atol=1e-6),
        "SciPy L-BFGS-B": "SciPy",
    }
    methods["optax.adam(0.1)"] = optax.adam(0.1)
    if not many:
        methods |= {"optax.adam(0.3)": optax.adam(0.3), "optax.lbfgs": optax.lbfgs()}
    rows = kept.setdefault("optimizers", {})[f"{rocks} rocks, {len(sought)} parameters, {starts} starts"] = {}
    for name, method in methods.items():
        search = _by_scipy if method == "SciPy" else lambda *given, method=method: summits_of(*given, method).values
        search(Evaluator(problem), begin[:8])  # compiles
        evaluate, used = Evaluator(problem), time.process_time()
        values = search(evaluate, begin)
        rows[name] = [float(np.max(values)), evaluate.count, time.process_time() - used]
        write(kept)


def _by_scipy(evaluate, starts: np.ndarray) -> list[float]:
    """One start after the other, and one point in each call of the compiled program, within bounds."""
    from scipy.optimize import minimize

    from jaxrock.inverse.unknowns import _batch

    low, high = evaluate.ends
    size = high - low

    def loss(share):
        value, slope = (np.asarray(x)[0] for x in _batch(evaluate.problem, (low + size * share)[None])[:2])
        evaluate.note((low + size * share)[None], value[None])
        return -float(value), -slope * size

    shares = (evaluate.places(starts) - low) / size
    bounds = [(0.0, 1.0)] * low.size
    return [-minimize(loss, share, jac=True, method="L-BFGS-B", bounds=bounds).fun for share in shares]


def write(kept: dict) -> None:
    """Keep what was measured, and say it."""
    KEPT.write_text(json.dumps(kept) + "\n")
    KEPT.with_suffix(".md").write_text(inverse_report.text(kept, TRUTH))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=WHAT)
    parser.add_argument("--rocks", type=int, help="default 20; 100 for times")
    parser.add_argument("--repetitions", type=int, default=400)
    parser.add_argument("--scatter", type=float, default=0.1)
    parser.add_argument("--starts", type=int, help="default 8; 64 for times, 16 for optimizers")
    parser.add_argument("--spanning", action="store_true", help="rocks near the boundary")
    parser.add_argument("--points", type=int, default=256, help="of the plain grid, along each axis")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    kept = json.loads(KEPT.read_text()) if KEPT.exists() else {}
    if given.what == "coverage":
        coverage(kept, given.rocks or 20, given.repetitions, given.scatter, given.starts or 8, given.spanning)
    elif given.what == "times":
        times(kept, given.rocks or 100, given.starts or 64)
    elif given.what == "posterior":
        posterior(kept, given.rocks or 20)
    elif given.what == "samplers":
        samplers(kept)
    elif given.what == "optimizers":
        optimizers(kept, given.rocks or 20, given.starts or 16)
    elif given.what == "probabilities":
        probabilities(kept)
    else:
        grid(kept, given.rocks or 20, given.points)


if __name__ == "__main__":
    main()
