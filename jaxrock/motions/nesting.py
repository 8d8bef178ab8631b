"""The limit on the number of parts of one motion: each part adds to the compiled program of the whole."""

from typing import Any

import equinox as eqx

MOST = 100  # a sum of 33 delayed pulses: its program compiles in 40 s; twice as many parts take minutes


def check_nesting(motion: eqx.Module) -> None:
    """Raise ValueError for a motion made of too many parts, whose program would take minutes to compile.

    Every constructor of a motion calls this function, so that the count never recurses deeper than the limit.
    """
    count = _count(motion)
    if count > MOST:
        raise ValueError(
            f"A motion must be made of at most {MOST} motions, factors, shifts and sums, but this one is of {count}: "
            "make a `Record` of its samples, `rk.Record(sum(part.acceleration(times) for part in parts), dt)`."
        )


def _count(motion: Any) -> int:
    return 1 + sum(_count(part) for part in vars(motion).values() if isinstance(part, eqx.Module))
