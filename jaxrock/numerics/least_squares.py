"""Nonlinear least squares from many starts at once, and the covariance of what it finds.

Residuals and their derivatives come from one compiled function of all starts; the small algebra is done here.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

_MOST_STEPS, _FEW_STEPS = 60, 8  # of the last window, and of one on the way
_TIGHT, _LOOSE = 1e-10, 1e-2  # relative gain in a step, below which it is the last one there
_UNDETERMINED = 1e10  # variance of what the data do not tell, in squares of its natural size
_TO_THE_BOUND = 0.9  # share of the way to a bound that one step may go


class Problem(NamedTuple):
    """What is to be made small: `at(points, samples)` gives residuals (starts, n) and their derivatives.

    Residuals past the first `samples` are zero; of a point that has no result they are infinite. `scale`, `lower` and
    `upper` are (parameters,): their natural size, and the open interval that they stay in.
    """

    at: Callable
    scale: Float[np.ndarray, " parameters"]
    lower: Float[np.ndarray, " parameters"]
    upper: Float[np.ndarray, " parameters"]


class Progression(NamedTuple):
    """Windows of the data, one after the other; in all but the last a start is held near where it began.

    It is held as if by a measurement with the relative error `spread`, beside data with errors of size `noise`.
    """

    windows: tuple[int, ...]
    spread: float
    noise: float


class Minimum(NamedTuple):
    """The least sum of squares of all starts, and the share of them that came to it."""

    point: Float[np.ndarray, " parameters"]
    residuals: Float[np.ndarray, " n"]
    jacobian: Float[np.ndarray, "n parameters"]
    converged: bool
    agreement: float


class Covariance(NamedTuple):
    """Of estimates by least squares: for independent residuals, and for correlated ones."""

    independent: Float[np.ndarray, "parameters parameters"]
    robust: Float[np.ndarray, "parameters parameters"]
    scatter: float  # of residuals, by degrees of freedom
    correlation: float  # of neighbouring residuals


def least_squares(problem: Problem, first: np.ndarray, progression: Progression, starts: int, seed: int) -> Minimum:
    """The least sum of squares that is found from scattered starts, window after window.

    **Arguments:**

    - `first`: (parameters,) the first start; the others lie around it by the spread of the progression.
    - `starts`: how many. `seed`: of their random numbers.

    **Source:** Marquardt (1963); the damping by Nielsen (1999).
    """
    noise = np.random.default_rng(seed).normal(size=(starts, first.size)) * (np.arange(starts) > 0)[:, None]
    points = _inside(problem, np.tile(first, (starts, 1)), noise * progression.spread * problem.scale)
    *early, last = progression.windows
    for samples in early:
        points = _descend(problem, points, samples, (progression.noise / progression.spread) ** 2, _FEW_STEPS, _LOOSE)[
            0
        ]
    points, residuals, jacobian, converged = _descend(problem, points, last, 0.0, _MOST_STEPS, _TIGHT)
    costs = np.sum(residuals**2, axis=1)
    best = int(np.argmin(costs))
    # What is so near is the same minimum, to a thirtieth of the standard errors.
    near = costs <= costs[best] * (1 + 1e-6) + 1e-3 * progression.noise**2
    share = float(np.mean(near)) if np.isfinite(costs[best]) else 0.0
    return Minimum(points[best], residuals[best], jacobian[best], bool(converged[best]), share)


def _inside(problem: Problem, points: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Points after steps, each parameter no further than most of its way to a bound."""
    room = np.where(steps > 0, problem.upper - points, problem.lower - points)
    return points + np.where(np.abs(steps) < _TO_THE_BOUND * np.abs(room), steps, _TO_THE_BOUND * room)


def _descend(problem: Problem, points: np.ndarray, samples: int, hold: float, most: int, enough: float):
    """Steps of Levenberg and Marquardt of all starts together: points, residuals, derivatives, and which converged.

    `hold`: weight of the squared relative distance from where a start began.
    """
    begun = points
    residuals, jacobian = problem.at(points, samples)

    def cost(points, residuals):
        return np.sum(residuals**2, axis=1) + hold * np.sum(((points - begun) / problem.scale) ** 2, axis=1)

    costs = cost(points, residuals)
    damping, growth = np.full(len(points), 1e-3), np.full(len(points), 2.0)
    done = ~np.isfinite(costs)
    for _ in range(most):
        if done.all():
            break
        steps, gains = _damped_steps(problem, points, residuals, jacobian, begun, hold, damping)
        trial = _inside(problem, points, np.where(done[:, None], 0.0, steps))
        new_residuals, new_jacobian = problem.at(trial, samples)
        new_costs = cost(trial, new_residuals)
        better = ~done & (new_costs < costs)
        fall = np.subtract(costs, new_costs, out=np.zeros_like(costs), where=better)
        ratio = fall / np.maximum(gains, 1e-300)
        small = np.max(np.abs(trial - points) / problem.scale, axis=1) < 1e-9
        # The sum of squares can fall no more, or does so no more.
        ended = (gains <= enough * costs) | (better & (fall <= enough * costs)) | small
        points = np.where(better[:, None], trial, points)
        residuals = np.where(better[:, None], new_residuals, residuals)
        jacobian = np.where(better[:, None, None], new_jacobian, jacobian)
        costs = np.where(better, new_costs, costs)
        damping = np.where(better, damping * np.clip(1 - (2 * ratio - 1) ** 3, 0.1, 2.0), damping * growth)
        damping, growth = np.minimum(damping, 1e15), np.minimum(np.where(better, 2.0, 2 * growth), 1e15)
        done |= ended
    return points, residuals, jacobian, done & np.isfinite(costs)


def _damped_steps(problem: Problem, points, residuals, jacobian, begun, hold: float, damping):
    """Damped Gauss-Newton steps, and the gains in the sum of squares that they promise."""
    slopes = np.nan_to_num(jacobian) * problem.scale
    errors = np.where(np.isfinite(residuals), residuals, 0.0)
    normal = np.einsum("sni,snj->sij", slopes, slopes) + hold * np.eye(problem.scale.size)
    gradient = np.einsum("sni,sn->si", slopes, errors) + hold * (points - begun) / problem.scale
    diagonal = np.einsum("sii->si", normal)
    # A parameter that the data do not show stays where it is.
    floor = 1e-12 * np.maximum(diagonal.max(axis=1, keepdims=True), 1e-280)
    ridge = damping[:, None] * diagonal + floor
    damped = normal + ridge[:, :, None] * np.eye(problem.scale.size)
    steps = -np.linalg.solve(damped, gradient[:, :, None])[:, :, 0]
    gains = np.sum(steps * (ridge * steps - gradient), axis=1)
    return steps * problem.scale, gains


def covariance(minimum: Minimum, scale: np.ndarray, scatter_is_known: bool) -> Covariance:
    """Covariance of the point of least squares, from weighted residuals and their derivatives there.

    **Arguments:**

    - `scale`: (parameters,) natural sizes: what is not told at all gets a variance of 1e10 or more of their squares.
    - `scatter_is_known`: whether residuals were weighted by the inverse of their true standard deviation.

    **Source:** for correlated residuals the covariance of ordinary least squares under errors that are stationary: each
    a combination of those before it (Yule & Walker, by Brockwell & Davis 1991, 8.1), of an order after Akaike (1974).
    """
    residuals, slopes = minimum.residuals, np.nan_to_num(minimum.jacobian) * scale
    size, count = slopes.shape
    if not np.isfinite(residuals).all():
        unknown = np.diag(np.full(count, np.inf))
        return Covariance(unknown, unknown, np.inf, 0.0)
    values, vectors = np.linalg.eigh(slopes.T @ slopes)
    floor = 1e-14 * max(values.max(), 1e-280)
    undetermined = vectors[:, values <= floor]
    # However small the residuals are: they say nothing about what does not show in them.
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
    """Of residuals with those so many places later, from 1 on down to where they vanish.

    Each is taken as a combination of those before it, of the order that explains most for its number of terms.
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
    correlations = list(powers[: terms.size + 1])  # of no order at all: none but with itself
    while terms.size and len(correlations) < size - 1 and np.max(np.abs(correlations[-terms.size :])) > 1e-3:
        correlations.append(float(terms @ correlations[: -terms.size - 1 : -1]))
    return np.array(correlations)
