"""The rigid rectangular block: Housner's equation, and its linearisation for slender blocks."""

import equinox as eqx
import jax.numpy as jnp

from jaxrock.blocks.rigid import Block, Side
from jaxrock.models.coefficients import Table
from jaxrock.numerics.elementary import sine_cosine


class Housner(eqx.Module):
    """The rigid rectangular block with its exact nonlinear equation (Housner 1963; D&D 2012, 2.1-2.2)."""

    def table(self, block: Block | Side) -> Table:
        """sin(alpha - x) = sin(alpha) cos x - cos(alpha) sin x; its arm is cos(alpha - x)."""
        sine, cosine = sine_cosine(block.alpha)  # a quotient of XLA's own becomes a tangent, which LLVM may lack
        return Table(rs=-cosine, rc=sine, ms=sine, mc=cosine)

    @property
    def falls_flat(self) -> bool:
        """Whether a rotation of pi/2 means that the block lies on its side."""
        return True


class Linear(eqx.Module):
    """The slender block linearised about its corner (D&D 2012, 3.1-3.2; Voyagaki et al. 2012, 2.3)."""

    def table(self, block: Block | Side) -> Table:
        """Restoring moment alpha - x, arm 1."""
        one = jnp.ones_like(block.alpha)
        return Table(r0=block.alpha, r1=-one, m0=one)

    @property
    def falls_flat(self) -> bool:
        """A linear block has no horizontal: only the point of no return counts."""
        return False
