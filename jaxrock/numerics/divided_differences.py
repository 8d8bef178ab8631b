"""Quotients of exponentials and logarithms without cancellation, with exact derivatives of every order."""

import functools
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Inexact

from jaxrock._core.types import RealLike

# Nodes closer together than this are summed as a power series; others are divided.
_CLOSE = 1.0
_TERMS = 14


def exponential_difference(*nodes: RealLike) -> Inexact[Array, "..."]:
    """Divided difference of e^x at the given nodes: positive, symmetric in them, and smooth where they meet.

    With one node it is e^x, with two (e^x - e^y)/(x - y), with n + 1 equal ones e^x/n!. The response of a linear system
    with the rates a, b, c... at time t after a blow is t^n exponential_difference(a t, b t, c t...), resonance
    included: solutions written with it have no removable singularities.

    **Arguments:**

    - `nodes`: one or more arrays that broadcast. Large negative ones are safe; above 709 (float32: 88) it overflows.

    **Source:** McCurdy, Ng & Parlett (1984), accurate computation of divided differences of the exponential.
    """
    kind = jnp.result_type(float, *nodes)
    return _difference(*(jnp.asarray(node, kind) for node in nodes))


@functools.partial(jax.custom_jvp)
def _difference(*nodes: Array) -> Array:
    nodes = _sorted(nodes)
    row = [jnp.exp(node) for node in nodes]
    for width in range(1, len(nodes)):
        row = [
            _mean(nodes[i], nodes[i + 1], row[i]) if width == 1 else _merged(row[i : i + 2], nodes[i : i + width + 1])
            for i in range(len(row) - 1)
        ]
    return row[0]


@functools.partial(_difference.defjvp, symbolic_zeros=True)
def _difference_jvp(nodes, tangents):
    # The derivative by a node repeats the node: no formula is differentiated, so none loses digits. All derivatives are
    # one formula of stacked arrays, not one formula each.
    value, nodes = _difference(*nodes), jnp.broadcast_arrays(*nodes)
    moving = [i for i, tangent in enumerate(tangents) if not isinstance(tangent, jax.custom_derivatives.SymbolicZero)]
    if not moving:
        return value, jnp.zeros_like(value)
    changes = jnp.stack([jnp.broadcast_to(tangents[i], value.shape) for i in moving])
    return value, jnp.sum(changes * _difference(*nodes, jnp.stack([nodes[i] for i in moving])), axis=0)


def _sorted(nodes: tuple[Array, ...]) -> list[Array]:
    """Return the nodes, largest first."""
    nodes = list(nodes)
    for end in range(len(nodes) - 1, 0, -1):
        for i in range(end):
            nodes[i], nodes[i + 1] = jnp.maximum(nodes[i], nodes[i + 1]), jnp.minimum(nodes[i], nodes[i + 1])
    return nodes


def _mean(upper: Array, lower: Array, value: Array) -> Array:
    """Return the mean of e^x between two nodes; `value` is e^upper."""
    gap = upper - lower
    return value * jnp.where(gap == 0, 1.0, -jnp.expm1(-gap) / jnp.where(gap == 0, 1.0, gap))


def _merged(row: list[Array], nodes: list[Array]) -> Array:
    """Return the difference at sorted nodes, from those without the last and without the first."""
    gap = nodes[0] - nodes[-1]
    close = gap < _CLOSE
    quotient = (row[0] - row[1]) / jnp.where(close, 1.0, gap)
    centre = (nodes[0] + nodes[-1]) / 2
    return jnp.where(close, _power_series([jnp.where(close, n - centre, 0.0) for n in nodes], centre), quotient)


def _power_series(offsets: list[Array], centre: Array) -> Array:
    """Return the difference at centre + offsets, at most `_CLOSE`/2: complete symmetric polynomials over factorials."""
    order = len(offsets) - 1
    polynomials = [jnp.ones_like(centre)] * len(offsets)  # of degree k in the first, first two, ... offsets
    total = polynomials[-1] / math.factorial(order)
    for k in range(1, _TERMS):
        previous = jnp.zeros_like(centre)
        for i, offset in enumerate(offsets):
            previous = polynomials[i] = previous + offset * polynomials[i]
        total = total + previous * (1 / math.factorial(order + k))
    return jnp.exp(centre) * total


def growth_ratio(x: RealLike) -> Inexact[Array, "..."]:
    """Return (e^x - 1)/x, smooth through 0."""
    return exponential_difference(x, 0.0)


def logarithm_ratio(y: RealLike) -> Inexact[Array, "..."]:
    """Return -log(1 - y)/y for y < 1, smooth through 0."""
    y = jnp.asarray(y)
    small = jnp.abs(y) < 0.05
    far = jnp.where(small, 0.5, y)
    near, power = 1.0, jnp.where(small, y, 0.0)
    series = jnp.zeros_like(power)
    for k in range(14, 0, -1):
        series = (series + 1 / (k + 1)) * power
    return jnp.where(small, near + series, -jnp.log1p(-far) / far)
