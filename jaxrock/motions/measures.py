"""Measures of intensity by name, and their growth with the scale of a motion."""

import re
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np

from jaxrock._core.arrays import shown
from jaxrock._core.did_you_mean import did_you_mean
from jaxrock.motions import intensity
from jaxrock.motions.files.parsing import NUMBER
from jaxrock.motions.motion import AbstractMotion
from jaxrock.motions.suite import Suite

# By OpenQuake's names (SV is not one of them): function, unit, and the power of a motion's scale as which each grows.
_NAMED: dict[str, tuple[Callable, str, float]] = {
    "PGA": (intensity.peak_acceleration, "g", 1.0),
    "PGV": (intensity.peak_velocity, "m/s", 1.0),
    "PGD": (intensity.peak_displacement, "m", 1.0),
    "IA": (intensity.arias, "m/s", 2.0),
    "CAV": (intensity.cumulative_absolute_velocity, "m/s", 1.0),
}
_AT_PERIOD = {"SA": (intensity.spectral_acceleration, "g"), "SV": (intensity.spectral_velocity, "m/s")}
NAMES = (*_NAMED, *(f"{name}(period)" for name in _AT_PERIOD))
_SPECTRAL = re.compile(rf"({'|'.join(_AT_PERIOD)})\(({NUMBER})\)")


class Measure(NamedTuple):
    """A measure of intensity: its name, and a function of a motion.

    `power` is the power of a motion's scale as which the measure grows; None: it is not known.
    """

    name: str
    function: Callable[[AbstractMotion], Any]
    power: float | None = None


def unit_of(name: str) -> str:
    """Return the unit of one of the package's measures by its name; empty for another name."""
    spectral = _SPECTRAL.fullmatch(name)
    return _AT_PERIOD[spectral[1]][1] if spectral else _NAMED[name][1] if name in _NAMED else ""


def are_different(first: str, second: str) -> bool:
    """Return whether two names are known to stand for different measures of the package."""

    def parts(name):
        spectral = _SPECTRAL.fullmatch(name)
        return (spectral[1], float(spectral[2])) if spectral else (name, None) if name in _NAMED else None

    first, second = parts(first), parts(second)
    return None not in (first, second) and first != second


def measure_of(name: str, value: str | Callable) -> Measure:
    """Return the measure that a word or a function stands for; `name` is the argument's name for messages.

    **Raises:** ValueError for an unknown word, or another kind of value.
    """
    spectral = _SPECTRAL.fullmatch(value) if isinstance(value, str) else None
    if spectral:
        function, period = _AT_PERIOD[spectral[1]][0], float(spectral[2])
        return Measure(spectral[0], lambda motion: float(function(motion, period)), 1.0)
    if isinstance(value, str) and value in _NAMED:
        function, _, power = _NAMED[value]
        return Measure(value, function, power)
    if callable(value) and not isinstance(value, type):
        return Measure(getattr(value, "__name__", type(value).__name__), value)
    words = ", ".join(repr(word) for word in NAMES)
    told = f"must be one of {words}, or a function of a motion, but is {shown(value)}.{did_you_mean(value, NAMES)}"
    raise ValueError(f"Argument `{name}` {told}")


def strengths(name: str, measure: Measure, suite: Suite) -> np.ndarray:
    """(motions,) Return a measure of all unscaled motions of a suite.

    **Raises:** ValueError for a value that is not a positive number.
    """
    peaks = {"PGA": suite.peak_acceleration, "PGV": suite.peak_velocity}
    if measure.power is not None and measure.name in peaks:
        return np.asarray(peaks[measure.name], float)
    values = [_number(name, measure, motion) for motion in suite.motions()]
    for value, title in zip(values, suite.names):
        if not 0 < value < np.inf:
            raise ValueError(f"Argument `{name}` must be positive for all motions, but is {value:g} for {title!r}.")
    return np.array(values)


def scaled_strengths(measure: Measure, suite: Suite, scale: np.ndarray) -> np.ndarray:
    """(motions, scales) Return a measure of all motions at all scales, by its power if it grows as one."""
    try:
        power = power_of("measures", measure, suite.motions())
    except ValueError:
        return np.array([[float(measure.function(s * motion)) for s in scale] for motion in suite.motions()])
    return np.array([float(measure.function(motion)) for motion in suite.motions()])[:, None] * scale**power


def power_of(name: str, measure: Measure, motions: Iterable[AbstractMotion]) -> float:
    """Return the power of a motion's scale as which a measure grows: 1 for peaks and spectra, 2 for Arias intensity.

    **Raises:** ValueError for a measure that grows otherwise, or not at all.
    """
    if measure.power is not None:
        return measure.power
    motion = next(iter(motions))
    one, two, three = (_number(name, measure, scaled) for scaled in (motion, 2.0 * motion, 3.0 * motion))
    with np.errstate(all="ignore"):
        powers = np.log([two / one, three / one]) / np.log([2.0, 3.0])
    if not (np.isfinite(powers).all() and abs(powers[0]) > 1e-6 and abs(powers[0] - powers[1]) < 1e-6):
        found = f"{one:g}, {two:g} and {three:g} of a motion, twice and three times as strong"
        raise ValueError(f"Argument `{name}` must grow as a power of a motion's scale, but is {found}.")
    return float(np.round(powers[0], 9))


def _number(name: str, measure: Measure, motion: AbstractMotion) -> float:
    value = measure.function(motion)
    try:
        return float(value)
    except (TypeError, ValueError) as error:
        raise ValueError(f"Argument `{name}` must give one number of a motion, but gives {shown(value)}.") from error
