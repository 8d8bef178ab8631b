"""Rocking and overturning of free-standing blocks, on JAX.

What everyone uses is here; the rest lies in namespaces: `motions`, `blocks`, `models`, `responses`, `studies`,
`closed_form`, `hazard`, `inverse`, `plot`.

Conventions: angles in rad, time in s, accelerations in g; positive ground acceleration drives negative
rotation; `alpha` is the slenderness angle, `p` the frequency parameter [rad/s], `restitution` the angular
velocity after an impact over that before it.
"""

import importlib as _importlib
import typing as _typing

from jaxrock import (
    blocks as blocks,
    closed_form as closed_form,
    models as models,
    motions as motions,
    responses as responses,
    studies as studies,
)
from jaxrock._arguments.parameters import parameter as parameter
from jaxrock._core.namespace import shown as _shown
from jaxrock.blocks import restitution as restitution
from jaxrock.blocks.rigid import Block as Block
from jaxrock.compiler import cache as _cache
from jaxrock.engines.taylor.accurate import Series as Series
from jaxrock.models.rigid import (
    Housner as Housner,
    Linear as Linear,
)
from jaxrock.models.spring import Spring as Spring
from jaxrock.motions import intensity as intensity
from jaxrock.motions.files.example import example_record as example_record
from jaxrock.motions.files.reading import read_record as read_record
from jaxrock.motions.harmonic import HarmonicMotion as HarmonicMotion
from jaxrock.motions.pulses import *  # noqa: F403  (those of files that were added)
from jaxrock.motions.pulses.exponential import (
    ExponentialPulse as ExponentialPulse,
    RectangularPulse as RectangularPulse,
    TriangularPulse as TriangularPulse,
)
from jaxrock.motions.pulses.mavroeidis_papageorgiou import MavroeidisPapageorgiouPulse as MavroeidisPapageorgiouPulse
from jaxrock.motions.pulses.ricker import RickerPulse as RickerPulse
from jaxrock.motions.pulses.sinusoidal import (
    CosinePulse as CosinePulse,
    HalfSinePulse as HalfSinePulse,
    SinePulse as SinePulse,
)
from jaxrock.motions.record import Record as Record
from jaxrock.responses.history import simulate as simulate
from jaxrock.responses.outcome import outcome as outcome
from jaxrock.status import Status as Status
from jaxrock.studies import (
    saved_outcomes as _saved_outcomes,  # noqa: F401  (what `Grid.load` knows again)
    similarity as similarity,
)
from jaxrock.studies.critical import critical_amplitudes as critical_amplitudes
from jaxrock.studies.spectra import (
    overturning_map as overturning_map,
    rocking_spectrum as rocking_spectrum,
)
from jaxrock.sweeps.sweep import sweep as sweep

if _typing.TYPE_CHECKING:
    from jaxrock import hazard as hazard, inverse as inverse, plot as plot
    from jaxrock.engines.diffrax.arcs import Diffrax as Diffrax
    from jaxrock.motions import processing as processing

__version__ = "0.1.0"

# Few programs need all of them, and they import much: matplotlib, SciPy's optimisers and filters, Diffrax.
_LATER = {
    "hazard": "jaxrock.hazard",
    "inverse": "jaxrock.inverse",
    "plot": "jaxrock.plot",
    "processing": "jaxrock.motions.processing",
}


if not _typing.TYPE_CHECKING:  # checkers know these names from above, and are to tell of any other

    def __getattr__(name: str):
        if name in _LATER:
            return _importlib.import_module(_LATER[name])
        if name == "Diffrax":
            return _importlib.import_module("jaxrock.engines.diffrax.arcs").Diffrax
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


_NAMESPACES = """
    blocks closed_form hazard intensity inverse models motions plot processing responses restitution similarity studies
"""


def __dir__() -> list[str]:
    return sorted({*_shown(globals(), *_NAMESPACES.split()), *_LATER, "Diffrax"})


keep_compiled = _cache.keep_compiled
_cache.watch(
    pure=(
        "blocks.asymmetric", "blocks.flexible", "blocks.restitution", "blocks.rigid", "closed_form", "engines.diffrax",
        "engines.taylor", "models", "motions.pulses", "responses", "status",
    ),
    immutable=("blocks.edge", "blocks.rock", "motions.motion", "motions.record"),
    without_programs=("compiler.cache", "sweeps", "plot", "command_line"),
)  # fmt: skip
