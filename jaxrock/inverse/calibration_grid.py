"""The grid of a calibration: cells over each parameter, their probability weights, and outcomes of the scenes."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr
from jaxtyping import Array, Float

from jaxrock._arguments.parameters import leaves_of, shared
from jaxrock.compiler import checks
from jaxrock.inverse.unknowns import Unknown
from jaxrock.models.equation import AbstractEquation
from jaxrock.studies.parameters import named_of_model
from jaxrock.studies.suite_scenes import TOPPLED, UNDECIDED, Scenes

# Limits of the usual parameters (Housner's restitution does not exist for wider blocks).
_LIMITS = dict.fromkeys(("alpha", "alpha1", "alpha2"), (1e-3, 0.9)) | {"restitution": (0.0, 1.0)}
LEAST_SEEN = 0.01  # peak rotation over slenderness below which an observer sees no motion
_BEYOND = 2.5  # standard deviations by which the grid extends beyond the range of a median


class Axis(eqx.Module):
    """Cells over one parameter, or over its logarithm.

    - `middles`: (cells,) coordinates of the middles; `width`: of a cell.
    - `deviation`: standard deviation of the scatter; None without scatter, or where it is unknown.
    """

    middles: Float[np.ndarray, " cells"]
    width: float
    deviation: float | None
    is_scattered: bool = eqx.field(static=True)
    log: bool = eqx.field(static=True)

    @classmethod
    def of(cls, name: str, unknown: Unknown, scatter, count: int) -> "Axis":
        """Return the cells over a range, extended by the scatter."""
        low, high = (float(x) for x in unknown.ends)
        if scatter is None:  # the outermost middles are the ends of the range: beyond them a likelihood would be flat
            middles = np.linspace(low, high, count)
            return cls(middles, (high - low) / (count - 1), None, False, unknown.log)
        widest = float(scatter.high) if isinstance(scatter, Unknown) else float(scatter)
        low, high = low - _BEYOND * widest, high + _BEYOND * widest
        # Scatter does not extend the grid beyond a parameter's limits, unless the range of the median does.
        ends = [
            np.log(max(end, 1e-300)) if unknown.log else end
            for end in _LIMITS.get(name, (0.0, np.inf) if unknown.log else (-np.inf, np.inf))
        ]
        low, high = max(low, min(ends[0], float(unknown.ends[0]))), min(high, max(ends[1], float(unknown.ends[1])))
        width = (high - low) / count
        known = None if isinstance(scatter, Unknown) else float(scatter)
        return cls(low + width * (np.arange(count) + 0.5), width, known, True, unknown.log)

    @property
    def count(self) -> int:
        """Number of cells."""
        return self.middles.size

    @property
    def values(self) -> np.ndarray:
        """The parameter in the middle of each cell."""
        return np.exp(self.middles) if self.log else self.middles

    def weights(self, values: dict, name: str) -> Float[Array, " cells"]:
        """Return the probability of the distribution in each cell; the end cells include the tails beyond the grid.

        Without scatter, return Catmull-Rom weights of the cells around the value; they are differentiable everywhere.
        """
        place = jnp.log(values[name]) if self.log else values[name]
        if not self.is_scattered:
            # At an end rounding may put the value on either side: use the slope of the inside there.
            known = jax.lax.stop_gradient(place)
            place = place + (jnp.clip(known, self.middles[0], self.middles[-1]) - known)
            return self._by_cubics((place - self.middles[0]) / self.width)
        deviation = values[f"{name}_sd"] if self.deviation is None else self.deviation
        edges = self.middles[:-1] + self.width / 2
        below = ndtr((edges - place) / deviation)
        return jnp.diff(jnp.concatenate([jnp.zeros(1), below, jnp.ones(1)]))

    def _by_cubics(self, place: Array) -> Float[Array, " cells"]:
        """Return cubic weights of the cells around a place, which is counted in cells from the first."""
        x = jnp.abs(place - np.arange(-1.0, self.count + 1))
        near, far = 1 - 2.5 * x**2 + 1.5 * x**3, 2 - 4 * x + 2.5 * x**2 - 0.5 * x**3
        found = jnp.where(x < 1, near, jnp.where(x < 2, far, 0.0))
        # Values before the first and after the last cell are extrapolated linearly: 2 f[0] - f[1].
        outer = jnp.stack([2 * found[0], -found[0], -found[-1], 2 * found[-1]])
        return found[1:-1].at[np.array([0, 1, -2, -1])].add(outer)


def _of_cells(axes: dict[str, Axis]) -> dict[str, np.ndarray]:
    """Return the parameters in all cells, the last one changing fastest."""
    grid = np.meshgrid(*(axis.values for axis in axes.values()), indexing="ij")
    return {name: x.ravel() for name, x in zip(axes, grid)}


def model_of_cells(model: AbstractEquation, axes: dict[str, Axis]) -> dict[str, np.ndarray]:
    """Return the parameters of the model in all cells: those whose names begin with "model."."""
    found, own = {name: x for name, x in _of_cells(axes).items() if _is_of_model(name)}, named_of_model(model)
    unknown = [name for name in found if name not in own]
    if unknown:
        said = f"name parameters of `model`, which has {', '.join(own) or 'none'}, but names {unknown[0]!r}"
        raise ValueError(f"Argument `unknowns` must {said}.")
    return found


def _is_of_model(name: str) -> bool:
    return name.startswith("model.")


def blocks_of_cells(block: Callable, axes: dict[str, Axis]) -> Any:
    """Return the blocks of all cells, the last parameter changing fastest; shared leaves are stored once."""
    cells = _of_cells(axes)
    grid = {name: x for name, x in cells.items() if not _is_of_model(name)}
    made = checks.with_checks(lambda *each: block(**dict(zip(grid, each))))
    numbers = jnp.arange(next(iter(cells.values())).size)  # the block may be known
    try:
        found = jax.vmap(lambda number, *each: made(*each))(numbers, *map(jnp.asarray, grid.values()))
    except TypeError as error:
        raise ValueError(f"Argument `block` must make a block of {sorted(grid)}, but: {error}.") from error
    for message, failed in zip(found.messages, found.failed):
        _check_cells(message, np.asarray(failed), grid or {"cell": np.asarray(numbers)})
    blocks = found.results
    for leaf in leaves_of(blocks):
        if leaf.is_shared and not _is_one(np.asarray(leaf.value)):
            axes = leaf.declared.axes
            said = f"declares its parameters (`jaxrock.parameter`), but `{leaf.name}` is not declared, and differs"
            if axes is not None:
                said = f"shares its lists, but `{leaf.name}` is declared as one (axes={axes}), and differs"
            raise ValueError(f"Argument `block` must make blocks of a class that {said} from cell to cell.")
    return jax.tree.map(lambda x, own: x[0] if own else x, blocks, shared(blocks))


def _check_cells(message: str, failed: np.ndarray, grid: dict[str, np.ndarray]) -> None:
    """Raise ValueError where a check of the block has failed, naming the first such cell by its parameters."""
    failed = np.broadcast_to(failed, next(iter(grid.values())).size)
    cells = np.flatnonzero(failed)
    if cells.size:
        at = ", ".join(f"{name} = {values.ravel()[cells[0]]:.4g}" for name, values in grid.items())
        raise ValueError(
            f"Argument `block` must make a block in every cell of the grid, but fails in {cells.size} of {failed.size}"
            f", the first of which is {at}: {message[0].lower()}{message[1:]}. The grid goes {_BEYOND} of the largest "
            "`scatter` beyond the ranges of `unknowns`."
        )


def _is_one(values: np.ndarray) -> bool:
    """Return whether all cells have the same value; NaN in all cells counts as the same."""
    return np.array_equal(values, np.broadcast_to(values[:1], values.shape), equal_nan=True)


class Table(eqx.Module):
    """Outcomes of the scenes of each test, over the cells.

    - `seen`: (tests,) 1, 0 or -1.
    - `toppled`: (tests, cells, ...) share that topples, counting undecided scenes by the share of their possible
      motions that topples; `lower` and `upper` count none, and all, of these.
    - `density`: (tests, cells, ...) density of the logarithm of the observed rotation, in scenes that stood.
    """

    seen: Float[Array, " tests"]
    toppled: Float[Array, "tests *cells"]
    lower: Float[Array, "tests *cells"]
    upper: Float[Array, "tests *cells"]
    density: Float[Array, "tests *cells"] | None
    has_rotation: np.ndarray | None

    @classmethod
    def of(cls, found: Scenes, seen, ways, told, deviation: float, shape: tuple[int, ...]) -> "Table":
        """Build the table from scenes (tests, orientations, cells), and from the orientation of each test."""
        count = found.verdict.shape[1]
        turned = np.clip(np.where(ways == 0, 0.5, ways < 0), 0, 1) if count > 1 else np.zeros_like(ways)
        mix = np.stack([1 - turned, turned][:count], axis=1)

        def mean(values):
            return jnp.asarray(np.einsum("tw,twc->tc", mix, values).reshape(-1, *shape))

        upper = mean((found.verdict == TOPPLED) | (found.verdict == UNDECIDED))
        lower = mean(found.verdict == TOPPLED)
        density, has = None, None
        if told is not None:
            has = np.isfinite(told)
            with np.errstate(all="ignore"):
                off = (np.log(told)[:, None, None] - np.log(found.rotation)) / deviation
                density = np.exp(-(off**2) / 2) / (deviation * np.sqrt(2 * np.pi))
            still = found.rotation < LEAST_SEEN
            density = mean(np.where((told == 0)[:, None, None], still, np.where(still, 0.0, np.nan_to_num(density))))
        return cls(jnp.asarray(seen), mean(found.share), lower, upper, density, has)


def weighed(shares: Float[Array, "tests *cells"], weights: list) -> Float[Array, " tests"]:
    """Return the weighted means over all axes of cells."""
    for each in reversed(weights):
        shares = shares @ each
    return shares
