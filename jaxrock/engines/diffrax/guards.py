"""One smooth arc of a rocking block as a problem for diffrax: its forcing, its right-hand side, its guards."""

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Inexact, Int, PyTree

from jaxrock._core.types import Flag, Scalar
from jaxrock.compiler.hints import select
from jaxrock.engines.events import Events
from jaxrock.engines.scene import Scene
from jaxrock.engines.state import Node, State
from jaxrock.engines.stepper import AbstractStepper
from jaxrock.models.equation import AbstractMoments, Angle
from jaxrock.motions.motion import AbstractMotion
from jaxrock.motions.shaking import Shaking
from jaxrock.status import still_where

Pair = Inexact[Array, "2"]  # opening angle, velocity per p t


class _Policy(NamedTuple):
    """Settings of the diffrax engine that change times, but no result beyond its error.

    - `longest`: longest step of the default controller [1/p].
    - `order`: order of the motion's series, for waits, for coming to rest, and for pieces that are polynomials.
    - `share`: usual steps in one solve; a longer arc continues in the next, so that the lanes of a batch keep pace.
    - `solve_steps`: step budget of one solve.
    - `solves`: budget of solves of a scene, besides four for each piece of the motion.
    """

    longest: float = 0.5
    order: int = 12
    share: int = 4
    solve_steps: int = 4096
    solves: int = 4096


DIFFRAX_POLICY = _Policy()
_NOISE = 64  # error of an acceleration, in units of rounding


class Forcing(eqx.Module):
    """The ground acceleration [g] along an arc.

    A polynomial piece (of a record) is stored as its terms, so that the right-hand side does not look into the record.
    """

    motion: AbstractMotion | None  # None: the terms are exact
    shaking: Shaking  # Taylor coefficients in time/unit
    unit: Scalar  # [s]
    piece: Int[Array, ""]
    local: Scalar
    during: Flag
    p: Scalar

    @classmethod
    def of(cls, scene: Scene, state: State | Node) -> "Forcing":
        """Build the forcing from a state on."""
        shaking, unit = scene.shaking(state.piece, state.local, DIFFRAX_POLICY.order)
        piece = jnp.minimum(state.piece, scene.pieces - 1)
        polynomial = all(terms is None or len(terms) <= DIFFRAX_POLICY.order for terms in shaking)
        motion = None if polynomial else scene.motion
        return cls(motion, shaking, unit, piece, state.local, state.piece < scene.pieces, scene.p)

    def __call__(self, time: Scalar) -> tuple[Scalar, Scalar | None]:
        """Return the acceleration [g] and weight (`Shaking.at`) at p t since the state."""
        if self.motion is None:
            return self.shaking.at(time / (self.p * self.unit))
        here = self.piece, self.local + time / self.p, 1 / self.p, 0
        values = Shaking(self.motion.series(*here), self.motion.vertical_series(*here))
        return values.each(lambda terms: [jnp.where(self.during, u, 0.0) for u in terms]).now

    @property
    def reach(self) -> Scalar:
        """Return the time for which `steepest` holds [s], within the piece."""
        return 0.25 * self.unit

    @property
    def steepest(self) -> tuple[Scalar, Scalar | None]:
        """Return bounds of how fast the acceleration changes within `reach`, horizontal and vertical [g/s]."""
        return jax.tree.map(lambda rate: rate / self.unit, self.shaking.steepest(0.25))


def is_hop(stepper: AbstractStepper, state: State, arc: "ArcProblem") -> Flag:
    """Return whether a block that leaves the ground comes back at once, without a peak or a speed that matters.

    From the ground at speed v under a deceleration a it flies for 2 v/a. Let the deceleration change by less than a/2
    within twice that time: it stays between a/2 and 3 a/2. Then the hop is not higher than v^2/a and not faster than 2
    v.
    """
    moments, v, forcing, acceleration = stepper.scene.moments, state.velocity, arc.forcing, arc.start_acceleration
    back = jnp.where(acceleration < 0, -acceleration, 1.0)
    flight, height = 4 * v / (back * stepper.scene.p), v * v / back
    weight = forcing.shaking.now[1]
    pull = moments.steepest_start * (1.0 if weight is None else weight) + moments.restoring_at_rest + back
    change = moments.change_at_rest(*forcing.steepest) * flight + 2 * height * pull
    certain = (change <= back / 2) & (flight <= jnp.minimum(stepper.room(state), forcing.reach))
    least = (moments.fall(Angle.of(jnp.minimum(height, moments.saddle))) / moments.fall_at_rest) ** 2
    small = (height <= 0.999 * state.peak) & (2 * v <= state.fastest) & (least >= state.closeness)
    starts = (state.opening == 0) & (v > 0) & (acceleration < 0)
    if arc.bend is not None:
        small = small & (height < arc.bend)
    return starts & certain & small & (not stepper.history)


class ArcProblem(eqx.Module):
    """The smooth problem of one arc, and its guards; time is p t since its start."""

    moments: AbstractMoments
    forcing: Forcing
    side: Scalar
    opening: Scalar
    velocity: Scalar
    start_acceleration: Scalar  # at the start
    start_jerk: Scalar  # its derivative
    noise: Scalar  # error by rounding of an acceleration that is zero
    helpful: tuple[Scalar, Scalar | None]  # the forcing and weight still to come that help the block most
    hop: Flag  # certain to come back, with a turning point too small to matter
    flat: Flag  # whether a rotation of pi/2 ends it
    bend: Scalar | None  # next opening angle at which the moments bend; None: they are smooth everywhere

    @classmethod
    def of(cls, scene: Scene, start: State | Node, forcing: Forcing, history: bool) -> "ArcProblem":
        """Build the arc from a state on."""
        zero, no = jnp.zeros_like(start.opening), jnp.zeros_like(start.opening, bool)
        flat = (start.opening < jnp.pi / 2) & (history or scene.falls_flat)
        state = start.side, start.opening, start.velocity
        moments, bend = _smooth(scene.moments, start, forcing)
        arc = cls(moments, forcing, *state, zero, zero, zero, scene.outlook.most_helpful(start.piece), no, flat, bend)
        y = jnp.stack([start.opening, start.velocity])
        acceleration, jerk = jax.jvp(arc.acceleration, (zero, y), (zero + 1, arc.flow(zero, y)))
        # An acceleration that is zero by continuity, or up to rounding, becomes zero: its sign would be random.
        pull = scene.moments.restoring_at_rest + jnp.abs(forcing(zero)[0]) * scene.moments.arm_at_rest
        noise = _NOISE * jnp.finfo(acceleration.dtype).eps * (pull + jnp.abs(jerk) * scene.p * start.local)
        leaving = (start.opening == 0) & (start.velocity == 0)
        acceleration = jnp.where(start.uplifting | (leaving & (jnp.abs(acceleration) <= noise)), 0.0, acceleration)
        noise = jax.lax.stop_gradient(noise)
        return eqx.tree_at(lambda a: (a.start_acceleration, a.start_jerk, a.noise), arc, (acceleration, jerk, noise))

    def acceleration(self, time: Scalar, y: Pair) -> Scalar:
        """Return the acceleration of the opening angle per (p t)^2."""
        acceleration, weight = self.forcing(time)
        return self.moments.acceleration(Angle.of(y[0]), y[1], self.side * acceleration, weight)

    def flow(self, time: Scalar, y: Pair) -> Pair:
        """Return the right-hand side."""
        return jnp.stack([y[1], self.acceleration(time, y)])

    def gap(self, opening: Scalar) -> Scalar:
        """Return the opening angle beyond the saddle; zero within rounding."""
        gap = opening - self.moments.saddle
        return jnp.where(jnp.abs(gap) <= 64 * jnp.finfo(gap.dtype).eps * self.moments.saddle, 0.0, gap)

    @property
    def leaving(self) -> Flag:
        """Return whether the block leaves rest."""
        return (self.opening == 0) & (self.velocity == 0)

    @property
    def horizon(self) -> Scalar:
        """Return the time (p t) for which rounding dominates the acceleration of a block that leaves rest."""
        return self.noise / jnp.maximum(self.start_jerk, self.noise)

    def is_void(self, time: Scalar, y: Pair, event: Flag) -> Flag:
        """Return whether the block leaves rest by no more than rounding: the threshold is touched, not passed."""
        nothing = event & (jnp.abs(y[1]) <= self.noise * time)
        return self.leaving & (self.start_acceleration == 0) & ((self.start_jerk <= 0) | nothing)

    def guards(self, time: Scalar, y: Pair) -> Inexact[Array, "guards"]:
        """Return one guard for every event, in the order of `Events`, then certain loss, then the bend of the moments.
        All start above zero; the first at zero ends the arc."""
        jets = [self.opening, self.velocity, self.start_acceleration, self.start_jerk]  # derivatives at the start
        # The acceleration must pass zero by more than rounding, so that no extremum fires twice.
        rises = jnp.where(self.start_acceleration == 0, self.start_jerk >= 0, self.start_acceleration > 0)
        most = self.noise / (_NOISE * jnp.finfo(self.noise.dtype).eps)
        directed = jnp.where(rises, 1.0, -1.0) * self.acceleration(time, y) + self.noise
        # Just beyond the saddle, rounding decides the sign of the gap, also where a piece of the moments ends near
        # there.
        beyond = True if self.bend is None else (self.gap(self.opening) != 0) | (self.gap(y[0]) != 0)
        guards = Events(
            impact=_guard(time, y[0], [jets[0], jets[1], jets[2] / 2, jets[3] / 6], True),
            turning=_guard(time, y[1], [jets[1], jets[2], jets[3] / 2], ~self.hop),
            extremum=jnp.where(self.hop, 1.0, directed / most),
            saddle=_guard(time, y[0] - self.moments.saddle, [self.gap(self.opening), jets[1]], beyond),
            flat=_guard(time, jnp.pi / 2 - y[0], [jnp.pi / 2 - self.opening], self.flat),
        )
        held = self._hold(self.opening)
        forced = self.helpful[0] > 0
        if self.helpful[1] is not None:
            forced = forced | (self.helpful[1] != 1)
        # An arc that ends here ends a rest within rounding: without the margin the next arcs would end at once, too.
        lost = _guard(time, self._hold(y[0]), [held], forced & (held > self.noise))
        if self.bend is None:
            return jnp.stack([*guards, lost])
        return jnp.stack([*guards, lost, _guard(time, self.bend - y[0], [self.bend - self.opening], True)])

    def _hold(self, opening: Scalar) -> Scalar:
        """Return the deceleration of a block at rest at this angle, under the most helpful forcing."""
        return -self.moments.acceleration(Angle.of(opening), jnp.zeros_like(opening), *self.helpful)


def _smooth(moments: AbstractMoments, start: State | Node, forcing: Forcing) -> tuple[AbstractMoments, Scalar | None]:
    """Return the smooth moments that act on an arc, and the angle at which they bend. A turning point ends an arc, so
    its rotation is monotone."""
    if not moments.bends:
        return moments, None
    acceleration, weight = forcing(jnp.zeros_like(start.opening))
    begins = moments.acceleration(Angle.of(start.opening), start.velocity, start.side * acceleration, weight)
    # From the ground a block can only open, although rounding may decide the sign of an acceleration that is zero.
    opens = (begins >= 0) | (start.opening == 0)
    return moments.ahead(start.opening, select(start.velocity == 0, opens, start.velocity > 0))


def _guard(time: Scalar, value: Scalar, jet: list[Scalar], active: Flag | bool) -> Scalar:
    """Divide `value` by its leading term c t^m at the start, with Taylor coefficients `jet`; one at time 0."""
    lead, power = jnp.ones_like(time), jnp.ones_like(time)
    found = jnp.zeros_like(time, bool)
    for m, c in enumerate(jet):
        here = ~found & (c != 0)
        lead = jnp.where(here, c, lead)
        power = jnp.where(here, time**m, power)
        found = found | here
    later = found & (time > 0) & active
    return jnp.where(later, value / jnp.where(later, lead * power, 1.0), 1.0)


def field(t, y, args: ArcProblem):
    """Return the right-hand side, with the signature that diffrax expects."""
    return args.flow(t, y)


def field_of_trials(t, y, args: ArcProblem):
    """Return the right-hand side for an implicit solver, with zero derivatives where it is not finite.

    A trial of the root finder may leave the domain of a user's equation. The solver rejects that step, but JAX
    differentiates it. Lineax then raises for a linear system that is not finite, in all scenes of a batch.
    """
    found = args.flow(t, y)
    return still_where(~jnp.isfinite(found).all(), found)


def first_guard(t, y, args: ArcProblem, **kwargs):
    """Return the smallest guard, with the signature that diffrax expects."""
    # Diffrax compares it with a zero of the default type, also where the scene is in single precision.
    return jnp.min(args.guards(t, y)).astype(jnp.result_type(float))


def usual_step(rtol: float) -> float:
    """Return the step (p t) that methods of order five take at this tolerance."""
    return min(0.1 * (rtol / 1e-8) ** 0.2, DIFFRAX_POLICY.longest)


class StepControl(diffrax.PIDController):
    """A PID controller with a given first step. Diffrax would check a given first step by a host callback, and programs
    with callbacks can be neither cached nor exported."""

    first: Scalar | None = None

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        """Return the first step's end, and the controller's state."""
        return super().init(terms, t0, t1, y0, self.first, args, func, error_order)


def first_step(arc: ArcProblem, rtol: float) -> Scalar:
    """Return a first step (p t) that does not jump over a small hop.

    It is half the way back to the ground, or slightly more than the whole way for a certain hop.
    """
    x, v, acceleration = arc.opening, arc.velocity, arc.start_acceleration
    tiny = jnp.finfo(x.dtype).tiny
    back = jnp.maximum(-acceleration, tiny)
    root = jnp.sqrt(v * v + 2 * back * x)
    to_ground = jnp.where(v > 0, (v + root) / back, 2 * x / jnp.maximum(root - v, tiny))
    # Where the deceleration only begins to grow, its growth turns the block back.
    to_turn = jnp.sqrt(2 * jnp.maximum(v, 0.0) / jnp.maximum(-arc.start_jerk, tiny))
    usual = jnp.minimum(usual_step(rtol), jnp.where(to_turn > 0, 4 * to_turn, jnp.inf))
    return jnp.where(to_ground > 0, jnp.minimum(jnp.where(arc.hop, 1.1, 0.5) * to_ground, usual), usual)


class _Bracket(eqx.Module):
    lower: Scalar
    upper: Scalar
    at_lower: Scalar
    at_upper: Scalar
    count: Int[Array, ""]


class Illinois(optx.AbstractRootFinder):
    """Root of a function that is positive at `lower` and not at `upper`.

    False position with Illinois's weights, and bisection whenever that has not at least quartered the bracket in three
    steps.
    """

    rtol: float
    atol: float
    norm: Any = eqx.field(static=True, default=jnp.abs)

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        """Return the bracket: the last step of the solver."""
        lower, upper = (jnp.asarray(options[name], y.dtype) for name in ("lower", "upper"))
        return _Bracket(lower, upper, fn(lower, args)[0], fn(upper, args)[0], jnp.array(0))

    def step(self, fn, y, args, options, state, tags):
        """Evaluate the function once, and shrink the bracket."""
        bisect = state.count % 3 == 2
        share = state.at_lower / (state.at_lower - state.at_upper)
        share = jnp.where(bisect | ~(share > 0) | ~(share < 1), 0.5, share)
        x = state.lower + share.astype(y.dtype) * (state.upper - state.lower)
        value, aux = fn(x, args)
        above = value > 0
        # The end that stays is weighted down, so that it moves in the next step.
        state = _Bracket(
            lower=jnp.where(above, x, state.lower),
            upper=jnp.where(above, state.upper, x),
            at_lower=jnp.where(above, value, jnp.where(bisect, 1.0, 0.5) * state.at_lower),
            at_upper=jnp.where(above, jnp.where(bisect, 1.0, 0.5) * state.at_upper, value),
            count=state.count + 1,
        )
        return x, state, aux

    def terminate(self, fn, y, args, options, state, tags):
        """Return whether the bracket is as small as rounding allows, or the root is met."""
        small = state.upper - state.lower <= self.atol + self.rtol * jnp.abs(state.upper)
        # A guard within rounding of zero may have no root but the start.
        return small | (state.at_upper == 0) | (state.at_lower <= 0) | (state.count >= 200), optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """Return the last point."""
        return y, aux, {}


def first_solver_state(
    solver: diffrax.AbstractSolver, term: diffrax.ODETerm, zero: Scalar, y0: Pair, arc: ArcProblem
) -> PyTree:
    """Return a solver state with its first stage evaluated, where the solver reuses the last stage (FSAL).

    Otherwise every step has a stage that only the first needs.
    """
    if not isinstance(solver, diffrax.AbstractERK) or solver.init(term, zero, zero, y0, arc) is None:
        return None
    return jnp.array(False), term.vf(zero, y0, arc)
