"""The equation of motion as a small table of numbers, one row per model.

With the opening angle x = |rotation| (rad), side s = +1 or -1, dimensionless time p t and ground
acceleration u (g), every model of a rigid symmetric block reads

    x'' = -[restoring(x) + s u arm(x)],
    restoring(x) = r0 + r1 x + rs sin x + rc cos x,      arm(x) = m0 + ms sin x + mc cos x.

A coefficient that a model does not have is None, so that nothing is computed for it.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import ArrayLike, Inexact

from jaxrock import skewed
from jaxrock._checks import checked, one_of
from jaxrock._trigonometry import sine_cosine
from jaxrock.block import Block, Side

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


class Housner(eqx.Module):
    """The rigid rectangular block with its exact nonlinear equation (Housner 1963; D&D 2012, 2.1-2.2)."""

    def table(self, block: Block | Side) -> Table:
        """sin(alpha - x) = sin(alpha) cos x - cos(alpha) sin x; its arm is cos(alpha - x)."""
        sine, cosine = sine_cosine(block.alpha)  # a quotient of XLA's own becomes a tangent, which LLVM may lack
        return Table(rs=-cosine, rc=sine, ms=sine, mc=cosine)

    @property
    def falls_flat(self) -> bool:
        """Whether a rotation of pi/2 means that the block lies on its side."""
        return True


class Linear(eqx.Module):
    """The slender block linearised about its corner (D&D 2012, 3.1-3.2; Voyagaki et al. 2012, 2.3)."""

    def table(self, block: Block | Side) -> Table:
        """Restoring moment alpha - x, arm 1."""
        one = jnp.ones_like(block.alpha)
        return Table(r0=block.alpha, r1=-one, m0=one)

    @property
    def falls_flat(self) -> bool:
        """A linear block has no horizontal: only the point of no return counts."""
        return False


class Spring(eqx.Module):
    """A rigid column on a rotational spring without play: the spring models of a rigid block.

    **Arguments:**

    - `kind`: `"SM1"` (the mass at a distance R above the spring), `"SM2"` (the mass at the pivot, shaken by a moment)
      or `"SM3"` (the mass at the height R cos(alpha) above the spring); all with the block's moment of inertia.
    - `law`: moment of the spring over m g R at the opening angle x: `"sine"`: sin(alpha - x), the block's own;
      `"linear"`: sin(alpha) (1 - x/alpha), a constant negative stiffness; `"plastic"`: sin(alpha), and the weight
      of the leaning column pulls by sin(x) (SM1) or cos(alpha) sin(x) (SM2, SM3).

    All have the overturning arm cos(alpha) cos(x), uplift at tan(alpha), and lie flat at pi/2. So SM1, SM2 and SM3
    differ by the law "plastic" alone. It balances at x = alpha (SM1), or where sin(x) = tan(alpha) (SM2, SM3): there
    alpha must be below pi/4, for a stouter block on this spring never overturns.

    Equation 9 lets the weight lean in SM2 although its mass is at the pivot; it is taken as printed. Codes that shake
    SM2 by a moment, or use linear geometry, have the arm cos(alpha): `Equation` does that.

    Under vertical motion a spring is not a block: its moment does not change with the weight. That raises ValueError.

    The rigid multi-mass model (mmSM) of n lumped masses is "SM1" of a block with p/sqrt(1 + 1/(2 (n - 1)^2)).

    **Raises:** ValueError for other words; at use, for a block of alpha >= pi/4 where that is not allowed.

    **Source:** Diamantopoulos & Fragiadakis (2017), equations 4-6 (SM1), 7-9 (SM2), 10-12 (SM3), 13-15 (mmSM).
    """

    kind: str = eqx.field(static=True)
    law: str = eqx.field(static=True)

    def __init__(self, kind: str = "SM1", law: str = "linear"):
        self.kind = one_of("kind", kind, ("SM1", "SM2", "SM3"))
        self.law = one_of("law", law, ("sine", "linear", "plastic"))

    def table(self, block: Block | Side) -> Table:
        """Moment of the spring and of the weight, as far as they are kept apart; arm cos(alpha) cos(x)."""
        alpha = block.alpha
        if self.law == "plastic" and self.kind != "SM1":
            message = f"be below pi/4 in Spring({self.kind!r}, law='plastic'), which never overturns above"
            alpha = checked("block.alpha", alpha, message, lambda angle: angle < jnp.pi / 4)
        sine, cosine = sine_cosine(alpha)
        if self.law == "sine":
            return Table(rs=-cosine, rc=sine, mc=cosine)  # D&F 2017, 4, 7, 10
        if self.law == "linear":
            return Table(r0=sine, r1=-sine / alpha, mc=cosine)  # D&F 2017, 5, 8, 11
        weight = jnp.ones_like(alpha) if self.kind == "SM1" else cosine
        return Table(r0=sine, rs=-weight, mc=cosine)  # D&F 2017, 6; 9, 12

    @property
    def falls_flat(self) -> bool:
        """Whether a rotation of pi/2 means that the column lies on the ground."""
        return True


class Equation(eqx.Module):
    """A model of your own, written as functions; the diffrax engine solves it.

    With the opening angle x = |rotation| [rad], velocity v = dx/d(p t), side s and ground acceleration u [g]:

        d^2x/d(p t)^2 = -[restoring(x, block) + s u arm(x, block) + dissipation(x, v, block)]

    **Arguments:**

    - `restoring`: restoring moment over m g R; positive at x = 0. Its first zero is the unstable equilibrium.
    - `arm`: overturning arm over R; positive at x = 0. None: 1.
    - `dissipation`: moment over m g R against the motion, zero at rest. None: none.
    - `acceleration`: instead of the three, the whole right-hand side: acceleration(x, v, s u, block), linear in s u.
    - `falls_flat`: whether a rotation of pi/2 means that the block lies on its side.

    A vertical acceleration v [g] multiplies the restoring moment by 1 + v.

    The functions must be smooth, work on JAX arrays, and be defined somewhat beyond 0 and pi/2. Functions that are
    Equinox modules may carry parameters to differentiate. A block that has stopped below its unstable equilibrium
    after the motion counts as safe: what dissipates does not lift.

    **Raises:** ValueError where neither or both ways are used.
    """

    _acceleration: "_Function"
    falls_flat: bool = eqx.field(static=True)

    def __init__(
        self,
        restoring: Callable | None = None,
        arm: Callable | None = None,
        dissipation: Callable | None = None,
        *,
        acceleration: Callable | None = None,
        falls_flat: bool = True,
    ):
        if (restoring is None) == (acceleration is None) or (acceleration is not None and (arm or dissipation)):
            raise ValueError("Give either `restoring` (with `arm` and `dissipation`) or `acceleration`.")
        parts = (restoring, arm, dissipation) if acceleration is None else (acceleration,)
        self._acceleration = _Function(parts)
        self.falls_flat = falls_flat

    def table(self, block: Block | Side) -> "EquationTable":
        """What the engine asks of the equation, for one block."""
        return EquationTable(self._acceleration, block)


class _Function(eqx.Module):
    """Functions, as leaves where they are modules (with parameters) and static where they are plain."""

    modules: tuple
    plain: tuple = eqx.field(static=True)

    def __init__(self, parts: tuple):
        self.modules = tuple(f if isinstance(f, eqx.Module) else None for f in parts)
        self.plain = tuple(None if isinstance(f, eqx.Module) else f for f in parts)

    def __call__(self, x: Scalar, v: Scalar, push: Scalar, block: Block | Side) -> Scalar:
        parts = [m if m is not None else f for m, f in zip(self.modules, self.plain)]
        if len(parts) == 1:
            return parts[0](x, v, push, block)
        restoring, arm, dissipation = parts
        moment = restoring(x, block) + push * (1.0 if arm is None else arm(x, block))
        return -moment if dissipation is None else -moment - dissipation(x, v, block)


class EquationTable(eqx.Module):
    """What a `Table` tells, for a model that is given as functions."""

    function: _Function
    block: Block | Side
    factor: Scalar | None  # of all accelerations (see `Table.times`)
    restoring_at_rest: Scalar
    arm_at_rest: Scalar
    saddle: Scalar  # first zero of the restoring moment, at most pi/2

    def __init__(self, function: _Function, block: Block | Side, factor: Scalar | None = None):
        self.function, self.block, self.factor = function, block, factor
        zero = Angle.of(jnp.zeros_like(block.alpha))
        self.restoring_at_rest = eqx.error_if(
            self.restoring(zero), self.restoring(zero) <= 0, "The restoring moment must be positive at rotation 0."
        )
        self.arm_at_rest = eqx.error_if(
            self.arm(zero), self.arm(zero) <= 0, "The overturning arm must be positive at rotation 0."
        )
        self.saddle = self._first_zero()

    def acceleration(self, angle: Angle, velocity: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """Acceleration of the opening angle per (p t)^2; push = side u, weight = 1 + v (None: 1)."""
        value = self._value(angle, velocity, push)
        return value if weight is None else value - (weight - 1) * self.restoring(angle)

    def _value(self, angle: Angle, velocity: Scalar, push: Scalar) -> Scalar:
        value = jnp.asarray(self.function(angle.value, velocity, push, self.block), self.block.alpha.dtype)
        return value if self.factor is None else self.factor * value

    def times(self, factor: Scalar) -> "EquationTable":
        """As in `Table`."""
        return EquationTable(self.function, self.block, factor)

    def restoring(self, angle: Angle) -> Scalar:
        """Restoring moment over m g R at an opening angle."""
        zero = jnp.zeros_like(angle.value)
        return -self._value(angle, zero, zero)

    def arm(self, angle: Angle) -> Scalar:
        """Overturning moment over m R u g at an opening angle."""
        zero = jnp.zeros_like(angle.value)
        return self._value(angle, zero, zero) - self._value(angle, zero, zero + 1)

    def repulsion(self, angle: Angle, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """How fast nearby angles part, per angle."""
        zero = jnp.zeros_like(angle.value)
        return jax.grad(lambda x: self.acceleration(Angle.of(x), zero, push, weight))(angle.value)

    @property
    def stiffness(self) -> Scalar:
        """One, or the factor: nothing else is known of the shape of the function."""
        return jnp.ones_like(self.saddle) if self.factor is None else self.factor

    @property
    def threshold(self) -> Scalar:
        """Ground acceleration at which the block uplifts [g]."""
        return self.restoring_at_rest / self.arm_at_rest

    def change_at_rest(self, horizontal: Scalar, vertical: Scalar | None) -> Scalar:
        """As in `Table`."""
        return Table.change_at_rest(self, horizontal, vertical)

    def held_manifold(self, angle: Angle, hold: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """As in `Table`; infinite, because nothing is known of the function beyond this angle."""
        return jnp.full_like(hold, jnp.inf)

    def _first_zero(self) -> Scalar:
        """Where the block balances: a scan, bisection, and a Newton step that carries the derivatives."""

        def moment(x):
            return self.restoring(Angle.of(x))

        grid = jnp.linspace(0.0, jnp.pi / 2, 257, dtype=self.block.alpha.dtype)
        falls = jax.lax.stop_gradient(jax.vmap(moment)(grid)) <= 0
        first = jnp.argmax(falls)

        def halve(_, bracket):
            low, high = bracket
            middle = (low + high) / 2
            above = jax.lax.stop_gradient(moment(middle)) > 0
            return jnp.where(above, middle, low), jnp.where(above, high, middle)

        low, _ = jax.lax.fori_loop(0, 60, halve, (grid[jnp.maximum(first - 1, 0)], grid[first]))
        low = jax.lax.stop_gradient(low)
        root = low - moment(low) / jax.lax.stop_gradient(jax.grad(moment)(low))
        return jnp.where(jnp.any(falls), root, jnp.pi / 2)


Model = Housner | Linear | Spring | Equation
