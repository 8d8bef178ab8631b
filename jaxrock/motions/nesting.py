"""The limit on motions within motions: each adds to the compiled program of the whole, unless a sum stacks it."""

from typing import Any

import equinox as eqx

MOST = 100  # motions one within another, and kinds of parts in a sum: their program compiles in about a minute


def check_nesting(motion: eqx.Module) -> None:
    """Raise ValueError for a motion made of too many parts, whose program would take minutes to compile.

    Every constructor of a motion calls this function, so that the count never recurses deeper than the limit.
    """
    count = _count(motion)
    if count > MOST:
        raise too_many(count)


def too_many(count: int) -> ValueError:
    """Return the error for a motion made of `count` motions."""
    return ValueError(
        f"A motion must be made of at most {MOST} motions, factors, shifts and sums, but this one is of {count}: "
        "make a `Record` of its samples, `rk.Record(sum(part.acceleration(times) for part in parts), dt)`."
    )


def _count(motion: Any) -> int:
    """Count the motions one within another; a sum counts as its largest part, as alike parts share a program."""
    values = vars(motion).values()
    largest = (
        max(map(_count, value))
        for value in values
        if isinstance(value, tuple) and value and isinstance(value[0], eqx.Module)
    )
    return 1 + sum(_count(part) for part in values if isinstance(part, eqx.Module)) + sum(largest)
