"""Find the smallest change of a record with which the margins of blocks reach their targets: a design-point search.

Along a direction of change there is a first length at which the targets are reached; computing it needs margins alone.
Slopes of the margins then turn the direction. If margins were linear, one turn would lead to the least change (Hasofer
& Lind 1974; Rackwitz & Fiessler 1978). The search turns by that much or less, whichever shortens the length. Verdicts
decide about every step, so that jumps and kinks of margins do not mislead the search.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from jaxrock._arguments.parameters import one_of_many, shared
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.rigid import Block
from jaxrock.compiler.hints import jit_low_effort
from jaxrock.engines.stepper import AbstractEngine
from jaxrock.inverse.batches import in_batches
from jaxrock.models.equation import AbstractEquation
from jaxrock.motions.record import Record
from jaxrock.responses.outcome import outcome
from jaxrock.status import is_decided

_LANES = 64  # records in one call of the compiled program
_SHORTEST, _LONGEST = 1e-4, 1e2  # range of lengths tried first along a direction, over the record's root mean square
_FINE = 1024  # number of scale factors of a record that are tried, each half a per cent above the preceding one
_NOTHING = 1e-10  # share of a change that rounding may leave of it after the projection
_CLOSER = 5  # refinements of the length along a direction, each by a factor of 64
_TURNS = 0.5 ** np.arange(8)  # shares of the turn towards the change that linear margins would need
_SHORTER = np.array([0.7, 0.85, 0.93, 0.97, 0.985, 0.993, 0.997, 0.999])  # lengths tried, over the current one


class Site(eqx.Module):
    """Blocks under a record, and their target margins: at most `target` where `side` is 1, at least where it is -1."""

    blocks: Block | AsymmetricBlock
    samples: Float[Array, " n"]
    dt: Float[ArrayLike, ""]
    side: Float[Array, " blocks"]
    target: Float[Array, " blocks"]
    model: AbstractEquation
    engine: AbstractEngine | None

    def margin(self, block: Block | AsymmetricBlock, change: Float[Array, " n"]):
        """Return the margin of a block under the changed record, and whether its sign is known."""
        record = Record(self.samples + change, self.dt, throw=False)
        result = outcome(block, record, self.model, engine=self.engine, throw=False)
        return result.margin, is_decided(result.status)

    def margins(self, changes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the margins of all blocks under changes, (changes, n), and whether each is known.

        Both results are (changes, blocks). One compiled program serves any number of changes.
        """
        margins, known = in_batches(lambda *part: _margins(self, *part), changes, _LANES)
        return margins, known


@jit_low_effort(eqx.filter_jit, follows_scenes=True)
def _margins(
    site: Site, changes: Float[ArrayLike, "lanes n"], wanted: Bool[ArrayLike, " lanes"]
) -> tuple[Float[Array, "lanes blocks"], Bool[Array, "lanes blocks"]]:
    own = jax.tree.map(lambda whole: None if whole else 0, shared(site.blocks))
    of_all = jax.vmap(site.margin, in_axes=(own, None))

    def of_one(change, wanted):  # a scene under a record of NaN ends at once
        margins, known = of_all(site.blocks, jnp.where(wanted, change, jnp.nan))
        return jnp.where(wanted, margins, 0.0), known & wanted

    return jax.vmap(of_one)(changes, wanted)


@jit_low_effort(eqx.filter_jit, follows_scenes=True)
def _margins_and_slopes(site: Site, change: Float[ArrayLike, " n"]):
    """Return margins of all blocks, (blocks,), and their derivatives by the change, (blocks, n)."""

    def one(number):
        block = one_of_many(site.blocks, number)
        return jax.value_and_grad(lambda change: site.margin(block, change)[0])(change)

    return jax.lax.map(one, jnp.arange(site.side.size))


class Found(NamedTuple):
    """A change that reaches the targets.

    - `direction`: of root mean square 1; `length`: root mean square of the change [g].
    - `lengths`: those after each step of the search.
    - `slope`: largest slope of a margin by a length [1/g], at the last turn.
    """

    direction: np.ndarray
    length: float
    lengths: tuple[float, ...] = ()
    slope: float = np.nan

    @property
    def change(self) -> np.ndarray:
        """The change itself [g]."""
        return self.length * self.direction


class Search(NamedTuple):
    """A site, the root mean square of its record [g], and the projection of changes (..., n) onto those allowed."""

    site: Site
    size: float
    allowed: Callable[[np.ndarray], np.ndarray]

    def reached(self, changes: np.ndarray) -> np.ndarray:
        """Return whether changes, (lanes, n), do what is wanted."""
        margin, known = self.site.margins(changes)
        side, target = np.asarray(self.site.side), np.asarray(self.site.target)
        return ((side * (margin - target) <= 0) & known).all(axis=1)

    def slopes(self, change: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the excess of margins over targets, (blocks,), and slopes by allowed changes, (blocks, n) [1/g]."""
        margin, slopes = map(np.asarray, _margins_and_slopes(self.site, change))
        side = np.asarray(self.site.side)
        slopes = side[:, None] * np.where(np.isfinite(slopes), slopes, 0.0)
        return side * (margin - np.asarray(self.site.target)), self.allowed(slopes)

    def in_direction(self, direction: np.ndarray, fine: bool = False) -> Found | None:
        """Return the shortest tried change in a direction that reaches the targets; None if none does.

        Each trial is a quarter longer than the preceding one. With `fine`, for a change that scales the record, trials
        that make the record half a per cent larger each are added.
        """
        scale = rms(direction)
        if not scale > 0:
            return None
        direction = direction / scale
        lengths = np.geomspace(_SHORTEST, _LONGEST, _LANES)
        if fine:
            lengths = np.union1d(lengths, np.geomspace(1.0, 1.0 + _LONGEST, _FINE)[1:] - 1.0)
        lengths = self.size * lengths
        good = self.reached(lengths[:, None] * direction)
        if not good.any():
            return None
        first = int(np.argmax(good))
        return self._closer(Found(direction, lengths[first]), lengths[first - 1] if first else 0.0)

    def _closer(self, found: Found, below: float) -> Found:
        """Refine the length to where the change just reaches the targets; at the length `below` it does not."""
        above = found.length
        for _ in range(_CLOSER):
            lengths = np.linspace(below, above, _LANES + 1)[1:]
            good = self.reached(lengths[:, None] * found.direction)
            good[-1] = True
            first = int(np.argmax(good))
            below, above = lengths[first - 1] if first else below, lengths[first]
        return found._replace(length=float(above))

    def nearer(self, found: Found, steps: int, progress: Callable[[], None] = lambda: None) -> Found:
        """Return a shorter change that reaches the same targets.

        The search turns it, at most `steps` times, until no direction tried shortens it by a thousandth.
        """
        lengths, slope = [found.length], np.nan
        for _ in range(steps):
            excess, slopes = self.slopes(found.change)
            slope = float(rms(slopes).max()) * slopes.shape[1]
            straight = least_change(slopes, slopes @ found.change - excess)
            progress()
            if straight is None:
                break
            turned = (1 - _TURNS[:, None]) * found.change + _TURNS[:, None] * straight
            turned = turned / np.maximum(rms(turned), 1e-300)[:, None]
            shorter = found.length * _SHORTER
            tried = self.reached((turned[:, None] * shorter[:, None]).reshape(-1, turned.shape[1]))
            good = tried.reshape(_TURNS.size, _SHORTER.size)
            if not good.any():
                break
            best = np.where(good.any(axis=1), good.argmax(axis=1), _SHORTER.size)
            turn = int(np.argmin(best))
            found = found._replace(direction=turned[turn], length=float(shorter[best[turn]]))
            lengths.append(found.length)
        return self._to_the_verge(found)._replace(lengths=tuple(lengths), slope=slope)

    def _to_the_verge(self, found: Found) -> Found:
        lengths = found.length * np.linspace(0.9, 1.0, _LANES)
        bad = np.flatnonzero(~self.reached(lengths[:, None] * found.direction)[:-1])
        if not bad.size:
            return found
        return self._closer(found._replace(length=lengths[bad[-1] + 1]), lengths[bad[-1]])


def rms(changes: np.ndarray) -> Any:
    """Return root mean squares, (...), of changes (..., n)."""
    return np.sqrt(np.mean(np.square(changes), axis=-1))


def least_change(slopes: np.ndarray, bound: np.ndarray) -> np.ndarray | None:
    """Return the shortest change (n,) with slopes @ change <= bound, for slopes (blocks, n); None if there is none.

    **Source:** Lawson & Hanson (1974), 23.4: least distance programming.
    """
    from scipy.optimize import nnls

    scale = np.linalg.norm(slopes, axis=1)
    if not (scale > 0).all():
        return None
    rows, bound = slopes / scale[:, None], bound / scale
    size = np.abs(bound).max()
    if size == 0:
        return np.zeros(slopes.shape[1])
    matrix = np.vstack([-rows.T, -bound[None] / size])
    weights, _ = nnls(matrix, np.append(np.zeros(rows.shape[1]), 1.0))
    left = matrix @ weights
    left[-1] -= 1.0
    return None if left[-1] > -1e-12 else -left[:-1] / left[-1] * size


def allowed_changes(
    count: int, dt: float, band: tuple[float, float] | None, baseline: bool, kept: np.ndarray | None = None
) -> Callable:
    """Return the orthogonal projection of changes, (..., n), onto the allowed ones.

    Allowed changes lie within a band of frequencies [Hz]. If `baseline`, they preserve velocity and displacement at the
    end of the record. Their products with the rows of `kept`, (rows, n), vanish.
    """
    inside = np.ones(count // 2 + 1, bool)
    if band is not None:
        frequency = np.fft.rfftfreq(count, dt)
        inside = (frequency >= band[0]) & (frequency <= band[1])

    def in_band(changes: np.ndarray) -> np.ndarray:
        return changes if inside.all() else np.fft.irfft(np.fft.rfft(changes, axis=-1) * inside, count, axis=-1)

    fixed = [] if kept is None else [kept]
    if baseline and count >= 4:
        fixed.append(_baseline(count, dt))
    if not fixed:
        return in_band
    _, sizes, rows = np.linalg.svd(in_band(np.concatenate(fixed)), full_matrices=False)
    rows = rows[sizes > 1e-12 * np.sqrt(count)]

    def projected(changes: np.ndarray) -> np.ndarray:
        within = in_band(changes)
        left = within - (within @ rows.T) @ rows
        # Projecting a change that is not allowed at all leaves only rounding errors, which are no direction.
        return np.where(rms(left) > _NOTHING * rms(changes), left.T, 0.0).T

    return projected


def _baseline(count: int, dt: float) -> np.ndarray:
    """Return coefficients of the final velocity and displacement by all samples, (2, n), in arbitrary units."""
    time = dt * np.arange(count)
    velocity, displacement = np.ones(count), time[-1] - time
    # The integrals of straight lines between samples are exact.
    velocity[[0, -1]] = 0.5
    displacement[[0, -1]] = time[-1] / 2 - dt / 6, dt / 6
    return np.stack([velocity, displacement / time[-1]])
