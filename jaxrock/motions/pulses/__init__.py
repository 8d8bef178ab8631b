"""Pulses, one family a file. A pulse class defined in a file here is public and known to the command line.

Imports `motions.motion` and `numerics`. Start with `pulse`, then `sinusoidal`.
"""

import importlib
import inspect
import pkgutil

from jaxrock._arguments.parameters import declared
from jaxrock.motions.pulses.pulse import AbstractPulse


def _defined() -> dict[str, type[AbstractPulse]]:
    """Return every pulse class that a module of this folder defines, by name."""
    names = sorted(f"{__name__}.{found.name}" for found in pkgutil.iter_modules(__path__))
    kinds = [kind for name in names for kind in vars(importlib.import_module(name)).values()]
    return {
        kind.__name__: kind
        for kind in kinds
        if isinstance(kind, type) and issubclass(kind, AbstractPulse) and not inspect.isabstract(kind)
    }


_KINDS = _defined()
PULSES = {kind.word(): kind for kind in _KINDS.values()}  # by the word of the command line
# Units of the parameters that are not dimensionless.
UNITS = {name: known.unit for kind in _KINDS.values() for name, known in declared(kind).items() if known.unit != "-"}
globals().update(_KINDS)
__all__ = list(_KINDS)
