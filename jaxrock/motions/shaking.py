"""What motions tell of the ground: its acceleration as a series, and bounds of it."""

from collections.abc import Callable
from typing import NamedTuple, overload

import jax.numpy as jnp
from jaxtyping import Array, Inexact, Int

from jaxrock.numerics.polynomial import horner, rescaled, shifted

Scalar = Inexact[Array, ""]


class Shaking(NamedTuple):
    """Taylor coefficients of the ground's acceleration [g]; `vertical` (upward) is None where there is none."""

    horizontal: list[Scalar]
    vertical: list[Scalar] | None = None

    def each(self, function: Callable) -> "Shaking":
        """The same with the coefficients that a function makes of those of each component."""
        return Shaking(function(self.horizontal), None if self.vertical is None else function(self.vertical))

    def at(self, x: Scalar) -> tuple[Scalar, Scalar | None]:
        """Horizontal acceleration [g], and the weight of a mass over that at rest (None: 1), at x units of time."""
        return horner(self.horizontal, x), None if self.vertical is None else 1 + horner(self.vertical, x)

    @property
    def now(self) -> tuple[Scalar, Scalar | None]:
        """As `at` no time at all."""
        return self.horizontal[0], None if self.vertical is None else 1 + self.vertical[0]

    def rescaled(self, length: Scalar) -> "Shaking":
        """Coefficients in time/length."""
        return self.each(lambda terms: rescaled(terms, length))

    def shifted(self, by: Scalar) -> "Shaking":
        """Coefficients about a time `by` later."""
        return self.each(lambda terms: shifted(terms, by))

    def steepest(self, within: Scalar | float = 1.0) -> tuple[Scalar, Scalar | None]:
        """Bounds of how fast the components change in so many units of time, per unit."""

        def bound(terms):
            slopes = [k * jnp.abs(c) for k, c in enumerate(terms)][1:]
            return horner(slopes or [jnp.zeros_like(terms[0])], within)

        return bound(self.horizontal), None if self.vertical is None else bound(self.vertical)


class Bounds(NamedTuple):
    """Upper bounds of a component's absolute acceleration within each piece [g], times `gain` where there is one: what
    only scales a motion leaves the array to all scales alike.

    Of a motion in which many follow one another: `left`, how many pieces there are from each on to the end of its own,
    and `peak`, the largest value among those of one; None: all pieces belong together.
    """

    values: Inexact[Array, " pieces"]
    gain: Scalar | None = None
    left: Int[Array, " pieces"] | None = None
    peak: Scalar | None = None

    def scaled(self, factor: Scalar) -> "Bounds":
        """Those of a motion that is so many times as strong."""
        factor = jnp.abs(factor)
        return self._replace(gain=factor if self.gain is None else factor * self.gain)

    def times_gain(self, values: Inexact[Array, "..."]) -> Inexact[Array, "..."]:
        """Some of the values, or what was made of them, as bounds."""
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
        """The same with the bounds that a function makes of those of each component."""
        return Envelope(function(self.horizontal), None if self.vertical is None else function(self.vertical))


@overload
def sum_of_series(first: list[Scalar], second: list[Scalar] | None) -> list[Scalar]: ...
@overload
def sum_of_series(first: list[Scalar] | None, second: list[Scalar] | None) -> list[Scalar] | None: ...
def sum_of_series(first: list[Scalar] | None, second: list[Scalar] | None) -> list[Scalar] | None:
    """Coefficients of a sum; None is zero."""
    if first is None or second is None:
        return first if second is None else second
    longer, shorter = (first, second) if len(first) > len(second) else (second, first)
    return [a + b for a, b in zip(longer, shorter)] + longer[len(shorter) :]
