"""The scene that a fit to a measured history simulates, and the coordinates in which its parameters are fitted."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrock._arguments.parameters import Parameter, check_single
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.rigid import Block
from jaxrock.compiler import checks
from jaxrock.compiler.hints import jit_low_effort
from jaxrock.engines.scene import peak_bound
from jaxrock.engines.stepper import AbstractEngine
from jaxrock.engines.taylor.accurate import Series
from jaxrock.models.equation import AbstractEquation
from jaxrock.motions.motion import AbstractMotion
from jaxrock.motions.pulses.exponential import RectangularPulse
from jaxrock.responses.arguments import engine_of, start_of
from jaxrock.responses.current_model import current_model
from jaxrock.responses.history import simulate
from jaxrock.status import Status, is_decided
from jaxrock.studies.parameters import declarations, named, rebuilt, rebuilt_model

_OF_MEASUREMENT = ("initial", "velocity", "delay", "offset")

_SHAPE: dict[type, tuple[str, ...]] = {Block: ("alpha", "p"), AsymmetricBlock: ("alpha1", "alpha2", "p1")}


class FittedScene(eqx.Module):
    """Block, motion and measurement as simulated, and the `names` of the fitted parameters."""

    names: tuple[str, ...] = eqx.field(static=True)
    block: Block | AsymmetricBlock
    motion: AbstractMotion
    model: AbstractEquation
    initial: tuple[Array, Array]
    engine: AbstractEngine

    @classmethod
    def of(cls, block, motion, model, parameters, initial, rotation, engine) -> "FittedScene":
        """Check the names, and fill in the defaults."""
        still = RectangularPulse(0.0, 1.0)
        check_single(block=block, motion=still if motion is None else motion, model=model)
        free, motion = motion is None, still if motion is None else motion
        if not free and not float(peak_bound(motion)) > 0:
            raise ValueError("Argument `motion` must move the ground; None is free rocking.")
        allowed = [name for name in named(block, motion, model) if not (free and name in ("amplitude", "duration"))]
        of_law = [name for name in allowed if name.startswith("restitution")]
        names = (*_SHAPE[type(block)], *of_law, "initial") if parameters is None else tuple(parameters)
        allowed += _OF_MEASUREMENT
        unknown = [name for name in names if name not in allowed]
        if unknown or not names or len(set(names)) < len(names):
            wanted = f"be different names out of {', '.join(allowed)}"
            raise ValueError(f"Argument `parameters` must {wanted}, but is {parameters!r}.")
        if initial is None:
            initial = (float(np.ravel(rotation)[0]), 0.0) if free else (0.0, 0.0)
        block = _given(block, names)
        if engine is None:
            engine = Series(order=8, tolerance=1e-10) if model.is_series else engine_of(None, model, motion)
        model = current_model(model, block, motion)
        return cls(names, block, motion, model, start_of(initial, block=block), engine)

    @property
    def logarithmic(self) -> np.ndarray:
        """A truth value for each parameter: whether it is fitted by its logarithm."""
        return self._ends[:, 0] == 0

    @property
    def _ends(self) -> np.ndarray:
        """Open intervals of the parameters, (parameters, 2).

        Parameters whose interval begins at zero are fitted by their logarithms, because combinations that data do not
        distinguish are products of powers.
        """
        known = {name: (one.range.low, one.range.high) for name, one in self._declared.items()}
        known |= {"initial": (-np.pi / 2, np.pi / 2)}
        return np.array([known.get(name, (-np.inf, np.inf)) for name in self.names])

    @property
    def _declared(self) -> dict[str, Parameter]:
        return declarations(self.block, self.motion, self.model)

    def _natural_size(self, name: str, value: float) -> float:
        """Return the natural size of a parameter: its value; 1 for angles and numbers that may be negative."""
        known = self._declared.get(name)
        if known is not None and known.axes is not None and known.unit in ("-", "rad") and known.range.low < 0:
            return 1.0
        return abs(value) or 1.0

    def coordinates(self) -> tuple[np.ndarray, ...]:
        """Return the start of the fit, natural sizes of its coordinates, and both ends of their open intervals."""
        alpha, p = map(float, _size(self.block))
        sizes = {"initial": alpha, "velocity": alpha * p, "delay": 1 / p, "offset": alpha}
        known = named(self.block, self.motion, self.model) | dict(zip(("initial", "velocity"), self.initial))
        values = np.array([float(known.get(name, 0.0)) for name in self.names])
        scale = np.array([sizes.get(n) or self._natural_size(n, x) for n, x in zip(self.names, values)])
        reach = float(self._reach)
        bounds = np.array([(-reach, reach) if n == "delay" else ends for n, ends in zip(self.names, self._ends)]).T
        with np.errstate(divide="ignore", invalid="ignore"):
            values, bounds = (np.where(self.logarithmic, np.log(x), x) for x in (values, bounds))
        return values, np.where(self.logarithmic, 1.0, scale), *bounds

    def values(self, point):
        """Return the parameters at coordinates."""
        return jnp.where(self.logarithmic, jnp.exp(jnp.where(self.logarithmic, point, 0.0)), point)

    @property
    def _reach(self) -> Array:
        """Largest |delay| of the measurement [s]; the user should shift data by more than that before the fit."""
        return 2 / _size(self.block)[1]

    def at(self, values: dict) -> tuple[Any, AbstractMotion, AbstractEquation, tuple]:
        """Return block, motion, model and initial state with other parameters."""
        before = named(self.block, self.motion, self.model)
        after = {name: values.get(name, x) for name, x in before.items()}
        block, motion = rebuilt(self.block, self.motion, after, before["amplitude"])
        model = rebuilt_model(self.model, after)
        return block, motion, model, (values.get("initial", self.initial[0]), values.get("velocity", self.initial[1]))

    def rotation(self, point, time, until):
        """Return the rotation at times up to `until`, and whether the engine computed the response."""
        values = dict(zip(self.names, self.values(point)))
        duration = until + (self._reach if "delay" in self.names else 0.0)
        with checks.collect() as collected:
            block, motion, model, initial = self.at(values)
            response = simulate(block, motion, model, initial=initial, duration=duration, engine=self.engine, samples=2)
            at = jnp.clip(time - values.get("delay", 0.0), 0.0, duration)
            rotation, _ = response(at)
            # Beyond the point where the motion is lost, a slope is no slope.
            rotation = jnp.where(at <= response.known_until, rotation, jax.lax.stop_gradient(rotation))
        # An open verdict concerns the time after the data; chaos leaves the first part of a history as it is.
        known = is_decided(response.status) | (response.status == Status.undecided)
        for _, failed in collected:
            known &= ~failed
        return rotation + values.get("offset", 0.0), known


def _size(block: Block | AsymmetricBlock) -> tuple[Array, Array]:
    """Return the slenderness angle, that of the weaker side, and the frequency parameter."""
    if isinstance(block, Block):
        return block.alpha, block.p
    return jnp.minimum(block.alpha1, block.alpha2), block.p1


def _given(block: Block | AsymmetricBlock, names: Sequence[str]) -> Block | AsymmetricBlock:
    """Return the block with explicit values for fitted parameters that would otherwise follow from others."""
    if isinstance(block, Block):
        return Block(block.alpha, block.p, block.restitution, opens=block.opens) if "restitution" in names else block
    radii = block.radius_ratio if "radius_ratio" in names else block.given_radius_ratio
    fitted = "restitution1" in names or "restitution2" in names
    law = (block.restitution1, block.restitution2) if fitted else block.law
    return AsymmetricBlock(block.alpha1, block.alpha2, block.p1, block.inertia_ratio, radii, law)


@jit_low_effort(follows_scenes=True)
def rotation_history(point, time, until, scene: FittedScene):
    """Return the rotations at one point, their derivatives by the coordinates, and whether all are known and finite."""

    def value_twice(point):
        rotation, known = scene.rotation(point, time, until)
        return rotation, (rotation, known)

    slopes, (rotation, known) = jax.jacfwd(value_twice, has_aux=True)(point)
    return rotation, slopes, known & jnp.all(jnp.isfinite(rotation)) & jnp.all(jnp.isfinite(slopes))
