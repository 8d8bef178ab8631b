"""Samples of a distribution whose density is dear to compute: chains whose proposals do not depend on where they are.

So those of all chains and many steps are computed at once, each of them once, and a proposal leads from any maximum to
any other. How often one is taken tells how near the proposals are to the distribution. They learn from all points that
were computed before: kernels around some of these, drawn by their weights, each as wide as its neighbours are apart
(Cappe et al. 2004). A small share is spread evenly over the box, so that no place is out of reach: a summit that was
missed would show, by a chain that stays there.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

ROUNDS = 8  # of learning, at most
_ENOUGH = 0.5  # independent points for each that is drawn, with which it has learned enough
_RISE = 1.1  # of that from round to round, below which it learns no more
_FREEDOM = 5.0  # degrees, of Student's t: tails that are heavier than those of most distributions
_KERNELS = 400
_NEIGHBOURS = 25  # kernels by whose distances one is as wide as it is; at least six for each dimension
_WIDER = 0.1  # than that, of the width of all
_EVENLY = 0.05
_FEWEST = 50  # points that weights must leave; otherwise they are made more alike


class Kernels(NamedTuple):
    """A distribution in a box: a share of it even, the rest in kernels, all of the same weight.

    - `centres`: (kernels, dimensions); `roots`: (kernels, dimensions, dimensions) their covariances are root root^T.
    - `evenly`: the even share; `low`, `high`: (dimensions,) the box.
    """

    centres: np.ndarray
    roots: np.ndarray
    evenly: float
    low: np.ndarray
    high: np.ndarray

    def draw(self, random: np.random.Generator, count: int) -> np.ndarray:
        """So many independent places, (count, dimensions); what falls out of the box is drawn again."""
        size, found = self.low.size, np.empty((0, self.low.size))
        while len(found) < count:
            which = random.integers(len(self.centres), size=2 * count)
            away = random.normal(size=(2 * count, size))
            away /= np.sqrt(random.chisquare(_FREEDOM, 2 * count) / _FREEDOM)[:, None]
            places = self.centres[which] + np.einsum("nij,nj->ni", self.roots[which], away)
            anywhere = random.uniform(self.low, self.high, (2 * count, size))
            places = np.where(random.uniform(size=2 * count)[:, None] < self.evenly, anywhere, places)
            inside = ((places >= self.low) & (places <= self.high)).all(axis=1)
            found = np.concatenate([found, places[inside]])
        return found[:count]

    def log_density(self, places: np.ndarray) -> np.ndarray:
        """Logarithm of the density at places in the box, (n, dimensions), but for a constant: what falls out of it."""
        size = self.low.size
        away = np.einsum("kij,nkj->nki", np.linalg.inv(self.roots), places[:, None] - self.centres)
        log_kernels = -(_FREEDOM + size) / 2 * np.log1p(np.sum(away**2, axis=2) / _FREEDOM)
        log_kernels -= np.linalg.slogdet(self.roots)[1] + size / 2 * math.log(_FREEDOM * math.pi)
        log_kernels += math.lgamma((_FREEDOM + size) / 2) - math.lgamma(_FREEDOM / 2) - math.log(len(self.centres))
        in_kernels = math.log1p(-self.evenly) + np.logaddexp.reduce(log_kernels, axis=1)
        return np.logaddexp(in_kernels, math.log(self.evenly) - np.sum(np.log(self.high - self.low)))


def around(centres: np.ndarray, extent: float, evenly: float, low: np.ndarray, high: np.ndarray) -> Kernels:
    """Kernels of an extent, in shares of the box, and an even share."""
    return Kernels(centres, np.tile(extent * np.diag(high - low), (len(centres), 1, 1)), evenly, low, high)


class Drawn(NamedTuple):
    """Points of several rounds: places (n, dimensions), logarithms of the wanted density there (n,), and the
    distributions that they were drawn from, with their numbers."""

    places: np.ndarray
    log_density: np.ndarray
    rounds: tuple[tuple[int, Kernels], ...]

    def and_more(self, places: np.ndarray, log_density: np.ndarray, kernels: Kernels) -> "Drawn":
        """These and another round."""
        places, log_density = np.concatenate([self.places, places]), np.concatenate([self.log_density, log_density])
        return Drawn(places, log_density, (*self.rounds, (len(places) - len(self.places), kernels)))

    @property
    def log_weights(self) -> np.ndarray:
        """Logarithms of the weights with which all points together stand for the wanted distribution, (n,)."""
        parts = [math.log(count) + kernels.log_density(self.places) for count, kernels in self.rounds]
        return self.log_density - np.logaddexp.reduce(parts, axis=0)

    def learned(self, random: np.random.Generator) -> Kernels:
        """Kernels around some of the points."""
        _, last = self.rounds[-1]
        shares = _shares(self.log_weights)
        centres = self.places[random.choice(len(shares), size=_KERNELS, p=shares)]
        size = last.low.size
        # Points that are all the same, or in a plane, have a width as well.
        covariance = np.cov(centres.T).reshape(size, size) + 1e-10 * np.diag((last.high - last.low) ** 2)
        root = np.linalg.cholesky(covariance)
        white = np.linalg.solve(root, centres.T).T
        near = np.argsort(np.sum((white[:, None] - white) ** 2, axis=2), axis=1)[:, : max(_NEIGHBOURS, 6 * size)]
        away = white[near] - white[:, None]
        local = np.einsum("kni,knj->kij", away, away) / near.shape[1] + _WIDER**2 * np.eye(size)
        return Kernels(centres, root @ np.linalg.cholesky(local), _EVENLY, last.low, last.high)


def _shares(log_weights: np.ndarray) -> np.ndarray:
    """Weights that add up to one; where only a few points have all of it, more alike."""
    relative = log_weights - log_weights.max()
    for power in np.linspace(1.0, 0.02, 50):
        shares = np.exp(power * relative)
        shares /= shares.sum()
        if 1 / np.sum(shares**2) >= _FEWEST:
            break
    return shares


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
    """Points of rounds of `count` proposals, the first from `kernels`, each of the next learned from all before, until
    they are about as good as they get; `density`: logarithms (n,) at places (n, dimensions)."""
    drawn, best = Drawn(np.empty((0, kernels.low.size)), np.empty(0), ()), 0.0
    for number in range(ROUNDS):
        places = kernels.draw(random, count)
        values = density(places)
        drawn = drawn.and_more(places, values, kernels)
        progress()
        found = _efficiency(values - kernels.log_density(places))
        if found > _ENOUGH or (number > 2 and found < _RISE * best):
            break
        best = max(best, found)
        kernels = drawn.learned(random)
    return drawn


class Chains(NamedTuple):
    """Chains so far, with where they began: places (steps + 1, chains, dimensions), log-densities (steps + 1, chains),
    logarithms of the weights where they are (chains,), and what is proposed to them."""

    places: np.ndarray
    log_density: np.ndarray
    held: np.ndarray
    kernels: Kernels

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
        return Chains(places, values, weights[now, each], self.kernels)


def begin(drawn: Drawn, count: int, random: np.random.Generator) -> Chains:
    """So many chains with proposals that learned from all points, which begin at some of these: by their weights, so
    that they are about where they will be."""
    kernels = drawn.learned(random)
    weights = np.exp(drawn.log_weights - drawn.log_weights.max())
    at = random.choice(weights.size, size=count, p=weights / weights.sum())
    places, values = drawn.places[at], drawn.log_density[at]
    return Chains(places[None], values[None], values - kernels.log_density(places), kernels)
