"""The stroboscopic map: the state of a block once a period of a motion that repeats."""

from typing import Annotated

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Inexact, Int

from jaxrock._arguments.annotations import arguments, at_least, pair
from jaxrock._arguments.parameters import check_single, in_real_numbers
from jaxrock._arguments.tables import AbstractTable, Column, scenes
from jaxrock._core.precision import say_if_single
from jaxrock._core.types import Real, Scalar
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.rigid import Block
from jaxrock.compiler import checks
from jaxrock.engines.stepper import AbstractEngine
from jaxrock.models.equation import AbstractEquation
from jaxrock.models.rigid import Housner
from jaxrock.motions.motion import AbstractMotion
from jaxrock.motions.record import padded
from jaxrock.responses.arguments import engine_of, start_of
from jaxrock.responses.current_model import current_model, standing
from jaxrock.responses.periods import after_periods
from jaxrock.status import Status, still_if_none


class StroboscopicState(AbstractTable):
    """The state of a block after whole periods of a motion that repeats.

    - `rotation`: [rad]; `velocity`: angular velocity [rad/s]. Both are infinite if the block overturned, with the sign
      of the side to which it fell.
    - `overturned`: the verdict: no later period can bring the block back.
    - `impact_count`: impacts in all periods, or until the block was lost.
    - `known_periods`: number of periods after which the state was known to 1e-4 of the slenderness. Where it is less
      than the number of all, later states are those of one of many motions that errors of the computation allow: a
      point of a chaotic orbit, but not that of this start.
    - `status`: a `Status`. With any other than successful rotation and velocity are NaN.
    """

    rotation: Real
    velocity: Real
    overturned: Bool[Array, "..."]
    impact_count: Int[Array, "..."]
    known_periods: Int[Array, "..."]
    status: Status

    @property
    def state(self) -> Inexact[Array, "... 2"]:
        """Rotation [rad] and angular velocity [rad/s] as one array, of shape (..., 2)."""
        return jnp.stack([self.rotation, self.velocity], axis=-1)

    @property
    def _columns(self):
        units = {"rotation": "rad", "velocity": "rad/s"}
        axes = scenes(self.rotation.ndim)
        return {name: Column(axes, getattr(self, name), units.get(name, "-")) for name in self.__dataclass_fields__}


@arguments
def stroboscopic_map(
    block: Block | AsymmetricBlock,
    motion: AbstractMotion,
    state: Annotated[tuple[ArrayLike, ArrayLike] | Inexact[Array, " 2"], pair] = (0.0, 0.0),
    model: AbstractEquation = Housner(),
    *,
    periods: Annotated[int, at_least(1, 10**6)] = 1,
    engine: AbstractEngine | None = None,
    throw: bool = True,
) -> StroboscopicState:
    """Compute the state of a block after whole periods of a motion that repeats.

    **Arguments:**

    - `block`, `model`, `engine`, `throw`: as in `outcome`; under `jax.vmap` for many scenes.
    - `motion`: one period of the motion, `HarmonicMotion(amplitude, period, cycles=1)` or any other. It begins again as
      soon as it ends.
    - `state`: rotation [rad] and angular velocity [rad/s] at the start, a pair or an array of shape (2,).
    - `periods`: number of periods, from 1 to 1e6.

    **Returns:** a `StroboscopicState`. Its `state` is differentiable, through impacts, by the state at the start and by
    the parameters of block and motion. Eigenvalues of the derivative by the state at a fixed point are the multipliers
    of a periodic orbit.

    **Raises:** ValueError for arguments outside their ranges; arrays where scalars are wanted.

    **Source:** Hogan (1989), the map of a slender block under harmonic shaking, and its periodic orbits.
    """
    say_if_single()
    rotation, velocity = state
    return after_turns(block, motion, start_of((rotation, velocity), throw), model, periods, engine, throw)


def after_turns(
    block: Block | AsymmetricBlock,
    motion: AbstractMotion,
    start: tuple[Scalar, Scalar],
    model: AbstractEquation,
    periods: int | Int[Array, ""],
    engine: AbstractEngine | None,
    throw: bool = True,
) -> StroboscopicState:
    """Return the state after a number of periods that may be traced, from a start that was checked."""
    model, engine = current_model(model, block, motion), engine_of(engine, model, motion)
    given = *in_real_numbers(block, motion), model, start
    block, motion, model, start = given if throw else still_if_none(given)
    block = standing(block, model, engine, throw)
    check_single(block=block, motion=motion)
    given = block, padded(motion), model, start
    block, motion, model, start = given if throw else still_if_none(given)
    found = after_periods(block, motion, model, start, jnp.asarray(periods, jnp.int32), engine)
    result = StroboscopicState(**{name: getattr(found, name) for name in StroboscopicState.__dataclass_fields__})
    return result if throw else checks.nan_where_inputs_are(result, given)
