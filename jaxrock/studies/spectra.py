"""Rocking spectra and overturning maps."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxrock._arguments.annotations import arguments
from jaxrock._arguments.ranges import Range, not_nan, ratio
from jaxrock._arguments.tables import AbstractTable, Column
from jaxrock._core.arrays import Values, is_traced, to_device
from jaxrock._core.progress import Progress
from jaxrock._core.renamed import renamed
from jaxrock.blocks.restitution import Restitution
from jaxrock.blocks.rigid import Block
from jaxrock.compiler import trace_function
from jaxrock.engines.stepper import AbstractEngine
from jaxrock.models.equation import AbstractEquation
from jaxrock.models.rigid import Housner
from jaxrock.motions.motion import AbstractMotion
from jaxrock.motions.pulses.sinusoidal import SinePulse
from jaxrock.motions.record import with_room
from jaxrock.motions.suite import Suite, warn_of_repeated
from jaxrock.responses.current_model import current_model
from jaxrock.responses.outcome import Outcome, outcome
from jaxrock.status import Status, is_decided
from jaxrock.studies.any_size import BlockOfAnySize, of_any_size
from jaxrock.studies.spectrum import Spectrum
from jaxrock.sweeps.runner import cheap_per_point
from jaxrock.sweeps.sweep import surface


class OverturningMap(AbstractTable):
    """An overturning map; every result has the shape (len(intensity), len(frequency_ratio)), or (..., of these two).

    - `frequency_ratio`: omega/p [-]; `intensity`: peak acceleration over the uplift threshold [-].
    - `parameters`: further axes, in front of these, by the pulse's names.
    - `state`: 0 safe, 1 overturned without impact, 2 overturned after impacts, -1 not computed (see `status`).
    - `rotation_ratio`: peak |rotation| over alpha [-]; infinite where the block overturned.
    - `impact_count`, `margin`, `status`: as in `Outcome`.
    - `scene`: shape of the block, pulse, model and engine of the map, for `overturning_borders`.
    """

    frequency_ratio: Float[Array, " columns"]
    intensity: Float[Array, " rows"]
    state: Int[Array, "*more rows columns"]
    rotation_ratio: Float[Array, "*more rows columns"]
    impact_count: Int[Array, "*more rows columns"]
    margin: Float[Array, "*more rows columns"]
    status: Status
    parameters: dict[str, Float[Array, " _"]] = eqx.field(default_factory=dict)
    scene: Any = None

    max_rotation = renamed("max_rotation", "rotation_ratio")

    @property
    def overturned(self) -> Bool[Array, "*more rows columns"]:
        """Verdict of each block; False where `state` is -1, not computed."""
        return jnp.asarray(self.state > 0)

    @property
    def pulse_duration(self) -> Float[Array, " columns"]:
        """p times the duration (or period) of the pulse [-], 2 pi/frequency_ratio."""
        return 2 * jnp.pi / self.frequency_ratio

    @property
    def uplift_strength(self) -> Float[Array, " rows"]:
        """Uplift threshold over the peak acceleration [-], 1/intensity."""
        return 1 / self.intensity

    @property
    def _columns(self):
        axes = (*self.parameters, "intensity", "frequency_ratio")
        results = ("state", "rotation_ratio", "impact_count", "overturned", "margin", "status")
        return {
            **{name: Column((name,), values) for name, values in self.parameters.items()},
            **{name: Column((name,), getattr(self, name)) for name in axes[-2:]},
            **{name: Column(axes, getattr(self, name)) for name in results},
        }


@arguments
def rocking_spectrum(
    alpha: ArrayLike,
    motion: AbstractMotion | Suite,
    period: Values,
    restitution: Restitution | None = None,
    model: AbstractEquation = Housner(),
    *,
    engine: AbstractEngine | None = None,
    opens: str | None = None,
    progress: bool | None = None,
) -> Spectrum:
    """Compute the peak response of blocks of one slenderness and every size under one motion, or those of a suite.

    **Arguments:**

    - `alpha`: slenderness angle [rad], in (0, pi/2).
    - `motion`: any motion, or a `Suite`; a suite's motions run one after the other, and share programs.
    - `period`: (n,) values of 2 pi/p [s], positive.
    - `restitution`, `opens`, `model`, `engine`: as in `Block` and `outcome`.
    - `progress`: whether to draw a progress bar; None: on a terminal, if it takes long.

    **Returns:** a `Spectrum` over the periods; of a suite, with an axis of motions in front: results (motions, n). A
    repeated motion of a suite causes a warning.
    With traced arguments (within `jax.jit`, `jax.vmap`, `jax.grad`) it is a plain function of arrays.

    **Raises:** ValueError for arguments outside their ranges.

    **Source:** Makris & Konstantinidis (2003), the rocking spectrum.
    """
    period = axis("period", period, _period)
    block = of_any_size(alpha, restitution, opens)  # raises here, where values are concrete

    def under(motion, progress):
        scene = BlockOfAnySize.of(block), motion, current_model(model, block, motion, period), engine
        return surface(_under_motion, (period,), scene, "spectrum", progress, names=_PEAKS)

    if not isinstance(motion, Suite):
        return Spectrum(period, **under(motion, progress))
    warn_of_repeated(motion)
    bar, found = Progress(len(motion), "records", progress), []
    for each in motion.motions():
        found.append(under(with_room(each), False))
        bar.add(1)
    return Spectrum(period, **jax.tree.map(_stacked, *found), motions=motion.names)


def _stacked(*results: Array) -> Array:
    """Stack results of several motions; NumPy stacks known ones, as JAX would compile a program for each number."""
    return jnp.stack(results) if is_traced(results) else to_device(np.stack([np.asarray(x) for x in results]))


@arguments
def self_similar_spectrum(
    frequency_ratio: Values | None = None,
    intensity: Values | None = None,
    *,
    pulse_duration: Values | None = None,
    uplift_strength: Values | None = None,
    alpha: ArrayLike = 0.2,
    restitution: Restitution | None = None,
    opens: str | None = None,
    pulse: Callable[..., AbstractMotion] = SinePulse,
    model: AbstractEquation = Housner(),
    engine: AbstractEngine | None = None,
    progress: bool | None = None,
    **parameters: Values,
) -> Spectrum:
    """Compute the peak response under a pulse against its frequency, in dimensionless terms: one curve per intensity.

    **Arguments:**

    - `frequency_ratio`: (n,) values of omega/p [-], positive, omega = 2 pi/period of the pulse.
    - `intensity`: (rows,) peak acceleration over the uplift threshold [-], positive. The pulse's `amplitude` counts as
      the peak. The peak of a `MavroeidisPapageorgiouPulse`, and of a `RickerPulse` with a `center` of its own, is lower
      (`rk.intensity.peak_acceleration`).
    - `pulse_duration`, `uplift_strength`: (n,) and (rows,) alternatives to these two axes, positive: p times the
      duration (or period) of the pulse [-], and uplift threshold over peak acceleration [-].
    - `alpha`, `restitution`, `opens`: as in `Block`. In the linear model alpha plays no part. Positive
      acceleration lifts a wall that opens to the left.
    - `pulse`: makes a motion from amplitude [g] and period (or duration, for pulses that have one) [s]: a pulse of the
      package, or any function that JAX can trace. The values that it reads may have changed since the last call.
    - `model`, `engine`, `progress`: as in `rocking_spectrum`.
    - `parameters`: further ones of the pulse by their names, such as `shape=0.5`: a number, or a list, which is one
      more axis, in front of the others.

    **Returns:** a `Spectrum` with results of shape (rows, n), or (..., rows, n).
    With traced arguments (within `jax.jit`, `jax.vmap`, `jax.grad`) it is a plain function of arrays.

    **Raises:** ValueError for arguments outside their ranges; TypeError for parameters that the pulse does not have.

    **Source:** Dimitrakopoulos & DeJong (2012), section 4; Voyagaki, Psycharis & Mylonakis (2012), 2.2, figure 3.5.
    """
    axes = _PulseAxes.of(frequency_ratio, intensity, pulse_duration, uplift_strength, parameters)
    scene = _scene(axes, of_any_size(alpha, restitution, opens), pulse, model, engine)
    results = _over_pulses(axes, scene, "spectrum", progress, _PEAKS)
    return Spectrum(abscissa=axes.ratio, intensity=axes.intensity, parameters=axes.lists, **results)


@arguments
def overturning_map(
    frequency_ratio: Values | None = None,
    intensity: Values | None = None,
    *,
    pulse_duration: Values | None = None,
    uplift_strength: Values | None = None,
    alpha: ArrayLike = 0.2,
    restitution: Restitution | None = None,
    opens: str | None = None,
    pulse: Callable[..., AbstractMotion] = SinePulse,
    model: AbstractEquation = Housner(),
    engine: AbstractEngine | None = None,
    progress: bool | None = None,
    **parameters: Values,
) -> OverturningMap:
    """Compute which blocks overturn under a pulse, over its frequency and intensity.

    **Arguments:** as in `self_similar_spectrum`.

    **Returns:** an `OverturningMap`.
    With traced arguments (within `jax.jit`, `jax.vmap`, `jax.grad`) it is a plain function of arrays.

    **Raises:** ValueError for arguments outside their ranges; TypeError for parameters that the pulse does not have.

    **Source:** Zhang & Makris (2001); Dimitrakopoulos & DeJong (2012), figure 4; Voyagaki, Psycharis & Mylonakis
    (2012), 2.2, figures 3.1 to 3.3 and 3.6.
    """
    axes = _PulseAxes.of(frequency_ratio, intensity, pulse_duration, uplift_strength, parameters)
    scene = _scene(axes, of_any_size(alpha, restitution, opens), pulse, model, engine)
    results = _over_pulses(axes, scene, "map", progress, _STATES)
    return OverturningMap(
        frequency_ratio=axes.ratio, intensity=axes.intensity, parameters=axes.lists, scene=scene, **results
    )


class _PulseAxes(NamedTuple):
    """Axes over pulses: frequency ratios, intensities, and further parameters of the pulse."""

    ratio: Float[Array, " columns"]
    intensity: Float[Array, " rows"]
    parameters: dict[str, Array]  # numbers and lists

    @classmethod
    def of(cls, frequency_ratio, intensity, pulse_duration, uplift_strength, parameters) -> "_PulseAxes":
        """Make each of the two axes from whichever of its two arguments is given."""
        ratio = _either("frequency_ratio", frequency_ratio, "pulse_duration", pulse_duration, 2 * math.pi)
        intensity = _either("intensity", intensity, "uplift_strength", uplift_strength, 1.0)
        parameters = {name: not_nan(name, values) for name, values in parameters.items()}
        for name, values in parameters.items():
            if values.ndim > 1 or values.size == 0:
                raise ValueError(f"Argument `{name}` must be a number or a list, but has shape {values.shape}.")
        return cls(ratio, intensity, parameters)

    @property
    def lists(self) -> dict[str, Array]:
        """Parameters that are lists, and so axes."""
        return {name: values for name, values in self.parameters.items() if values.ndim}


def _either(name: str, values: Values | None, other: str, others: Values | None, product: float) -> Float[Array, " n"]:
    """Return an axis from its own argument, or from another one as `product` over that."""
    if values is not None and others is None:
        return axis(name, values)
    if others is not None and values is None:
        return product / axis(other, others)
    which = "neither is" if values is None else "both are"
    raise ValueError(f"Argument `{name}` must be given, or `{other}` in its place, but {which}.")


def _scene(axes: _PulseAxes, block: Block, pulse, model, engine) -> tuple:
    """Return the part that all points share: a pytree, which holds the scalar parameters of the pulse."""
    lists = tuple(axes.lists)
    numbers = {name: value for name, value in axes.parameters.items() if name not in lists}
    number = jax.ShapeDtypeStruct((), jnp.result_type(block.alpha, *axes.parameters.values(), *axes[:2]))
    made = _Family(trace_function(pulse, number, number, **dict.fromkeys(axes.parameters, number)), numbers, lists)
    return BlockOfAnySize.of(block, scaled=True), made, current_model(model, block, axes.ratio, axes.intensity), engine


class _Family(eqx.Module):
    """A family of pulses by size and extent: some parameters are fixed numbers, others are given at each point."""

    pulse: Callable
    numbers: dict[str, Array]
    lists: tuple[str, ...] = eqx.field(static=True)

    def __call__(self, size, extent, *listed):
        return self.pulse(size, extent, **self.numbers, **dict(zip(self.lists, listed)))


def _over_pulses(
    axes: _PulseAxes, scene: tuple, label: str, progress: bool | None, names: tuple[str, ...]
) -> dict[str, Any]:
    """Outcomes over the outer product of parameters, intensities (rows) and frequency ratios (columns), at p = 1."""
    points = (*axes.lists.values(), axes.intensity, axes.ratio)
    # Points that are neighbours in intensity share a chunk, because they move alike.
    return surface(_under_pulse, points, scene, label, progress, columns=True, names=names)


_period = Range("be positive and finite, from 1e-5 to 1e6", 0.0, np.inf, lambda x: (x >= 1e-5) & (x <= 1e6))  # 2 pi/p


def axis(name: str, values: Values, allowed: Range = ratio) -> Float[Array, " n"]:
    """Return a list of numbers in a range as an array."""
    array = allowed(name, values)
    array = array if array.ndim else array.reshape(1)
    if array.ndim != 1 or array.size == 0:
        raise ValueError(f"Argument `{name}` must be a list of at least one value, but has shape {array.shape}.")
    return array


# Results of an outcome that a surface keeps. They are computed with it, point by point. Spectra and maps compute the
# same ones, so a spectrum and a map of one pulse are one program.
_PEAKS = ("rotation_ratio", "velocity_ratio", "impact_count", "overturned", "margin", "status")
_STATES = ("state", "rotation_ratio", "impact_count", "margin", "status")


def _over(value: Array, size: Array) -> Array:
    """Divide by a size where the value is finite; an infinite value stays, with zero slopes in place of NaN."""
    finite = jnp.isfinite(value)
    return jnp.where(finite, jnp.where(finite, value, 0.0) / size, value)


def _kept(result: Outcome, block: Block) -> dict:
    """Return the results that a spectrum or a map keeps of an outcome."""
    rest = {name: getattr(result, name) for name in ("impact_count", "overturned", "margin", "status")}
    ratios = {
        "rotation_ratio": _over(result.max_rotation, block.alpha),
        "velocity_ratio": _over(result.max_velocity, block.p * block.alpha),
    }
    state = jnp.where(result.overturned, jnp.where(result.impact_count > 0, 2, 1), 0)
    return {"state": jnp.where(is_decided(result.status), state, -1), **ratios, **rest}


# Functions of surfaces. Arguments shared by all points lie in the scene, a pytree, so a second surface of a kind is not
# compiled again.


@cheap_per_point
def _under_motion(period, scene):
    shape, motion, model, engine = scene
    alpha, period = _in_one_precision(shape.alpha, period, of=motion)
    block = shape.sized(alpha, 2 * jnp.pi / period)
    return _kept(outcome(block, motion, model, engine=engine), block)


def under_pulse(*point_and_scene) -> tuple[Outcome, Block]:
    """Return the outcome at one point, and the block: `(*parameters, intensity, ratio, scene)`."""
    *point, (shape, pulse, model, engine) = point_and_scene
    alpha, *parameters, intensity, ratio = _in_one_precision(shape.alpha, *point)
    block = shape.sized(alpha, jnp.ones_like(alpha))
    motion = pulse(intensity * model.moments(block).threshold, 2 * jnp.pi / ratio, *parameters)
    return outcome(block, motion, model, engine=engine), block


def _in_one_precision(*numbers: Array, of: Any = ()) -> list[Array]:
    """Convert the numbers to the highest precision of them and of a tree's leaves.

    Otherwise a quantity made of one number alone has only that number's digits.
    """
    kind = jnp.result_type(*numbers, *jax.tree.leaves(of))
    return [x.astype(kind) for x in numbers]


@cheap_per_point
def _under_pulse(*point_and_scene) -> dict:
    return _kept(*under_pulse(*point_and_scene))
