"""The parameters of a scene by name: what derivatives are taken by."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Inexact

from jaxrock.block import Block
from jaxrock.motion import AbstractMotion, Scaled
from jaxrock.scene import peak_bound

Real = Inexact[Array, "..."]


def named(block: Block, motion: AbstractMotion) -> dict[str, Real]:
    """Parameters and their values.

    `alpha`, `p`, `restitution`, and those of the motion as it names them; `amplitude` [g] also of a motion that does
    not (a record): its peak, which scales all of it.
    """
    found = {"alpha": block.alpha, "p": block.p, "restitution": block.restitution}
    found |= _numbers(motion)
    return found if "amplitude" in found else found | {"amplitude": peak_bound(motion)}


def rebuilt(block: Block, motion: AbstractMotion, values: dict[str, Real]) -> tuple[Block, AbstractMotion]:
    """The scene with other values of its parameters, and derivatives by them.

    A restitution that follows alpha goes on doing so: `restitution` then is what is added to a restitution of its own.
    """
    restitution = values["restitution"]
    if block.given_restitution is None:
        follows = eqx.tree_at(lambda b: b.alpha, block, values["alpha"]).restitution
        restitution = follows + (restitution - jax.lax.stop_gradient(block.restitution))
    new = eqx.tree_at(
        lambda b: (b.alpha, b.p, b.given_restitution),
        block,
        (values["alpha"], values["p"], restitution),
        is_leaf=lambda x: x is None,
    )
    names = list(_numbers(motion))
    changed = eqx.tree_at(lambda m: [_at(m, name) for name in names], motion, [values[name] for name in names])
    if "amplitude" not in names:
        changed = Scaled(changed, values["amplitude"] / jax.lax.stop_gradient(peak_bound(motion)))
    return new, changed


def _numbers(motion: AbstractMotion) -> dict[str, Real]:
    """The single numbers of a motion by name; parts of a motion made of motions have the part's name in front.

    The factor of a scaled motion is left out: its amplitude says the same.
    """
    paths = jax.tree_util.tree_leaves_with_path(motion)
    return {
        jax.tree_util.keystr(path).lstrip("."): leaf
        for path, leaf in paths
        if not jax.tree_util.keystr(path).endswith((".samples", "factor"))
        and jnp.issubdtype(jnp.result_type(leaf), jnp.inexact)
    }


def _at(motion: AbstractMotion, name: str):
    for part in name.split("."):
        motion = getattr(motion, part)
    return motion
