"""Laws of restitution: how an impact slows a block.

A law gives the ratio of the angular velocity after an impact to that before it. All effects of an impact follow from
the ratio: the rebound, its derivatives, the remaining energy, and the growth of errors. A new law is therefore one
class, here or in a file of yours:

    class Brittle(rk.restitution.AbstractRestitution):
        firm: jax.Array
        speed: jax.Array  # [rad/s]

        def ratio(self, corners, speed):
            return self.firm / (1 + speed / self.speed)

    block = rk.Block(0.2, 2.0, restitution=Brittle(0.95, 1.0))
"""

import abc
import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from jaxrock._arguments.parameters import Owner, check_declared, is_ours, parameter, set_parameters
from jaxrock._arguments.ranges import Range, checked, not_negative, share, size, with_throw
from jaxrock._arguments.repr import described
from jaxrock._core.arrays import check_shapes, if_traced, is_traced
from jaxrock._core.types import Real
from jaxrock.compiler import trace_function
from jaxrock.compiler.hints import select
from jaxrock.numerics.elementary import sine_cosine

__all__ = ["AbstractRestitution", "AngularMomentum", "Constant", "Corners", "Housner", "PerSide", "SpeedDependent"]


def __dir__() -> list[str]:
    return __all__


# m R^2/I about a corner
ratio_of_inertia = Range("be in (0, 1], and not below 1e-6", 0.0, 1.0, lambda x: (x >= 1e-6) & (x <= 1))


class Corners(NamedTuple):
    """The parameters of a block at an impact, for a law: of the corner that it leaves, and of the one that it comes to.

    - `alpha`, `next_alpha`: slenderness angles at the one and at the other [rad].
    - `p`: frequency parameter about the corner that it leaves [rad/s].
    - `inertia_ratio`: m R^2/I about the corner that it comes to [-]; 3/4 for a rectangle.
    - `radius_ratio`: distance of the centre of mass from the corner that it leaves, over that from the other [-].
    - `side`: 1 or -1, the side on which the impact ends a stay. For a law that depends on the speed it may be traced:
      `jnp.where(corners.side < 0, ...)`.
    """

    alpha: Real
    next_alpha: Real
    p: Real
    inertia_ratio: Real | float = 0.75
    radius_ratio: Real | float = 1.0
    side: int = 1


class AbstractRestitution(Owner):
    """A law of restitution. Its fields are parameters: derivatives by them exist."""

    __repr__ = described

    def __check_init__(self):
        check_declared(self)
        if is_ours(self) or self.depends_on_speed or is_traced(self):
            return
        slow, fast = (self.ratio(Corners(*jnp.array([0.2, 0.2, 1.0])), jnp.asarray(speed)) for speed in (0.1, 0.7))
        if not is_traced((slow, fast)) and np.any(np.asarray(slow) != np.asarray(fast)):
            raise ValueError(
                f"The ratio of a {type(self).__name__} depends on the speed of the impact, so its property "
                "`depends_on_speed` must be True."
            )

    @abc.abstractmethod
    def ratio(self, corners: Corners, speed: Real) -> Real:
        """Return the angular velocity after an impact over that before it.

        **Arguments:**

        - `corners`: the `Corners` of the impact.
        - `speed`: |angular velocity| just before it [rad/s], 0 or more.

        **Returns:** the ratio, smooth in the speed, in [0, 1]: a response with any other has the status `not_finite`.
        For an asymmetric block, a ratio that does not depend on the speed may exceed 1.
        """

    @property
    def depends_on_speed(self) -> bool:
        """Return whether the ratio depends on the speed of the impact; if not, it is computed once for a scene."""
        return True

    @property
    def mirrored(self) -> "AbstractRestitution":
        """The law for the block seen from behind, its sides exchanged; a law that tells sides apart overrides it."""
        return self

    def most(self, corners: Corners, speed: Real) -> Real:
        """Return an upper bound of the ratio of all impacts up to a speed; the default is right for a monotonic law."""
        return jnp.maximum(self.ratio(corners, jnp.zeros_like(speed)), self.ratio(corners, speed))


class Constant(AbstractRestitution):
    """A constant ratio, at every impact.

    **Arguments:**

    - `value`: the ratio, in [0, 1].

    **Raises:** ValueError for a value outside its range.
    """

    value: Real = parameter("-", share, symbol="e", argument="restitution")

    @with_throw
    def __init__(self, value: ArrayLike, *, throw: bool = True):
        set_parameters(self, value=value)

    def ratio(self, corners: Corners, speed: Real) -> Real:
        """Return the value."""
        return self.value

    @property
    def depends_on_speed(self) -> bool:
        """False: the ratio is constant."""
        return False


class Housner(AbstractRestitution):
    """The impact of a rectangle that keeps its angular momentum about the new corner: 1 - 1.5 sin^2(alpha).

    **Arguments:**

    - `inertia_ratio`: m R^2/I about a corner, in (0, 1], of a symmetric block that is no homogeneous rectangle:
      1 - 2 inertia_ratio sin^2(alpha). None: 3/4, a rectangle's.

    **Raises:** ValueError for a value outside its range; with a block so wide that it is negative, for the block.

    **Source:** Housner (1963); Dimitrakopoulos & DeJong (2012), equation 2.4.
    """

    inertia_ratio: Real | None = parameter("-", ratio_of_inertia)

    @with_throw
    def __init__(self, inertia_ratio: ArrayLike | None = None, *, throw: bool = True):
        self.inertia_ratio = None if inertia_ratio is None else ratio_of_inertia("inertia_ratio", inertia_ratio)

    def ratio(self, corners: Corners, speed: Real) -> Real:
        """Return the ratio, which follows alpha, also under differentiation."""
        return jnp.maximum(1 - self._loss * jnp.sin(corners.alpha) ** 2, 0)  # Housner 1963; D&D 2012, 2.4

    @property
    def _loss(self) -> Real | float:
        return 1.5 if self.inertia_ratio is None else 2 * self.inertia_ratio

    @property
    def depends_on_speed(self) -> bool:
        """False: the ratio follows from the shape."""
        return False


class AngularMomentum(AbstractRestitution):
    """The impact of any block that keeps its angular momentum about the new corner, at least 0.

    From corner s to corner t: 1 - kappa_t [1 - (R_s/R_t) cos(alpha_s + alpha_t)], kappa_t = m R_t^2/I_t. This is
    Housner's ratio for a rectangle; a `Block` counts as one.
    """

    def ratio(self, corners: Corners, speed: Real) -> Real:
        """Return the ratio, which follows the block's shape."""
        (sine, cosine), (next_sine, next_cosine) = sine_cosine(corners.alpha), sine_cosine(corners.next_alpha)
        of_sum = cosine * next_cosine - sine * next_sine  # cos(alpha_s + alpha_t)
        return jnp.maximum(1 - corners.inertia_ratio * (1 - corners.radius_ratio * of_sum), 0)

    @property
    def depends_on_speed(self) -> bool:
        """False: the ratio follows from the shape."""
        return False


class PerSide(AbstractRestitution):
    """A separate ratio for the impacts that end the stays on either side of a block.

    **Arguments:**

    - `first`, `second`: the ratio at the end of a stay on side 1 (rotation > 0), and on side 2, 0 or more.

    **Raises:** ValueError where their product exceeds 1: it is the part of its speed that a block keeps over two
    impacts. (One of them may exceed 1: about corners of unequal height it often does. On a symmetric block neither
    may.)
    """

    first: Real = parameter("-", not_negative, symbol="e1", argument="restitution")
    second: Real = parameter("-", not_negative, symbol="e2", argument="restitution")

    @with_throw
    def __init__(self, first: ArrayLike, second: ArrayLike, *, throw: bool = True):
        self.first, self.second = (not_negative(f"restitution[{i}]", e) for i, e in enumerate((first, second)))
        check_shapes(**{"restitution[0]": self.first, "restitution[1]": self.second})
        keeps = "be a pair whose product, the speed kept by two impacts, is at most 1"
        product = self.first * self.second
        rounding = max(1e-12, 4 * float(jnp.finfo(product.dtype).eps))
        product = checked("restitution", product, keeps, lambda x: x <= 1 + rounding)
        self.first = select(jnp.isnan(product), product, self.first)

    def ratio(self, corners: Corners, speed: Real) -> Real:
        """Return the ratio of the side."""
        return self.second if corners.side < 0 else self.first

    @property
    def mirrored(self) -> "PerSide":
        """The law with the ratios exchanged."""
        return PerSide(self.second, self.first)

    @property
    def depends_on_speed(self) -> bool:
        """False: the ratio depends on the side alone."""
        return False


class SpeedDependent(AbstractRestitution):
    """A ratio that changes from gentle to violent impacts: violent + (gentle - violent) e^(-speed/scale).

    **Arguments:**

    - `gentle`, `violent`: the ratio of impacts much slower, and much faster, than `scale`, in [0, 1].
    - `scale`: angular velocity at which it changes [rad/s], positive.

    **Raises:** ValueError for a value outside its range.

    A form to fit to measurements, not a law of materials: contacts that yield keep less of a violent impact.
    """

    gentle: Real = parameter("-", share)
    violent: Real = parameter("-", share)
    scale: Real = parameter("rad/s", size)

    @with_throw
    def __init__(self, gentle: ArrayLike, violent: ArrayLike, scale: ArrayLike, *, throw: bool = True):
        set_parameters(self, gentle=gentle, violent=violent, scale=scale)

    def ratio(self, corners: Corners, speed: Real) -> Real:
        """Return a ratio between `gentle` and `violent`."""
        return self.violent + (self.gentle - self.violent) * jnp.exp(-speed / self.scale)


Restitution = ArrayLike | AbstractRestitution
_ALIKE = (Constant, Housner, AngularMomentum, SpeedDependent)  # laws that ignore the side


def on_sides(law: AbstractRestitution, corners: Corners) -> tuple[Corners, Corners]:
    """Return a symmetric block's `Corners` for side 1 and side 2; the same object where the law ignores the side."""
    return (corners, corners._replace(side=-1)) if tells_sides(law, corners) else (corners, corners)


def tells_sides(law: AbstractRestitution, corners: Corners) -> bool:
    """Return whether the ratio depends on the side: whether its jaxprs on the two sides differ."""
    if type(law) in _ALIKE:
        return False
    arrays, others = eqx.partition((law, corners), eqx.is_array)

    def ratio(side: int, arrays):
        law, corners = eqx.combine(arrays, others)
        return law.ratio(corners._replace(side=side), jnp.zeros_like(corners.p))

    traced: list[Any] = [trace_function(functools.partial(ratio, side), arrays) for side in (1, -1)]
    one, other = traced
    if one.program != other.program:
        return True
    pairs = zip(one.captured, other.captured, strict=True)
    return any(a is not b and (is_traced((a, b)) or not np.array_equal(a, b)) for a, b in pairs)


def law_of(
    restitution: Restitution | None, otherwise: AbstractRestitution, symmetric: bool = False
) -> AbstractRestitution:
    """Return the law for an argument `restitution`: itself, a constant one for a number, or, for None, `otherwise`."""
    if restitution is None:
        return otherwise
    if symmetric and isinstance(restitution, PerSide):  # corners of one height: no impact gains speed
        both = share("restitution[0]", restitution.first), share("restitution[1]", restitution.second)
        return eqx.tree_at(lambda law: (law.first, law.second), restitution, both)
    return restitution if isinstance(restitution, AbstractRestitution) else Constant(restitution)


def fitting_alpha(law: AbstractRestitution, alpha: Real) -> Real:
    """Return the slenderness angle, after a check that the law is valid for it."""
    if not isinstance(law, Housner):
        return alpha
    if law.inertia_ratio is None:
        widest = np.arcsin(np.sqrt(2 / 3)) * (1 + 1e-6)
        reason = "Housner's value is negative above"
        allowed = f"be at most 0.955, of a width of 1.41 heights, when `restitution` is None or Housner's: {reason}"
        return checked("alpha", alpha, allowed, lambda x: x <= widest)
    allowed = "be so small that Housner's restitution 1 - 2 inertia_ratio sin^2(alpha) is not negative"
    return checked("alpha", alpha, allowed, lambda x: law._loss * jnp.sin(x) ** 2 <= 1 + 1e-6)


def fitting_width(law: AbstractRestitution, width: Real, height: Real) -> Real:
    """Return the width of a rectangle, after a check that the law is valid for it."""
    if not isinstance(law, Housner):
        return width
    reason = "Housner's value is negative above"
    allowed = f"be at most 1.41 times the height when `restitution` is None or Housner's: {reason}"
    if law.inertia_ratio is not None:
        allowed = "be so small that Housner's restitution 1 - 2 inertia_ratio sin^2(alpha) is not negative"
    return checked("width", width, allowed, lambda x: fits(law, x, height))


def fits(law: AbstractRestitution, width: ArrayLike, height: Real) -> ArrayLike:
    """Return whether the law is valid for rectangles of this width."""
    if not isinstance(law, Housner):
        return True
    width, height, loss = map(if_traced, (width, height, law._loss))
    return loss * width**2 <= (1 + 1e-6) * (width**2 + height**2)


class Reset(eqx.Module):
    """A law bound to the impacts that end a block's stays on one corner; speeds are per p t, as in the engines.

    A law that does not depend on the speed is reduced to its number.
    """

    law: AbstractRestitution
    corners: Corners | None
    p: Real | None  # unit of the speeds [rad/s]

    @classmethod
    def of(cls, law: AbstractRestitution, corners: Corners, p: Real, most: float = np.inf) -> "Reset":
        """Bind a law to a corner; a ratio that does not depend on the speed is NaN above `most`."""
        if law.depends_on_speed:
            return cls(law, corners, p)
        ratio = law.ratio(corners, jnp.zeros_like(p))
        # Checked for the package's own laws, too: an optimiser's step may leave the range that the constructor checked.
        ratio = select((ratio >= 0) & (ratio <= most), ratio, jnp.nan)
        # Set without the check of `Constant`: with corners of unequal height the ratio at one may exceed 1.
        return cls(eqx.tree_at(lambda c: c.value, Constant(0.0), ratio), None, None)

    @property
    def _number(self) -> Real:
        assert isinstance(self.law, Constant)
        return self.law.value

    @property
    def depends_on_speed(self) -> bool:
        """True if the ratio depends on the speed of the impact."""
        return self.law.depends_on_speed

    def ratio(self, speed: Real) -> Real:
        """Return the speed after an impact over that before it; NaN where a law gives a ratio outside [0, 1]."""
        if self.corners is None or self.p is None:
            return self._number
        ratio = self.law.ratio(self.corners, speed * self.p)
        return select((ratio >= 0) & (ratio <= 1), ratio, jnp.nan)

    def slope(self, speed: Real) -> Real:
        """Return the derivative of the speed after an impact by that before it."""
        if not self.depends_on_speed:
            return self._number
        return jax.jvp(lambda v: v * self.ratio(v), (speed,), (jnp.ones_like(speed),))[1]

    def most(self, speed: Real) -> Real:
        """Return an upper bound of the ratio of all impacts up to a speed."""
        if self.corners is None or self.p is None:
            return self._number
        return self.law.most(self.corners, speed * self.p)
