"""Derivatives of a `LaneFunction`, as such: Jacobian, tangents in one or a few directions, and the transpose."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrock._core.unit_tangents import unit_tangents
from jaxrock.compiler.autodiff.jvp_jaxpr import jvp_jaxpr
from jaxrock.compiler.primitive.lane_function import LaneFunction


def value_and_jacobian(fn: LaneFunction, has_tangent: tuple[bool, ...]) -> LaneFunction:
    """Return the `LaneFunction` of (value, Jacobian).

    For each leaf of the value, the Jacobian has in a leading axis its derivatives by all numbers with a tangent; None
    for integers.
    """
    return fn.derivative(has_tangent, _with_jacobian)


def value_and_change(fn: LaneFunction, has_tangent: tuple[bool, ...]) -> LaneFunction:
    """Return the `LaneFunction` of (value, tangents); it takes a direction's leaves last. None for integers."""
    return fn.derivative(has_tangent, _with_change)


def value_and_changes(fn: LaneFunction, has_tangent: tuple[bool, ...], count: int) -> LaneFunction:
    """Return the `LaneFunction` of (value, tangents) in `count` directions, which have a leading axis."""
    return fn.derivative(has_tangent, _with_changes, count)


def pulled_back(fn: LaneFunction, has_tangent: tuple[bool, ...]) -> LaneFunction:
    """Return the `LaneFunction` of the cotangents of the leaves with a tangent: the transpose of `value_and_change`.

    It takes the cotangents of the value last, without those of integers. JAX's reverse mode follows the function.
    """
    return fn.derivative(has_tangent, _transpose)


def _with_jacobian(fn: LaneFunction, has_tangent: tuple[bool, ...]) -> LaneFunction:
    def both(leaves):
        directions = unit_tangents(_moving(leaves, has_tangent))
        if len(directions[0]) == 1:  # an axis of one direction only adds operations
            value, tangents = jvp_jaxpr(fn.program, leaves, has_tangent, [x[0] for x in directions], None)
            tangents = [x[None] for x in tangents]
        else:
            value, tangents = jvp_jaxpr(fn.program, leaves, has_tangent, directions, len(directions[0]))
        columns = [d if _is_real(x) else None for x, d in zip(value, tangents, strict=True)]
        return jax.tree.unflatten(jax.tree.structure(fn.results), value), columns

    count = sum(math.prod(leaf.shape) for leaf in _moving(fn.in_avals, has_tangent))
    results = _with_each(fn.results, lambda out: jax.ShapeDtypeStruct((count, *out.shape), out.dtype))
    return _made(fn, has_tangent, both, fn.in_avals, "jacobian", results)


def _with_change(fn: LaneFunction, has_tangent: tuple[bool, ...]) -> LaneFunction:
    in_avals = (*fn.in_avals, *_moving(fn.in_avals, has_tangent))

    def both(leaves):
        own, direction = leaves[: len(has_tangent)], leaves[len(has_tangent) :]
        value, tangents = jvp_jaxpr(fn.program, own, has_tangent, direction, None)
        changes = [d if _is_real(x) else None for x, d in zip(value, tangents, strict=True)]
        return jax.tree.unflatten(jax.tree.structure(fn.results), value), changes

    results = _with_each(fn.results, lambda out: jax.ShapeDtypeStruct(out.shape, out.dtype))
    return _made(
        fn, has_tangent, both, in_avals, "change", results, directions=sum(has_tangent), origin=(fn, has_tangent)
    )


def _with_changes(fn: LaneFunction, has_tangent: tuple[bool, ...], count: int) -> LaneFunction:
    def many(x):
        return jax.ShapeDtypeStruct((count, *x.shape), x.dtype)

    def both(leaves):
        own, directions = leaves[: len(has_tangent)], leaves[len(has_tangent) :]
        value, tangents = jvp_jaxpr(fn.program, own, has_tangent, directions, count)
        changes = [d if _is_real(x) else None for x, d in zip(value, tangents, strict=True)]
        return jax.tree.unflatten(jax.tree.structure(fn.results), value), changes

    in_avals = (*fn.in_avals, *map(many, _moving(fn.in_avals, has_tangent)))
    results = _with_each(fn.results, many)
    return _made(fn, has_tangent, both, in_avals, f"{count} changes", results, directions=sum(has_tangent))


def _transpose(fn: LaneFunction, has_tangent: tuple[bool, ...]) -> LaneFunction:
    real = [out for out in jax.tree.leaves(fn.results) if _is_real(out)]
    moving = _moving(fn.in_avals, has_tangent)

    def pulled(leaves):
        own, rest = leaves[: len(has_tangent)], iter(leaves[len(has_tangent) :])
        value, pull = jax.vjp(_of_moving(fn, has_tangent, own), _moving(own, has_tangent))
        return pull([next(rest) if _is_real(x) else np.zeros(x.shape, jax.dtypes.float0) for x in value])[0]

    return _made(fn, has_tangent, pulled, (*fn.in_avals, *real), "pulled back", moving)


def _with_each(value: Any, shapes: Callable) -> tuple:
    return value, [shapes(out) if _is_real(out) else None for out in jax.tree.leaves(value)]


def _made(
    fn: LaneFunction,
    has_tangent: tuple[bool, ...],
    function: Callable,
    in_avals: Sequence,
    word: str,
    results: Any,
    **more: Any,
) -> LaneFunction:
    return LaneFunction(
        function,
        jax.tree.structure(list(in_avals)),
        in_avals,
        key=None if fn.key is None else f"{fn.key} {word} {[int(each) for each in has_tangent]}",
        results=results,
        in_lanes=fn.in_lanes,
        refill=fn.refill,
        order=fn.order + 1,
        mode=fn.mode,
        **more,
    )


def _moving(leaves: Sequence, has_tangent: tuple[bool, ...]) -> list:
    return [leaf for leaf, move in zip(leaves, has_tangent) if move]


def _is_real(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jnp.inexact)


def _of_moving(fn: LaneFunction, has_tangent: tuple[bool, ...], leaves: Sequence) -> Callable:
    """Return the function of the leaves that have a tangent; the other leaves are constant."""

    def function(moving):
        rest = iter(moving)
        return fn([next(rest) if move else x for x, move in zip(leaves, has_tangent)])

    return function
