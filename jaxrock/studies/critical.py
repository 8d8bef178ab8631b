"""Critical amplitudes and durations: all ends of the intervals in which a block overturns.

Whether a block overturns is not monotonic: below the amplitude that overturns it without impact there are others
that do so after one, three, five impacts, in ever narrower intervals, and safe gaps between them that may be narrower
still. A bisection of the verdict finds one end of them by chance. Here the margin, its slope and the number of impacts
at sampled points tell where something may hide between two of them, and only there the sampling is refined.
"""

from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxrock._arguments import arguments, pair
from jaxrock._checks import ratio, scalar
from jaxrock._parameters import broadcast, leaves_of, one_of_many
from jaxrock._tables import AbstractTable, Column
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.rigid import Block
from jaxrock.engines.scene import peak_bound, uplift_threshold
from jaxrock.engines.stepper import AbstractEngine
from jaxrock.models.equation import AbstractEquation
from jaxrock.models.rigid import Housner
from jaxrock.motions.motion import AbstractMotion, Scaled
from jaxrock.responses.current_model import current_model
from jaxrock.responses.outcome import outcome
from jaxrock.status import Status
from jaxrock.studies.ends import brackets_of, roots_of
from jaxrock.studies.parameters import named, rebuilt
from jaxrock.sweeps.sweep import surface

_FIRST = 256  # intervals of the first sampling
_LEAST = 1e-12  # [g]; amplitudes are factors on a motion


class Critical(AbstractTable):
    """Ends of overturning intervals, in rising order; (ends,) for one scene, (scenes, ends) for many, then filled up.

    - `count`: number of ends.
    - `value`: amplitude [g], or duration (or period) of the motion [s]; infinite where filled up.
    - `intensity`: the amplitude over the uplift threshold [-].
    - `rising`: the block overturns above this end, and not below.
    - `impacts`: before it overturns, just beside this end.
    - `balanced`: the block comes to balance at this end. If not, the verdict jumps: an impact is grazed, or the shaking
      throws it flat; such an end has no derivatives here (NaN).
    - `complete`: whether every point that was looked at could be decided.
    - `names`, `derivative`: (..., ends, parameters) of `value` by the other parameters of the scene; the amplitude of
      a motion stands for its size, and is left out for critical amplitudes.
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

    @property
    def lowest(self) -> Float[Array, "..."]:
        """The least critical value above which a block overturns (over many scenes: a spectrum); infinite if none."""
        return jnp.min(jnp.where(self.rising, self.value, jnp.inf), axis=-1, initial=jnp.inf)

    @property
    def _columns(self):
        scenes = () if self.value.ndim == 1 else ("scene",)
        ends, slopes = (*scenes, "end"), zip(self.names, jnp.moveaxis(self.derivative, -1, 0))
        each = {name: getattr(self, name) for name in ("intensity", "rising", "impacts", "balanced")}
        each |= {f"derivative.{name}": slope for name, slope in slopes}
        told = {name: Column(ends, values) for name, values in ({"value": self.value} | each).items()}
        return told | {name: Column(scenes, getattr(self, name)) for name in ("count", "complete")}


@arguments
def critical_amplitudes(
    block: Block | AsymmetricBlock,
    motion: AbstractMotion,
    model: AbstractEquation = Housner(),
    *,
    intensity: Annotated[tuple[float, float], pair] = (1.0, 10.0),
    derivatives: bool = True,
    engine: AbstractEngine | None = None,
    progress: bool | None = None,
) -> Critical:
    """All amplitudes of a motion at which a block begins or ceases to overturn.

    **Arguments:**

    - `block`, `motion`: one scene, or many: parameters of shape (scenes,). The amplitude of the motion plays no part.
    - `model`, `engine`: as in `outcome`.
    - `intensity`: where to look: least and largest amplitude over the uplift threshold [-]. Below 1 nothing moves.
    - `derivatives`: whether to find them; without, they are not numbers (NaN).
    - `progress`: as in `rocking_spectrum`.

    **Returns:** a `Critical`. Intervals of overturning that are much narrower than the sampling and give no sign of
    themselves beside them may be missed; a safe gap between different numbers of impacts is not.

    **Raises:** ValueError for arguments outside their ranges; TypeError within `jax.jit`, `jax.vmap` or a derivative,
    as the number of ends is not known before: `derivative` has what these would give.

    **Source:** Voyagaki et al. (2012), 3.11 (the balance); derivatives by the implicit function of the margin.
    """
    low, high = _rising("intensity", intensity)
    model = current_model(model, block, motion)
    scenes = _Scenes.of(block, motion, model)
    # Dense where the least amplitudes are: overturning intervals crowd towards the threshold.
    grid = np.concatenate([[low], low + (high - low) * np.geomspace(1e-4, 1.0, _FIRST)])
    factors = grid * (scenes.threshold / scenes.peak)[:, None]
    return _critical(scenes, np.log(factors), _Amplitude(model, engine), derivatives, progress)


@arguments
def critical_durations(
    block: Block | AsymmetricBlock,
    motion: AbstractMotion,
    model: AbstractEquation = Housner(),
    *,
    factor: Annotated[tuple[float, float], pair] = (0.05, 20.0),
    derivatives: bool = True,
    engine: AbstractEngine | None = None,
    progress: bool | None = None,
) -> Critical:
    """All durations of a motion of given amplitude at which a block begins or ceases to overturn.

    **Arguments:**

    - `block`, `motion`, `model`, `derivatives`, `engine`, `progress`: as in `critical_amplitudes`.
    - `factor`: where to look: least and largest duration over that of `motion` [-], all times stretched alike.

    **Returns:** a `Critical`; `value` is the duration of the whole motion [s].

    **Raises:** as `critical_amplitudes`.
    """
    low, high = _rising("factor", factor)
    if block.law.depends_on_speed:  # a longer motion is taken as a larger p, which makes impacts faster
        raise ValueError("Argument `block` must have a restitution that does not depend on the speed of impacts.")
    model = current_model(model, block, motion)
    scenes = _Scenes.of(block, motion, model)
    grid = np.linspace(np.log(low), np.log(high), _FIRST + 1)
    grid = np.broadcast_to(grid, (scenes.threshold.size, grid.size))
    return _critical(scenes, grid, _Duration(model, engine), derivatives, progress)


def _rising(name: str, ends: tuple[float, float]) -> tuple[float, float]:
    low, high = (float(scalar(name, ratio(name, end))) for end in ends)
    if low >= high:
        raise ValueError(f"Argument `{name}` must be rising, but is {ends}.")
    return low, high


class _Scenes(eqx.Module):
    """Many scenes: parameters of shape (scenes,), samples of a record as they are."""

    block: Block | AsymmetricBlock
    motion: AbstractMotion
    threshold: np.ndarray  # [g], (scenes,)
    peak: np.ndarray  # bound of the acceleration [g]
    amplitude: np.ndarray  # as the motion names it [g]
    single: bool = eqx.field(static=True)

    @classmethod
    def of(cls, block: Block | AsymmetricBlock, motion: AbstractMotion, model: AbstractEquation) -> "_Scenes":
        """Broadcast all parameters against one another."""
        both = block, motion
        if any(isinstance(leaf.value, jax.core.Tracer) for leaf in leaves_of(both)):
            raise TypeError(
                "Critical values are searched from what was found before, so they cannot be traced (jax.jit, jax.vmap, "
                "jax.grad): give all scenes in one call, and take `derivative`."
            )
        shape = jnp.broadcast_shapes(*(jnp.shape(leaf.value) for leaf in leaves_of(both) if not leaf.is_shared))
        if len(shape) > 1:
            raise ValueError(
                f"The parameters of `block` and `motion` must be numbers or lists, but have shape {shape}."
            )
        size = shape[0] if shape else 1
        block, motion = broadcast(both, (size,))

        def facts(index):
            block_, motion_ = one_of_many((block, motion), index)
            return (
                uplift_threshold(block_, model),
                peak_bound(motion_),
                jnp.abs(named(block_, motion_)["amplitude"]),
            )

        found = cls(block, motion, *map(np.asarray, jax.vmap(facts)(jnp.arange(size))), single=not shape)
        if not (found.peak > _LEAST).all():
            raise ValueError(f"Argument `motion` must move the ground, but its peak is {found.peak.min():g} g.")
        return found


# What is varied: z is the logarithm of a factor.


class _Kind(eqx.Module):
    model: AbstractEquation
    engine: AbstractEngine | None

    def margin(self, z, block, motion):
        """Margin and outcome of the scene with the factor e^z."""
        result = outcome(*self.scene(z, block, motion), self.model, engine=self.engine)
        return result.margin, result

    def at(self, z, index, scenes):
        """Margin, its slope, impacts and status of one point."""
        place = one_of_many(scenes, index)
        margin, slope, result = jax.jvp(lambda z: self.margin(z, *place), (z,), (jnp.ones_like(z),), has_aux=True)
        decided = (result.status == Status.successful) | (result.status == Status.undecided)
        return jnp.where(decided, margin, jnp.nan), slope, result.impact_count

    def slopes(self, z, index, scenes):
        """Derivatives of the logarithm of the critical value by the parameters."""
        block, motion = one_of_many(scenes, index)
        values = {name: jnp.asarray(value) for name, value in named(block, motion).items() if self.keeps(name)}

        def margin(z, values):
            place = rebuilt(block, motion, named(block, motion) | values)
            return self.margin(z, *place)[0]

        def unit(values):
            return jnp.log(self.unit(*rebuilt(block, motion, named(block, motion) | values)))

        by_z, by_values = jax.jacfwd(margin, argnums=(0, 1))(z, values)
        own = jax.jacfwd(unit)(values)
        by_z = jnp.where(by_z == 0, jnp.nan, by_z)
        return {name: own[name] - slope / by_z for name, slope in by_values.items()}


class _Amplitude(_Kind):
    def scene(self, z, block, motion):
        """A larger motion."""
        return block, Scaled(motion, jnp.exp(z))

    def unit(self, block, motion):
        """What the factor multiplies: the amplitude [g]."""
        return jnp.abs(named(block, motion)["amplitude"])

    def keeps(self, name: str) -> bool:
        """Whether the critical value depends on a parameter."""
        return name != "amplitude"


class _Duration(_Kind):
    def scene(self, z, block, motion):
        """A longer motion is a larger p: only their product counts."""
        return eqx.tree_at(lambda b: b.p, block, block.p * jnp.exp(z)), motion

    def unit(self, block, motion):
        """What the factor multiplies: the duration of the motion [s]."""
        return motion.end

    def keeps(self, name: str) -> bool:
        """Whether the critical value depends on a parameter."""
        return name not in ("duration", "period", "dt")


def _at(z, index, scene):
    kind, scenes = scene
    return kind.at(z, index, scenes)


def _slopes(z, index, scene):
    kind, scenes = scene
    return kind.slopes(z, index, scenes)


def _critical(scenes: _Scenes, grid: np.ndarray, kind: _Kind, derivatives: bool, progress: bool | None) -> Critical:
    """Search, find, differentiate, and sort by scenes."""
    scene = scenes.block, scenes.motion

    def run(function, z, index):
        return surface(function, (z, index), (kind, scene), "critical", progress, outer=False)

    def at(z, index):
        return tuple(map(np.asarray, run(_at, z, index)))

    brackets, complete = brackets_of(at, grid)
    ends = roots_of(at, brackets)
    order = np.lexsort((ends["z"], ends["index"]))
    ends = {name: values[order] for name, values in ends.items()}
    names = tuple(name for name in named(*one_of_many(scene, 0)) if kind.keeps(name))
    units = np.asarray(jax.vmap(lambda index: kind.unit(*one_of_many(scene, index)))(jnp.arange(grid.shape[0])))
    value = np.exp(ends["z"]) * units[ends["index"]]
    derivative = np.full((order.size, len(names)), np.nan)
    if derivatives and order.size:
        slopes = run(_slopes, ends["safe"], ends["index"])
        derivative = np.stack([np.asarray(slopes[name]) for name in names], axis=-1) * value[:, None]
        derivative[~ends["balanced"]] = np.nan
    amplitude = value if isinstance(kind, _Amplitude) else scenes.amplitude[ends["index"]]
    rows = {
        "value": (value, np.inf),
        "intensity": (amplitude / scenes.threshold[ends["index"]], np.inf),
        "rising": (ends["rising"], False),
        "impacts": (ends["impacts"], 0),
        "balanced": (ends["balanced"], False),
        "derivative": (derivative, np.nan),
    }
    count = np.bincount(ends["index"], minlength=grid.shape[0])
    place = np.arange(order.size) - np.repeat(np.cumsum(count) - count, count)

    def filled(values, rest):
        table = np.full((grid.shape[0], int(count.max(initial=0)), *values.shape[1:]), rest, values.dtype)
        table[ends["index"], place] = values
        return jnp.asarray(table[0] if scenes.single else table)

    first = 0 if scenes.single else slice(None)
    counts = jnp.asarray(count[first]), jnp.asarray(complete[first])
    return Critical(counts[0], *(filled(*row) for row in rows.values()), complete=counts[1], names=names)
