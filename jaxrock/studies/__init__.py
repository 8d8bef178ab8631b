"""Studies of many responses: spectra, overturning maps, critical amplitudes, sensitivities, similarity; grids.

Imports `responses` and `sweeps`. Start with `spectra`.
"""

from jaxrock._core.namespace import shown as _shown
from jaxrock.studies.attractors import (
    Basins as Basins,
    basins as basins,
)
from jaxrock.studies.azimuths import (
    AzimuthOutcomes as AzimuthOutcomes,
    azimuth_outcomes as azimuth_outcomes,
)
from jaxrock.studies.borders import (
    Borders as Borders,
    Region as Region,
    overturning_borders as overturning_borders,
)
from jaxrock.studies.critical import (
    critical_amplitudes as critical_amplitudes,
    critical_durations as critical_durations,
)
from jaxrock.studies.critical_ends import Critical as Critical
from jaxrock.studies.period_doubling import (
    Bifurcation as Bifurcation,
    bifurcation as bifurcation,
)
from jaxrock.studies.sensitivities import (
    Sensitivity as Sensitivity,
    SensitivityMap as SensitivityMap,
    Slopes as Slopes,
    SlopeStatus as SlopeStatus,
    sensitivity as sensitivity,
    sensitivity_map as sensitivity_map,
)
from jaxrock.studies.spectra import (
    OverturningMap as OverturningMap,
    overturning_map as overturning_map,
    rocking_spectrum as rocking_spectrum,
    self_similar_spectrum as self_similar_spectrum,
)
from jaxrock.studies.spectrum import Spectrum as Spectrum
from jaxrock.studies.stroboscopic import (
    StroboscopicState as StroboscopicState,
    stroboscopic_map as stroboscopic_map,
)
from jaxrock.sweeps.devices import use_cpu_devices as use_cpu_devices
from jaxrock.sweeps.grid import Grid as Grid


def __dir__() -> list[str]:
    return _shown(globals(), "similarity")
