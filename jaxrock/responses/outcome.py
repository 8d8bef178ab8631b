"""The outcome of a block under a motion: peak, verdict, margin."""

from typing import Annotated, overload

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
from jaxrock.compiler.hints import select
from jaxrock.engines.scene import Scene
from jaxrock.engines.state import ROUNDING, State, all_moving, initial_state
from jaxrock.engines.stepper import AbstractEngine, AbstractStepper
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
    - `overturned`: the verdict.
    - `margin`: signed distance to overturning [-]: positive safe, negative overturned, zero on the boundary.
    - `differentiable`: whether `max_rotation` is a smooth function here. It is not where two peaks tie, where an impact
      before the peak is grazed, or if the block overturned. Ties and grazes count within 1e-9, in single precision
      within 5e-4, of the peak and of the slenderness angle. Where an impact or the uplift falls on a jump of the
      motion, and in a tie, derivatives are those of one side.
    - `clearance`: distance from a graze before the peak [rad]: the least height at which the block turned back before
      the ground, or the least depth to which it would have come where it hit the ground while being slowed down. It is
      infinite if there was neither. Where it is zero the number of impacts changes.
    - `error`: estimated standard error of `max_rotation` from rounding and tolerance [rad]; infinite if overturned.
    - `status`: a `Status`. With any other than successful the numbers are not results.

    The margin is the smallest squared distance from standing still in balance (Voyagaki et al. 2012, 3.11), (velocity/p
    sin alpha)^2 + (acceleration/p^2 sin alpha)^2, over turning points and crossings of the unstable equilibrium. The
    acceleration is that with or without the shaking, whichever is larger. If the block overturned, the margin is the
    negative distance over those since the last outward crossing.

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
    overturned: Bool[Array, "..."]
    margin: Real
    differentiable: Bool[Array, "..."]
    clearance: Real
    error: Real
    status: Status

    @property
    def _columns(self):
        units = {"max_rotation": "rad", "max_velocity": "rad/s", "time_of_max": "s", "clearance": "rad", "error": "rad"}
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
    - `model`: `Housner()` (nonlinear), `Linear()`, a `Spring(...)`, an `Equation` or `AbstractEquation` of your own.
    - `initial`: rotation [rad] and angular velocity [rad/s] at time 0.
    - `duration`: time for which to follow a `FlexibleBlock` [s], positive; None: the motion and 10/p of free rocking. A
      rigid block is followed to its end.
    - `engine`: `Series(...)` or `Diffrax(...)`; None takes `Series()`, for an `Equation` or `Rolling` `Diffrax()`, of
      tolerance 1e-10 under a record.
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
    given = *in_real_numbers(block, motion), model, start_of(initial, throw)
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
        return _by_steps(scene)
    check_single(block=block, motion=motion)
    if not isinstance(engine, Series):
        return lane_function(
            _by_steps, reverse=_on_tape, key="outcome", results=outcome_like, in_lanes=True, refill=True
        )(scene)
    passes = _OutcomePasses(rounds=POLICY.is_record(motion.knots.size - 1))
    return lane_function(passes, reverse=_on_tape, key="outcome", results=outcome_like)(scene)


def _by_steps(scene) -> Outcome:
    return _to_outcome(*scene, taped=False)


def _on_tape(scene) -> Outcome:
    return _to_outcome(*scene, taped=True)


def outcome_like(scene) -> Outcome:
    """Return the shapes and dtypes of an outcome, from its inputs."""

    def made():
        real, count = jnp.zeros((), jnp.result_type(*jax.tree.leaves(scene[:2]))), jnp.zeros((), jnp.int32)
        flag = count == 0
        return Outcome(real, real, real, count, flag, real, flag, real, real, Status.successful)

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
        return stepper, all_moving(state, scene)

    def fast(self, point, state, limit):
        return fast_loop(point, state, limit)

    def accurate(self, point, state):
        return point.to_the_end(state)

    def unfinished(self, point, state):
        return ~state.done & (state.steps < most_steps(point.scene.most_pieces))

    def result(self, point, state):
        result = conclude(point, state)
        return result, result.status != Status.successful


def _to_outcome(block, motion, model, initial, engine, *, taped: bool) -> Outcome:
    scene = Scene.of(block, motion, model)
    stepper = engine.stepper(scene, None, history=False, taped=taped)
    state = initial_state(scene, *(jnp.asarray(x, scene.p.dtype) for x in initial))
    return conclude(stepper, stepper.end_on_tape(state) if taped else stepper.to_the_end(all_moving(state, scene)))


def has_one_peak(peak: Real, second: Real, clearance: Real, alpha: Real) -> Bool[Array, "..."]:
    """Return whether neither another peak ties with the highest, nor an impact is grazed before it."""
    equal = max(1e-9, ROUNDING * float(jnp.finfo(peak.dtype).eps))
    tie = (peak - second <= equal * peak) & (peak > 0)
    return ~tie & ~(clearance <= equal * alpha)


def conclude(stepper: AbstractStepper, state: State) -> Outcome:
    """Add the free stage to a state at the end of the motion (or where the block was lost)."""
    final = stepper.finish(state)
    overturned = final.overturned

    def unless_overturned(value):
        return select(overturned, jnp.inf, value)

    # A block that stands still in balance goes nowhere, however many steps it takes.
    eps = jnp.finfo(state.closeness.dtype).eps
    unfinished = Status.where(state.closeness > eps, Status.step_budget_exhausted, Status.undecided)
    is_smooth = has_one_peak(final.peak, final.second, final.peak_clearance, stepper.scene.alpha)
    margin = select(overturned, -final.closeness_beyond, final.closeness)
    status = Status.where(state.done, final.status, unfinished)
    return Outcome(
        differentiable=is_smooth & ~overturned,
        clearance=select(overturned, final.clearance, final.peak_clearance),
        max_rotation=unless_overturned(final.peak),
        max_velocity=unless_overturned(final.fastest * stepper.scene.p),
        time_of_max=unless_overturned(final.peak_time),
        impact_count=final.impacts,
        overturned=overturned,
        margin=margin,
        error=unless_overturned(final.error),
        status=Status.where(jnp.isnan(margin), Status.not_finite, status),
    )
