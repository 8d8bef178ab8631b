"""Roots of increasing or decreasing functions inside brackets, elementwise, with derivatives."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Inexact

Real = Inexact[Array, "..."]

_MOST_STEPS = 100


def bracketed_root(function: Callable, lower: Real, upper: Real, *parameters: Real) -> Real:
    """Where `function(x, *parameters)`, elementwise, changes its sign between `lower` and `upper`.

    Where it does not, the end with the smaller value is returned. The search is not differentiated: two Newton
    steps from its result carry first and second derivatives with respect to the parameters.

    **Source:** Chandrupatla (1997), inverse quadratic interpolation where it is safe, else bisection.
    """
    known = jax.lax.stop_gradient(parameters)
    shape = jnp.broadcast_shapes(*(jnp.shape(value) for value in (lower, upper, *parameters)))
    ends = (jnp.broadcast_to(jax.lax.stop_gradient(end), shape) for end in (lower, upper))
    root = search_root(lambda x: function(x, *known), *ends)
    for _ in range(2):
        value, slope = jax.jvp(lambda x: function(x, *parameters), (root,), (jnp.ones_like(root),))
        # Without a root there is nothing to improve; a double root has no derivative.
        step = jnp.where(slope == 0, 0.0, value / jnp.where(slope == 0, 1.0, slope))
        small = jnp.abs(step) <= 1e-6 * (jnp.abs(root) + jnp.finfo(root.dtype).tiny)
        root = root - jnp.where(small | (slope == 0), step, jax.lax.stop_gradient(jnp.zeros_like(step)))
    return root


def search_root(function: Callable, a: Real, b: Real) -> Real:
    """The root of `function(x)`, elementwise, between arrays `a` and `b` of one shape, to rounding; no derivatives."""
    fa, fb = function(a), function(b)
    tight = 2 * jnp.finfo(a.dtype).eps

    def unfinished(carry):
        a, b, _, fa, fb, _, _, count = carry
        return jnp.any(_open(a, b, fa, fb, tight)) & (count < _MOST_STEPS)

    def step(carry):
        a, b, c, fa, fb, fc, share, count = carry
        x = a + share * (b - a)
        fx = function(x)
        going = _open(a, b, fa, fb, tight)
        same = (fx > 0) == (fa > 0)
        # c: the point before; a: the newest; b: on the other side.
        new = (x, jnp.where(same, b, a), jnp.where(same, a, b), fx, jnp.where(same, fb, fa), jnp.where(same, fa, fb))
        a, b, c, fa, fb, fc = (jnp.where(going, n, o) for n, o in zip(new, (a, b, c, fa, fb, fc)))
        return a, b, c, fa, fb, fc, _next_share(a, b, c, fa, fb, fc, tight), count + 1

    start = (b, a, a, fb, fa, fa, jnp.full_like(a, 0.5), 0)
    a, b, _, fa, fb, _, _, _ = jax.lax.while_loop(unfinished, step, start)
    return jnp.where(jnp.abs(fa) < jnp.abs(fb), a, b)


def _open(a, b, fa, fb, tight):
    """Whether the bracket is wider than rounding and holds a change of sign."""
    wide = jnp.abs(b - a) > tight * jnp.minimum(jnp.abs(a), jnp.abs(b))
    return wide & (fa != 0) & (fb != 0) & ((fa > 0) != (fb > 0))


def _next_share(a, b, c, fa, fb, fc, tight):
    """Where between a and b to look next."""
    xi, phi = (a - b) / (c - b), (fa - fb) / (fc - fb)
    safe = (phi**2 < xi) & ((1 - phi) ** 2 < 1 - xi)
    guess = fa / (fb - fa) * fc / (fb - fc) + (c - a) / (b - a) * fa / (fc - fa) * fb / (fc - fb)
    least = jnp.minimum(0.5, tight * jnp.abs(a) / jnp.abs(b - a) / 2)
    return jnp.clip(jnp.where(safe & jnp.isfinite(guess), guess, 0.5), least, 1 - least)
