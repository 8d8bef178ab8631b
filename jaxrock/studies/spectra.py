"""Whole surfaces: rocking spectra and overturning maps."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxrock._arguments import arguments
from jaxrock._checks import Range, Values, ratio
from jaxrock.blocks.restitution import AbstractRestitution, Restitution
from jaxrock.blocks.rigid import Block
from jaxrock.engines.stepper import AbstractEngine
from jaxrock.models.equation import AbstractEquation
from jaxrock.models.rigid import Housner
from jaxrock.motions.motion import AbstractMotion
from jaxrock.motions.pulses.sinusoidal import SinePulse
from jaxrock.responses.current_model import current_model
from jaxrock.responses.outcome import Outcome, outcome
from jaxrock.status import Status
from jaxrock.sweeps.sweep import surface
from jaxrock.transforms.user_function import current_function


class Spectrum(eqx.Module):
    """A rocking spectrum; every result has the shape (..., len(abscissa)).

    - `abscissa`: 2 pi/p [s], or the frequency ratio omega/p [-] of a self-similar spectrum.
    - `max_rotation`: peak |rotation| over alpha [-]; infinite where the block overturned.
    - `max_velocity`: peak |angular velocity| over p alpha [-]; infinite where the block overturned.
    - `impact_count`, `overturned`, `margin`, `status`: as in `Outcome`.
    - `intensity`: peak acceleration over the uplift threshold [-], one per row (self-similar spectrum), or None.
    """

    abscissa: Float[Array, " n"]
    max_rotation: Float[Array, "*rows n"]
    max_velocity: Float[Array, "*rows n"]
    impact_count: Int[Array, "*rows n"]
    overturned: Bool[Array, "*rows n"]
    margin: Float[Array, "*rows n"]
    status: Status
    intensity: Float[Array, " rows"] | None = None


class OverturningMap(eqx.Module):
    """An overturning map; every result has the shape (len(intensity), len(frequency_ratio)).

    - `frequency_ratio`: omega/p [-]; `intensity`: peak acceleration over the uplift threshold [-].
    - `state`: 0 safe, 1 overturned without impact, 2 overturned after impacts, -1 not computed (see `status`).
    - `max_rotation`: peak |rotation| over alpha [-]; infinite where the block overturned.
    - `impact_count`, `margin`, `status`: as in `Outcome`.
    """

    frequency_ratio: Float[Array, " columns"]
    intensity: Float[Array, " rows"]
    state: Int[Array, "rows columns"]
    max_rotation: Float[Array, "rows columns"]
    impact_count: Int[Array, "rows columns"]
    margin: Float[Array, "rows columns"]
    status: Status


@arguments
def rocking_spectrum(
    alpha: ArrayLike,
    motion: AbstractMotion,
    period: Values,
    restitution: Restitution | None = None,
    model: AbstractEquation = Housner(),
    *,
    engine: AbstractEngine | None = None,
    progress: bool | None = None,
) -> Spectrum:
    """Peak response of blocks of one slenderness and every size under one motion.

    **Arguments:**

    - `alpha`: slenderness angle [rad], in (0, pi/2).
    - `motion`: any motion.
    - `period`: (n,) values of 2 pi/p [s], positive.
    - `restitution`, `model`, `engine`: as in `Block` and `outcome`.
    - `progress`: whether to draw a progress bar; None: on a terminal, if it takes long.

    **Returns:** a `Spectrum` over the periods.
    With traced arguments (within `jax.jit`, `jax.vmap`, `jax.grad`) it is a plain function of arrays.

    **Raises:** ValueError for arguments outside their ranges.

    **Source:** Makris & Konstantinidis (2003), the rocking spectrum.
    """
    period = axis("period", period, _period)
    block = Block(alpha, 1.0, restitution)  # raises here, where values are known

    scene = block.alpha, block.law, motion, current_model(model, block, motion, period), engine
    return Spectrum(period, **surface(_under_motion, (period,), scene, "spectrum", progress))


@arguments
def self_similar_spectrum(
    frequency_ratio: Values,
    intensity: Values,
    *,
    alpha: ArrayLike = 0.2,
    restitution: Restitution | None = None,
    pulse: Callable[[Array, Array], AbstractMotion] = SinePulse,
    model: AbstractEquation = Housner(),
    engine: AbstractEngine | None = None,
    progress: bool | None = None,
) -> Spectrum:
    """Peak response under a pulse against its frequency, in dimensionless terms: one curve per intensity.

    **Arguments:**

    - `frequency_ratio`: (n,) values of omega/p [-], positive, omega = 2 pi/period of the pulse.
    - `intensity`: (rows,) peak acceleration over the uplift threshold [-], positive.
    - `alpha`, `restitution`: of the block. In the linear model alpha plays no part.
    - `pulse`: makes a motion from amplitude [g] and period [s] (for pulses with a duration, that): a pulse of the
      package, or any function that JAX can trace; what it reads may have changed since the last call.
    - `model`, `engine`, `progress`: as in `rocking_spectrum`.

    **Returns:** a `Spectrum` with results of shape (rows, n).
    With traced arguments (within `jax.jit`, `jax.vmap`, `jax.grad`) it is a plain function of arrays.

    **Raises:** ValueError for arguments outside their ranges.

    **Source:** Dimitrakopoulos & DeJong (2012), section 4.
    """
    results, ratio, intensity = _over_pulses(
        _peaks_under_pulse, frequency_ratio, intensity, alpha, restitution, pulse, model, engine, "spectrum", progress
    )
    return Spectrum(abscissa=ratio, intensity=intensity, **results)


@arguments
def overturning_map(
    frequency_ratio: Values,
    intensity: Values,
    *,
    alpha: ArrayLike = 0.2,
    restitution: Restitution | None = None,
    pulse: Callable[[Array, Array], AbstractMotion] = SinePulse,
    model: AbstractEquation = Housner(),
    engine: AbstractEngine | None = None,
    progress: bool | None = None,
) -> OverturningMap:
    """Who overturns under a pulse, over its frequency and intensity.

    **Arguments:** as in `self_similar_spectrum`.

    **Returns:** an `OverturningMap`.
    With traced arguments (within `jax.jit`, `jax.vmap`, `jax.grad`) it is a plain function of arrays.

    **Raises:** ValueError for arguments outside their ranges.

    **Source:** Zhang & Makris (2001); Dimitrakopoulos & DeJong (2012), figure 4.
    """
    results, ratio, intensity = _over_pulses(
        _states_under_pulse, frequency_ratio, intensity, alpha, restitution, pulse, model, engine, "map", progress
    )
    return OverturningMap(frequency_ratio=ratio, intensity=intensity, **results)


def _over_pulses(function, frequency_ratio, intensity, alpha, restitution, pulse, model, engine, label, progress):
    """Outcomes over the outer product of intensities (rows) and frequency ratios (columns), at p = 1."""
    ratio, intensity = axis("frequency_ratio", frequency_ratio), axis("intensity", intensity)
    block = Block(alpha, 1.0, restitution)

    number = jax.ShapeDtypeStruct((), jnp.result_type(block.alpha, ratio, intensity))
    pulse, model = current_function(pulse, number, number), current_model(model, block, ratio, intensity)
    scene = block.alpha, scaled_law(block), pulse, model, engine
    # Neighbours in intensity share a chunk: they move alike.
    results = surface(function, (intensity, ratio), scene, label, progress, columns=True)
    return results, ratio, intensity


def scaled_law(block: Block) -> AbstractRestitution:
    """The restitution of a block that stands for those of every size; ValueError, if it is not the same for all."""
    if block.law.depends_on_speed:
        raise ValueError("Argument `restitution` must not depend on the speed of impacts, where size plays no part.")
    return block.law


_period = Range("be positive and finite, from 1e-5 to 1e6", 0.0, np.inf, lambda x: (x >= 1e-5) & (x <= 1e6))  # 2 pi/p


def axis(name: str, values: Values, allowed: Range = ratio) -> Float[Array, " n"]:
    """A list of numbers in a range, as an array."""
    array = jnp.atleast_1d(allowed(name, values))
    if array.ndim != 1 or array.size == 0:
        raise ValueError(f"Argument `{name}` must be a list of at least one value, but has shape {array.shape}.")
    return array


# What a surface keeps of an outcome: computed with it, point by point.


def _peaks(result: Outcome, block: Block) -> dict:
    """Of a spectrum."""
    rest = {name: getattr(result, name) for name in ("impact_count", "overturned", "margin", "status")}
    velocity = result.max_velocity / (block.p * block.alpha)
    return {"max_rotation": result.max_rotation / block.alpha, "max_velocity": velocity, **rest}


def _states(result: Outcome, block: Block) -> dict:
    """Of a map."""
    rest = {name: getattr(result, name) for name in ("impact_count", "margin", "status")}
    state = jnp.where(result.overturned, jnp.where(result.impact_count > 0, 2, 1), 0)
    state = jnp.where(result.status == Status.successful, state, -1)
    return {"state": state, "max_rotation": result.max_rotation / block.alpha, **rest}


# The functions of surfaces. What is given for all points lies in the scene, a pytree, so that a second surface of a
# kind is not compiled again.


def _under_motion(period, scene):
    alpha, restitution, motion, model, engine = scene
    block = Block(alpha, 2 * jnp.pi / period, restitution)
    return _peaks(outcome(block, motion, model, engine=engine), block)


def _under_pulse(intensity, ratio, scene) -> tuple[Outcome, Block]:
    alpha, restitution, pulse, model, engine = scene
    block = Block(alpha, jnp.ones_like(alpha), restitution)
    motion = pulse(intensity * model.moments(block).threshold, 2 * jnp.pi / ratio)
    return outcome(block, motion, model, engine=engine), block


def _peaks_under_pulse(intensity, ratio, scene) -> dict:
    return _peaks(*_under_pulse(intensity, ratio, scene))


def _states_under_pulse(intensity, ratio, scene) -> dict:
    return _states(*_under_pulse(intensity, ratio, scene))
