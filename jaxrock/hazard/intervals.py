"""Intervals of fragilities that hold for few shakings and few motions, where standard errors do not.

For independent outcomes, intervals come from the profile of the likelihood with Jeffreys' penalty. The penalty is half
of the logarithm of the information's determinant, and removes the bias (Firth). It keeps all estimates finite, so that
separable outcomes have intervals, too: any dispersion down to 0 explains them, and any median between them.

For motions at many levels, the pooled outcomes of one motion give one number about the median. Student's t and
chi-squared therefore have as many observations as there are motions.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxrock._arguments.annotations import arguments
from jaxrock._arguments.ranges import inner_share, scalar
from jaxrock._arguments.tables import AbstractTable, Column
from jaxrock._core.arrays import Values
from jaxrock.hazard.fragility import FitStatus, counted

_FLATTEST = -9.0  # ln of the least slope that is distinguished from 0, times the spread of the levels
_STEEPEST = 40.0  # slope times the distance of two neighbouring levels, which separates their outcomes


class FragilityIntervals(AbstractTable):
    """Confidence intervals of the median and the dispersion of a lognormal fragility, each by itself.

    - `confidence`: in (0, 1).
    - `median`: (2,) ends, in the unit of the levels; 0 or infinite where the outcomes leave that side open.
    - `dispersion`: (2,) ends [-]; infinite where the outcomes do not distinguish the slope from 0.
    - `status`: a `FitStatus`; unless it is successful, the ends are NaN.
    """

    confidence: float = eqx.field(static=True)
    median: Float[Array, "2"]
    dispersion: Float[Array, "2"]
    status: FitStatus

    @property
    def _columns(self):
        units = {"median": "that of the levels", "dispersion": "-"}
        told = {name: Column(("end",), getattr(self, name), unit) for name, unit in units.items()}
        ends = Column(("end",), np.array(["low", "high"]))
        return {"end": ends} | told | {"confidence": Column((), self.confidence), "status": Column((), self.status)}


@arguments
def fragility_intervals(
    levels: Values, toppled: Values, trials: Values = 1, *, confidence: ArrayLike = 0.95
) -> FragilityIntervals:
    """Find intervals of the lognormal fragility of independent outcomes, also for few or separable outcomes.

    **Arguments:**

    - `levels`, `toppled`, `trials`: as in `fit_fragility`; values, not traced.
    - `confidence`: in (0, 1).

    **Returns:** a `FragilityIntervals`, always with ends: of the profile of the likelihood with Jeffreys' penalty. For
    the coverage of 95 % intervals in synthetic samples of 5 to 40 outcomes, see benchmarks/few_motions.md; for 5 and 10
    outcomes they are too wide rather than too narrow. `fit_fragility` gives the most probable fragility. Outcomes of a
    suite at many levels are not independent: use `SimulatedFragility.intervals`.

    **Raises:** ValueError for arguments outside their ranges, or of other shapes.

    **Source:** Firth (1993), the penalty; Heinze & Schemper (2002), its profile for separable outcomes; Kosmidis &
    Firth (2021), why estimates are finite, for probits, too.
    """
    from scipy.special import chdtri

    levels, toppled, survived = (np.asarray(x, float) for x in counted(levels, toppled, trials))
    confidence = _confidence(confidence)
    tried = toppled + survived > 0
    logarithms = np.log(levels[tried])
    if np.unique(np.round(logarithms, 9)).size < 2:
        # Outcomes at one level contain no information on the change between levels.
        anything = jnp.array([0.0, jnp.inf])
        return FragilityIntervals(confidence, anything, anything, FitStatus.successful)
    centre, spread = logarithms.mean(), logarithms.std()
    height = _Height((logarithms - centre) / spread, toppled[tried], survived[tried])
    median, slope = _ends(height, chdtri(1, 1 - confidence) / 2)
    with np.errstate(divide="ignore"):
        median, dispersion = np.exp(centre + spread * median), spread / slope[::-1]
    # The penalty excludes steep slopes even for separable outcomes, which do not contradict them.
    last, first = np.max(levels, where=survived > 0, initial=0.0), np.min(levels, where=toppled > 0, initial=np.inf)
    if last <= first:
        median, dispersion = np.array([min(median[0], last), max(median[1], first)]), np.array([0.0, dispersion[1]])
    return FragilityIntervals(confidence, jnp.asarray(median), jnp.asarray(dispersion), FitStatus.successful)


def intervals_of_motions(fit, motions: int, confidence: ArrayLike) -> FragilityIntervals:
    """Return intervals from a fit whose covariance treats motions as clusters, with the factor motions/(motions - 1).

    The logarithm of the median is a mean over motions, with Student's t. The part of the squared dispersion that is
    between motions is their number times the variance of that mean. It scatters as a sample variance does. The rest is
    within motions, and its error is neglected because each motion has many scenes.
    """
    from scipy.special import chdtri, stdtrit

    confidence = _confidence(confidence)
    if motions < 2 or fit.status != FitStatus.successful:
        nothing = jnp.full(2, jnp.nan)
        status = FitStatus.not_converged if fit.status == FitStatus.successful else fit.status
        return FragilityIntervals(confidence, nothing, nothing, status)
    if not float(fit.covariance[0, 0]) > 0:
        nothing = jnp.full(2, jnp.nan)
        return FragilityIntervals(confidence, nothing, nothing, FitStatus.alike)
    freedom, tail = motions - 1, (1 - confidence) / 2
    variance = float(fit.covariance[0, 0])
    beyond = stdtrit(freedom, 1 - tail) * np.sqrt(variance)
    median = float(fit.fragility.median) * np.exp([-beyond, beyond])
    found = float(fit.fragility.dispersion) ** 2
    between = min(motions * variance, found * motions / freedom)
    # The likelihood divides by the number of motions: adding `between`/motions removes that bias.
    ends = found + between * (freedom / chdtri(freedom, [tail, 1 - tail]) - freedom / motions)
    return FragilityIntervals(confidence, jnp.asarray(median), jnp.sqrt(jnp.asarray(ends)), FitStatus.successful)


def _confidence(value: ArrayLike) -> float:
    return float(scalar("confidence", inner_share("confidence", value)))


class _Height(NamedTuple):
    """The log-likelihood of lines, z = intercept + slope abscissa, with Jeffreys' penalty."""

    abscissas: np.ndarray
    toppled: np.ndarray
    survived: np.ndarray

    def __call__(self, intercept: np.ndarray, slope: np.ndarray) -> np.ndarray:
        """Return the penalised log-likelihoods, (lines,), of intercepts and slopes, (lines,)."""
        from scipy.special import log_ndtr

        z = intercept[:, None] + slope[:, None] * self.abscissas
        above, below = log_ndtr(z), log_ndtr(-z)
        weights = np.log(self.toppled + self.survived) - z**2 - above - below
        return above @ self.toppled + below @ self.survived + _log_determinant(weights, self.abscissas) / 2

    @property
    def range(self) -> tuple[float, float]:
        """Logarithms of two slopes: one hardly distinguished from 0, and one that separates any neighbours."""
        gaps = np.diff(np.unique(np.round(self.abscissas, 6)))
        return _FLATTEST, float(np.log(_STEEPEST / gaps.min()))

    def best_intercept(self, logarithm: float) -> tuple[float, float]:
        """Return the best intercept for a slope, given by its logarithm, and the height there."""
        slope = np.exp(logarithm)
        ends = -slope * self.abscissas.max() - 6, -slope * self.abscissas.min() + 6
        return _highest(lambda intercept: self(intercept, np.full_like(intercept, slope)), *ends)

    def at_slope(self, logarithm: float) -> float:
        """Return the maximum over medians for a slope, given by its logarithm."""
        return self.best_intercept(logarithm)[1]

    def at_median(self, median: float) -> float:
        """Return the maximum over slopes for a median."""
        flattest, steepest = self.range

        def at(logarithm):
            slope = np.exp(logarithm)
            return self(-slope * median, slope)

        return _highest(at, flattest - np.log1p(abs(median)), steepest)[1]


def _log_determinant(weights: np.ndarray, abscissas: np.ndarray) -> np.ndarray:
    """Return the log-determinant of the information of intercept and slope, from logarithms of weights (lines, n).

    Distances are from the abscissa of the largest weight, so that a second weight counts however small it is.
    """
    top = np.argmax(weights, axis=1)[:, None]
    largest = np.take_along_axis(weights, top, 1)
    shares, away = weights - largest, abscissas - abscissas[top]
    with np.errstate(divide="ignore"):
        squares = shares + 2 * np.log(np.abs(away))
    most = np.max(squares, axis=1, keepdims=True)
    # Weighted sums of squares and of distances from that abscissa, scaled by exp(most) to avoid underflow.
    second = np.sum(np.exp(squares - most), axis=1)
    first = np.sum(np.sign(away) * np.exp((squares - most + shares) / 2), axis=1)
    return 2 * largest[:, 0] + most[:, 0] + np.log(np.sum(np.exp(shares), axis=1) * second - first**2)


def _highest(height: Callable[[np.ndarray], np.ndarray], low: float, high: float) -> tuple[float, float]:
    """Return the place of the maximum of a unimodal function, and its height there.

    The search refines a grid until its places are 3e-4 apart, and ends with the parabola through the best three. Places
    are logarithms of slopes, or in standard deviations, so that this distance is small.
    """
    for _ in range(1 + int(np.ceil(np.log((high - low) / 16 / 3e-4) / np.log(8)))):
        places = np.linspace(low, high, 17)
        heights = height(places)
        best = int(np.argmax(heights))
        low, high = places[max(best - 1, 0)], places[min(best + 1, 16)]
    if best in (0, 16):
        return float(places[best]), float(heights[best])
    before, top, after = heights[best - 1 : best + 2]
    bend = before - 2 * top + after
    share = (before - after) / (2 * bend) if bend < 0 else 0.0
    return float(places[best] + share * (places[1] - places[0])), float(top - (before - after) * share / 4)


def _ends(height: _Height, drop: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends of median and slope between which the profiles are less than `drop` below the maximum."""
    from scipy.optimize import brentq, minimize_scalar

    flattest, steepest = height.range
    found = minimize_scalar(lambda place: -height.at_slope(place), bounds=(flattest, steepest), method="bounded")
    # Where outcomes do not rise with the level, the flattest slope is the best.
    top, best = max((height.at_slope(place), place) for place in (found.x, flattest))
    centre = -height.best_intercept(best)[0] / np.exp(best)

    def inside_slope(place):
        return height.at_slope(place) - top + drop

    def end(side):
        def inside(logarithm):
            return height.at_median(centre + side * np.expm1(logarithm)) - top + drop

        return (
            side * np.inf
            if inside(-_FLATTEST) > 0
            else centre + side * np.expm1(brentq(inside, 0.0, -_FLATTEST, xtol=1e-9))
        )

    flat = 0.0 if inside_slope(flattest) > 0 else np.exp(brentq(inside_slope, flattest, best, xtol=1e-9))
    steep = np.exp(brentq(inside_slope, best, steepest, xtol=1e-9))
    return np.array([end(-1), end(1)]), np.array([flat, steep])
