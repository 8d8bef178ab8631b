"""Fit a block and a motion to a measured history, so that the simulated rotation follows the measured one.

SciPy's least squares starts from many points, with exact derivatives of whole histories by all parameters. A wrong
period puts a simulated history out of phase, and the sum of squares has a minimum at every slip by a cycle. The fit
therefore begins with a short window of the data. Longer windows follow, each starting from the preceding minimum.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxrock._arguments.annotations import arguments, at_least, list_of, pair
from jaxrock._arguments.ranges import finite, inner_share, not_negative, positive, scalar
from jaxrock._arguments.tables import AbstractTable, Column
from jaxrock._core.arrays import Values
from jaxrock._core.settings import called_by_users
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.rigid import Block
from jaxrock.engines.stepper import AbstractEngine
from jaxrock.inverse.history_scene import FittedScene, rotation_history
from jaxrock.models.equation import AbstractEquation
from jaxrock.models.rigid import Housner
from jaxrock.motions.motion import AbstractMotion
from jaxrock.numerics.least_squares import Covariance, LeastSquares, Minimum, Progression, covariance, least_squares
from jaxrock.status import Enumeration, item
from jaxrock.studies.parameters import named_of_model, rebuilt_model

_GROWTH = 1.6  # ratio of the lengths of consecutive windows
_WIDE = 0.25  # relative standard error above which a linear model in the parameters no longer describes the data


class HistoryStatus(Enumeration):
    """Result code of a fit to a history; `HistoryStatus[fit.status]` is the message."""

    successful = item("A minimum of the sum of squares was found, and it tells every parameter.")
    not_identified = item(
        "The data do not tell the parameters apart: along some combination of them the standard error is so wide that "
        "intervals mean little. See `warnings` for what is known; fit fewer parameters, or larger rotations."
    )
    not_converged = item(
        "No start came to a minimum of the sum of squares. Better starting values or more starts may help."
    )
    not_simulated = item("No start could be simulated to the end of the data: the numbers are not results.")


class HistoryFit(AbstractTable):
    """The result of `fit_history`; parameters are in the order of `names`.

    - `names`, `values`: of the parameters.
    - `covariance`: (parameters, parameters), for independent errors of the measurement.
    - `robust_covariance`: (parameters, parameters), for errors correlated in time as the residuals are; wider, if they
      are correlated.
    - `scatter`: standard deviation of the measurement [rad]: as given (the root mean square, if there are many), or
      estimated from the residuals.
    - `residuals`: (n,) measured less fitted rotation [rad]; `rotation`: (n,) fitted [rad].
    - `correlation`: of neighbouring residuals [-]; `correlated`: whether it is more than chance.
    - `misfit`: root mean square of residuals over scatter, by degrees of freedom. It is near 1 for a good model, and
      exactly 1 where the scatter was estimated.
    - `agreement`: share of the starts that reached this minimum.
    - `block`, `motion`, `model`, `initial`: the fitted scene, for `simulate`. The motion is at rest if none was given.
    - `status`: a `HistoryStatus`; `warnings`: cautions about the result, in words; empty if there are none.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    values: Float[np.ndarray, " parameters"]
    covariance: Float[np.ndarray, "parameters parameters"]
    robust_covariance: Float[np.ndarray, "parameters parameters"]
    scatter: float
    residuals: Float[np.ndarray, " n"]
    rotation: Float[np.ndarray, " n"]
    correlation: float
    correlated: bool
    misfit: float
    agreement: float
    block: Block | AsymmetricBlock
    motion: AbstractMotion
    model: AbstractEquation
    initial: tuple[float, float]
    status: HistoryStatus
    warnings: tuple[str, ...] = eqx.field(static=True)

    def __getitem__(self, name: str) -> float:
        """Return the estimate of a parameter."""
        if name not in self.names:
            raise KeyError(f"{name!r} is not one of the parameters {', '.join(self.names)}.")
        return float(self.values[self.names.index(name)])

    @called_by_users
    def intervals(self, confidence: float = 0.95, robust: bool | None = None) -> Float[np.ndarray, "parameters 2"]:
        """Return confidence intervals, each for one parameter by itself.

        **Arguments:**

        - `confidence`: in (0, 1).
        - `robust`: whether to use `robust_covariance`; None: use it if residuals are correlated.

        **Returns:** (parameters, 2) lower and upper ends.

        **Raises:** ValueError for a confidence outside its range.

        **Source:** Student (1908), t.
        """
        from scipy.special import stdtrit

        confidence = float(scalar("confidence", inner_share("confidence", confidence)))
        robust = self.correlated if robust is None else robust
        covariance = self.robust_covariance if robust else self.covariance
        t = stdtrit(self.residuals.size - self.values.size, (1 + confidence) / 2)
        half = t * np.sqrt(np.diag(covariance))
        return np.stack([self.values - half, self.values + half], axis=1)

    @property
    def _columns(self):
        intervals = self.intervals()
        own = "that of the parameter"
        return {
            "parameter": Column(("parameter",), self.names),
            "value": Column(("parameter",), self.values, own),
            "standard_error": Column(("parameter",), np.sqrt(np.diag(self.covariance)), own),
            **{name: Column(("parameter",), intervals[:, i], own) for i, name in enumerate(("low", "high"))},
            "scatter": Column((), self.scatter, "rad"),
            "misfit": Column((), self.misfit),
            "status": Column((), self.status),
        }


@arguments
def fit_history(
    time: Values,
    rotation: Values,
    block: Block | AsymmetricBlock,
    motion: AbstractMotion | None = None,
    model: AbstractEquation = Housner(),
    *,
    parameters: Annotated[Sequence[str] | None, list_of(str, "names")] = None,
    initial: Annotated[tuple[float, float] | None, pair] = None,
    scatter: Values | None = None,
    spread: float = 0.2,
    starts: Annotated[int, at_least(1, 10**6)] = 8,
    seed: Annotated[int, at_least(0)] = 0,
    engine: AbstractEngine | None = None,
) -> HistoryFit:
    """Estimate a block, and the motion under it, from a measured history of its rotation.

    **Arguments:**

    - `time`: (n,) times of the measurements from the start of the motion [s], 0 or more and rising.
    - `rotation`: (n,) measured [rad].
    - `block`, `motion`: starting values of fitted parameters, and values of all others; a motion of None is free
      rocking.
    - `model`: as in `outcome`.
    - `parameters`: names of the fitted parameters. None: angles, frequency parameter and restitutions of the block, and
      "initial". Names are:
        - of a block "alpha", "p", "restitution"; of an asymmetric block "alpha1", "alpha2", "p1", "inertia_ratio",
          "radius_ratio", "restitution1", "restitution2"; those of a law of restitution, as "restitution.gentle";
        - those of the motion ("amplitude" [g] also of a record: its peak);
        - those of the model, by where they are, as "model.edge.radius" of `Rolling(0.1)`;
        - "initial" [rad] and "velocity" [rad/s] at time 0;
        - of the measurement its "delay" [s] behind the motion (until then, the block keeps its state at time 0) and its
          "offset" [rad].
    - `initial`: rotation [rad] and angular velocity [rad/s] at time 0, to start from. None: (0, 0) under a motion, the
      first measured rotation without.
    - `scatter`: standard deviation of the errors of measurement [rad], one number or (n,); None: from the residuals.
    - `spread`: relative uncertainty of the starting values, by which starts are scattered.
    - `starts`: number of starts, at least 1; the first has the given values. `seed`: seed of the others.
    - `engine`: as in `outcome`; None: series of order 8 to a tolerance of 1e-10, ample for data.

    **Returns:** a `HistoryFit`. A restitution that is neither fitted nor given follows the angles.

    **Raises:** ValueError for arguments outside their ranges, or names that the scene does not have.

    **Source:** Branch, Coleman & Li (1999), by SciPy; Brockwell & Davis (1991), 8.1, correlated residuals.
    """
    if np.size(rotation) == 0:
        raise ValueError("Argument `rotation` must hold measurements, but is empty.")
    spread = float(scalar("spread", positive("spread", spread)))
    scene = FittedScene.of(block, motion, model, parameters, initial, rotation, engine)
    time, rotation, weight = _data(time, rotation, scatter, 2 * len(scene.names))
    places = np.arange(time.size)

    def at(point: np.ndarray, samples: int):
        """Return weighted residuals and their derivatives in a window of the data."""
        fitted, slopes, known = map(np.asarray, rotation_history(jnp.asarray(point), time, time[samples - 1], scene))
        inside = np.where(places < samples, weight, 0.0)
        residuals = np.where(inside > 0, (rotation - fitted) * inside, 0.0)
        return np.where(known, residuals, np.inf), -slopes * inside[:, None]

    first, scale, lower, upper = scene.coordinates()
    if not ((lower < first) & (first < upper)).all():
        outside = scene.names[int(np.argmin((lower < first) & (first < upper)))]
        raise ValueError(f"Parameter `{outside}` can be fitted only from within its range, not from its end.")
    problem = LeastSquares(at, scale, lower, upper)
    progression = Progression(_windows(time.size, first.size), spread, float(_noise(rotation) * np.median(weight)))
    minimum = least_squares(problem, first, progression, starts, seed)
    found = _fit(scene, minimum, covariance(minimum, scale, scatter is not None), problem, rotation, weight, scatter)
    return replace(found, model=rebuilt_model(model, named_of_model(found.model)))  # with functions as they were given


def _data(time: Values, rotation: Values, scatter: Values | None, least: int):
    """Check the measurements; return times, rotations and weights as arrays of one length."""
    time = np.asarray(not_negative("time", time))
    rotation = np.asarray(finite("rotation", rotation))
    if time.ndim != 1 or time.size <= least:
        raise ValueError(f"Argument `time` must be a list of more than {least} values, but has shape {time.shape}.")
    if not (np.diff(time) > 0).all():
        raise ValueError("Argument `time` must rise from value to value.")
    if rotation.shape != time.shape:
        raise ValueError(f"Argument `rotation` must have the shape {time.shape} of `time`, but has {rotation.shape}.")
    scatter = np.asarray(positive("scatter", 1.0 if scatter is None else scatter))
    if scatter.shape not in ((), time.shape) or not np.isfinite(scatter).all():
        raise ValueError(f"Argument `scatter` must be finite numbers of shape () or {time.shape}.")
    return time, rotation, np.broadcast_to(1 / scatter, time.shape)


def _windows(size: int, count: int) -> tuple[int, ...]:
    """Return the numbers of samples in the windows; the last window holds all."""
    windows = [size]
    while windows[0] / _GROWTH > max(4 * count, size / 40):
        windows.insert(0, int(windows[0] / _GROWTH))
    return tuple(windows)


def _noise(rotation: np.ndarray) -> float:
    """Estimate the size of errors from second differences, in which a smooth history nearly vanishes."""
    size = float(np.median(np.abs(np.diff(rotation, 2))) / (0.6745 * np.sqrt(6)))
    return max(size, 1e-7 * float(np.max(np.abs(rotation))), 1e-300)


def _fit(scene: FittedScene, minimum: Minimum, spread: Covariance, problem, rotation, weight, scatter) -> HistoryFit:
    """Return the result in the units of the data, with its warnings."""
    size = rotation.size
    simulated = bool(np.isfinite(minimum.residuals).all())
    # For independent residuals the correlation of neighbours has the standard deviation size^(-1/2). Residuals of a
    # perfect fit are rounding errors of the engine, whose correlation means nothing.
    real = simulated and np.max(np.abs(minimum.residuals / weight)) > 1e-7 * np.max(np.abs(rotation))
    correlated = real and spread.correlation > max(3 / np.sqrt(size), 0.1)
    values = np.asarray(scene.values(minimum.point))
    by_coordinates = np.where(scene.logarithmic, values, 1.0)
    both = np.outer(by_coordinates, by_coordinates)
    block, motion, model, initial = scene.at(dict(zip(scene.names, jnp.asarray(values))))
    status, warnings = HistoryStatus.not_simulated, []
    if simulated:
        status, warnings = _judged(scene, minimum, spread, problem, correlated, scatter)
    estimated = spread.scatter if scatter is None else float(np.sqrt(np.mean(1 / weight**2)))
    return HistoryFit(
        names=scene.names,
        values=values,
        covariance=both * spread.independent,
        robust_covariance=both * spread.robust,
        scatter=estimated,
        residuals=minimum.residuals / weight,
        rotation=rotation - minimum.residuals / weight,
        correlation=spread.correlation,
        correlated=bool(correlated),
        misfit=1.0 if scatter is None else spread.scatter,
        agreement=minimum.agreement,
        block=block,
        motion=motion,
        model=model,
        initial=(float(initial[0]), float(initial[1])),
        status=status,
        warnings=tuple(warnings),
    )


def _judged(scene: FittedScene, minimum: Minimum, spread: Covariance, problem: LeastSquares, correlated, scatter):
    """Return the status, and warnings in words."""
    size, count = minimum.residuals.size, minimum.point.size
    warnings = []
    used = spread.robust if correlated else spread.independent
    variances, directions = np.linalg.eigh(used / np.outer(problem.scale, problem.scale))
    errors = np.sqrt(np.maximum(variances, 0.0))
    for error, direction in zip(errors, directions.T):
        if error > _WIDE:
            terms = " ".join(
                f"{c:+.2f} {n}" for c, n in zip(direction * np.sign(direction.sum()), scene.names) if abs(c) > 0.05
            )
            warnings.append(
                f"The data hardly tell how far the relative changes {terms} go together: standard error {error:.2g}."
            )
    identified = not warnings
    if correlated:
        warnings.append(
            f"Neighbouring residuals are correlated ({spread.correlation:.2f}): intervals are by `robust_covariance`, "
            "which allows for errors of measurement that last, but not for what the model leaves out."
        )
    if scatter is not None and abs(spread.scatter**2 - 1) > 4 * np.sqrt(2 / (size - count)):
        warnings.append(f"Residuals are {spread.scatter:.3g} times the stated scatter.")
    if minimum.agreement < 0.25:
        warnings.append(f"Only {minimum.agreement:.0%} of the starts came to this minimum: there may be a lower one.")
    margin = np.minimum(minimum.point - problem.lower, problem.upper - minimum.point)
    for name, near in zip(scene.names, margin < np.sqrt(np.diag(used))):
        if near:
            warnings.append(f"`{name}` is at its bound to within its standard error: its interval reaches beyond.")
    # No minimum is reached along a direction that the data do not determine, so that status takes precedence.
    status = HistoryStatus.successful if minimum.converged else HistoryStatus.not_converged
    return status if identified else HistoryStatus.not_identified, warnings
