"""Search for the maxima of a likelihood from many starts, by the package's BFGS or by optax and optimistix.

Optimisers of other libraries take their steps side by side, in one compiled program, until each reports convergence.
Like the package's BFGS, they return the paths of all starts.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrock._core.arrays import shown, to_device
from jaxrock._core.types import Real
from jaxrock.compiler.hints import jit_low_effort
from jaxrock.inverse.unknowns import Evaluator, Problem
from jaxrock.numerics.batched_bfgs import Summits, batched_bfgs

_TOGETHER = 8  # climbers in one call of the compiled program
_STEPS = 300  # largest number of steps of an optimiser
_TOLERANCE = 1e-6  # relative and absolute tolerance at which an optimiser of optax has converged
_PATIENCE, _LEAST = 40, 1e-7  # steps in which the best value must rise by so much; some optimisers never terminate


class Trace(eqx.Module):
    """The paths of a search from many starts; NaN after the end of a path, and where the motion is impossible.

    - `values`: (steps, starts, parameters), in the order of an estimate's `names`, in their units.
    - `log_likelihood`: (steps, starts), with the priors.
    """

    values: Float[Array, "steps starts parameters"]
    log_likelihood: Float[Array, "steps starts"]

    @classmethod
    def of(cls, evaluate: Evaluator, summits: Summits) -> "Trace":
        """Return the trace of the points on the way to summits."""
        assert summits.path is not None
        points, values = summits.path
        parameters = evaluate.problem.parameters(evaluate.places(points))
        return cls(*to_device((np.where(np.isnan(values)[..., None], np.nan, parameters), values)))


def optimizer_or_none(name: str, value: Any) -> Any:
    """Check that an argument is an optimiser of optax, a minimiser of optimistix, or None."""
    if value is None or _is_of_optax(value):
        return value
    import optimistix

    if isinstance(value, optimistix.AbstractMinimiser):
        return value
    said = "be an optax.GradientTransformation or an optimistix.AbstractMinimiser"
    raise ValueError(f"Argument `{name}` must {said}, but is {shown(value)}.")


def _is_of_optax(value: Any) -> bool:
    return not isinstance(value, type) and callable(getattr(value, "update", None)) and hasattr(value, "init")


def summits_of(evaluate: Evaluator, starts: np.ndarray, optimizer: Any = None) -> Summits:
    """Find maxima from many starts by an optimiser; None: the package's batched BFGS."""
    return batched_bfgs(evaluate, starts) if optimizer is None else _Foreign.of(optimizer, evaluate).climbed(starts)


class _Foreign:
    """Climbers that use a minimiser of optimistix, or one of optax wrapped by it."""

    def __init__(self, solver: Any, evaluate: Evaluator):
        self.solver, self.evaluate = solver, evaluate
        self.low, self.high = evaluate.ends

    @classmethod
    def of(cls, optimizer: Any, evaluate: Evaluator) -> "_Foreign":
        import optimistix

        if not isinstance(optimizer, optimistix.AbstractMinimiser):
            import optax

            optimizer = optax.with_extra_args_support(optimizer)
            optimizer = optimistix.OptaxMinimiser(optimizer, rtol=_TOLERANCE, atol=_TOLERANCE)
        return cls(optimizer, evaluate)

    def climbed(self, starts: np.ndarray) -> Summits:
        """Return the summits at which climbers arrive."""
        parts = [self._together(starts[i : i + _TOGETHER]) for i in range(0, len(starts), _TOGETHER)]
        best, arrived = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
        values, _ = self.evaluate(best)
        longest = max(len(part[2]) for part in parts)
        paths = [np.concatenate([_lengthened(np.array(part[i]), longest) for part in parts], axis=1) for i in (2, 3)]
        return Summits(best, values, arrived & np.isfinite(values), (paths[0], paths[1]))

    def _together(self, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray, list, list]:
        """Climb together; return the best points, whether each climber has converged, and all points and values."""
        count, all_points, all_values = len(starts), [], []
        points = jnp.asarray(np.pad(starts, ((0, _TOGETHER - count), (0, 0)), mode="edge"))
        problem, ends = self.evaluate.problem, jnp.asarray(self.evaluate.ends)
        state = _begun(self.solver, problem, ends, points)
        done, arrived = np.zeros(count, bool), np.zeros(count, bool)
        since, top = np.zeros(count, int), np.full(count, -np.inf)
        best = np.array(starts)
        for _ in range(_STEPS):
            points, state, (at, loss), ended = _stepped(self.solver, problem, ends, points, state)
            at, value = np.asarray(at)[:count], -np.asarray(loss)[:count]
            self.evaluate.note(self.evaluate.places(at), value)
            all_points.append(np.where(done[:, None], np.nan, at))
            all_values.append(np.where(done | ~np.isfinite(value), np.nan, value))
            gained = np.where(np.isfinite(value), value, -np.inf) > top + _LEAST
            better = (value > top) & ~done
            best[better], top[better] = at[better], value[better]
            since = np.where(gained, 0, since + 1)
            newly = ~done & (np.asarray(ended)[:count] | (since >= _PATIENCE))
            arrived |= newly
            done |= newly
            if done.all():
                break
        return best, arrived, all_points, all_values


def _lengthened(path: np.ndarray, steps: int) -> np.ndarray:
    return np.pad(path, ((0, steps - len(path)), *((0, 0),) * (path.ndim - 1)), constant_values=np.nan)


def _loss_of(problem: Problem, ends: Real):
    """Return the loss at a point; its auxiliary data repeat point and loss, because a step may end elsewhere."""

    def loss(point, _):
        low, high = ends
        value = -problem.log_density(low + (high - low) * (1 + jnp.sin(point)) / 2)
        return value, (point, value)

    return loss


def _each(function):
    """Vectorise a function of one climber's point and state over many climbers."""
    return eqx.filter_vmap(function, in_axes=eqx.if_array(0), out_axes=eqx.if_array(0))


@jit_low_effort(eqx.filter_jit, follows_scenes=True)
def _begun(solver, problem: Problem, ends: Real, points: Real):
    loss = _loss_of(problem, ends)

    def one(point):
        value, aux = jax.eval_shape(loss, point, None)
        return solver.init(loss, point, None, {}, value, aux, frozenset())

    return _each(one)(points)


@jit_low_effort(eqx.filter_jit, follows_scenes=True)
def _stepped(solver, problem: Problem, ends: Real, points: Real, state):
    loss = _loss_of(problem, ends)

    def one(point, state):
        new, state, aux = solver.step(loss, point, None, {}, state, frozenset())
        ended, _ = solver.terminate(loss, new, None, {}, state, frozenset())
        return new, state, aux, ended

    return _each(one)(points, state)
