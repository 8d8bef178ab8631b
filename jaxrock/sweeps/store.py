"""Long sweeps on disk: a Zarr store of finished blocks, which many processes write, and which outlives them."""

import hashlib
import importlib.metadata
import json
import os
import shutil
import uuid
from pathlib import Path

import jax
import numpy as np

from jaxrock.sweeps.grid import FINISHED, POINT, dimensions, layout_name, needed, shape_of

_FINGERPRINT = "jaxrock_fingerprint"


def fingerprint(axes: dict[str, np.ndarray], outer: bool, program: str) -> dict[str, str]:
    """What tells a sweep from others, part by part."""
    hashes = {f"axis `{k}`": hashlib.sha256(f"{v.dtype}".encode() + v.tobytes()).hexdigest() for k, v in axes.items()}
    return hashes | {
        "order of the axes": ", ".join(axes),
        "layout": layout_name(outer),
        "precision": "double" if jax.config.jax_enable_x64 else "single",
        "function, or what it holds": program,
        "version of jaxrock": importlib.metadata.version("jaxrock"),
        "version of JAX": jax.__version__,
    }


class Store:
    """A Zarr group: axes, one array for every result with one chunk for every block, and `finished`, written last."""

    def __init__(self, path: str | Path, names: list[str], made_by: dict[str, str]):
        """Open it.

        **Raises:** ValueError for a store of another sweep, or anything else at this path.
        """
        self.path, self.names = Path(path), names
        _check(self.path, made_by)
        self._group = needed("zarr").open_group(str(path), mode="r+")
        self._arrays = [self._group[name] for name in names]

    @property
    def block(self) -> tuple[int, ...]:
        """Points of a block along every axis of the grid."""
        return tuple(self._group.attrs["jaxrock_block"])

    def finished(self) -> np.ndarray:
        """Whether every block is done, in the order of the blocks."""
        return np.asarray(self._group[FINISHED][...]).ravel()

    def write(self, place: tuple[slice, ...], leaves: list[np.ndarray]) -> None:
        """Write one block: its results, and when all are there, that it is done."""
        for array, leaf in zip(self._arrays, leaves):
            array[place] = leaf
        number = tuple(part.start // size for part, size in zip(place, self.block))
        self._group[FINISHED][number] = True

    def read(self) -> list[np.ndarray]:
        """All results."""
        return [np.asarray(array[...]) for array in self._arrays]


def create(
    path: str | Path,
    axes: dict[str, np.ndarray],
    outer: bool,
    names: list[str],
    leaves: list[jax.ShapeDtypeStruct],
    block: tuple[int, ...],
    made_by: dict[str, str],
) -> None:
    """Make a store of a sweep, of which no block is done."""
    path = Path(path)
    zarr = needed("zarr")
    # Made elsewhere and moved: a job that is killed meanwhile leaves no half of a store.
    aside = path.with_name(f"{path.name}.{uuid.uuid4().hex}")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        group = zarr.open_group(str(aside), mode="w-", zarr_format=3)
        shape = shape_of(axes.values(), outer)
        for name, leaf in zip(names, leaves):
            group.create_array(
                name,
                shape=(*shape, *leaf.shape),
                dtype=leaf.dtype,
                chunks=(*block, *(max(n, 1) for n in leaf.shape)),
                dimension_names=dimensions(axes, outer, name, len(leaf.shape)),
                fill_value=np.nan if np.issubdtype(leaf.dtype, np.inexact) else 0,
            )
        for name, values in axes.items():
            array = group.create_array(
                name, shape=values.shape, dtype=values.dtype, dimension_names=(name if outer else POINT,)
            )
            array[...] = values
        # Its own chunk for every block: two processes never write the same file.
        blocks = tuple(-(-n // part) for n, part in zip(shape, block))
        group.create_array(
            FINISHED,
            shape=blocks,
            dtype=bool,
            chunks=(1,) * len(blocks),
            dimension_names=[f"{name}.block" for name in dimensions(axes, outer, FINISHED, 0)],
            fill_value=False,
        )
        group.attrs.update(
            {"layout": layout_name(outer), "jaxrock_block": list(block), _FINGERPRINT: json.dumps(made_by)}
        )
        os.rename(aside, path)
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _check(path: Path, made_by: dict[str, str]) -> None:
    zarr = needed("zarr")
    try:
        known = json.loads(zarr.open_group(str(path), mode="r").attrs[_FINGERPRINT])
    except Exception as error:  # whatever is there, it is none of ours
        raise ValueError(
            f"Argument `store` must be a new path or the store of a sweep, but {path} is neither."
        ) from error
    parts = [part for part in {**known, **made_by} if known.get(part) != made_by.get(part)]
    if parts:
        raise ValueError(
            f"The store {path} was made by another sweep: other {'; other '.join(parts)}. Take another path, or the "
            "same sweep."
        )
