"""Hard cases, each answer judged right, refused or wrong: `python benchmarks/hard_cases.py`.

Ten thousand random ones within 1e-14 to 1e-3 of an edge (`references/edge_cases.py`), `hard_cases.py count`; 40-digit
Taylor series judge both engines. `count --new` draws and judges them again (ten minutes more). And the named ones of
`references/hard_cases.py`, `hard_cases.py page`. Prints a report and writes it to `hard_cases.md` beside this file.
"""

import functools
import math
import pathlib
import sys
import time
from dataclasses import dataclass

import jax
import numpy as np
from common import least_time, table

import jaxrock as rk
from references import hard_cases as named
from references.edge_cases import BATCH, COLUMNS, GROUPS, kept_cases, solver

HERE = pathlib.Path(__file__).resolve().parent
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


def cell(known, found, bound, refusable):
    """What an engine made of a named case: its error, or its refusal."""
    if not found["successful"]:
        return "refused" if refusable else "refused, needlessly"
    wrong = named.judge(known, found, math.inf if refusable else bound, counted=not refusable)
    if wrong:
        return f"WRONG: {wrong}"
    return "overturns" if known["overturned"] else f"{named.error_made(known, found):.0e}"


def page_report():
    """Every named case with the error and the time of each engine: text of the report."""
    engines = {"series": 1e-11, "diffrax": 1e-7, "tight": 1e-10}
    rows, refused, wrong = [], dict.fromkeys(engines, 0), 0
    for case in named.CASES:
        for model in case.models:
            known, (block, kind, numbers, options) = named.answers()[named.key(case, model)], named.scene(case, model)
            right = "overturns" if known["overturned"] else f"{float(known['peak']) / block[0]:.6g}"
            row = [case.name, case.hard, model, right]
            for name, bound in engines.items():
                scene = [(block, numbers, options["initial"])]
                solve = functools.partial(named.outcomes, kind, model, named.engines()[name], scene, lanes=1)
                found = {key: value[0] for key, value in solve().items()}
                refused[name] += not found["successful"]
                row += [cell(known, found, bound, name in case.refused), f"{1e3 * least_time(solve, 3):.2g}"]
            wrong += any("WRONG" in x for x in row)
            rows.append(row)
            print(" | ".join(row), flush=True)
    header = ["case", "what is hard", "model", "peak/alpha"]
    for name in engines:
        header += [name, "ms"]
    counts = ", ".join(f"{name} refuses {count}" for name, count in refused.items())
    return f"""{len(rows)} scenes: {wrong} wrong; {counts}. An entry is the error of peak/alpha; "diffrax"
is `Diffrax(rtol=1e-8)`, "tight" is `Diffrax(rtol=1e-12)`. Times are of one response, compiled, float64.
The judge is that of `references/hard_cases.py`: verdict, margin, impacts, peak, and the estimate of its error;
cases that an engine may refuse are on the edge for it, and then only verdict and estimate count.

{table(header, rows)}
"""


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
