"""The pieces of a motion: how many of them have a length, and the acceleration at a time."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Inexact, Int

from jaxrock._core.types import Scalar
from jaxrock.compiler.hints import select
from jaxrock.numerics.lookup import count_up_to


class Extent(NamedTuple):
    """The extent of a motion in pieces, and whether time runs forward.

    - `pieces`: number of pieces up to the last one with a positive length.
    - `forward`: whether no length is negative or NaN.
    """

    pieces: Int[Array, ""]
    forward: Bool[Array, ""]

    @classmethod
    def of(cls, lengths: Inexact[Array, " pieces"]) -> "Extent":
        """Make it for pieces of these lengths [s]."""
        numbers = jnp.arange(1, lengths.size + 1, dtype=jnp.int32)
        return cls(jnp.max(select(lengths > 0, numbers, 0)), (lengths >= 0).all())

    @classmethod
    def of_equal(cls, length: Scalar, most: int, finish: Scalar | None = None) -> "Extent":
        """Make it for `most` pieces of one length [s]; those that begin at `finish` [s] or later have no length.

        None: all have one. The cost does not depend on the number of pieces.
        """
        length, end = jax.lax.stop_gradient((length, length if finish is None else finish))
        if most == 0:
            return cls(jnp.zeros((), jnp.int32), jnp.ones((), bool))
        if finish is None:
            return cls(select(length > 0, most, 0).astype(jnp.int32), length >= 0)
        found = jnp.ceil(end / select(length > 0, length, 1.0))
        found = select(found > 0, jnp.minimum(found, most), 0.0)  # 0 for NaN, too
        # The quotient is rounded, and so are the times at which pieces begin: these decide, as they do in `knots`.
        found = select((found > 0) & (length * (found - 1) >= end), found - 1, found)
        found = select((found < most) & (length * found < end), found + 1, found)
        return cls(select(length > 0, found, 0).astype(jnp.int32), length >= 0)

    def after(self, quiet: Scalar) -> "Extent":
        """Make it for the same pieces after one more, of this length [s]."""
        first = select(quiet > 0, 1, 0).astype(jnp.int32)
        return Extent(select(self.pieces > 0, self.pieces + 1, first), self.forward & (quiet >= 0))


@jax.jit
def acceleration_at(motion: Any, time: Inexact[Array, "..."]) -> Inexact[Array, "..."]:
    """Return the acceleration of a motion [g] at times from its start [s]: zero outside, at a jump the value after
    it.
    """
    motion = motion.prepared
    knots = motion.knots

    def at(t):
        piece = jnp.clip(count_up_to(knots, t) - 1, 0, knots.size - 2)
        value = motion.series(piece, t - knots[piece], jnp.ones_like(t), 0)[0]
        return select((t >= 0) & (t < knots[-1]), value, 0.0)

    return jax.vmap(at)(time.ravel().astype(knots.dtype)).reshape(time.shape)
