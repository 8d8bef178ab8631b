"""The error of a computed state: its covariance, propagated to first order.

Every step adds its own error. The flow between impacts amplifies the accumulated error, as x'' = repulsion x amplifies
small differences. An impact mixes its components, because an error in height is an error in time (the saltation
matrix).

The estimate costs a few per cent of a step, and tells apart a verdict from a toss-up.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxrock._core.types import Scalar
from jaxrock.compiler.hints import select
from jaxrock.numerics.polynomial import horner

# Series of cosh(x) and sinh(x)/x in x^2, without divisions; up to here accurate to 2e-7, enough for an error estimate.
_NEAR = 4.0
_COSH = tuple(1 / math.factorial(2 * k) for k in range(7))
_SINH_RATIO = tuple(1 / math.factorial(2 * k + 1) for k in range(7))

# Standard errors of the angle within which a touch of the ground may be a miss, and a miss a touch.
GRAZING = 32.0


class StateCovariance(eqx.Module):
    """Variances and covariance of the errors of opening angle and velocity (per p t) [rad^2]."""

    xx: Scalar
    xv: Scalar
    vv: Scalar

    @classmethod
    def none(cls, like: Scalar) -> "StateCovariance":
        """Return zero errors."""
        zero = jnp.zeros_like(like)
        return cls(zero, zero, zero)

    @classmethod
    def where(cls, condition: Bool[Array, ""], one: "StateCovariance", other: "StateCovariance") -> "StateCovariance":
        """Select `one` where the condition holds, else `other`."""
        return cls(*(select(condition, a, b) for a, b in zip(one._parts, other._parts)))

    @property
    def _parts(self) -> tuple[Scalar, Scalar, Scalar]:
        return self.xx, self.xv, self.vv

    @property
    def angle(self) -> Scalar:
        """Return the standard error of the opening angle [rad]."""
        return jnp.sqrt(jnp.maximum(self.xx, 0.0))

    @property
    def square(self) -> Scalar:
        """Return the squared standard error of angle and velocity together [rad^2]."""
        return self.xx + self.vv

    def error_of(self, of_angle: Scalar | float, of_velocity: Scalar | float) -> Scalar:
        """Return the standard error of a quantity with these derivatives."""
        return jnp.sqrt(self.variance(of_angle, of_velocity))

    def variance(self, of_angle: Scalar | float, of_velocity: Scalar | float) -> Scalar:
        """Return the variance of a quantity with these derivatives."""
        variance = of_angle**2 * self.xx + 2 * of_angle * of_velocity * self.xv + of_velocity**2 * self.vv
        return jnp.maximum(variance, 0.0)

    def plus(self, angle: Scalar | float, velocity: Scalar | float) -> "StateCovariance":
        """Add independent errors."""
        return self.plus_variance(angle**2, velocity**2)

    def plus_variance(self, angle: Scalar | float, velocity: Scalar | float) -> "StateCovariance":
        """Add the squares of independent errors."""
        return StateCovariance(self.xx + angle, self.xv, self.vv + velocity)

    def _through(self, a: Scalar, b: Scalar | float, c: Scalar, d: Scalar) -> "StateCovariance":
        """Return M S M' with M = [[a, b], [c, d]]."""
        return StateCovariance(
            a * a * self.xx + 2 * a * b * self.xv + b * b * self.vv,
            a * c * self.xx + (a * d + b * c) * self.xv + b * d * self.vv,
            c * c * self.xx + 2 * c * d * self.xv + d * d * self.vv,
        )

    def after_flow(self, repulsion: Scalar, time: Scalar) -> "StateCovariance":
        """Return the errors after a time (p t) under x'' = repulsion x; an attraction counts as zero."""
        pull = jnp.maximum(repulsion, 1e-12)  # positive for arcs of infinite length, too
        square = pull * time**2

        def far():
            root = jnp.sqrt(square)
            growth = jnp.exp(jnp.minimum(root, 30.0))
            return (growth + 1 / growth) / 2, jnp.maximum((growth - 1 / growth) / (2 * root), 1.0)

        even, ratio = (horner([jnp.full_like(square, c) for c in terms], square) for terms in (_COSH, _SINH_RATIO))
        even, ratio = jax.lax.cond(square > _NEAR, far, lambda: (even, ratio))
        odd = ratio * time
        return self._through(even, odd, pull * odd, even)

    def after_impact(
        self, speed: Scalar, before: Scalar, after: Scalar, ratio: Scalar, slope: Scalar
    ) -> "StateCovariance":
        """Return the errors after an impact at `speed` < 0, with the opening's accelerations before and after it.

        `ratio`: e, the speed after the impact over the speed before; `slope`: e', the derivative of the one by the
        other. The saltation matrix is [[e, 0], [-(after + e' before)/speed, e']].

        An impact so gentle that it may not happen is as uncertain as a fall through the error of the angle. An impact
        that an outward acceleration may have prevented is as uncertain as its own change of velocity.
        """
        kick = -(after + slope * before)
        fall = kick**2 * self.xx  # the fourth power of the speed of such a fall
        gentle = ~(speed**4 >= fall)
        fallen = jax.lax.cond(gentle, lambda: jnp.sqrt(jnp.sqrt(jnp.maximum(fall, 0.0))), lambda: jnp.zeros_like(fall))
        bounded = jnp.minimum(jnp.minimum(speed, -fallen), -1e-18)
        missed = (before > 0) & ~(speed**4 > (2 * GRAZING * before) ** 2 * self.xx)
        spread = self._through(ratio, 0.0, kick / bounded, slope)
        return spread.plus(0.0, select(missed, (1 + ratio) * jnp.abs(speed), 0.0))
