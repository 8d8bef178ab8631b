"""A trial step within a piece of a record: its end, and whether an event may fall into it.

The end follows from the series, or, where the equation is linear, exactly. About the balance that moves with the ground
the opening angle is a hyperbolic sine and cosine, whose acceleration changes its sign at most once.
"""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxrock._core.types import Flag, Scalar
from jaxrock.compiler.hints import materialize_by, select
from jaxrock.engines.state import State
from jaxrock.engines.taylor.accurate import TaylorStepper
from jaxrock.engines.taylor.expansion import Start, taylor_expansion
from jaxrock.numerics.polynomial import horner, last_size, remainder

# Series of (cosh(x) - 1)/x^2 and (sinh(x) - x)/x^3 in x^2, accurate to rounding up to here.
_EXACT = 0.04
_EVEN, _ODD = (tuple(1 / math.factorial(2 * k + first) for k in range(5)) for first in (2, 3))


class TrialStep(NamedTuple):
    """A trial step from a state to the end of a piece, or a half or a quarter of the way.

    Time is in the unit of `start`, but for `unit`.
    """

    start: Start
    unit: Scalar  # [s]
    room: Scalar  # length
    full: Flag  # ends with the piece
    holds: Flag  # accurate to the tolerance
    missed: Scalar  # truncation error at its end [rad]
    opening: Scalar  # at its end
    speed: Scalar
    slows: Flag  # the acceleration is negative at its start
    steady: Flag  # the velocity is monotone
    one_way: Flag  # the block does not turn
    largest: Scalar  # bound of the speed within it

    @classmethod
    def of(cls, stepper: TaylorStepper, state: State) -> "TrialStep":
        """Compute the trial step from a state; `stepper` is that of its side."""
        shaking, unit = stepper.shaking(state.piece, state.local)
        start, whole = stepper.start(state, shaking, unit), stepper.room(state) * (1 / unit)
        return (_exactly if _is_linear(start) else _by_series)(stepper, start, unit, whole)

    @property
    def time(self) -> Scalar:
        """Return its length in p t."""
        return self.room * self.start.stretch

    def no_faster(self, fastest: Scalar) -> Flag:
        """Return whether the speed exceeds neither that at the ends nor `fastest` (per p t)."""
        return (self.largest <= fastest * self.start.stretch) | self.steady


def _by_series(stepper: TaylorStepper, start: Start, unit: Scalar, whole: Scalar) -> TrialStep:
    order = stepper.order
    series = taylor_expansion(start, order)
    terms, speeds = series.opening, series.speed
    size = jnp.minimum(stepper.scene.alpha, jnp.abs(terms[0]) + jnp.abs(terms[1]))
    missed, most = last_size(terms) * whole**order, stepper.tolerance * size
    full, half = missed <= most, missed <= 2**order * most
    room = materialize_by(select(full, whole, select(half, 0.5, 0.25) * whole), start.one)
    holds = full | half | (missed <= 4**order * most)

    # Bounds of how far the acceleration departs from its first value, and the velocity from a straight line.
    change = room * horner([k * jnp.abs(c) for k, c in enumerate(speeds)][2:], room)
    bend = 0.5 * room * change
    first, then = jnp.abs(speeds[0]), select(speeds[0] < 0, -1.0, 1.0) * (speeds[0] + room * speeds[1])
    return TrialStep(
        start=start,
        unit=unit,
        room=room,
        full=full,
        holds=holds,
        missed=remainder(terms, room),
        opening=horner(terms, room),
        speed=horner(speeds, room),
        slows=speeds[1] < 0,
        steady=jnp.abs(speeds[1]) > change,
        one_way=(first > bend) & (then > bend),
        largest=jnp.maximum(first, then) + bend,
    )


def _is_linear(start: Start) -> bool:
    """Return whether x'' = rate (x - saddle) + a straight line."""
    moments, (horizontal, vertical) = start.moments, start.shaking
    is_line = not moments.trigonometric and moments.groups.arm.line is None and moments.has_free_swing
    return is_line and vertical is None and len(horizontal) <= 2


def _exactly(stepper: TaylorStepper, start: Start, unit: Scalar, whole: Scalar) -> TrialStep:
    moments: Any = start.moments
    pull = -moments.restoring_terms.line
    rate = start.stretch**2 * pull
    # The balance moves along a straight line, about which offset'' = rate offset (D&D 2012, 3.1).
    lever = start.side * (moments.arm_terms.constant / pull)  # a quotient that no step changes
    now, *rest = start.shaking.horizontal
    drift = lever * rest[0] if rest else jnp.zeros_like(whole)
    offset = start.opening - moments.restoring_terms.constant / pull - lever * now
    relative = start.speed - drift

    whole_square = rate * whole**2
    full, half = whole_square <= _EXACT, whole_square <= 4 * _EXACT
    room = materialize_by(select(full, whole, select(half, 0.5, 0.25) * whole), start.one)
    square = rate * room**2
    grown, more = (square * horner([jnp.full_like(square, c) for c in terms], square) for terms in (_EVEN, _ODD))
    lag = more * room  # of sinh over the root of the rate behind it
    opening = start.opening + (room * start.speed + (grown * offset + lag * relative))
    speed = start.speed + (grown * relative + rate * (room + lag) * offset)
    end = offset + (grown * offset + (room + lag) * relative)

    # A solution of that equation is nowhere larger than at its ends, and has at most one zero.
    steady = offset * end > 0
    change = rate * room * jnp.maximum(jnp.abs(offset), jnp.abs(end))
    first, then = jnp.abs(start.speed), jnp.abs(speed)
    return TrialStep(
        start=start,
        unit=unit,
        room=room,
        full=full,
        holds=square <= _EXACT,
        missed=jnp.zeros_like(room),
        opening=opening,
        speed=speed,
        slows=offset < 0,
        steady=steady,
        one_way=(start.speed * speed > 0) & (steady | (first > change)),
        largest=jnp.maximum(first, then) + change,
    )
