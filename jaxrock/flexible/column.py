"""A flexible column without linearisation: the law of its base, finite rotations, and its weight as it bends.

Element j of the column leans by psi_j, so that the masses are at L cos(alpha) times sums of sin(psi)/elements. The
elements bend against psi - theta. In units of m L^2, with the moments carried_j and masses sway_jk of `unit_column`,

    sum over k of sway_jk [cos(psi_j - psi_k) psi_k'' + sin(psi_j - psi_k) psi_k'^2] + (bending and damping)_j
        = carried_j [g/L sin(psi_j) - cos(alpha) a_g/L cos(psi_j)],    g only with P-Delta

and the moment of bending and damping at the base is that of the spring. With small rotations sin(psi) = psi, cos = 1.
psi = chords q, by the modal displacements q of the clamped column.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Inexact

from jaxrock._core.types import Scalar
from jaxrock.blocks.cantilever import unit_column
from jaxrock.blocks.flexible import FlexibleBlock
from jaxrock.flexible.phases import Numbers
from jaxrock.numerics.roots import implicit

Modal = Inexact[Array, " modes"]


class ColumnConstants(eqx.Module):
    """The constants of a block in the equations, beside its `Numbers`."""

    numbers: Numbers
    weight: Scalar  # g/L [1/s^2]
    base: str = eqx.field(static=True)
    finite: bool = eqx.field(static=True)
    p_delta: bool = eqx.field(static=True)

    @classmethod
    def of(cls, block: FlexibleBlock) -> "ColumnConstants":
        """Collect the constants of a block of scalars."""
        weight = block.gravity / block.length
        return cls(Numbers.of(block), weight, block.base, block.rotations == "finite", block.p_delta)

    @property
    def _unit(self):
        return unit_column(self.numbers.rotation.size + 1)

    def sine(self, angle):
        """Return the sine of an angle, or the angle itself where rotations are small."""
        return jnp.sin(angle) if self.finite else angle

    def _raised(self, angle):
        """Return 1 - cos(angle), or its small-rotation form: the integral of `sine`."""
        return 2 * jnp.sin(angle / 2) ** 2 if self.finite else angle**2 / 2

    def spring(self, rotation: Scalar, side: Scalar) -> Scalar:
        """Return the moment of the base; with P-Delta, without the moment of the weight of a straight column."""
        alpha, half, opening = self.numbers.alpha, self.weight / 2, side * rotation
        # D&F 2017, equations 13, 14, 15.
        if self.base == "sine":
            law = half * jnp.sin(alpha - opening)
        elif self.base == "linear":
            law = self.numbers.strength * (1 - opening / alpha)
        else:
            law = self.numbers.strength - half * self.sine(opening)
        return side * (law + half * self.sine(opening)) if self.p_delta else side * law

    def potential(self, q: Modal, rotation: Scalar) -> Scalar:
        """Return the potential energy of the base and of the weight."""
        alpha, half, opening = self.numbers.alpha, self.weight / 2, jnp.abs(rotation)
        if self.base == "sine":
            energy = half * (jnp.cos(alpha - opening) - jnp.cos(alpha))
        elif self.base == "linear":
            energy = self.numbers.strength * (opening - opening**2 / (2 * alpha))
        else:
            energy = self.numbers.strength * opening - half * self._raised(opening)
        if not self.p_delta:
            return energy
        lowered = jnp.sum(self._unit.carried * self._raised(self._unit.chords @ q))
        return energy + half * self._raised(rotation) - self.weight * lowered

    def strain(self, q: Modal, rotation: Scalar) -> Scalar:
        """Return the energy of bending."""
        return jnp.sum(self.numbers.squares * (q - self.numbers.rotation * rotation) ** 2) / 2

    def kinetic(self, q: Modal, v: Modal) -> Scalar:
        """Return the kinetic energy."""
        if not self.finite:
            return jnp.sum(v**2) / 2
        lean, speed = self._unit.chords @ q, self._unit.chords @ v
        return speed @ (self._unit.sway * jnp.cos(lean[:, None] - lean)) @ speed / 2

    def elastic(self, q: Modal, v: Modal, rotation: Scalar, speed: Scalar) -> Modal:
        """Return the forces of bending and of its damping on the modes."""
        numbers = self.numbers
        bent, bends = q - numbers.rotation * rotation, v - numbers.rotation * speed
        return numbers.squares * bent + numbers.damping * bends

    def remaining_force(self, q: Modal, v: Modal, a: Modal, ground: Scalar) -> Modal:
        """Return the forces on the modes that small rotations without P-Delta omit; `ground`: ground acceleration
        [g]."""
        unit, numbers = self._unit, self.numbers
        lean, force = unit.chords @ q, jnp.zeros_like(q)
        if self.finite:
            apart, speed = lean[:, None] - lean, unit.chords @ v
            change = unit.chords @ a + numbers.mass_damping * speed
            turning = jnp.sin(apart) * speed**2 - 2 * jnp.sin(apart / 2) ** 2 * change
            push = ground * jnp.cos(numbers.alpha) * self.weight
            force = 2 * push * unit.carried * jnp.sin(lean / 2) ** 2 - jnp.sum(unit.sway * turning, 1)
        if self.p_delta:
            force = force + self.weight * unit.carried * self.sine(lean)
        return force @ unit.chords

    def displacements(self, q: Modal) -> Inexact[Array, " masses"]:
        """Return the displacements of the masses, from the base to the top, over L cos(alpha)."""
        steps = self.sine(self._unit.chords @ q) / self.numbers.rotation.size
        return jnp.concatenate([jnp.zeros(1), jnp.cumsum(steps)])

    def saddle(self) -> tuple[Modal, Scalar]:
        """Return modal displacements and rotation of the unstable equilibrium."""
        numbers = self.numbers
        straight = jnp.append(numbers.rotation, 1.0) * numbers.balance
        if not self.p_delta:
            return straight[:-1], straight[-1]
        held, x = jax.lax.stop_gradient((self, straight))
        x = jax.lax.fori_loop(0, 14, lambda _, x: x - _to_saddle(held, x), x)
        x = implicit(_to_saddle, x, self)
        return x[:-1], x[-1]

    def lack(self, x: Inexact[Array, " unknowns"]) -> Inexact[Array, " unknowns"]:
        """Return the residual of the equilibrium at modal displacements and a rotation, in the same units."""
        numbers, q, rotation, none = self.numbers, x[:-1], x[-1], jnp.zeros_like(x[:-1])
        elastic = self.elastic(q, none, rotation, 0 * rotation)
        weighed = (elastic - self.remaining_force(q, none, none, 0 * rotation)) / numbers.squares
        moment = jnp.sum(numbers.rotation * elastic) - self.spring(rotation, jnp.ones_like(rotation))
        return jnp.append(weighed, moment / numbers.spring_rate)


def _to_saddle(column: ColumnConstants, x: Inexact[Array, " unknowns"]) -> Inexact[Array, " unknowns"]:
    lack, slopes = jax.vmap(lambda d: jax.jvp(column.lack, (x,), (d,)), out_axes=(None, 1))(jnp.eye(x.size))
    return jnp.linalg.solve(slopes, lack)
