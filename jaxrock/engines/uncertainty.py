"""How far a computed state may be off: the covariance of its errors, carried along to first order.

Every step adds what it may get wrong; the flow between impacts stretches what is there, as x'' = repulsion x
stretches small differences; an impact mixes it, because an error in height is an error in time (the saltation
matrix). The estimate costs a few per cent of a step, and tells apart a verdict from a toss-up.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Inexact

Scalar = Inexact[Array, ""]

# Standard errors of the angle within which a touch of the ground may be a miss, and a miss a touch.
GRAZING = 32.0


class Spread(eqx.Module):
    """Variances and covariance of the errors of opening angle and velocity (per p t) [rad^2]."""

    xx: Scalar
    xv: Scalar
    vv: Scalar

    @classmethod
    def none(cls, like: Scalar) -> "Spread":
        """No error at all."""
        zero = jnp.zeros_like(like)
        return cls(zero, zero, zero)

    @classmethod
    def where(cls, condition: Bool[Array, ""], one: "Spread", other: "Spread") -> "Spread":
        """`one` where the condition holds, else `other`."""
        return cls(*(jnp.where(condition, a, b) for a, b in zip(one._parts, other._parts)))

    @property
    def _parts(self) -> tuple[Scalar, Scalar, Scalar]:
        return self.xx, self.xv, self.vv

    @property
    def angle(self) -> Scalar:
        """Standard error of the opening angle [rad]."""
        return jnp.sqrt(jnp.maximum(self.xx, 0.0))

    @property
    def size(self) -> Scalar:
        """Standard error of angle and velocity together [rad]."""
        return jnp.sqrt(jnp.maximum(self.xx + self.vv, 0.0))

    def along(self, of_angle: Scalar | float, of_velocity: Scalar | float) -> Scalar:
        """Standard error of a quantity with these derivatives."""
        variance = of_angle**2 * self.xx + 2 * of_angle * of_velocity * self.xv + of_velocity**2 * self.vv
        return jnp.sqrt(jnp.maximum(variance, 0.0))

    def plus(self, angle: Scalar | float, velocity: Scalar | float) -> "Spread":
        """Add independent errors."""
        return Spread(self.xx + angle**2, self.xv, self.vv + velocity**2)

    def _through(self, a: Scalar, b: Scalar | float, c: Scalar, d: Scalar) -> "Spread":
        """M S M' with M = [[a, b], [c, d]]."""
        return Spread(
            a * a * self.xx + 2 * a * b * self.xv + b * b * self.vv,
            a * c * self.xx + (a * d + b * c) * self.xv + b * d * self.vv,
            c * c * self.xx + 2 * c * d * self.xv + d * d * self.vv,
        )

    def after_flow(self, repulsion: Scalar, time: Scalar) -> "Spread":
        """Errors after a time (p t) under x'' = repulsion x; an attraction is taken as none."""
        rate = jnp.sqrt(jnp.maximum(repulsion, 1e-12))
        growth = jnp.exp(jnp.minimum(rate * time, 30.0))
        even, odd = (growth + 1 / growth) / 2, jnp.maximum((growth - 1 / growth) / (2 * rate), time)
        return self._through(even, odd, rate**2 * odd, even)

    def after_impact(self, speed: Scalar, before: Scalar, after: Scalar, ratio: Scalar, slope: Scalar) -> "Spread":
        """Errors after an impact at `speed` < 0, with the opening's accelerations before and after it.

        `ratio`: of the speeds after and before, e; `slope`: of the one by the other, e'. The saltation matrix
        [[e, 0], [-(after + e' before)/speed, e']]. An impact so gentle that it may not happen
        at all is as uncertain as a fall through the error of the angle; one that an outward acceleration may have
        prevented is as uncertain as its own change of velocity.
        """
        kick = -(after + slope * before)
        gentle = jnp.sqrt(jnp.abs(kick) * self.angle)
        bounded = jnp.minimum(jnp.minimum(speed, -gentle), -1e-18)
        missed = speed**2 <= 2 * GRAZING * jnp.maximum(before, 0.0) * self.angle
        spread = self._through(ratio, 0.0, kick / bounded, slope)
        return spread.plus(0.0, jnp.where(missed, (1 + ratio) * jnp.abs(speed), 0.0))
