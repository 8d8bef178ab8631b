"""Harmonic ground motion: a sinusoid of many cycles."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from jaxrock._arguments.parameters import parameter, set_parameters
from jaxrock._arguments.ranges import Range, size, strength, with_throw
from jaxrock._core.types import Real, Scalar
from jaxrock.compiler.hints import stop_gradient
from jaxrock.motions.motion import AbstractMotion
from jaxrock.motions.pulses.pulse import AbstractPulse, Piece, one_piece
from jaxrock.motions.pulses.sinusoidal import sinusoid

_cycles = Range("be above 0 and at most 1e6", 0.0, np.inf, lambda x: (x > 0) & (x <= 1e6))
_phase = Range("be finite, and at most 1000 in size", -np.inf, np.inf, lambda x: (x >= -1e3) & (x <= 1e3))


class HarmonicMotion(AbstractPulse):
    """Harmonic shaking: u = amplitude sin(2 pi t/period + phase) for `cycles` periods, then rest.

    **Arguments:**

    - `amplitude`: [g]; positive drives negative rotation.
    - `period`: [s], positive.
    - `cycles`: number of cycles, above 0 and at most 1e6; also a part of a cycle.
    - `phase`: [rad]; pi/2 starts with a jump to `amplitude`.

    The motion is differentiable by all four. It is one smooth piece: cycles cost only the steps that a block takes
    under them.

    **Raises:** ValueError for a value outside its range.

    **Source:** Spanos & Koh (1984), harmonic shaking of a rigid block.
    """

    amplitude: Real = parameter("g", strength, symbol="a_g")
    period: Real = parameter("s", size, symbol="T")
    cycles: Real = parameter("-", _cycles, symbol="n")
    phase: Real = parameter("rad", _phase, symbol="phi")

    @with_throw
    def __init__(
        self,
        amplitude: ArrayLike,
        period: ArrayLike,
        cycles: ArrayLike,
        phase: ArrayLike = 0.0,
        *,
        throw: bool = True,
    ):
        set_parameters(self, amplitude=amplitude, period=period)
        set_parameters(self, cycles=cycles, phase=phase)

    @property
    def knots(self) -> Real:
        return one_piece(self.cycles * self.period)

    @property
    def scales(self) -> Real:
        return (self.period / (2 * math.pi))[None]

    @property
    def bounds(self) -> Real:
        return jnp.abs(self.amplitude)[None]

    def series(self, piece: Piece, local: Real, unit: Real, order: int) -> list[Real]:
        rate = 2 * math.pi / self.period
        return sinusoid(self.amplitude, rate, rate * local + self.phase, unit, order, local)


def cycles_in(motion: AbstractMotion) -> Scalar | None:
    """Return the number of cycles of all harmonic parts of a motion, without derivatives; None without such parts."""

    def is_harmonic(part):
        return isinstance(part, HarmonicMotion)

    found = filter(is_harmonic, jax.tree.leaves(motion, is_leaf=is_harmonic))
    counts = [stop_gradient(part.cycles) for part in found]
    return sum(counts[1:], counts[0]) if counts else None
