"""The series engine: Taylor steps of a rocking block from event to event, exact to rounding.

A lane (one block under one motion) steps through its own time. Within a smooth piece of the motion the opening angle is
expanded about the present state, and the last coefficients give the step. It ends early at the first event: impact,
turning point, saddle crossing, or a new largest velocity.

A block at rest waits for the threshold. Under `jax.vmap` lanes advance together, each at its own time; a branch that no
lane needs is not taken.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PyTree

from jaxrock._arguments.annotations import at_least, check_fields, known
from jaxrock._arguments.ranges import inner_share
from jaxrock._core.types import Flag, Scalar
from jaxrock.compiler import cond_any, lane_function
from jaxrock.compiler.hints import materialize, opaque_one, select, stop_gradient
from jaxrock.engines.bookkeeping import checked_step, errors_after, escaped, record_extrema
from jaxrock.engines.events import WATCHED, Events, landed, level_of
from jaxrock.engines.free_stage import FreeStage, Visit, free_stage
from jaxrock.engines.impact import impact
from jaxrock.engines.rest import wait
from jaxrock.engines.scene import Scene
from jaxrock.engines.settling import settled
from jaxrock.engines.state import Node, State, surpasses
from jaxrock.engines.stepper import AbstractEngine, AbstractStepper
from jaxrock.engines.taylor.expansion import End, Start, arrive, extreme_speed, taylor_expansion
from jaxrock.engines.taylor.policy import POLICY, exact
from jaxrock.engines.taylor.step_start import clear_start
from jaxrock.engines.taylor.tape import end_on_tape, on_tape
from jaxrock.engines.taylor.whole_step import Cut, Step
from jaxrock.models.equation import Angle
from jaxrock.motions.shaking import Shaking
from jaxrock.numerics.derivatives_of import with_derivatives_of
from jaxrock.numerics.polynomial import (
    Watch,
    derivative,
    first_event,
    horner,
    jet,
    longest,
    remainder,
    rescaled,
)
from jaxrock.status import Status


class Series(AbstractEngine):
    """Settings of the series engine.

    **Arguments:**

    - `order`: order of the Taylor steps, 4 to 64. None takes 9 for motions of many pieces (records), else 20 for linear
      equations and 16 for others. A `tolerance`, or single precision, that leaves room for it lowers these.
    - `tolerance`: local error of a step over the slenderness alpha, in (0, 1); None takes half the rounding unit.
      Larger ones take less time where there are many scenes, and leave more of them undecided.
    - `max_steps`: step budget; None takes 100,000 (`outcome`), or 4,096 and two per piece of the motion (`simulate`,
      which stores every step).

    **Raises:** ValueError for a value outside its range.
    """

    order: Annotated[int | None, at_least(4, 64)] = eqx.field(static=True, default=None)
    tolerance: Annotated[float | None, known(inner_share)] = eqx.field(static=True, default=None)
    max_steps: Annotated[int | None, at_least(1, 10**9)] = eqx.field(static=True, default=None)

    def __check_init__(self):
        check_fields(self)

    def stepper(self, scene: Scene, stop: Scalar | None, history: bool, taped: bool = False) -> "TaylorStepper":
        """Return the stepper of a scene; short pieces of a record need few terms."""
        moments: Any = scene.moments
        if not moments.has_series:
            raise ValueError(
                "Argument `engine` must be a Diffrax(...) for a model that is given as functions, or has ties that "
                "yield or break."
            )
        tolerance = self.tolerance or exact(scene.p.dtype)
        return TaylorStepper(
            scene=scene,
            stop=stop,
            engine=self,
            order=self.order or POLICY.order(scene.pieces_of_part, tolerance, not moments.trigonometric),
            tolerance=tolerance,
            history=history,
            taped=taped,
        )

    def budget(self, scene: Scene, history: bool) -> int:
        """Return the largest number of steps."""
        return self.max_steps or (POLICY.history_steps + 2 * scene.most_pieces if history else POLICY.outcome_steps)

    @property
    def in_lanes(self) -> bool:
        return True

    def loop(self, unfinished: Callable, step: Callable, carry: PyTree, budget: int) -> PyTree:
        """Run a loop that stops with the last lane."""
        return jax.lax.while_loop(unfinished, step, carry)


class TaylorStepper(AbstractStepper):
    """One scene with the engine's settings, and the time up to which to follow it."""

    scene: Scene
    stop: Scalar | None  # time at which to stop [s]; None: at the end of the motion
    engine: Series
    order: int = eqx.field(static=True)
    tolerance: float = eqx.field(static=True)
    history: bool = eqx.field(static=True)
    doubt: float = eqx.field(static=True, default=8.0)  # the errors estimated here are rounding
    taped: bool = eqx.field(static=True, default=False)  # the steps support reverse mode

    def shaking(self, piece: Int[Array, ""], local: Scalar) -> tuple[Shaking, Scalar]:
        """Return Taylor coefficients of the ground acceleration [g] in a piece, in time/unit, and the unit [s]."""
        shaking, unit = self.scene.shaking(piece, local, self.order)
        return shaking.each(lambda terms: [materialize(u, local) for u in terms]), materialize(unit, local)

    @property
    def rounding(self) -> float:
        """Return the error that a step adds, over the slenderness, however small its last terms are."""
        return min(self.tolerance, exact(self.scene.p.dtype))

    @property
    def longest(self) -> float:
        """Return the longest step, in the unit of its series."""
        return min(16.0, longest(self.order, self.scene.p.dtype))

    def advance(self, state: State) -> State:
        """Advance a lane by one step."""
        return self.step(state, *self.shaking(state.piece, state.local))

    def step(self, state: State, shaking: Shaking, unit: Scalar) -> State:
        """Advance a lane by one step: a wait at rest, or rocking."""
        resting = state.side == 0
        waited = wait(self, state, shaking, unit, self.order, self.tolerance, cond_any)
        rocked = self.on(state.side)._rock(state, shaking, unit, ~resting)
        after = checked_step(self, state, jax.tree.map(lambda a, b: select(resting, a, b), waited, rocked))
        return settled(self, state, after)

    @property
    def follows_free_stage(self) -> bool:
        """Return whether the free stage has no closed form, unless for a history."""
        return not self.history and not self.scene.moments.has_free_swing

    def on_tape(self, state: State, budget: int) -> tuple[State, State]:
        """Follow a block so that reverse mode differentiates its steps, and return all states, as `states_of`."""
        return on_tape(self, state, budget)

    def end_on_tape(self, state: State) -> State:
        """Follow a block so that reverse mode goes through, and return the last state, within the budget of an
        outcome."""
        return end_on_tape(self, state)

    def finish(self, state: State) -> State:
        """Solve the free stage: by energy where that is known, else by steps."""
        if not self.scene.moments.has_free_swing:
            return self.after_history(state) if self.history else state
        scene = self.scene.on(state.side)
        moments: Any = scene.moments  # `Coefficients`: no others have a free swing in closed form
        moving = (state.side != 0) & ~state.overturned & (state.piece >= scene.pieces)
        moving = moving & ((state.opening != 0) | (state.velocity != 0))  # not lifted for zero time
        other: Any = scene.both_moments[1]
        here, there = Visit(moments, scene.reset), Visit(other, scene.far_reset)
        visits = (here, there) if scene.far is None else (here, there, here)
        start = visits, state.opening, state.velocity, moving, state.peak
        if self.taped:
            # In reverse mode the branch not taken (roots of zero) would spoil the other.
            name = "free stage, to pi/2" if scene.falls_flat else "free stage"
            stage = lane_function(
                lambda start: free_stage(*start, falls_flat=scene.falls_flat), key=name, in_lanes=True
            )(start)
        else:
            none = FreeStage.none(state.opening)
            stage = jax.lax.cond(moving, lambda: free_stage(*start, falls_flat=scene.falls_flat), lambda: none)
        # A loss after one more impact is a new excursion; otherwise this excursion may have been closer before.
        beyond = select(stage.impacts > 0, stage.closeness, jnp.minimum(state.closeness_beyond, stage.closeness))
        higher = surpasses(stage.peak, state.peak)
        # The energy missing to the saddle, 2 (E_saddle - E), and its error.
        slope = -2 * moments.restoring(Angle.of(state.opening))
        off = state.spread.error_of(slope, -2 * state.velocity)
        toss_up = moving & (jnp.abs(stage.deficit) <= self.doubt * off * stage.share)
        # A block that stands still in balance, within the error of the state, has no decisive excursion.
        toss_up = toss_up | (
            moving & (slope**2 / 4 + state.velocity**2 <= self.doubt**2 * state.spread.variance(1.0, 1.0))
        )
        toss_up = toss_up & (state.status == Status.successful)
        flat = stage.peak_steepness <= 0
        error = select(flat, off, off * stage.peak_share / select(flat, 1.0, stage.peak_steepness))
        # Peaks come from the energy missing to the saddle: small peaks have lost digits.
        lost = select(moving, 4 * self.rounding * moments.saddle, 0.0)
        return replace(
            state,
            overturned=state.overturned | stage.overturned,
            closeness=jnp.minimum(state.closeness, stage.closeness),
            closeness_beyond=beyond,
            peak=select(stage.peak > state.peak, stage.peak, state.peak),
            second=jnp.maximum(state.second, jnp.minimum(state.peak, stage.peak)),
            peak_clearance=select(stage.peak > state.peak, state.clearance, state.peak_clearance),
            peak_time=select(higher, self.time(state) + stage.peak_time / scene.p, state.peak_time),
            error=stop_gradient(select(higher, error, state.error) + lost),
            fastest=jnp.maximum(state.fastest, stage.fastest),
            impacts=state.impacts + stage.impacts,
            large_impacts=state.large_impacts + stage.impacts,
            status=Status.where(toss_up, Status.undecided, state.status),
        )

    def evaluate(self, node: Node, elapsed: Scalar) -> tuple[Scalar, Scalar]:
        """Evaluate the history by a new series about the node."""
        shaking, unit = self.shaking(node.piece, node.local)
        coefficients = taylor_expansion(self.on(node.side).start(node, shaking, unit), self.order).opening
        opening, speed = jet(coefficients, elapsed / unit, 1)
        return opening, speed / unit

    def start(self, state: State | Node, shaking: Shaking, unit: Scalar) -> Start:
        """Return the start of a step, with time in `unit`."""
        stretch = jnp.ones_like(unit) if self.scene.scales is None else materialize(self.scene.p * unit, state.local)
        moments: Any = self.scene.moments
        return Start(
            moments.bare,
            stretch,
            state.side,
            state.uplifting,
            state.opening,
            state.velocity * stretch,
            shaking,
            opaque_one(state.local),
        )

    def _rock(self, state: State, shaking: Shaking, unit: Scalar, rocking: Flag) -> State:
        """Advance by a Taylor step, cut at the first event."""
        # A step cannot use more room than that; the bound keeps it finite.
        start, room = self.start(state, shaking, unit), jnp.minimum(self.room(state), 32 * unit) / unit
        # The step is found without derivatives; then its end moves as the flow and the event determine.
        stepper, before, begin, reach = stop_gradient((self, state, start, room))
        step = Step.of(stepper, before, begin, reach, rocking)
        cut = cond_any(step.eventful, lambda cut, *flags: stepper._cut(before, step, *flags), step.whole)
        hits = cut.hits
        early = cut.length < step.length
        full = step.full & ~early
        end = End(
            length=cut.length,
            opening=cut.opening,
            speed=cut.speed,
            level=level_of(self.scene, hits),
            room=room,
            meets=hits.impact | hits.saddle | hits.flat,
            turns=hits.turning,
            full=full,
        )
        length, opening, speed = arrive(self.order, start, end)
        elapsed, velocity = length * unit, speed / start.stretch
        piece, local, over = self.move_on(state, elapsed, full)
        lost = escaped(self, state, start.angle)
        moved = (step.length > 0) & rocking
        time = select(cut.length > 0, cut.length * start.stretch, jnp.inf)
        rounded = self.rounding * horner([jnp.abs(c) for c in step.coefficients], cut.length)
        missed = remainder(step.coefficients, cut.length)
        missed = rounded + missed, rounded + missed * jnp.maximum(self.order / time, 1.0)
        # A zero-length step keeps the velocity bitwise; its derivatives follow those of coinciding knots.
        kept = select(rocking, with_derivatives_of(state.velocity, velocity), state.velocity)
        exact = landed(self.scene, hits, opening, select(moved, velocity, kept))
        jerk = select(hits.extremum, jet(derivative(step.coefficients), length, 2)[2], jnp.inf)
        fastest = extreme_speed(start, length, opening, speed, jerk) / start.stretch
        passed = replace(
            state,
            spread=errors_after(self, state, start.angle, shaking.now, elapsed, missed),
            piece=piece,
            local=local,
            opening=exact[0],
            velocity=exact[1],
            beyond=state.beyond ^ hits.saddle,
            uplifting=state.uplifting & ~moved,
            extremal=select(moved, hits.extremum, state.extremal),
            fastest=select(moved, jnp.maximum(state.fastest, fastest), state.fastest),
            done=over & (not self.follows_free_stage),
        )

        def happen(passed, needed, inside):
            return self._happen(state, passed, start, step, (length, opening, velocity), cut, inside)

        stepped = cond_any(step.eventful & (hits.impact | hits.turning | hits.saddle), happen, passed)
        down = stepped.opening >= jnp.pi / 2
        overturned = state.overturned | lost | down if self.scene.falls_flat else state.overturned | lost
        # A history continues to the ground; for an outcome the verdict is enough.
        ends = overturned & down if self.history else overturned
        return replace(stepped, overturned=overturned, done=stepped.done | ends)

    def _cut(self, state: State, step: Step, needed: Flag, inside) -> Cut:
        """Find the first event of a step."""
        length, saddle = inside(step.length), self.scene.moments.saddle
        scaled = [inside(c) for c in rescaled(step.coefficients, length)]
        one = jnp.ones_like(length)
        signs = Events(one, *step.signs, select(state.beyond, 1.0, -1.0), -one)
        below = state.opening < jnp.pi / 2 if self.history else None  # an outcome needs no fall down to the ground
        wanted = Events(True, ~step.monotone | self._matters(state, scaled), step.faster, True, below)
        watches = [
            Watch(watched.derivative, sign, watched.level(self.scene), active)
            for watched, sign, active in zip(WATCHED, signs, wanted)
            if active is not None
        ]
        landing = first_event(scaled, watches, clear_start(state, scaled, saddle), needed)
        opening, speed, acceleration = landing.jet[0], landing.jet[1] / length, landing.jet[2] / length**2
        never = [jnp.zeros_like(landing.hits[0])] * (len(Events._fields) - len(watches))
        hits = Events(*landing.hits, *never)
        return Cut(landing.x * length, opening, speed, acceleration, hits._replace(impact=hits.impact & (speed <= 0)))

    def _happen(self, state: State, passed: State, start: Start, step: Step, end, cut: Cut, inside) -> State:
        """Apply the event at the end of a step."""
        length, opening, velocity = (inside(value) for value in end)
        shaking = start.shaking.each(lambda terms: [inside(u) for u in terms])
        ground = shaking.at(length)
        # The value of the series, with the derivatives of the equation.
        law = self.scene.moments.acceleration(Angle.of(opening), velocity, state.side * ground[0], ground[1])
        acceleration = with_derivatives_of(cut.acceleration / start.stretch**2, law)
        hits = cut.hits
        noted = record_extrema(
            self, passed, step.signs[0] > 0, hits.turning, hits.saddle, opening, velocity, acceleration
        )
        unit = start.stretch / self.scene.p
        steepest = jax.tree.map(lambda rate: rate / unit, shaking.steepest(step.length))
        reach = (step.length - length) * unit
        return impact(self, noted, hits.impact, velocity, ground, *stop_gradient((steepest, reach)))

    def _matters(self, state: State, scaled) -> Flag:
        """Return whether the only turning point of this step could be a new peak, or closer to overturning than
        before."""
        always = jnp.ones_like(state.beyond)
        if self.history:
            return always
        # The opening angle stays below c0 + c1 x - fall x^2, whose top is c0 + c1^2/(4 fall).
        moments = self.scene.moments
        fall = -scaled[2] - sum(jnp.maximum(c, 0.0) for c in scaled[3:])
        rise = jnp.maximum(scaled[1], 0.0) ** 2 / (4 * select(fall > 0, fall, 1.0))
        top = select(fall > 0, jnp.minimum(state.opening + rise, moments.saddle), moments.saddle)
        least = (moments.restoring(Angle.of(top)) / moments.restoring_at_rest) ** 2
        inward = state.velocity < 0  # it may graze the ground
        return inward | state.beyond | (top >= 0.999 * state.peak) | (least < state.closeness)  # 0.999: near ties, too
