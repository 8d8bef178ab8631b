"""The quadrature over motions at each rock and over possible rocks, for the probabilities of outcomes.

The motion at each rock differs from that of the site by a lognormal factor, and alpha, p and restitution are uncertain.
Margins and rotations are computed at nodes along the logarithm of the factor, for a few possible rocks. Between nodes
they are interpolated linearly:

    P(stands) = mean over possible rocks of sum_k w_k Phi(y_k/s_k),

The sum is over the quarter points of the intervals between nodes. Here y is a function of the margin that is nearly
linear in ln amplitude, and w_k the normal probability around the quarter point. The width s_k is half of the change
of y from node to node; a probit of that width makes the sum smooth.

Nodes are fixed levels of the strength of the motion: a growing motion moves the weights, and not the nodes. So the
probability is as smooth in the amplitude as the normal distribution, however rough the margin. Overturning sets are
unions of intervals, some narrower than the distance of nodes. Nodes that moved with the amplitude would enter and leave
such intervals, and the probability would jump. A fixed node either meets such a narrow set, which then counts as a
whole interval, or misses it.

Possible rocks are a Latin hypercube (McKay, Beckman & Conover 1979), whose first direction is that in which a rock
becomes easier to topple. A slenderer rock acts like a stronger motion. So the variance within the strata of that
direction is added to that of the amplitude: the total is right for any number of rocks.
"""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import log_ndtr, logsumexp, ndtr, ndtri
from jaxtyping import ArrayLike

from jaxrock._arguments.ranges import positive, scalar
from jaxrock._core.arrays import is_traced, to_device
from jaxrock._core.types import Real
from jaxrock.inverse.observations import Flags, Observations

MOST_ACCURATE, LEAST_ACCURATE = 1e-3, 0.05  # range of errors of a probability
_APART, _APART_EXACT = 25.0, 10.0  # distance of nodes, in standard deviations for each unit of the error
_LEAST_APART, _MOST_APART = 0.01, 0.8
_ROCKS, _ROCKS_POWER = 0.045, 1.4  # possible rocks: (0.045/error)^1.4
_WELL_KNOWN = 10.0  # scatter by rocks over that by motion, per unit of the error, below which one rock suffices
_REACH = 4.0  # standard deviations to each side that nodes cover
_SMEAR = 0.5  # width of the probit, over the difference of y between nodes
_LEAST_WIDTH = 1e-3  # of that probit
_SLOPE_OVER = 1.2  # standard deviations at each end from which y is extrapolated
_LEAST_SLOPE = 0.05  # of y by a standard deviation, beyond the outermost nodes
_END_WIDTH = 0.1  # width of the probit of y beyond these nodes, so that the probability is smooth
_BY_P = 0.5  # change of ln amplitude with the effect of that of ln p: from 0 for long pulses to 1 for short ones
_LEAST_SHARE = 1 / 64  # half of one of the 32 copies that an engine follows at most
_GOLDEN = (np.sqrt(5) - 1) / 2
_DESIGNS = 200  # number of Latin hypercubes drawn; the least correlated is used


def quadrature_accuracy(name: str, value: Any) -> float:
    """Check the error that the quadrature may leave in a probability."""
    known = float(scalar(name, positive(name, value)))
    if not MOST_ACCURATE <= known <= LEAST_ACCURATE:
        raise ValueError(f"Argument `{name}` must be in [{MOST_ACCURATE:g}, {LEAST_ACCURATE:g}], but is {known:g}.")
    return known


class Quadrature(eqx.Module):
    """Nodes and weights of the quadrature: strengths of the motion, and possible rocks.

    - `apart`: distance of nodes, in standard deviations; `each_side`: number of nodes on each side of the motion
      itself.
    - `absorbed`: share of the rocks' variance that counts as variance of the amplitude.
    - `phases`: (possible,) shift of the nodes of each possible rock, as a share of the distance.
    - `normals`: (3, possible) standard normal: ease of toppling, remaining differences of alpha and p, restitution.
    """

    apart: float = eqx.field(static=True)
    each_side: int = eqx.field(static=True)
    absorbed: float = eqx.field(static=True)
    phases: Real
    normals: Real

    @classmethod
    def of(cls, accuracy: float, exact: bool) -> "Quadrature":
        """Return the quadrature for an error of about `accuracy` in a probability.

        `exact`: rocks are known so well that their variance is only added to that of the amplitude.
        """
        apart = float(np.clip((_APART_EXACT if exact else _APART) * accuracy, _LEAST_APART, _MOST_APART))
        rocks = 1 if exact else max(round((_ROCKS / accuracy) ** _ROCKS_POWER), 1)
        normals = _latin_hypercube(rocks)
        absorbed = float(1 - np.mean(normals[0] ** 2))
        phases = (np.arange(rocks) * _GOLDEN) % 1
        return cls(apart, int(np.ceil(_REACH / apart)), absorbed, *to_device((phases, normals)))

    @classmethod
    def coarse(cls) -> "Quadrature":
        """Return the quadrature of fewest nodes, enough to find where a likelihood is large."""
        return cls.of(_MOST_APART / _APART_EXACT, True)

    @property
    def scenes(self) -> int:
        """Number of scenes for each rock and orientation."""
        return (2 * self.each_side + 2) * self.phases.size

    def drawn(self, seed: int) -> "Quadrature":
        """Return a quadrature of as many nodes, with random phases and random places in the inner halves of strata."""
        rng, count = np.random.default_rng(seed), self.phases.size
        phases = (np.asarray(self.phases) + rng.uniform()) % 1
        normals = np.asarray(self.normals)
        if count > 1:
            share = np.stack([(rng.permutation(count) if i else np.arange(count)) for i in range(3)])
            normals = _quantile((share + rng.uniform(0.25, 0.75, share.shape)) / count)
        return eqx.tree_at(lambda it: (it.phases, it.normals), self, to_device((phases, normals)))


@functools.cache
def _latin_hypercube(count: int) -> np.ndarray:
    """Return nearly uncorrelated means of the standard normal over equal strata in three directions, (3, count)."""
    ends = _quantile(np.arange(1, count) / count)
    density = np.concatenate([[0.0], np.exp(-(ends**2) / 2) / np.sqrt(2 * np.pi), [0.0]])
    means, rng = -count * np.diff(density), np.random.default_rng(0)
    drawn = np.stack([[means, rng.permutation(means), rng.permutation(means)] for _ in range(_DESIGNS)])
    correlation = np.abs(drawn @ drawn.transpose(0, 2, 1))[:, [0, 0, 1], [1, 2, 2]]
    return drawn[np.argmin(correlation @ [1.0, 0.5, 0.25])]


def _quantile(share: np.ndarray) -> np.ndarray:
    from scipy.special import ndtri

    return ndtri(share)


class Levels(NamedTuple):
    """Strengths of the motion at nodes, (nodes, ..., possible, rocks), and the rocks at each."""

    strength: Real  # logarithm
    alpha: Real
    p: Real
    restitution: Real


def levels_around(
    observations: Observations, quadrature: Quadrature, scatter: ArrayLike, strength: Real
) -> tuple[Levels, Real]:
    """Return nodes around motions of known logarithmic strength, (...), and their distance from it.

    Distances, (nodes, ..., possible, rocks), are in standard deviations.
    """
    seen = observations
    by_alpha, by_p = _as_amplitudes(seen)
    by_rock = by_alpha**2 + by_p**2
    variance = scatter**2 + quadrature.absorbed * by_rock
    # Linear y through quarter points, with the smear, has a variance larger by this factor.
    spread = 1 + quadrature.apart**2 * (_SMEAR**2 - 1 / 48)
    # A change of the scatter moves weights, and neither the nodes nor the variance that the intervals add.
    deviation = jnp.sqrt(variance - jax.lax.stop_gradient((1 - 1 / spread) * variance))
    step = quadrature.apart * jax.lax.stop_gradient(deviation)
    strength = strength[..., None, None]
    base = jnp.floor(jax.lax.stop_gradient(strength) / step)
    number = np.arange(2 * quadrature.each_side + 2) - quadrature.each_side
    level = (base + quadrature.phases[:, None] + _in_front(number - 0.5, base[None])) * step
    where = (level - strength) / deviation
    length = jnp.sqrt(jnp.where(by_rock > 0, by_rock, 1.0))
    easier, other, bouncier = quadrature.normals[..., None]
    offsets = (
        (-by_alpha * easier + by_p * other) / length * (seen.alpha_sd / seen.alpha),
        (by_p * easier + by_alpha * other) / length * (seen.p_sd / seen.p),
        bouncier * seen.restitution_sd,
    )
    rocks = (jnp.broadcast_to(x, level.shape) for x in rocks_at(seen, offsets))
    return Levels(level, *rocks), where


def _as_amplitudes(seen: Observations) -> tuple[Real, Real]:
    """Return standard deviations of ln amplitude, (rocks,), with about the effect of those of alpha and of p."""
    weaker = seen.weaker_alpha
    by_alpha = seen.alpha_sd / seen.alpha * weaker / (jnp.sin(weaker) * jnp.cos(weaker))  # that of ln tan(alpha)
    return by_alpha, _BY_P * seen.p_sd / seen.p


def are_known_well(observations: Observations, scatter: Real, accuracy: float) -> bool:
    """Return whether the scatter of the motion dominates, so that one possible rock stands for all."""
    seen = observations
    known = seen.alpha, seen.alpha_sd, seen.p, seen.p_sd, seen.restitution_sd, scatter
    if is_traced(known):
        return False
    alpha, alpha_sd, p, p_sd, restitution_sd, scatter = (np.asarray(x) for x in known)
    by_rock = np.hypot(alpha_sd / np.sin(alpha), _BY_P * p_sd / p)  # tan(alpha), or more where the rock is wide
    return bool((by_rock <= _WELL_KNOWN * accuracy * scatter).all() and (restitution_sd <= accuracy).all())


def rocks_at(observations: Observations, offsets: tuple[Real, Real, Real] | Real) -> tuple[Real, Real, Real]:
    """Return alpha, p and restitution of rocks with offsets, (3, ..., rocks), in ln alpha, ln p and restitution."""
    most = observations.widest
    alpha = jnp.minimum(observations.alpha * jnp.exp(offsets[0]), jnp.maximum(most, observations.alpha))
    p = observations.p * jnp.exp(offsets[1])
    restitution = jnp.where(observations.follows, observations.by_momentum(alpha), observations.restitution)
    # At a restitution of 1 impacts never die out.
    high = jnp.maximum(jnp.where(observations.restitution_sd > 0, 0.99, 1.0), restitution)
    return alpha, p, jnp.clip(restitution + offsets[2], 0.0, high)


class Possible(NamedTuple):
    """Outcomes of rocks in possible scenes, (scenes, ..., ways, rocks), at the quarter points of intervals.

    The axis of ways holds all equally likely cases of a rock: its orientations, and the possible rocks.
    """

    weight: Real  # normal probability around each quarter point
    y: Real  # the margin, transformed to be nearly linear in ln amplitude
    width: Real  # width of the probit of y
    known: Flags  # whether it was computed, with a verdict
    stands: Real  # share that stands where chaos leaves the verdict of a node open, as a normal quantile; else 0
    ends: Real  # y at the first and the last node, its slope beyond, and where they are
    rotation: Real  # [rad]
    rotation_width: Real

    @classmethod
    def of(cls, where, margin, rotation, known, lost, verge, apart: float, share: Real | None = None) -> "Possible":
        """Interpolate from results at nodes, (nodes, ..., ways, rocks).

        Nodes lie at the given distances in standard deviations, `apart` from each other; `verge` is the rotation from
        which a rock at rest overturns; `share`, NaN elsewhere, overturns where chaos leaves the verdict open.

        On the way to overturning the rotation grows without bounds with the amplitude. The energy left to overturn,
        about (1 - rotation/verge)^2, does not; it passes zero with y, and is about twice y there.
        """
        left = 1 - rotation / verge
        left = jnp.where(lost, 2 * _straightened(jnp.minimum(margin, 0.0)), left * jnp.abs(left))
        left = jnp.where(known, left, 0.25)
        ends_of_parts = jnp.concatenate([verge[:1], _halves(verge)]), jnp.concatenate([left[:1], _halves(left)])
        share = jnp.full_like(margin, jnp.nan) if share is None else share
        is_open = ~jnp.isnan(share)
        y, known = _bridged(_straightened(jnp.where(known, margin, 0.0)), known, ~is_open)
        stands = _stands(jnp.where(is_open, 1 - share, jnp.where(y < 0, 0.0, 1.0)), known, is_open)
        width = jnp.sqrt((_SMEAR * jnp.diff(y, axis=0)) ** 2 + _LEAST_WIDTH**2)
        few = min(max(round(_SLOPE_OVER / apart), 1), len(y) - 1)
        # Distances `where` depend on the scatter, through which slopes have derivatives by it; the nodes are fixed.
        slope = jnp.stack(
            [(y[0] - y[few]) / (where[few] - where[0]), (y[-1 - few] - y[-1]) / (where[-1] - where[-1 - few])]
        )
        far = jnp.broadcast_arrays(where[:1], where[-1:], y[:1])[:2]
        ends = jnp.stack([y[0], y[-1], *(jnp.maximum(slope, 0.0) + _LEAST_SLOPE), far[0][0], far[1][0]])
        half = jnp.concatenate([where[:1], _halves(where)])
        weight = jnp.diff(ndtr(half), axis=0)
        return cls(
            weight, _between(y), _twice(width), _twice(known[1:] & known[:-1]), stands, ends,
            _rotation(_between(verge), _between(left)), jnp.abs(jnp.diff(_rotation(*ends_of_parts), axis=0)),
        )  # fmt: skip

    def log_probabilities(self, density: Real | None = None) -> Real:
        """Return the log-probabilities that rocks stand, and that they topple, (2 or 3, ..., rocks).

        With a log-density of each part, the ends first and last, a third row is standing with that density. All rows
        are computed together: a program of half the length compiles in half the time.
        """
        # An open scene counts with its share, one that was not computed as one half; both have no slope.
        inner = jnp.where(self.known, self.y / self.width, self.stands)
        # A sufficiently small motion spares every rock, and a sufficiently large one topples it: extrapolate y to its
        # zero beyond the outermost nodes.
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
    """Return the first `count` entries along the second axis, and the others."""
    return values[:, :count], values[:, count:]


def _rotation(verge: Real, left: Real) -> Real:
    return verge * (1 - left / (left**2 + 1e-6) ** 0.25)


def _between(values: Real) -> Real:
    """Return linearly interpolated values at the quarter points of intervals, (2 intervals, ...)."""
    pairs = jnp.stack([0.75 * values[:-1] + 0.25 * values[1:], 0.25 * values[:-1] + 0.75 * values[1:]], axis=1)
    return pairs.reshape(-1, *values.shape[1:])


def _halves(values: Real) -> Real:
    """Return the middles and upper ends of intervals, (2 intervals, ...)."""
    pairs = jnp.stack([(values[:-1] + values[1:]) / 2, values[1:]], axis=1)
    return pairs.reshape(-1, *values.shape[1:])


def _twice(values: Real | Flags) -> Real | Flags:
    """Repeat values of intervals at both of their quarter points."""
    return jnp.repeat(values, 2, axis=0)


def _mean_of_ways(logarithms: Real) -> Real:
    """Return logarithms of mean probabilities over equally likely ways, from logarithms (..., ways, rocks)."""
    count = logarithms.shape[-2]
    return logarithms[..., 0, :] if count == 1 else logsumexp(logarithms, axis=-2) - np.log(count)


def _in_front(values: np.ndarray, like: Real) -> np.ndarray:
    """Reshape values to broadcast along the first axis of an array."""
    return values.reshape(-1, *[1] * (like.ndim - 1))


def _straightened(margin: Real) -> Real:
    """Return a function of the margin that is nearly linear in ln amplitude, with slope 1/2 through zero.

    In a free stage the margin is 1 - E/E_crit, and the energy is proportional to the square of the amplitude:
    -ln(1 - margin)/2 is ln(critical/amplitude) there. Above zero its Taylor polynomial replaces it, because a margin of
    1 is not infinitely far away.
    """
    lost = margin < 0
    return jnp.where(lost, -jnp.log1p(-jnp.where(lost, margin, 0.0)) / 2, margin / 2 + margin**2 / 4)


def _stands(share: Real, known: Flags, is_open: Flags) -> Real:
    """Return the normal quantile of the share that stands, at the quarter points of intervals with an open end.

    It is zero elsewhere. A share of all, or of none, is taken to be half a copy away from that.
    """
    told = known | is_open
    between = jnp.where(_twice(told[1:] & told[:-1]), _between(share), 0.5)
    return jax.lax.stop_gradient(ndtri(jnp.clip(between, _LEAST_SHARE, 1 - _LEAST_SHARE)))


def _bridged(values: Real, known: Flags, may: Flags) -> tuple[Real, Flags]:
    """Fill a single node that was not computed with the mean of both neighbours, where it `may` be filled."""
    alone = ~known[1:-1] & known[:-2] & known[2:] & may[1:-1]
    inner = jnp.where(alone, (values[:-2] + values[2:]) / 2, values[1:-1])
    known = jnp.concatenate([known[:1], known[1:-1] | alone, known[-1:]])
    return jnp.concatenate([values[:1], inner, values[-1:]]), known
