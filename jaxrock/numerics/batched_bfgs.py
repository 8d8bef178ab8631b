"""Batched BFGS ascent: many climbers maximise a function whose values and slopes come in batches.

Each climber has its own BFGS matrix; dimensions are few. In every round a climber tries one point. If the gain is
sufficient, it takes a new direction in the next round, else a shorter step. So no round waits for a line search, and a
round is one call of one compiled program, in whatever state the climbers are.

(`optax.lbfgs` under `jax.vmap` also works, but waits for the longest line search; `optax.adam` takes many times as many
points: benchmarks/inverse.md.)
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

_LONGEST_STEP = 1.0  # in the units of the points
_SUFFICIENT = 1e-4  # share of the gain that the slope predicts
_SHORTEST_STEP = 1e-9  # a climber with a shorter step is at a jump, and ends

# (rounds, depth): after so many rounds, climbers so far below the best are stopped. A compromise: with later limits a
# fit takes up to twice as many points, and now and then finds a higher summit; more starts do, too.
_HOPELESS = ((2, 10.0), (5, 4.0), (8, 1.5), (12, 0.5), (20, 0.1), (30, 0.02), (40, 0.005))
_PATIENCE, _LEAST_GAIN = 12, 2e-6  # rounds in which a climber must gain so much; at a kink none would end otherwise
_SAME = 0.01  # distance from a higher climber, in the units of the points, at which one is stopped
_NOWHERE = -1e300  # in place of a value that is not finite


class Summits(NamedTuple):
    """The last points of all climbers, and their paths.

    - `points`: (climbers, dimensions); `values`: (climbers,); `arrived`: whether each is on a summit.
    - `path`: points (rounds, climbers, dimensions) and values (rounds, climbers), NaN after a climber's end.
    """

    points: np.ndarray
    values: np.ndarray
    arrived: np.ndarray
    path: tuple[np.ndarray, np.ndarray] | None = None


def batched_bfgs(
    evaluate: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    starts: np.ndarray,
    free: np.ndarray | bool = True,
    rounds: int = 150,
    promise: float = 1e-7,
    group: np.ndarray | int = 0,
) -> Summits:
    """Climb from many starts.

    **Arguments:**

    - `evaluate`: values (points,) and slopes (points, dimensions) at points (points, dimensions).
    - `starts`: (climbers, dimensions).
    - `free`: (climbers, dimensions), which coordinates of a climber may change.
    - `rounds`: at most.
    - `promise`: a climber has arrived when the slope predicts a smaller gain than this for a whole step.
    - `group`: (climbers,) numbers. Climbers of one group look for the same summit: those far below the best of the
      group, or beside a higher one, are stopped.

    **Returns:** `Summits`.
    """
    points, free = np.array(starts, float), np.broadcast_to(free, np.shape(starts))
    group = np.broadcast_to(group, len(points))
    values, slopes = _finite(*evaluate(points))
    slopes = slopes * free
    count, size = points.shape
    inverse = np.tile(np.eye(size), (count, 1, 1))  # of minus the Hessian
    fresh, done, arrived = np.ones(count, bool), np.zeros(count, bool), np.zeros(count, bool)
    search, step = np.zeros_like(points), np.ones(count)
    path, since, reached = [], np.zeros(count, int), values.copy()
    for number in range(rounds):
        on_the_way = ~done & (values > _NOWHERE)
        path.append((np.where(done[:, None], np.nan, points), np.where(on_the_way, values, np.nan)))
        direction = np.einsum("cij,cj->ci", inverse, slopes)
        direction *= np.minimum(1.0, _LONGEST_STEP / np.maximum(np.max(np.abs(direction), axis=1), 1e-300))[:, None]
        search[fresh], step[fresh] = direction[fresh], 1.0
        promised = np.sum(search * slopes, axis=1)
        level = fresh & ~done & (promised < promise)
        arrived |= level & (values > _NOWHERE)
        done |= level | (step < _SHORTEST_STEP)
        gaining = values > reached + _LEAST_GAIN
        since, reached = np.where(gaining, number, since), np.where(gaining, values, reached)
        done |= _given_up(number, points, values, group) | (number - since >= _PATIENCE)
        if done.all():
            break
        active = np.flatnonzero(~done)
        trial = points[active] + step[active, None] * search[active]
        higher, new = _finite(*evaluate(trial))
        gain, expected = higher - values[active], step[active] * promised[active]
        good = gain >= _SUFFICIENT * expected
        fresh = np.zeros(count, bool)
        moved = active[good]
        fresh[moved] = True
        new = (new * free[active])[good]
        inverse[moved] = _bfgs(inverse[moved], trial[good] - points[moved], slopes[moved] - new)
        points[moved], values[moved], slopes[moved] = trial[good], higher[good], new
        # The next trial is the top of the parabola through both values and the slope.
        bad = active[~good]
        shorter = expected[~good] / np.maximum(2 * (expected[~good] - gain[~good]), 1e-300)
        step[bad] *= np.clip(shorter, 0.1, 0.5)
    places, heights = map(np.array, zip(*path))
    return Summits(points, values, arrived, (places, heights))


def _bfgs(inverse: np.ndarray, move: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Update the BFGS matrices, which map the change of the slope to the move; unchanged where the move is not
    concave.
    """
    product = np.sum(move * change, axis=1)
    concave = product > 1e-8 * np.linalg.norm(move, axis=1) * np.linalg.norm(change, axis=1)
    weight = 1 / np.where(concave, product, 1.0)
    across = np.eye(move.shape[1]) - weight[:, None, None] * move[:, :, None] * change[:, None, :]
    new = across @ inverse @ across.swapaxes(1, 2) + weight[:, None, None] * move[:, :, None] * move[:, None, :]
    return np.where(concave[:, None, None], new, inverse)


def _given_up(number: int, points: np.ndarray, values: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Return which climbers are far below the best of their group after so many rounds, or beside a higher one."""
    alike = group[:, None] == group
    below = np.where(alike, values, -np.inf).max(axis=1) - values
    hopeless = np.any([(number >= rounds) & (below > depth) for rounds, depth in _HOPELESS], axis=0)
    if number >= _HOPELESS[0][0]:
        order = np.arange(values.size)
        higher = (values > values[:, None]) | ((values == values[:, None]) & (order < order[:, None]))
        near = np.max(np.abs(points[:, None] - points), axis=2) < _SAME
        hopeless |= (alike & higher & near).any(axis=1)
    return hopeless


def _finite(values, slopes) -> tuple[np.ndarray, np.ndarray]:
    """Replace values at points with NaN or infinity by `_NOWHERE`, and their slopes by zero."""
    values, slopes = np.array(values, float), np.array(slopes, float)
    bad = ~np.isfinite(values) | ~np.isfinite(slopes).all(axis=1)
    return np.where(bad, _NOWHERE, values), np.where(bad[:, None], 0.0, slopes)
