"""Samples of a distribution whose density is dear to compute: chains whose proposals do not depend on where they are.

So those of all chains and many steps are computed at once, each of them once, and a proposal leads from any maximum to
any other. How often one is taken tells how near the proposals are to the distribution. They learn from all points that
were computed before: kernels around some of these, drawn by their weights, each about as wide as its neighbours are
apart (Cappe et al. 2004). A small share is spread evenly over the box, so that no place is out of reach; but chains
that agree cannot tell of a summit so narrow that no proposal has met it.

`independent_proposals` makes of it a sampler in the manner of BlackJAX, for any density over a box whose values at many
places are cheaper together:

    sampler = independent_proposals(log_density, low=np.zeros(2), high=np.ones(2))
    state = sampler.init(np.array([[0.3, 0.5]]), key)
    for number in range(20):
        state, info = sampler.step(jax.random.fold_in(key, number), state)
    state.places[1:]
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

ROUNDS = 12  # of learning, at most
_ENOUGH = 0.5  # independent points for each that is drawn, with which it has learned enough
_RISE = 1.1  # of that from round to round, below which it learns no more
_FREEDOM = 5.0  # degrees, of Student's t: tails that are heavier than those of most distributions
_KERNELS = 400  # at most
_NEIGHBOURS = 25  # kernels by whose distances one is as wide as it is; at least six for each dimension
_WIDER = 0.03  # than that, of the width of all
_EVENLY = 0.05
_AROUND, _FIRST_EVENLY = 0.05, 0.85  # widths of the first kernels, in boxes; the share that is even then
_FEWEST = 50  # points that weights must leave; otherwise they are made more alike
_TRIED = 256  # places of each kernel, to see how much of it is in the box


class Kernels(NamedTuple):
    """A distribution in a box: a share of it even, the rest in kernels.

    - `centres`: (kernels, dimensions); `roots`: (kernels, dimensions, dimensions) their covariances are root root^T.
    - `shares`: (kernels,) which, with the even one, are about 1 of what is in the box.
    - `evenly`: the even share; `low`, `high`: (dimensions,) the box.
    """

    centres: np.ndarray
    roots: np.ndarray
    shares: np.ndarray
    evenly: float
    low: np.ndarray
    high: np.ndarray

    def draw(self, random: np.random.Generator, count: int) -> np.ndarray:
        """So many independent places, (count, dimensions); what falls out of the box is drawn again."""
        size, accepted = self.low.size, np.empty((0, self.low.size))
        shares = np.append(self.shares, self.evenly) / (self.shares.sum() + self.evenly)
        while len(accepted) < count:
            which = random.choice(shares.size, size=2 * count, p=shares)
            even = which == len(self.centres)
            which[even] = 0
            away = np.einsum("nij,nj->ni", self.roots[which], _student(random, 2 * count, size))
            anywhere = random.uniform(self.low, self.high, (2 * count, size))
            places = np.where(even[:, None], anywhere, self.centres[which] + away)
            inside = ((places >= self.low) & (places <= self.high)).all(axis=1)
            accepted = np.concatenate([accepted, places[inside]])
        return accepted[:count]

    def log_density(self, places: np.ndarray) -> np.ndarray:
        """Logarithm of the density at places in the box, (n, dimensions), but for a constant that is near zero."""
        size = self.low.size
        # By matrices' products and a sum of exponentials: six times as fast as `einsum` and `logaddexp.reduce`.
        away = np.matmul(places - self.centres[:, None], np.linalg.inv(self.roots).transpose(0, 2, 1))
        log_kernels = -(_FREEDOM + size) / 2 * np.log1p(np.einsum("kni,kni->kn", away, away) / _FREEDOM)
        heights = np.log(self.shares) - np.linalg.slogdet(self.roots)[1] - size / 2 * math.log(_FREEDOM * math.pi)
        log_kernels += (heights + math.lgamma((_FREEDOM + size) / 2) - math.lgamma(_FREEDOM / 2))[:, None]
        largest = log_kernels.max(axis=0)
        together = largest + np.log(np.exp(log_kernels - largest).sum(axis=0))
        even = math.log(self.evenly) - np.sum(np.log(self.high - self.low))
        return np.logaddexp(together, even)


def _student(random: np.random.Generator, count: int, size: int) -> np.ndarray:
    """Draws of Student's t in so many dimensions, (count, size)."""
    return random.normal(size=(count, size)) / np.sqrt(random.chisquare(_FREEDOM, count) / _FREEDOM)[:, None]


def _kernels(
    centres: np.ndarray, roots: np.ndarray, weights: np.ndarray, evenly: float, low: np.ndarray, high: np.ndarray
) -> Kernels:
    """Kernels with such weights of what is drawn in the box: those at its ends, where much is drawn again, have more.

    How much is counted, not known. That changes the proposals a little, and not how well their density is known.
    """
    away = _student(np.random.default_rng(0), _TRIED, low.size)
    tried = centres[:, None] + np.einsum("kij,nj->kni", roots, away)
    inside = ((tried >= low) & (tried <= high)).all(axis=2).mean(axis=1)
    shares = (1 - evenly) * weights / weights.sum() / np.maximum(inside, 1 / _TRIED)
    return Kernels(centres, roots, shares, evenly, low, high)


def around(centres: np.ndarray, extent: float, evenly: float, low: np.ndarray, high: np.ndarray) -> Kernels:
    """Kernels of an extent, in shares of the box, and an even share."""
    roots = np.tile(extent * np.diag(high - low), (len(centres), 1, 1))
    return _kernels(centres, roots, np.ones(len(centres)), evenly, low, high)


class Drawn(NamedTuple):
    """Points of several rounds: places (n, dimensions), logarithms of the wanted density there (n,), and the
    distributions that they were drawn from, with their numbers."""

    places: np.ndarray
    log_density: np.ndarray
    rounds: tuple[tuple[int, Kernels], ...]

    def and_more(self, places: np.ndarray, log_density: np.ndarray, kernels: Kernels) -> "Drawn":
        """These and another round."""
        rounds, count = self.rounds, len(places)
        if rounds and rounds[-1][1] is kernels:
            rounds, count = rounds[:-1], count + rounds[-1][0]
        places, log_density = np.concatenate([self.places, places]), np.concatenate([self.log_density, log_density])
        return Drawn(places, log_density, (*rounds, (count, kernels)))

    @property
    def log_weights(self) -> np.ndarray:
        """Logarithms of the weights with which all points together stand for the wanted distribution, (n,)."""
        parts = [math.log(count) + kernels.log_density(self.places) for count, kernels in self.rounds]
        return self.log_density - np.logaddexp.reduce(parts, axis=0)

    def learned(self, random: np.random.Generator) -> tuple[Kernels, bool]:
        """Kernels around some of the points, and whether their weights were taken as they are."""
        shares, plain = _shares(self.log_weights)
        drawn = random.choice(len(shares), size=_KERNELS, p=shares)
        which, weights = np.unique(drawn, return_counts=True)
        last, centres = self.rounds[-1][1], self.places[which]
        size = last.low.size
        # Points that are all the same, or in a plane, have a width as well.
        covariance = np.cov(self.places[drawn].T).reshape(size, size) + 1e-10 * np.diag((last.high - last.low) ** 2)
        root = np.linalg.cholesky(covariance)
        white = np.linalg.solve(root, centres.T).T
        order = np.argsort(np.sum((white[:, None] - white) ** 2, axis=2), axis=1)
        near = order[:, 1 : 1 + max(_NEIGHBOURS, 6 * size)]  # the first is the kernel itself
        nearness = weights[near] / weights[near].sum(axis=1, keepdims=True)
        away = np.sqrt(nearness)[..., None] * (white[near] - white[:, None])
        local = np.einsum("kni,knj->kij", away, away) + _WIDER**2 * np.eye(size)
        roots = root @ np.linalg.cholesky(local)
        return _kernels(centres, roots, weights, _EVENLY, last.low, last.high), plain


def _shares(log_weights: np.ndarray) -> tuple[np.ndarray, bool]:
    """Weights that add up to one; where only a few points have all of it, more alike, and whether they are not."""
    relative = log_weights - log_weights.max()
    for power in np.linspace(1.0, 0.02, 50):
        shares = np.exp(power * relative)
        shares /= shares.sum()
        if 1 / np.sum(shares**2) >= _FEWEST:
            break
    return shares, bool(power == 1.0)


def _efficiency(log_weights: np.ndarray) -> float:
    """How many independent points of the wanted distribution one of these is worth, by their weights (n,)."""
    weights = np.exp(log_weights - log_weights.max())
    return float(weights.sum() ** 2 / np.sum(weights**2) / weights.size)


def learn(
    density: Callable[[np.ndarray], np.ndarray],
    kernels: Kernels,
    count: int,
    random: np.random.Generator,
    progress: Callable[[], None] = lambda: None,
) -> Drawn:
    """Points of rounds of `count` proposals, the first from `kernels` and their centres, each of the next learned from
    all before, until they are about as good as they get; `density`: logarithms (n,) at places (n, dimensions).

    **Raises:** ValueError if all of the first have a density of zero.
    """
    drawn, best, plain = Drawn(np.empty((0, kernels.low.size)), np.empty(0), ()), 0.0, False
    for number in range(ROUNDS):
        places = kernels.draw(random, count)
        if number == 0:
            places = np.concatenate([kernels.centres, places])[:count]
        values = density(places)
        if number == 0 and not np.isfinite(values).any():
            raise ValueError("No place was found where the density is not zero.")
        drawn = drawn.and_more(places, values, kernels)
        progress()
        efficiency = _efficiency(values - kernels.log_density(places)) if np.isfinite(values).any() else 0.0
        # While few points have all of the weight, it says nothing yet.
        if efficiency > _ENOUGH or (plain and efficiency < _RISE * best):
            break
        best = max(best, efficiency)
        kernels, plain = drawn.learned(random)
    return drawn


class Chains(NamedTuple):
    """Chains so far, with where they began: places (steps + 1, chains, dimensions), log-densities (steps + 1, chains),
    logarithms of the weights where they are (chains,), what is proposed to them, and all points up to now."""

    places: np.ndarray
    log_density: np.ndarray
    held: np.ndarray
    kernels: Kernels
    drawn: Drawn

    @property
    def steps(self) -> int:
        """How many there were."""
        return len(self.places) - 1

    def follow(self, density: Callable[[np.ndarray], np.ndarray], steps: int, random: np.random.Generator) -> "Chains":
        """The chains some steps later: each goes to what is proposed with a probability of the ratio of the weights
        there and where it is (Hastings 1970)."""
        count = self.held.size
        proposed = self.kernels.draw(random, steps * count)
        values = density(proposed)
        drawn = self.drawn.and_more(proposed, values, self.kernels)
        weights = np.concatenate([self.held, values - self.kernels.log_density(proposed)]).reshape(-1, count)
        offered = np.concatenate([self.places[-1], proposed]).reshape(*weights.shape, -1)
        values = np.concatenate([self.log_density[-1], values]).reshape(-1, count)
        each, now, at = np.arange(count), np.zeros(count, int), []
        for number in range(1, steps + 1):
            ratio = weights[number] - weights[now, each]
            now = np.where(random.exponential(size=count) > -ratio, number, now)
            at.append(now)
        places = np.concatenate([self.places, offered[np.array(at), each]])
        values = np.concatenate([self.log_density, values[np.array(at), each]])
        return Chains(places, values, weights[now, each], self.kernels, drawn)


def begin(drawn: Drawn, count: int, random: np.random.Generator) -> Chains:
    """So many chains with proposals that learned from all points, which begin at some of these: by their weights, so
    that they are about where they will be."""
    kernels, _ = drawn.learned(random)
    weights = np.exp(drawn.log_weights - drawn.log_weights.max())
    at = random.choice(weights.size, size=count, p=weights / weights.sum())
    places, values = drawn.places[at], drawn.log_density[at]
    return Chains(places[None], values[None], values - kernels.log_density(places), kernels, drawn)


class Taken(NamedTuple):
    """What a round of steps has come to: places (steps, chains, dimensions), log-densities there (steps, chains), and
    the share of proposals that were taken."""

    places: np.ndarray
    log_density: np.ndarray
    acceptance_rate: float


class Sampler(NamedTuple):
    """A sampler in the manner of BlackJAX; its states are `Chains`, and nothing else remembers anything.

    - `init(places, key)`: chains that have learned, from first places (n, dimensions) where the density is large.
    - `step(key, state, steps)`: the chains a round later (or so many steps), and what was `Taken` in it.
    - `anew(key, state)`: chains that begin anew, with proposals that learned from all that was met since.

    A key is one of JAX, or a generator of random numbers of NumPy.
    """

    init: Callable[..., Chains]
    step: Callable[..., tuple[Chains, Taken]]
    anew: Callable[..., Chains]


def independent_proposals(
    log_density: Callable[[np.ndarray], np.ndarray],
    low: np.ndarray,
    high: np.ndarray,
    *,
    chains: int = 8,
    points: int = 512,
    progress: Callable[[], None] = lambda: None,
) -> Sampler:
    """A sampler for a density that is dear, and known at many places at once.

    **Arguments:**

    - `log_density`: logarithms (n,) of the density at places (n, dimensions), but for a constant.
    - `low`, `high`: (dimensions,) the box outside of which there is none of it.
    - `chains`: how many; `points`: how many places are computed together, a multiple of them.
    - `progress`: called after every round of learning.

    **Returns:** a `Sampler`.
    """
    low, high = np.asarray(low, float), np.asarray(high, float)

    def init(places, key) -> Chains:
        random = _random(key)
        first = around(np.atleast_2d(places), _AROUND, _FIRST_EVENLY, low, high)
        return begin(learn(log_density, first, points, random, progress), chains, random)

    def step(key, state: Chains, steps: int = points // chains) -> tuple[Chains, Taken]:
        new = state.follow(log_density, steps, _random(key))
        places = new.places[-steps - 1 :]
        moved = np.any(np.diff(places, axis=0) != 0, axis=2)
        return new, Taken(places[1:], new.log_density[-steps:], float(np.mean(moved)))

    def anew(key, state: Chains) -> Chains:
        return begin(state.drawn, chains, _random(key))

    return Sampler(init, step, anew)


def _random(key: Any) -> np.random.Generator:
    if isinstance(key, np.random.Generator):
        return key
    return np.random.default_rng(np.asarray(jax.random.key_data(key)).ravel())
