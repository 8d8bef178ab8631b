"""Blocks whose parameters are uncertain, as random draws."""

from typing import Annotated

import jax
import jax.numpy as jnp
from jaxtyping import ArrayLike

from jaxrock._arguments import arguments, at_least
from jaxrock._checks import not_negative, scalar
from jaxrock._parameters import check_single
from jaxrock.blocks.rigid import Block


def _deviation(name: str, value: ArrayLike) -> float:
    return float(scalar(name, not_negative(name, value)))


@arguments
def draw_blocks(
    block: Block,
    draws: Annotated[int, at_least(1, 10**7)],
    *,
    alpha: Annotated[float, _deviation] = 0.0,
    p: Annotated[float, _deviation] = 0.0,
    restitution: Annotated[float, _deviation] = 0.0,
    seed: Annotated[int, at_least(0, 2**32 - 1)] = 0,
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

    **Raises:** ValueError for arguments outside their ranges.
    """
    check_single(block=block)
    keys = jax.random.split(jax.random.key(seed), 3)
    normal = [jax.random.normal(key, (draws,)) for key in keys[:2]]
    alphas, ps = block.alpha * jnp.exp(alpha * normal[0]), block.p * jnp.exp(p * normal[1])
    if restitution == 0:
        return Block(alphas, ps, jax.tree.map(lambda x: jnp.broadcast_to(x, (draws,)), block.law))
    if block.law.depends_on_speed:
        raise ValueError("Argument `restitution` must be 0 for a block whose law of restitution depends on the speed.")
    ends = (0 - block.restitution) / restitution, (1 - block.restitution) / restitution
    return Block(alphas, ps, block.restitution + restitution * jax.random.truncated_normal(keys[2], *ends, (draws,)))
