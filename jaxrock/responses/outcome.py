"""The outcome of a block under a motion: peak, verdict, margin."""

import functools
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Annotated, Any, overload

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Int

from jaxrock._arguments.annotations import arguments, pair
from jaxrock._arguments.parameters import check_single, in_real_numbers
from jaxrock._arguments.tables import AbstractTable, Column, scenes
from jaxrock._core.precision import say_if_single
from jaxrock._core.types import Real
from jaxrock.blocks.flexible import FlexibleBlock
from jaxrock.compiler import TwoPass, checks, lane_function
from jaxrock.compiler.hints import stop_gradient
from jaxrock.engines.conclusion import Conclusion, conclude
from jaxrock.engines.copies import TOLD, conclude_with_copies
from jaxrock.engines.scene import Scene
from jaxrock.engines.state import State, all_moving, initial_state
from jaxrock.engines.stepper import AbstractEngine
from jaxrock.engines.taylor.accurate import Series
from jaxrock.engines.taylor.fast_loop import fast_loop, most_steps
from jaxrock.engines.taylor.policy import POLICY
from jaxrock.flexible.response import outcome_flexible
from jaxrock.flexible.stepper import FlexibleOutcome
from jaxrock.models.equation import AbstractEquation
from jaxrock.motions.joined_records import is_in_place
from jaxrock.motions.motion import AbstractMotion
from jaxrock.motions.record import padded
from jaxrock.responses.arguments import USUAL, AnyBlock, RigidBlock, engine_of, start_of, steps_of_flexible
from jaxrock.responses.current_model import current_model, standing
from jaxrock.status import Status, still_if_none


class Outcome(AbstractTable):
    """Outcome of a scene: the motion, and the free stage after it to its end.

    - `max_rotation`: largest |rotation| [rad]; infinite if the block overturned.
    - `max_velocity`: largest |angular velocity| [rad/s]; infinite if the block overturned.
    - `time_of_max`: time of `max_rotation` [s]; infinite if the block overturned.
    - `impact_count`: impacts during the motion, and those after it if the block overturns after them (one, of an
      asymmetric block up to two). The infinitely many impacts of a block that comes to rest are counted down to hops of
      rounding height.
    - `large_impact_count`: of these, the impacts faster than a fall from a rotation of 1e-6 alpha.
    - `overturned`: the verdict.
    - `overturned_share`: share that overturns [-] of the motions that errors of the computation allow: 0 or 1 where the
      verdict holds.
    - `margin`: signed distance to overturning [-]: positive safe, negative overturned, zero on the boundary.
    - `differentiable`: whether `max_rotation` is a smooth function here. It is not where two peaks tie, where an impact
      before the peak is grazed, or if the block overturned. Ties and grazes count within 1e-9, in single precision
      within 5e-4, of the peak and of the slenderness angle. Where an impact or the uplift falls on a jump of the
      motion, and in a tie, derivatives are those of one side.
    - `clearance`: distance from a graze before the peak [rad]: the least height at which the block turned back before
      the ground, or the least depth to which it would have come where it hit the ground while being slowed down. It is
      infinite if there was neither. Where it is zero the number of impacts changes.
    - `error`: estimated standard error of `max_rotation` from rounding and tolerance [rad]; infinite if overturned.
    - `known_until`: time after which the block follows one of many motions that errors of the computation allow [s];
      infinite if there is none. Impacts after it are those of one of these motions.
    - `status`: a `Status`. With any other than successful the numbers are not results.

    The margin is the smallest squared distance from standing still in balance (Voyagaki et al. 2012, 3.11), (velocity/p
    sin alpha)^2 + (acceleration/p^2 sin alpha)^2, over turning points and crossings of the unstable equilibrium. The
    acceleration is that with or without the shaking, whichever is larger. If the block overturned, the margin is the
    negative distance over those since the last outward crossing. Where the restoring moment of an equation of your own
    or a rounded edge rises at first, its changes up to the balance, rises and falls, stand for the acceleration.

    It is at most 1, except for a block that never uplifts: 2 - bound of the acceleration/threshold. In a free linear
    stage it is 1 - E/E_crit. (In the linear model alpha stands for sin alpha.)

    Its sign is the verdict's. It passes through zero smoothly where a block comes to balance on its corner. It jumps
    where the shaking itself throws a stocky block flat, or where an impact or a turning point is only just grazed.

    For an asymmetric block it is the smaller of both sides'. Where a block that just stands on its stronger side comes
    back to fall on the other, it touches zero from below and jumps. Long after the start of a record the passage
    through zero can be narrower than the last digit.
    """

    max_rotation: Real
    max_velocity: Real
    time_of_max: Real
    impact_count: Int[Array, "..."]
    large_impact_count: Int[Array, "..."]
    overturned: Bool[Array, "..."]
    overturned_share: Real
    margin: Real
    differentiable: Bool[Array, "..."]
    clearance: Real
    error: Real
    known_until: Real
    status: Status

    @property
    def _columns(self):
        units = {"max_rotation": "rad", "max_velocity": "rad/s", "time_of_max": "s", "clearance": "rad", "error": "rad"}
        units["known_until"] = "s"
        axes = scenes(self.max_rotation.ndim)
        return {name: Column(axes, getattr(self, name), units.get(name, "-")) for name in self.__dataclass_fields__}


@overload
def outcome(
    block: RigidBlock,
    motion: AbstractMotion,
    model: AbstractEquation = ...,
    *,
    initial: tuple[ArrayLike, ArrayLike] = ...,
    engine: AbstractEngine | None = ...,
    throw: bool = ...,
) -> Outcome: ...


@overload
def outcome(
    block: FlexibleBlock,
    motion: AbstractMotion,
    *,
    duration: ArrayLike | None = ...,
    engine: AbstractEngine | None = ...,
    throw: bool = ...,
) -> FlexibleOutcome: ...


@arguments
def outcome(
    block: AnyBlock,
    motion: AbstractMotion,
    model: AbstractEquation = USUAL,
    *,
    initial: Annotated[tuple[ArrayLike, ArrayLike], pair] = (0.0, 0.0),
    duration: ArrayLike | None = None,
    engine: AbstractEngine | None = None,
    throw: bool = True,
) -> Outcome | FlexibleOutcome:
    """Compute the outcome of a block under a motion and in the free stage after it.

    **Arguments:**

    - `block`: a `Block`, `AsymmetricBlock` or `FlexibleBlock` of scalars (use `jax.vmap` for many).
    - `motion`: any motion, with a vertical one if it has one (`with_vertical`); the ground rests after its end.
    - `model`: `Housner()` (nonlinear), `Linear()`, a `Spring(...)`, a `Mechanism(...)` with its own block, an
      `Equation` or `AbstractEquation` of your own.
    - `initial`: rotation [rad] and angular velocity [rad/s] at time 0.
    - `duration`: time for which to follow a `FlexibleBlock` [s], positive; None: the motion and 10/p of free rocking. A
      rigid block is followed to its end.
    - `engine`: `Series(...)` or `Diffrax(...)`; None takes `Series()`, for an `Equation`, `Mechanism` or `Rolling`
      `Diffrax()`, of tolerance 1e-10 under a record.
    - `throw`: whether a number outside of its range raises. False, for trial steps of optimisers: the outcome is NaN,
      its derivatives are zero, and its status is `Status.not_finite`. Make block and motion with `throw=False`, too.

    **Returns:** an `Outcome`; of a flexible block, to which `model` and `initial` do not apply, a `FlexibleOutcome`.

    **Raises:** ValueError for arguments outside their ranges, or that do not apply; arrays where scalars are wanted.
    """
    if isinstance(block, FlexibleBlock):
        settings = steps_of_flexible(model, initial, engine)
        return outcome_flexible(block, motion, duration=duration, throw=throw, **settings)
    if duration is not None:
        raise ValueError(
            "Argument `duration` does not apply to the outcome of a rigid block, which is followed to its end: use "
            "`simulate`."
        )
    say_if_single()
    model, engine = current_model(model, block, motion), engine_of(engine, model, motion)
    given = *in_real_numbers(block, motion), model, start_of(initial, throw, block)
    block, motion, model, start = given if throw else still_if_none(given)
    block = standing(block, model, engine, throw)
    in_place = isinstance(engine, Series) and is_in_place(motion)
    given = block, motion if in_place else padded(motion), model, start
    result = _outcome(*(given if throw else still_if_none(given)), engine)
    return result if throw else checks.nan_where_inputs_are(result, given)


@jax.jit
def _outcome(block, motion, model, initial, engine) -> Outcome:
    scene = block, motion, model, initial, engine
    if engine.reverse:
        return _in_reverse(scene)
    check_single(block=block, motion=motion)
    if not isinstance(engine, Series):
        return lane_function(
            _by_steps, reverse=_in_reverse, key="outcome", results=outcome_like, in_lanes=True, refill=True
        )(scene)
    passes = _OutcomePasses(rounds=POLICY.is_record(motion.knots.size - 1))
    return lane_function(passes, reverse=_in_reverse, key="outcome", results=outcome_like)(scene)


def _by_steps(scene) -> Outcome:
    *_, engine = scene
    stepper, state = _begun(scene, engine.stepper)
    return _outcome_of(conclude_with_copies(stepper, all_moving(state, stepper.scene)))


def _in_reverse(scene) -> Outcome:
    """Compute the outcome so that reverse mode goes through its steps; what copies tell comes without derivatives."""
    *given, engine = scene
    taped = not engine.reverse
    stepper, state = _begun(scene, functools.partial(engine.stepper, taped=taped))
    state = stepper.end_on_tape(stepper.begun(state)) if taped else stepper.to_the_end(all_moving(state, stepper.scene))
    found = _outcome_of(conclude(stepper, state))

    def with_copies():
        told = _outcome(*stop_gradient(given), engine.forward)
        return {name: getattr(told, name) for name in TOLD}

    told = {name: stop_gradient(getattr(found, name)) for name in TOLD}
    told = jax.lax.cond(found.status == Status.undecided, with_copies, lambda: told)
    return replace(found, **told)


def _begun(scene, stepper_of: Callable) -> tuple[Any, State]:
    block, motion, model, initial, _ = scene
    scene = Scene.of(block, motion, model)
    return stepper_of(scene, None, history=False), initial_state(
        scene, *(jnp.asarray(x, scene.p.dtype) for x in initial)
    )


def outcome_like(scene) -> Outcome:
    """Return the shapes and dtypes of an outcome, from its inputs."""

    def made():
        real = jnp.zeros((), jnp.result_type(*jax.tree.leaves(scene[:2])))
        return _outcome_of(Conclusion.blank(real))

    return jax.eval_shape(made)


class _OutcomePasses(TwoPass):
    """The outcome in two passes, with rounds where some blocks are lost long before others."""

    def __init__(self, rounds: bool):
        self.round = POLICY.round if rounds else None

    def init(self, tree):
        block, motion, model, initial, engine = tree
        scene = Scene.of(block, motion, model, in_place=True)
        stepper = engine.stepper(scene, None, history=False)
        state = initial_state(scene, *(jnp.asarray(x, scene.p.dtype) for x in initial))
        return stepper, stepper.begun(all_moving(state, scene))

    def fast(self, point, state, limit):
        return fast_loop(point, state, limit)

    def accurate(self, point, state):
        return _outcome_of(conclude_with_copies(point, state))

    def unfinished(self, point, state):
        return ~state.done & (state.steps < most_steps(point.scene))

    def result(self, point, state):
        result = _outcome_of(conclude(point, state))
        return result, result.status != Status.successful


def _outcome_of(found: Conclusion) -> Outcome:
    return Outcome(**{field.name: getattr(found, field.name) for field in fields(Conclusion)})
