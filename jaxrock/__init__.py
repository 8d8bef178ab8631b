"""Rocking and overturning of free-standing blocks, on JAX.

Conventions: angles in rad, time in s, accelerations in g; positive ground acceleration drives negative
rotation; `alpha` is the slenderness angle, `p` the frequency parameter [rad/s], `restitution` the angular
velocity after an impact over that before it.
"""

import importlib as _importlib
import typing as _typing

from jaxrock import closed_form as closed_form
from jaxrock._parameters import parameter as parameter
from jaxrock.blocks import restitution as restitution
from jaxrock.blocks.asymmetric import AsymmetricBlock as AsymmetricBlock
from jaxrock.blocks.flexible import FlexibleBlock as FlexibleBlock
from jaxrock.blocks.mesh import Rock as Rock
from jaxrock.blocks.random import draw_blocks as draw_blocks
from jaxrock.blocks.rigid import Block as Block
from jaxrock.engines.taylor.careful import Series as Series
from jaxrock.flexible.response import (
    FlexibleResponse as FlexibleResponse,
    outcome_flexible as outcome_flexible,
    simulate_flexible as simulate_flexible,
)
from jaxrock.flexible.stepper import FlexibleOutcome as FlexibleOutcome
from jaxrock.hazard.curves import (
    HazardCurve as HazardCurve,
    allowed_scale as allowed_scale,
    branch_weights as branch_weights,
    survival_probability as survival_probability,
    toppling_rate as toppling_rate,
)
from jaxrock.hazard.fragility import (
    AbstractFragility as AbstractFragility,
    FitStatus as FitStatus,
    FragilityFit as FragilityFit,
    LogNormalFragility as LogNormalFragility,
    TabulatedFragility as TabulatedFragility,
    fit_fragility as fit_fragility,
)
from jaxrock.hazard.nrml import write_nrml as write_nrml
from jaxrock.hazard.openquake import HazardCurves as HazardCurves, read_hazard_curves as read_hazard_curves
from jaxrock.hazard.probit import ProbitFit as ProbitFit, fit_probit as fit_probit
from jaxrock.hazard.simulated_fragility import (
    SimulatedFragility as SimulatedFragility,
    simulated_fragility as simulated_fragility,
)
from jaxrock.hazard.suite_outcomes import SuiteOutcomes as SuiteOutcomes, suite_outcomes as suite_outcomes
from jaxrock.hazard.surfaces import (
    SimulatedSurface as SimulatedSurface,
    SurfaceFit as SurfaceFit,
    SurfaceFragility as SurfaceFragility,
    fit_surface as fit_surface,
    simulated_surface as simulated_surface,
    surface_of as surface_of,
)
from jaxrock.inverse.block_calibration import (
    BlockCalibration as BlockCalibration,
    CalibrationStatus as CalibrationStatus,
    calibrate_block as calibrate_block,
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
from jaxrock.inverse.log_density import LogDensity as LogDensity, log_density as log_density
from jaxrock.inverse.observation_files import read_observations as read_observations
from jaxrock.inverse.observations import Observations as Observations
from jaxrock.inverse.posterior import (
    Posterior as Posterior,
    PosteriorStatus as PosteriorStatus,
    sample_motion as sample_motion,
)
from jaxrock.inverse.unknowns import Unknown as Unknown
from jaxrock.keeping.compiled import keep_compiled as keep_compiled
from jaxrock.models.coefficients import Coefficients as Coefficients, Terms as Terms
from jaxrock.models.equation import AbstractEquation as AbstractEquation
from jaxrock.models.rigid import Housner as Housner, Linear as Linear
from jaxrock.models.spring import Spring as Spring
from jaxrock.models.user_equation import Equation as Equation
from jaxrock.motions import intensity as intensity
from jaxrock.motions.components import Components as Components, read_components as read_components
from jaxrock.motions.files.example import example_record as example_record
from jaxrock.motions.files.reading import read_record as read_record
from jaxrock.motions.files.traces import record_of_trace as record_of_trace
from jaxrock.motions.files.writing import write_at2 as write_at2, write_csv as write_csv
from jaxrock.motions.intensity import peak_acceleration as peak_acceleration, peak_velocity as peak_velocity
from jaxrock.motions.motion import AbstractMotion as AbstractMotion, WithVertical as WithVertical
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
from jaxrock.motions.record import Origin as Origin, Record as Record
from jaxrock.motions.suite import Suite as Suite
from jaxrock.responses.contact import Contact as Contact, contact_forces as contact_forces
from jaxrock.responses.history import Response as Response, simulate as simulate
from jaxrock.responses.outcome import Outcome as Outcome, outcome as outcome
from jaxrock.status import Status as Status
from jaxrock.studies import (
    saved_outcomes as _saved_outcomes,  # noqa: F401  (what `Grid.load` knows again)
    similarity as similarity,
)
from jaxrock.studies.borders import (
    Borders as Borders,
    Region as Region,
    overturning_borders as overturning_borders,
)
from jaxrock.studies.critical import (
    Critical as Critical,
    critical_amplitudes as critical_amplitudes,
    critical_durations as critical_durations,
)
from jaxrock.studies.sensitivities import (
    Sensitivity as Sensitivity,
    SensitivityMap as SensitivityMap,
    sensitivity as sensitivity,
    sensitivity_map as sensitivity_map,
)
from jaxrock.studies.spectra import (
    OverturningMap as OverturningMap,
    Spectrum as Spectrum,
    overturning_map as overturning_map,
    rocking_spectrum as rocking_spectrum,
    self_similar_spectrum as self_similar_spectrum,
)
from jaxrock.sweeps.devices import use_cpu_devices as use_cpu_devices
from jaxrock.sweeps.grid import Grid as Grid
from jaxrock.sweeps.sweep import sweep as sweep

if _typing.TYPE_CHECKING:
    from jaxrock import plot as plot
    from jaxrock.engines.diffrax.arcs import Diffrax as Diffrax
    from jaxrock.motions import processing as processing

__version__ = "0.1.0"


def __getattr__(name: str):
    # Few programs that compute draw figures, or solve by Diffrax: both are imported when they are
    # first used, and so is SciPy's processing of signals.
    if name == "plot":
        return _importlib.import_module("jaxrock.plot")
    if name == "processing":
        return _importlib.import_module("jaxrock.motions.processing")
    if name == "Diffrax":
        return _importlib.import_module("jaxrock.engines.diffrax.arcs").Diffrax
    raise AttributeError(f"module 'jaxrock' has no attribute {name!r}")
