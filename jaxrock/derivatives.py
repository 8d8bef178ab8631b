"""Derivatives of functions that JAX differentiates in forward mode only, or not at all."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxrock.lanes import Passes, in_lanes

_MANY = 64  # numbers to differentiate by, from which on a Jacobian is dearer than a tape


@jax.custom_jvp
def with_derivatives_of(value, other):
    """`value`, with the derivatives of `other`, which is the same but for rounding; without derivatives it is free."""
    return value


@with_derivatives_of.defjvp
def _(primals, tangents):
    return with_derivatives_of(*primals), tangents[1]


def differentiable(function: Callable, on_tape: Callable | None = None, passes: Passes | None = None) -> Callable:
    """`function(tree)` with derivatives of every order, forward and reverse, from forward mode alone.

    The derivative is a small Jacobian times the change of the inputs: one column for every number that is
    differentiated, all in one run with the value. As a product it transposes, so reverse mode goes through; and the
    function that makes value and Jacobian is `differentiable` in its turn, so second derivatives do, too.

    `on_tape`: the same function, through whose own code reverse mode goes; for derivatives by very many numbers.
    `passes`: as in `in_lanes`; under `jax.vmap` all this runs in lanes.
    """
    in_lanes_ = in_lanes(function, passes)

    @eqx.filter_custom_jvp
    def evaluate(tree):
        return in_lanes_(tree)

    @evaluate.def_jvp
    def _(primals, tangents):
        (tree,), (change,) = primals, tangents
        leaves, structure = jax.tree.flatten(tree)
        all_changes = structure.flatten_up_to(change)
        moves, changes = [d is not None for d in all_changes], [d for d in all_changes if d is not None]
        if on_tape is not None and sum(d.size for d in changes) > _MANY:
            return eqx.filter_jvp(on_tape, (tree,), (change,))
        value, jacobian = differentiable(_value_and_jacobian(function, structure, moves))(leaves)

        def contracted(columns):
            return sum(jnp.tensordot(c, d, axes=d.ndim) for c, d in zip(columns, changes))

        moved = [None if columns is None else contracted(columns) for columns in jacobian]
        return value, jax.tree.unflatten(jax.tree.structure(value), moved)

    return evaluate


def _value_and_jacobian(function: Callable, structure, moves: list[bool]) -> Callable:
    """`function` at leaves, with its real outputs' derivatives by the leaves that move (a list; None for others)."""

    def both(leaves):
        moving = [leaf for leaf, moves_ in zip(leaves, moves) if moves_]
        sizes = [leaf.size for leaf in moving]
        cuts = np.cumsum(sizes)[:-1]

        def of(moving):
            rest = iter(moving)
            return function(jax.tree.unflatten(structure, [next(rest) if m else x for x, m in zip(leaves, moves)]))

        directions = jnp.split(jnp.eye(sum(sizes), dtype=jnp.result_type(*moving)), cuts, axis=1)
        directions = [d.reshape(-1, *leaf.shape).astype(leaf.dtype) for d, leaf in zip(directions, moving)]
        value, columns = jax.vmap(lambda *d: jax.jvp(of, (moving,), (list(d),)), out_axes=(None, 0))(*directions)

        def per_leaf(out, column):
            if not jnp.issubdtype(out.dtype, jnp.inexact):
                return None
            parts = jnp.split(column, cuts, axis=0)
            return [jnp.moveaxis(p, 0, -1).reshape(*out.shape, *leaf.shape) for p, leaf in zip(parts, moving)]

        return value, [per_leaf(*pair) for pair in zip(jax.tree.leaves(value), jax.tree.leaves(columns), strict=True)]

    return both
