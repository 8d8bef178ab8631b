"""What a flexible block does under a motion: `simulate_flexible` gives its history, `outcome_flexible` the outcome."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Inexact, Int

from jaxrock._checks import Values, checked, scalar
from jaxrock.blocks.flexible import FlexibleBlock
from jaxrock.flexible.stepper import FlexibleOutcome, FlexibleScene, FlexibleState
from jaxrock.motions.motion import AbstractMotion
from jaxrock.status import Status
from jaxrock.transforms.differentiation import differentiable

Scalar = Inexact[ArrayLike, "..."]


class FlexibleResponse(eqx.Module):
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
    scene: FlexibleScene
    nodes: FlexibleState  # every step's start
    node_times: Inexact[Array, "..."]

    def __call__(self, time: Values) -> tuple[Inexact[Array, "..."], Inexact[Array, "..."], Inexact[Array, "..."]]:
        """Base rotation [rad], displacement of the top [m], and its bending part [m].

        **Arguments:**

        - `time`: any shape, in [0, duration] [s].

        **Returns:** three arrays of the shape of `time`. A block that has fallen lies still.

        **Raises:** ValueError for a time outside the history.
        """
        rotation, displacement, bending, _ = self._rows(time)
        return rotation, displacement, bending

    def base_moment(self, time: Values) -> Inexact[Array, "..."]:
        """Moment of the base over m g R sin(alpha), at which it unlocks [-].

        Locked: the column's elastic and damping forces times their heights. Rocking: the spring's own moment,
        side - rotation/alpha; because the base has no mass, the same forces balance it. (Without their damping part
        they would not: the elastic ones alone differ from it wherever the column is damped.)
        """
        return self._rows(time)[3] / self.scene.numbers.strength

    def energy(self, time: Values) -> tuple[Inexact[Array, "..."], Inexact[Array, "..."], Inexact[Array, "..."]]:
        """Kinetic, strain and base's potential energy, of a block 1 m deep [J]."""
        block = self.scene.block
        scale = block.density * block.width * block.height * block.length**2
        return tuple(scale * part for part in _along(self, self._checked(time), "energy"))

    def _checked(self, time):
        if self.node_times.ndim > 1:
            raise ValueError("This response holds many scenes: call it inside jax.vmap.")
        end = self.scene.stop * (1 + 1e-12)
        return checked("time", time, "be in the history [0, duration]", lambda t: (t >= 0) & (t <= end))

    def _rows(self, time):
        return _along(self, self._checked(time), "outputs")

    @property
    def status(self) -> Status:
        """What the numbers are worth."""
        return self.outcome.status

    @property
    def max_rotation(self) -> Scalar:
        """Largest |rotation| of the base [rad]; infinite if the block overturned."""
        return self.outcome.max_rotation

    @property
    def impact_count(self) -> Int[Array, "..."]:
        """Impacts within the duration."""
        return self.outcome.impact_count

    @property
    def overturned(self) -> Bool[Array, "..."]:
        """The verdict, which looks beyond the duration."""
        return self.outcome.overturned

    @property
    def _impacts(self):
        return self.nodes.impacted & (jnp.arange(self.node_times.shape[-1]) > 0) & jnp.isfinite(self.node_times)

    @property
    def impact_times(self) -> Inexact[Array, " impacts"]:
        """Times of the impacts [s]; under jit filled up with inf."""
        return self._events(self.node_times, jnp.inf)

    @property
    def impact_modes(self) -> Inexact[Array, "impacts modes"]:
        """Share of each clamped mode of the column in the energy just after each impact [-]."""
        q, v = jnp.split(self.nodes.motion[:, :-1], 2, axis=1)
        energies = v**2 + self.scene.numbers.squares * q**2
        total = energies.sum(1, keepdims=True)
        return self._events(energies / jnp.where(total > 0, total, 1.0), 0.0)

    def _events(self, values, filling):
        found = self._impacts
        order = jnp.argsort(~found, stable=True)
        keep = found.reshape(found.shape + (1,) * (values.ndim - 1))
        values = jnp.where(keep, values, filling)[order]
        return values if isinstance(found, jax.core.Tracer) else values[: int(found.sum())]


def outcome_flexible(
    block: FlexibleBlock, motion: AbstractMotion, *, duration: ArrayLike | None = None, max_steps: int = 4096
) -> FlexibleOutcome:
    """Tell what becomes of a flexible block under a motion.

    **Arguments:**

    - `block`: a `FlexibleBlock` of scalars (use `jax.vmap` for many).
    - `motion`: any horizontal motion; the ground rests after its end.
    - `duration`: how long to follow the block [s], positive; None: the motion and 10/p of free rocking.
    - `max_steps`: budget of steps besides four for each piece of the motion, at least 1.

    **Returns:** a `FlexibleOutcome`. Its derivatives (forward and reverse) by block and motion are exact.

    **Raises:** ValueError for arguments outside their ranges.
    """
    return _outcome(block, motion, _duration(block, motion, duration), _budget(motion, max_steps))


def simulate_flexible(
    block: FlexibleBlock,
    motion: AbstractMotion,
    *,
    duration: ArrayLike | None = None,
    samples: int = 2001,
    max_steps: int = 4096,
) -> FlexibleResponse:
    """Compute the history of a flexible block under a motion.

    **Arguments:**

    - `block`, `motion`, `duration`, `max_steps`: as in `outcome_flexible`.
    - `samples`: number of equally spaced points of the ready-made history, at least 2; any other time is had by
      calling the result.

    **Returns:** a `FlexibleResponse`.

    **Raises:** ValueError for arguments outside their ranges.
    """
    if samples < 2:
        raise ValueError(f"Argument `samples` must be at least 2, but is {samples}.")
    return _simulate(block, motion, _duration(block, motion, duration), samples, _budget(motion, max_steps))


def _duration(block: FlexibleBlock, motion: AbstractMotion, duration: ArrayLike | None) -> Scalar:
    if motion.vertical_bounds is not None:
        raise ValueError(
            "Argument `motion` must not be vertical for a FlexibleBlock, whose base does not weigh anything."
        )
    if duration is None:
        return motion.end + 10 / jnp.sqrt(1.5 * block.gravity / block.length)  # 10/p
    return scalar("duration", checked("duration", duration, "be positive and finite", lambda t: (t > 0) & (t < np.inf)))


def _budget(motion: AbstractMotion, max_steps: int) -> int:
    if max_steps < 1:
        raise ValueError(f"Argument `max_steps` must be at least 1, but is {max_steps}.")
    return max_steps + 4 * motion.knots.size


@eqx.filter_jit
def _outcome(block, motion, stop, budget: int) -> FlexibleOutcome:
    def run(given):
        scene = FlexibleScene.of(*given)
        state = jax.lax.while_loop(lambda s: ~s.done & (s.steps < budget), lambda s: scene.advance(s), scene.start())
        return scene.conclude(state)

    return differentiable(run)((block, motion, stop))


@eqx.filter_jit
def _simulate(block, motion, stop, samples: int, budget: int) -> FlexibleResponse:
    scene = FlexibleScene.of(block, motion, stop)
    state = scene.start()
    nodes = jax.tree.map(lambda x: jnp.broadcast_to(x, (budget + 1,) + x.shape), state)

    def step(carry):
        state, nodes = carry
        state = scene.advance(state)
        return state, jax.tree.map(lambda buffer, x: buffer.at[state.steps].set(x), nodes, state)

    state, nodes = jax.lax.while_loop(lambda c: ~c[0].done & (c[0].steps < budget), step, (state, nodes))
    index = jnp.arange(budget + 1)
    times = jnp.where(index <= state.steps, jax.vmap(scene.time)(nodes), jnp.inf)
    time = jnp.linspace(jnp.zeros_like(stop), stop, samples)
    empty = jnp.zeros(2)
    response = FlexibleResponse(time, empty, empty, empty, scene.conclude(state), scene, nodes, times)
    rows = _along(response, time, "outputs")[:3]
    return eqx.tree_at(lambda r: (r.rotation, r.displacement, r.bending), response, rows)


@eqx.filter_jit
def _along(response: FlexibleResponse, time, what: str):
    """Follow the block from the node before each time."""
    scene = response.scene
    scales = jnp.array([1.0, 0, 0, 1.0]) + jnp.array([0.0, 1, 1, 0]) * jnp.cos(scene.numbers.alpha) * scene.block.length

    def at(t):
        index = jnp.clip(jnp.searchsorted(response.node_times, t, side="right") - 1, 0, response.node_times.size - 1)
        node = jax.tree.map(lambda x: x[index], response.nodes)
        path, length, _, _ = scene.arc(node)
        # The last node is the end of the history.
        x = jnp.where(node.done, 0.0, (t - response.node_times[index]) / length)
        return tuple(path.outputs(x) * scales) if what == "outputs" else scene.energy(path.state(x))

    found = jax.vmap(at)(time.ravel())
    return tuple(part.reshape(time.shape) for part in found)
