"""Policy of the series engine, not mathematics: numbers that change times, but no result beyond its error."""

import math
from typing import NamedTuple

import jax.numpy as jnp


class Policy(NamedTuple):
    """Settings of the series engine.

    - `pulse_order`: order of Taylor steps under motions of few pieces.
    - `linear_order`: the same for linear equations, whose terms cost little.
    - `record_order`: order under many pieces; short pieces need few terms.
    - `many_pieces`: number of pieces above which a motion counts as a record.
    - `outcome_steps`: step budget of an outcome; `history_steps`: of a history, besides two for each piece.
    - `fast_steps`: steps after which a scene is left to the accurate pass, besides three for each piece.
    - `steps_per_cycle`: more of these for each cycle of a harmonic motion.
    - `shorter`: shares of a step that are tried for a certificate, after the whole.
    - `round`: steps after which scenes under a record form new chunks where XLA follows them.
    """

    pulse_order: int = 16
    linear_order: int = 20
    record_order: int = 9
    many_pieces: int = 32
    outcome_steps: int = 100_000
    history_steps: int = 4096
    fast_steps: int = 1000
    steps_per_cycle: int = 16
    shorter: tuple[float, ...] = (0.4, 0.1)
    round: int = 256

    def is_record(self, pieces: int) -> bool:
        """Return whether a motion of so many pieces counts as a record."""
        return pieces > self.many_pieces

    def order(self, pieces: int, tolerance: float, linear: bool) -> int:
        """Return the default order of the steps."""
        digits = -math.log10(tolerance)
        if self.is_record(pieces):  # its steps are as long as its pieces, whatever the tolerance
            return int(min(self.record_order, max(6, digits / 2 + 3)))
        if linear:
            return int(min(self.linear_order, max(10, digits + 5)))
        return int(min(self.pulse_order, max(8, digits + 3)))


POLICY = Policy()


def exact(dtype) -> float:
    """Return the tolerance at which only rounding errors remain."""
    return float(jnp.finfo(dtype).eps) / 2
