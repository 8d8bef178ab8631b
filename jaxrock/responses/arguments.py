"""Checks of arguments that `outcome` and `simulate` share: the kind of the block, the initial state, the engine."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from jaxrock._arguments.parameters import check_single
from jaxrock._arguments.ranges import checked, scalar, strength
from jaxrock._core.arrays import as_real, is_traced, shown
from jaxrock._core.throwing import throwing
from jaxrock._core.types import Scalar
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.flexible import FlexibleBlock
from jaxrock.blocks.rigid import Block
from jaxrock.engines.stepper import AbstractEngine
from jaxrock.engines.taylor.accurate import Series
from jaxrock.engines.taylor.policy import POLICY
from jaxrock.models.equation import AbstractEquation
from jaxrock.models.rigid import Housner
from jaxrock.motions.motion import AbstractMotion

RigidBlock = Block | AsymmetricBlock
AnyBlock = RigidBlock | FlexibleBlock

USUAL = Housner()  # the default model of a rigid block


def engine_of(engine: AbstractEngine | None, model: AbstractEquation, motion: AbstractMotion) -> AbstractEngine:
    """Return the engine given, or the default of the model.

    Under a record, steps run from sample to sample, however loose the tolerance; a tight one decides more scenes, in
    the same time.
    """
    if engine is not None:
        return engine
    if model.is_series:
        return Series()
    from jaxrock.engines.diffrax.arcs import Diffrax  # the import takes a fifth of a second

    check_single(motion=motion)
    return Diffrax(rtol=1e-10) if POLICY.is_record(motion.knots.size - 1) else Diffrax()


def start_of(
    initial: tuple[ArrayLike, ArrayLike], throw: bool = True, block: AnyBlock | None = None
) -> tuple[Scalar, Scalar]:
    """Check initial rotation and angular velocity; without `throw`, invalid values become NaN.

    A `block` that opens to one side starts at rest or on that side.
    """
    if all(isinstance(x, float) and x == 0 for x in initial):
        return _at_rest(jnp.result_type(float))
    with throwing(throw):
        start = _start_of(initial)
        side = block.only_side if isinstance(block, Block) else None
        return start if side is None else _on_side(start, side)


_usual: dict[np.dtype, tuple[Scalar, Scalar]] = {}


def _at_rest(precision: np.dtype) -> tuple[Scalar, Scalar]:
    """Return the default start, in the session's default precision. To make it takes a tenth of an outcome's time."""
    if precision in _usual:
        return _usual[precision]
    made = as_real("initial[0]", 0.0), as_real("initial[1]", 0.0)
    if not is_traced(made):  # JAX traces constants within some transformations
        _usual[precision] = made
    return made


def _start_of(initial: tuple[ArrayLike, ArrayLike]) -> tuple[Scalar, Scalar]:
    rotation, velocity = initial
    rotation = checked(
        "initial[0]", rotation, "be a rotation in (-pi/2, pi/2)", lambda x: (x > -np.pi / 2) & (x < np.pi / 2)
    )
    velocity = as_real("initial[1]", velocity)
    if not isinstance(velocity, jax.core.Tracer):  # a status reports traced values that are not finite
        velocity = strength("initial[1]", velocity)
    return scalar("initial[0]", rotation), scalar("initial[1]", velocity)


def _on_side(start: tuple[Scalar, Scalar], side: int) -> tuple[Scalar, Scalar]:
    rotation, velocity = start
    allowed, way = f"be {'0 or more' if side > 0 else '0 or less'}, as the wall opens to that side", float(side)
    rotation = checked("initial[0]", rotation, allowed, lambda x: ~(way * x < 0))
    if not is_traced(start) and float(np.asarray(rotation)) == 0:  # a status reports traced values
        velocity = checked("initial[1]", velocity, f"{allowed}, where it stands", lambda x: ~(way * x < 0))
    return rotation, velocity


def steps_of_flexible(
    model: AbstractEquation, initial: tuple[ArrayLike, ArrayLike], engine: AbstractEngine | None
) -> dict[str, int]:
    """Return the step budget for a flexible block; raise ValueError for arguments that do not apply to one."""
    if model is not USUAL:
        raise ValueError("Argument `model` does not apply to a FlexibleBlock, whose equation is its own.")
    start_of(initial)  # raises for an invalid start
    # NumPy compares: within `jax.jit` a comparison by JAX is traced, even of concrete values.
    if is_traced(initial) or any(np.asarray(x) != 0 for x in initial):
        raise ValueError(
            f"Argument `initial` must be (0, 0) for a FlexibleBlock, which starts at rest, but is {shown(initial)}."
        )
    if engine is None:
        return {}
    if not isinstance(engine, Series) or engine.order is not None or engine.tolerance is not None:
        raise ValueError(
            "Argument `engine` must be None or Series(max_steps=...) for a FlexibleBlock, whose phases are solved in "
            f"closed form, but is {shown(engine)}."
        )
    return {} if engine.max_steps is None else {"max_steps": engine.max_steps}
