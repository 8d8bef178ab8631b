"""Fragilities, the probability that a rock topples in a shaking of given intensity, and their fit to outcomes."""

import abc
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Inexact

from jaxrock._arguments.annotations import arguments
from jaxrock._arguments.parameters import Owner, parameter, set_parameters
from jaxrock._arguments.ranges import checked, if_known, level as at_level, not_negative, positive, share
from jaxrock._arguments.repr import described
from jaxrock._arguments.tables import AbstractTable, Column, scenes
from jaxrock._core.arrays import Values, as_real, check_shapes, is_traced
from jaxrock._core.one_program import one_program
from jaxrock._core.settings import called_by_users
from jaxrock._core.types import Real
from jaxrock.compiler.hints import jit_low_effort
from jaxrock.hazard.probit_line import padded_counts, probit, probit_line, slope_tests
from jaxrock.motions.measures import are_different
from jaxrock.status import Enumeration, item


class AbstractFragility(Owner):
    """Base class of fragilities: the probability that a rock topples, as a function of the shaking's intensity.

    A subclass defines `__call__`, and `knots` if it is not smooth; it may have a `measure`.
    """

    __repr__ = described

    @abc.abstractmethod
    def __call__(self, level: Values) -> Real:
        """Return the probability that a shaking of intensity `level` (any shape) topples the rock."""

    @property
    def knots(self) -> Inexact[Array, " knots"]:
        """Levels between which the fragility is close to a low polynomial; integrals are split there."""
        return jnp.zeros(0)


class LogNormalFragility(AbstractFragility):
    """A fragility that is the cumulative normal distribution of the logarithm of the intensity.

    **Arguments:**

    - `median`: intensity that topples half of the time, in the unit of the hazard curve, positive.
    - `dispersion`: standard deviation of the logarithm of the intensity that topples [-], positive.
    - `measure`: the intensity measure, such as "PGA"; a label. Hazard curves of another measure are refused.

    **Raises:** ValueError for a value outside its range.
    """

    median: Real = parameter("-", positive)
    dispersion: Real = parameter("-", positive)
    measure: str = eqx.field(static=True)

    @arguments
    def __init__(self, median: ArrayLike, dispersion: ArrayLike, measure: str = ""):
        set_parameters(self, median=median, dispersion=dispersion)
        self.measure = measure

    @called_by_users
    def __call__(self, level: Values) -> Real:
        level = if_known(at_level, "level", level)
        check_shapes(level=level, median=self.median)
        return lognormal(level, self.median, self.dispersion)

    @property
    def knots(self) -> Inexact[Array, " knots"]:
        # Eight standard deviations away the probability is 0 or 1 to rounding.
        return self.median * jnp.exp(self.dispersion * jnp.array([-8.0, -4.0, 0.0, 4.0, 8.0]))


def lognormal_of(median: Real, dispersion: Real, measure: str) -> LogNormalFragility:
    """Return a lognormal fragility whose parameters may be NaN, which the constructor refuses."""
    return eqx.tree_at(lambda f: (f.median, f.dispersion), LogNormalFragility(1.0, 1.0, measure), (median, dispersion))


@one_program
def lognormal(level: Real, median: Real, dispersion: Real) -> Real:
    """Return the lognormal probability of toppling, also for intensities of 0 and infinity."""
    none, any_level = level <= 0, level == jnp.inf  # there the logarithm has no finite derivative
    z = jnp.log(jnp.where(none | any_level, 1.0, level) / median) / dispersion
    return jnp.where(none, 0.0, jnp.where(any_level, 1.0, jax.lax.erfc(-z / math.sqrt(2)) / 2))


class TabulatedFragility(AbstractFragility):
    """A fragility interpolated between probabilities at levels, linearly in the logarithm of the intensity.

    Below the first level nothing topples; above the last one its probability holds. For a fragility that grows, these
    rules never overestimate the probability.

    **Arguments:**

    - `levels`: (n,) intensities, in the unit of the hazard curve, positive and rising; n at least 2.
    - `probabilities`: (n,) of toppling, in [0, 1]; they may rise and fall, as overturning does with amplitude.
    - `measure`: as in `LogNormalFragility`.

    **Raises:** ValueError for values outside their ranges, or of other shapes.
    """

    levels: Inexact[Array, "*batch n"]
    probabilities: Inexact[Array, "*batch n"]
    measure: str = eqx.field(static=True)

    @arguments
    def __init__(self, levels: Values, probabilities: Values, measure: str = ""):
        levels = rising("levels", levels)
        self.levels, probabilities = alike(levels, share("probabilities", probabilities))
        self.probabilities = beside("probabilities", probabilities, levels)
        self.measure = measure

    @called_by_users
    def __call__(self, level: Values) -> Real:
        return _interpolated(if_known(at_level, "level", level), self.levels, self.probabilities)

    @property
    def knots(self) -> Inexact[Array, " knots"]:
        return self.levels


@one_program
def _interpolated(level: Real, levels: Real, probabilities: Real) -> Real:
    below, above = level < levels[0], level >= levels[-1]
    inside = jnp.where(below | above, levels[0], level)  # logarithms of 0 and infinity have no finite derivatives
    between = jnp.interp(jnp.log(inside), jnp.log(levels), probabilities)
    return jnp.where(below, 0.0, jnp.where(above, probabilities[-1], between))


def check_measure(name: str, measure: str, fragility: AbstractFragility) -> None:
    """Raise ValueError if the measure of an argument differs from that of a fragility, where both are known."""
    own = str(getattr(fragility, "measure", ""))
    if are_different(measure, own):
        raise ValueError(f"Argument `{name}` must be of the fragility's measure, {own}, but is {measure}.")


def rising(name: str, value: Values) -> Inexact[Array, "*batch n"]:
    """Return `value` as an array of two positive levels or more, each above the preceding one."""
    array = as_real(name, value)
    if array.ndim == 0 or array.shape[-1] < 2 or array.size == 0:
        raise ValueError(f"Argument `{name}` must hold at least two levels, but has shape {array.shape}.")
    allowed = "be positive and finite, and rise from level to level"
    return checked(name, array, allowed, _rises)


def _rises(x):
    return (x > the_one_before(x, 0.0)) & (x < np.inf)


def the_one_before(x, first: float):
    """Return for each value the preceding one along the last axis, after `first`.

    Concrete values use NumPy, because JAX would compile the operation for each length.
    """
    arrays = np if isinstance(x, np.ndarray) else jnp
    return arrays.concatenate([arrays.full_like(x[..., :1], first), x[..., :-1]], axis=-1)


def rising_list(name: str, value: Values) -> Inexact[Array, " n"]:
    """Return `value` as `rising` does, but only a list (one axis)."""
    array = rising(name, value)
    if array.ndim > 1:
        raise ValueError(f"Argument `{name}` must be a list of levels, but has shape {array.shape}.")
    return array


def outcomes(toppled: Values, levels: Real, trials: Real) -> Real:
    """Return `toppled` as numbers, one for each level; `toppled` holds counts out of `trials`, or truth values."""
    if isinstance(toppled, (list, tuple)) and all(isinstance(each, (bool, np.bool_)) for each in toppled):
        toppled = np.asarray(toppled)
    if np.dtype(getattr(toppled, "dtype", float)) == bool:
        toppled = jnp.asarray(toppled, levels.dtype)
    toppled = beside("toppled", as_real("toppled", toppled), levels)
    most = trials if is_traced(trials) else np.asarray(trials)
    return checked("toppled", toppled, "be from 0 to `trials`", lambda x: (x >= 0) & (x <= most))


def alike(*arrays: Real) -> tuple[Real, ...]:
    """Return the arrays in one precision, the highest among them."""
    dtype = jnp.result_type(*arrays)
    return tuple(array.astype(dtype) for array in arrays)


def beside(name: str, array: Real, levels: Real) -> Real:
    """Return `array` if it has a value for each level."""
    if array.shape != levels.shape:
        expected = f"have the shape {levels.shape} of `levels`"
        raise ValueError(f"Argument `{name}` must {expected}, but has shape {array.shape}.")
    return array


class FitStatus(Enumeration):
    """Result code of a fit; `FitStatus[fit.status]` is the message."""

    successful = item("The likelihood has one maximum, and it was found.")
    separable = item(
        "No shaking that a rock survived was stronger than one that toppled it (or the reverse, or all ended alike), "
        "by one measure or some sum of several: the likelihood only grows as the dispersion shrinks or the median "
        "leaves the data. Outcomes that overlap are needed; these only tell between which levels the median lies."
    )
    not_growing = item(
        "Stronger shakings did not topple more often: no lognormal fragility describes that. Tabulate it."
    )
    not_converged = item("The maximum of the likelihood was not found.")
    alike = item(
        "All motions did the same at every level: nothing is known of how they differ, and there are no intervals. "
        "Take more motions, more levels, or more draws."
    )


class FragilityFit(AbstractTable):
    """The result of `fit_fragility`; where `status` is not `FitStatus.successful`, the numbers of the fit are NaN.

    - `fragility`: the `LogNormalFragility` of largest likelihood.
    - `covariance`: (2, 2) of (ln median, ln dispersion), the inverse of the observed information. It is good for many
      outcomes, and too small for few; `fragility_intervals` holds for few.
    - `log_likelihood`: at the maximum, without the binomial coefficients.
    - `highest_survived`, `lowest_toppled`: in the unit of the levels, 0 and infinite if there are none. Where the
      outcomes are separable in the usual order, the median lies between them.
    - `status`: a `FitStatus`.
    - `p_value`: probability that outcomes independent of the levels give such a slope (Rao's score test with the
      observed information). Above 0.05 this measure of intensity is useless here. It holds for separable outcomes, too.
      It is 1 where all outcomes are equal, and NaN for a simulation of one record, which carries no information on
      others.
    """

    fragility: LogNormalFragility
    covariance: Inexact[Array, "2 2"]
    log_likelihood: Inexact[Array, ""]
    highest_survived: Inexact[Array, ""]
    lowest_toppled: Inexact[Array, ""]
    status: FitStatus
    p_value: Inexact[Array, ""]

    @property
    def _columns(self):
        own = "that of the levels"
        units = {"median": own, "highest_survived": own, "lowest_toppled": own}
        errors = jnp.sqrt(jnp.diagonal(self.covariance, axis1=-2, axis2=-1))
        told = {"median": self.fragility.median, "dispersion": self.fragility.dispersion}
        told |= {f"standard_error_of_ln_{name}": errors[..., i] for i, name in enumerate(("median", "dispersion"))}
        told |= {
            n: getattr(self, n) for n in ("log_likelihood", "highest_survived", "lowest_toppled", "p_value", "status")
        }
        axes = scenes(self.log_likelihood.ndim)
        return {name: Column(axes, values, units.get(name, "-")) for name, values in told.items()}


def fit_fragility(levels: Values, toppled: Values, trials: Values = 1) -> FragilityFit:
    """Fit the lognormal fragility under which outcomes are most probable (probit regression on the logarithm).

    **Arguments:**

    - `levels`: (n,) intensities of the shakings, positive.
    - `toppled`: (n,) 0 or 1 (or False and True) for each shaking; or how many of its `trials` toppled.
    - `trials`: number of rocks exposed at each level, (n,) or one number.

    **Returns:** a `FragilityFit`, also for data without a maximum, which its status reports. It has derivatives of
    first order by the data.

    **Raises:** ValueError for arguments outside their ranges, or of other shapes.

    **Source:** Silvapulle (1981), when the maximum exists; Baker (2015), the fit to counts at levels.
    """
    levels, toppled, survived = counted(levels, toppled, trials)
    (levels,), toppled, survived, _ = padded_counts([levels], toppled, survived)
    return _fit(levels, toppled, survived)


def counted(levels: Values, toppled: Values, trials: Values) -> tuple[Real, Real, Real]:
    """Check the user's data; return levels, numbers toppled and numbers that survived, (n,) each."""
    levels = positive("levels", levels)
    if levels.ndim != 1 or levels.size == 0:
        raise ValueError(f"Argument `levels` must be a list of at least one value, but has shape {levels.shape}.")
    trials = not_negative("trials", trials)
    if trials.shape not in ((), levels.shape):
        raise ValueError(f"Argument `trials` must have shape {levels.shape} or (), but has shape {trials.shape}.")
    levels, trials, toppled = alike(levels, trials, outcomes(toppled, levels, trials))
    return levels, toppled, trials - toppled


@jit_low_effort()
def _fit(levels, toppled, survived) -> FragilityFit:
    highest_survived, highest_toppled = (jnp.max(jnp.where(n > 0, levels, 0.0)) for n in (survived, toppled))
    lowest_survived, lowest_toppled = (jnp.min(jnp.where(n > 0, levels, jnp.inf)) for n in (survived, toppled))
    separable = (highest_survived <= lowest_toppled) | (highest_toppled <= lowest_survived)

    logarithm = jnp.log(levels)
    centre, spread = jnp.mean(logarithm), jnp.std(logarithm)
    abscissa = (logarithm - centre) / jnp.where(separable, 1.0, spread)
    line, converged = probit_line(abscissa[None], toppled, survived)
    # z = line[0] + line[1] (ln level - centre)/spread = (ln level - ln median)/dispersion.
    z = line[0] + line[1] * abscissa
    dispersion = spread / jnp.where(line[1] > 0, line[1], 1.0)
    median = jnp.exp(centre - line[0] * dispersion)
    growing = (line[1] > 0) & (median > 0) & (median < jnp.inf)
    likelihood, _, curvature = probit(z, toppled, survived)
    # Derivatives by ln median and ln dispersion; at the maximum slopes sum to 0, so second derivatives of z drop out.
    rows = jnp.stack([jnp.full_like(z, 1 / dispersion), z])

    status = FitStatus.where(growing, FitStatus.successful, FitStatus.not_growing)
    status = FitStatus.where(converged, status, FitStatus.not_converged)
    status = FitStatus.where(separable, FitStatus.separable, status)
    covariance = jnp.linalg.inv(rows @ (-curvature[:, None] * rows.T))
    fit = lognormal_of(median, dispersion, ""), covariance, likelihood
    good = status == FitStatus.successful
    fit = jax.tree.map(lambda x: jnp.where(good, x, jnp.nan), fit)
    test = slope_tests((logarithm - centre)[None], toppled, survived)[0]
    fragility, covariance, likelihood = fit
    return FragilityFit(fragility, covariance, likelihood, highest_survived, lowest_toppled, status, test)
