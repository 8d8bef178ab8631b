"""The events that end a step, in one list: the guards that an engine watches, and the values that an event sets
exactly."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Inexact

from jaxrock.engines.scene import Scene
from jaxrock.numerics.choice import where

Scalar = Inexact[Array, ""]
Flag = Bool[Array, ""]


class Events(NamedTuple):
    """One value per kind of event; for a step, whether that event ends it.

    Impact; turning point; extremum of the velocity; the saddle, where the block balances; flat on the ground.
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
    return where(hits.saddle, scene.moments.saddle, where(hits.flat, jnp.pi / 2, 0.0))


def landed(scene: Scene, hits: Events, opening: Scalar, velocity: Scalar) -> tuple[Scalar, Scalar]:
    """Return opening angle and velocity at the end of a step, exact where its event sets them. At an impact, `impact`
    sets them."""
    opening = where(hits.flat, jnp.pi / 2, where(hits.saddle, scene.moments.saddle, opening))
    return opening, where(hits.turning, 0.0, velocity)
