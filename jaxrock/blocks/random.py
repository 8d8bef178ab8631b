"""Blocks whose parameters are uncertain, as random draws."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxrock.blocks.flexible import check_rigid
from jaxrock.blocks.rigid import Block


def draw_blocks(
    block: Block, draws: int, *, alpha: float = 0.0, p: float = 0.0, restitution: float = 0.0, seed: int = 0
) -> Block:
    """Blocks whose parameters are uncertain, as random draws.

    **Arguments:**

    - `block`: medians of slenderness and frequency parameter, mean of the restitution.
    - `draws`: how many.
    - `alpha`, `p`: standard deviations of their logarithms [-], 0 or more.
    - `restitution`: standard deviation [-] of a normal distribution that is cut off at 0 and 1; at 0 restitution
      stays, and follows alpha if it is Housner's.
    - `seed`: of the random numbers.

    **Returns:** a `Block` with parameters of shape (draws,).

    **Raises:** ValueError for arguments outside their ranges, or a flexible block.
    """
    check_rigid(block)
    if draws < 1:
        raise ValueError(f"Argument `draws` must be at least 1, but is {draws}.")
    for name, value in (("alpha", alpha), ("p", p), ("restitution", restitution)):
        if not 0 <= value < np.inf:
            raise ValueError(f"Argument `{name}` must be 0 or more and finite, but is {value}.")
    keys = jax.random.split(jax.random.key(seed), 3)
    normal = [jax.random.normal(key, (draws,)) for key in keys[:2]]
    alphas, ps = block.alpha * jnp.exp(alpha * normal[0]), block.p * jnp.exp(p * normal[1])
    if restitution == 0:
        return Block(alphas, ps, jax.tree.map(lambda x: jnp.broadcast_to(x, (draws,)), block.law))
    if block.law.depends_on_speed:
        raise ValueError("Argument `restitution` must be 0 for a block whose law of restitution depends on the speed.")
    ends = (0 - block.restitution) / restitution, (1 - block.restitution) / restitution
    return Block(alphas, ps, block.restitution + restitution * jax.random.truncated_normal(keys[2], *ends, (draws,)))
