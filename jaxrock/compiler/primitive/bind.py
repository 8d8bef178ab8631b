"""The primitive `lane_map`, a lane function at one point or at many, with all its rules; and `single_jacobian`.

- Under `jax.vmap` one point becomes many; another `jax.vmap` multiplies the number of points.
- The tangent is a small Jacobian times the tangents of the inputs. Value and Jacobian are one `LaneFunction`, so
  derivatives of every order follow, and reverse mode. In derivatives of higher order, every direction is a point.
- `lower` lowers it when JAX compiles, for the platform that JAX compiles for.

`single_jacobian` stands for the derivative at one point until it is known whether `jax.vmap` makes many points of it.
"""

import functools
import math

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from jaxrock._core.settings import under_usual_settings
from jaxrock._core.unit_tangents import AT_ONCE, in_rows, unit_tangents
from jaxrock.compiler.autodiff.derivatives import (
    pulled_back,
    value_and_change,
    value_and_changes,
    value_and_jacobian,
)
from jaxrock.compiler.primitive.lane_function import LaneFunction, Mode
from jaxrock.compiler.primitive.lower import lowered
from jaxrock.compiler.primitive.sharding_types import summed_like, typed_like, without_mesh

_MANY = 64  # by more numbers than these, a Jacobian costs more than a tape

lane_map_p = Primitive("lane_map")
lane_map_p.multiple_results = True


def computed(fn: LaneFunction, leaves: list):
    """Return the results of a `LaneFunction` for the leaves of one point."""
    found = lane_map_p.bind(*leaves, fn=fn, is_batched=(False,) * len(leaves), size=None)
    return jax.tree.unflatten(jax.tree.structure(fn.results), found)


# Parameters: the `LaneFunction`; for each leaf, whether it is batched (has a leading axis); the number of points (None:
# one, without an axis).


@functools.partial(jax.jit, static_argnames=("fn", "is_batched", "size"))
def _compiled(*leaves, fn, is_batched, size):
    return lane_map_p.bind(*leaves, fn=fn, is_batched=is_batched, size=size)


@lane_map_p.def_impl
@under_usual_settings
def _(*leaves, fn, is_batched, size):
    return _compiled(*leaves, fn=fn, is_batched=is_batched, size=size)


@lane_map_p.def_abstract_eval
def _(*leaves, fn, is_batched, size):
    axis = () if size is None else (size,)
    return typed_like(leaves, [((*axis, *x.shape), x.dtype) for x in jax.tree.leaves(fn.results)])


@under_usual_settings
def _batched(leaves, axes, *, fn, is_batched, size):
    new = [axis is not None for axis in axes]  # an unmapped leaf has no axis
    leaves = [jnp.moveaxis(x, axis, 0) if moved else x for x, axis, moved in zip(leaves, axes, new)]
    more = next(x.shape[0] for x, moved in zip(leaves, new) if moved)
    of_directions = not any(new[: len(new) - fn.directions])
    if of_directions and size is None:
        # Only directions are mapped: each lane gets the point's numbers, and computes the value beside its tangent.
        spread = [not (moved or x.shape) for x, moved in zip(leaves, new)]
        leaves = [jnp.broadcast_to(x, (more,)) if every else x for x, every in zip(leaves, spread)]
        new = [moved or every for moved, every in zip(new, spread)]
    if size is None:
        found = lane_map_p.bind(*leaves, fn=fn, is_batched=tuple(new), size=more)
    else:
        found = _one_more_axis(leaves, new, more, fn, is_batched, size)
    shared = len(jax.tree.leaves(fn.results[0])) if of_directions else 0  # the value is the same for all directions
    return [*(x[0] for x in found[:shared]), *found[shared:]], [*[None] * shared, *[0] * (len(found) - shared)]


batching.primitive_batchers[lane_map_p] = _batched


def _one_more_axis(leaves, new, more, fn, is_batched, size):
    """Merge both axes into one, unless that would copy an array that all points share for each of them."""
    if any(moved and not old and jnp.ndim(x) > 1 for moved, old, x in zip(new, is_batched, leaves)):
        moving = [x for x, moved in zip(leaves, new) if moved]

        def one(moving):
            rest = iter(moving)
            given = [next(rest) if moved else x for x, moved in zip(leaves, new)]
            return lane_map_p.bind(*given, fn=fn, is_batched=is_batched, size=size)

        return jax.lax.map(one, moving)

    def merged(x, moved, old):
        if not (moved or old):
            return x
        x = x if moved else x[None]
        x = x if old else x[:, None]
        return jnp.broadcast_to(x, (more, size, *x.shape[2:])).reshape(more * size, *x.shape[2:])

    leaves = [merged(*each) for each in zip(leaves, new, is_batched)]
    flags = tuple(moved or old for moved, old in zip(new, is_batched))
    found = lane_map_p.bind(*leaves, fn=fn, is_batched=flags, size=more * size)
    return [x.reshape(more, size, *x.shape[1:]) for x in found]


def _unmoved(x):
    return ad.Zero(jax.typeof(x).to_tangent_aval())


def _has_tangent(changes) -> tuple[bool, ...]:
    return tuple(type(d) is not ad.Zero and d.dtype != jax.dtypes.float0 for d in changes)


@under_usual_settings
def _jvp(leaves, changes, *, fn, is_batched, size):
    has_tangent = _has_tangent(changes)
    if not any(has_tangent):
        found = lane_map_p.bind(*leaves, fn=fn, is_batched=is_batched, size=size)
        return found, [_unmoved(x) for x in found]
    moving = [d for d, move in zip(changes, has_tangent) if move]
    axes = [0 if mine else None for mine, move in zip(is_batched, has_tangent) if move]
    numbers = sum(x.size for x, move in zip(fn.in_avals, has_tangent) if move)
    if fn.mode == Mode.TAPE or (fn.reverse is not None and numbers > _MANY):
        value = lane_map_p.bind(*leaves, fn=fn, is_batched=is_batched, size=size)
        taped = fn if fn.mode == Mode.TAPE else fn.taped
        return value, _jvp_in_one_direction(leaves, has_tangent, moving, taped, is_batched, size)[1]
    too_many = fn.mode == Mode.JACOBIAN_OR_JVP and numbers > _MANY
    if too_many or fn.mode == Mode.JVP:
        return _jvp_in_one_direction(leaves, has_tangent, moving, fn, is_batched, size)
    # Few directions of one point are lanes of a vector: the jaxpr of one direction is the smallest. (With long arrays,
    # which one lane looks up for all directions, that would take a fifth longer.)
    alone = size is None and 1 < numbers <= AT_ONCE and not any(x.shape for x in fn.in_avals)
    if fn.mode == Mode.COLUMNS or (fn.in_lanes and fn.order):
        value, jacobian = _jacobian_by_columns(leaves, has_tangent, fn, is_batched, size)
    elif fn.in_lanes and alone:
        value, jacobian = _jacobian_alone(leaves, has_tangent, fn)
    elif fn.in_lanes and numbers > AT_ONCE:
        value, jacobian = _jacobian_in_rows(leaves, has_tangent, fn, is_batched, size)
    else:
        value, jacobian = _jacobian_at_once(leaves, has_tangent, fn, is_batched, size)

    def contracted(jacobian, *moving):
        change = jnp.concatenate([d.ravel() for d in moving])

        def along(columns):
            each = change.reshape(-1, *[1] * (columns.ndim - 1)).astype(columns.dtype)
            return (columns * each).sum(axis=0)

        return jax.tree.map(along, jacobian)

    if size is not None:
        contracted = jax.vmap(contracted, in_axes=(0, *axes))
    return value, [_unmoved(x) if d is None else d for x, d in zip(value, contracted(jacobian, *moving), strict=True)]


def _jvp_in_one_direction(leaves, has_tangent, moving, fn, is_batched, size):
    """Return value and tangent from one run that computes both.

    For a part of a function that forward mode follows as a whole, along far fewer directions than the part has inputs.
    Also for a tape, where the inputs are too many for a Jacobian.
    """
    both = value_and_change(fn, has_tangent)
    flags = *is_batched, *(mine for mine, move in zip(is_batched, has_tangent) if move)
    found = lane_map_p.bind(*leaves, *moving, fn=both, is_batched=flags, size=size)
    value, changes = jax.tree.unflatten(jax.tree.structure(both.results), found)
    value = jax.tree.leaves(value)
    return value, [_unmoved(x) if d is None else d for x, d in zip(value, changes, strict=True)]


def _jacobian_at_once(leaves, has_tangent, fn, is_batched, size):
    """Return value and Jacobian from one run with all directions."""
    both = value_and_jacobian(fn, has_tangent)
    found = lane_map_p.bind(*leaves, fn=both, is_batched=is_batched, size=size)
    value, jacobian = jax.tree.unflatten(jax.tree.structure(both.results), found)
    return jax.tree.leaves(value), jacobian


def _jacobian_by_columns(leaves, has_tangent, fn, is_batched, size):
    """Return value and Jacobian of a derivative from a `LaneFunction` of one direction, with each direction as a point.

    A Hessian by five numbers, with all directions in one run, takes 36 numbers for every number of the function. It
    compiles ten times as long. This run takes 12, and computes the first derivatives again for every direction.
    """
    both = value_and_change(fn, has_tangent)
    moving = [x for x, move in zip(fn.in_avals, has_tangent) if move]

    def one(*direction):
        found = lane_map_p.bind(
            *leaves, *direction, fn=both, is_batched=(*is_batched, *[False] * len(moving)), size=size
        )
        value, changes = jax.tree.unflatten(jax.tree.structure(both.results), found)
        return jax.tree.leaves(value), changes

    value, changes = jax.vmap(one, out_axes=(None, 0 if size is None else 1))(*unit_tangents(moving))
    return value, changes


def _jacobian_in_rows(leaves, has_tangent, fn, is_batched, size):
    """Return value and Jacobian, a few directions at a time: machine code for all at once would be too long."""
    moving = [x for x, move in zip(fn.in_avals, has_tangent) if move]
    rows = in_rows(unit_tangents(moving), AT_ONCE)
    both = value_and_changes(fn, has_tangent, rows[0].shape[1])

    def one(*row):
        found = lane_map_p.bind(*leaves, *row, fn=both, is_batched=(*is_batched, *[False] * len(moving)), size=size)
        value, changes = jax.tree.unflatten(jax.tree.structure(both.results), found)
        return jax.tree.leaves(value), changes

    axes = () if size is None else (size,)
    value, changes = jax.vmap(one, out_axes=(None, len(axes)))(*rows)
    count = sum(math.prod(x.shape) for x in moving)

    def column(d):
        whole = d.reshape(*axes, -1, *d.shape[len(axes) + 2 :])
        return whole[:, :count] if axes else whole[:count]

    return value, [None if d is None else column(d) for d in changes]


ad.primitive_jvps[lane_map_p] = _jvp


@under_usual_settings
def _transpose(weights, *leaves, fn, is_batched, size):
    """Transpose the tangent on a tape, which is linear in its direction; the cotangent of the value is dropped."""
    base, has_tangent = fn.origin
    count = len(leaves) - fn.directions
    values = len(jax.tree.leaves(fn.results[0]))
    weights = [ad.instantiate_zeros(x) for x in weights[values:]]
    flags = *is_batched[:count], *[size is not None] * len(weights)
    found = lane_map_p.bind(*leaves[:count], *weights, fn=pulled_back(base, has_tangent), is_batched=flags, size=size)
    summed = [x if size is None or mine else x.sum(axis=0) for x, mine in zip(found, is_batched[count:])]
    return [*[None] * count, *(summed_like(x, leaf.aval) for x, leaf in zip(summed, leaves[count:]))]


ad.primitive_transposes[lane_map_p] = _transpose

mlir.register_lowering(lane_map_p, functools.partial(lowered, on_cpu=False))
mlir.register_lowering(lane_map_p, functools.partial(lowered, on_cpu=True), platform="cpu")


# Value and Jacobian of one point. `grad` may be vmapped later (`jax.vmap(jax.jit(jax.grad(...)))`), so the choice of
# the Jacobian's schedule is deferred. One point is lowered with its directions as lanes. Under `jax.vmap` one run has
# all directions, so that each point is computed once.
# Parameters: the `LaneFunction`; for each leaf, whether it has a tangent.
single_jacobian_p = Primitive("single_jacobian")
single_jacobian_p.multiple_results = True


def _jacobian_alone(leaves, has_tangent, fn):
    found = single_jacobian_p.bind(*leaves, fn=fn, has_tangent=has_tangent)
    value, jacobian = jax.tree.unflatten(jax.tree.structure(value_and_jacobian(fn, has_tangent).results), found)
    return jax.tree.leaves(value), jacobian


def _by_columns(*leaves, fn, has_tangent):
    return jax.tree.leaves(_jacobian_by_columns(leaves, has_tangent, fn, (False,) * len(leaves), None))


@functools.partial(jax.jit, static_argnames=("fn", "has_tangent"))
def _compiled_single(*leaves, fn, has_tangent):
    return single_jacobian_p.bind(*leaves, fn=fn, has_tangent=has_tangent)


@single_jacobian_p.def_impl
@under_usual_settings
def _(*leaves, fn, has_tangent):
    return _compiled_single(*leaves, fn=fn, has_tangent=has_tangent)


@single_jacobian_p.def_abstract_eval
def _(*leaves, fn, has_tangent):
    return typed_like(
        leaves, [(x.shape, x.dtype) for x in jax.tree.leaves(value_and_jacobian(fn, has_tangent).results)]
    )


@under_usual_settings
def _single_batched(leaves, axes, *, fn, has_tangent):
    is_batched = tuple(axis is not None for axis in axes)
    leaves = [jnp.moveaxis(x, axis, 0) if mine else x for x, axis, mine in zip(leaves, axes, is_batched)]
    size = next(x.shape[0] for x, mine in zip(leaves, is_batched) if mine)
    found = jax.tree.leaves(_jacobian_at_once(leaves, has_tangent, fn, is_batched, size))
    return found, [0] * len(found)


batching.primitive_batchers[single_jacobian_p] = _single_batched


@under_usual_settings
def _single_jvp(leaves, changes, *, fn, has_tangent):
    moved = _has_tangent(changes)

    def function(*moving):
        rest = iter(moving)
        return _by_columns(
            *(next(rest) if move else x for x, move in zip(leaves, moved)), fn=fn, has_tangent=has_tangent
        )

    if not any(moved):
        found = function()
        return found, [_unmoved(x) for x in found]
    moving = ([x for x, move in zip(each, moved) if move] for each in (leaves, changes))
    found, pushed = jax.jvp(function, *moving)
    return found, [_unmoved(x) if d.dtype == jax.dtypes.float0 else d for x, d in zip(found, pushed)]


ad.primitive_jvps[single_jacobian_p] = _single_jvp


@under_usual_settings
def _single_lowered(context, *leaves, **parameters):
    written = mlir.lower_fun(functools.partial(_by_columns, **parameters), multiple_results=True)
    return written(without_mesh(context), *leaves)


mlir.register_lowering(single_jacobian_p, _single_lowered)
