"""Accelerograms: straight lines between equally spaced samples."""

import abc
import contextvars
import warnings
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Inexact

from jaxrock._arguments.annotations import arguments
from jaxrock._arguments.parameters import parameter
from jaxrock._arguments.ranges import not_negative, size, strength, with_throw
from jaxrock._core.arrays import Values, is_traced, of_each, to_device
from jaxrock._core.label import Label
from jaxrock._core.precision import frames_of_the_package
from jaxrock._core.types import Scalar
from jaxrock.compiler.hints import select
from jaxrock.motions.motion import AbstractMotion, Piece
from jaxrock.motions.pieces import Extent

_SHORT = 64  # samples; shorter records are not padded but compiled for their own length
STRONGEST = 3.0  # [g]; few records exceed it
_is_in_g = contextvars.ContextVar("is_in_g", default=False)  # whether samples are known to be in g


class AbstractPolyline(AbstractMotion):
    """Straight lines between samples."""

    samples: eqx.AbstractVar[Inexact[Array, "*batch n"]]
    dt: eqx.AbstractVar[Inexact[Array, "..."]]

    @property
    def _ends(self) -> tuple[Inexact[Array, " pieces"], Inexact[Array, " pieces"]]:
        """Accelerations at both ends of each piece [g]."""
        if self.samples.shape[-1] == 1:
            return self.samples, self.samples
        return self.samples[:-1], self.samples[1:]

    @property
    def scales(self) -> None:
        return None

    @property
    def bounds(self) -> Inexact[Array, " pieces"]:
        left, right = self._ends
        return jnp.maximum(jnp.abs(left), jnp.abs(right))

    def series(self, piece: Piece, local: Scalar, unit: Scalar, order: int) -> list[Scalar]:
        left, right = self._ends
        now = left[piece]
        slope = (right[piece] - now) * (1 / self.dt)
        return [now + slope * local, slope * unit][: order + 1]


class Origin(NamedTuple):
    """Metadata of a record as its file states them; empty where the file says nothing.

    - `event`, `station`, `component`: the earthquake, the station's name, the direction of the sensor.
    - `start`: time of the first sample; `code`: of the station.
    - `format`, `unit`: of the file, before the samples were converted to g; `file`: its name.
    """

    event: str = ""
    station: str = ""
    component: str = ""
    start: str = ""
    code: str = ""
    format: str = ""
    unit: str = ""
    file: str = ""


class Record(AbstractPolyline):
    """An accelerogram: straight lines between equally spaced samples.

    **Arguments:**

    - `acceleration`: (n,) samples [g], the first at time 0, finite; n at least 1 (a single sample lasts no time and
      moves nothing). Or (..., n) of many records of one length, for use under `jax.vmap`.
    - `dt`: time between samples [s], positive.
    - `name`: where it comes from; shown in tables and figures. Compiled functions ignore it: one serves all names, and
      a record that it returns has the name of the record for which it was compiled.
    - `origin`: an `Origin`, the metadata of its file; None: nothing.

    **Raises:** ValueError for samples that are not finite numbers, a column (n, 1) in place of them, or dt <= 0.

    Known samples beyond 3 g raise a warning, as they are likely in another unit. `factor * record` never warns.

    An engine steps from knot to knot, so it meets the record exactly: there is no interpolation error.
    """

    samples: Inexact[Array, "*batch n"] = parameter("g", strength, axes=1)
    dt: Inexact[Array, "..."] = parameter("s", size)
    label: Label = eqx.field(static=True)

    @with_throw
    @arguments
    def __init__(
        self, acceleration: Values, dt: ArrayLike, name: str = "", origin: Origin | None = None, *, throw: bool = True
    ):
        samples = strength("acceleration", acceleration)
        if samples.ndim == 0 or samples.shape[-1] == 0:
            raise ValueError(f"Argument `acceleration` must hold at least one sample, but has shape {samples.shape}.")
        if samples.ndim > 1 and samples.shape[-1] == 1:
            raise ValueError(
                f"Argument `acceleration` must have its samples along the last axis, but has shape {samples.shape}."
            )
        self.samples = samples
        self.dt = size("dt", dt)
        self.label = Label((name, origin or Origin()))
        if not is_traced(samples) and not _is_in_g.get():
            _warn_of_unit(np.asarray(samples), name)

    @property
    def name(self) -> str:
        """Where the record comes from; empty within `jax.jit` and the like, whose programs serve all names."""
        return self._told[0]

    @property
    def origin(self) -> Origin:
        """Metadata that its file states; empty where the name is."""
        return self._told[1]

    @property
    def _told(self) -> tuple[str, Origin]:
        return ("", Origin()) if is_traced(self.samples) else self.label.value

    @property
    def knots(self) -> Inexact[Array, " knots"]:
        # A single sample is a piece of no length: the ground never moves.
        if self.samples.shape[-1] == 1:
            return jnp.zeros(2, self.samples.dtype)
        count = self.samples.shape[-1]
        if is_traced(self.dt):  # a NumPy array would become a constant of the program
            return self.dt * jnp.arange(count)
        return to_device(np.asarray(self.dt) * np.arange(count, dtype=self.dt.dtype))

    @property
    def lengths(self) -> Inexact[Array, " pieces"]:
        count = self.samples.shape[-1]
        return jnp.zeros(1, self.samples.dtype) if count == 1 else jnp.full(count - 1, self.dt, self.samples.dtype)

    def length(self, piece: Piece) -> Scalar:
        return self.lengths[0]

    @property
    def lasting(self) -> Extent:
        return Extent.of_equal(self.dt, self.samples.shape[-1] - 1)


def record_in_g(acceleration: Values, dt: ArrayLike, name: str = "", origin: Origin | None = None) -> Record:
    """Make a `Record` from accelerations known to be in g, without a warning about their unit."""
    before = _is_in_g.set(True)
    try:
        return Record(acceleration, dt, name, origin)
    finally:
        _is_in_g.reset(before)


def _warn_of_unit(samples: np.ndarray, name: str) -> None:
    peak = max(float(samples.max()), -float(samples.min()))
    if peak > STRONGEST:
        unit, per_g = ("m/s2", 9.81) if peak <= STRONGEST * 9.81 else ("cm/s2", 981)
        warnings.warn(
            f"{f'Record {name!r}' if name else 'A record'} peaks at {peak:.4g} g. If its samples are in {unit}, divide "
            f"them by {per_g}: it then peaks at {peak / per_g:.3g} g.",
            UserWarning,
            stacklevel=frames_of_the_package() + 1,
        )


class AbstractChosen(AbstractMotion):
    """A record stored in an array together with others."""

    @property
    @abc.abstractmethod
    def alone(self) -> "Padded":
        """The record with an array of its own samples."""


class Padded(AbstractPolyline):
    """A record padded with zero samples at its end."""

    samples: Inexact[Array, "*batch n"] = parameter("g", strength, axes=1)
    dt: Inexact[Array, "..."] = parameter("s", size)
    finish: Inexact[Array, "..."] = parameter("s", not_negative, is_free=False)

    @property
    def knots(self) -> Inexact[Array, " knots"]:
        return jnp.minimum(self.dt * jnp.arange(self.samples.shape[-1]), self.finish)

    @property
    def lengths(self) -> Inexact[Array, " pieces"]:
        return select(self.dt * jnp.arange(self.samples.shape[-1] - 1) < self.finish, self.dt, 0.0)

    def length(self, piece: Piece) -> Scalar:
        return select(self.dt * piece < self.finish, self.dt, 0.0)

    @property
    def lasting(self) -> Extent:
        return Extent.of_equal(self.dt, self.samples.shape[-1] - 1, self.finish)


def padded(motion: AbstractMotion) -> AbstractMotion:
    """Pad the records of a motion, so that one compiled program serves many lengths.

    Padding adds at most a quarter of the samples. Pieces beyond the end have no length.
    """
    return jax.tree.map(_padded, motion, is_leaf=_is_record)


def with_room(motion: AbstractMotion) -> AbstractMotion:
    """Pad the records of a motion to the next power of two, 1024 at least, so that a few programs serve all lengths."""
    return jax.tree.map(_doubled, motion, is_leaf=_is_record)


def roomy(count: int) -> int:
    """Return a padded size, at most a quarter larger than `count`; few sizes occur."""
    return count + -count % (1 << max((count - 1).bit_length() - 3, 0))


def _is_record(part) -> bool:
    return type(part) is Record or isinstance(part, AbstractChosen)


def _doubled(part):
    if isinstance(part, AbstractChosen):
        return part.alone
    if type(part) is not Record:
        return part
    count = part.samples.shape[-1]
    return Padded(*_with_room(part.samples, part.dt, max(1024, 1 << (count - 1).bit_length()) - count))


def _padded(part):
    if isinstance(part, AbstractChosen):
        return part.alone
    if type(part) is not Record or part.samples.shape[-1] <= _SHORT:
        return part
    count = part.samples.shape[-1]
    return Padded(*_with_room(part.samples, part.dt, roomy(count) - count))


def _with_room(samples, dt, more: int):
    # NumPy pads known samples: `jnp.pad` would compile a program for every number of samples.
    room = [(0, 0)] * (samples.ndim - 1) + [(0, more)]
    if is_traced(samples):
        roomier = jnp.pad(samples, room)
    else:
        with jax.ensure_compile_time_eval():  # known also under tracing
            roomier = to_device(np.pad(np.asarray(samples), room))
    return roomier, dt, of_each(lambda dt: dt * (samples.shape[-1] - 1), dt)
