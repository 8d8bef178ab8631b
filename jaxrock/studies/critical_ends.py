"""Critical values of scenes: ends of overturning intervals, and how thin intervals are merged."""

from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxrock._arguments.annotations import arguments, known
from jaxrock._arguments.ranges import not_negative
from jaxrock._arguments.tables import AbstractTable, Column
from jaxrock._core.arrays import is_traced, of_each
from jaxrock._core.one_program import one_program

# Padding values of scenes with fewer ends.
PADDING = {
    "value": np.inf, "scale": np.inf, "intensity": np.inf, "rising": False, "impacts": 0, "balanced": False,
    "derivative": np.nan,
}  # fmt: skip


class Critical(AbstractTable):
    """Ends of overturning intervals, in rising order; (ends,) for one scene, (scenes, ends) padded for many.

    Below and above an end the verdicts differ, so ends rise and fall in turn (but beside points that are not decided).

    - `count`: number of ends.
    - `value`: amplitude [g], or duration (or period) of the motion [s]; infinite where padded. Of a motion that
      names no amplitude (a record, a sum) it is the peak acceleration; `scale` is the factor on the motion itself.
    - `intensity`: the amplitude over the uplift threshold [-].
    - `rising`: the block overturns above this end, and not below.
    - `impacts`: before it overturns, just beside this end.
    - `balanced`: the block comes to balance at this end. If not, the verdict jumps: an impact is grazed, or the shaking
      throws it flat; such an end has no derivatives here (NaN).
    - `complete`: whether every sampled point could be decided. If not, ends may be missing. Within 1e-8 of an end
      (relative) no point needs to be decided.
    - `names`, `derivative`: (..., ends, parameters) of `value` by the other parameters of the scene, with names as in
      `sensitivity`. For critical amplitudes the amplitude of the motion is left out: it only stands for the motion's
      size.
    - `from_the_least`: whether the block already overturns at the least value that was sampled.
    - `scale`: `value` over that of the motion as it was given [-]: the factor on a record, on the amplitude of a pulse,
      or on the duration; infinite where padded. None for ends that were put together by hand.
    - `merged`: number of thin intervals and safe gaps that were merged into what surrounds them (see `without_thin`).
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
    scale: Float[Array, "..."] | None = None
    merged: Int[Array, "..."] = eqx.field(default_factory=lambda: jnp.zeros((), int))

    @property
    @one_program
    def lowest(self) -> Float[Array, "..."]:
        """Least critical value above which a block overturns (over many scenes: a spectrum).

        Infinite if there is none. NaN where the block already overturns at the least value that was sampled: the
        critical value lies below it.
        """
        found = jnp.min(jnp.where(self.rising, self.value, jnp.inf), axis=-1, initial=jnp.inf)
        return jnp.where(self.from_the_least, jnp.nan, found)

    @arguments
    def without_thin(self, narrowest: Annotated[float, known(not_negative)]) -> "Critical":
        """Merge overturning intervals and safe gaps that are thin into what surrounds them, the thinnest first.

        Both ends of a thin one are left out, so the others rise and fall in turn. An interval or gap that reaches to
        the least or the largest value that was searched is not thin, because its other end is not known.

        **Arguments:**

        - `narrowest`: intervals and gaps are thin if they are narrower, relative to their lower end [-]; 0 or more.

        **Returns:** the ends that are left, as short as they can be (within `jax.jit` and the like padded to the same
        length), and in `merged` the number of intervals and gaps that were merged.

        **Raises:** ValueError for an argument outside its range.
        """
        return merged_ends(self, narrowest, short=not is_traced(self))

    @property
    def _columns(self):
        scenes = () if self.value.ndim == 1 else ("scene",)
        ends, slopes = (*scenes, "end"), zip(self.names, jnp.moveaxis(self.derivative, -1, 0))
        each = {name: getattr(self, name) for name in ("intensity", "rising", "impacts", "balanced")}
        each |= {f"derivative.{name}": slope for name, slope in slopes}
        each = {"value": self.value, "scale": self.scale} | each
        told = {name: Column(ends, values) for name, values in each.items()}
        of_scenes = ("count", "complete", "from_the_least", "merged")
        return told | {name: Column(scenes, getattr(self, name)) for name in of_scenes}


def intervals_of(ends: Critical) -> list[tuple[int | None, int | None]]:
    """Return the places of both ends of every overturning interval of one scene.

    None: the interval reaches beyond what was searched. Where ends are missing, because points between them are not
    decided, the safe gap there is left out.
    """
    found: list[tuple[int | None, int | None]] = []
    inside, start = bool(ends.from_the_least), None
    for k, rising in enumerate(np.asarray(ends.rising)[: int(ends.count)].tolist()):
        if rising and not inside:
            inside, start = True, k
        elif inside and not rising:
            found.append((start, k))
            inside, start = False, None
    return [*found, (start, None)] if inside else found


def merged_ends(ends: Critical, narrowest: float, *, short: bool) -> Critical:
    """Merge thin intervals and gaps, as `Critical.without_thin` does; `short`: leave out places that no scene needs."""
    rows = {name: getattr(ends, name) for name in PADDING if getattr(ends, name) is not None}
    rows, removed = _without_thin(rows, jnp.asarray(narrowest, ends.value.dtype))
    changed = rows | {"count": ends.count - 2 * removed, "merged": ends.merged + removed}
    if short:
        most, axis = int(np.max(np.asarray(changed["count"]), initial=0)), ends.value.ndim - 1
        changed |= of_each(lambda x: x[(slice(None),) * axis + (slice(most),)], rows)
    given = {name: getattr(ends, name) for name in ends.__dataclass_fields__}
    return Critical(**(given | changed))


@one_program
def _without_thin(rows: dict[str, Array], narrowest: Float[Array, ""]) -> tuple[dict[str, Array], Int[Array, "..."]]:
    """Return padded rows of ends without thin intervals and gaps, and how many of these there were."""

    def of_scene(rows):
        order, removed = _order_without_thin(jax.lax.stop_gradient(rows["value"]), rows["rising"], narrowest)

        def taken(name, values):
            padding = jnp.full_like(values, PADDING[name], shape=(1, *values.shape[1:]))
            return jnp.concatenate([values, padding])[order]

        return {name: taken(name, values) for name, values in rows.items()}, removed

    for _ in range(rows["value"].ndim - 1):
        of_scene = jax.vmap(of_scene)
    return of_scene(rows)


def _order_without_thin(
    value: Float[Array, " ends"], rising: Bool[Array, " ends"], narrowest: Float[Array, ""]
) -> tuple[Int[Array, " ends"], Int[Array, ""]]:
    """Return the places of the ends that are left, then `ends` as often as a place is free, and the number merged."""
    count = value.size
    if count < 2:
        return jnp.arange(count), jnp.zeros((), int)
    value, rising = jnp.append(value, jnp.inf), jnp.append(rising, False)

    def widths(order):
        low, high = value[order[:-1]], value[order[1:]]
        both = jnp.isfinite(high) & (rising[order[:-1]] != rising[order[1:]])
        return jnp.where(both, high / jnp.where(both, low, 1.0) - 1, jnp.inf)

    def without_thinnest(carry):
        order, removed = carry
        later = jnp.concatenate([order[2:], jnp.full(2, count, order.dtype)])
        return jnp.where(jnp.arange(count) < jnp.argmin(widths(order)), order, later), removed + 1

    start = jnp.arange(count), jnp.zeros((), int)
    return jax.lax.while_loop(lambda carry: widths(carry[0]).min() < narrowest, without_thinnest, start)
