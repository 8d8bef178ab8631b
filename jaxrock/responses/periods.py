"""The state of a block after whole periods of a motion that repeats.

The steps are those of an outcome. Every period starts from the state at the end of the one before, and its error with
it, until that error has outgrown the state.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from jaxrock._core.types import Flag, Real, Scalar
from jaxrock.compiler import TwoPass, lane_function
from jaxrock.compiler.hints import select
from jaxrock.engines.scene import Scene
from jaxrock.engines.state import State, all_moving, initial_state
from jaxrock.engines.stepper import AbstractStepper
from jaxrock.engines.taylor.accurate import Series
from jaxrock.engines.taylor.fast_loop import fast_loop
from jaxrock.engines.uncertainty import StateCovariance
from jaxrock.status import Status

KNOWN_TO = 1e-4  # standard error over the slenderness up to which a state is known


class AfterPeriods(eqx.Module):
    """Rotation [rad], angular velocity [rad/s] and counts after whole periods; see `StroboscopicState`."""

    rotation: Real
    velocity: Real
    overturned: Bool[Array, "..."]
    impact_count: Int[Array, "..."]
    known_periods: Int[Array, "..."]
    status: Status


class _Turn(NamedTuple):
    """The state of a block in one period."""

    state: State
    left: Int[Array, ""]  # periods to come, this one included
    impacts: Int[Array, ""]  # of the periods before
    known: Int[Array, ""]  # periods after which the error was small
    lost: Flag  # the error has outgrown the state

    @property
    def goes_on(self) -> Flag:
        return (self.left > 0) & ~self.state.overturned & (self.state.status == Status.successful)


@jax.jit
def after_periods(block, motion, model, start, periods, engine) -> AfterPeriods:
    """Return the state after `periods` repetitions of a motion, from rotation [rad] and angular velocity [rad/s]."""
    given = block, motion, model, start, periods, engine
    if engine.reverse:
        return _by_steps(given)
    if not isinstance(engine, Series):
        return lane_function(_by_steps, key="periods", results=_like, in_lanes=True)(given)
    return lane_function(_Passes(), key="periods", results=_like)(given)


def _like(given) -> AfterPeriods:
    """Return the shapes and dtypes of a result, from its inputs."""

    def made():
        real = jnp.zeros((), jnp.result_type(*jax.tree.leaves(given[:2])))
        flag, count = jnp.zeros((), bool), jnp.zeros((), jnp.int32)
        return AfterPeriods(real, real, flag, count, count, Status.where(flag, Status.undecided, Status.successful))

    return jax.eval_shape(made)


class _Passes(TwoPass):
    """The periods in two passes."""

    def init(self, tree):
        return _begun(tree)

    def fast(self, point, state, limit):
        def followed(turn):
            return _next_period(point, turn._replace(state=fast_loop(point, turn.state, limit)))

        return jax.lax.while_loop(lambda turn: turn.goes_on, followed, state)

    def accurate(self, point, state):
        return _followed(point, state)

    def unfinished(self, point, state):
        return state.goes_on

    def result(self, point, state):
        found = _result(point, state)
        return found, found.status != Status.successful


def _by_steps(given) -> AfterPeriods:
    return _followed(*_begun(given))


def _begun(given) -> tuple[Any, _Turn]:
    block, motion, model, start, periods, engine = given
    scene = Scene.of(block, motion, model)
    scene = replace(scene, outlook=scene.outlook.repeated)
    state = initial_state(scene, *(jnp.asarray(x, scene.p.dtype) for x in start))
    none = jnp.zeros((), jnp.int32)
    turn = _Turn(all_moving(_without_extremes(state), scene), periods, none, none, jnp.zeros((), bool))
    if isinstance(engine, Series):
        return engine.stepper(scene, None, history=False), turn
    return engine.stepper(scene, scene.motion.end, history=True), turn  # else it follows the free stage, too


def _without_extremes(state: State) -> State:
    """Return the state as if its peak and velocity had been infinite: no step searches for larger ones."""
    return replace(state, peak=jnp.full_like(state.peak, jnp.inf), fastest=jnp.full_like(state.fastest, jnp.inf))


def _followed(stepper: AbstractStepper, turn: _Turn) -> AfterPeriods:
    def period(turn):
        return _next_period(stepper, turn._replace(state=stepper.to_the_end(turn.state)))

    return _result(stepper, jax.lax.while_loop(lambda turn: turn.goes_on, period, turn))


def _next_period(stepper: AbstractStepper, turn: _Turn) -> _Turn:
    """Return the state at the start of the period after one that has been followed to its end."""
    state, scene = turn.state, stepper.scene
    lost = turn.lost | ~(state.spread.square <= (KNOWN_TO * scene.alpha) ** 2)
    following = _without_extremes(initial_state(scene, *_seen(state, scene)))
    spread = StateCovariance.where(lost, following.spread, state.spread)
    status = Status.where(state.done, state.status, Status.step_budget_exhausted)
    status = Status.where(status == Status.successful, following.status, status)
    goes_on = (status == Status.successful) & ~state.overturned
    following = replace(following, spread=spread, steps=jnp.zeros_like(state.steps))
    following = replace(following, overturned=state.overturned)
    # A block that has fallen, or could not be followed, stays as it is.
    kept = replace(state, status=status, impacts=jnp.zeros_like(state.impacts))
    return _Turn(
        jax.tree.map(lambda a, b: select(goes_on, a, b), following, kept),
        turn.left - 1,
        turn.impacts + state.impacts,
        select(lost, turn.known, turn.known + 1),
        lost,
    )


def _seen(state: State, scene: Scene) -> tuple[Scalar, Scalar]:
    """Return rotation [rad] and angular velocity [rad/s]."""
    return state.side * state.opening, state.side * state.velocity * scene.p


def _result(stepper: AbstractStepper, turn: _Turn) -> AfterPeriods:
    state = turn.state
    rotation, velocity = _seen(state, stepper.scene)
    fell, known = state.overturned, state.status == Status.successful

    def told(value):
        value = select(fell, state.side * jnp.inf, value)
        return select(known, value, jnp.nan)

    return AfterPeriods(told(rotation), told(velocity), fell & known, turn.impacts, turn.known, state.status)
