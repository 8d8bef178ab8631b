"""How long notebooks take, in full size: with nothing kept (cold), and once more with what that has left (warm).

    python benchmarks/notebooks.py [--only NAMES] [--cells]

Times are processor seconds of all threads of the kernel, with its start and its end, and seconds on the wall. Every
notebook starts with an empty folder of kept programs. The files are left alone. `--cells` tells the slowest cells of
the second run, in seconds on the wall.
"""

import argparse
import datetime
import os
import pathlib
import resource
import tempfile
import time

import nbclient
import nbformat

HERE = pathlib.Path(__file__).resolve().parent
FOLDER = HERE.parent / "notebooks"
BAR = 60.0  # processor seconds, warm


def spent() -> tuple[float, float]:
    """Processor seconds of processes that have ended, and the clock."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime, time.perf_counter()


def measure(path: pathlib.Path, kept: str) -> tuple[float, float, list[tuple[float, int, str]]]:
    """Processor and wall seconds of one run, and its cells, slowest first: seconds, number, first line."""
    os.environ |= {"JAXROCK_CACHE": kept, "PYTHONPATH": str(HERE.parent)}
    notebook = nbformat.read(path, as_version=4)
    before = spent()
    beside = {"metadata": {"path": str(path.parent)}}  # where its data are
    nbclient.NotebookClient(notebook, timeout=1800, kernel_name="python3", resources=beside).execute()
    after = spent()
    cells = [
        (seconds(cell), number, cell.source.partition("\n")[0])
        for number, cell in enumerate(notebook.cells)
        if cell.cell_type == "code"
    ]
    return after[0] - before[0], after[1] - before[1], sorted(cells, reverse=True)


def seconds(cell) -> float:
    """How long a cell ran, on the wall."""
    told, ends = cell.metadata["execution"], ("iopub.execute_input", "shell.execute_reply")
    begun, ended = (datetime.datetime.fromisoformat(told[end]) for end in ends)
    return (ended - begun).total_seconds()


def row(name: str, with_cells: bool) -> list[str]:
    """Of the table."""
    with tempfile.TemporaryDirectory() as kept:
        cold, warm = (measure(FOLDER / f"{name}.ipynb", kept) for _ in range(2))
    found = [name, *(f"{x:.0f}" for x in (*cold[:2], *warm[:2]))]
    print("| " + " | ".join(found) + " |" + ("" if warm[0] <= BAR else "  too long"), flush=True)
    for taken, number, line in warm[2][:4] if with_cells else ():
        print(f"    cell {number}: {taken:.1f} s  {line}", flush=True)
    return found


def main():
    """Print the table, and write it if it is whole; rows that were measured alone take the place of the old ones."""
    parser = argparse.ArgumentParser()
    names = [path.stem for path in sorted(FOLDER.glob("*.ipynb"))]
    parser.add_argument("--only", nargs="*", choices=names, default=names)
    parser.add_argument("--cells", action="store_true")
    arguments = parser.parse_args()
    path = HERE / "notebooks.md"
    before, _, after = path.read_text().partition("| notebook") if path.exists() else ("", "", "")
    old = {line.split(" | ")[0].removeprefix("| "): line for line in after.splitlines() if " | " in line}
    for name in arguments.only:
        old[name] = "| " + " | ".join(row(name, arguments.cells)) + " |"
        lines = [old[name] for name in names if name in old]
        head = "| notebook | cold [s] | wall | warm [s] | wall |\n|---|---|---|---|---|\n"
        path.write_text(before + head + "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
