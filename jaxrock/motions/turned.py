"""Motions as a block feels them that may be turned round: mirrored, but for what the ground does vertically."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Inexact

from jaxrock._checks import factor
from jaxrock._parameters import parameter
from jaxrock.motions.motion import AbstractMotion, AtTheSameTimes, Piece, Scalar, Scaled
from jaxrock.motions.shaking import Envelope


def has_vertical(motion: AbstractMotion) -> bool:
    """Whether the ground moves vertically; how much is not computed."""
    return jax.eval_shape(lambda motion: motion.vertical_bounds, motion) is not None


def felt(motion: AbstractMotion, times: Scalar) -> AbstractMotion:
    """A motion `times` as strong; if that is negative, as a block feels it that is turned round."""
    if not has_vertical(motion):
        return Scaled(motion, times)
    return Scaled(Turned(motion, jnp.where(times < 0, -1.0, 1.0)), jnp.abs(times))


class Turned(AtTheSameTimes):
    """A motion whose horizontal acceleration is mirrored where `way` is -1."""

    way: Inexact[Array, "..."] = parameter("-", factor, is_free=False)

    @property
    def envelope(self) -> Envelope:
        return self.motion.envelope

    def series(self, piece: Piece, local: Scalar, unit: Scalar, order: int) -> list[Scalar]:
        return [self.way * u for u in self.motion.series(piece, local, unit, order)]

    def vertical_series(self, piece: Piece, local: Scalar, unit: Scalar, order: int) -> list[Scalar] | None:
        return self.motion.vertical_series(piece, local, unit, order)
