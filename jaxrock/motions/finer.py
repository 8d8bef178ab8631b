"""Two motions at once: where the pieces of each lie among the finer ones that end wherever a piece of either ends."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Inexact, Int

from jaxrock.motions.shaking import Bounds
from jaxrock.numerics.choice import where
from jaxrock.numerics.fixed import fixed
from jaxrock.numerics.given import given, is_zero

Scalar = Inexact[Array, ""]
_FEW = 32  # pieces that are compared, one with all; more are sorted


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
        knots = jnp.concatenate([self.first, self.second])
        if knots.size > _FEW:
            return jnp.sort(knots)  # which keeps the order of those that are alike
        return given(_in_order, jnp.sort(fixed(knots)), (self.first, self.second))

    @property
    def _passed(self) -> Int[Array, " pieces"]:
        """How many knots of the first motion come before each finer piece."""
        first, second, begins = jax.lax.stop_gradient((self.first, self.second, self.knots[:-1, None]))
        if begins.size > _FEW:
            knots, is_first = jnp.concatenate([first, second]), jnp.arange(begins.size + 1) < first.size
            return jnp.cumsum(jax.lax.sort((knots, is_first.astype(jnp.int32)), num_keys=1)[1][:-1])
        up_to, below = (jnp.sum(each, axis=1, dtype=jnp.int32) for each in (first <= begins, second < begins))
        return jnp.minimum(up_to, jnp.arange(1, begins.size + 1, dtype=jnp.int32) - below)

    @property
    def following(self) -> Int[Array, " knots"] | None:
        """For each finer piece, and for what comes after them, the first from there on that lasts; None: they are few,
        and one after the other is as quick."""
        knots = self.knots
        return _following(knots) if knots.size > _FEW else None

    def places(self, piece: Int[Array, "..."]) -> tuple[Place, Place]:
        """Where the two motions are in finer pieces."""
        passed = self._passed[piece]
        return _place(self.first, passed - 1), _place(self.second, piece - passed)

    def spread(self, *values: Inexact[Array, " _"] | None, quiet: float) -> list[Any]:
        """Values of the pieces of either motion (None: it has none) for the finer ones; `quiet` where it is still, and
        in pieces without a length, where both never are at once."""
        begins, lasting = self.knots[:-1], jnp.diff(self.knots) > 0
        places = self.places(jnp.arange(begins.size))
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


def _in_order(_, knots: tuple, changes: tuple) -> Inexact[Array, " finer"]:
    """Changes of few knots that are sorted: JAX would sort their numbers, too, and look them up, which becomes no
    machine code where it is done at every step."""
    first, second = fixed(knots)
    count = [jnp.arange(x.size, dtype=jnp.int32) for x in (first, second)]
    before_first = jnp.sum(second < first[:, None], axis=1, dtype=jnp.int32)
    before_second = jnp.sum(first <= second[:, None], axis=1, dtype=jnp.int32)
    numbers, found = jnp.arange(first.size + second.size, dtype=jnp.int32)[:, None], 0.0
    for place, change in zip((count[0] + before_first, count[1] + before_second), changes):
        if not is_zero(change):
            found = found + jnp.sum(where(place == numbers, change, 0.0), axis=1)
    return jnp.asarray(found)


@jax.custom_jvp
def _following(knots: Inexact[Array, " knots"]) -> Int[Array, " knots"]:
    numbers = jnp.arange(knots.size, dtype=jnp.int32)
    last = numbers[-1:]
    lasting = where(jnp.diff(knots) > 0, numbers[:-1], last)
    return jax.lax.cummin(jnp.concatenate([lasting, last]), reverse=True)


@functools.partial(_following.defjvp, symbolic_zeros=True)
def _(knots, changes):
    # Of knots that come together one may go: a piece without a length has derivatives, and is not passed over.
    still = isinstance(changes[0], SymbolicZero)
    found = _following(*knots) if still else jnp.arange(knots[0].size, dtype=jnp.int32)
    return found, np.zeros(found.shape, jax.dtypes.float0)


def _place(knots: Inexact[Array, " knots"], piece: Int[Array, "..."]) -> Place:
    last = knots.size - 2
    return Place(jnp.clip(piece, 0, last).astype(jnp.int32), (piece >= 0) & (piece <= last))
