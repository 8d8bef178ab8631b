"""A Taylor step over the whole reach of its series, and its end after a cut at an event."""

import functools
from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxrock._core.types import Flag, Scalar
from jaxrock.compiler.hints import materialize, select
from jaxrock.engines.events import Events
from jaxrock.engines.state import State
from jaxrock.engines.taylor.expansion import Start, taylor_expansion
from jaxrock.engines.taylor.step_start import overshoot, signs_at_start, unbalanced
from jaxrock.numerics.polynomial import derivative, jet, keeps_sign, step_length


class Cut(NamedTuple):
    """The end of a step after a cut at its event, in the unit of the step's time."""

    length: Scalar
    opening: Scalar
    speed: Scalar
    acceleration: Scalar
    hits: Events


class Step(NamedTuple):
    """A Taylor step over the whole reach of its series, with tests for events within it."""

    coefficients: list[Scalar]
    length: Scalar
    full: Flag  # goes to the end of the room
    signs: tuple[Scalar, Scalar]  # initial signs of velocity and acceleration
    monotone: Flag  # the acceleration keeps its sign: at most one turning point
    faster: Flag  # the velocity may exceed the largest so far
    eventful: Flag
    whole: Cut  # its end, if no event cuts it

    @classmethod
    def of(cls, stepper: Any, state: State, start: Start, room: Scalar, rocking: Flag) -> "Step":
        """Compute the step from a state on."""
        scene, order = stepper.scene, stepper.order
        coefficients = unbalanced(taylor_expansion(start, order).opening)
        # Relative to the motion itself while it is small: tiny rotations keep their digits, too.
        size = functools.reduce(jnp.maximum, [jnp.abs(c) for c in coefficients[: max(order // 2, 4)]])
        size = jnp.minimum(scene.alpha, size)
        length = step_length(coefficients, stepper.tolerance * size, jnp.minimum(room, stepper.longest))
        full = length >= room * (1 - 1e-9)
        length = materialize(select(full, room, length), state.local)
        opening, speed = (materialize(value, state.local) for value in jet(coefficients, length, 1))

        signs = signs_at_start(state, coefficients)
        turning = materialize(keeps_sign(derivative(coefficients), signs[0], length), state.local) <= 0
        crossing = (opening >= scene.moments.saddle) != state.beyond
        top = jnp.maximum(jnp.abs(coefficients[1]), jnp.abs(speed)) + materialize(
            overshoot(coefficients, length), state.local
        )
        monotone = materialize(keeps_sign(derivative(derivative(coefficients)), signs[1], length), state.local) > 0
        faster = (top > state.fastest * start.stretch) & ~monotone
        eventful = turning | crossing | faster | (opening <= 0)
        if stepper.history:
            eventful = eventful | (opening >= jnp.pi / 2)
        return cls(
            coefficients=coefficients,
            length=length,
            full=full,
            signs=signs,
            monotone=monotone,
            faster=faster,
            eventful=eventful & rocking & (length > 0),
            whole=Cut(length, opening, speed, jnp.zeros_like(speed), Events(*[jnp.zeros_like(full)] * 5)),
        )
