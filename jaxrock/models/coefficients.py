"""The equation of motion as a small table of numbers, one row per model.

With the opening angle x = |rotation| (rad), side s = +1 or -1, dimensionless time p t and ground
acceleration u (g), every model of a rigid symmetric block reads

    x'' = -[restoring(x) + s u arm(x)],
    restoring(x) = r0 + r1 x + rs sin x + rc cos x,      arm(x) = m0 + ms sin x + mc cos x.

A coefficient that a model does not have is None, so that nothing is computed for it.
"""

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import ArrayLike, Inexact

from jaxrock.models import free_swing as skewed
from jaxrock.numerics.elementary import sine_cosine

Scalar = Inexact[ArrayLike, ""]


def _sum_of(*products: tuple[Scalar | None, Scalar | float]) -> Scalar | float:
    """Add coefficient times function for the coefficients that exist."""
    return sum((c * f for c, f in products if c is not None), start=0.0)


def _weighed(weight: Scalar | None, moment: Scalar) -> Scalar:
    return moment if weight is None else weight * moment


class Angle(NamedTuple):
    """An angle [rad] with its sine and cosine, which are computed once."""

    value: Scalar
    sine: Scalar
    cosine: Scalar

    @classmethod
    def of(cls, value: Scalar) -> "Angle":
        """An angle from its value, between 0 and pi/2 or a little beyond."""
        return cls(value, *sine_cosine(jnp.asarray(value)))


class Table(eqx.Module):
    """Coefficients of restoring moment and overturning arm, both over m g R (module docstring)."""

    r0: Scalar | None = None
    r1: Scalar | None = None
    rs: Scalar | None = None
    rc: Scalar | None = None
    m0: Scalar | None = None
    ms: Scalar | None = None
    mc: Scalar | None = None
    known_saddle: Scalar | None = None  # where it is known beforehand, because the coefficients change on the way

    @property
    def bare(self) -> "Table":
        """The coefficients alone."""
        return self if self.known_saddle is None else replace(self, known_saddle=None)

    def times(self, factor: Scalar) -> "Table":
        """All accelerations times a factor: of a side whose own frequency parameter is not that of the scene."""
        return replace(jax.tree.map(lambda c: factor * c, self.bare), known_saddle=self.saddle)

    @property
    def trigonometric(self) -> bool:
        """Whether sin x or cos x appear at all."""
        return any(c is not None for c in (self.rs, self.rc, self.ms, self.mc))

    def restoring(self, angle: Angle) -> Scalar:
        """Restoring moment over m g R at an opening angle."""
        return _sum_of((self.r0, 1.0), (self.r1, angle.value), (self.rs, angle.sine), (self.rc, angle.cosine))

    def arm(self, angle: Angle) -> Scalar:
        """Overturning moment over m R u g at an opening angle."""
        return _sum_of((self.m0, 1.0), (self.ms, angle.sine), (self.mc, angle.cosine))

    def repulsion(self, angle: Angle, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """How fast nearby angles part, per angle: minus the derivative of weight restoring + push arm."""
        restoring = _weighed(weight, _sum_of((self.r1, 1.0), (self.rs, angle.cosine), (self.rc, -angle.sine)))
        return -restoring - push * _sum_of((self.ms, angle.cosine), (self.mc, -angle.sine))

    def acceleration(self, angle: Angle, velocity: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """Acceleration of the opening angle per (p t)^2; push = side u, weight = 1 + v (None: 1)."""
        return -(_weighed(weight, self.restoring(angle)) + push * self.arm(angle))

    @property
    def restoring_at_rest(self) -> Scalar:
        """Restoring moment over m g R just after uplift: sin(alpha), or alpha in the linear model."""
        return _sum_of((self.r0, 1.0), (self.rc, 1.0))

    @property
    def arm_at_rest(self) -> Scalar:
        """Overturning arm over R just after uplift: cos(alpha), or 1 in the linear model."""
        return _sum_of((self.m0, 1.0), (self.mc, 1.0))

    @property
    def threshold(self) -> Scalar:
        """Ground acceleration at which the block uplifts [g]: tan(alpha), or alpha in the linear model."""
        return self.restoring_at_rest / self.arm_at_rest

    def change_at_rest(self, horizontal: Scalar, vertical: Scalar | None) -> Scalar:
        """By how much the acceleration just after uplift changes with that of the ground, at most."""
        change = horizontal * self.arm_at_rest
        return change if vertical is None else change + vertical * self.restoring_at_rest

    @property
    def sinusoidal(self) -> bool:
        """Whether the restoring moment is a sinusoid, perhaps with a constant (else it is one straight line)."""
        return self.rs is not None

    @property
    def _wave(self) -> tuple[Scalar, Scalar]:
        """Factors of sin x and cos x, of a restoring moment that is a sinusoid."""
        return self.rs, 0.0 if self.rc is None else self.rc

    @property
    def stiffness(self) -> Scalar:
        """How fast the restoring moment falls at the saddle: k in k sin(saddle - x), or k (saddle - x)."""
        if not self.sinusoidal:
            return -self.r1
        height = jnp.hypot(*self._wave)
        return height if self.r0 is None else jnp.sqrt((height - self.r0) * (height + self.r0))

    @property
    def skew(self) -> Scalar | None:
        """c in restoring(x) = k [sin(saddle - x) + c (1 - cos(saddle - x))]; None where there is no such part."""
        return self.r0 / self.stiffness if self.sinusoidal and self.r0 is not None else None

    @property
    def saddle(self) -> Scalar:
        """Opening angle of the unstable equilibrium: the block balances on its corner [rad]."""
        if self.known_saddle is not None:
            return self.known_saddle
        if not self.sinusoidal:
            return -self.r0 / self.r1
        of_sine, of_cosine = self._wave
        middle = jnp.arctan2(of_cosine, -of_sine)
        return middle if self.r0 is None else middle + jnp.arctan2(self.r0, self.stiffness)

    def manifold(self, x: Scalar) -> Scalar:
        """Outward velocity over p that just reaches the saddle without forcing [rad]; negative beyond it."""
        gap = self.saddle - x
        if self.skew is not None:
            return jnp.sqrt(self.stiffness) * skewed.distance(gap, self.skew)
        # In half the angle: no cancellation near the saddle.
        distance = 2 * sine_cosine(gap / 2)[0] if self.sinusoidal else gap
        return jnp.sqrt(self.stiffness) * distance

    def held_manifold(self, angle: Angle, hold: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """Outward velocity over p that reaches the unstable equilibrium under a constant forcing.

        `push`: the forcing against it [g]; `weight`: 1 + vertical acceleration (None: 1); `hold`: restoring moment and
        forcing at the angle, positive. For a spring with a line or a constant it is more than enough: what holds stays
        below a line from `hold` to zero.
        """
        factor = 1.0 if weight is None else weight
        if self.sinusoidal and self.skew is None:
            across, along = _sum_of((self.rs, factor), (self.ms, push)), _sum_of((self.rc, factor), (self.mc, push))
            return jnp.sqrt(2 * jnp.maximum(jnp.hypot(across, along) - self.repulsion(angle, push, weight), 0.0))
        if not self.sinusoidal:  # its sum with an arm that is a constant, or a cosine, is concave: the tangent
            slope = self.repulsion(angle, push, weight)
        else:  # convex up to pi/2: the chord; the arm, a cosine, is concave
            flat = Angle(jnp.pi / 2, 1.0, 0.0)
            fall = factor * (self.restoring(angle) - self.restoring(flat))
            slope = fall / jnp.maximum(jnp.pi / 2 - angle.value, jnp.finfo(hold.dtype).eps)
            slope = slope + push * self.mc * angle.sine
        # Without weight the forcing alone brings it back.
        light = jnp.zeros_like(slope, bool) if weight is None else weight <= 0
        return jnp.where(light, jnp.inf, hold / jnp.sqrt(jnp.where(light, 1.0, slope)))
