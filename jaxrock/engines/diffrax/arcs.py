"""The diffrax engine: one `diffrax.diffeqsolve` for each smooth arc of a rocking block.

An arc ends with an impact, turning point, velocity extremum, saddle crossing, certain loss, an angle at which the
moments bend, or a knot. All events are roots of the smallest of a few guards that start positive.

A guard may start at zero, as the opening angle after an impact and the velocity after a turning point do. Division by
the power of time with which it leaves zero finds a hop of any size. Velocity and acceleration are guarded, too: a dip
through the ground inside one step cannot hide, because it needs a turning point. A step across a knot or a bend would
keep values within the tolerance, but not slopes.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Any

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PyTree

from jaxrock._arguments.annotations import arguments, at_least, known
from jaxrock._arguments.ranges import inner_share
from jaxrock._core.types import Flag, Scalar
from jaxrock.compiler import lane_function
from jaxrock.engines.bookkeeping import checked_step, errors_after, escaped, record_extrema
from jaxrock.engines.diffrax.cond_select import cond_select
from jaxrock.engines.diffrax.guards import (
    DIFFRAX_POLICY,
    ArcProblem,
    Forcing,
    Illinois,
    Pair,
    StepControl,
    field,
    field_of_trials,
    first_guard,
    first_solver_state,
    first_step,
    is_hop,
    usual_step,
)
from jaxrock.engines.diffrax.static_with_arrays import StaticWithArrays
from jaxrock.engines.events import WATCHED, Events, landed
from jaxrock.engines.impact import impact
from jaxrock.engines.memory import remembered
from jaxrock.engines.rest import wait
from jaxrock.engines.scene import Scene
from jaxrock.engines.settling import settled
from jaxrock.engines.state import Node, State
from jaxrock.engines.stepper import AbstractEngine, AbstractStepper
from jaxrock.models.equation import Angle
from jaxrock.numerics.derivatives_of import with_derivatives_of
from jaxrock.numerics.roots import carried
from jaxrock.status import Status

_ADJOINTS: dict[type, Any] = {
    diffrax.RecursiveCheckpointAdjoint: "checkpointed",
    diffrax.ForwardMode: "lax",
    diffrax.DirectAdjoint: "bounded",
}


class Diffrax(AbstractEngine):
    """Settings of the diffrax engine.

    **Arguments:**

    - `solver`: any diffrax solver of ordinary differential equations.
    - `rtol`: tolerance of a step relative to the state, in (0, 1). The tightest is about 1e-12 in double precision
      and 2e-6 in single, which replaces smaller values.
    - `atol`: absolute tolerance over alpha; None takes 1e-8 rtol, so that small hops keep their digits. For solvers of
      low order, whose steps that makes very short, give some 1e-2 rtol.
    - `controller`: a step-size controller instead of the PID controller with these tolerances; `rtol` then is
      only what it is trusted to keep.
    - `adjoint`: `diffrax.ForwardMode()` (the default: all modes, reverse by way of a small Jacobian),
      `diffrax.RecursiveCheckpointAdjoint()` for reverse mode by many numbers, or `diffrax.DirectAdjoint()` (slower).
    - `max_solves`: budget of solves, each of one arc or a part of it; None takes 4,096 and four per piece of
      the motion.

    **Raises:** ValueError for a value outside its range, or an adjoint that events do not go with.
    """

    _solver: StaticWithArrays
    _controller: StaticWithArrays
    _adjoint: StaticWithArrays
    rtol: float = eqx.field(static=True)
    atol: float | None = eqx.field(static=True)
    max_solves: int | None = eqx.field(static=True)

    @arguments
    def __init__(
        self,
        solver: diffrax.AbstractSolver = diffrax.Tsit5(),
        rtol: Annotated[float, known(inner_share)] = 1e-8,
        atol: Annotated[float | None, known(inner_share)] = None,
        controller: diffrax.AbstractStepSizeController | None = None,
        adjoint: diffrax.AbstractAdjoint = diffrax.ForwardMode(),
        max_solves: Annotated[int | None, at_least(1, 10**9)] = None,
    ):
        self._solver, self._controller, self._adjoint = (
            StaticWithArrays.of(solver),
            StaticWithArrays.of(controller),
            StaticWithArrays.of(adjoint),
        )
        self.rtol, self.atol, self.max_solves = rtol, atol, max_solves

    def __repr__(self) -> str:
        names = ("solver", "rtol", "atol", "controller", "adjoint", "max_solves")
        return f"Diffrax({', '.join(f'{name}={getattr(self, name)!r}' for name in names)})"

    @property
    def solver(self) -> diffrax.AbstractSolver:
        """The solver."""
        return self._solver.value

    @property
    def controller(self) -> diffrax.AbstractStepSizeController | None:
        """The step-size controller, if given."""
        return self._controller.value

    @property
    def adjoint(self) -> diffrax.AbstractAdjoint:
        """The adjoint."""
        return self._adjoint.value

    def __check_init__(self):
        if type(self.adjoint) not in _ADJOINTS:
            names = ", ".join(kind.__name__ for kind in _ADJOINTS)
            raise ValueError(f"Argument `adjoint` must be one of {names}, but is {type(self.adjoint).__name__}.")

    @property
    def reverse(self) -> bool:
        """Return whether reverse mode differentiates this engine's own loops: with every adjoint but `ForwardMode`."""
        return not isinstance(self.adjoint, diffrax.ForwardMode)

    forward = property(lambda x: Diffrax(x.solver, x.rtol, x.atol, x.controller, max_solves=x.max_solves))

    @property
    def in_lanes(self) -> bool:
        """Return whether machine code runs the solve of an arc: unless reverse mode differentiates it."""
        return not self.reverse

    def stepper(self, scene: Scene, stop: Scalar | None, history: bool, taped: bool = False) -> "ArcStepper":
        """Return the stepper of a scene."""
        if taped:
            raise ValueError(
                "Derivatives by so many numbers need reverse mode: use Series(), or "
                "Diffrax(adjoint=diffrax.RecursiveCheckpointAdjoint())."
            )
        return ArcStepper(scene=scene, stop=stop, history=history, engine=self)

    def budget(self, scene: Scene, history: bool) -> int:
        """Return the largest number of solves."""
        usual = DIFFRAX_POLICY.solves + 4 * scene.most_pieces
        # Between impacts there are about four arcs, plus two passes of each bend; a history stores every arc, so its
        # bound is lower.
        return self.max_solves or usual + scene.moments.bends * (64 if history else usual // 2)

    def loop(self, unfinished: Callable, step: Callable, carry: PyTree, budget: int) -> PyTree:
        """Run a loop that the adjoint supports."""
        return eqxi.while_loop(unfinished, step, carry, max_steps=budget, kind=_ADJOINTS[type(self.adjoint)])

    def within(self, dtype) -> tuple[float, float]:
        """Return the relative tolerance, and the least absolute one over alpha, that this precision allows. In single
        precision the rounding of a step exceeds the usual ones."""
        eps = float(jnp.finfo(dtype).eps)
        return (max(self.rtol, 16 * eps), 8 * eps) if eps > 1e-10 else (self.rtol, 0.0)

    def limits(self, scene: Scene, piece: Int[Array, ""]) -> tuple[Scalar, Scalar]:
        """Return the absolute tolerance [rad], and the longest step (p t) in a piece of the motion; without
        derivatives."""
        rtol, least = self.within(scene.p.dtype)
        atol = max(self.atol or 1e-8 * rtol, least) * scene.alpha
        # A fraction of the time in which the forcing changes: a step sees at most one turn of it.
        return jax.lax.stop_gradient((atol, jnp.minimum(DIFFRAX_POLICY.longest, scene.p * scene.scale(piece))))

    def solve(self, arc: ArcProblem, limits: tuple[Scalar, Scalar], length: Scalar, event: diffrax.Event | None) -> Any:
        """Solve the arc, for `length` (p t) at most."""
        length = jnp.where(arc.side != 0, length, 0.0)
        # The first step is not cut to the length: `minimum` of two equal times halves both derivatives. Diffrax cuts
        # it, and the step ends with the arc.
        rtol, _ = self.within(arc.opening.dtype)
        first = first_step(arc, rtol)
        first = jax.lax.stop_gradient(jnp.where(first > 0, first, 1.0))
        controller = self.controller or StepControl(rtol, limits[0], dtmax=limits[1], first=first)
        implicit = isinstance(self.solver, diffrax.AbstractImplicitSolver)
        term, zero = diffrax.ODETerm(field_of_trials if implicit else field), jnp.zeros_like(length)
        y0 = jnp.stack([arc.opening, arc.velocity])
        return diffrax.diffeqsolve(
            term,
            self.solver,
            t0=zero,
            t1=length,
            dt0=None if isinstance(controller, StepControl) else first,
            y0=y0,
            args=arc,
            solver_state=first_solver_state(self.solver, term, zero, y0, arc),
            stepsize_controller=controller,
            event=event,
            adjoint=self.adjoint,
            max_steps=DIFFRAX_POLICY.solve_steps,
            throw=False,
        )

    def locate(
        self, arc: ArcProblem, limits: tuple[Scalar, Scalar], length: Scalar, event: diffrax.Event
    ) -> tuple[Any, Scalar, Pair]:
        """Return the solution up to its event; its end (p t), and opening angle and velocity there, with their
        derivatives.

        The event is located without derivatives; derivatives of the arc are taken at that time, and the implicit
        function moves the time. (Optimistix does that for diffrax, but checks its quotient by a host callback, which
        programs that JAX caches cannot contain.)
        """
        held = jax.tree.map(lambda x: jax.lax.stop_gradient(x) if eqx.is_inexact_array(x) else x, (arc, length))
        solution = self.solve(held[0], limits, held[1], event)
        end = jax.lax.stop_gradient(solution.ts[-1])
        there = self.solve(arc, limits, end, None).ys[-1]
        y = with_derivatives_of(jax.lax.stop_gradient(solution.ys[-1]), there)
        flow, bent = jax.jvp(arc.flow, (end, y), (jnp.ones_like(end), arc.flow(end, y)))
        first = jnp.argmin(jax.lax.stop_gradient(arc.guards(end, y)))

        def at(time):
            return y + (time - end) * flow + (time - end) ** 2 / 2 * bent

        def guard(time):
            return arc.guards(time, at(time))[first]

        def left(time):
            value, slope = jax.jvp(guard, (time,), (jnp.ones_like(time),))
            clear = jnp.abs(value) < jnp.abs(slope) / jnp.finfo(slope.dtype).eps  # no arc of zero length
            return jnp.where(clear, value / jnp.where(clear, slope, 1.0), 0.0)

        # The primal values are those found without derivatives.
        free = length + (end - jax.lax.stop_gradient(length))
        time = with_derivatives_of(end, jnp.where(solution.event_mask, carried(end, left), free))
        return solution, time, with_derivatives_of(y, at(time))


class ArcStepper(AbstractStepper):
    """One scene with the engine's settings, and the time up to which to follow it."""

    scene: Scene
    stop: Scalar | None
    history: bool = eqx.field(static=True)
    engine: Diffrax
    doubt: float = eqx.field(static=True, default=1.0)  # the error estimate is generous

    def advance(self, state: State) -> State:
        """Advance a lane by one arc, or by a wait at rest."""
        scene = self.scene
        forcing = Forcing.of(scene, state)
        eps = float(jnp.finfo(scene.p.dtype).eps)
        resting = state.side == 0
        waited = wait(self, state, forcing.shaking, forcing.unit, DIFFRAX_POLICY.order, eps, cond_select)
        rocked = self.at(state)._rock(state, forcing, ~resting)
        after = checked_step(self, state, jax.tree.map(lambda a, b: jnp.where(resting, a, b), waited, rocked))
        if self.history:
            return after
        goes = (after.status == Status.successful) | (after.status == Status.undecided) & self.has_copies
        return settled(self, state, replace(after, done=after.done | ~goes))

    def finish(self, state: State) -> State:
        """Follow the free stage by the same arcs."""
        return self.after_history(state) if self.history else state

    @property
    def follows_free_stage(self) -> bool:
        return not self.history

    def evaluate(self, node: Node, elapsed: Scalar) -> tuple[Scalar, Scalar]:
        """Solve again from the node."""
        scene = self.at(node).scene
        arc = ArcProblem.of(scene, node, Forcing.of(scene, node), self.history)

        def run(scene):
            engine, *arc = scene
            return engine.solve(*arc, event=None).ys[-1]

        run = run if self.engine.reverse else lane_function(run)
        time = self.scene.p * elapsed
        y = run((self.engine, arc, self.engine.limits(self.scene, node.piece), time))
        # A solve of zero length has no derivative with respect to its length.
        shift = jnp.where(time == 0, time - jax.lax.stop_gradient(time), 0.0)
        flow, bent = jax.jvp(arc.flow, (time, y), (jnp.ones_like(time), arc.flow(time, y)))
        opening, velocity = y + shift * flow + shift**2 / 2 * bent
        return opening, velocity * self.scene.p

    def _rock(self, state: State, forcing: Forcing, rocking: Flag) -> State:
        """Follow an arc up to its event, the knot, or the stop."""
        scene, engine = self.scene, self.engine
        lost = escaped(self, state, Angle.of(state.opening)) & (not self.history)
        room = jnp.where(rocking & ~lost, self.room(state), 0.0)
        rtol, _ = engine.within(scene.p.dtype)
        share = DIFFRAX_POLICY.share * jnp.minimum(usual_step(rtol) / scene.p, scene.scale(state.piece))
        whole = room <= share
        length = scene.p * jnp.where(whole, room, jax.lax.stop_gradient(share))
        arc = ArcProblem.of(scene, state, forcing, self.history)
        arc = replace(arc, hop=is_hop(self, state, arc))
        eps = float(jnp.finfo(scene.p.dtype).eps)
        event = diffrax.Event(first_guard, Illinois(rtol=4 * eps, atol=0.0), direction=False)
        solution, time, y = engine.locate(arc, engine.limits(scene, state.piece), length, event)
        void = rocking & arc.is_void(time, y, solution.event_mask)
        time = jnp.where(void, jnp.maximum(time, jnp.minimum(arc.horizon, length)), time)
        y = jnp.where(void, 0.0, y)
        happened = rocking & solution.event_mask & (time > 0) | void
        guards = arc.guards(time, y)
        fired = happened & (jnp.arange(guards.size) == jnp.argmin(guards))
        hits = Events(*fired[: len(WATCHED)])
        ground = hits.impact | (happened & (y[0] <= 0) & ~void)
        # At the saddle a free block passes most slowly: two events coincide.
        crossing = hits.saddle | (happened & (arc.gap(y[0]) == 0) & (arc.gap(state.opening) != 0))
        hits = hits._replace(impact=ground & ~void, turning=hits.turning & ~ground, saddle=crossing & ~ground)

        elapsed = time / scene.p
        full = ~happened & whole
        piece, local, over = self.move_on(state, jnp.where(full, room, elapsed), full)
        steps = jnp.maximum(solution.stats["num_accepted_steps"], 1)
        off = 2.5 * rtol * steps * jnp.maximum(jnp.abs(y), jnp.stack([state.opening, jnp.abs(state.velocity)]))
        spread = errors_after(self, state, Angle.of(state.opening), forcing.shaking.now, elapsed, (off[0], off[1]))
        moved = time > 0
        opening, velocity = landed(scene, hits, y[0], y[1])
        if arc.bend is not None:
            opening = jnp.where(fired[-1], arc.bend, opening)
        after = replace(
            state,
            piece=piece,
            local=local,
            opening=opening,
            velocity=velocity,
            uplifting=state.uplifting & ~moved,
            beyond=state.beyond ^ hits.saddle,
            fastest=jnp.maximum(state.fastest, jnp.abs(y[1])),
            spread=spread,
            done=over & self.history,  # an outcome continues through the free stage
        )
        if scene.moments.remembers:
            after, lets_go = remembered(self, state, after)
            hits = hits._replace(saddle=hits.saddle | lets_go)
        after = replace(after, side=jnp.where(void, 0.0, after.side))
        return self._happen(state, after, arc, hits, y, lost, solution.result)

    def _happen(self, before: State, after: State, arc: ArcProblem, hits: Events, y: Pair, lost: Flag, result) -> State:
        """Apply the event of an arc: peaks, margin, impact, verdict."""
        scene = self.scene
        outward = (before.velocity > 0) | ((before.velocity == 0) & (arc.start_acceleration >= 0))
        acceleration = arc.acceleration((after.local - before.local) * scene.p, y)
        after = record_extrema(self, after, outward, hits.turning, hits.saddle, y[0], y[1], acceleration)
        quiet = before.piece >= scene.pieces
        forcing = Forcing.of(scene, after)
        reach = jnp.minimum(self.room(after), forcing.reach)
        after = impact(self, after, hits.impact, y[1], forcing.shaking.now, forcing.steepest, reach)
        down = after.opening >= jnp.pi / 2
        gone = before.overturned | lost | escaped(self, after, Angle.of(after.opening))
        overturned = gone | down if scene.falls_flat else gone
        exhausted = result == diffrax.RESULTS.max_steps_reached
        failed = ~exhausted & ~diffrax.is_okay(result)
        balanced = quiet & (before.velocity == 0) & (jnp.abs(arc.start_acceleration) <= arc.noise) & (before.side != 0)
        # A block that falls flat at nearly zero speed may have turned back just before.
        barely = scene.falls_flat & down & ~gone
        barely = barely & (y[1] ** 2 <= 2 * self.doubt * jnp.abs(acceleration) * after.spread.angle)
        status = Status.where(balanced | barely, Status.undecided, after.status)
        status = Status.where(exhausted, Status.step_budget_exhausted, status)
        status = Status.where(failed, Status.solver_failed, status)
        ends = overturned & down if self.history else overturned
        return replace(after, overturned=overturned, status=status, done=after.done | ends | exhausted | failed)
