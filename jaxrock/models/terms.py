"""Sums of functions of the opening angle: the moments that have a Taylor recurrence.

`Terms` holds the coefficients, `Basis` the functions: 1, x, sin x, cos x, and those of half the angle and of twice the
angle, which restraints need. A coefficient that a model does not have is None: no code is generated for it.
"""

import functools
import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from jaxrock._core.types import Scalar
from jaxrock.models.equation import Angle
from jaxrock.numerics.elementary import sine_cosine
from jaxrock.numerics.polynomial import sum_of_products

UNIT_FUNCTION = 1.0  # the function of a constant term: its product is the coefficient itself


class Basis(NamedTuple):
    """The functions that the coefficients of `Terms` multiply, at an angle, or term k of their series.

    None: zero, or not needed.
    """

    constant: Any = None
    line: Any = None
    sine: Any = None
    cosine: Any = None
    half_sine: Any = None  # sin(x/2)
    half_cosine: Any = None
    double_sine: Any = None  # sin(2 x)
    double_cosine: Any = None

    @classmethod
    def at(cls, angle: Angle, half: bool = False, double: bool = False) -> "Basis":
        """Evaluate the functions at an angle; those of half and of twice the angle where they are needed."""
        found = cls(UNIT_FUNCTION, angle.value, angle.sine, angle.cosine)
        if half:
            sine, cosine = sine_cosine(angle.value / 2)
            found = found._replace(half_sine=sine, half_cosine=cosine)
        if double:
            square = angle.sine * angle.sine
            found = found._replace(double_sine=2 * angle.sine * angle.cosine, double_cosine=1 - 2 * square)
        return found

    def term(self, k: int) -> "Basis":
        """Return term k of series; None where a series is shorter."""
        return Basis(*(None if series is None or k >= len(series) else series[k] for series in self))

    @property
    def derivative(self) -> "Basis":
        """Return the derivatives of these functions by the angle."""

        def times(factor, value):
            return None if value is None else factor * value

        return Basis(
            None,
            self.constant,
            self.cosine,
            None if self.sine is None else -self.sine,
            times(0.5, self.half_cosine),
            times(-0.5, self.half_sine),
            times(2, self.double_cosine),
            times(-2, self.double_sine),
        )


class Terms(eqx.Module):
    """A moment, or an arm, as a sum of functions of the opening angle x; None for an absent term.

    **Arguments:**

    - `constant`, `line`, `sine`, `cosine`: coefficients of 1, x, sin x and cos x [-].
    - `half_sine`, `half_cosine`, `double_sine`, `double_cosine`: coefficients of sin(x/2), cos(x/2), sin(2 x) and
      cos(2 x) [-], of restraints and dampers alone.
    """

    constant: Scalar | float | None = None
    line: Scalar | float | None = None
    sine: Scalar | float | None = None
    cosine: Scalar | float | None = None
    half_sine: Scalar | float | None = None
    half_cosine: Scalar | float | None = None
    double_sine: Scalar | float | None = None
    double_cosine: Scalar | float | None = None

    @property
    def coefficients(self) -> tuple[Scalar | float | None, ...]:
        """Return the coefficients in the order of `Basis`."""
        return tuple(getattr(self, name) for name in Basis._fields)

    @property
    def trigonometric(self) -> bool:
        """Return whether there is a term in a sine or a cosine."""
        return any(c is not None for c in self.coefficients[2:])

    @property
    def has_half(self) -> bool:
        """Return whether there is a term of half the angle."""
        return self.half_sine is not None or self.half_cosine is not None

    @property
    def has_double(self) -> bool:
        """Return whether there is a term of twice the angle."""
        return self.double_sine is not None or self.double_cosine is not None

    def at(self, angle: Angle) -> Scalar:
        """Return the sum at an angle."""
        return jnp.zeros_like(angle.value) + self.summed(Basis.at(angle, self.has_half, self.has_double))

    def slope(self, angle: Angle) -> Scalar:
        """Return the derivative of the sum by the angle."""
        found = self.summed(Basis.at(angle, self.has_half, self.has_double).derivative)
        return jnp.zeros_like(angle.value) + found

    def summed(self, basis: Basis, empty: Any = 0.0) -> Any:
        """Return the sum of coefficients times functions; `empty` where there is no such pair."""
        pairs = [(c, f) for c, f in zip(self.coefficients, basis) if c is not None and f is not None]
        alone, pairs = (
            [c for c, f in pairs if f is UNIT_FUNCTION],
            [pair for pair in pairs if pair[1] is not UNIT_FUNCTION],
        )
        if len(pairs) > 1:
            alone.append(sum_of_products(*map(list, zip(*pairs))))
        elif pairs:
            alone.append(pairs[0][0] * pairs[0][1])
        return functools.reduce(operator.add, alone) if alone else empty

    def products(self, basis: Basis, sign: Scalar | None = None) -> list:
        """Return coefficients times functions, where both exist; `sign` multiplies all of them."""
        pairs = [(c, f) for c, f in zip(self.coefficients, basis) if c is not None and f is not None]
        pairs = pairs if sign is None else [(sign * c, f) for c, f in pairs]
        return [c if f is UNIT_FUNCTION else c * f for c, f in pairs]

    def plus(self, other: "Terms") -> "Terms":
        """Return the sum of both."""
        pairs = zip(self.coefficients, other.coefficients)
        return Terms(*(a if b is None else b if a is None else a + b for a, b in pairs))

    def each(self, function: Callable, *others: Any) -> "Terms":
        """Apply a function to every coefficient that is not None, with its counterparts in `others`."""
        pairs = zip(self.coefficients, *others)
        return Terms(*(None if c is None else function(c, *more) for c, *more in pairs))


class TermGroups(NamedTuple):
    """Sums of terms by what multiplies them; None for an absent group.

    - `restoring`: of the weight, which a vertical acceleration v changes: times 1 + v.
    - `arm`: of the ground acceleration: times side u.
    - `restraint`: of restraints, whose forces do not change with the weight: times 1.
    - `damping`: times the velocity dx/d(p t).
    """

    restoring: Terms
    arm: Terms
    restraint: Terms | None = None
    damping: Terms | None = None

    def _any(self, name: str) -> bool:
        return any(getattr(terms, name) for terms in self if terms is not None)

    @property
    def trigonometric(self) -> bool:
        """Return whether there is a term in a sine or a cosine."""
        return self._any("trigonometric")

    @property
    def has_half(self) -> bool:
        """Return whether there is a term of half the angle."""
        return self._any("has_half")

    @property
    def has_double(self) -> bool:
        """Return whether there is a term of twice the angle."""
        return self._any("has_double")
