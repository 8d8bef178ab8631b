"""Copies of a scene: the motions that errors of the computation allow, and the verdict that they share.

Under a long record, chattering impacts amplify rounding errors until they exceed the rotation itself. The block then
follows one of many motions, and the linearised error says nothing more. Whether these motions differ in what matters
is another question: most have the same verdict, and the peak came before.

So the motion that was computed goes on as the first of them. Copies of it start where the error was still small, each
from a state drawn from the covariance there. They follow the same steps one after the other in the same loop, which is
compiled once. `Tally` compares how close they come to balance, and how high they rise.
"""

import math
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from jaxrock._core.types import Flag, Scalar
from jaxrock.compiler import cond_any
from jaxrock.compiler.hints import select, stop_gradient
from jaxrock.engines.bookkeeping import MOST_OFF
from jaxrock.engines.conclusion import Conclusion, conclude
from jaxrock.engines.state import Reached, State
from jaxrock.engines.stepper import AbstractStepper
from jaxrock.engines.uncertainty import StateCovariance
from jaxrock.status import Status

_BRANCH = 1e-4  # standard error over the saddle's angle from which copies start: it is still linear there
FEW, MORE = 8, 16  # copies that decide where all stay far from balance, and where they spread
SKIPPED = 16  # copies without a result, after which no more are drawn
# Standard deviations of the copies that must fit between their mean and balance, of a few copies and of more.
_CLEAR_OF_FEW, _CLEAR_OF_MORE = 8.0, 5.0
_FAR = 0.49  # closeness above which the distance of a copy from balance is not measured
_LOW = 0.5  # share of the peak so far below which the peaks of a copy are not measured
TOLD = ("overturned_share", "error", "differentiable", "known_until", "status")  # what the copies of a scene tell


def _normal_pairs(count: int) -> np.ndarray:
    """Return points of a plane, normally distributed: an additive recurrence (Roberts 2018) through Box and Muller."""
    steps = np.arange(1, count + 1)
    along, around = (steps * 0.7548776662466927) % 1, (steps * 0.5698402909980532) % 1
    radius = np.sqrt(-2 * np.log(along))
    return np.stack([radius * np.cos(2 * math.pi * around), radius * np.sin(2 * math.pi * around)])


_DRAWS = _normal_pairs(MORE + SKIPPED + 1)


def scattered(stepper: AbstractStepper, state: Any, number: Int[Array, ""]) -> tuple[Scalar, Scalar, Flag]:
    """Draw opening and velocity from the covariance of a state; return them, and whether it is beyond the saddle."""
    scene, spread = stepper.at(state).scene, state.spread
    first, second = (jnp.asarray(draws, state.opening.dtype)[number % draws.size] for draws in _DRAWS)
    # At least some units of rounding, else all copies would be the same motion.
    least = 64 * jnp.finfo(state.opening.dtype).eps * scene.alpha
    angle = jnp.maximum(spread.angle, least)
    along = spread.xv / angle
    across = jnp.sqrt(jnp.maximum(spread.vv - along**2, 0.0)) + least
    opening = jnp.maximum(state.opening + angle * first, 0.0)
    velocity = state.velocity + along * first + across * second
    return opening, select(opening > 0, velocity, jnp.abs(velocity)), opening >= scene.moments.saddle


class Branch(eqx.Module):
    """The state from which copies start: the last one with a small error."""

    piece: Int[Array, ""]
    local: Scalar
    side: Scalar  # 0: no state yet
    opening: Scalar
    velocity: Scalar
    peak: Scalar
    fastest: Scalar
    closeness: Scalar
    spread: StateCovariance
    reached: Reached | None  # by ties that remember it

    @classmethod
    def of(cls, state: State) -> "Branch":
        """Keep the fields of a state, without derivatives."""
        names = "piece", "local", "side", "opening", "velocity", "peak", "fastest", "closeness", "spread", "reached"
        return stop_gradient(cls(*(getattr(state, name) for name in names)))

    def copy(self, stepper: AbstractStepper, like: State, number: Int[Array, ""]) -> State:
        """Return the start of a copy; `like`: any state, whose other fields no longer matter."""
        opening, velocity, beyond = scattered(stepper, self, number)
        no, zero = jnp.zeros_like(like.done), jnp.zeros_like(opening)
        return replace(
            like,
            piece=self.piece,
            local=self.local,
            side=self.side,
            opening=opening,
            velocity=velocity,
            uplifting=no,
            beyond=beyond,
            extremal=no,
            peak=_LOW * self.peak,
            second=_LOW * self.peak,
            fastest=self.fastest,
            closeness=jnp.maximum(self.closeness, _FAR),
            closeness_beyond=jnp.full_like(opening, jnp.inf),
            spread=StateCovariance.none(zero),
            reached=self.reached,
            overturned=no,
            done=(self.piece >= stepper.scene.pieces) & (not stepper.follows_free_stage),
            status=Status.where(no, Status.undecided, Status.successful),
        )


class Tally(eqx.Module):
    """Counts and sums over the copies so far."""

    copies: Int[Array, ""]
    skipped: Int[Array, ""]  # without a result
    fell: Int[Array, ""]
    distance: Scalar  # sum of the distances from balance
    distance2: Scalar  # of their squares
    far: Int[Array, ""]  # copies whose distance is not measured, because it is 1 or more
    rise: Scalar  # sum of the peaks after the branch [rad]
    rise2: Scalar
    highest: Scalar  # the largest of these peaks
    off_peak: Scalar  # sum of squared deviations of the peak [rad^2]
    off_margin: Scalar  # of the margin
    off_speed: Scalar  # of the largest velocity over p [rad^2]

    @classmethod
    def none(cls, like: Scalar) -> "Tally":
        """Return the tally of no copies."""
        zero, count = jnp.zeros_like(like), jnp.zeros_like(like, jnp.int32)
        return cls(count, count, count, zero, zero, count, *[zero] * 6)

    def plus(self, branch: Branch, copy: Conclusion, base: Conclusion, p: Scalar) -> "Tally":
        """Add a copy. `base`: the motion that was computed first."""
        counts = (copy.status == Status.successful) | (copy.status == Status.undecided)
        fell = copy.overturned
        distance = jnp.sqrt(jnp.minimum(jnp.abs(copy.margin), 1.0))
        rise = select(fell, 0.0, copy.max_rotation)
        peak = jnp.maximum(rise, branch.peak) - select(base.overturned, 0.0, base.max_rotation)
        margin = select(fell, copy.margin, jnp.minimum(copy.margin, branch.closeness)) - base.margin
        speed = select(fell, 0.0, copy.max_velocity - select(base.overturned, 0.0, base.max_velocity)) / p
        after = Tally(
            self.copies + 1,
            self.skipped,
            self.fell + fell,
            self.distance + distance,
            self.distance2 + distance**2,
            self.far + (distance == 1),
            self.rise + rise,
            self.rise2 + rise**2,
            jnp.maximum(self.highest, rise),
            self.off_peak + select(fell, 0.0, peak) ** 2,
            self.off_margin + margin**2,
            self.off_speed + speed**2,
        )
        skipped = replace(self, skipped=self.skipped + 1)
        return jax.tree.map(lambda a, b: select(counts, a, b), after, skipped)

    def _share(self, total: Scalar) -> Scalar:
        return total / jnp.maximum(self.copies, 1)

    def _mean_and_deviation(self, total: Scalar, squares: Scalar) -> tuple[Scalar, Scalar]:
        mean = self._share(total)
        return mean, jnp.sqrt(jnp.maximum(self._share(squares) - mean**2, 0.0))

    def agrees(self, base: Conclusion) -> Flag:
        """Return whether all copies have the verdict of the motion that was computed first."""
        return (self.copies > 0) & (self.fell == select(base.overturned, self.copies, 0))

    def is_clear(self, base: Conclusion) -> Flag:
        """Return whether all agree, and stay so far from balance that no other motion may reach it."""
        mean, deviation = self._mean_and_deviation(self.distance, self.distance2)
        many = self.copies >= MORE
        needed = select(many, _CLEAR_OF_MORE, _CLEAR_OF_FEW)
        # Copies that all fall far from balance may miss another way out: a few tell too little.
        told = many | ((self.copies >= FEW) & ~(base.overturned & (self.far > 0)))
        return told & self.agrees(base) & (mean > needed * deviation)

    def wants_more(self, branch: Branch, base: Conclusion) -> Flag:
        """Return whether more copies may tell more.

        Peaks after the branch that agree may do so by chance, where most but not all motions come to rest before.
        """
        by_chance = (self.highest > branch.peak) & (self._share(self.off_peak) <= (MOST_OFF * base.max_rotation) ** 2)
        enough = select(self.is_clear(base) & ~by_chance, FEW, MORE)
        return (self.copies < enough) & (self.skipped < SKIPPED)

    def decided(self, branch: Branch, base: Conclusion, known_until: Scalar, p: Scalar) -> Conclusion:
        """Return the conclusion: the numbers of the motion that was computed first, with what the copies say."""
        clear = self.is_clear(base)
        mean, deviation = self._mean_and_deviation(self.rise, self.rise2)
        # Peaks after the branch that lie below the one before, but not clearly.
        threat = jnp.maximum(mean + _CLEAR_OF_MORE * deviation - jnp.maximum(branch.peak, self.highest), 0.0)
        off = jnp.sqrt(self._share(self.off_peak)) + threat / _CLEAR_OF_MORE
        error = select(base.overturned, jnp.inf, jnp.maximum(base.error, off))
        rotation = select(base.overturned, 1.0, base.max_rotation)
        holds = base.overturned | (error <= MOST_OFF * rotation)
        holds = holds & (self._share(self.off_margin) <= MOST_OFF**2)
        holds = holds & (base.overturned | (jnp.sqrt(self._share(self.off_speed)) * p <= MOST_OFF * base.max_velocity))
        status = Status.where(holds, Status.successful, Status.chaotic)
        share = (self.fell + base.overturned) / (self.copies + 1)
        return replace(
            base,
            overturned_share=select(clear, select(base.overturned, 1.0, 0.0), share).astype(base.margin.dtype),
            error=select(clear, error, base.error),
            differentiable=base.differentiable & holds & clear,
            known_until=known_until,
            status=Status.where(clear, status, Status.undecided),
        )


class Paths(eqx.Module):
    """The motions of one scene: the first one, and after it its copies."""

    branch: Branch
    tally: Tally
    base: Conclusion
    number: Int[Array, ""]  # of the present motion; 0: the first
    begun: Int[Array, ""]  # steps before it
    known_until: Scalar  # time at which the first motion was lost [s]
    finished: Flag

    @classmethod
    def of(cls, state: State) -> "Paths":
        """Begin with the first motion."""
        like, count = stop_gradient(state.opening), jnp.zeros_like(state.steps)
        branch = replace(Branch.of(state), side=jnp.zeros_like(like))
        never, no = jnp.full_like(like, jnp.inf), jnp.zeros_like(state.done)
        return cls(branch, Tally.none(like), Conclusion.blank(like), count, count, never, no)

    def noted(self, stepper: AbstractStepper, before: State, after: State) -> "Paths":
        """Keep the state before a step in which the error passes the limit, and the time of a loss."""
        limit = _limit(stepper)
        was_known = before.status == Status.successful
        lost = was_known & (after.status == Status.undecided)
        # A loss within one step resets the error.
        passes = (before.side != 0) & ~(before.spread.square > limit) & ((after.spread.square > limit) | lost)
        passes = passes & (was_known | (self.branch.side == 0))

        def kept():
            branch = _either(passes, Branch.of(before), self.branch)
            return branch, select(lost, stop_gradient(stepper.time(before)), self.known_until)

        noting = (self.number == 0) & (passes | lost)
        branch, known_until = jax.lax.cond(noting, kept, lambda: (self.branch, self.known_until))
        return replace(self, branch=branch, known_until=known_until)

    def parted(self, stepper: AbstractStepper, state: State) -> State:
        """Draw the state of a copy again where its own error has grown: rest may have brought all copies together."""
        grown = (self.number > 0) & (state.side != 0) & (state.spread.square > _limit(stepper))

        def again():
            opening, velocity, beyond = scattered(stepper, state, self.number + state.steps)
            spread = StateCovariance.none(opening)
            return replace(state, opening=opening, velocity=velocity, beyond=beyond, spread=spread)

        return jax.lax.cond(grown, again, lambda: state)

    def is_over(self, state: State, budget: Int[Array, ""] | int) -> Flag:
        """Return whether the present motion has come to its end."""
        return state.done | (state.steps - self.begun >= budget)

    def next(self, stepper: AbstractStepper, state: State, ended: Conclusion) -> "tuple[State, Paths]":
        """Begin the next motion, if there is one; `ended`: the conclusion of the present one."""
        first = self.number == 0
        base = _either(first, ended, self.base)
        copy, known, p, time = stop_gradient((ended, base, stepper.scene.p, stepper.time(state)))
        # The energy at the end of the motion may be too close to call although the error is small.
        at_end = first & (self.branch.side == 0) & (state.status == Status.successful)
        branch = _either(at_end, Branch.of(state), self.branch)
        tally = _either(first, self.tally, self.tally.plus(branch, copy, known, p))
        is_open = (known.status == Status.undecided) & (branch.side != 0)
        more = is_open & (first | tally.wants_more(branch, known))
        known_until = select(first & is_open, jnp.minimum(self.known_until, time), self.known_until)
        told = tally.decided(branch, known, known_until, p)
        seen = {name: _either(is_open & ~more, getattr(told, name), getattr(base, name)) for name in TOLD}
        following = Paths(branch, tally, replace(base, **seen), self.number + more, state.steps, known_until, ~more)
        return _either(more, branch.copy(stepper, state, self.number), state), following


def _limit(stepper: AbstractStepper) -> Scalar:
    """Return the square of the error from which copies start."""
    return (_BRANCH * stepper.scene.moments.saddle) ** 2


def _either(condition: Flag, one: Any, other: Any) -> Any:
    """Select one of two trees."""
    return jax.tree.map(lambda a, b: select(condition, a, b), one, other)


def most_paths(budget: int) -> int:
    """Return the step budget of all motions of a scene; `budget`: of one."""
    return min(budget * (1 + MORE + SKIPPED), 2**31 - 1)


def conclude_with_copies(stepper: AbstractStepper, state: State) -> Conclusion:
    """Follow a block from time 0 to its end, and its copies where errors outgrow the rotation.

    Under a motion of few pieces only a near balance makes errors grow as large. Copies would tell nothing there, and
    compiling would take half as long again.
    """
    if not stepper.has_copies:
        return conclude(stepper, stepper.to_the_end(state))
    budget = stepper.engine.budget(stepper.scene, history=False)

    def step(carry):
        state, paths = carry
        over = paths.is_over(state, budget)
        after = stepper.advance(state)
        paths = _either(over, paths, paths.noted(stepper, state, after))
        after = paths.parted(stepper, after)

        def next_path(carry, needed, inside):
            state, paths = jax.tree.map(inside, carry)
            return paths.next(stepper, state, conclude(stepper, state))

        return cond_any(over, next_path, (_either(over, state, after), paths))

    carry = stepper.begun(state), Paths.of(state)
    return stepper.engine.loop(lambda carry: ~carry[1].finished, step, carry, most_paths(budget))[1].base
