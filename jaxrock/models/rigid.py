"""The rigid rectangular block: Housner's equation, and its linearisation for slender blocks."""

import jax.numpy as jnp

from jaxrock.blocks.rigid import Block, Side
from jaxrock.models.coefficients import Coefficients
from jaxrock.models.equation import AbstractEquation
from jaxrock.models.terms import Terms
from jaxrock.numerics.elementary import sine_cosine


class Housner(AbstractEquation):
    """The rigid rectangular block with its exact nonlinear equation (Housner 1963; D&D 2012, 2.1-2.2)."""

    def moments(self, block: Block | Side) -> Coefficients:
        """Return the restoring moment sin(alpha - x) = sin(alpha) cos x - cos(alpha) sin x, with the arm cos(alpha -
        x)."""
        sine, cosine = sine_cosine(block.alpha)  # XLA turns sin/cos quotients into a tangent, which LLVM may lack
        return Coefficients(Terms(sine=-cosine, cosine=sine), Terms(sine=sine, cosine=cosine), arm_lasts=True)

    @property
    def forces_follow(self) -> bool:
        """Return True: only weight and ground act on the block."""
        return True


class Linear(AbstractEquation):
    """The slender block linearised about its corner (D&D 2012, 3.1-3.2; Voyagaki et al. 2012, 2.3)."""

    def moments(self, block: Block | Side) -> Coefficients:
        """Return the restoring moment alpha - x, with arm 1."""
        one = jnp.ones_like(block.alpha)
        return Coefficients(Terms(constant=block.alpha, line=-one), Terms(constant=one))

    @property
    def forces_follow(self) -> bool:
        """Return True: only weight and ground act on the block."""
        return True

    @property
    def falls_flat(self) -> bool:
        """Return False: a linear block has no horizontal position, only the point of no return counts."""
        return False
