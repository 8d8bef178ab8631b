"""The linear block under one cycle of a sine: constants, limits of overturning, peaks, and the islands between them.

Everything is dimensionless: `intensity` is a_g/(g alpha), `frequency_ratio` is omega_g/p, times are p t counted from
*uplift*, rotations are over alpha and velocities over p alpha. The first excursion is to negative rotation.
Arguments broadcast; functions are smooth in all of them.

A block overturns without impact (case 2), after one impact that comes after the pulse (1.2) or while it lasts (1.1),
and, at frequency ratios below about 1, in further islands of intensity, after 3, 5, 7... impacts.

**Source:** Dimitrakopoulos & DeJong (2012), "D&D" below, corrected where `notebooks/errata` says so.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Inexact, Int

from jaxrock._checks import checked, elementwise, positive, share
from jaxrock.closed_form import _sine_arcs as arcs
from jaxrock.numerics.roots import bracketed_root

Real = Inexact[ArrayLike, "..."]
Result = Float[Array, "..."]


def _above_one(name, value):
    return checked(name, value, "be greater than 1 (the block uplifts)", lambda x: (x > 1) & (x < np.inf))


_GRID = 256  # samples that bracket a root of case 1.1
_MOST_DROP = 8  # impacts lost from one sample to the next, where turns are sought one by one

_elementwise = elementwise(intensity=_above_one, frequency_ratio=positive, restitution=share)


class Constants(eqx.Module):
    """The constants of D&D 3.9 (A0*, B0*, C0*, D0*), the phase psi at uplift, and the end p T_ex of the pulse."""

    A0: Result
    B0: Result
    C0: Result
    D0: Result
    phase: Result
    end: Result


@_elementwise
def constants(intensity: Real, frequency_ratio: Real) -> Constants:
    """What all formulas of the sine pulse are made of.

    **Arguments:**

    - `intensity`: a_g/(g alpha), above 1.
    - `frequency_ratio`: omega_g/p, positive.

    **Source:** D&D 3.3, 3.7, 3.9 (D0* by its definition; the second line is printed with a factor to the wrong power).
    """
    a, w = intensity, frequency_ratio
    phase = arcs.uplift_phase(a)
    slope = jnp.sqrt((a - 1) * (a + 1))
    end = (2 * jnp.pi - phase) / w
    A0, B0, C0 = w * (w + slope) / (w**2 + 1), w * (w - slope) / (w**2 + 1), 2 * a / (w**2 + 1)
    decaying, growing = _free_coordinates(A0, B0, C0, w, end)
    return Constants(A0, B0, C0, decaying * growing, phase, end)


@_elementwise
def no_impact_limit(frequency_ratio: Real) -> Result:
    """The intensity from which on a block overturns without impact (case 2), whatever its restitution.

    **Source:** D&D 3.10.
    """
    return _no_impact_limit(frequency_ratio)


@_elementwise
def impact_time_limit(frequency_ratio: Real) -> Result:
    """The intensity at which the first impact comes just as the pulse ends; above it, later.

    **Source:** D&D 3.31.
    """
    return _impact_time_limit(frequency_ratio)


@_elementwise
def after_pulse_limits(frequency_ratio: Real, restitution: Real) -> tuple[Result, Result]:
    """The two intensities between which a block overturns after one impact that comes after the pulse (case 1.2).

    **Returns:** (lower, upper); lower is `impact_time_limit` where the interval goes on below it; both inf where
    there is no such interval.

    **Source:** D&D 3.18, searched only where it holds: between 3.31 and 3.10.
    """
    first, last = _impact_time_limit(frequency_ratio), _no_impact_limit(frequency_ratio)

    def excess(a, w, e):
        return e**2 * (1 - _product(a, w)) - 1

    # 1 - D0* rises to one maximum and falls to 1 at the upper limit.
    inner = (jnp.sqrt(5.0) - 1) / 2

    def narrow(_, bracket):
        low, high = bracket
        left, right = high - inner * (high - low), low + inner * (high - low)
        better = excess(left, frequency_ratio, restitution) > excess(right, frequency_ratio, restitution)
        return jnp.where(better, low, left), jnp.where(better, right, high)

    top = sum(jax.lax.fori_loop(0, 60, narrow, (jax.lax.stop_gradient(first), jax.lax.stop_gradient(last)))) / 2
    exists = excess(top, frequency_ratio, restitution) > 0
    upper = bracketed_root(excess, top, last, frequency_ratio, restitution)
    begins = excess(first, frequency_ratio, restitution) < 0
    lower = bracketed_root(excess, first, top, frequency_ratio, restitution)
    return jnp.where(exists, jnp.where(begins, lower, first), jnp.inf), jnp.where(exists, upper, jnp.inf)


@_elementwise
def during_pulse_limit(frequency_ratio: Real, restitution: Real) -> Result:
    """The intensity from which on, up to `impact_time_limit`, one impact during the pulse overturns a block (case 1.1).

    **Returns:** the intensity; inf where there is no such interval.

    **Source:** D&D 3.20 and 3.21 (the "numerical" curve of figure 3), with the first root of 3.21.
    """
    last = _impact_time_limit(frequency_ratio)

    def excess(a, w, e):
        return _growth_after_impact(a, w, e, _impact_during_pulse(a, w))

    return _topmost_root(excess, last, frequency_ratio, restitution)


@_elementwise
def approximate_during_pulse_limit(frequency_ratio: Real, restitution: Real) -> Result:
    """Case 1.1 without a transcendental equation: D&D's approximation of `during_pulse_limit`.

    Within 1 % for frequency ratios between 2.5 and 4 and restitutions of 0.8 to 0.96; below 2 it is 2 to 6 % low,
    near the upper end of the curve (above 4) up to 8 % high. **Returns:** inf where it has no root.

    **Source:** D&D 3.30 with 3.29.
    """
    last = _impact_time_limit(frequency_ratio)

    def excess(a, w, e):
        return _growth_after_impact(a, w, e, _approximate_impact_time(a, w), jump=True)

    return _topmost_root(excess, last, frequency_ratio, restitution)


@_elementwise
def impact_time(intensity: Real, frequency_ratio: Real) -> Result:
    """When the block first falls back to the ground, p t from uplift; inf where it overturns before.

    **Source:** D&D 3.21 (while the pulse lasts), 3.13 (after it).
    """
    a, w = intensity, frequency_ratio
    limit, lost = _impact_time_limit(w), _no_impact_limit(w)
    middle = (limit + lost) / 2
    after = jnp.where((a > limit) & (a < lost), a, middle)
    decaying, growing = _free_coordinates(*_series_constants(after, w))
    late = _end(after, w) + jnp.log((1 + jnp.sqrt(1 - decaying * growing)) / growing)  # 3.13 from the pulse's end
    early = _impact_during_pulse(jnp.where(a > limit, (1 + limit) / 2, a), w)
    return jnp.where(a < limit, early, jnp.where(a < lost, late, jnp.inf))


@_elementwise
def approximate_impact_time(intensity: Real, frequency_ratio: Real) -> Result:
    """D&D's approximation of `impact_time` while the pulse lasts; not a number where the formula is not real.

    **Source:** D&D 3.29.
    """
    return _approximate_impact_time(intensity, frequency_ratio)


@_elementwise
def peak_after_pulse(intensity: Real, frequency_ratio: Real, restitution: Real) -> Result:
    """The largest rotation over alpha after the first impact, where that comes after the pulse.

    Exact between `impact_time_limit` and `no_impact_limit`, and no result below (there D&D draw it dashed). The first
    excursion, before the impact, may be larger: see `first_peak`. **Returns:** inf where that impact overturns.

    **Source:** D&D 4.13, with D0* by its definition.
    """
    lost = restitution**2 * (1 - _product(intensity, frequency_ratio))
    left = 1 - jnp.where(lost < 1, lost, 0.0)
    return jnp.where(lost < 1, 1 - jnp.sqrt(left), jnp.inf)


@_elementwise
def restitution_scale_law(intensity: Real, frequency_ratio: Real, restitution: Real) -> Result:
    """`peak_after_pulse` for small peaks: proportional to the square of the restitution.

    **Source:** D&D 4.14 corrected: restitution^2 (1 - D0*)/2, without the square root that is printed.
    """
    return restitution**2 * (1 - _product(intensity, frequency_ratio)) / 2


@_elementwise
def first_peak(intensity: Real, frequency_ratio: Real) -> Result:
    """The largest rotation over alpha before the first impact; inf where the block overturns without impact.

    **Source:** D&D 3.4, 3.5 where the velocity is zero.
    """
    a, w = intensity, frequency_ratio
    safe = a < _no_impact_limit(w)
    a = jnp.where(safe, a, (1 + _no_impact_limit(w)) / 2)
    end = _end(a, w)
    outward = _state(end, a, w)[1] > 0
    peak_while = bracketed_root(lambda t, a, w: _state(t, a, w)[1], (jnp.pi - 2 * arcs.uplift_phase(a)) / w, end, a, w)
    opening, speed = _state(jnp.where(outward, end, peak_while), a, w)
    gap = (1 - opening - jnp.where(outward, speed, 0.0)) * (1 - opening + jnp.where(outward, speed, 0.0))
    free = 1 - jnp.sqrt(jnp.where(outward, gap, 1.0))
    return jnp.where(safe, jnp.where(outward, free, opening), jnp.inf)


class OverturningIntervals(eqx.Module):
    """The intensities that overturn a block, from the lowest: everything between `lower` and `upper`.

    - `impacts`: before overturning, in the middle of the interval.
    Without loss (restitution 1) the safe gap below the last interval closes, and it touches the one before.
    - `searched_from`: below this intensity nothing was searched.
    """

    lower: Float[np.ndarray, " n"]
    upper: Float[np.ndarray, " n"]
    impacts: Int[np.ndarray, " n"]
    searched_from: float


def overturning_intervals(
    frequency_ratio: float, restitution: float, *, searched_from: float = 1.0001, points: int = 4096
) -> OverturningIntervals:
    """Every interval of intensity that overturns a block, the islands with 3, 5, 7... impacts included.

    **Arguments:**

    - `frequency_ratio`: omega_g/p, positive. `restitution`: in [0, 1].
    - `searched_from`: lowest intensity searched, above 1.
    - `points`: samples of the search below `impact_time_limit`. Narrower islands and gaps are found where the number
      of impacts changes with them, as it did wherever this was checked.

    **Returns:** `OverturningIntervals`; the ends are roots to rounding.

    **Source:** D&D 3.10, 3.18, 3.20 and, for more impacts, the same condition after each arc in closed form; what
    the paper calls complete covers frequency ratios above 1.05 only.
    """
    ratio = float(positive("frequency_ratio", frequency_ratio))
    restitution = float(share("restitution", restitution))
    limit, last = float(impact_time_limit(ratio)), float(no_impact_limit(ratio))
    samples = np.linspace(searched_from, max(limit * (1 - 1e-13), searched_from), points)
    values, impacts = _at(samples, ratio, restitution)
    # Where the number of impacts changes there is an island or a gap, however narrow; else it is near an extreme.
    turns = _impact_turns(samples, impacts, ratio, restitution)
    step = (limit - searched_from) / points * np.linspace(-1, 1, 129)
    more = [turns, _inside(turns, samples[1] - samples[0]), (samples[_near_zero(values), None] + step).ravel()]
    more = np.clip(np.concatenate(more), searched_from, samples[-1])
    samples, order = np.unique(np.concatenate([samples, more]), return_index=True)
    values = np.concatenate([values, _at(more, ratio, restitution)[0]])[order]
    lost = values > 0
    change = np.flatnonzero(lost[1:] != lost[:-1])

    def unchanged(points):
        return (_at(points, ratio, restitution)[0] > 0) == lost[change][:, None]

    ends = sum(_narrowed(samples[change], samples[change + 1], unchanged, 17)) / 2
    lower, upper = list(ends[~lost[change]]), list(ends[lost[change]])
    if lost[0]:
        lower.insert(0, searched_from)
    begins, stops = (float(x) for x in after_pulse_limits(ratio, restitution))
    if lost[-1]:
        upper.append(stops if np.isfinite(stops) else limit)
    elif np.isfinite(stops):
        lower.append(begins)
        upper.append(stops)
    middle = np.minimum((np.array(lower) + np.array(upper)) / 2, np.nextafter(last, 0))
    impacts = _at(middle, ratio, restitution)[1]
    return OverturningIntervals(
        np.array([*lower, last]), np.array([*upper, np.inf]), np.array([*impacts, 0]), float(searched_from)
    )


# ---- The mathematics ----


def _end(a: Array, w: Array) -> Array:
    """p T_ex."""
    return (2 * jnp.pi - arcs.uplift_phase(a)) / w


def _series_constants(a: Array, w: Array) -> tuple[Array, ...]:
    """A0*, B0*, C0*, omega, p T_ex; D&D 3.9."""
    slope = jnp.sqrt((a - 1) * (a + 1))
    return w * (w + slope) / (w**2 + 1), w * (w - slope) / (w**2 + 1), 2 * a / (w**2 + 1), w, _end(a, w)


def _free_coordinates(A0, B0, C0, w, end) -> tuple[Array, Array]:
    """1 - |rotation| +- velocity at the end of the pulse: the factors of D0*, each with its exponential."""
    return A0 * jnp.exp(-end) - w * C0 / 2, B0 * jnp.exp(end) + w * C0 / 2


def _product(a: Array, w: Array) -> Array:
    """D0*; D&D 3.9, first line."""
    decaying, growing = _free_coordinates(*_series_constants(a, w))
    return decaying * growing


def _no_impact_limit(w: Array) -> Array:
    def excess(slope, w):
        a = jnp.sqrt(1 + slope**2)
        return slope - w - a * jnp.exp(-(2 * jnp.pi - jnp.arctan2(1.0, slope)) / w)  # D&D 3.10

    decay = jnp.exp(-1.5 * jnp.pi / w)
    # (1 - decay) slope is at most omega + decay, because psi is at most pi/2
    slope = bracketed_root(excess, w, (w + decay) / -jnp.expm1(-1.5 * jnp.pi / w), w)
    return jnp.sqrt(1 + slope**2)


def _impact_time_limit(w: Array) -> Array:
    def excess(logarithm, w):
        missing = jnp.exp(logarithm)
        slope = w - missing
        side = 1 + w**2 + jnp.sqrt(1 + (2 + slope**2) * w**2)
        return logarithm + (2 * jnp.pi - jnp.arctan2(1.0, slope)) / w - jnp.log(side / w)  # D&D 3.31

    # The slope is near omega where omega is small: what is missing is found by its logarithm.
    lowest = jnp.log((1 + w**2) / w) - 2 * jnp.pi / w - 1
    missing = jnp.exp(bracketed_root(excess, lowest, jnp.log(w), w))
    return jnp.sqrt(1 + (w - missing) ** 2)


def _state(time: Array, a: Array, w: Array) -> tuple[Array, Array]:
    """Opening and speed of the first excursion; D&D 3.4."""
    return arcs.arc(time, arcs.start(a), a, w)


def _impact_during_pulse(a: Array, w: Array) -> Array:
    """First root of D&D 3.21: the block can only fall after the driving stretch, and then falls once."""
    lower = (jnp.pi - 2 * arcs.uplift_phase(a)) / w
    return bracketed_root(lambda t, a, w: _state(t, a, w)[0], lower, _end(a, w), a, w)


def _growth_after_impact(a: Array, w: Array, e: Array, time: Array, jump: bool = False) -> Array:
    """Left minus right side of D&D 3.20, over 2 e^(p T_ex - time): positive where one impact overturns."""
    A0, B0, C0, _, end = _series_constants(a, w)
    angle = w * time + arcs.uplift_phase(a)
    if jump:  # 3.22 as it stands: an approximate time is not a zero of the rotation
        twice_speed = B0 * jnp.exp(time) - A0 * jnp.exp(-time) + C0 * w * jnp.cos(angle)
    else:
        twice_speed = -2 * _state(time, a, w)[1]
    after = e * twice_speed + C0 * (w * jnp.exp(time - end) - w * jnp.cos(angle) - jnp.sin(angle)) - 2
    return after / 2


def _approximate_impact_time(a: Array, w: Array) -> Array:
    """D&D 3.29, with kappa and lambda of 3.26."""
    A0, B0, C0, _, _ = _series_constants(a, w)
    angle = w + arcs.uplift_phase(a)
    sine, cosine = jnp.sin(angle), jnp.cos(angle)
    falling = A0 - C0 * jnp.e * w / 2 * (cosine + w * sine)
    rising = B0 + C0 * w / (2 * jnp.e) * (cosine - w * sine)
    offset = 1 - a * sine
    square = offset**2 - falling * rising
    ratio = (offset + jnp.sqrt(jnp.maximum(square, 0.0))) / rising
    return jnp.where((square >= 0) & (ratio > 0), jnp.log(jnp.where(ratio > 0, ratio, 1.0)), jnp.nan)


def _topmost_root(excess, last: Array, w: Array, e: Array) -> Array:
    """The highest intensity up to `last` at which `excess` turns positive; inf if there is none."""
    share = jnp.linspace(0, 1, _GRID + 1)[1:].reshape(-1, *[1] * last.ndim)
    grid = 1 + (jax.lax.stop_gradient(last) - 1) * share**2
    positive = excess(grid, *(jnp.broadcast_to(x, grid.shape) for x in (w, e))) > 0
    turns = jnp.where(positive[1:] & ~positive[:-1], jnp.arange(_GRID - 1).reshape(share[1:].shape), -1)
    index = jnp.max(turns, axis=0)[None]
    lower, upper = (jnp.take_along_axis(grid, jnp.maximum(index, 0) + k, 0)[0] for k in (0, 1))
    return jnp.where(index[0] >= 0, bracketed_root(excess, lower, upper, w, e), jnp.inf)


def _impact_turns(samples: np.ndarray, impacts: np.ndarray, ratio, restitution) -> np.ndarray:
    """Both sides of the intensities at which the number of impacts falls, each to rounding."""
    drop = impacts[:-1] - impacts[1:]
    pairs = np.flatnonzero((drop > 0) & (drop <= _MOST_DROP))
    levels = [(i, level) for i in pairs for level in range(impacts[i + 1], impacts[i])]
    if not levels:
        return np.zeros(0)
    index, level = np.array(levels).T

    def more(points):
        return _at(points, ratio, restitution)[1] > level[:, None]

    return np.unique(np.concatenate(_narrowed(samples[index], samples[index + 1], more, 9)))


def _at(points: np.ndarray, ratio: float, restitution: float) -> tuple[np.ndarray, np.ndarray]:
    """`growth` at the end of the pulse, and the impacts before overturning, at points of any shape."""
    if not points.size:
        return np.zeros(points.shape), np.zeros(points.shape, int)
    end = arcs.follow(points.ravel(), ratio, restitution)
    directly = end.opening + end.speed > 1
    return arcs.growth(end, restitution).reshape(points.shape), (end.impacts + ~directly).reshape(points.shape)


def _narrowed(below, above, like_below, levels: int) -> tuple[np.ndarray, np.ndarray]:
    """Brackets of a change, each cut into 9 at every level."""
    rows = np.arange(below.size)
    for _ in range(levels):
        grid = below[:, None] + (above - below)[:, None] * np.linspace(0, 1, 10)
        first = np.cumprod(like_below(grid[:, 1:-1]), axis=1).sum(axis=1)
        below, above = grid[rows, first], grid[rows, first + 1]
    return below, above


def _inside(turns: np.ndarray, widest: float) -> np.ndarray:
    """Samples between neighbouring turns that lie within one step of the search."""
    gaps = np.diff(turns)
    narrow = gaps < widest
    return (turns[:-1, None] + gaps[:, None] * np.linspace(0, 1, 33)[1:-1])[narrow].ravel()


def _near_zero(values: np.ndarray) -> np.ndarray:
    """Samples that are local extremes towards zero."""
    size, sign = np.abs(values), np.sign(values)
    lowest = (size[1:-1] <= size[:-2]) & (size[1:-1] <= size[2:]) & (size[1:-1] < 0.3)
    return 1 + np.flatnonzero(lowest & (sign[1:-1] == sign[:-2]) & (sign[1:-1] == sign[2:]))
