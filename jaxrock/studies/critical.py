"""Critical amplitudes and durations: all ends of the intervals in which a block overturns.

Overturning is not monotonic in amplitude. Below the amplitude that overturns a block without impact, others overturn it
after one, three or five impacts. These intervals are ever narrower, and the safe gaps between them may be narrower
still. A bisection of the verdict finds one end by chance.

Here the margin, its slope and the number of impacts at sampled points tell where an end may hide between two of them.
Only there is the sampling refined. `ends` finds all ends; `lowest_ends` finds a given number of the lowest, stops there
and can be traced by JAX.
"""

from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxrock._arguments.annotations import arguments, at_least, pair
from jaxrock._arguments.parameters import broadcast, in_real_numbers, leaves_of, one_of_many
from jaxrock._arguments.ranges import ratio, scalar
from jaxrock._arguments.tables import AbstractTable, Column
from jaxrock._core.arrays import if_traced, is_traced, of_each, to_device
from jaxrock._core.one_program import one_program
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.rigid import Block
from jaxrock.compiler import checks
from jaxrock.compiler.hints import jit_low_effort
from jaxrock.engines.scene import uplift_threshold
from jaxrock.engines.stepper import AbstractEngine
from jaxrock.models.equation import AbstractEquation
from jaxrock.models.rigid import Housner
from jaxrock.motions.motion import AbstractMotion
from jaxrock.responses.current_model import current_model
from jaxrock.studies.ends import brackets_of, roots_of
from jaxrock.studies.lowest_ends import lowest_ends
from jaxrock.studies.parameters import named, peak_of
from jaxrock.studies.search_axis import AbstractVaried, Amplitude, Duration, check_sizeless, on_border
from jaxrock.sweeps.runner import cheap_per_point
from jaxrock.sweeps.sweep import known_surface, surface

_FIRST = 256  # intervals of the first sampling
_LEAST = 1e-12  # [g]; amplitudes are factors on a motion


class Critical(AbstractTable):
    """Ends of overturning intervals, in rising order; (ends,) for one scene, (scenes, ends) padded for many.

    - `count`: number of ends.
    - `value`: amplitude [g], or duration (or period) of the motion [s]; infinite where padded. Of a motion that
      names no amplitude (a record, a sum) it is the peak: over `intensity.peak_acceleration(motion)` a factor on it.
    - `intensity`: the amplitude over the uplift threshold [-].
    - `rising`: the block overturns above this end, and not below.
    - `impacts`: before it overturns, just beside this end.
    - `balanced`: the block comes to balance at this end. If not, the verdict jumps: an impact is grazed, or the shaking
      throws it flat; such an end has no derivatives here (NaN).
    - `complete`: whether every sampled point could be decided.
    - `names`, `derivative`: (..., ends, parameters) of `value` by the other parameters of the scene. For critical
      amplitudes the amplitude of the motion is left out: it only stands for the motion's size.
    - `from_the_least`: whether the block already overturns at the least value that was sampled.
    """

    count: Int[Array, "..."]
    value: Float[Array, "..."]
    intensity: Float[Array, "..."]
    rising: Bool[Array, "..."]
    impacts: Int[Array, "..."]
    balanced: Bool[Array, "..."]
    derivative: Float[Array, "..."]
    complete: Bool[Array, "..."]
    names: tuple[str, ...] = eqx.field(static=True)
    from_the_least: Bool[Array, "..."] = eqx.field(default_factory=lambda: jnp.zeros((), bool))

    @property
    @one_program
    def lowest(self) -> Float[Array, "..."]:
        """Least critical value above which a block overturns (over many scenes: a spectrum).

        Infinite if there is none. NaN where the block already overturns at the least value that was sampled: the
        critical value lies below it.
        """
        found = jnp.min(jnp.where(self.rising, self.value, jnp.inf), axis=-1, initial=jnp.inf)
        return jnp.where(self.from_the_least, jnp.nan, found)

    @property
    def _columns(self):
        scenes = () if self.value.ndim == 1 else ("scene",)
        ends, slopes = (*scenes, "end"), zip(self.names, jnp.moveaxis(self.derivative, -1, 0))
        each = {name: getattr(self, name) for name in ("intensity", "rising", "impacts", "balanced")}
        each |= {f"derivative.{name}": slope for name, slope in slopes}
        told = {name: Column(ends, values) for name, values in ({"value": self.value} | each).items()}
        return told | {name: Column(scenes, getattr(self, name)) for name in ("count", "complete", "from_the_least")}


@arguments
def critical_amplitudes(
    block: Block | AsymmetricBlock,
    motion: AbstractMotion,
    model: AbstractEquation = Housner(),
    *,
    intensity: Annotated[tuple[float, float], pair] = (1.0, 10.0),
    derivatives: bool | None = None,
    max_ends: Annotated[int | None, at_least(1, 256)] = None,
    engine: AbstractEngine | None = None,
    progress: bool | None = None,
) -> Critical:
    """Find all amplitudes of a motion at which a block begins or ceases to overturn.

    **Arguments:**

    - `block`, `motion`: one scene, or many: parameters of shape (scenes,). The amplitude of the motion plays no part.
    - `model`, `engine`: as in `outcome`.
    - `intensity`: search range: least and largest amplitude over the uplift threshold [-]. Below 1 nothing moves.
    - `derivatives`: whether to compute `derivative`; without, it is NaN. None: only for concrete arguments; for traced
      ones JAX differentiates `value` by the traced arguments.
    - `max_ends`: number of ends to find, from the lowest on, 1 to 256; results are padded to that number. None: all
      ends. Under records and over wide ranges this takes minutes, even if no more ends are found (the progress bar
      grows with the intervals still to be searched). Traced arguments need a number.
    - `progress`: as in `rocking_spectrum`.

    **Returns:** a `Critical`. An overturning interval may be missed if it is much narrower than the sampling and leaves
    no trace in the margins beside it. A safe gap between different numbers of impacts is not missed.
    With traced arguments (within `jax.jit`, `jax.vmap`, `jax.grad`) it is a plain function of arrays.

    **Raises:** ValueError for arguments outside their ranges.

    **Source:** Voyagaki et al. (2012), 3.11 (the balance); derivatives by the implicit function of the margin.
    """
    low, high = _rising("intensity", intensity)
    block, motion = in_real_numbers(block, motion)
    model = current_model(model, block, motion)
    scenes = _Scenes.of(block, motion, model)
    # Overturning intervals crowd towards the threshold, so the sampling is dense at the least amplitudes.
    grid = np.concatenate([[low], low + (high - low) * np.geomspace(1e-4, 1.0, _FIRST)])
    grid = np.log(grid) + if_traced(scenes.least)[:, None]
    return _critical(scenes, grid, Amplitude(model, engine), derivatives, max_ends, progress)


@arguments
def critical_durations(
    block: Block | AsymmetricBlock,
    motion: AbstractMotion,
    model: AbstractEquation = Housner(),
    *,
    factor: Annotated[tuple[float, float], pair] = (0.05, 20.0),
    derivatives: bool | None = None,
    max_ends: Annotated[int | None, at_least(1, 256)] = None,
    engine: AbstractEngine | None = None,
    progress: bool | None = None,
) -> Critical:
    """Find all durations of a motion of given amplitude at which a block begins or ceases to overturn.

    **Arguments:**

    - `block`, `motion`, `model`, `derivatives`, `max_ends`, `engine`, `progress`: as in `critical_amplitudes`.
    - `factor`: search range: least and largest duration over that of `motion` [-]; all times are stretched alike.

    **Returns:** a `Critical`; `value` is the duration of the whole motion [s].
    With traced arguments (within `jax.jit`, `jax.vmap`, `jax.grad`) it is a plain function of arrays.

    **Raises:** ValueError for arguments outside their ranges, and for laws of restitution and models of your own that
    depend on the speed of impacts, or on p.
    """
    low, high = _rising("factor", factor)
    block, motion = in_real_numbers(block, motion)
    model = current_model(model, block, motion)
    check_sizeless(block, model)
    scenes = _Scenes.of(block, motion, model)
    grid = np.linspace(np.log(low), np.log(high), _FIRST + 1)
    grid = np.broadcast_to(grid, (scenes.threshold.size, grid.size))
    return _critical(scenes, grid, Duration(model, engine), derivatives, max_ends, progress)


def _rising(name: str, ends: tuple[float, float]) -> tuple[float, float]:
    low, high = (float(scalar(name, ratio(name, end))) for end in ends)
    if low >= high:
        raise ValueError(f"Argument `{name}` must be rising, but is {ends}.")
    return low, high


class _Scenes(eqx.Module):
    """Many scenes: numbers have shape (scenes,), and samples of a record are shared by all."""

    both: PyTree  # block and motion
    threshold: Float[Array, " scenes"]  # [g]
    amplitude: Float[Array, " scenes"]  # as the motion names it [g]
    least: Float[Array, " scenes"]  # logarithm of the factor of the motion that reaches the threshold
    single: bool = eqx.field(static=True)

    @classmethod
    def of(cls, block: Block | AsymmetricBlock, motion: AbstractMotion, model: AbstractEquation) -> "_Scenes":
        """Broadcast all parameters against one another."""
        both = block, motion
        shape = jnp.broadcast_shapes(*(jnp.shape(leaf.value) for leaf in leaves_of(both) if not leaf.is_shared))
        if len(shape) > 1:
            raise ValueError(
                f"The parameters of `block` and `motion` must be numbers or lists, but have shape {shape}."
            )
        size = shape[0] if shape else 1
        both = broadcast(both, (size,))

        threshold, peak, amplitude, least = _facts(both, model, size)
        message = "Argument `motion` must move the ground"
        if is_traced(peak):
            least = checks.error_if(least, (peak <= _LEAST).any(), message)
        elif (np.asarray(peak) <= _LEAST).any():
            raise ValueError(f"{message}, but its peak is {np.nanmin(np.asarray(peak)):g} g.")
        return cls(both, threshold, amplitude, least, single=not shape)


@jit_low_effort(eqx.filter_jit)
def _facts(both: PyTree, model: AbstractEquation, size: int) -> tuple[Array, Array, Array, Array]:
    """Threshold, peak and amplitude of `size` scenes, and the log of the least factor that moves the block."""

    def one(index):
        block, motion = one_of_many(both, index)
        threshold, peak = uplift_threshold(block, model), peak_of(motion)
        return threshold, peak, jnp.abs(named(block, motion)["amplitude"]), jnp.log(threshold / peak)

    return jax.vmap(one)(jnp.arange(size))


def _names(both: PyTree) -> list[str]:
    """Names of the parameters of a scene, in the order of `named`, without computing the peak of a sum."""
    found = []
    jax.eval_shape(lambda both: found.extend(named(*one_of_many(both, 0))), both)
    return found


# Functions of one point of one of many scenes.


@cheap_per_point
def _at(z, index, scene):
    kind, both = scene
    return kind.at(z, *one_of_many(both, index))


@cheap_per_point
def _slopes(z, index, scene):
    kind, both = scene
    return kind.slopes(z, *one_of_many(both, index))


def _critical(
    scenes: _Scenes,
    grid: Float[Array | np.ndarray, "scenes points"],
    kind: AbstractVaried,
    derivatives: bool | None,
    most: int | None,
    progress: bool | None,
) -> Critical:
    """Find all ends, or the `most` lowest; compute derivatives if they are requested."""
    known = not is_traced((scenes, grid, kind))
    if most is None and not known:
        raise ValueError(
            "Argument `max_ends` must be given where arguments are traced (jax.jit, jax.vmap, a derivative): the "
            "number of ends is not known before."
        )
    names = tuple(filter(kind.keeps, _names(scenes.both)))
    wanted = names if derivatives is None and known or derivatives else ()
    rows = (
        _all(scenes, grid, kind, wanted, progress)
        if most is None
        else _lowest(scenes, grid, kind, wanted, most, progress)
    )
    if not wanted:
        rows["derivative"] = to_device(np.full((*rows["value"].shape, len(names)), np.nan, rows["value"].dtype))
    return Critical(**(of_each(lambda x: x[0], rows) if scenes.single else rows), names=names)


# Padding values of scenes with fewer ends.
_REST = {
    "value": np.inf, "intensity": np.inf, "rising": False, "impacts": 0, "balanced": False, "derivative": np.nan,
}  # fmt: skip


def _all(scenes: _Scenes, grid, kind: AbstractVaried, names: tuple[str, ...], progress) -> dict:
    """Bracket all ends, polish and differentiate them, and sort them by scene."""

    def run(function, z, index):
        return known_surface(function, (z, index), (kind, scenes.both), "critical", progress, outer=False)

    def at(z, index):
        return run(_at, z, index)

    brackets, told = brackets_of(at, np.asarray(grid))
    ends = roots_of(at, brackets)
    told["complete"][ends["index"][~ends["known"]]] = False
    order = np.lexsort((ends["z"], ends["index"]))
    ends = {name: values[order] for name, values in ends.items()}
    units = kind.units(scenes.both, scenes.amplitude)
    units, threshold, amplitude = (np.asarray(x)[ends["index"]] for x in (units, scenes.threshold, scenes.amplitude))
    value = np.exp(ends["z"]) * units
    rows = {"value": value, "intensity": kind.amplitude(value, amplitude) / threshold}
    rows |= {name: ends[name] for name in ("rising", "impacts", "balanced")}
    if names:
        derivative = np.zeros((0, len(names)))
        if order.size:
            slopes = run(_slopes, ends["safe"], ends["index"])
            derivative = np.stack([slopes[name] for name in names], axis=-1) * value[:, None]
        rows["derivative"] = np.where(ends["balanced"][:, None], derivative, np.nan)
    count = np.bincount(ends["index"], minlength=grid.shape[0])
    place = np.arange(order.size) - np.repeat(np.cumsum(count) - count, count)

    def filled(name, values):
        table = np.full((grid.shape[0], int(count.max(initial=0)), *values.shape[1:]), _REST[name], values.dtype)
        table[ends["index"], place] = values
        return table

    return to_device({name: filled(name, values) for name, values in rows.items()} | told | {"count": count})


class _Wanted(eqx.Module):
    """Static settings of a program: names of the derivatives, and the number of ends."""

    names: tuple[str, ...] = eqx.field(static=True)
    most: int = eqx.field(static=True)


def _lowest(scenes: _Scenes, grid, kind: AbstractVaried, names: tuple[str, ...], most: int, progress) -> dict:
    """Find the `most` lowest ends of every scene; many scenes are the points of a surface."""
    scene = _Wanted(names, most), kind, scenes, grid
    if scenes.single:  # a surface would pad one scene to a full chunk of lanes
        return jax.tree.map(lambda x: x[None], _lowest_of_one(0, scene))
    return surface(_lowest_of_one, (jnp.arange(grid.shape[0]),), scene, "critical", progress)


@jit_low_effort(follows_scenes=True)
def _lowest_of_one(index, scene) -> dict:
    """Find ends without derivatives, then attach those of the implicit function."""
    wanted, kind, scenes, grid = scene
    block, motion = one_of_many(scenes.both, index)
    known, *place = jax.lax.stop_gradient((kind, block, motion))
    ends = lowest_ends(lambda z: known.at(z, *place), jax.lax.stop_gradient(grid[index]), wanted.most)
    found, balanced = ends["found"], ends["balanced"] & ends["found"]
    safe = on_border(ends["safe"], found, balanced, (kind, block, motion))
    value = jnp.exp(safe + (ends["z"] - ends["safe"])) * kind.unit(block, motion)
    amplitude = kind.amplitude(value, scenes.amplitude[index])
    rows = {"value": value, "intensity": amplitude / scenes.threshold[index]}
    rows |= {name: ends[name] for name in ("rising", "impacts", "balanced")}
    if wanted.names:
        slopes = jax.vmap(lambda z: kind.slopes(z, block, motion))(safe)
        derivative = jnp.stack([slopes[name] for name in wanted.names], axis=-1) * value[:, None]
        rows["derivative"] = jnp.where(balanced[:, None], derivative, jnp.nan)

    def filled(name, values):
        return jnp.where(found.reshape(-1, *[1] * (values.ndim - 1)), values, _REST[name])

    told = {name: ends[name] for name in ("complete", "from_the_least")} | {"count": found.sum()}
    return {name: filled(name, values) for name, values in rows.items()} | told
