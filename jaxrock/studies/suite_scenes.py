"""Scenes of a suite: every motion at many scales, with both signs, on many blocks.

Motions run one after the other; the scenes of one motion run together and share its samples. Records are padded to the
next power of two, so that a few programs serve a suite of any lengths.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from jaxrock._arguments.parameters import leaves_of, one_of_many, shared
from jaxrock._arguments.ranges import size
from jaxrock._core.arrays import Values, shown, to_device
from jaxrock._core.progress import Progress
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.restitution import tells_sides
from jaxrock.blocks.rigid import Block
from jaxrock.compiler.hints import jit_low_effort
from jaxrock.models.equation import AbstractEquation
from jaxrock.motions.mirrored import scaled_and_mirrored
from jaxrock.motions.record import with_room
from jaxrock.motions.suite import Suite
from jaxrock.responses.current_model import current_model
from jaxrock.responses.outcome import Outcome, outcome
from jaxrock.status import Status, is_decided
from jaxrock.studies.parameters import rebuilt_model

STOOD, TOPPLED, UNDECIDED = 0, 1, -1
BOUNDS = ("lower", "upper", "share")  # ways to count undecided scenes: none, all, or the share that topples
FACINGS = {"one": (1,), "both": (1, -1)}  # signs of the horizontal motion


class Scenes(NamedTuple):
    """Results of the scenes: arrays (motions, factors, blocks).

    - `verdict`: 1 toppled, 0 stood, -1 undecided.
    - `rotation`: peak rotation over slenderness (of an asymmetric block over the smaller one); infinite if it toppled,
      NaN where undecided.
    - `margin`: as in `Outcome`; NaN where undecided.
    - `share`: share that topples of the motions that errors of the computation allow: 0 or 1 with a verdict, 0.5 where
      nothing is known.
    """

    verdict: np.ndarray
    rotation: np.ndarray
    margin: np.ndarray
    share: np.ndarray


def verdict_and_share(result: Outcome) -> tuple[Array, Array]:
    """Return the verdict of a scene, and the share that topples, as `Scenes` documents them."""
    good = is_decided(result.status)
    verdict = jnp.where(good, jnp.where(result.overturned, TOPPLED, STOOD), UNDECIDED).astype(jnp.int8)
    share = jnp.where(good | (result.status == Status.undecided), result.overturned_share, jnp.nan)
    return verdict, jnp.nan_to_num(share, nan=0.5)


def topples(verdict: np.ndarray, how: str, share: np.ndarray | None) -> np.ndarray:
    """Return how much of each scene counts as toppled; `how` is one of `BOUNDS`, `share` None: one half where open."""
    of_open = {"lower": 0.0, "upper": 1.0, "share": 0.5 if share is None else share}[how]
    return np.where(verdict == UNDECIDED, of_open, verdict == TOPPLED)


def stacked(block: Block | AsymmetricBlock) -> Block | AsymmetricBlock:
    """Broadcast the parameters of a block to shape (draws,); leaves that all draws share stay."""
    shape = np.broadcast_shapes((1,), *(np.shape(leaf.value) for leaf in leaves_of(block) if not leaf.is_shared))
    if len(shape) > 1:
        raise ValueError(f"The parameters of `block` must be numbers or lists, but have shape {shape}.")
    return _of_each(block, lambda x: np.broadcast_to(x, shape))


def _of_each(blocks: Block | AsymmetricBlock, function: Callable[[np.ndarray], np.ndarray]):
    """Apply a function to the array of every number of a block; leaves that all draws share stay."""
    arrays = jax.tree.map(np.asarray, blocks)
    return jax.tree.map(lambda x, own: to_device(x if own else function(x)), arrays, shared(blocks))


def is_symmetric(block: Block | AsymmetricBlock) -> bool:
    """Return whether a block is its own mirror image, so that turning it round changes nothing."""
    return isinstance(block, Block) and block.opens is None and not tells_sides(block.law, block.corners)


def both_ways(factors: np.ndarray, facing: str) -> np.ndarray:
    """Append factors of the opposite sign to factors (motions, levels) if `facing` turns blocks round."""
    return np.concatenate([way * factors for way in FACINGS[facing]], axis=1)


def as_draws(verdict: np.ndarray, facing: str) -> np.ndarray:
    """Reshape verdicts (motions, levels, draws) under factors of `both_ways`: turned blocks become further draws."""
    motions, rows, draws = verdict.shape
    ways = len(FACINGS[facing])
    return verdict.reshape(motions, ways, -1, draws).swapaxes(1, 2).reshape(motions, rows // ways, ways * draws)


def rising_scales(scale: Values) -> np.ndarray:
    """Return factors on all motions as an array, also for a single number."""
    scales = np.atleast_1d(np.asarray(size("scale", scale), float))
    if scales.ndim > 1 or scales.size == 0 or np.any(np.diff(scales) <= 0):
        raise ValueError(f"Argument `scale` must be a number, or rise from scale to scale, but is {shown(scale)}.")
    return scales


def capacities(verdict: np.ndarray, levels: ArrayLike) -> np.ndarray:
    """Find the levels between which a block first topples, (..., 2); the second axis of the verdicts is the levels."""
    ends, count = np.concatenate([[0.0], np.asarray(levels), [np.inf]]), verdict.shape[1]
    toppled, stood = verdict == TOPPLED, verdict == STOOD
    first = np.where(toppled.any(axis=1), toppled.argmax(axis=1), count)
    safe = np.where(stood.all(axis=1), count, (~stood).argmax(axis=1))
    return np.stack([ends[safe], ends[first + 1]], axis=-1)


def comes_back(verdict: np.ndarray) -> np.ndarray:
    """Return whether a block stands at a level above one that topples it."""
    return np.any(np.maximum.accumulate(verdict == TOPPLED, axis=1) & (verdict == STOOD), axis=1)


def scenes_of_suite(
    blocks: Block | AsymmetricBlock,
    suite: Suite,
    factors: np.ndarray,
    model: AbstractEquation,
    engine,
    progress,
    varied: Mapping[str, np.ndarray] = MappingProxyType({}),
) -> Scenes:
    """Compute stacked blocks under every motion of a suite times factors: (motions, factors) or (factors,) for all.

    `varied`: parameters of the model that differ from block to block, by name.
    """
    factors = np.broadcast_to(factors, (len(suite), np.shape(factors)[-1]))
    draws, count = jax.tree.leaves(blocks)[0].shape[0], factors.shape[1]
    # Neighbours differ by the factor, so they move alike.
    lanes = _of_each(blocks, lambda x: np.repeat(x, count))
    more = {name: to_device(np.repeat(x, count)) for name, x in varied.items()}
    model = current_model(model, lanes, next(suite.motions()), factors)
    bar = Progress(factors.size * draws, "suite", progress)
    found = []
    for motion, row in zip(suite.motions(), factors):
        found.append(of_motion(with_room(motion), lanes, to_device(np.tile(row, draws)), model, engine, more))
        bar.add(count * draws)
    shape = len(suite), draws, count
    parts = (np.stack([np.asarray(x) for x in part]).reshape(shape).swapaxes(1, 2) for part in zip(*found))
    return Scenes(*parts)


@jit_low_effort(follows_scenes=True)
def of_motion(motion, blocks, factors, model, engine, varied) -> Scenes:
    """Compute all scenes of one motion, side by side: stacked blocks, each with its factor and parameters of the
    model."""

    def one(lane, factor):
        block, own = one_of_many(blocks, lane), rebuilt_model(model, {name: x[lane] for name, x in varied.items()})
        result = outcome(block, scaled_and_mirrored(motion, factor), own, engine=engine)
        alpha = jnp.minimum(block.alpha1, block.alpha2) if isinstance(block, AsymmetricBlock) else block.alpha
        verdict, share = verdict_and_share(result)
        rotation, margin = (
            jnp.where(verdict == UNDECIDED, jnp.nan, x) for x in (result.max_rotation / alpha, result.margin)
        )
        return Scenes(verdict, rotation, margin, share)

    return jax.vmap(one)(jnp.arange(factors.size), factors)
