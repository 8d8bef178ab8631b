"""Sensitivity of a response to the parameters of its scene, and how far derivatives can be trusted."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Inexact

from jaxrock._arguments.annotations import arguments
from jaxrock._arguments.parameters import check_single, in_real_numbers
from jaxrock._arguments.ranges import not_nan, scalar
from jaxrock._arguments.repr import described
from jaxrock._arguments.tables import AbstractTable, Column, scenes
from jaxrock._core.arrays import Values, as_real
from jaxrock._core.types import Real
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.rigid import Block
from jaxrock.compiler.hints import jit_low_effort
from jaxrock.engines.scene import uplift_threshold
from jaxrock.engines.stepper import AbstractEngine
from jaxrock.models.equation import AbstractEquation
from jaxrock.models.rigid import Housner
from jaxrock.motions.motion import AbstractMotion
from jaxrock.motions.pulses.exponential import ExponentialPulse
from jaxrock.responses.current_model import current_model
from jaxrock.responses.outcome import Outcome, outcome
from jaxrock.status import Enumeration, Status, is_decided, item
from jaxrock.studies.any_size import BlockOfAnySize
from jaxrock.studies.parameters import named, rebuilt, rebuilt_model
from jaxrock.studies.spectra import axis
from jaxrock.sweeps.runner import cheap_per_point
from jaxrock.sweeps.sweep import surface


class SlopeStatus(Enumeration):
    """Status of slopes; `SlopeStatus[found.margin.status]` is the message."""

    useful = item("A linear step says what comes of changes that are much smaller than `reach`.")
    useless = item(
        "Useless: a relative change of a thousandth of the parameters, or of less, uses up all that this result can "
        "change by, so that no step along its slope predicts anything; where chaotic rocking makes rounding errors do "
        "that before the result, slopes are NaN. What many scenes do together is "
        "smooth: shares that topple of blocks with scatter (`hazard.simulated_fragility` of `blocks.draw_blocks`, "
        "`inverse.calibrate_block`) and likelihoods that know of scatter (`inverse.log_density`)."
    )
    not_smooth = item("Two peaks tie, or an impact is grazed before the peak: slopes are those of one side, if any.")
    missing = item("The scene overturned, so that it has no peak, or it could not be computed: there are no slopes.")


class Slopes(eqx.Module):
    """Derivatives of one result by the parameters.

    - `value`: the result.
    - `derivative`: (..., parameters) partial derivatives, in the units of the result over those of the parameters.
    - `elasticity`: (..., parameters) per cent of the result per cent of the parameter, d ln y/d ln x.
    - `reach`: relative change of all parameters together, in the steepest direction, that changes the result by all of
      its range to first order: by its own value, the margin by at least 1. Linear steps must stay far below it.
      Infinite where all slopes are zero, NaN where there are none.
    - `status`: a `SlopeStatus`.
    """

    __repr__ = described

    value: Real
    derivative: Inexact[Array, "... parameters"]
    elasticity: Inexact[Array, "... parameters"]
    reach: Real
    status: SlopeStatus


class Sensitivity(AbstractTable):
    """Result of `sensitivity`.

    - `names`, `values`: the parameters; the last, where the motion is a pulse or a record, is `uplift_strength`.
    - `max_rotation`, `max_velocity`, `margin`: `Slopes` of [rad], [rad/s], [-].
    - `outcome`: the response itself.
    - `valid`: whether the derivatives of `max_rotation` describe the response: computed, not overturned, smooth here
      (`Outcome.differentiable`), and its peak before `Outcome.known_until`. Where it is false they are NaN.
    - `condition`: length of the vector of elasticities of `max_rotation`: relative errors grow by at most that factor.
    - `graze_distance`: relative change of all parameters together, in the worst direction and to first order, that
      makes a grazing impact appear or vanish before the peak. This changes the number of impacts. Infinite if the block
      stays far from any graze, NaN where the response was not computed or has no slope.
    - `boundary_distance`: relative change that overturns the block, or saves an overturned one: margin over its slope.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    values: Inexact[Array, "... parameters"]
    max_rotation: Slopes
    max_velocity: Slopes
    margin: Slopes
    outcome: Outcome
    valid: Bool[Array, "..."]
    condition: Real
    graze_distance: Real
    boundary_distance: Real

    @property
    def _columns(self):
        return _table(self, scenes(self.condition.ndim))


def _table(found: Sensitivity, axes: tuple[str, ...]) -> dict[str, Column]:
    """Return results over the axes of scenes, and their slopes over those axes and the parameters."""
    over = (*axes, "parameter")
    told = {"parameter": Column(("parameter",), found.names), "at": Column(over, found.values, _OWN)}
    for name, unit in {"max_rotation": "rad", "max_velocity": "rad/s", "margin": "-"}.items():
        slopes = getattr(found, name)
        told[name] = Column(axes, slopes.value, unit)
        told[f"{name}_derivative"] = Column(over, slopes.derivative, f"{unit} over {_OWN}")
        told[f"{name}_elasticity"] = Column(over, slopes.elasticity)
        told[f"{name}_reach"] = Column(axes, slopes.reach)
        told[f"{name}_slopes"] = Column(axes, slopes.status)
    names = ("valid", "condition", "graze_distance", "boundary_distance")
    told |= {name: Column(axes, getattr(found, name)) for name in names}
    return told | {"status": Column(axes, found.outcome.status)}


_OWN = "that of the parameter"
_USELESS = 1e-3  # reach below which slopes are useless: no parameter of a block or an earthquake is known so well
_RESULTS = ("max_rotation", "max_velocity", "margin", "clearance")


@arguments
def sensitivity(
    block: Block | AsymmetricBlock,
    motion: AbstractMotion,
    model: AbstractEquation = Housner(),
    *,
    engine: AbstractEngine | None = None,
) -> Sensitivity:
    """Compute derivatives and elasticities of a response by every parameter of its scene, and their limits.

    **Arguments:**

    - `block`, `motion`, `model`, `engine`: as in `outcome`; under `jax.vmap` for many scenes.

    **Returns:** a `Sensitivity`. Derivatives are partial. That by `alpha` includes a restitution that follows it
    (Housner's law), at a fixed amplitude [g]. `amplitude` of a record scales all of it. Numbers of a law and of a model
    are named by where they are, such as `restitution.gentle` and `model.edge.radius`. `uplift_strength`, the uplift
    threshold over the amplitude, is varied through the amplitude. The function is a plain function of arrays:
    `jax.jit`, `jax.vmap` and further derivatives go through it.

    **Raises:** ValueError for arguments outside their ranges.
    """
    block, motion = in_real_numbers(block, motion)
    check_single(model=model)
    return _sensitivity(block, motion, current_model(model, block, motion), engine)


@jit_low_effort(follows_scenes=True)  # one program, because it has many operations
def _sensitivity(block, motion, model, engine) -> Sensitivity:
    parameters = named(block, motion, model)
    names, values = tuple(parameters), jnp.stack([jnp.asarray(v) for v in parameters.values()])

    def results(values):
        known = dict(zip(names, jnp.unstack(values)))
        changed = *rebuilt(block, motion, known, parameters["amplitude"]), rebuilt_model(model, known)
        result = outcome(*changed, engine=engine)
        return jnp.stack([getattr(result, name) for name in _RESULTS]), result

    rows, result = jax.jacfwd(results, has_aux=True)(values)
    return _told(names, values, uplift_threshold(block, model), rows, result)


def _told(names: tuple[str, ...], values, threshold, rows, result: Outcome) -> Sensitivity:
    """Build the `Sensitivity` from derivatives (results, parameters) at the values of the parameters."""
    decided = is_decided(result.status)
    # A peak after the time at which errors have outgrown the rotation is that of one of many motions.
    lost = (result.status == Status.chaotic) | (result.time_of_max > result.known_until)
    known, valid = decided & ~lost, decided & ~lost & result.differentiable
    # uplift_strength = threshold/amplitude: d/d ln strength = -d/d ln amplitude.
    amplitude = values[names.index("amplitude")]
    strength = threshold / jnp.abs(amplitude)
    rows = jnp.concatenate([rows, -rows[:, [names.index("amplitude")]] * amplitude / strength], axis=1)
    independent = len(names)
    values = jnp.append(values, strength)

    def steepest(name):
        return jnp.linalg.norm((rows[_RESULTS.index(name)] * values)[:independent])

    def slopes(name, known, missing, range_=0.0):
        value, row, steep = getattr(result, name), rows[_RESULTS.index(name)], steepest(name)
        relative = row[:independent] * values[:independent] / jnp.where(value == 0, 1.0, value)
        relative = jnp.append(relative, -relative[names.index("amplitude")])  # also of an infinite strength
        flat = steep == 0
        reach = jnp.where(flat, jnp.inf, jnp.maximum(jnp.abs(value), range_) / jnp.where(flat, 1.0, steep))
        row, relative, reach = (jnp.where(known, x, jnp.nan) for x in (row, relative, reach))
        status = SlopeStatus.where(reach < _USELESS, SlopeStatus.useless, SlopeStatus.useful)
        status = SlopeStatus.where(known, status, SlopeStatus.not_smooth)
        status = SlopeStatus.where(lost, SlopeStatus.useless, status)
        status = SlopeStatus.where(missing, SlopeStatus.missing, status)
        return Slopes(value, row, relative, reach, status)

    def distance(name, value):
        """Return, to first order, the relative change of all parameters together that makes a result zero."""
        steep = steepest(name)
        far = (steep == 0) | (value == jnp.inf)
        return jnp.where(known, jnp.where(far, jnp.inf, jnp.abs(value) / jnp.where(far, 1.0, steep)), jnp.nan)

    without_peak = ~decided | result.overturned
    rotation = slopes("max_rotation", valid, without_peak)
    return Sensitivity(
        names=(*names, "uplift_strength"),
        values=values,
        max_rotation=rotation,
        max_velocity=slopes("max_velocity", valid, without_peak),
        margin=slopes("margin", known, ~decided, 1.0),
        outcome=result,
        valid=valid,
        condition=jnp.linalg.norm(rotation.elasticity[:independent]),
        graze_distance=distance("clearance", result.clearance),
        boundary_distance=distance("margin", result.margin),
    )


class SensitivityMap(AbstractTable):
    """Sensitivities of a block under the exponential pulse; results have the shape (strengths, durations).

    - `uplift_strength`, `pulse_duration`: the axes, threshold/amplitude and p t_d [-]; `shape` of the pulse.
    - `sensitivity`: a `Sensitivity` whose arrays have these two axes in front.
    """

    uplift_strength: Float[Array, " rows"]
    pulse_duration: Float[Array, " columns"]
    shape: Float[Array, ""]
    sensitivity: Sensitivity

    @property
    def _columns(self):
        axes = ("uplift_strength", "pulse_duration")
        return {name: Column((name,), getattr(self, name)) for name in axes} | _table(self.sensitivity, axes)


@arguments
def sensitivity_map(
    uplift_strength: Values,
    pulse_duration: Values,
    shape: ArrayLike = 0.0,
    *,
    alpha: ArrayLike = 0.2,
    restitution: ArrayLike | None = None,
    opens: str | None = None,
    model: AbstractEquation = Housner(),
    engine: AbstractEngine | None = None,
    progress: bool | None = None,
) -> SensitivityMap:
    """Compute sensitivities over uplift strength and pulse duration, for one shape of the exponential pulse.

    **Arguments:**

    - `uplift_strength`: (rows,) uplift threshold over amplitude [-], positive; below 1 the block uplifts.
    - `pulse_duration`: (columns,) p t_d [-], positive.
    - `shape`: of the pulse, as in `ExponentialPulse`.
    - `alpha`, `restitution`, `opens`, `model`, `engine`, `progress`: as in `self_similar_spectrum`.

    **Returns:** a `SensitivityMap`.
    With traced arguments (within `jax.jit`, `jax.vmap`, `jax.grad`) it is a plain function of arrays.

    **Raises:** ValueError for arguments outside their ranges.

    **Source:** Voyagaki, Psycharis & Mylonakis (2012), 2.1 (the pulse) and 2.2 (its dimensionless parameters).
    """
    strength, duration = axis("uplift_strength", uplift_strength), axis("pulse_duration", pulse_duration)
    shape, alpha = scalar("shape", not_nan("shape", shape)), as_real("alpha", alpha)
    block = Block(alpha, 1.0, restitution, opens=opens)  # raises here, where values are concrete
    check_single(block=block)
    model = current_model(model, block, shape, strength, duration)
    scene = shape, BlockOfAnySize.of(block, scaled=True), model, engine
    sensitivities = surface(_under_lobe, (strength, duration), scene, "sensitivity", progress)
    return SensitivityMap(strength, duration, shape, sensitivities)


@cheap_per_point
def _under_lobe(strength, duration, scene) -> Sensitivity:
    shape, of_block, model, engine = scene
    block = of_block.sized(of_block.alpha, jnp.ones_like(of_block.alpha))
    # Positive acceleration drives negative rotation, to the left; the size of the response to both sides is the same.
    pulse = ExponentialPulse(model.moments(block).threshold / strength, duration, shape)
    return sensitivity(block, pulse, model, engine=engine)
