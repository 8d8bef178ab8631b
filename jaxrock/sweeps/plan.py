"""Grid of points, its blocks, and the order in which points are computed."""

import functools
import math
from typing import NamedTuple

import numpy as np

from jaxrock.sweeps.labels import shape_of

_CHUNK = 64  # neighbours that go to one device together
_TILE = 8  # extent of these neighbours along each of the last two axes of a grid
# By the number of lanes of a compiled call on a CPU: the most calls of that size. More calls would use the next size:
# compiling another size takes longer than these calls.
_CALLS = {_CHUNK: 1, 2 * _CHUNK: 4, 2**10: 8, 2**14: math.inf}
_GPU_LANES = 2**10, 2**16  # the least and the most, in powers of two
_SMALLEST_BLOCK = 65536
_LARGEST_BLOCK = 2**18  # bounds the memory for grids of any size
_BLOCKS = 64  # number of blocks of a large grid, which processes share; a killed job loses one per process at most


class Plan(NamedTuple):
    """Grid of points and its blocks: tiles of `block` points along each axis; the last of an axis may be smaller."""

    axes: tuple[np.ndarray, ...]
    outer: bool
    block: tuple[int, ...]

    @classmethod
    def of(cls, axes: tuple[np.ndarray, ...], outer: bool, points: int | None = None) -> "Plan":
        """Plan blocks of about `points` points: whole rows of the last axes, if they fit."""
        shape = shape_of(axes, outer)
        room = points or min(max(_SMALLEST_BLOCK, math.prod(shape) // _BLOCKS), _LARGEST_BLOCK)
        block = []
        for size in reversed(shape):
            parts = -(-size // max(room, 1))
            block.insert(0, -(-size // parts))  # parts of nearly equal size
            room //= block[0]
        return cls(axes, outer, tuple(block))

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the grid."""
        return shape_of(self.axes, self.outer)

    @property
    def blocks(self) -> tuple[int, ...]:
        """Number of blocks along every axis."""
        return tuple(-(-size // part) for size, part in zip(self.shape, self.block))

    @property
    def sizes(self) -> np.ndarray:
        """Number of points of every block."""
        lengths = [np.minimum(part, n - part * np.arange(-(-n // part))) for n, part in zip(self.shape, self.block)]
        return functools.reduce(np.multiply.outer, lengths).ravel()

    def place(self, number: int) -> tuple[slice, ...]:
        """Return the slices of a block in the grid."""
        index = np.unravel_index(number, self.blocks)
        return tuple(slice(int(i) * p, min((int(i) + 1) * p, n)) for i, p, n in zip(index, self.block, self.shape))

    def points(self, number: int) -> list[np.ndarray]:
        """Return the flat points of a block."""
        place = self.place(number)
        if not self.outer:
            return [values[place[0]] for values in self.axes]
        parts = [values[part] for values, part in zip(self.axes, place)]
        return [x.ravel() for x in np.meshgrid(*parts, indexing="ij")]


def layout(points: int, devices: int, platform: str) -> tuple[int, int]:
    """Return the shape of a batch, (devices, lanes): one of few shapes, each of which is compiled.

    Few points skip the fast pass (`compiler.primitive.lanes`), which changes the last digits. The number of points
    decides it, not the number of devices that share them.
    """
    share = -(-points // devices)
    if platform != "cpu":
        least, most = _GPU_LANES
        return devices, 2 ** (min(max(share, least), most) - 1).bit_length()
    few = points <= _CHUNK
    return devices, next(n for n, calls in _CALLS.items() if share <= n * calls and (few or n > _CHUNK))


def shard(points: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Reorder flat points by device, with chunks in turn: neighbours cost the same, so the shares do."""
    devices, lanes = shape
    if devices == 1:
        return points
    return points.reshape(lanes // _CHUNK, devices, _CHUNK).swapaxes(0, 1).ravel()


@functools.lru_cache(maxsize=16)
def dealt_to(shape: tuple[int, int]) -> list[np.ndarray]:
    """Return the points of a batch that each device has, in its order."""
    return list(shard(np.arange(math.prod(shape)), shape).reshape(shape))


@functools.lru_cache(maxsize=16)
def tiles(shape: tuple[int, ...], columns: bool) -> np.ndarray:
    """Order a block's flat points so that neighbours along its last two axes are near each other.

    Neighbours along the last axis are nearest (`columns`: along the last but one).
    """
    if len(shape) < 2:
        return np.arange(math.prod(shape))
    *rest, i, j = (x.ravel() for x in np.indices(shape))
    within = (i, j) if columns else (j, i)
    return np.lexsort((*within, j // _TILE, i // _TILE, *reversed(rest)))
