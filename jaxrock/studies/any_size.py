"""Blocks of one slenderness and every size, of which spectra and maps are made."""

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from jaxrock._core.types import Real
from jaxrock.blocks.restitution import AbstractRestitution, Restitution
from jaxrock.blocks.rigid import Block


class BlockOfAnySize(eqx.Module):
    """All of a block but its size; the parts that are no arrays are static, so points of a surface share it."""

    alpha: Real
    law: AbstractRestitution
    opens: str | None = eqx.field(static=True)

    @classmethod
    def of(cls, block: Block, scaled: bool = False) -> "BlockOfAnySize":
        """Take the shape of a block; of a `scaled` one, where size plays no part, no impact depends on the speed."""
        return cls(block.alpha, scaled_law(block) if scaled else block.law, block.opens)

    def sized(self, alpha: Real, p: Real) -> Block:
        """Return the block of a size; `alpha`: its own, in the precision of the size."""
        return Block(alpha, p, self.law, opens=self.opens)


def of_any_size(alpha: ArrayLike, restitution: Restitution | None, opens: str | None = None) -> Block:
    """Return a block that stands for blocks of every size, cached for plain numbers.

    Making it takes a quarter of the time of a small map.
    """
    if isinstance(alpha, float) and isinstance(restitution, float | None):
        return _of_plain_numbers(alpha, restitution, opens, jnp.result_type(float))
    return Block(alpha, 1.0, restitution, opens=opens)


@functools.lru_cache(maxsize=64)
def _of_plain_numbers(alpha: float, restitution: float | None, opens: str | None, precision: np.dtype) -> Block:
    return Block(alpha, 1.0, restitution, opens=opens)  # in the precision of the session


def scaled_law(block: Block) -> AbstractRestitution:
    """Return the restitution of a block of any size; ValueError if it depends on the speed of impacts."""
    if block.law.depends_on_speed:
        raise ValueError("Argument `restitution` must not depend on the speed of impacts, where size plays no part.")
    return block.law
