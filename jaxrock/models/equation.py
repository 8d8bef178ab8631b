"""What every model must tell: for a block on one of its corners, the moments that act on it.

With the opening angle x = |rotation| (rad), velocity v = dx/d(p t), side s and ground acceleration u (g), x'' is minus
the restoring moment and s u times the overturning arm, both over m g R, and whatever else a model adds.
"""

import abc
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Inexact

from jaxrock._parameters import Owner, check_declared
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.rigid import Block, Side
from jaxrock.numerics.choice import where
from jaxrock.numerics.elementary import sine_cosine
from jaxrock.numerics.gauss_legendre import gauss_legendre_of_unit
from jaxrock.numerics.roots import carried

Scalar = Inexact[Array, ""]
_GAUSS = gauss_legendre_of_unit(12)


class Angle(NamedTuple):
    """An angle [rad] with its sine and cosine, which are computed once."""

    value: Any
    sine: Any
    cosine: Any

    @classmethod
    def of(cls, value: Scalar | float) -> "Angle":
        """An angle from its value, between 0 and pi/2 or a little beyond."""
        return cls(value, *sine_cosine(jnp.asarray(value)))


class Rolled(NamedTuple):
    """Where the centre of mass is over the point at which a block touches the ground, all over R."""

    height: Scalar
    reach: Scalar  # horizontal distance; positive as long as the weight rights the block
    radius: Scalar  # of curvature of what it rolls on


class AbstractMoments(eqx.Module):
    """The moments that act on one block on one of its corners, and what follows from them."""

    if TYPE_CHECKING:  # which would make them arguments of every subclass, where they are mostly properties

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
        stiffness: eqx.AbstractVar[Scalar]  # how fast the restoring moment falls there; 1 where that is not known
        restoring_at_rest: eqx.AbstractVar[Scalar]  # restoring moment just after uplift, positive
        arm_at_rest: eqx.AbstractVar[Scalar]  # overturning arm just after uplift, positive

    @abc.abstractmethod
    def acceleration(self, angle: Angle, velocity: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """Acceleration of the opening angle per (p t)^2; push = side u, weight = 1 + v (None: 1)."""

    @abc.abstractmethod
    def restoring(self, angle: Angle) -> Scalar:
        """Restoring moment over m g R at an opening angle."""

    @abc.abstractmethod
    def arm(self, angle: Angle) -> Scalar:
        """Overturning moment over m R u g at an opening angle."""

    @abc.abstractmethod
    def repulsion(self, angle: Angle, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """How fast nearby angles part, per angle: the derivative of the acceleration by the angle."""

    @abc.abstractmethod
    def times(self, factor: Scalar | float) -> "AbstractMoments":
        """All accelerations times a factor: of a side whose own frequency parameter is not that of the scene."""

    @abc.abstractmethod
    def held_manifold(self, angle: Angle, hold: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """Outward velocity over p that is enough to reach the unstable equilibrium under a constant forcing.

        `push`: the forcing against it [g]; `weight`: 1 + vertical acceleration (None: 1); `hold`: restoring moment and
        forcing at the angle, positive.
        """

    def unheld_manifold(self, angle: Angle, hold: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar | float:
        """The same where `hold` is not positive: zero, unless something further on may hold it."""
        return 0.0

    def held(self, angle: Angle, velocity: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """The largest acceleration inward under a forcing of this size or less [g]."""
        return -self.acceleration(angle, velocity, push, weight)

    def held_either_way(self, angle: Angle, velocity: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """The same where the arm may be negative."""
        one, other = (-self.acceleration(angle, velocity, way * push, weight) for way in (1, -1))
        return jnp.maximum(one, other)

    def work(self, opening: Scalar) -> Scalar:
        """Work of the weight up to an opening angle, over m g R: half the squared speed on the ground after a free fall
        from there."""
        nodes, weights = (jnp.asarray(values, opening.dtype) for values in _GAUSS)
        return opening * jnp.sum(weights * jax.vmap(lambda x: self.restoring(Angle.of(x)))(opening * nodes))

    @property
    def bends(self) -> int:
        """Return the largest number of opening angles at which a derivative of these moments jumps."""
        return 0

    def ahead(self, opening: Scalar, outward: Bool[Array, ""]) -> tuple["AbstractMoments", Scalar]:
        """Return smooth moments that act from an opening angle on, outward or inward, and the next angle at which they
        bend.

        The moments go on beyond that angle as if they did not bend. The angle is beyond pi/2 where there is none.
        """
        raise NotImplementedError

    def rolled(self, angle: Angle) -> Rolled | None:
        """Where the centre of mass is at an opening angle; None for a block that turns about its corner."""
        return None

    @property
    def threshold(self) -> Scalar:
        """Ground acceleration at which the block uplifts [g]: tan(alpha), or alpha in the linear model."""
        return self.restoring_at_rest / self.arm_at_rest

    def change_at_rest(self, horizontal: Scalar, vertical: Scalar | None) -> Scalar:
        """By how much the acceleration just after uplift changes with that of the ground, at most."""
        change = horizontal * self.arm_at_rest
        return change if vertical is None else change + vertical * self.restoring_at_rest


class AbstractEquation(Owner):
    """An equation of motion of rigid blocks. Models of the package are such, and a model of your own may be.

    A subclass says in `moments` what acts on a block: `Coefficients`, where restoring moment and arm are sums of a
    constant, a line, a sine and a cosine of the opening angle (then the series engine solves it, exact to rounding, and
    in machine code), or the moments of an `Equation` made of functions (then the diffrax engine does, and `is_series`
    is false). Its fields are parameters: what is an array there may be differentiated by, and may differ from lane to
    lane under `jax.vmap`.
    """

    def __check_init__(self):
        check_declared(self)

    @abc.abstractmethod
    def moments(self, block: Block | Side) -> AbstractMoments:
        """The moments that act on a block, or on one side of an asymmetric one.

        **Arguments:**

        - `block`: tells `alpha` [rad] and `p` [rad/s], scalars.

        **Returns:** moments over m g R, in time p t.
        """

    def moments_of_sides(self, block: AsymmetricBlock) -> tuple[AbstractMoments, AbstractMoments]:
        """Those of side 1 and of side 2 of an asymmetric block; each in its own time."""
        first, second = block.sides
        return self.moments(first), self.moments(second)

    @property
    def falls_flat(self) -> bool:
        """Return whether a rotation of pi/2 means that the block lies on its side."""
        return True

    @property
    def is_series(self) -> bool:
        """Return whether its moments are `Coefficients`, so that the series engine can solve it."""
        return True

    @property
    def feels_weight(self) -> bool:
        """Return whether a vertical acceleration changes the restoring moment; if not, vertical motions are refused."""
        return True


def last_rise(moments: AbstractMoments, like: Scalar) -> Scalar:
    """The opening angle from which on up to pi/2 the restoring moment over the arm only falls, by a scan, without
    derivatives: what does not hold a block there will not hold it further on. `like`: a number of the same type."""
    grid = _grid(like)

    def strength(x):
        at = Angle.of(x)
        return moments.restoring(at) / jnp.abs(moments.arm(at))

    found = jax.vmap(strength)(grid)
    return jax.lax.stop_gradient(jnp.max(where(found[1:] > found[:-1], grid[1:], 0.0)))


def _grid(like: Scalar) -> Inexact[Array, " angles"]:
    return jnp.linspace(0.0, jnp.pi / 2, 257, dtype=like.dtype)


def first_zero(moment: Callable, like: Scalar) -> Scalar:
    """Where a moment that rights a block first vanishes, at most pi/2: a scan, bisection, and the derivatives of the
    implicit function. `like`: a number of the same type."""
    grid = _grid(like)
    falls = jax.lax.stop_gradient(jax.vmap(moment)(grid)) <= 0
    first = jnp.argmax(falls)

    def halve(_, bracket):
        low, high = bracket
        middle = (low + high) / 2
        above = jax.lax.stop_gradient(moment(middle)) > 0
        return where(above, middle, low), where(above, high, middle)

    low, _ = jax.lax.fori_loop(0, 60, halve, (grid[jnp.maximum(first - 1, 0)], grid[first]))
    found = jnp.any(falls)

    def left(x):
        value, slope = jax.value_and_grad(moment)(x)
        return value / where(found, slope, 1.0)

    return where(found, carried(jax.lax.stop_gradient(low), left), jnp.pi / 2)
