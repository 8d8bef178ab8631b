"""The diffrax engine: one `diffrax.diffeqsolve` for each smooth arc of a rocking block.

An arc runs from one event to the next: impact, turning point, velocity extremum, saddle crossing, certain loss,
a knot of the motion. All are roots of one function, the smallest of a few guards that are positive at first.
A guard that starts at zero (the opening angle after an impact, the velocity after a turning point) is divided by
the power of time with which it leaves zero, so that a hop of any size is seen and its start is not an event. The
signs of velocity and acceleration are guards too, so that a dip through the ground inside one step cannot hide: it
needs a turning point. Knots end arcs, so that the right-hand side of every solve is smooth.
"""

from dataclasses import replace
from typing import Any

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, ArrayLike, Bool, Inexact, Int

from jaxrock.engine import AbstractEngine, AbstractStepper, either
from jaxrock.models import Angle
from jaxrock.scene import Scene
from jaxrock.state import State
from jaxrock.status import Status

Scalar = Inexact[ArrayLike, ""]
Flag = Bool[ArrayLike, ""]
Pair = Inexact[Array, "2"]  # opening angle, velocity per p t

_ORDER = 12  # of the motion's series, for waiting and for coming to rest
_LONGEST = 0.5  # step of the default controller, in 1/p
_SHARE = 4  # usual steps in one solve: a longer arc goes on in the next, so that the lanes of a batch keep pace
_MOST_STEPS = 4096  # of one solve

_ADJOINTS = {
    diffrax.RecursiveCheckpointAdjoint: "checkpointed",
    diffrax.ForwardMode: "lax",
    diffrax.DirectAdjoint: "bounded",
}


class Diffrax(AbstractEngine):
    """Settings of the diffrax engine.

    **Arguments:**

    - `solver`: any diffrax solver of ordinary differential equations.
    - `rtol`: tolerance of a step relative to the state, in (0, 1); 1e-12 is about the tightest in double precision.
    - `atol`: absolute tolerance over alpha; None takes 1e-8 rtol, so that small hops keep their digits.
    - `controller`: a step-size controller instead of the PID controller with these tolerances; `rtol` then is
      only what it is trusted to keep.
    - `adjoint`: `diffrax.RecursiveCheckpointAdjoint()` (the default: reverse mode), `diffrax.ForwardMode()`, or
      `diffrax.DirectAdjoint()` (both, slower).
    - `max_solves`: budget of solves, each of one arc or a part of it; None takes 4,096 and four per piece of
      the motion.

    **Raises:** ValueError for a value outside its range, or an adjoint that events do not go with.
    """

    solver: diffrax.AbstractSolver = eqx.field(static=True, default=diffrax.Tsit5())
    rtol: float = eqx.field(static=True, default=1e-8)
    atol: float | None = eqx.field(static=True, default=None)
    controller: diffrax.AbstractStepSizeController | None = eqx.field(static=True, default=None)
    adjoint: diffrax.AbstractAdjoint = eqx.field(static=True, default=diffrax.RecursiveCheckpointAdjoint())
    max_solves: int | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        if not 0 < self.rtol < 1:
            raise ValueError(f"Argument `rtol` must be in (0, 1), but is {self.rtol}.")
        if self.atol is not None and not 0 < self.atol < 1:
            raise ValueError(f"Argument `atol` must be in (0, 1), but is {self.atol}.")
        if self.max_solves is not None and self.max_solves < 1:
            raise ValueError(f"Argument `max_solves` must be at least 1, but is {self.max_solves}.")
        if type(self.adjoint) not in _ADJOINTS:
            names = ", ".join(kind.__name__ for kind in _ADJOINTS)
            raise ValueError(f"Argument `adjoint` must be one of {names}, but is {type(self.adjoint).__name__}.")

    def stepper(self, scene: Scene, stop: Scalar, history: bool) -> "ArcStepper":
        """This engine at work on a scene."""
        return ArcStepper(scene=scene, stop=stop, history=history, engine=self)

    def budget(self, scene: Scene, history: bool) -> int:
        """Largest number of solves."""
        return self.max_solves or 4096 + 4 * scene.pieces

    def loop(self, unfinished, step, carry, budget: int):
        """A loop that goes with the adjoint."""
        return eqxi.while_loop(unfinished, step, carry, max_steps=budget, kind=_ADJOINTS[type(self.adjoint)])

    def controller_for(self, scene: Scene, piece: Int[ArrayLike, ""]) -> diffrax.AbstractStepSizeController:
        """The step-size controller within a piece of the motion."""
        if self.controller is not None:
            return self.controller
        atol = (self.atol or 1e-8 * self.rtol) * scene.alpha
        # A fraction of the time in which the forcing changes: a step sees at most one turn of it.
        longest = jax.lax.stop_gradient(jnp.minimum(_LONGEST, scene.p * scene.scales[piece]))
        return diffrax.PIDController(rtol=self.rtol, atol=jax.lax.stop_gradient(atol), dtmax=longest)


class _Bracket(eqx.Module):
    lower: Scalar
    upper: Scalar
    at_lower: Scalar
    at_upper: Scalar
    count: Int[Array, ""]


class Illinois(optx.AbstractRootFinder):
    """Root of a function that is positive at `lower` and not at `upper`: false position with Illinois's weights,
    and bisection whenever that has not at least quartered the bracket in three steps."""

    rtol: float
    atol: float
    norm: Any = eqx.field(static=True, default=jnp.abs)

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        """The bracket of the last step."""
        lower, upper = (jnp.asarray(options[name], f_struct.dtype) for name in ("lower", "upper"))
        return _Bracket(lower, upper, fn(lower, args)[0], fn(upper, args)[0], jnp.array(0))

    def step(self, fn, y, args, options, state, tags):
        """One evaluation."""
        bisect = state.count % 3 == 2
        share = state.at_lower / (state.at_lower - state.at_upper)
        share = jnp.where(bisect | ~(share > 0) | ~(share < 1), 0.5, share)
        x = state.lower + share * (state.upper - state.lower)
        value, aux = fn(x, args)
        above = value > 0
        # The end that stays is weighted down, so that it moves next time.
        state = _Bracket(
            lower=jnp.where(above, x, state.lower),
            upper=jnp.where(above, state.upper, x),
            at_lower=jnp.where(above, value, jnp.where(bisect, 1.0, 0.5) * state.at_lower),
            at_upper=jnp.where(above, jnp.where(bisect, 1.0, 0.5) * state.at_upper, value),
            count=state.count + 1,
        )
        return x, state, aux

    def terminate(self, fn, y, args, options, state, tags):
        """Whether the bracket is as small as rounding allows, or the root is met."""
        small = state.upper - state.lower <= self.atol + self.rtol * jnp.abs(state.upper)
        # A quantity that is only noise may have no root but the start.
        return small | (state.at_upper == 0) | (state.at_lower <= 0) | (state.count >= 200), optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """The last point."""
        return y, aux, {}


class _Arc(eqx.Module):
    """The smooth problem of one arc, and its guards; time is p t since its start."""

    scene: Scene
    start: State
    bend: Scalar  # acceleration at the start
    jerk: Scalar  # its derivative
    noise: Scalar  # what rounding may make of an acceleration that is zero
    hop: Flag  # too small for its turning point to matter, and certain to come back
    history: bool = eqx.field(static=True)

    @classmethod
    def of(cls, scene: Scene, start: State, history: bool) -> "_Arc":
        zero, no = jnp.zeros_like(start.opening), jnp.zeros_like(start.opening, bool)
        arc = cls(scene, start, zero, zero, zero, no, history)
        y = jnp.stack([start.opening, start.velocity])
        bend, jerk = jax.jvp(arc.acceleration, (zero, y), (zero + 1, arc.flow(zero, y)))
        # What is zero by continuity, or but for rounding, is zero: its sign would mean nothing.
        pull = scene.table.restoring_at_rest + jnp.abs(arc.push(zero)) * scene.table.arm_at_rest
        noise = 64 * jnp.finfo(bend.dtype).eps * (pull + jnp.abs(jerk) * scene.p * start.local)
        noise = jax.lax.stop_gradient(noise)
        leaving = (start.opening == 0) & (start.velocity == 0)
        bend = jnp.where(start.uplifting | (leaving & (jnp.abs(bend) <= noise)), 0.0, bend)
        return cls(scene, start, bend, jerk, noise, no, history)

    def push(self, time: Scalar) -> Scalar:
        """Side times ground acceleration [g]."""
        scene, start = self.scene, self.start
        inner = jnp.minimum(start.piece, scene.pieces - 1)
        value = scene.motion.series(inner, start.local + time / scene.p, 1 / scene.p, 0)[0]
        return start.side * jnp.where(start.piece < scene.pieces, value, 0.0)

    def acceleration(self, time: Scalar, y: Pair) -> Scalar:
        """Acceleration of the opening angle per (p t)^2."""
        return self.scene.table.acceleration(Angle.of(y[0]), y[1], self.push(time))

    def gap(self, opening: Scalar) -> Scalar:
        """Opening angle beyond the saddle; zero where that is only rounding."""
        gap = opening - self.scene.table.saddle
        return jnp.where(jnp.abs(gap) <= 64 * jnp.finfo(gap.dtype).eps * self.scene.table.saddle, 0.0, gap)

    @property
    def horizon(self) -> Scalar:
        """Time (p t) for which the acceleration of a block that leaves rest is only noise."""
        return self.noise / jnp.maximum(self.jerk, self.noise)

    def is_void(self, time: Scalar, y: Pair, event: Flag) -> Flag:
        """Whether the block leaves rest by no more than rounding: the threshold is touched, not passed."""
        leaving = (self.start.opening == 0) & (self.start.velocity == 0) & (self.bend == 0)
        return leaving & ((self.jerk <= 0) | (event & (jnp.abs(y[1]) <= self.noise * time)))

    def flow(self, time: Scalar, y: Pair) -> Pair:
        """The right-hand side."""
        return jnp.stack([y[1], self.acceleration(time, y)])

    def guards(self, time: Scalar, y: Pair) -> Inexact[Array, "guards"]:
        """Ground, turning point, velocity extremum, saddle, certain loss, fallen flat: the first to reach zero ends
        the arc. All start above zero."""
        start, table = self.start, self.scene.table
        ground = _guard(time, y[0], [start.opening, start.velocity, self.bend / 2, self.jerk / 6], True)
        turn = _guard(time, y[1], [start.velocity, self.bend, self.jerk / 2], ~self.hop)
        # The acceleration has to be past zero by more than rounding, so that no extremum is met twice.
        rises = jnp.where(self.bend == 0, self.jerk >= 0, self.bend > 0)
        along = jnp.where(rises, 1.0, -1.0) * self.acceleration(time, y) + self.noise
        extremum = jnp.where(self.hop, 1.0, along / (1e14 * self.noise))
        saddle = _guard(time, y[0] - table.saddle, [self.gap(start.opening), start.velocity], True)
        ceiling = self.scene.ceilings[start.piece]

        def hold(x):
            angle = Angle.of(x)
            return table.restoring(angle) + ceiling * table.arm(angle)

        held = hold(start.opening)
        escape = _guard(time, hold(y[0]), [held], (ceiling > 0) & (held > 0))
        flat = jnp.pi / 2 - y[0]
        low = start.opening < jnp.pi / 2
        flat = _guard(time, flat, [jnp.pi / 2 - start.opening], low & (self.history or self.scene.falls_flat))
        return jnp.stack([ground, turn, extremum, saddle, escape, flat])


def _guard(time: Scalar, value: Scalar, jet: list[Scalar], active: Flag) -> Scalar:
    """`value` over its leading term c t^m at the start, `jet` = its Taylor coefficients there; one at time 0."""
    lead, power = jnp.ones_like(time), jnp.ones_like(time)
    found = jnp.zeros_like(time, bool)
    for m, c in enumerate(jet):
        here = ~found & (c != 0)
        lead = jnp.where(here, c, lead)
        power = jnp.where(here, time**m, power)
        found = found | here
    later = found & (time > 0) & active
    return jnp.where(later, value / jnp.where(later, lead * power, 1.0), 1.0)


def _field(t, y, args: _Arc):
    return args.flow(t, y)


def _first_guard(t, y, args: _Arc, **kwargs):
    return jnp.min(args.guards(t, y))


class ArcStepper(AbstractStepper):
    """One scene with the engine's settings, and how far to follow it."""

    scene: Scene
    stop: Scalar
    history: bool = eqx.field(static=True)
    engine: Diffrax
    doubt: float = eqx.field(static=True, default=2.0)  # a tolerance is more than the error that it leaves

    def advance(self, state: State) -> State:
        """One arc of a lane, or a wait at rest."""
        scene = self.scene
        forcing, unit = scene.forcing(state.piece, state.local, _ORDER)
        eps = float(jnp.finfo(scene.p.dtype).eps)
        resting = state.side == 0
        waited = self.wait(state, forcing, unit, _ORDER, eps, either)
        rocked = self._rock(state, _steepest(forcing, unit), unit, ~resting)
        after = self.checked(state, jax.tree.map(lambda a, b: jnp.where(resting, a, b), waited, rocked))
        if self.history:
            return after
        # After the motion a block that has fallen back and turned below its saddle is safe: it only loses energy.
        quiet = (state.piece >= scene.pieces) & (after.side != 0)
        turned = quiet & (state.velocity >= 0) & (after.velocity == 0) & ~after.beyond & (after.opening > 0)
        turned = turned & (after.impact_time > scene.motion.end)
        return replace(after, done=after.done | turned | (after.status != Status.successful))

    def finish(self, state: State) -> State:
        """Follow the free stage by the same arcs."""
        if not self.history:
            return state
        stepper = ArcStepper(self.scene, jnp.full_like(self.stop, jnp.inf), False, self.engine)
        moving = (state.side != 0) & ~state.overturned & (state.piece >= self.scene.pieces)
        state = replace(state, done=~moving | ~state.done, steps=jnp.zeros_like(state.steps))
        budget = self.engine.budget(self.scene, False)
        return self.engine.loop(lambda s: ~s.done & (s.steps < budget), lambda s: stepper.advance(s), state, budget)

    def evaluate(self, node: State, elapsed: Scalar) -> tuple[Scalar, Scalar]:
        """Solve again from the node."""
        solution = self._solve(_Arc.of(self.scene, node, self.history), self.scene.p * elapsed, None)
        opening, velocity = solution.ys[-1]
        return opening, velocity * self.scene.p

    def _solve(self, arc: _Arc, length: Scalar, event: diffrax.Event | None):
        """The arc, for `length` (p t) at most."""
        start, engine = arc.start, self.engine
        length = jnp.where(start.side != 0, length, 0.0)
        first = jnp.minimum(_first_step(arc, engine.rtol), length)
        return diffrax.diffeqsolve(
            diffrax.ODETerm(_field),
            engine.solver,
            t0=jnp.zeros_like(length),
            t1=length,
            dt0=jax.lax.stop_gradient(jnp.where(first > 0, first, 1.0)),
            y0=jnp.stack([start.opening, start.velocity]),
            args=arc,
            stepsize_controller=engine.controller_for(self.scene, start.piece),
            event=event,
            adjoint=engine.adjoint,
            max_steps=_MOST_STEPS,
            throw=False,
        )

    def _is_hop(self, state: State, bend: Scalar, steepest: Scalar, unit: Scalar) -> Flag:
        """Whether the block comes back to the ground at once, without a peak or a speed that matters.

        From the ground at speed v under a deceleration a it flies for 2 v/a. Where the deceleration changes by less
        than a/2 within twice that time, it stays between a/2 and 3 a/2: the hop is not higher than v^2/a and not
        faster than 2 v.
        """
        table, v = self.scene.table, state.velocity
        back = jnp.where(bend < 0, -bend, 1.0)
        flight, height = 4 * v / (back * self.scene.p), v * v / back
        change = steepest * flight * table.arm_at_rest + 2 * height * (1 + table.restoring_at_rest + back)
        certain = (change <= back / 2) & (flight <= jnp.minimum(self.room(state), 0.25 * unit))
        least = (table.restoring(Angle.of(jnp.minimum(height, table.saddle))) / table.restoring_at_rest) ** 2
        small = (height <= state.peak) & (2 * v <= state.fastest) & (least >= state.closeness)
        starts = (state.opening == 0) & (v > 0) & (bend < 0)
        return starts & certain & small & (not self.history)

    def _rock(self, state: State, steepest: Scalar, unit: Scalar, rocking: Flag) -> State:
        """Rocking: an arc up to its event, the knot, or the stop."""
        scene, engine = self.scene, self.engine
        lost = self.escaped(state, Angle.of(state.opening)) & (not self.history)
        room = jnp.where(rocking & ~lost, self.room(state), 0.0)
        share = _SHARE * jnp.minimum(_usual_step(engine.rtol) / scene.p, scene.scales[state.piece])
        whole = room <= share
        length = scene.p * jnp.where(whole, room, jax.lax.stop_gradient(share))
        arc = _Arc.of(scene, state, self.history)
        arc = replace(arc, hop=self._is_hop(state, arc.bend, steepest, unit))
        eps = float(jnp.finfo(scene.p.dtype).eps)
        event = diffrax.Event(_first_guard, Illinois(rtol=4 * eps, atol=0.0), direction=False)
        solution = self._solve(arc, length, event)
        time, y = solution.ts[-1], solution.ys[-1]
        void = rocking & arc.is_void(time, y, solution.event_mask)
        time = jnp.where(void, jnp.maximum(time, jnp.minimum(arc.horizon, length)), time)
        y = jnp.where(void, 0.0, y)
        happened = rocking & solution.event_mask & (time > 0) | void
        guards = arc.guards(time, y)
        fired = happened & (jnp.arange(guards.size) == jnp.argmin(guards))
        ground, turning, _, crossing, _, flat = fired
        ground = ground | (happened & (y[0] <= 0) & ~void)
        # The saddle is where a free block has its slowest passage: two events in one.
        crossing = crossing | (happened & (arc.gap(y[0]) == 0) & (arc.gap(state.opening) != 0))
        turning, crossing = turning & ~ground, crossing & ~ground

        elapsed = time / scene.p
        full = ~happened & whole
        piece, local, over = self.move_on(state, jnp.where(full, room, elapsed), full)
        steps = jnp.maximum(solution.stats["num_accepted_steps"], 1)
        off = engine.rtol * steps * jnp.maximum(jnp.abs(y), jnp.stack([state.opening, jnp.abs(state.velocity)]))
        spread = self.spread_after(state, Angle.of(state.opening), arc.push(0.0), elapsed, (off[0], off[1]))
        moved = time > 0
        after = replace(
            state,
            piece=piece,
            local=local,
            opening=jnp.where(flat, jnp.pi / 2, jnp.where(crossing, scene.table.saddle, y[0])),
            velocity=jnp.where(turning, 0.0, y[1]),
            uplifting=state.uplifting & ~moved,
            beyond=state.beyond ^ crossing,
            fastest=jnp.maximum(state.fastest, jnp.abs(y[1])),
            spread=spread,
            done=over & self.history,  # an outcome goes on through the free stage
        )
        after = replace(after, side=jnp.where(void, 0.0, after.side))
        return self._happen(state, after, arc, (ground & ~void, turning, crossing), y, lost, solution.result)

    def _happen(self, before: State, after: State, arc: _Arc, events, y: Pair, lost: Flag, result) -> State:
        """Let the event of an arc happen: peaks, margin, impact, verdict."""
        ground, turning, crossing = events
        scene = self.scene
        outward = (before.velocity > 0) | ((before.velocity == 0) & (arc.bend >= 0))
        bend = arc.acceleration((after.local - before.local) * scene.p, y)
        after = self.note(after, outward, turning, crossing, y[0], y[1], bend)
        quiet = before.piece >= scene.pieces
        forcing, unit = scene.forcing(after.piece, after.local, _ORDER)
        reach = jnp.minimum(self.room(after), 0.25 * unit)
        after = self.impact(after, ground, y[1], forcing[0], _steepest(forcing, unit), reach)
        down = after.opening >= jnp.pi / 2
        overturned = before.overturned | lost | self.escaped(after, Angle.of(after.opening))
        overturned = overturned | down if scene.falls_flat else overturned
        if not self.history:
            # The impact after the motion counts if the block is lost after it.
            decisive = (after.impact_time > scene.motion.end) & overturned
            after = replace(after, impacts=jnp.where(quiet, before.impacts + decisive, after.impacts))
        exhausted = result == diffrax.RESULTS.max_steps_reached
        failed = ~exhausted & ~diffrax.is_okay(result)
        balanced = quiet & (before.velocity == 0) & (jnp.abs(arc.bend) <= arc.noise) & (before.side != 0)
        status = Status.where(balanced, Status.undecided, after.status)
        status = Status.where(exhausted, Status.step_budget_exhausted, status)
        status = Status.where(failed, Status.solver_failed, status)
        ends = overturned & down if self.history else overturned
        return replace(after, overturned=overturned, status=status, done=after.done | ends | exhausted | failed)


def _steepest(forcing: list[Scalar], unit: Scalar) -> Scalar:
    """Bound of how fast the forcing changes within a quarter of the unit [g/s]."""
    return sum((k * jnp.abs(c) * 0.25 ** (k - 1) for k, c in enumerate(forcing) if k > 0), start=0.0) / unit


def _usual_step(rtol: float) -> float:
    """Step (p t) that methods of order five take at this tolerance."""
    return min(0.1 * (rtol / 1e-8) ** 0.2, _LONGEST)


def _first_step(arc: _Arc, rtol: float) -> Scalar:
    """A step (p t) that does not jump over a small hop: half the way back to the ground; a certain hop at once."""
    start, bend = arc.start, arc.bend
    x, v = start.opening, start.velocity
    tiny = jnp.finfo(x.dtype).tiny
    back = jnp.maximum(-bend, tiny)
    root = jnp.sqrt(v * v + 2 * back * x)
    to_ground = jnp.where(v > 0, (v + root) / back, 2 * x / jnp.maximum(root - v, tiny))
    # Where the deceleration is only just beginning, it is its growth that turns the block back.
    to_turn = jnp.sqrt(2 * jnp.maximum(v, 0.0) / jnp.maximum(-arc.jerk, tiny))
    usual = jnp.minimum(_usual_step(rtol), jnp.where(to_turn > 0, 4 * to_turn, jnp.inf))
    return jnp.where(to_ground > 0, jnp.minimum(jnp.where(arc.hop, 1.1, 0.5) * to_ground, usual), usual)
