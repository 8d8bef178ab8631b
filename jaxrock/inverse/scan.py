"""Scan a likelihood for starting points of climbers, and choose competing summits among their results.

Values at many places together, by few scenes and without slopes, are cheap. A first scan covers the ranges. A few more,
each half as wide as the preceding one, lie around the best places so far.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxrock.inverse.unknowns import Evaluator
from jaxrock.numerics.batched_bfgs import Summits

Places = Float[np.ndarray, "n parameters"]
_CENTRES, _AROUND = 16, 16  # best places of a scan, and places of the next one around each
_NARROWER = (1.0, 0.5, 0.25)  # standard deviations around these, in distances of places of the first scan
_BESIDE = 0.1  # share of the ranges within which a higher place excludes a lower one
_COMPARED = 2000  # number of best places compared by `_BESIDE`
_FEWEST = 12  # least number of starting places, filled up with excluded ones
COMPETING = 1.9207  # log-likelihood below the maximum within which summits compete: the ratio of 95 %
_VALLEY = 0.5  # fall of log-likelihood on the straight line between two summits that separates them
_BETWEEN = 12  # places tried on that line
_ALIKE, _MOST = 0.02, 12  # share of the ranges within which summits are identical; largest number compared


def scan(evaluate: Evaluator, count: int) -> None:
    """Scan a number of places spread over the ranges, and some around the best of them."""
    evaluate.scan(spread(count, evaluate))
    low, high = evaluate.ends
    rng, distance = np.random.default_rng(0), count ** (-1 / low.size)
    for factor in _NARROWER:
        places, values = best_scanned(evaluate)
        centres = places[~_has_higher_beside(places, evaluate, factor * distance)][:_CENTRES]
        away = factor * distance * rng.normal(size=(_AROUND, len(centres), low.size))
        around = np.clip(centres + (high - low) * away, low, high)
        evaluate.scan(around.reshape(-1, low.size))


def starts(evaluate: Evaluator, count: int) -> Places:
    """Return, as points, the best scanned places without a higher one nearby; fill up with others if these are few."""
    places, _ = best_scanned(evaluate)
    beside = _has_higher_beside(places, evaluate, _BESIDE)
    wanted = np.concatenate([places[~beside][:count], places[beside][: max(_FEWEST - np.sum(~beside), 0)]])
    return evaluate.points(wanted[:count])


def best_scanned(evaluate: Evaluator) -> tuple[Places, Float[np.ndarray, " n"]]:
    """Return the best places of the scan and their values, the highest first."""
    places, values = evaluate.scanned
    order = np.argsort(-values, kind="stable")[:_COMPARED]
    return places[order], values[order]


def _has_higher_beside(places: Places, evaluate: Evaluator, distance: float) -> Bool[np.ndarray, " n"]:
    """Return for each place whether a higher place, listed before it, is near in every range."""
    low, high = evaluate.ends
    share = (places - low) / (high - low)
    near = np.max(np.abs(share[:, None] - share[None]), axis=2) < distance
    return np.tril(near, -1).any(axis=1)


def spread(count: int, evaluate: Evaluator) -> Places:
    """Spread places evenly over the ranges: multiples of irrational numbers, modulo one.

    Started from Halton's sequence (of SciPy), five of eight fits end on a lower summit, and one on a higher.
    """
    low, high = evaluate.ends
    return low + (high - low) * (0.01 + 0.98 * low_discrepancy(count, low.size))


def low_discrepancy(count: int, dimensions: int) -> Places:
    """Return multiples of irrational numbers, modulo one, in a box of size 1."""
    root = np.roots([1, *[0] * (dimensions - 1), -1, -1])
    ratio = np.max(root.real[np.abs(root.imag) < 1e-9])  # x^(n+1) = x + 1, the golden ratio for n = 1
    return (0.5 + np.outer(np.arange(count), ratio ** -np.arange(1.0, dimensions + 1))) % 1


class Competing(NamedTuple):
    """Competing summits about as high as the highest: places (n, parameters) and values (n,), the highest first."""

    places: Places
    values: Float[np.ndarray, " n"]


def competing(evaluate: Evaluator, summits: Summits) -> Competing:
    """Return summits less than 1.92 below the highest, separated by a fall of over 1/2 from all higher ones.

    The fall is tested on the straight lines between them.
    """
    order = np.argsort(-summits.values)
    order = order[summits.values[order] > summits.values.max() - COMPETING]
    places, values = evaluate.places(summits.points[order]), summits.values[order]
    apart = ~_has_higher_beside(places, evaluate, _ALIKE)
    places, values = places[apart][:_MOST], values[apart][:_MOST]
    share, kept = np.linspace(0, 1, _BETWEEN + 2)[1:-1, None], [0]
    for number in range(1, len(places)):
        lines = places[number] + share * (places[kept] - places[number])[:, None]
        least = evaluate.at(lines.reshape(-1, places.shape[1]))[0].reshape(len(kept), _BETWEEN).min(axis=1)
        if (least < values[number] - _VALLEY).all():
            kept.append(number)
    return Competing(places[kept[1:]], values[kept[1:]])
