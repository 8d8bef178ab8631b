"""The Taylor series of a floor's acceleration, and its bound over a stretch of time."""

import functools
from typing import NamedTuple

import jax.numpy as jnp

from jaxrock._core.types import Flag, Scalar
from jaxrock.compiler.hints import materialize, select
from jaxrock.motions.floor_states import OscillatorState, ringing_amplitude
from jaxrock.numerics.polynomial import horner


class Building(NamedTuple):
    """The damping of a building over critical, and the participation of its floor."""

    damping: Scalar
    gain: Scalar


def bound_of_stretch(
    building: Building,
    terms: list[Scalar],
    before: OscillatorState,
    after: OscillatorState,
    angle: Scalar,
    rings: Flag | None,
) -> Scalar:
    """Bound the floor's acceleration within a stretch, from the ground's coefficients in time over its length.

    A function is at most its values at five points, plus an eighth of the largest second derivative over a quarter of
    the stretch. Under a line it is also at most the line plus the amplitude about it: less, in a long stretch.
    """
    damping, gain = building.damping, building.gain
    begin, end = terms[0], sum(terms[1:], terms[0])
    rise = terms[1] if len(terms) > 1 else jnp.zeros_like(begin)
    left, right = _relative(before, begin, damping), _relative(after, end, damping)
    slopes = [angle * (state.speed - 2 * damping * w) - rise for state, w in ((before, left), (after, right))]
    amplitude = ringing_amplitude(left, slopes[0] / select(angle > 0, angle, jnp.inf), damping)
    amplitude = jnp.abs(gain) * amplitude
    # The cubic of values and slopes at both ends errs by 1/384 of the largest fourth derivative.
    values = [begin + gain * left, end + gain * right]
    tilts = [rise + gain * slope for slope in slopes]
    change = values[1] - values[0]
    cubic = [values[0], tilts[0], 3 * change - 2 * tilts[0] - tilts[1], tilts[0] + tilts[1] - 2 * change]
    near = _largest(cubic, angle**2 * amplitude) + angle**4 / 384 * amplitude
    under_lines = jnp.minimum(near, jnp.maximum(jnp.abs(begin), jnp.abs(end)) + amplitude)
    if rings is None:
        return under_lines
    whole = floor_terms(building, terms, before, angle, len(terms) - 1)
    bend = horner([k * (k - 1) * jnp.abs(c) for k, c in enumerate(whole)], jnp.ones_like(begin))
    return select(rings, under_lines, _largest(whole, bend))


def _largest(terms: list[Scalar], bend: Scalar) -> Scalar:
    """Bound a function on [0, 1] by its Taylor coefficients and a bound of its second derivative."""
    values = [jnp.abs(horner(terms, jnp.full_like(bend, k / 4))) for k in range(5)]
    return functools.reduce(jnp.maximum, values) + bend / 128


def _relative(state: OscillatorState, ground: Scalar, damping: Scalar) -> Scalar:
    """Return the acceleration of the oscillator relative to the ground [g]."""
    return state.place + 2 * damping * state.speed - ground


def floor_terms(
    building: Building, ground: list[Scalar], state: OscillatorState, angle: Scalar, order: int
) -> list[Scalar]:
    """Return the coefficients of u + gain w, where the relative acceleration w obeys the oscillator's equation under
    -u''; `angle` is omega times the unit of time."""
    damping = building.damping
    first = _relative(state, ground[0], damping)
    slope = angle * (state.speed - 2 * damping * first)
    terms = [first, slope - ground[1] if len(ground) > 1 else slope]
    square, friction = materialize(angle**2, angle), materialize(2 * damping * angle, angle)
    for k in range(order - 1):
        term = (friction * (k + 1) * terms[k + 1] + square * terms[k]) * (-1 / ((k + 1) * (k + 2)))
        terms.append(materialize(term - ground[k + 2] if k + 2 < len(ground) else term, angle))
    return [
        building.gain * w + ground[k] if k < len(ground) else building.gain * w
        for k, w in enumerate(terms[: order + 1])
    ]
