"""One primitive of JAX: a program of one scene, at one scene or at many. All its rules stand here; last, those of a
second one, which is the derivative of one scene as long as nothing makes many of it.

- Under `jax.vmap` one scene becomes many, and one more axis of many becomes more of them.
- The derivative is a small Jacobian times the change of the inputs; value and Jacobian are one program of the same
  kind, so derivatives of every order follow, and reverse mode. Of derivatives every direction is a scene of its own.
- It is lowered where JAX compiles, for the platform that it compiles for (`lowering`).
"""

import functools
import math

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from jaxrock._abstract import summed_like, typed_like, without_mesh
from jaxrock._settings import under_usual_settings
from jaxrock.transforms.forward_mode import (
    directions_of,
    in_rows,
    pulled_back,
    value_and_change,
    value_and_changes,
    value_and_jacobian,
)
from jaxrock.transforms.lowering import lowered
from jaxrock.transforms.recipe import Recipe

AT_ONCE = 8  # directions of which machine code keeps the changes in registers
_MANY = 64  # numbers to differentiate by, from which on a Jacobian is dearer than a tape

scenes_p = Primitive("scenes")
scenes_p.multiple_results = True


def computed(recipe: Recipe, leaves: list):
    """What a recipe makes of the leaves of one scene."""
    found = scenes_p.bind(*leaves, recipe=recipe, own=(False,) * len(leaves), size=None)
    return jax.tree.unflatten(jax.tree.structure(recipe.results), found)


# Parameters: the recipe; which leaves are a scene's `own`, with a leading axis; how many scenes (None: one, no axis).


@functools.partial(jax.jit, static_argnames=("recipe", "own", "size"))
def _compiled(*leaves, recipe, own, size):
    return scenes_p.bind(*leaves, recipe=recipe, own=own, size=size)


@scenes_p.def_impl
@under_usual_settings
def _(*leaves, recipe, own, size):
    return _compiled(*leaves, recipe=recipe, own=own, size=size)


@scenes_p.def_abstract_eval
def _(*leaves, recipe, own, size):
    axis = () if size is None else (size,)
    return typed_like(leaves, [((*axis, *x.shape), x.dtype) for x in jax.tree.leaves(recipe.results)])


@under_usual_settings
def _batched(leaves, axes, *, recipe, own, size):
    new = [axis is not None for axis in axes]  # what is not mapped has none
    leaves = [jnp.moveaxis(x, axis, 0) if moved else x for x, axis, moved in zip(leaves, axes, new)]
    more = next(x.shape[0] for x, moved in zip(leaves, new) if moved)
    of_directions = not any(new[: len(new) - recipe.directions])
    if of_directions and size is None:
        # One scene's numbers are given to all directions, so that it is computed where they are.
        spread = [not (moved or x.shape) for x, moved in zip(leaves, new)]
        leaves = [jnp.broadcast_to(x, (more,)) if every else x for x, every in zip(leaves, spread)]
        new = [moved or every for moved, every in zip(new, spread)]
    if size is None:
        found = scenes_p.bind(*leaves, recipe=recipe, own=tuple(new), size=more)
    else:
        found = _one_more_axis(leaves, new, more, recipe, own, size)
    shared = len(jax.tree.leaves(recipe.results[0])) if of_directions else 0  # the value is the same in all
    return [*(x[0] for x in found[:shared]), *found[shared:]], [*[None] * shared, *[0] * (len(found) - shared)]


batching.primitive_batchers[scenes_p] = _batched


def _one_more_axis(leaves, new, more, recipe, own, size):
    """Both axes become one, unless arrays that all scenes share would be copied for each."""
    if any(moved and not old and jnp.ndim(x) > 1 for moved, old, x in zip(new, own, leaves)):
        moving = [x for x, moved in zip(leaves, new) if moved]

        def one(moving):
            rest = iter(moving)
            given = [next(rest) if moved else x for x, moved in zip(leaves, new)]
            return scenes_p.bind(*given, recipe=recipe, own=own, size=size)

        return jax.lax.map(one, moving)

    def merged(x, moved, old):
        if not (moved or old):
            return x
        x = x if moved else x[None]
        x = x if old else x[:, None]
        return jnp.broadcast_to(x, (more, size, *x.shape[2:])).reshape(more * size, *x.shape[2:])

    leaves = [merged(*each) for each in zip(leaves, new, own)]
    flags = tuple(moved or old for moved, old in zip(new, own))
    found = scenes_p.bind(*leaves, recipe=recipe, own=flags, size=more * size)
    return [x.reshape(more, size, *x.shape[1:]) for x in found]


def _unmoved(x):
    return ad.Zero(jax.typeof(x).to_tangent_aval())


def _moves(changes) -> tuple[bool, ...]:
    return tuple(type(d) is not ad.Zero and d.dtype != jax.dtypes.float0 for d in changes)


@under_usual_settings
def _pushed(leaves, changes, *, recipe, own, size):
    moves = _moves(changes)
    if not any(moves):
        found = scenes_p.bind(*leaves, recipe=recipe, own=own, size=size)
        return found, [_unmoved(x) for x in found]
    moving = [d for d, move in zip(changes, moves) if move]
    axes = [0 if mine else None for mine, move in zip(own, moves) if move]
    numbers = sum(x.size for x, move in zip(recipe.like, moves) if move)
    if recipe.derivatives == "on a tape" or (recipe.on_tape is not None and numbers > _MANY):
        value = scenes_p.bind(*leaves, recipe=recipe, own=own, size=size)
        taped = recipe if recipe.derivatives == "on a tape" else recipe.taped
        return value, _pushed_in_a_direction(leaves, moves, moving, taped, own, size)[1]
    too_many = recipe.derivatives == "a few at once" and numbers > _MANY
    if too_many or recipe.derivatives == "in a direction":
        return _pushed_in_a_direction(leaves, moves, moving, recipe, own, size)
    # Few directions of one scene are lanes of a vector, and the program of one is the smallest. (Lists of a record,
    # which one scene looks up for all lanes, would take a fifth longer.)
    alone = size is None and 1 < numbers <= AT_ONCE and not any(x.shape for x in recipe.like)
    if recipe.derivatives == "by directions" or (recipe.in_lanes and recipe.order):
        value, jacobian = _jacobian_by_directions(leaves, moves, recipe, own, size)
    elif recipe.in_lanes and alone:
        value, jacobian = _jacobian_alone(leaves, moves, recipe)
    elif recipe.in_lanes and numbers > AT_ONCE:
        value, jacobian = _jacobian_in_rows(leaves, moves, recipe, own, size)
    else:
        value, jacobian = _jacobian_at_once(leaves, moves, recipe, own, size)

    def contracted(jacobian, *moving):
        change = jnp.concatenate([d.ravel() for d in moving])

        def along(columns):
            each = change.reshape(-1, *[1] * (columns.ndim - 1)).astype(columns.dtype)
            return (columns * each).sum(axis=0)

        return jax.tree.map(along, jacobian)

    if size is not None:
        contracted = jax.vmap(contracted, in_axes=(0, *axes))
    return value, [_unmoved(x) if d is None else d for x, d in zip(value, contracted(jacobian, *moving), strict=True)]


def _pushed_in_a_direction(leaves, moves, moving, recipe, own, size):
    """Value and change by one program of both: of a part of something that forward mode goes through as a whole, and
    that moves by far fewer numbers than the part is given; or of a tape, where there are too many for a Jacobian."""
    both = value_and_change(recipe, moves)
    flags = *own, *(mine for mine, move in zip(own, moves) if move)
    found = scenes_p.bind(*leaves, *moving, recipe=both, own=flags, size=size)
    value, changes = jax.tree.unflatten(jax.tree.structure(both.results), found)
    value = jax.tree.leaves(value)
    return value, [_unmoved(x) if d is None else d for x, d in zip(value, changes, strict=True)]


def _jacobian_at_once(leaves, moves, recipe, own, size):
    """Value and Jacobian by one program of all directions."""
    both = value_and_jacobian(recipe, moves)
    found = scenes_p.bind(*leaves, recipe=both, own=own, size=size)
    value, jacobian = jax.tree.unflatten(jax.tree.structure(both.results), found)
    return jax.tree.leaves(value), jacobian


def _jacobian_by_directions(leaves, moves, recipe, own, size):
    """The same, of derivatives: by a program of one direction, which is a scene of its own.

    A Hessian of five numbers by one program of all would be thirty-six numbers for every number of the function, and
    take ten times as long to compile as this, of twelve, which computes the first derivatives for every direction."""
    both = value_and_change(recipe, moves)
    moving = [x for x, move in zip(recipe.like, moves) if move]

    def one(*direction):
        found = scenes_p.bind(*leaves, *direction, recipe=both, own=(*own, *[False] * len(moving)), size=size)
        value, changes = jax.tree.unflatten(jax.tree.structure(both.results), found)
        return jax.tree.leaves(value), changes

    value, changes = jax.vmap(one, out_axes=(None, 0 if size is None else 1))(*directions_of(moving))
    return value, changes


def _jacobian_in_rows(leaves, moves, recipe, own, size):
    """The same, a few directions at a time: machine code for all at once would be without end, or not at all."""
    moving = [x for x, move in zip(recipe.like, moves) if move]
    rows = in_rows(directions_of(moving), AT_ONCE)
    both = value_and_changes(recipe, moves, rows[0].shape[1])

    def one(*row):
        found = scenes_p.bind(*leaves, *row, recipe=both, own=(*own, *[False] * len(moving)), size=size)
        value, changes = jax.tree.unflatten(jax.tree.structure(both.results), found)
        return jax.tree.leaves(value), changes

    axes = () if size is None else (size,)
    value, changes = jax.vmap(one, out_axes=(None, len(axes)))(*rows)
    count = sum(math.prod(x.shape) for x in moving)

    def column(d):
        whole = d.reshape(*axes, -1, *d.shape[len(axes) + 2 :])
        return whole[:, :count] if axes else whole[:count]

    return value, [None if d is None else column(d) for d in changes]


ad.primitive_jvps[scenes_p] = _pushed


@under_usual_settings
def _transposed(weights, *leaves, recipe, own, size):
    """Of a change on a tape, which is linear in its direction; its value weighs nothing."""
    base, moves = recipe.origin
    count = len(leaves) - recipe.directions
    values = len(jax.tree.leaves(recipe.results[0]))
    weights = [ad.instantiate_zeros(x) for x in weights[values:]]
    flags = *own[:count], *[size is not None] * len(weights)
    found = scenes_p.bind(*leaves[:count], *weights, recipe=pulled_back(base, moves), own=flags, size=size)
    summed = [x if size is None or mine else x.sum(axis=0) for x, mine in zip(found, own[count:])]
    return [*[None] * count, *(summed_like(x, leaf.aval) for x, leaf in zip(summed, leaves[count:]))]


ad.primitive_transposes[scenes_p] = _transposed

mlir.register_lowering(scenes_p, functools.partial(lowered, on_cpu=False))
mlir.register_lowering(scenes_p, functools.partial(lowered, on_cpu=True), platform="cpu")


# Value and Jacobian of one scene, by directions; of many, which `jax.vmap` makes of it later, at once: every scene is
# computed once then. A derivative does not know what it will be part of (`jax.vmap(jax.jit(jax.grad(...)))`).
# Parameters: the recipe, and which of its leaves move.
alone_p = Primitive("scene_alone")
alone_p.multiple_results = True


def _jacobian_alone(leaves, moves, recipe):
    found = alone_p.bind(*leaves, recipe=recipe, moves=moves)
    value, jacobian = jax.tree.unflatten(jax.tree.structure(value_and_jacobian(recipe, moves).results), found)
    return jax.tree.leaves(value), jacobian


def _by_directions(*leaves, recipe, moves):
    return jax.tree.leaves(_jacobian_by_directions(leaves, moves, recipe, (False,) * len(leaves), None))


@functools.partial(jax.jit, static_argnames=("recipe", "moves"))
def _compiled_alone(*leaves, recipe, moves):
    return alone_p.bind(*leaves, recipe=recipe, moves=moves)


@alone_p.def_impl
@under_usual_settings
def _(*leaves, recipe, moves):
    return _compiled_alone(*leaves, recipe=recipe, moves=moves)


@alone_p.def_abstract_eval
def _(*leaves, recipe, moves):
    return typed_like(leaves, [(x.shape, x.dtype) for x in jax.tree.leaves(value_and_jacobian(recipe, moves).results)])


@under_usual_settings
def _alone_no_more(leaves, axes, *, recipe, moves):
    own = tuple(axis is not None for axis in axes)
    leaves = [jnp.moveaxis(x, axis, 0) if mine else x for x, axis, mine in zip(leaves, axes, own)]
    size = next(x.shape[0] for x, mine in zip(leaves, own) if mine)
    found = jax.tree.leaves(_jacobian_at_once(leaves, moves, recipe, own, size))
    return found, [0] * len(found)


batching.primitive_batchers[alone_p] = _alone_no_more


@under_usual_settings
def _alone_pushed(leaves, changes, *, recipe, moves):
    moved = _moves(changes)

    def function(*moving):
        rest = iter(moving)
        return _by_directions(
            *(next(rest) if move else x for x, move in zip(leaves, moved)), recipe=recipe, moves=moves
        )

    if not any(moved):
        found = function()
        return found, [_unmoved(x) for x in found]
    moving = ([x for x, move in zip(each, moved) if move] for each in (leaves, changes))
    found, pushed = jax.jvp(function, *moving)
    return found, [_unmoved(x) if d.dtype == jax.dtypes.float0 else d for x, d in zip(found, pushed)]


ad.primitive_jvps[alone_p] = _alone_pushed


@under_usual_settings
def _alone_lowered(context, *leaves, **parameters):
    written = mlir.lower_fun(functools.partial(_by_directions, **parameters), multiple_results=True)
    return written(without_mesh(context), *leaves)


mlir.register_lowering(alone_p, _alone_lowered)
