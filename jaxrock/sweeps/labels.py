"""Names of axes, results and dimensions, in memory and in files."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

POINT = "point"  # the one dimension of axes that go side by side
RECORDS = "jaxrock_blocks"  # the array of a store that tells which blocks are finished, and their checksums
_LONGEST = 200  # bytes of a name: file systems allow 255


def shape_of(axes: Iterable[np.ndarray], outer: bool) -> tuple[int, ...]:
    """Return the shape of the grid that axes span."""
    sizes = tuple(np.size(values) for values in axes)
    return sizes if outer else sizes[:1]


def numbered(axes: Mapping[str, np.ndarray]) -> tuple[dict[str, np.ndarray], dict[str, tuple[str, ...]]]:
    """Return all axes as numbers, and the words of axes that have words; words are numbered in their order."""
    words = {name: tuple(map(str, values)) for name, values in axes.items() if np.asarray(values).dtype.kind in "OU"}
    numbers = {name: np.arange(len(words[name])) if name in words else values for name, values in axes.items()}
    return numbers, words


def layout_name(outer: bool) -> str:
    """Return the name of a layout in files."""
    return "outer" if outer else "side by side"


def dimensions(axes: Iterable[str], outer: bool, name: str, more: int) -> tuple[str, ...]:
    """Return the names of the dimensions of a result that has `more` dimensions than the grid."""
    return (*(axes if outer else (POINT,)), *(f"{name}.{k}" for k in range(more)))


def names_of(values: Any) -> list[str]:
    """Name every array of a pytree by its path, such as `max_rotation` or `outcome.status`."""
    paths = [
        jax.tree_util.keystr(p, simple=True, separator=".") for p, _ in jax.tree_util.tree_leaves_with_path(values)
    ]
    return [path.removesuffix("._value") or "value" for path in paths]


def own_names(axes: Sequence[str], outer: bool, values: Any, grid: int) -> list[str]:
    """Name the arrays of a pytree for files; their first `grid` dimensions are those of the grid.

    **Raises:** ValueError where two of axes, results and dimensions have one name, or a name that files cannot have.
    """
    names, leaves = names_of(values), jax.tree.leaves(values)
    if not names:
        raise ValueError("A sweep needs a function that returns at least one array.")
    taken = [*axes, *names, RECORDS, *({POINT} - set(axes) if not outer else ())]
    for name, leaf in zip(names, leaves):
        taken += dimensions((), True, name, np.ndim(leaf) - grid)
    twice = [name for name, count in Counter(taken).items() if count > 1]
    if twice:
        raise ValueError(
            "Results must have names of their own, and other names than the axes and dimensions, but two are called "
            f"{twice[0]!r}."
        )
    bad = [name for name in (*axes, *names) if not _can_be_stored(name)]
    if bad:
        raise ValueError(
            f"Axes and results must have names that files can have (without / or \\, not too long), but one is "
            f"{bad[0]!r}."
        )
    return names


def _can_be_stored(name: str) -> bool:
    """Return whether NetCDF, Zarr and file systems accept a name."""
    plain = name.isprintable() and name == name.strip() and not set(name) & {"/", "\\"}
    reserved = name in ("", ".", "..") or name.startswith("__") or name.endswith(".json")
    return plain and not reserved and len(name.encode()) <= _LONGEST
