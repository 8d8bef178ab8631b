"""What rocks say about a motion, as a function for optimisers and samplers of any library."""

from collections.abc import Callable, Mapping
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Inexact

from jaxrock._arguments import arguments, at_least
from jaxrock._checks import as_real, check_shapes
from jaxrock._quickly import quickly
from jaxrock._settings import called_by_users
from jaxrock.engines.stepper import AbstractEngine
from jaxrock.inverse.likelihood import Likelihood, quadrature_accuracy
from jaxrock.inverse.observations import Observations
from jaxrock.inverse.unknowns import Problem, Unknown
from jaxrock.models.equation import AbstractEquation
from jaxrock.models.rigid import Housner

Real = Inexact[Array, "..."]


class LogDensity(eqx.Module):
    """Log-density of a motion's unknown parameters, given rocks, over points of the whole real line.

    Coordinate i of a point leads into the range of parameter i: its share of the range (of the range of logarithms, if
    it is searched in them) is 1/(1 + exp(-x)). Made by `log_density`; a pytree, for `jit`, `vmap` and derivatives of
    every order. Nothing is raised for any point: a motion that there is not, and what is no number, has minus infinity.
    """

    problem: Problem

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters, in the order of coordinates."""
        return self.problem.names

    @called_by_users
    def __call__(self, point: Inexact[ArrayLike, "*batch parameters"]) -> Float[Array, "*batch"]:
        """Log-density of points, (..., parameters), with respect to the points themselves, but for a constant: what a
        sampler takes. Many points at once take less time than `jax.vmap` of one."""
        return _at_points(self, self._checked(point), np.array(True))

    @called_by_users
    def objective(self, point: Inexact[ArrayLike, "*batch parameters"]) -> Float[Array, "*batch"]:
        """Log-likelihood and log-prior: what `estimate_motion` makes as large as it can. It does not depend on the
        coordinates."""
        return _at_points(self, self._checked(point), np.array(False))

    @called_by_users
    def values(self, point: Inexact[ArrayLike, "*batch parameters"]) -> dict[str, Float[Array, "*batch"]]:
        """Parameters by name, in their units, at points."""
        return self.problem.values(self.place(self._checked(point)))

    @arguments
    def point(self, values: Mapping[str, ArrayLike]) -> Float[Array, "*batch parameters"]:
        """The point of parameters by name; infinite at the ends of their ranges, not a number outside."""
        if set(values) != set(self.names):
            raise ValueError(f"Argument `values` must hold {', '.join(self.names)}, but holds {', '.join(values)}.")
        low, high = self.problem.ends.T
        given = [as_real(name, values[name]) for name in self.names]
        check_shapes(**dict(zip(self.names, given)))
        logs = [unknown.log for unknown in self.problem.unknowns.values()]
        place = jnp.stack(jnp.broadcast_arrays(*(jnp.log(x) if log else x for x, log in zip(given, logs))), axis=-1)
        return jnp.log(place - low) - jnp.log(high - place)

    @arguments
    def starts(
        self, count: Annotated[int, at_least(1, 10**6)], seed: Annotated[int, at_least(0)] = 0
    ) -> Float[Array, "count parameters"]:
        """So many points, spread evenly over the ranges (Halton's sequence): the likelihood has many maxima."""
        from scipy.stats import qmc  # it takes a third of a second

        share = jnp.asarray(qmc.Halton(len(self.names), seed=seed).random(count), self.problem.ends.dtype)
        return jnp.log(share) - jnp.log1p(-share)

    def _checked(self, point: ArrayLike) -> Real:
        point, size = as_real("point", point), len(self.names)
        if point.shape[-1:] != (size,):
            raise ValueError(f"Argument `point` must end with an axis of {size}, but has shape {point.shape}.")
        return point

    def place(self, point: Real) -> Real:
        """Parameters, or their logarithms where they are searched in these, at points."""
        low, high = self.problem.ends.T
        return low + (high - low) * jax.nn.sigmoid(point)

    def log_volume(self, point: Real) -> Real:
        """What the log-density has more than the objective: of the coordinates, (...)."""
        return jnp.sum(jax.nn.log_sigmoid(point) + jax.nn.log_sigmoid(-point), axis=-1)


@quickly(eqx.filter_jit, follows_scenes=True)
def _at_points(density: LogDensity, point: Real, by_point: Bool[ArrayLike, ""]) -> Real:
    """The log-density or, not `by_point`, the objective: one program for both."""
    problem = density.problem
    if point.shape[-1:] != (len(problem.names),):
        raise ValueError(
            f"Argument `point` must end with an axis of {len(problem.names)}, but has shape {point.shape}."
        )
    if point.size == 0:
        return jnp.zeros(point.shape[:-1], point.dtype)
    nowhere = jnp.isnan(point).any(axis=-1)  # after a step of an optimiser that has gone astray
    point = jnp.where(nowhere[..., None], 0.0, point)
    value = problem.log_density(density.place(point)) + jnp.where(by_point, density.log_volume(point), 0.0)
    return jnp.where(nowhere, -jnp.inf, value)


@arguments
def log_density(
    observations: Observations,
    motion: Callable,
    unknowns: dict[str, Unknown],
    scatter: ArrayLike = 0.3,
    *,
    lapse: ArrayLike = 0.02,
    accuracy: Annotated[float, quadrature_accuracy] = 0.02,
    model: AbstractEquation = Housner(),
    engine: AbstractEngine | None = None,
) -> LogDensity:
    """The log-density of a motion's parameters, for any optimiser or sampler: recipes in `docs/inverse.md`.

    **Arguments:** as in `estimate_motion`. `motion` and `model` are taken as they are now.

    **Returns:** a `LogDensity`.

    **Raises:** ValueError for arguments outside their ranges.
    """
    if not unknowns:
        raise ValueError("Argument `unknowns` must name at least one parameter.")
    likelihood = Likelihood(observations, motion, scatter, model, engine, lapse, accuracy=accuracy)
    return LogDensity(Problem(likelihood, dict(unknowns)).current())
