"""The near-fault pulse of Mavroeidis and Papageorgiou."""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from jaxrock._arguments.parameters import parameter, set_parameters
from jaxrock._arguments.ranges import Range, size, strength, with_throw
from jaxrock._core.types import Real
from jaxrock.motions.pulses.pulse import AbstractPulse, Piece, one_piece
from jaxrock.motions.pulses.sinusoidal import sinusoid

_above_one = Range("be above 1 and finite, and at most 1e6", 1.0, np.inf, lambda x: (x > 1) & (x <= 1e6))
_phase = Range("be finite, and at most 1000 in size", -np.inf, np.inf, lambda x: (x >= -1e3) & (x <= 1e3))


class MavroeidisPapageorgiouPulse(AbstractPulse):
    """The near-fault pulse of Mavroeidis & Papageorgiou: a cosine velocity under a cosine bell.

    velocity = V/2 [1 + cos(2 pi x/(oscillations period))] cos(2 pi x/period + phase), x = t - center,
    |x| <= oscillations period/2; `amplitude` g = 2 pi V/period.

    **Arguments:**

    - `amplitude`: acceleration amplitude 2 pi V/(g period) [g], V the peak of the velocity's envelope.
    - `period`: [s], positive.
    - `oscillations`: number of cycles under the bell (gamma of the source), above 1.
    - `phase`: phase of the cosine [rad] (nu of the source).

    **Raises:** ValueError for a value outside its range.

    **Source:** Mavroeidis & Papageorgiou (2003), equation 3 (velocity); its derivative is used.
    """

    amplitude: Real = parameter("g", strength, symbol="a_g")
    period: Real = parameter("s", size, symbol="T")
    oscillations: Real = parameter("-", _above_one, symbol="gamma")
    phase: Real = parameter("rad", _phase, symbol="nu")

    @with_throw
    def __init__(
        self,
        amplitude: ArrayLike,
        period: ArrayLike,
        oscillations: ArrayLike = 2.0,
        phase: ArrayLike = 0.0,
        *,
        throw: bool = True,
    ):
        set_parameters(self, amplitude=amplitude, period=period)
        set_parameters(self, oscillations=oscillations, phase=phase)

    @property
    def knots(self) -> Real:
        return one_piece(self.oscillations * self.period)

    @property
    def scales(self) -> Real:
        return (self.period / (2 * math.pi) / (1 + 1 / self.oscillations))[None]

    @property
    def bounds(self) -> Real:
        return jnp.abs(self.amplitude)[None] * (1 + 0.5 / self.oscillations)

    def series(self, piece: Piece, local: Real, unit: Real, order: int) -> list[Real]:
        # The product of cosines is a sum of three: one at the period, two at the side frequencies.
        time = local - self.oscillations * self.period / 2
        total: list[Any] = [0.0] * (order + 1)
        for weight, ratio in ((0.5, 1.0), (0.25, 1 + 1 / self.oscillations), (0.25, 1 - 1 / self.oscillations)):
            rate = ratio * 2 * math.pi / self.period
            angle = rate * time + self.phase
            size = self.amplitude * weight * ratio
            terms = sinusoid(-size, rate, angle, unit, order, local)
            total = [a + b for a, b in zip(total, terms)]
        return total
