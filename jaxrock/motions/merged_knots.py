"""Merged knots of two motions: the partition into pieces on which both motions are smooth."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Inexact, Int

from jaxrock._core.types import Scalar
from jaxrock.compiler import custom_tangent
from jaxrock.compiler.hints import select, stop_gradient
from jaxrock.motions.shaking import Bounds

_FEW = 32  # up to so many pieces, all pairs are compared; more are sorted


class Place(NamedTuple):
    """The piece of a motion, and whether the motion is under way; it is not before its first piece and after its
    last.
    """

    piece: Int[Array, "..."]
    moving: Bool[Array, "..."]


class MergedKnots(NamedTuple):
    """Merged pieces, from the knots of two motions.

    Where knots of both motions coincide, those of the first come first, also where only their derivatives differ.
    Between them lies a piece of zero length, in which the first motion is already past its knot and the second is not.
    """

    first: Inexact[Array, " knots"]
    second: Inexact[Array, " more"]

    @property
    def knots(self) -> Inexact[Array, " finer"]:
        """Times that bound the merged pieces [s]."""
        knots = jnp.concatenate([self.first, self.second])
        if knots.size > _FEW:
            return jnp.sort(knots)  # stable: equal knots keep their order
        return custom_tangent(_in_order, jnp.sort(stop_gradient(knots)), (self.first, self.second))

    @property
    def _passed(self) -> Int[Array, " pieces"]:
        """Number of knots of the first motion up to the beginning of each merged piece."""
        first, second, begins = jax.lax.stop_gradient((self.first, self.second, self.knots[:-1, None]))
        if begins.size > _FEW:
            knots, is_first = jnp.concatenate([first, second]), jnp.arange(begins.size + 1) < first.size
            return jnp.cumsum(jax.lax.sort((knots, is_first.astype(jnp.int32)), num_keys=1)[1][:-1])
        up_to, below = (jnp.sum(each, axis=1, dtype=jnp.int32) for each in (first <= begins, second < begins))
        return jnp.minimum(up_to, jnp.arange(1, begins.size + 1, dtype=jnp.int32) - below)

    @property
    def following(self) -> Int[Array, " knots"] | None:
        """For each merged piece, and for the end, the first piece from there on with a positive length.

        None for few pieces: stepping over them one by one is as quick.
        """
        return following_of(self.knots)

    def places(self, piece: Int[Array, "..."]) -> tuple[Place, Place]:
        """Return the places of both motions in merged pieces."""
        passed = self._passed[piece]
        return _place(self.first, passed - 1), _place(self.second, piece - passed)

    def spread(self, *values: Inexact[Array, " _"] | None, quiet: float) -> list[Any]:
        """Spread one value per piece of each motion (None: it has none) over the merged pieces.

        A merged piece gets `quiet` where the motion is still, and where the piece has no length: the two motions are
        never in such a piece at once.
        """
        begins, lasting = self.knots[:-1], jnp.diff(self.knots) > 0
        places = self.places(jnp.arange(begins.size))
        return [
            None if each is None else select(place.moving & lasting, each[place.piece], quiet)
            for place, each in zip(places, values)
        ]

    def spread_bounds(self, *bounds: Bounds) -> list[Bounds]:
        """Spread the bounds of both motions over the merged pieces."""
        found = self.spread(*(each.values for each in bounds), quiet=0.0)
        return [each._replace(values=values) for each, values in zip(bounds, found)]

    def series(
        self, *series: Callable | None, piece: Int[Array, ""], local: Scalar, unit: Scalar, order: int
    ) -> list[list[Scalar] | None]:
        """Return the terms of each motion's `series`, horizontal or vertical (None: not asked for), in a merged
        piece.
        """
        begin, found = self.knots[piece], []
        for knots, each, place in zip((self.first, self.second), series, self.places(piece)):
            terms = None if each is None else each(place.piece, begin - knots[place.piece] + local, unit, order)
            found.append(None if terms is None else [select(place.moving, u, 0.0) for u in terms])
        return found


def _in_order(_, knots: tuple, changes: tuple) -> Inexact[Array, " finer"]:
    """Sort the tangents of few knots along with the knots.

    JAX's own rule also sorts indices and gathers by them, which does not become machine code inside a step.
    """
    first, second = stop_gradient(knots)
    count = [jnp.arange(x.size, dtype=jnp.int32) for x in (first, second)]
    before_first = jnp.sum(second < first[:, None], axis=1, dtype=jnp.int32)
    before_second = jnp.sum(first <= second[:, None], axis=1, dtype=jnp.int32)
    numbers, found = jnp.arange(first.size + second.size, dtype=jnp.int32)[:, None], 0.0
    for place, change in zip((count[0] + before_first, count[1] + before_second), changes):
        if change is not None:
            found = found + jnp.sum(select(place == numbers, change, 0.0), axis=1)
    return jnp.asarray(found)


def following_of(knots: Inexact[Array, " knots"]) -> Int[Array, " knots"] | None:
    """Return, for each piece and for the end, the first piece from there on with a length; None for few pieces."""
    return _following(knots) if knots.size > _FEW else None


@jax.custom_jvp
def _following(knots: Inexact[Array, " knots"]) -> Int[Array, " knots"]:
    numbers = jnp.arange(knots.size, dtype=jnp.int32)
    last = numbers[-1:]
    lasting = select(jnp.diff(knots) > 0, numbers[:-1], last)
    return jax.lax.cummin(jnp.concatenate([lasting, last]), reverse=True)


@functools.partial(_following.defjvp, symbolic_zeros=True)
def _(knots, changes):
    # With tangents, a piece of zero length between coinciding knots has derivatives, so it is not skipped.
    still = isinstance(changes[0], SymbolicZero)
    found = _following(*knots) if still else jnp.arange(knots[0].size, dtype=jnp.int32)
    return found, np.zeros(found.shape, jax.dtypes.float0)


def _place(knots: Inexact[Array, " knots"], piece: Int[Array, "..."]) -> Place:
    last = knots.size - 2
    return Place(jnp.clip(piece, 0, last).astype(jnp.int32), (piece >= 0) & (piece <= last))
