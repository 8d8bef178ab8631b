"""Seismic hazard curves: annual rates of shakings of a site that exceed levels of intensity.

Shakings follow a Poisson process.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Inexact

from jaxrock._arguments.annotations import arguments
from jaxrock._arguments.ranges import checked, if_known, level as at_level, positive, scalar, share
from jaxrock._arguments.repr import described
from jaxrock._core.arrays import Values, as_real, is_traced
from jaxrock._core.settings import called_by_users
from jaxrock._core.types import Real, Scalar
from jaxrock.hazard.fragility import alike, beside, rising, the_one_before
from jaxrock.numerics.gauss_legendre import gauss_legendre

_ORDER = 20  # nodes of the quadrature between levels


class HazardCurve(eqx.Module):
    """Annual rates of shakings that exceed levels of intensity.

    Between levels the rate is a power law (a straight line in log-log). Beyond the levels with known rates the curve is
    not extrapolated. Shakings weaker than the first level do not count, and all that exceed the last count as if they
    just reached it. `extended` continues the power laws instead.

    **Arguments:**

    - `levels`: (n,) intensities, in the unit of the fragilities (peak acceleration: g), positive and rising; n at
      least 2.
    - `rates`: (n,) exceedances a year, 0 or more, never rising. Infinite first rates are unknown (the probability was 1
      to rounding), and so are zero last rates (it was 0 to rounding).
    - `measure`: the intensity measure, such as "PGA"; a label. Fragilities over another measure are refused.

    Both may have more axes in front, for use under `jax.vmap`.

    **Raises:** ValueError for values outside their ranges, or of different shapes.
    """

    __repr__ = described

    levels: Inexact[Array, "*batch n"]
    rates: Inexact[Array, "*batch n"]
    measure: str = eqx.field(static=True)

    @arguments
    def __init__(self, levels: Values, rates: Values, measure: str = ""):
        self.levels, rates = alike(rising("levels", levels), as_real("rates", rates))
        rates = beside("rates", rates, self.levels)

        allowed = "be 0 or more, never rise, and be infinite only before a positive finite one"
        self.rates = checked("rates", rates, allowed, _can_be_rates)
        self.measure = measure

    @classmethod
    @arguments
    def from_probabilities(
        cls, levels: Values, probabilities: Values, investigation_time: ArrayLike, measure: str = ""
    ) -> "HazardCurve":
        """Build a hazard curve from probabilities of exceedance.

        **Arguments:**

        - `levels`, `measure`: as in `HazardCurve`.
        - `probabilities`: (n,) of one exceedance or more in the investigation time, in [0, 1], never rising.
        - `investigation_time`: [years], positive.

        **Returns:** a `HazardCurve` with the rates -ln(1 - probability)/time of a Poisson process.

        **Raises:** ValueError for values outside their ranges, or of different shapes.
        """
        probabilities = share("probabilities", probabilities)
        time = scalar("investigation_time", positive("investigation_time", investigation_time))
        if is_traced((probabilities, time)):
            return cls(levels, -jnp.log1p(-probabilities) / time, measure)
        with np.errstate(divide="ignore"):  # a probability of 1 gives an infinite rate, which counts as unknown
            return cls(levels, -np.log1p(-np.asarray(probabilities)) / np.asarray(time), measure)

    @called_by_users
    def rate(self, level: Values) -> Real:
        """Return the known annual rate of shakings of intensity `level` or more, in the shape of `level`."""
        check_one(self)
        return self._rate(if_known(at_level, "level", level))

    @eqx.filter_jit
    def _rate(self, level: Real) -> Real:
        level = jnp.maximum(level, self.levels[0])
        after = jnp.clip(jnp.searchsorted(self.levels, level), 1, self.levels.size - 1)
        finite = jnp.isfinite(self.rates)
        start = jnp.where(finite, self.rates, jnp.max(jnp.where(finite, self.rates, 0.0)))[after - 1]
        _, exponents = power_laws(self)
        within = start * (level / self.levels[after - 1]) ** -exponents[after - 1]
        beyond = (level > self.levels[-1]) | (level > self.levels[0]) & (self.rates[after] == 0)
        return jnp.where(beyond, 0.0, within)

    @called_by_users
    def scaled(self, factor: ArrayLike) -> "HazardCurve":
        """Return the curve of a site where every shaking is `factor` times as intense (positive), with equal rates."""
        return scaled_curve(self, scalar("factor", positive("factor", factor)))

    @called_by_users
    def extended(self, lowest: ArrayLike, highest: ArrayLike) -> "HazardCurve":
        """Return the curve with the power laws of its first and last known interval continued.

        A hazard curve bends down in log-log. Where it does, the power laws are above it at both ends. The toppling
        rates under the curve and under the extended one then lie below and above the true one. This holds for a
        fragility that grows, and is 0 and 1 beyond `lowest` and `highest`.

        **Arguments:**

        - `lowest`: level to begin at, positive, below the first level.
        - `highest`: level to end at, above the last level.

        **Returns:** a `HazardCurve` with two more levels, and with known rates at all levels.

        **Raises:** ValueError for a level that is not beyond the curve, or if fewer than two rates are known.
        """
        check_one(self)
        known = not is_traced((self, lowest, highest))
        arrays, given = (np, np.asarray) if known else (jnp, jnp.asarray)  # NumPy compiles nothing
        own = given(self.levels)
        start, end = own[0], own[-1]
        lowest = checked("lowest", lowest, "be positive and below the first level", lambda x: (x > 0) & (x < start))
        highest = checked("highest", highest, "be finite and above the last level", lambda x: (x > end) & (x < np.inf))
        low, high = (given(scalar(name, x))[None] for name, x in (("lowest", lowest), ("highest", highest)))
        levels = arrays.concatenate([low, own, high])
        with np.errstate(over="ignore"):  # `_continued` checks for overflow
            return HazardCurve(levels, self._continued(levels, arrays, given), self.measure)

    def _continued(self, levels, arrays, given):
        """Return the rates at levels, the first and the last of which are beyond the curve."""
        own = given(self.levels)
        known = arrays.isfinite(given(self.rates)) & (given(self.rates) > 0)
        rates = given(checked("rates", self.rates, "be known at two levels or more", lambda _: known.sum() >= 2))
        first, last = arrays.argmax(known), known.size - 1 - arrays.argmax(known[::-1])

        def law(a, b, here):
            exponent = arrays.log(rates[a] / rates[b]) / arrays.log(own[b] / own[a])
            # Elsewhere the power law may overflow, and its value is not used.
            found = rates[a] * (arrays.where(here, levels, own[a]) / own[a]) ** -exponent
            said = "be levels up to which the power laws stay below the largest number"
            return given(checked("lowest` and `highest", found, said, lambda rate: rate < np.inf))

        before, after = levels < own[first], levels > own[last]
        inner = arrays.where(after, law(last - 1, last, after), arrays.pad(rates, 1))
        return arrays.where(before, law(first, first + 1, before), inner)


def _can_be_rates(x):
    known = ((x > 0) & (x < np.inf)).any(-1, keepdims=True)
    return (x >= 0) & ~(x > the_one_before(x, np.inf)) & (known | (x < np.inf))


def check_one(curve: HazardCurve) -> None:
    if curve.levels.ndim != 1:
        raise ValueError(f"Argument `curve` must be one, but has levels of shape {curve.levels.shape}. Use jax.vmap.")


def scaled_curve(curve: HazardCurve, factor: Scalar) -> HazardCurve:
    return eqx.tree_at(lambda c: c.levels, curve, curve.levels * factor)


def power_laws(curve: HazardCurve) -> tuple[Array, Array]:
    """Return for each interval between levels whether both rates are known, and the exponent of its law (else 0)."""
    start, end = curve.rates[:-1], curve.rates[1:]
    known = jnp.isfinite(start) & (end > 0)
    fall = jnp.log(jnp.where(known, start, 1.0) / jnp.where(known, end, 1.0))
    return known, fall / jnp.diff(jnp.log(curve.levels))


def shakings(curve: HazardCurve, knots: Inexact[Array, " knots"]) -> tuple[Array, Array]:
    """Return quadrature levels and annual rates, at which shakings represent all shakings of the curve.

    The integral of a function over the curve is the sum of its values at these levels times their rates. The function
    must be close to a low polynomial between levels and knots.
    """
    known, exponents = power_laws(curve)
    points, weights = gauss_legendre(_ORDER)
    logarithms = jnp.log(curve.levels)
    breaks, low, high = jnp.log(knots), logarithms[0], logarithms[-1]
    breaks = jnp.where(breaks <= low, low, jnp.where(breaks >= high, high, breaks))
    # A stable sort puts levels before equal knots; the empty piece between them still has derivatives.
    breaks = jnp.concatenate([logarithms, breaks])
    order = jnp.argsort(breaks, stable=True)
    breaks, passed = breaks[order], jnp.cumsum(order < logarithms.size)[:-1]
    middle, half = (breaks[1:] + breaks[:-1]) / 2, (breaks[1:] - breaks[:-1]) / 2
    interval = jnp.clip(passed - 1, 0, known.size - 1)
    start, exponent = jnp.where(known, curve.rates[:-1], 0.0)[interval], exponents[interval]
    nodes = middle[:, None] + half[:, None] * points
    density = (start * exponent)[:, None] * jnp.exp(-exponent[:, None] * (nodes - logarithms[interval][:, None]))
    # Shakings that exceed the last known level count at that level.
    last = jnp.isfinite(curve.rates) & (curve.rates > 0) & (jnp.append(curve.rates[1:], 0.0) == 0)
    return (
        jnp.concatenate([jnp.exp(nodes).ravel(), curve.levels]),
        jnp.concatenate([(half[:, None] * weights * density).ravel(), jnp.where(last, curve.rates, 0.0)]),
    )
