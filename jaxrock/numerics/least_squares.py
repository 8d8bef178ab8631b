"""Nonlinear least squares from scattered starts, over growing windows of data, and the covariance of the result.

SciPy takes the steps (a trust region with reflection at the bounds). This module adds the windows, the prior that holds
a start, and the covariance.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

_MOST_STEPS, _FEW_STEPS = 100, 12  # of the last window, and of an earlier one; refused steps count
_TIGHT, _LOOSE = 1e-10, 1e-2  # relative gain of a step below which the descent ends
_STILL = 1e-9  # relative size of a step that counts as zero
_UNDETERMINED = 1e10  # variance of undetermined combinations of parameters, in squares of their natural size
_TO_THE_BOUND = 0.9  # largest share of the way to a bound by which a start is scattered


class LeastSquares(NamedTuple):
    """The residuals to minimise: `at(point, samples)` gives residuals (n,) and their derivatives.

    Residuals past the first `samples` are zero; for a point without a result they are infinite. `scale`, `lower` and
    `upper` are (parameters,): their natural size, and the open interval that they stay in.
    """

    at: Callable
    scale: Float[np.ndarray, " parameters"]
    lower: Float[np.ndarray, " parameters"]
    upper: Float[np.ndarray, " parameters"]


class Progression(NamedTuple):
    """Windows of the data, one after the other; in all but the last a prior holds a start near its first point.

    The prior acts as a measurement with the relative error `spread`, beside data with errors of size `noise`.
    """

    windows: tuple[int, ...]
    spread: float
    noise: float


class _DescentEnd(NamedTuple):
    """The end of one descent: its point, residuals and derivatives there, and whether that is a minimum."""

    point: Float[np.ndarray, " parameters"]
    residuals: Float[np.ndarray, " n"]
    jacobian: Float[np.ndarray, "n parameters"]
    converged: bool

    @property
    def cost(self) -> float:
        """Sum of squares."""
        return float(np.sum(self.residuals**2))


class Minimum(NamedTuple):
    """The least sum of squares of all starts, and the share of the starts that reached it."""

    point: Float[np.ndarray, " parameters"]
    residuals: Float[np.ndarray, " n"]
    jacobian: Float[np.ndarray, "n parameters"]
    converged: bool
    agreement: float


class Covariance(NamedTuple):
    """Covariance of least-squares estimates: for independent residuals, and for correlated ones."""

    independent: Float[np.ndarray, "parameters parameters"]
    robust: Float[np.ndarray, "parameters parameters"]
    scatter: float  # standard deviation of the residuals, by degrees of freedom
    correlation: float  # of neighbouring residuals


def least_squares(
    problem: LeastSquares, first: np.ndarray, progression: Progression, starts: int, seed: int
) -> Minimum:
    """Find the least sum of squares from scattered starts, window after window.

    **Arguments:**

    - `first`: (parameters,) the first start; the others lie around it by the spread of the progression.
    - `starts`: their number. `seed`: of their random numbers.

    **Source:** Branch, Coleman & Li (1999), by SciPy.
    """
    noise = np.random.default_rng(seed).normal(size=(starts, first.size)) * (np.arange(starts) > 0)[:, None]
    points = _inside(problem, np.tile(first, (starts, 1)), noise * progression.spread * problem.scale)
    ends = [_through_windows(problem, point, progression) for point in points]
    costs = np.array([end.cost for end in ends])
    best = ends[int(np.argmin(costs))]
    # Ends with so similar costs count as the same minimum, to a thirtieth of the standard errors.
    near = costs <= best.cost * (1 + 1e-6) + 1e-3 * progression.noise**2
    share = float(np.mean(near)) if np.isfinite(best.cost) else 0.0
    return Minimum(*best, share)


def _through_windows(problem: LeastSquares, point: np.ndarray, progression: Progression) -> _DescentEnd:
    """Descend from a start, from the first window to the last."""
    *early, last = progression.windows
    for samples in early:
        point = _descend(problem, point, samples, progression.noise / progression.spread, _FEW_STEPS, _LOOSE).point
    return _descend(problem, point, last, 0.0, _MOST_STEPS, _TIGHT)


def _inside(problem: LeastSquares, points: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Add steps to points, each parameter moving no further than most of its way to a bound."""
    room = np.where(steps > 0, problem.upper - points, problem.lower - points)
    return points + np.where(np.abs(steps) < _TO_THE_BOUND * np.abs(room), steps, _TO_THE_BOUND * room)


def _descend(
    problem: LeastSquares, begun: np.ndarray, samples: int, hold: float, most: int, enough: float
) -> _DescentEnd:
    """Run SciPy's descent from one start in a window. `hold`: weight of the prior that holds it near its start."""
    from scipy.optimize import least_squares

    @functools.lru_cache(maxsize=2)  # computed together, but SciPy asks for each separately
    def at(place: tuple[float, ...]):
        residuals, jacobian = problem.at(np.array(place), samples)
        return residuals, np.nan_to_num(jacobian)

    held = hold * np.diag(1 / problem.scale)

    def residuals(point):
        return np.concatenate([at(tuple(point))[0], held @ (point - begun)])

    def slopes(point):
        return np.concatenate([at(tuple(point))[1], held])

    first, first_slopes = at(tuple(begun))
    has_result = bool(np.isfinite(first).all())
    if not has_result or not np.any(first @ first_slopes):
        return _DescentEnd(begun, first, first_slopes, has_result)  # no result there, or the gradient is zero
    bounds = problem.lower, problem.upper
    found = least_squares(
        residuals, begun, slopes, bounds, x_scale=problem.scale, ftol=enough, xtol=_STILL, gtol=None, max_nfev=most
    )
    left, last_slopes = at(tuple(found.x))
    return _DescentEnd(found.x, left, last_slopes, bool(found.status > 0))


def covariance(minimum: Minimum, scale: np.ndarray, scatter_is_known: bool) -> Covariance:
    """Return the covariance of a least-squares point, from weighted residuals and their derivatives there.

    **Arguments:**

    - `scale`: (parameters,) natural sizes: undetermined combinations get a variance of 1e10 or more of their squares.
    - `scatter_is_known`: whether residuals were weighted by the inverse of their true standard deviation.

    **Source:** for correlated residuals, the covariance of ordinary least squares under stationary errors. They are
    autoregressive (Yule & Walker, by Brockwell & Davis 1991, 8.1), of an order after Akaike (1974).
    """
    residuals, slopes = minimum.residuals, np.nan_to_num(minimum.jacobian) * scale
    size, count = slopes.shape
    if not np.isfinite(residuals).all():
        unknown = np.diag(np.full(count, np.inf))
        return Covariance(unknown, unknown, np.inf, 0.0)
    values, vectors = np.linalg.eigh(slopes.T @ slopes)
    floor = 1e-14 * max(values.max(), 1e-280)
    undetermined = vectors[:, values <= floor]
    # Independent of the size of the residuals: they say nothing about combinations that do not change them.
    unknown = _UNDETERMINED * np.outer(scale, scale) * (undetermined @ undetermined.T)
    values = np.maximum(values, floor)
    inverse = (vectors / values) @ vectors.T
    scatter = float(np.sqrt(np.sum(residuals**2) / (size - count)))
    middle = slopes.T @ slopes
    for lag, correlation in enumerate(_correlations(residuals)[1:], 1):
        product = correlation * (slopes[lag:].T @ slopes[:-lag])
        middle += product + product.T
    both = np.outer(scale, scale)
    robust = inverse @ middle @ inverse * scatter**2
    neighbours = float(np.sum(residuals[1:] * residuals[:-1]) / max(np.sum(residuals**2), 1e-300))
    independent = both * inverse * (1.0 if scatter_is_known else scatter**2)
    return Covariance(independent + unknown, both * robust + unknown, scatter, neighbours)


def _correlations(residuals: np.ndarray) -> np.ndarray:
    """Return the autocorrelations of residuals at lags 0, 1, ... until they vanish.

    The residuals are taken as an autoregressive process of the order with the least Akaike criterion.
    """
    size, most = residuals.size, min(12, residuals.size // 10)
    powers = np.array([np.sum(residuals[lag:] * residuals[: size - lag]) for lag in range(most + 1)])
    if not 0 < powers[0] < np.inf:
        return np.ones(1)
    powers = powers / powers[0]
    best, terms = 0.0, np.zeros(0)
    for order in range(1, most + 1):
        places = np.abs(np.subtract.outer(np.arange(order), np.arange(order)))
        combination = np.linalg.solve(powers[places], powers[1 : order + 1])  # Yule-Walker
        left = 1 - combination @ powers[1 : order + 1]
        merit = size * np.log(max(left, 1e-300)) + 2 * order  # Akaike
        if merit < best:
            best, terms = merit, combination
    correlations = list(powers[: terms.size + 1])  # order zero: only lag 0
    while terms.size and len(correlations) < size - 1 and np.max(np.abs(correlations[-terms.size :])) > 1e-3:
        correlations.append(float(terms @ correlations[: -terms.size - 1 : -1]))
    return np.array(correlations)
