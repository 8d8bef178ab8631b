"""The equation of motion as a small table of numbers, one row per model.

With the opening angle x = |rotation| (rad), side s = +1 or -1, dimensionless time p t and ground acceleration u (g),
every model of a rigid block reads

    x'' = -[restoring(x) + s u arm(x)],      both restoring and arm a sum  c0 + c1 x + cs sin x + cc cos x.

A coefficient that a model does not have is None: no code is generated for it.
"""

import math
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxrock._core.types import Scalar
from jaxrock.compiler.hints import select
from jaxrock.models import free_swing
from jaxrock.models.equation import AbstractMoments, Angle
from jaxrock.models.terms import UNIT_FUNCTION, Basis, TermGroups, Terms
from jaxrock.numerics.elementary import sine_cosine
from jaxrock.numerics.polynomial import sum_of_products


def _or_zero(coefficient: Scalar | float | None) -> Scalar | float:
    return 0.0 if coefficient is None else coefficient


def _length(sine: Any, cosine: Any) -> Scalar:
    """Return the amplitude of a sine and a cosine together. Moments over m g R neither overflow nor underflow when
    squared."""
    return jnp.abs(sine) if cosine is None else jnp.sqrt(sum_of_products([sine, cosine], [sine, cosine]))


def _weighed(weight: Scalar | None, moment: Scalar) -> Scalar:
    return moment if weight is None else weight * moment


_AT_REST = Basis(constant=UNIT_FUNCTION, cosine=UNIT_FUNCTION)  # sin 0 is zero
_FLAT = Angle(math.pi / 2, 1.0, 0.0)


class Coefficients(AbstractMoments):
    """Restoring moment and overturning arm, both over m g R, as sums of terms (module docstring).

    **Arguments:**

    - `restoring_terms`: a constant and a line; or a sine, with a cosine or a constant or both. For these the balance
      and free swings are known in closed form. The moment is positive at x = 0. Where it becomes positive again between
      the balance and pi/2, only `Diffrax()` solves it.
    - `arm_terms`: any terms; positive at x = 0.

    **Raises:** ValueError for other terms of the restoring moment.
    """

    restoring_terms: Terms
    arm_terms: Terms
    known_saddle: Scalar | None = None  # a known saddle, which many functions use
    arm_lasts: bool = eqx.field(static=True, default=False)  # whether the arm is known to be positive up to pi/2

    def __check_init__(self) -> None:
        moment = self.restoring_terms
        straight = moment.constant is not None and moment.line is not None and not moment.trigonometric
        known = not any(terms.has_half or terms.has_double for terms in (moment, self.arm_terms))
        if not known or (not straight and (moment.sine is None or moment.line is not None)):
            raise ValueError(
                "Argument `restoring_terms` must be a constant and a line, or a sine, a cosine and a constant, but is "
                f"{moment}. Use an `Equation` for any other moment."
            )

    @property
    def has_series(self) -> bool:
        """Return True: sums of these terms have a Taylor recurrence."""
        return True

    @property
    def has_free_swing(self) -> bool:
        """Return True: the energy of these terms is known."""
        return True

    @property
    def groups(self) -> TermGroups:
        """Return the terms by what multiplies them."""
        return TermGroups(self.restoring_terms, self.arm_terms)

    def with_groups(self, groups: TermGroups) -> "Coefficients":
        """Return other moments of this kind, of these terms alone."""
        return Coefficients(groups.restoring, groups.arm, arm_lasts=self.arm_lasts)

    @property
    def bare(self) -> "Coefficients":
        """Return the coefficients without a known saddle."""
        return self if self.known_saddle is None else replace(self, known_saddle=None)

    @property
    def balanced(self) -> "Coefficients":
        """Return the coefficients with the saddle, computed once for all its uses."""
        return replace(self, known_saddle=self.saddle)

    def times(self, factor: Scalar | float) -> "Coefficients":
        """Multiply all accelerations by a factor, for a side whose own frequency parameter is not that of the scene."""
        return replace(jax.tree.map(lambda c: factor * c, self.bare), known_saddle=self.saddle)

    @property
    def trigonometric(self) -> bool:
        """Return whether restoring moment or arm has a term in sin x or cos x."""
        return self.groups.trigonometric

    def restoring(self, angle: Angle) -> Scalar:
        """Return the restoring moment over m g R at an opening angle."""
        return self.restoring_terms.summed(Basis.at(angle))

    def arm(self, angle: Angle) -> Scalar:
        """Return the overturning moment over m R u g at an opening angle."""
        return self.arm_terms.summed(Basis.at(angle))

    def repulsion(self, angle: Angle, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """Return the rate at which nearby angles diverge, per angle: minus the derivative of weight restoring + push
        arm."""
        slopes = Basis.at(angle).derivative
        return -_weighed(weight, self.restoring_terms.summed(slopes)) - push * self.arm_terms.summed(slopes)

    def acceleration(self, angle: Angle, velocity: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """Return the acceleration of the opening angle per (p t)^2; push = side u, weight = 1 + v (None: 1)."""
        return -(_weighed(weight, self.restoring(angle)) + push * self.arm(angle))

    @property
    def restoring_at_rest(self) -> Scalar:
        """Return the restoring moment over m g R just after uplift: sin(alpha), or alpha in the linear model."""
        return self.restoring_terms.summed(_AT_REST)

    @property
    def arm_at_rest(self) -> Scalar:
        """Return the overturning arm over R just after uplift: cos(alpha), or 1 in the linear model."""
        return self.arm_terms.summed(_AT_REST)

    @property
    def sinusoidal(self) -> bool:
        """Return whether the restoring moment is a sinusoid, possibly with a constant (else it is one straight
        line)."""
        return self.restoring_terms.sine is not None

    @property
    def stiffness(self) -> Scalar:
        """Return the rate at which the restoring moment falls at the saddle: k in k sin(saddle - x), or k (saddle -
        x)."""
        moment = self.restoring_terms
        if not self.sinusoidal:
            return jnp.asarray(-_or_zero(moment.line))
        height = self.steepest
        return height if moment.constant is None else jnp.sqrt((height - moment.constant) * (height + moment.constant))

    @property
    def steepest(self) -> Scalar:
        """Return a bound of the rate at which the restoring moment changes with the angle."""
        moment = self.restoring_terms
        return _length(moment.sine, moment.cosine) if self.sinusoidal else jnp.abs(_or_zero(moment.line))

    @property
    def skew(self) -> Scalar | None:
        """Return c in restoring(x) = k [sin(saddle - x) + c (1 - cos(saddle - x))]; None for a moment without that
        part."""
        constant = self.restoring_terms.constant
        return constant / self.stiffness if self.sinusoidal and constant is not None else None

    @property
    def saddle(self) -> Scalar:
        """Return the opening angle of the unstable equilibrium, in which the block balances on its corner [rad]."""
        moment = self.restoring_terms
        if self.known_saddle is not None:
            return self.known_saddle
        if not self.sinusoidal:
            return -_or_zero(moment.constant) / jnp.asarray(moment.line)
        middle = jnp.arctan2(_or_zero(moment.cosine), -_or_zero(moment.sine))
        return middle if moment.constant is None else middle + jnp.arctan2(moment.constant, self.stiffness)

    def manifold(self, x: Scalar) -> Scalar:
        """Return the outward velocity over p that just reaches the saddle without forcing [rad]; negative beyond it."""
        gap = self.saddle - x
        if self.skew is not None:
            return jnp.sqrt(self.stiffness) * free_swing.distance(gap, self.skew)
        # Half the angle avoids cancellation near the saddle.
        distance = 2 * sine_cosine(gap / 2)[0] if self.sinusoidal else gap
        return jnp.sqrt(self.stiffness) * distance

    @property
    def _arm_may_turn(self) -> bool:
        """Return whether an arm of this form may change its sign or grow before pi/2."""
        arm = self.arm_terms
        several = arm.constant is not None and arm.cosine is not None
        return not self.arm_lasts and (arm.line is not None or arm.sine is not None or several)

    @property
    def _may_right_again(self) -> bool:
        """Return whether a restoring moment of this form may rise again before pi/2."""
        return self.restoring_terms.constant is not None and self.restoring_terms.cosine is not None

    def held(self, angle: Angle, velocity: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """Return the largest inward acceleration under a forcing of at most this size [g]."""
        held = self.held_either_way if self._arm_may_turn else super().held
        return held(angle, velocity, push, weight)

    def held_manifold(self, angle: Angle, hold: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """Return an outward velocity over p that reaches the unstable equilibrium under a constant forcing.

        For a spring with a line or a constant it is an upper bound: the holding moment stays below a line from `hold`
        to zero. It is infinite for an arm, or a restoring moment, without a known bound.
        """
        arm = self.arm_terms
        if arm.line is not None:
            return jnp.full_like(hold, jnp.inf)
        if not self._arm_may_turn:
            return self._enough(angle, hold, push, weight)
        # An arm without a line has at most one zero up to pi/2.
        here, flat = self.arm(angle), arm.summed(Basis.at(_FLAT))
        lasts = here * flat > 0
        if arm.constant is not None and arm.cosine is not None:  # concave, so its tangent is above it
            lasts = lasts & (arm.constant >= 0) & (arm.cosine >= 0)
        return select(lasts, self._enough(angle, hold, push * jnp.sign(here), weight), jnp.inf)

    def _enough(self, angle: Angle, hold: Scalar, push: Scalar, weight: Scalar | None) -> Scalar:
        """Compute `held_manifold` for an arm that keeps its sign, which `push` includes."""
        moment, arm, factor = self.restoring_terms, self.arm_terms, 1.0 if weight is None else weight
        if self.sinusoidal and self.skew is None and arm.constant is None:
            sines, cosines = (
                Terms(*pair).summed(Basis(factor, push))
                for pair in ((moment.sine, arm.sine), (moment.cosine, arm.cosine))
            )
            return jnp.sqrt(2 * jnp.maximum(_length(sines, cosines) - self.repulsion(angle, push, weight), 0.0))
        if arm.sine is not None:
            return jnp.full_like(hold, jnp.inf)
        if not self.sinusoidal:  # The sum with a constant or cosine arm is concave: below its tangent.
            slope = self.repulsion(angle, push, weight)
        else:  # convex up to pi/2, so below its chord; the arm, a cosine, is concave
            fall = self.restoring(angle) - self.restoring(_FLAT)
            slope = factor * fall / jnp.maximum(jnp.pi / 2 - angle.value, jnp.finfo(hold.dtype).eps)
            if self._may_right_again:  # concave at first if the constant is negative: below tangent or chord
                slope = jnp.minimum(slope, -factor * moment.summed(Basis.at(angle).derivative))
            slope = slope + push * _or_zero(arm.cosine) * angle.sine
        # Without weight, the forcing alone brings the block back.
        light = jnp.zeros_like(slope, bool) if weight is None else weight <= 0
        if self._may_right_again:  # also where its moment no longer falls at pi/2: it rights itself again
            light = light | (jnp.asarray(moment.cosine) <= 0)
        return select(light, jnp.inf, hold / jnp.sqrt(select(light, 1.0, slope)))

    def unheld_manifold(self, angle: Angle, hold: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar | float:
        """Return zero where no moment further on can hold the block.

        It is infinite, too, where bounds of moment and arm further on do not exclude that they hold it.
        """
        if not self._arm_may_turn and not self._may_right_again:
            return 0.0
        arm, flat = self.arm_terms, self.restoring(_FLAT)
        most = jnp.abs(_or_zero(arm.constant)) + jnp.abs(_or_zero(arm.line)) * jnp.pi / 2
        most = push * (most + _length(_or_zero(arm.sine), arm.cosine))
        # The restoring moment falls, or rises again: it is largest at an end. Beyond pi/2 no moment counts as holding.
        may = (flat > 0) | (_weighed(weight, jnp.maximum(self.restoring(angle), flat)) + most > 0)
        return select(may & (angle.value < jnp.pi / 2), jnp.inf, 0.0)


def of_one_kind(first: AbstractMoments, second: AbstractMoments) -> tuple[AbstractMoments, AbstractMoments]:
    """Return the moments of both sides of a block as pytrees of one structure, between which a program may choose.

    A term that only one side's `Coefficients` have is zero on the other.

    **Raises:** ValueError for moments that have no common form.
    """
    kinds = {jax.tree.structure(moments) for moments in (first, second)}
    if len(kinds) == 1:
        return first, second
    if not isinstance(first, Coefficients) or not isinstance(second, Coefficients):
        said = f"{type(first).__name__} and {type(second).__name__}"
        said = said if type(first) is not type(second) else f"two different programs of {type(first).__name__}"
        raise ValueError(
            f"Argument `model` must have moments of one kind on both sides of a block, but has {said}. One function "
            "that depends on numbers of its own or of its `block` serves both sides."
        )
    if first.sinusoidal != second.sinusoidal:
        raise ValueError(
            "Argument `model` must have restoring moments of one kind on both sides of a block, but has a straight "
            "line on one and a sinusoid on the other: give both as an `Equation`."
        )
    parts = {
        name: [_with_terms_of(*pair) for pair in ((one, other), (other, one))]
        for name in ("restoring_terms", "arm_terms")
        for one, other in [(getattr(first, name), getattr(second, name))]
    }
    lasts = first.arm_lasts and second.arm_lasts
    made = [
        Coefficients(restoring, arm, side.saddle, lasts)
        for restoring, arm, side in zip(*parts.values(), (first, second))
    ]
    return made[0], made[1]


def _with_terms_of(terms: Terms, other: Terms) -> Terms:
    pairs = zip(terms.coefficients, other.coefficients)
    return Terms(*(jnp.zeros_like(b) if a is None and b is not None else a for a, b in pairs))
