"""Groups of states that have come together, and the periodic orbits among them."""

from collections.abc import Callable

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

_NEAR = 1e-4  # distance of states that count as one, over the slenderness
_WIDE = 4 * _NEAR  # distance from the state that stands for such states
_EQUAL = 1e-6  # distance from its start at which an orbit comes back
_LONGER = 10  # times the periods in which a state that stands for others settles
_LONGEST = 64  # periods of an orbit that is found
AWAY = 1e9  # rotation and velocity that stand for a state that overturned or was not computed


def orbits_of(states: np.ndarray, periods: int, images: Callable, eps: float) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the number of the orbit on which each state settles, from 1 on, and the orbits, the most frequent first.

    **Arguments:**

    - `states`: (n, 2), in units in which they are of order 1.
    - `periods`: after which they were found.
    - `images`: returns the states after numbers of periods from states, `AWAY` for a block that has no state then.
    - `eps`: rounding unit of the states.

    **Returns:** (n,) numbers, 0 of states that do not settle; (period, 2) states of each orbit.
    """
    places, group = _grouped(states)
    # A few states stand for all: these have time to settle.
    late = images(places, np.full(len(places), _LONGER * periods, np.int32))
    settled, later = _grouped(late)
    cycles = _cycles(settled, images, max(_EQUAL, 64 * eps))
    number = np.full(len(settled), -1)
    for k, cycle in enumerate(cycles):
        number[cycle] = k
    number = np.where(_is_near(late, settled[later]), number[later], -1)
    label = np.where(_is_near(states, places[group]), number[group], -1)
    counts = np.bincount(label[label >= 0], minlength=len(cycles))
    order = np.argsort(-counts, stable=True)
    rank = np.zeros(len(cycles) + 1, int)  # the last for states that have not settled
    rank[order] = np.arange(1, len(cycles) + 1)
    return rank[label], [settled[cycles[k]] for k in order]


def _is_near(states: np.ndarray, others: np.ndarray) -> np.ndarray:
    return np.abs(states - others).max(axis=1) <= _WIDE


def _cycles(places: np.ndarray, images: Callable, equal: float) -> list[list[int]]:
    """Return the groups of each periodic orbit among groups of states, in the order of its periods."""
    away, target = KDTree(places).query(images(places, np.ones(len(places), np.int32)))
    target, cycles = np.where(away <= _WIDE, target, -1), []
    seen = np.zeros(len(places), bool)
    for begin in range(len(places)):
        found = [] if seen[begin] else _cycle(target, begin)
        seen[found] = True
        cycles += [found] if found else []
    if not cycles:
        return []
    # On a slow way to an orbit, states come close to themselves without coming back.
    starts = places[[cycle[0] for cycle in cycles]]
    back = images(starts, np.array([len(cycle) for cycle in cycles], np.int32))
    off = np.where(np.abs(starts).max(axis=1) < AWAY, np.abs(back - starts).max(axis=1), np.inf)
    return [cycle for cycle, missed in zip(cycles, off) if missed <= equal]


def _grouped(states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the most frequent state of each group of states near each other, and the group of every state."""
    cells, cell, counts = np.unique(np.round(states / _NEAR), axis=0, return_inverse=True, return_counts=True)
    cell = cell.reshape(-1)
    pairs = KDTree(cells).query_pairs(1.5, output_type="ndarray")
    near = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(cells), len(cells)))
    groups, group = connected_components(near, directed=False)
    order = np.lexsort((-counts, group))
    firsts = order[np.searchsorted(group[order], np.arange(groups))]
    member = np.empty(len(cells), int)
    member[cell[::-1]] = np.arange(len(states))[::-1]  # the first state of each cell
    return states[member[firsts]], group[cell]


def _cycle(target: np.ndarray, begin: int) -> list[int]:
    """Return the groups through which a group comes back to itself; an empty list if it does not."""
    found, at = [begin], target[begin]
    while at >= 0 and at != begin and len(found) < _LONGEST:
        found.append(int(at))
        at = target[at]
    return found if at == begin else []
