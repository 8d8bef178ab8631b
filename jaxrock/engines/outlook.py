"""What the ground may still do: bounds of all that is to come, from each piece of a motion on."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Inexact, Int

from jaxrock.motions.shaking import Bounds, Envelope
from jaxrock.numerics.choice import where
from jaxrock.numerics.lookup import pick

Scalar = Inexact[Array, ""]
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
        """Of a component; no derivatives."""
        values = jax.lax.stop_gradient(jnp.pad(bounds.values, (0, 1)))
        if values.size <= _NEAR:
            return cls(bounds, _maximum_to_end(values, bounds.left), values, values)
        to_end, near, far = _maxima(values)
        return cls(bounds, to_end if bounds.left is None else _maximum_to_end(values, bounds.left), near, far)

    def at(self, values: Inexact[Array, " knots"], piece: Int[Array, ""]) -> Scalar:
        """One of these bounds."""
        return self.bounds.times_gain(pick(values, piece))


class Outlook(eqx.Module):
    """What each component of the ground may still do, and whether that lifts a block that rests while
    |u| < threshold (1 + v)."""

    horizontal: _Ahead
    vertical: _Ahead | None
    threshold: Scalar

    @classmethod
    def of(cls, envelope: Envelope, threshold: Scalar) -> "Outlook":
        """The outlook at the start."""
        vertical = None if envelope.vertical is None else _Ahead.of(envelope.vertical)
        return cls(_Ahead.of(envelope.horizontal), vertical, threshold)

    @property
    def strongest_drive(self) -> Scalar:
        """Bound of what ever acts against the threshold [g], with its derivatives."""
        horizontal = self.horizontal.bounds
        if self.vertical is None:
            return horizontal.strongest
        vertical = self.vertical.bounds
        weight = self.threshold * vertical.times_gain(vertical.values)
        return jnp.max(horizontal.times_gain(horizontal.values) + weight)

    def _drive(self, piece: Int[Array, ""], which: str) -> Scalar:
        """Bound of what acts against the threshold [g]; for what is at rest while |u| + threshold |v| < threshold."""
        drive = self.horizontal.at(getattr(self.horizontal, which), piece)
        if self.vertical is None:
            return drive
        return drive + self.threshold * self.vertical.at(getattr(self.vertical, which), piece)

    def is_over(self, piece: Int[Array, ""]) -> Bool[Array, ""]:
        """Whether nothing from a piece on lifts a block at rest."""
        return self._drive(piece, "to_end") <= self.threshold

    def after_quiet(self, piece: Int[Array, ""]) -> Int[Array, ""]:
        """First piece from `piece` on that may uplift a block at rest; cheap, so it may stop early."""
        if self.horizontal.near.size <= _NEAR:
            return piece
        far, near = (self._drive(piece, which) < self.threshold for which in ("far", "near"))
        return piece + where(far, _FAR, where(near, _NEAR, 0))

    def most_helpful(self, piece: Int[Array, ""]) -> tuple[Scalar, Scalar | None]:
        """The forcing [g] and weight still to come that do most for a block past its saddle."""
        most, vertical = self.horizontal.at(self.horizontal.to_end, piece), self.vertical
        return most, None if vertical is None else 1 - vertical.at(vertical.to_end, piece)


def _maxima(values: Inexact[Array, " n"]) -> tuple[Inexact[Array, " n"], ...]:
    """Largest of the values from each position on: to the end, of the next 16, and of the next 256.

    In one loop: a loop takes XLA longer to compile than all else around a scene.
    """

    def wider(k, maxima):
        (wide, near), reach = maxima, 1 << k
        wide = _wider(wide, reach)
        return wide, where(reach < _NEAR, wide, near)

    size = values.size
    far, near = jax.lax.fori_loop(0, min(size - 1, _FAR - 1).bit_length(), wider, (values, values))
    # To the end: the next 256, and whole stretches of as many beyond the one in which these begin.
    stretches = jax.lax.cummax(far[::_FAR], reverse=True)  # few, of which XLA may take the square
    beyond = jax.lax.concatenate([stretches[1:], jax.lax.full((1,), 0.0, values.dtype)], 0)
    beyond = jax.lax.broadcast_in_dim(beyond, (beyond.size, _FAR), (0,)).reshape(-1)[:size]
    return jax.lax.max(far, beyond), near, far


def _maximum_to_end(values: Inexact[Array, " n"], left: Int[Array, " m"] | None) -> Inexact[Array, " n"]:
    """Largest of the values from each position on, or of so many as are `left`; XLA's own takes n^2 operations on
    CPUs."""
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
    """Each value, or the one `reach` further on if that is larger (zeros beyond the end, and beyond the `room` that is
    left from a position on; none is negative)."""
    beyond = jnp.concatenate([values, jnp.zeros_like(values)])
    more = jax.lax.dynamic_slice_in_dim(beyond, reach, values.size, allow_negative_indices=False)  # zeros are the last
    return jnp.maximum(values, more if room is None else where(reach < room, more, 0.0))
