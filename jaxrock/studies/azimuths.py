"""Planar outcomes of a rock over azimuths, under both horizontal components of a record: the planar bound.

Each vertical plane is analysed alone, with the rock's section and the record's component in that plane. Coupling
between planes (twisting, rolling along an edge, sliding) is not modelled.
"""

import warnings
from collections.abc import Callable

import jax
import numpy as np
from jaxtyping import ArrayLike, Float, Int8

from jaxrock._arguments.annotations import arguments
from jaxrock._arguments.parameters import check_single, shared
from jaxrock._arguments.ranges import direction, scalar
from jaxrock._arguments.tables import AbstractTable, Column
from jaxrock._core.arrays import Values, shown, to_device
from jaxrock._core.precision import frames_of_the_package
from jaxrock._core.progress import Progress
from jaxrock._core.renamed import renamed
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.rigid import Block
from jaxrock.blocks.rock import Rock
from jaxrock.engines.stepper import AbstractEngine
from jaxrock.models.equation import AbstractEquation
from jaxrock.models.rigid import Housner
from jaxrock.motions.components import Components
from jaxrock.motions.record import with_room
from jaxrock.responses.current_model import current_model
from jaxrock.studies.suite_scenes import STOOD, TOPPLED, UNDECIDED, Scenes, of_motion, rising_scales, stacked


class AzimuthOutcomes(AbstractTable):
    """Outcomes of a rock in every vertical plane; a table.

    - `azimuth`: (azimuths,) of the planes, in the rock's axes [rad]; `scale`: (scales,) of the record.
    - `blocks`: planar block of the rock in each plane, with parameters of shape (azimuths,).
    - `verdict`, `rotation_ratio`, `margin`: (azimuths, scales), as in `SuiteOutcomes`.
    """

    azimuth: Float[np.ndarray, " azimuths"]
    scale: Float[np.ndarray, " scales"]
    blocks: Block | AsymmetricBlock
    verdict: Int8[np.ndarray, "azimuths scales"]
    rotation_ratio: Float[np.ndarray, "azimuths scales"]
    margin: Float[np.ndarray, "azimuths scales"]

    rotation = renamed("rotation", "rotation_ratio")

    @property
    def _columns(self):
        axes = {"azimuth": Column(("azimuth",), self.azimuth, "rad"), "scale": Column(("scale",), self.scale)}
        results = {"verdict": self.verdict, "rotation_ratio": self.rotation_ratio, "margin": self.margin}
        return axes | {name: Column((*axes,), values) for name, values in results.items()}

    @property
    def toppled(self) -> Int8[np.ndarray, " scales"]:
        """Planar bound at every scale: 1 if some plane topples, 0 if all stand, -1 if that is undecided."""
        some, undecided = ((self.verdict == each).any(axis=0) for each in (TOPPLED, UNDECIDED))
        return np.where(some, TOPPLED, np.where(undecided, UNDECIDED, STOOD)).astype(np.int8)

    @property
    def weakest(self) -> Float[np.ndarray, " scales"]:
        """Azimuth of the lowest margin at every scale [rad], among decided planes; NaN if no plane is decided."""
        known = np.where(np.isnan(self.margin), np.inf, self.margin)
        return np.where(np.isfinite(known).any(axis=0), self.azimuth[known.argmin(axis=0)], np.nan)


@arguments
def azimuth_outcomes(
    rock: Rock | Callable,
    components: Components,
    azimuth: Values | None = None,
    scale: Values = 1.0,
    model: AbstractEquation = Housner(),
    *,
    orientation: ArrayLike = 0.0,
    vertical: bool = True,
    engine: AbstractEngine | None = None,
    progress: bool | None = None,
) -> AzimuthOutcomes:
    """Compute the outcome of a rock in every vertical plane; its slenderness may vary with azimuth.

    **Arguments:**

    - `rock`: a `Rock`; or a function of an azimuth [rad] that returns the `Block` or `AsymmetricBlock` in its plane,
      side 1 of which is towards the azimuth.
    - `components`: both horizontal components of a record, optionally the vertical one.
    - `azimuth`: (azimuths,) of planes, in the rock's axes [rad]; None: 36 from 0 to pi. Each plane covers both of its
      sides.
    - `scale`: factors on the record, a number or a list, positive and rising.
    - `orientation`: azimuth of the record's first component in the rock's axes [rad].
    - `vertical`: whether the vertical component, if there is one, also shakes the rock.
    - `model`, `engine`, `progress`: as in `rocking_spectrum`.

    **Returns:** an `AzimuthOutcomes`. Its `weakest` is the azimuth that governs the planar bound, and
    `components.along(weakest - orientation)` is the record along it.

    It warns if the base of the rock is rounded in some plane.

    **Raises:** ValueError for arguments outside their ranges, and for a function that returns no block, or blocks of
    two kinds.
    """
    if not isinstance(rock, Rock) and (not callable(rock) or isinstance(rock, type)):
        raise ValueError(f"Argument `rock` must be a Rock, or a function of an azimuth, but is {shown(rock)}.")
    angles = np.linspace(0, np.pi, 36, endpoint=False) if azimuth is None else np.asarray(direction("azimuth", azimuth))
    if angles.ndim != 1 or angles.size == 0:
        raise ValueError(f"Argument `azimuth` must be a list of angles, but has shape {angles.shape}.")
    scales = rising_scales(scale)
    first = float(scalar("orientation", direction("orientation", orientation)))
    blocks = _blocks(rock, angles)
    model = current_model(model, blocks, components.first, scales)
    known, alike = jax.tree.map(np.asarray, blocks), shared(blocks)  # alike in all scenes of a plane
    bar, found = Progress(angles.size * scales.size, "azimuths", progress), []
    for index, angle in enumerate(angles):
        motion = components.in_plane(angle - first, vertical)
        lanes = jax.tree.map(lambda x, own, at=index: x[at] if own else np.full(scales.shape, x[at]), known, alike)
        found.append(of_motion(with_room(motion), to_device(lanes), to_device(scales), model, engine, {}))
        bar.add(scales.size)
    parts = Scenes(*(np.stack([np.asarray(x) for x in part]) for part in zip(*found)))
    return AzimuthOutcomes(angles, scales, blocks, parts.verdict, parts.rotation, parts.margin)


def _blocks(rock: Rock | Callable, angles: np.ndarray) -> Block | AsymmetricBlock:
    """Return the block of the rock in all planes, with parameters of shape (azimuths,)."""
    if isinstance(rock, Rock) and any(any(rock.section(float(angle)).rolls) for angle in angles):
        warnings.warn(
            "The base is rounded: the rock is taken to rock about the outermost points of the ground it stands on, as "
            "`Rock.section` has it by default. A function of the azimuth can take another block.",
            stacklevel=frames_of_the_package() + 1,
        )
    found = [_in_plane(rock, float(angle)) for angle in angles]
    for block in found:
        if not isinstance(block, Block | AsymmetricBlock):
            raise ValueError(f"Argument `rock` must give a Block or an AsymmetricBlock, but gives {shown(block)}.")
        check_single(rock=block)
    if len({jax.tree.structure(block) for block in found}) > 1:
        raise ValueError("Argument `rock` must give blocks of one kind for all azimuths, but gives several.")
    return stacked(jax.tree.map(lambda *x: np.stack(x), *found))


def _in_plane(rock: Rock | Callable, azimuth: float):
    if not isinstance(rock, Rock):
        return rock(azimuth)
    section = rock.section(azimuth)
    return AsymmetricBlock.from_corners(section.right, section.left, section.centre, section.gyration_radius)
