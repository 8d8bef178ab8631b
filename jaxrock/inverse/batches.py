"""Run a program compiled for a fixed number of points at any number of points."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float


def in_batches(
    function: Callable[[Float[np.ndarray, "lanes dimensions"], Bool[np.ndarray, " lanes"]], Sequence],
    points: Float[np.ndarray, "points dimensions"],
    lanes: int,
    progress: Callable[[int], None] = lambda more: None,
) -> list[np.ndarray]:
    """Return the results of `function(points, wanted)`, each (points, ...), computed in batches of `lanes` points.

    The last batch is padded. Padding points are not `wanted`, and `function` need not compute them.
    """
    results = []
    for begin in range(0, len(points), lanes):
        part = points[begin : begin + lanes]
        count = len(part)
        filled_up = np.pad(part, ((0, lanes - count), (0, 0)), mode="edge")
        results.append([np.asarray(x)[:count] for x in function(filled_up, np.arange(lanes) < count)])
        progress(count)
    return [np.concatenate(x) for x in zip(*results)]
