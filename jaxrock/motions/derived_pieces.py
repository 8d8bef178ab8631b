"""The pieces of a motion that is made of another one: the same pieces, or those from a time on."""

from typing import TYPE_CHECKING

import jax.numpy as jnp
from jaxtyping import Array, Inexact, Int

from jaxrock._core.types import Scalar
from jaxrock.compiler.hints import select
from jaxrock.motions.interface import AbstractPieces, Piece
from jaxrock.motions.pieces import Extent
from jaxrock.motions.shaking import Bounds, Envelope
from jaxrock.numerics.lookup import count_up_to, take

_FEW = 8  # pieces without a length that are not worth a table of the next one with a length


class SamePieces(AbstractPieces):
    """The pieces of `motion`, a field of the class that takes them over."""

    if TYPE_CHECKING:  # an annotation here would be a field

        @property
        def motion(self) -> AbstractPieces: ...

    @property
    def knots(self) -> Inexact[Array, " knots"]:
        return self.motion.knots

    @property
    def first_quiet(self) -> int:
        return self.motion.first_quiet

    @property
    def lengths(self) -> Inexact[Array, " pieces"]:
        return self.motion.lengths

    def length(self, piece: Piece) -> Scalar:
        return self.motion.length(piece)

    @property
    def lasting(self) -> Extent:
        return self.motion.lasting

    @property
    def time_rounding(self) -> Scalar | None:
        return self.motion.time_rounding

    @property
    def following(self) -> Int[Array, " knots"] | None:
        return self.motion.following

    @property
    def scales(self) -> Inexact[Array, " pieces"] | None:
        return self.motion.scales


class RestOfPieces(SamePieces):
    """The pieces of `motion` from the time `start` [s] on, both fields of the class that takes them over."""

    if TYPE_CHECKING:

        @property
        def start(self) -> Scalar: ...

    @property
    def _current(self) -> tuple[Int[Array, ""], Scalar]:
        """The piece in which the rest begins, and the time that is over of it [s]."""
        knots = self.motion.knots
        piece = jnp.clip(count_up_to(knots, self.start) - 1, 0, knots.size - 2).astype(jnp.int32)
        return piece, self.start - take(knots, piece)

    @property
    def knots(self) -> Inexact[Array, " knots"]:
        knots, (current, _) = self.motion.knots, self._current
        return select(jnp.arange(knots.size) > current, self._cut(knots - self.start), 0.0)

    @staticmethod
    def _cut(left: Inexact[Array, "..."]) -> Inexact[Array, "..."]:
        """Return a time that is left; zero after the end."""
        return select(left > 0, left, 0.0)

    @property
    def lengths(self) -> Inexact[Array, " pieces"]:
        inner = self.motion.lengths
        return self._left(jnp.arange(inner.size), inner)

    def length(self, piece: Piece) -> Scalar:
        return self._left(piece, self.motion.length(piece))

    def _left(self, piece: Int[Array, "..."], length: Inexact[Array, "..."]) -> Inexact[Array, "..."]:
        current, over = self._current
        return select(piece > current, length, select(piece == current, self._cut(length - over), 0.0))

    @property
    def lasting(self) -> Extent:
        found = Extent.of(self.lengths)
        return found._replace(forward=found.forward & self.motion.lasting.forward & (self.start >= 0))

    @property
    def following(self) -> Int[Array, " knots"] | None:
        inner, knots = self.motion.following, self.motion.knots.size
        if inner is None and knots <= _FEW:
            return None
        current, _ = self._current
        first = jnp.maximum(jnp.arange(knots, dtype=jnp.int32), current)
        return first if inner is None else inner[first]

    @property
    def envelope(self) -> Envelope:
        current, _ = self._current

        def of_the_rest(x: Bounds) -> Bounds:
            left = jnp.arange(x.values.size) >= current
            return x._replace(values=select(left, x.values, 0.0), peak=None)

        return self.motion.envelope.each(of_the_rest)

    def series(self, piece: Piece, local: Scalar, unit: Scalar, order: int) -> list[Scalar]:
        return self.motion.series(piece, self._within(piece, local), unit, order)

    def vertical_series(self, piece: Piece, local: Scalar, unit: Scalar, order: int) -> list[Scalar] | None:
        return self.motion.vertical_series(piece, self._within(piece, local), unit, order)

    def _within(self, piece: Piece, local: Scalar) -> Scalar:
        """Return the time since the start of a piece of the whole motion [s]."""
        current, over = self._current
        return local + select(piece == current, over, 0.0)
