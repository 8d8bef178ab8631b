"""What both engines do alike: time and pieces, waiting at rest, impacts and coming to rest, peaks and the margin.

An engine brings its own way to follow a rocking block from event to event (`advance`), to tell what follows after
the motion (`finish`), and to evaluate a history (`evaluate`).
"""

import abc
from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from equinox import AbstractVar
from jaxtyping import Array, ArrayLike, Bool, Inexact, Int, PyTree

from jaxrock._keep import keep, keep_flag
from jaxrock._pick import pick
from jaxrock._trigonometry import logarithm
from jaxrock.models import Angle
from jaxrock.polynomial import Watch, first_event, rescaled, step_length
from jaxrock.scene import Scene
from jaxrock.spread import GRAZING, Spread
from jaxrock.state import State, surpasses
from jaxrock.status import Status
from jaxrock.taylor import meet

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
        lost = (after.side != 0) & ~(after.spread.size <= _LOST * self.scene.table.saddle)
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

    def wait(self, state: State, forcing: list[Scalar], unit: Scalar, order: int, tolerance: float, branch) -> State:
        """At rest: go on to the knot, or to where the acceleration exceeds the threshold (`branch`: see `when`)."""
        scene, threshold = self.scene, self.scene.table.threshold
        room = self.room(state) / unit
        truncated = len(forcing) > order  # else a polynomial: exact
        length = step_length(forcing, tolerance * threshold, room) if truncated else room
        never = pick(scene.ceilings, state.piece) <= threshold
        # How far a step goes changes nothing: it has no derivative.
        room, length = jax.lax.stop_gradient((room, jnp.where(jnp.isfinite(length), length, 0.0)))
        scaled = rescaled(forcing, length)
        fixed, level = jax.lax.stop_gradient((scaled, threshold))
        slope = fixed[1] if len(fixed) > 1 else jnp.zeros_like(length)
        gap = level - jnp.abs(fixed[0])
        slack = 8 * jnp.finfo(gap.dtype).eps * level
        touching = jnp.abs(gap) <= slack
        lifts = (gap < -slack) | (touching & (jnp.sign(fixed[0]) * slope > 0))

        def search(found, needed, inside):
            series = [inside(c) for c in fixed] + [jnp.zeros_like(length)] * (2 - len(fixed))
            # A threshold that is touched already counts as passed when it is left behind by more than rounding.
            one, least = jnp.ones_like(gap), level + jnp.where(touching, 2 * slack, 0.0)
            watches = [Watch(0, -one, least, True), Watch(0, one, -least, True)]
            landing = first_event(series, watches, jnp.zeros_like(gap), needed)
            value, rate = landing.jet[:2]
            met = (landing.hits[0] | landing.hits[1]) & (jnp.sign(value) * rate > 0)
            return landing.x, jnp.where(met, value, 0.0)

        reachable = ~lifts & ~never & (state.side == 0)
        reachable = reachable & (sum(jnp.abs(c) for c in fixed) >= level)
        x, passed = branch(reachable, search, (jnp.ones_like(length), jnp.zeros_like(length)))
        met, early = passed != 0, x < 1
        x = jnp.where(met, meet(x, scaled, jnp.sign(passed) * threshold), x)
        full = (length >= room) & ~early
        piece, local, over = self.move_on(state, x * length * unit, full)
        piece = jnp.where(full & ~over & ~self.history, scene.after_quiet(piece), piece)
        waited = self.lift(replace(state, piece=piece, local=local, done=over | (never & ~early)), passed, met, met)
        lifted = self.lift(state, fixed[0], lifts, touching)
        return jax.tree.map(lambda a, b: jnp.where(lifts, a, b), lifted, waited)

    def lift(self, state: State, acceleration, lifts: Flag, continuous: Flag) -> State:
        """Leave rest where `lifts`: positive acceleration drives negative rotation."""
        return replace(
            state,
            side=jnp.where(lifts, -jnp.sign(acceleration), state.side),
            uplifting=jnp.where(lifts, continuous, state.uplifting),
            beyond=jnp.where(lifts, False, state.beyond),
            extremal=jnp.where(lifts, False, state.extremal),
        )

    def escaped(self, state: State, angle: Angle) -> Flag:
        """Whether no forcing still to come can bring it back.

        The most helpful forcing is the bound of all that is to come, for good: the block is lost if it is past the
        stable manifold even then.
        """
        table = self.scene.table
        ceiling = pick(self.scene.ceilings, state.piece)
        hold = table.restoring(angle) + ceiling * table.arm(angle)
        needed = jnp.where(hold > 0, table.held_manifold(angle, hold, ceiling), 0.0)
        certain = state.velocity - needed > self.doubt * state.spread.along(1.0, 1.0)
        return state.beyond & (state.velocity >= 0) & certain

    def spread_after(self, state: State, angle: Angle, push: Scalar, elapsed: Scalar, step: tuple) -> Spread:
        """Errors after `elapsed` seconds of rocking; `push`: side times acceleration [g]; `step`: what the engine's
        own approximation adds to the errors of angle and velocity [rad]. Rounding is added here."""
        stepper, state, angle, push, elapsed, step = jax.lax.stop_gradient((self, state, angle, push, elapsed, step))
        table, p = stepper.scene.table, stepper.scene.p  # an error has no derivative
        eps, time, speed = 2 * jnp.finfo(p.dtype).eps, p * elapsed, jnp.abs(state.velocity)
        clock = eps * p * state.local  # the time of a state is rounded, too
        pull = eps * (table.restoring_at_rest + jnp.abs(push) * table.arm_at_rest)  # of what acceleration is left
        spread = state.spread.after_flow(table.repulsion(angle, push), time)
        return spread.plus(
            step[0] + eps * (jnp.abs(state.opening) + speed * time) + pull * time**2 + clock * speed,
            step[1] + eps * speed + pull * (time + p * state.local),
        )

    def note(self, state: State, outward, turning, crossing, opening, speed, bend) -> State:
        """Keep peaks and how close the block came to standing still in balance (see `Outcome.margin`)."""
        table = self.scene.table
        # The acceleration with or without the shaking, whichever is larger: a block that the ground holds for an
        # instant, far from its saddle, is not in balance.
        pull = jnp.maximum(jnp.abs(bend), jnp.abs(table.restoring(Angle.of(opening))))
        stillness = keep((speed**2 + pull**2) / table.restoring_at_rest**2, state.local)
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

    def impact(self, state: State, hit: Flag, speed: Scalar, forcing: Scalar, steepest: Scalar, reach: Scalar) -> State:
        """Change side with the restitution; come to rest where the impacts to come no longer matter.

        `forcing`: the ground acceleration [g]; for `reach` seconds from now it changes by `steepest` [g/s] at most.

        After an impact at speed v the block hops for 2 v/a, a the deceleration on that side; the hops to come last
        2 v (1/a + e/a')/(1 - e^2). They are replaced by rest where it is certain that they end before the forcing
        has changed by half of the weaker deceleration (so all speeds stay below e^(1/2) those of constant forcing,
        and all hops end within four times that time), and that none is higher, faster or closer to overturning than
        what has been. Each is slower by e, so those above the rounding of alpha can be counted.
        """
        scene, table, e = self.scene, self.scene.table, self.scene.restitution
        rebound = e * jnp.abs(speed)
        side = -state.side
        push = side * forcing * table.arm_at_rest
        here, there = table.restoring_at_rest + push, table.restoring_at_rest - push
        spread = jax.lax.stop_gradient(state.spread.after_impact(speed, -there, -here, e))
        slowed = hit & (here < 0)  # by the forcing, before it hit the ground: without that it would have turned back
        depth = speed**2 / (2 * jnp.where(slowed, -here, 1.0))
        weaker = jnp.minimum(here, there)
        held = (weaker > 0) & (e < 1)
        here, there = jnp.where(held, here, 1.0), jnp.where(held, there, 1.0)
        remaining = 2 * rebound * (1 / here + e / there) / jnp.where(held, 1 - e * e, 1.0)
        window = 4 * remaining / scene.p
        dies = held & (steepest * window * table.arm_at_rest <= weaker / 2) & (window <= reach)
        # Speed of a hop of rounding height; a history shows the hops down to there.
        low = jnp.sqrt(100 * jnp.finfo(scene.p.dtype).eps * scene.alpha * jnp.minimum(here, there))
        if self.history:
            dies = dies & (rebound <= low)
        else:
            highest = 3 * rebound**2 * jnp.maximum(1 / here, e * e / there)
            least = (table.restoring(Angle.of(jnp.minimum(highest, table.saddle))) / table.restoring_at_rest) ** 2
            dies = dies & (highest <= state.peak) & (2 * rebound <= state.fastest) & (least >= state.closeness)
        rests = keep_flag(hit & (dies | (rebound == 0)), state.local)
        more = logarithm(low / jnp.maximum(rebound, low)) / logarithm(jnp.clip(e, 1e-3, 1 - 1e-9))
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
