"""Fragility by simulation: what becomes of uncertain blocks under many motions, each scaled to many levels.

Whether a block overturns does not grow with the motion: it may topple at one level and stand at a higher one. The
verdict of every scene is kept, so that nothing is made monotone before a lognormal curve is asked for; and a scene
without a verdict bounds the probability from both sides.
"""

from collections.abc import Callable, Sequence
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int8

from jaxrock._arguments import arguments, word_of
from jaxrock._checks import Values, checked, one_of, placed
from jaxrock._quickly import quickly
from jaxrock._settings import called_by_users
from jaxrock._tables import AbstractTable, Column
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.rigid import Block
from jaxrock.engines.stepper import AbstractEngine
from jaxrock.hazard.fragility import (
    FragilityFit,
    TabulatedFragility,
    fit_fragility,
    lognormal_of,
    rising_list,
)
from jaxrock.hazard.intervals import FragilityIntervals, intervals_of_motions
from jaxrock.hazard.probit_line import probit, slope_tests
from jaxrock.models.equation import AbstractEquation
from jaxrock.models.rigid import Housner
from jaxrock.motions.measures import measure_of, power_of, strengths, unit_of
from jaxrock.motions.motion import AbstractMotion
from jaxrock.motions.suite import Suite, repeated
from jaxrock.studies.suite_scenes import (
    FACINGS,
    STOOD,
    TOPPLED,
    UNDECIDED,
    as_draws,
    both_ways,
    capacities,
    comes_back,
    scenes,
    stacked,
)


def counts(verdict: np.ndarray, bound: str | None) -> np.ndarray:
    """How many toppled along the last axis, if all that is undecided stood ("lower") or toppled ("upper")."""
    undecided = int(np.sum(verdict == UNDECIDED))
    if bound is None and undecided:
        raise ValueError(
            f"Argument `bound` must be 'lower' or 'upper', because {undecided} of {verdict.size} scenes are undecided."
        )
    upper = bound is not None and one_of("bound", bound, ("lower", "upper")) == "upper"
    return np.sum(verdict != STOOD if upper else verdict == TOPPLED, axis=-1).astype(float)


class SimulatedFragility(AbstractTable):
    """What became of blocks under scaled motions.

    - `levels`: (levels,) of the measure; `measure`: its name, "PGA" [g], say.
    - `names`: of the motions; `peak_acceleration` [g], `peak_velocity` [m/s], `strength` (the measure): (motions,)
      before they were scaled; the measure grows with the `power` of the scale.
    - `verdict`: (motions, levels, draws) 1 toppled, 0 stood, -1 undecided (the verdict was too close to call, or could
      not be computed).
    - `turns`: so many motions, one after the other, are one record at several azimuths.
    """

    levels: Float[Array, " levels"]
    verdict: Int8[np.ndarray, "motions levels draws"]
    peak_acceleration: Float[Array, " motions"]
    peak_velocity: Float[Array, " motions"]
    names: tuple[str, ...] = eqx.field(static=True)
    measure: str = eqx.field(static=True)
    strength: Float[np.ndarray, " motions"] | None = None
    power: float = eqx.field(static=True, default=1.0)
    turns: int = eqx.field(static=True, default=1)

    @property
    def unit(self) -> str:
        """The unit of the levels; empty where it is not known."""
        return unit_of(self.measure)

    @property
    def _columns(self):
        axes, unit = ("motion", "level"), self.unit or "that of the measure"
        rows = {name: values.reshape(self.verdict.shape[:2]) for name, values in self.table().items()}
        told = {"motion": Column(("motion",), np.array(self.names)), "level": Column(("level",), self.levels, unit)}
        units = {"peak_acceleration": "g", "peak_velocity": "m/s"}
        return told | {name: Column(axes, rows[name], units.get(name, "-")) for name in rows if name not in axes}

    @property
    def undecided(self) -> int:
        """Number of scenes without a verdict."""
        return int(np.sum(self.verdict == UNDECIDED))

    @called_by_users
    def counts(self, bound: str | None = None) -> Float[np.ndarray, "motions levels"]:
        """How many draws toppled under every motion at every level.

        **Arguments:**

        - `bound`: "lower" counts what is undecided as standing, "upper" as toppled. May be left out if nothing is.

        **Raises:** ValueError if a bound is needed, or is another word.
        """
        return counts(self.verdict, bound)

    @property
    def lower(self) -> Float[np.ndarray, " levels"]:
        """Share that toppled at every level, over motions and draws, if all that is undecided stood."""
        return np.mean(self.verdict == TOPPLED, axis=(0, 2))

    @property
    def upper(self) -> Float[np.ndarray, " levels"]:
        """The same if all that is undecided toppled."""
        return np.mean(self.verdict != STOOD, axis=(0, 2))

    @called_by_users
    def tabulated(self, bound: str | None = None) -> TabulatedFragility:
        """Shares at the levels as a fragility, which rises and falls as they do. `bound`: as in `counts`."""
        motions, _, draws = self.verdict.shape
        return TabulatedFragility(self.levels, self.counts(bound).sum(axis=0) / (motions * draws), self.measure)

    @called_by_users
    def fit(self, bound: str | None = None) -> FragilityFit:
        """The lognormal fragility under which the verdicts are most probable.

        **Arguments:**

        - `bound`: as in `counts`.

        **Returns:** a `FragilityFit`. Its covariance and `p_value` take records as what is random: what one does at one
        level, at one azimuth and to one block goes with what it does at others (a sandwich of clusters). Standard
        errors from it are too small for few records: `intervals` hold. Of one record both are NaN; of records that all
        did the same the covariance is. Blocks are taken as drawn often enough. Look at `monotone` and `falls` before a
        curve that only rises is used.

        **Raises:** ValueError if a bound is needed.

        **Source:** Baker (2015), the fit to stripes; Liang & Zeger (1986), the covariance of clusters.
        """
        # Scores of what one record does add up, and go with the counts: as if its turns were draws.
        toppled = self.counts(bound).reshape(self._records, self.turns, -1).sum(axis=1)
        trials = float(self.turns * self.verdict.shape[2])
        fit = fit_fragility(self.levels, toppled.sum(axis=0), self._records * trials)
        unknown = jnp.full_like(fit.covariance, jnp.nan)
        if self._records == 1:
            covariance, test = unknown, unknown[0, 0]
        else:
            covariance, test = _clustered(fit, self.levels, *placed((toppled, np.asarray(trials))))
        if np.all(toppled == toppled[0]):
            covariance = unknown
        fragility = lognormal_of(fit.fragility.median, fit.fragility.dispersion, self.measure)
        return eqx.tree_at(lambda f: (f.fragility, f.covariance, f.p_value), fit, (fragility, covariance, test))

    @called_by_users
    def intervals(self, bound: str | None = None, confidence: ArrayLike = 0.95) -> FragilityIntervals:
        """Confidence intervals of the fit's median and dispersion, which hold for few motions: Student's t for the
        logarithm of the median, chi-squared for the part of the squared dispersion that is between motions.

        **Arguments:**

        - `bound`: as in `counts`.
        - `confidence`: in (0, 1).

        **Returns:** a `FragilityIntervals`; NaN with the status of the fit where that failed, of one record only, at
        however many azimuths, and (`FitStatus.alike`) of records that all did the same.
        They take the capacities under records as lognormal, as the fit does. How often intervals of 95 % held the truth
        of made suites of 5 to 40 motions stands in benchmarks/few_motions.md.

        **Raises:** ValueError if a bound is needed, or for a confidence outside its range.

        **Source:** Fisher (1925), t and chi-squared; Liang & Zeger (1986), the variance between motions.
        """
        return intervals_of_motions(self.fit(bound), self._records, confidence)

    @property
    def _records(self) -> int:
        """Number of records: of motions that say something of their own."""
        return len(self.verdict) // self.turns

    @property
    def monotone(self) -> Bool[np.ndarray, "motions draws"]:
        """Return whether every level above the first that topples a block topples it, too (undecided ones may have)."""
        return ~comes_back(self.verdict)

    @property
    def falls(self) -> Float[np.ndarray, " levels"]:
        """By how much the share that topples is lower at a level than at some level below it; 0 where it is not."""
        return np.maximum.accumulate(self.lower) - self.lower

    @property
    def capacities(self) -> Float[np.ndarray, "motions draws 2"]:
        """Between which levels every block first topples: (below, above), 0 and infinite where that is not known.

        Above the upper level it may stand again. An undecided level may have been the first: it widens the bracket.
        """
        return capacities(self.verdict, self.levels)

    @called_by_users
    def table(self) -> dict[str, np.ndarray]:
        """Columns with a row for every motion and level: names, level, peaks [g], [m/s], trials, toppled, undecided."""
        motions, levels, draws = self.verdict.shape
        strength = self.strength
        if strength is None:
            strength = self.peak_velocity if self.measure == "PGV" else self.peak_acceleration
        factors = _factors(self.levels, strength, self.power)
        return {
            "motion": np.repeat(np.array(self.names), levels),
            "level": np.tile(np.asarray(self.levels), motions),
            "peak_acceleration": np.ravel(factors * np.asarray(self.peak_acceleration)[:, None]),
            "peak_velocity": np.ravel(factors * np.asarray(self.peak_velocity)[:, None]),
            "trials": np.full(motions * levels, draws),
            "toppled": np.sum(self.verdict == TOPPLED, axis=2).ravel(),
            "undecided": np.sum(self.verdict == UNDECIDED, axis=2).ravel(),
        }


@quickly()
def _clustered(fit: FragilityFit, levels, toppled, draws):
    """Covariance of (ln median, ln dispersion), and the test of the slope, where what one record (a row) does at all
    levels is one outcome."""
    median, dispersion = fit.fragility.median, fit.fragility.dispersion
    z = jnp.log(levels / median) / dispersion
    rows = jnp.stack([jnp.full_like(z, -1 / dispersion), -z])  # of z by ln median and ln dispersion
    scores = jax.vmap(lambda toppled: rows @ probit(z, toppled, draws - toppled)[1])(toppled)
    motions = toppled.shape[0]
    abscissas = jnp.tile(jnp.log(levels), motions)[None]
    labels = jnp.repeat(jnp.arange(motions), levels.size)
    test = slope_tests(abscissas, toppled.ravel(), draws - toppled.ravel(), labels, motions, motions)[0]
    return fit.covariance @ (scores.T @ scores * motions / (motions - 1)) @ fit.covariance, test


@arguments
def simulated_fragility(
    block: Block | AsymmetricBlock,
    motions: Suite | Sequence[AbstractMotion],
    levels: Values,
    model: AbstractEquation = Housner(),
    *,
    facing: Annotated[str, word_of(*FACINGS)] = "one",
    measure: str | Callable[[AbstractMotion], float] = "PGA",
    engine: AbstractEngine | None = None,
    progress: bool | None = None,
) -> SimulatedFragility:
    """Simulate whether blocks topple under motions that are scaled to levels of intensity (stripes, or incremental
    analysis).

    **Arguments:**

    - `block`: a `Block` or `AsymmetricBlock`; with parameters of shape (draws,) uncertain, such as `draw_blocks` and
      `draw_rocks` make.
    - `motions`: a `Suite`, or what makes one, of motions that differ.
    - `levels`: (levels,) of the measure, positive and rising; two or more.
    - `facing`: "one": as it stands; "both": also turned round, as draws after those that are not, where nobody knows
      which way the motion comes.
    - `model`, `engine`, `progress`: as in `rocking_spectrum`.
    - `measure`: what the levels are: "PGA" [g], "PGV" [m/s], "PGD" [m], "IA" (Arias) or "CAV" [m/s], "SA(0.5)" [g] or
      "SV(0.5)" [m/s] at a period [s]; or a function of a motion that grows as a power of its scale, such as
      `lambda m: rk.intensity.average_spectral_acceleration(m, [0.2, 0.5, 1.0])`.

    **Returns:** a `SimulatedFragility`: its `tabulated()` and `fit().fragility` go into `toppling_rate` and
    `survival_probability` with a hazard curve of the same measure.

    **Raises:** ValueError for arguments outside their ranges, and for a motion that is there twice.

    **Source:** Vamvatsikos & Cornell (2002), scaled records; Jalayer & Cornell (2009), stripes.
    """
    levels = rising_list("levels", levels)
    suite = motions if isinstance(motions, Suite) else Suite(motions)
    twice = repeated(suite)
    if twice:
        raise ValueError(
            f"Argument `motions` must hold each motion once, but {twice[0]!r} and {twice[1]!r} are the same."
        )
    kind = measure_of("measure", measure)
    strength = strengths("measure", kind, suite)
    power = power_of("measure", kind, suite.motions())
    factors = _factors(levels, strength, power)
    strongest = factors * np.asarray(suite.peak_acceleration)[:, None]
    checked("levels", strongest.max(axis=0), "keep all motions at 1e9 g or below", lambda x: x <= 1e9)
    found = scenes(stacked(block), suite, both_ways(factors, facing), model, engine, progress)
    peaks, verdict = (suite.peak_acceleration, suite.peak_velocity), as_draws(found.verdict, facing)
    return SimulatedFragility(levels, verdict, *peaks, suite.names, kind.name, strength, power, suite.turns)


def _factors(levels, strength, power: float) -> np.ndarray:
    """By how much every motion is scaled at every level."""
    return (np.asarray(levels)[None, :] / np.asarray(strength)[:, None]) ** (1 / power)
