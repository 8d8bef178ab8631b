"""The history of a block under a motion."""

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Any, overload

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Inexact, Int

from jaxrock._arguments.annotations import arguments, at_least, pair
from jaxrock._arguments.ranges import scalar, span
from jaxrock._arguments.tables import AbstractTable, over_time
from jaxrock._core.arrays import Values
from jaxrock._core.one_program import by_numpy_or_one_program
from jaxrock._core.precision import say_if_single
from jaxrock._core.settings import called_by_users
from jaxrock._core.throwing import throwing
from jaxrock._core.types import Real
from jaxrock.blocks.flexible import FlexibleBlock
from jaxrock.blocks.rigid import Block
from jaxrock.compiler import checks, lane_function
from jaxrock.compiler.hints import jit_low_effort
from jaxrock.engines.scene import Scene
from jaxrock.engines.state import Node, State
from jaxrock.engines.stepper import AbstractEngine, AbstractStepper
from jaxrock.engines.taylor.accurate import Series
from jaxrock.engines.trajectory import Trajectory, at_times, times_of
from jaxrock.flexible.response import FlexibleResponse, simulate_flexible
from jaxrock.models.equation import AbstractEquation
from jaxrock.motions.motion import AbstractMotion
from jaxrock.motions.record import padded
from jaxrock.numerics.derivatives_of import with_derivatives_of
from jaxrock.responses.arguments import USUAL, AnyBlock, RigidBlock, engine_of, start_of, steps_of_flexible
from jaxrock.responses.compile_setup import numbers_of, with_numbers
from jaxrock.responses.current_model import current_model, standing
from jaxrock.responses.steps import Summary, history_like, started, steps_followed, steps_on_tape, with_copies
from jaxrock.status import Status, still_if_none


class Response(AbstractTable):
    """The history of a scene; call it with times to evaluate it anywhere: `rotation, velocity = response(t)`.

    - `time`, `rotation`, `velocity`: (samples,) equally spaced history [s], [rad], [rad/s].
    - `impact_times`, `impact_velocities`: of every impact [s] and just before it [rad/s].
    - `peak_times`, `peak_rotations`: of every turning point [s], [rad].
    - `impact_count`, `large_impact_count`, `max_rotation` [rad], `time_of_max` [s], `max_velocity` [rad/s]: within the
      duration.
    - `overturned`, `overturned_share`, `margin`, `error` [rad], `status`: as in `Outcome`; the verdict looks beyond a
      duration that covers the motion.
    - `known_until`: time after which the history is one of many that errors of the computation allow [s].

    Where the step budget ended the history early (see `status`), later rotations and velocities are NaN. Under jit or
    vmap the arrays of impacts and peaks have fixed length: times are padded with inf, values with 0. Outside they hold
    the events alone.
    """

    time: Inexact[Array, "..."]
    rotation: Inexact[Array, "..."]
    velocity: Inexact[Array, "..."]
    summary: Summary
    trajectory: Trajectory = eqx.field(repr=False)

    @property
    def _columns(self):
        return over_time(self.time, {"rotation": (self.rotation, "rad"), "velocity": (self.velocity, "rad/s")})

    @called_by_users
    def __call__(self, time: Values) -> tuple[Inexact[Array, "..."], Inexact[Array, "..."]]:
        """Return rotation and angular velocity.

        **Arguments:**

        - `time`: any shape, between 0 and duration [s].

        **Returns:** rotation [rad] and angular velocity [rad/s], of the shape of `time`, to the accuracy of the steps
        themselves; at an impact the velocity after it. A block that has fallen lies still. A linear equation, which has
        no horizontal position, stops it where no forcing to come could bring it back.

        **Raises:** ValueError for a time outside the history.
        """
        return _evaluate(self.trajectory, self.trajectory.checked(time))

    @property
    def impact_count(self) -> Int[Array, "..."]:
        """Number of impacts within the duration."""
        return self.summary.impact_count

    @property
    def large_impact_count(self) -> Int[Array, "..."]:
        """Number of impacts within the duration that are faster than a fall from a rotation of 1e-6 alpha."""
        return self.summary.large_impact_count

    @property
    def max_rotation(self) -> Real:
        """Largest |rotation| within the duration [rad]; infinite if the block overturned."""
        return self.summary.max_rotation

    @property
    def max_velocity(self) -> Real:
        """Largest |angular velocity| within the duration [rad/s]; infinite if the block overturned."""
        return self.summary.max_velocity

    @property
    def time_of_max(self) -> Real:
        """Time of `max_rotation` [s]."""
        return self.summary.time_of_max

    @property
    def overturned(self) -> Bool[Array, "..."]:
        """The verdict, which looks beyond a duration that covers the motion."""
        return self.summary.overturned

    @property
    def overturned_share(self) -> Real:
        """Share that overturns of the motions that errors of the computation allow [-]."""
        return self.summary.overturned_share

    @property
    def error(self) -> Real:
        """Estimated standard error of the largest rotation [rad]; infinite if the block overturned."""
        return self.summary.error

    @property
    def known_until(self) -> Real:
        """Time after which the history is one of many that errors of the computation allow [s]; else infinite."""
        return self.summary.known_until

    @property
    def margin(self) -> Real:
        """Signed distance to overturning [-], as in `Outcome`."""
        return self.summary.margin

    @property
    def status(self) -> Status:
        """The `Status` of the computation: any other than successful invalidates the numbers."""
        return self.summary.status

    @property
    def duration(self) -> Inexact[Array, "..."]:
        """Length of the history [s]."""
        return self.trajectory.duration

    @property
    def scene(self) -> Scene:
        """The scene that was simulated."""
        return self.trajectory.stepper.scene

    @property
    def _impacts(self) -> tuple:
        return self.trajectory.events(_impacts_of)

    @property
    def _peaks(self) -> tuple:
        return self.trajectory.events(_peaks_of)

    @property
    def impact_times(self) -> Inexact[Array, " impacts"]:
        """Times of the impacts [s]."""
        return self._impacts[0]

    @property
    def impact_velocities(self) -> Inexact[Array, " impacts"]:
        """Angular velocities just before the impacts [rad/s]."""
        return self._impacts[1]

    @property
    def peak_times(self) -> Inexact[Array, " peaks"]:
        """Times of the turning points [s]."""
        return self._peaks[0]

    @property
    def peak_rotations(self) -> Inexact[Array, " peaks"]:
        """Rotations at the turning points [rad]."""
        return self._peaks[1]


# Functions for the argument `told` of `Trajectory.events`.


def _impacts_of(xp: Any, path: Trajectory) -> tuple:
    nodes = path.nodes
    velocities = nodes.impact_velocity * path.stepper.scene.p
    return path.impacted, nodes.impact_time, (nodes.impact_time, xp.inf), (velocities, 0.0)


def _peaks_of(xp: Any, path: Trajectory) -> tuple:
    nodes = path.nodes.start
    turned = (nodes.velocity == 0) & (nodes.side != 0) & (nodes.opening > 0) & xp.isfinite(path.times)
    # A step through a zero-length piece leaves a block that turns in place.
    stays = turned[:-1] & (nodes.opening[1:] == nodes.opening[:-1])
    turned = turned & ~xp.concatenate([turned[:1] & False, stays])
    return turned, path.times, (path.times, xp.inf), (nodes.side * nodes.opening, 0.0)


@overload
def simulate(
    block: RigidBlock,
    motion: AbstractMotion,
    model: AbstractEquation = ...,
    *,
    initial: tuple[ArrayLike, ArrayLike] = ...,
    duration: ArrayLike | None = ...,
    engine: AbstractEngine | None = ...,
    samples: int = ...,
    throw: bool = ...,
) -> Response: ...


@overload
def simulate(
    block: FlexibleBlock,
    motion: AbstractMotion,
    *,
    duration: ArrayLike | None = ...,
    engine: AbstractEngine | None = ...,
    samples: int = ...,
    throw: bool = ...,
) -> FlexibleResponse: ...


@arguments
def simulate(
    block: AnyBlock,
    motion: AbstractMotion,
    model: AbstractEquation = USUAL,
    *,
    initial: Annotated[tuple[ArrayLike, ArrayLike], pair] = (0.0, 0.0),
    duration: ArrayLike | None = None,
    engine: AbstractEngine | None = None,
    samples: Annotated[int, at_least(2, 10**7)] = 2001,
    throw: bool = True,
) -> Response | FlexibleResponse:
    """Compute the history of a block under a motion.

    **Arguments:**

    - `block`, `motion`, `model`, `initial`, `engine`, `throw`: as in `outcome`.
    - `duration`: time for which to follow the block [s], positive; None: the motion and 10/p of free rocking.
    - `samples`: number of equally spaced points of the ready-made history, at least 2; a call of the result gives any
      other time.

    **Returns:** a `Response`; of a flexible block a `FlexibleResponse`.

    **Raises:** ValueError for arguments outside their ranges, or that do not apply.
    """
    if isinstance(block, FlexibleBlock):
        budget = steps_of_flexible(model, initial, engine)
        return simulate_flexible(block, motion, duration=duration, samples=samples, throw=throw, **budget)
    if duration is not None:
        with throwing(throw):
            duration = scalar("duration", span("duration", duration))
    say_if_single()
    model = current_model(model, block, motion)
    engine = engine_of(engine, model, motion)
    given = block, motion, model, start_of(initial, throw, block), duration
    block, motion, model, start, duration = given if throw else still_if_none(given)
    given = standing(block, model, engine, throw), padded(motion), model, start, duration
    block, motion, model, start, duration = given if throw else still_if_none(given)
    summary, path = _simulate(block, motion, model, start, duration, engine)
    summary = with_copies((block, motion, model, start, path.duration, engine), summary)
    time = path.equally_spaced(samples)
    rotation, velocity = _evaluate(path, time)
    response = Response(time, rotation, velocity, summary, path)
    return response if throw else checks.nan_where_inputs_are(response, given)


@jit_low_effort(follows_scenes=True)
def _simulate(block, motion, model, initial, duration, engine) -> tuple[Summary, Trajectory]:
    p = block.p if isinstance(block, Block) else block.p1
    stop = motion.end + 10 / p if duration is None else jnp.asarray(duration)
    told = block, motion, model, initial, stop, engine
    run = (
        steps_followed
        if engine.reverse
        else lane_function(steps_followed, reverse=steps_on_tape, key="history", results=history_like)
    )
    steps, nodes, summary, numbers = run(told)
    stepper, _ = started(told)
    stepper = with_numbers(stepper, with_derivatives_of(numbers, numbers_of(stepper)))
    impacted = (jnp.diff(nodes.impacts, prepend=0) > 0) & (jnp.arange(nodes.done.size) <= steps)
    return summary, Trajectory(stepper, nodes, times_of(stepper.time, nodes.start, steps), impacted, stop)


@by_numpy_or_one_program()
def _evaluate(path: Trajectory, time):
    """Evaluate rotation [rad] and angular velocity [rad/s] at times."""
    return _after_nodes(path.stepper, *path.before(time, path.nodes.start), path.duration, time.shape)


@jit_low_effort(follows_scenes=True, static_argnames="shape")
def _after_nodes(stepper: AbstractStepper, node, elapsed, duration, shape):
    return at_times(evaluation(stepper), node, elapsed, duration, shape)


def evaluation(stepper: AbstractStepper) -> Callable:
    """Return `at(node, elapsed)`: rotation [rad] and angular velocity [rad/s], `elapsed` seconds after a node and
    before the next."""
    if stepper.engine.reverse:
        return lambda node, elapsed: _at((stepper, Node.of(node), elapsed))
    stepper = _moving_in_evaluation(stepper)
    in_lanes = stepper.engine.in_lanes
    at = lane_function(
        _at,
        reverse=_at,
        key="evaluation",
        results=lambda given: (given[2], given[2]),
        in_lanes=in_lanes,
        mode="jacobian by columns",
    )

    def found(node: Node | State, elapsed):
        moving = {name: getattr(node, name) for name in ("local", "opening", "velocity")}
        return at((stepper, replace(jax.lax.stop_gradient(Node.of(node)), **moving), elapsed))

    return found


def _moving_in_evaluation(stepper: AbstractStepper) -> AbstractStepper:
    """Return the stepper with tangents only in the fields that an evaluation depends on."""
    scene, still = stepper.scene, jax.lax.stop_gradient(stepper)
    moving = {name: getattr(scene, name) for name in ("moments", "far", "p", "motion", "knots", "scales")}
    moved: Any = {"scene": replace(still.scene, **moving)}  # a field of all that are no base
    return replace(still, **moved)


def _at(given) -> tuple[Real, Real]:
    """Return rotation [rad] and angular velocity [rad/s] at a time after a node."""
    stepper, node, elapsed = given
    opening, speed = stepper.evaluate(node, elapsed)
    # The last node is the end of the history: the block lies, rests, or is caught in motion there.
    lies = node.done & (node.opening >= jnp.pi / 2)
    caught = with_derivatives_of((node.opening, node.velocity * stepper.scene.p), (opening, speed))
    opening, speed = (jnp.where(node.done, end, x) for end, x in zip(caught, (opening, speed)))
    if isinstance(stepper.engine, Series):  # Diffrax locates an impact only to its tolerance
        # Hops of rounding height, by which a block comes to rest, are no steps: it lies there. Rounding of an impact
        # time is excluded.
        rounding = 64 * float(jnp.finfo(opening.dtype).eps)
        hops = opening < -rounding * (stepper.scene.alpha + jnp.abs(speed) * (stepper.time(node) + elapsed))
        opening, speed = jnp.where(hops, 0.0, opening), jnp.where(hops, 0.0, speed)
    return node.side * jnp.where(lies, node.opening, opening), node.side * jnp.where(lies, 0.0, speed)
