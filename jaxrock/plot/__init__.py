"""Figures: functions that take results, draw them into matplotlib axes and return the axes.

The package imports all others except `command_line`. Each kind of result has a module; a new figure is a function in
one of them, under `style.figure`, and an import here.
"""

from jaxrock._core.namespace import shown as _shown
from jaxrock.plot.animations import animate as animate, save_animation as save_animation
from jaxrock.plot.closed_forms import safety_regions as safety_regions, sine_regions as sine_regions
from jaxrock.plot.drawings import scene as scene
from jaxrock.plot.fits import found_record as found_record, history_fit as history_fit
from jaxrock.plot.fragilities import fragility as fragility, fragility_surface as fragility_surface
from jaxrock.plot.regions import feasible_region as feasible_region, search as search
from jaxrock.plot.responses import history as history, phase as phase
from jaxrock.plot.rocks import righting as righting, slenderness as slenderness
from jaxrock.plot.sensitivities import (
    critical as critical,
    critical_scales as critical_scales,
    sensitivity_map as sensitivity_map,
    tornado as tornado,
)
from jaxrock.plot.spectra import spectrum as spectrum
from jaxrock.plot.stroboscopic import (
    basins_of_attraction as basins_of_attraction,
    bifurcation_diagram as bifurcation_diagram,
)
from jaxrock.plot.style import broken_curve as broken_curve, log_ticks as log_ticks
from jaxrock.plot.surfaces import borders as borders, overturning as overturning


def __dir__() -> list[str]:
    return _shown(globals())
