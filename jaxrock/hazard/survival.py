"""Rates at which shakings of a hazard curve topple rocks, and tests of the curve by rocks that have survived.

The fragility of a rock gives the probability that a shaking topples it. Rocks at one site share their shakings. Given
the intensity they topple independently, but a shaking that spares one is likely to spare the others. Their joint
survival is therefore more probable than the product of the single ones.
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

from jaxrock._arguments.annotations import arguments, list_of
from jaxrock._arguments.ranges import checked, inner_share, not_negative, scalar, share
from jaxrock._core.arrays import Values, to_device
from jaxrock._core.types import Scalar
from jaxrock.compiler.hints import jit_low_effort
from jaxrock.hazard.curves import HazardCurve, check_one, power_laws, scaled_curve, shakings
from jaxrock.hazard.fragility import AbstractFragility, LogNormalFragility, check_measure
from jaxrock.numerics.roots import search_root

_each = list_of(AbstractFragility, "fragilities")


def _one_or_many(name: str, value: Any) -> tuple[AbstractFragility, ...]:
    return (value,) if isinstance(value, AbstractFragility) else tuple(_each(name, value))


Fragilities = Annotated[AbstractFragility | Sequence[AbstractFragility], _one_or_many]

_Stack = tuple[AbstractFragility, int]  # with the number of rocks, because a fragility may have no arrays

# Factors at which `allowed_scale` evaluates survival: 20 steps a decade.
_FACTORS = np.geomspace(1e-4, 1e4, 161)


def _check(fragilities: Fragilities, curve: HazardCurve) -> None:
    check_one(curve)
    for each in _one_or_many("fragilities", fragilities):
        check_measure("curve", curve.measure, each)


@arguments
def toppling_rate(fragility: AbstractFragility, curve: HazardCurve) -> Scalar:
    """Return the annual rate of shakings that topple a rock: the fragility integrated over the hazard curve's rates.

    **Arguments:**

    - `fragility`: of the rock, over the measure and in the unit of the curve.
    - `curve`: a `HazardCurve`; under `jax.vmap` for many.

    **Returns:** the rate [1/year]. A lognormal fragility is integrated in closed form over each power law, any other
    by Gauss-Legendre quadrature between levels and knots.

    **Raises:** ValueError for several curves or fragilities in one, and for those of different measures.

    **Source:** Cornell, Jalayer, Hamburger & Foutch (2002), the integral, and its closed form over one power law.
    """
    _check(fragility, curve)
    _rocks(fragility, 0.0)
    return _toppling_rate(fragility, curve)


@arguments
def survival_probability(fragilities: Fragilities, ages: Values, curve: HazardCurve) -> Scalar:
    """Return the probability that all rocks of a site have stood since they became fragile, under shared shakings.

    At each time before present only rocks that were already fragile count. The rate of shakings that topple at least
    one of them is the integral of 1 - (1 - F1)(1 - F2)... over the curve.

    **Arguments:**

    - `fragilities`: that of one rock, or a list of one for each rock.
    - `ages`: time for which each rock has been fragile [years], (rocks,), or one number for all; 0 or more. For
      uncertain ages, take the mean over samples, by `jax.vmap`.
    - `curve`: a `HazardCurve`; under `jax.vmap` for many.

    **Returns:** the probability.

    **Raises:** ValueError for ages outside their range, or not as many as rocks, and for another measure's curve.
    """
    _check(fragilities, curve)
    return jnp.exp(-_topplings(*_rocks(fragilities, ages), curve))


@arguments
def branch_weights(prior: Values, survival: Values) -> Inexact[Array, " branches"]:
    """Return the weights of the branches of a logic tree after rocks were found standing (Bayes).

    **Arguments:**

    - `prior`: (branches,) weights, 0 or more; they need not add to 1.
    - `survival`: (branches,) probability under each branch that the rocks have stood, in [0, 1].

    **Returns:** (branches,) weights that add to 1.

    **Raises:** ValueError for values outside their ranges or of different shapes, and if the survival is 0 under every
    branch that has weight: then none of the branches explains the rocks.
    """
    prior = not_negative("prior", prior)
    survival = share("survival", survival)
    if prior.ndim != 1 or prior.shape != survival.shape:
        both = f"{prior.shape} and {survival.shape}"
        raise ValueError(f"Arguments `prior` and `survival` must be lists of one length, but have shapes {both}.")
    if prior.size == 0:
        raise ValueError("Arguments `prior` and `survival` must hold at least one branch, but are empty.")
    weights = prior * survival
    total = jnp.sum(weights)
    return weights / checked("survival", total, "be above 0 for a branch that has weight", lambda x: x > 0)


@arguments
def allowed_scale(fragilities: Fragilities, ages: Values, curve: HazardCurve, probability: ArrayLike = 0.05) -> Scalar:
    """Return the factor on the intensity of all shakings at which the survival of all rocks has a given probability.

    Larger factors are rejected with the confidence 1 - `probability`. The factor scales the levels of the curve, and
    not its rates.

    **Arguments:**

    - `fragilities`, `ages`, `curve`: as in `survival_probability`.
    - `probability`: of survival, in (0, 1).

    **Returns:** the smallest such factor between 1e-4 and 1e4, with derivatives of every order. It is 0 if survival is
    less probable already under the smallest factor, and infinite if it is more probable under all.

    Survival is evaluated at 20 factors a decade. A fragility that rises and falls may make survival dip within a
    shorter range, and the search may miss that dip. With a large factor the weakest shakings matter: compare the result
    with that of `curve.extended`.

    **Raises:** ValueError for arguments outside their ranges, and for another measure's curve.

    **Source:** Anderson & Brune (1999), the rule of rejection.
    """
    _check(fragilities, curve)
    probability = scalar("probability", inner_share("probability", probability))
    return _allowed_scale(*_rocks(fragilities, ages), curve, -jnp.log(probability))


def _rocks(fragilities: Fragilities, ages: Values) -> tuple[tuple[_Stack, ...], Inexact[Array, " rocks"]]:
    """Stack the fragilities of equal kinds; return the stacks, and the ages of all rocks in their order."""
    rocks = _one_or_many("fragilities", fragilities)
    ages = not_negative("ages", ages)
    if ages.shape not in ((), (len(rocks),)) or not rocks:
        raise ValueError(f"Argument `ages` must be one for each of {len(rocks)} rocks, but has shape {ages.shape}.")
    arrays = jnp if isinstance(ages, jax.core.Tracer) else np
    ages = arrays.broadcast_to(ages, len(rocks))
    kinds = {}
    for index, rock in enumerate(rocks):
        numbers, rest = eqx.partition(rock, eqx.is_array_like)
        kind = jax.tree.structure(rock), *map(jnp.shape, jax.tree.leaves(numbers)), *jax.tree.leaves(rest)
        kinds.setdefault(kind, []).append(index)
    for first, *_ in kinds.values():
        shape = jax.eval_shape(rocks[first], jax.ShapeDtypeStruct((), ages.dtype)).shape
        if shape:
            raise ValueError(f"Argument `fragilities` must each be of one rock, but one has shape {shape}.")
    # Rocks of one kind are vmapped, so that a hundred of them compile as one.
    stacks = []
    for members in kinds.values():
        numbers, rest = eqx.partition([rocks[index] for index in members], eqx.is_array_like)
        stacks.append((eqx.combine(jax.tree.map(_stacked, *numbers), rest[0]), len(members)))
    order = np.concatenate(list(kinds.values()))
    return tuple(stacks), ages[order] if isinstance(ages, jax.core.Tracer) else to_device(ages[order])


def _stacked(*numbers: Any) -> Array:
    """Stack numbers; concrete ones by NumPy, because JAX would compile a program for every number of rocks."""
    if any(isinstance(number, jax.core.Tracer) for number in numbers):
        return jnp.stack(numbers)
    return to_device(np.stack([np.asarray(number) for number in numbers]))


@jit_low_effort(eqx.filter_jit)
def _toppling_rate(fragility: AbstractFragility, curve: HazardCurve) -> Scalar:
    if type(fragility) is LogNormalFragility:  # a subclass may have other probabilities
        return _lognormal_rate(fragility, curve)
    levels, rates = shakings(curve, fragility.knots)
    return rates @ fragility(levels)


def _lognormal_rate(fragility: LogNormalFragility, curve: HazardCurve) -> Scalar:
    """Return the toppling rate in closed form, integrated by parts.

    It is the rate at the first known level times the fragility there, plus the integral of the rate over the fragility.
    Over a power law with exponent k, and with z = ln(level/median)/dispersion, that integral is
    rate(start) exp(a^2/2 - z(start)^2/2) [Phi(b) - Phi(a)], where a and b are z + k dispersion at start and end.
    """
    known, exponents = power_laws(curve)
    logarithms = jnp.log(curve.levels / fragility.median)
    z = logarithms / fragility.dispersion
    start, end = z[:-1] + exponents * fragility.dispersion, z[1:] + exponents * fragility.dispersion
    # Evaluate both in the lower tail, where their difference keeps its digits.
    upper = start + end > 0
    low, high = jnp.where(upper, -end, start), jnp.where(upper, -start, end)
    logarithm = log_ndtr(high) + jnp.log(-jnp.expm1(log_ndtr(low) - log_ndtr(high)))
    rates = jnp.where(known, curve.rates[:-1], 0.0)
    # (a^2 - z^2)/2 written out: a - z would lose the digits of a small dispersion.
    grown = exponents * (logarithms[:-1] + exponents * fragility.dispersion**2 / 2)
    within = rates @ jnp.exp(grown + logarithm)
    first = jnp.isfinite(curve.rates) & ~jnp.append(False, jnp.isfinite(curve.rates[:-1]))
    return within + jnp.where(first, curve.rates, 0.0) @ fragility(curve.levels)


@jit_low_effort(eqx.filter_jit)
def _topplings(rocks: tuple[_Stack, ...], ages: Inexact[Array, " rocks"], curve: HazardCurve) -> Scalar:
    """Return the expected number of shakings that topple at least one of the rocks that are fragile at that time."""

    def of_each(function):
        return [eqx.filter_vmap(function, axis_size=count)(rock) for rock, count in rocks]

    knots = [each.ravel() for each in of_each(lambda rock: rock.knots)]
    levels, rates = shakings(curve, jnp.concatenate(knots))
    # With the oldest rock first, the first k rocks are fragile from the age of rock k to that of the next.
    order = jnp.argsort(-ages)
    ages = ages[order]
    single = jnp.concatenate(of_each(lambda rock: rock(levels)))[order]
    # This form of 1 - (1 - F)(1 - G) does not lose digits of small probabilities.
    joint = jax.lax.associative_scan(lambda f, g: f + g * (1 - f), single)
    return (ages - jnp.append(ages[1:], 0.0)) @ (joint @ rates)


@jit_low_effort(eqx.filter_jit)
def _allowed_scale(rocks, ages, curve, most: Scalar) -> Scalar:
    """Return the factor of `allowed_scale`, at which `most` topplings are expected."""
    numbers, rest = eqx.partition((rocks, ages, curve, most), eqx.is_array)

    def excess(logarithm, numbers):
        rocks, ages, curve, most = eqx.combine(numbers, rest)
        return _topplings(rocks, ages, scaled_curve(curve, jnp.exp(logarithm))) - most

    return _first_factor(excess, numbers)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _first_factor(excess: Callable, numbers: PyTree) -> Scalar:
    """Return the first factor at which `excess(ln factor, numbers)` is not negative."""
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
