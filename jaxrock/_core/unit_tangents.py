"""Unit tangents of arrays, one for each number in them, for Jacobians by columns."""

import math
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

AT_ONCE = 8  # unit tangents whose products machine code keeps in registers


def unit_tangents(leaves: Sequence) -> list:
    """Return the unit tangents of leaves, in a leading axis: each is one for one number, and zero for all others."""
    sizes = [math.prod(leaf.shape) for leaf in leaves]
    whole = jnp.eye(sum(sizes), dtype=jnp.result_type(*(leaf.dtype for leaf in leaves)))
    parts = jnp.split(whole, np.cumsum(sizes)[:-1], axis=1)
    return [part.reshape(-1, *leaf.shape).astype(leaf.dtype) for part, leaf in zip(parts, leaves)]


def in_rows(tangents: Sequence, most: int) -> list:
    """Return tangents in rows of at most `most`; the last row is filled up with zeros."""
    count = len(tangents[0])
    rows = -(-count // most)
    width = -(-count // rows)

    def cut(x):
        return jnp.pad(x, [(0, rows * width - count), *[(0, 0)] * (x.ndim - 1)]).reshape(rows, width, *x.shape[1:])

    return [cut(x) for x in tangents]
