"""Fragility by simulation: outcomes of uncertain blocks under many motions, each scaled to many levels.

Overturning is not monotone in the level: a block may topple at one level and stand at a higher one. The result keeps
the verdict of every scene, and only a lognormal fit is monotone. Scenes without a verdict bound the probability from
both sides.
"""

from collections.abc import Callable, Sequence
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int8

from jaxrock._arguments.annotations import arguments, word_of
from jaxrock._arguments.ranges import checked, one_of
from jaxrock._arguments.tables import AbstractTable, Column
from jaxrock._core.arrays import Values, to_device
from jaxrock._core.settings import called_by_users
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.rigid import Block
from jaxrock.compiler.hints import jit_low_effort
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
    BOUNDS,
    FACINGS,
    STOOD,
    TOPPLED,
    UNDECIDED,
    as_draws,
    both_ways,
    capacities,
    comes_back,
    scenes_of_suite,
    stacked,
    topples,
)


def counts(verdict: np.ndarray, bound: str | None, share: np.ndarray | None = None) -> np.ndarray:
    """Count toppled scenes along the last axis; `bound`, `share`: as in `SimulatedFragility`."""
    undecided = int(np.sum(verdict == UNDECIDED))
    if bound is None and undecided:
        raise ValueError(
            f"Argument `bound` must be 'lower', 'upper' or 'share', because {undecided} of {verdict.size} scenes are "
            "undecided."
        )
    return topples(verdict, "lower" if bound is None else one_of("bound", bound, BOUNDS), share).sum(axis=-1)


class SimulatedFragility(AbstractTable):
    """Outcomes of blocks under scaled motions.

    - `levels`: (levels,) of the measure; `measure`: its name, "PGA" [g], say.
    - `names`: of the motions; `peak_acceleration` [g], `peak_velocity` [m/s], `strength` (the measure): (motions,)
      before they were scaled; the measure grows with the `power` of the scale.
    - `verdict`: (motions, levels, draws) 1 toppled, 0 stood, -1 undecided (the verdict was too close to call, or could
      not be computed).
    - `turns`: number of consecutive motions that are one record at several azimuths.
    - `share`: in the shape of `verdict`, the share that topples of the motions that errors of the computation allow: 0
      or 1 with a verdict, 0.5 where nothing is known (None: of all undecided scenes).
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
    share: Float[np.ndarray, "motions levels draws"] | None = None

    @property
    def unit(self) -> str:
        """The unit of the levels; empty if unknown."""
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
        """Return the number of draws that toppled under every motion at every level.

        **Arguments:**

        - `bound`: "lower" counts undecided scenes as standing, "upper" as toppled, "share" by their `share`. None is
          allowed where every scene is decided.

        **Raises:** ValueError if a bound is needed, or is another word.
        """
        return counts(self.verdict, bound, self.share)

    @property
    def lower(self) -> Float[np.ndarray, " levels"]:
        """Share that toppled at every level, over motions and draws, if all undecided scenes stood."""
        return np.mean(self.verdict == TOPPLED, axis=(0, 2))

    @property
    def upper(self) -> Float[np.ndarray, " levels"]:
        """Share that toppled at every level, over motions and draws, if all undecided scenes toppled."""
        return np.mean(self.verdict != STOOD, axis=(0, 2))

    @called_by_users
    def tabulated(self, bound: str | None = None) -> TabulatedFragility:
        """Return the shares at the levels as a fragility, which need not be monotone. `bound`: as in `counts`."""
        motions, _, draws = self.verdict.shape
        return TabulatedFragility(self.levels, self.counts(bound).sum(axis=0) / (motions * draws), self.measure)

    @called_by_users
    def fit(self, bound: str | None = None) -> FragilityFit:
        """Fit the lognormal fragility under which the verdicts are most probable.

        **Arguments:**

        - `bound`: as in `counts`.

        **Returns:** a `FragilityFit`. Its covariance and `p_value` treat records as clusters, because outcomes of one
        record at several levels, azimuths and blocks are correlated. Standard errors from it are too small for few
        records; `intervals` hold. For one record both are NaN; for records with equal outcomes the covariance is NaN.
        The sampling error of the drawn blocks is neglected. Check `monotone` and `falls` before you use a monotone
        curve.

        **Raises:** ValueError if a bound is needed.

        **Source:** Baker (2015), the fit to stripes; Liang & Zeger (1986), the covariance of clusters.
        """
        # Scores of a record add up, and are linear in the counts: the turns of a record may count as draws.
        toppled = self.counts(bound).reshape(self._records, self.turns, -1).sum(axis=1)
        trials = float(self.turns * self.verdict.shape[2])
        fit = fit_fragility(self.levels, toppled.sum(axis=0), self._records * trials)
        unknown = jnp.full_like(fit.covariance, jnp.nan)
        if self._records == 1:
            covariance, test = unknown, unknown[0, 0]
        else:
            covariance, test = _clustered(fit, self.levels, *to_device((toppled, np.asarray(trials))))
        if np.all(toppled == toppled[0]):
            covariance = unknown
        fragility = lognormal_of(fit.fragility.median, fit.fragility.dispersion, self.measure)
        return eqx.tree_at(lambda f: (f.fragility, f.covariance, f.p_value), fit, (fragility, covariance, test))

    @called_by_users
    def intervals(self, bound: str | None = None, confidence: ArrayLike = 0.95) -> FragilityIntervals:
        """Return confidence intervals of the fit's median and dispersion, which hold for few motions.

        They use Student's t for the logarithm of the median, and chi-squared for the part of the squared dispersion
        that is between motions.

        **Arguments:**

        - `bound`: as in `counts`.
        - `confidence`: in (0, 1).

        **Returns:** a `FragilityIntervals`. It is NaN with the status of the fit where that failed, for one record at
        any number of azimuths, and (`FitStatus.alike`) for records with equal outcomes. Intervals assume lognormal
        capacities under records, as the fit does. For the coverage of 95 % intervals in synthetic suites of 5 to 40
        motions, see benchmarks/few_motions.md.

        **Raises:** ValueError if a bound is needed, or for a confidence outside its range.

        **Source:** Fisher (1925), t and chi-squared; Liang & Zeger (1986), the variance between motions.
        """
        return intervals_of_motions(self.fit(bound), self._records, confidence)

    @property
    def _records(self) -> int:
        """Number of records, which are independent; azimuths of one record are not."""
        return len(self.verdict) // self.turns

    @property
    def monotone(self) -> Bool[np.ndarray, "motions draws"]:
        """Return whether every level above the first that topples a block topples it, too (undecided ones may have)."""
        return ~comes_back(self.verdict)

    @property
    def falls(self) -> Float[np.ndarray, " levels"]:
        """Fall of the share that topples at a level from its maximum over lower levels; 0 where it does not fall."""
        return np.maximum.accumulate(self.lower) - self.lower

    @property
    def capacities(self) -> Float[np.ndarray, "motions draws 2"]:
        """Bracket of levels in which each block first topples, (below, above); 0 and infinite where unknown.

        Above the upper level a block may stand again. An undecided level may be the first that topples it, and widens
        the bracket.
        """
        return capacities(self.verdict, self.levels)

    @called_by_users
    def table(self) -> dict[str, np.ndarray]:
        """Return columns with a row for every motion and level: names, level, peaks [g], [m/s], and counts of draws."""
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


@jit_low_effort()
def _clustered(fit: FragilityFit, levels, toppled, draws):
    """Return the covariance of (ln median, ln dispersion), and the test of the slope, with each record as a cluster."""
    median, dispersion = fit.fragility.median, fit.fragility.dispersion
    z = jnp.log(levels / median) / dispersion
    rows = jnp.stack([jnp.full_like(z, -1 / dispersion), -z])  # derivatives of z by ln median and ln dispersion
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
    - `motions`: a `Suite`, or a list of motions; all must differ.
    - `levels`: (levels,) of the measure, positive and rising; two or more.
    - `facing`: "one": as it stands; "both": also turned round, for a motion of unknown direction. Turned blocks are
      further draws after the others.
    - `model`, `engine`, `progress`: as in `rocking_spectrum`.
    - `measure`: that of the levels: "PGA" [g], "PGV" [m/s], "PGD" [m], "IA" (Arias) or "CAV" [m/s], "SA(0.5)" [g] or
      "SV(0.5)" [m/s] at a period [s]; or a function of a motion that grows as a power of its scale, such as
      `lambda m: rk.intensity.average_spectral_acceleration(m, [0.2, 0.5, 1.0])`.

    **Returns:** a `SimulatedFragility`: its `tabulated()` and `fit().fragility` go into `toppling_rate` and
    `survival_probability` with a hazard curve of the same measure.

    **Raises:** ValueError for arguments outside their ranges, and for a repeated motion.

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
    found = scenes_of_suite(stacked(block), suite, both_ways(factors, facing), model, engine, progress)
    verdict, share = (as_draws(each, facing) for each in (found.verdict, found.share))
    peaks = suite.peak_acceleration, suite.peak_velocity
    return SimulatedFragility(levels, verdict, *peaks, suite.names, kind.name, strength, power, suite.turns, share)


def _factors(levels, strength, power: float) -> np.ndarray:
    """Return the scale factor of every motion at every level."""
    return (np.asarray(levels)[None, :] / np.asarray(strength)[:, None]) ** (1 / power)
