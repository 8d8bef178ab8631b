"""The closeness of a rocking base to standing still in balance, from which the margin of a flexible block follows.

About the balance the base moves by an unstable mode, which grows, and the one that mirrors it, which decays; the rest
are vibrations. Where the ground rests, the sign of the growing amplitude is the verdict.

With amplitudes g and d [rad] the distance is sqrt(2 (g^2 + d^2)). A rigid base that turns back at theta has come as
near as balance - theta.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Inexact, Int

from jaxrock._core.types import Scalar
from jaxrock.flexible.phases import Arc, Phase
from jaxrock.numerics.roots import implicit

_HALVINGS = 40  # bisections of a step for its least distance


def mirrored(rocking: Phase) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """Return the index of the growing mode, and of the one that decays as it grows (a little faster, with damping)."""
    grows = jnp.argmax(rocking.rates.real)
    return grows, jnp.argmin(jnp.abs(rocking.rates + rocking.rates[grows]))


class _Near(NamedTuple):
    """A step near the balance; `modes`: the mirrored ones."""

    path: Arc
    modes: Int[Array, " two"]
    side: Scalar
    balance: Scalar

    def parts(self, x: Scalar) -> Inexact[Array, " two"]:
        """Return the growing and the decaying amplitude [rad]."""
        return self.side * self.path.mode_amplitudes(x).real[self.modes]

    def distance(self, parts: Inexact[Array, "... two"]) -> Inexact[Array, "..."]:
        """Return the squared distance over that of the block at rest."""
        return 2 * (parts**2).sum(axis=-1) / self.balance**2

    def slope(self, x: Scalar) -> Scalar:
        """Return the rate at which the distance grows."""
        return jax.jvp(lambda x: self.distance(self.parts(x)), (x,), (jnp.ones_like(x),))[1]


def _to_nearest(told: tuple[_Near, Bool[Array, ""]], x: Scalar) -> Scalar:
    """Return the Newton step to the least distance, if that is inside."""
    near, inside = told
    value, bend = jax.jvp(near.slope, (x,), (jnp.ones_like(x),))
    inside = inside & (bend > 0)
    return jnp.where(inside, value / jnp.where(inside, bend, 1.0), 0.0)


def approached(path: Arc, side: Scalar, balance: Scalar, end: Scalar, before: tuple[Scalar, Scalar]) -> tuple:
    """Return closeness, and closeness since the last outward crossing of the balance, after the step `path` up to x =
    `end`."""
    closeness, beyond = before
    near = _Near(path, jnp.stack(mirrored(path.phase)), side, balance)
    still = jax.lax.stop_gradient(end)

    def halve(_, bracket):
        low, high = bracket
        middle = (low + high) / 2
        falls = near.slope(middle) < 0
        return jnp.where(falls, middle, low), jnp.where(falls, high, middle)

    # A minimum inside the step moves, which second derivatives feel; one at its start, where the distance only rises,
    # stays.
    low, high = jax.lax.fori_loop(0, _HALVINGS, halve, (0 * still, still))
    inside = (low > 0) & (high < still)
    place = implicit(_to_nearest, jax.lax.stop_gradient((low + high) / 2), (near, inside))
    rocking = side != 0
    parts = jax.vmap(near.parts)(jnp.stack([0 * still, place, end]))
    least = jnp.where(rocking, jnp.min(near.distance(parts[1:])), jnp.inf)
    was, _, now = parts.sum(axis=1) > 0
    beyond = jnp.where(rocking & now, jnp.where(was, jnp.minimum(beyond, least), least), jnp.inf)
    return jnp.minimum(closeness, least), beyond


def still_to_come(outward: Scalar, inward: Scalar, grows: Scalar, decays: Scalar) -> Scalar:
    """Return the least squared distance [rad^2] of free rocking from these amplitudes on; rates [1/s], both
    positive."""
    safe = jnp.where(outward == 0, 1.0, outward)
    time = jnp.log(jnp.maximum(decays * inward**2 / (grows * safe**2), 1.0)) / (2 * (grows + decays))
    nearest = 2 * ((safe * jnp.exp(grows * time)) ** 2 + (inward * jnp.exp(-decays * time)) ** 2)
    return jnp.where(outward == 0, 0.0, nearest)
