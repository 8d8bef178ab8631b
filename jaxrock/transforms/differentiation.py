"""Derivatives of functions that JAX differentiates in forward mode only, or not at all."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxrock.transforms.batching import Passes, in_lanes
from jaxrock.transforms.deferred import deferred

_MANY = 64  # numbers to differentiate by, from which on a Jacobian is dearer than a tape


@jax.custom_jvp
def with_derivatives_of(value, other):
    """`value`, with the derivatives of `other`, which is the same but for rounding; without derivatives it is free."""
    return value


@with_derivatives_of.defjvp
def _(primals, tangents):
    return with_derivatives_of(*primals), tangents[1]


def differentiable(
    function: Callable,
    on_tape: Callable | None = None,
    passes: Passes | None = None,
    alone: Callable | None = None,
) -> Callable:
    """`function(tree)` with derivatives of every order, forward and reverse, from forward mode alone.

    The derivative is a small Jacobian times the change of the inputs: one column for every number that is
    differentiated, all in one run with the value. As a product it transposes, so reverse mode goes through; and the
    function that makes value and Jacobian is `differentiable` in its turn, so second derivatives do, too.

    `on_tape`: the same function, through whose own code reverse mode goes; for derivatives by very many numbers.
    `passes`, `alone`: as in `in_lanes`; under `jax.vmap` all this runs in lanes.
    """
    in_lanes_ = in_lanes(function, passes, alone)

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
        along = _Along(structure, moves)
        more = None if passes is None else along.passes(passes)
        both = along.value_and_jacobian(function)
        value, jacobian = differentiable(both, passes=more, alone=along.deferred(both, function, leaves))(leaves)

        def contracted(columns):
            return sum(jnp.tensordot(c, d, axes=d.ndim) for c, d in zip(columns, changes))

        moved = [None if columns is None else contracted(columns) for columns in jacobian]
        return value, jax.tree.unflatten(jax.tree.structure(value), moved)

    return evaluate


class _Along(NamedTuple):
    """Forward mode along every number of the leaves that move."""

    structure: Any  # of the tree
    moves: list[bool]  # which of its leaves do

    def _start(self, leaves):
        """The moving leaves, their directions, and the tree of such leaves."""
        moving = [leaf for leaf, moves in zip(leaves, self.moves) if moves]
        sizes = [leaf.size for leaf in moving]
        directions = jnp.split(jnp.eye(sum(sizes), dtype=jnp.result_type(*moving)), np.cumsum(sizes)[:-1], axis=1)
        directions = [d.reshape(-1, *leaf.shape).astype(leaf.dtype) for d, leaf in zip(directions, moving)]

        def tree(moving):
            rest = iter(moving)
            return self.structure.unflatten([next(rest) if m else x for x, m in zip(leaves, self.moves)])

        return moving, directions, tree

    def _columns(self, value, tangents, leaves) -> list:
        """For every leaf of a value its derivatives by the moving leaves, in their shapes; None for integers."""
        moving = [leaf for leaf, moves in zip(leaves, self.moves) if moves]
        cuts = np.cumsum([leaf.size for leaf in moving])[:-1]

        def of(out, column):
            if not jnp.issubdtype(out.dtype, jnp.inexact):
                return None
            parts = jnp.split(column, cuts, axis=0)
            return [jnp.moveaxis(p, 0, -1).reshape(*out.shape, *leaf.shape) for p, leaf in zip(parts, moving)]

        return [of(*pair) for pair in zip(jax.tree.leaves(value), jax.tree.leaves(tangents), strict=True)]

    def value_and_jacobian(self, function: Callable) -> Callable:
        """`function(tree)` at leaves, with its real outputs' derivatives by the leaves that move (a list)."""

        def both(leaves):
            moving, directions, tree = self._start(leaves)
            value, tangents = jax.vmap(
                lambda *d: jax.jvp(lambda x: function(tree(x)), (moving,), (list(d),)), out_axes=(None, 0)
            )(*directions)
            return value, self._columns(value, tangents, leaves)

        return both

    def deferred(self, both: Callable, function: Callable, leaves: list) -> Callable:
        """`both`, value and Jacobian, traced where it is compiled: what it returns is known from the value."""
        program, value = jax.make_jaxpr(function, return_shape=True)(self.structure.unflatten(leaves))
        if any(isinstance(x, jax.core.Tracer) for x in program.consts):
            return both  # it must be traced within what these belong to
        moving = [leaf for leaf, moves in zip(leaves, self.moves) if moves]

        def of(out):
            if not jnp.issubdtype(out.dtype, jnp.inexact):
                return None
            return [jax.ShapeDtypeStruct((*out.shape, *leaf.shape), out.dtype) for leaf in moving]

        description = f"value and derivatives by {[int(moves) for moves in self.moves]}"
        return deferred(both, program, description, (value, [of(out) for out in jax.tree.leaves(value)]))

    def passes(self, passes: Passes) -> Passes:
        """The same in parts. Only the careful pass has derivatives, so there is no quick one."""

        def begin(leaves):
            moving, directions, tree = self._start(leaves)
            begun, tangents = _pushed(lambda x: passes.begin(tree(x)), (moving,), (directions,))
            # Leaves go along for their shapes.
            return (begun[0], tangents[0], leaves), (begun[1], tangents[1])

        def carefully(scene, state):
            return _pushed(passes.carefully, (scene[0], state[0]), (scene[1], state[1]))

        def conclude(scene, state):
            (value, postponed), (tangents, _) = _pushed(passes.conclude, (scene[0], state[0]), (scene[1], state[1]))
            tangents = jax.tree.map(lambda x, d: x if d is None else d, value, tangents, is_leaf=lambda x: x is None)
            return (value, self._columns(value, tangents, scene[2])), postponed

        return Passes(begin, None, carefully, None, conclude, None)


def _pushed(function: Callable, values: tuple, tangents: tuple):
    """`function(*values)`, and its tangents (None for what is not real) from stacks of tangents like that."""
    real, rest = eqx.partition(values, eqx.is_inexact_array)

    def of_real(real):
        return eqx.partition(function(*eqx.combine(real, rest)), eqx.is_inexact_array)

    def along(tangents):
        return jax.jvp(of_real, (real,), (tangents,), has_aux=True)

    results, pushed, other = jax.vmap(along, out_axes=(None, 0, None))(tangents)
    return eqx.combine(results, other), pushed
