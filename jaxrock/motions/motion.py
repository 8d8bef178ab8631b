"""Ground motions: the interface between every motion and the engines, and motions made of motions.

A motion is smooth on pieces. It gives the times that separate them (`knots`), a time scale and a bound of every piece,
and its Taylor series at any point of a piece. Accelerations are in g; a positive one drives negative rotation.
"""

import abc
import functools
import itertools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Inexact, Int

from jaxrock._arguments.annotations import arguments
from jaxrock._arguments.parameters import check_declared, parameter, set_parameters
from jaxrock._arguments.ranges import delay, factor, if_known, not_nan, with_throw
from jaxrock._arguments.repr import described
from jaxrock._core.arrays import Values
from jaxrock._core.types import Scalar
from jaxrock.compiler.hints import select
from jaxrock.motions.derived_pieces import RestOfPieces, SamePieces
from jaxrock.motions.interface import AbstractPieces, Piece as Piece
from jaxrock.motions.merged_knots import MergedKnots
from jaxrock.motions.merged_parts import MergedPair, MergedParts
from jaxrock.motions.nesting import check_nesting
from jaxrock.motions.pieces import Extent, acceleration_at
from jaxrock.motions.shaking import Bounds, Envelope


class AbstractMotion(AbstractPieces):
    """The interface of every ground motion: `acceleration(t)`, `knots`, `end`, and series for the engines."""

    __repr__ = described

    def __check_init__(self):
        check_declared(self)
        check_nesting(self)

    @property
    def prepared(self) -> "AbstractMotion":
        """This motion, in which sums hold what all steps of a scene need."""
        return jax.tree.map(_with_merged, self, is_leaf=lambda node: type(node) is Summed)

    @arguments
    def acceleration(self, time: Values) -> Inexact[Array, "..."]:
        """Ground acceleration.

        **Arguments:**

        - `time`: any shape, time from the start of the motion [s].

        **Returns:** acceleration [g], of the shape of `time`; zero outside the motion, at a jump the value after it.
        """
        return acceleration_at(self, if_known(not_nan, "time", time))

    def with_vertical(self, vertical: "AbstractMotion") -> "WithVertical":
        """Combine this horizontal motion with a vertical one, positive upward (whose own vertical part is not used)."""
        return WithVertical(self, vertical)

    @with_throw
    def shifted(self, delay: ArrayLike, *, throw: bool = True) -> "Shifted":
        """Return this motion after `delay` seconds of quiet (0 or more)."""
        return Shifted(self, delay)

    @with_throw
    def from_time(self, start: ArrayLike, *, throw: bool = True) -> "FromTime":
        """Return the rest of this motion, from `start` seconds (0 or more) on."""
        return FromTime(self, start)

    def __mul__(self, factor: ArrayLike) -> "Scaled":
        return Scaled(self, factor)

    def __rmul__(self, factor: ArrayLike) -> "Scaled":
        return self * factor

    def __truediv__(self, factor: ArrayLike) -> "Scaled":
        return self * (1 / factor)

    def __neg__(self) -> "Scaled":
        return self * -1.0

    def __add__(self, other: "AbstractMotion") -> "Summed":
        return Summed(self, other) if isinstance(other, AbstractMotion) else NotImplemented

    def __radd__(self, other: object) -> "AbstractMotion":
        return self if isinstance(other, int) and other == 0 else NotImplemented  # `sum` starts with 0

    def __sub__(self, other: "AbstractMotion") -> "Summed":
        return Summed(self, -other) if isinstance(other, AbstractMotion) else NotImplemented

    __array_ufunc__ = None  # a NumPy array times a motion is a motion, not an array of motions


class _Changed(AbstractMotion):
    """A motion made of others, which defines its `envelope`; the bounds follow from that."""

    @property
    @abc.abstractmethod
    def envelope(self) -> Envelope:
        """Bounds of the horizontal and of the vertical acceleration."""

    @property
    def bounds(self) -> Inexact[Array, " pieces"]:
        horizontal = self.envelope.horizontal
        return horizontal.times_gain(horizontal.values)

    @property
    def vertical_bounds(self) -> Inexact[Array, " pieces"] | None:
        vertical = self.envelope.vertical
        return None if vertical is None else vertical.times_gain(vertical.values)


class AtTheSameTimes(SamePieces, _Changed):
    """A motion made of one other, with the same pieces."""

    motion: AbstractMotion


class Scaled(AtTheSameTimes):
    """A motion times a factor (`factor * motion`)."""

    factor: Inexact[Array, "..."] = parameter("-", factor, is_free=False)  # the motion's amplitude is the same

    @arguments
    def __init__(self, motion: AbstractMotion, factor: ArrayLike):
        self.motion = motion
        set_parameters(self, factor=factor)

    def __mul__(self, factor: ArrayLike) -> "Scaled":
        return Scaled(self.motion, self.factor * Scaled(self.motion, factor).factor)

    @property
    def envelope(self) -> Envelope:
        return self.motion.envelope.each(lambda bounds: bounds.scaled(self.factor))

    def series(self, piece: Piece, local: Scalar, unit: Scalar, order: int) -> list[Scalar]:
        return [self.factor * u for u in self.motion.series(piece, local, unit, order)]

    def vertical_series(self, piece: Piece, local: Scalar, unit: Scalar, order: int) -> list[Scalar] | None:
        terms = self.motion.vertical_series(piece, local, unit, order)
        return None if terms is None else [self.factor * v for v in terms]


class Shifted(_Changed):
    """A motion after `delay` seconds of quiet (`motion.shifted(delay)`)."""

    motion: AbstractMotion
    delay: Inexact[Array, "..."] = parameter("s", delay)

    @arguments
    def __init__(self, motion: AbstractMotion, delay: ArrayLike):
        self.motion = motion
        set_parameters(self, delay=delay)
        if type(motion) is Shifted:
            self.motion, self.delay = motion.motion, motion.delay + self.delay

    @property
    def knots(self) -> Inexact[Array, " knots"]:
        knots = self.motion.knots + self.delay
        return jnp.concatenate([jnp.zeros_like(knots[:1]), knots])

    @property
    def first_quiet(self) -> int:
        return 1 + self.motion.first_quiet

    @property
    def lengths(self) -> Inexact[Array, " pieces"]:
        inner = self.motion.lengths
        return jnp.concatenate([jnp.full_like(inner[:1], self.delay), inner])

    def length(self, piece: Piece) -> Scalar:
        return select(piece > 0, self.motion.length(jnp.maximum(piece - 1, 0)), self.delay)

    @property
    def lasting(self) -> Extent:
        return self.motion.lasting.after(self.delay)

    @property
    def time_rounding(self) -> Scalar | None:
        return self.motion.time_rounding

    @property
    def following(self) -> Int[Array, " knots"] | None:
        inner = self.motion.following
        return None if inner is None else jnp.concatenate([jnp.zeros_like(inner[:1]), inner + 1])

    @property
    def scales(self) -> Inexact[Array, " pieces"] | None:
        scales = self.motion.scales
        return None if scales is None else jnp.concatenate([jnp.full_like(scales[:1], jnp.inf), scales])

    @property
    def envelope(self) -> Envelope:
        def after_quiet(x: Bounds) -> Bounds:
            return x._replace(values=jnp.concatenate([jnp.zeros_like(x.values[:1]), x.values]))

        return self.motion.envelope.each(after_quiet)

    def series(self, piece: Piece, local: Scalar, unit: Scalar, order: int) -> list[Scalar]:
        inner = self.motion.series(jnp.maximum(piece - 1, 0), local, unit, order)
        return [select(piece > 0, u, 0.0) for u in inner]

    def vertical_series(self, piece: Piece, local: Scalar, unit: Scalar, order: int) -> list[Scalar] | None:
        inner = self.motion.vertical_series(jnp.maximum(piece - 1, 0), local, unit, order)
        return None if inner is None else [select(piece > 0, v, 0.0) for v in inner]


class FromTime(RestOfPieces, _Changed):
    """A motion from `start` seconds on (`motion.from_time(start)`): pieces that are over have no length."""

    motion: AbstractMotion
    start: Inexact[Array, "..."] = parameter("s", delay)

    @arguments
    def __init__(self, motion: AbstractMotion, start: ArrayLike):
        self.motion = motion
        set_parameters(self, start=start)
        if type(motion) is FromTime:
            self.motion, self.start = motion.motion, motion.start + self.start


class _Together(AbstractMotion):
    """Several motions at once, on merged pieces."""

    @property
    @abc.abstractmethod
    def _together(self) -> tuple[AbstractMotion, ...]:
        """The motions."""

    @property
    def _pieces(self) -> MergedPair | MergedParts:
        return MergedPair(*self._together)

    @property
    def knots(self) -> Inexact[Array, " knots"]:
        return self._pieces.knots

    @property
    def time_rounding(self) -> Scalar | None:
        # The times of a shifted part are rounded like those of the whole sum.
        parts, knots = jax.tree.leaves(self._together, is_leaf=lambda node: isinstance(node, Shifted)), self.knots
        if not any(isinstance(part, Shifted) for part in parts):
            return None
        own = (motion.time_rounding for motion in self._together)
        return sum((late for late in own if late is not None), jnp.finfo(knots.dtype).eps * knots[-1])

    @property
    def following(self) -> Int[Array, " knots"] | None:
        return self._pieces.following

    @property
    def scales(self) -> Inexact[Array, " pieces"] | None:
        return self._pieces.scales


class Summed(_Together):
    """The sum of motions (`motion + motion`, `sum(motions)`): the parts of sums within it are its own parts."""

    parts: tuple[AbstractMotion, ...]
    merged: MergedParts | None  # computed once for all steps of a scene: see `prepared`; None: where it is needed

    @arguments
    def __init__(self, first: AbstractMotion, second: AbstractMotion):
        parts = (motion.parts if type(motion) is Summed else (motion,) for motion in (first, second))
        self.parts, self.merged = tuple(itertools.chain(*parts)), None

    @property
    def first(self) -> AbstractMotion:
        """The sum of all parts but the last."""
        *parts, _ = self.parts
        return functools.reduce(Summed, parts)

    @property
    def second(self) -> AbstractMotion:
        """The last part."""
        return self.parts[-1]

    def parameter_path(self, path: tuple[str, ...]) -> tuple[str, ...]:
        """Return the path that names a parameter: `first` and `second`, of three `first.first` to `second`."""
        names: dict[int, tuple] = {
            2: (("first",), ("second",)),
            3: (("first", "first"), ("first", "second"), ("second",)),
        }
        field, *rest = path
        if field != "parts" or len(self.parts) not in names:
            return path
        return *names[len(self.parts)][int(rest[0])], *rest[1:]

    @property
    def _together(self) -> tuple[AbstractMotion, ...]:
        return self.parts

    @property
    def _pieces(self) -> MergedPair | MergedParts:
        if self.merged is not None:
            return self.merged
        return MergedPair(*self.parts) if len(self.parts) == 2 else MergedParts.of(self.parts)

    @property
    def lasting(self) -> Extent:
        return self._pieces.lasting

    @property
    def bounds(self) -> Inexact[Array, " pieces"]:
        return self._pieces.bounds

    def series(self, piece: Piece, local: Scalar, unit: Scalar, order: int) -> list[Scalar]:
        return self._pieces.series("series", piece, local, unit, order) or []

    @property
    def vertical_bounds(self) -> Inexact[Array, " pieces"] | None:
        return self._pieces.vertical_bounds

    def vertical_series(self, piece: Piece, local: Scalar, unit: Scalar, order: int) -> list[Scalar] | None:
        return self._pieces.series("vertical_series", piece, local, unit, order)


def _with_merged(part: Any) -> Any:
    """Return a sum with its merged pieces; of two, these are computed anyway where they are needed."""
    if type(part) is not Summed or part.merged is not None:
        return part
    parts = tuple(each.prepared for each in part.parts)
    merged = MergedParts.of(parts) if len(parts) > 2 else None
    return eqx.tree_at(lambda s: (s.parts, s.merged), part, (parts, merged), is_leaf=lambda x: x is None)


class WithVertical(_Changed, _Together):
    """A horizontal motion together with a vertical one (`horizontal.with_vertical(vertical)`).

    **Arguments:**

    - `horizontal`: as any motion, positive acceleration drives negative rotation.
    - `vertical`: positive upward [g]; it makes the block heavier. Where it reaches -1 g the block leaves the ground,
      which is no longer rocking: see `contact_forces`.

    Both begin at time 0. Scaling or shifting the motion scales or shifts both.
    """

    horizontal: AbstractMotion
    vertical: AbstractMotion

    @arguments
    def __init__(self, horizontal: AbstractMotion, vertical: AbstractMotion):
        self.horizontal, self.vertical = horizontal, vertical

    @property
    def _together(self) -> tuple[AbstractMotion, ...]:
        return self.horizontal, self.vertical

    @property
    def _finer(self) -> MergedKnots:
        return MergedPair(*self._together).finer

    @property
    def envelope(self) -> Envelope:
        return Envelope(*self._finer.spread_bounds(*(motion.envelope.horizontal for motion in self._together)))

    def series(self, piece: Piece, local: Scalar, unit: Scalar, order: int) -> list[Scalar]:
        found = self._finer.series(self.horizontal.series, None, piece=piece, local=local, unit=unit, order=order)
        return found[0] or []

    def vertical_series(self, piece: Piece, local: Scalar, unit: Scalar, order: int) -> list[Scalar] | None:
        return self._finer.series(None, self.vertical.series, piece=piece, local=local, unit=unit, order=order)[1]


def is_of_several(motion: AbstractMotion) -> bool:
    """Return whether a motion combines two motions or more."""
    parts = jax.tree.leaves(motion, is_leaf=lambda node: isinstance(node, _Together))
    return any(isinstance(part, _Together) for part in parts)


def merged_pieces(motion: AbstractMotion) -> int:
    """Return how many pieces sums of more than two parts have beyond those of their longest part."""
    parts = jax.tree.leaves(motion, is_leaf=lambda node: type(node) is Summed)
    merged = (part.merged for part in parts if type(part) is Summed)
    return sum(each.knots.size - 1 - each.longest for each in merged if each is not None)
