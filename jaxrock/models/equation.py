"""The interface of every model: the moments that act on a block on one of its corners.

With the opening angle x = |rotation| (rad), velocity v = dx/d(p t), side s and ground acceleration u (g), x'' is minus
the restoring moment and s u times the overturning arm, both over m g R, and any further terms of a model.
"""

import abc
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Inexact

from jaxrock._arguments.parameters import Owner, check_declared
from jaxrock._core.types import Scalar
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.rigid import Block, Side
from jaxrock.compiler.hints import select
from jaxrock.numerics.elementary import sine_cosine
from jaxrock.numerics.gauss_legendre import gauss_legendre_of_unit
from jaxrock.numerics.roots import carried

_GAUSS = gauss_legendre_of_unit(12)
_STEPS = 256  # of a scan from rest to pi/2


class Angle(NamedTuple):
    """An angle [rad] with its sine and cosine, which are computed once."""

    value: Any
    sine: Any
    cosine: Any

    @classmethod
    def of(cls, value: Scalar | float) -> "Angle":
        """Build an angle from its value, between 0 and pi/2 or a little beyond."""
        return cls(value, *sine_cosine(jnp.asarray(value)))


class Rolled(NamedTuple):
    """Position of the centre of mass relative to the contact of a block with the ground, all over R."""

    height: Scalar
    reach: Scalar  # horizontal distance; positive as long as the weight restores the block
    radius: Scalar  # radius of curvature of the edge at the contact


class AbstractMoments(eqx.Module):
    """The moments that act on one block on one of its corners, and quantities derived from these."""

    if TYPE_CHECKING:  # annotations here would make them arguments of every subclass, where most are properties

        @property
        def saddle(self) -> Scalar: ...
        @property
        def stiffness(self) -> Scalar: ...
        @property
        def restoring_at_rest(self) -> Scalar: ...
        @property
        def arm_at_rest(self) -> Scalar: ...
    else:
        saddle: eqx.AbstractVar[Scalar]  # opening angle of the unstable equilibrium: it balances on its corner [rad]
        stiffness: eqx.AbstractVar[Scalar]  # rate at which the restoring moment falls there; 1 if unknown
        restoring_at_rest: eqx.AbstractVar[Scalar]  # restoring moment just after uplift, positive
        arm_at_rest: eqx.AbstractVar[Scalar]  # overturning arm just after uplift, positive

    @abc.abstractmethod
    def acceleration(self, angle: Angle, velocity: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """Return the acceleration of the opening angle per (p t)^2; push = side u, weight = 1 + v (None: 1)."""

    @abc.abstractmethod
    def restoring(self, angle: Angle) -> Scalar:
        """Return the restoring moment over m g R at an opening angle."""

    @abc.abstractmethod
    def arm(self, angle: Angle) -> Scalar:
        """Return the overturning moment over m R u g at an opening angle."""

    @abc.abstractmethod
    def repulsion(self, angle: Angle, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """Return the rate at which nearby angles diverge, per angle: the derivative of the acceleration by the
        angle."""

    @abc.abstractmethod
    def times(self, factor: Scalar | float) -> "AbstractMoments":
        """Multiply all accelerations by a factor, for a side whose own frequency parameter is not that of the scene."""

    @abc.abstractmethod
    def held_manifold(self, angle: Angle, hold: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """Return an outward velocity over p that reaches the unstable equilibrium under a constant forcing.

        `push`: the forcing against it [g]; `weight`: 1 + vertical acceleration (None: 1); `hold`: restoring moment and
        forcing at the angle, positive.
        """

    def unheld_manifold(self, angle: Angle, hold: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar | float:
        """Return `held_manifold` for a `hold` that is not positive: zero, unless a moment further on may hold the
        block."""
        return 0.0

    def fall(self, angle: Angle) -> Scalar:
        """Return how far the restoring moment changes from an opening angle to the balance: rises count like falls.

        That is the moment itself, unless it rises somewhere. The margin of an outcome is measured by it.
        """
        return self.restoring(angle)

    @property
    def fall_at_rest(self) -> Scalar:
        """Return `fall` at rest."""
        return self.restoring_at_rest

    def held(self, angle: Angle, velocity: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """Return the largest inward acceleration under a forcing of at most this size [g]."""
        return -self.acceleration(angle, velocity, push, weight)

    def held_either_way(self, angle: Angle, velocity: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """Return `held` for an arm that may be negative."""
        one, other = (-self.acceleration(angle, velocity, way * push, weight) for way in (1, -1))
        return jnp.maximum(one, other)

    def work(self, opening: Scalar) -> Scalar:
        """Return the work of the weight up to an opening angle, over m g R.

        It is half the squared speed on the ground after a free fall from there.
        """
        nodes, weights = (jnp.asarray(values, opening.dtype) for values in _GAUSS)
        return opening * jnp.sum(weights * jax.vmap(lambda x: self.restoring(Angle.of(x)))(opening * nodes))

    @property
    def bends(self) -> int:
        """Return the largest number of opening angles at which a derivative of these moments jumps."""
        return 0

    def ahead(self, opening: Scalar, outward: Bool[Array, ""]) -> tuple["AbstractMoments", Scalar]:
        """Return smooth moments that act from an opening angle on, outward or inward, and the next angle at which they
        bend.

        The moments continue smoothly past that angle. Without a further bend the angle is beyond pi/2.
        """
        raise NotImplementedError

    def rolled(self, angle: Angle) -> Rolled | None:
        """Return the position of the centre of mass at an opening angle; None for a block that turns about its
        corner."""
        return None

    @property
    def threshold(self) -> Scalar:
        """Return the ground acceleration at which the block uplifts [g]: tan(alpha), or alpha in the linear model."""
        return self.restoring_at_rest / self.arm_at_rest

    @property
    def threshold_of_weight(self) -> Scalar | None:
        """Return the part of the threshold that the weight holds [g]; None where that is all of it."""
        return None

    @property
    def has_series(self) -> bool:
        """Return whether the opening angle has a Taylor recurrence, so that the series engine can follow it."""
        return False

    @property
    def is_damped(self) -> bool:
        """Return whether a moment is known to depend on the velocity."""
        return False

    @property
    def has_free_swing(self) -> bool:
        """Return whether free swings are known in closed form."""
        return False

    @property
    def remembers(self) -> bool:
        """Return whether moments depend on the largest opening angle so far, as `remembering` tells them."""
        return False

    @property
    def balanced(self) -> "AbstractMoments":
        """Return the moments with the saddle, computed once for all its uses."""
        return self

    @property
    def steepest_start(self) -> Scalar:
        """Return an estimate of the rate at which the restoring moment changes with the angle near rest."""
        return self.stiffness

    def change_at_rest(self, horizontal: Scalar, vertical: Scalar | None) -> Scalar:
        """Bound the change of the acceleration just after uplift by the changes of the ground acceleration."""
        change = horizontal * self.arm_at_rest
        return change if vertical is None else change + vertical * self.restoring_at_rest


class AbstractEquation(Owner):
    """An equation of motion of rigid blocks: the base class of the package's models, and of your own.

    A subclass returns from `moments` the moments that act on a block:

    - `Coefficients`, where restoring moment and arm are sums of a constant, a line, a sine and a cosine of the opening
      angle. The series engine solves it, exact to rounding, and in machine code.
    - The moments of an `Equation` made of functions. The diffrax engine solves it, and `is_series` is false.

    Its fields are parameters: arrays, or dictionaries, tuples and modules of these. Arrays among them may be
    differentiated by, and may differ from lane to lane under `jax.vmap`. Single numbers have names in `sensitivity` and
    fits, `model.` and their path. A method `parameter_path(path)` may return a shorter path.
    """

    def __check_init__(self):
        check_declared(self)

    def __add__(self, restraint: Any) -> "AbstractEquation":
        """Return the model with a restraint, such as `rk.Housner() + rk.models.Tendon(...)`."""
        if not hasattr(restraint, "restrains"):
            return NotImplemented
        return restraint.restrains(self)

    @abc.abstractmethod
    def moments(self, block: Block | Side) -> AbstractMoments:
        """Return the moments that act on a block, or on one side of an asymmetric one.

        **Arguments:**

        - `block`: has `alpha` [rad] and `p` [rad/s], scalars.

        **Returns:** moments over m g R, in time p t.
        """

    def moments_of_sides(self, block: AsymmetricBlock) -> tuple[AbstractMoments, AbstractMoments]:
        """Return the moments of side 1 and of side 2 of an asymmetric block, each in its own time."""
        first, second = block.sides
        return self.moments(first), self.moments(second)

    @property
    def falls_flat(self) -> bool:
        """Return whether a block at a rotation of pi/2 lies on its side."""
        return True

    @property
    def is_series(self) -> bool:
        """Return whether its moments are `Coefficients`, so that the series engine can solve it."""
        return True

    @property
    def forces_follow(self) -> bool:
        """Return whether the forces of the ground follow from the rotation, as `contact_forces` computes them.

        They do where the block is rigid, turns about its corners or rolls on its edges, and only weight and ground act
        on it.
        """
        return False

    @property
    def feels_weight(self) -> bool:
        """Return whether a vertical acceleration changes the restoring moment; if not, vertical motions are refused."""
        return True


class Summit(eqx.Module):
    """The largest restoring moment below the balance, and the opening angle where it acts."""

    angle: Scalar  # by a scan, without derivatives; 0 where the moment only falls
    moment: Scalar

    @classmethod
    def of(cls, restoring: Callable, saddle: Scalar) -> "Summit":
        """Find it for a restoring moment, a function of an `Angle`."""
        step = jnp.pi / 2 / _STEPS

        def moment(x):
            return jax.lax.stop_gradient(restoring(Angle.of(x)))

        def higher(k, best):
            x = k.astype(saddle.dtype) * step
            value = moment(x)
            better = (value > best[1]) & (x < saddle)
            return select(better, x, best[0]), select(better, value, best[1])

        zero = jnp.zeros_like(jax.lax.stop_gradient(saddle))
        at, middle = jax.lax.fori_loop(1, _STEPS + 1, higher, (zero, moment(zero)))
        # The top of the parabola through the highest angle of the scan and its neighbours.
        low, high = moment(jnp.maximum(at - step, 0.0)), moment(at + step)
        bend = 2 * middle - low - high
        shift = select(bend > 0, (high - low) / (2 * select(bend > 0, bend, 1.0)), 0.0)
        angle = select(at == 0, 0.0, at + jnp.clip(shift, -0.5, 0.5) * step)
        angle = jax.lax.stop_gradient(angle)
        return cls(angle, restoring(Angle.of(angle)))

    def times(self, factor: Scalar | float) -> "Summit":
        """Multiply the moment by a factor."""
        return Summit(self.angle, factor * self.moment)

    def fall(self, angle: Angle, moment: Scalar) -> Scalar:
        """Return `AbstractMoments.fall` at an angle where this moment acts, of moments that rise up to the summit."""
        return select(angle.value < self.angle, 2 * self.moment - moment, moment)

    def fall_at_rest(self, moment: Scalar) -> Scalar:
        """Return `fall` at rest, for the moment there."""
        return select(self.angle > 0, 2 * self.moment - moment, moment)


def last_rise(moments: AbstractMoments, like: Scalar) -> Scalar:
    """Return the opening angle from which the ratio of restoring moment to arm only falls, up to pi/2.

    A forcing that does not hold a block there will not hold it further on. The angle comes from a scan, without
    derivatives. `like`: a number of the same dtype.
    """
    grid = _grid(like)

    def strength(x):
        at = Angle.of(x)
        return moments.restoring(at) / jnp.abs(moments.arm(at))

    found = jax.vmap(strength)(grid)
    return jax.lax.stop_gradient(jnp.max(select(found[1:] > found[:-1], grid[1:], 0.0)))


def _grid(like: Scalar) -> Inexact[Array, " angles"]:
    return jnp.linspace(0.0, jnp.pi / 2, _STEPS + 1, dtype=like.dtype)


def first_zero(moment: Callable, like: Scalar) -> Scalar:
    """Return the first zero of a restoring moment, at most pi/2.

    A scan and bisection find it; the implicit function gives its derivatives. `like`: a number of the same dtype.
    """
    grid = _grid(like)
    falls = jax.lax.stop_gradient(jax.vmap(moment)(grid)) <= 0
    first = jnp.argmax(falls)

    def halve(_, bracket):
        low, high = bracket
        middle = (low + high) / 2
        above = jax.lax.stop_gradient(moment(middle)) > 0
        return select(above, middle, low), select(above, high, middle)

    low, _ = jax.lax.fori_loop(0, 60, halve, (grid[jnp.maximum(first - 1, 0)], grid[first]))
    found = jnp.any(falls)

    def left(x):
        value, slope = jax.value_and_grad(moment)(x)
        return value / select(found, slope, 1.0)

    return select(found, carried(jax.lax.stop_gradient(low), left), jnp.pi / 2)
