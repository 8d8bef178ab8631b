"""Bounds of the forcing still to come, from each piece of a motion on."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Inexact, Int

from jaxrock._core.types import Scalar
from jaxrock.compiler.hints import select
from jaxrock.motions.shaking import Bounds, Envelope
from jaxrock.numerics.lookup import take

_FAR, _NEAR = 256, 16  # pieces that a block at rest may skip at once


class _Ahead(eqx.Module):
    """Bounds of one component from each piece to the end, and over the next pieces [g].

    Scenes that differ by a scale of their motion share the arrays.
    """

    bounds: Bounds
    to_end: Inexact[Array, " knots"]
    near: Inexact[Array, " knots"]
    far: Inexact[Array, " knots"]

    @classmethod
    def of(cls, bounds: Bounds) -> "_Ahead":
        """Compute the bounds of a component, without derivatives."""
        values = jax.lax.stop_gradient(jnp.pad(bounds.values, (0, 1)))
        if values.size <= _NEAR:
            return cls(bounds, _maximum_to_end(values, bounds.left), values, values)
        to_end, near, far = _maxima(values)
        return cls(bounds, to_end if bounds.left is None else _maximum_to_end(values, bounds.left), near, far)

    @property
    def repeated(self) -> "_Ahead":
        """The bounds of a motion that repeats: the largest of all is always to come."""
        return replace(self, to_end=jnp.full_like(self.to_end, jnp.max(self.to_end)))

    def at(self, values: Inexact[Array, " knots"], piece: Int[Array, ""]) -> Scalar:
        """Look up one of these arrays at a piece, times the gain."""
        return self.bounds.times_gain(take(values, piece))


class RemainingForcing(eqx.Module):
    """Bounds of each component of the forcing still to come, and whether it lifts a block that rests while |u| <
    threshold + of_weight v."""

    horizontal: _Ahead
    vertical: _Ahead | None
    threshold: Scalar
    of_weight: Scalar  # the part of the threshold that changes with a vertical acceleration

    @classmethod
    def of(cls, envelope: Envelope, threshold: Scalar, of_weight: Scalar | None = None) -> "RemainingForcing":
        """Build the outlook of a motion; `of_weight`: None where the weight makes all of the threshold."""
        vertical = None if envelope.vertical is None else _Ahead.of(envelope.vertical)
        of_weight = threshold if of_weight is None else of_weight
        return cls(_Ahead.of(envelope.horizontal), vertical, threshold, of_weight)

    @property
    def repeated(self) -> "RemainingForcing":
        """The outlook of a motion that repeats."""
        vertical = None if self.vertical is None else self.vertical.repeated
        return replace(self, horizontal=self.horizontal.repeated, vertical=vertical)

    @property
    def strongest_drive(self) -> Scalar:
        """Return a bound of the drive against the threshold over the whole motion [g], with its derivatives."""
        horizontal = self.horizontal.bounds
        if self.vertical is None:
            return horizontal.strongest
        vertical = self.vertical.bounds
        weight = self.of_weight * vertical.times_gain(vertical.values)
        return jnp.max(horizontal.times_gain(horizontal.values) + weight)

    def _drive(self, piece: Int[Array, ""], which: str) -> Scalar:
        """Return a bound of the drive against the threshold [g]; a block stays at rest while |u| + of_weight |v| <
        threshold."""
        drive = self.horizontal.at(getattr(self.horizontal, which), piece)
        if self.vertical is None:
            return drive
        return drive + self.of_weight * self.vertical.at(getattr(self.vertical, which), piece)

    def is_over(self, piece: Int[Array, ""]) -> Bool[Array, ""]:
        """Return whether no forcing from a piece on lifts a block at rest."""
        return self._drive(piece, "to_end") <= self.threshold

    def after_quiet(self, piece: Int[Array, ""]) -> Int[Array, ""]:
        """Return the first piece from `piece` on that may uplift a block at rest; the search is cheap and may stop
        early."""
        if self.horizontal.near.size <= _NEAR:
            return piece
        far, near = (self._drive(piece, which) < self.threshold for which in ("far", "near"))
        return piece + select(far, _FAR, select(near, _NEAR, 0))

    def most_helpful(self, piece: Int[Array, ""]) -> tuple[Scalar, Scalar | None]:
        """Return the forcing [g] and the weight still to come that most help a block past its saddle."""
        most, vertical = self.horizontal.at(self.horizontal.to_end, piece), self.vertical
        return most, None if vertical is None else 1 - vertical.at(vertical.to_end, piece)


def _maxima(values: Inexact[Array, " n"]) -> tuple[Inexact[Array, " n"], ...]:
    """Return the largest of the values from each position on: to the end, of the next 16, and of the next 256.

    One loop computes all three: XLA takes longer to compile a loop than everything else around a scene.
    """

    def wider(k, maxima):
        (wide, near), reach = maxima, 1 << k
        wide = _wider(wide, reach)
        return wide, select(reach < _NEAR, wide, near)

    size = values.size
    far, near = jax.lax.fori_loop(0, min(size - 1, _FAR - 1).bit_length(), wider, (values, values))
    # To the end: the next 256 values, then the maxima of whole stretches of 256 beyond.
    stretches = jax.lax.cummax(far[::_FAR], reverse=True)  # few, as XLA may take n^2 operations
    beyond = jax.lax.concatenate([stretches[1:], jax.lax.full((1,), 0.0, values.dtype)], 0)
    beyond = jax.lax.broadcast_in_dim(beyond, (beyond.size, _FAR), (0,)).reshape(-1)[:size]
    return jax.lax.max(far, beyond), near, far


def _maximum_to_end(values: Inexact[Array, " n"], left: Int[Array, " m"] | None) -> Inexact[Array, " n"]:
    """Return the largest of the values from each position on, or of the next `left` ones.

    XLA's own cumulative maximum takes n^2 operations on CPUs.
    """
    times, size = (values.size - 1).bit_length(), values.size
    if left is not None:
        room = jnp.pad(left, (0, size - left.size))
        return jax.lax.fori_loop(0, times, lambda k, values: _wider(values, 1 << k, room), values)
    for k in range(times):
        values = jnp.maximum(values, jnp.pad(values[1 << k :], (0, min(1 << k, size))))
    return values


def _wider(
    values: Inexact[Array, " n"], reach: Int[Array, ""], room: Int[Array, " n"] | None = None
) -> Inexact[Array, " n"]:
    """Return the elementwise maximum of each value and the one `reach` positions later.

    Positions past the end, or past the `room` left from a position on, count as zero; no value is negative.
    """
    beyond = jnp.concatenate([values, jnp.zeros_like(values)])
    more = jax.lax.dynamic_slice_in_dim(beyond, reach, values.size, allow_negative_indices=False)  # zeros end it
    return jnp.maximum(values, more if room is None else select(reach < room, more, 0.0))
