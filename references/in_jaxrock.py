"""Models and motions of jaxrock by the references' names and numbers."""

import jaxrock as rk

MODELS = {"nonlinear": rk.Housner(), "linear": rk.Linear()}
PULSES = {
    "sine": rk.SinePulse,
    "cosine": rk.CosinePulse,
    "half sine": rk.HalfSinePulse,
    "rectangle": rk.RectangularPulse,
    "triangle": rk.TriangularPulse,
    "exponential": rk.ExponentialPulse,
    "ricker symmetric": rk.RickerPulse,
}


def motion(kind, numbers):
    """A motion from a kind and its numbers; of a record: dt, then its samples."""
    if kind == "sum":
        return rk.CosinePulse(*numbers[:2]) + rk.RectangularPulse(*numbers[2:4]).shifted(numbers[4])
    if kind == "record":
        return rk.Record(numbers[1:], numbers[0])
    return PULSES[kind](*numbers)
