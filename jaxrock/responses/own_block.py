"""Whether a block that is given beside a response is that of the response."""

import numpy as np

from jaxrock._checks import is_traced
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.restitution import tells_sides
from jaxrock.blocks.rigid import Block
from jaxrock.engines.scene import Scene


def check_own(scene: Scene, block: Block | AsymmetricBlock) -> None:
    """Raise ValueError where a block is known not to be that of a scene."""
    if is_traced((scene, block)):
        return
    if isinstance(block, Block):
        angles, rate, differ = [block.alpha] * 2, block.p, tells_sides(block.law, block.corners)
    else:
        angles, rate, differ = [block.alpha1, block.alpha2], block.p1, True
    rtol = 1e-5 if np.asarray(scene.alpha).dtype.itemsize < 8 else 1e-9
    for told, own, given in (
        ("alpha and p are {:.6g} rad and {:.6g} rad/s", [scene.alpha, scene.p], [np.min(angles), rate]),
        ("sides uplift at {:.6g} and {:.6g} g", *_uplifts(scene, angles, rtol)),
        ("law of restitution or shape tells {:d} sides apart", [2 * (scene.far is not None)], [2 * differ]),
    ):
        if not np.allclose(own, given, rtol=rtol, atol=0, equal_nan=True):
            raise ValueError(
                f"Argument `block` must be that of the response, whose {told.format(*own)}, but is a "
                f"{type(block).__name__} whose {told.format(*given)}."
            )


def _uplifts(scene: Scene, angles: list, rtol: float) -> tuple[np.ndarray, np.ndarray]:
    """Accelerations that uplift a scene's block, and one of these angles, to either side [g]."""
    own = np.array([moments.threshold for moments in scene.both_moments])
    for threshold in (np.tan, np.asarray):  # of nonlinear models, and of linear ones
        if np.isclose(np.min(own), threshold(scene.alpha), rtol=rtol, atol=0):
            return own, threshold(np.array(angles))
    return own, own  # another model: it cannot be told
