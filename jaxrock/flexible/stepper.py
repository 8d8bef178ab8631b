"""A flexible block under a motion: its state, one step, and its outcome.

Each phase (locked base, rocking on either corner) is linear, so a step is exact. It is a sum of exponentials and the
polynomial response to the motion's Taylor series. Steps end where the series loses accuracy, at knots, and at events.
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Inexact, Int

from jaxrock._arguments.tables import AbstractTable, Column, scenes
from jaxrock._core.types import Real
from jaxrock.blocks.cantilever import unit_column
from jaxrock.blocks.flexible import FlexibleBlock, is_possible
from jaxrock.blocks.restitution import Reset, on_sides
from jaxrock.flexible.closeness import approached, mirrored, still_to_come
from jaxrock.flexible.phases import Arc, Numbers, Phase, arc, locked_phase, rocking_phase
from jaxrock.motions.floors import with_solved_floors
from jaxrock.motions.motion import AbstractMotion
from jaxrock.numerics.derivatives_of import with_derivatives_of
from jaxrock.numerics.exponential_sums import Curve, first_exit, highest, powers
from jaxrock.numerics.polynomial import step_length
from jaxrock.numerics.roots import implicit
from jaxrock.status import Status

_ORDER = 16  # order of the motion's Taylor series


class FlexibleState(eqx.Module):
    """State of a flexible block, and extremes so far."""

    piece: Int[Array, ""]
    local: Real  # time since the start of the piece [s]
    motion: Inexact[Array, " states"]  # (q, q', theta)
    side: Real  # 0: the base is locked
    last_side: Real  # side from which the base returned last
    stay: Real  # time for which the base has rocked on this side [s]
    braked_stay: Real  # the stay that the last impact ended [s]
    maxima: Inexact[Array, " six"]  # of rotation, top displacement over L, its bending part; of their negatives
    closeness: Real  # smallest squared distance from standing still in balance (`margin`)
    closeness_beyond: Real  # `closeness` since the last outward crossing of the balance
    impacts: Int[Array, ""]
    impacted: Bool[Array, ""]  # an impact made this state
    fallen: Bool[Array, ""]
    stride: Real  # longest step that the remainder allows [s]
    done: Bool[Array, ""]
    status: Status
    steps: Int[Array, ""]


class FlexibleOutcome(AbstractTable):
    """Outcome of a flexible block within a duration.

    - `max_rotation`: largest |rotation| of the base [rad]; infinite if the block overturned.
    - `max_displacement`: largest |displacement| of the top relative to the ground [m]; infinite if it overturned.
    - `max_bending`: largest part of it that is bending [m]; infinite if the block overturned.
    - `impact_count`: impacts within the duration.
    - `overturned`: the verdict, which looks beyond a duration that covers the motion.
    - `margin`: signed distance to overturning [-], by the rocking part of the motion (its unstable mode and the one
      that mirrors it, without vibrations). It is 1 if the base has not turned, positive if the block survives, zero
      where it comes to balance, negative if it overturns. For rigid and undamped rocking it is (1 - peak/balance)^2.
    - `energy`: energy at the end over that of the unstable equilibrium [-]. Below 1 a block that is not already beyond
      cannot overturn by itself.
    - `status`: a `Status`. It is `undecided` if, at the end, the block would overturn by itself, or has the energy to,
      but is not lost. While the ground shakes, a loss is not known.
    """

    max_rotation: Real
    max_displacement: Real
    max_bending: Real
    impact_count: Int[Array, "..."]
    overturned: Bool[Array, "..."]
    margin: Real
    energy: Real
    status: Status

    @property
    def _columns(self):
        units = {"max_rotation": "rad", "max_displacement": "m", "max_bending": "m"}
        names = (*units, "impact_count", "overturned", "margin", "energy", "status")
        axes = scenes(self.max_rotation.ndim)
        return {name: Column(axes, getattr(self, name), units.get(name, "-")) for name in names}


def resets_of(block: FlexibleBlock) -> tuple[Reset, ...]:
    """Return the impacts that end the stays on side 1 and on side 2, or one for both."""
    one, other = on_sides(block.law, block.corners)
    corners = (one,) if one is other else (one, other)
    return tuple(Reset.of(block.law, each, jnp.ones_like(block.alpha), 1.0) for each in corners)


def _may_be(block: FlexibleBlock, ground: AbstractMotion) -> Bool[Array, ""]:
    """Return whether block and motion pass the checks of constructors, which a step of an optimiser may bypass."""
    knots = ground.knots
    forward = (knots[0] >= 0) & (knots[-1] >= 0) & (ground.lengths >= 0).all()
    return is_possible(block) & forward


def _ratio(resets: tuple[Reset, ...], side: Real, speed: Real) -> Real:
    ratios = [reset.ratio(speed) for reset in resets]
    return ratios[0] if len(ratios) == 1 else jnp.where(side < 0, ratios[1], ratios[0])


class FlexibleScene(eqx.Module):
    """A flexible block under a motion, reduced to the constants of a step."""

    block: FlexibleBlock
    ground: AbstractMotion
    stop: Real
    numbers: Numbers
    locked: Phase
    rocking: Phase
    whole: Bool[Array, ""]
    reset: tuple[Reset, ...]  # with speeds in rad/s: on side 1 and 2, or one for both
    knots: Inexact[Array, " knots"]

    @classmethod
    def of(cls, block: FlexibleBlock, ground: AbstractMotion, stop: Real) -> "FlexibleScene":
        """Build the scene from scalars."""
        numbers, ground = Numbers.of(block), with_solved_floors(ground)
        rocking, whole = rocking_phase(numbers)
        reset = resets_of(block)
        return cls(block, ground, stop, numbers, locked_phase(numbers), rocking, whole, reset, ground.knots)

    def start(self) -> FlexibleState:
        """Return the state at rest at time 0."""
        n = 2 * self.numbers.rotation.size + 1
        zero, count, no = jnp.zeros(()), jnp.zeros((), jnp.int32), jnp.zeros((), bool)
        finite = jnp.isfinite(self.rocking.rates).all() & jnp.isfinite(self.stop) & _may_be(self.block, self.ground)
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
            closeness=zero + 1,
            closeness_beyond=zero + jnp.inf,
            impacts=count,
            impacted=no,
            fallen=no,
            stride=zero + jnp.inf,
            done=~(finite & self.whole),
            status=Status.where(finite & ~self.whole, Status.solver_failed, status),
            steps=count,
        )

    def time(self, state: FlexibleState) -> Real:
        """Return the time of a state [s]."""
        return self.knots[state.piece] + state.local

    def longest(self, state: FlexibleState) -> Real:
        """Return the longest step [s]: after a growth of more than e^10, the unstable mode would hide the others."""
        return 10 / jax.lax.stop_gradient(jnp.max(self.rocking.rates.real))

    def arc(self, state: FlexibleState) -> tuple[Arc, Real, Real, Bool[Array, ""]]:
        """Return the arc from this state, its length [s], the share of it within this piece, and whether it ends with
        the piece.

        The share is 1, or 0 in a zero-length piece.
        """
        load, length, share, whole = self.load(state)
        phase = Phase.where(state.side == 0, self.locked, self.rocking)
        return arc(self.numbers, phase, state.side, state.motion, load, length), length, share, whole

    def load(self, state: FlexibleState) -> tuple[Inexact[Array, " order"], Real, Real, Bool[Array, ""]]:
        """Return the ground acceleration [g] along the arc from here, and the rest that `arc` returns."""
        quiet, inner = state.piece >= self.knots.size - 1, jnp.minimum(state.piece, self.knots.size - 2)
        lasts = jnp.where(quiet, jnp.inf, self.ground.lengths[inner])
        remaining = jnp.minimum(lasts, self.stop - self.knots[state.piece]) - state.local
        left = jax.lax.stop_gradient(jnp.maximum(remaining, 0.0))
        scales = self.ground.scales
        scale = jax.lax.stop_gradient(jnp.where(quiet, jnp.inf, jnp.inf if scales is None else scales[inner]))
        room = jnp.where(left > 0, left, jax.lax.stop_gradient(lasts))
        unit = jnp.where(jnp.isfinite(scale), scale, jnp.where(jnp.isfinite(room) & (room > 0), room, 1.0))
        load = jnp.where(quiet, 0.0, jnp.stack(self.ground.series(inner, state.local, unit, _ORDER)))
        # At the end of a piece, take an arc of usual length: in a longer one, large terms cancel even at its start.
        cap = jnp.minimum(jnp.where(left > 0, left, unit), self.longest(state)) / unit
        if len(load) > 4:
            size = jnp.finfo(left.dtype).eps / 4 * jnp.max(self.ground.bounds)
            cap = step_length(list(jax.lax.stop_gradient(load)), jax.lax.stop_gradient(size), cap)
        length, whole = cap * unit, cap * unit >= left
        share = jnp.where(whole, remaining / length, 1.0)
        return load * powers(length / unit, len(load)), length, share, whole

    def advance(self, state: FlexibleState) -> FlexibleState:
        """Advance by one step: to an event, to the end of a piece, or as far as the motion's series is accurate."""
        return self.step_on(state, *self.arc(state))

    def step_on(
        self, state: FlexibleState, path: Arc, length: Real, share: Real, whole: Bool[Array, ""]
    ) -> FlexibleState:
        """Advance along an arc."""
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
        level = jnp.where(below, low, high)
        value, slope, _ = jax.lax.stop_gradient(watched.jet(x))
        hit = (below | above) & (slope != 0) & (x > 0)
        at_end = ~(below | above) & (x >= jax.lax.stop_gradient(share))
        nearer = x - jax.lax.stop_gradient(value - level) / jnp.where(hit, slope, 1.0)
        x = jnp.where(hit, implicit(_to_level, nearer, (watched, level)), jnp.where(at_end, share, x))
        slope = with_derivatives_of(slope, watched.jet(x)[1])  # value as found, derivatives of the step's end
        motion = path.state(x)
        maxima, certain = _maxima(rows, state.maxima, x)
        status = Status.where(certain, state.status, Status.solver_failed)
        near = approached(path, state.side, self.numbers.balance, x, (state.closeness, state.closeness_beyond))
        state = eqx.tree_at(lambda s: (s.maxima, s.closeness, s.closeness_beyond, s.status), state,
                            (maxima, *near, status))  # fmt: skip
        return self._land(state, motion, x * length, slope / length, below, above, at_end & whole, ~certain)

    def _land(self, state, motion, elapsed, speed, below, above, piece_over, failed) -> FlexibleState:
        """Return the state after a step, and after the event that ended it."""
        numbers, rocking = self.numbers, state.side != 0
        returned, fallen = rocking & below, rocking & above
        # A locked base has a rotation of exactly zero.
        still = motion.at[-1].set(jnp.where(rocking & ~returned, motion[-1], 0.0))
        stay = jnp.where(rocking, state.stay + elapsed, 0.0)
        # A column that trembles while the base uplifts must not use up the impact that ends the rocking.
        counts = (state.side != state.last_side) | (stay > state.braked_stay) | (self.block.impacts == "every")
        counts, n = counts & returned, numbers.rotation.size
        slowed = still.at[n:-1].multiply(_ratio(self.reset, state.side, jnp.abs(speed)))
        after = jnp.where(counts, slowed, still)
        # A damped column may push the base over at once.
        pushed = numbers.moment(after)
        over = numbers.damped & (jnp.abs(pushed) > numbers.strength)
        side = jnp.where(returned, jnp.where(over, jnp.sign(pushed), 0.0), state.side)
        side = jnp.where(~rocking & (below | above), jnp.where(above, 1.0, -1.0), side)
        local = jnp.where(piece_over, 0.0, state.local + elapsed)
        piece = state.piece + piece_over
        stopped = piece_over & (self.knots[jnp.minimum(state.piece + 1, self.knots.size - 1)] >= self.stop)
        stopped |= piece_over & (state.piece == self.knots.size - 1)
        # The end of the duration may lie within the piece.
        local = jnp.where(stopped, state.local + elapsed, local)
        piece = jnp.where(stopped, state.piece, piece)
        finite = jnp.isfinite(after).all() & jnp.isfinite(elapsed)
        return replace(
            state,
            piece=piece,
            local=local,
            motion=after,
            side=side,
            last_side=jnp.where(returned, state.side, state.last_side),
            stay=jnp.where(returned, 0.0, stay),
            braked_stay=jnp.where(counts, stay, state.braked_stay),
            impacts=state.impacts + counts,
            impacted=counts,
            fallen=state.fallen | fallen,
            done=stopped | fallen | ~finite | failed,
            status=Status.where(finite, state.status, Status.not_finite),
            steps=state.steps + 1,
        )

    def column(self, motion: Inexact[Array, " states"]) -> Inexact[Array, " masses"]:
        """Return the displacements of the masses from the base to the top, over L cos(alpha)."""
        column = unit_column(self.block.masses)
        return jnp.concatenate([jnp.zeros(1), column.shapes @ motion[: self.block.masses - 1]])

    @property
    def summit(self) -> Real:
        """Return the energy of the unstable equilibrium, over m L^2 [1/s^2]."""
        return self.numbers.strength * self.numbers.balance / 2

    def energy(self, motion: Inexact[Array, " states"]) -> tuple[Real, Real, Real]:
        """Return kinetic energy, strain energy of the column, potential energy of the base, over m L^2 [1/s^2]."""
        numbers = self.numbers
        q, v = jnp.split(motion[:-1], 2)
        rotation = motion[-1]
        strain = jnp.sum(numbers.squares * (q - numbers.rotation * rotation) ** 2) / 2
        base = numbers.strength * jnp.abs(rotation) - numbers.spring_rate * rotation**2 / 2
        return jnp.sum(v**2) / 2, strain, base

    def conclude(self, state: FlexibleState) -> FlexibleOutcome:
        """Compute the outcome from the state at the end."""
        gone = state.fallen | self._never_returns(state)
        # Take the stop itself: the sum of piece and local time is rounded.
        until = jnp.where(state.done & (state.status == Status.successful), self.stop, self.time(state))
        lost = state.fallen | (gone & (until >= self.knots[-1]))  # the ground may bring it back
        total = sum(self.energy(state.motion)) / self.summit
        status = Status.where(lost | ((total < 1) & ~gone), state.status, Status.undecided)
        status = Status.where(state.status == Status.successful, status, state.status)
        status = Status.where(state.done, status, Status.step_budget_exhausted)
        length = jnp.cos(self.numbers.alpha) * self.block.length
        largest = jnp.maximum(*jnp.split(state.maxima, 2)) * jnp.stack([jnp.ones_like(length), length, length])
        largest = jnp.where(lost, jnp.inf, largest)
        rotation, displacement, bending = largest
        margin = self._margin(state, gone)
        return FlexibleOutcome(rotation, displacement, bending, state.impacts, lost, margin, total, status)

    def _amplitudes(self, state: FlexibleState) -> Complex[Array, " modes"]:
        """Return the amplitudes of the modes of the rocking base [rad], about its balance."""
        return self.rocking.project @ (state.motion - state.side * self.numbers.center)

    def _never_returns(self, state: FlexibleState) -> Bool[Array, ""]:
        """Return whether, without further shaking, the unstable mode outgrows all others from here on."""
        side, rates = state.side, self.rocking.rates.real
        amplitudes = self._amplitudes(state)
        growing = rates == jnp.max(rates)
        outward = side * jnp.sum(jnp.where(growing, amplitudes.real, 0.0))
        others = jnp.sum(jnp.where(growing, 0.0, jnp.abs(amplitudes)))
        return (side != 0) & (outward > 0) & (self.numbers.balance + outward > others)

    def _margin(self, state: FlexibleState, gone: Bool[Array, ""]) -> Real:
        """Return the margin: the closeness so far, and that of the present swing if the ground rests from now on."""
        grows, decays = mirrored(self.rocking)
        outward, inward = (state.side * self._amplitudes(state).real[k] for k in (grows, decays))
        rates = (self.rocking.rates[grows].real, -self.rocking.rates[decays].real)
        ahead = still_to_come(outward, inward, *rates) / self.numbers.balance**2
        ahead = jnp.where(state.side != 0, ahead, jnp.inf)
        beyond = jnp.where(outward + inward > 0, jnp.minimum(state.closeness_beyond, ahead), ahead)
        fallen = jnp.where(state.fallen, state.closeness_beyond, beyond)
        return jnp.where(gone, -fallen, jnp.minimum(state.closeness, ahead))


def _to_level(told: tuple[Curve, Real], x: Real) -> Real:
    """Return the Newton step to where a curve crosses a level."""
    curve, level = told
    value, slope, _ = curve.jet(x)
    return (value - level) / jnp.where(slope == 0, 1.0, slope)


def _maxima(rows, maxima, x):
    """Return the largest values of rotation, displacement and bending, and of their negatives; whether they are
    certain."""
    both = jax.tree.map(lambda r: jnp.concatenate([r[:3], r[:3]]), rows)
    signs = jnp.array([1.0, 1, 1, -1, -1, -1])[:, None]
    both = Curve(both.amplitudes * signs, both.rates, both.coefficients * signs, both.errors)
    values, certain = jax.vmap(highest, in_axes=(0, 0, None))(both, maxima, x)
    return values, certain.all()
