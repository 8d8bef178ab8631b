"""What both engines do alike: time and pieces, waiting at rest, impacts and coming to rest, peaks and the margin.

An engine brings its own way to follow a rocking block from event to event (`advance`), to tell what follows after
the motion (`finish`), and to evaluate a history (`evaluate`).
"""

import abc
import functools
from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from equinox import AbstractVar
from jaxtyping import Array, ArrayLike, Bool, Inexact, Int, PyTree

from jaxrock.engines.scene import Scene
from jaxrock.engines.state import State, surpasses
from jaxrock.engines.taylor.expansion import meet
from jaxrock.engines.uncertainty import GRAZING, Spread
from jaxrock.models.equation import Angle
from jaxrock.motions.motion import Shaking
from jaxrock.numerics.elementary import logarithm
from jaxrock.numerics.lookup import pick
from jaxrock.numerics.polynomial import Watch, first_event, step_length
from jaxrock.numerics.xla_cpu import keep, keep_flag
from jaxrock.status import Status

Scalar = Inexact[ArrayLike, ""]


Flag = Bool[ArrayLike, ""]


_LOST = 1e-2  # standard error over the saddle's angle beyond which a state means nothing


def when(needed: Flag, function: Callable, value: PyTree) -> PyTree:
    """`function(value, needed, inside)` where needed; under vmap the function runs only if some lane needs it.

    What the function makes from values outside must pass through `inside` first: otherwise XLA moves it
    out of the branch, and every step pays for it.
    """

    def body(carry):
        first, value = carry
        # The flag changes in the loop: what depends on it stays in the loop.
        return jnp.zeros_like(first), function(value, first, lambda x: keep(x, jnp.where(first, 0.0, -1.0)))

    return jax.lax.while_loop(lambda carry: carry[0], body, (needed, value))[1]


def either(needed: Flag, function: Callable, value: PyTree) -> PyTree:
    """As `when`, but always computed, so that reverse mode goes through."""
    return jax.tree.map(lambda a, b: jnp.where(needed, a, b), function(value, needed, lambda x: x), value)


class AbstractEngine(eqx.Module):
    """Settings of a way to solve scenes."""

    @property
    def reverse(self) -> bool:
        """Whether reverse mode goes through this engine's own loops."""
        return False

    @abc.abstractmethod
    def stepper(self, scene: Scene, stop: Scalar, history: bool, taped: bool = False) -> "AbstractStepper":
        """This engine at work on a scene, up to the time `stop` [s] (infinite: the end of the motion); `taped`: so that
        reverse mode goes through its steps."""

    @abc.abstractmethod
    def budget(self, scene: Scene, history: bool) -> int:
        """Largest number of steps."""

    @abc.abstractmethod
    def loop(self, unfinished: Callable, step: Callable, carry: PyTree, budget: int) -> PyTree:
        """Repeat `step` while `unfinished`, at most `budget` times."""


class AbstractStepper(eqx.Module):
    """One scene with an engine's settings, and how far to follow it."""

    scene: AbstractVar[Scene]
    stop: AbstractVar[Scalar]  # time at which to stop [s]; infinite: at the end of the motion
    history: AbstractVar[bool]  # follow an overturning block down to the ground
    doubt: AbstractVar[float]  # standard errors from the boundary within which a verdict is not given

    @abc.abstractmethod
    def advance(self, state: State) -> State:
        """The state at the next event or step."""

    @abc.abstractmethod
    def finish(self, state: State) -> State:
        """A state at the end of the motion, brought to the end of the free stage: peak, verdict and margin."""

    @abc.abstractmethod
    def evaluate(self, node: State, elapsed: Scalar) -> tuple[Scalar, Scalar]:
        """Opening angle [rad] and its velocity [rad/s], `elapsed` seconds after a node and before the next."""

    def on(self, side: Scalar) -> "AbstractStepper":
        """The same for a block that stands on this side."""
        return self if self.scene.far is None else replace(self, scene=self.scene.on(side))

    def time(self, state: State) -> Scalar:
        """Time of a state [s]."""
        return pick(self.scene.knots, state.piece) + state.local

    def room(self, state: State) -> Scalar:
        """Time to the next knot or the stop [s]."""
        to_knot = pick(self.scene.lengths, state.piece) - state.local
        return jnp.maximum(jnp.minimum(to_knot, self.stop - self.time(state)), 0.0)

    def move_on(self, state: State, elapsed: Scalar, full: Flag) -> tuple[Int[Array, ""], Scalar, Flag]:
        """Piece and local time after `elapsed` seconds (`full`: up to the knot or the stop), and whether it is over."""
        to_knot = pick(self.scene.lengths, state.piece) - state.local
        ends = full & (to_knot <= self.stop - self.time(state))
        piece = state.piece + ends
        over = jnp.where(jnp.isfinite(self.stop), full & ~ends, piece >= self.scene.pieces)
        return piece, jnp.where(ends, 0.0, state.local + elapsed), over

    def checked(self, before: State, after: State) -> State:
        """Count the step; stop where the state is not finite, and tell where its error has outgrown it."""
        good = jnp.isfinite(after.opening) & jnp.isfinite(after.velocity) & jnp.isfinite(after.local)
        lost = (after.side != 0) & ~(after.spread.size <= _LOST * self.scene.moments.saddle)
        if not self.history:
            # In the free stage only the next peak or passage counts, which `note` judges.
            lost = lost & (before.piece < self.scene.pieces)
        undecided = lost & (after.status == Status.successful)
        status = Status.where(undecided, Status.undecided, after.status)
        return replace(
            after,
            steps=before.steps + 1,
            status=Status.where(good, status, Status.not_finite),
            done=after.done | ~good,
        )

    def wait(self, state: State, shaking: Shaking, unit: Scalar, order: int, tolerance: float, branch) -> State:
        """At rest: go on to the knot, or to where the ground lifts the block (`branch`: see `when`)."""
        scene, eps = self.scene, jnp.finfo(state.local.dtype).eps
        room = self.room(state) / unit
        length = self.longest_wait(shaking, room, order, tolerance)
        never = pick(scene.drives, state.piece) <= scene.threshold
        # How far a step goes changes nothing: it has no derivative.
        room, length = jax.lax.stop_gradient((room, jnp.where(jnp.isfinite(length), length, 0.0)))
        zero = jnp.zeros_like(length)
        lifted, found = [], []
        for drive, level in scene.drives_of(shaking.rescaled(length)):
            fixed, high = jax.lax.stop_gradient((drive, level))
            slope = fixed[1] if len(fixed) > 1 else zero
            slack = 8 * eps * high
            touching = jnp.abs(high - fixed[0]) <= slack
            lifts = (high - fixed[0] < -slack) | (touching & (slope > 0))
            # A threshold that is touched already counts as passed when it is left behind by more than rounding.
            least = high + jnp.where(touching, 2 * slack, 0.0)

            def search(found, needed, inside, fixed=fixed, least=least):
                series = [inside(c) for c in fixed] + [zero] * (2 - len(fixed))
                watch = Watch(0, -jnp.ones_like(zero), least, True)
                landing = first_event(series, [watch], zero, needed)
                return landing.x, landing.hits[0] & (landing.jet[1] > 0)

            reachable = ~lifts & ~never & (state.side == 0) & (sum(jnp.abs(c) for c in fixed) >= high)
            x, met = branch(reachable, search, (jnp.ones_like(length), jnp.zeros_like(lifts)))
            found.append((jnp.where(met, meet(x, drive, level), x), met, x))
            lifted.append((lifts, touching))
        (x, met, at), (x2, met2, at2) = found
        second = met2 & (~met | (at2 < at))
        met, early = met | met2, jnp.minimum(at, at2) < 1
        x = jnp.where(second, x2, jnp.where(met, x, jnp.minimum(at, at2)))
        full = (length >= room) & ~early
        piece, local, over = self.move_on(state, x * length * unit, full)
        piece = jnp.where(full & ~over & (not self.history), scene.after_quiet(piece), piece)
        waited = replace(state, piece=piece, local=local, done=over | (never & ~early))
        waited = self.lift(waited, jnp.where(second, -1.0, 1.0), met, met)
        (first, touching), (other, touching2) = lifted
        at_once = self.lift(state, jnp.where(first, 1.0, -1.0), first | other, jnp.where(first, touching, touching2))
        return jax.tree.map(lambda a, b: jnp.where(first | other, a, b), at_once, waited)

    def longest_wait(self, shaking: Shaking, room: Scalar, order: int, tolerance: float) -> Scalar:
        """For how long the series tell what the ground does, at most `room`."""
        length = room
        for terms, scale in zip(shaking, (self.scene.threshold, 1.0)):
            if terms is not None and len(terms) > order:  # else a polynomial: exact
                length = jnp.minimum(length, step_length(terms, tolerance * scale, room))
        return length

    def lift(self, state: State, side: Scalar, lifts: Flag, continuous: Flag) -> State:
        """Leave rest to a side where `lifts`; `continuous`: with zero acceleration."""
        return replace(
            state,
            side=jnp.where(lifts, side, state.side),
            uplifting=jnp.where(lifts, continuous, state.uplifting),
            beyond=jnp.where(lifts, False, state.beyond),
            extremal=jnp.where(lifts, False, state.extremal),
        )

    def escaped(self, state: State, angle: Angle) -> Flag:
        """Whether no forcing still to come can bring it back.

        The most helpful forcing is the bound of all that is to come, for good: the block is lost if it is past the
        stable manifold even then.
        """
        moments = self.scene.moments
        ceiling, weight = self.scene.most_helpful(state.piece)
        hold = -moments.acceleration(angle, state.velocity, ceiling, weight)
        needed = jnp.where(hold > 0, moments.held_manifold(angle, hold, ceiling, weight), 0.0)
        certain = state.velocity - needed > self.doubt * state.spread.along(1.0, 1.0)
        return state.beyond & (state.velocity >= 0) & certain

    def spread_after(self, state: State, angle: Angle, ground: tuple, elapsed: Scalar, step: tuple) -> Spread:
        """Errors after `elapsed` seconds of rocking; `ground`: acceleration [g] and weight (`Shaking.at`); `step`: what
        the engine's own approximation adds to the errors of angle and velocity [rad]. Rounding is added here."""
        given = self, state, angle, ground, elapsed, step
        stepper, state, angle, (acceleration, weight), elapsed, step = jax.lax.stop_gradient(given)
        push = state.side * acceleration
        moments, p = stepper.scene.moments, stepper.scene.p  # an error has no derivative
        eps, time, speed = 2 * jnp.finfo(p.dtype).eps, p * elapsed, jnp.abs(state.velocity)
        clock = eps * p * state.local  # the time of a state is rounded, too
        pull = eps * (moments.restoring_at_rest + jnp.abs(push) * moments.arm_at_rest)  # of what acceleration is left
        spread = state.spread.after_flow(moments.repulsion(angle, push, weight), time)
        return spread.plus(
            step[0] + eps * (jnp.abs(state.opening) + speed * time) + pull * time**2 + clock * speed,
            step[1] + eps * speed + pull * (time + p * state.local),
        )

    def note(self, state: State, outward, turning, crossing, opening, speed, bend) -> State:
        """Keep peaks and how close the block came to standing still in balance (see `Outcome.margin`)."""
        moments = self.scene.moments
        # The acceleration with or without the shaking, whichever is larger: a block that the ground holds for an
        # instant, far from its saddle, is not in balance.
        pull = jnp.maximum(jnp.abs(bend), jnp.abs(moments.restoring(Angle.of(opening))))
        stillness = keep((moments.stiffness * speed**2 + pull**2) / moments.restoring_at_rest**2, state.local)
        turn = turning & (outward | state.beyond)
        closeness = jnp.where(turn, jnp.minimum(state.closeness, stillness), state.closeness)
        closeness = jnp.where(crossing, jnp.minimum(closeness, stillness), closeness)
        beyond = jnp.where(crossing, jnp.where(state.beyond, stillness, jnp.inf), state.closeness_beyond)
        beyond = jnp.where(turning & state.beyond, jnp.minimum(beyond, stillness), beyond)
        higher = turning & outward
        first = higher & surpasses(opening, state.peak)
        # Turning back just above the ground, within the error of the angle: there may have been an impact.
        off = jnp.abs(opening) + state.spread.angle
        grazing = turning & ~outward & (off <= GRAZING * state.spread.angle)
        graze = jnp.where(grazing, jnp.sqrt(8 * jnp.abs(bend) * off), 0.0)
        # Standing still in balance, within the error of the state along which it leaves.
        balanced = (turning | crossing) & (jnp.hypot(speed, pull) <= self.doubt * state.spread.along(1.0, 1.0))
        if self.scene.falls_flat:
            balanced = balanced | (higher & (jnp.abs(opening - jnp.pi / 2) <= self.doubt * state.spread.angle))
        undecided = balanced & (state.status == Status.successful)
        highest = higher & (opening > state.peak)
        clearance = jnp.where(turning & ~outward, jnp.minimum(state.clearance, opening), state.clearance)
        return replace(
            state,
            peak=jnp.where(highest, opening, state.peak),
            second=jnp.where(higher, jnp.maximum(state.second, jnp.minimum(opening, state.peak)), state.second),
            clearance=clearance,
            peak_clearance=jnp.where(highest, clearance, state.peak_clearance),
            peak_time=jnp.where(first, self.time(state), state.peak_time),
            error=jnp.where(first, jax.lax.stop_gradient(state.spread.angle), state.error),
            closeness=closeness,
            closeness_beyond=beyond,
            spread=jax.lax.stop_gradient(state.spread.plus(0.0, graze)),
            status=Status.where(undecided, Status.undecided, state.status),
        )

    def impact(self, state: State, hit: Flag, speed: Scalar, ground: tuple, steepest: tuple, reach: Scalar) -> State:
        """Change side with the restitution; come to rest where the impacts to come no longer matter.

        `ground`: acceleration [g] and weight (`Shaking.at`); for `reach` seconds from now horizontal and vertical
        acceleration change by `steepest` [g/s] at most.

        After an impact at speed v the block hops for 2 v/a, a the deceleration on that side; the hops to come last
        2 v (1/a + e'/a')/(1 - e e'), with a' and e' on the other side. They are replaced by rest where it is certain
        that they end before the forcing has changed by half of the weaker deceleration (so all speeds stay below
        e^(1/2) those of constant forcing, and all hops end within four times that time), and that none is higher,
        faster or closer to overturning than what has been. Each is slower by e, so those above the rounding of alpha
        can be counted.
        """
        scene, (moments, ahead), side = self.scene, self.scene.both_moments, -state.side
        e, back = scene.restitution, scene.far_restitution
        rebound, rest = e * jnp.abs(speed), Angle(jnp.zeros_like(speed), 0.0, 1.0)
        # Decelerations on the side to come, and on the one before.
        here = -ahead.acceleration(rest, rebound, side * ground[0], ground[1])
        there = -moments.acceleration(rest, speed, state.side * ground[0], ground[1])
        spread = jax.lax.stop_gradient(state.spread.after_impact(speed, -there, -here, e))
        slowed = hit & (there < 0)  # by the forcing, before it hit the ground: without that it would have turned back
        depth = speed**2 / (2 * jnp.where(slowed, -there, 1.0))
        weaker = jnp.minimum(here, there)
        held = (weaker > 0) & (e * back < 1)
        here, there = jnp.where(held, here, 1.0), jnp.where(held, there, 1.0)
        remaining = 2 * rebound * (1 / here + back / there) / jnp.where(held, 1 - e * back, 1.0)
        window = 4 * remaining / scene.p
        change = functools.reduce(jnp.maximum, [t.change_at_rest(*steepest) for t in scene.different_moments])
        dies = held & (change * window <= weaker / 2) & (window <= reach)
        # Speed of a hop of rounding height; a history shows the hops down to there.
        low = jnp.sqrt(100 * jnp.finfo(scene.p.dtype).eps * scene.alpha * jnp.minimum(here, there))
        if self.history:
            dies = dies & (rebound <= low)
        else:
            highest = 3 * rebound**2 * jnp.maximum(1 / here, back * back / there)
            fastest = 2 * rebound if scene.far is None else 2 * rebound * jnp.maximum(back, 1)
            dies = dies & (highest <= state.peak) & (fastest <= state.fastest)
            for t in scene.different_moments:
                least = (t.restoring(Angle.of(jnp.minimum(highest, t.saddle))) / t.restoring_at_rest) ** 2
                dies = dies & (least >= state.closeness)
        rests = keep_flag(hit & (dies | (rebound == 0)), state.local)
        slower = e if scene.far is None else jnp.sqrt(e * back)  # from hop to hop, in the mean
        more = logarithm(low / jnp.maximum(rebound, low)) / logarithm(jnp.clip(slower, 1e-3, 1 - 1e-9))
        more = jnp.where(rests, jnp.ceil(more).astype(state.impacts.dtype), 0)
        wait = jax.lax.stop_gradient(jnp.where(rests & (rebound > 0), remaining / scene.p, 0.0))
        return replace(
            state,
            impacts=state.impacts + (hit & (speed < 0)) + more,
            impact_time=jnp.where(hit, self.time(state), state.impact_time),
            impact_velocity=jnp.where(hit, state.side * speed, state.impact_velocity),
            side=jnp.where(rests, 0.0, jnp.where(hit, side, state.side)),
            clearance=jnp.where(slowed, jnp.minimum(state.clearance, depth), state.clearance),
            opening=jnp.where(hit, 0.0, state.opening),
            velocity=jnp.where(rests, 0.0, jnp.where(hit, rebound, state.velocity)),
            spread=Spread.where(rests, Spread.none(speed), Spread.where(hit, spread, state.spread)),
            local=state.local + wait,
            beyond=state.beyond & ~hit,
            uplifting=state.uplifting & ~hit,
            extremal=state.extremal & ~hit,
        )
