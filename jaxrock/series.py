"""The series engine: Taylor steps of a rocking block from event to event, exact to rounding.

A lane (one block under one motion) steps through its own time. Within a smooth piece of the motion the
opening angle is expanded about the present state, the last coefficients give the step, and the step ends
early at the first event: impact, turning point, saddle crossing, or a new largest velocity. A block at rest
waits for the threshold. Under `jax.vmap` lanes advance together, each at its own time; a branch that no
lane needs is not taken.
"""

from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Inexact, Int

from jaxrock._keep import keep
from jaxrock.models import Angle, opening_series
from jaxrock.polynomial import (
    Landing,
    Watch,
    derivative,
    fall_bound,
    first_event,
    jet,
    keeps_sign,
    rescaled,
    step_length,
)
from jaxrock.scene import Scene
from jaxrock.state import State, surpasses
from jaxrock.status import Status

Scalar = Inexact[ArrayLike, ""]
Flag = Bool[ArrayLike, ""]


class Series(eqx.Module):
    """Settings of the series engine.

    **Arguments:**

    - `order`: order of the Taylor steps, at least 4; None takes 8 for motions of many pieces (records), else 16.
    - `tolerance`: local error of a step over the slenderness alpha, positive; None takes half the rounding unit.
    - `max_steps`: step budget; None takes 100,000 (`outcome`), or 4,096 and two per piece of the motion
      (`simulate`, which stores every step).

    **Raises:** ValueError for a value outside its range.
    """

    order: int | None = eqx.field(static=True, default=None)
    tolerance: float | None = eqx.field(static=True, default=None)
    max_steps: int | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        if self.order is not None and self.order < 4:
            raise ValueError(f"Argument `order` must be at least 4, but is {self.order}.")
        if self.tolerance is not None and not 0 < self.tolerance < 1:
            raise ValueError(f"Argument `tolerance` must be in (0, 1), but is {self.tolerance}.")
        if self.max_steps is not None and self.max_steps < 1:
            raise ValueError(f"Argument `max_steps` must be at least 1, but is {self.max_steps}.")

    def order_for(self, scene: Scene) -> int:
        """Order of the steps: short pieces of a record need few terms."""
        return self.order or (8 if scene.pieces > 32 else 16)

    def tolerance_for(self, scene: Scene) -> float:
        """Local error over alpha."""
        return self.tolerance or float(jnp.finfo(scene.p.dtype).eps) / 2


def _when(needed: Flag, function: Callable, value: State) -> State:
    """`function(value, needed, inside)` where needed; under vmap the function runs only if some lane needs it.

    What the function makes from values outside must pass through `inside` first: otherwise XLA moves it
    out of the branch, and every step pays for it.
    """

    def body(carry):
        first, value = carry
        # The flag changes in the loop: what depends on it stays in the loop.
        return jnp.zeros_like(first), function(value, first, lambda x: keep(x, jnp.where(first, 0.0, -1.0)))

    return jax.lax.while_loop(lambda carry: carry[0], body, (needed, value))[1]


class Stepper(eqx.Module):
    """One scene with the engine's settings, and how far to follow it."""

    scene: Scene
    stop: Scalar  # time at which to stop [s]; infinite: at the end of the motion
    order: int = eqx.field(static=True)
    tolerance: float = eqx.field(static=True)
    history: bool = eqx.field(static=True)  # follow an overturning block down to the ground

    def time(self, state: State) -> Scalar:
        """Time of a state [s]."""
        return self.scene.knots[state.piece] + state.local

    def forcing(self, state: State) -> tuple[list[Scalar], Scalar]:
        """Taylor coefficients of the ground acceleration [g] about a state, in time/unit, and the unit [s]."""
        terms, unit = self.scene.forcing(state.piece, state.local, self.order)
        return [keep(u, state.local) for u in terms], keep(unit, state.local)

    def _room(self, state: State, unit: Scalar) -> Scalar:
        """Time to the next knot or the stop, in units."""
        to_knot = self.scene.lengths[state.piece] - state.local
        return jnp.maximum(jnp.minimum(to_knot, self.stop - self.time(state)), 0.0) / unit

    def _advance(self, state: State, elapsed: Scalar, full: Flag) -> tuple[Int[Array, ""], Scalar, Flag]:
        """Piece and local time after `elapsed` seconds (`full`: up to the knot or the stop), and whether it is over."""
        to_knot = self.scene.lengths[state.piece] - state.local
        ends = full & (to_knot <= self.stop - self.time(state))
        piece = state.piece + ends
        over = jnp.where(jnp.isfinite(self.stop), full & ~ends, piece >= self.scene.pieces)
        return piece, jnp.where(ends, 0.0, state.local + elapsed), over

    def advance(self, state: State) -> State:
        """One step of a lane: waiting at rest, or rocking."""
        forcing, unit = self.forcing(state)
        room = self._room(state, unit)
        resting = state.side == 0
        waited = self._wait(state, forcing, unit, room)
        rocked = self._rock(state, forcing, unit, room, ~resting)
        after = jax.tree.map(lambda a, b: jnp.where(resting, a, b), waited, rocked)
        good = jnp.isfinite(after.opening) & jnp.isfinite(after.velocity) & jnp.isfinite(after.local)
        return replace(
            after,
            steps=state.steps + 1,
            status=Status.where(good, after.status, Status.not_finite),
            done=after.done | ~good,
        )

    def _wait(self, state: State, forcing, unit, room) -> State:
        """At rest: go on to the knot, or to where the acceleration exceeds the threshold."""
        scene, threshold = self.scene, self.scene.table.threshold
        truncated = len(forcing) > self.order  # else a polynomial: exact
        length = step_length(forcing, self.tolerance * threshold, room) if truncated else room
        never = scene.ceilings[state.piece] <= threshold
        length = jnp.where(jnp.isfinite(length), length, 0.0)
        scaled = rescaled(forcing, length)
        slope = scaled[1] if len(scaled) > 1 else jnp.zeros_like(length)
        gap = threshold - jnp.abs(scaled[0])
        slack = 8 * jnp.finfo(gap.dtype).eps * threshold
        touching = jnp.abs(gap) <= slack
        lifts = (gap < -slack) | (touching & (jnp.sign(scaled[0]) * slope > 0))
        full = length >= room
        piece, local, over = self._advance(state, length * unit, full)
        piece = jnp.where(full & ~over & ~self.history, scene.after_quiet(piece), piece)
        waited = replace(state, piece=piece, local=local, done=over | never)

        def search(waited, needed, inside):
            series = rescaled(forcing, inside(length)) + [jnp.zeros_like(length)] * (2 - len(forcing))
            # A threshold that is only touched (or was just left) is not met again at once.
            start = jnp.where(touching, 1e-8, 0.0).astype(gap.dtype)
            one = jnp.ones_like(gap)
            watches = [Watch(0, -one, threshold, True), Watch(0, one, -threshold, True)]
            landing = first_event([inside(c) for c in series], watches, start, needed)
            value, rate = landing.jet
            met = (landing.hits[0] | landing.hits[1]) & (jnp.sign(value) * rate > 0)
            early = landing.x < 1
            cut = replace(
                waited,
                piece=jnp.where(early, state.piece, waited.piece),
                local=jnp.where(early, state.local + landing.x * length * unit, waited.local),
                done=waited.done & ~early,
            )
            return self._lift(cut, value, met, jnp.ones_like(met))

        reachable = ~lifts & ~never & (state.side == 0)
        reachable = reachable & (sum(jnp.abs(c) for c in scaled) >= threshold)
        waited = _when(reachable, search, waited)
        lifted = self._lift(state, scaled[0], lifts, touching)
        return jax.tree.map(lambda a, b: jnp.where(lifts, a, b), lifted, waited)

    def _lift(self, state: State, acceleration, lifts: Flag, continuous: Flag) -> State:
        """Leave rest where `lifts`: positive acceleration drives negative rotation."""
        return replace(
            state,
            side=jnp.where(lifts, -jnp.sign(acceleration), state.side),
            uplifting=jnp.where(lifts, continuous, state.uplifting),
            beyond=jnp.where(lifts, False, state.beyond),
            extremal=jnp.where(lifts, False, state.extremal),
        )

    def angle(self, state: State) -> Angle:
        """The opening angle of a state with its sine and cosine."""
        angle = Angle.of(state.opening)
        return Angle(angle.value, keep(angle.sine, state.local), keep(angle.cosine, state.local))

    def expand(self, state: State, angle: Angle, forcing, unit) -> list[Scalar]:
        """Taylor coefficients of the opening angle about a state, in time/unit."""
        stretch = keep(self.scene.p * unit, state.local)
        speed = state.velocity * stretch
        return opening_series(self.scene.table, stretch, state.side, angle, speed, state.uplifting, forcing, self.order)

    def _rock(self, state: State, forcing, unit, room, rocking: Flag) -> State:
        """Rocking: a Taylor step, cut at the first event."""
        scene = self.scene
        table, saddle = scene.table, scene.table.saddle
        angle = self.angle(state)
        coefficients = self.expand(state, angle, forcing, unit)
        # Relative to the motion itself while it is small: tiny rotations keep their digits too.
        size = jnp.minimum(scene.alpha, jnp.max(jnp.abs(jnp.stack(coefficients[: max(self.order // 2, 4)]))))
        length = step_length(coefficients, self.tolerance * size, jnp.minimum(room, 16.0))
        full = length >= room * (1 - 1e-9)
        length = jnp.where(full, room, length)
        length = keep(length, state.local)
        stretch = unit * scene.p
        opening, speed = (keep(value, state.local) for value in jet(coefficients, length, 1))
        velocity = speed / stretch

        signs = self._signs(state, coefficients)
        turning = keep(keeps_sign(derivative(coefficients), signs[0], length), state.local) <= 0
        crossing = (opening >= saddle) != state.beyond
        top_speed = jnp.maximum(jnp.abs(coefficients[1]), jnp.abs(speed)) + keep(
            _bend(coefficients, length), state.local
        )
        monotone = keep(keeps_sign(derivative(derivative(coefficients)), signs[1], length), state.local) > 0
        faster = (top_speed > state.fastest * stretch) & ~monotone
        eventful = (turning | crossing | faster | (opening <= 0)) & rocking
        if self.history:
            eventful = eventful | (rocking & (opening >= jnp.pi / 2))

        # No forcing that is still to come can bring it back: restoring + ceiling arm < 0 from here on.
        ceiling = scene.ceilings[state.piece]
        escaped = (state.velocity >= 0) & state.beyond
        escaped = escaped & (table.restoring(angle) + ceiling * table.arm(angle) <= 0)

        piece, local, over = self._advance(state, length * unit, full)
        moved = (length > 0) & rocking
        passed = replace(
            state,
            piece=piece,
            local=local,
            opening=opening,
            velocity=jnp.where(moved, velocity, state.velocity),
            uplifting=state.uplifting & ~moved,
            extremal=state.extremal & ~moved,
            fastest=jnp.where(moved, jnp.maximum(state.fastest, jnp.abs(velocity)), state.fastest),
            done=over,
        )

        def land(passed, needed, inside):
            scaled = [inside(c) for c in rescaled(coefficients, inside(length))]
            series = rescaled(forcing, inside(length))
            return self._land(state, passed, scaled, series, signs, faster, length, unit, needed)

        stepped = _when(eventful & moved, land, passed)
        down = stepped.opening >= jnp.pi / 2
        overturned = state.overturned | escaped | down if scene.falls_flat else state.overturned | escaped
        # A history goes on to the ground; for an outcome the verdict is enough.
        ends = overturned & down if self.history else overturned
        return replace(stepped, overturned=overturned, done=stepped.done | ends)

    def _signs(self, state: State, coefficients) -> tuple[Scalar, Scalar]:
        """Signs with which velocity and acceleration start; where one is zero, that of its derivative."""

        def of(value, following):
            return jnp.where(value != 0, jnp.sign(value), jnp.where(following < 0, -1.0, 1.0))

        velocity = jnp.where(state.uplifting, 1.0, of(state.velocity, coefficients[2]))
        acceleration = jnp.where(
            state.uplifting, 1.0, of(jnp.where(state.extremal, 0.0, coefficients[2]), coefficients[3])
        )
        return velocity, acceleration

    def _land(self, state, passed, scaled, forcing, signs, faster, length, unit, needed) -> State:
        """Find the first event of a step, move the lane there, and let it happen."""
        scene, saddle = self.scene, self.scene.table.saddle
        one = jnp.ones_like(length)
        watches = [
            Watch(0, one, 0.0, True),
            Watch(1, signs[0], 0.0, self._matters(state, scaled)),
            Watch(2, signs[1], 0.0, faster),
            Watch(0, jnp.where(state.beyond, 1.0, -1.0), saddle, True),
        ]
        if self.history:
            watches.append(Watch(0, -one, jnp.pi / 2, state.opening < jnp.pi / 2))
        landing = first_event(scaled, watches, _clear_start(state, scaled, saddle), needed)
        per_step = length * unit * scene.p
        opening, speed, bend = landing.jet[0], landing.jet[1] / per_step, landing.jet[2] / per_step**2
        impact, turning, extremum, crossing = landing.hits[:4]
        ground = landing.hits[4] if self.history else jnp.zeros_like(impact)
        impact = impact & (speed <= 0)
        early = landing.x < 1
        elapsed = landing.x * length * unit
        landed = replace(
            passed,
            piece=jnp.where(early, state.piece, passed.piece),
            local=jnp.where(early, state.local + elapsed, passed.local),
            opening=jnp.where(ground, jnp.pi / 2, jnp.where(crossing, saddle, opening)),
            velocity=jnp.where(turning, 0.0, speed),
            beyond=state.beyond ^ crossing,
            extremal=extremum,
            fastest=jnp.maximum(state.fastest, jnp.abs(speed)),
            done=passed.done & ~early,
        )
        landed = self._note(landed, signs[0] > 0, turning, crossing, opening, speed, bend)
        return self._impact(landed, impact, speed, forcing, landing, length, unit)

    def _matters(self, state: State, scaled) -> Flag:
        """Whether a turning point in this step could be a new peak, or closer to overturning than before."""
        always = jnp.ones_like(state.beyond)
        if self.history:
            return always
        # The opening angle stays below c0 + c1 x - fall x^2, whose top is c0 + c1^2/(4 fall).
        table = self.scene.table
        fall = -scaled[2] - sum(jnp.maximum(c, 0.0) for c in scaled[3:])
        rise = jnp.maximum(scaled[1], 0.0) ** 2 / (4 * jnp.where(fall > 0, fall, 1.0))
        top = jnp.where(fall > 0, jnp.minimum(state.opening + rise, table.saddle), table.saddle)
        least = (table.restoring(Angle.of(top)) / table.restoring_at_rest) ** 2
        return state.beyond | (top >= state.peak) | (least < state.closeness)

    def _note(self, state: State, outward, turning, crossing, opening, speed, bend) -> State:
        """Keep peaks and how close the block came to standing still in balance (see `Outcome.margin`)."""
        table = self.scene.table
        # The acceleration with or without the shaking, whichever is larger: a block that the ground holds for an
        # instant, far from its saddle, is not in balance.
        pull = jnp.maximum(jnp.abs(bend), jnp.abs(table.restoring(Angle.of(opening))))
        stillness = (speed**2 + pull**2) / table.restoring_at_rest**2
        turn = turning & (outward | state.beyond)
        closeness = jnp.where(turn, jnp.minimum(state.closeness, stillness), state.closeness)
        closeness = jnp.where(crossing, jnp.minimum(closeness, stillness), closeness)
        beyond = jnp.where(crossing, jnp.where(state.beyond, stillness, jnp.inf), state.closeness_beyond)
        beyond = jnp.where(turning & state.beyond, jnp.minimum(beyond, stillness), beyond)
        higher = turning & outward
        first = higher & surpasses(opening, state.peak)
        return replace(
            state,
            peak=jnp.where(higher, jnp.maximum(opening, state.peak), state.peak),
            peak_time=jnp.where(first, self.time(state), state.peak_time),
            closeness=closeness,
            closeness_beyond=beyond,
        )

    def _impact(self, state: State, impact: Flag, speed, forcing, landing: Landing, length, unit) -> State:
        """Change side with the restitution; come to rest where the impacts to come no longer matter.

        After an impact at speed v the block hops for 2 v/a, a the deceleration on that side; the hops to come last
        2 v (1/a + e/a')/(1 - e^2). They are replaced by rest where it is certain that they end before the forcing
        has changed by half of the weaker deceleration (so all speeds stay below e^(1/2) those of constant forcing,
        and all hops end within four times that time), and that none is higher, faster or closer to overturning than
        what has been. Each is slower by e, so those above the tolerance can be counted.
        """
        scene, table, e = self.scene, self.scene.table, self.scene.restitution
        rebound = e * jnp.abs(speed)
        side = -state.side
        push = side * jet(forcing, landing.x, 0)[0] * table.arm_at_rest
        here, there = table.restoring_at_rest + push, table.restoring_at_rest - push
        weaker = jnp.minimum(here, there)
        held = (weaker > 0) & (e < 1)
        here, there = jnp.where(held, here, 1.0), jnp.where(held, there, 1.0)
        remaining = 2 * rebound * (1 / here + e / there) / jnp.where(held, 1 - e * e, 1.0)
        window = 4 * remaining / (scene.p * unit)  # in units of time
        steepest = sum(k * jnp.abs(c) for k, c in enumerate(forcing)) / jnp.where(length > 0, length, 1.0)
        dies = held & (steepest * window * table.arm_at_rest <= weaker / 2) & (window <= (1 - landing.x) * length)
        # Speed of a hop as high as the tolerance; a history shows the hops down to there.
        low = jnp.sqrt(200 * self.tolerance * scene.alpha * jnp.minimum(here, there))
        if self.history:
            dies = dies & (rebound <= low)
        else:
            highest = 3 * rebound**2 * jnp.maximum(1 / here, e * e / there)
            least = (table.restoring(Angle.of(jnp.minimum(highest, table.saddle))) / table.restoring_at_rest) ** 2
            dies = dies & (highest <= state.peak) & (2 * rebound <= state.fastest) & (least >= state.closeness)
        rests = impact & (dies | (rebound == 0))
        more = jnp.log(low / jnp.maximum(rebound, low)) / jnp.log(jnp.clip(e, 1e-3, 1 - 1e-9))
        more = jnp.where(rests, jnp.ceil(more).astype(state.impacts.dtype), 0)
        wait = jnp.where(rests & (rebound > 0), remaining / scene.p, 0.0)
        return replace(
            state,
            impacts=state.impacts + (impact & (speed < 0)) + more,
            impact_time=jnp.where(impact, self.time(state), state.impact_time),
            impact_velocity=jnp.where(impact, state.side * speed, state.impact_velocity),
            side=jnp.where(rests, 0.0, jnp.where(impact, side, state.side)),
            opening=jnp.where(impact, 0.0, state.opening),
            velocity=jnp.where(rests, 0.0, jnp.where(impact, rebound, state.velocity)),
            local=state.local + wait,
            beyond=state.beyond & ~impact,
            uplifting=state.uplifting & ~impact,
            extremal=state.extremal & ~impact,
        )


def _bend(coefficients: list[Scalar], length: Scalar) -> Scalar:
    """How far the velocity can exceed its end values within a step (an eighth of its largest second derivative)."""
    one = jnp.ones_like(length)
    third = jnp.maximum(fall_bound(coefficients, one, 3, length), fall_bound(coefficients, -one, 3, length))
    return third * length**2 / 8


def _clear_start(state: State, scaled: list[Scalar], saddle: Scalar) -> Scalar:
    """From where to look for events: a block that leaves rest has opening, velocity and (continuous motion)
    acceleration zero at its start, and all three are positive up to here."""
    one, zero = jnp.ones_like(saddle), jnp.zeros_like(saddle)
    lead = jnp.where(state.uplifting, 3 * scaled[3], scaled[2])
    rest = [zero, zero, zero, jnp.where(state.uplifting, 0.0, scaled[3]), *scaled[4:]]
    tiny = jnp.finfo(saddle.dtype).tiny
    clear = jnp.clip(lead / jnp.maximum(fall_bound(rest, one, 2), tiny), 0.0, 0.5)
    below_saddle = jnp.sqrt(saddle / (4 * sum(jnp.abs(c) for c in scaled) + tiny))
    leaving = (state.opening == 0) & (state.velocity == 0)
    return jnp.where(leaving, jnp.minimum(clear, below_saddle), 0.0)
