"""Types of traced arrays within `jax.shard_map`, which hold axes of the mesh, for the primitives of the package."""

from collections.abc import Sequence
from typing import Any

import jax
from jax.sharding import PartitionSpec


def _varying(aval: Any) -> frozenset:
    """Return the axes of a mesh along which a value differs."""
    return getattr(getattr(aval, "mat", aval), "varying", None) or getattr(aval, "vma", None) or frozenset()


def typed_like(operands: Sequence, shapes: Sequence[tuple[tuple[int, ...], Any]]) -> list:
    """Return types of results of these shapes and dtypes; they vary along each axis of the mesh that an operand does.

    **Raises:** TypeError where no operand varies along the axes of all others.
    """
    widest = max(operands, key=lambda aval: len(_varying(aval)), default=None)
    if widest is None or not _varying(widest):
        return [jax.core.ShapedArray(shape, dtype) for shape, dtype in shapes]
    if any(_varying(aval) - _varying(widest) for aval in operands):
        raise TypeError("Arguments differ along different axes of a mesh: make them alike by `jax.lax.pcast`.")

    def of(shape, dtype):
        sharding = widest.sharding.update(spec=PartitionSpec(*[None] * len(shape)))
        return widest.update(shape=shape, dtype=dtype, weak_type=False, sharding=sharding)

    return [of(*each) for each in shapes]


def summed_like(value: Any, aval: Any) -> Any:
    """Return a cotangent, summed over the axes of a mesh along which its primal `aval` does not vary."""
    axes = _varying(jax.typeof(value)) - _varying(aval)
    return jax.lax.psum(value, tuple(axes)) if axes else value


def without_mesh(context):
    """Return a lowering context whose operands have types without a mesh."""
    return context.replace(avals_in=[jax.core.ShapedArray(x.shape, x.dtype) for x in context.avals_in])
