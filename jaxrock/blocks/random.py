"""Random draws of blocks whose parameters are uncertain."""

import functools
from typing import Annotated, Any, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from jaxrock._arguments.annotations import arguments, at_least, pair
from jaxrock._arguments.parameters import broadcast, check_single
from jaxrock._arguments.ranges import not_negative, positive, scalar
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.restitution import tells_sides
from jaxrock.blocks.rigid import Block
from jaxrock.blocks.rock import Rock


def _deviation(name: str, value: ArrayLike) -> float:
    return float(scalar(name, not_negative(name, value)))


@overload
def draw_blocks(
    block: Block, draws: int, *, alpha: float = ..., p: float = ..., restitution: float = ..., seed: int = ...
) -> Block: ...


@overload
def draw_blocks(
    block: AsymmetricBlock, draws: int, *, alpha: float = ..., p: float = ..., restitution: float = ..., seed: int = ...
) -> AsymmetricBlock: ...


@arguments
def draw_blocks(
    block: Block | AsymmetricBlock,
    draws: Annotated[int, at_least(1, 10**7)],
    *,
    alpha: Annotated[float, _deviation] = 0.0,
    p: Annotated[float, _deviation] = 0.0,
    restitution: Annotated[float, _deviation] = 0.0,
    seed: Annotated[int, at_least(0, 2**32 - 1)] = 0,
) -> Block | AsymmetricBlock:
    """Draw random blocks whose parameters are uncertain.

    **Arguments:**

    - `block`: medians of slenderness and frequency parameter, mean of the restitution.
    - `draws`: number of blocks.
    - `alpha`, `p`: standard deviations of their logarithms [-], 0 or more; both sides of an `AsymmetricBlock` are drawn
      by the same factor.
    - `restitution`: standard deviation [-] of a normal distribution that is cut off at 0 and 1. With 0 the block's law
      stays: a restitution by Housner or by angular momentum follows alpha. It must be 0 for an `AsymmetricBlock`.
    - `seed`: of the random numbers.

    **Returns:** a block of the same kind with parameters of shape (draws,).

    **Raises:** ValueError for arguments outside their ranges.
    """
    check_single(block=block)
    alphas, ps, last = _factors(jax.random.key(seed), alpha, p, draws)
    try:
        if isinstance(block, AsymmetricBlock):
            return _drawn_sides(block, alphas, ps, restitution)
        return _drawn(block, alphas, ps, restitution, last)
    except _NoBlock as error:
        names = " and ".join(f"`{name}`" for name, deviation in (("alpha", alpha), ("p", p)) if deviation > 0)
        said = f"let all {draws} draws be blocks, but one is none ({str(error).rstrip('.')})"
        raise ValueError(f"The standard deviation {names} must {said}. Lower it, or draw less stocky blocks.") from None


@functools.partial(jax.jit, static_argnames="draws")
def _factors(key: Array, alpha: ArrayLike, p: ArrayLike, draws: int) -> tuple[Array, Array, Array]:
    """Return random factors of the slenderness and of the frequency parameter, and a key for more."""
    *keys, last = jax.random.split(key, 3)
    return *(jnp.exp(by * jax.random.normal(key, (draws,))) for key, by in zip(keys, (alpha, p))), last


class _NoBlock(ValueError):
    """A draw is outside of its range."""


def _made(kind: type, *parameters, **settings) -> Any:
    try:
        return kind(*parameters, **settings)
    except ValueError as error:
        raise _NoBlock(str(error)) from None


def _drawn(block: Block, alpha: Array, p: Array, restitution: float, key: Array) -> Block:
    """Multiply the slenderness and the frequency parameter of a block by these factors."""
    if restitution != 0 and block.law.depends_on_speed:
        raise ValueError("Argument `restitution` must be 0 for a block whose law of restitution depends on the speed.")
    if restitution != 0 and tells_sides(block.law, block.corners):
        raise ValueError("Argument `restitution` must be 0 for a block whose law of restitution tells its sides apart.")
    if restitution == 0:
        law = broadcast(block.law, alpha.shape)
    else:
        ends = (0 - block.restitution) / restitution, (1 - block.restitution) / restitution
        law = block.restitution + restitution * jax.random.truncated_normal(key, *ends, alpha.shape)
    made = _made(Block, alpha * block.alpha, p * block.p, law, opens=block.opens)
    if block.beam is None:
        return made
    beams = jnp.broadcast_to(block.beam, alpha.shape)
    return eqx.tree_at(lambda frame: frame.beam, made, beams, is_leaf=lambda x: x is None)


def _drawn_sides(block: AsymmetricBlock, alpha: Array, p: Array, restitution: float) -> AsymmetricBlock:
    if restitution != 0:
        raise ValueError("Argument `restitution` must be 0 for an AsymmetricBlock, whose sides have each its own.")
    ratios, law = (block.inertia_ratio, block.given_radius_ratio), broadcast(block.law, alpha.shape)
    inertia, radius = jax.tree.map(lambda x: jnp.broadcast_to(x, alpha.shape), ratios)
    angles = alpha * block.alpha1, alpha * block.alpha2
    return _made(AsymmetricBlock, *angles, p * block.p1, inertia, radius, law)


def _tolerances(name: str, value) -> tuple[float, float]:
    low, high = (float(scalar(name, positive(name, each))) for each in pair(name, value))
    if low > high:
        raise ValueError(f"Argument `{name}` must be a pair of which the second is not smaller, but is {value}.")
    return low, high


@arguments
def draw_rocks(
    rock: Rock,
    azimuth: ArrayLike,
    draws: Annotated[int, at_least(1, 10**6)],
    *,
    tolerance: Annotated[tuple[float, float], _tolerances],
    resolution: Annotated[float, _deviation] = 0.0,
    seed: Annotated[int, at_least(0, 2**32 - 1)] = 0,
) -> AsymmetricBlock:
    """Draw the blocks that a rock may be in a vertical plane, given the uncertain points of its mesh on the ground.

    **Arguments:**

    - `rock`: a `Rock`.
    - `azimuth`: as in `Rock.section`; the base is narrow.
    - `draws`: number of blocks.
    - `tolerance`: least and largest of the height up to which vertices stand on the ground [m], positive: one is drawn
      for each block, evenly in its logarithm.
    - `resolution`: standard deviation of the heights of the vertices [m], 0 or more: noise of scan or photographs.
    - `seed`: of the random numbers.

    **Returns:** an `AsymmetricBlock` with parameters of shape (draws,). A block that would not stand is drawn again, as
    the rock does stand.

    **Raises:** ValueError for arguments outside their ranges; where fewer than one in a hundred stands.
    """
    random, (low, high) = np.random.default_rng(seed), tolerance
    section, heights = rock.section(azimuth), rock.vertices[:, 2]
    near = heights <= heights.min() + high + 8 * resolution
    width, heights = rock.widths(azimuth)[near], heights[near]
    corners = []
    for _ in range(100 * draws):
        up = heights + resolution * random.normal(size=heights.size)
        down = np.flatnonzero(up <= up.min() + np.exp(random.uniform(np.log(low), np.log(high))))
        right, left = down[width[down].argmax()], down[width[down].argmin()]
        if width[left] < 0 < width[right]:
            corners.append([width[right], -width[left], section.centre[1] - up[right], section.centre[1] - up[left]])
        if len(corners) == draws:
            break
    else:
        raise ValueError("Argument `tolerance` must let the rock stand, but in fewer than 1 in 100 draws it does.")
    width1, width2, height1, height2 = np.array(corners).T
    radii = np.hypot(width1, height1), np.hypot(width2, height2)
    alphas = np.arctan2(width1, height1), np.arctan2(width2, height2)
    return AsymmetricBlock.from_radii(*alphas, *radii, section.gyration_radius)
