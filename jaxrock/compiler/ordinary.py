"""Functions of the door as ordinary JAX, for `JAXROCK_COMPILER=off`: no lanes, no machine code, no cache.

Derivatives are those of JAX: `jax.jvp` through the function, and `jax.custom_jvp` for rules. So this backend judges the
compiler.
"""

import os
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero

from jaxrock._core.unit_tangents import unit_tangents

# Read once: programs that JAX has compiled already would not follow a change.
IS_ORDINARY = os.environ.get("JAXROCK_COMPILER", "").strip().lower() in ("off", "no", "none", "false", "0")
_MANY = 64  # numbers to differentiate by, from which on a Jacobian is dearer than reverse mode


def ordinary_lane_function(function: Callable, reverse: Callable | None = None, contract: bool = True) -> Callable:
    """Return `function(tree)` with derivatives forward and reverse of every order, from forward mode alone.

    **Arguments:**

    - `function`: of a tree of arrays. `reverse`: the same, where JAX's reverse mode goes through its code.
    - `contract`: whether derivatives are a Jacobian times the tangents, which transposes; else they are `jax.jvp`.
    """

    def run(tree: Any) -> Any:
        leaves, structure = _flat(tree)

        def of_leaves(which: Callable) -> Callable:
            return lambda *leaves: which(structure.unflatten(leaves))

        backward = None if reverse is None else of_leaves(reverse)
        return _differentiable(of_leaves(function), backward, contract)(*map(jnp.asarray, leaves))

    return run


def _flat(tree: Any) -> tuple[list, Any]:
    return jax.tree.flatten(tree)


def _differentiable(function: Callable, reverse: Callable | None, contract: bool) -> Callable:
    run = jax.custom_jvp(function)

    def rule(primals: tuple, tangents: tuple) -> tuple:
        moving = [i for i, d in enumerate(tangents) if not isinstance(d, SymbolicZero)]
        moving = [i for i in moving if jnp.issubdtype(primals[i].dtype, jnp.inexact)]
        if not moving:
            value = run(*primals)
            return value, jax.tree.map(_zero, value)

        def of_moving(which: Callable, *own: Any) -> Any:
            rest = dict(zip(moving, own))
            return which(*(rest.get(i, x) for i, x in enumerate(primals)))

        own, directions = [primals[i] for i in moving], [tangents[i] for i in moving]
        if not contract or (reverse is not None and sum(x.size for x in own) > _MANY):
            return jax.jvp(lambda *own: of_moving(reverse or function, *own), own, directions)

        def value_and_jacobian(*leaves: Any) -> tuple:
            def one(*own: Any) -> Any:
                rest = dict(zip(moving, own))
                return function(*(rest.get(i, x) for i, x in enumerate(leaves)))

            own = [leaves[i] for i in moving]
            columns = jax.vmap(lambda *d: jax.jvp(one, own, list(d))[1])(*unit_tangents(own))
            return function(*leaves), columns

        value, columns = _differentiable(value_and_jacobian, None, True)(*primals)
        change = jnp.concatenate([d.ravel() for d in directions])
        return value, jax.tree.map(lambda x, column: _contracted(x, column, change), value, columns)

    run.defjvp(rule, symbolic_zeros=True)
    return run


def _zero(x: Any) -> Any:
    kind = jax.typeof(x).to_tangent_aval()
    return jnp.zeros(kind.shape, kind.dtype)


def _contracted(value: Any, columns: Any, change: Any) -> Any:
    if columns.dtype == jax.dtypes.float0:
        return _zero(value)
    each = change.reshape(-1, *[1] * (columns.ndim - 1)).astype(columns.dtype)
    return (columns * each).sum(axis=0)


def ordinary_custom_tangent(rule: Callable, values: Any, by: Any, *settings: Any) -> Any:
    """Return `values` with tangents by a rule, as `custom_tangent`, by `jax.custom_jvp`."""

    @jax.custom_jvp
    def given(values: Any, by: Any) -> Any:
        return values

    def change(primals: tuple, tangents: tuple) -> tuple:
        values, by = primals
        _, structure = _flat(by)
        known = [None if isinstance(d, SymbolicZero) else d for d in structure.flatten_up_to(tangents[1])]
        value = given(values, by)
        if all(d is None for d in known):
            return value, jax.tree.map(_zero, value)
        found = rule(*settings, value, by, structure.unflatten(known))
        flat, of_values = _flat(value)
        told = [_zero(x) if d is None else d for x, d in zip(flat, of_values.flatten_up_to(found))]
        return value, of_values.unflatten(told)

    given.defjvp(change, symbolic_zeros=True)
    return given(jax.tree.map(jnp.asarray, values), jax.tree.map(jnp.asarray, by))
