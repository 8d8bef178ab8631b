"""Names that were at the top of the package before it had namespaces; they go with the first release."""

import importlib
import warnings
from typing import Any

_MOVED = {
    "blocks": "AsymmetricBlock FlexibleBlock Rock draw_blocks",
    "hazard": """
        AbstractFragility FitStatus FragilityFit HazardCurve HazardCurves LogNormalFragility ProbitFit
        SimulatedFragility SimulatedSurface SuiteOutcomes SurfaceFit SurfaceFragility TabulatedFragility
        allowed_scale branch_weights fit_fragility fit_probit fit_surface read_hazard_curves simulated_fragility
        simulated_surface suite_outcomes surface_of survival_probability toppling_rate write_nrml
    """,
    "intensity": "peak_acceleration peak_velocity",
    "inverse": """
        BlockCalibration CalibrationStatus Estimate EstimateStatus FeasibleRegion FoundRecord HistoryFit
        HistoryStatus Likelihood LogDensity Observations Posterior PosteriorStatus RecordStatus Unexceeded Unknown
        calibrate_block estimate_motion feasible_region find_record fit_history log_density read_observations
        sample_motion unexceeded_motion
    """,
    "models": "AbstractEquation Coefficients Equation Terms",
    "motions": """
        AbstractMotion Components Origin Suite WithVertical read_components record_of_trace write_at2 write_csv
    """,
    "responses": """
        Contact FlexibleOutcome FlexibleResponse Outcome Response contact_forces outcome_flexible simulate_flexible
    """,
    "studies": """
        Borders Critical Grid OverturningMap Region Sensitivity SensitivityMap Spectrum critical_durations
        overturning_borders self_similar_spectrum sensitivity sensitivity_map use_cpu_devices
    """,
}
_HOMES = {name: space for space, names in _MOVED.items() for name in names.split()}


def moved(name: str) -> Any:
    """What a name of before means now, with a warning that says where it is."""
    if name not in _HOMES:
        raise AttributeError(f"module 'jaxrock' has no attribute {name!r}")
    home = _HOMES[name]
    told = f"`jaxrock.{name}` is `jaxrock.{home}.{name}` now; the old name goes with the first release."
    warnings.warn(told, DeprecationWarning, stacklevel=3)
    return getattr(getattr(importlib.import_module("jaxrock"), home), name)
