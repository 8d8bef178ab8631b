"""Rocking and overturning of free-standing blocks, on JAX."""

from jaxrock.block import Block as Block
from jaxrock.models import Housner as Housner, Linear as Linear
from jaxrock.motion import AbstractMotion as AbstractMotion, Record as Record
from jaxrock.pulses import (
    CosinePulse as CosinePulse,
    ExponentialPulse as ExponentialPulse,
    HalfSinePulse as HalfSinePulse,
    MavroeidisPapageorgiouPulse as MavroeidisPapageorgiouPulse,
    RectangularPulse as RectangularPulse,
    RickerPulse as RickerPulse,
    SinePulse as SinePulse,
    TriangularPulse as TriangularPulse,
)
from jaxrock.response import Outcome as Outcome, Response as Response, outcome as outcome, simulate as simulate
from jaxrock.series import Series as Series
from jaxrock.status import Status as Status

__version__ = "0.1.0"
