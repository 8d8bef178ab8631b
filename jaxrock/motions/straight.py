"""A known motion as straight lines, in NumPy: what measures of intensity are sums over."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxrock._checks import is_traced
from jaxrock._parameters import check_single
from jaxrock.blocks.rigid import GRAVITY
from jaxrock.motions.motion import AbstractMotion, Scaled, Shifted, WithVertical
from jaxrock.motions.record import Record

_PARTS = 16384  # of a motion of few smooth pieces


class Straight(NamedTuple):
    """Straight lines, one after the other; between two of them the acceleration may jump.

    - `begin`, `end`: acceleration at the ends of each [m/s^2]; `length` of each [s].
    """

    begin: np.ndarray
    end: np.ndarray
    length: np.ndarray

    @property
    def times(self) -> np.ndarray:
        """Their ends, from 0 on [s]."""
        return np.concatenate([[0.0], np.cumsum(self.length)])

    @property
    def velocity(self) -> np.ndarray:
        """At their ends [m/s], of a ground at rest at first."""
        return np.concatenate([[0.0], np.cumsum(self.length * (self.begin + self.end) / 2)])

    @property
    def displacement(self) -> np.ndarray:
        """At their ends [m]."""
        gain = self.length * self.velocity[:-1] + self.length**2 * (2 * self.begin + self.end) / 6
        return np.concatenate([[0.0], np.cumsum(gain)])


def straight(motion: AbstractMotion) -> Straight:
    """The horizontal acceleration of one known motion: of a record just that, of others close to it.

    **Raises:** ValueError for many motions in one, or one that is traced.
    """
    check_single(motion=motion)
    if is_traced(motion):
        raise ValueError("Argument `motion` must be known: its intensity is no function under `jax.jit` or `jax.vmap`.")
    if isinstance(motion, Record):
        samples = GRAVITY * np.asarray(motion.samples, float)
        return Straight(samples[:-1], samples[1:], np.full(samples.size - 1, float(motion.dt)))
    if isinstance(motion, Scaled):
        inner, factor = straight(motion.motion), float(motion.factor)
        return Straight(factor * inner.begin, factor * inner.end, inner.length)
    if isinstance(motion, WithVertical):
        return straight(motion.horizontal)
    if isinstance(motion, Shifted):
        inner, delay = straight(motion.motion), float(motion.delay)
        before = (0.0, 0.0, delay)
        return Straight(*(np.append(x, part) for x, part in zip(before, inner))) if delay else inner
    lengths = np.asarray(motion.lengths, float)
    # Pieces of no length, at the room of longer records, say nothing.
    pieces = np.flatnonzero(lengths > 0)
    parts = max(1, -(-_PARTS // max(pieces.size, 1)))
    values = GRAVITY * np.asarray(_values(motion, parts, pieces), float)
    return Straight(values[:, :-1].ravel(), values[:, 1:].ravel(), np.repeat(lengths[pieces] / parts, parts))


@functools.partial(jax.jit, static_argnums=1)
def _values(motion: AbstractMotion, parts: int, pieces):
    """Acceleration [g] at the ends of all parts of each piece, from within it."""
    lengths, shares = motion.lengths, jnp.arange(parts + 1) / parts

    def at(piece, share):
        return motion.series(piece, share * lengths[piece], jnp.ones_like(lengths[piece]), 0)[0]

    return jax.vmap(lambda piece: jax.vmap(lambda share: at(piece, share))(shares))(pieces)
