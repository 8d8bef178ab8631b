"""The response of a flexible block to a motion: `simulate_flexible` gives its history, `outcome_flexible` the
outcome."""

from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Inexact, Int

from jaxrock._arguments.annotations import arguments, at_least
from jaxrock._arguments.parameters import check_single
from jaxrock._arguments.ranges import scalar, span
from jaxrock._arguments.tables import AbstractTable, over_time
from jaxrock._core.arrays import Values
from jaxrock._core.one_program import by_numpy_or_one_program
from jaxrock._core.precision import say_if_single
from jaxrock._core.settings import called_by_users
from jaxrock._core.throwing import throwing
from jaxrock._core.types import Real
from jaxrock.blocks.flexible import FlexibleBlock
from jaxrock.compiler import checks, lane_function
from jaxrock.compiler.hints import jit_low_effort
from jaxrock.engines.trajectory import Trajectory, at_times, followed, times_of
from jaxrock.flexible.nonlinear import scene_of
from jaxrock.flexible.stepper import FlexibleOutcome, FlexibleScene
from jaxrock.motions.mirrored import has_vertical
from jaxrock.motions.motion import AbstractMotion
from jaxrock.status import Status, still_if_none


class FlexibleResponse(AbstractTable):
    """The history of a flexible block; call it with times to evaluate it anywhere.

    - `time`, `rotation`, `displacement`, `bending`: (samples,) [s], base rotation [rad], displacement of the top
      relative to the ground [m], the part of it that is bending [m].
    - `impact_times` [s], `impact_modes`: (impacts, modes) share of each clamped mode in the energy after an impact.
    - `outcome`: a `FlexibleOutcome`; `max_rotation` [rad], `impact_count`, `overturned`, `status`: its own.
    """

    time: Inexact[Array, "..."]
    rotation: Inexact[Array, "..."]
    displacement: Inexact[Array, "..."]
    bending: Inexact[Array, "..."]
    outcome: FlexibleOutcome
    trajectory: Trajectory = eqx.field(repr=False)

    @property
    def _columns(self):
        units = {"rotation": "rad", "displacement": "m", "bending": "m"}
        return over_time(self.time, {name: (getattr(self, name), unit) for name, unit in units.items()})

    @called_by_users
    def __call__(self, time: Values) -> tuple[Inexact[Array, "..."], Inexact[Array, "..."], Inexact[Array, "..."]]:
        """Return base rotation [rad], displacement of the top [m], and its bending part [m].

        **Arguments:**

        - `time`: any shape, between 0 and duration [s].

        **Returns:** three arrays of the shape of `time`. A block that has fallen lies still.

        **Raises:** ValueError for a time outside the history.
        """
        return _at_times(self.trajectory, self.trajectory.checked(time), "outputs")[:3]

    @called_by_users
    def column(self, time: Values) -> Inexact[Array, "..."]:
        """Return the displacements of the masses relative to the ground [m], from the base (which stays) to the top.

        **Arguments:**

        - `time`: any shape, between 0 and duration [s].

        **Returns:** an array of one axis more than `time`, of length `masses`.

        **Raises:** ValueError for a time outside the history.
        """
        return _at_times(self.trajectory, self.trajectory.checked(time), "column")

    @called_by_users
    def energy(self, time: Values) -> tuple[Inexact[Array, "..."], Inexact[Array, "..."], Inexact[Array, "..."]]:
        """Return kinetic, strain and base's potential energy, of a block 1 m deep [J]."""
        block = self.scene.block
        scale = block.density * block.width * block.height * block.length**2
        parts = _at_times(self.trajectory, self.trajectory.checked(time), "energy")
        return tuple(scale * part for part in parts)

    @property
    def scene(self) -> FlexibleScene:
        """The scene that was simulated."""
        return self.trajectory.stepper

    @property
    def duration(self) -> Inexact[Array, "..."]:
        """Length of the history [s]."""
        return self.trajectory.duration

    @property
    def status(self) -> Status:
        """The `Status` of the computation: any other than successful invalidates the numbers."""
        return self.outcome.status

    @property
    def max_rotation(self) -> Real:
        """Largest |rotation| of the base [rad]; infinite if the block overturned."""
        return self.outcome.max_rotation

    @property
    def impact_count(self) -> Int[Array, "..."]:
        """Impacts within the duration."""
        return self.outcome.impact_count

    @property
    def overturned(self) -> Bool[Array, "..."]:
        """The verdict, which looks beyond a duration that covers the motion."""
        return self.outcome.overturned

    @property
    def impact_times(self) -> Inexact[Array, " impacts"]:
        """Times of the impacts [s]; under jit filled up with inf."""
        return self.trajectory.events(_impacts_of)[0]

    @property
    def impact_modes(self) -> Inexact[Array, "impacts modes"]:
        """Share of each clamped mode of the column in the energy just after each impact [-].

        With P-Delta the modes are those of the column under its weight, about the balance.
        """
        return self.trajectory.events(_modes_of)[0]


def _impacts_of(xp: Any, path: Trajectory) -> tuple:
    return path.impacted, path.times, (path.times, xp.inf)


def _modes_of(_, path: Trajectory) -> tuple:
    return path.impacted, path.times, (_shares(path.nodes.motion, path.stepper.numbers.squares), 0.0)


@jax.jit
def _shares(motion: Real, squares: Real) -> Real:
    """Return the share of each mode in the energy at each step."""
    q, v = jnp.split(motion[:, :-1], 2, axis=1)
    energies = v**2 + squares * q**2
    total = energies.sum(1, keepdims=True)
    return energies / jnp.where(total > 0, total, 1.0)


@arguments
def outcome_flexible(
    block: FlexibleBlock,
    motion: AbstractMotion,
    *,
    duration: ArrayLike | None = None,
    max_steps: Annotated[int | None, at_least(1, 10**9)] = None,
    throw: bool = True,
) -> FlexibleOutcome:
    """Compute the outcome of a flexible block under a motion.

    **Arguments:**

    - `block`: a `FlexibleBlock` of scalars (use `jax.vmap` for many).
    - `motion`: any horizontal motion; the ground rests after its end.
    - `duration`: time for which to follow the block [s], positive; None: the motion and 10/p of free rocking.
    - `max_steps`: budget of steps besides four for each piece of the motion, at least 1. None: 4,096, or 32,768 where
      phases are not linear (then every vibration that matters takes about a step a cycle).
    - `throw`: as in `outcome`.

    **Returns:** a `FlexibleOutcome`. Its derivatives (forward and reverse) by block and motion are exact. Where the
    block is still rocking at the end, the modes about the balance give the verdict. That is exact where phases are
    linear, and near the balance where they are not.

    **Raises:** ValueError for arguments outside their ranges.
    """
    say_if_single()
    given = _given(block, motion, duration, throw)
    result = _outcome(*given, _budget(block, motion, max_steps))
    return result if throw else checks.nan_where_inputs_are(result, given)


@arguments
def simulate_flexible(
    block: FlexibleBlock,
    motion: AbstractMotion,
    *,
    duration: ArrayLike | None = None,
    samples: Annotated[int, at_least(2, 10**7)] = 2001,
    max_steps: Annotated[int | None, at_least(1, 10**9)] = None,
    throw: bool = True,
) -> FlexibleResponse:
    """Compute the history of a flexible block under a motion.

    **Arguments:**

    - `block`, `motion`, `duration`, `max_steps`, `throw`: as in `outcome_flexible`.
    - `samples`: number of equally spaced points of the ready-made history, at least 2; a call of the result gives any
      other time.

    **Returns:** a `FlexibleResponse`.

    **Raises:** ValueError for arguments outside their ranges.
    """
    say_if_single()
    given = _given(block, motion, duration, throw)
    result, path = _simulate(*given, _budget(block, motion, max_steps))
    time = path.equally_spaced(samples)
    rotation, displacement, bending = _at_times(path, time, "outputs")[:3]
    response = FlexibleResponse(time, rotation, displacement, bending, result, path)
    return response if throw else checks.nan_where_inputs_are(response, given)


def _given(
    block: FlexibleBlock, motion: AbstractMotion, duration: ArrayLike | None, throw: bool
) -> tuple[FlexibleBlock, AbstractMotion, Real]:
    """Check the arguments, and return block, motion and duration."""
    if throw:
        return block, motion, _duration(block, motion, duration, throw)
    block, motion = still_if_none((block, motion))
    return still_if_none((block, motion, _duration(block, motion, duration, throw)))


def _duration(block: FlexibleBlock, motion: AbstractMotion, duration: ArrayLike | None, throw: bool) -> Real:
    check_single(block=block, motion=motion)
    if has_vertical(motion):
        raise ValueError(
            "Argument `motion` must not be vertical for a FlexibleBlock, whose base does not weigh anything."
        )
    if duration is None:
        return motion.end + 10 / block.p
    with throwing(throw):
        return scalar("duration", span("duration", duration))


def _budget(block: FlexibleBlock, motion: AbstractMotion, max_steps: int | None) -> int:
    usual = 4096 if block.is_linear else 32_768
    return (max_steps or usual) + 4 * motion.knots.size


@jit_low_effort(static_argnames="budget")
def _outcome(block, motion, stop, budget: int) -> FlexibleOutcome:
    def run(given):
        scene = scene_of(*given)
        state = jax.lax.while_loop(lambda s: ~s.done & (s.steps < budget), lambda s: scene.advance(s), scene.start())
        return scene.conclude(state)

    return lane_function(run)((block, motion, stop))


@jit_low_effort(static_argnames="budget")
def _simulate(block, motion, stop, budget: int) -> tuple[FlexibleOutcome, Trajectory]:
    def loop(unfinished, step, carry, budget):
        return jax.lax.while_loop(unfinished, step, carry)

    def run(given):
        scene = scene_of(*given)
        state, nodes = followed(lambda s: scene.advance(s), scene.start(), budget, loop)
        times = times_of(scene.time, nodes, state.steps)
        impacted = nodes.impacted & (jnp.arange(times.size) > 0) & jnp.isfinite(times)
        return scene.conclude(state), Trajectory(scene, nodes, times, impacted, given[-1])

    # A full Jacobian of all steps by every sample of a record would be too large.
    return lane_function(run, mode="jacobian or jvp")((block, motion, stop))


@by_numpy_or_one_program(static_argnums=2)
def _at_times(path: Trajectory, time, what: str):
    """Evaluate outputs, displacements of the masses, or energies, at times."""
    return _after_nodes(path.stepper, *path.before(time, path.nodes), path.duration, time.shape, what)


@jit_low_effort(static_argnames=("shape", "what"))
def _after_nodes(scene, node, elapsed, duration, shape, what: str):
    reach = jnp.cos(scene.numbers.alpha) * scene.block.length
    scales = jnp.array([1.0, 0, 0, 1.0]) + jnp.array([0.0, 1, 1, 0]) * reach

    def follow(node, elapsed):
        curve, length, _, _ = scene.arc(node)
        # The last node is the end of the history, but the derivative by time passes through it.
        x = jnp.where(node.done, elapsed - jax.lax.stop_gradient(elapsed), elapsed) / length
        if what == "outputs":
            return tuple(curve.outputs(x) * scales)
        state = curve.state(x)
        return scene.energy(state) if what == "energy" else reach * scene.column(state)

    return at_times(follow, node, elapsed, duration, shape)
