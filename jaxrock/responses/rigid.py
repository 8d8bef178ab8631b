"""What a block does under a motion: `simulate` gives its history, `outcome` only what came of it."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Inexact, Int

from jaxrock._checks import Values, as_real, checked, scalar
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.rigid import Block
from jaxrock.engines.diffrax.arcs import Diffrax
from jaxrock.engines.scene import Scene, check_single
from jaxrock.engines.state import State, initial_state, surpasses
from jaxrock.engines.stepper import AbstractEngine, AbstractStepper
from jaxrock.engines.taylor.careful import Series
from jaxrock.engines.taylor.fast import glance, has_many_pieces, most_steps
from jaxrock.models.equation import AbstractEquation
from jaxrock.models.rigid import Housner
from jaxrock.motions.motion import AbstractMotion
from jaxrock.responses.current_model import current_model
from jaxrock.status import Status
from jaxrock.transforms.batching import Passes
from jaxrock.transforms.differentiation import differentiable

Scalar = Inexact[ArrayLike, "..."]


class Outcome(eqx.Module):
    """What came of a scene: the motion, and the free stage after it to its end.

    - `max_rotation`: largest |rotation| [rad]; infinite if the block overturned.
    - `max_velocity`: largest |angular velocity| [rad/s]; infinite if the block overturned.
    - `time_of_max`: when `max_rotation` was reached [s]; infinite if the block overturned.
    - `impact_count`: impacts during the motion, and the one after it if that one decides the verdict. The
      impacts without end of a block that comes to rest are counted down to hops of rounding height.
    - `overturned`: the verdict.
    - `margin`: signed distance to overturning [-]: positive safe, negative overturned, zero on the boundary.
    - `differentiable`: whether the derivatives of `max_rotation` are those of a smooth function here: not where two
      peaks tie, or where before the peak an impact is grazed (both within 1e-9); nor if the block overturned. Where an
      impact or the uplift falls on a jump of the motion, and in a tie, derivatives are those of one side.
    - `clearance`: how far from a graze the block has been before the peak [rad]: the least height at which it turned
      back before the ground, or the least depth to which it would have come where it hit the ground while being slowed
      down; infinite if there was neither. Where it is zero the number of impacts changes.
    - `error`: estimated standard error of `max_rotation` from rounding and tolerance [rad]; infinite if overturned.
    - `status`: a `Status`. With any other than successful the numbers are not results.

    The margin is the smallest squared distance from standing still in balance (Voyagaki et al. 2012, 3.11),
    (velocity/p sin alpha)^2 + (acceleration/p^2 sin alpha)^2, over turning points and crossings of the
    unstable equilibrium, the acceleration with or without the shaking, whichever is larger; if the block overturned,
    its negative over those since the last outward crossing. It is at most 1, except for a block that never uplifts:
    2 - bound of the acceleration/threshold. In a free linear stage it is 1 - E/E_crit. (In the linear model
    alpha stands for sin alpha.)
    Its sign is the verdict's; it passes through zero smoothly where a block comes to balance on its corner, and
    jumps where the shaking itself throws a stocky block flat, or where an impact or a turning point is only just
    grazed. Of an asymmetric block it is the smaller of both sides'; where a block that just stands on its stronger
    side comes back to fall on the other, it touches zero from below and jumps. Long after the start of a record the
    passage through zero can be narrower than the last digit.
    """

    max_rotation: Scalar
    max_velocity: Scalar
    time_of_max: Scalar
    impact_count: Int[Array, "..."]
    overturned: Bool[Array, "..."]
    margin: Scalar
    differentiable: Bool[Array, "..."]
    clearance: Scalar
    error: Scalar
    status: Status


class Response(eqx.Module):
    """The history of a scene; call it with times to evaluate it anywhere: `rotation, velocity = response(t)`.

    - `time`, `rotation`, `velocity`: (samples,) equally spaced history [s], [rad], [rad/s].
    - `impact_times`, `impact_velocities`: of every impact [s] and just before it [rad/s].
    - `peak_times`, `peak_rotations`: of every turning point [s], [rad].
    - `impact_count`, `max_rotation` [rad], `time_of_max` [s], `max_velocity` [rad/s]: within the duration.
    - `overturned`, `margin`, `status`: as in `Outcome`; the verdict looks beyond a duration that covers the motion.

    Under jit or vmap the arrays of impacts and peaks have fixed length: times are filled up with inf, values
    with 0. Outside they hold the events alone.
    """

    time: Inexact[Array, "..."]
    rotation: Inexact[Array, "..."]
    velocity: Inexact[Array, "..."]
    impact_count: Int[Array, "..."]
    max_rotation: Scalar
    max_velocity: Scalar
    time_of_max: Scalar
    overturned: Bool[Array, "..."]
    margin: Scalar
    status: Status
    duration: Scalar
    stepper: AbstractStepper
    nodes: State  # every step's start, one axis more; nodes past the last repeat it at time inf
    node_times: Inexact[Array, "..."]
    impacted: Bool[Array, "..."]

    def __call__(self, time: Values) -> tuple[Inexact[Array, "..."], Inexact[Array, "..."]]:
        """Rotation and angular velocity.

        **Arguments:**

        - `time`: any shape, in [0, duration] [s].

        **Returns:** rotation [rad] and angular velocity [rad/s], of the shape of `time`, to the accuracy of the
        steps themselves; at an impact the velocity after it. A block that has fallen lies still.

        **Raises:** ValueError for a time outside the history.
        """
        self._check_single()
        end = self.duration * (1 + 1e-12)  # a time computed as the duration may round past it
        time = checked("time", time, "be in the history [0, duration]", lambda t: (t >= 0) & (t <= end))
        return _evaluate(self, time)

    def _check_single(self):
        if jnp.ndim(self.node_times) > 1:
            raise ValueError("This response holds many scenes: call it, and read its events, inside jax.vmap.")

    def _events(self, times, values, found):
        """Events in order; trimmed to their number where that is known."""
        order = jnp.argsort(jnp.where(found, times, jnp.inf), stable=True)
        times, values = jnp.where(found, times, jnp.inf)[order], jnp.where(found, values, 0.0)[order]
        if _traced(found):
            return times, values
        count = int(found.sum())
        return times[:count], values[:count]

    def _impacts(self):
        def one(nodes, impacted, p):
            return nodes.impact_time, nodes.impact_velocity * p, impacted

        return self._gather(one)

    def _peaks(self):
        def one(nodes, impacted, p):
            found = (nodes.velocity == 0) & (nodes.side != 0) & (nodes.opening > 0)
            return self.node_times, nodes.side * nodes.opening, found & jnp.isfinite(self.node_times)

        return self._gather(one)

    def _gather(self, one):
        self._check_single()
        return self._events(*one(self.nodes, self.impacted, self.stepper.scene.p))

    @property
    def impact_times(self) -> Inexact[Array, " impacts"]:
        """Times of the impacts [s]."""
        return self._impacts()[0]

    @property
    def impact_velocities(self) -> Inexact[Array, " impacts"]:
        """Angular velocities just before the impacts [rad/s]."""
        return self._impacts()[1]

    @property
    def peak_times(self) -> Inexact[Array, " peaks"]:
        """Times of the turning points [s]."""
        return self._peaks()[0]

    @property
    def peak_rotations(self) -> Inexact[Array, " peaks"]:
        """Rotations at the turning points [rad]."""
        return self._peaks()[1]


def _traced(value) -> bool:
    return isinstance(value, jax.core.Tracer)


def outcome(
    block: Block | AsymmetricBlock,
    motion: AbstractMotion,
    model: AbstractEquation = Housner(),
    *,
    initial: tuple[ArrayLike, ArrayLike] = (0.0, 0.0),
    engine: AbstractEngine | None = None,
) -> Outcome:
    """What becomes of a rigid block under a motion and in the free stage after it: `jaxrock.outcome` tells more."""
    return _outcome(block, motion, current_model(model, block, motion), _start(initial), _engine(engine, model))


def simulate(
    block: Block | AsymmetricBlock,
    motion: AbstractMotion,
    model: AbstractEquation = Housner(),
    *,
    initial: tuple[ArrayLike, ArrayLike] = (0.0, 0.0),
    duration: ArrayLike | None = None,
    engine: AbstractEngine | None = None,
    samples: int = 2001,
) -> Response:
    """The history of a rigid block under a motion: `jaxrock.simulate` tells more."""
    if samples < 2:
        raise ValueError(f"Argument `samples` must be at least 2, but is {samples}.")
    if duration is not None:
        duration = checked("duration", duration, "be positive and finite", lambda t: (t > 0) & (t < np.inf))
        duration = scalar("duration", duration)
    model = current_model(model, block, motion)
    response = _simulate(block, motion, model, _start(initial), duration, _engine(engine, model))
    time = jnp.linspace(jnp.zeros_like(response.duration), response.duration, samples)
    rotation, velocity = _evaluate(response, time)
    return eqx.tree_at(lambda r: (r.time, r.rotation, r.velocity), response, (time, rotation, velocity))


def _engine(engine: AbstractEngine | None, model: AbstractEquation) -> AbstractEngine:
    if engine is not None:
        return engine
    return Diffrax() if not model.is_series else Series()


_warned = False


def _start(initial: tuple[ArrayLike, ArrayLike]) -> tuple[Scalar, Scalar]:
    """Check the initial state, and warn once where numbers are single precision by default."""
    global _warned
    if not jax.config.jax_enable_x64 and not _warned:
        _warned = True
        warnings.warn(
            "jaxrock runs in single precision here: expect 5 digits. For 13, put "
            '`jax.config.update("jax_enable_x64", True)` before the first computation.',
            stacklevel=4,
        )
    rotation, velocity = initial
    rotation = checked(
        "initial[0]", rotation, "be a rotation in (-pi/2, pi/2)", lambda x: (x > -np.pi / 2) & (x < np.pi / 2)
    )
    return scalar("initial[0]", rotation), scalar("initial[1]", as_real("initial[1]", velocity))


@jax.jit
def _outcome(block, motion, model, initial, engine) -> Outcome:
    def run(scene):
        return _follow(*scene, engine, taped=False)

    def on_tape(scene):
        return _follow(*scene, engine, taped=True)

    scene = block, motion, model, initial
    if engine.reverse:
        return run(scene)
    check_single(block, motion)
    passes = _passes(engine, has_many_pieces(motion.knots.size - 1)) if isinstance(engine, Series) else None
    return differentiable(run, on_tape, passes)(scene)


def _passes(engine: Series, rounds: bool) -> Passes:
    """The outcome in parts; in rounds where some blocks are lost long before others."""

    def begin(scene):
        block, motion, model, initial = scene
        scene = Scene.of(block, motion, model)
        stepper = engine.stepper(scene, jnp.full_like(scene.p, jnp.inf), history=False)
        return stepper, initial_state(scene, *(jnp.asarray(x, scene.p.dtype) for x in initial))

    def conclude(stepper, state):
        found = _conclude(stepper, state)
        return found, found.status != Status.successful

    return Passes(
        begin=begin,
        quickly=glance,
        carefully=lambda stepper, state: _to_the_end(engine, stepper, state),
        unfinished=lambda stepper, state: ~state.done & (state.steps < most_steps(stepper.scene.pieces)),
        conclude=conclude,
        round=256 if rounds else None,
    )


def _follow(block, motion, model, initial, engine, taped: bool) -> Outcome:
    scene = Scene.of(block, motion, model)
    stepper = engine.stepper(scene, jnp.full_like(scene.p, jnp.inf), history=False, taped=taped)
    state = initial_state(scene, *(jnp.asarray(x, scene.p.dtype) for x in initial))
    if taped:
        # A tape holds all steps, as a history does.
        state, _ = stepper.on_tape(state, engine.budget(scene, history=True))
    else:
        state = _to_the_end(engine, stepper, state)
    return _conclude(stepper, state)


def _to_the_end(engine: AbstractEngine, stepper: AbstractStepper, state: State) -> State:
    """Follow a block to the end of the motion."""
    budget = engine.budget(stepper.scene, history=False)
    return engine.loop(lambda s: ~s.done & (s.steps < budget), lambda s: stepper.advance(s), state, budget)


def _conclude(stepper: AbstractStepper, state: State) -> Outcome:
    """Add the free stage to a state at the end of the motion (or where the block was lost)."""
    final = stepper.finish(state)
    overturned = final.overturned

    def unless_overturned(value):
        return jnp.where(overturned, jnp.inf, value)

    tie = final.peak - final.second <= 1e-9 * final.peak
    graze = final.peak_clearance <= 1e-9 * stepper.scene.alpha
    return Outcome(
        differentiable=~(tie & (final.peak > 0)) & ~graze & ~overturned,
        clearance=jnp.where(overturned, final.clearance, final.peak_clearance),
        max_rotation=unless_overturned(final.peak),
        max_velocity=unless_overturned(final.fastest * stepper.scene.p),
        time_of_max=unless_overturned(final.peak_time),
        impact_count=final.impacts,
        overturned=overturned,
        margin=jnp.where(overturned, -final.closeness_beyond, final.closeness),
        error=unless_overturned(final.error),
        status=Status.where(state.done, final.status, Status.step_budget_exhausted),
    )


@jax.jit
def _simulate(block, motion, model, initial, duration, engine) -> Response:
    stop = motion.end + 10 / block.p if duration is None else jnp.asarray(duration)

    def run(scene):
        return _steps(*scene, engine, taped=False)

    def on_tape(scene):
        return _steps(*scene, engine, taped=True)

    run = run if engine.reverse else differentiable(run, on_tape)
    state, nodes, final = run((block, motion, model, initial, stop))
    scene = Scene.of(block, motion, model)
    stepper, budget = engine.stepper(scene, stop, history=True), nodes.steps.size - 1
    index = jnp.arange(budget + 1)
    times = jax.vmap(stepper.time)(nodes)
    times = jnp.where(index <= state.steps, times, jnp.inf)
    impacted = jnp.diff(nodes.impacts, prepend=0) > 0
    # The largest within the duration: the end may be on the way to a peak.
    higher = surpasses(state.opening, state.peak)
    lost = final.overturned
    return Response(
        time=times[:2],
        rotation=times[:2],
        velocity=times[:2],
        impact_count=state.impacts,
        max_rotation=jnp.where(lost, jnp.inf, jnp.maximum(state.peak, state.opening)),
        max_velocity=jnp.where(lost, jnp.inf, state.fastest * scene.p),
        time_of_max=jnp.where(lost, jnp.inf, jnp.where(higher, stepper.time(state), state.peak_time)),
        overturned=lost,
        margin=final.margin,
        status=final.status,
        duration=stop,
        stepper=stepper,
        nodes=nodes,
        node_times=times,
        impacted=impacted & (index <= state.steps),
    )


def _steps(block, motion, model, initial, stop, engine, taped: bool) -> tuple[State, State, Outcome]:
    """The state at the end of a history, the states before all steps (and after the last), and what came of it."""
    scene = Scene.of(block, motion, model)
    stop = stop.astype(scene.p.dtype)
    stepper, budget = engine.stepper(scene, stop, history=True, taped=taped), engine.budget(scene, history=True)
    state = initial_state(scene, *(jnp.asarray(x, scene.p.dtype) for x in initial))
    if taped:
        state, nodes = stepper.on_tape(state, budget)
        nodes = jax.tree.map(lambda x, last: jnp.concatenate([x, last[None]])[: budget + 1], nodes, state)
        return state, nodes, _conclude(stepper, state)
    nodes = jax.tree.map(lambda x: jnp.zeros((budget + 1,) + x.shape, x.dtype), state)

    def store(nodes, state):
        return jax.tree.map(lambda buffer, x: buffer.at[state.steps].set(x), nodes, state)

    def step(carry):
        state, nodes = carry
        state = stepper.advance(state)
        return state, store(nodes, state)

    state, nodes = engine.loop(
        lambda carry: ~carry[0].done & (carry[0].steps < budget), step, (state, store(nodes, state)), budget
    )
    return state, nodes, _conclude(stepper, state)


@jax.jit
def _evaluate(response: Response, time):
    """Follow the block from the node before each time."""
    stepper = response.stepper

    def at(t):
        index = jnp.clip(jnp.searchsorted(response.node_times, t, side="right") - 1, 0, response.node_times.size - 1)
        node = jax.tree.map(lambda x: x[index], response.nodes)
        opening, speed = stepper.evaluate(node, jnp.minimum(t, response.duration) - response.node_times[index])
        # The last node is the end of the history: the block lies, rests, or is caught in motion there.
        lies = node.done & (node.opening >= jnp.pi / 2)
        velocity = jnp.where(node.done, node.velocity * stepper.scene.p, speed)
        velocity = jnp.where(lies, 0.0, velocity)
        return node.side * jnp.where(node.done, node.opening, opening), node.side * velocity

    rotation, velocity = jax.vmap(at)(time.ravel())
    return rotation.reshape(time.shape), velocity.reshape(time.shape)
