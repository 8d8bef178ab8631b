"""What the pieces of a motion tell: how many of them last, and which acceleration there is at a time."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Inexact, Int

from jaxrock.numerics.choice import where
from jaxrock.numerics.lookup import count_up_to

Scalar = Inexact[Array, ""]


class Lasting(NamedTuple):
    """Up to which piece a motion lasts, and whether time runs forward.

    - `pieces`: how many there are up to the last with a length above zero.
    - `forward`: whether no piece has a length below zero, or one that is not a number.
    """

    pieces: Int[Array, ""]
    forward: Bool[Array, ""]

    @classmethod
    def of(cls, lengths: Inexact[Array, " pieces"]) -> "Lasting":
        """Of pieces of these lengths [s]."""
        numbers = jnp.arange(1, lengths.size + 1, dtype=jnp.int32)
        return cls(jnp.max(where(lengths > 0, numbers, 0)), (lengths >= 0).all())

    @classmethod
    def of_equal(cls, length: Scalar, most: int, finish: Scalar | None = None) -> "Lasting":
        """Of `most` pieces of one length [s], of which those have none that would begin at `finish` [s] or later (None:
        all last). Found by a few numbers, not by a list of as many as there are pieces."""
        length, end = jax.lax.stop_gradient((length, length if finish is None else finish))
        if most == 0:
            return cls(jnp.zeros((), jnp.int32), jnp.ones((), bool))
        if finish is None:
            return cls(where(length > 0, most, 0).astype(jnp.int32), length >= 0)
        found = jnp.ceil(end / where(length > 0, length, 1.0))
        found = where(found > 0, jnp.minimum(found, most), 0.0)  # none, too, where it is not a number
        # The quotient is rounded, and so are times at which pieces begin: these decide, as they do in `knots`.
        found = where((found > 0) & (length * (found - 1) >= end), found - 1, found)
        found = where((found < most) & (length * found < end), found + 1, found)
        return cls(where(length > 0, found, 0).astype(jnp.int32), length >= 0)

    def after(self, quiet: Scalar) -> "Lasting":
        """Of the same pieces after one more, of this length [s]."""
        first = where(quiet > 0, 1, 0).astype(jnp.int32)
        return Lasting(where(self.pieces > 0, self.pieces + 1, first), self.forward & (quiet >= 0))


@jax.jit
def acceleration_at(motion: Any, time: Inexact[Array, "..."]) -> Inexact[Array, "..."]:
    """Acceleration of a motion [g] at times from its start [s]: zero outside of it, at a jump the value after it."""
    knots = motion.knots

    def at(t):
        piece = jnp.clip(count_up_to(knots, t) - 1, 0, knots.size - 2)
        value = motion.series(piece, t - knots[piece], jnp.ones_like(t), 0)[0]
        return where((t >= 0) & (t < knots[-1]), value, 0.0)

    return jax.vmap(at)(time.ravel().astype(knots.dtype)).reshape(time.shape)
