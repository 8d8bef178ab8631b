"""Ricker wavelets: derivatives of a Gaussian."""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import ArrayLike

from jaxrock._arguments.parameters import parameter, set_parameters
from jaxrock._arguments.ranges import one_of, size, strength, with_throw
from jaxrock._core.types import Real
from jaxrock.compiler.hints import materialize
from jaxrock.motions.pulses.pulse import AbstractPulse, Piece, one_piece

# Peak of |y^3 - 3y| e^(-y^2/2), at y^2 = 3 - sqrt(6).
_ANTISYMMETRIC_PEAK = math.sqrt(3 - math.sqrt(6)) * math.sqrt(6) * math.exp(-(3 - math.sqrt(6)) / 2)


class RickerPulse(AbstractPulse):
    """A Ricker wavelet, the second or third derivative of a Gaussian.

    symmetric: u = amplitude (1 - 2 y^2) e^(-y^2), y = pi (t - center)/period;
    antisymmetric: u proportional to (y^3 - 3 y) e^(-y^2/2), y = 2 pi (t - center)/(sqrt(3) period),
    scaled to a peak of `amplitude`.

    **Arguments:**

    - `amplitude`: peak acceleration [g].
    - `period`: period of the spectral peak [s], positive.
    - `kind`: "symmetric" or "antisymmetric".
    - `center`: time of the wavelet's centre [s], positive. None: late enough that what is cut off at
      time 0 is below 1e-12 of the peak. The motion ends at 2 center.

    **Raises:** ValueError for a value outside its range.

    **Source:** Ricker (1943); Diamantopoulos & Fragiadakis (2017), section 4 (symmetric);
    Vassiliou & Makris (2011) (antisymmetric).
    """

    amplitude: Real = parameter("g", strength, symbol="a_g")
    period: Real = parameter("s", size, symbol="T")
    center: Real = parameter("s", size)
    kind: str = eqx.field(static=True)

    @with_throw
    def __init__(
        self,
        amplitude: ArrayLike,
        period: ArrayLike,
        kind: str = "symmetric",
        center: ArrayLike | None = None,
        *,
        throw: bool = True,
    ):
        set_parameters(self, amplitude=amplitude, period=period)
        self.kind = one_of("kind", kind, ("symmetric", "antisymmetric"))
        default = 5.7 / math.pi if kind == "symmetric" else 8.2 * math.sqrt(3) / (2 * math.pi)
        self.center = default * self.period if center is None else size("center", center)

    @property
    def knots(self) -> Real:
        return one_piece(2 * self.center)

    @property
    def scales(self) -> Real:
        return (self.period / (2 * math.pi))[None]

    @property
    def bounds(self) -> Real:
        return jnp.abs(self.amplitude)[None]

    def series(self, piece: Piece, local: Real, unit: Real, order: int) -> list[Real]:
        # With y = rate (t - center): Gaussian g' = -rate y g, then times a polynomial in y.
        symmetric = self.kind == "symmetric"
        rate = (math.sqrt(2) if symmetric else 2 / math.sqrt(3)) * math.pi / self.period
        y, step = rate * (local - self.center), rate * unit
        gauss = [jnp.exp(-(y**2) / 2)]
        gauss.append(-step * y * gauss[0])
        for k in range(1, order):
            gauss.append(materialize(-step * (y * gauss[k] + step * gauss[k - 1]) * (1 / (k + 1)), local))
        if symmetric:
            factor = [1 - y**2, -2 * y * step, -(step**2)]
        else:
            size = 1 / _ANTISYMMETRIC_PEAK
            factor = [
                size * (y**3 - 3 * y),
                size * (3 * y**2 - 3) * step,
                size * 3 * y * step**2,
                size * step**3,
            ]
        return [
            self.amplitude * sum(factor[j] * gauss[k - j] for j in range(min(k, len(factor) - 1) + 1))
            for k in range(order + 1)
        ]
