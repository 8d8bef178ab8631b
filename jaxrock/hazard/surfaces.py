"""Fragility surfaces: the probability that a rock topples, over peak acceleration and PGV/PGA.

Peak acceleration alone decides whether a block uplifts. The ratio of peak velocity to peak acceleration measures the
duration of the push. Together they explain most of a motion's effect on a rock.
"""

import inspect
from collections.abc import Callable, Sequence
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Inexact, Int8

from jaxrock._arguments.annotations import arguments, list_of, word_of
from jaxrock._arguments.parameters import one_of_many
from jaxrock._arguments.ranges import checked, if_known, inner_share, level, not_negative, positive, scalar
from jaxrock._arguments.repr import described
from jaxrock._core.arrays import Values, check_shapes, shown
from jaxrock._core.one_program import one_program
from jaxrock._core.settings import called_by_users
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.rigid import GRAVITY, Block
from jaxrock.compiler.hints import jit_low_effort
from jaxrock.engines.stepper import AbstractEngine
from jaxrock.hazard.fragility import (
    FitStatus,
    LogNormalFragility,
    TabulatedFragility,
    alike,
    lognormal,
    outcomes,
    rising_list,
)
from jaxrock.hazard.probit import inverse_information, or_separable
from jaxrock.hazard.probit_line import most_clusters, padded_counts, probit, probit_line
from jaxrock.hazard.simulation import SimulatedFragility, counts
from jaxrock.models.equation import AbstractEquation
from jaxrock.models.rigid import Housner
from jaxrock.motions.intensity import peak_acceleration, peak_velocity
from jaxrock.motions.mirrored import scaled_and_mirrored
from jaxrock.motions.motion import AbstractMotion
from jaxrock.responses.current_model import current_model
from jaxrock.responses.outcome import outcome
from jaxrock.studies.suite_scenes import (
    FACINGS,
    STOOD,
    TOPPLED,
    UNDECIDED,
    as_draws,
    both_ways,
    stacked,
    verdict_and_share,
)
from jaxrock.sweeps.sweep import surface


class SurfaceFragility(eqx.Module):
    """A lognormal fragility in peak acceleration whose median follows a power of PGV/PGA.

    P = Phi((ln PGA - ln median(ratio))/dispersion), median(ratio) = median (ratio/1 s)^exponent.

    - `median` [g] at a ratio of 1 s; `exponent` [-], negative as a rule; `dispersion` [-].
    """

    __repr__ = described

    median: Float[Array, ""]
    exponent: Float[Array, ""]
    dispersion: Float[Array, ""]

    @called_by_users
    def __call__(self, acceleration: Values, ratio: Values) -> Inexact[Array, "..."]:
        """Return the probability to topple at peak accelerations [g] and PGV/PGA [s], which broadcast."""
        acceleration, median = if_known(level, "acceleration", acceleration), self._median(ratio)
        check_shapes(acceleration=acceleration, ratio=median)
        return lognormal(acceleration, median, self.dispersion)

    def _median(self, ratio):
        return _power(self.median, positive("ratio", ratio), self.exponent)

    @called_by_users
    def at(self, ratio: ArrayLike) -> LogNormalFragility:
        """Return the fragility in peak acceleration for motions of one PGV/PGA [s]."""
        return LogNormalFragility(self._median(ratio), self.dispersion, "PGA")

    @called_by_users
    def acceleration(self, probability: Values, ratio: Values) -> Inexact[Array, "..."]:
        """Return the peak acceleration [g] at which the rock topples with a probability in (0, 1): a contour."""
        probability, median = inner_share("probability", probability), self._median(ratio)
        check_shapes(probability=probability, ratio=median)
        return _reached(probability, median, self.dispersion)


@one_program
def _power(factor, ratio, exponent):
    return factor * ratio**exponent


@one_program
def _reached(probability, median, dispersion):
    """Return the quantile of a lognormal distribution."""
    return median * jnp.exp(dispersion * jax.scipy.special.ndtri(probability))


class SurfaceFit(eqx.Module):
    """The result of `fit_surface`; where `status` is not `FitStatus.successful`, the numbers of the fit are NaN.

    - `fragility`: the `SurfaceFragility` of largest likelihood.
    - `covariance`: (3, 3) of (ln median, exponent, ln dispersion): the inverse of the observed information, or a
      sandwich of the clusters if these are given.
    - `status`: a `FitStatus`.
    """

    __repr__ = described

    fragility: SurfaceFragility
    covariance: Float[Array, "3 3"]
    status: FitStatus


@arguments
def fit_surface(
    acceleration: Values,
    ratio: Values,
    toppled: Values,
    trials: Values = 1,
    clusters: Sequence | np.ndarray | None = None,
) -> SurfaceFit:
    """Fit the two-measure lognormal fragility under which outcomes are most probable (probit regression).

    **Arguments:**

    - `acceleration`, `ratio`: (n,) peak accelerations [g] and PGV/PGA [s] of the shakings, positive.
    - `toppled`, `trials`: as in `fit_fragility`.
    - `clusters`: (n,) labels; outcomes of one label are not independent, for example those of one record.

    **Returns:** a `SurfaceFit`.

    **Raises:** ValueError for arguments outside their ranges, or of other shapes, and for fewer than two clusters.

    **Source:** the two measures by Purvance, Anooshehpoor & Brune (2008); Liang & Zeger (1986), clusters.
    """
    acceleration, ratio = positive("acceleration", acceleration), positive("ratio", ratio)
    if acceleration.ndim != 1 or acceleration.size < 3 or acceleration.shape != ratio.shape:
        both = f"{acceleration.shape} and {ratio.shape}"
        raise ValueError(f"Arguments `acceleration` and `ratio` must be lists of one length above 2, but are {both}.")
    trials = not_negative("trials", trials)
    if trials.shape not in ((), acceleration.shape):
        raise ValueError(f"Argument `trials` must have shape {acceleration.shape} or (), but has {trials.shape}.")
    acceleration, ratio, trials, toppled = alike(acceleration, ratio, trials, outcomes(toppled, acceleration, trials))
    labels = (
        np.arange(acceleration.size) if clusters is None else np.unique(np.asarray(clusters), return_inverse=True)[1]
    )
    if labels.shape != acceleration.shape:
        raise ValueError(f"Argument `clusters` must have shape {acceleration.shape}, but has shape {labels.shape}.")
    count = int(labels.max()) + 1
    if count < 2:
        raise ValueError("Argument `clusters` must name at least two clusters, but names one.")
    both, toppled, survived, labels = padded_counts([acceleration, ratio], toppled, trials - toppled, labels)
    acceleration, ratio = both
    fit, scores, measures = _fit(acceleration, ratio, toppled, survived)
    fit = or_separable(fit, measures, toppled, survived)
    if clusters is None:
        return fit
    covariance = _clustered(fit.covariance, scores, labels, count, most_clusters(count))
    return eqx.tree_at(lambda f: f.covariance, fit, covariance)


@jit_low_effort(static_argnames="most")
def _clustered(covariance, scores, labels, count: ArrayLike, most: int) -> Float[Array, "3 3"]:
    summed = jnp.zeros((most, 3)).at[labels].add(scores)
    return covariance @ (summed.T @ summed * count / (count - 1)) @ covariance


@jit_low_effort()
def _fit(acceleration, ratio, toppled, survived):
    """Return the fit, the scores of all outcomes, and the logarithms of the measures.

    Scores are derivatives of the log-likelihood by (ln median, exponent, ln dispersion).
    """
    measures = jnp.log(jnp.stack([acceleration, ratio]))
    centre = jnp.mean(measures, axis=1, keepdims=True)
    size = jnp.std(measures, axis=1, keepdims=True)
    known = jnp.all(size > 1e-9)
    abscissas = (measures - centre) / jnp.where(size > 1e-9, size, 1.0)
    line, converged = probit_line(abscissas, toppled, survived)
    z = line[0] + line[1:] @ abscissas
    slopes = line[1:] / jnp.where(size > 1e-9, size, 1.0)[:, 0]
    # z = (ln PGA - exponent ln ratio - ln median)/dispersion
    growing = slopes[0] > 0
    dispersion = 1 / jnp.where(growing, slopes[0], 1.0)
    exponent = -slopes[1] * dispersion
    logarithm = -(line[0] - slopes @ centre[:, 0]) * dispersion
    _, by_z, curvature = probit(z, toppled, survived)
    rows = jnp.stack([jnp.full_like(z, -1 / dispersion), -measures[1] / dispersion, -z])
    covariance, told = inverse_information(rows, curvature, toppled + survived)
    converged &= known & told & jnp.all(jnp.isfinite(covariance)) & (jnp.sum(toppled) > 0) & (jnp.sum(survived) > 0)
    status = FitStatus.where(growing, FitStatus.successful, FitStatus.not_growing)
    status = FitStatus.where(converged, status, FitStatus.not_converged)
    numbers = jnp.exp(logarithm), exponent, dispersion, covariance
    *numbers, covariance = (jnp.where(status == FitStatus.successful, x, jnp.nan) for x in numbers)
    return SurfaceFit(SurfaceFragility(*numbers), covariance, status), (rows * by_z).T, measures


@arguments
def surface_of(found: SimulatedFragility, bound: str | None = None) -> SurfaceFit:
    """Fit the two-measure fragility of scaled motions, each of which has its own PGV/PGA.

    **Arguments:**

    - `found`: from `simulated_fragility`, under motions of different PGV/PGA.
    - `bound`: as in `SimulatedFragility.counts`.

    **Returns:** a `SurfaceFit`. Each record, at all of its azimuths, is a cluster. For one record the covariance is
    NaN.

    **Raises:** ValueError if a bound is needed.
    """
    table = found.table()
    ratio = table["peak_velocity"] / (GRAVITY * table["peak_acceleration"])
    toppled = found.counts(bound)
    records = np.indices(toppled.shape)[0].ravel() // found.turns
    return _of_clusters(table["peak_acceleration"], ratio, toppled.ravel(), table["trials"], records)


def _of_clusters(acceleration, ratio, toppled, trials, clusters: np.ndarray) -> SurfaceFit:
    """Fit as `fit_surface` does, and also one cluster, for which the covariance is unknown (NaN)."""
    if clusters.max() > 0:
        return fit_surface(acceleration, ratio, toppled, trials, clusters)
    fit = fit_surface(acceleration, ratio, toppled, trials)
    return eqx.tree_at(lambda f: f.covariance, fit, jnp.full_like(fit.covariance, jnp.nan))


class SimulatedSurface(eqx.Module):
    """Outcomes of blocks under pulses, over peak acceleration and PGV/PGA.

    - `acceleration`: (rows,) [g]; `ratio`: (columns,) PGV/PGA [s].
    - `verdict`: (pulses, rows, columns, draws) 1 toppled, 0 stood, -1 undecided.
    - `ways`: 2 if the second half of the draws are the blocks of the first half, turned round.
    - `share`: in the shape of `verdict`, as in `SimulatedFragility`.
    """

    __repr__ = described

    acceleration: Float[Array, " rows"]
    ratio: Float[Array, " columns"]
    verdict: Int8[np.ndarray, "pulses rows columns draws"]
    ways: int = eqx.field(static=True, default=1)
    share: Float[np.ndarray, "pulses rows columns draws"] | None = None

    @property
    def lower(self) -> Float[np.ndarray, "rows columns"]:
        """Shares that toppled if all undecided scenes stood."""
        return np.mean(self.verdict == TOPPLED, axis=(0, 3))

    @property
    def upper(self) -> Float[np.ndarray, "rows columns"]:
        """Shares that toppled if all undecided scenes toppled."""
        return np.mean(self.verdict != STOOD, axis=(0, 3))

    @property
    def undecided(self) -> int:
        """Number of scenes without a verdict."""
        return int(np.sum(self.verdict == UNDECIDED))

    @arguments
    def at(self, ratio: ArrayLike, upper: bool = False) -> TabulatedFragility:
        """Return the fragility in peak acceleration at one PGV/PGA [s], interpolated linearly in its logarithm.

        **Arguments:**

        - `ratio`: within the columns.
        - `upper`: whether to count undecided scenes as toppled.

        **Raises:** ValueError for a ratio outside the columns.
        """
        ends = float(self.ratio[0]), float(self.ratio[-1])
        allowed = f"be in [{ends[0]:g}, {ends[1]:g}]"
        ratio = scalar("ratio", checked("ratio", ratio, allowed, lambda x: (x >= ends[0]) & (x <= ends[1])))
        shares = jnp.asarray(self.upper if upper else self.lower)
        place = jnp.log(ratio)
        row = jax.vmap(lambda share: jnp.interp(place, jnp.log(self.ratio), share))(shares)
        return TabulatedFragility(self.acceleration, row, "PGA")

    @called_by_users
    def fit(self, bound: str | None = None) -> SurfaceFit:
        """Fit the two-measure lognormal fragility of all cells: a smooth summary.

        **Arguments:**

        - `bound`: as in `SimulatedFragility.counts`.

        **Returns:** a `SurfaceFit`. Each draw, with both of its facings, is a cluster. The covariance measures the
        sampling error of the draws, for the given pulses; for a single block it is NaN.
        """
        share = None if self.share is None else np.moveaxis(self.share, 0, -1)
        toppled = counts(np.moveaxis(self.verdict, 0, -1), bound, share)  # (rows, columns, draws), of all pulses
        toppled = toppled.reshape(*toppled.shape[:2], self.ways, -1).sum(axis=2)
        cells = np.meshgrid(
            np.asarray(self.acceleration), np.asarray(self.ratio), np.arange(toppled.shape[-1]), indexing="ij"
        )
        acceleration, ratio, draws = (x.ravel() for x in cells)
        return _of_clusters(acceleration, ratio, toppled.ravel(), float(self.ways * len(self.verdict)), draws)


@arguments
def simulated_surface(
    block: Block | AsymmetricBlock,
    pulses: Annotated[Sequence[Callable[[ArrayLike, ArrayLike], AbstractMotion]], list_of(callable, "functions")],
    acceleration: Values,
    ratio: Values,
    model: AbstractEquation = Housner(),
    *,
    facing: Annotated[str, word_of(*FACINGS)] = "one",
    engine: AbstractEngine | None = None,
    progress: bool | None = None,
) -> SimulatedSurface:
    """Simulate whether blocks topple under pulses, over peak acceleration and PGV/PGA.

    **Arguments:**

    - `block`, `facing`: as in `simulated_fragility`.
    - `pulses`: functions that make motions from amplitude [g] and period or duration [s]. Peak acceleration must be
      proportional to the amplitude, and peak velocity to both. All pulses have equal weights.
    - `acceleration`: (rows,) peak accelerations [g], positive and rising.
    - `ratio`: (columns,) PGV/PGA [s], positive and rising.
    - `model`, `engine`, `progress`: as in `rocking_spectrum`.

    **Returns:** a `SimulatedSurface`.

    **Raises:** ValueError for arguments outside their ranges.

    **Source:** Purvance, Anooshehpoor & Brune (2008), the two measures.
    """
    acceleration, ratio = rising_list("acceleration", acceleration), rising_list("ratio", ratio)
    if not pulses:
        raise ValueError("Argument `pulses` must hold at least one pulse, but is empty.")
    blocks, parts = stacked(block), []
    for pulse in pulses:
        unit = _unit(pulse)
        peak, speed = float(peak_acceleration(unit)), float(peak_velocity(unit))
        # One motion of amplitude 1 g for each ratio is scaled to every acceleration.
        period = ratio * GRAVITY * peak / speed
        group = jax.vmap(lambda t, pulse=pulse: pulse(jnp.ones_like(t), t))(period)
        factors = both_ways(np.broadcast_to(np.asarray(acceleration) / peak, (ratio.size, acceleration.size)), facing)
        found = _verdicts(blocks, group, factors, model, engine, progress)
        parts.append([as_draws(each, facing).swapaxes(0, 1) for each in found])
    verdict, share = map(np.stack, zip(*parts))
    return SimulatedSurface(acceleration, ratio, verdict, len(FACINGS[facing]), share)


def _unit(pulse: Callable) -> AbstractMotion:
    """Return the motion that a pulse makes from amplitude 1 g and period 1 s; raise ValueError if it makes none."""
    try:
        inspect.signature(pulse).bind(1.0, 1.0)
    except (TypeError, ValueError) as error:
        said = f"make motions of amplitude and period, but {shown(pulse)} does not: {error}"
        raise ValueError(f"Argument `pulses` must {said}. Give the others within a function.") from None
    unit = pulse(jnp.ones(()), jnp.ones(()))
    if not isinstance(unit, AbstractMotion):
        raise ValueError(f"Argument `pulses` must make motions, but {shown(pulse)} makes {shown(unit)}.")
    return unit


def _verdicts(
    blocks: Block | AsymmetricBlock, group: AbstractMotion, factors: np.ndarray, model, engine, progress
) -> list[np.ndarray]:
    """Verdicts and shares (motions, levels, draws) of a stack of motions, scaled by factors (motions, levels)."""
    draws = jax.tree.leaves(blocks)[0].shape[0]
    motions, levels = factors.shape
    index, draw = np.arange(motions), np.arange(draws)
    # Neighbouring lanes differ only in the level, so that their responses take similar steps.
    points = (
        np.repeat(index, draws * levels),
        np.tile(np.repeat(draw, levels), motions),
        np.repeat(factors[:, None, :], draws, axis=1).ravel(),
    )
    scene = blocks, group, current_model(model, blocks, group, factors), engine
    tables = surface(_verdict, points, scene, "fragility", progress, outer=False)
    return [np.asarray(table).reshape(motions, draws, levels).swapaxes(1, 2) for table in tables]


def _verdict(index, draw, factor, scene):
    blocks, group, model, engine = scene
    motion = jax.tree.map(lambda x: x[index], group)  # `jax.vmap` gave every leaf, also shared ones, a leading axis
    result = outcome(one_of_many(blocks, draw), scaled_and_mirrored(motion, factor), model, engine=engine)
    return verdict_and_share(result)
