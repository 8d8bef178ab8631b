"""Any number of points for a program that is compiled for so many."""

from collections.abc import Callable

import jax
import numpy as np
from jaxtyping import Float


def in_batches(
    function: Callable[[np.ndarray], list],
    points: Float[np.ndarray, "points dimensions"],
    lanes: int,
    progress: Callable[[int], None] = lambda more: None,
) -> list[np.ndarray]:
    """Results of `function`, each (points, ...): it is called with so many points (`lanes`) at a time."""
    results = []
    for begin in range(0, len(points), lanes):
        part = points[begin : begin + lanes]
        results.append([np.asarray(x)[: len(part)] for x in function(_filled_up(part, lanes))])
        progress(len(part))
    return [np.concatenate(x) for x in zip(*results)]


def _filled_up(points: np.ndarray, lanes: int) -> np.ndarray:
    """Points, and as many that are no numbers as there is room for: a scene of those ends at once. Where JAX stops at
    what is no number these are copies, which take as long as the last point does."""
    filling = {"mode": "edge"} if jax.config.jax_debug_nans else {"constant_values": np.nan}
    return np.pad(points, ((0, lanes - len(points)), (0, 0)), **filling)
