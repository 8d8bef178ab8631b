"""Any number of points for a program that is compiled for so many."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float


def in_batches(
    function: Callable[[Float[np.ndarray, "lanes dimensions"], Bool[np.ndarray, " lanes"]], Sequence],
    points: Float[np.ndarray, "points dimensions"],
    lanes: int,
    progress: Callable[[int], None] = lambda more: None,
) -> list[np.ndarray]:
    """Results of `function(points, wanted)`, each (points, ...): it is called with so many points (`lanes`) at a time,
    of which those that are not `wanted` fill up the last ones, and need not be computed."""
    results = []
    for begin in range(0, len(points), lanes):
        part = points[begin : begin + lanes]
        count = len(part)
        filled_up = np.pad(part, ((0, lanes - count), (0, 0)), mode="edge")
        results.append([np.asarray(x)[:count] for x in function(filled_up, np.arange(lanes) < count)])
        progress(count)
    return [np.concatenate(x) for x in zip(*results)]
