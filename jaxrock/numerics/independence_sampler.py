"""Independence sampler for a distribution whose density is expensive: proposals do not depend on the chains' states.

So the proposals of all chains and many steps are evaluated in one batch, each once, and a proposal leads from any
maximum to any other. The acceptance rate tells how near the proposals are to the distribution.

The proposals are learned from all points evaluated before. They are kernels around some of these points, drawn by their
weights, each about as wide as the distances of its neighbours (Cappe et al. 2004). A small share is uniform over the
box, so that every place can be reached. But chains that agree cannot reveal a summit so narrow that no proposal has met
it.

`independent_proposals` wraps this as a sampler with BlackJAX's interface, for any density over a box that is cheaper to
evaluate in batches:

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
_ENOUGH = 0.5  # independent points per drawn point at which learning ends
_RISE = 1.1  # least ratio of that from round to round; below it learning ends
_FREEDOM = 5.0  # degrees of freedom of Student's t, whose tails are heavier than those of most distributions
_KERNELS = 400  # at most
_NEIGHBOURS = 25  # kernels whose distances set the width of one; at least six for each dimension
_WIDER = 0.03  # added width, as a share of the width of all
_EVENLY = 0.05
_AROUND, _FIRST_EVENLY = 0.05, 0.85  # widths of the first kernels, as shares of the box; the uniform share then
_FEWEST = 50  # least effective number of points; with fewer, weights are flattened
_TRIED = 256  # draws from each kernel that estimate its share inside the box


class Kernels(NamedTuple):
    """A distribution in a box: a uniform share, and kernels.

    - `centres`: (kernels, dimensions); `roots`: (kernels, dimensions, dimensions), covariances are root root^T.
    - `shares`: (kernels,); with the uniform one, the shares inside the box sum to about 1.
    - `evenly`: the uniform share; `low`, `high`: (dimensions,) the box.
    """

    centres: np.ndarray
    roots: np.ndarray
    shares: np.ndarray
    evenly: float
    low: np.ndarray
    high: np.ndarray

    def draw(self, random: np.random.Generator, count: int) -> np.ndarray:
        """Draw `count` independent places, (count, dimensions); a place outside the box is drawn again."""
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
        """Return the logarithm of the density at places in the box, (n, dimensions), up to a constant that is near
        zero.
        """
        size = self.low.size
        # Matrix products and a plain sum of exponentials are six times as fast as `einsum` and `logaddexp.reduce`.
        away = np.matmul(places - self.centres[:, None], np.linalg.inv(self.roots).transpose(0, 2, 1))
        log_kernels = -(_FREEDOM + size) / 2 * np.log1p(np.einsum("kni,kni->kn", away, away) / _FREEDOM)
        heights = np.log(self.shares) - np.linalg.slogdet(self.roots)[1] - size / 2 * math.log(_FREEDOM * math.pi)
        log_kernels += (heights + math.lgamma((_FREEDOM + size) / 2) - math.lgamma(_FREEDOM / 2))[:, None]
        largest = log_kernels.max(axis=0)
        together = largest + np.log(np.exp(log_kernels - largest).sum(axis=0))
        even = math.log(self.evenly) - np.sum(np.log(self.high - self.low))
        return np.logaddexp(together, even)


def _student(random: np.random.Generator, count: int, size: int) -> np.ndarray:
    """Draw from Student's t in `size` dimensions, (count, size)."""
    return random.normal(size=(count, size)) / np.sqrt(random.chisquare(_FREEDOM, count) / _FREEDOM)[:, None]


def _kernels(
    centres: np.ndarray, roots: np.ndarray, weights: np.ndarray, evenly: float, low: np.ndarray, high: np.ndarray
) -> Kernels:
    """Make kernels with these weights inside the box: kernels at its ends, which often draw again, have larger shares.

    The share inside is estimated by counting. An error changes the proposals a little, but not the accuracy of their
    density.
    """
    away = _student(np.random.default_rng(0), _TRIED, low.size)
    tried = centres[:, None] + np.einsum("kij,nj->kni", roots, away)
    inside = ((tried >= low) & (tried <= high)).all(axis=2).mean(axis=1)
    shares = (1 - evenly) * weights / weights.sum() / np.maximum(inside, 1 / _TRIED)
    return Kernels(centres, roots, shares, evenly, low, high)


def around(centres: np.ndarray, extent: float, evenly: float, low: np.ndarray, high: np.ndarray) -> Kernels:
    """Make kernels of equal widths, in shares of the box, and a uniform share."""
    roots = np.tile(extent * np.diag(high - low), (len(centres), 1, 1))
    return _kernels(centres, roots, np.ones(len(centres)), evenly, low, high)


class Drawn(NamedTuple):
    """Points of several rounds.

    - `places`: (n, dimensions); `log_density`: (n,) logarithms of the wanted density there.
    - `rounds`: the distributions from which they were drawn, with their numbers of points.
    """

    places: np.ndarray
    log_density: np.ndarray
    rounds: tuple[tuple[int, Kernels], ...]

    def and_more(self, places: np.ndarray, log_density: np.ndarray, kernels: Kernels) -> "Drawn":
        """Append the points of another round."""
        rounds, count = self.rounds, len(places)
        if rounds and rounds[-1][1] is kernels:
            rounds, count = rounds[:-1], count + rounds[-1][0]
        places, log_density = np.concatenate([self.places, places]), np.concatenate([self.log_density, log_density])
        return Drawn(places, log_density, (*rounds, (count, kernels)))

    @property
    def log_weights(self) -> np.ndarray:
        """Logarithms of the importance weights of all points together for the wanted distribution, (n,)."""
        parts = [math.log(count) + kernels.log_density(self.places) for count, kernels in self.rounds]
        return self.log_density - np.logaddexp.reduce(parts, axis=0)

    def learned(self, random: np.random.Generator) -> tuple[Kernels, bool]:
        """Return kernels around some of the points, and whether their weights were used unflattened."""
        shares, plain = _shares(self.log_weights)
        drawn = random.choice(len(shares), size=_KERNELS, p=shares)
        which, weights = np.unique(drawn, return_counts=True)
        last, centres = self.rounds[-1][1], self.places[which]
        size = last.low.size
        # Added so that points that coincide, or lie in a plane, have a width as well.
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
    """Normalise weights, flattened where a few points have nearly all; return whether they are not flattened."""
    relative = log_weights - log_weights.max()
    for power in np.linspace(1.0, 0.02, 50):
        shares = np.exp(power * relative)
        shares /= shares.sum()
        if 1 / np.sum(shares**2) >= _FEWEST:
            break
    return shares, bool(power == 1.0)


def _efficiency(log_weights: np.ndarray) -> float:
    """Return the effective number of independent points per point, by their weights (n,)."""
    weights = np.exp(log_weights - log_weights.max())
    return float(weights.sum() ** 2 / np.sum(weights**2) / weights.size)


def learn(
    density: Callable[[np.ndarray], np.ndarray],
    kernels: Kernels,
    count: int,
    random: np.random.Generator,
    progress: Callable[[], None] = lambda: None,
) -> Drawn:
    """Draw rounds of `count` proposals, until their efficiency stops improving.

    The first round draws from `kernels` and their centres, each later one from kernels learned from all points before.
    `density`: logarithms (n,) at places (n, dimensions).

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
        # While few points have all of the weight, the efficiency says nothing yet.
        if efficiency > _ENOUGH or (plain and efficiency < _RISE * best):
            break
        best = max(best, efficiency)
        kernels, plain = drawn.learned(random)
    return drawn


class Chains(NamedTuple):
    """Chains so far, with their first places.

    - `places`: (steps + 1, chains, dimensions); `log_density`: (steps + 1, chains).
    - `held`: (chains,) logarithms of the weights at the current places.
    - `kernels`: the distribution of proposals; `drawn`: all points up to now.
    """

    places: np.ndarray
    log_density: np.ndarray
    held: np.ndarray
    kernels: Kernels
    drawn: Drawn

    @property
    def steps(self) -> int:
        """Number of steps."""
        return len(self.places) - 1

    def follow(self, density: Callable[[np.ndarray], np.ndarray], steps: int, random: np.random.Generator) -> "Chains":
        """Advance the chains by some steps.

        A chain accepts a proposal with a probability of the ratio of the weights there and at its place (Hastings
        1970).
        """
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
    """Start `count` chains with proposals learned from all points.

    The chains start at some of the points, drawn by their weights, so that they begin near equilibrium.
    """
    kernels, _ = drawn.learned(random)
    weights = np.exp(drawn.log_weights - drawn.log_weights.max())
    at = random.choice(weights.size, size=count, p=weights / weights.sum())
    places, values = drawn.places[at], drawn.log_density[at]
    return Chains(places[None], values[None], values - kernels.log_density(places), kernels, drawn)


class Taken(NamedTuple):
    """The result of a round of steps.

    - `places`: (steps, chains, dimensions); `log_density`: (steps, chains).
    - `acceptance_rate`: share of accepted proposals.
    """

    places: np.ndarray
    log_density: np.ndarray
    acceptance_rate: float


class Sampler(NamedTuple):
    """A sampler with BlackJAX's interface; its states are `Chains`, and it has no other memory.

    - `init(places, key)`: chains that have learned, from first places (n, dimensions) where the density is large.
    - `step(key, state, steps)`: the chains after a round (or so many steps), and the `Taken` steps.
    - `anew(key, state)`: chains that begin anew, with proposals learned from all points evaluated since.

    A key is one of JAX, or a NumPy random generator.
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
    """Make a sampler for a density that is expensive, and evaluated at many places at once.

    **Arguments:**

    - `log_density`: logarithms (n,) of the density at places (n, dimensions), up to a constant.
    - `low`, `high`: (dimensions,) the box, outside of which the density is zero.
    - `chains`: their number; `points`: number of places in one batch, a multiple of it.
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
