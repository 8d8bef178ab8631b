"""Records one after the other in one array: one of them is chosen by its number, and many scenes share the array.

Engines follow a chosen record in place, from its first piece among those of all to its last.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Inexact, Int

from jaxrock._checks import is_traced, placed, size, strength
from jaxrock._parameters import Owner, parameter
from jaxrock.motions.motion import AbstractMotion, Piece, Scalar, Scaled
from jaxrock.motions.record import AbstractChosen, Padded, Record, Straight, roomy
from jaxrock.motions.shaking import Bounds, Envelope
from jaxrock.numerics.choice import where


class JoinedRecords(Owner):
    """Records one after the other, with room for more at the end: so that one program serves many suites.

    A record of n samples has n places: its n - 1 pieces, and one for the quiet after it.
    """

    samples: Inexact[Array, " places"] = parameter("g", strength, axes=1)
    dt: Inexact[Array, " records"] = parameter("s", size, axes=1)
    first: Int[Array, " records"] = parameter("-", axes=1, is_whole=True)  # place of each
    count: Int[Array, " records"] = parameter("-", axes=1, is_whole=True)  # samples of each
    owner: Int[Array, " places"] = parameter("-", axes=1, is_whole=True)  # which record has a place
    longest: int = eqx.field(static=True)  # room for the samples of any

    @classmethod
    def of(cls, records: Sequence[Record]) -> "JoinedRecords":
        """Join records; what is known stays so within `jax.jit`."""
        sizes = np.array([record.samples.size for record in records])
        places, owners = roomy(int(sizes.sum())), roomy(len(records))
        owner = np.repeat(np.arange(len(records)), sizes)
        whole = ((np.cumsum(sizes) - sizes, owners), (sizes, owners), (owner, places))
        library = jnp if is_traced(records) else np
        samples = library.concatenate([library.asarray(record.samples) for record in records])
        dt = library.stack([library.asarray(record.dt) for record in records])
        samples = library.pad(samples, (0, places - samples.size))
        dt = library.pad(dt, (0, owners - dt.size), mode="edge")
        with jax.ensure_compile_time_eval():
            first, count, owner = (placed(np.pad(x, (0, n - x.size), mode="edge").astype(np.int32)) for x, n in whole)
            samples, dt = (x if library is jnp else placed(x) for x in (samples, dt))
        return cls(samples, dt, first, count, owner, roomy(int(sizes.max())))

    @property
    def place(self) -> Int[Array, " places"]:
        """How many places of the same record come before each."""
        return jnp.arange(self.samples.size, dtype=jnp.int32) - self.first[self.owner]


class _InPlace(Straight):
    """All records as one motion, of which a scene is followed from one piece to another. The time is its own record's.

    No array depends on which of them that is.
    """

    joined: JoinedRecords
    record: Int[Array, ""]
    sure: Scalar

    @property  # type: ignore[misc]
    def samples(self) -> Inexact[Array, " places"]:  # type: ignore[override]
        return self.joined.samples

    @property  # type: ignore[misc]
    def dt(self) -> Scalar:  # type: ignore[override]
        return self.sure * self.joined.dt[self.record]  # which makes slopes no numbers, at no cost in a step

    @property
    def knots(self) -> Inexact[Array, " knots"]:
        many = self.joined
        return many.dt[many.owner] * jnp.minimum(many.place, many.count[many.owner] - 1)

    @property
    def lengths(self) -> Inexact[Array, " pieces"]:
        many = self.joined
        return where(self._left > 0, many.dt[many.owner], jnp.inf)[:-1]

    def length(self, piece: Piece) -> Scalar:
        return self.joined.dt[self.record]

    @property
    def _left(self) -> Int[Array, " places"]:
        """Pieces from each place on to the end of its record."""
        many = self.joined
        return jnp.maximum(many.count[many.owner] - 1 - many.place, 0)

    @property
    def envelope(self) -> Envelope:
        many, values = self.joined, self.bounds
        values = where(self._left[:-1] > 0, values, 0.0)
        peaks = jax.ops.segment_max(values, many.owner[:-1], many.dt.size, indices_are_sorted=True)
        return Envelope(Bounds(values, self.sure, left=self._left[:-1], peak=peaks[self.record]), None)


class Chosen(AbstractChosen):
    """One of many records, by its number, which may be traced: what `suite[number]` is."""

    joined: JoinedRecords
    record: Int[Array, "..."] = parameter("-", is_free=False, is_whole=True)
    sure: Inexact[Array, "..."] = parameter("-", is_free=False)  # 1; what is not a number where there is no such record

    @property
    def alone(self) -> Padded:
        """The record with samples of its own."""
        many, places = self.joined, jnp.arange(self.joined.longest)
        first, count, dt = (x[self.record] for x in (many.first, many.count, many.dt))
        samples = many.samples[jnp.minimum(first + places, many.samples.size - 1)]
        return Padded(self.sure * where(places < count, samples, 0.0), dt, dt * (count - 1))

    @property
    def knots(self) -> Inexact[Array, " knots"]:
        return self.alone.knots

    @property
    def scales(self) -> None:
        return None

    @property
    def bounds(self) -> Inexact[Array, " pieces"]:
        return self.alone.bounds

    def series(self, piece: Piece, local: Scalar, unit: Scalar, order: int) -> list[Scalar]:
        return self.alone.series(piece, local, unit, order)


def is_in_place(motion: AbstractMotion) -> bool:
    """Whether a motion is a chosen record, or that times a factor."""
    while isinstance(motion, Scaled):
        motion = motion.motion
    return isinstance(motion, Chosen)


class Stretch(NamedTuple):
    """A motion of which a scene is followed from one piece on, up to another; there is room for so many."""

    motion: AbstractMotion
    first: Int[Array, ""]
    end: Int[Array, ""]
    room: int


def in_place(motion: AbstractMotion) -> Stretch:
    """Where a motion that `is_in_place` is found among all."""

    def is_chosen(part):
        return isinstance(part, Chosen)

    (chosen,) = filter(is_chosen, jax.tree.leaves(motion, is_leaf=is_chosen))
    many, record = chosen.joined, chosen.record
    place = _InPlace(joined=many, record=record, sure=chosen.sure)  # type: ignore[call-arg]
    whole = jax.tree.map(lambda part: place if is_chosen(part) else part, motion, is_leaf=is_chosen)
    return Stretch(whole, many.first[record], many.first[record] + many.count[record] - 1, many.longest - 1)
