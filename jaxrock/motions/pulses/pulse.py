"""The base class of pulses: an amplitude [g], and a start at time 0."""

import re

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxrock._core.arrays import is_concrete, to_device
from jaxrock._core.types import Real
from jaxrock.motions.motion import AbstractMotion, Piece as Piece


def one_piece(end: Real) -> Real:
    """Return the knots of a motion that is smooth from 0 to `end`."""
    if is_concrete(end):
        return to_device(np.stack([np.zeros_like(end), end]))
    return jnp.stack([jnp.zeros_like(end), end])


class AbstractPulse(AbstractMotion):
    """A motion that is proportional to its `amplitude` [g]."""

    amplitude: eqx.AbstractVar[Real]

    @classmethod
    def word(cls) -> str:
        """Return the command line's word for it: `half-sine` for `HalfSinePulse`."""
        return re.sub("(?<=[a-z])(?=[A-Z])", "-", cls.__name__.removesuffix("Pulse")).lower()
