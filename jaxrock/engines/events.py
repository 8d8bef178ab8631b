"""The events that end a step, in one list: the guards that an engine watches, and the values that an event sets
exactly."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxrock._core.types import Scalar
from jaxrock.compiler.hints import select
from jaxrock.engines.scene import Scene


class Events(NamedTuple):
    """One value per kind of event; for a step, whether that event ends it.

    Impact; turning point; extremum of the velocity; the saddle, where the block balances; flat on the ground. The
    series engine watches the last one in histories only.
    """

    impact: Any
    turning: Any
    extremum: Any
    saddle: Any
    flat: Any


class Watched(NamedTuple):
    """A guard: the event is where a derivative of the opening angle passes a level."""

    derivative: int
    level: Callable[[Scene], Scalar | float]


WATCHED = Events(
    impact=Watched(0, lambda scene: 0.0),
    turning=Watched(1, lambda scene: 0.0),
    extremum=Watched(2, lambda scene: 0.0),
    saddle=Watched(0, lambda scene: scene.moments.saddle),
    flat=Watched(0, lambda scene: jnp.pi / 2),
)


def level_of(scene: Scene, hits: Events) -> Scalar:
    """Return the opening angle at which a step ends, if an event sets it."""
    return select(hits.saddle, scene.moments.saddle, select(hits.flat, jnp.pi / 2, 0.0))


def landed(scene: Scene, hits: Events, opening: Scalar, velocity: Scalar) -> tuple[Scalar, Scalar]:
    """Return opening angle and velocity at the end of a step, exact where its event sets them. At an impact, `impact`
    sets them."""
    opening = select(hits.flat, jnp.pi / 2, select(hits.saddle, scene.moments.saddle, opening))
    return opening, select(hits.turning, 0.0, velocity)
