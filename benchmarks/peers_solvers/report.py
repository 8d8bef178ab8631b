"""Tables and picture of the peers."""

import datetime
import importlib.metadata
import os
import pathlib
import platform

from . import one_block

COLOURS = {
    "jaxrock": "#c1272d",
    "jaxrock-diffrax": "#f0929b",
    "taylor": "#1f4e79",
    "closed": "#3a9ad9",
    "dopri5": "#7fb069",
    "heyoka": "#8e6bbf",
    "scipy": "#e0a030",
    "diffrax": "#888888",
}
PACKAGES = ("jax", "jaxlib", "diffrax", "numba", "heyoka", "scipy", "numpy", "gmpy2")
SAMPLES = 5690


def number(speed):
    """A speed as text."""
    for size, unit in ((1e6, "M"), (1e3, "k")):
        if speed >= size:
            return f"{speed / size:.3g}{unit}"
    return f"{speed:.3g}"


def small(value):
    """An error as text."""
    return "-" if value is None else f"{value:.0e}".replace("e-0", "e-")


def line(row):
    """A row as one line of progress."""
    head = f"{row['peer']:16}{row['setting']:28}"
    if "failed" in row:
        return f"{head}failed: {row['failed']}"
    errors = f"worst {small(row['worst'])}, wrong {row['wrong']}, refused {row['refused']}" if "worst" in row else ""
    return f"{head}{number(row['speed']):>7}/s  {errors}"


def surroundings():
    """Date, machine and versions."""
    info = pathlib.Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    facts = {key.strip(): value.strip() for key, value in (text.split(":", 1) for text in lines if ":" in text)}
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    versions = []
    for name in PACKAGES:
        try:
            versions.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            continue
    model = facts.get("model name", platform.processor())
    return (
        f"{datetime.date.today()}; {model} (family {facts.get('cpu family')}, model {facts.get('model')}), "
        f"{cores} cores; Python {platform.python_version()}, {', '.join(versions)}"
    )


def table(rows, names):
    """A Markdown table of one problem."""
    record = rows[0]["problem"] in ("P4", "P6", "P7")
    header = ["peer", "setting", "responses/s", "cores busy", "scenes timed", "compilation [s]"]
    header += ["median", "99 %", "worst", "worst/condition", "wrong verdicts", "refused"]
    if record:
        header.insert(3, "samples/s")
    lines = [header, ["---"] * len(header)]
    for row in sorted(rows, key=lambda r: (list(COLOURS).index(r["peer"]), -r["goal"])):
        cells = [names[row["peer"]], row["setting"]]
        if "failed" in row:
            lines.append([*cells, "failed: " + row["failed"][:80].replace("|", "/"), *["-"] * (len(header) - 3)])
            continue
        cells.append(number(row["speed"]))
        if record:
            cells.append(number(row["speed"] * SAMPLES))
        cells.append(f"{row['cores']:.1f}" if row.get("cores", 0) > 0.3 else "-")
        cells += [f"{row['scenes']:,}", f"{max(row['first'], 0):.1f}"]
        if "of" not in row:
            lines.append([*cells, *["-"] * 6])
            continue
        cells += [small(row.get(key)) for key in ("median", "p99", "worst", "worst_conditioned")]
        wrong = f"{row['wrong_tame']} ({row['wrong']})" if row["wrong"] != row["wrong_tame"] else f"{row['wrong']}"
        lines.append([*cells, f"{wrong} of {row['of']}", str(row["refused"])])
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def best_table(rows, names):
    """The fastest of each peer at each error, all problems side by side."""
    codes = sorted({row["problem"] for row in rows})
    lines = [["error at most", "peer", *codes], ["---"] * (len(codes) + 2)]
    for limit in (1e-5, 1e-9, 1e-11):
        for peer in COLOURS:
            cells = []
            for code in codes:
                fit = [r for r in rows if r["problem"] == code and r["peer"] == peer and r.get("worst_conditioned")
                       is not None and r["worst_conditioned"] <= limit and not r["wrong_tame"]]  # fmt: skip
                fastest = max(fit, key=lambda r: r["speed"], default=None)
                cells.append("-" if fastest is None else f"{number(fastest['speed'])} ({small(fastest['worst'])})")
            if any(cell != "-" for cell in cells):
                lines.append([f"{limit:.0e}".replace("e-0", "e-"), names[peer], *cells])
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def picture(rows, names, file):
    """Error against speed, a panel for each problem."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    codes = sorted({row["problem"] for row in rows})
    figure, panels = plt.subplots(1, len(codes), figsize=(3.4 * len(codes), 4.2), sharey=True, squeeze=False)
    for axes, code in zip(panels[0], codes):
        for peer in COLOURS:
            mine = [r for r in rows if (r["problem"], r["peer"]) == (code, peer) and r.get("worst") is not None]
            mine.sort(key=lambda r: r["worst"])
            axes.loglog([r["speed"] for r in mine], [max(r["worst"], 1e-16) for r in mine], "o-", ms=5,
                        color=COLOURS[peer], label=names[peer])  # fmt: skip
        axes.set(title=next(r["title"] for r in rows if r["problem"] == code).replace(", ", ",\n", 1))
        axes.title.set_fontsize(8)
        axes.set_xlabel("responses/s")
        axes.grid(alpha=0.3)
    panels[0][0].set_ylabel("worst error of peak/alpha")
    handles = {label: h for axes in panels[0] for h, label in zip(*axes.get_legend_handles_labels())}
    figure.legend(handles.values(), handles.keys(), loc="lower center", ncols=4, frameon=False)
    figure.tight_layout(rect=(0, 0.13, 1, 1))
    figure.savefig(file, dpi=130)
    plt.close(figure)


def one_block_text(data):
    """The section on one block at a time."""
    record = f"`rk.example_record()` ({SAMPLES:,} samples)"
    return f"""
## One block at a time under a record

Measured by `python benchmarks/peers.py --problems one --keep`. {data["surroundings"]}.

{record}, Housner's restitution. One response at a time on one core, the least of {one_block.REPEATS} (jaxrock, after
compilation) or {one_block.REPEATS_SCIPY} (SciPy) runs. "Cut at samples": one `solve_ivp` for each sample while the
block rocks; "steps ≤ dt": the usual short cut, where steps run across the kinks of the record.

{one_block.text(data["rows"])}
"""


def write(data, names, folder):
    """`peers.md` and `peers.png`."""
    rows = data["rows"]
    runs = data.get("runs", 1)
    several = f" Put together from {runs} runs (`--keep`): compare speeds with care." if runs > 1 else ""
    text = f"""# jaxrock and its peers

Written by `python benchmarks/peers.py`. {data["surroundings"]}.{several}

Peak |theta|/alpha of every scene, over the motion and the free rocking after it. Speed: responses a second, wall
clock, the best of {data["repeat"]} runs after compilation, all cores for everyone. Error: |peak - reference|/alpha
over random scenes with references of 30 digits (`references/peers.py`) whose condition number is below 1e4; the
condition number is the sum of |d peak/alpha| over relative changes of alpha, restitution, amplitude and frequency.
Wrong verdicts: of such scenes (in brackets: of all). Refused: answered with a status instead of a number.
Cores busy: processor time over wall clock of that run (unknown where other processes work); less than there are
cores means that the machine did other work too, and the speed is too low.
Compilation: the first call less the best one. Slow peers are timed on some scenes with a reference.
Skipped, not installed: {", ".join(data.get("skipped") or ["none"])}.

## The fastest at each error

Responses a second (worst error); the worst error over its condition number is below the limit, no verdict is wrong.

{best_table(rows, names)}

![Error against speed](peers.png)
"""
    for title in dict.fromkeys(row["title"] for row in sorted(rows, key=lambda r: r["problem"])):
        part = [row for row in rows if row["title"] == title]
        facts = data["problems"][part[0]["problem"]]
        median, most, largest = facts["conditions"]
        text += f"\n## {part[0]['problem']}: {title}\n\n"
        text += f"{facts['references']} references, {facts['overturned']} overturned"
        text += f"; condition numbers: median {median:.2g}, 90 % {most:.2g}, largest {largest:.2g}.\n\n"
        text += table(part, names) + "\n"
    if "one" in data:
        text += one_block_text(data["one"])
    (folder / "peers.md").write_text(text)
    picture(rows, names, folder / "peers.png")
