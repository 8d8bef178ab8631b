"""A flexible block with nonlinear phases: the same steps, as long as the remainder of the linear phase allows."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Inexact

from jaxrock._core.types import Scalar
from jaxrock.blocks.flexible import FlexibleBlock
from jaxrock.flexible.column import ColumnConstants
from jaxrock.flexible.phases import Phase, arc, locked_phase, rocking_phase
from jaxrock.flexible.remainder import NonlinearArc, Tangents, nonlinear_arc
from jaxrock.flexible.stepper import FlexibleScene, FlexibleState, resets_of
from jaxrock.motions.motion import AbstractMotion
from jaxrock.status import Status

_PRECISION = 10_000  # tolerance of a step, in units of rounding
_SHORTEST = 1e-12  # shortest step over duration


class NonlinearScene(FlexibleScene):
    """A flexible block under a motion, with a nonlinear base law, finite rotations, or P-Delta."""

    tangents: Tangents

    @classmethod
    def of(cls, block: FlexibleBlock, ground: AbstractMotion, stop: Scalar) -> "NonlinearScene":
        """Build the scene from scalars."""
        tangents = Tangents.of(ColumnConstants.of(block))
        numbers = tangents.numbers
        rocking, whole = rocking_phase(numbers)
        # Reject a column that leans too far before it balances.
        whole &= (numbers.balance > 0) & (numbers.balance < jnp.pi / 2) & (numbers.squares > 0).all()
        locked, resets = locked_phase(numbers), resets_of(block)
        return cls(block, ground, stop, numbers, locked, rocking, whole, resets, ground.knots, tangents)

    def longest(self, state: FlexibleState) -> Scalar:
        """Return the longest step [s]."""
        return jnp.minimum(super().longest(state), state.stride)

    def arc(self, state: FlexibleState) -> tuple[NonlinearArc, Scalar, Scalar, Bool[Array, ""]]:
        """Return the arc from here, as of a linear block, with its remainder."""
        load, length, share, whole = self.load(state)
        phase = Phase.where(state.side == 0, self.locked, self.rocking)
        path = arc(self.numbers, phase, state.side, state.motion, load, length)
        return nonlinear_arc(self.tangents, path, state.side, load, length), length, share, whole

    def advance(self, state: FlexibleState) -> FlexibleState:
        """Advance by one step, or reject it and shorten the stride."""
        path, length, share, whole = self.arc(state)
        allowed = _PRECISION * jnp.finfo(length.dtype).eps * self.numbers.balance
        miss = jax.lax.stop_gradient(path.error / allowed)
        good = (miss <= 1) & jnp.isfinite(miss)
        factor = jnp.where(jnp.isfinite(miss), jnp.clip(0.9 * jnp.maximum(miss, 1e-30) ** -0.1, 0.25, 2.0), 0.25)
        held = jax.lax.stop_gradient(length)
        next_ = self.step_on(state, path, length, share, whole)
        # A good step allows another as long; if it ended with the piece, it may allow a longer one.
        longer = jnp.maximum(factor, 1.0) * held
        next_ = replace(next_, stride=jnp.where(whole, jnp.maximum(longer, state.stride), longer))
        failed = held < _SHORTEST * self.stop
        again = replace(
            state,
            stride=jnp.minimum(factor, 0.7) * held,
            impacted=jnp.zeros_like(state.impacted),
            steps=state.steps + 1,
            done=failed,
            status=Status.where(failed, Status.solver_failed, state.status),
        )
        return jax.tree.map(lambda a, b: jnp.where(good, a, b), next_, again)

    def column(self, motion: Inexact[Array, " states"]) -> Inexact[Array, " masses"]:
        """Return the displacements of the masses from the base to the top, over L cos(alpha)."""
        return self.tangents.column.displacements(self._clamped(motion)[0])

    def energy(self, motion: Inexact[Array, " states"]) -> tuple[Scalar, Scalar, Scalar]:
        """Return kinetic energy, strain energy of the column, potential energy of base and weight, over m L^2
        [1/s^2]."""
        column, (q, v), rotation = self.tangents.column, self._clamped(motion), motion[-1]
        return column.kinetic(q, v), column.strain(q, rotation), column.potential(q, rotation)

    @property
    def summit(self) -> Scalar:
        """Return the energy of the unstable equilibrium, over m L^2 [1/s^2]."""
        kinetic, strain, potential = self.energy(self.numbers.center)
        return kinetic + strain + potential

    def _clamped(self, motion: Inexact[Array, " states"]) -> tuple:
        """Return displacements and velocities of the clamped modes."""
        return tuple(self.tangents.turn @ x for x in jnp.split(motion[:-1], 2))


def scene_of(block: FlexibleBlock, ground: AbstractMotion, stop: Scalar) -> FlexibleScene:
    """Build the scene of a block, linear or not, in the session's default precision."""
    usual = jnp.result_type(float)
    given = block, ground, stop
    block, ground, stop = jax.tree.map(lambda x: x.astype(usual) if eqx.is_inexact_array(x) else x, given)
    if block.is_linear:
        return FlexibleScene.of(block, ground, stop)
    if jnp.finfo(usual).bits < 64:  # the powers of its polynomials leave three digits, or fewer
        raise ValueError(
            "Argument `block` must be linear in single precision. Put "
            '`jax.config.update("jax_enable_x64", True)` before the first computation for one that is not.'
        )
    return NonlinearScene.of(block, ground, stop)
