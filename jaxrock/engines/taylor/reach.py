"""How far the series of a step goes within a piece of a record."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Inexact

from jaxrock.engines.state import State
from jaxrock.engines.taylor.careful import TaylorStepper
from jaxrock.engines.taylor.expansion import Start, expand
from jaxrock.numerics.polynomial import horner
from jaxrock.numerics.xla_cpu import keep_by

Scalar = Inexact[Array, ""]
Flag = Bool[Array, ""]


class Reach(NamedTuple):
    """The series of a step, to the end of a piece or a half or a quarter of the way. Time is in the unit of the series,
    but for `unit`."""

    start: Start
    unit: Scalar  # [s]
    terms: list[Scalar]  # of the opening angle
    speeds: list[Scalar]  # of its velocity
    whole: Scalar  # time to the end of the piece
    room: Scalar  # how far it goes
    full: Flag  # as far as that
    holds: Flag  # and is as exact as it has to be
    missed: Scalar  # what it leaves out at its end [rad]
    opening: Scalar  # there
    speed: Scalar
    change: Scalar  # bound of how far the acceleration is off its first value on the way
    bend: Scalar  # and the velocity off a straight line
    first: Scalar  # size of the velocity at the start,
    then: Scalar  # and of that line at the end, negative if it has turned

    @classmethod
    def of(cls, stepper: TaylorStepper, state: State) -> "Reach":
        """From a state on, of which `stepper` is on the side."""
        order = stepper.order
        shaking, unit = stepper.shaking(state.piece, state.local)
        start = stepper.start(state, shaking, unit)
        series = expand(start, order)
        terms, speeds = series.opening, series.speed
        size = jnp.minimum(stepper.scene.alpha, jnp.abs(terms[0]) + jnp.abs(terms[1]))
        last = jnp.abs(terms[-1]) + jnp.abs(terms[-2]) + 0.02 * (jnp.abs(terms[-3]) + jnp.abs(terms[-4]))

        whole = stepper.room(state) * (1 / unit)
        missed, most = last * whole**order, stepper.tolerance * size
        full, half = missed <= most, missed <= 2**order * most
        room = keep_by(jnp.where(full, whole, jnp.where(half, 0.5, 0.25) * whole), start.one)
        missed = missed * jnp.where(full, 1.0, jnp.where(half, 0.5**order, 0.25**order))

        change = room * horner([k * jnp.abs(c) for k, c in enumerate(speeds)][2:], room)
        return cls(
            start=start,
            unit=unit,
            terms=terms,
            speeds=speeds,
            whole=whole,
            room=room,
            full=full,
            holds=missed <= most,
            missed=missed,
            opening=horner(terms, room),
            speed=horner(speeds, room),
            change=change,
            bend=0.5 * room * change,
            first=jnp.abs(speeds[0]),
            then=jnp.where(speeds[0] < 0, -1.0, 1.0) * (speeds[0] + room * speeds[1]),
        )

    @property
    def time(self) -> Scalar:
        """p t of how far it goes."""
        return self.room * self.start.stretch

    @property
    def steady(self) -> Flag:
        """Whether the velocity grows or falls all the way."""
        return jnp.abs(self.speeds[1]) > self.change

    @property
    def one_way(self) -> Flag:
        """Whether the block does not turn."""
        return (self.first > self.bend) & (self.then > self.bend)

    def no_faster(self, fastest: Scalar) -> Flag:
        """Whether it is nowhere on the way faster than at an end or (per p t) than this."""
        fastest = fastest * self.start.stretch
        return ((self.first + self.bend <= fastest) & (self.then + self.bend <= fastest)) | self.steady
