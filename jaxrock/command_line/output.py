"""What commands print and write: aligned tables, CSV files, figures, and what could not be computed."""

import sys
from pathlib import Path

import numpy as np

import jaxrock as rk


def table(rows: list[tuple[str, str, str]]) -> str:
    """Lines of names, values and units."""
    widths = [max(len(row[i]) for row in rows) for i in (0, 1)]
    return "\n".join(f"  {name:<{widths[0]}}  {value:>{widths[1]}}  {unit}".rstrip() for name, value, unit in rows)


def write_csv(path: Path, header: str, *columns) -> None:
    """Write columns of numbers, under a header of names with commas between them."""
    np.savetxt(path, np.column_stack([np.asarray(c, dtype=float) for c in columns]), delimiter=",", header=header,
               comments="", fmt="%.12g")  # fmt: skip


def save(figure, path: Path) -> None:
    """Write a figure, and say so."""
    figure.savefig(path, dpi=150)
    print(f"wrote {path}")


def status_of_surface(status: rk.Status) -> int:
    """Exit status of a surface: 1, with a message, where some scenes were not computed."""
    if bool(np.all(np.asarray(status == rk.Status.successful))):
        return 0
    print("jaxrock: some scenes were not computed (impacts that do not die out)", file=sys.stderr)
    return 1
