"""Unknown parameters of a motion, their ranges and priors, and the likelihood over them."""

from collections.abc import Callable
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxrock._arguments.annotations import arguments, pair
from jaxrock._arguments.ranges import finite, positive, scalar
from jaxrock._arguments.repr import described
from jaxrock._core.arrays import shown
from jaxrock._core.types import Real
from jaxrock.compiler.hints import jit_low_effort
from jaxrock.inverse.batches import in_batches
from jaxrock.inverse.likelihood import Likelihood
from jaxrock.inverse.observations import Flags
from jaxrock.inverse.scatter import Quadrature

_LANES = 4  # points in one call of the compiled program with slopes
_SCANNED = 64  # points in one call of the program without slopes
_FARTHEST = 5.0  # largest distance of a prior from its range, in standard deviations; more suggests a mistake


class Unknown(eqx.Module):
    """An unknown parameter: its range and prior.

    **Arguments:**

    - `low`, `high`: the range, in the unit of the parameter; positive if `log`.
    - `log`: whether the search, and a uniform prior, are in the logarithm of the parameter (default) or in itself.
    - `prior`: median and standard deviation of a normal prior on the logarithm (or on itself). None: a uniform prior,
      with which the fit is that of maximum likelihood.

    **Raises:** ValueError for values outside their ranges, and for a prior more than five standard deviations away from
    the range.
    """

    __repr__ = described

    low: Real
    high: Real
    prior: tuple[Real, Real] | None
    log: bool = eqx.field(static=True)

    @arguments
    def __init__(
        self,
        low: ArrayLike,
        high: ArrayLike,
        log: bool = True,
        prior: Annotated[tuple[ArrayLike, ArrayLike] | None, pair] = None,
    ):
        check = positive if log else finite
        self.low, self.high = (scalar(name, check(name, x)) for name, x in (("low", low), ("high", high)))
        if not self.low < self.high:
            raise ValueError(f"Argument `high` must be above `low`, but is {high} with {low}.")
        self.log = log
        self.prior = (
            None
            if prior is None
            else (
                scalar("prior[0]", check("prior[0]", prior[0])),
                scalar("prior[1]", positive("prior[1]", prior[1])),
            )
        )
        if prior is not None and not _FARTHEST >= self._away:
            given = f"{prior} with a range of {low} to {high}"
            raise ValueError(f"Argument `prior` must be within five standard deviations of the range, but is {given}.")

    @property
    def ends(self) -> Float[Array, "2"]:
        """Both ends of the range, as logarithms if `log`."""
        ends = jnp.stack([self.low, self.high])
        return jnp.log(ends) if self.log else ends

    @property
    def _prior(self) -> tuple[Real, Real]:
        assert self.prior is not None
        return self.prior

    @property
    def _middle(self) -> Real:
        """Coordinate of the prior's median."""
        median, _ = self._prior
        return jnp.log(median) if self.log else median

    @property
    def _away(self) -> Real:
        """Distance of the range from the prior's median, in standard deviations of the prior."""
        low, high = self.ends
        return jnp.maximum(low - self._middle, self._middle - high) / self._prior[1]

    def log_prior(self, place: Real) -> Real:
        """Return the logarithm of the prior's density at a place in the range, up to a constant."""
        if self.prior is None:
            return jnp.zeros_like(place)
        return -(((place - self._middle) / self.prior[1]) ** 2) / 2


class Problem(eqx.Module):
    """A likelihood and its unknown parameters; a place holds their logarithms, or the parameters themselves."""

    likelihood: Likelihood
    unknowns: dict[str, Unknown]

    def __check_init__(self):
        for name, unknown in self.unknowns.items():
            if not isinstance(unknown, Unknown):
                said = f"hold an `Unknown` for {shown(name)}, but holds {shown(unknown)}"
                raise ValueError(f"Argument `unknowns` must {said}.")

    @property
    def names(self) -> tuple[str, ...]:
        """The unknown parameters, in the order of coordinates."""
        return tuple(self.unknowns)

    @property
    def ends(self) -> Float[Array, "parameters 2"]:
        """Ranges of the places: logarithms of parameters, or parameters themselves."""
        return jnp.stack([unknown.ends for unknown in self.unknowns.values()])

    def current(self) -> "Problem":
        """Return the problem with the current state of motion and model."""
        return eqx.tree_at(lambda problem: problem.likelihood, self, self.likelihood.current(self.names))

    def values(self, places: Real) -> dict[str, Real]:
        """Return the parameters at places, by name."""
        return {
            name: jnp.exp(places[..., i]) if unknown.log else places[..., i]
            for i, (name, unknown) in enumerate(self.unknowns.items())
        }

    def parameters(self, places: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Return the parameters at concrete places, (..., parameters), by NumPy, which compiles nothing."""
        logs = np.array([unknown.log for unknown in self.unknowns.values()])
        return np.where(logs, np.exp(np.where(logs, places, 0.0)), places)

    def log_prior(self, places: Real) -> Real:
        """Return the logarithm of the prior's density at places, (..., parameters), up to a constant."""
        priors = [unknown.log_prior(places[..., i]) for i, unknown in enumerate(self.unknowns.values())]
        return sum(priors[1:], start=priors[0])

    def log_density(self, places: Real, slopes: bool = True, wanted: Flags | None = None) -> Real:
        """Return log-likelihood plus log-prior, a density over places, at the `wanted` places, (..., parameters).

        It has derivatives if `slopes`.
        """
        terms = self.likelihood.terms(self.values(places), slopes, wanted)
        return jnp.sum(terms, axis=-1) + self.log_prior(places)


@jit_low_effort(eqx.filter_jit, follows_scenes=True)
def _batch(problem: Problem, places: Real, wanted: Flags) -> tuple[Real, Real, tuple[Real, Real, Real, Real, Real]]:
    def density(places):
        terms, facts = problem.likelihood.terms_and_facts(problem.values(places), wanted)
        return jnp.sum(terms, axis=-1) + problem.log_prior(places), facts

    # Each value depends on its own place alone, so that the gradient of the sum holds the slopes of all values.
    value, back, facts = jax.vjp(density, places, has_aux=True)
    return value, back(jnp.ones_like(value))[0], facts


@jit_low_effort(eqx.filter_jit, follows_scenes=True)
def _log_density(problem: Problem, places: Real, wanted: Flags) -> Real:
    return problem.log_density(places, slopes=False, wanted=wanted)


def densities(problem: Problem, places: np.ndarray, progress: Callable[[int], None] = lambda more: None) -> np.ndarray:
    """Return log-densities (n,) of a `current` problem at any places, (n, parameters), without slopes.

    They are minus infinity outside of the domain.
    """
    (found,) = in_batches(lambda *part: [_log_density(problem, *part)], places, _SCANNED, progress)
    return np.where(np.isnan(found), -np.inf, found)


class Evaluator:
    """Evaluates values and slopes at any number of points, in batches of one compiled program, and counts them.

    Points are angles, with places at low + (high - low) (1 + sin angle)/2. Every point is allowed. A maximum at the end
    of a range is an ordinary one, where the slope vanishes and the curvature does not.
    """

    def __init__(self, problem: Problem, progress: Callable[[int], None] = lambda more: None):
        self.problem, self.count, self.progress = problem.current(), 0, progress
        self._coarse = eqx.tree_at(lambda it: it.likelihood.quadrature, self.problem, Quadrature.coarse())
        self.ends = np.asarray(problem.ends).T
        self.scanned = np.empty((0, len(problem.names))), np.empty(0)
        self.known = np.empty((0, len(problem.names))), np.empty(0)  # places and values of all evaluations with slopes

    def __call__(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        values, slopes = self.at(self.places(points))
        low, high = self.ends
        return values, slopes * (high - low) * np.cos(points) / 2

    def at(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return values at places, and slopes by the places."""
        values, slopes = in_batches(lambda *part: _batch(self.problem, *part)[:2], places, _LANES, self.progress)
        self.note(places, values)
        return values, slopes

    def scan(self, places: np.ndarray) -> np.ndarray:
        """Return approximate log-likelihoods at places, by few scenes and without slopes."""
        values = densities(self._coarse, places, self.progress)
        self.scanned = np.concatenate([self.scanned[0], places]), np.concatenate([self.scanned[1], values])
        return values

    @property
    def scenes(self) -> int:
        """Number of scenes computed so far."""
        few, many = (problem.likelihood.scenes for problem in (self._coarse, self.problem))
        return few * len(self.scanned[1]) + many * self.count

    def note(self, places: np.ndarray, values: np.ndarray) -> None:
        """Count and store values at places that the caller has computed."""
        self.count += len(places)
        self.known = np.concatenate([self.known[0], places]), np.concatenate([self.known[1], values])

    @property
    def lowest(self) -> float:
        """The lowest finite value so far."""
        return float(np.min(self.known[1], initial=np.inf, where=np.isfinite(self.known[1])))

    def facts(self, place: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return `survival`, share of scenes computed, and `surprise` of the likelihood at a place, (rocks,) each."""
        self.count += 1
        return tuple(x[0] for x in in_batches(lambda *part: _batch(self.problem, *part)[2], place[None], _LANES))

    def errors(self, place: np.ndarray) -> tuple[np.ndarray, float]:
        """Estimate the standard errors of the quadrature at a place.

        **Returns:** errors of the probabilities that rocks stand, (rocks,), and of the log-likelihood.
        """

        def found(problem):
            value, _, facts = _batch(problem, np.tile(place, (_LANES, 1)), np.arange(_LANES) < 1)
            return np.asarray(value)[0], np.asarray(facts[0])[0]

        drawn = self.problem.likelihood.drawn()
        self.count += len(drawn)
        problems = (eqx.tree_at(lambda problem: problem.likelihood, self.problem, each) for each in drawn)
        values, stands = zip(*map(found, problems))
        return np.std(stands, axis=0, ddof=1), float(np.std(values, ddof=1))

    def places(self, points: np.ndarray) -> np.ndarray:
        """Return the places of points."""
        low, high = self.ends
        return low + (high - low) * (1 + np.sin(points)) / 2

    def points(self, places: np.ndarray) -> np.ndarray:
        """Return the points of places; places outside the ranges are clipped to their ends."""
        low, high = self.ends
        return np.arcsin(np.clip(2 * (places - low) / (high - low) - 1, -1.0, 1.0))
