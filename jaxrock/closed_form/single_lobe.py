"""The single-lobe pulse in closed form: the linear block under one hump of any shape, from rectangle to spike.

Everything is dimensionless. `uplift_strength` is g alpha/A_g (1/intensity): below 1 the block uplifts. `pulse_duration`
is p t_d. `shape` runs from -inf (rectangle) through 0 (triangle) to +inf (spike, which moves nothing). Times are in
t_d, rotations in alpha, velocities in p alpha. As in the paper, and unlike the rest of jaxrock, a positive pulse drives
positive rotation. Arguments broadcast; all functions are smooth in all of them.

The motion is written with divided differences of the exponential in place of the paper's sums, so that it has no
singularities at shape 0 and duration 2 |shape|, and nothing cancels.

**Source:** Voyagaki, Psycharis & Mylonakis (2012), "V" below.
"""

import enum

import jax.numpy as jnp
from jaxtyping import Array, Int

from jaxrock._arguments.ranges import not_nan, positive
from jaxrock._core.types import Floats, RealLike
from jaxrock.compiler import elementwise
from jaxrock.numerics.divided_differences import exponential_difference, growth_ratio, logarithm_ratio
from jaxrock.numerics.roots import bracketed_root

__all__ = [
    "Region", "critical_duration", "critical_shape", "falling_wall", "peak_border", "peak_rotation",
    "peak_time", "pulse", "region", "rising_wall", "rotation", "safety_wall", "uplift_time", "velocity",
]  # fmt: skip


def __dir__() -> list[str]:
    return __all__


_MOST_SHAPE = 1e17  # beyond, the pulse is its limit to rounding
_STEEP = 30.0  # beyond, exponentials of -shape enter the sums at other places


class Region(enum.IntEnum):
    """The outcome of a block, as in V figures 3.1 to 3.3."""

    overturns_while_rising = 1  # O1: past alpha before the pulse has its peak
    overturns_while_falling = 2  # O2: past alpha before the pulse ends
    overturns_after = 3  # O3
    peaks_after = 4  # S2: safe, largest rotation after the pulse
    peaks_during = 5  # S1: safe, largest rotation while the pulse falls
    at_rest = 6  # never uplifts


_elementwise = elementwise(uplift_strength=positive, pulse_duration=positive, shape=not_nan, time=not_nan)


@_elementwise
def pulse(time: RealLike, shape: RealLike) -> Floats:
    """Ground acceleration over its peak.

    **Arguments:**

    - `time`: in t_d; outside [0, 1] the ground is quiet.
    - `shape`: from -inf to +inf.

    **Source:** V 2.1.
    """
    shape = _clipped(shape)
    foot = jnp.clip(jnp.minimum(time, 1 - time), 0.0, 0.5)  # distance from the nearer foot
    up, down = _parts(shape)
    falling = 2 * foot * growth_ratio(2 * down * foot) / growth_ratio(down)
    rising = 2 * foot * jnp.exp(-up * (1 - 2 * foot)) * growth_ratio(-2 * up * foot) / growth_ratio(-up)
    inside = (time > 0) & (time < 1)
    # At -inf the hump has vertical sides, at +inf it has no width.
    return jnp.where(inside, jnp.where(shape >= 0, rising, falling), 0.0)


@_elementwise
def uplift_time(uplift_strength: RealLike, shape: RealLike) -> Floats:
    """Time at which the block uplifts [t_d]; inf where it does not.

    **Source:** V 2.4.
    """
    time, _ = _uplift(uplift_strength, _clipped(shape))
    return jnp.where(uplift_strength < 1, time, jnp.inf)


@_elementwise
def safety_wall(pulse_duration: RealLike, shape: RealLike) -> Floats:
    """Uplift strength below which a block overturns, at any restitution.

    **Arguments:**

    - `pulse_duration`: p t_d, positive.
    - `shape`: from -inf to +inf.

    **Source:** V 3.12, 3.13, 3.14, in one form that holds for every shape.
    """
    return _safety_wall(pulse_duration, _clipped(shape))


@_elementwise
def rising_wall(pulse_duration: RealLike, shape: RealLike) -> Floats:
    """Uplift strength below which a block is past alpha before the pulse has its peak: between O1 and O2.

    **Source:** V 3.8b, 3.9b, 3.10b.
    """
    shape = _clipped(shape)
    wall = _safety_wall(pulse_duration, shape)
    return bracketed_root(_missing_at_middle, 0 * wall, wall, pulse_duration, shape)


@_elementwise
def falling_wall(pulse_duration: RealLike, shape: RealLike) -> Floats:
    """Uplift strength below which a block is past alpha before the pulse ends: between O2 and O3.

    **Source:** V 3.8a (without the term -f^2 that is printed on its right), 3.9a, 3.10a corrected.
    """
    shape = _clipped(shape)
    wall = _safety_wall(pulse_duration, shape)
    return bracketed_root(_missing_at_end, 0 * wall, wall, pulse_duration, shape)


@_elementwise
def peak_border(pulse_duration: RealLike, shape: RealLike) -> Floats:
    """Uplift strength at which a block has its largest rotation just as the pulse ends: between S2 and S1.

    **Source:** V 3.15a at time 1.
    """
    shape = _clipped(shape)
    wall = _safety_wall(pulse_duration, shape)
    return bracketed_root(_speed_at_end, wall, jnp.ones_like(wall), pulse_duration, shape)


@_elementwise
def rotation(time: RealLike, uplift_strength: RealLike, pulse_duration: RealLike, shape: RealLike) -> Floats:
    """Rotation over alpha, from the start of the pulse to the block's first return to the ground.

    **Arguments:**

    - `time`: in t_d.
    - `uplift_strength`: g alpha/A_g, positive.
    - `pulse_duration`: p t_d, positive.
    - `shape`: from -inf to +inf.

    **Returns:** theta/alpha; NaN after the first return, from which on it depends on the restitution: an engine is
    needed there.

    **Source:** V 3.2, 3.4, 3.6.
    """
    return _history(time, uplift_strength, pulse_duration, _clipped(shape))[0]


@_elementwise
def velocity(time: RealLike, uplift_strength: RealLike, pulse_duration: RealLike, shape: RealLike) -> Floats:
    """Angular velocity over p alpha, with the arguments of `rotation`.

    **Source:** V 3.3, 3.5, 3.7.
    """
    return _history(time, uplift_strength, pulse_duration, _clipped(shape))[1]


@_elementwise
def peak_time(uplift_strength: RealLike, pulse_duration: RealLike, shape: RealLike) -> Floats:
    """Time of the largest rotation [t_d]: inf for a block that overturns, 1/2 (the limit) for one that stays at rest.

    **Source:** V 3.15a, 3.15b, 3.16, 3.17a and b corrected.
    """
    return _peak(uplift_strength, pulse_duration, _clipped(shape))[0]


@_elementwise
def peak_rotation(uplift_strength: RealLike, pulse_duration: RealLike, shape: RealLike) -> Floats:
    """Largest rotation over alpha, at any restitution: inf for a block that overturns.

    **Arguments:** as in `rotation`.

    The first peak is the largest: a pulse of one sign that has passed its peak gives back less at each excursion than
    the impact before it has taken.

    **Source:** V 3.2 at the time of 3.15; 3.18.
    """
    return _peak(uplift_strength, pulse_duration, _clipped(shape))[1]


@_elementwise
def region(uplift_strength: RealLike, pulse_duration: RealLike, shape: RealLike) -> Int[Array, "..."]:
    """The outcome of the block: one of the numbers in `Region`.

    **Source:** V figures 3.1 to 3.3.
    """
    shape = _clipped(shape)
    wall, strength = _safety_wall(pulse_duration, shape), jnp.minimum(uplift_strength, 1.0)
    middle, end = _at_middle(strength, pulse_duration, shape), _at_end(strength, pulse_duration, shape)
    found = jnp.where(end[1] > 0, Region.peaks_after, Region.peaks_during)
    found = jnp.where(uplift_strength >= 1, Region.at_rest, found)
    found = jnp.where(uplift_strength < wall, Region.overturns_after, found)
    found = jnp.where((uplift_strength < wall) & (end[0] > strength), Region.overturns_while_falling, found)
    return jnp.where((uplift_strength < wall) & (middle[0] > strength), Region.overturns_while_rising, found)


@_elementwise
def critical_duration(uplift_strength: RealLike, shape: RealLike) -> Floats:
    """Least pulse duration p t_d that overturns a block; inf for one that does not uplift.

    **Source:** the inverse of V 3.12; -log(1 - strength) for a rectangle.
    """
    shape = _clipped(shape)
    strength = jnp.where(uplift_strength < 1, uplift_strength, 0.5)

    def excess(logarithm, strength, shape):
        return _safety_wall(jnp.exp(logarithm), shape) / strength - 1

    # The rectangle's is the shortest. Spikes exceed the tangents at their peak, others a triangle: log 2 slope/(1 - s).
    shortest = jnp.log(-jnp.log1p(-strength))
    longest = jnp.log(2 * (1 + jnp.maximum(shape, 0.0)) / (1 - strength))
    found = jnp.exp(bracketed_root(excess, shortest - 1e-9, longest, strength, shape))
    return jnp.where(uplift_strength < 1, found, jnp.inf)


@_elementwise
def critical_shape(uplift_strength: RealLike, pulse_duration: RealLike) -> Floats:
    """Shape below which a block overturns; -inf where not even a rectangle overturns it.

    **Source:** the inverse of V 3.12.
    """

    def excess(position, strength, duration):
        return _safety_wall(duration, _clipped(_unfolded(position))) / strength - 1

    end = jnp.ones_like(pulse_duration) * (1 - 1e-9)
    within = uplift_strength < -jnp.expm1(-pulse_duration)
    strength = jnp.where(within, uplift_strength, _safety_wall(pulse_duration, jnp.zeros_like(pulse_duration)))
    return jnp.where(within, _unfolded(bracketed_root(excess, -end, end, strength, pulse_duration)), -jnp.inf)


# ---- The mathematics: arrays of one shape, shapes clipped ----


def _clipped(shape: Array) -> Array:
    return jnp.clip(shape, -_MOST_SHAPE, _MOST_SHAPE)


def _parts(value: Array) -> tuple[Array, Array]:
    """Return the positive and negative part, with the derivatives of a positive number at 0."""
    return jnp.where(value >= 0, value, 0.0), jnp.where(value < 0, value, 0.0)


def _unfolded(position: Array) -> Array:
    """Map (-1, 1) to all shapes."""
    return 10 * position / ((1 - position) * (1 + position))


def _uplift(strength: Array, shape: Array) -> tuple[Array, Array]:
    """Return the time of uplift, and the rest of the rising branch after it [t_d]; V 2.4."""
    strength = jnp.where(strength < 1, strength, 1.0)
    lack = 1 - strength
    # log(1 + strength (e^shape - 1))/shape, and the same measured from the peak
    low, high = jnp.where(shape >= -_STEEP, shape, -_STEEP), jnp.where(shape <= _STEEP, shape, _STEEP)
    # For spikes 1 - y is strength + lack e^-shape, which would round to 0.
    weak, tiny = (shape > 1) & (strength < 0.5), jnp.finfo(strength.dtype).tiny
    spiked = -jnp.log(jnp.maximum(strength + lack * jnp.exp(-low), tiny)) / jnp.where(weak, shape, 1.0)
    left = lack * growth_ratio(-low) * logarithm_ratio(jnp.where(weak, 0.5, lack * low * growth_ratio(-low)))
    left = jnp.where(weak, spiked, left)
    time = strength * growth_ratio(high) * logarithm_ratio(-strength * high * growth_ratio(high))
    steep = jnp.where(shape < -_STEEP, shape, -_STEEP)
    box = jnp.log(jnp.where(lack > 0, lack, 1.0) + strength * jnp.exp(steep)) / steep
    time = jnp.where(shape < -_STEEP, jnp.where(lack > 0, box, 1.0), jnp.where(shape > _STEEP, 1 - left, time))
    left = jnp.where(shape < -_STEEP, 1 - time, left)
    return time / 2, left / 2


def _safety_wall(duration: Array, shape: Array) -> Array:
    """V 3.12. With x = 1/2 - shape/duration, twice the uplift time at the wall is -log(1 - x M)/(x f)."""
    mild = jnp.where(shape <= _STEEP, shape, _STEEP)
    x = 0.5 - mild / duration
    spread = exponential_difference(0.0, mild - duration / 2, -duration) * duration  # M/f
    small = x * duration * spread
    near = spread * logarithm_ratio(jnp.where(small < 0.5, small, 0.0))
    # where 1 - x M is small, use its form e^-f (1 + f (e^s - 1)/s), s = f/2 + shape
    up, down = _parts(duration / 2 + mild)
    logarithm = duration - up - jnp.log(jnp.exp(-up) + duration * growth_ratio(down - up))
    twice = jnp.where(small < 0.5, near, logarithm / jnp.where(small < 0.5, 1.0, x * duration))
    wall = twice * growth_ratio(mild * twice) / growth_ratio(mild)
    # A spike: the same, measured from the peak of the pulse.
    steep = jnp.where(shape > _STEEP, shape, _STEEP)
    s, x = steep + duration / 2, steep - duration / 2
    rest = growth_ratio(-s)
    small = x * rest
    far = -jnp.log((duration + x * jnp.exp(-s)) / s) / jnp.where(small < 0.5, 1.0, x)
    left = jnp.where(small < 0.5, rest * logarithm_ratio(jnp.where(small < 0.5, small, 0.0)), far)
    spiked = jnp.exp(-steep * left) * jnp.expm1(-steep * (1 - left)) / jnp.expm1(-steep)
    return jnp.where(shape > _STEEP, spiked, wall)


def _rising(since: Array, strength: Array, duration: Array, shape: Array) -> tuple[Array, Array]:
    """Return rotation and velocity times strength at a time `since` uplift, while the pulse rises; V 3.2, H = 0."""
    _, left = _uplift(strength, shape)
    up, down = _parts(shape)
    # The final value of an increasing exponential is factored out, so that spikes do not overflow.
    rate, grown = duration * since, 2 * up * since
    nodes = (rate - grown, -rate - grown, 2 * down * since)
    lift = jnp.where(shape < 0, 1 - strength + strength * jnp.exp(down), jnp.exp(2 * up * (since - left)))
    push = 2 * lift / growth_ratio(down - up)
    speed = push * duration * since**2 * exponential_difference(*nodes)
    angle = push * duration**2 * since**3 * exponential_difference(*nodes, -grown)
    return angle, speed


def _at_middle(strength: Array, duration: Array, shape: Array) -> tuple[Array, Array]:
    """Return rotation and velocity times strength at the peak of the pulse."""
    _, left = _uplift(strength, shape)
    return _rising(left, strength, duration, shape)


def _falling(since, middle, strength, duration, shape) -> tuple[Array, Array]:
    """Return rotation and velocity times strength at a time `since` the pulse's peak, from those at the peak; V 3.2."""
    angle, speed = middle
    up, down = _parts(shape)
    rate, grown = duration * since, -2 * down * since
    nodes = (rate - grown, -rate - grown, -2 * up * since)
    push = 2 * jnp.exp(down * (1 - 2 * since)) / growth_ratio(down - up)
    sinh, cosh, rise = jnp.sinh(rate), jnp.cosh(rate), 2 * jnp.sinh(rate / 2) ** 2
    lack = 1 - strength
    less_speed = push * duration * since**2 * exponential_difference(*nodes)
    less_angle = push * duration**2 * since**3 * exponential_difference(*nodes, -grown)
    return (
        angle * cosh + speed * sinh + lack * rise - less_angle,
        angle * sinh + speed * cosh + lack * sinh - less_speed,
    )


def _at_end(strength: Array, duration: Array, shape: Array) -> tuple[Array, Array]:
    """Return rotation and velocity times strength at the end of the pulse, as if there were no ground."""
    return _falling(jnp.full_like(duration, 0.5), _at_middle(strength, duration, shape), strength, duration, shape)


def _missing_at_middle(strength, duration, shape):
    return _at_middle(strength, duration, shape)[0] - strength


def _missing_at_end(strength, duration, shape):
    return _at_end(strength, duration, shape)[0] - strength


def _speed_at_end(strength, duration, shape):
    return _at_end(strength, duration, shape)[1]


def _history(time: Array, strength: Array, duration: Array, shape: Array) -> tuple[Array, Array]:
    """Return rotation and velocity, NaN after the first return."""
    rocks = (strength < 1) & (shape < _MOST_SHAPE)  # a perfect spike moves nothing
    strength = jnp.where(rocks, strength, 0.5)
    uplift, _ = _uplift(strength, shape)
    # At the end of a piece, too, the time derivative is its own; `jnp.clip` would halve it at a tie.
    since = jnp.where(time > uplift, jnp.where(time <= 0.5, time, 0.5) - uplift, 0.0)
    rising, middle = _rising(since, strength, duration, shape), _at_middle(strength, duration, shape)
    since = jnp.where(time > 0.5, jnp.where(time <= 1, time - 0.5, 0.5), 0.0)
    falling = _falling(since, middle, strength, duration, shape)
    after = duration * jnp.where(time > 1, time - 1, 0.0)
    sinh, cosh, rise = jnp.sinh(after), jnp.cosh(after), 2 * jnp.sinh(after / 2) ** 2
    free = (
        falling[0] * cosh + falling[1] * sinh - strength * rise,
        falling[0] * sinh + falling[1] * cosh - strength * sinh,
    )
    returned = (falling[0] < 0) | (free[0] < 0)
    values = []
    for early, middle, late in zip(rising, falling, free):
        value = jnp.where(time <= 0.5, early, jnp.where(time <= 1, middle, late)) / strength
        value = jnp.where((time > 0.5) & returned, jnp.nan, value)
        values.append(jnp.where(rocks & (time > uplift), value, 0.0))
    return values[0], values[1]


def _falling_speed(since, angle, speed, strength, duration, shape):
    return _falling(since, (angle, speed), strength, duration, shape)[1]


def _peak(strength: Array, duration: Array, shape: Array) -> tuple[Array, Array]:
    """Return time and size of the largest rotation."""
    rocks, wall = strength < 1, _safety_wall(duration, shape)
    lost = strength < wall
    inside = jnp.where(rocks & ~lost, strength, (1 + wall) / 2)
    middle, half = _at_middle(inside, duration, shape), jnp.full_like(duration, 0.5)
    angle, speed = (value / inside for value in _falling(half, middle, inside, duration, shape))
    late = speed > 0
    # S2: free flight from the end of the pulse, z w = (1 - angle)^2 - speed^2
    gap = jnp.where(late, 1 - angle, 1.0)
    fast = jnp.where(late, speed, 0.0)
    bend = jnp.maximum((gap - fast) * (gap + fast), 0.0)
    bend = jnp.where(bend > 0, bend, 1.0)
    free_time = 1 + jnp.arctanh(jnp.minimum(fast / gap, 1 - 1e-16)) / duration  # V 3.15b
    free_angle = (2 * angle - angle**2 + fast**2) / (1 + jnp.sqrt(bend))
    # S1: the velocity's zero while the pulse falls
    since = bracketed_root(_falling_speed, 0 * half, half, *middle, inside, duration, shape)  # V 3.15a
    early_angle = _falling(since, middle, inside, duration, shape)[0] / inside
    time = jnp.where(late, free_time, 0.5 + since)
    size = jnp.where(late, free_angle, early_angle)
    return (
        jnp.where(lost, jnp.inf, jnp.where(rocks, time, 0.5)),
        jnp.where(lost, jnp.inf, jnp.where(rocks, size, 0.0)),
    )
