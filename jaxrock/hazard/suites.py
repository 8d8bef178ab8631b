"""Outcomes of many blocks under a suite of motions, as recorded or scaled (incremental dynamic analysis).

Overturning is not monotone in the scale: a block may topple at one and stand at a higher one. Curves are not made
monotone, and undecided scenes bound every share from both sides.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Annotated

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int8

from jaxrock._arguments.annotations import arguments, list_of, word_of
from jaxrock._arguments.parameters import leaves_of
from jaxrock._arguments.ranges import checked, positive
from jaxrock._arguments.tables import AbstractTable, Column
from jaxrock._core.arrays import Values, shown
from jaxrock._core.renamed import renamed
from jaxrock._core.settings import called_by_users
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.rigid import Block
from jaxrock.engines.stepper import AbstractEngine
from jaxrock.models.equation import AbstractEquation
from jaxrock.models.rigid import Housner
from jaxrock.motions.measures import Measure, measure_of, scaled_strengths
from jaxrock.motions.motion import AbstractMotion
from jaxrock.motions.suite import Suite, warn_of_repeated
from jaxrock.studies.suite_scenes import (
    FACINGS,
    UNDECIDED,
    capacities,
    comes_back,
    is_symmetric,
    rising_scales,
    scenes_of_suite,
    stacked,
)


class SuiteOutcomes(AbstractTable):
    """Outcomes of blocks under the motions of a suite.

    - `suite`, `blocks` (with parameters of shape (blocks,)), `scale`: (scales,); `facing`: (facings,) 1 as recorded, -1
      turned round.
    - `verdict`: (motions, scales, facings, blocks) 1 toppled, 0 stood, -1 undecided.
    - `rotation_ratio`: in the shape of `verdict`, peak rotation over slenderness (of an asymmetric block over the
      smaller one) [-]; infinite if it toppled, NaN where undecided.
    - `margin`: in the shape of `verdict`, as in `Outcome`; NaN where undecided.
    - `share`: in the shape of `verdict`, as in `SimulatedFragility`.
    """

    suite: Suite
    blocks: Block | AsymmetricBlock
    scale: Float[np.ndarray, " scales"]
    facing: tuple[int, ...] = eqx.field(static=True)
    verdict: Int8[np.ndarray, "motions scales facings blocks"]
    rotation_ratio: Float[np.ndarray, "motions scales facings blocks"]
    margin: Float[np.ndarray, "motions scales facings blocks"]
    share: Float[np.ndarray, "motions scales facings blocks"] | None = None

    rotation = renamed("rotation", "rotation_ratio")

    @property
    def _columns(self):
        axes = {"motion": self.suite.names, "scale": self.scale, "facing": self.facing,
                "block": np.arange(self.verdict.shape[3])}  # fmt: skip
        results = {"verdict": self.verdict, "rotation_ratio": self.rotation_ratio, "margin": self.margin}
        told = {name: Column((name,), np.asarray(values)) for name, values in axes.items()}
        return told | {name: Column((*axes,), values) for name, values in results.items()}

    @property
    def undecided(self) -> int:
        """Number of scenes without a verdict."""
        return int(np.sum(self.verdict == UNDECIDED))

    @called_by_users
    def reaches(self, state: Values) -> tuple[np.ndarray, np.ndarray]:
        """Return shares of blocks, over both facings, that reach damage states, for every motion and scale.

        **Arguments:**

        - `state`: (states,) peak rotations over slenderness, positive; a block that toppled has reached all.

        **Returns:** lower and upper bounds, (motions, scales, states): none, or all, of the undecided scenes count.

        **Raises:** ValueError for states that are not a list of positive numbers.
        """
        states = np.asarray(positive("state", state), float)
        if states.ndim != 1 or states.size == 0:
            raise ValueError(f"Argument `state` must be a list of states, but has shape {states.shape}.")
        found = self.rotation_ratio[..., None] >= states  # False where the rotation is NaN
        bounds = found, found | (self.verdict == UNDECIDED)[..., None]
        return tuple(each.mean(axis=(2, 3)) for each in bounds)

    @property
    def capacity(self) -> Float[np.ndarray, "motions facings blocks 2"]:
        """Bracket of scales in which each block first topples, (below, above); 0 and infinite where unknown.

        Above the upper scale a block may stand again. An undecided scale may be the first that topples it, and widens
        the bracket.
        """
        return capacities(self.verdict, self.scale)

    @property
    def comes_back(self) -> np.ndarray:
        """Truth values (motions, facings, blocks): a block stands at a scale above one that topples it."""
        return comes_back(self.verdict)

    @called_by_users
    def table(self, measures: Mapping[str, str | Callable] | Sequence[str] | None = None) -> dict[str, np.ndarray]:
        """Return columns with a row for every scene: `pandas.DataFrame(found.table())`.

        **Arguments:**

        - `measures`: names as in `simulated_fragility`, such as `["IA", "SA(0.5)"]`, or a mapping of column names to
          such names or to functions of a motion, such as `{"Arias": rk.intensity.arias}`. Each is evaluated for the
          scaled motion. None: only the peaks.

        **Returns:** motion, (of components: source and azimuth [rad],) scale, facing, block, the block's parameters
        (except those that all blocks share), PGA [g], PGV [m/s], the measures, rotation_ratio, margin, verdict (1
        toppled, 0 stood, -1 undecided).

        **Raises:** ValueError for measures that are neither functions nor known names, and for repeated names.
        """
        kinds = measures_by_name(measures)
        motion, scale, facing, block = (places.ravel() for places in np.indices(self.verdict.shape))
        strength = self.scale[scale]
        columns = {"motion": np.array(self.suite.names)[motion]}
        if self.suite.azimuth is not None:
            columns |= {"source": np.array(self.suite.sources)[motion], "azimuth": self.suite.azimuth[motion]}
        columns |= {"scale": strength, "facing": np.array(self.facing)[facing], "block": block}
        columns |= {leaf.name: np.asarray(leaf.value)[block] for leaf in leaves_of(self.blocks) if not leaf.is_shared}
        peaks = {"PGA": self.suite.peak_acceleration, "PGV": self.suite.peak_velocity}
        columns |= {name: np.asarray(peak)[motion] * strength for name, peak in peaks.items()}
        results = {"rotation_ratio": self.rotation_ratio, "margin": self.margin, "verdict": self.verdict}
        for name, kind in kinds.items():
            if name not in peaks and name in (columns | results):
                raise ValueError(f"Argument `measures` must not have names of other columns, but has {name!r}.")
            if name not in peaks or name != kind.name or kind.power is None:
                columns[name] = scaled_strengths(kind, self.suite, self.scale)[motion, scale]
        return columns | {name: each.ravel() for name, each in results.items()}


def measures_by_name(measures) -> dict[str, Measure]:
    """Return the measures by the names of their columns."""
    if measures is None:
        return {}
    if isinstance(measures, Mapping):
        named = [(str(name), measure_of("measures", each)) for name, each in measures.items()]
    elif isinstance(measures, (list, tuple)) and not any(map(callable, measures)):
        named = [(kind.name, kind) for kind in (measure_of("measures", each) for each in measures)]
    else:
        raise ValueError(f"Argument `measures` must hold names, or functions by name, but is {shown(measures)}.")
    found = dict(named)
    if len(found) < len(named):
        raise ValueError(f"Argument `measures` must have each name once, but is {shown(measures)}.")
    return found


@arguments
def suite_outcomes(
    block: Block | AsymmetricBlock,
    motions: Suite | Annotated[Sequence[AbstractMotion], list_of(AbstractMotion, "motions")],
    scale: Values = 1.0,
    model: AbstractEquation = Housner(),
    *,
    facing: Annotated[str, word_of(*FACINGS)] = "one",
    engine: AbstractEngine | None = None,
    progress: bool | None = None,
) -> SuiteOutcomes:
    """Compute the outcomes of blocks under the motions of a suite, as recorded or at many scales.

    **Arguments:**

    - `block`: a `Block` or `AsymmetricBlock`, of scalars or with parameters of shape (blocks,).
    - `motions`: a `Suite`, or a list of motions; `Suite(components, azimuth=...)` for records with two components.
    - `scale`: factors on all motions, a number (1: as recorded) or a list, positive and rising.
    - `facing`: "one": as it stands; "both": also turned round, which for a symmetric block of one
      restitution is a mirror image.
    - `model`, `engine`, `progress`: as in `rocking_spectrum`.

    **Returns:** a `SuiteOutcomes`; `fit_probit` takes columns of its `table()`. A repeated motion causes a warning.

    **Raises:** ValueError for arguments outside their ranges.

    **Source:** Vamvatsikos & Cornell (2002), incremental dynamic analysis.
    """
    scales = rising_scales(scale)
    suite = motions if isinstance(motions, Suite) else Suite(motions)
    warn_of_repeated(suite)
    strongest = float(np.max(suite.peak_acceleration))
    checked("scale", scales, "keep all motions at 1e9 g or below", lambda x: x * strongest <= 1e9)
    blocks, ways = stacked(block), FACINGS[facing]
    symmetric = is_symmetric(block)
    factors = np.concatenate([way * scales for way in (ways[:1] if symmetric else ways)])
    found = scenes_of_suite(blocks, suite, factors, model, engine, progress)
    draws = jax.tree.leaves(blocks)[0].shape[0]

    def by_facing(values):
        values = values.reshape(len(suite), -1, scales.size, draws).swapaxes(1, 2)
        return np.repeat(values, len(ways), axis=2) if symmetric else values

    return SuiteOutcomes(suite, blocks, scales, ways, *map(by_facing, found))
