"""Calibrate blocks from verdicts under known motions: slenderness, size, restitution and their scatter.

The verdict of a single scene jumps, and its margin has slopes up to 1e15 after a long record. The fit therefore uses
the share of a parameter's distribution that topples. Scenes are computed once, on a grid over the parameters. Each
cell has the weight of its probability, which makes the sum smooth in the distribution's median and scatter.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxrock._arguments.annotations import arguments, at_least, known, list_of
from jaxrock._arguments.ranges import Range, below_one, share, whole
from jaxrock._arguments.tables import AbstractTable, Column
from jaxrock._core.arrays import Values, as_real, shown
from jaxrock._core.settings import called_by_users
from jaxrock.compiler.hints import jit_low_effort
from jaxrock.engines.stepper import AbstractEngine
from jaxrock.inverse.calibration_grid import LEAST_SEEN, Axis, Table, blocks_of_cells, model_of_cells, weighed
from jaxrock.inverse.unknowns import Unknown
from jaxrock.models.equation import AbstractEquation
from jaxrock.models.rigid import Housner
from jaxrock.motions.motion import AbstractMotion
from jaxrock.motions.suite import Suite
from jaxrock.status import Enumeration, item
from jaxrock.studies.suite_scenes import scenes_of_suite

_LEAST_BEND = 1e-8  # least curvature of the likelihood, in squared ranges; anything smaller is rounding
_deviation = Range("be in (0, 1]", 0.0, 1.0, lambda x: (x > 0) & (x <= 1))
_STARTS = 6  # grid points from which the likelihood is maximised


class CalibrationStatus(Enumeration):
    """Result code of a calibration; `CalibrationStatus[found.status]` is the message."""

    successful = item(
        "A maximum of the likelihood lies within the ranges: the highest that was found from the best points of a net."
    )
    at_an_end = item(
        "The likelihood is largest at an end of a range: standard errors do not hold. Widen it, or accept it."
    )
    not_told = item(
        "The likelihood is flat: tests leave a parameter open, and its standard error is infinite. Tests that end "
        "either way near where it decides, a prior, or its value would tell it."
    )
    not_converged = item("No climb from the best points of a net reached a maximum of the likelihood.")


class BlockCalibration(AbstractTable):
    """The result of `calibrate_block`.

    - `values`: the most probable values by name. A parameter with scatter has its median, and the scatter as `name_sd`.
    - `covariance`: of the parameters in this order (of the logarithms where the `Unknown` is `log`). It is the inverse
      of the observed information. `standard_errors`, by name, are infinite where one would be larger than the range,
      and NaN where there is no maximum.
    - `log_likelihood`: at the maximum, with the priors except for their constants.
    - `probability`: (tests,) probability of toppling in each test, with undecided scenes by their share. `bounds`:
      (2, tests) this probability if all undecided scenes stood, and if all toppled.
    - `held_out`: (tests,) probability of toppling from fits to the tests of other motions; NaN where `folds` was 0.
    - `status`: a `CalibrationStatus`.
    """

    values: dict[str, Float[Array, ""]]
    covariance: Float[Array, "terms terms"]
    log_likelihood: Float[Array, ""]
    probability: Float[Array, " tests"]
    bounds: Float[Array, "2 tests"]
    held_out: Float[Array, " tests"]
    toppled: Float[Array, " tests"]
    status: CalibrationStatus
    problem: "_Problem"

    @property
    def _columns(self):
        return {
            "parameter": Column(("parameter",), np.array([*self.values])),
            "value": Column(("parameter",), np.array([*self.values.values()]), "that of the parameter"),
            "standard_error": Column(("parameter",), jnp.sqrt(jnp.diag(self.covariance)), "that of its place"),
            "log_likelihood": Column((), self.log_likelihood),
            "status": Column((), self.status),
        }

    @property
    def standard_errors(self) -> dict[str, Float[Array, ""]]:
        """Standard errors by name: of logarithms where the `Unknown` is `log`, of the parameters elsewhere."""
        return dict(zip(self.values, jnp.sqrt(jnp.diag(self.covariance))))

    @called_by_users
    def log_density(self, values: Mapping[str, ArrayLike]) -> Float[Array, ""]:
        """Return the log-likelihood plus log-prior at values by name: smooth, for JAX optimisers and samplers.

        **Raises:** ValueError for other names.
        """
        if not isinstance(values, Mapping) or set(values) != set(self.problem.unknowns):
            raise ValueError(f"Argument `values` must have the names {sorted(self.problem.unknowns)}.")
        return _density(self.problem, {name: as_real(name, values[name]) for name in self.problem.unknowns})

    def auc(self, held_out: bool = False) -> float:
        """Share of pairs of a toppled and a standing test in which the first is more probable; NaN without pairs."""
        chosen, toppled = np.asarray(self.held_out if held_out else self.probability), np.asarray(self.toppled)
        fell, stood = (chosen[(toppled == way) & np.isfinite(chosen)] for way in (1, 0))
        if not fell.size or not stood.size:
            return float("nan")
        places = np.searchsorted(np.sort(stood), fell, side="left"), np.searchsorted(np.sort(stood), fell, side="right")
        return float(np.mean(places[0] + places[1]) / (2 * stood.size))

    @arguments
    def curve(self, bins: Annotated[int, at_least(2, 1000)] = 10, held_out: bool = False) -> dict[str, np.ndarray]:
        """Return the calibration curve: tests ordered by probability, in bins of about equal counts.

        **Arguments:**

        - `bins`: number of bins; `held_out`: whether to use the fits to other motions.

        **Returns:** columns tests (their number), probability (its mean), toppled (share that toppled).
        """
        chosen = np.asarray(self.held_out if held_out else self.probability)
        known = np.flatnonzero(np.isfinite(chosen) & (np.asarray(self.toppled) >= 0))
        parts = [part for part in np.array_split(known[np.argsort(chosen[known])], bins) if part.size]
        toppled = np.asarray(self.toppled)
        return {
            "tests": np.array([part.size for part in parts]),
            "probability": np.array([chosen[part].mean() for part in parts]),
            "toppled": np.array([toppled[part].mean() for part in parts]),
        }

    @arguments
    def disagreeing(self, probability: ArrayLike = 0.05, held_out: bool = False) -> np.ndarray:
        """Return the indices of tests whose outcome had less than this probability, the least probable first.

        **Raises:** ValueError for a probability outside [0, 1].
        """
        most = float(share("probability", probability))
        chosen, toppled = np.asarray(self.held_out if held_out else self.probability), np.asarray(self.toppled)
        as_it_was = np.where(toppled == 1, chosen, 1 - chosen)
        order = np.argsort(as_it_was)
        return order[(as_it_was[order] < most) & (toppled[order] >= 0)]


class _Problem(eqx.Module):
    """The likelihood over coordinates: the unknowns, and the table of scenes computed on the grid."""

    unknowns: dict[str, Unknown]
    axes: dict[str, Axis]
    table: Table
    lapse: float = eqx.field(static=True)

    @property
    def ends(self):
        return jnp.stack([unknown.ends for unknown in self.unknowns.values()])

    def place(self, name: str, value):
        return jnp.log(value) if self.unknowns[name].log else value

    def values(self, places) -> dict:
        named = zip(self.unknowns.items(), places)
        return {name: jnp.exp(x) if unknown.log else x for (name, unknown), x in named}

    def probabilities(self, places, shares):
        """Return the probability of toppling in each test; `shares`, (tests, cells...), are those that topple."""
        values = self.values(places)
        found = weighed(shares, [axis.weights(values, name) for name, axis in self.axes.items()])
        return self.lapse / 2 + (1 - self.lapse) * found

    def terms(self, places):
        """Return the log-likelihood of each test."""
        table = self.table
        p = jnp.clip(self.probabilities(places, table.toppled), 1e-12, 1 - 1e-12)
        verdicts = jnp.where(table.seen == 1, jnp.log(p), jnp.where(table.seen == 0, jnp.log1p(-p), 0.0))
        if table.density is None:
            return verdicts
        values = self.values(places)
        density = weighed(table.density, [axis.weights(values, name) for name, axis in self.axes.items()])
        return jnp.where(table.has_rotation, jnp.log((1 - self.lapse) * density + self.lapse), verdicts)

    def log_density(self, places, weights=None):
        prior = sum(unknown.log_prior(x) for unknown, x in zip(self.unknowns.values(), places))
        terms = self.terms(places)
        return jnp.sum(terms if weights is None else weights * terms) + prior


@arguments
def calibrate_block(
    block: Callable,
    motions: Suite | Annotated[Sequence[AbstractMotion], list_of(AbstractMotion, "motions")],
    toppled: Values,
    unknowns: Mapping[str, Unknown],
    scatter: Mapping[str, Unknown | float],
    model: AbstractEquation = Housner(),
    *,
    rotation: Values | None = None,
    rotation_sd: Annotated[float, known(_deviation)] = 0.3,
    facing: Values = 0,
    cells: Mapping[str, int] | Annotated[int, at_least(8, 4096)] = 64,
    lapse: Annotated[float, known(below_one)] = 0.01,
    groups: Sequence | None = None,
    folds: Annotated[int, at_least(0, 1000)] = 0,
    engine: AbstractEngine | None = None,
    progress: bool | None = None,
) -> BlockCalibration:
    """Find slenderness, size or restitution of a block, and their scatter, from outcomes under known motions.

    **Arguments:**

    - `block`: function that makes a `Block` or `AsymmetricBlock` from the unknown parameters by name, such as
      `lambda alpha: rk.Block(alpha, 3.0)`, or `rk.Block`.
    - `motions`: (tests,) motions as scaled in each test: a `Suite`, or a list from which one can be made.
    - `toppled`: (tests,) 1 toppled, 0 stood, -1 not known.
    - `unknowns`: an `Unknown` for each parameter (of the model: "model.edge.radius"): its value, or median over tests.
    - `scatter`: for parameters that differ from test to test (set-up of a rock, its base): the standard deviation of
      the logarithm (of the parameter itself where its `Unknown` is not `log`), a number or an `Unknown`. At least one
      parameter must have scatter.
    - `model`, `engine`, `progress`: as in `rocking_spectrum`.
    - `rotation`: (tests,) peak rotation over slenderness of a block that stood, 0 if it was not seen to move (below
      0.01), NaN where only the verdict is known.
    - `rotation_sd`: standard deviation of the logarithm of `rotation`, in (0, 1], from measurement and model error.
    - `facing`: 1 if motion and block have the same positive direction in a test, -1 if not, 0 not known: one number or
      (tests,). It has no effect on a symmetric block.
    - `cells`: number of grid cells over each parameter, one number or by name; the scenes are their product. With
      scatter the grid extends 2.5 of the largest deviation beyond the range, without it to the ends of the range. It is
      limited to 0.9 rad for `alpha`, `alpha1` and `alpha2`, and to 0 and 1 for `restitution`.
    - `lapse`: share of tests that end either way whatever the block is, so that one odd test cannot decide the fit.
    - `groups`: (tests,) labels of motions for cross-validation, such as the record that was scaled; None: each test.
    - `folds`: number of parts into which the groups are divided for cross-validation; 0: no cross-validation.

    **Returns:** a `BlockCalibration`.

    **Raises:** ValueError for arguments outside their ranges, or that do not go together.

    **Source:** Purvance, Anooshehpoor & Brune (2008), probabilities of toppling; the mixture is an integral over cells.
    """
    suite = motions if isinstance(motions, Suite) else Suite(motions)
    axes = _axes(unknowns, scatter, cells)
    places = {**unknowns, **{f"{name}_sd": each for name, each in scatter.items() if isinstance(each, Unknown)}}
    places = {name: places[name] for name in sorted(places)}  # as JAX orders what a program is given
    seen, ways, told = _tests(len(suite), toppled, facing, rotation)
    lanes, varied, dealt = blocks_of_cells(block, axes), model_of_cells(model, axes), _dealt(groups, len(suite), folds)
    signs = np.array([1.0, -1.0]) if (ways <= 0).any() else np.array([1.0])
    found = scenes_of_suite(lanes, suite, signs, model, engine, progress, varied)
    table = Table.of(found, seen, ways, told, rotation_sd, tuple(axis.count for axis in axes.values()))
    problem = _Problem(places, axes, table, lapse)
    return _fitted(problem, dealt)


def _axes(unknowns, scatter, cells) -> dict[str, Axis]:
    if not isinstance(unknowns, Mapping) or not unknowns or not all(isinstance(x, Unknown) for x in unknowns.values()):
        raise ValueError(f"Argument `unknowns` must hold an `Unknown` by name, but is {shown(unknowns)}.")
    if not isinstance(scatter, Mapping) or not scatter or not set(scatter) <= set(unknowns):
        raise ValueError(f"Argument `scatter` must hold one or more of {sorted(unknowns)}, but is {shown(scatter)}.")
    for name, each in scatter.items():
        if isinstance(each, bool) or not isinstance(each, (Unknown, int, float)):
            raise ValueError(f"Argument `scatter` must hold numbers or `Unknown`s, but holds {shown(each)}.")
        if not (float(each.low) if isinstance(each, Unknown) else each) > 0:
            raise ValueError(f"Argument `scatter` must be positive, but is {shown(each)} for {name!r}.")
    if isinstance(cells, Mapping) and not set(cells) <= set(unknowns):
        raise ValueError(f"Argument `cells` must have some of the names {sorted(unknowns)}, but has {sorted(cells)}.")
    counts = cells if isinstance(cells, Mapping) else dict.fromkeys(unknowns, cells)
    counts = {name: whole("cells", count, 8, 4096) for name, count in counts.items()}
    return {
        name: Axis.of(name, each, scatter.get(name), counts.get(name, 64)) for name, each in sorted(unknowns.items())
    }


def _tests(count: int, toppled, facing, rotation) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return the checked outcomes, orientations and rotations of the tests; the last is None if not given."""

    def of_tests(name, value, allowed):
        array = np.asarray(as_real(name, np.asarray(value, float) if np.asarray(value).dtype == bool else value), float)
        if array.shape not in ((), (count,)) or not np.isin(array, allowed).all():
            said = f"hold {', '.join(map(str, allowed))} for each of {count} tests"
            raise ValueError(f"Argument `{name}` must {said}, but is {shown(value)}.")
        return np.broadcast_to(array, (count,))

    seen, ways = of_tests("toppled", toppled, (1, 0, -1)), of_tests("facing", facing, (1, 0, -1))
    if rotation is None:
        return seen, ways, None
    told = np.asarray(as_real("rotation", rotation), float)
    if told.shape != (count,) or not (np.isnan(told) | (told == 0) | (told >= LEAST_SEEN)).all():
        raise ValueError(f"Argument `rotation` must hold 0, {LEAST_SEEN} or more, or NaN for each of {count} tests.")
    if (np.isfinite(told) & (seen == 1)).any():
        raise ValueError("Argument `rotation` must be NaN for tests that toppled.")
    return seen, ways, told


def _numbered(labels) -> np.ndarray:
    """Return an integer for each label, the same for equal labels."""
    return np.unique([str(label) for label in np.atleast_1d(np.asarray(labels, object))], return_inverse=True)[1]


def _dealt(groups, count: int, folds: int) -> np.ndarray | None:
    """Return the number of the fold in which each test is held out; None without folds."""
    labels = np.arange(count) if groups is None else _numbered(groups)
    if labels.shape != (count,):
        raise ValueError(f"Argument `groups` must hold a label for each of {count} tests, but has {labels.shape}.")
    number = int(labels.max()) + 1
    if folds and (folds < 2 or folds > number):
        raise ValueError(f"Argument `folds` must be 0, or from 2 to the {number} groups, but is {folds}.")
    return np.random.default_rng(0).permutation(number)[labels] % folds if folds else None


def _fitted(problem: _Problem, part: np.ndarray | None) -> BlockCalibration:
    """Fit the most probable coordinates with their errors, and the held-out probabilities by cross-validation."""
    place, converged = climbed(problem, _starts(problem))
    ends = np.asarray(problem.ends)
    covariance, good = _errors(np.asarray(_hessian(problem, jnp.asarray(place))), np.ptp(ends, axis=1))
    at_end = np.any(
        (place - ends[:, 0] < 1e-4 * np.ptp(ends, axis=1)) | (ends[:, 1] - place < 1e-4 * np.ptp(ends, axis=1))
    )
    status = CalibrationStatus.successful if good and converged else CalibrationStatus.not_converged
    status = CalibrationStatus.not_told if np.isinf(covariance).any() else status
    status = CalibrationStatus.at_an_end if at_end else status
    table = problem.table
    held_out = np.full(table.seen.shape, np.nan)
    if part is not None:
        for number in range(int(part.max()) + 1):
            other, _ = climbed(problem, [place], (part != number).astype(float))
            held_out[part == number] = np.asarray(_probabilities(problem, other, table.toppled))[part == number]
    bounds = [_probabilities(problem, place, shares) for shares in (table.lower, table.upper)]
    height, _ = _value(problem, place, np.ones(len(table.seen)))
    return BlockCalibration(
        problem.values(jnp.asarray(place)), jnp.asarray(covariance), height,
        _probabilities(problem, place, table.toppled), jnp.stack(bounds), jnp.asarray(held_out), table.seen, status,
        problem,
    )  # fmt: skip


def _errors(hessian: np.ndarray, extents: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return the covariance of the coordinates, and whether they are at a maximum.

    A direction whose curvature is within 1 of zero, in squared ranges, is flat. A parameter whose standard error
    exceeds its range is not identified: its variance is infinite, and its covariances are NaN.
    """
    bends, directions = np.linalg.eigh(-hessian * np.outer(extents, extents))
    if not np.all(bends > -1):
        return np.full_like(hessian, np.nan), False
    covariance = directions / np.maximum(bends, _LEAST_BEND) @ directions.T
    open_ones = np.diag(covariance) > 1
    covariance[open_ones] = covariance[:, open_ones] = np.nan
    covariance[open_ones, open_ones] = np.inf
    return covariance * np.outer(extents, extents), True


def _starts(problem: _Problem) -> list[np.ndarray]:
    """Return the best points of a regular grid over the ranges."""
    ends = np.asarray(problem.ends)
    side = max(2, int(600 ** (1 / len(ends))))
    shares = [(np.arange(min(side, 24)) + 0.5) / min(side, 24)] * len(ends)
    net = np.stack([x.ravel() for x in np.meshgrid(*shares, indexing="ij")], axis=1)
    points = ends[:, 0] + net * np.ptp(ends, axis=1)
    heights = np.asarray(_heights(problem, jnp.asarray(points)))
    return [points[k] for k in np.argsort(-heights)[:_STARTS]]


def climbed(problem: _Problem, starts: list[np.ndarray], weights=None) -> tuple[np.ndarray, bool]:
    """Maximise within the ranges from each start; return the best coordinates, and whether the search converged."""
    from scipy.optimize import minimize

    ends = np.asarray(problem.ends)
    # Weights of 1 in place of None, so that one compiled program serves both.
    weights = np.ones(len(problem.table.seen)) if weights is None else weights

    def down(place):
        value, slope = _value(problem, place, weights)
        return -float(value), -np.asarray(slope)

    settings = {"jac": True, "method": "L-BFGS-B", "bounds": ends, "options": {"ftol": 1e-13, "gtol": 1e-7}}
    found = [minimize(down, start, **settings) for start in starts]
    best = min(found, key=lambda each: each.fun)
    return best.x, bool(best.success) or float(np.abs(best.jac).max()) < 1e-3


@jit_low_effort(follows_scenes=True)
def _density(problem, values):
    return problem.log_density(jnp.stack([problem.place(name, values[name]) for name in problem.unknowns]))


@jit_low_effort(follows_scenes=True)
def _heights(problem, points):
    return jax.lax.map(problem.log_density, points)


@jit_low_effort(follows_scenes=True)
def _value(problem, place, weights):
    return jax.value_and_grad(lambda x: problem.log_density(x, weights))(place)


@jit_low_effort(follows_scenes=True)
def _probabilities(problem, place, shares):
    return problem.probabilities(place, shares)


@jit_low_effort(follows_scenes=True)
def _hessian(problem, place):
    return jax.hessian(problem.log_density)(place)
