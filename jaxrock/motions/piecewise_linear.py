"""A known motion as straight lines, in NumPy: the measures of intensity are sums over these lines."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxrock._arguments.parameters import check_single
from jaxrock._core.one_program import check_known
from jaxrock.blocks.rigid import GRAVITY
from jaxrock.motions.motion import AbstractMotion, Scaled, Shifted, WithVertical
from jaxrock.motions.peaks import too_long
from jaxrock.motions.record import Record

_LINES = 16384  # least number of lines of all smooth pieces together
_PER_SCALE = 256  # lines per time scale of the acceleration
_FEWEST = 32  # least number of lines per time scale, with an error of 1e-7
_MOST = 1 << 20


class PiecewiseLinear(NamedTuple):
    """Straight lines, one after the other; between two of them the acceleration may jump.

    - `begin`, `end`: acceleration at the ends of each [m/s^2]; `length` of each [s].
    """

    begin: np.ndarray
    end: np.ndarray
    length: np.ndarray

    @property
    def times(self) -> np.ndarray:
        """Times of the ends of lines, from 0 on [s]."""
        return np.concatenate([[0.0], np.cumsum(self.length)])

    @property
    def velocity(self) -> np.ndarray:
        """Velocity at the ends of lines [m/s], of a ground that starts from rest."""
        return np.concatenate([[0.0], np.cumsum(self.length * (self.begin + self.end) / 2)])

    @property
    def displacement(self) -> np.ndarray:
        """Displacement at the ends of lines [m]."""
        gain = self.length * self.velocity[:-1] + self.length**2 * (2 * self.begin + self.end) / 6
        return np.concatenate([[0.0], np.cumsum(gain)])


def piecewise_linear(motion: AbstractMotion) -> PiecewiseLinear:
    """Return the horizontal acceleration of one known motion: a record exactly, other motions approximately.

    **Raises:** ValueError for many motions in one, or one that is traced.
    """
    check_single(motion=motion)
    check_known(motion=motion)
    if isinstance(motion, Record):
        samples = GRAVITY * np.asarray(motion.samples, float)
        return PiecewiseLinear(samples[:-1], samples[1:], np.full(samples.size - 1, float(motion.dt)))
    if isinstance(motion, Scaled):
        inner, factor = piecewise_linear(motion.motion), float(motion.factor)
        return PiecewiseLinear(factor * inner.begin, factor * inner.end, inner.length)
    if isinstance(motion, WithVertical):
        return piecewise_linear(motion.horizontal)
    if isinstance(motion, Shifted):
        inner, delay = piecewise_linear(motion.motion), float(motion.delay)
        before = (0.0, 0.0, delay)
        return PiecewiseLinear(*(np.append(x, part) for x, part in zip(before, inner))) if delay else inner
    lengths, scales = jax.tree.map(lambda x: np.asarray(x, float), _pieces(motion))
    counts = _counts(lengths, scales)
    piece = np.repeat(np.arange(lengths.size), counts)
    number = np.arange(piece.size) - np.repeat(np.cumsum(counts) - counts, counts)
    step = (lengths / np.maximum(counts, 1))[piece]
    places = (number * step, (number + 0.5) * step, np.minimum((number + 1) * step, lengths[piece]))
    begin, middle, end = (GRAVITY * _values(motion, piece, local) for local in places)
    # Chords lie on the inner side of a curve: shift them to have the curve's integral by Simpson's rule.
    bend = 2 / 3 * (middle - (begin + end) / 2)
    return PiecewiseLinear(begin + bend, end + bend, step)


def _counts(lengths: np.ndarray, scales: np.ndarray | None) -> np.ndarray:
    """Return the number of lines of each piece: one for a straight piece, none without a length, else by its curvature.

    Padding of records gives pieces without a length.

    **Raises:** ValueError for curves of too many lines.
    """
    lasting = lengths > 0
    if scales is None:
        return lasting.astype(int)
    smooth = lasting & np.isfinite(scales)
    changes = np.where(smooth, lengths / np.where(smooth, scales, 1.0), 0.0)
    if changes.sum() * _FEWEST > _MOST:
        raise too_long(_MOST // _FEWEST, changes.sum())
    wanted = np.maximum(_PER_SCALE * changes, np.where(smooth, _LINES / max(smooth.sum(), 1), 0.0))
    return np.where(lasting, np.ceil(np.maximum(wanted * min(1.0, _MOST / max(wanted.sum(), 1.0)), 1.0)), 0).astype(int)


def _values(motion: AbstractMotion, piece: np.ndarray, local: np.ndarray) -> np.ndarray:
    """Return the acceleration [g] at times from the beginnings of pieces, each from within its piece."""
    room = (0, (1 << (piece.size - 1).bit_length()) - piece.size)  # few sizes, as each is compiled
    return np.asarray(_series(motion, np.pad(piece, room, "edge"), np.pad(local, room, "edge")), float)[: piece.size]


@jax.jit
def _pieces(motion: AbstractMotion):
    return motion.lengths, motion.scales


@jax.jit
def _series(motion: AbstractMotion, piece, local):
    return jax.vmap(lambda piece, local: motion.series(piece, local, jnp.ones_like(local), 0)[0])(piece, local)
