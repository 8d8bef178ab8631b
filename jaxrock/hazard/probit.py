"""Probit fits of outcomes to the logarithms of intensity measures, with standard errors also for few motions."""

from collections.abc import Mapping, Sequence
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr
from jaxtyping import Array, Bool, Float

from jaxrock._arguments.annotations import arguments, word_of
from jaxrock._arguments.ranges import not_negative, positive
from jaxrock._arguments.tables import AbstractTable, Column
from jaxrock._core.arrays import Values, is_traced, shown
from jaxrock._core.one_program import one_program
from jaxrock._core.settings import called_by_users
from jaxrock.compiler.hints import jit_low_effort
from jaxrock.hazard.fragility import FitStatus, LogNormalFragility, outcomes
from jaxrock.hazard.probit_line import most_clusters, padded_counts, probit, probit_line, slope_tests


class ProbitFit(AbstractTable):
    """The result of `fit_probit`; where `status` is not `FitStatus.successful`, the numbers of the fit are NaN.

    P = Phi(intercept + sum of slopes times ln measure).

    - `names`: of the measures; `intercept`; `slopes`: (measures,).
    - `covariance`: (1 + measures, 1 + measures) of the intercept and the slopes. That of a jackknife is NaN where
      outcomes are separable once a cluster is left out, so that the line without it does not exist.
    - `log_likelihood`: at the maximum, without the binomial coefficients.
    - `p_values`: (measures,) probability of such a slope if outcomes do not depend on the measure, given the others
      (Rao's score test with the observed information, or with clusters if given). They hold for separable outcomes,
      too. They are 1 where no slope can be identified: a measure is constant, all outcomes are equal, or the other
      measures separate them.
    - `falls`: (measures,) whether the mean logarithm of a measure is less where rocks toppled than where they stood.
    - `status`: a `FitStatus`. For a single measure with which toppling falls, it is successful with a slope below 0.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    intercept: Float[Array, ""]
    slopes: Float[Array, " measures"]
    covariance: Float[Array, "terms terms"]
    log_likelihood: Float[Array, ""]
    p_values: Float[Array, " measures"]
    falls: Bool[Array, " measures"]
    status: FitStatus

    @property
    def _columns(self):
        terms = np.array(["intercept", *self.names])
        return {
            "term": Column(("term",), terms),
            "value": Column(("term",), jnp.concatenate([self.intercept[None], self.slopes])),
            "standard_error": Column(("term",), self.standard_errors),
            "p_value": Column(("term",), jnp.concatenate([jnp.full(1, jnp.nan), self.p_values])),
            "log_likelihood": Column((), self.log_likelihood),
            "status": Column((), self.status),
        }

    @property
    def standard_errors(self) -> Float[Array, " terms"]:
        """Standard errors of the intercept and the slopes."""
        return jnp.sqrt(jnp.diag(self.covariance))

    @property
    def useless(self) -> tuple[str, ...]:
        """Names of measures whose relation to toppling may be chance.

        Their slope does not differ significantly from 0: `p_values` above 0.05, or NaN where a measure says the same as
        another, or nothing. A single measure with a slope below 0 counts, too.
        """
        untold = ~(self.p_values <= 0.05)
        if len(self.names) == 1:
            untold |= self.falls
        return tuple(name for name, bad in zip(self.names, np.asarray(untold)) if bad)

    @called_by_users
    def __call__(self, **measures: Values) -> Float[Array, "..."]:
        """Return the probability to topple at measures by name, positive, which broadcast.

        **Raises:** ValueError for other names, or numbers that are not positive.
        """
        if set(measures) != set(self.names):
            raise ValueError(f"The arguments must be `{'`, `'.join(self.names)}`, but are {sorted(measures)}.")
        logarithms = [jnp.log(positive(name, measures[name])) for name in self.names]
        return ndtr(self.intercept + sum(slope * x for slope, x in zip(self.slopes, logarithms)))

    @property
    def fragility(self) -> LogNormalFragility:
        """The lognormal fragility of a single measure.

        **Raises:** ValueError for more measures than one, and for a fit that failed or does not grow.
        """
        if len(self.names) != 1 or not self.slopes[0] > 0:
            raise ValueError("A lognormal fragility must have one measure, with which the probability grows.")
        return LogNormalFragility(jnp.exp(-self.intercept / self.slopes[0]), 1 / self.slopes[0], self.names[0])


@arguments
def fit_probit(
    measures: Mapping[str, Values],
    toppled: Values,
    trials: Values = 1,
    *,
    clusters: Sequence | np.ndarray | None = None,
    errors: Annotated[str, word_of("information", "clusters", "jackknife")] | None = None,
) -> ProbitFit:
    """Fit the probit line in the logarithms of measures under which outcomes are most probable.

    **Arguments:**

    - `measures`: (n,) positive values by name, one measure or more.
    - `toppled`, `trials`: as in `fit_fragility`.
    - `clusters`: (n,) labels; outcomes of one label are not independent, for example those of one motion.
    - `errors`: how the covariance is estimated.
        - "information": the inverse of the observed information, for independent outcomes (default without clusters).
        - "clusters": a sandwich of C clusters times C/(C - 1) (default with them), too small for few clusters.
        - "jackknife": every cluster (without clusters, every row) left out once. It is safer for few, 10 to 40:
          somewhat too large rather than too small. NaN where the remaining outcomes are separable.

    **Returns:** a `ProbitFit`.

    **Raises:** ValueError for arguments outside their ranges, or of other shapes, and for fewer than two clusters.

    **Source:** Liang & Zeger (1986), clusters; Bell & McCaffrey (2002), the jackknife; Rao (1948), the test of slopes.
    """
    if not isinstance(measures, Mapping) or not measures or not all(isinstance(name, str) for name in measures):
        raise ValueError(f"Argument `measures` must hold lists by name, but is {shown(measures)}.")
    lists = [positive(name, values) for name, values in measures.items()]
    first = lists[0]
    if first.ndim != 1 or first.size < 2 or any(each.shape != first.shape for each in lists):
        raise ValueError(f"Argument `measures` must hold lists of one length, but of {[x.shape for x in lists]}.")
    trials = not_negative("trials", trials)
    if trials.shape not in ((), first.shape):
        raise ValueError(f"Argument `trials` must have shape {first.shape} or (), but has shape {trials.shape}.")
    toppled = outcomes(toppled, first, trials)
    if errors is None:
        errors = "information" if clusters is None else "clusters"
    labels = np.arange(first.size) if clusters is None else np.unique(np.asarray(clusters), return_inverse=True)[1]
    if labels.shape != first.shape:
        raise ValueError(f"Argument `clusters` must have shape {first.shape}, but has shape {labels.shape}.")
    if errors != "information" and labels.max() < 1:
        raise ValueError("Argument `clusters` must name at least two clusters, but names one.")
    count = 0 if errors == "information" else int(labels.max()) + 1
    lists, toppled, survived, labels = padded_counts(lists, toppled, trials - toppled, labels)
    logarithms = _logarithms(lists)
    numbers = _fit(logarithms, toppled, survived, labels, count, most_clusters(count), errors)
    return or_separable(ProbitFit(tuple(measures), *numbers), logarithms, toppled, survived)


@one_program
def _logarithms(lists):
    """Return the logarithms of the measures in the default precision, because sums over outcomes are long."""
    return jnp.log(jnp.stack(lists).astype(jnp.result_type(float)))


def or_separable(fit, logarithms, toppled, survived):
    """Return the fit, with the status `separable` if it failed because a plane separates the outcomes.

    Outcomes in the plane itself do not count. Then no maximum exists. A linear program looks for such a plane: all
    outcomes on their side of it or in it, with the largest sum of distances.

    **Source:** Albert & Anderson (1984), when no maximum exists; Konis (2007), the program.
    """
    if is_traced((fit, logarithms, toppled, survived)) or bool(fit.status == FitStatus.successful):
        return fit
    from scipy.optimize import linprog  # imported here because it takes half a second

    rows = np.asarray(logarithms, float)
    rows = rows - rows.mean(axis=1, keepdims=True)
    rows = np.concatenate([np.ones_like(rows[:1]), rows / np.maximum(np.abs(rows).max(axis=1, keepdims=True), 1e-9)])
    sides = np.concatenate([rows[:, np.asarray(toppled) > 0], -rows[:, np.asarray(survived) > 0]], axis=1)
    plane = linprog(-np.sum(sides, axis=1), A_ub=-sides.T, b_ub=np.zeros(sides.shape[1]), bounds=(-1, 1))
    parted = plane.success and np.max(plane.x @ sides, initial=0.0) > 1e-5  # less is within the solver's tolerance
    return eqx.tree_at(lambda f: f.status, fit, FitStatus.separable) if parted else fit


def inverse_information(rows, curvature, trials):
    """Return the covariance of a line by the observed information, and whether it is reliable.

    It is not where this information is negligible beside that of outcomes of even odds, as along a separating plane.
    """
    covariance = jnp.linalg.inv(rows @ (-curvature[:, None] * rows.T))
    even = jnp.trace(covariance @ (rows @ (trials[:, None] * rows.T)))
    return covariance, (even > 0) & (even < jnp.finfo(rows.dtype).eps ** -0.75)


@jit_low_effort(static_argnames=("most", "errors"))
def _fit(logarithms, toppled, survived, labels, count, most: int, errors: str):
    centre, size = jnp.mean(logarithms, 1), jnp.std(logarithms, 1)
    known = jnp.all(size > 1e-9)
    size = jnp.where(size > 1e-9, size, 1.0)
    abscissas = (logarithms - centre[:, None]) / size[:, None]
    line, converged = probit_line(abscissas, toppled, survived)
    rows = jnp.concatenate([jnp.ones_like(abscissas[:1]), abscissas])
    likelihood, by_z, curvature = probit(line @ rows, toppled, survived)
    covariance, told = inverse_information(rows, curvature, toppled + survived)
    told &= jnp.all(jnp.isfinite(covariance))
    if errors == "clusters":
        scores = jnp.zeros((most, len(rows))).at[labels].add((rows * by_z).T)
        covariance = covariance @ (scores.T @ scores * count / (count - 1)) @ covariance
    elif errors == "jackknife":

        def without(left_out):
            kept = (labels != left_out).astype(toppled.dtype)
            return probit_line(abscissas, toppled * kept, survived * kept)

        # Padding labels name no row: lines without them equal the full fit, and add nothing.
        lines, found = jax.lax.map(without, jnp.arange(most), batch_size=64)
        off = lines - line
        covariance = jnp.where(jnp.all(found), (count - 1) / count * off.T @ off, jnp.nan)
    # Convert to the logarithms themselves: intercept = line[0] - sum(line[k] centre[k]/size[k]).
    back = jnp.diag(jnp.concatenate([jnp.ones(1), 1 / size])).at[0, 1:].set(-centre / size)
    # For separable outcomes, probabilities approach 0 or 1, and the slopes grow without bound.
    converged &= known & told & (jnp.sum(toppled) > 0) & (jnp.sum(survived) > 0) & (likelihood < -1e-6)
    status = FitStatus.where(converged, FitStatus.successful, FitStatus.not_converged)
    status = FitStatus.where(likelihood >= -1e-6, FitStatus.separable, status)
    numbers = (back @ line)[0], (back @ line)[1:], back @ covariance @ back.T, likelihood
    tests = slope_tests(abscissas, toppled, survived, None if errors == "information" else labels, count, most)
    means = [jnp.sum(abscissas * n, axis=1) / jnp.sum(n) for n in (toppled, survived)]
    return *(jnp.where(converged, x, jnp.nan) for x in numbers), tests, means[0] < means[1], status
