"""The interface between a ground motion and the engines: its smooth pieces, their bounds, scales and Taylor series."""

import abc

import jax.numpy as jnp
from jaxtyping import Array, Inexact, Int

from jaxrock._arguments.parameters import Owner
from jaxrock._core.arrays import of_each
from jaxrock._core.types import Scalar
from jaxrock.motions.pieces import Extent
from jaxrock.motions.shaking import Bounds, Envelope
from jaxrock.numerics.lookup import take

Piece = Int[Array, ""]  # number of a smooth piece


class AbstractPieces(Owner):
    """The smooth pieces of a ground motion."""

    @property
    @abc.abstractmethod
    def knots(self) -> Inexact[Array, " knots"]:
        """Times that bound the smooth pieces, from 0 to the end of the motion [s], never decreasing."""

    @property
    def first_quiet(self) -> int:
        """Number of pieces before it begins, in which the ground is still."""
        return 0

    @property
    def lengths(self) -> Inexact[Array, " pieces"]:
        """Durations of the pieces [s]; exact also for a motion that begins late, whose knots are rounded."""
        return jnp.diff(self.knots)

    def length(self, piece: Piece) -> Scalar:
        """Return the duration of one piece [s]."""
        return take(self.lengths, piece)

    @property
    def lasting(self) -> Extent:
        """The last piece with a positive length, and whether time runs forward in every piece."""
        return Extent.of(self.lengths)

    @property
    def time_rounding(self) -> Scalar | None:
        """Bound of the relative timing error of parts through rounding of times [s]; None: `lengths` are exact."""
        return None

    @property
    def following(self) -> Int[Array, " knots"] | None:
        """For each piece, and for the end, the first piece from there on that has a length; None: few or none to
        skip.
        """
        return None

    @property
    @abc.abstractmethod
    def scales(self) -> Inexact[Array, " pieces"] | None:
        """Time scale of the acceleration in each piece [s]; infinite for a straight line. None: all are straight."""

    @property
    @abc.abstractmethod
    def bounds(self) -> Inexact[Array, " pieces"]:
        """An upper bound of the absolute acceleration within each piece [g]."""

    @abc.abstractmethod
    def series(self, piece: Piece, local: Scalar, unit: Scalar, order: int) -> list[Scalar]:
        """Taylor coefficients of the acceleration [g] about `local` seconds after knot `piece`.

        Coefficient k multiplies (elapsed time / unit)^k. A motion that is a polynomial returns
        fewer than order + 1 coefficients: the others are zero.
        """

    @property
    def vertical_bounds(self) -> Inexact[Array, " pieces"] | None:
        """An upper bound of the absolute vertical acceleration within each piece [g]; None: the ground has none."""
        return None

    def vertical_series(self, piece: Piece, local: Scalar, unit: Scalar, order: int) -> list[Scalar] | None:
        """Return the Taylor coefficients of the vertical acceleration, positive upward [g], as `series` does."""
        return None

    @property
    def envelope(self) -> Envelope:
        """Bounds of the horizontal and of the vertical acceleration."""
        vertical = self.vertical_bounds
        return Envelope(Bounds(self.bounds), None if vertical is None else Bounds(vertical))

    @property
    def end(self) -> Scalar:
        """Time at which the ground comes to rest [s]."""
        return of_each(lambda knots: knots[-1], self.knots)
