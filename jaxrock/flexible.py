"""What a flexible block does under a motion: `simulate_flexible` gives its history, `outcome_flexible` what came of it.

Each phase (locked base, rocking on either corner) is linear, so a step is exact: a sum of exponentials, and the
polynomial that answers the motion's Taylor series. Steps end where the series does, at knots, and at events.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Inexact, Int

from jaxrock._checks import Values, checked, scalar
from jaxrock.derivatives import differentiable
from jaxrock.flexible_block import FlexibleBlock
from jaxrock.flexible_phases import Arc, Numbers, Phase, arc, locked_phase, rocking_phase
from jaxrock.modal_curves import Curve, first_exit, highest, powers
from jaxrock.motion import AbstractMotion
from jaxrock.polynomial import step_length
from jaxrock.status import Status

Scalar = Inexact[ArrayLike, "..."]

_ORDER = 16  # of the motion's Taylor series


class FlexibleState(eqx.Module):
    """A flexible block on its way, and what it has seen so far."""

    piece: Int[Array, ""]
    local: Scalar  # time since the start of the piece [s]
    motion: Inexact[Array, " states"]  # (q, q', theta)
    side: Scalar  # 0: the base is locked
    last_side: Scalar  # from which the base returned last
    stay: Scalar  # how long the base has rocked on this side [s]
    braked_stay: Scalar  # the stay that the last impact ended [s]
    maxima: Inexact[Array, " six"]  # of rotation, top displacement over L, its bending part; of their negatives
    impacts: Int[Array, ""]
    impacted: Bool[Array, ""]  # just now
    fallen: Bool[Array, ""]
    done: Bool[Array, ""]
    status: Status
    steps: Int[Array, ""]


class FlexibleOutcome(eqx.Module):
    """What came of a flexible block within a duration.

    - `max_rotation`: largest |rotation| of the base [rad]; infinite if the block overturned.
    - `max_displacement`: largest |displacement| of the top relative to the ground [m]; infinite if it overturned.
    - `max_bending`: largest part of it that is bending [m]; infinite if the block overturned.
    - `impact_count`: impacts within the duration.
    - `overturned`: the verdict, which looks beyond the duration.
    - `energy`: energy at the end over that of the unstable equilibrium [-]; below 1 no block overturns by itself.
    - `status`: a `Status`; `undecided` if, at the end, the energy suffices to overturn but the block is not lost.
    """

    max_rotation: Scalar
    max_displacement: Scalar
    max_bending: Scalar
    impact_count: Int[Array, "..."]
    overturned: Bool[Array, "..."]
    energy: Scalar
    status: Status


class FlexibleScene(eqx.Module):
    """A flexible block under a motion, reduced to what a step needs."""

    block: FlexibleBlock
    ground: AbstractMotion
    stop: Scalar
    numbers: Numbers
    locked: Phase
    rocking: Phase
    whole: Bool[Array, ""]
    knots: Inexact[Array, " knots"]

    @classmethod
    def of(cls, block: FlexibleBlock, ground: AbstractMotion, stop: Scalar) -> "FlexibleScene":
        """Build the scene from scalars."""
        numbers = Numbers.of(block)
        rocking, whole = rocking_phase(numbers)
        return cls(block, ground, stop, numbers, locked_phase(numbers), rocking, whole, ground.knots)

    def start(self) -> FlexibleState:
        """At rest at time 0."""
        n = 2 * self.numbers.rotation.size + 1
        zero, count, no = jnp.zeros(()), jnp.zeros((), jnp.int32), jnp.zeros((), bool)
        finite = jnp.isfinite(self.rocking.rates).all() & jnp.isfinite(self.stop)
        status = Status.where(finite, Status.successful, Status.not_finite)
        return FlexibleState(
            piece=count,
            local=zero,
            motion=jnp.zeros(n),
            side=zero,
            last_side=zero,
            stay=zero,
            braked_stay=zero,
            maxima=jnp.zeros(6),
            impacts=count,
            impacted=no,
            fallen=no,
            done=~(finite & self.whole),
            status=Status.where(finite & ~self.whole, Status.solver_failed, status),
            steps=count,
        )

    def time(self, state: FlexibleState) -> Scalar:
        """Time of a state [s]."""
        return self.knots[state.piece] + state.local

    def arc(self, state: FlexibleState) -> tuple[Arc, Scalar, Scalar, Bool[Array, ""]]:
        """The motion from here: the arc, its length [s], the share of it that belongs to this piece (1, or 0 of a
        piece without length), and whether it ends with the piece."""
        last = self.knots.size - 1
        quiet, inner = state.piece >= last, jnp.minimum(state.piece, last - 1)
        piece_ends = jnp.where(quiet, jnp.inf, self.knots[jnp.minimum(state.piece + 1, last)])
        remaining = jnp.minimum(piece_ends, self.stop) - self.knots[state.piece] - state.local
        left = jax.lax.stop_gradient(jnp.maximum(remaining, 0.0))
        scale = jax.lax.stop_gradient(jnp.where(quiet, jnp.inf, self.ground.scales[inner]))
        unit = jnp.where(jnp.isfinite(scale), scale, jnp.where(left > 0, left, 1.0))
        load = [jnp.where(quiet, 0.0, u) for u in self.ground.series(inner, state.local, unit, _ORDER)]
        # Grown by more than e^10, the unstable mode would hide the others.
        fastest = jax.lax.stop_gradient(jnp.max(self.rocking.rates.real))
        cap = jnp.minimum(left, 10 / fastest) / unit
        if len(load) > 4:
            size = jnp.finfo(left.dtype).eps / 4 * jnp.max(self.ground.bounds)
            cap = step_length(jax.lax.stop_gradient(load), jax.lax.stop_gradient(size), cap)
        length = jnp.where(left > 0, cap * unit, 1.0)
        whole = cap * unit >= left
        share = jnp.where(whole, remaining / length, 1.0)
        load = jnp.stack(load) * powers(length / unit, len(load))
        phase = Phase.where(state.side == 0, self.locked, self.rocking)
        return arc(self.numbers, phase, state.side, state.motion, load, length), length, share, whole

    def advance(self, state: FlexibleState) -> FlexibleState:
        """One step: to an event, to the end of a piece, or as far as the motion's series holds."""
        path, length, share, whole = self.arc(state)
        rows = path.curves()
        turned, moment = (jax.tree.map(lambda x, i=i: x[i], rows) for i in (0, 3))
        rocking, limit = state.side != 0, self.numbers.strength
        watched = Curve(
            jnp.where(rocking, state.side * turned.amplitudes, moment.amplitudes),
            turned.rates,
            jnp.where(rocking, state.side * turned.coefficients, moment.coefficients),
            jnp.where(rocking, turned.errors, moment.errors),
        )
        low, high = jnp.where(rocking, 0.0, -limit), jnp.where(rocking, jnp.pi / 2, limit)
        x, below, above = first_exit(watched, low, high, share)
        value, slope = watched.jet(x)
        # One step of Newton's method gives the time of the event its derivatives.
        miss = value - jnp.where(below, low, high)
        hit = (below | above) & (slope != 0) & (x > 0)
        at_end = ~(below | above) & (x >= jax.lax.stop_gradient(share))
        x = jnp.where(hit, x - miss / jnp.where(hit, slope, 1.0), jnp.where(at_end, share, x))
        motion = path.state(x)
        state = eqx.tree_at(lambda s: (s.maxima,), state, (_maxima(rows, state.maxima, x),))
        return self._land(state, motion, x * length, below, above, at_end & whole)

    def _land(self, state, motion, elapsed, below, above, piece_over) -> FlexibleState:
        """The state after a step, and after the event that ended it."""
        numbers, rocking = self.numbers, state.side != 0
        returned, fallen = rocking & below, rocking & above
        # A locked base, whose rotation is zero to the last digit.
        still = motion.at[-1].set(jnp.where(rocking & ~returned, motion[-1], 0.0))
        stay = jnp.where(rocking, state.stay + elapsed, 0.0)
        # A column that trembles while the base uplifts must not use up the impact that ends the rocking.
        counts = (state.side != state.last_side) | (stay > state.braked_stay) | (self.block.impacts == "every")
        counts &= returned
        n = numbers.rotation.size
        after = jnp.where(counts, still.at[n:-1].multiply(self.block.restitution), still)
        # A damped column may push the base over at once.
        pushed = numbers.moment(after)
        over = numbers.damped & (jnp.abs(pushed) > numbers.strength)
        side = jnp.where(returned, jnp.where(over, jnp.sign(pushed), 0.0), state.side)
        side = jnp.where(~rocking & (below | above), jnp.where(above, 1.0, -1.0), side)
        local = jnp.where(piece_over, 0.0, state.local + elapsed)
        piece = state.piece + piece_over
        stopped = piece_over & (self.knots[jnp.minimum(state.piece + 1, self.knots.size - 1)] >= self.stop)
        stopped |= piece_over & (state.piece == self.knots.size - 1)
        # At the end of the duration: within the piece.
        local = jnp.where(stopped, state.local + elapsed, local)
        piece = jnp.where(stopped, state.piece, piece)
        finite = jnp.isfinite(after).all() & jnp.isfinite(elapsed)
        return FlexibleState(
            piece=piece,
            local=local,
            motion=after,
            side=side,
            last_side=jnp.where(returned, state.side, state.last_side),
            stay=jnp.where(returned, 0.0, stay),
            braked_stay=jnp.where(counts, stay, state.braked_stay),
            maxima=state.maxima,
            impacts=state.impacts + counts,
            impacted=counts,
            fallen=state.fallen | fallen,
            done=stopped | fallen | ~finite,
            status=Status.where(finite, state.status, Status.not_finite),
            steps=state.steps + 1,
        )

    def energy(self, motion: Inexact[Array, " states"]) -> tuple[Scalar, Scalar, Scalar]:
        """Kinetic energy, strain energy of the column, potential energy of the base, over m L^2 [1/s^2]."""
        numbers = self.numbers
        q, v = jnp.split(motion[:-1], 2)
        rotation = motion[-1]
        strain = jnp.sum(numbers.squares * (q - numbers.rotation * rotation) ** 2) / 2
        base = numbers.strength * jnp.abs(rotation) - numbers.spring_rate * rotation**2 / 2
        return jnp.sum(v**2) / 2, strain, base

    def conclude(self, state: FlexibleState) -> FlexibleOutcome:
        """What came of it, from the state at the end."""
        lost = state.fallen | self._never_returns(state)
        total = sum(self.energy(state.motion)) / (self.numbers.strength * self.numbers.alpha / 2)
        quiet = self.time(state) >= self.knots[-1]
        status = Status.where(lost | (total < 1) | ~quiet, state.status, Status.undecided)
        status = Status.where(state.status == Status.successful, status, state.status)
        status = Status.where(state.done, status, Status.step_budget_exhausted)
        length = jnp.cos(self.numbers.alpha) * self.block.length
        largest = jnp.maximum(*jnp.split(state.maxima, 2)) * jnp.stack([jnp.ones_like(length), length, length])
        largest = jnp.where(lost, jnp.inf, largest)
        return FlexibleOutcome(*largest, state.impacts, lost, total, status)

    def _never_returns(self, state: FlexibleState) -> Bool[Array, ""]:
        """Whether, without further shaking, the unstable mode outgrows all others from here on."""
        side, phase = state.side, self.rocking
        n = self.numbers.rotation.size
        center = self.numbers.alpha * side * jnp.concatenate([self.numbers.rotation, jnp.zeros(n), jnp.ones(1)])
        amplitudes = phase.project @ (state.motion - center)
        growing = phase.rates.real == jnp.max(phase.rates.real)
        outward = side * jnp.sum(jnp.where(growing, amplitudes.real, 0.0))
        others = jnp.sum(jnp.where(growing, 0.0, jnp.abs(amplitudes)))
        quiet = self.time(state) >= self.knots[-1]
        return quiet & (side != 0) & (outward > 0) & (self.numbers.alpha + outward > others)


def _maxima(rows, maxima, x):
    """The largest values of rotation, displacement and bending, and of their negatives."""
    both = jax.tree.map(lambda r: jnp.concatenate([r[:3], r[:3]]), rows)
    signs = jnp.array([1.0, 1, 1, -1, -1, -1])[:, None]
    both = Curve(both.amplitudes * signs, both.rates, both.coefficients * signs, both.errors)
    return jax.vmap(highest, in_axes=(0, 0, None))(both, maxima, x)


class FlexibleResponse(eqx.Module):
    """The history of a flexible block; call it with times to evaluate it anywhere.

    - `time`, `rotation`, `displacement`, `bending`: (samples,) [s], base rotation [rad], displacement of the top
      relative to the ground [m], the part of it that is bending [m].
    - `impact_times` [s], `impact_modes`: (impacts, modes) share of each clamped mode in the energy after an impact.
    - `outcome`: a `FlexibleOutcome`; `status`: its status.
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
        side - rotation/alpha.
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
    - `motion`: any motion; the ground rests after its end.
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
