"""The log-density of a motion given rocks, as a function for optimisers and samplers of any library."""

from collections.abc import Callable, Mapping
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Inexact

from jaxrock._arguments.annotations import arguments, at_least
from jaxrock._core.arrays import as_real, check_shapes
from jaxrock._core.settings import called_by_users
from jaxrock._core.types import Real
from jaxrock.compiler.hints import jit_low_effort
from jaxrock.engines.stepper import AbstractEngine
from jaxrock.inverse.likelihood import Likelihood
from jaxrock.inverse.observations import Observations
from jaxrock.inverse.scatter import quadrature_accuracy
from jaxrock.inverse.unknowns import Problem, Unknown
from jaxrock.models.equation import AbstractEquation
from jaxrock.models.rigid import Housner


class LogDensity(eqx.Module):
    """Log-density of a motion's unknown parameters, given rocks, over points of the whole real line.

    A logistic function maps coordinate i of a point into the range of parameter i. The share of the range (of the
    range of logarithms, if it is searched in them) is 1/(1 + exp(-x)). `log_density` makes it. It is a pytree, for
    `jit`, `vmap` and derivatives of every order. No point raises an error: impossible motions and NaN have minus
    infinity.
    """

    problem: Problem

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, in the order of coordinates."""
        return self.problem.names

    @called_by_users
    def __call__(self, point: Inexact[ArrayLike, "*batch parameters"]) -> Float[Array, "*batch"]:
        """Return the log-density at points, (..., parameters), with respect to the points, up to a constant.

        Samplers take this function. One call with many points takes less time than `jax.vmap` of calls with one.
        """
        return _at_points(self, self._checked(point), np.array(True))

    @called_by_users
    def objective(self, point: Inexact[ArrayLike, "*batch parameters"]) -> Float[Array, "*batch"]:
        """Return the log-likelihood plus log-prior, which `estimate_motion` maximises.

        It does not depend on the choice of coordinates.
        """
        return _at_points(self, self._checked(point), np.array(False))

    @called_by_users
    def values(self, point: Inexact[ArrayLike, "*batch parameters"]) -> dict[str, Float[Array, "*batch"]]:
        """Return the parameters by name, in their units, at points."""
        return self.problem.values(self.place(self._checked(point)))

    @arguments
    def point(self, values: Mapping[str, ArrayLike]) -> Float[Array, "*batch parameters"]:
        """Return the point of parameters given by name; infinite at the ends of their ranges, NaN outside."""
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
        """Return `count` points spread evenly over the ranges (Halton's sequence): the likelihood has many maxima."""
        from scipy.stats import qmc  # imported here because it takes a third of a second

        share = jnp.asarray(qmc.Halton(len(self.names), seed=seed).random(count), self.problem.ends.dtype)
        return jnp.log(share) - jnp.log1p(-share)

    def _checked(self, point: ArrayLike) -> Real:
        point, size = as_real("point", point), len(self.names)
        if point.shape[-1:] != (size,):
            raise ValueError(f"Argument `point` must end with an axis of {size}, but has shape {point.shape}.")
        return point

    def place(self, point: Real) -> Real:
        """Return the parameters, or their logarithms where these are searched, at points."""
        low, high = self.problem.ends.T
        return low + (high - low) * jax.nn.sigmoid(point)

    def log_volume(self, point: Real) -> Real:
        """Return the log-Jacobian of the coordinates, (...): the log-density less the objective."""
        return jnp.sum(jax.nn.log_sigmoid(point) + jax.nn.log_sigmoid(-point), axis=-1)


@jit_low_effort(eqx.filter_jit, follows_scenes=True)
def _at_points(density: LogDensity, point: Real, by_point: Bool[ArrayLike, ""]) -> Real:
    """Return the log-density or, if not `by_point`, the objective; one compiled program serves both."""
    problem = density.problem
    if point.shape[-1:] != (len(problem.names),):
        raise ValueError(
            f"Argument `point` must end with an axis of {len(problem.names)}, but has shape {point.shape}."
        )
    if point.size == 0:
        return jnp.zeros(point.shape[:-1], point.dtype)
    nowhere = jnp.isnan(point).any(axis=-1)  # a diverged optimiser may step to NaN
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
    """Return the log-density of a motion's parameters, for any optimiser or sampler: recipes in `docs/inverse.md`.

    **Arguments:** as in `estimate_motion`. The state of `motion` and `model` is read at this call.

    **Returns:** a `LogDensity`.

    **Raises:** ValueError for arguments outside their ranges.
    """
    if not unknowns:
        raise ValueError("Argument `unknowns` must name at least one parameter.")
    likelihood = Likelihood(observations, motion, scatter, model, engine, lapse, accuracy=accuracy)
    return LogDensity(Problem(likelihood, dict(unknowns)).current())
