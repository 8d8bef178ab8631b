"""jaxrock's second engine, diffrax, on fewer scenes."""

import jaxrock as rk

from . import jaxrock_api

FEW = {"P4": 16, "P6": 16, "P7": 16}  # scenes; else 200
SETTINGS = ((1e-6, 1e-7), (1e-12, 1e-12))


def ways(problem):
    """The ways to solve a problem: (goal of the error, label, function of the chosen scenes)."""
    solver = jaxrock_api.under_record if problem.motion == "record" else jaxrock_api.under_pulses
    return [(goal, f"rtol {rtol:g}", solver(problem, rk.Diffrax(rtol=rtol))) for goal, rtol in SETTINGS]
