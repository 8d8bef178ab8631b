"""Seismic hazard curves, and what the survival of precariously balanced rocks says about them.

Shakings of a site come as a Poisson process; a hazard curve gives the annual rate of those that exceed each level of
intensity. A shaking topples a rock with the probability that its fragility gives. Rocks at one site share their
shakings: given the intensity they topple independently, but what spares one is likely to spare the others, so that
their joint survival is more probable than the product of the single ones.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import log_ndtr
from jaxtyping import Array, ArrayLike, Inexact, PyTree

from jaxrock._arguments import arguments, list_of
from jaxrock._checks import (
    Values,
    as_real,
    checked,
    if_known,
    inner_share,
    level as at_level,
    not_negative,
    positive,
    scalar,
    share,
)
from jaxrock._described import described
from jaxrock.hazard.fragility import AbstractFragility, LogNormalFragility, alike, beside, rising
from jaxrock.numerics.gauss_legendre import gauss_legendre
from jaxrock.numerics.roots import search_root

Real = Inexact[Array, "..."]
Number = Inexact[Array, ""]
_each = list_of(AbstractFragility, "fragilities")


def _one_or_many(name: str, value: Any) -> tuple[AbstractFragility, ...]:
    return (value,) if isinstance(value, AbstractFragility) else tuple(_each(name, value))


Fragilities = Annotated[AbstractFragility | Sequence[AbstractFragility], _one_or_many]
_NODES, _WEIGHTS = gauss_legendre(20)

# Where `allowed_scale` looks for its factor: 20 steps a decade.
_FACTORS = np.geomspace(1e-4, 1e4, 161)


class HazardCurve(eqx.Module):
    """Annual rates of shakings that exceed levels of intensity.

    Between levels the rate is a power law (a straight line in log-log). Beyond the levels whose rates are known nothing
    is made up: shakings weaker than the first do not count, and all that exceed the last count as if they just reached
    it. `extended` continues the power laws instead.

    **Arguments:**

    - `levels`: (n,) intensities, in the unit of the fragilities (peak acceleration: g), positive and rising; n at
      least 2.
    - `rates`: (n,) exceedances a year, 0 or more, never rising. Not known are the first ones if infinite (the
      probability was 1 to rounding), and the last ones if zero (it was 0 to rounding).
    - `measure`: what the levels are, such as "PGA"; a label.

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

        def holds(x):
            known = jnp.any((x > 0) & (x < jnp.inf), -1, keepdims=True)
            return (x >= 0) & ~(jnp.diff(x, prepend=jnp.inf) > 0) & (known | (x < jnp.inf))

        allowed = "be 0 or more, never rise, and be infinite only before a positive finite one"
        self.rates = checked("rates", rates, allowed, holds)
        self.measure = measure

    @classmethod
    @arguments
    def from_probabilities(
        cls, levels: Values, probabilities: Values, investigation_time: ArrayLike, measure: str = ""
    ) -> "HazardCurve":
        """Build a hazard curve from probabilities of exceedance.

        **Arguments:**

        - `levels`, `measure`: as in `HazardCurve`.
        - `probabilities`: (n,) of one exceedance or more in that time, in [0, 1], never rising.
        - `investigation_time`: [years], positive.

        **Returns:** a `HazardCurve` with the rates -ln(1 - probability)/time of a Poisson process.

        **Raises:** ValueError for values outside their ranges, or of different shapes.
        """
        probabilities = share("probabilities", probabilities)
        time = scalar("investigation_time", positive("investigation_time", investigation_time))
        return cls(levels, -jnp.log1p(-probabilities) / time, measure)

    def rate(self, level: Values) -> Real:
        """Annual rate of shakings of intensity `level` or more that the curve knows; of the shape of `level`."""
        _single(self)
        return self._rate(if_known(at_level, "level", level))

    @eqx.filter_jit
    def _rate(self, level: Real) -> Real:
        level = jnp.maximum(level, self.levels[0])
        after = jnp.clip(jnp.searchsorted(self.levels, level), 1, self.levels.size - 1)
        finite = jnp.isfinite(self.rates)
        start = jnp.where(finite, self.rates, jnp.max(jnp.where(finite, self.rates, 0.0)))[after - 1]
        _, exponents = _power_laws(self)
        within = start * (level / self.levels[after - 1]) ** -exponents[after - 1]
        beyond = (level > self.levels[-1]) | (level > self.levels[0]) & (self.rates[after] == 0)
        return jnp.where(beyond, 0.0, within)

    def scaled(self, factor: ArrayLike) -> "HazardCurve":
        """The curve of a site where every shaking is `factor` times as intense (positive); rates stay."""
        return _scaled(self, scalar("factor", positive("factor", factor)))

    def extended(self, lowest: ArrayLike, highest: ArrayLike) -> "HazardCurve":
        """The curve with the power laws of its first and last known interval continued.

        A hazard curve bends down in log-log. Where it does, the power laws are above it at both ends, so that the
        toppling rates under the curve and under the extended one lie below and above the true one (of a fragility that
        grows, and is 0 and 1 beyond `lowest` and `highest`).

        **Arguments:**

        - `lowest`: level to begin at, positive, below the first level.
        - `highest`: level to end at, above the last level.

        **Returns:** a `HazardCurve` with two levels more, all of whose rates are known.

        **Raises:** ValueError for a level that is not beyond the curve, or if fewer than two rates are known.
        """
        _single(self)
        start, end = self.levels[0], self.levels[-1]
        lowest = checked("lowest", lowest, "be positive and below the first level", lambda x: (x > 0) & (x < start))
        highest = checked("highest", highest, "be finite and above the last level", lambda x: (x > end) & (x < jnp.inf))
        levels = jnp.concatenate([scalar("lowest", lowest)[None], self.levels, scalar("highest", highest)[None]])
        known = jnp.isfinite(self.rates) & (self.rates > 0)
        rates = checked("rates", self.rates, "be known at two levels or more", lambda _: jnp.sum(known) >= 2)
        first, last = jnp.argmax(known), known.size - 1 - jnp.argmax(known[::-1])

        def law(a, b):
            exponent = jnp.log(rates[a] / rates[b]) / jnp.log(self.levels[b] / self.levels[a])
            found = rates[a] * (levels / self.levels[a]) ** -exponent
            said = "be levels up to which the power laws stay below the largest number"
            return checked("lowest` and `highest", found, said, lambda rate: rate < jnp.inf)

        inner = jnp.pad(rates, 1)
        inner = jnp.where(levels > self.levels[last], law(last - 1, last), inner)
        inner = jnp.where(levels < self.levels[first], law(first, first + 1), inner)
        return HazardCurve(levels, inner, self.measure)


@arguments
def toppling_rate(fragility: AbstractFragility, curve: HazardCurve) -> Number:
    """Annual rate of shakings that topple a rock: the fragility integrated over the rates of the hazard curve.

    **Arguments:**

    - `fragility`: of the rock, over the measure and in the unit of the curve.
    - `curve`: a `HazardCurve`; under `jax.vmap` for many.

    **Returns:** the rate [1/year]. A lognormal fragility is integrated in closed form over each power law, any other
    by Gauss-Legendre quadrature between levels and knots.

    **Raises:** ValueError for several curves or fragilities in one.

    **Source:** Cornell, Jalayer, Hamburger & Foutch (2002), the integral, and its closed form over one power law.
    """
    _single(curve)
    _rocks(fragility, 0.0)
    return _toppling_rate(fragility, curve)


@arguments
def survival_probability(fragilities: Fragilities, ages: Values, curve: HazardCurve) -> Number:
    """Probability that all rocks of a site have stood since they became fragile, under the shakings they share.

    At each time before present only the rocks that were fragile already count: the rate of shakings that topple at
    least one of them is the integral of 1 - (1 - F1)(1 - F2)... over the curve.

    **Arguments:**

    - `fragilities`: of a rock, or of each.
    - `ages`: for how long each rock has been fragile [years], (rocks,), or one number for all; 0 or more. Where ages
      are uncertain: the mean over samples, by `jax.vmap`.
    - `curve`: a `HazardCurve`; under `jax.vmap` for many.

    **Returns:** the probability.

    **Raises:** ValueError for ages outside their range, or not as many as rocks.
    """
    _single(curve)
    return jnp.exp(-_topplings(*_rocks(fragilities, ages), curve))


@arguments
def branch_weights(prior: Values, survival: Values) -> Inexact[Array, " branches"]:
    """Weights of the branches of a logic tree after rocks were found standing (Bayes).

    **Arguments:**

    - `prior`: (branches,) weights, 0 or more; they need not add to 1.
    - `survival`: (branches,) probability under each branch that the rocks have stood, in [0, 1].

    **Returns:** (branches,) weights that add to 1.

    **Raises:** ValueError for values outside their ranges or of different shapes, and if under every branch that has
    weight the rocks must have toppled: then none of the branches explains them.
    """
    prior = not_negative("prior", prior)
    survival = share("survival", survival)
    if prior.ndim != 1 or prior.shape != survival.shape:
        both = f"{prior.shape} and {survival.shape}"
        raise ValueError(f"Arguments `prior` and `survival` must be lists of one length, but have shapes {both}.")
    weights = prior * survival
    total = jnp.sum(weights)
    return weights / checked("survival", total, "be above 0 for a branch that has weight", lambda x: x > 0)


@arguments
def allowed_scale(fragilities: Fragilities, ages: Values, curve: HazardCurve, probability: ArrayLike = 0.05) -> Number:
    """The factor on the intensity of every shaking at which the survival of all rocks falls to a given probability.

    Larger factors are rejected with the confidence 1 - `probability`. The levels of the curve are scaled; its rates
    stay.

    **Arguments:**

    - `fragilities`, `ages`, `curve`: as in `survival_probability`.
    - `probability`: of survival, in (0, 1).

    **Returns:** the smallest such factor between 1e-4 and 1e4, with derivatives of every order; 0 if
    survival is less probable under the smallest one already, infinite if more probable under all. Survival is looked
    up at 20 factors a decade: where a fragility that rises and falls makes it dip for less than that, the dip may be
    missed. A large factor brings the weakest shakings into play: compare with that of `curve.extended`.

    **Raises:** ValueError for arguments outside their ranges.

    **Source:** Anderson & Brune (1999), the rule of rejection.
    """
    _single(curve)
    probability = scalar("probability", inner_share("probability", probability))
    return _allowed_scale(*_rocks(fragilities, ages), curve, -jnp.log(probability))


def _single(curve: HazardCurve) -> None:
    if curve.levels.ndim != 1:
        raise ValueError(f"Argument `curve` must be one, but has levels of shape {curve.levels.shape}. Use jax.vmap.")


def _rocks(fragilities: Fragilities, ages: Values) -> tuple[tuple[AbstractFragility, ...], Inexact[Array, " rocks"]]:
    """The rocks, all with fragilities of one kind stacked into one, and an age for each in the order of the stacks."""
    rocks = _one_or_many("fragilities", fragilities)
    ages = not_negative("ages", ages)
    if ages.shape not in ((), (len(rocks),)) or not rocks:
        raise ValueError(f"Argument `ages` must be one for each of {len(rocks)} rocks, but has shape {ages.shape}.")
    ages = jnp.broadcast_to(ages, len(rocks))
    kinds = {}
    for index, rock in enumerate(rocks):
        numbers, rest = eqx.partition(rock, eqx.is_array_like)
        kind = jax.tree.structure(rock), *map(jnp.shape, jax.tree.leaves(numbers)), *jax.tree.leaves(rest)
        kinds.setdefault(kind, []).append(index)
    for first, *_ in kinds.values():
        shape = jax.eval_shape(rocks[first], jax.ShapeDtypeStruct((), ages.dtype)).shape
        if shape:
            raise ValueError(f"Argument `fragilities` must each be of one rock, but one has shape {shape}.")
    # A hundred rocks of one kind are compiled as one.
    stacks = []
    for members in kinds.values():
        numbers, rest = eqx.partition([rocks[index] for index in members], eqx.is_array_like)
        stacks.append(eqx.combine(jax.tree.map(lambda *x: jnp.stack(x), *numbers), rest[0]))
    return tuple(stacks), ages[np.concatenate(list(kinds.values()))]


def _scaled(curve: HazardCurve, factor: Number) -> HazardCurve:
    return eqx.tree_at(lambda c: c.levels, curve, curve.levels * factor)


def _power_laws(curve: HazardCurve) -> tuple[Array, Array]:
    """Of every interval between levels: whether both rates are known, and the exponent of its power law (else 0)."""
    start, end = curve.rates[:-1], curve.rates[1:]
    known = jnp.isfinite(start) & (end > 0)
    fall = jnp.log(jnp.where(known, start, 1.0) / jnp.where(known, end, 1.0))
    return known, fall / jnp.diff(jnp.log(curve.levels))


def _shakings(curve: HazardCurve, knots: Inexact[Array, " knots"]) -> tuple[Array, Array]:
    """Levels, and annual rates of shakings of just these levels, that stand for all shakings of the curve.

    The integral of a function over the curve is the sum of its values at these levels times their rates, if between
    levels and knots it is as gentle as a polynomial.
    """
    known, exponents = _power_laws(curve)
    logarithms = jnp.log(curve.levels)
    breaks = jnp.clip(jnp.log(knots), logarithms[0], logarithms[-1])
    breaks = jnp.sort(jnp.concatenate([logarithms, breaks]))
    middle, half = (breaks[1:] + breaks[:-1]) / 2, (breaks[1:] - breaks[:-1]) / 2
    interval = jnp.clip(jnp.searchsorted(logarithms, middle, method="compare_all") - 1, 0, known.size - 1)
    start, exponent = jnp.where(known, curve.rates[:-1], 0.0)[interval], exponents[interval]
    nodes = middle[:, None] + half[:, None] * _NODES
    density = (start * exponent)[:, None] * jnp.exp(-exponent[:, None] * (nodes - logarithms[interval][:, None]))
    # What exceeds the last known level counts there.
    last = jnp.isfinite(curve.rates) & (curve.rates > 0) & (jnp.append(curve.rates[1:], 0.0) == 0)
    return (
        jnp.concatenate([jnp.exp(nodes).ravel(), curve.levels]),
        jnp.concatenate([(half[:, None] * _WEIGHTS * density).ravel(), jnp.where(last, curve.rates, 0.0)]),
    )


@eqx.filter_jit
def _toppling_rate(fragility: AbstractFragility, curve: HazardCurve) -> Number:
    if isinstance(fragility, LogNormalFragility):
        return _lognormal_rate(fragility, curve)
    levels, rates = _shakings(curve, fragility.knots)
    return rates @ fragility(levels)


def _lognormal_rate(fragility: LogNormalFragility, curve: HazardCurve) -> Number:
    """The rate by parts: that at the first known level, and the integral of the rate over the fragility.

    Over a power law with exponent k, and with z = ln(level/median)/dispersion, that is
    rate(start) exp(a^2/2 - z(start)^2/2) [Phi(b) - Phi(a)], where a and b are z + k dispersion at start and end.
    """
    known, exponents = _power_laws(curve)
    z = jnp.log(curve.levels / fragility.median) / fragility.dispersion
    start, end = z[:-1] + exponents * fragility.dispersion, z[1:] + exponents * fragility.dispersion
    # Both in the lower tail, where their difference keeps its digits.
    upper = start + end > 0
    low, high = jnp.where(upper, -end, start), jnp.where(upper, -start, end)
    logarithm = log_ndtr(high) + jnp.log(-jnp.expm1(log_ndtr(low) - log_ndtr(high)))
    rates = jnp.where(known, curve.rates[:-1], 0.0)
    within = rates @ jnp.exp((start - z[:-1]) * (start + z[:-1]) / 2 + logarithm)
    first = jnp.isfinite(curve.rates) & ~jnp.append(False, jnp.isfinite(curve.rates[:-1]))
    return within + jnp.where(first, curve.rates, 0.0) @ fragility(curve.levels)


@eqx.filter_jit
def _topplings(rocks: tuple[AbstractFragility, ...], ages: Inexact[Array, " rocks"], curve: HazardCurve) -> Number:
    """Expected number of shakings that topple at least one of the rocks that are fragile by then."""
    knots = [eqx.filter_vmap(lambda rock: rock.knots)(rock).ravel() for rock in rocks]
    levels, rates = _shakings(curve, jnp.concatenate(knots))
    # With the oldest rock first, the first k rocks count from the age of rock k to that of the next.
    order = jnp.argsort(-ages)
    ages = ages[order]
    single = jnp.concatenate([eqx.filter_vmap(lambda rock: rock(levels))(rock) for rock in rocks])[order]
    # 1 - (1 - F)(1 - G), in which small probabilities do not cancel.
    joint = jax.lax.associative_scan(lambda f, g: f + g * (1 - f), single)
    return (ages - jnp.append(ages[1:], 0.0)) @ (joint @ rates)


@eqx.filter_jit
def _allowed_scale(rocks, ages, curve, most: Number) -> Number:
    """As `allowed_scale`, at which `most` topplings are expected."""
    numbers, rest = eqx.partition((rocks, ages, curve, most), eqx.is_array)

    def excess(logarithm, numbers):
        rocks, ages, curve, most = eqx.combine(numbers, rest)
        return _topplings(rocks, ages, _scaled(curve, jnp.exp(logarithm))) - most

    return _first_factor(excess, numbers)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _first_factor(excess: Callable, numbers: PyTree) -> Number:
    """The first factor at which `excess(ln factor, numbers)` is not negative."""
    grid = jnp.log(jnp.asarray(_FACTORS, jnp.result_type(float)))
    reached = jax.lax.map(lambda logarithm: excess(logarithm, numbers), grid) >= 0
    at = jnp.argmax(reached)
    logarithm = search_root(lambda x: excess(x, numbers), grid[jnp.maximum(at - 1, 0)], grid[at])
    factor = jnp.where(jnp.any(reached), jnp.exp(logarithm), jnp.inf)
    return jnp.where(reached[0], 0.0, factor)


@_first_factor.defjvp
def _first_factor_jvp(excess, primals, tangents):
    (numbers,), (changes,) = primals, tangents
    factor = _first_factor(excess, numbers)
    exists = (factor > 0) & (factor < jnp.inf)
    logarithm = jnp.log(jnp.where(exists, factor, 1.0))
    _, slope = jax.jvp(lambda x: excess(x, numbers), (logarithm,), (jnp.ones_like(logarithm),))
    _, change = jax.jvp(lambda n: excess(logarithm, n), (numbers,), (changes,))
    return factor, change * jnp.where(exists, -jnp.exp(logarithm) / jnp.where(exists, slope, 1.0), 0.0)
