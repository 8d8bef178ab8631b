"""How many motions one motion is made of: each is a part of the program that follows the whole."""

from typing import Any

import equinox as eqx

MOST = 100  # of which a sum of 33 delayed pulses is made: its program compiles in 40 s, twice as many take minutes


def check_nesting(motion: eqx.Module) -> None:
    """Raise ValueError for a motion that is made of too many: their program would take minutes to compile.

    Called wherever a motion is made, so that it never has to look deeper than that.
    """
    count = _count(motion)
    if count > MOST:
        raise ValueError(
            f"A motion must be made of at most {MOST} motions, factors, shifts and sums, but this one is of {count}: "
            "make a `Record` of its samples, `rk.Record(sum(part.acceleration(times) for part in parts), dt)`."
        )


def _count(motion: Any) -> int:
    return 1 + sum(_count(part) for part in vars(motion).values() if isinstance(part, eqx.Module))
