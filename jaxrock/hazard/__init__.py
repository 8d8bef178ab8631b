"""The probability that a rock topples: fragilities, fitted or simulated, hazard curves, and files of OpenQuake.

The package imports `studies`, `responses` and `sweeps`. Start reading with `fragility`, then `curves` and `survival`.
"""

from jaxrock._core.namespace import shown as _shown
from jaxrock.hazard.curves import HazardCurve as HazardCurve
from jaxrock.hazard.explanation import compare_measures as compare_measures
from jaxrock.hazard.fragility import (
    AbstractFragility as AbstractFragility,
    FitStatus as FitStatus,
    FragilityFit as FragilityFit,
    LogNormalFragility as LogNormalFragility,
    TabulatedFragility as TabulatedFragility,
    fit_fragility as fit_fragility,
)
from jaxrock.hazard.intervals import (
    FragilityIntervals as FragilityIntervals,
    fragility_intervals as fragility_intervals,
)
from jaxrock.hazard.nrml import write_nrml as write_nrml
from jaxrock.hazard.openquake import (
    HazardCurves as HazardCurves,
    read_hazard_curves as read_hazard_curves,
)
from jaxrock.hazard.probit import (
    ProbitFit as ProbitFit,
    fit_probit as fit_probit,
)
from jaxrock.hazard.simulation import (
    SimulatedFragility as SimulatedFragility,
    simulated_fragility as simulated_fragility,
)
from jaxrock.hazard.suites import (
    SuiteOutcomes as SuiteOutcomes,
    suite_outcomes as suite_outcomes,
)
from jaxrock.hazard.surfaces import (
    SimulatedSurface as SimulatedSurface,
    SurfaceFit as SurfaceFit,
    SurfaceFragility as SurfaceFragility,
    fit_surface as fit_surface,
    simulated_surface as simulated_surface,
    surface_of as surface_of,
)
from jaxrock.hazard.survival import (
    allowed_scale as allowed_scale,
    branch_weights as branch_weights,
    survival_probability as survival_probability,
    toppling_rate as toppling_rate,
)


def __dir__() -> list[str]:
    return _shown(globals())
