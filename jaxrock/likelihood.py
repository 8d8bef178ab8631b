"""How probable observations of rocks are under a motion.

What is certain about a rock is the sign of the margin of a known block under a known motion. Neither is known: the
motion at each rock differs from that of the site by a lognormal factor of its own (`scatter`, its standard deviation in
ln amplitude: what the ground, its surface and the model of a rigid block in a plane leave open), and alpha, p and
restitution are uncertain. The probability that a rock stands is the share of these possible scenes with a positive
margin:

    P(stands) = E[margin > 0],  over  ln amplitude + scatter e0,  ln alpha + (alpha_sd/alpha) e1,  ln p + (p_sd/p) e2,
                                restitution + restitution_sd e3,  all e independent and normal.

A probit of the margin over its slope (the delta method) would give that where the margin is straight; but overturning
sets are unions of intervals, narrower than the scatter or wider, and a probit with one slope would be certain where the
slope vanishes, in the middle of one. So the margin is computed at 13 nodes along the direction in which the scatter
moves it most (a larger amplitude, a slenderer or a smaller rock all act alike), and is taken as straight between them:

    P(stands) = sum_k w_k Phi(y_k/s_k),

over the quarter points of the 12 intervals, with y a function of the margin that is nearly straight in ln amplitude,
w_k the normal probability, and s_k half of what y changes by from node to node: a probit that smears each interval so
far that the sum is smooth. Beyond the last nodes, 3.6 standard deviations away, y goes on
straight, so that an observation that is all but impossible still says in which direction it is less so. The nodes also
lie off the main direction, in such a pattern that all four add their variance. Detail below about 0.3 scatter is not
resolved. No derivatives are needed for the likelihood, and only first ones for its slope.

Of an asymmetric rock of which it is not known which way round it stood in the shaking, the probability is the mean over
both ways.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import log_ndtr, logsumexp
from jaxtyping import Array, ArrayLike, Inexact

from jaxrock._checks import checked, positive, put_down
from jaxrock.asymmetric import AsymmetricBlock
from jaxrock.block import Block
from jaxrock.engine import AbstractEngine
from jaxrock.models import Housner, Model
from jaxrock.observations import ROTATION, TOPPLED, Observations
from jaxrock.response import outcome
from jaxrock.status import Status

Real = Inexact[Array, "..."]

NODES = 13  # scenes that are computed for each rock
_NODES = np.arange(NODES) - NODES // 2
_APART = 0.6  # distance of nodes, in standard deviations
_SMEAR = 0.5  # of the difference between nodes
_LEAST_WIDTH = 1e-3
_LEAST_SLOPE = 0.05  # of y by a standard deviation, beyond the last nodes
_END_WIDTH = 0.1  # of y there, so that the probability is smooth
_FLAT = -np.log(np.pi / 2)  # log-density of a rotation of which nothing is known but that the rock stands


def _weights() -> np.ndarray:
    """Probability of the surroundings of each quarter point, and of what lies beyond the last nodes."""
    half = np.arange(2 * _NODES[0], 2 * _NODES[-1] + 1) * _APART / 2
    below = np.array([math.erfc(-x / math.sqrt(2)) / 2 for x in half])
    return np.concatenate([below[:1], np.diff(below), below[:1]])


def _between(values):
    """Values at the quarter points of intervals, (2 intervals, ...), of what is straight between nodes."""
    xp = jnp if isinstance(values, jax.Array) else np
    pairs = xp.stack([0.75 * values[:-1] + 0.25 * values[1:], 0.25 * values[:-1] + 0.75 * values[1:]], axis=1)
    return pairs.reshape(-1, *values.shape[1:])


def _twice(values):
    """What intervals have in common, at their quarter points."""
    return (jnp if isinstance(values, jax.Array) else np).repeat(values, 2, axis=0)


_WEIGHTS = _weights()
_LAST = float(_NODES[-1] * _APART)


def _design() -> np.ndarray:
    """Where nodes lie, (nodes, 4), in standard deviations: along the main direction, and off it in three others.

    The patterns off the main direction have no mean and no correlation. What all of it adds to the variance of
    something straight is 1 in each column.
    """
    turn = 2 * np.pi * _NODES / np.array([[3], [3], [5]])
    columns = np.stack([np.ones(NODES), _NODES * _APART, np.cos(turn[0]), np.sin(turn[1]), np.cos(turn[2])], axis=1)
    weights = np.exp(-((_NODES * _APART) ** 2) / 2)[:, None]
    root = np.sqrt(weights / weights.sum())
    off = (np.linalg.qr(columns * root)[0] / root)[:, 2:]
    columns = np.column_stack([_NODES * _APART, off])
    inner = _WEIGHTS[1:-1, None]
    variance = np.sum(inner * (_between(columns) ** 2 + _twice(np.diff(columns, axis=0) * _SMEAR) ** 2), axis=0)
    return columns / np.sqrt(variance)


_DESIGN = _design()


class Likelihood(eqx.Module):
    """The likelihood of observations as a function of the parameters of a motion.

    **Arguments:**

    - `observations`: an `Observations`.
    - `motion`: what makes the motion of its parameters by name, such as `SinePulse`; any function will do.
    - `scatter`: standard deviation of ln amplitude from rock to rock [-], positive: what the motion at one rock may
      differ from that of the site, and the model be wrong by. 0.3 is a third up or down.
    - `model`, `engine`: as in `outcome`.
    - `lapse`: probability that what was seen of a rock says nothing, in [0, 1): somebody moved it, it was misjudged, or
      it stands in a gap between two ways of overturning that is too narrow to be resolved. One rock can then speak
      against a motion no more strongly than 2/lapse to 1.

    **Raises:** ValueError for a value outside its range.
    """

    observations: Observations
    scatter: Real
    lapse: Real
    motion: Callable = eqx.field(static=True)
    model: Model
    engine: AbstractEngine | None

    def __init__(
        self,
        observations: Observations,
        motion: Callable,
        scatter: ArrayLike = 0.3,
        model: Model = Housner(),
        engine: AbstractEngine | None = None,
        lapse: ArrayLike = 0.02,
    ):
        self.observations, self.motion, self.model, self.engine = observations, motion, model, engine
        self.scatter = positive("scatter", scatter)
        self.lapse = checked("lapse", lapse, "be in [0, 1)", lambda x: (x >= 0) & (x < 1))

    def log_terms(self, values: dict[str, ArrayLike], slopes: bool = True) -> Real:
        """Log-likelihood of each rock, (..., rocks), for `values` (...) of the motion's parameters by name.

        For a rock that survived or toppled the logarithm of a probability, for a measured rotation that of a density
        [1/rad]. It has first derivatives if `slopes`, and is computed faster without; those of second order raise
        NotImplementedError (take differences of slopes). Many motions at once take less time than `jax.vmap` of one.
        """
        return self._terms(self._possible(values, slopes))

    def _terms(self, possible: "_Possible") -> Real:
        seen = self.observations
        variance = possible.rotation_width**2 + seen.rotation_sd**2
        density = -((seen.rotation - possible.rotation) ** 2) / (2 * variance) - jnp.log(2 * jnp.pi * variance) / 2
        # Of a rotation in a scene that overturns, had it not, nothing is known; nor of one that was not computed.
        density = jnp.where(possible.measurable, density, _FLAT)
        ends = jnp.full_like(density[:1], _FLAT)
        density = jnp.where(seen.seen == ROTATION, jnp.concatenate([ends, density, ends]), 0.0)
        stands, topples = possible.log_probability(True, density), possible.log_probability(False)
        found = jnp.where(seen.seen == TOPPLED, topples, stands)
        return self._or_lapse(found, jnp.where(seen.seen == ROTATION, _FLAT, 0.0))

    def _or_lapse(self, log_probability: Real, flat: Real | float = 0.0) -> Real:
        """With the possibility that the observation says nothing: then it is as likely that a rock stands as not."""
        return jnp.logaddexp(jnp.log1p(-self.lapse) + log_probability, jnp.log(self.lapse / 2) + flat)

    def survival(self, values: dict[str, ArrayLike]) -> Real:
        """Probability that each rock stands, (..., rocks)."""
        return jnp.exp(self._possible(values).log_probability(True))

    def surprise(self, values: dict[str, ArrayLike]) -> tuple[Real, Real, Real]:
        """For each rock: how badly it fits, what one expects of that, and with which variance; (..., rocks) each.

        The badness is minus the log-probability; for a measured rotation half its squared distance from what is
        expected, in standard deviations, and minus the log-probability that it stands.
        """
        return self._surprise(self._possible(values))

    def terms_and_facts(self, values: dict[str, ArrayLike]) -> tuple[Real, tuple[Real, Real, Real, Real]]:
        """What `log_terms`, and `survival` with `surprise`, return; for the cost of the first."""
        possible = self._possible(values, slopes=True)
        return self._terms(possible), (jnp.exp(possible.log_probability(True)), *self._surprise(possible))

    def _surprise(self, nodes: "_Possible") -> tuple[Real, Real, Real]:
        seen = self.observations
        both = (self._or_lapse(nodes.log_probability(which)) for which in (True, False))
        stands, topples = (jnp.maximum(x, -1e3) for x in both)
        share, lost = jnp.exp(stands), jnp.exp(topples)
        badness = jnp.where(seen.seen == TOPPLED, -topples, -stands)
        mean, variance = -(share * stands + lost * topples), share * lost * (stands - topples) ** 2

        weight = jnp.where(nodes.measurable, _along(_WEIGHTS[1:-1], nodes.y), 0.0)
        weight = weight / nodes.y.shape[-2]
        total = jnp.maximum(jnp.sum(weight, axis=(0, -2)), 1e-9)
        centre = jnp.sum(weight * nodes.rotation, axis=(0, -2)) / total
        spread = nodes.rotation_width**2 + (nodes.rotation - centre[..., None, :]) ** 2
        spread = seen.rotation_sd**2 + jnp.sum(weight * spread, axis=(0, -2)) / total
        measured = jnp.where((seen.seen == ROTATION) & (total > 1e-6), 0.5, 0.0)
        return badness + measured * (seen.rotation - centre) ** 2 / spread, mean + measured, variance + measured

    def _possible(self, values: dict[str, ArrayLike], slopes: bool = False) -> "_Possible":
        """What becomes of every rock in every possible scene; with first derivatives, if `slopes`."""
        names, parameters = tuple(values), jnp.broadcast_arrays(*map(jnp.asarray, values.values()))
        scenes = possible_scenes(self.observations, self.scatter)
        shape = (*parameters[0].shape, *scenes[0].shape)

        def one(parameters, factor, block):
            def results(parameters):
                with put_down():  # known to be good; a check in the program would cost more than it
                    motion = self.motion(**dict(zip(names, parameters))) * factor
                    found = outcome(block, motion, self.model, engine=self.engine)
                rotation = jnp.where(found.overturned, 0.0, found.max_rotation)
                real = jnp.stack([found.margin, rotation])
                return real, (real, found.overturned, found.status == Status.successful)

            if not slopes:
                return None, results(parameters)[1]
            # The product of a small Jacobian: in reverse it is computed once, with the values.
            _, back, found = jax.vjp(results, parameters, has_aux=True)
            return jnp.stack([back(row)[0] for row in jnp.eye(2)]), found

        parameters = [jnp.broadcast_to(x[..., None, None, None], shape).ravel() for x in parameters]
        parameters = jnp.stack(parameters, axis=-1)
        scenes = jax.tree.map(lambda x: jnp.broadcast_to(x, shape).ravel(), scenes)
        # Values whose derivatives are known: JAX has to go through this product only, and not through the engine.
        fixed = jax.lax.stop_gradient(parameters)
        rows, (real, lost, known) = jax.vmap(one)(fixed, *scenes)
        if slopes:
            real = _sloping(real, jnp.where(jnp.isfinite(rows), rows, 0.0), parameters)
        return _Possible.of(*(jnp.moveaxis(x.reshape(shape), -3, 0) for x in (*real.T, lost, known)))


@jax.custom_jvp
def _sloping(values: Real, rows: Real, parameters: Real) -> Real:
    """Values, (..., results), with the rows of their Jacobian by parameters, (..., results, parameters)."""
    return values


@_sloping.defjvp
def _(primals, tangents):
    values, rows, parameters = primals
    return values, jnp.einsum("...ij,...j->...i", _constant(rows, parameters), tangents[2])


@jax.custom_jvp
def _constant(rows: Real, parameters: Real) -> Real:
    """Rows that are known at these parameters only."""
    return rows


@_constant.defjvp
def _(primals, tangents):
    raise NotImplementedError("A likelihood has first derivatives only: for second ones take differences of slopes.")


class _Possible(NamedTuple):
    """What becomes of rocks in possible scenes, (scenes, ..., ways, rocks): the quarter points of intervals."""

    y: Real  # the margin, straightened
    width: Real  # what it is smeared by
    known: Real  # whether it was computed
    ends: Real  # y at the first and the last node, and its slope beyond
    rotation: Real  # [rad]
    rotation_width: Real
    measurable: Real  # whether there is a rotation

    @classmethod
    def of(cls, margin, rotation, lost, known) -> "_Possible":
        """From the results at nodes, (nodes, ..., ways, rocks)."""
        y = _straightened(jnp.where(known, margin, 0.0))
        width = jnp.sqrt((_SMEAR * jnp.diff(y, axis=0)) ** 2 + _LEAST_WIDTH**2)
        slope = jnp.stack([y[0] - y[3], y[-4] - y[-1]]) / (3 * _APART)
        ends = jnp.stack([y[0], y[-1], *(jnp.maximum(slope, 0.0) + _LEAST_SLOPE)])
        there = known & ~lost
        rotation = jnp.where(there, rotation, 0.0)
        both, one = there[1:] & there[:-1], there[1:] | there[:-1]
        # Where only one end of an interval has a rotation, that one holds.
        alone = _twice(rotation[1:] + rotation[:-1])
        step = jnp.where(both, jnp.diff(rotation, axis=0), 0.0)
        rotation = jnp.where(_twice(both), _between(rotation), alone)
        return cls(
            _between(y), _twice(width), _twice(known[1:] & known[:-1]), ends, rotation, _twice(_SMEAR * step),
            _twice(one),
        )  # fmt: skip

    def log_probability(self, stands: bool, density: Real | float = 0.0) -> Real:
        """Logarithm of the probability that rocks stand (or topple), (..., rocks); with a log-density of each part."""
        sign = 1.0 if stands else -1.0
        # Of a scene that could not be computed nothing is known: one half, and no slope.
        inner = log_ndtr(jnp.where(self.known, sign * self.y / self.width, 0.0))
        # A motion that is small enough spares every rock, and one that is large enough topples it. How far away is
        # that?
        first, last, before, after = self.ends
        near, slope, far = (first, before, last) if stands else (-last, after, -first)
        beyond = log_ndtr(-_LAST + jnp.minimum(near, 0.0) / slope)
        other = log_ndtr(-_LAST) + log_ndtr(far / _END_WIDTH)
        parts = jnp.concatenate([jnp.stack([beyond, other]), inner + _along(np.log(_WEIGHTS[1:-1]), inner)])
        if jnp.ndim(density):  # that beyond the ends first, as here
            parts = parts + jnp.concatenate([density[:1], density[-1:], density[1:-1]])
        return _mean_of_ways(logsumexp(parts, axis=0))


def _mean_of_ways(logarithms: Real) -> Real:
    """Of probabilities, by their logarithms (..., ways, rocks): which way a rock was shaken is anybody's guess."""
    count = logarithms.shape[-2]
    return logarithms[..., 0, :] if count == 1 else logsumexp(logarithms, axis=-2) - np.log(count)


def _along(values: np.ndarray, like: Real) -> np.ndarray:
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


def possible_scenes(observations: Observations, scatter: ArrayLike) -> tuple[Real, Block | AsymmetricBlock]:
    """Factor on the motion, with its sign, (nodes, ways, rocks), and the rocks at the nodes, (nodes, 1, rocks)."""
    deviation = jnp.stack(
        [
            jnp.broadcast_to(scatter, observations.alpha.shape),
            observations.alpha_sd / observations.alpha,
            observations.p_sd / observations.p,
            observations.restitution_sd,
        ]
    )
    offsets = jnp.einsum("ki,jir->kjr", _DESIGN, _directions(observations.weaker_alpha, deviation)) * deviation
    blocks = observations.blocks_at(*rocks_at(observations, offsets[:, 1:].swapaxes(0, 1)))
    return jnp.exp(offsets[:, :1]) * observations.ways, jax.tree.map(lambda x: x[:, None], blocks)


def rocks_at(observations: Observations, offsets: Real) -> tuple[Real, Real, Real]:
    """Alpha, p and restitution of rocks that are off by (3, ..., rocks) in ln alpha, ln p and restitution."""
    most = observations.widest
    alpha = jnp.minimum(observations.alpha * jnp.exp(offsets[0]), jnp.maximum(most, observations.alpha))
    p = observations.p * jnp.exp(offsets[1])
    restitution = jnp.where(observations.follows, observations.by_momentum(alpha), observations.restitution)
    # At 1 impacts never die out.
    high = jnp.maximum(jnp.where(observations.restitution_sd > 0, 0.99, 1.0), restitution)
    return alpha, p, jnp.clip(restitution + offsets[2], 0.0, high)


def _directions(alpha: Real, deviation: Real) -> Real:
    """Orthonormal directions of standardised scatter, (4, 4, rocks); the first moves the margin most.

    A larger amplitude acts like a lower threshold tan(alpha), about like half as much in ln p (between none for long
    pulses and all for short ones), and like a higher restitution, a little. A rough guess is enough: it decides where
    the nodes lie.
    """
    guess = deviation * jnp.stack(
        [jnp.ones_like(alpha), -alpha / (jnp.sin(alpha) * jnp.cos(alpha)), 0.5 + 0 * alpha, 0.3 + 0 * alpha]
    )
    first = guess / jnp.linalg.norm(guess, axis=0)

    def complete(first):
        # A reflection that turns the first axis into this direction; its other columns are the rest.
        axis = jnp.eye(4)[0]
        across = first + jnp.where(first[0] < 0, -1.0, 1.0) * axis
        return jnp.where(first[0] < 0, 1.0, -1.0) * (jnp.eye(4) - 2 * jnp.outer(across, across) / (across @ across))

    return jax.vmap(complete, in_axes=1, out_axes=2)(first)
