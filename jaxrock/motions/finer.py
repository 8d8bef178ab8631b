"""Two motions at once: where the pieces of each lie among the finer ones that end wherever a piece of either ends."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Inexact, Int

from jaxrock.motions.shaking import Bounds
from jaxrock.numerics.choice import where
from jaxrock.numerics.lookup import count_below, count_up_to

Scalar = Inexact[Array, ""]


class Place(NamedTuple):
    """The piece of a motion, and whether it moves: before and after its pieces it does not."""

    piece: Int[Array, "..."]
    moving: Bool[Array, "..."]


class Finer(NamedTuple):
    """The finer pieces, of the knots of two motions.

    Of knots that come together those of the first motion come first, also where they are told apart by their
    derivatives alone: between them lies a piece without a length, in which the first motion has moved on already, and
    the second has not.
    """

    first: Inexact[Array, " knots"]
    second: Inexact[Array, " more"]

    @property
    def knots(self) -> Inexact[Array, " finer"]:
        """Where they end, and the first begins [s]."""
        return jnp.sort(jnp.concatenate([self.first, self.second]))  # which keeps the order of those that are alike

    def places(self, piece: Int[Array, ""]) -> tuple[Place, Place]:
        """Where the two motions are in a finer piece."""
        return self._places(piece, self.knots[piece], count_up_to, count_below)

    def _places(self, piece, begin, up_to: Callable, below: Callable) -> tuple[Place, Place]:
        passed = jnp.minimum(up_to(self.first, begin), piece + 1 - below(self.second, begin))
        return _place(self.first, passed - 1), _place(self.second, piece - passed)

    def spread(self, *values: Inexact[Array, " _"] | None, quiet: float) -> list[Any]:
        """Values of the pieces of either motion (None: it has none) for the finer ones; `quiet` where it is still, and
        in pieces without a length, where both never are at once."""
        begins, lasting = self.knots[:-1], jnp.diff(self.knots) > 0
        places = self._places(
            jnp.arange(begins.size),
            begins,
            lambda knots, x: jnp.searchsorted(knots, x, side="right"),
            lambda knots, x: jnp.searchsorted(knots, x, side="left"),
        )
        return [
            None if each is None else where(place.moving & lasting, each[place.piece], quiet)
            for place, each in zip(places, values)
        ]

    def spread_bounds(self, *bounds: Bounds) -> list[Bounds]:
        """Bounds of the pieces of both motions for the finer ones."""
        found = self.spread(*(each.values for each in bounds), quiet=0.0)
        return [each._replace(values=values) for each, values in zip(bounds, found)]

    def series(
        self, *series: Callable | None, piece: Int[Array, ""], local: Scalar, unit: Scalar, order: int
    ) -> list[list[Scalar] | None]:
        """What the `series` of either motion, horizontal or vertical (None: not asked for), gives in a finer piece."""
        begin, found = self.knots[piece], []
        for knots, each, place in zip((self.first, self.second), series, self.places(piece)):
            terms = None if each is None else each(place.piece, begin - knots[place.piece] + local, unit, order)
            found.append(None if terms is None else [where(place.moving, u, 0.0) for u in terms])
        return found


def _place(knots: Inexact[Array, " knots"], piece: Int[Array, "..."]) -> Place:
    last = knots.size - 2
    return Place(jnp.clip(piece, 0, last).astype(jnp.int32), (piece >= 0) & (piece <= last))
