"""Ground motions: the interface between every motion and the engines, and motions made of motions.

A motion is smooth on pieces. It gives the times that separate them (`knots`), a time scale and a bound of every piece,
and its Taylor series at any point of a piece. Accelerations are in g; a positive one drives negative rotation.
"""

import abc
import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Inexact, Int

from jaxrock._arguments.annotations import arguments
from jaxrock._arguments.parameters import Owner, check_declared, parameter, set_parameters
from jaxrock._arguments.ranges import delay, factor, if_known, not_nan, with_throw
from jaxrock._arguments.repr import described
from jaxrock._core.arrays import Values, of_each
from jaxrock._core.types import Scalar
from jaxrock.compiler.hints import select
from jaxrock.motions.merged_knots import MergedKnots
from jaxrock.motions.nesting import check_nesting
from jaxrock.motions.pieces import Extent, acceleration_at
from jaxrock.motions.shaking import Bounds, Envelope, sum_of_series
from jaxrock.numerics.lookup import take

Piece = Int[Array, ""]  # number of a smooth piece


class AbstractMotion(Owner):
    """The interface of every ground motion: `acceleration(t)`, `knots`, `end`, and series for the engines."""

    __repr__ = described

    def __check_init__(self):
        check_declared(self)
        check_nesting(self)

    @property
    @abc.abstractmethod
    def knots(self) -> Inexact[Array, " knots"]:
        """Times that bound the smooth pieces, from 0 to the end of the motion [s], never decreasing."""

    @property
    def lengths(self) -> Inexact[Array, " pieces"]:
        """Durations of the pieces [s]; exact also for a motion that begins late, whose knots are rounded."""
        return jnp.diff(self.knots)

    def length(self, piece: Piece) -> Scalar:
        """Return the duration of one piece [s]."""
        return take(self.lengths, piece)

    @property
    def lasting(self) -> Extent:
        """The last piece with a positive length, and whether time runs forward in every piece."""
        return Extent.of(self.lengths)

    @property
    def time_rounding(self) -> Scalar | None:
        """Bound of the relative timing error of parts through rounding of times [s]; None: `lengths` are exact."""
        return None

    @property
    def following(self) -> Int[Array, " knots"] | None:
        """For each piece, and for the end, the first piece from there on that has a length; None: few or none to
        skip.
        """
        return None

    @property
    @abc.abstractmethod
    def scales(self) -> Inexact[Array, " pieces"] | None:
        """Time scale of the acceleration in each piece [s]; infinite for a straight line. None: all are straight."""

    @property
    @abc.abstractmethod
    def bounds(self) -> Inexact[Array, " pieces"]:
        """An upper bound of the absolute acceleration within each piece [g]."""

    @abc.abstractmethod
    def series(self, piece: Piece, local: Scalar, unit: Scalar, order: int) -> list[Scalar]:
        """Taylor coefficients of the acceleration [g] about `local` seconds after knot `piece`.

        Coefficient k multiplies (elapsed time / unit)^k. A motion that is a polynomial returns
        fewer than order + 1 coefficients: the others are zero.
        """

    @property
    def vertical_bounds(self) -> Inexact[Array, " pieces"] | None:
        """An upper bound of the absolute vertical acceleration within each piece [g]; None: the ground has none."""
        return None

    def vertical_series(self, piece: Piece, local: Scalar, unit: Scalar, order: int) -> list[Scalar] | None:
        """Return the Taylor coefficients of the vertical acceleration, positive upward [g], as `series` does."""
        return None

    @property
    def envelope(self) -> Envelope:
        """Bounds of the horizontal and of the vertical acceleration."""
        vertical = self.vertical_bounds
        return Envelope(Bounds(self.bounds), None if vertical is None else Bounds(vertical))

    @property
    def end(self) -> Scalar:
        """Time at which the ground comes to rest [s]."""
        return of_each(lambda knots: knots[-1], self.knots)

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


class AtTheSameTimes(_Changed):
    """A motion made of one other, with the same pieces."""

    motion: AbstractMotion

    @property
    def knots(self) -> Inexact[Array, " knots"]:
        return self.motion.knots

    @property
    def lengths(self) -> Inexact[Array, " pieces"]:
        return self.motion.lengths

    def length(self, piece: Piece) -> Scalar:
        return self.motion.length(piece)

    @property
    def lasting(self) -> Extent:
        return self.motion.lasting

    @property
    def time_rounding(self) -> Scalar | None:
        return self.motion.time_rounding

    @property
    def following(self) -> Int[Array, " knots"] | None:
        return self.motion.following

    @property
    def scales(self) -> Inexact[Array, " pieces"] | None:
        return self.motion.scales


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


class _Together(AbstractMotion):
    """Two motions at once, on merged pieces."""

    @property
    @abc.abstractmethod
    def _both(self) -> tuple[AbstractMotion, AbstractMotion]:
        """The two motions."""

    @property
    def _finer(self) -> MergedKnots:
        first, second = self._both
        return MergedKnots(first.knots, second.knots)

    @property
    def knots(self) -> Inexact[Array, " knots"]:
        return self._finer.knots

    @property
    def time_rounding(self) -> Scalar | None:
        # The times of a shifted part are rounded like those of the whole sum.
        parts, knots = jax.tree.leaves(self._both, is_leaf=lambda node: isinstance(node, Shifted)), self.knots
        if not any(isinstance(part, Shifted) for part in parts):
            return None
        own = (motion.time_rounding for motion in self._both)
        return sum((late for late in own if late is not None), jnp.finfo(knots.dtype).eps * knots[-1])

    @property
    def following(self) -> Int[Array, " knots"] | None:
        return self._finer.following

    @property
    def scales(self) -> Inexact[Array, " pieces"] | None:
        spread = self._finer.spread(*(motion.scales for motion in self._both), quiet=jnp.inf)
        found = [values for values in spread if values is not None]
        return functools.reduce(jnp.minimum, found) if found else None


class Summed(_Together):
    """The sum of two motions (`motion + motion`)."""

    first: AbstractMotion
    second: AbstractMotion

    @arguments
    def __init__(self, first: AbstractMotion, second: AbstractMotion):
        self.first, self.second = first, second

    @property
    def _both(self) -> tuple[AbstractMotion, AbstractMotion]:
        return self.first, self.second

    @property
    def bounds(self) -> Inexact[Array, " pieces"]:
        # Values are spread before the gain applies, so that lanes with different gains share the spread array.
        both = self._finer.spread_bounds(*(motion.envelope.horizontal for motion in self._both))
        return functools.reduce(jnp.add, (bounds.times_gain(bounds.values) for bounds in both))

    def series(self, piece: Piece, local: Scalar, unit: Scalar, order: int) -> list[Scalar]:
        both = (motion.series for motion in self._both)
        return sum_of_series(*self._finer.series(*both, piece=piece, local=local, unit=unit, order=order)) or []

    @property
    def vertical_bounds(self) -> Inexact[Array, " pieces"] | None:
        spread = self._finer.spread(*(motion.vertical_bounds for motion in self._both), quiet=0.0)
        found = [bounds for bounds in spread if bounds is not None]
        return functools.reduce(jnp.add, found) if found else None

    def vertical_series(self, piece: Piece, local: Scalar, unit: Scalar, order: int) -> list[Scalar] | None:
        both = (motion.vertical_series for motion in self._both)
        return sum_of_series(*self._finer.series(*both, piece=piece, local=local, unit=unit, order=order))


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
    def _both(self) -> tuple[AbstractMotion, AbstractMotion]:
        return self.horizontal, self.vertical

    @property
    def envelope(self) -> Envelope:
        return Envelope(*self._finer.spread_bounds(*(motion.envelope.horizontal for motion in self._both)))

    def series(self, piece: Piece, local: Scalar, unit: Scalar, order: int) -> list[Scalar]:
        found = self._finer.series(self.horizontal.series, None, piece=piece, local=local, unit=unit, order=order)
        return found[0] or []

    def vertical_series(self, piece: Piece, local: Scalar, unit: Scalar, order: int) -> list[Scalar] | None:
        return self._finer.series(None, self.vertical.series, piece=piece, local=local, unit=unit, order=order)[1]


def is_of_several(motion: AbstractMotion) -> bool:
    """Return whether a motion combines two motions or more."""
    parts = jax.tree.leaves(motion, is_leaf=lambda node: isinstance(node, _Together))
    return any(isinstance(part, _Together) for part in parts)
