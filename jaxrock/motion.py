"""Ground motions: what every motion must tell the engines, records, and motions made of motions.

A motion is smooth on pieces. It gives the times that separate them (`knots`), for each piece a time
scale and a bound of its acceleration, and its Taylor series at any point of a piece. Accelerations
are in units of g; positive acceleration drives negative rotation.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Inexact, Int

from jaxrock._checks import Values, checked, finite, positive

Scalar = Inexact[ArrayLike, ""]


class AbstractMotion(eqx.Module):
    """What every ground motion offers: `acceleration(t)`, `knots`, `end`, and series for the engines."""

    @property
    @abc.abstractmethod
    def knots(self) -> Inexact[Array, " knots"]:
        """Times that bound the smooth pieces, from 0 to the end of the motion [s], never decreasing."""

    @property
    @abc.abstractmethod
    def scales(self) -> Inexact[Array, " pieces"]:
        """Time in which the acceleration of each piece changes [s]; infinite for a straight line."""

    @property
    @abc.abstractmethod
    def bounds(self) -> Inexact[Array, " pieces"]:
        """An upper bound of the absolute acceleration within each piece [g]."""

    @abc.abstractmethod
    def series(self, piece: Int[Array, ""], local: Scalar, unit: Scalar, order: int) -> list[Scalar]:
        """Taylor coefficients of the acceleration [g] about `local` seconds after knot `piece`.

        Coefficient k multiplies (elapsed time / unit)^k. A motion that is a polynomial returns
        fewer than order + 1 coefficients: the others are zero.
        """

    @property
    def end(self) -> Scalar:
        """Time at which the ground comes to rest [s]."""
        return self.knots[-1]

    def acceleration(self, time: Values) -> Inexact[Array, "..."]:
        """Ground acceleration.

        **Arguments:**

        - `time`: any shape, time from the start of the motion [s].

        **Returns:** acceleration [g], of the shape of `time`; zero outside the motion, and at a jump the
        value after it.
        """
        time = jnp.asarray(time, self.knots.dtype)
        knots = self.knots

        def at(t):
            piece = jnp.clip(jnp.searchsorted(knots, t, side="right") - 1, 0, knots.size - 2)
            value = self.series(piece, t - knots[piece], jnp.ones_like(t), 0)[0]
            return jnp.where((t >= 0) & (t < knots[-1]), value, 0.0)

        return jax.vmap(at)(time.ravel()).reshape(time.shape)

    def shifted(self, delay: ArrayLike) -> "Shifted":
        """The same motion after `delay` seconds of quiet (0 or more)."""
        return Shifted(self, delay)

    def __mul__(self, factor: ArrayLike) -> "Scaled":
        return Scaled(self, factor)

    def __rmul__(self, factor: ArrayLike) -> "Scaled":
        return Scaled(self, factor)

    def __neg__(self) -> "Scaled":
        return Scaled(self, -1.0)

    def __add__(self, other: "AbstractMotion") -> "Summed":
        return Summed(self, other)

    def __sub__(self, other: "AbstractMotion") -> "Summed":
        return Summed(self, -other)


class _Label:
    """A name that compiled functions do not see: all labels are equal, so that a new name compiles nothing."""

    def __init__(self, text: str):
        self.text = text

    def __eq__(self, other):
        return isinstance(other, _Label)

    def __hash__(self):
        return 0


class Record(AbstractMotion):
    """An accelerogram: straight lines between equally spaced samples.

    **Arguments:**

    - `acceleration`: (n,) samples [g], the first at time 0, finite; n at least 1.
    - `dt`: time between samples [s], positive.
    - `name`: where it comes from; shown in tables and figures.

    **Raises:** ValueError for samples that are not a finite one-dimensional array, or dt <= 0.

    Stepping from knot to knot, an engine meets the record exactly: there is no interpolation error.
    """

    samples: Inexact[Array, "*batch n"]
    dt: Inexact[Array, "..."]
    label: _Label = eqx.field(static=True)

    def __init__(self, acceleration: Values, dt: ArrayLike, name: str = ""):
        samples = finite("acceleration", acceleration)
        if samples.ndim == 0 or samples.shape[-1] == 0:
            raise ValueError(f"Argument `acceleration` must hold at least one sample, but has shape {samples.shape}.")
        self.samples = samples
        self.dt = positive("dt", dt)
        self.label = _Label(name)

    @property
    def name(self) -> str:
        """Where the record comes from."""
        return self.label.text

    @property
    def knots(self) -> Inexact[Array, " knots"]:
        # A single sample is a piece of no length: the ground never moves.
        if self.samples.shape[-1] == 1:
            return jnp.zeros(2, self.samples.dtype)
        return self.dt * jnp.arange(self.samples.shape[-1])

    @property
    def _ends(self) -> tuple[Inexact[Array, " pieces"], Inexact[Array, " pieces"]]:
        """Acceleration at both ends of each piece [g]."""
        if self.samples.shape[-1] == 1:
            return self.samples, self.samples
        return self.samples[:-1], self.samples[1:]

    @property
    def scales(self) -> Inexact[Array, " pieces"]:
        return jnp.full_like(self._ends[0], jnp.inf)

    @property
    def bounds(self) -> Inexact[Array, " pieces"]:
        left, right = self._ends
        return jnp.maximum(jnp.abs(left), jnp.abs(right))

    def series(self, piece, local, unit, order):
        left, right = self._ends
        slope = (right[piece] - left[piece]) / self.dt
        return [left[piece] + slope * local, slope * unit][: order + 1]


class Scaled(AbstractMotion):
    """A motion times a factor (`factor * motion`)."""

    motion: AbstractMotion
    factor: Inexact[Array, "..."]

    def __init__(self, motion: AbstractMotion, factor: ArrayLike):
        self.motion = motion
        self.factor = finite("factor", factor)

    @property
    def knots(self):
        return self.motion.knots

    @property
    def scales(self):
        return self.motion.scales

    @property
    def bounds(self):
        return jnp.abs(self.factor) * self.motion.bounds

    def series(self, piece, local, unit, order):
        return [self.factor * u for u in self.motion.series(piece, local, unit, order)]


class Shifted(AbstractMotion):
    """A motion after `delay` seconds of quiet (`motion.shifted(delay)`)."""

    motion: AbstractMotion
    delay: Inexact[Array, "..."]

    def __init__(self, motion: AbstractMotion, delay: ArrayLike):
        self.motion = motion
        self.delay = checked("delay", delay, "be 0 or more and finite", lambda x: (x >= 0) & (x < jnp.inf))

    @property
    def knots(self):
        knots = self.motion.knots + self.delay
        return jnp.concatenate([jnp.zeros_like(knots[:1]), knots])

    @property
    def scales(self):
        scales = self.motion.scales
        return jnp.concatenate([jnp.full_like(scales[:1], jnp.inf), scales])

    @property
    def bounds(self):
        bounds = self.motion.bounds
        return jnp.concatenate([jnp.zeros_like(bounds[:1]), bounds])

    def series(self, piece, local, unit, order):
        inner = self.motion.series(jnp.maximum(piece - 1, 0), local, unit, order)
        return [jnp.where(piece > 0, u, 0.0) for u in inner]


class Summed(AbstractMotion):
    """The sum of two motions (`motion + motion`); its pieces end wherever a piece of either ends."""

    first: AbstractMotion
    second: AbstractMotion

    @property
    def knots(self):
        return jnp.sort(jnp.concatenate([self.first.knots, self.second.knots]))

    def _inside(self, motion: AbstractMotion, middle: Inexact[Array, "..."]):
        """Piece of `motion` at a time strictly between knots, and whether it moves then."""
        piece = jnp.searchsorted(motion.knots, middle, side="right") - 1
        last = motion.knots.size - 2
        return jnp.clip(piece, 0, last), (piece >= 0) & (piece <= last)

    def _middles(self):
        knots = self.knots
        return (knots[:-1] + knots[1:]) / 2

    @property
    def scales(self):
        def of(motion):
            piece, moving = self._inside(motion, self._middles())
            return jnp.where(moving, motion.scales[piece], jnp.inf)

        return jnp.minimum(of(self.first), of(self.second))

    @property
    def bounds(self):
        def of(motion):
            piece, moving = self._inside(motion, self._middles())
            return jnp.where(moving, motion.bounds[piece], 0.0)

        return of(self.first) + of(self.second)

    def series(self, piece, local, unit, order):
        knots = self.knots
        middle = (knots[piece] + knots[piece + 1]) / 2
        total = []
        for motion in (self.first, self.second):
            inner, moving = self._inside(motion, middle)
            offset = knots[piece] - motion.knots[inner] + local
            terms = [jnp.where(moving, u, 0.0) for u in motion.series(inner, offset, unit, order)]
            longer, shorter = (total, terms) if len(total) > len(terms) else (terms, total)
            total = [a + b for a, b in zip(longer, shorter)] + longer[len(shorter) :]
        return total
