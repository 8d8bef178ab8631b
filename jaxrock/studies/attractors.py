"""Basins of attraction: to which of several orbits a block settles, over its state at the start."""

from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxrock._arguments.annotations import arguments, at_least
from jaxrock._arguments.parameters import check_single
from jaxrock._arguments.ranges import Range
from jaxrock._arguments.tables import AbstractTable, Column
from jaxrock._core.arrays import Values
from jaxrock._core.one_program import check_known
from jaxrock._core.precision import say_if_single
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.rigid import Block
from jaxrock.engines.stepper import AbstractEngine
from jaxrock.models.equation import AbstractEquation
from jaxrock.models.rigid import Housner
from jaxrock.motions.motion import AbstractMotion
from jaxrock.responses.current_model import current_model
from jaxrock.status import Status
from jaxrock.studies.spectra import axis
from jaxrock.studies.stroboscopic import StroboscopicState, after_turns
from jaxrock.sweeps.runner import cheap_per_point
from jaxrock.sweeps.sweep import known_surface, surface

_rotation = Range("be in (-pi/2, pi/2)", -np.pi / 2, np.pi / 2, lambda x: (x > -np.pi / 2) & (x < np.pi / 2))
_velocity = Range("be finite, and at most 1e9 in size", -np.inf, np.inf, lambda x: (x >= -1e9) & (x <= 1e9))


class Basins(AbstractTable):
    """Basins of attraction; every result has the shape (velocities, rotations).

    - `rotation`, `velocity`: the axes, states at the start [rad], [rad/s].
    - `attractor`: number of the periodic orbit on which the block settles, from 1 in the order of their shares. 0: it
      has not settled, as on a chaotic orbit or a slow way to a periodic one; -1: it overturned; -2: it was not computed
      (see `status`).
    - `orbits`: for each orbit its states once a period, rotation [rad] and angular velocity [rad/s], (period, 2).
    - `final`: the `StroboscopicState`s after all periods.
    """

    rotation: Float[Array, " columns"]
    velocity: Float[Array, " rows"]
    attractor: Int[Array, "rows columns"]
    orbits: tuple[Float[Array, "_ 2"], ...]
    final: StroboscopicState = eqx.field(repr=False)

    @property
    def status(self) -> Status:
        """The `Status` of each start."""
        return self.final.status

    @property
    def shares(self) -> dict[int, float]:
        """Share of the starts by the numbers of `attractor` [-]."""
        numbers, counts = np.unique(np.asarray(self.attractor), return_counts=True)
        return {int(number): float(count) / self.attractor.size for number, count in zip(numbers, counts)}

    @property
    def _columns(self):
        over = ("velocity", "rotation")
        told = {"rotation": Column(("rotation",), self.rotation, "rad")}
        told |= {"velocity": Column(("velocity",), self.velocity, "rad/s"), "attractor": Column(over, self.attractor)}
        for name, unit in {"rotation": "rad", "velocity": "rad/s"}.items():
            told[f"final_{name}"] = Column(over, getattr(self.final, name), unit)
        return told | {"overturned": Column(over, self.final.overturned), "status": Column(over, self.status)}


@arguments
def basins(
    block: Block | AsymmetricBlock,
    motion: AbstractMotion,
    rotation: Values,
    velocity: Values,
    model: AbstractEquation = Housner(),
    *,
    periods: Annotated[int, at_least(1, 10**5)] = 60,
    engine: AbstractEngine | None = None,
    progress: bool | None = None,
) -> Basins:
    """Compute on which periodic orbit a block settles under a motion that repeats, over its state at the start.

    **Arguments:**

    - `block`, `model`, `engine`: as in `outcome`.
    - `motion`: one period of the motion, as in `stroboscopic_map`.
    - `rotation`: (columns,) rotations at the start [rad], in (-pi/2, pi/2).
    - `velocity`: (rows,) angular velocities at the start [rad/s].
    - `periods`: number of periods in which to settle, from 1 to 1e5. States within 1e-4 of the slenderness after these
      count as one, which is followed for ten times as many more.
    - `progress`: whether to draw a progress bar; None: on a terminal, if it takes long.

    **Returns:** `Basins`.

    **Raises:** ValueError for arguments outside their ranges, and for traced ones.
    """
    say_if_single()
    check_single(block=block, motion=motion)
    rotation, velocity = axis("rotation", rotation, _rotation), axis("velocity", velocity, _velocity)
    check_known(block=block, motion=motion, rotation=rotation, velocity=velocity)
    model = current_model(model, block, motion, rotation)
    scene = block, motion, model, engine, jnp.asarray(periods, jnp.int32)
    final = surface(_final, (velocity, rotation), scene, "basins", progress)
    attractor, orbits = _settled(final, scene, _size(block))
    return Basins(rotation, velocity, jnp.asarray(attractor), orbits, final)


@cheap_per_point
def _final(velocity, rotation, scene) -> StroboscopicState:
    return _after(velocity, rotation, scene[-1], scene)


@cheap_per_point
def _after(velocity, rotation, periods, scene) -> StroboscopicState:
    block, motion, model, engine, *_ = scene
    kind = jnp.result_type(*jax.tree.leaves((block, motion)), rotation, velocity)
    return after_turns(block, motion, (rotation.astype(kind), velocity.astype(kind)), model, periods, engine)


def _size(block: Block | AsymmetricBlock) -> np.ndarray:
    """Return the scales of rotation [rad] and angular velocity [rad/s]."""
    alpha, p = (block.alpha, block.p) if isinstance(block, Block) else (block.alpha1, block.p1)
    return np.asarray([alpha, alpha * p], float)


def _settled(final: StroboscopicState, scene: tuple, size: np.ndarray) -> tuple[np.ndarray, tuple]:
    """Return the number of the orbit of every state, and the orbits."""
    from jaxrock.studies.settled_states import AWAY, orbits_of  # SciPy's trees take long to import

    def images(starts, periods):
        rotation, velocity = (starts * size).T
        found = known_surface(_after, (velocity, rotation, periods), scene, "basins", False, outer=False)
        image = np.asarray(found.state, float) / size
        return np.where(np.isfinite(image), image, AWAY)

    status, overturned = np.asarray(final.status == Status.successful), np.asarray(final.overturned)
    attractor = np.where(status, np.where(overturned, -1, 0), -2)
    stands = attractor == 0
    if not stands.any():
        return attractor, ()
    states = np.asarray(final.state, float)[stands] / size
    attractor[stands], orbits = orbits_of(states, int(scene[-1]), images, np.finfo(final.rotation.dtype).eps)
    return attractor, tuple(jnp.asarray(orbit * size) for orbit in orbits)
