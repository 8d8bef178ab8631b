"""Long sweeps on disk: a Zarr store of finished blocks, which many processes write, and which outlives them.

A block is finished when its record exists: a checksum for each of its results, and one for these checksums. The record
is a file of its own, written after all results. Every read is verified against it. The description tells what a store
contains. Every file is written under a temporary name and then renamed.
"""

import hashlib
import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxrock._arguments.tables import needed
from jaxrock._core.atomic_files import uninterrupted, written_atomically
from jaxrock.sweeps.description import Description, digest_of_axis, read_description
from jaxrock.sweeps.labels import POINT, RECORDS, dimensions, layout_name, shape_of
from jaxrock.sweeps.plan import Plan
from jaxrock.sweeps.stored import stored

_DIGEST = hashlib.sha256().digest_size
_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:(/|:)")  # a single letter is a drive
_MANY = 5  # files that a message names
_AXIS_CHUNK = 2**20
_WORDS = "words"  # an attribute of an axis: what its numbers stand for


def local(argument: str, path: Any) -> Path:
    """Return a path of a file system, or raise ValueError."""
    told = os.fspath(path) if isinstance(path, (str, os.PathLike)) else path
    if not isinstance(told, str) or not told or "\0" in told:
        raise ValueError(f"Argument `{argument}` must be a path, but is {path!r}.")
    if _URL.match(told):
        raise ValueError(
            f"Argument `{argument}` must be a path of a file system, but is {told!r}. Object stores cannot rename, on "
            "which it depends that nothing is lost: write to a disk, and copy what is finished."
        )
    return Path(os.path.expanduser(told))


class Store:
    """A Zarr group: axes, one array for every result with one chunk for every block, and a record of every block."""

    def __init__(self, path: Path, description: Description):
        self.path, self._description, self._about = path, description, description.about
        self.mended: list[Path] = []  # files found damaged when the store was opened
        self.outer = self._about["made_by"]["layout"] == layout_name(True)
        self.names = list(self._about["results"])
        self._types = [np.dtype(kind) for kind in self._about["results"].values()]
        self._metadata = description.metadata
        self._arrays, self._records = [self._array(name) for name in self.names], self._array(RECORDS)
        self._stored = [array.dtype for array in self._arrays]
        axes = [np.broadcast_to(0.0, self._metadata[name]["shape"]) for name in self._about["axes"]]
        self._plan = Plan(tuple(axes), self.outer, tuple(self._about["block"]))  # where blocks lie

    def _array(self, name: str):
        """Open an array of this store by its description; blocks are written even where they equal the fill value."""
        zarr = needed("zarr")
        place = zarr.storage.StorePath(zarr.storage.LocalStore(self.path), name)
        return zarr.Array(zarr.AsyncArray(self._metadata[name], place, {"write_empty_chunks": True}))

    @property
    def block(self) -> tuple[int, ...]:
        """Points of a block along every axis of the grid."""
        return self._plan.block

    @property
    def count(self) -> int:
        """Number of blocks."""
        return math.prod(self._plan.blocks)

    def axis(self, name: str) -> np.ndarray | None:
        """Return the values of an axis; None if they are damaged."""
        values = self._part(self._array(name), ...)
        good = values is not None and digest_of_axis(values) == self._about["made_by"][f"axis `{name}`"]
        return values if good else None

    def axes(self) -> dict[str, np.ndarray]:
        """Return all axes; as words, where they have words.

        **Raises:** ValueError where one is damaged.
        """
        found = {name: self.axis(name) for name in self._about["axes"]}
        _refuse(self.path, [self.path / name for name, values in found.items() if values is None])
        words = {name: self._metadata[name]["attributes"].get(_WORDS) for name in found}
        return {name: np.array(words[name]) if words[name] else np.asarray(found[name]) for name in found}

    def mend(self, axes: dict[str, np.ndarray]) -> list[Path]:
        """Rewrite damaged axes and description; return the files that were damaged."""
        damaged = self._description.damaged(self.path)
        self._description.write(self.path)
        lost = [name for name in axes if self.axis(name) is None]
        for name in lost:
            self._array(name)[...] = axes[name]
        return damaged + [self.path / name for name in lost]

    def mark(self, state: str) -> None:
        """Mark the store as "unfinished" for other readers, with values that may be missing, or as "finished"."""
        self._description = self._description.marked(state)
        self._description.write(self.path)

    def begun(self) -> list[int]:
        """Return the blocks that have a record, intact or not.

        Walking the folder is faster than opening every block's record where there are many blocks, few of them
        finished. Other files beside the records are ignored.
        """
        root, found, blocks = self.path / RECORDS / "c", [], self._plan.blocks
        more = len(self._records.shape) - len(blocks)
        for folder, _, files in os.walk(root, onerror=_unless_missing):
            index = Path(folder).relative_to(root).parts
            if files and len(index) == len(blocks) + more - 1 and all(map(str.isdecimal, index)):
                place = tuple(map(int, index[: 1 - more]))
                if all(i < n for i, n in zip(place, blocks)):
                    found.append(int(np.ravel_multi_index(place, blocks)))
        return sorted(found)

    def look(self, number: int) -> tuple[bool, list[Path]]:
        """Return whether a block is finished and intact, and its damaged files."""
        leaves, damaged = self._read(number)
        return leaves is not None, damaged

    def write(self, number: int, leaves: list[np.ndarray]) -> None:
        """Write one block: first all its results, then its record."""
        place = self._plan.place(number)
        leaves = [leaf.astype(kind, copy=False) for kind, leaf in zip(self._stored, leaves)]
        for array, leaf in zip(self._arrays, leaves):
            array[place] = leaf
        told = np.stack([self._digest(number, name, leaf) for name, leaf in zip(self.names, leaves)])
        self._records[self._index(number)] = np.stack([*told, self._digest(number, RECORDS, told)])

    def read(self) -> list[np.ndarray]:
        """Read all results.

        **Raises:** ValueError for a store that is not finished, or damaged.
        """
        records = [self._part(self._records, self._index(number)) for number in range(self.count)]
        missing = sum(record is not None and not record.any() for record in records)
        if missing:
            raise ValueError(
                f"The store {self.path} is not finished: {self.count - missing} of {self.count} blocks. Run the same "
                "sweep with it again."
            )
        shape, damaged = self._plan.shape, []
        more = [array.shape[len(shape) :] for array in self._arrays]
        results = [np.empty((*shape, *sizes), kind) for sizes, kind in zip(more, self._types)]
        for number in range(self.count):
            leaves, bad = self._read(number)
            damaged += bad
            for whole, leaf in zip(results, leaves or []):
                whole[self._plan.place(number)] = leaf
        _refuse(self.path, damaged)
        return results

    def _index(self, number: int) -> tuple[int, ...]:
        return tuple(int(i) for i in np.unravel_index(number, self._plan.blocks))

    def _read(self, number: int) -> tuple[list[np.ndarray] | None, list[Path]]:
        """Return the results of a block (None if they are missing or damaged), and its damaged files."""
        record = self._part(self._records, self._index(number))
        if record is not None and not record.any():
            return None, []
        if record is None or (record[-1] != self._digest(number, RECORDS, record[:-1])).any():
            return None, [self._file(RECORDS, number)]
        leaves, damaged = [], []
        for name, array, kind, told in zip(self.names, self._arrays, self._types, record):
            part = self._part(array, self._plan.place(number))
            if part is None or (self._digest(number, name, part) != told).any():
                damaged.append(self._file(name, number))
            else:
                leaves.append(part.astype(kind, copy=False))
        return None if damaged else leaves, damaged

    @staticmethod
    def _part(array, place) -> np.ndarray | None:
        """Return a part of an array; None if it cannot be read."""
        try:
            return np.asarray(array[place])
        except (OSError, MemoryError):
            raise
        except Exception:  # codecs raise their own error types
            return None

    def _file(self, name: str, number: int) -> Path:
        """Return the file of a block."""
        more = len(self._metadata[name]["shape"]) - len(self._plan.blocks)
        return self.path.joinpath(name, "c", *map(str, (*self._index(number), *(0,) * more)))

    def _digest(self, number: int, name: str, leaf: np.ndarray) -> np.ndarray:
        """Compute the checksum of a result, bound to this store, this block and the result's name."""
        told = hashlib.sha256(f"{self._description.checksum} {number} {name} ".encode())
        told.update(leaf.tobytes())
        return np.frombuffer(told.digest(), np.uint8)


def _unless_missing(error: OSError) -> None:
    if not isinstance(error, FileNotFoundError):
        raise error


def listed(files: list[Path]) -> str:
    """List the first of some files, and the number of the others."""
    return ", ".join(map(str, files[:_MANY])) + (f", and {len(files) - _MANY} more" if len(files) > _MANY else "")


def _refuse(path: Path, damaged: list[Path]) -> None:
    if damaged:
        raise ValueError(
            f"The store {path} is damaged: {listed(damaged)}. A sweep that is called with its store computes again "
            "what is damaged."
        )


def opened(path: Path) -> Store:
    """Open an existing store for reading.

    **Raises:** ValueError where there is none, or one whose files differ from its description.
    """
    description = read_description(path, "Argument `path` must be the store of a sweep or a saved grid")
    _refuse(path, description.damaged(path))
    return Store(path, description)


def of_sweep(path: Path, made_by: dict[str, str]) -> Store:
    """Open the store of a sweep.

    **Raises:** ValueError for a store of another sweep, or anything else at this path.
    """
    description = read_description(path, "Argument `store` must be a new path or the store of a sweep")
    known = description.about["made_by"]
    parts = [part for part in {**known, **made_by} if known.get(part) != made_by.get(part)]
    if parts:
        raise ValueError(
            f"The store {path} was made by another sweep: other {'; other '.join(parts)}. Take another path, or the "
            "same sweep."
        )
    return Store(path, description)


def made_or_mended(
    path: Path,
    axes: dict[str, np.ndarray],
    outer: bool,
    leaves: dict[str, jax.ShapeDtypeStruct],
    block: tuple[int, ...],
    made_by: dict[str, str],
    words: Mapping[str, Sequence[str]],
) -> list[Path]:
    """Make the store of a sweep, or mend its axes and description; return the files that were damaged."""
    return uninterrupted(_made_or_mended, path, axes, outer, leaves, block, made_by, words)


def _made_or_mended(path, axes, outer, leaves, block, made_by, words) -> list[Path]:
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with written_atomically(path) as aside:
                create(aside, axes, outer, leaves, block, made_by, words)
            return []
        except FileExistsError:  # another process made it first
            pass
    return of_sweep(path, made_by).mend(axes)


def create(
    path: Path,
    axes: dict[str, np.ndarray],
    outer: bool,
    leaves: dict[str, jax.ShapeDtypeStruct],
    block: tuple[int, ...],
    made_by: dict[str, str],
    words: Mapping[str, Sequence[str]],
    *,
    whole: bool = False,
) -> Store:
    """Make a store without finished blocks.

    `leaves`: results by name, as of one point; `words`: labels of the numbers of axes; `whole`: all blocks are written
    before the store is read.
    """
    zarr = needed("zarr")
    for name, values in (axes | leaves).items():
        if np.dtype(values.dtype).kind not in ("iuf" if name in axes else "biufc"):
            raise ValueError(
                f"A store takes numbers and booleans, and axes of real numbers, but `{name}` is {values.dtype}."
            )
    group = zarr.open_group(zarr.storage.LocalStore(path), mode="w-", zarr_format=3)
    # The outer checksum finds damaged bytes before a codec decompresses them.
    usual: dict[str, Any] = {"compressors": (zarr.codecs.ZstdCodec(level=0), zarr.codecs.Crc32cCodec())}
    usual["config"] = {"write_empty_chunks": True}
    shape = shape_of(axes.values(), outer)
    forms = {name: stored(np.dtype(leaf.dtype), whole) for name, leaf in leaves.items()}
    for name, leaf in leaves.items():
        form = forms[name]
        group.create_array(
            name, shape=(*shape, *leaf.shape), dtype=form.kind, chunks=(*block, *(max(n, 1) for n in leaf.shape)),
            dimension_names=dimensions(axes, outer, name, len(leaf.shape)), fill_value=form.fill,
            attributes=form.unfinished, **usual,
        )  # fmt: skip
    for name, values in axes.items():
        array = group.create_array(
            name, shape=values.shape, dtype=values.dtype, chunks=(min(values.size, _AXIS_CHUNK),),
            dimension_names=(name if outer else POINT,), fill_value=stored(values.dtype, True).fill,
            attributes={_WORDS: list(words[name])} if name in words else {}, **usual,
        )  # fmt: skip
        array[...] = values
    # Every block has its own chunk, so that two processes never write the same file.
    blocks = Plan(tuple(axes.values()), outer, block).blocks
    group.create_array(
        RECORDS, shape=(*blocks, len(leaves) + 1, _DIGEST), dtype=np.uint8, fill_value=0,
        chunks=(*(1,) * len(blocks), len(leaves) + 1, _DIGEST),
        dimension_names=dimensions((), True, RECORDS, len(blocks) + 2), **usual,
    )  # fmt: skip
    metadata = {name: json.loads((path / name / "zarr.json").read_text()) for name in (*axes, *leaves, RECORDS)}
    kinds = {name: np.dtype(leaf.dtype).newbyteorder("=").str for name, leaf in leaves.items()}
    marks = {
        name: {"unfinished": form.unfinished, "finished": form.finished}
        for name, form in forms.items()
        if form.unfinished != form.finished
    }
    description = Description.of(list(axes), kinds, block, made_by, metadata, marks)
    description.write(path)
    return Store(path, description)
