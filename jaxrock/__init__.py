"""Rocking and overturning of free-standing blocks, on JAX.

Conventions: angles in rad, time in s, accelerations in g; positive ground acceleration drives negative
rotation; `alpha` is the slenderness angle, `p` the frequency parameter [rad/s], `restitution` the angular
velocity after an impact over that before it.
"""

import importlib
from typing import TYPE_CHECKING

from jaxrock import closed_form as closed_form, similarity as similarity
from jaxrock.arcs import Diffrax as Diffrax
from jaxrock.asymmetric import AsymmetricBlock as AsymmetricBlock
from jaxrock.block import Block as Block
from jaxrock.contact import Contact as Contact, contact_forces as contact_forces
from jaxrock.critical import (
    Critical as Critical,
    critical_amplitudes as critical_amplitudes,
    critical_durations as critical_durations,
)
from jaxrock.devices import use_cpu_devices as use_cpu_devices
from jaxrock.dispatch import outcome as outcome, simulate as simulate
from jaxrock.feasible import (
    FeasibleRegion as FeasibleRegion,
    Unexceeded as Unexceeded,
    feasible_region as feasible_region,
    unexceeded_motion as unexceeded_motion,
)
from jaxrock.flexible import (
    FlexibleResponse as FlexibleResponse,
    outcome_flexible as outcome_flexible,
    simulate_flexible as simulate_flexible,
)
from jaxrock.flexible_block import FlexibleBlock as FlexibleBlock
from jaxrock.flexible_scene import FlexibleOutcome as FlexibleOutcome
from jaxrock.fragility import (
    AbstractFragility as AbstractFragility,
    FitStatus as FitStatus,
    FragilityFit as FragilityFit,
    LogNormalFragility as LogNormalFragility,
    TabulatedFragility as TabulatedFragility,
    fit_fragility as fit_fragility,
)
from jaxrock.grid import Grid as Grid
from jaxrock.hazard import (
    HazardCurve as HazardCurve,
    allowed_scale as allowed_scale,
    branch_weights as branch_weights,
    survival_probability as survival_probability,
    toppling_rate as toppling_rate,
)
from jaxrock.hazard_files import HazardCurves as HazardCurves, read_hazard_curves as read_hazard_curves
from jaxrock.histories import HistoryFit as HistoryFit, HistoryStatus as HistoryStatus, fit_history as fit_history
from jaxrock.intensity import peak_acceleration as peak_acceleration, peak_velocity as peak_velocity
from jaxrock.inverse import (
    Estimate as Estimate,
    EstimateStatus as EstimateStatus,
    estimate_motion as estimate_motion,
)
from jaxrock.likelihood import Likelihood as Likelihood
from jaxrock.models import Equation as Equation, Housner as Housner, Linear as Linear, Spring as Spring
from jaxrock.motion import AbstractMotion as AbstractMotion, Record as Record, WithVertical as WithVertical
from jaxrock.observation_files import read_observations as read_observations
from jaxrock.observations import Observations as Observations
from jaxrock.posterior import Posterior as Posterior, PosteriorStatus as PosteriorStatus, sample_motion as sample_motion
from jaxrock.problem import Unknown as Unknown
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
from jaxrock.records import example_record as example_record, read_record as read_record
from jaxrock.response import Outcome as Outcome, Response as Response
from jaxrock.sensitivity import (
    Sensitivity as Sensitivity,
    SensitivityMap as SensitivityMap,
    sensitivity as sensitivity,
    sensitivity_map as sensitivity_map,
)
from jaxrock.series import Series as Series
from jaxrock.spectra import (
    OverturningMap as OverturningMap,
    Spectrum as Spectrum,
    overturning_map as overturning_map,
    rocking_spectrum as rocking_spectrum,
    self_similar_spectrum as self_similar_spectrum,
)
from jaxrock.status import Status as Status
from jaxrock.suites import (
    SimulatedFragility as SimulatedFragility,
    Suite as Suite,
    draw_blocks as draw_blocks,
    simulated_fragility as simulated_fragility,
)
from jaxrock.surfaces import (
    SimulatedSurface as SimulatedSurface,
    SurfaceFit as SurfaceFit,
    SurfaceFragility as SurfaceFragility,
    fit_surface as fit_surface,
    simulated_surface as simulated_surface,
    surface_of as surface_of,
)
from jaxrock.sweeps import sweep as sweep

if TYPE_CHECKING:
    from jaxrock import plot as plot

__version__ = "0.1.0"


def __getattr__(name: str):
    # Figures are drawn by few programs that compute: `jaxrock.plot` is imported when it is first used.
    if name == "plot":
        return importlib.import_module("jaxrock.plot")
    raise AttributeError(f"module 'jaxrock' has no attribute {name!r}")
