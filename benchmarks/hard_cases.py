"""Hard cases, each answer judged right, refused or wrong: `python benchmarks/hard_cases.py`.

Ten thousand random ones, `hard_cases.py count`: half of the scenes lie within 1e-14 to 1e-3 of the overturning
boundary, half of them within that of a change of their impacts: a grazing touch of the ground, an impact at the end of
the pulse, or hops just above the uplift threshold. 40-digit Taylor series (`reference_taylor.py`) judge both engines.
Scenes and their references are kept in `hard_cases_answers.npz`; `count --new` draws and judges them again (ten
minutes more). And the named ones of `tests/hard_cases.py`, `hard_cases.py page`. Prints a report and writes it to
`hard_cases.md` beside this file.
"""

import functools
import importlib.util
import math
import pathlib
import sys
import time
from dataclasses import dataclass

import jax

jax.config.update("jax_platforms", "cpu")
jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

HERE = pathlib.Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

import reference_taylor  # noqa: E402

import jaxrock as rk  # noqa: E402

ANSWERS = HERE / "hard_cases_answers.npz"
SEED, POINTS, BATCH = 20261121, 32, 256
TUNER = rk.Series(max_steps=3000)  # finds the edges
COLUMNS = ("alpha", "p", "restitution", "amplitude", "duration", "shape", "delay", "rotation", "velocity")
MODELS = {"nonlinear": rk.Housner(), "linear": rk.Linear()}
MOTIONS = {
    "sine": lambda a, duration, shape: rk.SinePulse(a, duration),
    "cosine": lambda a, duration, shape: rk.CosinePulse(a, duration),
    "exponential": rk.ExponentialPulse,
    "rectangle": lambda a, duration, shape: rk.RectangularPulse(a, duration),
    "half sine": lambda a, duration, shape: rk.HalfSinePulse(a, duration),
}
ENGINES = {  # name: engine, the tolerance of the bound
    "Series()": (rk.Series(), 1e-11),
    "Diffrax(rtol=1e-8)": (rk.Diffrax(rtol=1e-8), 1e-7),
    "Diffrax(rtol=1e-12)": (rk.Diffrax(rtol=1e-12), 1e-11),
}
# Farther from the edge than this, in relative terms, no engine needs to refuse.
CLEAR = {"Series()": 1e-11, "Diffrax(rtol=1e-8)": 1e-5, "Diffrax(rtol=1e-12)": 1e-9}
STATUS_NAMES = ("step_budget_exhausted", "undecided", "solver_failed", "not_finite")
STATUSES = tuple(getattr(rk.Status, name) for name in STATUS_NAMES)
MOST_WRONG = 10
HEADER = "# Hard cases\n\nWritten by `python benchmarks/hard_cases.py`.\n"
SEPARATOR = "\n## "
PARTS = {"count": "Ten thousand cases on the edge", "page": "Named cases"}


@dataclass(frozen=True)
class Group:
    """One kind of scene: how many, where its edge is, and which number is tuned to it."""

    model: str
    kind: str
    edge: str  # "boundary": the verdict changes; "impacts": their number does; "hops": just above the threshold
    count: int
    tuned: str = "amplitude"

    @property
    def delayed(self):
        """Whether the motion waits first."""
        return self.tuned == "delay"

    @property
    def name(self):
        """What the tables call it."""
        where = {"boundary": "boundary", "impacts": "touch", "hops": "small hops"}[self.edge]
        return f"{self.model}, {self.kind}, {where}" + (f" by {self.tuned}" if self.edge == "impacts" else "")


GROUPS = [
    Group(model, kind, edge, count, tuned)
    for model in MODELS
    for kind, edge, count, tuned in (
        ("sine", "boundary", 625, "amplitude"),
        ("cosine", "boundary", 625, "amplitude"),
        ("exponential", "boundary", 625, "amplitude"),
        ("rectangle", "boundary", 625, "amplitude"),
        ("rectangle", "impacts", 500, "delay"),
        ("half sine", "impacts", 500, "delay"),
        ("rectangle", "impacts", 500, "velocity"),
        ("sine", "impacts", 214, "amplitude"),
        ("cosine", "impacts", 214, "amplitude"),
        ("exponential", "impacts", 214, "amplitude"),
        ("sine", "hops", 358, "amplitude"),
    )
]


# Scenes


def spread_out(random, low, high, count):
    """Numbers whose logarithms are uniform."""
    return np.exp(random.uniform(math.log(low), math.log(high), count))


def draw(group, random, count):
    """Random scenes, (count, columns), whose tuned number is still to be found."""
    alpha, p = spread_out(random, 0.03, 1.0, count), spread_out(random, 0.5, 5.0, count)
    threshold = alpha if group.model == "linear" else np.tan(alpha)
    restitution, shape, zero = random.uniform(0.3, 1.0, count), random.uniform(-20, 20, count), np.zeros(count)
    if group.kind in ("sine", "cosine"):
        duration = 2 * np.pi / (p * spread_out(random, 0.3, 8.0, count))
    else:
        duration = spread_out(random, 0.05, 15.0, count) / p
    amplitude, delay, rotation, velocity = threshold.copy(), zero, zero, zero
    if group.edge == "impacts":
        fallen = random.random(count) < (0.6 if group.tuned == "amplitude" else 1.1)
        rotation = np.where(fallen, alpha * spread_out(random, 1e-3, 0.9, count), 0.0)
        amplitude = np.where(fallen, -threshold, threshold)
        if group.tuned != "amplitude":
            amplitude = amplitude * spread_out(random, 1.2, 10.0, count)
            duration = spread_out(random, 0.1, 3.0, count) / p
    if group.edge == "hops":
        excess = spread_out(random, 1e-8, 1e-1, count)
        amplitude = threshold * (1 + excess)
        restitution = np.where(excess > 1e-2, random.uniform(0.8, 0.99, count), random.uniform(0.6, 0.9, count))
    return np.stack([alpha, p, restitution, amplitude, duration, shape, delay, rotation, velocity], axis=1)


def tuning(group, scenes):
    """A grid of the tuned number for each scene, (scenes, points)."""
    alpha, p, _, amplitude, _, _, _, rotation, _ = scenes.T
    if group.tuned == "amplitude":
        return amplitude[:, None] * np.geomspace(1.001, 100.0, POINTS)
    if group.tuned == "delay":  # in times of the free fall
        fall = np.arccosh(alpha / (alpha - rotation)) / p
        return fall[:, None] * np.linspace(0.02, 1.5, POINTS)
    threshold = alpha if group.model == "linear" else np.tan(alpha)
    speed = p * np.sqrt(2 * rotation * (np.abs(amplitude) - threshold))  # stopped about at the ground
    return -speed[:, None] * np.linspace(0.2, 4.0, POINTS)


@functools.cache
def solver(model, kind, delayed, engine):
    """Outcomes of scenes, (count, columns), all by one compiled batch."""

    def one(scene):
        alpha, p, restitution, amplitude, duration, shape, delay, rotation, velocity = scene
        motion = MOTIONS[kind](amplitude, duration, shape)
        block, motion = rk.Block(alpha, p, restitution), motion.shifted(delay) if delayed else motion
        return rk.outcome(block, motion, MODELS[model], initial=(rotation, velocity), engine=engine)

    solve = jax.jit(jax.vmap(one))

    def in_batches(scenes):
        parts = []
        for first in range(0, len(scenes), BATCH):
            part = scenes[first : first + BATCH]
            found = solve(part[np.arange(BATCH) % len(part)])
            parts.append(jax.tree.map(lambda x: np.asarray(x)[: len(part)], found))  # noqa: B023
        return jax.tree.map(lambda *x: np.concatenate(x), *parts)

    return in_batches


def changes_along(group, found):
    """Where the edge lies between neighbours: verdicts, or numbers of impacts of safe blocks."""
    lost = np.asarray(found.overturned)
    return lost if group.edge == "boundary" else np.where(lost, -1, np.asarray(found.impact_count))


def on_the_edge(group, random):
    """Scenes tuned to their edge to the last digit, then moved off it by 1e-14 to 1e-3 of the tuned number.

    **Returns:** the scenes, and how far each was moved.
    """
    if group.edge == "hops":
        return draw(group, random, group.count), np.full(group.count, np.nan)
    solve, column = solver(group.model, group.kind, group.delayed, TUNER), COLUMNS.index(group.tuned)

    def value(scenes, tuned):
        scenes = scenes.copy()
        scenes[:, column] = tuned
        return changes_along(group, solve(scenes))

    chosen, lows, highs = [], [], []
    while sum(map(len, chosen)) < group.count:
        scenes = draw(group, random, group.count + group.count // 4)
        grid = tuning(group, scenes)
        values = value(np.repeat(scenes, POINTS, axis=0), grid.ravel()).reshape(grid.shape)
        change = values[:, 1:] != values[:, :-1]
        if group.edge == "impacts":
            change &= (values[:, 1:] >= 0) & (values[:, :-1] >= 0)
        some = np.flatnonzero(change.any(axis=1))
        index = np.argmax(change[some] * random.random(change[some].shape), axis=1)
        chosen.append(scenes[some])
        lows.append(grid[some, index])
        highs.append(grid[some, index + 1])
    scenes, low, high = (np.concatenate(x)[: group.count] for x in (chosen, lows, highs))
    before = value(scenes, low)
    for _ in range(60):
        middle = (low + high) / 2
        same = value(scenes, middle) == before
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    moved = spread_out(random, 1e-14, 1e-3, group.count) * random.choice([-1, 1], group.count)
    scenes[:, column] = high * (1 + moved)
    return scenes, moved


def as_reference(group, scene):
    """The same scene for the reference."""
    alpha, p, restitution, amplitude, duration, shape, delay, rotation, velocity = (float(x) for x in scene)
    numbers = (amplitude, duration, shape) if group.kind == "exponential" else (amplitude, duration)
    options = {"model": group.model, "initial": (rotation, velocity)} | ({"delay": delay} if group.delayed else {})
    return (alpha, p, restitution), group.kind, numbers, options


def in_two(text):
    """A decimal number as a sum of two float64."""
    from mpmath import mp, mpf

    with mp.workdps(40):
        value = mpf(text)
        return float(value), float(value - mpf(float(value)))


def references(group, scenes):
    """Verdict (-1: the reference cannot decide), peak in two parts, impacts, and how gentle a touch was, of scenes."""
    rows = []
    for known in reference_taylor.answers([as_reference(group, scene) for scene in scenes]):
        if "error" in known:
            rows.append((-1, 0.0, 0.0, 0, np.inf, np.inf))
            continue
        peak = (np.inf, 0.0) if known["overturned"] else in_two(known["peak"])
        gentle = [np.inf if known[name] is None else known[name] for name in ("grazing", "dip")]
        rows.append((known["overturned"], *peak, known["impacts"], *gentle))
    return np.array(rows, float)


def new_cases():
    """Draw the scenes, tune them, and let the reference answer; keep all that."""
    groups, kept = np.repeat(np.arange(len(GROUPS)), [group.count for group in GROUPS]), []
    for i, group in enumerate(GROUPS):
        start = time.perf_counter()
        scenes, moved = on_the_edge(group, np.random.default_rng([SEED, i]))
        drawn = time.perf_counter()
        known = references(group, scenes)
        kept.append((scenes, moved, known))
        end = time.perf_counter()
        print(f"{group.name}: {group.count} scenes in {drawn - start:.0f} s, judged in {end - drawn:.0f} s", flush=True)
    scenes, moved, known = (np.concatenate(x) for x in zip(*kept))
    np.savez_compressed(ANSWERS, groups=groups, scenes=scenes, moved=moved, known=known)


# Judging


def kept_cases(again):
    """The kept scenes: group of each, scenes, how far they are from their edge, and the reference's answers."""
    if again or not ANSWERS.exists():
        new_cases()
    with np.load(ANSWERS) as kept:
        return kept["groups"], kept["scenes"], kept["moved"], kept["known"]


def solve_all(groups, scenes, engine):
    """Outcomes of all scenes by an engine, with the time to compile [s] and the time to run [s] each took."""
    kinds = {}
    for i, group in enumerate(GROUPS):
        kinds.setdefault((group.model, group.kind, group.delayed), []).append(i)
    parts, compiling, running = [], 0.0, np.zeros(len(scenes))
    for kind, members in kinds.items():
        solve = solver(*kind, engine)
        start = time.perf_counter()
        solve(scenes[:1])  # a batch of one scene; it compiles
        compiling += time.perf_counter() - start
        for member in members:
            lanes = np.flatnonzero(groups == member)
            start = time.perf_counter()
            found = solve(scenes[lanes])
            running[lanes] = (time.perf_counter() - start) / len(lanes)
            parts.append((lanes, found))
        print(f"{engine}: {', '.join(map(str, kind))}", flush=True)
    order = np.argsort(np.concatenate([lanes for lanes, _ in parts]))
    found = jax.tree.map(lambda *x: np.concatenate(x)[order], *(found for _, found in parts))
    return found, compiling, running


@dataclass(frozen=True)
class Judgement:
    """What became of each scene under one engine; arrays over the scenes but `name` and `compiling`."""

    name: str
    judged: np.ndarray  # the reference could decide
    refused: np.ndarray
    wrong: np.ndarray  # successful, and not right
    right_anyway: np.ndarray  # refused beside numbers that are right
    status: np.ndarray
    made: np.ndarray  # error of the peak over alpha; infinite for a wrong verdict, NaN where both overturn
    told: np.ndarray  # error estimate over alpha
    bound: np.ndarray
    compiling: float
    running: np.ndarray

    @property
    def right(self):
        """Successful and right."""
        return self.judged & ~self.refused & ~self.wrong


def judge(name, groups, scenes, known):
    """Run an engine over all scenes and judge its answers."""
    engine, tolerance = ENGINES[name]
    found, compiling, running = solve_all(groups, scenes, engine)
    alpha, lost = scenes[:, 0], known[:, 0] == 1
    with np.errstate(invalid="ignore"):
        made = np.abs((found.max_rotation - known[:, 1]) - known[:, 2]) / alpha
    made = np.where(found.overturned == lost, np.where(lost, np.nan, made), np.inf)
    told = found.error / alpha
    bound = 10 * np.maximum(np.where(np.isfinite(told), told, 0.0), tolerance)
    judged, refused = known[:, 0] >= 0, np.asarray(found.status != rk.Status.successful)
    off = ~(np.isnan(made) | (made <= bound))
    return Judgement(
        name, judged, judged & refused, judged & ~refused & off, judged & refused & ~off,
        np.asarray(found.status._value), made, told, bound, compiling, running,
    )  # fmt: skip


def table(header, rows):
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def group_table(judgements, groups):
    """Right, refused and wrong by group."""
    header = ["group", "scenes"]
    for j in judgements:
        header += [f"`{j.name}`: right / refused / wrong", "worst error/bound", "ms a scene"]
    rows = []
    for i, name in [*((i, group.name) for i, group in enumerate(GROUPS)), (None, "**all**")]:
        here = groups == i if i is not None else groups >= 0
        row = [name, str(here.sum())]
        for j in judgements:
            counts = " / ".join(str((x & here).sum()) for x in (j.right, j.refused, j.wrong))
            safe = here & (j.right | j.wrong) & ~np.isnan(j.made)
            worst = (j.made / j.bound)[safe].max(initial=0.0)
            row += [counts, f"{worst:.2g}", f"{1e3 * j.running[here].mean():.2g}"]
        rows.append(row)
    return table(header, rows)


def distance_table(judgements, groups, moved):
    """Refusals by distance from the edge: how many of the scenes, and how many where a refusal is not needed."""
    edges = np.array([group.edge for group in GROUPS])[groups]
    rows = []
    for edge, name in (("boundary", "boundary"), ("impacts", "touch")):
        for low in range(-14, -3):
            here = (edges == edge) & (np.abs(moved) >= 10.0**low) & (np.abs(moved) < 10.0 ** (low + 1))
            refused = [f"{100 * (j.refused & here).sum() / here.sum():.1f} %" for j in judgements]
            rows.append([name, f"1e{low} to 1e{low + 1}", str(here.sum()), *refused])
    here = edges == "hops"
    rows.append(["small hops", "-", str(here.sum())])
    rows[-1] += [f"{100 * (j.refused & here).sum() / here.sum():.1f} %" for j in judgements]
    return table(["edge", "distance", "scenes", *(f"refused by `{j.name}`" for j in judgements)], rows)


def summary_table(judgements, moved):
    """One row for each engine: what it refused, whether it had to, and how good its estimate of the error is."""
    rows = []
    for j in judgements:
        clear = ~(np.abs(moved) < CLEAR[j.name])
        needless = j.refused & clear
        safe = j.right & (j.made > 0) & (j.told > 0)
        shares = np.percentile((j.made / j.told)[safe], (50, 90, 99, 100))
        statuses = [(status, int((j.status == status._value).sum())) for status in STATUSES]
        share = 100 * needless.sum() / clear.sum()
        rows.append([
            f"`{j.name}`", str(j.right.sum()), str(j.refused.sum()), str(j.wrong.sum()),
            ", ".join(f"{name} {count}" for (_, count), name in zip(statuses, STATUS_NAMES) if count),
            str(j.right_anyway.sum()), f"{needless.sum()} of {clear.sum()} ({share:.2f} %)",
            " / ".join(f"{share:.2g}" for share in shares), f"{np.nanmax(np.where(j.right, j.made, 0)):.1e}",
            f"{j.running.sum():.1f} s", f"{j.compiling:.0f} s",
        ])  # fmt: skip
    header = [
        "engine", "right", "refused", "wrong", "refusals", "of them right numbers", "needless refusals",
        "error/estimate: median / 90 % / 99 % / worst", "worst error of peak/alpha", "time of all", "compiling",
    ]  # fmt: skip
    return table(header, rows)


def wrong_table(judgements, groups, scenes, moved, known):
    """The wrong answers, if any, with what it takes to repeat them."""
    rows = []
    for j in judgements:
        for i in np.flatnonzero(j.wrong)[:MOST_WRONG]:
            numbers = ", ".join(repr(float(x)) for x in scenes[i])
            verdict = "overturns" if known[i, 0] else f"{known[i, 1] / scenes[i, 0]:.9f}"
            rows.append([
                f"`{j.name}`", str(i), GROUPS[groups[i]].name, f"{moved[i]:.1e}", verdict,
                f"{j.made[i]:.1e}", f"{j.told[i]:.1e}", numbers,
            ])  # fmt: skip
    if not rows:
        return "There are none."
    header = ["engine", "scene", "group", "distance", "reference: peak/alpha", "error", "told", ", ".join(COLUMNS)]
    return table(header, rows)


def count_report(again=False):
    """The ten thousand scenes: text of the report."""
    groups, scenes, moved, known = kept_cases(again)
    judgements = []
    for name in ENGINES:
        judgements.append(judge(name, groups, scenes, known))
        j = judgements[-1]
        print(f"{name}: right {j.right.sum()}, refused {j.refused.sum()}, wrong {j.wrong.sum()}", flush=True)
    touch = np.array([group.edge == "impacts" for group in GROUPS])[groups]
    gentle = touch & ((known[:, 4] < 1e-3) | (known[:, 5] < 1e-6))
    clear = ", ".join(f"{distance:.0e} (`{name}`)" for name, distance in CLEAR.items())
    lost, open_ = (known[:, 0] == 1).sum(), (known[:, 0] < 0).sum()
    return f"""{len(scenes):,} scenes; the reference overturns {lost:,} and cannot decide {open_} (not judged).
In {gentle.sum():,} of the {touch.sum():,} touches the block meets the ground with less than 1e-3 of the speed that it
could have, or turns less than 1e-6 alpha above it.

*Right*: a successful status, the reference's verdict, and a peak within 10 max(`error`, tolerance x alpha), tolerance
1e-11 (`Series`, `rtol=1e-12`) or 1e-7 (`rtol=1e-8`). *Refused*: any other status. *Wrong*: all else. A refusal is
*needless* if the scene is farther from its edge than {clear}.
Error and estimate are those of the peak of blocks that do not overturn. Times are in batches of {BATCH:,}.

{summary_table(judgements, moved)}

{group_table(judgements, groups)}

{distance_table(judgements, groups, moved)}

### Wrong answers

{wrong_table(judgements, groups, scenes, moved, known)}
"""


# The page of named cases


def named_cases():
    """The module `tests/hard_cases.py` with its table, its answers and its engines; one scene in a batch."""
    path = HERE.parent / "tests" / "hard_cases.py"
    spec = importlib.util.spec_from_file_location("named_hard_cases", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    module.LANES = 1
    return module


def cell(cases, known, found, bound, refusable):
    """What an engine made of a named case: its error, or its refusal."""
    if not found["successful"]:
        return "refused" if refusable else "refused, needlessly"
    wrong = cases.judge(known, found, math.inf if refusable else bound, counted=not refusable)
    if wrong:
        return f"WRONG: {wrong}"
    return "overturns" if known["overturned"] else f"{cases.error_made(known, found):.0e}"


def page_report():
    """Every named case with the error and the time of each engine: text of the report."""
    cases = named_cases()
    engines = {"series": 1e-11, "diffrax": 1e-7, "tight": 1e-10}
    rows, refused, wrong = [], dict.fromkeys(engines, 0), 0
    for case in cases.CASES:
        for model in case.models:
            known, (block, kind, numbers, options) = cases.answers()[cases.key(case, model)], cases.scene(case, model)
            right = "overturns" if known["overturned"] else f"{float(known['peak']) / block[0]:.6g}"
            row = [case.name, case.hard, model, right]
            for name, bound in engines.items():
                scene = [(block, numbers, options["initial"])]
                solve = functools.partial(cases.outcomes, kind, model, cases.engines()[name], scene)
                found = {key: value[0] for key, value in solve().items()}
                refused[name] += not found["successful"]
                row += [cell(cases, known, found, bound, name in case.refused), f"{1e3 * least_time(solve):.2g}"]
            wrong += any("WRONG" in x for x in row)
            rows.append(row)
            print(" | ".join(row), flush=True)
    header = ["case", "what is hard", "model", "peak/alpha"]
    for name in engines:
        header += [name, "ms"]
    counts = ", ".join(f"{name} refuses {count}" for name, count in refused.items())
    return f"""{len(rows)} scenes: {wrong} wrong; {counts}. An entry is the error of peak/alpha; "diffrax"
is `Diffrax(rtol=1e-8)`, "tight" is `Diffrax(rtol=1e-12)`. Times are of one response, compiled, float64.
The judge is that of `tests/hard_cases.py`: verdict, margin, impacts, peak, and the estimate of its error;
cases that an engine may refuse are on the edge for it, and then only verdict and estimate count.

{table(header, rows)}
"""


def least_time(function):
    """Least time of three calls [s]."""
    times = []
    for _ in range(3):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def main():
    """Measure the part that is asked for, or both; keep the other part of the report."""
    path = HERE / "hard_cases.md"
    old = dict.fromkeys(PARTS, "")
    if path.exists():
        parts = path.read_text().split(SEPARATOR)[1:]
        old |= {name: part for name, title in PARTS.items() for part in parts if part.startswith(title)}
    wanted = [name for name in PARTS if name in sys.argv] or list(PARTS)
    new = {"count": lambda: count_report("--new" in sys.argv), "page": page_report}
    for name in wanted:
        old[name] = f"{PARTS[name]}\n\n{new[name]()}"
        path.write_text(HEADER + "".join(SEPARATOR + text for text in old.values() if text))
    print(path.read_text())


if __name__ == "__main__":
    main()
