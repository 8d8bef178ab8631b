"""The ground's acceleration as a Taylor series, and bounds of it."""

from collections.abc import Callable
from typing import NamedTuple, overload

import jax.numpy as jnp
from jaxtyping import Array, Inexact, Int

from jaxrock._core.types import Scalar
from jaxrock.numerics.polynomial import horner, rescaled, shifted


class Shaking(NamedTuple):
    """Taylor coefficients of the ground's acceleration [g]; `vertical` (upward) is None where there is none."""

    horizontal: list[Scalar]
    vertical: list[Scalar] | None = None

    def each(self, function: Callable) -> "Shaking":
        """Apply a function to the coefficients of each component."""
        return Shaking(function(self.horizontal), None if self.vertical is None else function(self.vertical))

    def at(self, x: Scalar) -> tuple[Scalar, Scalar | None]:
        """Return the horizontal acceleration [g] and the weight over that at rest (None: 1), at x units of time."""
        return horner(self.horizontal, x), None if self.vertical is None else 1 + horner(self.vertical, x)

    @property
    def now(self) -> tuple[Scalar, Scalar | None]:
        """The values of `at` for x = 0."""
        return self.horizontal[0], None if self.vertical is None else 1 + self.vertical[0]

    def rescaled(self, length: Scalar) -> "Shaking":
        """Return the coefficients in time/length."""
        return self.each(lambda terms: rescaled(terms, length))

    def shifted(self, by: Scalar) -> "Shaking":
        """Return the coefficients about a time `by` later."""
        return self.each(lambda terms: shifted(terms, by))

    def steepest(self, within: Scalar | float = 1.0) -> tuple[Scalar, Scalar | None]:
        """Bound the rates of change of the components within this many units of time, per unit."""

        def bound(terms):
            slopes = [k * jnp.abs(c) for k, c in enumerate(terms)][1:]
            return horner(slopes or [jnp.zeros_like(terms[0])], within)

        return bound(self.horizontal), None if self.vertical is None else bound(self.vertical)


class Bounds(NamedTuple):
    """Upper bounds of a component's absolute acceleration within each piece [g], times `gain` where there is one.

    The gain stands apart so that lanes that only scale a motion share the array.

    Where many records follow one another, `left` is the number of pieces from each to the end of its record, and `peak`
    the largest value of the chosen record. None: all pieces belong to one motion.
    """

    values: Inexact[Array, " pieces"]
    gain: Scalar | None = None
    left: Int[Array, " pieces"] | None = None
    peak: Scalar | None = None

    def scaled(self, factor: Scalar) -> "Bounds":
        """Return the bounds of the motion times a factor."""
        factor = jnp.abs(factor)
        return self._replace(gain=factor if self.gain is None else factor * self.gain)

    def times_gain(self, values: Inexact[Array, "..."]) -> Inexact[Array, "..."]:
        """Multiply some of the values, or numbers derived from them, by the gain."""
        return values if self.gain is None else self.gain * values

    @property
    def strongest(self) -> Scalar:
        """The largest bound."""
        return self.times_gain(jnp.max(self.values) if self.peak is None else self.peak)


class Envelope(NamedTuple):
    """Bounds of the horizontal acceleration, and of the vertical one if there is any."""

    horizontal: Bounds
    vertical: Bounds | None

    def each(self, function: Callable) -> "Envelope":
        """Apply a function to the bounds of each component."""
        return Envelope(function(self.horizontal), None if self.vertical is None else function(self.vertical))


@overload
def sum_of_series(first: list[Scalar], second: list[Scalar] | None) -> list[Scalar]: ...
@overload
def sum_of_series(first: list[Scalar] | None, second: list[Scalar] | None) -> list[Scalar] | None: ...
def sum_of_series(first: list[Scalar] | None, second: list[Scalar] | None) -> list[Scalar] | None:
    """Add two lists of coefficients; None is zero."""
    if first is None or second is None:
        return first if second is None else second
    longer, shorter = (first, second) if len(first) > len(second) else (second, first)
    return [a + b for a, b in zip(longer, shorter)] + longer[len(shorter) :]
