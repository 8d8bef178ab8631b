"""The series engine: Taylor steps of a rocking block from event to event, exact to rounding.

A lane (one block under one motion) steps through its own time. Within a smooth piece of the motion the
opening angle is expanded about the present state, the last coefficients give the step, and the step ends
early at the first event: impact, turning point, saddle crossing, or a new largest velocity. A block at rest
waits for the threshold. Under `jax.vmap` lanes advance together, each at its own time; a branch that no
lane needs is not taken.
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import ArrayLike, Bool, Inexact

from jaxrock._keep import keep
from jaxrock.engine import AbstractEngine, AbstractStepper, when
from jaxrock.free import free_stage
from jaxrock.models import Angle, Table, opening_series
from jaxrock.polynomial import (
    Watch,
    derivative,
    fall_bound,
    first_event,
    jet,
    keeps_sign,
    last_size,
    rescaled,
    step_length,
)
from jaxrock.scene import Scene
from jaxrock.state import State, surpasses
from jaxrock.status import Status

Scalar = Inexact[ArrayLike, ""]
Flag = Bool[ArrayLike, ""]

_OUTCOME_STEPS = 100_000


class Series(AbstractEngine):
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

    def stepper(self, scene: Scene, stop: Scalar, history: bool) -> "TaylorStepper":
        """This engine at work on a scene; short pieces of a record need few terms."""
        if not isinstance(scene.table, Table):
            raise ValueError("Argument `engine` must be a Diffrax(...) for a model that is given as functions.")
        return TaylorStepper(
            scene=scene,
            stop=stop,
            order=self.order or (8 if scene.pieces > 32 else 16),
            tolerance=self.tolerance or float(jnp.finfo(scene.p.dtype).eps) / 2,
            history=history,
        )

    def budget(self, scene: Scene, history: bool) -> int:
        """Largest number of steps."""
        return self.max_steps or (4096 + 2 * scene.pieces if history else _OUTCOME_STEPS)

    def loop(self, unfinished, step, carry, budget: int):
        """A loop that stops at the last lane; forward mode only."""
        return jax.lax.while_loop(unfinished, step, carry)


class TaylorStepper(AbstractStepper):
    """One scene with the engine's settings, and how far to follow it."""

    scene: Scene
    stop: Scalar  # time at which to stop [s]; infinite: at the end of the motion
    order: int = eqx.field(static=True)
    tolerance: float = eqx.field(static=True)
    history: bool = eqx.field(static=True)
    doubt: float = eqx.field(static=True, default=8.0)  # what is estimated here is rounding

    def forcing(self, state: State) -> tuple[list[Scalar], Scalar]:
        """Taylor coefficients of the ground acceleration [g] about a state, in time/unit, and the unit [s]."""
        terms, unit = self.scene.forcing(state.piece, state.local, self.order)
        return [keep(u, state.local) for u in terms], keep(unit, state.local)

    def advance(self, state: State) -> State:
        """One step of a lane: waiting at rest, or rocking."""
        forcing, unit = self.forcing(state)
        resting = state.side == 0
        waited = self.wait(state, forcing, unit, self.order, self.tolerance, when)
        rocked = self._rock(state, forcing, unit, ~resting)
        return self.checked(state, jax.tree.map(lambda a, b: jnp.where(resting, a, b), waited, rocked))

    def finish(self, state: State) -> State:
        """The free stage by energy."""
        scene, table = self.scene, self.scene.table
        moving = (state.side != 0) & ~state.overturned & (state.piece >= scene.pieces)
        stage = free_stage(table, scene.restitution, state.opening, state.velocity, moving)
        # A loss after one more impact is a new excursion; otherwise this one may have been closer before.
        beyond = jnp.where(stage.impacts > 0, stage.closeness, jnp.minimum(state.closeness_beyond, stage.closeness))
        higher = surpasses(stage.peak, state.peak)
        # The energy that is missing to the saddle, 2 (E_saddle - E), and what it may be off.
        slope = -2 * table.restoring(Angle.of(state.opening))
        off = state.spread.along(slope, -2 * state.velocity) * stage.share
        toss_up = moving & (jnp.abs(stage.deficit) <= self.doubt * off) & (state.status == Status.successful)
        steepness = 2 * jnp.abs(table.restoring(Angle.of(stage.peak)))
        return replace(
            state,
            overturned=state.overturned | stage.overturned,
            closeness=jnp.minimum(state.closeness, stage.closeness),
            closeness_beyond=beyond,
            peak=jnp.maximum(state.peak, stage.peak),
            peak_time=jnp.where(higher, self.time(state) + stage.peak_time / scene.p, state.peak_time),
            error=jax.lax.stop_gradient(jnp.where(higher, off / jnp.where(steepness > 0, steepness, 1.0), state.error)),
            fastest=jnp.maximum(state.fastest, stage.fastest),
            impacts=state.impacts + stage.impacts,
            status=Status.where(toss_up, Status.undecided, state.status),
        )

    def evaluate(self, node: State, elapsed: Scalar) -> tuple[Scalar, Scalar]:
        """Expand the series again about the node."""
        forcing, unit = self.forcing(node)
        coefficients = self.expand(node, self.angle(node), forcing, unit)
        opening, speed = coefficients[-1], jnp.zeros_like(unit)
        for c in reversed(coefficients[:-1]):
            speed = speed * (elapsed / unit) + opening
            opening = opening * (elapsed / unit) + c
        return opening, speed / unit

    def angle(self, state: State) -> Angle:
        """The opening angle of a state with its sine and cosine."""
        angle = Angle.of(state.opening)
        return Angle(angle.value, keep(angle.sine, state.local), keep(angle.cosine, state.local))

    def expand(self, state: State, angle: Angle, forcing, unit) -> list[Scalar]:
        """Taylor coefficients of the opening angle about a state, in time/unit."""
        stretch = keep(self.scene.p * unit, state.local)
        speed = state.velocity * stretch
        return opening_series(self.scene.table, stretch, state.side, angle, speed, state.uplifting, forcing, self.order)

    def _rock(self, state: State, forcing, unit, rocking: Flag) -> State:
        """Rocking: a Taylor step, cut at the first event."""
        scene = self.scene
        saddle = scene.table.saddle
        room = self.room(state) / unit
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

        escaped = self.escaped(state, angle)
        piece, local, over = self.move_on(state, length * unit, full)
        moved = (length > 0) & rocking

        rounded, missed = self.tolerance * size, last_size(coefficients) * length**self.order
        time = jnp.where(length > 0, length * stretch, jnp.inf)
        step = rounded + missed, rounded + missed * jnp.maximum(self.order / time, 1.0)

        def spread_at(elapsed):
            return self.spread_after(state, angle, state.side * forcing[0], elapsed, step)

        passed = replace(
            state,
            spread=spread_at(length * unit),
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
            return self._land(state, passed, scaled, series, signs, faster, spread_at, length, unit, needed)

        stepped = when(eventful & moved, land, passed)
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

    def _land(self, state, passed, scaled, forcing, signs, faster, spread_at, length, unit, needed) -> State:
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
            spread=spread_at(elapsed),
            piece=jnp.where(early, state.piece, passed.piece),
            local=jnp.where(early, state.local + elapsed, passed.local),
            opening=jnp.where(ground, jnp.pi / 2, jnp.where(crossing, saddle, opening)),
            velocity=jnp.where(turning, 0.0, speed),
            beyond=state.beyond ^ crossing,
            extremal=extremum,
            fastest=jnp.maximum(state.fastest, jnp.abs(speed)),
            done=passed.done & ~early,
        )
        landed = self.note(landed, signs[0] > 0, turning, crossing, opening, speed, bend)
        reach = (1 - landing.x) * length * unit
        steepest = sum(k * jnp.abs(c) for k, c in enumerate(forcing)) / jnp.where(length > 0, length * unit, 1.0)
        return self.impact(landed, impact, speed, jet(forcing, landing.x, 0)[0], steepest, reach)

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
        inward = state.velocity < 0  # it may graze the ground
        return inward | state.beyond | (top >= state.peak) | (least < state.closeness)


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
