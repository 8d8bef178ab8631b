"""Ground motions: the interface to the engines (`motion`), pulses, records, suites, files and measures of intensity.

Imports `numerics` and `blocks`. Start with `motion`. A new pulse is a file in `pulses`, a new file format is one in
`files`.
"""

from jaxrock._core.namespace import shown as _shown
from jaxrock.motions import intensity as intensity
from jaxrock.motions.components import (
    Components as Components,
    components_of_stream as components_of_stream,
    read_components as read_components,
)
from jaxrock.motions.files.example import example_record as example_record
from jaxrock.motions.files.fema_p695 import fema_p695 as fema_p695
from jaxrock.motions.files.reading import read_record as read_record
from jaxrock.motions.files.spectra import (
    ResponseSpectra as ResponseSpectra,
    read_spectra as read_spectra,
)
from jaxrock.motions.files.traces import record_of_trace as record_of_trace
from jaxrock.motions.files.writing import (
    write_at2 as write_at2,
    write_csv as write_csv,
)
from jaxrock.motions.floors import on_floor as on_floor
from jaxrock.motions.motion import (
    AbstractMotion as AbstractMotion,
    WithVertical as WithVertical,
)
from jaxrock.motions.pulse_fit import (
    PulseFit as PulseFit,
    PulseStatus as PulseStatus,
    fit_pulse as fit_pulse,
)
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
from jaxrock.motions.record import (
    Origin as Origin,
    Record as Record,
)
from jaxrock.motions.suite import Suite as Suite


def __dir__() -> list[str]:
    return _shown(globals(), "intensity")
