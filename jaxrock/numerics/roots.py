"""Roots of increasing or decreasing functions inside brackets, elementwise, with derivatives."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from jaxrock._core.types import Real
from jaxrock.compiler import custom_tangent

_Tree = TypeVar("_Tree")
_MOST_STEPS = 100


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def bracketed_root(function: Callable, lower: Real, upper: Real, *parameters: Real) -> Real:
    """Return the point between `lower` and `upper` where `function(x, *parameters)`, elementwise, changes its sign.

    Without a change of sign, it is the end where the function is smaller in size. Derivatives of every order by the
    parameters (none by the bracket) come from the implicit function theorem; at such an end they mean nothing.
    `function` must not close over traced values.
    """
    shape = jnp.broadcast_shapes(*(jnp.shape(value) for value in (lower, upper, *parameters)))
    return search_root(lambda x: function(x, *parameters), *(jnp.broadcast_to(end, shape) for end in (lower, upper)))


@bracketed_root.defjvp
def _bracketed_root_jvp(function, primals, tangents):
    (lower, upper, *parameters), (_, _, *changes) = primals, tangents
    root = bracketed_root(function, lower, upper, *parameters)
    _, change_by = jax.linearize(function, root, *parameters)  # linearised once: the function may hold a search, too
    slope = change_by(jnp.ones_like(root), *map(jnp.zeros_like, parameters))
    change = change_by(jnp.zeros_like(root), *changes)
    flat = slope == 0  # a double root, or an end of the bracket without a root
    return root, jnp.where(flat, 0.0, -change / jnp.where(flat, 1.0, slope))


def carried(x: Real, step: Callable, times: int = 2) -> Real:
    """Return `x`, a root found without derivatives, with those of the implicit function.

    `step(x)` is Newton's distance to the root, with derivatives. It may close over traced values; if it does not, use
    `implicit`. The root itself does not move. Each repetition doubles the order to which derivatives are exact: the
    first after one, the second and third after two.
    """
    for _ in range(times):
        left = step(x)
        x = x - (left - jax.lax.stop_gradient(left))
    return x


def implicit(step: Callable, x: _Tree, by: Any) -> _Tree:
    """Return `x`, a root found without derivatives, with those of every order of the implicit function.

    `step(by, x)`, a function of a module, is Newton's distance to the root. It is computed only for derivatives.
    """
    return custom_tangent(_by_newton, x, by, step)


def tangent_along(function: Callable, by: Any, tangents: Any) -> Any:
    """Return the tangent of `function(by)`, given those of `by` as rules of `custom_tangent` get them."""
    flat: tuple[list, Any] = jax.tree.flatten(by)
    leaves, structure = flat
    known = structure.flatten_up_to(tangents)
    moving = [(x, d) for x, d in zip(leaves, known) if d is not None]

    def of_moving(*own):
        rest = iter(own)
        return function(structure.unflatten([x if d is None else next(rest) for x, d in zip(leaves, known)]))

    return jax.jvp(of_moving, [x for x, _ in moving], [d for _, d in moving])[1]


def _by_newton(step: Callable, x: _Tree, by: Any, changes: Any) -> _Tree:
    # At a root, the derivative of the step by x is one.
    return jax.tree.map(jnp.negative, tangent_along(lambda by: step(by, x), by, changes))


def search_root(function: Callable, a: Real, b: Real) -> Real:
    """Return the root of `function(x)`, elementwise, between arrays `a` and `b` of one shape, to rounding; no
    derivatives.

    **Source:** Chandrupatla (1997), inverse quadratic interpolation where it is safe, else bisection.
    """
    ends, tight = (a, b), 4 * jnp.finfo(a.dtype).eps

    def unfinished(carry):
        a, b, _, fa, fb, _, _, count = carry
        return (count < 2) | (jnp.any(_open(a, b, fa, fb, tight)) & (count < 2 + _MOST_STEPS))

    def step(carry):
        a, b, c, fa, fb, fc, share, count = carry
        # The loop evaluates the ends first: a function is large, and so it is compiled once.
        first, begins = count == 0, count < 2
        x = jnp.where(begins, jnp.where(first, *ends), a + share * (b - a))
        fx = function(x)
        fa, fb = (jnp.where(first, fx, f) for f in (fa, fb))
        going = begins | _open(a, b, fa, fb, tight)
        same = ((fx > 0) == (fa > 0)) & ~begins
        # c: the point before; a: the newest; b: on the other side.
        new = (x, jnp.where(same, b, a), jnp.where(same, a, b), fx, jnp.where(same, fb, fa), jnp.where(same, fa, fb))
        a, b, c, fa, fb, fc = (jnp.where(going, n, o) for n, o in zip(new, (a, b, c, fa, fb, fc)))
        share = jnp.where(begins, 0.5, _next_share(a, b, c, fa, fb, fc, tight))
        return a, b, c, fa, fb, fc, share, count + 1

    nothing = jnp.zeros_like(a)
    start = (a, a, a, nothing, nothing, nothing, nothing, 0)
    a, b, _, fa, fb, _, _, _ = jax.lax.while_loop(unfinished, step, start)
    return jnp.where(jnp.abs(fa) < jnp.abs(fb), a, b)


def _open(a, b, fa, fb, tight):
    """Return whether the bracket is wider than rounding and holds a change of sign."""
    wide = jnp.abs(b - a) > tight * jnp.minimum(jnp.abs(a), jnp.abs(b))
    return wide & (fa != 0) & (fb != 0) & ((fa > 0) != (fb > 0))


def _next_share(a, b, c, fa, fb, fc, tight):
    """Return the next point between a and b, as a share of the way."""
    xi, phi = (a - b) / (c - b), (fa - fb) / (fc - fb)
    safe = (phi**2 < xi) & ((1 - phi) ** 2 < 1 - xi)
    guess = fa / (fb - fa) * fc / (fb - fc) + (c - a) / (b - a) * fa / (fc - fa) * fb / (fc - fb)
    least = jnp.minimum(0.5, tight * jnp.abs(a) / jnp.abs(b - a) / 2)
    return jnp.clip(jnp.where(safe & jnp.isfinite(guess), guess, 0.5), least, 1 - least)
