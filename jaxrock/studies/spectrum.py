"""Rocking spectra as results: of one motion, of a suite, of a family of pulses; and percentiles over a suite."""

from typing import Annotated

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxrock._arguments.annotations import arguments, word_of
from jaxrock._arguments.ranges import Range
from jaxrock._arguments.tables import AbstractTable, Column
from jaxrock._core.arrays import Values, is_traced, shown, to_device
from jaxrock._core.renamed import renamed
from jaxrock.status import Status, is_decided

_RATIOS = ("rotation_ratio", "velocity_ratio")
_percentile = Range("be in [0, 100]", 0.0, 100.0, lambda x: (x >= 0) & (x <= 100))


class Spectrum(AbstractTable):
    """A rocking spectrum; every result has the shape (..., len(abscissa)), that of a suite (motions, len(abscissa)).

    - `abscissa`: 2 pi/p [s], or the frequency ratio omega/p [-] of a self-similar spectrum.
    - `rotation_ratio`: peak |rotation| over alpha [-]; infinite where the block overturned.
    - `velocity_ratio`: peak |angular velocity| over p alpha [-]; infinite where the block overturned.
    - `impact_count`, `overturned`, `margin`, `status`: as in `Outcome`.
    - `intensity`: peak acceleration over the uplift threshold [-], one per row (self-similar spectrum), or None.
    - `parameters`: further axes of a self-similar spectrum, in front of the rows, by the pulse's names.
    - `motions`: names of a suite's motions, one per row; None for a single motion.
    """

    abscissa: Float[Array, " n"]
    rotation_ratio: Float[Array, "*rows n"]
    velocity_ratio: Float[Array, "*rows n"]
    impact_count: Int[Array, "*rows n"]
    overturned: Bool[Array, "*rows n"]
    margin: Float[Array, "*rows n"]
    status: Status
    intensity: Float[Array, " rows"] | None = None
    parameters: dict[str, Float[Array, " _"]] = eqx.field(default_factory=dict)
    motions: tuple[str, ...] | None = eqx.field(static=True, default=None)

    max_rotation = renamed("max_rotation", "rotation_ratio")
    max_velocity = renamed("max_velocity", "velocity_ratio")

    @property
    def pulse_duration(self) -> Float[Array, " n"] | None:
        """p times the duration (or period) of the pulse [-], 2 pi/abscissa; None of a rocking spectrum."""
        return None if self.intensity is None else 2 * jnp.pi / self.abscissa

    @property
    def uplift_strength(self) -> Float[Array, " rows"] | None:
        """Uplift threshold over the peak acceleration [-], 1/intensity; None of a rocking spectrum."""
        return None if self.intensity is None else 1 / self.intensity

    @arguments
    def percentiles(
        self,
        percentile: Values = (16.0, 50.0, 84.0),
        result: Annotated[str, word_of(*_RATIOS)] = "rotation_ratio",
    ) -> tuple[Float[Array, "percentiles n"], Float[Array, "percentiles n"]]:
        """Return bounds of percentiles over the motions of a suite, size by size.

        A block that overturned counts as infinite. A scene without a verdict (`is_open`) counts as 0 in the lower
        bound, and as infinite in the upper one; without such scenes the bounds are equal.

        A percentile interpolates linearly between the two nearest of the sorted values, at the place
        (motions - 1) percentile/100, counted from 0. That is the default of `numpy.percentile`, definition 7 of
        Hyndman & Fan (1996). It is infinite where the upper of the two is infinite and has a weight.

        **Arguments:**

        - `percentile`: a number or a list, in per cent, in [0, 100].
        - `result`: "rotation_ratio" or "velocity_ratio".

        **Returns:** lower and upper bounds [-], each (percentiles, n).

        **Raises:** ValueError for percentiles out of range or NaN, and for a spectrum that is not of a suite.
        """
        if self.motions is None:
            raise ValueError("Percentiles are over the motions of a suite, but this is no spectrum of a suite.")
        wanted = np.atleast_1d(np.asarray(_percentile("percentile", percentile), float))
        if wanted.ndim != 1 or wanted.size == 0:
            raise ValueError(f"Argument `percentile` must be a number or a list, but is {shown(percentile)}.")
        library = jnp if is_traced(self) else np
        values, is_open = library.asarray(getattr(self, result)), library.asarray(self.is_open)
        bounds = [
            _percentiles(library, library.where(is_open, library.asarray(each, values.dtype), values), wanted)
            for each in (0.0, np.inf)
        ]
        lower, upper = bounds if is_traced(self) else map(to_device, bounds)
        return lower, upper

    @property
    def is_open(self) -> Bool[Array, "*rows n"]:
        """Mask of scenes without a verdict: their status is neither successful nor chaotic."""
        return jnp.broadcast_to(~is_decided(self.status), self.overturned.shape)

    @property
    def _columns(self):
        across = "abscissa" if self.intensity is None else "frequency_ratio"
        rows = "intensity" if self.motions is None else "motion"
        axes = (*self.parameters, *(() if self.intensity is None and self.motions is None else (rows,)), across)
        results = (*_RATIOS, "impact_count", "overturned", "margin", "status")
        return {
            **{name: Column((name,), values) for name, values in self.parameters.items()},
            "intensity": Column(("intensity",), self.intensity),
            "motion": Column(("motion",), None if self.motions is None else np.array(self.motions)),
            across: Column((across,), self.abscissa, "s" if self.intensity is None else "-"),
            **{name: Column(axes, getattr(self, name)) for name in results},
        }


def _percentiles(library, values, wanted: np.ndarray):
    """Return percentiles along the last axis but one: (..., percentiles, n); values may be infinite, but not NaN."""
    ordered, last = library.sort(values, axis=-2), values.shape[-2] - 1
    place = last * wanted / 100
    nearest = np.round(place)
    # Rounding of the place must not give a weight to an infinite value.
    place = np.where(np.abs(place - nearest) <= 1e-12 * max(last, 1), nearest, place)
    below = place.astype(int)
    weight = library.asarray((place - below)[:, None], values.dtype)
    low, high = ordered[..., below, :], ordered[..., np.minimum(below + 1, last), :]
    is_finite = library.isfinite(high)
    step = library.where(is_finite, high, 0.0) - library.where(is_finite, low, 0.0)
    return library.where(weight > 0, library.where(is_finite, low + weight * step, high), low)
