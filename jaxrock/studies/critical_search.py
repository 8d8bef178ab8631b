"""The search for critical values of many scenes at once: all ends by `ends`, or the lowest by `lowest_ends`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxrock._arguments.parameters import broadcast, check_single, leaves_of, one_of_many
from jaxrock._core.arrays import is_traced, of_each, to_device
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.rigid import Block
from jaxrock.compiler import checks
from jaxrock.compiler.hints import jit_low_effort
from jaxrock.engines.scene import uplift_threshold
from jaxrock.models.equation import AbstractEquation
from jaxrock.motions.motion import AbstractMotion
from jaxrock.studies.critical_ends import PADDING, Critical, merged_ends
from jaxrock.studies.ends import brackets_of, roots_of
from jaxrock.studies.lowest_ends import lowest_ends
from jaxrock.studies.parameters import named, peak_of
from jaxrock.studies.search_axis import AbstractVaried, on_border
from jaxrock.sweeps.runner import cheap_per_point
from jaxrock.sweeps.sweep import known_surface, surface

_LEAST = 1e-12  # [g]; amplitudes are factors on a motion


class CriticalScenes(eqx.Module):
    """Many scenes: numbers have shape (scenes,), and samples of a record are shared by all."""

    both: PyTree  # block and motion
    threshold: Float[Array, " scenes"]  # [g]
    amplitude: Float[Array, " scenes"]  # as the motion names it [g]
    least: Float[Array, " scenes"]  # logarithm of the factor of the motion that reaches the threshold
    single: bool = eqx.field(static=True)

    @classmethod
    def of(cls, block: Block | AsymmetricBlock, motion: AbstractMotion, model: AbstractEquation) -> "CriticalScenes":
        """Broadcast all parameters against one another."""
        check_single(model=model)
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


def _names(both: PyTree, model: AbstractEquation) -> list[str]:
    """Names of the parameters of a scene, in the order of `named`, without computing the peak of a sum."""
    found: list[str] = []

    def tell(both, model):
        block, motion = one_of_many(both, 0)
        found.extend(named(block, motion, model))

    jax.eval_shape(tell, both, model)
    return found


# Functions of one point of one of many scenes.


@cheap_per_point
def _at(z, index, scene):
    kind, both = scene
    return kind.at(z, *one_of_many(both, index))


@cheap_per_point
def _slopes(z, index, scene):
    kind, both, peak = scene
    return kind.slopes(z, *one_of_many(both, index), peak[index])


@jit_low_effort(eqx.filter_jit)
def _slopes_of_units(kind: AbstractVaried, both: PyTree, peak: Array) -> dict[str, Array]:
    """Derivatives of the logarithms of the units of all scenes, whose peaks are costly: once, not at every end."""
    few = 16

    def one(index):
        return kind.slopes_of_unit(*one_of_many(both, index), peak[index])

    return jax.lax.map(one, jnp.arange(peak.size), batch_size=min(few, peak.size))


def critical_ends(
    scenes: CriticalScenes,
    grid: Float[Array | np.ndarray, "scenes points"],
    kind: AbstractVaried,
    *,
    derivatives: bool | None,
    most: int | None,
    narrowest: float | None,
    progress: bool | None,
) -> Critical:
    """Find all ends, or the `most` lowest; compute derivatives if they are requested; merge what is too narrow.

    `grid`: logarithms of the factors that are sampled first.
    """
    known = not is_traced((scenes, grid, kind))
    if most is None and not known:
        raise ValueError(
            "Argument `max_ends` must be given where arguments are traced (jax.jit, jax.vmap, a derivative): the "
            "number of ends is not known before."
        )
    names = tuple(filter(kind.keeps, _names(scenes.both, kind.model)))
    wanted = names if derivatives is None and known or derivatives else ()
    rows = (
        _all(scenes, grid, kind, wanted, progress)
        if most is None
        else _lowest(scenes, grid, kind, wanted, most, progress)
    )
    if not wanted:
        rows["derivative"] = to_device(np.full((*rows["value"].shape, len(names)), np.nan, rows["value"].dtype))
    rows["merged"] = to_device(np.zeros(grid.shape[0], int))
    found = Critical(**(of_each(lambda x: x[0], rows) if scenes.single else rows), names=names)
    return found if narrowest is None else merged_ends(found, narrowest, short=most is None)


def _all(scenes: CriticalScenes, grid, kind: AbstractVaried, names: tuple[str, ...], progress) -> dict:
    """Bracket all ends, polish and differentiate them, and sort them by scene."""

    def run(function, z, index, *more):
        return known_surface(function, (z, index), (kind, scenes.both, *more), "critical", progress, outer=False)

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
    intensity = kind.amplitude(value, amplitude) / threshold
    rows = {"value": value, "scale": np.exp(ends["z"]), "intensity": intensity}
    rows |= {name: ends[name] for name in ("rising", "impacts", "balanced")}
    if names:
        derivative = np.zeros((0, len(names)))
        if order.size:
            slopes = run(_slopes, ends["safe"], ends["index"], scenes.amplitude)
            own = jax.tree.map(np.asarray, _slopes_of_units(kind, scenes.both, scenes.amplitude))
            derivative = np.stack([slopes[name] + own[name][ends["index"]] for name in names], axis=-1)
            derivative *= value[:, None]
        rows["derivative"] = np.where(ends["balanced"][:, None], derivative, np.nan)
    count = np.bincount(ends["index"], minlength=grid.shape[0])
    place = np.arange(order.size) - np.repeat(np.cumsum(count) - count, count)

    def filled(name, values):
        table = np.full((grid.shape[0], int(count.max(initial=0)), *values.shape[1:]), PADDING[name], values.dtype)
        table[ends["index"], place] = values
        return table

    return to_device({name: filled(name, values) for name, values in rows.items()} | told | {"count": count})


class _Wanted(eqx.Module):
    """Static settings of a program: names of the derivatives, and the number of ends."""

    names: tuple[str, ...] = eqx.field(static=True)
    most: int = eqx.field(static=True)


def _lowest(scenes: CriticalScenes, grid, kind: AbstractVaried, names: tuple[str, ...], most: int, progress) -> dict:
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
    scale = jnp.exp(safe + (ends["z"] - ends["safe"]))
    value = scale * kind.unit(block, motion)
    amplitude = kind.amplitude(value, scenes.amplitude[index])
    rows = {"value": value, "scale": scale, "intensity": amplitude / scenes.threshold[index]}
    rows |= {name: ends[name] for name in ("rising", "impacts", "balanced")}
    if wanted.names:
        peak = scenes.amplitude[index]
        slopes = jax.vmap(lambda z: kind.slopes(z, block, motion, peak))(safe)
        own = kind.slopes_of_unit(block, motion, peak)
        derivative = jnp.stack([slopes[name] + own[name] for name in wanted.names], axis=-1) * value[:, None]
        rows["derivative"] = jnp.where(balanced[:, None], derivative, jnp.nan)

    def filled(name, values):
        return jnp.where(found.reshape(-1, *[1] * (values.ndim - 1)), values, PADDING[name])

    told = {name: ends[name] for name in ("complete", "from_the_least")} | {"count": found.sum()}
    return {name: filled(name, values) for name, values in rows.items()} | told
