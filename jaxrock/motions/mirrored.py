"""Motions as a block turned by half a circle feels them: the horizontal acceleration is mirrored, the vertical is
not.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Inexact

from jaxrock._arguments.parameters import parameter
from jaxrock._arguments.ranges import factor
from jaxrock._core.types import Scalar
from jaxrock.motions.motion import AbstractMotion, AtTheSameTimes, Piece, Scaled
from jaxrock.motions.shaking import Envelope


def has_vertical(motion: AbstractMotion) -> bool:
    """Return whether the ground moves vertically; the acceleration itself is not computed."""
    return jax.eval_shape(lambda motion: motion.vertical_bounds, motion) is not None


def scaled_and_mirrored(motion: AbstractMotion, times: Scalar) -> AbstractMotion:
    """Scale a motion by `times`; a negative factor mirrors its horizontal acceleration only, as if the block were
    turned.
    """
    if not has_vertical(motion):
        return Scaled(motion, times)
    return Scaled(Mirrored(motion, jnp.where(times < 0, -1.0, 1.0)), jnp.abs(times))


class Mirrored(AtTheSameTimes):
    """A motion whose horizontal acceleration is mirrored where `way` is -1."""

    way: Inexact[Array, "..."] = parameter("-", factor, is_free=False)

    @property
    def envelope(self) -> Envelope:
        return self.motion.envelope

    def series(self, piece: Piece, local: Scalar, unit: Scalar, order: int) -> list[Scalar]:
        return [self.way * u for u in self.motion.series(piece, local, unit, order)]

    def vertical_series(self, piece: Piece, local: Scalar, unit: Scalar, order: int) -> list[Scalar] | None:
        return self.motion.vertical_series(piece, local, unit, order)
