"""Sums of many motions: what their merged pieces need, computed once, in tables that grow with the number of parts.

Parts of one class that differ by numbers only are stacked. A step evaluates one of them after another, and only those
between the first that has not ended and the last that has begun. The compiled program therefore does not grow with the
number of parts.
"""

import functools
import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Inexact, Int

from jaxrock._core.types import Scalar
from jaxrock.compiler import custom_tangent
from jaxrock.compiler.hints import select, stop_gradient
from jaxrock.motions.merged_knots import MergedKnots, following_of
from jaxrock.motions.nesting import MOST, too_many
from jaxrock.motions.pieces import Extent
from jaxrock.motions.shaking import sum_of_series

_SHORT = 8  # most pieces of a part that is stacked

_Motion = Any  # an `AbstractMotion`, whose module imports this one


class _Alone(eqx.Module):
    """One part that no other is like."""

    part: _Motion
    times: Inexact[Array, " knots"]  # its knots after a first quiet [s]
    passed: Int[Array, " pieces"]  # number of these up to the beginning of each merged piece
    quiet: int = eqx.field(static=True)  # pieces before the part begins

    @classmethod
    def of(cls, parts: Sequence[_Motion], times: Inexact[Array, " all"], ranks: Int[Array, " all"], pieces: int):
        """Make it from the places `ranks` of its `times` among all knots."""
        (part,) = parts
        here = jnp.zeros(pieces + 1, jnp.int32).at[ranks].set(1)
        return cls(part, times, jnp.cumsum(here)[:-1], part.first_quiet)

    @property
    def pieces(self) -> int:
        """Number of pieces of the part, after a first quiet."""
        return self.times.size - 1

    @property
    def _moving(self) -> Bool[Array, " pieces"]:
        return (self.passed > 0) & (self.passed < self.times.size)

    def spread(self, name: str, reduce: Any, none: float) -> Inexact[Array, " pieces"] | None:
        """Spread one value per piece of the part over the merged pieces."""
        values = getattr(self.part, name)
        inner = self.quiet + jnp.clip(self.passed - 1, 0, self.times.size - 2)
        return None if values is None else select(self._moving, values[inner], none)

    def is_forward(self) -> Bool[Array, ""]:
        """Return whether no piece of the part has a negative length."""
        return (self.part.lengths >= 0).all()

    def series(self, name: str, piece: Int[Array, ""], time: tuple, unit: Scalar, order: int) -> list[Scalar] | None:
        """Return the terms of the part in a merged piece, at (its begin, the time since then)."""
        passed, (begin, local) = self.passed[piece], time
        inner = jnp.clip(passed - 1, 0, self.times.size - 2)
        terms = getattr(self.part, name)(self.quiet + inner, begin - self.times[inner] + local, unit, order)
        moving = (passed > 0) & (passed < self.times.size)
        return None if terms is None else [select(moving, u, 0.0) for u in terms]


class _Alike(eqx.Module):
    """Parts that differ by numbers only, in the order in which they begin."""

    parts: _Motion  # all numbers have an axis of parts
    times: Inexact[Array, " begins"]  # begin of each piece of each part, after a first quiet [s]
    ranks: Int[Array, " knots"]  # places of the knots of each part, after a first quiet, among all
    first: Int[Array, " pieces"]  # the first part that has not ended, in each merged piece
    end: Int[Array, " pieces"]  # number of parts that have begun
    quiet: int = eqx.field(static=True)
    count: int = eqx.field(static=True)  # number of parts

    @classmethod
    def of(cls, parts: Sequence[_Motion], times: Inexact[Array, " all"], ranks: Int[Array, " all"], pieces: int):
        """Make it from the places `ranks` of the `times` of all parts among all knots."""
        count = len(parts)
        times, ranks = times.reshape(count, -1), ranks.reshape(count, -1)
        order = jnp.argsort(ranks[:, 0])
        stacked = jax.tree.map(lambda *x: jnp.stack(x)[order], *parts)
        times, ranks = times[order], ranks[order]
        at = jnp.arange(pieces, dtype=jnp.int32)
        first, end = (_count_up_to(x, at) for x in (jax.lax.cummax(ranks[:, -1]), ranks[:, 0]))
        return cls(stacked, times[:, :-1].ravel(), ranks.ravel(), first, end, parts[0].first_quiet, count)

    @property
    def pieces(self) -> int:
        """Number of pieces of each part, after a first quiet."""
        return self.times.size // self.count

    def spread(self, name: str, reduce: Any, none: float) -> Inexact[Array, " pieces"] | None:
        """Reduce one value per piece of each part over the parts that move, in each merged piece."""
        values = jax.vmap(lambda part: getattr(part, name))(self.parts)
        if values is None:
            return None
        ranks, at = self.ranks.reshape(self.count, -1), jnp.arange(self.first.size, dtype=jnp.int32)[:, None, None]
        moving = (ranks[:, :-1] <= at) & (at < ranks[:, 1:])
        return reduce(select(moving, values[:, self.quiet :], none), axis=(1, 2))

    def is_forward(self) -> Bool[Array, ""]:
        """Return whether no piece of a part has a negative length."""
        return (jax.vmap(lambda part: part.lengths)(self.parts) >= 0).all()

    def series(self, name: str, piece: Int[Array, ""], time: tuple, unit: Scalar, order: int) -> list[Scalar] | None:
        """Return the sum of the terms of the parts in a merged piece, at (its begin, the time since then)."""
        like = jax.eval_shape(lambda: self.one(jnp.int32(0), name, piece, time, unit, order))
        if like is None:
            return None
        leaves, structure = jax.tree.flatten((self, piece, time, unit))
        held, first, end = stop_gradient((jax.tree.unflatten(structure, leaves), self.first[piece], self.end[piece]))

        def add(carry):
            k, total = carry
            terms = held[0].one(k, name, *held[1:], order)
            return k + 1, [a + b for a, b in zip(total, terms)]

        nothing = [jnp.zeros(x.shape, x.dtype) for x in like]
        found = jax.lax.while_loop(lambda carry: carry[0] < end, add, (first, nothing))[1]
        return custom_tangent(_changes_of_sum, found, leaves, structure, name, order)

    def one(
        self, k: Int[Array, ""], name: str, piece: Int[Array, ""], time: tuple, unit: Scalar, order: int
    ) -> list[Scalar] | None:
        """Return the terms of part k in a merged piece."""
        count, (begin, local) = self.pieces, time
        ranks = [self.ranks[k * (count + 1) + i] for i in range(count + 1)]
        inner = sum(((rank <= piece).astype(jnp.int32) for rank in ranks[1:-1]), jnp.int32(0))
        part = jax.tree.map(lambda x: x[k], self.parts)
        since = begin - self.times[k * count + inner] + local
        terms = getattr(part, name)(self.quiet + inner, since, unit, order)
        moving = (ranks[0] <= piece) & (piece < ranks[-1])
        return None if terms is None else [select(moving, u, 0.0) for u in terms]

    def of_all(self, name: str, piece: Int[Array, ""], time: tuple, unit: Scalar, order: int) -> list[Scalar]:
        """Return `series` by a loop over all parts, which reverse mode differentiates.

        It skips no part: JAX does not transpose a vmapped `cond` whose operands are tangents.
        """

        def of(k):
            return self.one(k, name, piece, time, unit, order)

        nothing = [jnp.zeros(x.shape, x.dtype) for x in jax.eval_shape(of, jnp.int32(0))]
        return jax.lax.fori_loop(
            0, self.count, lambda k, total: [a + b for a, b in zip(total, of(jnp.int32(k)))], nothing
        )


def _changes_of_sum(structure: Any, name: str, order: int, _, leaves: list, changes: list) -> list[Scalar]:
    """Return the tangents of the terms of a sum of parts that are alike."""
    moving = [i for i, d in enumerate(changes) if d is not None and jnp.issubdtype(d.dtype, jnp.inexact)]

    def terms(*values):
        given = dict(zip(moving, values))
        alike, *at = jax.tree.unflatten(structure, [given.get(i, x) for i, x in enumerate(leaves)])
        return alike.of_all(name, *at, order)

    return jax.jvp(terms, [leaves[i] for i in moving], [changes[i] for i in moving])[1]


def _count_up_to(values: Int[Array, " n"], at: Int[Array, " m"]) -> Int[Array, " m"]:
    """Return how many of the sorted values are not larger than each of the numbers 0 to m - 1."""
    found = jnp.zeros(at.size + 1, jnp.int32).at[values].add(1)  # values beyond the last number do not count
    return jnp.cumsum(found)[:-1]


class MergedParts(eqx.Module):
    """The merged pieces of many motions: their knots, bounds and scales, and where each part is in them.

    Where knots of parts coincide, zero-length pieces lie between them, in which some parts are past their knots and
    others are not.
    """

    knots: Inexact[Array, " knots"]
    bounds: Inexact[Array, " pieces"]
    vertical_bounds: Inexact[Array, " pieces"] | None
    scales: Inexact[Array, " pieces"] | None
    lasting: Extent
    groups: tuple[_Alone | _Alike, ...]

    @classmethod
    def of(cls, parts: Sequence[_Motion]) -> "MergedParts":
        """Merge parts. **Raises:** ValueError for parts of too many kinds, whose program would be large."""
        kinds = _kinds(parts)
        if len(kinds) > MOST:
            raise too_many(len(kinds))
        begins = [_times(kind) for kind in kinds]
        times = jnp.concatenate([jnp.zeros_like(begins[0][:1]), *begins])  # the ground is still before its first part
        order = jnp.argsort(stop_gradient(times))  # stable: equal knots keep their order
        ranks = jnp.zeros(times.size, jnp.int32).at[order].set(jnp.arange(times.size, dtype=jnp.int32))
        places = itertools.accumulate((x.size for x in begins), initial=1)
        groups = tuple(
            (_Alone if len(kind) == 1 else _Alike).of(kind, own, ranks[place : place + own.size], times.size - 1)
            for kind, own, place in zip(kinds, begins, places)
        )
        knots = times[order]
        moves = jnp.diff(knots) > 0

        def spread(name, reduce, pairwise, none):
            found = [group.spread(name, reduce, none) for group in groups]
            found = [values for values in found if values is not None]
            return select(moves, functools.reduce(pairwise, found), none) if found else None

        lengths = Extent.of(jnp.diff(knots))
        forward = functools.reduce(jnp.logical_and, [group.is_forward() for group in groups], lengths.forward)
        return cls(
            knots=knots,
            bounds=spread("bounds", jnp.sum, jnp.add, 0.0),
            vertical_bounds=spread("vertical_bounds", jnp.sum, jnp.add, 0.0),
            scales=stop_gradient(spread("scales", jnp.min, jnp.minimum, jnp.inf)),
            lasting=lengths._replace(forward=forward),
            groups=groups,
        )

    @property
    def longest(self) -> int:
        """The largest number of pieces of a part."""
        return max(group.pieces for group in self.groups)

    @property
    def following(self) -> Int[Array, " knots"] | None:
        """For each merged piece, and for the end, the first piece from there on with a length; None for few pieces."""
        return following_of(self.knots)

    def series(self, name: str, piece: Int[Array, ""], local: Scalar, unit: Scalar, order: int) -> list[Scalar] | None:
        """Return the terms of the sum in a merged piece: the `series` or `vertical_series` of its parts, by name."""
        time = self.knots[piece], local
        found = (group.series(name, piece, time, unit, order) for group in self.groups)
        return functools.reduce(sum_of_series, found)


class MergedPair(NamedTuple):
    """The merged pieces of two motions, computed where they are needed."""

    first: _Motion
    second: _Motion

    @property
    def finer(self) -> MergedKnots:
        """Their merged knots."""
        return MergedKnots(self.first.knots, self.second.knots)

    @property
    def knots(self) -> Inexact[Array, " knots"]:
        """Times that bound the merged pieces [s]."""
        return self.finer.knots

    @property
    def following(self) -> Int[Array, " knots"] | None:
        """As of `MergedKnots`."""
        return self.finer.following

    @property
    def lasting(self) -> Extent:
        """The last piece with a length."""
        return Extent.of(jnp.diff(self.knots))

    @property
    def scales(self) -> Inexact[Array, " pieces"] | None:
        """The smaller time scale of both, in each merged piece [s]."""
        spread = self.finer.spread(*(motion.scales for motion in self), quiet=jnp.inf)
        found = [values for values in spread if values is not None]
        return functools.reduce(jnp.minimum, found) if found else None

    @property
    def bounds(self) -> Inexact[Array, " pieces"]:
        """Bounds of the absolute acceleration [g]."""
        # Values are spread before the gain applies, so that lanes with different gains share the spread array.
        both = self.finer.spread_bounds(*(motion.envelope.horizontal for motion in self))
        return functools.reduce(jnp.add, (bounds.times_gain(bounds.values) for bounds in both))

    @property
    def vertical_bounds(self) -> Inexact[Array, " pieces"] | None:
        """Bounds of the absolute vertical acceleration [g]."""
        spread = self.finer.spread(*(motion.vertical_bounds for motion in self), quiet=0.0)
        found = [bounds for bounds in spread if bounds is not None]
        return functools.reduce(jnp.add, found) if found else None

    def series(self, name: str, piece: Int[Array, ""], local: Scalar, unit: Scalar, order: int) -> list[Scalar] | None:
        """Return the terms of the sum in a merged piece: the `series` or `vertical_series` of both, by name."""
        both = (getattr(motion, name) for motion in self)
        return sum_of_series(*self.finer.series(*both, piece=piece, local=local, unit=unit, order=order))


def _kinds(parts: Sequence[_Motion]) -> list[list[_Motion]]:
    """Sort parts by what can be stacked: motions of a few pieces that differ by single numbers only."""
    kinds: dict[Any, list[_Motion]] = {}
    for number, part in enumerate(parts):
        leaves, structure = jax.tree.flatten(part)
        single = all(jnp.ndim(x) == 0 for x in leaves)
        key = (structure, *(jnp.result_type(x) for x in leaves)) if single else number
        kinds.setdefault(key, []).append(part)
    found = []
    for kind in kinds.values():
        few = len(kind) > 1 and jax.eval_shape(lambda part: part.knots, kind[0]).shape[0] - 1 <= _SHORT
        found += [kind] if few else [[part] for part in kind]
    return found


def _times(kind: Sequence[_Motion]) -> Inexact[Array, " all"]:
    """Return the knots of motions of a kind after their first quiet [s], one motion after another."""
    if len(kind) == 1:
        return kind[0].knots[kind[0].first_quiet :]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *kind)
    return jax.vmap(lambda part: part.knots[part.first_quiet :])(stacked).ravel()
