"""A mechanism of one degree of freedom: positions of its bodies in, equation of motion and impact out."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Inexact

from jaxrock._arguments.annotations import arguments
from jaxrock._arguments.parameters import parameter, set_parameters
from jaxrock._arguments.ranges import checked, size, with_throw
from jaxrock._core.arrays import shown
from jaxrock._core.types import Scalar
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.restitution import Restitution
from jaxrock.blocks.rigid import GRAVITY, Block, Side
from jaxrock.models.equation import AbstractEquation, AbstractMoments, Angle, Summit, first_zero, last_rise
from jaxrock.models.user_equation import Functions, as_functions_see
from jaxrock.numerics.gauss_legendre import gauss_legendre_of_unit

_CREEP = 1e-30  # a velocity so small that only a jump at zero velocity shows
_GAUSS = gauss_legendre_of_unit(12)


class RigidBody(NamedTuple):
    """A rigid body of a mechanism, at one opening angle.

    - `mass`: its mass [kg], 0 or more.
    - `x`: horizontal position of its centre of mass [m], growing to the side to which the mechanism opens.
    - `y`: height of its centre of mass [m].
    - `rotation`: its rotation [rad]; the sense does not matter.
    - `inertia`: moment of inertia about its centre of mass [kg m^2], 0 or more.

    An inerter against a horizontal displacement is a body without mass: its `rotation` is the displacement, and its
    `inertia` the inertance [kg].
    """

    mass: Any
    x: Any
    y: Any
    rotation: Any = 0.0
    inertia: Any = 0.0


class Mechanism(AbstractEquation):
    """A symmetric mechanism of rigid bodies, from their positions; the diffrax engine solves it.

    At an opening angle x, body i is at X_i and Y_i, turned by phi_i, and has the mass m_i and the moment of inertia
    I_i. With M = sum[m (X'^2 + Y'^2) + I phi'^2], side s and ground accelerations u and v [g],

        M x'' + M' x'^2/2 = -g [(1 + v) sum m Y' + s u sum m X'] - moment(x, x').

    The mirrored mechanism moves after an impact, whose impulses do no work on its velocities. So the impact leaves
    e = sum[m (X'^2 - Y'^2) + I phi'^2]/M of the velocity: 1 - 2 T_vertical/T, T the kinetic energy.

    **Arguments:**

    - `bodies`: bodies(x), a list of `RigidBody`, smooth in x from 0 to pi/2. At x = 0 the mechanism is at rest, and
      their weight holds it closed.
    - `moment`: moment(x, velocity) of springs and dampers against the opening [N m], velocity in rad/s; zero at rest.
      None: no such moment.
    - `gravity`: acceleration of gravity [m/s^2], positive.
    - `falls_flat`: whether the mechanism at x = pi/2 lies on the ground.

    The scene's block is `block()`. Functions that are Equinox modules may carry parameters to differentiate: make
    mechanism and block within the function that is differentiated. Values are as precise as the diffrax engine keeps
    them, and `contact_forces` refuses the response.

    **Raises:** ValueError for a function that returns no list of `RigidBody`. A call raises it for another block, for
    weight that does not close the mechanism, and for a moment that does not vanish at rest or jumps there.

    **Source:** derived here, by Lagrange's equation and d'Alembert's principle for impulses.
    """

    _functions: Callable
    gravity: Inexact[Array, "..."] = parameter("m/s^2", size)
    _has_moment: bool = eqx.field(static=True)
    _falls_flat: bool = eqx.field(static=True)

    @arguments
    def __init__(
        self,
        bodies: Callable,
        moment: Callable | None = None,
        *,
        gravity: ArrayLike = GRAVITY,
        falls_flat: bool = True,
    ):
        set_parameters(self, gravity=gravity)
        self._functions = BodyFunctions((bodies, moment))  # type: ignore[call-arg]  # made as `Functions`
        self._has_moment, self._falls_flat = moment is not None, falls_flat

    @with_throw
    def block(self, restitution: Restitution | None = None, *, throw: bool = True) -> Block:
        """Return the block that stands for the mechanism, for the scene.

        **Arguments:**

        - `restitution`: as in `Block`; None: the value that follows from the bodies.

        **Returns:** a `Block`. Its tan(alpha) is the uplift threshold, sum m Y'/sum m X', and its p^2 the initial
        acceleration: g sqrt((sum m X')^2 + (sum m Y')^2)/M. Of one rigid block it is that block.

        **Raises:** ValueError where the weight does not close the mechanism, and where the bodies' restitution is
        negative: the mechanism then stops in another way, and `restitution` must say how.
        """
        zero = jnp.zeros((), jnp.result_type(float))
        rest = _motion_of(self._functions, zero, None)
        lift = checked("bodies", rest.lift, "have a weight that closes the mechanism at rest", lambda x: x > 0)
        shift = checked("bodies", rest.shift, "move to the side of the opening at rest", lambda x: x > 0)
        if restitution is None:
            says = "have a restitution, 1 - 2 T_vertical/T, of 0 or more, unless `restitution` is given"
            restitution = checked("bodies", rest.kept / rest.inertia, says, lambda x: x >= 0)
        return Block(jnp.arctan2(lift, shift), jnp.sqrt(self.gravity * rest.weight / rest.inertia), restitution)

    def moments(self, block: Block | Side) -> "MechanismMoments":
        """Return the moments, as the engine calls them."""
        if isinstance(block, Side):
            raise ValueError("Argument `block` must be that of `Mechanism.block`, but is asymmetric.")
        return MechanismMoments.of(self._functions, block, self._has_moment)

    def moments_of_sides(self, block: AsymmetricBlock) -> tuple[AbstractMoments, AbstractMoments]:
        """Refuse an asymmetric block: both sides of a mechanism are alike."""
        raise ValueError("Argument `block` must be that of `Mechanism.block`, but is asymmetric.")

    def faults(self, block: Block | Side) -> dict[str, Bool[Array, ""]]:
        """Check mechanism and block at rest. Return messages, each with whether its fault occurs."""
        if isinstance(block, Side):
            self.moments(block)
        zero, seen = jnp.zeros_like(block.alpha), as_functions_see(block)
        rest = _motion_of(self._functions, zero, seen)
        alpha, p = jnp.arctan2(rest.lift, rest.shift), jnp.sqrt(self.gravity * rest.weight / rest.inertia)
        off = jnp.maximum(jnp.abs(block.alpha / alpha - 1), jnp.abs(block.p / p - 1))
        near = 1e5 * jnp.finfo(zero.dtype).eps
        still, creep, back = (self._functions(zero, zero + v, zero, seen)[1] for v in (0.0, _CREEP, -_CREEP))
        noise = near * self.gravity * rest.weight
        return {
            "The weight of the bodies must close the mechanism at opening 0": rest.lift <= 0,
            "The bodies must move to the side of the opening at opening 0": rest.shift <= 0,
            "The moment of a mechanism must be zero at rest": jnp.abs(still) > noise,
            "The moment must not jump where the velocity changes its sign: dry friction is nearly k tanh(v/w) with a "
            "small w, not k sign(v)": jnp.abs(creep - back) > noise,
            "The block of a mechanism must be that of its method `block`, whose alpha and p follow from the bodies": ~(
                off <= near
            ),
        }

    @property
    def falls_flat(self) -> bool:
        """Return the argument `falls_flat`."""
        return self._falls_flat

    @property
    def is_series(self) -> bool:
        """Return False: the positions are known only by their values."""
        return False


class BodyFunctions(Functions):
    """The functions of a mechanism; called like those of an `Equation`."""

    def parameter_path(self, path: tuple[str, ...]) -> None:
        """Name no parameter: the block changes with it, as `Mechanism.block` makes it."""
        return None

    def as_written(self, x: Scalar, v: Scalar, push: Scalar, block: Block | Side | None) -> Any:
        """Return the bodies and the moment against the opening at an angle and a velocity."""
        bodies, moment = [m if m is not None else f for m, f in zip(self.modules, self.plain)]
        found = bodies(x)
        if not isinstance(found, (list, tuple)) or not found or not all(isinstance(each, RigidBody) for each in found):
            raise ValueError(f"Argument `bodies` must be a function that returns a list of `RigidBody`, but it returns "
                             f"{shown(found)}.")  # fmt: skip
        found = [RigidBody(*(jnp.asarray(value, x.dtype) for value in body)) for body in found]
        for name, value in ((name, value) for body in found for name, value in zip(RigidBody._fields, body)):
            if value.shape:
                raise ValueError(f"The `{name}` of a `RigidBody` must be one number, but has shape {value.shape}.")
        return found, jnp.zeros_like(x) if moment is None else jnp.asarray(moment(x, v), x.dtype)


class _Motion(NamedTuple):
    """Inertia and motion of a mechanism at an opening angle, per unit of its velocity."""

    inertia: Scalar  # M
    growth: Scalar  # M'/2
    lift: Scalar  # sum m Y'
    shift: Scalar  # sum m X'
    kept: Scalar  # sum[m (X'^2 - Y'^2) + I phi'^2]
    raised: Scalar  # sum m Y

    @property
    def weight(self) -> Scalar:
        """Return the distance that stands for m R of a block, times the mass."""
        return jnp.hypot(self.lift, self.shift)


def _motion_of(functions: Callable, x: Scalar, block: Block | Side | None) -> _Motion:
    zero, one = jnp.zeros_like(x), jnp.ones_like(x)
    bodies, _ = functions(x, zero, zero, block)

    def placed(x):
        return [(body.x, body.y, body.rotation) for body in functions(x, zero, zero, block)[0]]

    def rates(x):
        return jax.jvp(placed, (x,), (one,))[1]

    moving, bending = jax.jvp(rates, (x,), (one,))
    inertia = growth = lift = shift = kept = raised = zero
    for (mass, _, y, _, own), (dx, dy, turn), (ddx, ddy, bend) in zip(bodies, moving, bending):
        inertia = inertia + mass * (dx * dx + dy * dy) + own * turn * turn
        kept = kept + mass * (dx * dx - dy * dy) + own * turn * turn
        growth = growth + mass * (dx * ddx + dy * ddy) + own * turn * bend
        lift, shift, raised = lift + mass * dy, shift + mass * dx, raised + mass * y
    return _Motion(inertia, growth, lift, shift, kept, raised)


class MechanismMoments(AbstractMoments):
    """The moments of a mechanism, over its initial inertia."""

    functions: Callable
    block: Block
    gravity: Scalar  # [m/s^2], as the block's p implies it
    rate: Scalar  # unit of the velocities [rad/s]
    restoring_at_rest: Scalar
    arm_at_rest: Scalar
    saddle: Scalar
    firm: Scalar  # angle past which the mechanism gets no firmer (`last_rise`)
    summit: Summit
    has_moment: bool = eqx.field(static=True)

    @classmethod
    def of(cls, functions: Callable, block: Block, has_moment: bool) -> "MechanismMoments":
        """Compute the moments of a mechanism whose block has this p."""
        block = cast(Block, as_functions_see(block))
        rest = _motion_of(functions, jnp.zeros_like(block.alpha), block)
        # A mechanism that does not stand has a NaN threshold (`standing` raises before).
        lift, shift = (jnp.where(value > 0, value, jnp.nan) / rest.weight for value in (rest.lift, rest.shift))
        gravity = block.p**2 * rest.inertia / rest.weight
        later = block.alpha, block.alpha, Summit(block.alpha, block.alpha)
        made = cls(functions, block, gravity, block.p, lift, shift, *later, has_moment)
        saddle = first_zero(lambda x: made.restoring(Angle.of(x)), block.alpha)
        summit = Summit.of(made.restoring, saddle)
        return replace(made, saddle=saddle, firm=last_rise(made, block.alpha), summit=summit)

    def acceleration(self, angle: Angle, velocity: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """Return the acceleration of the opening angle per (p t)^2; push = side u, weight = 1 + v (None: 1)."""
        at = _motion_of(self.functions, angle.value, self.block)
        lift = at.lift if weight is None else weight * at.lift
        moment = self.gravity * (lift + push * at.shift)
        if self.has_moment:
            moment = moment + self._moment(angle.value, velocity * self.rate)
        return -(moment / self.rate**2 + at.growth * velocity**2) / at.inertia

    def _moment(self, x: Scalar, velocity: Scalar) -> Scalar:
        return self.functions(x, velocity, jnp.zeros_like(x), self.block)[1]

    def times(self, factor: Scalar | float) -> "MechanismMoments":
        """Multiply all accelerations by a factor, the square of another unit of time."""
        ratio = jnp.sqrt(factor)
        return replace(self, rate=self.rate / ratio, restoring_at_rest=factor * self.restoring_at_rest,
                       arm_at_rest=factor * self.arm_at_rest, summit=self.summit.times(factor))  # fmt: skip

    def restoring(self, angle: Angle) -> Scalar:
        """Return the deceleration of a mechanism that stands at an opening angle, without shaking."""
        zero = jnp.zeros_like(angle.value)
        return -self.acceleration(angle, zero, zero)

    def fall(self, angle: Angle) -> Scalar:
        """Return how far the deceleration changes from an opening angle to the balance."""
        return self.summit.fall(angle, self.restoring(angle))

    @property
    def fall_at_rest(self) -> Scalar:
        """Return `fall` at rest."""
        return self.summit.fall_at_rest(self.restoring_at_rest)

    def arm(self, angle: Angle) -> Scalar:
        """Return the deceleration by a push of 1 g at an opening angle."""
        at = _motion_of(self.functions, angle.value, self.block)
        return self.gravity * at.shift / (self.rate**2 * at.inertia)

    def repulsion(self, angle: Angle, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """Return the rate at which nearby angles of a mechanism that stands still diverge, per angle."""
        zero = jnp.zeros_like(angle.value)
        return jax.grad(lambda x: self.acceleration(Angle.of(x), zero, push, weight))(angle.value)

    def work(self, opening: Scalar) -> Scalar:
        """Return the rise of the bodies and the work against the moment at creeping speed, over the initial inertia."""
        zero = jnp.zeros_like(opening)
        rest, at = (_motion_of(self.functions, x, self.block) for x in (zero, opening))
        found = self.gravity * (at.raised - rest.raised)
        if self.has_moment:
            nodes, weights = (jnp.asarray(values, opening.dtype) for values in _GAUSS)
            held = jax.vmap(lambda x: self._moment(x, jnp.zeros_like(x)))(opening * nodes)
            found = found + opening * jnp.sum(weights * held)
        return found / (self.rate**2 * rest.inertia)

    @property
    def stiffness(self) -> Scalar:
        """Return the rate at which the restoring moment falls at the balance; one where no balance lies before
        pi/2."""
        falls = -jax.grad(lambda x: self.restoring(Angle.of(x)))(self.saddle)
        return jnp.where(falls > 0, falls, 1.0)

    def held(self, angle: Angle, velocity: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """Return the largest inward acceleration, moving or standing, under a forcing of at most this size.

        The change of inertia may hurry a mechanism outward that a force still holds.
        """
        still = self.held_either_way(angle, jnp.zeros_like(velocity), push, weight)
        return jnp.maximum(self.held_either_way(angle, velocity, push, weight), still)

    def held_manifold(self, angle: Angle, hold: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """Return infinity: the moments beyond this angle are unknown."""
        return jnp.full_like(hold, jnp.inf)

    def unheld_manifold(self, angle: Angle, hold: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """Return zero beyond `firm`, where no moment further on can hold the mechanism, else infinity.

        A moment that does not weigh may hold a lighter mechanism further on.
        """
        if self.has_moment and weight is not None:
            return jnp.full_like(hold, jnp.inf)
        return jnp.where(angle.value < self.firm, jnp.inf, 0.0)
