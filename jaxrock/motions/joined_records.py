"""Records concatenated in one array: a traced number chooses one of them, and all lanes share the array.

Engines follow a chosen record in place, from its first piece to its last among the pieces of all records.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Inexact, Int

from jaxrock._arguments.parameters import Owner, parameter
from jaxrock._arguments.ranges import size, strength
from jaxrock._core.arrays import is_traced, to_device
from jaxrock._core.types import Scalar
from jaxrock.compiler.hints import select
from jaxrock.motions.motion import AbstractMotion, Piece, Scaled
from jaxrock.motions.record import AbstractChosen, AbstractPolyline, Padded, Record, roomy
from jaxrock.motions.shaking import Bounds, Envelope


class JoinedRecords(Owner):
    """Records concatenated in one array, padded at the end so that one compiled program serves many suites.

    A record of n samples has n places: its n - 1 pieces, and one for the quiet after it.
    """

    samples: Inexact[Array, " places"] = parameter("g", strength, axes=1)
    dt: Inexact[Array, " records"] = parameter("s", size, axes=1)
    first: Int[Array, " records"] = parameter("-", axes=1, is_whole=True)  # first place of each record
    count: Int[Array, " records"] = parameter("-", axes=1, is_whole=True)  # number of samples of each record
    owner: Int[Array, " places"] = parameter("-", axes=1, is_whole=True)  # record to which each place belongs
    longest: int = eqx.field(static=True)  # padded number of samples of the longest record

    @classmethod
    def of(cls, records: Sequence[Record]) -> "JoinedRecords":
        """Join records; known records give known arrays also within `jax.jit`."""
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
            first, count, owner = (
                to_device(np.pad(x, (0, n - x.size), mode="edge").astype(np.int32)) for x, n in whole
            )
            samples, dt = (x if library is jnp else to_device(x) for x in (samples, dt))
        return cls(samples, dt, first, count, owner, roomy(int(sizes.max())))

    @property
    def place(self) -> Int[Array, " places"]:
        """For each place, the number of places of its record before it."""
        return jnp.arange(self.samples.size, dtype=jnp.int32) - self.first[self.owner]


class _InPlace(AbstractPolyline):
    """All records as one motion, of which one record's pieces are followed; time counts from that record's start.

    No array depends on the chosen record.
    """

    joined: JoinedRecords
    record: Int[Array, ""]
    sure: Scalar

    @property  # type: ignore[misc]
    def samples(self) -> Inexact[Array, " places"]:  # type: ignore[override]
        return self.joined.samples

    @property  # type: ignore[misc]
    def dt(self) -> Scalar:  # type: ignore[override]
        return self.sure * self.joined.dt[self.record]  # an invalid number makes the slopes NaN, at no cost in a step

    @property
    def knots(self) -> Inexact[Array, " knots"]:
        many = self.joined
        return many.dt[many.owner] * jnp.minimum(many.place, many.count[many.owner] - 1)

    @property
    def lengths(self) -> Inexact[Array, " pieces"]:
        many = self.joined
        return select(self._left > 0, many.dt[many.owner], jnp.inf)[:-1]

    def length(self, piece: Piece) -> Scalar:
        return self.joined.dt[self.record]

    @property
    def _left(self) -> Int[Array, " places"]:
        """Number of pieces from each place to the end of its record."""
        many = self.joined
        return jnp.maximum(many.count[many.owner] - 1 - many.place, 0)

    @property
    def envelope(self) -> Envelope:
        many, values = self.joined, self.bounds
        values = select(self._left[:-1] > 0, values, 0.0)
        peaks = jax.ops.segment_max(values, many.owner[:-1], many.dt.size, indices_are_sorted=True)
        return Envelope(Bounds(values, self.sure, left=self._left[:-1], peak=peaks[self.record]), None)


class Chosen(AbstractChosen):
    """One of many records, by its number, which may be traced: the result of `suite[number]`."""

    joined: JoinedRecords
    record: Int[Array, "..."] = parameter("-", is_free=False, is_whole=True)
    sure: Inexact[Array, "..."] = parameter("-", is_free=False)  # 1, or NaN where no record has this number

    @property
    def alone(self) -> Padded:
        """The record with an array of its own samples."""
        many, places = self.joined, jnp.arange(self.joined.longest)
        first, count, dt = (x[self.record] for x in (many.first, many.count, many.dt))
        samples = many.samples[jnp.minimum(first + places, many.samples.size - 1)]
        return Padded(self.sure * select(places < count, samples, 0.0), dt, dt * (count - 1))

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
    """Return whether a motion is a chosen record, possibly times factors."""
    while isinstance(motion, Scaled):
        motion = motion.motion
    return isinstance(motion, Chosen)


class Stretch(NamedTuple):
    """A motion of which the pieces `first` to `end` are followed; `room` is the static limit of their number."""

    motion: AbstractMotion
    first: Int[Array, ""]
    end: Int[Array, ""]
    room: int


def in_place(motion: AbstractMotion) -> Stretch:
    """Return the stretch of a motion that `is_in_place` among the pieces of all records."""

    def is_chosen(part):
        return isinstance(part, Chosen)

    (chosen,) = filter(is_chosen, jax.tree.leaves(motion, is_leaf=is_chosen))
    many, record = chosen.joined, chosen.record
    place = _InPlace(joined=many, record=record, sure=chosen.sure)  # type: ignore[call-arg]
    whole = jax.tree.map(lambda part: place if is_chosen(part) else part, motion, is_leaf=is_chosen)
    return Stretch(whole, many.first[record], many.first[record] + many.count[record] - 1, many.longest - 1)
