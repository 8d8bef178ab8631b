"""Motions that rocks allow: likelihood regions over two parameters, and the largest motion that was not exceeded."""

from collections.abc import Callable, Mapping
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxrock._arguments.annotations import arguments, pair
from jaxrock._arguments.parameters import shared
from jaxrock._arguments.ranges import finite, scalar, size
from jaxrock._arguments.tables import AbstractTable, Column
from jaxrock._core.arrays import Values, shown, to_device
from jaxrock._core.progress import Progress
from jaxrock.engines.stepper import AbstractEngine
from jaxrock.inverse.batches import in_batches
from jaxrock.inverse.likelihood import Likelihood, as_program
from jaxrock.inverse.observations import SEEN_TOPPLED, Observations
from jaxrock.models.equation import AbstractEquation
from jaxrock.models.rigid import Housner
from jaxrock.motions.mirrored import has_vertical, scaled_and_mirrored
from jaxrock.motions.motion import AbstractMotion
from jaxrock.motions.pulses import UNITS
from jaxrock.studies.critical import critical_amplitudes
from jaxrock.studies.parameters import amplitude_of
from jaxrock.studies.spectra import axis

_LANES = 64  # motions in one call of the compiled program


class FeasibleRegion(AbstractTable):
    """The log-likelihood of observations over two parameters of a motion.

    - `names`: of the two parameters; `values`: (rows,) of the first and (columns,) of the second.
    - `log_likelihood`: (rows, columns).
    - `allowed`: (rows, columns), whether a motion is within the 95 % region of two parameters: its log-likelihood is
      less than 3.00 below the best of the map.
    """

    names: tuple[str, str] = eqx.field(static=True)
    values: tuple[Float[Array, " rows"], Float[Array, " columns"]]
    log_likelihood: Float[Array, "rows columns"]
    allowed: Bool[Array, "rows columns"]

    @property
    def _columns(self):
        return {
            **{name: Column((name,), x, UNITS.get(name, "unknown")) for name, x in zip(self.names, self.values)},
            "log_likelihood": Column(self.names, self.log_likelihood),
            "allowed": Column(self.names, self.allowed),
        }


@arguments
def feasible_region(
    likelihood: Likelihood,
    over: Mapping[str, Values],
    fixed: Mapping[str, ArrayLike] | None = None,
    *,
    progress: bool | None = None,
) -> FeasibleRegion:
    """Map the likelihood of observations over two parameters of a motion.

    **Arguments:**

    - `likelihood`: a `Likelihood`.
    - `over`: two parameters by name, with lists of values.
    - `fixed`: values of the motion's other parameters, if it has more, for example those of an `Estimate`.
    - `progress`: whether to draw a progress bar; None: on a terminal, if it takes long.

    **Returns:** a `FeasibleRegion`.

    **Raises:** ValueError unless there are two parameters with lists of finite values.
    """
    if len(over) != 2:
        raise ValueError(f"Argument `over` must name two parameters, but names {len(over)}.")
    lists = {name: axis(f"over[{name!r}]", values, finite) for name, values in over.items()}
    rows, columns = (x.ravel() for x in np.meshgrid(*lists.values(), indexing="ij"))
    rest = {name: scalar(f"fixed[{name!r}]", finite(f"fixed[{name!r}]", x)) for name, x in (fixed or {}).items()}
    likelihood = likelihood.current((*lists, *rest))
    bar = Progress(rows.size, "region", progress)

    def likely(motions, wanted):
        values: dict[str, ArrayLike] = {**dict(zip(lists, motions.T)), **rest}
        return [np.sum(as_program(Likelihood.terms, likelihood, values, False, wanted), axis=-1)]

    (found,) = in_batches(likely, np.stack([rows, columns], axis=1), _LANES, bar.add)
    total = found.reshape(*(x.size for x in lists.values()))
    # Half the 95 % quantile of chi-square with two degrees of freedom, -ln 0.05.
    (first, second), (across, up) = lists, lists.values()
    return FeasibleRegion((first, second), (across, up), *to_device((total, total > total.max() + np.log(0.05))))


class Unexceeded(AbstractTable):
    """The largest motions that all rocks survive, together with all weaker ones.

    - `durations`: (n,) [s].
    - `amplitude`: (n,) largest amplitude [g], as passed to the motion, up to which every rock stands. It is infinite
      where no amplitude tried topples a rock, and NaN where the least one topples a rock.
    - `by_rock`: (rocks, n) this amplitude for each standing rock alone.
    - `weakest`: (n,) index, from 0 among all rocks, of the rock that limits the amplitude; -1 where none does.
    - `complete`: (n,) whether every amplitude tried was decided, and the least topples no rock.
    """

    durations: Float[Array, " n"]
    amplitude: Float[Array, " n"]
    by_rock: Float[Array, "rocks n"]
    weakest: Int[Array, " n"]
    complete: Bool[Array, " n"]

    @property
    def _columns(self):
        return {
            "duration": Column(("duration",), self.durations, "s"),
            "amplitude": Column(("duration",), self.amplitude, "g"),
            "weakest": Column(("duration",), self.weakest),
            "complete": Column(("duration",), self.complete),
            "amplitude_by_rock": Column(("rock", "duration"), self.by_rock, "g"),
        }


@arguments
def unexceeded_motion(
    observations: Observations,
    motion: Callable,
    durations: Values,
    *,
    intensity: Annotated[tuple[float, float], pair] = (1.0, 20.0),
    model: AbstractEquation = Housner(),
    engine: AbstractEngine | None = None,
    progress: bool | None = None,
) -> Unexceeded:
    """Find the largest motion up to which all standing rocks would have stood, for each duration.

    Rocks have their stated values, and the motion is the same at all of them: no scatter. Amplitudes between two
    overturning intervals do not count as safe. A rock of unknown orientation counts with the orientation in which it
    survives the larger motion.

    **Arguments:**

    - `observations`: an `Observations`; rocks that toppled are left out.
    - `motion`: `motion(amplitude, duration)` makes it, such as `SinePulse`, or
      `lambda amplitude, duration: amplitude * rk.Record(samples, duration / 100)`: samples of a record must not depend
      on either.
    - `durations`: (n,) durations or periods [s], positive.
    - `intensity`, `model`, `engine`, `progress`: as in `critical_amplitudes`.

    **Returns:** an `Unexceeded`.

    **Raises:** ValueError for arguments outside their ranges, or if no rock stands.
    """
    durations = axis("durations", durations, size)
    standing = np.flatnonzero(np.asarray(observations.seen) != SEEN_TOPPLED)
    if standing.size == 0:
        raise ValueError("Argument `observations` must hold a rock that stands.")
    seen = observations.of(standing)
    ways, count = np.asarray(seen.ways), durations.size
    blocks = to_device(jax.tree.map(lambda x: np.tile(np.repeat(x, count), len(ways)), seen.blocks))
    motions, own = _motions(motion, *to_device((np.repeat(ways.ravel(), count), np.tile(durations, ways.size))))
    critical = critical_amplitudes(
        blocks,
        motions,
        model,
        intensity=intensity,
        derivatives=False,
        engine=engine,
        progress=progress,
    )
    # Of the two orientations take the larger amplitude; NaN where the least amplitude topples the rock in both.
    by_rock = np.fmax.reduce((np.asarray(critical.lowest) / np.asarray(own)).reshape(*ways.shape, count), axis=0)
    amplitude = by_rock.min(axis=0)
    weakest = np.where(np.isposinf(amplitude), -1, standing[np.argmin(by_rock, axis=0)])
    complete = np.asarray(critical.complete).reshape(-1, count).all(axis=0) & ~np.isnan(amplitude)
    return Unexceeded(*to_device((np.asarray(durations), amplitude, by_rock, weakest, complete)))


def _motions(motion: Callable, ways: Array, duration: Array) -> tuple[AbstractMotion, Array]:
    """Return all motions of unit amplitude in one batched motion, and the amplitude that each declares.

    `ways` is 1 or -1, the sign of each motion. Motions of all durations share the samples of a record.
    """
    first = [jax.ShapeDtypeStruct((), x.dtype) for x in (ways, duration)]
    one = eqx.filter_eval_shape(motion, *first)
    if not isinstance(one, AbstractMotion):
        raise ValueError(f"Argument `motion` must make a motion of amplitude and duration, but makes {shown(one)}.")
    is_level = not has_vertical(one)

    def turned(way, duration):
        return motion(way, duration) if is_level else scaled_and_mirrored(motion(jnp.ones_like(way), duration), way)

    like = eqx.filter_eval_shape(turned, *first)
    axes = jax.tree.map(lambda own: None if own else 0, shared(like))
    try:
        made = jax.vmap(turned, out_axes=axes)(ways, duration)
    except ValueError as error:
        if "out_axes" not in str(error):
            raise
        said = "whose samples do not depend on amplitude and duration: scale it outside, `amplitude * rk.Record(...)`"
        raise ValueError(f"Argument `motion` must make a motion {said}.") from None
    # Without `jit` each operation would compile a program of its own, dozens in all.
    return made, jax.jit(jax.vmap(lambda each: jnp.abs(amplitude_of(each)), in_axes=(axes,)))(made)
