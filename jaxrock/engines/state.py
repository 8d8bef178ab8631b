"""The state of a lane: one block under one motion at one time."""

from dataclasses import fields, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Inexact, Int

from jaxrock._core.types import Flag, Scalar
from jaxrock.compiler import custom_tangent
from jaxrock.compiler.hints import select, stop_gradient
from jaxrock.engines.scene import Scene
from jaxrock.engines.uncertainty import StateCovariance
from jaxrock.models.equation import Angle
from jaxrock.numerics.derivatives_of import with_derivatives_of
from jaxrock.status import Status


class Counts(NamedTuple):
    """Impacts up to the end of the motion, where steps follow the free stage, too."""

    impacts: Int[Array, "..."]
    large: Int[Array, "..."]


class Reached(NamedTuple):
    """Largest opening angle so far on either side [rad], which ties remember."""

    right: Scalar
    left: Scalar

    def on(self, side: Scalar) -> Scalar:
        """Return the value on a side."""
        return select(side < 0, self.left, self.right)

    def with_opening(self, side: Scalar, opening: Scalar) -> "Reached":
        """Return the values after an opening angle on a side."""
        right, left = (select(opening > known, opening, known) for known in self)
        return Reached(select(side > 0, right, self.right), select(side < 0, left, self.left))


class State(eqx.Module):
    """Position of a lane, and extremes so far. Velocities are per p t, angles in rad."""

    piece: Int[Array, ""]
    local: Scalar  # time since the start of the piece [s]
    side: Scalar  # corner it stands on: +1, -1; 0 at rest
    opening: Scalar  # side * rotation
    velocity: Scalar  # of the opening
    uplifting: Flag  # leaves rest now with zero acceleration, under a continuous motion
    beyond: Flag  # past the saddle
    extremal: Flag  # the velocity has an extremum here: the acceleration is zero, to rounding
    peak: Scalar
    peak_time: Scalar
    error: Scalar  # standard error of the peak
    fastest: Scalar
    impacts: Int[Array, ""]  # down to hops of rounding height
    large_impacts: Int[Array, ""]  # faster than a fall from `LARGE` alpha
    impact_time: Scalar  # of the last impact [s]
    impact_velocity: Scalar  # of the rotation, just before it
    closeness: Scalar  # smallest squared distance from standing still in balance (`margin`)
    closeness_beyond: Scalar  # `closeness` since the last outward crossing of the saddle
    clearance: Scalar  # smallest distance from a grazing impact [rad]: height of an inward turn above the
    # ground, or depth that a slowed block would have reached below it
    peak_clearance: Scalar  # `clearance` up to the peak
    second: Scalar  # second highest peak
    spread: StateCovariance  # covariance of the errors of opening and velocity
    overturned: Flag
    done: Flag
    status: Status
    steps: Int[Array, ""]
    counts: Counts | None = None  # None: steps do not follow the free stage
    reached: Reached | None = None  # None: the moments have no memory


class Node(eqx.Module):
    """The fields of a `State`, or of many, from which a block is followed within a step."""

    piece: Int[Array, "..."]
    local: Inexact[Array, "..."]
    side: Inexact[Array, "..."]
    opening: Inexact[Array, "..."]
    velocity: Inexact[Array, "..."]
    uplifting: Bool[Array, "..."]
    done: Bool[Array, "..."]
    reached: Reached | None = None

    @classmethod
    def of(cls, state: "State | Node") -> "Node":
        """Copy the fields from a state."""
        return cls(*(getattr(state, field.name) for field in fields(cls)))


class Kept(eqx.Module):
    """The fields of the `State` at the start of a step that a history stores."""

    start: Node
    impacts: Int[Array, "..."]
    impact_time: Inexact[Array, "..."]
    impact_velocity: Inexact[Array, "..."]

    @classmethod
    def of(cls, state: State) -> "Kept":
        """Copy the fields from a state."""
        return cls(Node.of(state), state.impacts, state.impact_time, state.impact_velocity)

    @property
    def done(self) -> Bool[Array, "..."]:
        """Return whether this is the last state."""
        return self.start.done


LARGE = 1e-6  # rotation over alpha from which a block falls to a large impact
ROUNDING = 4096  # units of rounding within which peaks count as equally high
# Fields that depend on the parameters of a block once it has rocked.
_MOVES = (
    "local", "opening", "velocity", "peak", "peak_time", "fastest", "impact_time", "impact_velocity", "closeness",
    "closeness_beyond", "clearance", "peak_clearance", "second",
)  # fmt: skip
_MOST = 1e30  # [g], [rad/s], [s]: larger inputs are rejected


def initial_state(scene: Scene, rotation: Scalar, velocity: Scalar) -> State:
    """Return the state at time 0 from rotation [rad] and angular velocity [rad/s]."""
    velocity = velocity / scene.p
    least = float(jnp.finfo(rotation.dtype).tiny) ** 0.5  # squares of smaller numbers underflow
    rotation, velocity = (select(jnp.abs(x) < least, x - stop_gradient(x), x) for x in (rotation, velocity))
    side = select(rotation != 0, jnp.sign(rotation), jnp.sign(velocity))
    # At rest, derivatives are those of side 1, until `rest.lift` knows the side to which the block uplifts.
    opening = with_derivatives_of(jnp.abs(rotation), select(side < 0, -rotation, rotation))
    outward = with_derivatives_of(side * velocity, select(side < 0, -velocity, velocity))
    zero, no = jnp.zeros_like(opening), jnp.zeros_like(opening, bool)
    count = jnp.zeros_like(opening, jnp.int32)
    moments: Any = scene.on(side).moments
    reached = None
    if moments.remembers:
        moments, reached = moments.remembering(opening), Reached(zero, zero).with_opening(side, opening)
    beyond = opening >= moments.saddle
    # Squared distance from standing still in balance, for a block that starts past its saddle.
    pull = moments.fall(Angle.of(opening))
    stillness = (moments.stiffness * outward**2 + pull**2) / moments.fall_at_rest**2
    # For a block that the motion cannot lift, the margin is the distance of the motion from lifting it.
    unlifted = jnp.maximum(2 - scene.outlook.strongest_drive / scene.threshold, 1)
    eps = jnp.finfo(opening.dtype).eps
    finite = jnp.isfinite(rotation) & jnp.isfinite(velocity)
    # With a NaN threshold, a block would seem to stand for ever. The comparison rejects NaN, and numbers so large that
    # their squares overflow.
    finite = finite & (scene.threshold + scene.p + scene.outlook.strongest_drive + scene.knots[-1] < _MOST)
    # A step of an optimiser may leave the ranges that constructors check.
    forward = scene.motion.lasting.forward if scene.first is None else scene.motion.length(scene.first) >= 0
    forward = forward & (scene.knots[0] >= 0) & (scene.knots[-1] >= 0)
    finite = finite & (scene.threshold > 0) & (scene.p > 0) & forward
    if scene.only_side is not None:  # what stands behind a wall leaves it no room there
        finite = finite & (side != -scene.only_side)
    spread = StateCovariance.none(opening).plus(eps * opening, eps * outward)
    if scene.motion.time_rounding is not None:  # a push that comes too late: at first the velocity lacks its impulse
        spread = spread.plus(0.0, scene.outlook.strongest_drive * scene.p * scene.motion.time_rounding)
    return State(
        piece=count if scene.first is None else scene.first,
        local=zero,
        side=side,
        opening=opening,
        velocity=outward,
        uplifting=no,
        beyond=beyond,
        extremal=no,
        peak=select(side == 0, zero, opening),
        peak_time=zero,
        error=zero,
        fastest=select(side == 0, zero, jnp.abs(outward)),
        impacts=count,
        large_impacts=count,
        impact_time=zero,
        impact_velocity=zero,
        closeness=select(side == 0, unlifted, select(outward == 0, jnp.minimum(stillness, 1.0), 1.0)),
        closeness_beyond=select(beyond, stillness, jnp.inf),
        clearance=jnp.full_like(opening, jnp.inf),
        peak_clearance=jnp.full_like(opening, jnp.inf),
        second=zero,
        spread=spread,
        overturned=no,
        done=~finite,
        status=Status.where(finite, Status.successful, Status.not_finite),
        steps=count,
        reached=reached,
    )


def all_moving(state: State, scene: Scene) -> State:
    """Return the state; if any parameter of the scene has a tangent, so have all fields that will depend on it.

    Otherwise JAX traces the loop over all steps twice to differentiate it: with the tangents at entry, then with those
    that the first step adds.
    """
    path = [getattr(state, name) for name in _MOVES]
    numbers = [x for x in jax.tree.leaves(scene) if not jnp.shape(x)]
    return replace(state, **dict(zip(_MOVES, custom_tangent(_all_move, path, (path, numbers)))))


def _all_move(values: list, _, changes: tuple) -> list:
    own, numbers = changes
    moving = [d for d in (*own, *numbers) if d is not None and jnp.issubdtype(d.dtype, jnp.inexact)]
    if not moving:
        return own
    # `where` makes zeros that vary between lanes under `jax.vmap` over directions, if the tangents do.
    none = select(jnp.zeros((), bool), moving[0], 0.0).astype(values[0].dtype)
    return [none if d is None else d for d in own]


def surpasses(value: Scalar, best: Scalar) -> Flag:
    """Return whether a peak exceeds the best so far by more than rounding: of equal peaks the first sets the time."""
    return value > best * (1 + ROUNDING * jnp.finfo(best.dtype).eps)
