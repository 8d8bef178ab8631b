"""Check that a block given beside a response is that of the response."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Inexact

from jaxrock._core.arrays import is_traced
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.restitution import Reset, on_sides, tells_sides
from jaxrock.blocks.rigid import Block
from jaxrock.engines.scene import Scene

_SHARES = (
    "slow to fast impacts leave {:.6g}, {:.6g}, {:.6g} of the velocity on side 1, {:.6g}, {:.6g}, {:.6g} on side 2"
)


def check_own(scene: Scene, block: Block | AsymmetricBlock) -> None:
    """Raise ValueError where a concrete block differs from that of a scene."""
    if is_traced((scene, block)):
        return
    if isinstance(block, Block):
        differ = block.opens is None and tells_sides(block.law, block.corners)
        angles, rate, opens = [block.alpha] * 2, block.p, block.only_side or 0
    else:
        angles, rate, differ, opens = [block.alpha1, block.alpha2], block.p1, True, 0
    rtol = 1e-5 if np.asarray(scene.alpha).dtype.itemsize < 8 else 1e-9
    checks: list[tuple[str, Any, Any]] = [
        ("alpha and p are {:.6g} rad and {:.6g} rad/s", [scene.alpha, scene.p], [np.min(angles), rate]),
        ("sides uplift at {:.6g} and {:.6g} g", *_uplifts(scene, angles, rtol)),
        ("law of restitution or shape tells {:d} sides apart", [2 * (scene.far is not None)], [2 * differ]),
        ("only side is {:d} (0: both)", [scene.only_side or 0], [opens]),
        ("sides rock at frequencies of the ratio {:.6g}", *_rates(scene, block, angles)),
        (_SHARES, _shares(_resets_of(scene)), _shares(_resets_of(block))),
    ]
    for told, own, given in checks:
        if not np.allclose(own, given, rtol=rtol, atol=0, equal_nan=True):
            raise ValueError(
                f"Argument `block` must be that of the response, whose {told.format(*own)}, but is a "
                f"{type(block).__name__} whose {told.format(*given)}."
            )


def _resets_of(owner: Scene | Block | AsymmetricBlock) -> tuple[Reset, Reset]:
    """Return the impacts that end stays on one side, and on the other."""
    if isinstance(owner, Scene):
        return owner.reset, owner.far_reset
    if isinstance(owner, Block):
        one, other = on_sides(owner.law, owner.corners) if owner.opens is None else (owner.corners,) * 2
    else:
        one, other = owner.corners
    p, most = (owner.p, 1.0) if isinstance(owner, Block) else (owner.p1, np.inf)
    return Reset.of(owner.law, one, p, most), Reset.of(owner.law, other, p, most)


@jax.jit
def _shares(resets: tuple[Reset, Reset]) -> Inexact[Array, " six"]:
    """Return the velocity ratios of impacts at three speeds, on either side."""
    speeds = jnp.array([0.0, 0.2, 1.0])
    return jnp.concatenate([jax.vmap(reset.ratio)(speeds) for reset in resets])


def _uplifts(scene: Scene, angles: list, rtol: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the accelerations that uplift a scene's block, and a block with these angles, to either side [g]."""
    own = np.array([moments.threshold for moments in scene.both_moments])
    for threshold in (np.tan, np.asarray):  # of nonlinear models, and of linear ones
        if np.isclose(np.min(own), threshold(scene.alpha), rtol=rtol, atol=0):
            return own, threshold(np.array(angles))
    return own, own  # another model: no formula to compare with


def _rates(scene: Scene, block: Block | AsymmetricBlock, angles: list) -> tuple[list, list]:
    """Return the frequency parameter of the other side over that of the first, of a scene's block and of a given
    one."""
    if isinstance(block, Block):
        return [1.0], [1.0]
    here, there = (float(moments.arm_at_rest) for moments in scene.both_moments)
    given, own = block.p2 / block.p1, np.sqrt(there / here)
    either = own, own * np.sqrt(np.cos(angles[0]) / np.cos(angles[1]))  # the arm of a model is 1, or cos alpha
    return [min(either, key=lambda rate: abs(rate - given))], [given]
