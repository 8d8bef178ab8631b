"""Infer motions and blocks from observed rocks, or from a measured history of rotation.

Holds likelihoods, estimates, posterior samples and regions of allowed motions. The package imports `studies` and
`responses`. Start reading with `likelihood`, then `estimate`.
"""

from jaxrock._core.namespace import shown as _shown
from jaxrock.inverse.block_calibration import (
    BlockCalibration as BlockCalibration,
    CalibrationStatus as CalibrationStatus,
    calibrate_block as calibrate_block,
)
from jaxrock.inverse.densities import (
    LogDensity as LogDensity,
    log_density as log_density,
)
from jaxrock.inverse.estimate import (
    Estimate as Estimate,
    EstimateStatus as EstimateStatus,
    estimate_motion as estimate_motion,
)
from jaxrock.inverse.feasible import (
    FeasibleRegion as FeasibleRegion,
    Unexceeded as Unexceeded,
    feasible_region as feasible_region,
    unexceeded_motion as unexceeded_motion,
)
from jaxrock.inverse.found_record import (
    FoundRecord as FoundRecord,
    RecordStatus as RecordStatus,
    find_record as find_record,
)
from jaxrock.inverse.history_fit import (
    HistoryFit as HistoryFit,
    HistoryStatus as HistoryStatus,
    fit_history as fit_history,
)
from jaxrock.inverse.likelihood import Likelihood as Likelihood
from jaxrock.inverse.observation_files import read_observations as read_observations
from jaxrock.inverse.observations import Observations as Observations
from jaxrock.inverse.posterior import (
    Posterior as Posterior,
    PosteriorStatus as PosteriorStatus,
    sample_motion as sample_motion,
)
from jaxrock.inverse.unknowns import Unknown as Unknown


def __dir__() -> list[str]:
    return _shown(globals())
