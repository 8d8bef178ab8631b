"""A scene: block, motion and model reduced to the numbers that the engines need."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Inexact, Int

from jaxrock._pick import pick
from jaxrock.block import Block
from jaxrock.models import EquationTable, Model, Table
from jaxrock.motion import AbstractMotion

Scalar = Inexact[ArrayLike, ""]

_FAR, _NEAR = 256, 16  # pieces that a block at rest may skip at once


def _sliding_maximum(values: Inexact[Array, " n"], width: int) -> Inexact[Array, " n"]:
    """Largest of the `width` values from each position on (width a power of two; zeros beyond the end)."""
    reach = 1
    while reach < width:
        values = jnp.maximum(values, jnp.pad(values[reach:], (0, min(reach, values.size))))
        reach *= 2
    return values


def _running_maximum(values: Inexact[Array, " n"]) -> Inexact[Array, " n"]:
    """Largest of the values from each position on; XLA's own takes n^2 operations on CPUs."""
    return jax.lax.associative_scan(jnp.maximum, values, reverse=True)


def peak_bound(motion: AbstractMotion) -> Scalar:
    """A bound of the motion's acceleration [g]: its peak, for records and most pulses."""
    return jnp.max(motion.bounds)


def check_single(block: Block, motion: AbstractMotion) -> None:
    """Raise ValueError where a parameter is an array outside of `jax.vmap`."""
    for name, owner in (("block", block), ("motion", motion)):
        for path, leaf in jax.tree_util.tree_leaves_with_path(owner):
            allowed = 1 if jax.tree_util.keystr(path).endswith(".samples") else 0
            if jnp.ndim(leaf) > allowed:
                raise ValueError(
                    f"Argument `{name}` must hold one scene, but `{jax.tree_util.keystr(path).lstrip('.')}` has "
                    f"shape {jnp.shape(leaf)}. Use jax.vmap for many."
                )


class Scene(eqx.Module):
    """One block under one motion. Piece `pieces` (one past the last) is the quiet after the motion."""

    table: Table | EquationTable
    p: Scalar
    alpha: Scalar
    restitution: Scalar
    motion: AbstractMotion
    knots: Inexact[Array, " knots"]
    lengths: Inexact[Array, " knots"]
    scales: Inexact[Array, " knots"]
    ceilings: Inexact[Array, " knots"]  # bound of |acceleration| from each piece to the end [g]
    quiet_near: Inexact[Array, " knots"]  # bound over the next pieces [g]
    quiet_far: Inexact[Array, " knots"]
    falls_flat: bool = eqx.field(static=True)

    @classmethod
    def of(cls, block: Block, motion: AbstractMotion, model: Model) -> "Scene":
        """Build the scene; raise ValueError where a parameter is an array outside of `jax.vmap`."""
        check_single(block, motion)
        dtype = jnp.result_type(block.alpha, block.p, *jax.tree.leaves(motion))
        block, motion = jax.tree.map(lambda x: jnp.asarray(x, dtype), (block, motion))
        knots, bounds, scales = motion.knots, motion.bounds, motion.scales
        infinity = jnp.full(1, jnp.inf, dtype)
        bounds = jnp.pad(bounds, (0, 1))
        skips = bounds.size > _NEAR
        return cls(
            table=model.table(block),
            p=block.p,
            alpha=block.alpha,
            restitution=block.restitution,
            motion=motion,
            knots=knots,
            lengths=jnp.concatenate([jnp.diff(knots), infinity]),
            scales=jnp.concatenate([scales, infinity]),
            ceilings=_running_maximum(bounds),
            quiet_near=_sliding_maximum(bounds, _NEAR) if skips else bounds,
            quiet_far=_sliding_maximum(bounds, _FAR) if skips else bounds,
            falls_flat=model.falls_flat,
        )

    @property
    def pieces(self) -> int:
        """Number of smooth pieces of the motion."""
        return self.knots.size - 1

    def after_quiet(self, piece: Int[Array, ""]) -> Int[Array, ""]:
        """First piece from `piece` on that may uplift a block at rest; cheap, so it may stop early."""
        if self.pieces < _NEAR:
            return piece
        threshold = self.table.threshold
        far, near = self.quiet_far[piece] < threshold, self.quiet_near[piece] < threshold
        return jnp.minimum(piece + jnp.where(far, _FAR, jnp.where(near, _NEAR, 0)), self.pieces)

    def forcing(self, piece: Int[Array, ""], local: Scalar, order: int) -> tuple[list[Scalar], Scalar]:
        """Taylor coefficients of the ground acceleration [g] in time/unit, and the unit [s]."""
        unit = jnp.minimum(1 / self.p, pick(self.scales, piece))
        during = piece < self.pieces
        inner = jnp.minimum(piece, self.pieces - 1)
        terms = self.motion.series(inner, local, unit, order)
        return [jnp.where(during, u, 0.0) for u in terms], unit
