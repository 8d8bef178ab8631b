"""The lowest ends of one line, as a plain function of arrays that can be traced (`ends` finds all ends of many lines).

The number of ends is unknown at trace time, so the caller gives the number wanted. Intervals wait in a queue, the
lowest first. A few at a time are halved, until the wanted ends are found or no interval can hide another.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxrock.studies.ends import (
    MOST_POINTS,
    PLACES,
    Sides,
    are_close,
    ends_of,
    halved,
    is_blurred,
    is_told,
    is_wide,
    next_point,
    none_open,
    with_open,
    without_open,
)

_AT_A_TIME = 32  # intervals
_ROOM = 1024  # capacity of the queue; each interval taken leaves at most two, which are taken next


class _Line(NamedTuple):
    """Queue of intervals, in rising order."""

    sides: Sides
    depth: Int[Array, " n"]
    here: Bool[Array, " n"]  # whether there is one
    tries: Int[Array, " n"]  # how often it was divided in vain, where the verdict is open

    def first(self, count: int) -> "_Line":
        """Return the first `count` intervals from the left; missing ones are empty places."""
        order = jnp.argsort(jnp.where(self.here, self.sides[0][0], jnp.inf), stable=True)[:count]
        return _Line([x[:, order] for x in self.sides], self.depth[order], self.here[order], self.tries[order])

    def part(self, begin: int, end: int) -> "_Line":
        """Return the intervals from `begin` to `end`."""
        return jax.tree.map(lambda x: x[..., begin:end], self)

    def followed_by(self, other: "_Line") -> "_Line":
        """Concatenate both queues, without sorting."""
        return jax.tree.map(lambda a, b: jnp.concatenate([a, b], axis=-1), self, other)


def lowest_ends(at: Callable, grid: Float[Array, " points"], most: int) -> dict[str, Any]:
    """Find the `most` lowest ends, without derivatives.

    `at`: margin, slope, impacts and openness at one point. **Returns:** the fields of `ends_of` for each end, and three
    flags. `found`: the place holds an end; `complete`: every sampled point could be decided; `from_the_least`: the
    scene overturns at the first point.
    """
    many = jax.vmap(at)
    values = without_open(jnp, [grid, *many(grid)])
    sides = [jnp.stack([x[:-1], x[1:]]) for x in values]
    count = grid.size - 1
    empty = _Line(
        [jnp.zeros_like(x, shape=(2, _ROOM)) for x in sides], *(jnp.zeros(_ROOM, t) for t in (int, bool, int))
    )
    line = _Line(sides, *(fill(count, t) for fill, t in zip((jnp.zeros, jnp.ones, jnp.zeros), (int, bool, int))))
    line = line.followed_by(empty).first(_ROOM)
    kept = empty.part(0, most)

    def unfinished(carry):
        line, kept, _ = carry
        return line.here[0] & ~(kept.here[-1] & (kept.sides[0][0, -1] <= line.sides[0][0, 0]))

    def step(carry):
        line, kept, complete = carry
        now, rest = line.part(0, _AT_A_TIME), line.part(_AT_A_TIME, _ROOM)
        left, right = now.sides[0]
        middle = jnp.where(now.here, left + places[now.tries] * (right - left), grid[0])
        values, blurred = (middle, *many(middle)), is_blurred(jnp, now.sides)
        again = now.here & values[4] & ~blurred & (now.tries < len(PLACES) - 1)
        complete &= (is_told(jnp, values, blurred) | again | ~now.here).all()
        sides, depth, single, more = halved(jnp, now.sides, values, now.depth)
        here, fresh = jnp.tile(now.here, 2), jnp.zeros_like(depth)
        kept = kept.followed_by(_Line(sides, depth, single & here, fresh)).first(most)
        rest = rest.followed_by(now._replace(here=again, tries=now.tries + 1))
        waiting = rest.followed_by(_Line(sides, depth, more & here, fresh)).first(_ROOM + _AT_A_TIME)
        return waiting.part(0, _ROOM), kept, complete & ~waiting.here[_ROOM]

    places = jnp.asarray(PLACES)
    complete = is_told(jnp, values, False).all()
    _, kept, complete = jax.lax.while_loop(unfinished, step, (line, kept, complete))
    sides, known = _closed(many, kept.sides, kept.here, grid[0])
    return ends_of(jnp, sides) | {"found": kept.here, "complete": complete & known, "from_the_least": values[1][0] < 0}


def _closed(many: Callable, sides: Sides, here: Bool[Array, " n"], elsewhere: Float[Array, ""]) -> tuple[Sides, Array]:
    """Narrow brackets to rounding; also return whether every point on the way could be decided."""

    def is_open(sides):
        return here & is_wide(jnp, sides)

    def step(carry):
        sides, known, extremes, count = carry
        open_ = is_open(sides)
        trial = jnp.where(open_, next_point(jnp, sides, count), elsewhere)
        values = (trial, *many(trial))
        onto = jnp.arange(2)[:, None] == ((values[1] < 0) == (sides[1][1] < 0))
        known &= ~(jnp.isnan(values[1]) & ~values[4] & open_).any()
        extremes = with_open(jnp, extremes, (*values[:4], values[4] & open_))
        return [jnp.where(onto & open_, new, old) for new, old in zip(values, sides)], known, extremes, count + 1

    start = sides, jnp.asarray(True), none_open(jnp, sides[0][0]), 0
    found = jax.lax.while_loop(lambda c: is_open(c[0]).any() & (c[3] < MOST_POINTS), step, start)
    return found[0], found[1] & (are_close(jnp, found[2], found[0]) | ~here).all()
