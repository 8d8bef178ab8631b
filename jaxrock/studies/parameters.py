"""The parameters of a scene by name: what derivatives are taken by."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Inexact

from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.rigid import Block
from jaxrock.engines.scene import peak_bound
from jaxrock.motions.motion import AbstractMotion, Scaled

Real = Inexact[Array, "..."]


_FREE = {Block: ("alpha", "p"), AsymmetricBlock: ("alpha1", "alpha2", "p1", "inertia_ratio")}


# What may follow from the others where it is not given.
_FOLLOWING = {Block: ("restitution",), AsymmetricBlock: ("radius_ratio", "restitution1", "restitution2")}


def named(block: Block | AsymmetricBlock, motion: AbstractMotion) -> dict[str, Real]:
    """Parameters and their values.

    Those of the block (`alpha`, `p`, `restitution`; of an asymmetric one `alpha1`, `alpha2`, `p1`, `inertia_ratio`,
    `radius_ratio`, `restitution1`, `restitution2`), and those of the motion as it names them; `amplitude` [g] also of a
    motion that does not (a record): its peak, which scales all of it.
    """
    found = {name: getattr(block, name) for name in (*_FREE[type(block)], *_FOLLOWING[type(block)])}
    found |= _numbers(motion)
    return found if "amplitude" in found else found | {"amplitude": peak_bound(motion)}


def rebuilt(
    block: Block | AsymmetricBlock, motion: AbstractMotion, values: dict[str, Real]
) -> tuple[Block | AsymmetricBlock, AbstractMotion]:
    """The scene with other values of its parameters, and derivatives by them.

    What follows from other parameters goes on doing so (a restitution, from alpha): its value then is what is added to
    one of its own.
    """
    free = _FREE[type(block)]
    new = eqx.tree_at(lambda b: [getattr(b, name) for name in free], block, [values[name] for name in free])
    for name in _FOLLOWING[type(block)]:
        value, given = values[name], f"given_{name}"
        if getattr(block, given) is None:
            value = getattr(new, name) + (value - jax.lax.stop_gradient(getattr(block, name)))
        new = eqx.tree_at(lambda b, given=given: getattr(b, given), new, value, is_leaf=lambda x: x is None)
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
