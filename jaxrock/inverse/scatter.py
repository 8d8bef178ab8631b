"""What may have become of rocks under a motion that is not the same at each of them, and how probable that is.

The motion at each rock differs from that of the site by a lognormal factor, and alpha, p and restitution are uncertain.
Margins and rotations are computed at nodes along the logarithm of the factor and are straight between them:

    P(stands) = sum_k w_k Phi(y_k/s_k),

over the quarter points of the intervals between nodes, with y a function of the margin that is nearly straight in ln
amplitude, w_k the normal probability of the quarter's surroundings, and s_k half of what y changes by from node to
node: a probit that smears each interval so far that the sum is smooth.

Nodes are fixed levels of the strength of the motion over the rock's tan(alpha): a motion that grows moves the weights
along, and not the nodes. So the probability is as smooth in the amplitude as the normal distribution is, however rough
the margin: overturning sets are unions of intervals, some of them narrower than what is between two nodes, and nodes
that move with the amplitude would flicker through these. What is narrower than two fifths of the scatter is either
met by a node or not, and counts for an interval or for nothing.

From node to node alpha, p and restitution change, too, in patterns that have no mean and no correlation: whatever the
normal weights, the variance of something straight is the sum of what each of them adds.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import log_ndtr, logsumexp, ndtr
from jaxtyping import Array, ArrayLike, Bool, Inexact

from jaxrock.inverse.observations import Observations

Real = Inexact[Array, "..."]
Flags = Bool[Array, "..."]
_APART = 0.4  # distance of nodes, in standard deviations
_EACH_SIDE = 9  # nodes on each side of the motion itself: 3.6 standard deviations
NODES = 2 * _EACH_SIDE + 2  # scenes that are computed for each rock
_SMEAR = 0.5  # of the difference between nodes
_LEAST_WIDTH = 1e-3
_SLOPE_OVER = 4  # nodes at each end from which y goes on
_LEAST_SLOPE = 0.05  # of y by a standard deviation, beyond the last nodes
_END_WIDTH = 0.1  # of y there, so that the probability is smooth

# Turns of the patterns from node to node: far from none and from each other, and so are their doubles.
_FAST, _FASTEST = 1.6, np.pi
_BY_P = 0.5  # a higher p acts like so much of the amplitude: between none for long pulses and all for short ones
_SPREAD = np.sqrt(1 + _APART**2 * (_SMEAR**2 - 1 / 48))  # of straight y through quarter points, with the smear


def _amplitude(turn: float) -> float:
    """Amplitude with which a cosine of so much turn from node to node adds a variance of 1, likewise."""
    mean_square = 1.0 if turn == np.pi else 0.5
    return 1 / np.sqrt(mean_square * (5 / 8 + 3 / 8 * np.cos(turn) + 2 * _SMEAR**2 * (1 - np.cos(turn))))


class Levels(NamedTuple):
    """Nodes, (nodes, ..., rocks): how strong the motion is, and which rocks stand there."""

    strength: Real  # logarithm
    alpha: Real
    p: Real
    restitution: Real


def levels_around(observations: Observations, scatter: ArrayLike, strength: Real) -> tuple[Levels, Real]:
    """Nodes around motions whose logarithm of the strength is known, (...), and how far they are from it, (nodes, ...,
    rocks), in standard deviations."""
    seen = observations
    weaker = seen.weaker_alpha
    by_alpha = seen.alpha_sd / seen.alpha * weaker / (jnp.sin(weaker) * jnp.cos(weaker))  # of ln tan(alpha)
    by_p = _BY_P * seen.p_sd / seen.p
    variance = scatter**2 + by_alpha**2 + by_p**2
    # A change of the scatter moves weights, and not the nodes: what the intervals between them add stays, too.
    deviation = jnp.sqrt(variance - jax.lax.stop_gradient((1 - 1 / _SPREAD**2) * variance))
    step = _APART * jax.lax.stop_gradient(deviation)
    strength = strength[..., None]
    base = jnp.floor(jax.lax.stop_gradient(strength) / step)
    number = base + _in_front(np.arange(NODES) - _EACH_SIDE, base[None])
    turned = _FAST * number
    fast, fastest = _amplitude(_FAST), _amplitude(_FASTEST)
    offsets = (
        fast * jnp.cos(turned) * (seen.alpha_sd / seen.alpha),
        fast * jnp.sin(turned) * (seen.p_sd / seen.p),
        fastest * jnp.cos(_FASTEST * number) * seen.restitution_sd,
    )
    alpha, p, restitution = rocks_at(seen, offsets)
    # Levels are of strength p^(1/2)/tan(alpha): the same for a slenderer or smaller rock takes less.
    needs = jnp.log(jnp.tan(weaker * alpha / seen.alpha) / jnp.tan(weaker)) - _BY_P * jnp.log(p / seen.p)
    where = (number * step - strength) / deviation
    return Levels(number * step + needs, alpha, p, restitution), where


def rocks_at(observations: Observations, offsets: tuple[Real, Real, Real] | Real) -> tuple[Real, Real, Real]:
    """Alpha, p and restitution of rocks that are off by (3, ..., rocks) in ln alpha, ln p and restitution."""
    most = observations.widest
    alpha = jnp.minimum(observations.alpha * jnp.exp(offsets[0]), jnp.maximum(most, observations.alpha))
    p = observations.p * jnp.exp(offsets[1])
    restitution = jnp.where(observations.follows, observations.by_momentum(alpha), observations.restitution)
    # At 1 impacts never die out.
    high = jnp.maximum(jnp.where(observations.restitution_sd > 0, 0.99, 1.0), restitution)
    return alpha, p, jnp.clip(restitution + offsets[2], 0.0, high)


class Possible(NamedTuple):
    """What becomes of rocks in possible scenes, (scenes, ..., ways, rocks): the quarter points of intervals."""

    weight: Real  # probability of the surroundings of each
    y: Real  # the margin, straightened
    width: Real  # what it is smeared by
    known: Flags  # whether it was computed
    ends: Real  # y at the first and the last node, its slope beyond, and where they are
    rotation: Real  # [rad]
    rotation_width: Real

    @classmethod
    def of(cls, where, margin, rotation, known, lost, verge) -> "Possible":
        """From the results at nodes, (nodes, ..., ways, rocks), which are so many standard deviations away; `verge` is
        the rotation from which a rock at rest overturns.

        On the way to overturning the rotation grows without bounds with the amplitude; what is left of the energy to
        overturn, about (1 - rotation/verge)^2, does not, and passes zero with y, of which it is twice as much there.
        """
        left = 1 - rotation / verge
        left = jnp.where(lost, 2 * _straightened(jnp.minimum(margin, 0.0)), left * jnp.abs(left))
        left = jnp.where(known, left, 0.25)
        ends_of_parts = jnp.concatenate([verge[:1], _halves(verge)]), jnp.concatenate([left[:1], _halves(left)])
        y, known = _bridged(_straightened(jnp.where(known, margin, 0.0)), known)
        width = jnp.sqrt((_SMEAR * jnp.diff(y, axis=0)) ** 2 + _LEAST_WIDTH**2)
        few = _SLOPE_OVER - 1
        # As far apart as they are by this scatter: it changes that, and not the nodes.
        slope = jnp.stack(
            [(y[0] - y[few]) / (where[few] - where[0]), (y[-1 - few] - y[-1]) / (where[-1] - where[-1 - few])]
        )
        far = jnp.broadcast_arrays(where[:1], where[-1:], y[:1])[:2]
        ends = jnp.stack([y[0], y[-1], *(jnp.maximum(slope, 0.0) + _LEAST_SLOPE), far[0][0], far[1][0]])
        half = jnp.concatenate([where[:1], _halves(where)])
        weight = jnp.diff(ndtr(half), axis=0)
        return cls(
            weight, _between(y), _twice(width), _twice(known[1:] & known[:-1]), ends,
            _rotation(_between(verge), _between(left)), jnp.abs(jnp.diff(_rotation(*ends_of_parts), axis=0)),
        )  # fmt: skip

    def log_probabilities(self, density: Real | None = None) -> Real:
        """Logarithms of the probability that rocks stand, and that they topple; with a log-density of each part, the
        ends first and last, also of the first with that: (2 or 3, ..., rocks).

        All are computed side by side: a program of half the length compiles in half the time.
        """
        # Of a scene that could not be computed nothing is known: one half, and no slope.
        inner = jnp.where(self.known, self.y / self.width, 0.0)
        # A motion that is small enough spares every rock, and one that is large enough topples it. How far away is
        # that?
        first, last, before, after, below, above = self.ends
        near, far = jnp.stack([first, -last]), jnp.stack([last, -first])
        this = jnp.stack([below, -above])
        beyond = this + jnp.minimum(near, 0.0) / jnp.stack([before, after])
        outer = jnp.stack([beyond, this[::-1], far / _END_WIDTH], axis=1)
        outer, inner = _parted(log_ndtr(jnp.concatenate([outer, jnp.stack([inner, -inner])], axis=1)), 3)
        ends = jnp.stack([outer[:, 0], outer[:, 1] + outer[:, 2]], axis=1)
        parts = jnp.concatenate([ends, inner + jnp.log(self.weight)], axis=1)
        if density is not None:
            density = jnp.concatenate([density[:1], density[-1:], density[1:-1]])
            parts = jnp.concatenate([parts, parts[:1] + density])
        return _mean_of_ways(logsumexp(parts, axis=1))

    @property
    def share_known(self) -> Real:
        """Probability of the scenes that were computed, (..., rocks)."""
        return jnp.mean(
            jnp.sum(jnp.where(self.known, self.weight, 0.0), axis=0) / jnp.sum(self.weight, axis=0), axis=-2
        )


def _parted(values: Real, count: int) -> tuple[Real, Real]:
    """The first along the second axis, and the others."""
    return values[:, :count], values[:, count:]


def _rotation(verge: Real, left: Real) -> Real:
    return verge * (1 - left / (left**2 + 1e-6) ** 0.25)


def _between(values: Real) -> Real:
    """Values at the quarter points of intervals, (2 intervals, ...), of what is straight between nodes."""
    pairs = jnp.stack([0.75 * values[:-1] + 0.25 * values[1:], 0.25 * values[:-1] + 0.75 * values[1:]], axis=1)
    return pairs.reshape(-1, *values.shape[1:])


def _halves(values: Real) -> Real:
    """Middles and upper ends of intervals, (2 intervals, ...)."""
    pairs = jnp.stack([(values[:-1] + values[1:]) / 2, values[1:]], axis=1)
    return pairs.reshape(-1, *values.shape[1:])


def _twice(values: Real | Flags) -> Real | Flags:
    """What intervals have in common, at their quarter points."""
    return jnp.repeat(values, 2, axis=0)


def _mean_of_ways(logarithms: Real) -> Real:
    """Of probabilities, by their logarithms (..., ways, rocks): which way a rock was shaken is anybody's guess."""
    count = logarithms.shape[-2]
    return logarithms[..., 0, :] if count == 1 else logsumexp(logarithms, axis=-2) - np.log(count)


def _in_front(values: np.ndarray, like: Real) -> np.ndarray:
    """Values along the first axis of an array."""
    return values.reshape(-1, *[1] * (like.ndim - 1))


def _straightened(margin: Real) -> Real:
    """A function of the margin that is nearly straight in ln amplitude, with slope 1/2 through zero.

    In a free stage the margin is 1 - E/E_crit, and energy goes with the square of the amplitude: -ln(1 - margin)/2 is
    ln(critical/amplitude) there. Above zero its Taylor polynomial stands for it, because a margin of 1 is not
    infinitely far away.
    """
    lost = margin < 0
    return jnp.where(lost, -jnp.log1p(-jnp.where(lost, margin, 0.0)) / 2, margin / 2 + margin**2 / 4)


def _bridged(values: Real, known: Flags) -> tuple[Real, Flags]:
    """A single node that could not be computed is the mean of both beside it, as what lies between nodes is."""
    alone = ~known[1:-1] & known[:-2] & known[2:]
    inner = jnp.where(alone, (values[:-2] + values[2:]) / 2, values[1:-1])
    known = jnp.concatenate([known[:1], known[1:-1] | alone, known[-1:]])
    return jnp.concatenate([values[:1], inner, values[-1:]]), known
