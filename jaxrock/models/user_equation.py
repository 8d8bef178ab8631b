"""An equation of motion of the user's own, written as functions."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Inexact

from jaxrock._arguments.annotations import arguments
from jaxrock._arguments.parameters import parameter, set_parameters
from jaxrock._arguments.ranges import checked, positive
from jaxrock._core.arrays import Values, is_traced
from jaxrock._core.types import Scalar
from jaxrock.blocks.restitution import Constant
from jaxrock.blocks.rigid import Block, Side
from jaxrock.compiler import trace_function
from jaxrock.compiler.hints import select
from jaxrock.models.equation import AbstractEquation, AbstractMoments, Angle, Summit, first_zero, last_rise
from jaxrock.numerics.lookup import stretch_from, take

_CHECKED = (0.0, 0.25, 0.5, 0.75, 1.0)  # opening angles over alpha at which dissipation must not jump
_CREEP = 1e-30  # a velocity so small that only a jump at zero velocity shows


class Equation(AbstractEquation):
    """A model of your own, written as functions; the diffrax engine solves it.

    With the opening angle x = |rotation| [rad], velocity v = dx/d(p t), side s and ground acceleration u [g]:

        d^2x/d(p t)^2 = -[restoring(x, block) + s u arm(x, block) + dissipation(x, v, block)]

    **Arguments:**

    - `restoring`: restoring moment over m g R; positive at x = 0. Its first zero is the unstable equilibrium.
    - `arm`: overturning arm over R; positive at x = 0. None: 1.
    - `dissipation`: moment over m g R against the motion, zero at rest. None: zero.
    - `acceleration`: instead of the three, the whole right-hand side: acceleration(x, v, s u, block), linear in s u.
    - `falls_flat`: whether a block at a rotation of pi/2 lies on its side.
    - `bends`: (k,) opening angles [rad], above 0 and growing, at which a derivative of the functions jumps, such as
      contact with a stop: steps end there. None: no such angle.

    A vertical acceleration v [g] multiplies the restoring moment by 1 + v.

    The functions must be continuous, smooth between these angles, work on JAX arrays, and be defined somewhat beyond 0
    and pi/2. Dry friction is nearly k tanh(v/w), with a small w. At a bend that `bends` does not list, values keep the
    tolerance, but slopes are off by 1e-5 to 1e-3, without a warning.

    Functions that are Equinox modules may carry parameters to differentiate by, with names such as
    `model.restoring.stiffness` in `sensitivity` and fits. Functions may read variables that change:
    every call of the package sees current values (under your `jax.jit`, those of the trace). A block that has stopped
    below its unstable equilibrium after the motion counts as safe: dissipation does not lift it.

    **Raises:** ValueError where neither or both ways are used. A call raises it for a block that does not stand by the
    equation, for dissipation that jumps at rest, and for an acceleration that is not linear in the push.
    """

    _acceleration: "Functions"
    _falls_flat: bool = eqx.field(static=True)
    bends: Inexact[Array, " bends"] | None = parameter("rad", positive, axes=1)

    @arguments
    def __init__(
        self,
        restoring: Callable | None = None,
        arm: Callable | None = None,
        dissipation: Callable | None = None,
        *,
        acceleration: Callable | None = None,
        falls_flat: bool = True,
        bends: Values | None = None,
    ):
        if (restoring is None) == (acceleration is None) or (acceleration is not None and (arm or dissipation)):
            raise ValueError("Give either `restoring` (with `arm` and `dissipation`) or `acceleration`.")
        parts = (restoring, arm, dissipation) if acceleration is None else (acceleration,)
        self._acceleration = Functions(parts)
        self._falls_flat, self.bends = falls_flat, None
        if bends is not None:
            set_parameters(self, bends=bends)
            angles = cast(Array, self.bends)
            if angles.ndim != 1:
                raise ValueError(f"Argument `bends` must be a list of angles, but has shape {angles.shape}.")
            self.bends = checked("bends", angles, "grow from each to the next", _grow)

    def moments(self, block: Block | Side) -> "FunctionMoments":
        """Return the moments of one block, as the engine calls them."""
        function = self._acceleration
        if not function.is_current and is_traced(block):  # functions of a model's method hold what that trace holds
            function = function.current(block.alpha.dtype, as_functions_see(block))
        return FunctionMoments(function, block, bends_at=self.bends)

    def parameter_path(self, path: tuple[str, ...]) -> tuple[str, ...]:
        """Return the path that names a parameter, such as `restoring.stiffness`."""
        return path[1:] if path[0] == "_acceleration" else path

    def at_rest(self, block: Block | Side) -> tuple[Scalar, Scalar]:
        """Return the restoring moment and overturning arm just after uplift, which must be positive."""
        zero = jnp.zeros_like(block.alpha)
        alone, pushed = (self._acceleration(zero, zero, push, as_functions_see(block)) for push in (zero, zero + 1))
        return -alone, alone - pushed

    def faults(self, block: Block | Side) -> dict[str, Bool[Array, ""]]:
        """Check the functions just after uplift and further on. Return messages, each with whether its fault occurs."""
        zero = jnp.zeros_like(block.alpha)
        alone, arm = self.at_rest(block)

        def moment(velocity=0.0, push=0.0, opening=0.0):
            return -self._acceleration(zero + opening, zero + velocity, zero + push, as_functions_see(block))

        noise = 1e3 * jnp.finfo(zero.dtype).eps * (jnp.abs(alone) + jnp.abs(arm))

        def jump(share):
            one, other = (moment(velocity=velocity, opening=share * block.alpha) for velocity in (_CREEP, -_CREEP))
            return jnp.abs(one - other)

        jumps = jnp.max(jax.vmap(jump)(jnp.asarray(_CHECKED, zero.dtype)), axis=0)
        bends = []
        for opening in (zero, 0.5 * block.alpha):
            at_none, at_one, at_two = (moment(push=push, opening=opening) for push in (0.0, 1.0, 2.0))
            bends.append(jnp.abs(at_two - 2 * at_one + at_none))
        return {
            "The restoring moment must be positive at rotation 0": alone <= 0,
            "The overturning arm must be positive at rotation 0": arm <= 0,
            "The dissipation must not jump where the velocity changes its sign: dry friction is nearly "
            "k tanh(v/w) with a small w, not k sign(v)": jumps > noise,
            "The acceleration must be linear in the push of the ground": jnp.maximum(*bends) > noise,
        }

    @property
    def falls_flat(self) -> bool:
        """Return the argument `falls_flat`."""
        return self._falls_flat

    @property
    def is_series(self) -> bool:
        """Return False: the functions are known only by their values."""
        return False


class Functions(eqx.Module):
    """Functions, as leaves where they are modules (with parameters) and static where they are plain.

    - `traced`: all of them together as they were at the time of a call; None: not yet traced.
    """

    modules: tuple
    plain: tuple = eqx.field(static=True)
    traced: Any

    def __init__(self, parts: tuple, traced: Any = None):
        self.modules = tuple(f if isinstance(f, eqx.Module) else None for f in parts)
        self.plain = tuple(None if isinstance(f, eqx.Module) else f for f in parts)
        self.traced = traced

    @property
    def is_current(self) -> bool:
        """Return whether the functions have been traced: a pytree for `jax.jit`."""
        return self.traced is not None

    def current(self, dtype: Any, block: Any) -> "Functions":
        """Trace the functions as they are now, for numbers of a type and for blocks like this one."""
        number = jax.ShapeDtypeStruct((), dtype)
        traced: Any = trace_function(self, number, number, number, jax.tree.map(lambda leaf: number, block))
        # The modules keep their arrays, which are parameters; the program holds their other parts.
        return type(self)(eqx.filter(self.modules, eqx.is_array_like), replace(traced, arrays=()))

    def parameter_path(self, path: tuple[str, ...]) -> tuple[str, ...] | None:
        """Return the path that names a parameter, after the function that holds it."""
        field, *rest = path
        if field == "traced":
            return None
        roles = ("restoring", "arm", "dissipation") if len(self.modules) > 1 else ("acceleration",)
        return roles[int(rest[0])], *rest[1:]

    def __call__(self, x: Scalar, v: Scalar, push: Scalar, block: Block | Side | None) -> Any:
        if self.traced is not None:
            return replace(self.traced, arrays=tuple(jax.tree.leaves(self.modules)))(x, v, push, block)
        return self.as_written(x, v, push, block)

    def as_written(self, x: Scalar, v: Scalar, push: Scalar, block: Block | Side | None) -> Any:
        """Call the functions as they are now."""
        parts = [m if m is not None else f for m, f in zip(self.modules, self.plain)]
        if len(parts) == 1:
            return parts[0](x, v, push, block)
        restoring, arm, dissipation = parts
        moment = restoring(x, block) + push * (1.0 if arm is None else arm(x, block))
        return -moment if dissipation is None else -moment - dissipation(x, v, block)


def as_functions_see(block: Block | Side) -> Block | Side:
    """Replace the restitution of a block by a constant law, so that one trace of the functions serves all blocks of a
    kind."""
    if isinstance(block, Side):
        return block
    if block.beam is not None:
        block = eqx.tree_at(lambda frame: frame.beam, block, None)
    law = eqx.tree_at(lambda constant: constant.value, Constant(0.0), block.restitution)
    return eqx.tree_at(lambda b: b.law, block, law, is_leaf=lambda x: x is block.law)


class FunctionMoments(AbstractMoments):
    """The moments of a model that is given as functions."""

    function: Callable
    block: Block | Side
    factor: Scalar | float | None  # multiplies all accelerations (see `times`)
    bends_at: Inexact[Array, " bends"] | None
    stretch: tuple[Scalar, Scalar] | None  # continues as a straight line beyond this interval; None: nowhere
    restoring_at_rest: Scalar
    arm_at_rest: Scalar
    saddle: Scalar  # first zero of the restoring moment, at most pi/2
    firm: Scalar  # angle past which the block gets no firmer (`last_rise`)
    summit: Summit

    def __init__(
        self,
        function: Callable,
        block: Block | Side,
        factor: Scalar | float | None = None,
        bends_at: Inexact[Array, " bends"] | None = None,
    ):
        self.function, self.block, self.factor = function, as_functions_see(block), factor
        self.bends_at, self.stretch = bends_at, None
        zero = Angle.of(jnp.zeros_like(block.alpha))
        # A block that does not stand has a NaN threshold (`standing` raises before).
        self.restoring_at_rest, self.arm_at_rest = (
            jnp.where(moment > 0, moment, jnp.nan) for moment in (self.restoring(zero), self.arm(zero))
        )
        self.saddle = first_zero(lambda x: self.restoring(Angle.of(x)), block.alpha)
        self.firm = last_rise(self, block.alpha)
        self.summit = Summit.of(self.restoring, self.saddle)

    def acceleration(self, angle: Angle, velocity: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """Return the acceleration of the opening angle per (p t)^2; push = side u, weight = 1 + v (None: 1)."""
        value = self._value(angle, velocity, push)
        return value if weight is None else value - (weight - 1) * self.restoring(angle)

    def _value(self, angle: Angle, velocity: Scalar, push: Scalar) -> Scalar:
        if self.factor is not None:  # the function's own unit of time is that of its side
            velocity = velocity / jnp.sqrt(self.factor)

        def of(x):
            return jnp.asarray(self.function(x, velocity, push, self.block), self.block.alpha.dtype)

        value = of(angle.value) if self.stretch is None else _straight_beyond(*self.stretch, of, angle.value)
        return value if self.factor is None else self.factor * value

    def times(self, factor: Scalar | float) -> "FunctionMoments":
        """Multiply all accelerations by a factor."""
        factor = factor if self.factor is None else factor * self.factor
        return FunctionMoments(self.function, self.block, factor, self.bends_at)

    @property
    def bends(self) -> int:
        """Return the number of angles given in `bends`."""
        return 0 if self.bends_at is None else self.bends_at.size

    def ahead(self, opening: Scalar, outward: Bool[Array, ""]) -> tuple["FunctionMoments", Scalar]:
        """Return the equation that acts from an opening angle on, and the angle at which it bends next."""
        starts = jnp.concatenate([jnp.zeros(1, opening.dtype), cast(Array, self.bends_at)])
        number, angle, ends = stretch_from(starts, opening, outward)
        inside = 4 * float(jnp.finfo(opening.dtype).eps)  # at a bend rounding decides the side of the function
        low, high = take(starts, number), take(jnp.append(starts, 4.0), number + 1)
        stretch = select(number == 0, -1.0, low * (1 + inside)), high * (1 - inside)
        moments = eqx.tree_at(lambda m: m.stretch, self, stretch, is_leaf=lambda x: x is None)
        return moments, select(ends, angle, jnp.pi)

    def restoring(self, angle: Angle) -> Scalar:
        """Return the restoring moment over m g R at an opening angle."""
        zero = jnp.zeros_like(angle.value)
        return -self._value(angle, zero, zero)

    def fall(self, angle: Angle) -> Scalar:
        """Return how far the restoring moment changes from an opening angle to the balance."""
        return self.summit.fall(angle, self.restoring(angle))

    @property
    def fall_at_rest(self) -> Scalar:
        """Return `fall` at rest."""
        return self.summit.fall_at_rest(self.restoring_at_rest)

    def arm(self, angle: Angle) -> Scalar:
        """Return the overturning moment over m R u g at an opening angle."""
        zero = jnp.zeros_like(angle.value)
        return self._value(angle, zero, zero) - self._value(angle, zero, zero + 1)

    def repulsion(self, angle: Angle, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """Return the rate at which nearby angles diverge, per angle."""
        zero = jnp.zeros_like(angle.value)
        return jax.grad(lambda x: self.acceleration(Angle.of(x), zero, push, weight))(angle.value)

    @property
    def stiffness(self) -> Scalar:
        """Return one, or the factor: the slope of the function at the balance is unknown."""
        one = jnp.ones_like(self.saddle)
        return one if self.factor is None else self.factor * one

    def held(self, angle: Angle, velocity: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """Return the largest inward acceleration under a forcing of at most this size; far from rest the arm may be
        negative."""
        return self.held_either_way(angle, velocity, push, weight)

    def held_manifold(self, angle: Angle, hold: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """Return infinity: the function beyond this angle is unknown."""
        return jnp.full_like(hold, jnp.inf)

    def unheld_manifold(self, angle: Angle, hold: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """Return infinity below `firm`, where a moment further on may hold the block, else zero."""
        return jnp.where(angle.value < self.firm, jnp.inf, 0.0)


def _straight_beyond(low: Scalar, high: Scalar, function: Callable, x: Scalar) -> Scalar:
    """Return a function of a number whose tangents continue beyond the interval where it is evaluated."""
    inside = select(x < low, low, select(x > high, high, x))
    value, slope = jax.jvp(function, (inside,), (jnp.ones_like(inside),))
    return value + slope * (x - inside)


def _grow(angles):
    arrays = np if isinstance(angles, np.ndarray) else jnp  # NumPy compiles no program
    return angles[1:] > angles[:-1] if angles.size > 1 else arrays.ones(1, bool)
