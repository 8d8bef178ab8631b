"""Figures: functions that take results, draw them into matplotlib axes and return the axes.

Imports everything but `command_line`. One module for each kind of result; another figure is a function in one of them.
"""

from jaxrock.plot.closed_forms import safety_regions as safety_regions, sine_regions as sine_regions
from jaxrock.plot.fits import history_fit as history_fit
from jaxrock.plot.fragilities import fragility as fragility, fragility_surface as fragility_surface
from jaxrock.plot.regions import feasible_region as feasible_region
from jaxrock.plot.responses import history as history, phase as phase
from jaxrock.plot.rocks import slenderness as slenderness
from jaxrock.plot.sensitivities import critical as critical, sensitivity_map as sensitivity_map, tornado as tornado
from jaxrock.plot.surfaces import overturning as overturning, spectrum as spectrum
